# Two commands on a fresh machine: `make quickstart` and `make test`.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: quickstart test check docs results ui setup clean

setup: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit("space_dist needs Python 3.11 or newer; try make PYTHON=python3.11" if sys.version_info < (3, 11) else 0)'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt torch==2.13.0
	$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev,carl]'
	$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt --no-deps carl-bench
	touch $(STAMP)

quickstart: $(STAMP)
	$(BIN)/python jobs/quickstart.py

# The tests start hundreds of processes: what is compiled of our modules is kept, whatever the environment says. Four at
# a time on two cores, since many wait for what they have started.
test: $(STAMP)
	PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -n 4 --dist loadfile --no-loadscope-reorder

check: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# One artefact of the paper, run and kept in docs/results: make results NAME=pointmass_uniform; in small: SCALE=0.02.
results: $(STAMP)
	$(BIN)/python jobs/results.py $(or $(NAME),$(error which grid? make results NAME=pointmass_uniform)) --scale $(or $(SCALE),1.0)

# The documentation as a site, in site/: open site/index.html. Warnings are errors.
docs: $(STAMP)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

# The MLflow dashboard of runs in this folder, at http://127.0.0.1:5000/#/experiments?workflowType=machine_learning
ui: $(STAMP)
	MLFLOW_DISABLE_TELEMETRY=true $(BIN)/mlflow ui --backend-store-uri sqlite:///mlflow.db --host 127.0.0.1 --port 5000

clean:
	rm -rf $(VENV)
