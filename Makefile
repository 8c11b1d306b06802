PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: install demo demo-ant test test-fast lint docs format clean

install: $(STAMP)

$(STAMP): setup.cfg pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $(STAMP)

demo: install  ## Meta-learn an arm, break it, and watch it adapt: a few minutes, results in demo/
	$(BIN)/famle demo

demo-ant: install  ## Break an ant in mid-run: a minute or two, results in demo-ant/
	$(BIN)/famle demo --robot ant --out demo-ant

test: lint docs  ## All that a change must pass
	$(BIN)/pytest --numprocesses 2 --cov --cov-report term-missing:skip-covered --cov-fail-under 90

test-fast: install  ## Without the slow tests
	$(BIN)/pytest --numprocesses 2 -m "not slow"

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

docs: install  ## The manual with its reference, in site/; a warning is an error
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet

format: install
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) demo demo-ant runs build dist site *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
