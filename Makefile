# `make run` does the main job, `make test` runs the tests; both make .venv first and are quick the second time.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
TEST_STAMP := $(VENV)/.installed-test

.PHONY: run test test-all lint clean
run: $(STAMP)
	$(BIN)/octarm run

# Hundreds of processes are started: were their modules compiled anew each time, a fifth of it would be that.
TEST_ENV := OPENBLAS_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE=
# Three workers on two cores: part of the time is waiting for real time to pass.
test: $(TEST_STAMP)
	$(TEST_ENV) $(BIN)/python -m pytest -n 3

# With every variant of the tests that inject faults into real processes, and what others show as well: twice as long.
test-all: $(TEST_STAMP)
	$(TEST_ENV) $(BIN)/python -m pytest -n 3 --every

lint: $(TEST_STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# Exact versions from constraints.txt; the build back end is pinned in pyproject.toml.
$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(None if v >= (3, 11) else "octarm needs Python 3.11 or newer, this is %d.%d; set PYTHON=python3.11" % v[:2])'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e .
	@touch $(STAMP)

$(TEST_STAMP): $(STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[test]"
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --only-binary :all: -c constraints.txt -e ".[baselines]" \
		|| echo "no wheels of python-control and slycot here: the tests that compare with them are left out"
	@touch $(TEST_STAMP)

clean:
	rm -rf $(VENV) runs build dist
