# A thin front door; everything here also works without make:
#   bash envs/setup.sh && .venv/bin/snakemake --cores 2 scenes/kitchen
#   bash envs/setup.sh && .venv/bin/python -m pytest
.DEFAULT_GOAL := help
CORES ?= all
COMMA := ,
PYTHON_BIN := .venv/bin/python
SNAKEMAKE := .venv/bin/snakemake
# QUALITY=draft, p05, 120s (some 120 seconds), held_out:24 (dB); SNAKEMAKE_ARGS and PYTEST_ARGS pass anything else through.
CONFIG = $(if $(QUALITY),--config quality=$(QUALITY))

# A run starts some hundred processes; without kept byte code each of them would compile every module anew.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help setup scenes status verify test test-all test-slurm fuzz node doctor lint format lock lock-torch licences sbom docs clean always plan relight bench compare score results \
  config envs examples iif_core lab profiles tests workflow

help:
	@echo 'make scenes/<name>    install what is missing, then make the scene (config/scenes/<name>.yaml)'
	@echo 'make relight/<name>   the scene under other light and from other cameras, as its file says'
	@echo 'make plan/<name>      what the scene requires, before any long work'
	@echo 'make bench/<name>     three points of speed and accuracy in this room'
	@echo 'make compare/<a>,<b>  two finished results side by side'
	@echo 'make score/<name>     scores of the maps in MAPS=<folder> against a scene with truth'
	@echo 'make scenes           every scene of the batch table'
	@echo '                      QUALITY=standard  CORES=2  SNAKEMAKE_ARGS="--dry-run"'
	@echo 'make status           where every scene stands, also during a run'
	@echo 'make verify           re-hash every artefact against its manifest'
	@echo 'make test             all tests but the long ones (PYTEST_ARGS="-k laplace" for a part)'
	@echo 'make test-all         every test, also those on large scenes'
	@echo 'make fuzz             read changed files of every kind (CASES=100000 SEED=0 JOBS=2)'
	@echo 'make test-slurm       the Slurm profiles on a Slurm of one node, which is started and stopped'
	@echo 'make doctor           what this machine offers and lacks'
	@echo 'make setup            only the environment, .venv'
	@echo 'make lint | format    check | rewrite the style of Python and Snakemake files'
	@echo 'make lock             resolve envs/*.in again (needs uv); lock-torch INDEX=<index> accepts more builds of torch'
	@echo 'make licences | sbom  envs/licences.md | the bill of materials, sbom.json (need uv)'
	@echo 'make docs             the documentation as a site, in site/'
	@echo 'make clean            remove caches; results/ and scenes/ stay'

setup:
	@bash envs/setup.sh

# The folders exist once made, and Snakemake alone knows whether they are up to date: `always` asks it every time.
scenes/%: setup always
	$(SNAKEMAKE) --cores $(CORES) $@ $(CONFIG) $(SNAKEMAKE_ARGS)

relight/%: setup always
	$(SNAKEMAKE) --cores $(CORES) $@ $(CONFIG) $(SNAKEMAKE_ARGS)

plan/%: setup always
	$(SNAKEMAKE) --cores $(CORES) $@ $(CONFIG) $(SNAKEMAKE_ARGS)

bench/%: setup always
	$(SNAKEMAKE) --cores $(CORES) $@ $(CONFIG) $(SNAKEMAKE_ARGS)

compare/%: setup always
	$(SNAKEMAKE) --cores $(CORES) $@ $(CONFIG) $(SNAKEMAKE_ARGS)

score/%: setup always
	$(SNAKEMAKE) --cores $(CORES) $@ --config quality=$(or $(QUALITY),draft) $(if $(MAPS),maps=$(MAPS)) $(SNAKEMAKE_ARGS)

results/studies/%: setup always
	$(SNAKEMAKE) -s lab/Snakefile --cores $(CORES) $@ $(CONFIG) $(SNAKEMAKE_ARGS)

results/%: setup always
	$(SNAKEMAKE) --cores $(CORES) $@ $(CONFIG) $(SNAKEMAKE_ARGS)

# Folders of the checkout, which make would take for targets that are up to date.
plan relight bench compare score results:
	@echo '$@: not a target; name what is to be made in it, such as make $@/$(if $(filter plan relight bench score,$@),kitchen,$(if $(filter compare,$@),kitchen$(COMMA)hall,kitchen/capture/manifest.json))' >&2; exit 1

config envs examples iif_core lab profiles tests workflow:
	@echo '$@: a folder of the program and not a target; make help lists the targets' >&2; exit 1

# Anything else; scene/x is taken for a slip of scenes/x.
.DEFAULT:
	@echo "$@: not a target$(if $(filter scene/%,$@),; did you mean $(@:scene/%=scenes/%)?); make help lists the targets" >&2; exit 1

scenes verify: setup
	$(SNAKEMAKE) --cores $(CORES) $@ $(CONFIG) $(SNAKEMAKE_ARGS)

# Changes nothing, so it installs nothing.
status:
	@test -x $(PYTHON_BIN) || { echo 'status: nothing is installed yet; make scenes/<name> installs what is missing' >&2; exit 1; }
	@$(PYTHON_BIN) -m workflow status $(if $(QUALITY),--quality $(QUALITY))

always:

# A file's tests stay in one process, because they share what its fixtures made. A process that dies ends the run, because the
# other would wait for ever for a new one.
IN_PARALLEL := -n 2 --dist loadfile --no-loadscope-reorder --max-worker-restart 0
# All tests but those marked `long`, which test-all adds; times are in docs/development/testing.md.
test: setup node
	$(PYTHON_BIN) -m pytest $(IN_PARALLEL) -m "not long" $(PYTEST_ARGS)

test-all: setup node
	$(PYTHON_BIN) -m pytest $(IN_PARALLEL) -o faulthandler_timeout=0 $(PYTEST_ARGS)

# The counts are kept in lab/notebook/data/reliability_fuzz.json.
CASES ?= 100000
SEED ?= 0
JOBS ?= $(shell nproc 2>/dev/null || echo 2)
fuzz: setup
	$(PYTHON_BIN) -m tests.fuzz.runner --cases $(CASES) --seed $(SEED) --jobs $(JOBS)

# The Slurm profiles on a Slurm of one node, in namespaces that end with it: needs root, slurm-wlm and munge; minutes.
test-slurm: setup
	bash tests/slurm/run.sh $(PYTEST_ARGS)

# What tests take from npm: Khronos' validator of glTF, axe-core, which looks for what hinders people with disabilities, and three.js,
# which opens scene.glb as viewers on the web do. Machines without npm test the structure of the files alone. Pages need Chromium as well, which comes with the machine.
NODE_PACKAGES := gltf-validator@2.0.0-dev.3.10 axe-core@4.14.1 three@0.187.0
NODE_FOLDERS := $(addprefix .node/node_modules/,gltf-validator axe-core three)
node:
	@if [ $$(ls -d $(NODE_FOLDERS) 2>/dev/null | wc -l) -lt 3 ] && command -v npm >/dev/null; then \
	  npm install --fetch-retries=1 --fetch-timeout=60000 --no-save --no-audit --no-fund --silent --prefix .node $(NODE_PACKAGES) \
	    || echo 'node: npm could not install $(NODE_PACKAGES); their tests will be skipped' >&2; fi

# Needs nothing installed: it tells what is missing.
doctor:
	@if [ -x $(PYTHON_BIN) ]; then $(PYTHON_BIN) -m workflow.runtime.doctor; else python3 -m workflow.runtime.doctor; fi

lint: setup
	$(PYTHON_BIN) -m ruff check .
	.venv/bin/lint-imports
	$(PYTHON_BIN) -m snakefmt --check Snakefile workflow/rules lab/Snakefile lab/rules

format: setup
	$(PYTHON_BIN) -m ruff check --fix .
	$(PYTHON_BIN) -m snakefmt Snakefile workflow/rules lab/Snakefile lab/rules

# One lock serves CPU and CUDA machines: torch and what only its CUDA builds need stay out (see envs/README.md).
OUTSIDE_LOCK := torch triton cuda-bindings cuda-pathfinder cuda-toolkit nvidia-cublas nvidia-cuda-cupti \
  nvidia-cuda-nvrtc nvidia-cuda-runtime nvidia-cudnn-cu13 nvidia-cufft nvidia-cufile nvidia-curand nvidia-cusolver \
  nvidia-cusparse nvidia-cusparselt-cu13 nvidia-nccl-cu13 nvidia-nvjitlink nvidia-nvshmem-cu13 nvidia-nvtx

COMPILE := uv pip compile --quiet --generate-hashes --python-version 3.11 --python-platform x86_64-manylinux_2_36
lock:
	cd envs && $(COMPILE) $(addprefix --no-emit-package ,$(OUTSIDE_LOCK)) requirements.in -o requirements.lock
	cd envs && $(COMPILE) --constraint requirements.lock requirements-cluster.in -o requirements-cluster.txt
	cd envs && $(COMPILE) docs.in -o docs.txt
	uv run --quiet envs/lock.py

# More builds of torch that setup.sh accepts: those of another index, or of a folder of wheels.
lock-torch:
	@test -n "$(INDEX)" || { echo 'lock-torch: say INDEX=<address of a package index, or a folder of wheels>' >&2; exit 1; }
	uv run --quiet envs/lock.py --index "$(INDEX)"

# Licences of everything that the locks name; then the bill of materials of a release (docs/development/releasing.md).
licences:
	uv run --quiet envs/third_party.py

sbom:
	uv run --quiet envs/third_party.py --sbom sbom.json

# The site has a separate environment: none of its packages is needed to run the workflow.
docs: .venv-docs/.made
	NO_MKDOCS_2_WARNING=1 .venv-docs/bin/mkdocs build --strict

.venv-docs/.made: envs/docs.txt
	$${PYTHON:-python3} -m venv .venv-docs
	.venv-docs/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --require-hashes -r envs/docs.txt
	touch $@

clean:
	rm -rf .pytest_cache .ruff_cache .hypothesis .benchmarks .import_linter_cache site
	find . -name .venv -prune -o -name __pycache__ -type d -prune -exec rm -rf {} +
