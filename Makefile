# Two commands set everything up: `make launch` (fly) and `make test` (develop). Both are quick the second time.
PYTHON ?= $(shell command -v python3.11 || command -v python3 || echo python3.11)
VENV   := .venv
BIN    := $(VENV)/bin
PIP    := $(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt

.PHONY: launch test check format bench soak clean

launch: $(VENV)/.fly
	$(BIN)/cosim launch

test: $(VENV)/.all check
	$(BIN)/python -m pytest -n 2 --dist loadfile

check: $(VENV)/.all
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(VENV)/.all
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(VENV)/.all
	$(BIN)/cosim bench

# What the suite does in seconds, at length: some minutes, on a machine that has nothing else to do.
soak: $(VENV)/.all
	$(BIN)/python tests/soak steps --count 1000000
	$(BIN)/python tests/soak kills --count 500
	$(BIN)/python tests/soak pauses --count 10

clean:
	rm -rf $(VENV) build *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "make: Python 3.11 or later is needed, found '$(PYTHON)'; name another with make PYTHON=..." >&2; exit 2; }
	$(PYTHON) -m venv $(VENV)

# What flying needs and no more: no torch, no vedo.
$(VENV)/.fly: pyproject.toml constraints.txt | $(BIN)/python
	@echo "installing what flying needs into $(VENV) (about 200 MB the first time)"
	$(PIP) --editable .
	@touch $@

$(VENV)/.all: pyproject.toml constraints.txt | $(BIN)/python
	@echo "installing everything with the extras train, view, export, bench and dev into $(VENV)"
	$(PIP) --editable '.[train,view,export,bench,dev]'
	@touch $@ $(VENV)/.fly
