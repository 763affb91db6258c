# Every target works as the first command on a fresh machine: .venv is made when it is missing or out of date.
.DEFAULT_GOAL := help
.PHONY: help demo test test-slow check bench notebooks clean

PYTHON ?= python3
BIN := .venv/bin
READY := .venv/installed
DEMO := outputs/demo
DEMO_SCENES := 240
DEMO_LAST := 00239

help: ## List the targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-10s %s\n", $$1, $$2}'

$(READY): pyproject.toml
	@echo "Installing into .venv: a few minutes, once"
	@$(PYTHON) -m venv .venv
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable ".[dev]"
	@touch $(READY)

# The held-out picture is the first frame of the last scene, which is always in the test split.
demo: $(READY) ## Make toy scenes, train both stages, evaluate, complete two pictures (CPU, under 15 minutes)
	rm -rf $(DEMO)
	$(BIN)/completesplat data toy kind=objects scenes=$(DEMO_SCENES) out=$(DEMO)/data
	$(BIN)/completesplat fit experiment=toy_var data.root=$(DEMO)/data trainer.max_steps=2200 data.color_jitter=null test=false out=$(DEMO)/var
	$(BIN)/completesplat fit experiment=toy_diffusion data.root=$(DEMO)/data trainer.max_steps=700 \
	  model.autoreconstructor_checkpoint=$(DEMO)/var/checkpoints/last.ckpt test=false out=$(DEMO)/diffusion
	$(BIN)/completesplat test ckpt=$(DEMO)/var/checkpoints/last.ckpt out=$(DEMO)/test_var
	$(BIN)/completesplat test ckpt=$(DEMO)/diffusion/checkpoints/last.ckpt out=$(DEMO)/test
	cp -r $(DEMO)/diffusion/weights $(DEMO)/weights
	cp $(DEMO)/test/metrics.json $(DEMO)/metrics.json
	cp $(DEMO)/data/toy_objects/*$(DEMO_LAST)_*/images/frame000001.jpg $(DEMO)/held_out.jpg
	cp `$(BIN)/python -c "import skimage; print(skimage.__path__[0])"`/data/coffee.png $(DEMO)/photograph.png
	$(BIN)/completesplat predict image=$(DEMO)/held_out.jpg weights=$(DEMO)/weights out=$(DEMO)
	$(BIN)/completesplat predict image=$(DEMO)/photograph.png weights=$(DEMO)/weights out=$(DEMO)
	@echo
	@echo "In $(DEMO):"
	@echo "  held_out/     4 completions of a scene that training never saw: look at sheet.png first;"
	@echo "                sample_0*.ply open in any splat viewer, orbit_0*.mp4 in any player"
	@echo "  photograph/   the same for a real photograph, which these toy weights do not understand"
	@echo "  metrics.json  scores of the latent diffusion's samples on held-out scenes (test_var/: of the VAR)"
	@echo "  weights/      for completesplat predict image=FILE weights=$(DEMO)/weights"
	@echo "  data/ var/ diffusion/   the toy scenes and the two training runs"

# Threads that wait at full speed, as GNU OpenMP's do by default, would keep the other test process off the cores.
test: check ## Lint, types and the tests (CPU, under 8 minutes)
	GOMP_SPINCOUNT=3000 $(BIN)/python -m pytest -q --numprocesses auto --maxprocesses 4 --dist worksteal

test-slow: $(READY) ## The tests that take minutes each
	$(BIN)/python -m pytest -q -m slow

check: $(READY) ## Lint, formatting and types
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

bench: $(READY) ## Time the rasterizer backends, data loading, and stage 2, side by side
	$(BIN)/completesplat bench rasterizers
	$(BIN)/completesplat bench data
	$(BIN)/completesplat bench diffusion

notebooks: $(READY) ## Run every notebook from top to bottom
	$(BIN)/jupyter execute notebooks/*.ipynb

clean: ## Remove everything that can be made again, the environment included
	rm -rf .venv outputs multirun build dist .pytest_cache .mypy_cache .ruff_cache *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
