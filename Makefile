# make render   a picture of the built-in head: out/head.png
# make test     ruff, mypy, pytest
# make slow     the exhaustive tests as well
# make head     assets/head.glb anew from its generator
# Both make .venv and install what is missing; see tools/system-libraries for what apt installs.

PYTHON ?= python3
VENV = .venv/bin

.PHONY: render test slow head system test-system

render: .venv/installed | system
	mkdir -p out
	$(VENV)/facerender render -o out/head.png

test: .venv/installed-dev | test-system
	$(VENV)/ruff check .
	$(VENV)/ruff format --check .
	$(VENV)/mypy
	$(VENV)/pytest

slow: .venv/installed-dev | test-system
	$(VENV)/pytest -m "slow or not slow"

head: .venv/installed-dev
	$(VENV)/python -m assets.head_generator -o assets/head.glb

system:
	@tools/system-libraries

test-system:
	@tools/system-libraries --tests

.venv/installed: pyproject.toml
	$(PYTHON) -m venv .venv
	$(VENV)/pip install --quiet --editable .
	touch $@

.venv/installed-dev: pyproject.toml
	$(PYTHON) -m venv .venv
	$(VENV)/pip install --quiet --editable '.[dev]'
	touch $@ .venv/installed
