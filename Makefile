# Everything from a fresh clone: needs make and Python 3.11 or newer with venv.
PYTHON ?= python3
BIN := .venv/bin

# The tests of pages need a browser; without it they are skipped, where COMPANION_REQUIRE_CHROMIUM=1 they fail.
.PHONY: demo test faults mutants bench-short lint compiled clean chromium

demo: .venv/installed
	$(BIN)/companion demo --config config/demo.toml

# Three workers for two cores: many tests wait. Bytecode is kept, whatever the environment says: a hundred
# processes start.
test: export PYTHONDONTWRITEBYTECODE =
test: .venv/installed
	$(BIN)/pytest -n 3 --dist loadfile -rs

# All of it takes minutes; a short form is among the tests.
faults: .venv/installed
	$(BIN)/python -m tests.safety.faults --out build

# What the tests of limits and phases would not notice; some minutes.
mutants: .venv/installed
	$(BIN)/python -m tests.core.mutants

# The app's latency beside the floor's, less than a minute; fails where a ratio is twice its goal in every turn.
bench-short: .venv/installed
	$(BIN)/companion bench system --short --only latency

lint: .venv/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# The core anew, after its source was changed: until then what was changed runs as plain Python.
compiled: .venv/installed
	$(BIN)/pip install --quiet --disable-pip-version-check --no-deps --editable .

chromium:
	@command -v chromium >/dev/null || { \
		echo "installing Debian's chromium, for the tests of pages ..."; \
		apt-get update -qq && DEBIAN_FRONTEND=noninteractive \
			apt-get install -y -qq --no-install-recommends chromium >/dev/null; } || \
	echo "chromium is missing and could not be installed: as root, apt-get install chromium" >&2

.venv/installed: pyproject.toml setup.py
	@echo "installing into .venv (two minutes, once; it compiles the core) ..."
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check --editable '.[dev]'
	@touch $@

clean:
	rm -rf .venv build dist mutants *.egg-info .pytest_cache .mypy_cache .ruff_cache
