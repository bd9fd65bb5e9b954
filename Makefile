# `make demo` runs the main job on the embedded data set. Tests: `make test-fast` while editing, `make test` before a
# commit, `make test-all` before a release.
PYTHON ?= python3
BIN := .venv/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check

PYTEST := $(BIN)/python -m pytest --numprocesses auto --maxprocesses 4 --dist loadfile
# Half the compilation, for tests of logic. Tests of bits and of parity with other code are marked `optimized`.
QUICK := JAX_DISABLE_MOST_OPTIMIZATIONS=1 \
  XLA_FLAGS='--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1'

.PHONY: demo test test-fast test-all setup check conf benchmark clean

demo: setup
	$(BIN)/mfvpr evaluate scorer=demo

test-fast: .venv/.test
	$(QUICK) $(PYTEST) -m 'not (slow or thorough or optimized)'

test: .venv/.test
	$(QUICK) $(PYTEST) -m 'not (slow or optimized)'
	$(PYTEST) -m 'optimized and not slow'

test-all: .venv/.test
	$(PYTEST)

setup: .venv/.setup

check: .venv/.check  ## style and types
	$(BIN)/ruff check . && $(BIN)/ruff format --check . && $(BIN)/pyright

conf: setup  ## the files of conf/ that follow from the scores' classes
	$(BIN)/python -m mfvpr.cli.declare

benchmark: .venv/.benchmark
	$(BIN)/python -m experiments.benchmark

clean:
	rm -rf .venv .pytest_cache .ruff_cache .hypothesis

.venv/.setup: pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "mfvpr needs Python 3.11 or newer, $(PYTHON) is $$($(PYTHON) --version 2>&1); name another: make PYTHON=python3.12 demo"; exit 2; }
	@echo "Installing mfvpr into .venv (once, about a minute) ..."
	@$(PYTHON) -m venv .venv
	@$(PIP) --editable .
	@touch $@

.venv/.test .venv/.check .venv/.benchmark: .venv/.%: .venv/.setup
	@$(PIP) --editable '.[$*]'
	@touch $@
