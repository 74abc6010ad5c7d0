PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

.PHONY: demo test check bench clean

# Sets up, simulates a home, learns, records, labels, and writes demo/day.rrd to look at.
demo: $(VENV)/.analyzer
	rm -rf demo
	$(BIN)/hearthlog demo --output demo

test: $(VENV)/.dev
	$(BIN)/pytest -n 2

check: $(VENV)/.dev build/checked/hearthlog
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	PYTHONPATH=build/checked $(BIN)/lint-imports

# The folders under the name they are installed by, for the linters, which follow no finder of
# setuptools: links, so they are what is edited. Point the type checker of an editor here too.
build/checked/hearthlog: Makefile
	mkdir -p $@
	ln -sfn $(addprefix $(CURDIR)/,analyzer models recorder schemas tools) $@
	ln -sfn $(CURDIR)/tools/package/__init__.py $(CURDIR)/tools/package/py.typed $@
	touch $@

bench: $(VENV)/.dev
	$(BIN)/python -m hearthlog.tools.bench

$(VENV)/.analyzer: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --editable '.[analyzer]'
	touch $@

$(VENV)/.dev: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --editable '.[dev]'
	touch $@ $(VENV)/.analyzer

clean:
	rm -rf $(VENV) demo
