# `make demo`, `make test` and `make lint` each do everything on a fresh machine with
# Python >= 3.11, make and a package index: create .venv, install the pinned versions, run.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
DATA ?= ../shared/data

.PHONY: demo test lint docs gallery clean

demo: $(VENV)/installed
	$(BIN)/eitskin demo --out build/demo --data $(DATA)

test: $(VENV)/installed
	$(BIN)/python -m pytest --numprocesses 2 --dist loadfile $(ARGS)

lint: $(VENV)/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# The reference of every public name as HTML that needs no network, in build/docs.
docs: $(VENV)/installed
	$(BIN)/python -m pdoc --docformat google --output-directory build/docs \
		eitskin.geometry eitskin.simulator eitskin.datasets eitskin.training eitskin.hardware

# The pictures in docs/gallery, each by the script of its name.
gallery: $(VENV)/installed
	for script in $(filter-out %/style.py, $(wildcard docs/gallery/*.py)); do \
		$(BIN)/python $$script docs/gallery || exit 1; done

# torch comes first and alone: its CPU build is then found by everything that asks for torch.
$(VENV)/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt torch
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[dev]"
	touch $@

clean:
	rm -rf $(VENV) build dist *.egg-info
