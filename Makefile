# The user's targets. The flow itself is declared in pipeline/dag.py and expanded by pipeline/plan.py into
# build/<agent>/plan/rules.mk, which is included here for the agents named on the command line.
SHELL := /bin/sh
MAKEFLAGS += --no-builtin-rules --no-builtin-variables
ifeq ($(filter -j%,$(MAKEFLAGS)),)
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

.PHONY: help new capture-check annotate behavior-tables behavior-benchmark test doctor clean FORCE

help:
	@sed 's/make cat/make $(or $(AGENT),cat)/' pipeline/help.txt
	@echo 'agents: $(AGENTS)'

include $(WANTED:%=build/%$(if $(TABLES),/tables)$(if $(VARIANT),/variants/$(VARIANT))/plan/rules.mk)
build/%/plan/rules.mk: .venv/.ok FORCE
	@$(PLAN) plan $* $(if $(MAKE_RESTARTS),>/dev/null)

.venv/.ok: envs/cpu.txt envs/cuda.txt envs/setup
	@envs/setup

behavior-tables: .venv/.ok
	@$(MAKE) --no-print-directory TABLES=1 $(or $(AGENT),cat).behavior_tables
	@cat build/$(or $(AGENT),cat)/behavior_tables/tables.txt

behavior-benchmark: .venv/.ok
	@$(MAKE) --no-print-directory behavior-tables AGENT=benchmark

new: .venv/.ok
	@$(PLAN) new '$(AGENT)'

annotate: .venv/.ok
	@$(PYTHON) -m stages.annotate build/$(or $(AGENT),cat) --clicks captures/$(or $(AGENT),cat)/clicks.json

capture-check: .venv/.ok
	@$(PYTHON) -m stages.check_captures captures/$(or $(AGENT),cat)

test: .venv/.ok
	@$(PYTHON) -m pytest tests

doctor: .venv/.ok
	@$(PYTHON) -m pipeline.doctor

clean:
	rm -rf build .snakemake
