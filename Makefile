# Every target works as the first command on a fresh machine: .venv is made when it is missing or out of date.
.DEFAULT_GOAL := help
.PHONY: help board demo demo-train test test-processes test-slow test-wheel test-browser fuzz check size lock bench gpu gpu-weights gpu-weights-inputs docs site try notebooks release clean

PYTHON ?= python3
BIN := .venv/bin
# The rasterizer's kernels are compiled in the background, while the target that needed .venv begins.
# LOCKED=1 installs the versions of requirements.lock, whose files must have the hashes in it. Most figures in the
# documents are by this TORCH; some machines have its CPU build at hand.
READY := .venv/installed$(if $(LOCKED),-locked)
TORCH := torch<2.14
DEMO := outputs/demo
DEMO_SCENES := 80
DEMO_LAST := 00079
TRAINED := outputs/demo_train
FUZZ_MINUTES ?= 10

help: ## List the targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-13s %s\n", $$1, $$2}'

$(READY): pyproject.toml $(if $(LOCKED),requirements.lock)
	@echo "Installing into .venv: a few minutes, once"
	@$(PYTHON) -m venv .venv
	$(if $(LOCKED),@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --require-hashes -r requirements.lock)
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable ".[dev]" "$(TORCH)"
	@$(BIN)/python -c "from completesplat.rasterizers.selection import auto; auto()" > /dev/null 2>&1 &
	@touch $(READY)

# The scenes have another seed than those of the weights' training. The toy image is the first frame of the last scene.
demo: $(READY) ## Complete four images with the weights in the package, and score some (CPU, minutes)
	rm -rf $(DEMO)
	$(BIN)/completesplat data toy kind=objects scenes=$(DEMO_SCENES) seed=1000 out=$(DEMO)/data
	cp completesplat/weights/fruits/held_out.jpg $(DEMO)/fruit.jpg
	cp completesplat/weights/rendered_couches/held_out.jpg $(DEMO)/couch.jpg
	cp $(DEMO)/data/toy_objects/*$(DEMO_LAST)_*/images/frame000001.jpg $(DEMO)/toy.jpg
	cp `$(BIN)/python -c "import skimage; print(skimage.__path__[0])"`/data/coffee.png $(DEMO)/photograph.png
	$(BIN)/completesplat predict image=$(DEMO)/fruit.jpg weights=fruits out=$(DEMO)
	$(BIN)/completesplat predict image=$(DEMO)/couch.jpg weights=rendered_couches out=$(DEMO)
	$(BIN)/completesplat predict image=$(DEMO)/toy.jpg weights=toy_objects out=$(DEMO)
	$(BIN)/completesplat predict image=$(DEMO)/photograph.png weights=general out=$(DEMO)
	$(BIN)/completesplat test weights=toy_objects data=toy_objects data.root=$(DEMO)/data out=$(DEMO)/test
	@echo
	@echo "In $(DEMO):"
	@echo "  fruit/        4 completions of a real photograph, of an apple that training never saw: look at sheet.png first;"
	@echo "                sample_0*.ply open in any splat viewer, orbit_0*.mp4 in any player"
	@echo "  couch/        the same for a rendered couch that training never saw"
	@echo "  toy/          the same for a toy scene that training never saw"
	@echo "  photograph/   the same for a photograph of a cup, by weights for photographs of anything: it keeps its front"
	@echo "  test/         metrics.json: scores of one sample for each held-out toy scene, beside naive predictors"
	@echo "Next: $(BIN)/completesplat predict image=FILE, and make demo-train for both stages of training"

demo-train: $(READY) ## Make toy scenes, train both stages briefly, evaluate, complete an image (CPU, under 15 minutes)
	rm -rf $(TRAINED)
	$(BIN)/completesplat data toy kind=objects scenes=240 out=$(TRAINED)/data
	$(BIN)/completesplat fit experiment=toy_var data.root=$(TRAINED)/data trainer.max_steps=2200 data.color_jitter=null test=false out=$(TRAINED)/var
	$(BIN)/completesplat fit experiment=toy_diffusion data.root=$(TRAINED)/data trainer.max_steps=1600 \
	  model.autoreconstructor_checkpoint=$(TRAINED)/var/checkpoints/last.ckpt test=false out=$(TRAINED)/diffusion
	$(BIN)/completesplat test ckpt=$(TRAINED)/var/checkpoints/last.ckpt out=$(TRAINED)/test_var
	$(BIN)/completesplat test ckpt=$(TRAINED)/diffusion/checkpoints/last.ckpt out=$(TRAINED)/test
	cp $(TRAINED)/data/toy_objects/*00239_*/images/frame000001.jpg $(TRAINED)/held_out.jpg
	$(BIN)/completesplat predict image=$(TRAINED)/held_out.jpg weights=$(TRAINED)/diffusion/weights out=$(TRAINED)
	@echo
	@echo "In $(TRAINED): data/ var/ diffusion/ (its weights/ are for predict weights=DIR), test_var/ and test/ with scores, held_out/"

# The processes fill the cores: further threads would take turns with them, and those that wait at full speed, as GNU
# OpenMP's do by default, would keep another process off its core. Where an environment forbids Python to keep compiled
# modules, rewriting every assertion takes ten seconds each time.
test: check ## Lint, types and the tests (CPU, 4 to 8 minutes on two cores)
	OMP_NUM_THREADS=1 GOMP_SPINCOUNT=1500 PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -q --numprocesses auto --maxprocesses 4 --dist worksteal

test-processes: $(READY) ## The tests that start processes and servers, send signals, damage files at random, fill disks
	OMP_NUM_THREADS=1 GOMP_SPINCOUNT=1500 PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -q -m "processes and not slow" --numprocesses auto --maxprocesses 4 --dist worksteal

test-slow: $(READY) ## The tests that take minutes each
	$(BIN)/python -m pytest -q -m slow

test-wheel: $(READY) ## The wheel in a new environment: a prediction, a sweep and its tables from an empty folder
	$(BIN)/python -m pytest -q -m slow tests/test_wheel.py

test-browser: $(READY) ## Viewer in Chromium (apt-get install chromium); skipped where it is missing
	$(BIN)/python -m pytest -q -m browser -rs

# What hypothesis finds is kept in .hypothesis/ and tried first the next time.
fuzz: $(READY) ## Damaged files for each of eight readers, FUZZ_MINUTES=10 each
	FUZZ_MINUTES=$(FUZZ_MINUTES) $(BIN)/python -m pytest -q -m "" -p no:logging --numprocesses auto --maxprocesses 8 tests/test_fuzzed_readers.py

check: $(READY) ## Lint, formatting and types
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

# Without torch, of which a machine with a GPU takes another build than one without: that is installed by pyproject.toml.
lock: $(READY) ## Write requirements.lock: the newest versions that pyproject.toml allows, for all systems, with hashes
	$(BIN)/python -m pip install --quiet --disable-pip-version-check uv
	$(BIN)/python -m uv pip compile pyproject.toml --extra dev --universal --python-version 3.11 --upgrade --generate-hashes \
	  --no-annotate --no-emit-package torch --custom-compile-command "make lock" --quiet --output-file requirements.lock

size: ## Print the lines of code of package and tests, and how dense they are
	@$(PYTHON) tests/lines_of_code.py completesplat tests

board: $(READY) ## Write the board's page from the results in completesplat/evaluation/board
	$(BIN)/python -c "from completesplat.evaluation.board_tables import write_page; write_page()"

bench: $(READY) ## Time the rasterizer backends, side by side
	$(BIN)/completesplat bench rasterizers

gpu: $(READY) ## What only a GPU can show, 25 minutes, in outputs/gpu: tests, times, trainings (SMALL=1: tiny sizes, anywhere)
	PYTHONPATH=. $(BIN)/python tests/gpu_day.py $(if $(SMALL),--small)

# On a machine without a network, with what is needed installed: READY= BIN=FOLDER_OF_PYTHON. What is cut goes on where it was.
WEIGHTS_OUT = outputs/gpu_weights$(if $(SMALL),_small)
INPUTS ?= $(WEIGHTS_OUT)_inputs
START ?= completesplat/weights/general
MINUTES ?= 14

gpu-weights-inputs: $(READY) ## Pack START=WEIGHTS and the captures SCANS=FOLDER MORE="FOLDER ..." for gpu-weights
	PYTHONPATH=. $(BIN)/python notebooks/gpu_weights_inputs.py $(INPUTS) $(if $(SMALL),--small,$(START) $(SCANS) $(MORE))

gpu-weights: $(READY) ## Better general weights in MINUTES=14 of a GPU, from INPUTS=FOLDER (SMALL=1: a rehearsal, anywhere)
	$(if $(SMALL),test -d $(INPUTS) || $(MAKE) gpu-weights-inputs)
	PYTHONPATH=.:$(PYTHONPATH) $(BIN)/python notebooks/gpu_weights.py $(INPUTS) $(WEIGHTS_OUT) --minutes $(MINUTES) \
	  $(if $(STAGE2),--stage2) $(if $(SMALL),--small)

docs: $(READY) ## The API reference, from the docstrings, in outputs/api
	$(BIN)/pdoc --docformat google --output-directory outputs/api completesplat '!completesplat.data.rendered._scene_script' '!completesplat.data.rendered._scene_meshes'
	@echo "outputs/api/completesplat.html"

# Predictions of the gallery are kept in outputs/gallery: remove it to make them again.
site: docs ## The site in outputs/site: documents, notebooks, API, weights, scenes that turn, try (these need Node.js)
	@$(BIN)/python -c "import furo, myst_nb" 2> /dev/null || \
	  $(BIN)/python -m pip install --quiet --disable-pip-version-check --editable ".[dev,site]"
	$(BIN)/python notebooks/website.py
	$(MAKE) try

# The page is complete in its folder; any static host serves it. WEIGHTS: a name in the package, or a folder of weights.
WEIGHTS ?= general
TRY := outputs/site/try
LICENCES = $(firstword $(wildcard $(WEIGHTS)/LICENSE.txt completesplat/weights/$(WEIGHTS)/LICENSE.txt) LICENSE)

try: $(READY) ## The page that completes photos in a browser, with WEIGHTS=general, in outputs/site/try (needs Node.js)
	cd notebooks/try && npm ci --no-audit --no-fund
	rm -rf $(TRY)
	mkdir -p $(TRY)
	$(BIN)/completesplat export weights=$(WEIGHTS) precision=float16 out=$(TRY)/weights
	cp $(LICENCES) $(TRY)/weights/LICENSE.txt
	$(BIN)/python notebooks/try/examples.py $(TRY)/examples
	node notebooks/try/build.mjs $(TRY)
	@echo "python3 -m http.server --directory $(TRY)"

notebooks: $(READY) ## Run every notebook from top to bottom, and store what it prints and draws
	$(BIN)/python tests/stored_notebooks.py

# The same commit gives the same bytes: hatchling takes all times from SOURCE_DATE_EPOCH, and sets the files' modes. The
# bill of materials has the versions of requirements.lock, and of torch, which is not in it, the range that is allowed.
SHA256 = $(shell which sha256sum || echo shasum -a 256)# which macOS has
release: export SOURCE_DATE_EPOCH = $(shell git log -1 --format=%ct)
release: ## Wheel, sdist, checksums and a bill of materials (CycloneDX), in dist; nothing is uploaded
	rm -rf dist build/release
	$(PYTHON) -m venv build/release
	build/release/bin/python -m pip install --quiet --disable-pip-version-check build twine cyclonedx-bom
	build/release/bin/python -m build --outdir dist
	build/release/bin/twine check --strict dist/*
	{ cat requirements.lock; sed -n 's/^  "\(torch>.*\)",/\1/p' pyproject.toml; } > build/release/requirements.txt
	build/release/bin/cyclonedx-py requirements --pyproject pyproject.toml --output-reproducible \
	  --output-file `ls dist/*.whl | sed 's/-py3.*/.cdx.json/'` build/release/requirements.txt
	cd dist && $(SHA256) * > SHA256SUMS && cat SHA256SUMS

clean: ## Remove everything that can be made again, the environment included
	rm -rf .venv outputs multirun build dist .hypothesis .pytest_cache .mypy_cache .ruff_cache *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
