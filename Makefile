# make render      render the built-in head to out/head.png
# make test        run ruff, mypy and the tests for every commit
# make test-all    run all tests
# make test-rest   run the tests that `make test` omits
# make fuzz MINUTES=10   fuzz all file readers; inputs that cause errors are in out/fuzz
# make docs        regenerate the tables of README and docs from their data
# make site        build the documentation as a web site in out/site
# make head        regenerate assets/head.glb and assets/relief.npy
# make lines       print the lines of code by package
# make npm         build the npm package of the shaders in out/npm, and docs/languages
# make install-shaders PREFIX=/usr/local [DESTDIR=]   install the GLSL library for pkg-config and CMake
# All targets except lines and install-shaders create .venv if it is missing, and install missing system
# libraries with apt (tools/system-libraries).

PYTHON ?= python3
VENV = .venv/bin
# One worker per core, so llvmpipe gets one thread. Bytecode is written, because tests start
# processes, and without bytecode each process would compile the package again.
PYTEST = LP_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE= $(VENV)/pytest -n auto --dist worksteal
# Markers in pyproject.toml. `make test` runs one smoke test of each.
LEFT_OUT = browser or cluster or compiler or memory or node or osmesa or slow or vulkan or wheel

MINUTES ?= 10
PREFIX ?= /usr/local
SHARE = $(DESTDIR)$(PREFIX)/share
VERSION = $(shell sed -n 's/^__version__ = "\(.*\)"/\1/p' facerender/__init__.py)

.PHONY: render test test-all test-rest fuzz docs site head lines npm install-shaders system test-system

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
	$(VENV)/python -m tools.head.relief -o assets/relief.npy

lines:
	@git ls-files facerender shaders tools benchmarks tests | grep -E '\.(py|js|css|html|glsl|frag|vert)$$' \
	    | xargs wc -l | awk '$$2 != "total" { split($$2, path, "/"); lines[path[1]] += $$1; \
	        if (path[1] == "facerender") lines["facerender/" path[2]] += $$1 } \
	        END { for (name in lines) print lines[name], name }' | sort -rn

npm: .venv/installed-dev
	$(VENV)/python tools/npm-package -o out/npm
	cp -R out/npm/languages docs

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
	$(VENV)/pip install --quiet --upgrade 'pip>=25.1'  # for dependency groups
	$(VENV)/pip install --quiet --editable . --group dev
	-NODE_USE_SYSTEM_CA=1 $(VENV)/npm install --silent --global \
	    "$$($(VENV)/python -c 'from facerender.glsl.translate import NAGA; print(NAGA)')"
	touch $@ .venv/installed
