# make render   a picture of the built-in head: out/head.png
# make test     ruff, mypy, and the tests to run before every commit
# make test-all    all tests
# make test-rest   the tests that make test leaves out
# make fuzz MINUTES=10   files changed at random for every reader: what breaks is put into out/fuzz
# make docs     the tables of README and docs anew, from their data
# make site     the documentation as a web site: out/site
# make head     assets/head.glb anew from its generator
# make npm      the shaders as an npm package: out/npm
# make install-shaders PREFIX=/usr/local [DESTDIR=]   the GLSL library, for pkg-config and CMake
# The others make .venv and install what is missing; see tools/system-libraries for what apt installs.

PYTHON ?= python3
VENV = .venv/bin
# One worker per core, so each draws with one thread. Bytecode is written, because tests start processes,
# and each would compile the package anew.
PYTEST = LP_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE= $(VENV)/pytest -n auto --dist worksteal
# Markers of pyproject.toml: `make test` runs one smoke test of each.
LEFT_OUT = browser or cluster or compiler or memory or node or osmesa or slow or vulkan or wheel

MINUTES ?= 10
PREFIX ?= /usr/local
SHARE = $(DESTDIR)$(PREFIX)/share
VERSION = $(shell sed -n 's/^__version__ = "\(.*\)"/\1/p' facerender/__init__.py)

.PHONY: render test test-all test-rest fuzz docs site head npm install-shaders system test-system

render: .venv/installed | system
	mkdir -p out
	$(VENV)/facerender render -o out/head.png

test: .venv/installed-dev | test-system
	$(VENV)/ruff check .
	$(VENV)/ruff format --check .
	$(VENV)/mypy
	$(PYTEST) -m "smoke or not ($(LEFT_OUT))"

test-rest: .venv/installed-dev | test-system
	$(PYTEST) -m "not smoke and ($(LEFT_OUT))"

test-all: test test-rest

fuzz: .venv/installed-dev | test-system
	$(VENV)/python -m tools.fuzz --minutes $(MINUTES)

docs: .venv/installed-dev | test-system
	$(VENV)/python -m tools.docs

site: .venv/installed-dev
	$(VENV)/sphinx-build --fail-on-warning --fresh-env --quiet docs out/site

head: .venv/installed-dev
	$(VENV)/python -m tools.head -o assets/head.glb

npm: .venv/installed
	$(VENV)/python tools/npm-package -o out/npm

install-shaders:
	mkdir -p "$(SHARE)/facerender/shaders" "$(SHARE)/pkgconfig" "$(SHARE)/cmake/facerender_shaders"
	cp -R shaders/facerender "$(SHARE)/facerender/shaders"
	cp tools/packaging/facerender_shadersConfig.cmake "$(SHARE)/cmake/facerender_shaders"
	sed 's/@VERSION@/$(VERSION)/' tools/packaging/facerender_shadersConfigVersion.cmake.in \
	    > "$(SHARE)/cmake/facerender_shaders/facerender_shadersConfigVersion.cmake"
	sed 's/@VERSION@/$(VERSION)/' tools/packaging/facerender-shaders.pc.in \
	    > "$(SHARE)/pkgconfig/facerender-shaders.pc"

system:
	@tools/system-libraries

test-system:
	@tools/system-libraries --tests

.venv/installed: pyproject.toml
	$(PYTHON) -m venv .venv
	$(VENV)/pip install --quiet --editable .
	touch $@

.venv/installed-dev: pyproject.toml | test-system
	$(PYTHON) -m venv .venv
	$(VENV)/pip install --quiet --editable '.[dev]'
	touch $@ .venv/installed
