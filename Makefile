# Everything on a fresh machine with Python 3.11 or later and make.
#   make demo    sets up, runs the main job, names the report to open
#   make test    sets up, checks style and types, runs the tests
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check -q
# One file for each kind of installation, newer than what it depends on.
USE := $(VENV)/.installed
DEV := $(VENV)/.installed-dev

.PHONY: demo test lint clean

$(BIN)/python:
	$(PYTHON) -c 'import sys; sys.exit("helmstar needs Python 3.11 or later, this is " + sys.version.split()[0]) if sys.version_info < (3, 11) else None'
	$(PYTHON) -m venv $(VENV)

KERNELS := $(shell find src -name '*.[ch]') hatch_build.py

$(USE): $(BIN)/python pyproject.toml constraints.txt $(KERNELS)
	@echo "installing helmstar into $(VENV) (once)"
	$(PIP) install -c constraints.txt -e .
	@touch $@

$(DEV): $(USE)
	@echo "installing the tools for tests into $(VENV) (once)"
	$(PIP) install -c constraints.txt -e ".[dev]"
	@touch $@

demo: $(USE)
	$(BIN)/helmstar run xu2020 --out helmstar-out/demo

test: $(DEV) lint
	$(BIN)/python -m pytest -n 2 --dist loadfile

lint: $(DEV)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --pythonpath $(BIN)/python

clean:
	rm -rf $(VENV) build dist helmstar-out benchmarks/build
