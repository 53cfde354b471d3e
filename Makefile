# Everything a newcomer needs from a bare clone: Python 3.11+ and make.
.DEFAULT_GOAL := help
SHELL := /bin/bash

# The first interpreter that runs and is new enough; looked for only when installing.
PYTHON ?= $(shell for name in python3.11 python3.12 python3.13 python3 python; do \
	$$name -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$name && break; done)
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
ARGS ?=
KERNELS := model/trajectron_model/kernels

.PHONY: help install serve test check sanitize format protos bench crash fuzz handover soak paper clean

help: ## show this list
	@grep -hE '^[a-z]+:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "make %-9s %s\n", $$1, $$2}'

# The stamp holds until dependencies or kernels change; the code itself is installed editable.
$(INSTALLED): pyproject.toml constraints.txt hatch_build.py $(wildcard $(KERNELS)/*.[ch]) $(KERNELS)/build.py
	@test -n "$(PYTHON)" || { echo "Python 3.11 or newer is needed: make PYTHON=/path/to/python3.11" >&2; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt hatchling editables \
		$$($(BIN)/python $(KERNELS)/build.py --requirement)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt \
		--no-build-isolation --editable '.[service,train,tracing,dev]'
	touch $@

install: $(INSTALLED) ## create .venv and install everything at exact versions

serve: $(INSTALLED) ## start the service on 127.0.0.1 (HTTP 8000, gRPC 50051); ARGS="--help" for flags
	TRAJECTRON_STATE_DIR="$${TRAJECTRON_STATE_DIR-runs/service}" exec $(BIN)/trajectron serve $(ARGS)

test: $(INSTALLED) ## run the tests, a process to each core; ARGS="-k name" for some
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest --numprocesses auto --dist loadfile $(ARGS)

check: $(INSTALLED) ## format, lint, types, import contracts, protos, documentation links, known weaknesses
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-logo
	$(BIN)/python scripts/protos.py --check
	$(BIN)/python scripts/links.py
	$(BIN)/python scripts/audit.py

format: $(INSTALLED) ## format the code and mend what the linter can
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

sanitize: $(INSTALLED) ## run the kernels' tests under address and undefined-behaviour sanitizers
	$(BIN)/python scripts/sanitize.py $(ARGS)

protos: $(INSTALLED) ## generate the code of the contract and lint it
	$(BIN)/python scripts/protos.py

bench: $(INSTALLED) ## time the model beside its bare matrix products, then the service around it
	$(BIN)/python benchmarks/model.py --threads 1 --json benchmarks/results/model-1-thread.json
	$(BIN)/python benchmarks/model.py --threads 2 --json benchmarks/results/model-2-threads.json
	$(BIN)/python -m benchmarks.step --threads 1 --json benchmarks/results/step-1-thread.json
	$(BIN)/python -m benchmarks.step --threads 2 --json benchmarks/results/step-2-threads.json
	$(BIN)/python -m benchmarks.decoding --threads 1 --check --json benchmarks/results/decoding-1-thread.json
	$(BIN)/python -m benchmarks.decoding --threads 2 --check --json benchmarks/results/decoding-2-threads.json
	$(BIN)/python -m benchmarks.service --json benchmarks/results/service.json
	$(BIN)/python -m benchmarks.overload --json benchmarks/results/overload.json

crash: $(INSTALLED) ## kill the service 100 times under load and look for what is missing (half an hour)
	$(BIN)/python -m benchmarks.crash --kills 100 --json benchmarks/results/crash.json $(ARGS)

handover: $(INSTALLED) ## move sessions between two replicas on one Redis, by 10 kills and 10 drains
	$(BIN)/python -m benchmarks.handover --kills 10 --drains 10 --json benchmarks/results/handover.json $(ARGS)

fuzz: $(INSTALLED) ## 20,000 hostile cases over HTTP and gRPC (some minutes)
	$(BIN)/python scripts/fuzz.py --json benchmarks/results/fuzz.json $(ARGS)

soak: $(INSTALLED) ## sessions and faults for 30 minutes: what grows, what is lost
	$(BIN)/python -m benchmarks.soak --minutes 30 --json benchmarks/results/soak.json $(ARGS)

paper: $(INSTALLED) ## measure the paper's figures and tables again (hours; goes on where it stopped); ARGS="--quick"
	$(BIN)/python -m benchmarks.paper $(ARGS)

clean: ## remove the environment and every cache
	rm -rf $(VENV) build dist .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
