# The commands a person types, which are also the ones that CI runs.
#
#   make demo    set-up, then the demonstration: a phantom heel through a whole study, a report in ./demo
#   make test    set-up, then lint, types, import contract and the tests
#   make test-all  the same with the tests that need full-size images or minutes
#   make fuzz    every reader of files on damaged copies of small valid ones, a minute each (SECONDS=10 make fuzz)
#   make audit   known vulnerabilities of the pinned dependencies (pip-audit in .venv-audit; it needs the package index)
#   make oldest  tests on the oldest versions that pyproject.toml allows, in .venv-oldest (needs uv and the index);
#   make newest  on the newest ones, in .venv-newest (TESTS=tests/dvc/io make newest: some of them)
#   make clean-install  the wheel in an environment of its own that nobody can write to, without a display (needs the index)
#   make setup   only the environment in .venv, redone when requirements.lock or pyproject.toml changes
#   make lint    ruff, mypy and the import contract
#   make format  rewrite the sources as ruff formats them
#   make lock    renew requirements.lock after a change of the dependencies (needs uv; UPGRADE=--upgrade for newer versions)
#   make docs    the documentation site in ./site (its tools in .venv-docs), refused where a link or a name leads nowhere,
#                or where proselint finds a cliche, a redundancy or a filler word
#   make peers   the environment of benchmarks/peers in .venv-peers (2.9 GB; Python 3.11 is what it was tried with)
#   make clean   remove the environment and the caches
#
# Another interpreter: make PYTHON=/path/to/python3.12 setup

# The first that runs, is 3.11 or newer, and can make an environment: a name on PATH may be too old, or a dead shim.
PYTHON ?= $(shell for name in python3 python3.13 python3.12 python3.11; do \
	if $$name -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1; \
	then echo $$name; break; fi; done)
SECONDS ?= 60
SEED ?= 1
UV ?= uv
UPGRADE ?=
TESTS ?=
VENV := .venv
QUIETLY := --disable-pip-version-check --quiet
# In a terminal, the packages and a bar for each; in a log, the four lines of the set-up.
WITH_PROGRESS = --disable-pip-version-check $$(test -t 1 || echo --quiet)
ifeq ($(OS),Windows_NT)
BIN := $(VENV)/Scripts
else
BIN := $(VENV)/bin
endif

# Where Python is told to keep no bytecode, each of the many processes would compile the sources of the project anew.
unexport PYTHONDONTWRITEBYTECODE

# Both cores to the end: a worker that has nothing left takes tests from the other, and each computes on one thread.
THREADS := OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 NUMBA_NUM_THREADS=2
PYTEST := $(THREADS) $(BIN)/python -m pytest -n 2 --dist worksteal
# Otherwise both workers, and the processes that they start, compile the same loops at the same time, for 15 s each.
COMPILED := $(THREADS) $(BIN)/python -c 'from dvc import GaussNewtonWithInterfaces; GaussNewtonWithInterfaces().prepare()'

.DEFAULT_GOAL := help
.PHONY: help setup demo test test-all short-tests all-tests fuzz lint format lock audit oldest newest clean-install docs peers clean
.DELETE_ON_ERROR:

help:
	@sed -n '3,20p' Makefile | sed 's/^# \{0,1\}//'

setup: $(VENV)/installed.stamp

# What is installed is compiled on all cores. pip would use one core, and take half a minute.
$(VENV)/dependencies.stamp: requirements.lock
	@test -n "$(PYTHON)" || { echo "No Python 3.11 or newer with the venv module was found on PATH." \
		"Install one (on Debian and Ubuntu also python3-venv), or name it: make PYTHON=/path/to/python3.11 setup" >&2; exit 1; }
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
		echo "mrstrain needs Python 3.11 or newer; $(PYTHON) is older. Name another: make PYTHON=/path/to/python3.11 setup" >&2; exit 1; }
	@echo "Set-up 1 of 5: making the environment $(VENV) with $(PYTHON)"
	@"$(PYTHON)" -m venv --clear $(VENV)
	@echo "Set-up 2 of 5: installing $$(grep -c == requirements.lock) packages (a minute or more, most of it downloads)"
	@$(BIN)/python -m pip install $(WITH_PROGRESS) --no-compile --require-hashes --only-binary :all: -r requirements.lock
	@echo "Set-up 3 of 5: compiling these packages (half a minute)"
	@$(BIN)/python -W ignore -m compileall -qq -j 0 $(VENV) || true  # some have files that no Python can compile
	@touch $@

# Built with the hatchling that the lock has pinned, so nothing comes in without a hash.
$(VENV)/installed.stamp: $(VENV)/dependencies.stamp pyproject.toml
	@echo "Set-up 4 of 5: installing mrstrain"
	@$(BIN)/python -m pip install $(QUIETLY) --no-deps --no-build-isolation -e .
	@echo "Set-up 5 of 5: compiling the registration code, and testing it on a tiny image pair"
	@$(THREADS) $(BIN)/python -c 'from dvc.registration.self_test import self_test; print("Test passed:", self_test())'
	@echo "mrstrain is ready: $(BIN)/mrstrain"
	@touch $@

demo: setup
	$(BIN)/mrstrain demo --out demo

# Two rules each, so that `make -j2 test` checks types while tests run.
test: lint short-tests

test-all: lint all-tests

short-tests: setup
	@$(COMPILED)
	$(PYTEST) -m "not full_size"

all-tests: setup
	@$(COMPILED)
	$(PYTEST)

fuzz: setup
	$(THREADS) $(BIN)/python -m tests.fuzz --seconds $(SECONDS) --seed $(SEED)

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: setup
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

lock:
	$(UV) pip compile pyproject.toml --group dev --universal --python-version 3.11 --generate-hashes \
		--no-header --no-emit-index-url --no-emit-find-links --quiet $(UPGRADE) -o requirements.lock

# Not part of `make test`, which works without a network. A dependency that the index does not know is a failure too
# (--strict): it was not looked up.
audit: .venv-audit/installed.stamp
	.venv-audit/$(notdir $(BIN))/pip-audit --strict --disable-pip --require-hashes -r requirements.lock

.venv-audit/installed.stamp:
	"$(PYTHON)" -m venv --clear .venv-audit
	.venv-audit/$(notdir $(BIN))/python -m pip install --disable-pip-version-check --quiet "pip-audit>=2.10"
	@touch $@

# Of what pyproject.toml names; what that needs in turn is of the newest version. On Python 3.13:
# make PYTHON=/path/to/python3.13 newest
oldest: RESOLUTION := lowest-direct
oldest: LENIENT := -W ignore::DeprecationWarning  # of newer versions, such as pyparsing's, about what old ones call
newest: RESOLUTION := highest
oldest newest:
	$(UV) venv --quiet --clear --python "$(PYTHON)" .venv-$@
	$(UV) pip install --quiet --python .venv-$@ --resolution $(RESOLUTION) --group dev -e .
	$(THREADS) .venv-$@/$(notdir $(BIN))/python -m pytest -n 2 --dist worksteal -m "not full_size" $(LENIENT) $(TESTS)

clean-install: setup
	$(BIN)/python -m tests.clean_install

# What proselint reads. Its checks of typography, of words said twice and of spelling variants take code and formulas for
# prose, and are off.
PROSE := README.md CHANGELOG.md docs benchmarks

docs: .venv-docs/installed.stamp
	.venv-docs/$(notdir $(BIN))/proselint check --config docs/proselint.json $(PROSE)
	NO_MKDOCS_2_WARNING=1 .venv-docs/$(notdir $(BIN))/mkdocs build --strict

.venv-docs/installed.stamp: docs/requirements.txt
	"$(PYTHON)" -m venv --clear .venv-docs
	.venv-docs/$(notdir $(BIN))/python -m pip install --disable-pip-version-check --quiet -r $<
	@touch $@

peers: .venv-peers/installed.stamp

.venv-peers/installed.stamp: benchmarks/peers/requirements.txt
	"$(PYTHON)" -m venv --clear .venv-peers
	.venv-peers/bin/python -m pip install --disable-pip-version-check --quiet -r $<
	@touch $@

clean:
	rm -rf $(VENV) .venv-docs .venv-peers .venv-audit .venv-oldest .venv-newest site .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis build dist
