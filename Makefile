# Every target sets itself up: the first run makes .venv and installs what it needs, later ones start at once.
PYTHON ?= python3
BIN := .venv/bin
ARGS ?=

.PHONY: compare test check speed ablation fuzz paper lasa clean

# The main job: ten spirals, every method, tables and pictures in results/spirals.
compare: .venv/installed
	$(BIN)/python -m experiments.spirals $(ARGS)

test: .venv/installed check
	$(BIN)/python -m pytest -n 2 $(ARGS)

check: .venv/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

speed ablation fuzz paper: .venv/installed
	$(BIN)/python -m experiments.$@ $(ARGS)

# LASA handwriting (free for non-commercial academic use), for the studies that can use it.
lasa: .venv/installed
	$(BIN)/pip install -q --disable-pip-version-check -c constraints.txt -e '.[dev,lasa]'

.venv/installed: pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10) and "latentds needs Python >= 3.10; say which: make PYTHON=python3.11 ...")'
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	@echo "Installing into .venv (once) ..."
	$(BIN)/pip install -q --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $@

clean:
	rm -rf .venv results
