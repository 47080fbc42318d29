# make demo and make test alone bring a bare machine with Python 3.11+ to a result.
VENV := .venv/bin
READY := .venv/.ready
BROWSER := .venv/.browser
BLENDER := .venv/.blender
VALIDATOR := .venv/.validator

.PHONY: help setup demo test test-all bench check docs dist clean

help:
	@echo "make setup     create .venv and install everything (CPU build of torch where there is no GPU)"
	@echo "make demo      a character walks along curves: motion, film and report in demo-out/"
	@echo "make test      the quick tests"
	@echo "make test-all  every test"
	@echo "make bench     cost of walks on this machine"
	@echo "make check     ruff, basedpyright, import-linter"
	@echo "make docs      the site in docs/_build/html: pages, gallery, reference"
	@echo "make dist      sdist and wheel in dist/, and their sizes"
	@echo "make clean     remove what these commands made, .venv included"

setup: $(READY)

$(READY): pyproject.toml constraints.txt .ci/setup
	@.ci/setup
	@touch $@

$(BROWSER): $(READY)
	@.ci/setup browser
	@touch $@

$(BLENDER): $(READY)
	@.ci/setup blender
	@touch $@

$(VALIDATOR): $(READY)
	@.ci/setup validator
	@touch $@

demo: $(READY)
	$(VENV)/mapctl demo -o demo-out

# Two threads on small matrices fight each other: one is faster.
test test-all bench docs: export OMP_NUM_THREADS = 1
test test-all bench docs: export MKL_NUM_THREADS = 1
test test-all bench docs: export OPENBLAS_NUM_THREADS = 1
# Test files compiled anew cost each process 20 s.
unexport PYTHONDONTWRITEBYTECODE

# A file's tests stay together: they share what is costly to make. Tests run in as many processes as there are WORKERS.
WORKERS := 2

test: $(READY) $(BROWSER) $(BLENDER) $(VALIDATOR)
	$(VENV)/python -m pytest -m "not slow" -n $(WORKERS) --dist loadfile

test-all: $(READY) $(BROWSER) $(BLENDER) $(VALIDATOR)
	$(VENV)/python -m pytest

bench: $(READY)
	$(VENV)/mapctl bench

check: $(READY)
	$(VENV)/ruff check .
	$(VENV)/ruff format --check .
	$(VENV)/basedpyright
	$(VENV)/lint-imports --no-cache --no-logo

# A warning is an error: a link that leads nowhere, a page that no other names, an example that fails.
docs: $(READY)
	$(VENV)/python -m sphinx --fail-on-warning --keep-going -b html docs docs/_build/html

# Of what is installed already, so that it needs no network.
dist: $(READY)
	rm -rf build dist
	$(VENV)/python -m build --no-isolation
	@du -h dist/*

clean:
	rm -rf .venv docs/_build build dist *.egg-info demo-out bench-out .pytest_cache .ruff_cache .hypothesis
	find mapctl priors controllers scenes tests -name __pycache__ -type d -prune -exec rm -rf {} +
