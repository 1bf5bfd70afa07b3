# make demo, test, test-all, lint, perf: each sets up .venv if it is missing. JOBS=4 make test takes four processes.
PYTHON ?= python3
BIN := .venv/bin
JOBS ?= 2
# a file's tests stay in one process, where they share what they compile and simulate
PYTEST := $(BIN)/python -m pytest -q -n $(JOBS) --dist loadfile --no-loadscope-reorder

.PHONY: demo test test-all lint perf clean

.venv/ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt torch
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable ".[learn,coco,hdf5,aedat,ros,dev]"
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
