# make demo | test | test-all | test-explore | coverage | fuzz | lock | audit | lint | docs | benchmark | extension | assets | test-blender-app | clean   (make setup is part of each)
# PYTHON=… chooses the interpreter, VENV=… the virtual environment, TESTS=… what the tests run on, MARKS=… which of them,
# BEST=1 renders the demo as the documentation shows it, WORKERS=… how many processes share the tests,
# NAMES=… which benchmarks `make benchmark` runs (all, or names; QUICK=1: only whether they run),
# ZIPS=… which zips `make extension` builds (all, or names), BLENDER=… the program that `make test-blender-app` drives.
SHELL := /bin/sh
VENV ?= .venv
TESTS ?= tests
MARKS ?= not slow and not long
WORKERS ?= auto
DEMO_OUT ?= demo_out
PYTHON ?= $(shell setup/pick_python.sh)
BIN := $(VENV)/bin
ZIPS ?=
NAMES ?= mpm worlds demo
BLENDER ?= blender
N ?= 100000
SEED ?= 0
# Tests of one file share scenes and bakes, so a file stays with one worker; tests/conftest.py has the order. A worker
# that crashes is not replaced: xdist 3.8 would wait for ever with the replacement, instead of naming the test.
SPREAD := -n $(WORKERS) --maxprocesses 4 --dist loadfile --no-loadscope-reorder --max-worker-restart 0
PYTEST := $(BIN)/python -m pytest $(SPREAD)
# Where PYTHONDONTWRITEBYTECODE is set, every process that tests start would compile all that it imports. A tree that
# may not be written works without.
COMPILED := __init__.py __main__.py batch benchmarks blind_check physgen_addon sim

.PHONY: setup demo test test-all test-explore coverage fuzz lint lock audit docs benchmark extension assets test-blender-app clean

setup:
	@test -n "$(PYTHON)" || exit 1
	@setup/system_libraries.sh
	@setup/venv.sh "$(PYTHON)" "$(VENV)"
	@$(BIN)/python -m compileall -q $(COMPILED) || true

demo: setup
	@$(BIN)/python -m physgen.batch.demo --out $(DEMO_OUT) $(if $(BEST),--best)

test: setup
	$(PYTEST) -m "$(MARKS)" $(TESTS)

test-all: setup
	$(PYTEST) $(TESTS)

# Examples that no run has drawn before, for the tests that draw any. Failing ones are kept in .hypothesis/.
test-explore: setup
	HYPOTHESIS_PROFILE=explore $(PYTEST) -m "hypothesis and not slow" $(TESTS)

# Line coverage of `make test`, with the processes that tests start: totals, a line a file, pages in build/coverage/html.
coverage: setup
	rm -rf build/coverage
	mkdir -p build/coverage
	$(BIN)/python -m coverage run -m pytest $(SPREAD) -m "$(MARKS)" $(TESTS) || touch build/coverage/failed
	$(BIN)/python -m coverage combine --quiet
	$(BIN)/python -m coverage html --quiet -d build/coverage/html
	$(BIN)/python -m coverage report --skip-covered --sort=cover
	@test ! -e build/coverage/failed

# What `make setup` installs, anew: the newest versions that pyproject.toml allows, with their hashes; look at the diff.
lock: setup
	$(BIN)/python setup/lock.py

# Known holes in what the lock names; needs a network, and an environment of its own so that nothing else changes.
audit: setup
	@test -d $(VENV)-audit || "$(PYTHON)" -m venv $(VENV)-audit
	$(VENV)-audit/bin/pip install --quiet --disable-pip-version-check pip-audit
	$(VENV)-audit/bin/pip-audit --strict --require-hashes --disable-pip -r $$($(BIN)/python setup/lock.py --name)

# Damaged and hostile files for every loader, N each; only its own errors may escape. SEED=… draws others.
fuzz: setup
	$(BIN)/python tests/fuzz/run.py --count $(N) --seed $(SEED)

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy sim batch blind_check physgen_addon

docs: setup
	@$(BIN)/python -m mkdocs --version >/dev/null 2>&1 || $(BIN)/python -m pip install --quiet -e '.[docs]'
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

benchmark: setup
	$(BIN)/python -m physgen.benchmarks $(NAMES) $(if $(QUICK),--quick)

# Any Python with pip, no environment: it builds a zip and runs nothing of it.
extension:
	@test -n "$(PYTHON)" || exit 1
	@"$(PYTHON)" setup/extension.py $(if $(ZIPS),--zips $(ZIPS))

# Materials and the sample scene as Blender assets, with previews, in dist/assets.
assets: setup
	@$(BIN)/python setup/assets.py

test-blender-app: setup extension
	$(BIN)/python tests/real_blender/run.py --blender "$(BLENDER)" --python "$(abspath $(BIN)/python)"

clean:
	rm -rf build dist site .venv .venv-* demo_out .pytest_cache .mypy_cache .ruff_cache
