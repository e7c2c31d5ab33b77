# `make demo` and `make test` are all that a fresh machine needs; both make .venv first.

PY := .venv/bin/python
# Two test workers on two cores: more threads inside each would only fight over them.
PYTEST := OMP_NUM_THREADS=1 $(PY) -m pytest -n 2 --dist loadfile

.PHONY: help demo docs reproduce test test-full lint lock certificates clean

help:  ## list the targets
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*##/\t/' | expand -t 12

demo: .venv/.up-to-date  ## record, learn, score and film, in runs/demo (under 10 minutes)
	@.venv/bin/hvs demo --out runs/demo --overwrite

TASK ?= align-thesis
reproduce: .venv/.up-to-date  ## record, pretrain, fine-tune and evaluate TASK's shipped policy anew, in runs/
	@.venv/bin/hvs reproduce --task $(TASK)

test: lint  ## ruff, mypy and every behaviour once (under 15 minutes)
	@$(PYTEST) -m "not slow"

test-full: lint  ## the same on the large counts (up to 80 minutes)
	@$(PYTEST)

docs: .venv/.up-to-date  ## the documentation as a web site, in build/docs (under 5 minutes)
	@$(PY) -m sphinx --quiet --fail-on-warning --keep-going docs build/docs
	@echo "open build/docs/index.html"

lint: .venv/.up-to-date  ## ruff and mypy
	@$(PY) -m ruff check .
	@$(PY) -m ruff format --check .
	@$(PY) -m mypy

lock:  ## resolve requirements.lock anew
	uv pip compile setup.cfg --extra learn --extra ray --extra dev --override scripts/lock.overrides \
	  --universal --python-version 3.12 --upgrade --quiet \
	  --no-annotate --no-header --no-emit-index-url --no-emit-find-links -o requirements.lock

certificates: .venv/.up-to-date  ## certify the named tasks and write the version lock
	@.venv/bin/hvs certify --workers 2

clean:  ## remove .venv, runs and caches
	rm -rf .venv runs build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

.venv/.up-to-date: requirements.lock setup.cfg scripts/make_venv.sh integrations/lerobot_env_hvs/pyproject.toml
	@scripts/make_venv.sh
