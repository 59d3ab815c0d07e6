# make demo, make test: everything else follows from these two. PYTHON chooses the interpreter of the environment.
SHELL := /bin/bash
PYTHON ?= python3
BIN := .venv/bin
LOWEST := .venv-lowest
OUT ?= out
# Tests run in this many processes; a file's tests stay in one of them.
TEST_PROCESSES ?= 2
PYTEST_OPTIONS := -q -n $(TEST_PROCESSES) --dist loadfile --no-loadscope-reorder

.PHONY: venv demo test lint test-lowest bench stress oclgrind devices-test gpu-check docs tables clean

venv: .venv/.installed

# torch comes first and by its exact version: a CPU build (+cpu) that pip is pointed to satisfies it; PyPI's has CUDA.
.venv/.installed: setup.py constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --constraint constraints.txt setuptools torch
	$(BIN)/python -m pip install --constraint constraints.txt --no-build-isolation --editable '.[dev,estimators]'
	touch $@

demo: venv
	$(BIN)/vestcl demo --out '$(OUT)'

lint: venv
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy vestcl train docs

# torch's OpenMP workers would spin on the cores that OpenCL's threads need, and there is a process a core.
test: lint
	OMP_NUM_THREADS=1 OMP_WAIT_POLICY=passive $(BIN)/pytest $(PYTEST_OPTIONS)

# The tests with the lowest versions that setup.py admits, on Python 3.10 or 3.11; torch is the same as in .venv.
test-lowest: $(LOWEST)/.installed
	OMP_NUM_THREADS=1 OMP_WAIT_POLICY=passive $(LOWEST)/bin/pytest $(PYTEST_OPTIONS)

$(LOWEST)/.installed: setup.py constraints.txt tests/support/lowest_versions.py
	$(PYTHON) -m venv $(LOWEST)
	$(LOWEST)/bin/python -m pip install --constraint constraints.txt setuptools torch
	$(LOWEST)/bin/python tests/support/lowest_versions.py > $(LOWEST)/requirements.txt
	$(LOWEST)/bin/python -m pip install --no-build-isolation --requirement $(LOWEST)/requirements.txt --editable .
	touch $@

bench: venv
	$(BIN)/vestcl bench splat
	$(BIN)/vestcl bench operators
	$(BIN)/vestcl bench stability
	$(BIN)/vestcl bench pipeline
	$(BIN)/vestcl bench train-step
	$(BIN)/vestcl bench pareto
	$(BIN)/vestcl bench inpaint
	$(BIN)/vestcl bench network
	$(BIN)/vestcl bench forecast street:

# What `make test` runs a tenth or a twentieth of: interrupts, fuzzed scenes, damaged caches, bad input. Each is seeded and says what failed.
stress: venv
	for script in tests/stress/*.py; do $(BIN)/python "$$script" || exit 1; done

# The operators' tests on every OpenCL device of this machine instead of the default one.
devices-test: venv
	VESTCL_TEST_DEVICES=all $(BIN)/pytest -q

# The operators on every GPU, in less than five minutes; ARGUMENTS=--allow-none passes where there is none.
gpu-check: venv
	$(BIN)/python tests/support/gpu_check.py $(ARGUMENTS)

# Data races and accesses out of bounds: every kernel on small scenes, on Oclgrind's simulated device.
oclgrind: venv
	$(BIN)/python tests/support/oclgrind_scenes.py

# docs/_build/html/index.html: warnings are errors, and the examples of the pages run.
docs: .venv/.docs-installed
	$(BIN)/sphinx-build -W --keep-going -q -b html docs docs/_build/html
	$(BIN)/sphinx-build -W --keep-going -q -b doctest docs docs/_build/doctest

.venv/.docs-installed: .venv/.installed
	$(BIN)/python -m pip install --constraint constraints.txt --no-build-isolation --editable '.[docs]'
	touch $@

# The tables of README.md and docs/, from the JSON files of docs/results.
tables: venv
	$(BIN)/python docs/tables.py

clean:
	rm -rf .venv $(LOWEST) build dist docs/_build docs/notebooks ./*.egg-info .pytest_cache .hypothesis .mypy_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
