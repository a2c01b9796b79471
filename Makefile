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
RUN    := $(PYTHON) -SE -m pipeline.run
AGENTS := $(patsubst agents/%.toml,%,$(wildcard agents/*.toml))
WANTED := $(foreach a,$(AGENTS),$(if $(filter $a $a.%,$(MAKECMDGOALS)),$a))

.PHONY: help new capture-check annotate behavior-tables registration-tables reconstruction-tables ablations longterm-tables behavior-benchmark export simulate serve extras test doctor clean FORCE
HOME_OF := build/$(or $(AGENT),cat)
INPUTS = $(foreach a,$1,--$(subst _,-,$a) $(HOME_OF)/$a)
# Called by a recipe, make shares the caller's jobs: as many at once as -j allows in all.
NESTING := --no-print-directory NESTED=1

help:
	@sed 's/make cat/make $(or $(AGENT),cat)/' pipeline/help.txt
	@echo 'agents: $(AGENTS)'

include $(WANTED:%=build/%$(if $(TABLES),/tables)$(if $(VARIANT),/variants/$(VARIANT))/plan/rules.mk)
build/%/plan/rules.mk: .venv/.ok FORCE
	@$(PLAN) plan $* $(if $(MAKE_RESTARTS),>/dev/null)

.venv/.ok: envs/cpu.txt envs/cuda.txt envs/setup
	@envs/setup

behavior-tables: .venv/.ok
	@$(MAKE) $(NESTING) TABLES=1 $(or $(AGENT),cat).behavior_tables
	@cat build/$(or $(AGENT),cat)/behavior_tables/tables.txt

behavior-benchmark: .venv/.ok
	@$(MAKE) $(NESTING) behavior-tables AGENT=benchmark

registration-tables reconstruction-tables: %-tables: .venv/.ok
	@set -e; for variant in $$($(PYTHON) -SE -c 'from pipeline import dag; print(*dag.VARIANTS["$*"])'); do \
	  $(MAKE) $(NESTING) $(or $(AGENT),cat).$* VARIANT=$$variant; done
	@$(MAKE) $(NESTING) $(or $(AGENT),cat).$*_tables
	@cat build/$(or $(AGENT),cat)/$*_tables/tables.txt

ablations: registration-tables reconstruction-tables

longterm-tables: .venv/.ok
	@$(MAKE) $(NESTING) $(or $(AGENT),cat).longterm_tables
	@cat build/$(or $(AGENT),cat)/longterm_tables/tables.txt

new: .venv/.ok
	@$(PLAN) new '$(AGENT)'

annotate: .venv/.ok
	@$(PYTHON) -m stages.annotate build/$(or $(AGENT),cat) --clicks captures/$(or $(AGENT),cat)/clicks.json

capture-check: .venv/.ok
	@$(PYTHON) -m stages.check_captures captures/$(or $(AGENT),cat)

# One format for another program, after the simulator; with a take of `make simulate` as one motion more.
export: .venv/.ok
	@$(PYTHON) -m stages.export --format $(or $(FORMAT),glb) --help >/dev/null
	@$(MAKE) $(NESTING) $(notdir $(HOME_OF)).simulator
	@$(PYTHON) -m stages.export $(call INPUTS,simulator reconstruction splats behavior_data frames masks) --format $(or $(FORMAT),glb) \
	  $(if $(wildcard $(HOME_OF)/take/manifest.json),--take $(HOME_OF)/take) \
	  --videos $(HOME_OF)/plan/videos.json --out $(HOME_OF)/exports/$(or $(FORMAT),glb)
	@echo '[$(HOME_OF)] written: $(HOME_OF)/exports/$(or $(FORMAT),glb); what is lost stands in its export.json'

# The behaviour model without a page: half a minute beside a scripted observer; `serve` shows it live.
simulate: .venv/.ok
	@test -z '$(SUBGOALS)' || test -f '$(SUBGOALS)' || { echo "error: SIM-004 $(SUBGOALS): there is no such file" >&2; exit 2; }
	@$(MAKE) $(NESTING) $(notdir $(HOME_OF)).$(if $(SUBGOALS),longterm,behavior)
	@$(PYTHON) -m stages.simulate $(if $(SUBGOALS),$(call INPUTS,longterm reconstruction behavior_data) --subgoals $(SUBGOALS),$(call INPUTS,behavior behavior_data)) --out $(HOME_OF)/take

serve: .venv/.ok
	@$(MAKE) $(NESTING) $(notdir $(HOME_OF)).simulator
	@$(PYTHON) -m stages.simulate $(call INPUTS,behavior behavior_data simulator) --serve --out $(HOME_OF)/take

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
	  echo "  -> one variant: make $$2.$$5 VARIANT=$$4; a table with all it compares: make registration-tables AGENT=$$2" >&2; exit 2;; esac
	@echo "error: REC-007 nobody knows how to make '$@'" >&2
	@echo "  -> agents: $(AGENTS); a new one: make new AGENT=<name>; artifacts and all else: make help" >&2; exit 2
