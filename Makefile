# `make demo`, `make test` and `make lint` each do everything on a fresh machine with
# Python >= 3.11, make and a package index: create .venv, install the pinned versions, run.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
DATA ?= ../shared/data
WORKERS := --numprocesses 2 --dist loadfile --no-loadscope-reorder

# Hundreds of processes start in the tests; what one has compiled the others need not.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test quick coverage mutations lint docs reference narrow firmware pictures bench \
	bench-long pages clean

demo: $(VENV)/installed
	$(BIN)/eitskin demo --out build/demo --data $(DATA)

test: $(VENV)/installed
	$(BIN)/python -m pytest $(WORKERS) $(ARGS)

# All but the tests marked slow, in plain Python: numba compiles for as long as all of them take.
# `make quick EITSKIN_PLAIN=` compiles.
quick: export EITSKIN_PLAIN ?= 1
quick: $(VENV)/installed
	$(BIN)/python -m pytest $(WORKERS) -m "not slow" $(ARGS)

# By lines; physics, datasets and codecs must have 95 %, each by itself. CONTRIBUTING.md has the rest.
CODEC := hardware/protocol/packets.py,hardware/protocol/messages.py,hardware/boards/text_*.py
coverage: $(VENV)/installed
	rm -rf build/coverage && mkdir -p build/coverage
	$(BIN)/coverage run -m pytest $(WORKERS) $(ARGS)
	$(BIN)/coverage combine --quiet
	for part in 'geometry/*' 'simulator/*' 'datasets/*' '$(CODEC)'; do \
		$(BIN)/coverage report --include="$$part" --skip-covered --fail-under=95 || exit 1; done
	$(BIN)/coverage report --skip-covered --format=total

# Formulas broken one by one in a copy, as a seed draws them: tests must fail.
mutations: $(VENV)/installed
	$(BIN)/python tests/mutations/run.py $(ARGS)

lint: $(VENV)/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	cd .types && ../$(BIN)/lint-imports --config ../pyproject.toml

# Pages, gallery and reference as one site that needs no network, in build/docs: begin with
# build/docs/index.html. A link that leads nowhere fails.
docs: $(VENV)/installed
	$(BIN)/python -m sphinx -W --keep-going -q -c docs/site -d build/doctrees . build/docs

# The pipeline that comes with eitskin, trained again; and one for the default clamp alone, with
# which `eitskin bench transfer` compares it.
RECIPES = training wide wide_bends plates
SETS = build/reference
reference narrow: $(SETS)/all
	$(BIN)/eitskin train $(SETS)/$(if $(filter narrow,$@),training,all) --preset joint \
		--out $(if $(filter narrow,$@),build/narrow.eitmodel,training/reference.eitmodel) \
		--replace $(ARGS)
$(SETS)/all: $(VENV)/installed
	for recipe in $(RECIPES); do \
		$(BIN)/eitskin generate $$recipe --out $(SETS)/$$recipe --resume || exit 1; done
	$(BIN)/eitskin dataset combine $(addprefix $(SETS)/,$(RECIPES)) --out $@

# The image of a NUCLEO-F411RE, in build/firmware; needs arm-none-eabi-gcc and no Python.
firmware:
	$(MAKE) --no-print-directory -C hardware/firmware/nucleo_f411 BUILD=$(CURDIR)/build/firmware

# The pictures of the pages, each by the script of its name; ARGS="bending scene" for some. The
# live page needs Chromium with its driver.
pictures: $(VENV)/installed
	$(BIN)/python docs/gallery/draw.py $(ARGS)

# Everything that README and docs quote, measured again into build/bench, for an hour or two.
# Results of the same version and seed are kept; see CONTRIBUTING.md.
# bench-long also runs the benchmarks that take more than ten minutes each.
bench bench-long: $(VENV)/installed
	$(BIN)/eitskin bench all --data $(DATA) $(if $(filter bench-long,$@),--long) $(ARGS)

# Pages that are generated: docs/results from benchmarks/published, commands and file keys from the
# code, outputs of notebooks; RESULTS=build/bench puts new results above.
pages: $(VENV)/installed
	$(BIN)/python -m eitskin.benchmarks.result_pages $(RESULTS)
	$(BIN)/python docs/site/reference.py
	$(BIN)/python docs/notebooks/run.py

# torch comes first and alone: its CPU build is then found by everything that asks for torch.
$(VENV)/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt torch
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[dev]"
	touch $@

clean:
	rm -rf $(VENV) build dist *.egg-info
