# The user's targets. The flow itself is declared in pipeline/dag.py and expanded by pipeline/plan.py into
# build/<agent>/plan/rules.mk, which is included here for the agents named on the command line.
SHELL := /bin/sh
MAKEFLAGS += --no-builtin-rules --no-builtin-variables
ifndef NESTED
MAKEFLAGS += -j$(shell nproc 2>/dev/null || echo 2)
endif
.SUFFIXES:
.DELETE_ON_ERROR:
.DEFAULT_GOAL := help

PYTHON := .venv/bin/python
PLAN   := $(PYTHON) -SE -m pipeline.plan
RUN    := $(PYTHON) -SE -m pipeline.run $(if $(PROCESSES),--processes $(PROCESSES))
COMMANDS := help new capture-check annotate behavior-tables registration-tables reconstruction-tables ablations longterm-tables behavior-benchmark export simulate serve extras test doctor clean
AGENTS := $(filter-out $(COMMANDS),$(patsubst agents/%.toml,%,$(wildcard agents/*.toml)))
WANTED := $(foreach a,$(AGENTS),$(if $(filter $a $a.%,$(MAKECMDGOALS)),$a))

.PHONY: $(COMMANDS) FORCE
# Where an agent's, or its variant's, own things stand; what a variant does not touch is its agent's (`INPUTS` knows).
ANIMAL := $(or $(AGENT),cat)
HOME_OF := build/$(ANIMAL)$(if $(VARIANT),/variants/$(VARIANT))
INPUTS = inputs=$$($(PLAN) inputs $(HOME_OF:build/%=%) $1)
# Called by a recipe, make shares the caller's jobs: as many at once as -j allows in all.
NESTING := --no-print-directory NESTED=1

help:
	@sed 's/cat/$(ANIMAL)/g' pipeline/help.txt
	@echo 'agents: $(AGENTS)'

include $(WANTED:%=build/%$(if $(TABLES),/tables)$(if $(VARIANT),/variants/$(VARIANT))/plan/rules.mk)
build/%/plan/rules.mk: .venv/.ok FORCE
	@$(PLAN) plan $* $(if $(MAKE_RESTARTS),>/dev/null)

.venv/.ok: envs/cpu.txt envs/cuda.txt envs/setup
	@envs/setup

behavior-tables: .venv/.ok
	@$(MAKE) $(NESTING) TABLES=1 $(ANIMAL).behavior_tables
	@cat build/$(ANIMAL)/behavior_tables/tables.txt

behavior-benchmark: .venv/.ok
	@$(MAKE) $(NESTING) behavior-tables AGENT=benchmark

registration-tables reconstruction-tables: %-tables: .venv/.ok
	@set -e; for variant in $$($(PYTHON) -SE -c 'from pipeline import dag; print(*dag.VARIANTS["$*"])'); do \
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

# One format for another program, after the simulator; with a take of `make simulate` as one motion more.
export: .venv/.ok
	@$(PYTHON) -m stages.export --format $(or $(FORMAT),glb) --help >/dev/null
	@$(MAKE) $(NESTING) $(ANIMAL).simulator
	@$(call INPUTS,simulator reconstruction splats behavior_data frames masks) && \
	$(PYTHON) -m stages.export $$inputs --format $(or $(FORMAT),glb) $(if $(INFLUENCES),--influences $(INFLUENCES)) \
	  $(if $(wildcard $(HOME_OF)/take/manifest.json),--take $(HOME_OF)/take) \
	  --videos build/$(ANIMAL)/plan/videos.json --out $(HOME_OF)/exports/$(or $(FORMAT),glb)
	@echo '[$(HOME_OF)] written: $(HOME_OF)/exports/$(or $(FORMAT),glb); what is lost stands in its export.json'

# The behaviour model without a page: half a minute beside a scripted observer; `serve` shows it live.
JOURNEY = $(if $(SUBGOALS)$(PLACES),longterm) $(if $(SUBGOALS)$(filter-out behavior,$(PLACES)),,behavior)
simulate: .venv/.ok
	@test -z '$(SUBGOALS)' || test -f '$(SUBGOALS)' || { { echo "error: SIM-004 $(SUBGOALS): there is no such file"; echo "  -> write it as docs/long_motion.md tells"; } >&2; exit 2; }
	@$(if $(PLACES),$(PYTHON) -m stages.simulate --places '$(PLACES)' --help >/dev/null)
	@$(MAKE) $(NESTING) $(JOURNEY:%=$(ANIMAL).%)
	@$(call INPUTS,$(JOURNEY) $(if $(filter longterm,$(JOURNEY)),reconstruction) behavior_data) && \
	$(PYTHON) -m stages.simulate $$inputs $(if $(SUBGOALS),--subgoals '$(SUBGOALS)') $(if $(PLACES),--places '$(PLACES)') --out $(HOME_OF)/take

serve: .venv/.ok
	@$(MAKE) $(NESTING) $(ANIMAL).simulator
	@$(call INPUTS,behavior behavior_data simulator) && $(PYTHON) -m stages.simulate $$inputs --serve --out $(HOME_OF)/take

extras: .venv/.ok
	@envs/extras

test: .venv/.ok
	@$(PYTHON) -m pytest tests

doctor: .venv/.ok
	@$(PYTHON) -m pipeline.doctor

clean:
	rm -rf build .snakemake

# A table compares variants that its own rule cannot make; name what does.
.DEFAULT:
	@case '$@' in build/*/variants/*) \
	  set -- $(subst /, ,$@); echo "error: REC-007 '$@' belongs to variant $$4 of $$2 and is not there yet" >&2; \
	  echo "  -> one variant: make $$2.$$5 VARIANT=$$4; a table with all it compares: make $$5-tables AGENT=$$2" >&2; exit 2;; esac
	@echo "error: REC-007 nobody knows how to make '$@'" >&2
	@echo "  -> $(if $(filter $(AGENTS:%=%.%),$@),artifacts: $$($(PYTHON) -SE -c 'from pipeline import dag; print(*dag.NODES)'),agents: $(AGENTS); a new one: make new AGENT=<name>); all else: make help" >&2; exit 2
