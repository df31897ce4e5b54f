# Every command makes .venv when it is missing and updates it when pyproject.toml or constraints.txt changed. "make demo"
# installs what the demo needs, the other commands install everything. uv installs the packages when it is on the PATH,
# or else pip. On Linux PyPI's wheels of torch include CUDA; without CUDA:
#   PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu make demo

PYTHON ?= python3
WORKERS ?= 2
PYTEST_ARGS ?=
DATA ?=

VENV := .venv
PY := $(VENV)/bin/python
ALL := $(VENV)/.installed-all
DEMO := $(VENV)/.installed-demo

# The state that .venv was installed from, compared by content: a checkout or a restored CI cache changes the times of
# files. The folder and the interpreter are part of the state, because a .venv that was moved does not work.
STATE = { cksum pyproject.toml constraints.txt; echo '$(CURDIR)'; $(PY) -V 2>/dev/null || echo 'no Python'; }

# uv does not read pip's configuration: pass on the indexes and folders of wheels, and pip's way to choose among them.
UV_OPTIONS = --index-strategy unsafe-best-match $$($(PY) -m pip config list | \
	sed -n "s/\\\\n/ /g; s/^[^.]*\.\(index-url\|extra-index-url\|find-links\)='\(.*\)'/\1 \2/p" | \
	while read -r option values; do for value in $$values; do echo "--$$option $$value"; done; done)

# Python keeps what it compiled, even where the environment says not to: every process of the tests, those that the tests
# start included, would otherwise compile some 2800 modules anew, which takes 5 s.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.NOTPARALLEL:
.PHONY: help install demo bench test test-all docs lint clean FORCE

help: ## Show this list
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/\1|\2/p' Makefile | while IFS='|' read -r name text; do \
		printf '  make %-10s %s\n' "$$name" "$$text"; done

install: $(ALL) ## Make .venv with every extra

# A scene of COLMAP is read by pycolmap, which the random problems do not need.
demo: $(if $(DATA),$(ALL),$(DEMO)) ## Solve problems beside OpenCV and PoseLib; DATA=folder solves a COLMAP scene
	$(VENV)/bin/pnpnet demo $(if $(DATA),--data '$(DATA)')

bench: $(ALL) ## Measure all results and write their pages: hours; continues where it was stopped (benchmarks/measure.sh)
	PYTHON='$(PY)' sh benchmarks/measure.sh

# One thread per worker: two workers on two cores would otherwise fight over them.
test: lint ## Lint, types and the quick tests
	OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 $(PY) -m pytest -n $(WORKERS) $(PYTEST_ARGS)

test-all: lint ## Lint, types and every test, the slow ones too
	OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 $(PY) -m pytest -n $(WORKERS) -m "" $(PYTEST_ARGS)

docs: $(ALL) ## Build the documentation into site; warnings are errors, as in test-all
	$(PY) -m sphinx -W --keep-going -b html docs site

lint: $(ALL) ## ruff and mypy
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) -m mypy

clean: ## Remove builds, caches and the demo's output; .venv and other outputs stay
	rm -rf build dist site jupyter_execute outputs/demo .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find . -path ./$(VENV) -prune -o -path ./.git -prune -o -type d -name __pycache__ -exec rm -rf {} +

# Without --no-compile pip compiles every module of every package; Python compiles those that are imported.
$(ALL): EXTRA := all
$(DEMO): EXTRA := demo
$(ALL) $(DEMO): FORCE
	@if $(STATE) | cmp -s - $@; then exit 0; fi; set -e; \
	$(PY) -m pip --version >/dev/null 2>&1 || { echo "Making $(VENV)"; $(PYTHON) -m venv --clear $(VENV); }; \
	echo "Installing kornia_pnpnet[$(EXTRA)] into $(VENV); a few minutes the first time"; \
	rm -f $(ALL) $(DEMO); \
	set -- -q -e '.[$(EXTRA)]' -c constraints.txt; \
	{ command -v uv >/dev/null && uv pip install --python $(PY) $(UV_OPTIONS) "$$@"; } || $(PY) -m pip install --no-compile "$$@"; \
	$(STATE) | tee $(if $(filter all,$(EXTRA)),$(DEMO)) > $@

FORCE:
