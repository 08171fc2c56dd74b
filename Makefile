# Two commands do everything on a fresh machine: `make demo` and `make test`.
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin
READY = $(VENV)/.ready

.PHONY: demo test test-all lint types contracts check bench docs clean

demo: $(READY)
	$(BIN)/shapespace demo --out demo-out $(DEMO)

test: $(READY)
	$(BIN)/python -m pytest -n auto --max-worker-restart 0 -m "not long" $(PYTEST)

test-all: $(READY)
	$(BIN)/python -m pytest -n auto --max-worker-restart 0 $(PYTEST)

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(READY)
	$(BIN)/pyright --pythonpath $(BIN)/python

contracts: $(READY)
	$(BIN)/lint-imports

check: lint types contracts test

bench: $(READY)
	set -e; for name in pca accuracy speed memory throughput; do $(BIN)/python benchmarks/$$name.py; done

# Strict: a link that leads nowhere fails the build. Everything is read anew, or the second build would pass.
docs: $(VENV)/.docs
	rm -rf build/site
	$(BIN)/python -m sphinx -q -W --keep-going --fresh-env -c docs/site -d build/site-trees . build/site
	@echo "The documentation is build/site/index.html; open it in a browser, it needs no server."

$(VENV)/.docs: $(READY)
	$(BIN)/python -m pip install --quiet --group docs
	touch $@

$(READY): pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --editable '.[all]'
	touch $@

clean:
	rm -rf $(VENV) build demo-out bench-out screenshots-out .pytest_cache .ruff_cache
