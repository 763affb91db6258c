# Every target works as the first command on a fresh machine: .venv is made when it is missing or out of date.
.DEFAULT_GOAL := help
.PHONY: help demo test test-slow check bench notebooks clean

PYTHON ?= python3
BIN := .venv/bin
READY := .venv/installed
DEMO := outputs/demo

help: ## List the targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-10s %s\n", $$1, $$2}'

$(READY): pyproject.toml
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable ".[dev]"
	@touch $(READY)

demo: $(READY) ## Make toy scenes, train both stages, evaluate, complete two pictures (CPU, minutes)
	$(BIN)/python -m completesplat demo out=$(DEMO)

test: check ## Lint, types and the tests (CPU, under 8 minutes)
	$(BIN)/python -m pytest -q

test-slow: $(READY) ## The tests that take minutes each
	$(BIN)/python -m pytest -q -m slow

check: $(READY) ## Lint, formatting and types
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

bench: $(READY) ## Time the rasterizer backends side by side
	$(BIN)/completesplat bench rasterizers

notebooks: $(READY) ## Run every notebook from top to bottom
	$(BIN)/jupyter execute notebooks/*.ipynb

clean: ## Remove everything that can be made again, the environment included
	rm -rf .venv outputs multirun build dist .pytest_cache .mypy_cache .ruff_cache *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
