# `make paper` and `make test` need nothing but python3 (3.11 or newer), pip, make and git.

PYTHON ?= python3
BIN := .venv/bin

.PHONY: paper closed-loop test check bench clean

paper: .venv/installed          ## reproduce every claim of the paper in SUMO
	@$(BIN)/evofsm paper --out results/paper

closed-loop: .venv/installed    ## does the reviser prevent collisions, at what cost? some 15 minutes
	@$(BIN)/evofsm bench closed-loop --out results/closed-loop

test: .venv/installed           ## all tests, doctests included
	@$(BIN)/python -m pytest -q

check: .venv/installed          ## lint, types and the import rule
	@$(BIN)/ruff check . && $(BIN)/ruff format --check . && $(BIN)/mypy && $(BIN)/lint-imports

bench: .venv/installed          ## how fast it is, as ratios against named references; bench.json
	@$(BIN)/python benchmarks/speed.py --json bench.json
	@$(BIN)/python benchmarks/decision.py

# pip installs into the environment from outside it, so Debian's ensurepip package is not needed.
.venv/installed: pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "evofsm needs Python 3.11 or newer; this is " + sys.version.split()[0] + ". Name another one: make PYTHON=python3.12")'
	@test -x $(BIN)/python || $(PYTHON) -m venv --without-pip .venv
	@echo "Installing evofsm and its tools into .venv (a minute or two) ..."
	@$(PYTHON) -m pip --python $(BIN)/python --disable-pip-version-check install --quiet --editable '.[dev]'
	@touch $@

clean:
	rm -rf .venv results bench.json dist build .pytest_cache .mypy_cache .ruff_cache .hypothesis
