# demo, bench, test, test-all and lint make .venv when it is missing, with every extra, and bring it up to date when
# pyproject.toml or constraints.txt changed. Linux wheels of torch on PyPI bring CUDA along; to leave it out:
#   PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu make demo

PYTHON ?= python3
WORKERS ?= 2
PYTEST_ARGS ?=
DATA ?=

VENV := .venv
PY := $(VENV)/bin/python
STAMP := $(VENV)/.installed

# What .venv was installed from. Compared by content, not by age: a checkout or a restored CI cache sets any file time.
# It names the folder and the interpreter too, since a moved .venv or one that lost its Python must be noticed.
FINGERPRINT = { cksum pyproject.toml constraints.txt; echo '$(CURDIR)'; $(PY) -V 2>/dev/null || echo 'no Python'; }
ifneq ($(strip $(shell $(FINGERPRINT))),$(strip $(shell cat $(STAMP) 2>/dev/null)))
$(STAMP): FORCE
endif

.DEFAULT_GOAL := help
.PHONY: help install demo bench test test-all docs lint clean FORCE

help: ## Show this list
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/\1|\2/p' Makefile | while IFS='|' read -r name text; do \
		printf '  make %-10s %s\n' "$$name" "$$text"; done

install: $(STAMP) ## Make .venv with every extra

demo: $(STAMP) ## Solve problems with the shipped weights, beside OpenCV; DATA=folder solves that COLMAP scene
	@mkdir -p outputs/demo
	$(VENV)/bin/pnpnet demo $(if $(DATA),--data '$(DATA)')

bench: $(STAMP) ## Time and memory beside other libraries; writes benchmarks/*.json and docs/performance.md
	$(PY) benchmarks/solvers.py --repeats 5 --out benchmarks/solvers.json
	$(PY) benchmarks/performance.py measure
	$(PY) benchmarks/performance.py render

# One thread per worker: two workers on two cores would otherwise fight over them.
test: lint ## Lint, types and the quick tests
	OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 $(PY) -m pytest -n $(WORKERS) $(PYTEST_ARGS)

test-all: lint ## Lint, types and every test, the slow ones too
	OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 $(PY) -m pytest -n $(WORKERS) -m "" $(PYTEST_ARGS)

docs: $(STAMP) ## Build the documentation into site; warnings are errors, as in test-all
	$(PY) -m sphinx -W --keep-going -b html docs site

lint: $(STAMP) ## ruff and mypy
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) -m mypy

clean: ## Remove builds, caches and the demo's output; .venv and other outputs stay
	rm -rf build dist site jupyter_execute outputs/demo .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find . -path ./$(VENV) -prune -o -path ./.git -prune -o -type d -name __pycache__ -exec rm -rf {} +

$(STAMP):
	@$(PY) -m pip --version >/dev/null 2>&1 || { echo "Making $(VENV)"; $(PYTHON) -m venv --clear $(VENV); }
	@echo "Installing kornia_pnpnet with every extra into $(VENV); minutes the first time"
	@$(PY) -m pip install -q -e '.[all]' -c constraints.txt
	@$(FINGERPRINT) > $@

FORCE:
