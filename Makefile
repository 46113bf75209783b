# The chores of beampose. `make help` lists them.
#
# PYTHON=python3.12 chooses the Python of a new environment, VENV=elsewhere its place.

PYTHON ?= python3
VENV ?= .venv
VENV_PEERS ?= .venv-peers
WORKERS ?= 2
SEEDS ?= 1:301
BIN := $(VENV)/bin
READY := $(VENV)/.ready
READY_PEERS := $(VENV_PEERS)/.ready
READY_DOCS := $(VENV)/.ready-docs
# Only the trackers that are there: ours, and the peers after `make peers`.
BENCH_PEERS = $(if $(wildcard $(READY_PEERS)),$(VENV_PEERS)/bin/python -m bench.peers,$(BIN)/python -m bench.peers --trackers ours)
SAMPLE_RUNS := $(patsubst %/run.yaml,%,$(wildcard sample_runs/*/run.yaml))
# Tests of one module stay on one worker as long as possible: they share what the module makes once.
PARALLEL := -n $(WORKERS) --dist worksteal
DEMO := results/demo
DEMO_FIRST := $(patsubst %,$(DEMO)/%/report.html,huo2015 sharp-turns calibration)

.DEFAULT_GOAL := help
.PHONY: help setup demo test test-all check format docs bench-tracking bench-random bench-detection bench-throughput bench-live bench-calibration peers bench-peers lock wheel clean

help:  ## List the chores
	@sed -n 's/^\([a-z-]*\):.*##  */\1|/p' $(MAKEFILE_LIST) | while IFS='|' read -r name what; do \
		printf '  make %-16s %s\n' "$$name" "$$what"; done

setup: $(READY)  ## Build the environment (.venv) from requirements.lock; once
	@echo "The environment $(VENV) is ready."

# The stamp is removed first: an installation that was broken off is not taken for a finished one.
$(READY): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
		echo "beampose needs Python 3.11 or newer; found: $$($(PYTHON) --version 2>&1 || true)." >&2; \
		echo "Name another one: make PYTHON=python3.12 $(MAKECMDGOALS)" >&2; exit 2; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { \
		echo "$(PYTHON) comes without venv or ensurepip, which build the environment." >&2; \
		echo "On Debian or Ubuntu: apt-get install python3-venv" >&2; exit 2; }
	@rm -f $(READY)
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --require-virtualenv --require-hashes --requirement requirements.lock
	$(BIN)/python -m pip install --quiet --require-virtualenv --no-deps --no-build-isolation --editable .
	@echo "Compiling for this machine, once (about a minute)."
	$(BIN)/python -m lab.runs.warm_up
	@touch $(READY)

# The batch's exit status is the demo's, but the results that are there are shown in any case.
demo: setup  ## Process the sample runs, calibrate the sample rig, show where the results are
	@test -n "$(SAMPLE_RUNS)" || { echo "sample_runs/ holds no run (a folder with a run.yaml)." >&2; exit 2; }
	@status=0; $(BIN)/beampose batch $(SAMPLE_RUNS) --out $(DEMO) || status=$$?; \
	$(BIN)/beampose calibrate rig sample_runs/calibration --out $(DEMO)/calibration || status=$$?; \
	echo; echo "All runs, the worst first, with a report each:"; \
	ls $(DEMO)/index.html 2>/dev/null | sed 's/^/  /'; \
	echo "Reports to open first (a run of pictures, fast turns, the calibration of a rig):"; \
	ls $(DEMO_FIRST) 2>/dev/null | sed 's/^/  /'; \
	echo "Tables: batch.csv in $(DEMO), and the CSV files in its folders."; \
	exit $$status

check: setup  ## Lint, formatting and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

test: check  ## The checks and the fast tests
	$(BIN)/python -m pytest $(PARALLEL)

test-all: check  ## The checks and all tests, the slow ones too
	$(BIN)/python -m pytest $(PARALLEL) -m 'slow or not slow'

format: setup  ## Format the code and apply the linter's automatic fixes
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: $(READY_DOCS)  ## Build the documentation site (build/docs/index.html); its gallery is executed, which takes some minutes
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict
	@echo "Open build/docs/index.html"

# In the project's environment, since pages are generated from the code. The list lacks what that environment has in any case.
$(READY_DOCS): $(READY) requirements-docs.lock
	@rm -f $(READY_DOCS)
	$(BIN)/python -m pip install --quiet --require-virtualenv --require-hashes --no-deps --requirement requirements-docs.lock
	$(BIN)/python -m pip check
	@touch $(READY_DOCS)

bench-tracking: setup  ## The tracking figures on fresh seeds, peers if installed
	$(BIN)/python -m bench.tracking
	$(BIN)/python -m bench.first_labels
	$(BIN)/python -m bench.rigid
	$(BENCH_PEERS)

bench-random: setup  ## Recordings drawn at random: how many are clean, and why the others are not (SEEDS=1:301)
	$(BIN)/python -m bench.random_scenes --seeds $(SEEDS) --jobs $(WORKERS)

bench-detection: setup  ## The detection figures, on fresh seeds
	$(BIN)/python -m bench.detection

bench-throughput: setup  ## What a run costs, stage by stage, beside reading its pictures (some minutes)
	$(BIN)/python -m bench.throughput

bench-live: setup  ## How late the poses of `beampose watch` are at 100 Hz (half a minute)
	$(BIN)/python -m bench.live

bench-calibration: setup  ## The calibration figures, on fresh seeds (a quarter of an hour)
	$(BIN)/python -m bench.calibration

peers: $(READY_PEERS)  ## Build an environment with other people's trackers (.venv-peers), for bench-peers; once
	@echo "The environment $(VENV_PEERS) is ready."

# In an environment of its own: peers forbid numpy and scipy versions that the lock file may come to hold. norfair goes
# without its dependencies, since its metadata contradict the others' (see pyproject.toml).
$(READY_PEERS): pyproject.toml
	@rm -f $(READY_PEERS)
	$(PYTHON) -m venv $(VENV_PEERS)
	$(VENV_PEERS)/bin/python -m pip install --quiet --require-virtualenv --editable '.[peers]'
	$(VENV_PEERS)/bin/python -m pip install --quiet --require-virtualenv --no-deps 'norfair>=2.3' 'filterpy>=1.4.5'
	@touch $(READY_PEERS)

bench-peers: peers  ## Other people's trackers and ours on the same points (half an hour)
	$(VENV_PEERS)/bin/python -m bench.peers

# In an environment of its own, so that the lock file depends on pyproject.toml alone. One list serves all systems and
# Pythons: `--universal` writes markers, `fewest` takes one version of each package. uv reads the hashes of all files of a
# version from the package index and downloads none. Versions that are already locked stay, unless pyproject.toml forbids
# them; `make lock LOCK_FLAGS=--upgrade` takes the newest. requirements-docs.lock adds to the environment that
# requirements.lock makes, so it lacks what that one installs on every system.
COMPILE := build/lock/bin/uv pip compile --quiet --universal --python-version 3.11 --fork-strategy fewest --generate-hashes \
	--strip-extras --no-header --no-emit-index-url --no-emit-find-links

lock:  ## Write requirements.lock and requirements-docs.lock again from pyproject.toml, with hashes
	$(PYTHON) -m venv --clear build/lock
	build/lock/bin/python -m pip install --quiet uv
	$(COMPILE) --extra dev $(LOCK_FLAGS) --output-file requirements.lock pyproject.toml
	sed -n 's/^\([A-Za-z0-9._-]*==[^ ]*\).*/\1/p' requirements.lock > build/lock/versions.txt
	$(PYTHON) -c 'import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["project"]["optional-dependencies"]["docs"], sep="\n")' \
		> build/lock/docs.txt
	$(COMPILE) --constraint build/lock/versions.txt --no-annotate $(LOCK_FLAGS) \
		$$(sed -n 's/^\([A-Za-z0-9._-]*\)==[^ ]* \\$$/--no-emit-package \1/p' requirements.lock) \
		--output-file requirements-docs.lock build/lock/docs.txt

wheel: setup  ## Build dist/beampose-*.whl
	$(BIN)/python -m build --no-isolation --outdir dist .

clean:  ## Remove the environment, builds, results and caches
	rm -rf .venv .venv-peers build dist results .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
