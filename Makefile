# `make demo` runs the main job on the embedded data set; `make demo WEIGHTS=1` downloads learned features first and uses
# them. Tests: `make test-fast` while editing, `make test` before a commit, `make test-all` before a release,
# `make test-wheel` for what is installed.
PYTHON ?= python3
CONSTRAINTS ?= /dev/null
BIN := .venv/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint $(CONSTRAINTS)

PYTEST := $(BIN)/python -m pytest --numprocesses auto --maxprocesses 4 --dist loadfile --timeout 900
# Half the compilation, for tests of logic. Tests of bits and of parity with other code are marked `optimized`.
FLAGS := --xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1
QUICK := JAX_DISABLE_MOST_OPTIMIZATIONS=1 XLA_FLAGS="`cat .venv/.flags`"

.PHONY: demo test test-fast test-all test-wheel setup check benchmark clean

demo: setup
	$(if $(WEIGHTS),$(BIN)/mfvpr weights download recommended)
	$(BIN)/mfvpr evaluate $(if $(WEIGHTS),system=mfvpr) scorer=demo

test-fast: .venv/.test .venv/.flags
	$(QUICK) $(PYTEST) -m 'not (slow or thorough or optimized)'

test: .venv/.test .venv/.flags
	$(QUICK) $(PYTEST) -m 'not (slow or optimized)'; quick=$$?; \
	$(PYTEST) -m 'optimized and not slow' && exit $$quick

test-all: test
	$(PYTEST) -m slow

# The quick tests on the installed wheel, outside of this folder, without any optional dependency.
test-wheel: .venv/.test
	@folder=`mktemp -d`; trap "rm -rf $$folder" EXIT; \
	$(BIN)/python -m hatchling build -t wheel -d $$folder && $(PYTHON) -m venv $$folder/env && \
	$$folder/env/bin/python -m pip install --quiet --disable-pip-version-check $$folder/*.whl pytest pytest-xdist && \
	cp -r tests pyproject.toml $$folder && cd $$folder && \
	JAX_DISABLE_MOST_OPTIMIZATIONS=1 env/bin/python -m pytest --numprocesses auto --maxprocesses 4 --dist loadfile \
	-m 'not (slow or thorough or optimized)'

setup: .venv/.setup

check: .venv/.check  ## style and types
	$(BIN)/ruff check . && $(BIN)/ruff format --check . && $(BIN)/pyright

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

# XLA ends a process at a flag that it does not know.
.venv/.flags: .venv/.setup
	@XLA_FLAGS='$(FLAGS)' $(BIN)/python -c 'import jax; jax.devices()' > $@ 2>&1 && echo '$(FLAGS)' > $@ || : > $@
