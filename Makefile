# Every target installs what it needs. Required: git, make, Python 3.11 or later.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.DEFAULT_GOAL := help
.PHONY: help loopback test tests flights all-flights lint fuzz kills soak docs pictures lock oldest clean

# one worker more than processors: many tests wait for a process or a disk
WORKERS := $(shell echo $$(($$(getconf _NPROCESSORS_ONLN) + 1)))
# hundreds of processes start in the tests: what one has compiled the next ones load
unexport PYTHONDONTWRITEBYTECODE

# duration per fuzz target: make fuzz SECONDS=3600
SECONDS := 120
# forged frames: make fuzz FRAMES=1000000
FRAMES := 10000000
# mutated logs per format
MUTANTS := 20000

help: ## list the targets
	@grep -E '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

$(STAMP): pyproject.toml requirements.lock
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or later is needed: make PYTHON=/path/to/python3.11")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	@touch $@

loopback: $(STAMP) ## fly the default scenario in virtual time: log in logs/ and error table
	$(BIN)/companion loopback

test: lint tests ## lint, type check and all tests but those of `flights`

tests: $(STAMP)
	$(BIN)/python -m pytest -n $(WORKERS) --dist worksteal -m "not flight"

flights: $(STAMP) ## the tests that fly for minutes of virtual time
	$(BIN)/python -m pytest -n auto --dist loadscope -m "flight and not long"

all-flights: $(STAMP) ## flights, on further channels, with further seeds and cells of the campaign
	$(BIN)/python -m pytest -n auto --dist loadscope -m flight

lint: $(STAMP) ## ruff, mypy --strict and the import contracts
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

fuzz: $(VENV)/.fuzz ## MUTANTS mutated logs per format; coverage-guided fuzzing, SECONDS per target (Linux)
	$(BIN)/python -m sitl.endurance.file_mutants --mutants $(MUTANTS)
	$(BIN)/python -m sitl.endurance.fuzz --seconds $(SECONDS)
	$(BIN)/python -m sitl.endurance.parameter_sweep
	$(BIN)/python -m sitl.endurance.forged_frames --frames $(FRAMES)

$(VENV)/.fuzz: $(STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check 'atheris>=3,<4'
	@touch $@

kills: $(STAMP) ## kill test: 200 kills of the service in flight
	$(BIN)/companion kills

soak: $(STAMP) ## soak test: a day of flight in virtual time with all faults
	$(BIN)/companion soak

docs: $(VENV)/.docs ## build the documentation site in build/site
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet

$(VENV)/.docs: $(STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check 'mkdocs-material>=9.6,<10' 'mkdocstrings-python>=1.16,<3'
	@touch $@

pictures: $(STAMP) ## take the pictures of live view and report in docs/ again (needs Chromium)
	$(BIN)/python -m tests.docs.pictures

docs/configuration.md: $(STAMP) companion/config/*.py
	$(BIN)/python -m companion.config.reference > $@

lock: ## regenerate requirements.lock from pyproject.toml (needs uv)
	uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-emit-index-url \
	  --no-annotate --no-header $(foreach e,dev plot report live foxglove campaign fleet,--extra $(e)) \
	  -o requirements.lock pyproject.toml

oldest: ## tests with the oldest dependencies that pyproject.toml allows (needs uv)
	uv venv --quiet --clear build/oldest
	uv pip install --quiet --python build/oldest --resolution lowest-direct -e '.[dev,report,live,fleet,campaign]'
	build/oldest/bin/python -m pytest -n $(WORKERS) --dist worksteal -m "not flight"

clean: ## remove the environment and tool caches
	rm -rf $(VENV) build *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
