# Every target sets itself up: git, make and Python 3.11 or later are all that must be there.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.DEFAULT_GOAL := help
.PHONY: help loopback test lint fuzz kills soak lock clean

# of each target of `make fuzz`: make fuzz SECONDS=3600
SECONDS := 120

help: ## this list
	@grep -E '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

$(STAMP): pyproject.toml requirements.lock
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or later is needed; name one: make PYTHON=/path/to/python3.11")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	@touch $@

loopback: $(STAMP) ## fly the default scenario in virtual time: a log in logs/ and a table
	$(BIN)/companion loopback

test: $(STAMP) lint ## lint, types and every test
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n auto

lint: $(STAMP) ## ruff and mypy --strict
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

fuzz: $(VENV)/.fuzz ## hostile bytes for SECONDS at every door, guided by coverage (Linux)
	$(BIN)/python -m sitl.endurance.fuzz --seconds $(SECONDS)

$(VENV)/.fuzz: $(STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check 'atheris>=3,<4'
	@touch $@

kills: $(STAMP) ## the flying service killed 200 times: what its logs lost
	$(BIN)/companion kills

soak: $(STAMP) ## a day of flight in virtual time with every fault: what grew
	$(BIN)/companion soak

lock: ## requirements.lock anew from pyproject.toml (needs uv)
	uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-emit-index-url \
	  --no-annotate --no-header $(foreach e,dev plot report logs campaign,--extra $(e)) \
	  -o requirements.lock pyproject.toml

clean: ## remove the environment and what tools left
	rm -rf $(VENV) build *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
