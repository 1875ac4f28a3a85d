# Two commands do all: `make reproduce` and `make test`. Both build .venv from the lock of versions first.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: reproduce test bench lint lock clean

reproduce: .venv/installed  ## the quick reference study: figures, tables and out/report.html
	$(BIN)/python -m benchmarks gail2014 --quick --out out

test: .venv/installed  ## the whole test suite
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

bench: .venv/installed  ## the quick measurements: time, memory, against C; out/benchmarks
	$(BIN)/python -m benchmarks all

lint: .venv/installed  ## format, lint and types, as pre-commit runs them
	$(BIN)/ruff format --check . && $(BIN)/ruff check . && $(BIN)/pyright

lock: .venv/installed  ## pin the versions that are installed now
	$(BIN)/python -m pip freeze --exclude-editable > requirements.lock

.venv/installed: pyproject.toml requirements.lock
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c requirements.lock -e '.[dev]'
	touch $@

clean:
	rm -rf .venv out
