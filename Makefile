# `make paper` and `make test` need nothing but python3 (3.11 or newer), pip, make and git;
# SUMO, of a system without a screen: libgl1, libxrender1 and libatomic1.

PYTHON ?= python3
BIN := .venv/bin
# Tests start Python often: what it compiles is kept, whatever the environment says.
export PYTHONDONTWRITEBYTECODE =
# Else Python reads no path with an umlaut that an editable installation names.
ifneq (,$(filter C POSIX,$(LC_ALL)))
export LC_ALL := C.UTF-8
endif
INSTALL = $(PYTHON) -m pip --python $(BIN)/python --disable-pip-version-check install --quiet

.PHONY: paper watch closed-loop evidence docs test test-all check house \
    bench fuzz torture soak lock lowest supply dist \
    clean

paper: .venv/installed          ## reproduce every claim of the paper in SUMO
	@$(BIN)/evofsm paper --out results/paper

watch: .venv/installed          ## look on while it drives case 1 of the paper, in the browser
	@$(BIN)/evofsm watch paper --case 1 --world sumo

closed-loop: .venv/installed    ## does the reviser prevent collisions, at what cost? some 15 minutes
	@$(BIN)/python -m studies closed-loop --out results/closed-loop

PYTEST = $(BIN)/python -m pytest -q -n auto --maxprocesses 4 --dist worksteal --durations=10
test: .venv/installed           ## the quick tests, doctests included; some minutes
	@$(PYTEST) -m 'not slow'

test-all: test                  ## those, and the slow rest: whole studies, torture, the browser
	@$(PYTEST) -m slow

check: .venv/installed          ## lint, types, the import rule and the house
	@$(BIN)/ruff check . && $(BIN)/ruff format --check . && $(BIN)/mypy && $(BIN)/lint-imports
	@$(BIN)/python tools/house.py

house: .venv/installed          ## draw the rooms from their imports; fails where an arrow goes up
	@$(BIN)/python tools/house.py

bench: .venv/installed          ## how fast it is, as ratios against named references; bench.json
	@$(BIN)/python benchmarks/speed.py --json bench.json
	@$(BIN)/python benchmarks/calls.py

evidence: .venv/installed       ## all studies in short, on one page; DATA=folder adds real drives
	@$(BIN)/python -m studies evidence --out results/evidence $(if $(DATA),--data $(DATA))

docs: .venv/installed           ## the documentation's site: results/docs/index.html
	@$(BIN)/python -m sphinx -W --keep-going -n -q docs results/docs

soak: .venv/installed           ## do the numbers hold for a thousand million steps, a monitor for a day? some 40 minutes
	@$(BIN)/python benchmarks/soak.py
	@$(BIN)/python benchmarks/monitor_soak.py

lock: .venv/installed           ## pin what development needs anew, with hashes
	@$(BIN)/uv pip compile --quiet --universal --generate-hashes --extra dev --upgrade \
	    --python-version 3.11 --no-annotate --custom-compile-command 'make lock' \
	    pyproject.toml --output-file requirements.lock

LOWEST := .venv-lowest/bin/python
lowest: .venv/installed         ## test the core with the lowest versions that are allowed
	@$(BIN)/uv venv --quiet --allow-existing --python $(BIN)/python .venv-lowest
	@$(BIN)/uv pip install --quiet --python $(LOWEST) --resolution lowest-direct \
	    --editable '.[tables,study,river]' 'pytest>=8.3' 'hypothesis>=6.100'
	@$(LOWEST) -m pytest -q -p no:cacheprovider tests/fsm
supply: .venv/installed         ## a bill of materials: sbom.json; known holes in what is pinned
	@$(BIN)/uv tool run --from cyclonedx-bom cyclonedx-py requirements requirements.lock -o sbom.json
	@$(BIN)/uv tool run pip-audit --strict --disable-pip --require-hashes --requirement requirements.lock

dist: .venv/installed           ## sdist and wheel; the quick tests of the one against the other
	@$(BIN)/python tools/dist.py

torture: .venv/installed        ## kill -9, full disks, damaged files, forged logs: is anything lost or wrong?
	@$(BIN)/python benchmarks/torture.py

SECONDS ?= 60
fuzz: .venv/installed           ## hostile files into every reader, SECONDS=60 each; findings stay in /tmp
	@$(BIN)/python tests/fuzz/fuzz.py --seconds $(SECONDS)

# pip installs into the environment from outside it, so Debian's ensurepip package is not needed.
# `make UNLOCKED=1` takes the newest versions that pyproject.toml allows, whatever was pinned.
.venv/installed: pyproject.toml requirements.lock
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "evofsm needs Python 3.11 or newer; this is " + sys.version.split()[0] + ". Name another one: make PYTHON=python3.12")'
	@test -x $(BIN)/python || $(PYTHON) -m venv --without-pip .venv
	@echo "Installing evofsm and its tools into .venv (a minute or two) ..."
ifdef UNLOCKED
	@$(INSTALL) --editable '.[dev]'
else
	@$(INSTALL) --require-hashes --requirement requirements.lock
	@$(INSTALL) --no-deps --no-build-isolation --editable .
endif
	@touch $@

clean:
	rm -rf .venv .venv-lowest sbom.json results bench.json dist build .pytest_cache .mypy_cache .ruff_cache .hypothesis
