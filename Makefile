# make setup    environments for Blender 4.5 (.venv, Python 3.11) and 5.2 (.venv-5.2, Python 3.13)
# make bake     the demo: build the scene, bake it, compare it with the path-traced reference
# make test     lint and all fast tests; GUI tests where a desktop Blender is available
# make slow     the tests that take long
# make package  the extension as a zip in dist/, built and validated by Blender's own tool

PYTHON ?= $(or $(shell tools/find-python 3.11),$(shell command -v python3))
PYTHON_52 ?= $(shell tools/find-python 3.13)
RUN := .venv/bin/python
RUN_52 := .venv-5.2/bin/python
PYTEST := -m pytest
INSTALL := -m pip install --quiet --disable-pip-version-check --editable '.[blender,test]'
DEMO := build/demo
.DEFAULT_GOAL := help
.PHONY: help setup setup-5.2 bake test lint slow package clean

help:
	@sed -n '/^#/!q; s/^# //p' Makefile

setup: .venv/.installed setup-5.2

.venv/.installed: pyproject.toml
	@tools/system-libraries $(PYTHON)
	@test -x $(RUN) || $(PYTHON) -m venv .venv
	$(RUN) $(INSTALL)
	@touch $@

ifeq ($(PYTHON_52),)
setup-5.2:
	@echo "SKIPPED: no Python 3.13 on this machine, so nothing is tested with Blender 5.2 (set PYTHON_52=/path/to/python3.13)" >&2
else
setup-5.2: .venv-5.2/.installed
endif

.venv-5.2/.installed: pyproject.toml | .venv/.installed
	@test -x $(RUN_52) || $(PYTHON_52) -m venv .venv-5.2
	$(RUN_52) $(INSTALL)
	@touch $@

$(DEMO)/courtyard.blend: $(wildcard demo/*.py) | .venv/.installed
	@mkdir -p $(DEMO)
	$(RUN) demo/courtyard.py $@

bake: .venv/.installed $(DEMO)/courtyard.blend
	$(RUN) -m gi_volumes bake $(DEMO)/courtyard.blend -o $(DEMO)/bake
	$(RUN) -m gi_volumes compare $(DEMO)/bake -o $(DEMO)/compare.png --size 400x225 --samples 64
	@echo "The bake is in $(DEMO)/bake; baked, path-traced and their difference are in $(DEMO)/compare.png"

lint: setup
	$(RUN) -m ruff check .
	$(RUN) -m ruff format --check .

# The last thing printed is pytest's own closing line.
test: lint
ifneq ($(PYTHON_52),)
	$(RUN_52) $(PYTEST) -q
endif
	$(RUN) $(PYTEST) -m 'not slow'

slow: setup
	$(RUN) $(PYTEST) -m slow

package: setup
	@mkdir -p dist
	$(RUN) tools/package.py dist

clean:
	rm -rf build dist
