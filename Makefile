# Two commands do everything on a fresh machine: `make demo` and `make test`.
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin
READY = $(VENV)/.ready
READY_FOR_DEMO = $(VENV)/.ready-for-demo
READY_TO_LINT = $(VENV)/.ready-to-lint
READY_FOR_DOCS = $(VENV)/.ready-for-docs
# Tests start many processes. Where Python may not write bytecode, each compiles its imports: 3 s instead of 1.
RUN_TESTS = env -u PYTHONDONTWRITEBYTECODE $(BIN)/python -m pytest -n auto --max-worker-restart 0
# Tests that show within two minutes whether other versions of the dependencies work.
QUICK = tests/api tests/contracts tests/formats tests/geometry tests/io/test_meshes.py tests/model/test_pca.py \
  tests/model/test_shape_model.py tests/recognise/test_saved_classifier.py tests/schemas tests/store tests/fit/test_robust.py

.PHONY: demo test test-all test-oldest test-newest lint types contracts check bench docs dist clean

demo: $(READY_FOR_DEMO)
	$(BIN)/shapespace demo -o demo-out $(DEMO)

test: $(READY)
	$(RUN_TESTS) -m "not long" $(PYTEST)

test-all: $(READY)
	$(RUN_TESTS) $(PYTEST)

# Each uses its own environment; old packages issue deprecation warnings for one another.
test-oldest: WHICH = oldest
test-newest: WHICH = newest
test-oldest test-newest:
	$(PYTHON) -m venv $(VENV)-$(WHICH)
	$(VENV)-$(WHICH)/bin/python -m pip install --quiet --upgrade pip
	$(VENV)-$(WHICH)/bin/python -m pip install --quiet --editable '.[all]' --group test --constraint constraints/$(WHICH).txt
	$(VENV)-$(WHICH)/bin/python -m pip check
	$(VENV)-$(WHICH)/bin/python -m pytest -n auto -m "not long" -W default $(or $(PYTEST),$(QUICK))

lint: $(READY_TO_LINT)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python tools/check_language.py

types: $(READY_TO_LINT)
	$(BIN)/pyright --pythonpath $(BIN)/python

contracts: $(READY_TO_LINT)
	$(BIN)/lint-imports

check: lint types contracts test

bench: $(READY)
	set -e; for name in pca accuracy speed memory throughput; do $(BIN)/python benchmarks/$$name.py; done

# Strict: a broken link fails the build. All files are read again, or the second build would pass.
docs: $(READY_FOR_DOCS)
	rm -rf build/site
	$(BIN)/python -m sphinx -q -W --keep-going --fresh-env -c docs/site -d build/site-trees . build/site
	@echo "The documentation is build/site/index.html; open it in a browser, it needs no server."

# The demo needs one extra. Python compiles what it imports; to compile all that pip installs takes time and space.
$(READY_FOR_DEMO): pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --no-compile --editable '.[report]'
	touch $@

$(READY): $(READY_FOR_DEMO)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --editable '.[all]' --group test
	touch $@

# Separate, because pyright installs Node, which nothing else needs.
$(READY_TO_LINT): $(READY)
	$(BIN)/python -m pip install --quiet --group lint
	touch $@

$(READY_FOR_DOCS): $(READY)
	$(BIN)/python -m pip install --quiet --group docs
	touch $@

dist: $(READY)
	rm -rf build dist
	$(BIN)/python -m pip install --quiet build
	$(BIN)/python -m build --outdir dist

clean:
	rm -rf $(VENV) $(VENV)-oldest $(VENV)-newest build dist demo-out bench-out screenshots-out .pytest_cache .ruff_cache
