# make setup     the environment .venv with all that the targets below need (Python 3.11 to 3.14)
# make run       the daemon on the simulated rig, recorded below recordings/ (PORT=/dev/ttyACM0 for a real one)
# make test      lint, types, import contracts, the quick tests; each alone: lint, types, contracts, unit
#                (ROOM=measure: the tests of a room alone, in seconds)
# make test-all  the same with the slow tests
# make mutants   whether the tests notice broken numerics; shaken, bits: whether answers depend on the processor
# make bench     what it costs, beside peers measured in the same run (ARGS=--full: docs/performance.md)
# make campaign  faults, crashes, fuzzing, hidden effects: lists them; NAME=faults runs one
# make demo      lists them; NAME=discover finds and repairs a hidden effect in a minute
# make docs      the web site in build/site; STEP=commands, axe, gallery ... (STEP=list lists them)
# make release   the steps of a release: lists them; STEP=check builds, tries and checks all of it
# make golden    the golden recordings in bags/ anew
# make colcon    colcon build and colcon test, and every executable started
# make clean     removes what the others made
# Further words for any of them: ARGS='--help'.
PYTHON ?= python3
VENV ?= .venv
# Further requirements, e.g. WITH='--constraint=packaging/ubuntu-24.04.txt' for what Ubuntu 24.04 has.
WITH ?=
# A build of OpenCV that is laid over PyPI's usual one, e.g. OPENCV='opencv-contrib-python-headless==4.6.0.66': Ubuntu's has boards.
OPENCV ?=
PORT ?=
# Words for what a target starts; the name of a campaign or a demo, the step of a release or of the documents.
ARGS =
NAME =
STEP =
# pip writes no byte code: half the time of a set-up goes into modules that nobody imports. The first import of a module
# writes it for all that come after, whatever the environment says of it: the tests and the documents start Python hundreds of times.
export PIP_COMPILE := 0
unexport PYTHONDONTWRITEBYTECODE
# As psd-deflection has it: our matrices are small or narrow, and more threads spin more than they compute.
export OMP_NUM_THREADS ?= 1
# uv installs the same packages with a tenth of the work. It is used if it is there; `make UV= run` takes pip all the same.
UV ?= $(shell command -v uv)
INSTALL = $(if $(UV),$(UV) pip install --python $(1)/bin/python,$(1)/bin/python -m pip install --disable-pip-version-check --use-pep517) --quiet
# A half-made environment is no environment: what has no pip is made anew, and what could not be made goes.
HALF_MADE = $(if $(wildcard $(VENV)/pyvenv.cfg),--clear)
MAKE_VENV = $(PYTHON) -m venv $(HALF_MADE) $(VENV) || { test ! -f $(VENV)/pyvenv.cfg || rm -rf $(VENV); exit 1; }
# Further words for pytest, e.g. PYTEST='-m "not browser"'.
PYTEST ?=
# Tests that run at a time: they wait for ports, discs and DDS, and three keep two cores busy.
WORKERS ?= 3
# Which tests: quick (not marked slow), slow, all.
TIER ?= quick
ROOM ?=
BIN := $(VENV)/bin
# A run needs the first of these, all the others need both.
READY := $(VENV)/.installed $(VENV)/.for_tests

.PHONY: help setup run test test-all lint types contracts unit mutants shaken bits bench campaign demo docs release golden colcon clean

help:
	@sed -n '/^#/!q;s/^# //p' Makefile

SOURCES := $(shell find psd_deflection msg_adapters config launch resource -type f -not -name '*.pyc') package.xml

$(VENV)/.requirements: setup.cfg
	$(PYTHON) -c 'import sys; sys.exit(0 if (3, 11) <= sys.version_info[:2] <= (3, 14) else f"Python 3.11 to 3.14 is needed, this is {sys.version.split()[0]}: make PYTHON=python3.12")'
	$(if $(UV),test -x $(BIN)/python,$(BIN)/python -m pip --version >/dev/null 2>&1) || $(MAKE_VENV)
	@echo 'setting up $(VENV), once: a minute or so, 0.6 GB'
	$(call INSTALL,$(VENV)) '.[ros,monitor,plot]' $(if $(WITH),'$(WITH)')
	touch $@

# Installed as a user has it (a wheel, not a link to the checkout), so that `ros2 run` finds it.
$(VENV)/.installed: $(VENV)/.requirements setup.py setup.cfg $(SOURCES)
	$(call INSTALL,$(VENV)) --no-deps --force-reinstall .
	touch $@

# What tests, campaigns and documents need besides, without another build of the package. Later than the package, so that
# two pips never write at once.
$(VENV)/.for_tests: $(VENV)/.requirements | $(VENV)/.installed
	@echo 'the tools of the tests into $(VENV), once: a minute or so, 0.9 GB more'
	$(BIN)/python -c 'import configparser; c = configparser.ConfigParser(); c.read("setup.cfg"); print(c["options.extras_require"]["test"])' > $(VENV)/test_tools
	$(call INSTALL,$(VENV)) -r $(VENV)/test_tools $(if $(WITH),'$(WITH)')
	$(if $(OPENCV),$(call INSTALL,$(VENV)) --no-deps '$(OPENCV)')
	touch $@

setup: $(READY)

test: $(if $(ROOM),,lint types contracts) unit

test-all: TIER = all
test-all: lint types contracts unit

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python -m tools.words

types: $(READY)
	$(BIN)/mypy

contracts: $(READY)
	$(BIN)/lint-imports --no-cache

unit: $(READY)
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadgroup --tier $(TIER) $(if $(ROOM),--room $(ROOM)) $(PYTEST)

run: $(VENV)/.installed
	$(BIN)/psd-deflection estimator --monitor --record recordings $(if $(PORT),--port $(PORT),--demo) $(ARGS)

mutants: $(READY)
	test -x build/mutants/bin/python || $(PYTHON) -m venv build/mutants
	$(call INSTALL,build/mutants) 'cosmic-ray>=8.4,<9'
	build/mutants/bin/python -m tools.mutants --python $(abspath $(BIN)/python) $(MUTANTS)

# The rooms of the numerics. The kernel: one that any processor of these ten years runs, and that is no machine's own.
NUMERICS := arms base camera measure model recordings rig studies
shaken: $(READY)
	OPENBLAS_CORETYPE=$${KERNEL:-Nehalem} $(BIN)/python -m pytest --shaken -n $(WORKERS) --dist loadgroup --tier quick -m 'not browser' $(PYTEST) $(NUMERICS:%=test/%) test/test_*.py

bits: $(READY)
	$(BIN)/python -m bench.bits

bench campaign demo release: $(READY)
	@$(BIN)/python -m tools.tasks $@ $(NAME)$(STEP) $(ARGS)

docs: $(READY)
	@$(BIN)/python -m tools.tasks docs $(or $(STEP),site) $(ARGS)

golden: $(READY)
	PYTHONPATH=. $(BIN)/python bags/make.py

colcon: $(READY)
	@$(BIN)/python -m tools.tasks colcon $(ARGS)

clean:
	rm -rf build dist install log *.egg-info $(VENV)
