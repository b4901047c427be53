# Two commands for a newcomer: make demo, make test. Each installs what it needs into .venv first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
SETUP := setup.py setup.cfg pyproject.toml package.xml

.PHONY: demo test lint bench bench-check clean

# One sample bag through the main job: blurred frames in, sharp frames, motion and pictures out.
demo: $(VENV)/.demo
	$(BIN)/depth-deblur replay bags/sample out/demo/bag --overwrite --report \
	  --pictures out/demo/pictures --estimates out/demo/motion.jsonl
	@echo 'results    out/demo/bag (a rosbag2 folder; topics: README.md)'
	@echo 'page       out/demo/bag.html (open it in a browser)'
	@echo 'pictures   out/demo/pictures (blurred | sharp | depth with the flow)'
	@echo 'motion     out/demo/motion.jsonl'

test: $(VENV)/.dev
	$(BIN)/python -m pytest

lint: $(VENV)/.dev
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

# Quality where DEPTH_DEBLUR_DATA names a folder with eval/ cases, then speed, then what the live node adds.
bench: $(VENV)/.dev
	@if [ -n "$$DEPTH_DEBLUR_DATA" ]; then \
	  $(BIN)/depth-deblur bench "$$DEPTH_DEBLUR_DATA/eval" -o out/bench || [ $$? -eq 1 ]; \
	else echo 'quality: skipped, DEPTH_DEBLUR_DATA is not set'; fi
	$(BIN)/python scripts/bench_speed.py
	$(BIN)/python scripts/bench_node.py

# The short part of the speed bench: fails where a mode is 60 % slower than docs/speed.json says.
bench-check: $(VENV)/.dev
	$(BIN)/python scripts/bench_speed.py --short --check

clean:
	rm -rf $(VENV) out build dist install log *.egg-info
	rm -rf .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(VENV)/.made:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed, $(PYTHON) is " + sys.version)'
	$(PYTHON) -m venv $(VENV)
	@touch $@

$(VENV)/.demo: $(VENV)/.made $(SETUP)
	@echo "installing into $(VENV), the first time about a minute ..."
	$(BIN)/pip install -qq --disable-pip-version-check --editable .
	@touch $@

$(VENV)/.dev: $(VENV)/.made $(SETUP)
	@echo "installing into $(VENV), ROS and the tools too, the first time about two minutes ..."
	$(BIN)/pip install -qq --disable-pip-version-check --editable '.[ros,test,lint]'
	@touch $(VENV)/.demo $@
