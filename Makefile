# make demo    install what it needs, and drive a robot round a room
# make check   install the rest; lint, types, contracts and the short unit tests
# make test    that, the documentation site and all tests but slow ones: what to run before a commit
#              is shared
# make qa      what takes long, for a release; continued where it was stopped
# make bench   measure this machine
# ARGS is passed on: make unit ARGS="tests/unit/gate -k latch"

VENV := .venv
BIN := $(VENV)/bin
PYTHON ?= python3
DEMO := $(VENV)/.demo
INSTALLED := $(VENV)/.installed
WARM := $(VENV)/.done
PYTEST := $(BIN)/pytest
# a worker that crashes ends the run: the one in its place has been seen to wait for ever
SIDE_BY_SIDE := -n 2 --dist loadfile --max-worker-restart 0
MAKEFLAGS += --no-print-directory
# bytecode is kept, also where the environment says no: robots start twice as fast with it
unexport PYTHONDONTWRITEBYTECODE

.PHONY: setup demo lint style rooms types site unit node system check test qa qa-tests extremes dockerfile signals \
  ci-extra slow first-starts page-commands train-tests ros2-environment bench faults soak mutation fuzz golden recordings pictures clean

setup: $(WARM)

$(DEMO): EXTRAS := sim,nav,page
$(INSTALLED): EXTRAS := all,dev

# by uv, which pip fetches where there is none: it takes a third of pip's time
# with pip, which uv leaves out: the tutorials install more by it
$(DEMO) $(INSTALLED): pyproject.toml
	@echo 'installing into $(VENV), which takes up to a minute'
	@if command -v uv >/dev/null; then \
	  uv venv --quiet --allow-existing --python '>=3.11' $(VENV); \
	else \
	  $(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	    { echo 'Python 3.11 or newer is needed; name it: make PYTHON=python3.12 $(MAKECMDGOALS)'; exit 1; }; \
	  $(PYTHON) -m venv $(VENV) && \
	  $(BIN)/python -m pip install --quiet --disable-pip-version-check uv; \
	fi
	@PATH="$$PATH:$(BIN)" uv pip install --quiet --python $(BIN)/python -e '.[$(EXTRAS)]' pip
	@touch $(DEMO) $@

# the kernels, compiled once, and again after a change of a package that has some (kernels/jit.py)
HOLDERS := kernels manipulation mapping navigation qa/bench
$(WARM): $(INSTALLED) $(shell find $(HOLDERS:%=gigabrain_zenoh/%) -name '*.py')
	@$(BIN)/gigabrain precompile
	@touch $@

# compiles the kernels itself, while the robot drives
demo: $(DEMO)
	@$(BIN)/gigabrain demo $(ARGS)

# ---- checks ----

# side by side, as mypy takes one core without a cache
lint: $(INSTALLED)
	@$(MAKE) -j2 types style rooms

style: $(INSTALLED)
	$(BIN)/ruff check
	$(BIN)/ruff format --check

rooms: $(INSTALLED)
	$(BIN)/lint-imports
	$(BIN)/python -m gigabrain_zenoh.qa.house

types: $(INSTALLED)
	$(BIN)/mypy

# the documentation: open site/index.html
site: $(INSTALLED)
	$(BIN)/python -m docs.site.build

unit: setup
	$(PYTEST) $(SIDE_BY_SIDE) -q $(or $(ARGS),tests/unit tests/fuzz)

node: setup
	$(PYTEST) $(SIDE_BY_SIDE) -q $(or $(ARGS),tests/node)

# robots and sessions, two at a time
system: setup
	$(PYTEST) $(SIDE_BY_SIDE) -q $(or $(ARGS),tests/system)

check: setup
	@$(MAKE) lint
	$(PYTEST) $(SIDE_BY_SIDE) -q -m 'not long and not slow and not qa' tests/unit tests/fuzz

test: setup
	@$(MAKE) lint
	@$(MAKE) site
	@$(MAKE) unit
	@$(MAKE) node
	@$(MAKE) system

# ---- what takes long ----

qa: setup
	@$(MAKE) qa-tests extremes dockerfile signals faults mutation fuzz

# every test that `make test` leaves out, and all properties with a thousand examples each; goes on
# where it was stopped, with what failed or was not reached
PASSED ?= .qa/passed_tests
qa-tests: setup
	$(PYTEST) -q -m 'qa or slow or hypothesis' -o faulthandler_timeout=7200 --hypothesis-profile=qa \
	  --passed $(PASSED) $(ARGS)

# every extreme value in every message
extremes: setup
	$(BIN)/python -m gigabrain_zenoh.qa.faults.rows.extreme_messages .qa/extremes.jsonl

dockerfile: setup
	$(BIN)/python -m tests.qa.dockerfile_steps

# signals to every command at random moments
signals: setup
	@mkdir -p .qa
	$(BIN)/python -m tests.qa.signal_sweep --results .qa/signals.jsonl

# every row but 39 ten times, the e-stop's thirty
INTO ?= .qa/faults.jsonl
faults: setup
	@mkdir -p $(dir $(INTO))
	$(BIN)/gigabrain faults --skip 39 43 44 --repeat 10 --into $(INTO)
	$(BIN)/gigabrain faults --only 43 44 --repeat 30 --into $(INTO)

# 70 minutes of driving in which things happen
soak: setup
	$(BIN)/gigabrain faults --only 39 --long --behaviour navigate --json soak.json

mutation: setup
	rm -rf mutants
	$(BIN)/mutmut run
	@test -z "$$($(BIN)/mutmut results)" || { $(BIN)/mutmut results; exit 1; }

# coverage-guided; seconds for each of the four kinds of decoders
FUZZ_S ?= 60
fuzz: setup
	@for target in tests/fuzz/fuzz_*.py; do \
	  $(BIN)/python $$target -max_total_time=$(FUZZ_S) -verbosity=0 -print_final_stats=1 || exit 1; \
	done

# what CI runs behind `make test`: slow tests, first starts in empty environments, and what the pages
# say to run
ci-extra: slow train-tests first-starts page-commands

# every command that the pages show
page-commands: setup
	$(BIN)/python -m tests.qa.documentation

# tests of some 2 s (unit), 3 s (node) and 5 s (system) and more; the last ones one after the
# other, as robots side by side delay each other
slow: setup
	$(PYTEST) $(SIDE_BY_SIDE) -q -m 'slow and not qa' tests/unit tests/fuzz tests/node
	$(PYTEST) -q -m 'slow and not qa' tests/system

# from the sdist, from the wheel by each Python that is found, for one command, and `make demo`
first-starts: setup
	$(BIN)/python -m tests.qa.first_start --way wheel --tool pip
	$(BIN)/python -m tests.qa.first_start --way make sdist tool --tool uv --python $(PYTHON)

# tests of training, in an environment of its own: TensorFlow, and an independent judge
TRAIN := .qa/train
$(TRAIN)/.installed: pyproject.toml | $(INSTALLED)
	@$(PYTHON) -m venv $(TRAIN)
	@PATH="$$PATH:$(BIN)" uv pip install --quiet --python $(TRAIN)/bin/python -e '.[train]' pytest hotcoco onnxruntime
	@touch $@

train-tests: $(TRAIN)/.installed
	$(TRAIN)/bin/python -m pytest --noconftest -W ignore -o addopts=--import-mode=importlib -q \
	  tests/unit/qa/test_train_judge.py tests/unit/qa/test_train_net.py

# real ROS 2, for the tests that compare with it; they build it themselves where it is missing
ros2-environment: $(INSTALLED)
	$(BIN)/python -m tests.ros2.environment $(ARGS)

bench: setup
	$(BIN)/gigabrain bench chain
	$(BIN)/gigabrain bench stack

# ---- files that are made ----

golden: setup
	$(BIN)/python -m gigabrain_schemas.examples
	$(BIN)/python -m tests.user_texts
	$(BIN)/python -m docs.site.benchmarks

recordings: setup
	$(BIN)/python -m gigabrain_zenoh.qa.drives tests/recordings

pictures: setup
	$(BIN)/gigabrain render docs/pictures/waffle_in_house.png --world house --seed 1
	$(BIN)/python -m tests.qa.pictures docs/pictures

clean:
	rm -rf $(VENV) .site site .mypy_cache .ruff_cache .pytest_cache .hypothesis .fuzz .fuzz-* .qa mutants
