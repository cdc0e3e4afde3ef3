# make demo   set up, and drive a robot round a room        make test   set up, and run all checks
# make setup  the set-up alone                              make check  those that start no robot
# make bench  measure this machine                          make qa     what takes hours

VENV := .venv
BIN := $(VENV)/bin
PYTHON ?= python3
INSTALLED := $(VENV)/.installed
DONE := $(VENV)/.done

.PHONY: setup demo test check lint unit system bench faults soak mutation fuzz golden recordings pictures clean qa

setup: $(DONE)

# uv where it is installed, pip otherwise
$(INSTALLED): pyproject.toml
	@if command -v uv >/dev/null; then \
	  uv venv --quiet --allow-existing --python '>=3.11' $(VENV) && \
	  uv pip install --quiet --python $(BIN)/python -e '.[all,dev]'; \
	else \
	  $(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	    { echo 'Python 3.11 or newer is needed; name it: make PYTHON=python3.12 $(MAKECMDGOALS)'; exit 1; }; \
	  $(PYTHON) -m venv $(VENV) && \
	  $(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[all,dev]'; \
	fi
	@touch $@

$(DONE): $(INSTALLED)
	@$(BIN)/gigabrain warm
	@touch $@

demo: setup
	@$(BIN)/gigabrain demo $(ARGS)

test:
	@$(MAKE) --no-print-directory check
	@$(MAKE) --no-print-directory system

check:
	@$(MAKE) --no-print-directory --jobs 2 setup lint  # one compiles while the other checks
	@$(MAKE) --no-print-directory unit

lint: $(INSTALLED)
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m gigabrain_zenoh.qa.house

unit: setup
	$(BIN)/pytest -n 2 --dist loadfile -m 'not system' $(ARGS)

system: setup
	$(BIN)/pytest -m system $(ARGS)  # these start robots, which have the machine to themselves

# before a release, on a machine with nothing else to do: hours, and continued where it was stopped
qa: setup
	$(BIN)/python -m tests.qa.dockerfile_steps
	$(BIN)/python -m gigabrain_zenoh.qa.faults.rows.extreme_messages .qa/extremes.jsonl

bench: setup
	$(BIN)/gigabrain bench chain
	$(BIN)/gigabrain bench stack

# every row ten times, the e-stop's thirty; hours, and continued where it was stopped
INTO ?= faults.jsonl
faults: setup
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

# signals to every command at random moments; goes on where it was stopped
.PHONY: signals qa
qa: signals
signals: setup
	$(BIN)/python -m tests.qa.signal_sweep --results .signals.jsonl $(ARGS)

golden: setup
	$(BIN)/python -m gigabrain_schemas.golden

recordings: setup
	$(BIN)/python -m gigabrain_zenoh.qa.drives tests/recordings

pictures: setup
	$(BIN)/gigabrain view --png docs/pictures/waffle_in_house.png --world house --seed 1
	$(BIN)/python -m tests.qa.pictures docs/pictures

clean:
	rm -rf .signals.jsonl $(VENV) .mypy_cache .ruff_cache .pytest_cache .hypothesis .fuzz .fuzz-* .qa mutants
