# make run     set-up, then the daemon on the simulated rig (or PORT=/dev/ttyACM0)
# make test    set-up, then lint, types, import contracts and every test
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

.PHONY: run test lint types contracts unit clean help

help:
	@sed -n 's/^# //p' Makefile

SOURCES := $(shell find psd_deflection msg_adapters config launch resource -type f -not -name '*.pyc') package.xml

$(VENV)/.requirements: setup.cfg
	$(PYTHON) -c 'import sys; sys.exit(0 if (3, 11) <= sys.version_info[:2] <= (3, 12) else f"Python 3.11 or 3.12 is needed, this is {sys.version.split()[0]}: make PYTHON=python3.12")'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check '.[ros,test]'
	touch $@

# Installed as a user has it (a wheel, not a link to the checkout), so that `ros2 run` finds it.
$(VENV)/.installed: $(VENV)/.requirements setup.py setup.cfg $(SOURCES)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --force-reinstall .
	touch $@

test: lint types contracts unit

lint: $(VENV)/.installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.installed
	$(BIN)/mypy

contracts: $(VENV)/.installed
	$(BIN)/lint-imports --no-cache

unit: $(VENV)/.installed
	$(BIN)/python -m pytest

clean:
	rm -rf build dist $(VENV)
