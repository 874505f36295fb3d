# Everything runs from .venv, which `make setup` builds from the hashed lock and nothing else.
SHELL := /bin/bash
PYTHON ?= python3
BIN := .venv/bin
DEMO ?= auto
DEMO_FLAGS := $(if $(filter headless,$(DEMO)),--headless,)

.DEFAULT_GOAL := help
.PHONY: help setup demo test lint check bench bench-registration bench-sections bench-twin bench-parts bench-verdicts campaign lock picture

help:      ## this list
	@grep -E '^[a-z-]+: .*## ' Makefile | sed -E 's/:.*## /\t/' | expand -t 20

setup: .venv/.ready  ## virtual environment with the locked packages and the bladecell command

.venv/.ready: requirements.lock pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit("bladecell needs Python 3.11 or newer" if sys.version_info < (3, 11) else 0)'
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	touch $@

demo: setup  ## simulated cell + station: inspect blades, show verdicts (DEMO=headless: no screen)
	$(BIN)/bladecell demo $(DEMO_FLAGS)

# One thread for linear algebra: threads that wait for each other by spinning make a busy machine crawl.
test: setup lint  ## every check that .ci/run runs
	OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/pytest

lint: setup  ## style, types, direction of imports
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

check: test  ## the same as test

bench: setup  ## accuracy and time of every stage, one table each
	$(BIN)/python -m benchmarks

bench-registration: setup  ## registration alone: accuracy, damage found, certainty, peers, random poses
	$(BIN)/python -m benchmarks.registration
	$(BIN)/python -m benchmarks.poses

bench-sections: setup  ## sections alone: the thesis' grid by both methods, sigmas, airfoils, time
	$(BIN)/python -m benchmarks.sections
	$(BIN)/python -m benchmarks.section_grid

bench-twin: setup  ## twin and repair alone: section 5.5, six kinds of wear, volumes, peers
	$(BIN)/python -m benchmarks.twin
	$(BIN)/python -m benchmarks.damage
	$(BIN)/python -m benchmarks.repair
	$(BIN)/python -m benchmarks.twin_peers

bench-parts: setup  ## whole parts from views to patches: occlusion, real blades as nominals
	$(BIN)/python -m benchmarks.views
	$(BIN)/python -m benchmarks.real_parts

bench-verdicts: setup  ## the whole product from files: verdicts of random parts against the truth; none may be wrong
	$(BIN)/python -m benchmarks.verdicts 20
	$(BIN)/python -m benchmarks.verdicts 6 --real
	$(BIN)/python -m benchmarks.verdicts 6 --real --rework

campaign: setup  ## hours: every registration cloud, 1,000 random poses a scenario, all seeds of the twin
	$(BIN)/python -m benchmarks.registration --full
	$(BIN)/python -m benchmarks.poses 1000
	$(BIN)/python -m benchmarks.twin --full
	$(BIN)/python -m benchmarks.thesis_twin --full
	$(BIN)/python -m benchmarks.repair 10
	$(BIN)/python -m benchmarks.twin_peers --full
	$(BIN)/python -m benchmarks.views 5
	$(BIN)/python -m benchmarks.verdicts 300
	$(BIN)/python -m benchmarks.verdicts 60 --real

picture: setup  ## redraw the picture of the screen in the README
	$(BIN)/python -m tests.station.tui.picture docs/screen.png

lock:      ## resolve the lock again (needs uv on PATH)
	uv pip compile pyproject.toml --extra dev --extra bench --universal --generate-hashes \
	  --no-header --no-emit-index-url --python-version 3.11 --quiet --output-file requirements.lock
