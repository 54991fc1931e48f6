# Two commands do everything from a bare Debian machine: `make demo` and `make test`.
SHELL := /bin/bash
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PLANNER ?= base-135m
INSTRUCTION ?= put the red cube in the bowl
ROBOT ?= panda
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1

KERNEL_SOURCES := CMakeLists.txt $(shell find kernel -name '*.c' -o -name '*.h' -o -name '*.cpp')

.PHONY: help demo test setup format check kernel pytest smoke evidence docs release-check experiments bench analysis clean

help:  ## list the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 16

$(VENV)/.ready: pyproject.toml constraints.txt scripts/setup.sh $(KERNEL_SOURCES)
	@PYTHON=$(PYTHON) VENV=$(VENV) scripts/setup.sh
	@touch $@

setup: $(VENV)/.ready  ## system packages, virtual environment, compiled kernel

demo: setup  ## run the main example: model files, live view, report
	@$(BIN)/dualbrain models fetch $(PLANNER) minilm-l6-v2-int8 minilm-l6-v2-tokenizer
	@$(BIN)/dualbrain demo "$(INSTRUCTION)" --planner $(PLANNER) $(if $(HEADLESS),--headless)

test: setup check kernel pytest smoke  ## all checks and tests

format: setup  ## format the code and fix lint findings
	@$(BIN)/ruff format . && $(BIN)/ruff check --fix .

check: setup  ## format, lint, types, import layers, rules on names and layout
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/basedpyright
	$(BIN)/lint-imports
	$(BIN)/python -m tools.structure

kernel: setup  ## the tests of the C kernel, under sanitizers
	$(BIN)/python -m pytest -q -n 2 tests/kernel

pytest: setup  ## the tests of the package; COVERAGE=1 prints the line coverage
	@$(BIN)/dualbrain models fetch smollm2-135m-instruct minilm-l6-v2-int8 minilm-l6-v2-tokenizer efficientnet-lite0
	$(BIN)/python -m pytest -q -n 2 --durations=25 $(if $(COVERAGE),--cov=dualbrain --cov-report=term:skip-covered) --ignore=tests/kernel

smoke: setup  ## the evaluation protocol from end to end, six episodes without a language model
	@rm -rf build/smoke
	$(BIN)/dualbrain evaluate --suite smoke --out build/smoke
	$(BIN)/dualbrain report build/smoke --gallery 0

evidence: setup  ## tests of the safety requirements, and the evidence folder of ROBOT at SITE, in build/evidence
	@rm -rf build/evidence build/evidence_tests.xml
	-$(BIN)/python -m pytest -q -m "" --junitxml=build/evidence_tests.xml $$($(BIN)/dualbrain evidence tests)
	$(BIN)/dualbrain evidence write $(ROBOT) $(if $(SITE),--site $(SITE)) --tests build/evidence_tests.xml --out build/evidence

docs: setup  ## the documentation site, in build/site; warnings are errors
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet

release-check: setup  ## distributions in dist/, checked in new environments; ALLOW_MISSING=1 without all Pythons
	@$(BIN)/python -m tools.release --write-docs $(if $(ALLOW_MISSING),--allow-missing)

experiments: setup  ## the slow experiments, resumable; logs are written to experiments/runs/
	@$(BIN)/python -m experiments

bench: setup  ## timings beside named peers, the compiled kernel at worst, mutants of it
	@$(BIN)/python -m benchmarks.gate && $(BIN)/python -m benchmarks.filter_step
	@$(BIN)/python -m benchmarks.peers.setup_environments && $(BIN)/python -m benchmarks.filter_latency
	@$(BIN)/python -m tools.kernel_limits && $(BIN)/python -m tools.mutation --seed 1 --count 60 --resume

analysis: setup  ## static analysis and fuzzing of the kernel, resumable; needs frama-c-base, cppcheck and clang
	@$(BIN)/python -m tools.static_analysis --write-docs

clean:
	rm -rf $(VENV) build runs
