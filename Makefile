# SPDX-License-Identifier: MIT
# One command each; every target does its own set-up, which is instant when nothing has changed.

SHELL := bash
BIN := .venv/bin
# Processes of the test run, with one thread each.
JOBS ?= $(shell nproc 2>/dev/null || echo 2)
# A module's tests in one process, since they share what they make; in the order of conftest.py.
SPREAD = -n $(JOBS) --dist loadscope --no-loadscope-reorder
ARGS ?=
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1
export LP_NUM_THREADS ?= 1
# Tests start more than a hundred processes: without bytecode each would compile all of our sources.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help setup vulkan demo demo-train test test-slow coverage fuzz lint format bench docs lock dist clean

help: ## these lines
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "make %-11s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

setup: ## .venv with the locked packages and a Vulkan driver (PYTHON=python3.12, LOCK=requirements-all.lock)
	@LOCK="$(LOCK)" PYTHON="$(PYTHON)" scripts/setup.sh

vulkan: ## look for a Vulkan device again, and install a driver where there is none
	@scripts/vulkan.sh

demo: setup ## the whole idea: render, predict by the released models, score, print the table, make twins
	@$(BIN)/python -m bench.demo $(ARGS)

demo-train: setup ## the same of ovens with a model that is trained from scratch
	@$(BIN)/python -m bench.demo --out results/demo-train --categories oven --train 640 --test 200 \
	  --methods registered icp $(ARGS)

test: setup ## the tests, shapes checked (JOBS=2, ARGS="-k geometry")
	@$(BIN)/python -m pytest $(SPREAD) --durations=8 -m "not slow" $(ARGS)

test-slow: setup ## the slow ones
	@$(BIN)/python -m pytest $(SPREAD) --durations=8 -m slow $(ARGS)

# Shapes unchecked: a checked call that is traced takes three times what either adds alone.
coverage: setup ## all tests, lines counted: at least 97 %
	@$(BIN)/python -m pytest $(SPREAD) --jaxtyping-packages= --cov --cov-report=term $(ARGS)

lint: setup ## ruff, pyright, import contracts
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/lint-imports --no-logo
	@$(BIN)/pyright --warnings

fuzz: setup ## damaged files of every format for an hour (ARGS="--seconds 600 --only URDF")
	@$(BIN)/python -m tests.fuzz --seconds 3600 $(ARGS)

format: setup ## ruff, writing
	@$(BIN)/ruff check --fix .
	@$(BIN)/ruff format .

bench: setup ## speed tests
	@$(BIN)/python -m pytest tests/speed --benchmark-enable --benchmark-columns=min,median,rounds \
	  --jaxtyping-packages= -p no:xdist $(ARGS)

docs: setup ## the pages of docs/ as a site in build/site
	@$(BIN)/python -m pip install -q --no-build-isolation -e '.[docs]'
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict $(ARGS)

lock: setup ## resolve pyproject.toml anew into the lock files (ARGS=--upgrade)
	@scripts/lock.sh $(ARGS)

dist: setup ## wheel and sdist in dist/
	@rm -rf dist
	@$(BIN)/hatchling build

clean: ## remove .venv, caches and builds; keep results
	rm -rf .venv build dist .pytest_cache .ruff_cache .import_linter_cache .hypothesis .benchmarks .coverage htmlcov
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
