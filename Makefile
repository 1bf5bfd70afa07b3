# make demo, test, test-all, lint, perf: each sets up .venv if it is missing. JOBS=4 make test takes four processes.
PYTHON ?= python3
BIN := .venv/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
JOBS ?= 2
# a file's tests stay in one process, where they share what they compile and simulate
PYTEST := $(BIN)/python -m pytest -q -n $(JOBS) --dist loadfile --no-loadscope-reorder

# tests start some 150 processes: the first of them that imports a module compiles it, not each, and not pip,
# which would compile many more
unexport PYTHONDONTWRITEBYTECODE
INSTALL := $(PIP) install --quiet --no-compile --no-deps

.PHONY: demo test test-all lint perf clean

.venv/ready: pyproject.toml constraints.txt constraints-cuda.txt
	$(PYTHON) -m venv .venv
	# PyTorch without CUDA, a tenth of the size, where pip is told of a place that has it; else what comes next
	sed -n '/^torch==/,/[^\\]$$/p' constraints.txt | sed '1s/ /+cpu /' > .venv/torch-cpu.txt
	$(INSTALL) --require-hashes --requirement .venv/torch-cpu.txt 2>/dev/null || true
	$(INSTALL) --require-hashes --requirement constraints.txt
	if $(BIN)/python -c "import importlib.metadata as m, sys; sys.exit('cuda' not in str(m.requires('torch')))"; then \
	    $(INSTALL) --require-hashes --requirement constraints-cuda.txt; fi
	$(INSTALL) --no-build-isolation --editable .
	$(PIP) check
	touch $@

demo: .venv/ready
	$(BIN)/dase demo

test: .venv/ready
	$(PYTEST) -m "not slow"

test-all: .venv/ready
	$(PYTEST)

lint: .venv/ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

perf: .venv/ready
	$(BIN)/python -m perf.benchmarks

clean:
	rm -rf .venv build dist *.egg-info out
