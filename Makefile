# make demo | test | test-all | lint | benchmark | extension | test-blender-app | clean   (make setup is part of each)
# PYTHON=… chooses the interpreter, VENV=… the virtual environment, TESTS=… what `make test` runs,
# ZIPS=… which zips `make extension` builds (all, or names), BLENDER=… the program that `make test-blender-app` drives.
SHELL := /bin/sh
VENV ?= .venv
TESTS ?= tests
DEMO_OUT ?= demo_out
PYTHON ?= $(shell setup/pick_python.sh)
BIN := $(VENV)/bin
ZIPS ?=
BLENDER ?= blender

.PHONY: setup demo test test-all lint benchmark extension test-blender-app clean

setup:
	@test -n "$(PYTHON)" || exit 1
	@setup/system_libraries.sh
	@setup/venv.sh "$(PYTHON)" "$(VENV)"

demo: setup
	@$(BIN)/python -m physgen.batch.demo --out $(DEMO_OUT)

test: setup
	$(BIN)/python -m pytest -m "not slow" $(TESTS)

test-all: setup
	$(BIN)/python -m pytest $(TESTS)

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy sim batch

benchmark: setup
	$(BIN)/python benchmarks/mpm.py
	$(BIN)/python benchmarks/worlds.py
	$(BIN)/python benchmarks/demo.py

extension: setup
	@$(BIN)/python setup/extension.py $(if $(ZIPS),--zips $(ZIPS))

test-blender-app: extension
	$(BIN)/python tests/real_blender/run.py --blender "$(BLENDER)" --python "$(abspath $(BIN)/python)"

clean:
	rm -rf build dist .venv .venv-* demo_out .pytest_cache .mypy_cache .ruff_cache
