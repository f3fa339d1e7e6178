# The Python that .venv is made from (3.11 or 3.12), the extras that the tests have (with sb3, those of
# Stable-Baselines3 are not skipped), and what pytest is given.
PYTHON ?= python3
TEST_EXTRAS ?= test
PYTEST_ARGS ?= -n 2 --dist loadfile --no-loadscope-reorder
# The first boxes follow no wall; three seeds show how far luck goes.
CONFIG ?= configs/point_maze.yaml
QUICK ?= --with configs/ablations/wrong_boxes.yaml --seeds 3 --trainer.eval_every 1 --total-env-steps 448000

VENV := .venv
BIN := $(VENV)/bin
INSTALL = $(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable
PINS := pyproject.toml constraints.txt

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.NOTPARALLEL:
.PHONY: help quickstart test lint format docs audit clean

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "make %-11s %s\n", $$1, $$2 }' $(firstword $(MAKEFILE_LIST))

quickstart: $(VENV)/.run ## install into .venv, train on the Point Maze with refinement and without (CONFIG=...)
	@dir=runs/quickstart; n=2; \
	while [ -e "$$dir" ] && [ -n "$$(ls -A "$$dir")" ]; do dir=runs/quickstart-$$n; n=$$((n + 1)); done; \
	set -ex; $(BIN)/star train $(CONFIG) $(QUICK) --run-dir "$$dir"; \
	$(BIN)/star train $(CONFIG) $(QUICK) --with ablations/no_refinement --run-dir "$$dir-unrefined"; \
	$(BIN)/python scripts/quickstart.py "$$dir" "$$dir-unrefined"

test: lint ## lint, check the types, run the tests (PYTEST_ARGS=...)
	$(BIN)/python -m mypy --num-workers 2 star envs
	$(BIN)/python -m pytest -q $(PYTEST_ARGS)

lint: $(VENV)/.$(TEST_EXTRAS) ## ruff: rules and formatting
	$(BIN)/python -m ruff check
	$(BIN)/python -m ruff format --check

format: $(VENV)/.$(TEST_EXTRAS) ## ruff: repair and format
	$(BIN)/python -m ruff check --fix
	$(BIN)/python -m ruff format

docs: $(VENV)/.docs ## build the documentation into site/
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

audit: ## known flaws of the packages in constraints.txt; asks a public database
	$(PYTHON) -m venv $(VENV)/audit
	$(VENV)/audit/bin/python -m pip install --quiet --disable-pip-version-check pip-audit==2.10.1
	$(VENV)/audit/bin/pip-audit --requirement constraints.txt --no-deps --disable-pip

clean: ## remove .venv, caches and built files; runs/ stays
	rm -rf $(VENV) .hypothesis .mypy_cache .pytest_cache .ruff_cache build dist site
	find star envs tests scripts -name __pycache__ -type d -exec rm -rf {} + 2>/dev/null || true

# One stamp for each set of packages: nothing is installed again unless the pins change.
$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 12) and \
	  "star-rl needs Python 3.11 or 3.12, not %d.%d; try: make PYTHON=python3.12 ..." % sys.version_info[:2])'
	$(PYTHON) -m venv $(VENV)

$(VENV)/.run: $(PINS) | $(BIN)/python
	@echo "installing into $(VENV) (a minute or two)"
	$(INSTALL) .
	@touch $@

$(VENV)/.$(TEST_EXTRAS) $(VENV)/.docs: $(VENV)/.%: $(PINS) | $(BIN)/python
	@echo "installing into $(VENV) (a minute or two)"
	$(INSTALL) '.[$*]'
	@touch $@ $(VENV)/.run
