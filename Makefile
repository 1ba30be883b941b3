# Every target sets itself up: the first run makes .venv and installs what it needs, later ones start at once.
PYTHON ?= python3
BIN := .venv/bin
ARGS ?=

.DEFAULT_GOAL := help
.PHONY: help compare test test-fast check attractors speed ablation fuzz paper training field robot hard-curves lasa docs clean

help: # What there is to make.
	@grep -E '^[a-z -]+:.*# ' $(MAKEFILE_LIST) | sed -E 's/^([a-z -]+):[^#]*# (.*)/\1|\2/' | awk -F'|' '{printf "  make %-34s %s\n", $$1, $$2}'
	@echo "Options go into ARGS: make compare ARGS=--quick"

compare: .venv/installed # Ten spirals, every method: a report, tables, rows and pictures in results/spirals.
	$(BIN)/python -m experiments.spirals $(ARGS)

test: .venv/installed check # Linters, types and every test.
	$(BIN)/python -m pytest -n 2 $(ARGS)

test-fast: .venv/installed # What a change of one file should run: all but the slow tests.
	$(BIN)/python -m pytest -n 2 -m "not slow" $(ARGS)

check: .venv/installed # Linters and types.
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

attractors speed ablation fuzz paper training field robot: .venv/installed # The studies: see the top of experiments/NAME.
	$(BIN)/python -m experiments.$@ $(ARGS)

hard-curves: .venv/installed # Seventy curves that are hard to learn from: which of them TubeDS follows.
	$(BIN)/python -m experiments.hard_curves $(ARGS)

lasa: .venv/installed # LASA handwriting (free for non-commercial academic use), for the studies that can use it.
	$(BIN)/pip install -q --disable-pip-version-check -c constraints.txt -e '.[dev,lasa]'

docs: .venv/installed # The site, in docs/_build: every block and gallery script is run, warnings are errors.
	$(BIN)/pip install -q --disable-pip-version-check -c constraints.txt -e '.[dev,docs]'
	$(BIN)/python -m sphinx -q -W --keep-going -b html docs docs/_build
	$(BIN)/python -m pytest tests/test_docs.py
	@echo "docs/_build/index.html"

.venv/installed: pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10) and "latentds needs Python >= 3.10; say which: make PYTHON=python3.11 ...")'
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	@echo "Installing into .venv (once) ..."
	$(BIN)/pip install -q --disable-pip-version-check -c constraints.txt -e '.[dev]'
	$(BIN)/python -c 'import latentds; latentds.warmup()'
	@touch $@

clean: # Remove .venv and results.
	rm -rf .venv results docs/_build docs/examples docs/sg_execution_times.rst
