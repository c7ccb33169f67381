# The two commands: `make train` and `make test`. Both make the environment first, with exactly the versions of the lock.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: train test lint lock
train: .venv/installed
	$(BIN)/arm5dof train

test: .venv/installed lint
	$(BIN)/python -m pytest -n 2 --dist worksteal

lint: .venv/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-logo --no-cache

.venv/installed: requirements.lock pyproject.toml
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check "pip>=25"  # Older ones take twice as long to find the rest.
	$(BIN)/pip install --quiet --no-compile --disable-pip-version-check --no-deps --requirement requirements.lock
	$(BIN)/pip install --quiet --no-compile --disable-pip-version-check --no-deps --editable .
	touch $@

# Maintainers: resolve anew. One jax for every Python: the newest that the XLA flag in arm5dof/runtime/xla.py is known for.
lock:
	echo "jax<0.11" | uv pip compile --universal --quiet --python-version 3.11 --extra test --constraint - pyproject.toml --output-file requirements.lock
