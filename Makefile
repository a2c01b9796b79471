# The user's targets. The flow itself is declared in pipeline/workflow/dag.py and expanded by pipeline/workflow/plan.py into
# build/<agent>/plan/rules.mk, which is included here for the agents named on the command line.
SHELL := /bin/sh
MAKEFLAGS += --no-builtin-rules --no-builtin-variables
ifndef NESTED
MAKEFLAGS += -j$(shell envs/parallel_jobs)
endif
.SUFFIXES:
.DELETE_ON_ERROR:
.DEFAULT_GOAL := help

# `HOME=other` on the command line names the build whose home the animal lives in; programs get the user's own.
ifeq ($(origin HOME),command line)
OTHER := $(HOME)
override HOME := $(shell eval echo "~$$(id -un)")
endif

PYTHON := .venv/bin/python
PLAN   := $(PYTHON) -SE -m pipeline.workflow.plan
RUN    := $(PYTHON) -SE -m pipeline.workflow.run $(if $(PROCESSES),--processes $(PROCESSES))
COMMANDS := help new capture-check annotate behavior-tables registration-tables reconstruction-tables ablations longterm-tables behavior-benchmark real-benchmark gallery export simulate serve extras dev types test test-fast test-slurm fuzz reproduce verify doctor clean
AGENTS := $(filter-out $(COMMANDS),$(patsubst agents/%.toml,%,$(wildcard agents/*.toml)))
WANTED := $(foreach a,$(AGENTS),$(if $(filter $a $a.%,$(MAKECMDGOALS)),$a))

.PHONY: $(COMMANDS) FORCE
# Some systems put the host's name into the environment as NAME; make takes it from its command line only.
ifeq ($(origin NAME),environment)
NAME :=
endif
# A variable on the command line that nothing reads is a typing error.
VARIABLES := AGENT NAME ABSENT REPLAYED HOME VARIANT FORMAT PLACES PROCESSES LOCK BODY GUIDANCE SUBGOALS DATA CRATE FUZZ
given = $(subst :,,$(firstword $(subst =, ,$1)))
$(foreach each,$(subst \$() $(),_,$(MAKEOVERRIDES)),$(if $(filter $(call given,$(each)),$(VARIABLES) PYTHON WORKERS NESTED TABLES),,$(error \
  REC-004 there is no variable $(call given,$(each)): known are $(VARIABLES))))
# Variables that become part of a command line or a path may contain plain names only.
PLAIN := a b c d e f g h i j k l m n o p q r s t u v w x y z 0 1 2 3 4 5 6 7 8 9 _ -
rest = $(if $1,$(call rest,$(wordlist 2,99,$1),$(subst $(firstword $1),,$2)),$2)
$(foreach name,AGENT NAME ABSENT REPLAYED OTHER VARIANT FORMAT PLACES PROCESSES LOCK BODY,$(if $(call rest,$(PLAIN),$(value $(name))),$(error REC-004 \
  $(name) is no plain name: use a-z, 0-9, _ and -)))
$(if $(call rest,$(PLAIN) = .,$(subst $() $(),,$(value GUIDANCE))),$(error REC-004 GUIDANCE is no list of NAME=SCALE: person=1.5 dog=2))
$(if $(NESTED),,$(if $(and $(NAME),$(WANTED)),$(error REC-004 NAME is for export, serve, simulate and verify: a build makes all \
  animals of a home)))
# Folder of an agent, of its variant, or of one animal of a home (NAME=); `INPUTS` takes what a variant does not change from
# its agent.
ANIMAL := $(or $(AGENT),cat)
HOME_OF := build/$(ANIMAL)$(if $(VARIANT),/variants/$(VARIANT))$(if $(NAME),/animals/$(NAME))
INPUTS = inputs=$$($(PLAN) inputs $(HOME_OF:build/%=%) $1)
TOGETHER_INPUTS = inputs=$$($(PLAN) together $(HOME_OF:build/%=%) $1)
# Nested make shares the job slots of its caller.
NESTING := --no-print-directory NESTED=1

help:
	@sed 's/cat/$(ANIMAL)/g' pipeline/workflow/help.txt
	@echo 'agents: $(AGENTS)'

RULES := $(WANTED:%=build/%$(if $(TABLES),/tables)$(if $(VARIANT),/variants/$(VARIANT))/plan/rules.mk)
include $(RULES)
build/%/plan/rules.mk: .venv/.ok FORCE
	@$(PLAN) plan $* $(if $(MAKE_RESTARTS),>/dev/null)

# LOCK=cuda or cpu, if jobs run on another machine than this one (a login node without a GPU); `doctor` shows it.
.venv/.ok: envs/cpu.txt envs/cuda.txt envs/setup $(if $(LOCK),$(if $(filter-out $(LOCK),$(shell cat .venv/lock 2>/dev/null || echo none)),FORCE))
	@envs/setup $(LOCK)

behavior-tables: .venv/.ok
	@$(MAKE) $(NESTING) TABLES=1 $(ANIMAL).behavior_tables
	@cat build/$(ANIMAL)/behavior_tables/tables.txt

behavior-benchmark: .venv/.ok
	@$(MAKE) $(NESTING) behavior-tables AGENT=benchmark

# DATA is a folder of public data; rows without data are skipped, with the expected layout.
real-benchmark: .venv/.ok
	@$(if $(DATA),,$(error REC-004 give DATA=folder, which holds the public data))$(PYTHON) -m benchmarks.real "$$DATA"

registration-tables reconstruction-tables: %-tables: .venv/.ok
	@set -e; for variant in $$($(PYTHON) -SE -c 'from pipeline.workflow import dag; print(*dag.VARIANTS["$*"])'); do \
	  $(MAKE) $(NESTING) $(ANIMAL).$* VARIANT=$$variant; done
	@$(MAKE) $(NESTING) $(ANIMAL).$*_tables
	@cat build/$(ANIMAL)/$*_tables/tables.txt

ablations: registration-tables reconstruction-tables

longterm-tables: .venv/.ok
	@$(MAKE) $(NESTING) $(ANIMAL).longterm_tables
	@cat build/$(ANIMAL)/longterm_tables/tables.txt

new: .venv/.ok
	@$(PLAN) new "$$AGENT" $(COMMANDS)

annotate: .venv/.ok
	@$(PYTHON) -m stages.annotate build/$(ANIMAL) --clicks captures/$(ANIMAL)/clicks.json

capture-check: .venv/.ok
	@$(PYTHON) -m stages.check_captures 'captures/$(ANIMAL)'

# One page over everything in build/, with links to the simulators and reports.
gallery: .venv/.ok
	@$(PYTHON) -m stages.compile_gallery build

# A wrong NAME is refused before anything is built.
CHECK_NAME = $(if $(NAME),@$(PLAN) plan $(ANIMAL) >/dev/null && $(PLAN) inputs $(HOME_OF:build/%=%) >/dev/null)

# One export format; includes a take of `make simulate` as a further motion, optionally on the body of another build
# (BODY=luna).
EXPORTED = $(HOME_OF)/exports/$(or $(FORMAT),glb)$(BODY:%=_on_%)
export: .venv/.ok
	$(CHECK_NAME)
	@$(PYTHON) -m stages.export --format $(or $(FORMAT),glb) --help >/dev/null
	@$(if $(BODY),$(PLAN) plan $(BODY))
	@$(MAKE) $(NESTING) $(ANIMAL).simulator $(BODY:%=%.simulator)
	@$(call INPUTS,simulator reconstruction splats behavior_data frames masks) && \
	$(PYTHON) -m stages.export $$inputs --format $(or $(FORMAT),glb) \
	  $(if $(wildcard $(HOME_OF)/take/manifest.json),--take $(HOME_OF)/take) \
	  $(BODY:%=--body build/%/simulator) --videos build/$(ANIMAL)$(if $(NAME),/animals/$(NAME))/plan/videos.json --out $(EXPORTED)
	@echo '[$(HOME_OF)] written: $(EXPORTED); export.json lists what is lost'

# The behavior model without a page: half a minute beside a scripted observer; `serve` shows it live. In a home of several
# animals all are simulated, without one (ABSENT=) or with a recorded one (REPLAYED=); a single one with NAME=. In the home of
# another build (HOME=other): a take, and a page that starts from it. GUIDANCE='person=1.5 dog=2': reactions to whom.
JOURNEY = $(if $(SUBGOALS)$(PLACES),longterm) $(if $(SUBGOALS)$(filter-out behavior,$(PLACES)),,behavior)
export SUBGOALS
ELSEWHERE = $(HOME_OF)/homes/$(OTHER)
MOVED = reconstruction splats behavior behavior_data
TOGETHER = $(if $(SUBGOALS)$(PLACES),INPUTS,TOGETHER_INPUTS)
PAGES = stages.export_simulator
simulate: .venv/.ok
	$(CHECK_NAME)
	@test -z "$$SUBGOALS" || test -f "$$SUBGOALS" || { { echo "error: SIM-004 $$SUBGOALS: there is no such file"; echo "  -> write it as docs/long_motion.md explains"; } >&2; exit 2; }
	@$(if $(PLACES),$(PYTHON) -m stages.simulate --places '$(PLACES)' --help >/dev/null)
	@$(if $(OTHER),$(PLAN) plan $(OTHER))
	@$(MAKE) $(NESTING) $(JOURNEY:%=$(ANIMAL).%) $(if $(OTHER),$(ANIMAL).splats $(OTHER).splats $(OTHER).behavior_data)
	@$(call $(TOGETHER),$(JOURNEY) $(if $(filter longterm,$(JOURNEY)),reconstruction) behavior_data $(if $(OTHER),feature_basis scene_template)) && \
	$(PYTHON) -m stages.simulate $$inputs $(if $(SUBGOALS),--subgoals "$$SUBGOALS") $(if $(PLACES),--places '$(PLACES)') $(if $(OTHER),--home build/$(OTHER)) \
	  $(if $(ABSENT),--absent $(ABSENT)) $(if $(REPLAYED),--replayed $(REPLAYED)) $(if $(GUIDANCE),--guidance $(GUIDANCE)) --out $(if $(OTHER),$(ELSEWHERE),$(HOME_OF))/take
	@$(if $(OTHER),$(call TOGETHER_INPUTS,$(MOVED)) && case "$$inputs" in (--animals*) kind=home_simulator page=$(PAGES).home; \
	  set -- $$inputs; inputs="--reconstruction $$2 --splats $$2 --behavior $$2 --behavior-data $$2";; (*) kind=simulator page=$(PAGES);; esac && \
	$(PYTHON) -m $$page $$inputs --config $(HOME_OF)/plan/configs/$$kind.json \
	  --home build/$(OTHER) --take $(ELSEWHERE)/take --out $(ELSEWHERE)/$$kind && echo "[$(HOME_OF)] open: $(ELSEWHERE)/$$kind/index.html")

serve: .venv/.ok
	$(CHECK_NAME)
	@$(MAKE) $(NESTING) $(ANIMAL).simulator
	@$(call INPUTS,behavior behavior_data simulator) && $(PYTHON) -m stages.simulate $$inputs --serve --out $(HOME_OF)/take

extras: .venv/.ok
	@envs/extras

# Type checker and run-time checks of array shapes, from a hashed lock, as in .ci/run.
dev: .venv/.ok
	@$(PYTHON) -m pip install --quiet --disable-pip-version-check --no-deps --require-hashes -r envs/dev.txt

types: dev
	@.venv/bin/basedpyright

# One test process per core, at most four: each takes up to 1.5 GB.
WORKERS := auto --maxprocesses 4
test: .venv/.ok
	@$(PYTHON) -m pytest tests -n $(WORKERS) --no-loadscope-reorder

# Fast tests for development, without those marked `slow` and `toy`.
test-fast: .venv/.ok
	@$(PYTHON) -m pytest tests -n $(WORKERS) -m 'not slow and not toy'

# A flow on a local Slurm that the test starts; skipped without slurmctld, slurmd, munge or the Snakemake plugin.
test-slurm: .venv/.ok
	@$(PYTHON) -m pytest tests/pipeline/workflow/test_slurm.py -rs

# Fuzz every reader of user files for a minute each; failing inputs are kept in build/fuzz.
fuzz: .venv/.ok
	@$(PYTHON) -m tests.fuzz $(FUZZ)

doctor: .venv/.ok
	@$(PYTHON) -m pipeline.workflow.doctor

# Rebuild from the crate of a report and name the first artifact that differs.
reproduce: .venv/.ok
	@agent=$$($(PYTHON) -SE -m pipeline.workflow.reproduce begin '$(CRATE)') && \
	$(MAKE) $(NESTING) $$agent && \
	$(PYTHON) -SE -m pipeline.workflow.reproduce compare '$(CRATE)' $$agent

# Hash all files in build/<agent> and captures/<agent>; a build itself compares only keys, sizes and times.
verify: .venv/.ok
	$(CHECK_NAME)
	@$(PYTHON) -SE -m pipeline.workflow.verify $(HOME_OF:build/%=%)

# All builds, or that of AGENT (or of its VARIANT) alone.
clean:
	rm -rf $(if $(AGENT),$(HOME_OF),build .snakemake)

# A table compares variants that its own rule cannot build; name the command that does.
.DEFAULT:
	@case '$@' in build/*/variants/*) \
	  set -- $(subst /, ,$@); echo "error: REC-007 '$@' belongs to variant $$4 of $$2 and is not there yet" >&2; \
	  echo "  -> one variant: make $$2.$$5 VARIANT=$$4; a table with all it compares: make $$5-tables AGENT=$$2" >&2; exit 2;; esac
	@echo "error: REC-007 there is no target '$@'" >&2
	@echo "  -> $(if $(filter $(AGENTS:%=%.%),$@),artifacts: $$(sed -n 's/^\.PHONY: [^.]*\.\([a-z_]*\) .*/\1/p' $(RULES) | tr '\n' ' '),agents: $(AGENTS); a new one: make new AGENT=<name>); all else: make help" >&2; exit 2
