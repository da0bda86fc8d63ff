# Everything runs in .venv; no target asks anything. `make` alone lists the targets.

VENV := .venv
STAMP := $(VENV)/.installed

# The first Python that runs and can make an environment. 3.11 first: pybullet has a wheel for it.
PYTHON ?= $(shell for python in python3.11 python3.12 python3.13 python3.10 python3; do \
	  $$python -c 'import ensurepip, sys, venv; sys.exit(sys.version_info < (3, 10))' \
	    2>/dev/null && echo $$python && break; \
	done)

# The environment stands alone: nothing of a sourced ROS installation, which has another Python,
# and no mark of another environment with ROS wheels that make may have been started from.
unexport PYTHONPATH
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE
# Where ROS looks for packages, as it does not look at Python's prefix.
demo test test-fast bench fuzz: export AMENT_PREFIX_PATH := $(CURDIR)/$(VENV)
# rclpy needs a folder it can write to, and no other machine has a part in this.
export ROS_LOG_DIR ?= $(CURDIR)/out/log
export ROS_AUTOMATIC_DISCOVERY_RANGE ?= LOCALHOST
export PIP_DISABLE_PIP_VERSION_CHECK := 1

.PHONY: help venv demo test test-fast lint matrix bench fuzz clean

help: ## list the targets (the default)
	@sed -n 's/^\([a-z-]*\):.*## /\1\t/p' $(firstword $(MAKEFILE_LIST)) | expand -t 12

venv: $(STAMP) ## make .venv and install the package into it, editable

# Launch files and wrappers are copied into .venv even by an editable install.
$(STAMP): pyproject.toml package.xml $(wildcard ember_ros/launch/* ember_ros/config/* ember_ros/resource/lib/*)
	@python='$(PYTHON)'; \
	if ! test -x $(VENV)/bin/python; then \
	  test -n "$$python" || { echo "no Python >= 3.10 with venv and ensurepip found" >&2; exit 1; }; \
	  $$python -m venv --clear $(VENV); \
	fi
	@$(VENV)/bin/python -c 'import sys; from importlib.util import find_spec; \
	  sys.exit(sys.version_info[:2] != (3, 11) and not find_spec("pybullet"))' \
	  || echo "pybullet has a wheel for Python 3.11 only: it is compiled now, for about five minutes"
	@echo "installing into $(VENV)"
	@$(VENV)/bin/python -m pip install --quiet --editable '.[all,test]'
	@touch $@

demo: $(STAMP) ## train a leg, let four of them walk, write what came of it to out/demo
	$(VENV)/bin/ember demo --out out/demo --force

test: $(STAMP) ## run the tests
	$(VENV)/bin/python -m pytest -n auto --dist worksteal

test-fast: $(STAMP) ## run the tests that are not slow
	$(VENV)/bin/python -m pytest -n auto --dist worksteal -m "not slow"

lint: $(STAMP) ## ruff and mypy
	$(VENV)/bin/ruff check
	$(VENV)/bin/ruff format --check
	$(VENV)/bin/mypy

matrix: ## try every Python 3.10 to 3.13 that is here, with the lowest and the newest versions
	test/matrix.sh

bench: $(STAMP) ## measure the speed
	$(VENV)/bin/ember bench

fuzz: $(STAMP) ## give every reader 6000 files that lie, and write what came of it to docs/results
	$(VENV)/bin/python test/mutate.py --out docs/results

clean: ## remove caches, builds and out/, but not .venv
	rm -rf out build dist install log *.egg-info .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -not -path './$(VENV)/*' -prune -exec rm -rf {} +
