# Two commands do all: `make reproduce` and `make test`. Both build .venv from the lock of versions first.
# OPTIONS are handed on to pytest, as in `make test OPTIONS=--full`.
PYTHON ?= python3
BIN := .venv/bin
ENVIRONMENT ?= .venv
OLDER ?= python3.11
NEWER ?= python3.13

PYTEST := OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder
# Workers take one core each: threads of BLAS for small matrices only get in their way.
AS_USERS := tests/benchmarks tests/pages
# Timed, or printed on a page: compiled as users compile.
TOOLS := tests/tools tests/ensembles/test_workers.py

.PHONY: reproduce test test-quick test-tenth test-tools smoke notebooks docs bench lint release lock clean

reproduce: .venv/installed  ## the quick reference study: figures, tables and out/report.html
	$(BIN)/python -m benchmarks gail2014 --quick --out out

LIBRARY := $(addprefix --ignore=,tests/smoke $(TOOLS) $(AS_USERS))

test: .venv/installed  ## the library; the same instructions, compiled without LLVM's optimisations: most of the time is compiling
	$(PYTEST) --unoptimised $(LIBRARY) $(OPTIONS)

test-tenth: .venv/installed  ## a tenth of these files, others every day, compiled as users compile
	$(PYTEST) --tenth $(LIBRARY) $(OPTIONS)

test-quick: .venv/installed  ## below a minute: refusals and structure, which compile nothing; tests/quick.py holds the list
	$(BIN)/python -m pytest --quick --unoptimised tests $(OPTIONS)

test-tools: .venv/installed  ## benchmarks, notebooks, programs and commands of the pages, every tool on every small system, ensembles on workers
	$(PYTEST) $(AS_USERS) $(OPTIONS)
	$(PYTEST) --unoptimised $(TOOLS) $(OPTIONS)

smoke:  ## a few minutes: every kind of step, with another environment, make smoke ENVIRONMENT=/path/to/venv
	$(ENVIRONMENT)/bin/python -m pytest -n 2 tests/smoke

notebooks: .venv/installed  ## run the notebooks and store their outputs
	$(BIN)/python -m tests.notebooks

docs: .venv/installed  ## the site, docs/_build/html/index.html
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c requirements.lock -e '.[docs]'
	$(BIN)/python -m sphinx -b html -q --fail-on-warning --keep-going docs docs/_build/html

bench: .venv/installed  ## the quick measurements: time, memory, against C; out/benchmarks
	$(BIN)/python -m benchmarks all

lint: .venv/installed  ## format, lint and types, as pre-commit runs them
	$(BIN)/ruff format --check . && $(BIN)/ruff check . && $(BIN)/pyright

release:  ## dist/: source archive and wheel, and README's program in an empty environment with the wheel alone
	.ci/release $(PYTHON)

lock:  ## pin the newest versions for both: make lock OLDER=python3.11 NEWER=python3.13; see .ci/lock
	$(OLDER) .ci/lock $(OLDER) $(NEWER)

.venv/installed: pyproject.toml requirements.lock
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c requirements.lock -e '.[dev]'
	touch $@

clean:
	rm -rf .venv out
