# make demo, make test, make lint, make perf: each sets up .venv if it is missing.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: demo test lint perf clean

.venv/ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt torch
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable ".[learn,coco,hdf5,aedat,ros,dev]"
	touch $@

demo: .venv/ready
	$(BIN)/dase demo

test: .venv/ready
	$(BIN)/python -m pytest -q

lint: .venv/ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

perf: .venv/ready
	$(BIN)/python -m perf.benchmarks

clean:
	rm -rf .venv build dist *.egg-info out
