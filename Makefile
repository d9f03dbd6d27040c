# Everything is made inside .venv; what it needs from outside is Python 3.11 or later with venv, and make.

VENV   := .venv
BIN    := $(VENV)/bin
READY  := $(VENV)/.phibench-ready
COMPLETE := $(VENV)/.phibench-complete
RECIPE ?= datasets/recipes/paper.toml
OUT    ?= out/paper
SAMPLES ?= 12
BENCH  ?= out/bench-dev
STUDIES ?= out/studies
STUDIES_ALL := $(notdir $(patsubst %/,%,$(dir $(wildcard studies/*/study.py))))
# Environment without Mitsuba, and what is tested in it.
BASE := out/base-env
BASE_TESTS := tests/scenes tests/estimator/geometry tests/benchmark/isolation tests/test_package.py
# Where proofs are: reading all other test files takes as long as ten of them.
PROOFS = tests/accuracy $(shell grep -rl --include='test_*.py' 'def test_.*accuracy' tests/[b-z]* | xargs grep -l mark.slow)
# Which Python makes the environment: `make setup PYTHON=python3.13`. Without it the first that is new enough.
PYTHON ?=
# Tests start hundreds of processes. Where compiled modules may not be kept, each compiles the package anew, for a second.
unexport PYTHONDONTWRITEBYTECODE
# Each of two processes begins with one half of the tests, and takes some of the other's at its end, so that both end
# together; `make test PARALLEL=` runs them one after the other.
PARALLEL ?= --numprocesses 2 --dist worksteal

# What renders, and all extras but those of networks and of the site.
RENDERING := --editable '.[render]'
EVERYTHING := --editable '.[render,cluster,study,film,export,test,check]'
# `$(call install,FOLDER OF PYTHON,WHAT)`: by uv where it is there and reaches a registry, else by pip, which says nothing
# but for everything that it had to say where it fails.
install = (command -v uv && uv pip install --quiet --python $(1)/python --constraint constraints.txt $(2)) >/dev/null 2>&1 || \
    $(1)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt $(2) \
    > $(1)/../pip.log 2>&1 || { cat $(1)/../pip.log >&2; exit 1; }

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help setup dataset bench studies studies-full lint clean
.PHONY: docs dist test test-base test-wheel test-slow proof test-all attack mutants benchmark

help:
	@echo "make dataset    render $(RECIPE) into $(OUT); installs what renders, in .venv"
	@echo "make setup      make .venv with everything in it, and make sure of LLVM"
	@echo "make bench      $(SAMPLES) samples of bench-dev, all built-in methods on them, a report, in out/"
	@echo "make studies    all studies, reduced, and a report on them, in out/studies"
	@echo "make studies-full  the same in full (hours), published to docs/studies"
	@echo "make test       the tests, without the slow ones"
	@echo "make test-base  the tests of scoring and geometry without Mitsuba, with any PYTHON=python3.13"
	@echo "make test-wheel  the wheel alone fetches, verifies and scores a released set of rooms of three kinds"
	@echo "make test-slow  the slow tests"
	@echo "make proof      the slow tests of accuracy, but those of many minutes"
	@echo "make test-all   all tests"
	@echo "make attack     hostile methods, files and moments: nothing is lost, and nobody is fooled (docs/trust.md)"
	@echo "make mutants    proof that the tests see faults: one fault at a time, in copies of the checkout"
	@echo "make benchmark  timings of what must be fast"
	@echo "make docs       all pages and the reference as a site, in out/site; runs the tutorials; it works from disk"
	@echo "make dist       source distribution and wheel, in dist/"
	@echo "make lint       ruff and mypy"
	@echo "make clean      remove caches and builds; .venv and out/ stay"

setup: $(COMPLETE)

# The stamp comes last, so that an interrupted set-up is taken up again; every step may be repeated.
$(READY): pyproject.toml constraints.txt
	@$(BIN)/python -c 'import sys, pip; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || ( \
	    python=; \
	    for name in $(or $(PYTHON),python3 python3.13 python3.12 python3.11 python3.14); do \
	        if "$$name" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then python=$$name; break; fi; \
	    done; \
	    if [ -z "$$python" ]; then \
	        echo "phibench: $(or $(PYTHON),no Python here) is not Python 3.11 or later: install one and name it with 'make setup PYTHON=...'." >&2; exit 1; \
	    fi; \
	    if ! "$$python" -c 'import ensurepip, venv' 2>/dev/null; then \
	        echo "phibench: $$python has no venv: install it (Debian, Ubuntu: apt-get install python3-venv)." >&2; exit 1; \
	    fi; \
	    echo "Making $(VENV) with $$python"; \
	    "$$python" -m venv --clear $(VENV) )
	@echo "Installing phibench and what it renders with (a minute the first time)"
	@$(call install,$(BIN),$(RENDERING))
	@$(BIN)/python -m phibench.render.setup.llvm
	@touch $@

$(COMPLETE): $(READY)
	@echo "Installing what tests, checks and studies need (a minute the first time)"
	@$(call install,$(BIN),$(EVERYTHING))
	@touch $@

dataset: $(READY)
	$(BIN)/phibench dataset make $(RECIPE) --out $(OUT)

# Samples that are there already are kept: a larger number renders only the new ones, a smaller one deletes none, and
# all are scored.
bench: $(READY)
	$(BIN)/phibench dataset make bench-dev --samples $(SAMPLES) --out $(BENCH)
	$(BIN)/phibench bench $(BENCH) --out $(BENCH)-report

# One after the other; the data sets are shared and kept.
studies: $(COMPLETE)
	@set -e; for name in $(STUDIES_ALL); do \
	    echo "== $$name"; $(BIN)/phibench study $$name --quick --out $(STUDIES)/$$name --data $(STUDIES)/data; \
	done
	$(BIN)/phibench report --study $(addprefix $(STUDIES)/,$(STUDIES_ALL)) --out $(STUDIES)/report.html

# Hours. The documents beside the pages are replaced; tests/studies/test_study_pages.py then names every
# number of a page that has to be edited.
studies-full: $(COMPLETE)
	@set -e; for name in $(STUDIES_ALL); do \
	    echo "== $$name"; \
	    $(BIN)/phibench study $$name --out $(STUDIES)-full/$$name --data $(STUDIES)/data --publish docs/studies; \
	done

test: $(COMPLETE)
	$(BIN)/python -m pytest $(PARALLEL)

# Scoring, reading and geometry as they are installed without Mitsuba, for any Python: `make test-base PYTHON=python3.13`.
# Tests that need a rendered data set are skipped there.
test-base:
	$(or $(PYTHON),python3) -m venv --clear $(BASE)
	@$(call install,$(BASE)/bin,--editable '.[test]')
	$(BASE)/bin/python -m pytest $(BASE_TESTS)

# The wheel alone in a clean environment: it fetches a released set of three kinds of rooms, verifies and scores it.
test-wheel: $(COMPLETE)
	$(BIN)/python -m pytest --slow tests/test_distribution.py

test-slow: $(COMPLETE)
	$(BIN)/python -m pytest --slow --study -m "slow or study"

proof: $(COMPLETE)
	$(BIN)/python -m pytest $(PARALLEL) --slow -m slow -k accuracy $(PROOFS)

test-all: $(COMPLETE)
	$(BIN)/python -m pytest --slow --study

attack: $(COMPLETE)
	$(BIN)/python -m pytest $(PARALLEL) --slow tests/attack

mutants: $(COMPLETE)
	$(BIN)/python tests/mutants/run.py

benchmark: $(COMPLETE)
	$(BIN)/python -m pytest --benchmark-enable --benchmark-only

docs: $(COMPLETE)
	@echo "Installing what the site needs"
	@$(call install,$(BIN),--editable '.[docs]')
	@echo "Building the site: half a minute, and some minutes more where the tutorials are to be run"
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict --site-dir out/site
	@echo "out/site/index.html"

# Source distribution, and the wheel built from it.
dist: $(COMPLETE)
	@$(call install,$(BIN),build)
	$(BIN)/python -m build --outdir dist .

lint: $(COMPLETE)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy --num-workers 2 -p phibench -p tools

clean:
	rm -rf build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis .benchmarks
	find phibench scenes render datasets estimator calibration benchmark robot studies tests -name __pycache__ -type d -prune -exec rm -rf {} +
