# SPDX-License-Identifier: Apache-2.0
# Every target that needs something sets it up first; what is there already is left alone.
ARGS ?=

.DEFAULT_GOAL := help
.PHONY: help demo test load bench jazzy lint setup lock clean

help: ## Show this list
	@echo "make TARGET [ARGS='...'] [PYTHON=python3.x]"
	@sed -n 's/^\([a-z]*\):.*## \(.*\)/  \1\t\2/p' $(firstword $(MAKEFILE_LIST))

demo: setup ## Run the demonstration on the simulated bench; ARGS go to `tactile_resonance demo`
	@tools/run.sh tactile_resonance demo $(ARGS)

test: setup ## Run all tests; ARGS go to pytest (--cov: with coverage)
	@tools/run.sh python -m pytest $(ARGS)

load: setup ## Run the demonstration beside other work and on the wall clock; refuse where a result differs
	@tools/run.sh tactile_resonance benchmark load $(ARGS)

bench: setup ## Run the quick form of every benchmark into build/benchmarks, and renew docs/benchmarks/README.md
	@tools/run.sh tactile_resonance benchmark --quick --output build/benchmarks $(ARGS)
	@tools/run.sh tactile_resonance benchmark overview

jazzy: export TACTILE_ROS = jazzy
jazzy: ## Set up ROS 2 Jazzy beside it; run the nodes' tests and a scan of two points on it
	@$(MAKE) --no-print-directory setup
	@tools/run.sh python -m pytest test/nodes $(addprefix test/integration/test_,stream.py lifecycle.py pole_map.py records.py)
	@tools/run.sh tactile_resonance demo --scene .ci/two_points.yaml

lint: setup ## Check style (ruff) and types of the core (mypy)
	@env -u PYTHONPATH .venv/bin/python -m ruff check
	@env -u PYTHONPATH .venv/bin/python -m mypy

setup: ## Make .venv and build the messages, where not done yet
	@python=$$(tools/find_python.sh) && "$$python" -E -s -S tools/bootstrap.py

lock: ## Renew the locks from requirements.in and requirements-ros.in
	@tools/lock.sh

clean: ## Remove everything that the other targets made, the environment included
	rm -rf .venv .venv-* build install install-* log .coverage .coverage.* .hypothesis .mypy_cache .pytest_cache .ruff_cache
	rm -rf tactile_resonance.egg-info
	find tactile_resonance test benchmarks tools launch -name __pycache__ -prune -exec rm -rf {} +
