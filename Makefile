# The commands of the README. Each does whatever set-up is still missing (bootstrap.py), then its job.

PYTHON ?= python3
VENV := .venv
ARGS ?=
# tests run in as many processes as there are cores, and those of one expensive fixture in one of them
SIDE_BY_SIDE := -n auto --maxprocesses 8 --dist loadscope
BENCH ?= simulator sac_updates codetr_speed nodes throughput recording_overhead bags growth memory whole_runs

# A shell in which another ROS or another environment is sourced must not mix with this one: its packages would be
# imported before ours, and the wheels search the directories of LD_LIBRARY_PATH in no fixed order.
unexport PYTHONPATH PYTHONHOME LD_LIBRARY_PATH _ROS_WHEELS_BOOTSTRAP_COMPLETE AMENT_PREFIX_PATH

.DEFAULT_GOAL := help
.PHONY: help setup train robot test coverage lint format docs bench clean

help:
	@echo "make train    set up what is missing, then learn the default task and watch it    (codetr train)"
	@echo "make test     set up what is missing, then run all tests, lint and types included (pytest)"
	@echo "make robot    set up what is missing, then let a robot in real time learn from scores     (codetr demo robot)"
	@echo "make coverage the same tests, and what they do not reach: a table, and pages in htmlcov/"
	@echo "make lint     lint, format and type checks alone"
	@echo "make bench    measure how fast everything is, some three hours on a machine that does nothing else (benchmarks/)"
	@echo "make docs     build the pages of docs/ as a site, API reference included, into site/"
	@echo "make format   put the code into the house format"
	@echo "make setup    the set-up alone, into $(VENV)"
	@echo "make clean    remove $(VENV) and every cache; runs are kept"
	@echo
	@echo "ARGS='...' is passed on:  make train ARGS='--config cpu --task Hopper-v5'   make test ARGS='-m \"not slow\"'"
	@echo "BENCH='...' names those to run: make bench BENCH='simulator nodes'"
	@echo "PYTHON=... chooses the interpreter (3.10 to 3.13):  make test PYTHON=python3.12"

setup:
	@command -v '$(PYTHON)' >/dev/null 2>&1 || { \
		echo "set-up: there is no command '$(PYTHON)'. Install Python 3.10 to 3.13 (Debian, Ubuntu:" \
			"apt install python3 python3-venv python3-dev) or name one that you have:" \
			"make test PYTHON=/path/to/python3.12" >&2; exit 1; }
	@'$(PYTHON)' bootstrap.py

robot: setup
	@$(VENV)/bin/codetr demo robot $(ARGS)

train: setup
	@$(VENV)/bin/codetr train $(ARGS)

test: setup
	@$(VENV)/bin/python -m pytest tests $(SIDE_BY_SIDE) $(ARGS)

coverage: setup
	@$(VENV)/bin/python -m pytest tests $(SIDE_BY_SIDE) --cov --cov-report=term:skip-covered --cov-report=html $(ARGS)

lint: setup
	@$(VENV)/bin/ruff check .
	@$(VENV)/bin/ruff format --check .
	@$(VENV)/bin/mypy

format: setup
	@$(VENV)/bin/ruff format .
	@$(VENV)/bin/ruff check --fix .

docs: setup
	@NO_MKDOCS_2_WARNING=1 $(VENV)/bin/mkdocs build --strict --quiet
	@echo "site/index.html"

bench: setup
	@for script in $(BENCH); do echo "== benchmarks/$$script.py"; $(VENV)/bin/python benchmarks/$$script.py || exit 1; done

clean:
	rm -rf $(VENV) .venv-removed .hypothesis .mypy_cache .pytest_cache .ruff_cache .coverage* htmlcov MUJOCO_LOG.TXT
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
