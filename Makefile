# Each target does all of its own set-up: a fresh machine needs Python >= 3.11 with venv, pip and make.
PYTHON ?= python3
# Options for installing torch, e.g. the index of its CPU wheels.
TORCH_PIP_OPTIONS ?=
VENV := .venv
DEMO_VENV := .venv-demo
DOCS_VENV := .venv-docs
METHODS := cjp cqr csp mcqr
BUNDLE := calibration_artifacts/synthetic-room
RUNTIME := $(shell find cvo_edge -type f -not -name "*.pyc")

.PHONY: help demo test check docs bench soak fuzz arm64 avx2 format clean

help:
	@echo "make demo    install the runtime alone and run the demonstration of every method"
	@echo "make test    install both packages and run the test-suite (CVO_DATA: real data, optional)"
	@echo "make arm64   test the runtime on an emulated 64-bit ARM, and compare its numbers with this machine's"
	@echo "make avx2    the same on an x86-64 without VNNI (both: Linux with apt-get, as root for the emulator)"
	@echo "make check   lint, formatting, types and import rules"
	@echo "make docs    build the documentation into build/site, strictly and without requests"
	@echo "make bench   compare speed, memory and start side by side; an hour on a quiet machine"
	@echo "make soak    a million frames: does memory grow? half an hour"
	@echo "make fuzz    ten thousand damaged models, artifacts and sensors, a thousand kills; half an hour"
	@echo "make format  reformat the code"
	@echo "make clean   remove the virtual environments, emulated boards and networks of make bench"

# Installed as users do, not editable: the demonstration proves that the wheel holds its data.
$(DEMO_VENV)/.installed: pyproject.toml $(RUNTIME)
	$(PYTHON) -m venv $(DEMO_VENV)
	rm -rf build/lib build/bdist.*
	$(DEMO_VENV)/bin/python -m pip install --quiet .
	@touch $@

$(VENV)/.installed: pyproject.toml export/pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install --quiet $(TORCH_PIP_OPTIONS) torch torchvision
	$(VENV)/bin/python -m pip install --quiet --editable ".[test,check]" --editable "./export[plot,ray]"
	@touch $@

demo: $(DEMO_VENV)/.installed $(addprefix demo-,$(METHODS))
	@echo "== the packaged bundle"
	$(DEMO_VENV)/bin/cvo-edge demo

demo-%: $(DEMO_VENV)/.installed
	@echo "== synthetic-room-$*"
	$(DEMO_VENV)/bin/cvo-edge demo $(BUNDLE)-$* --picture demo-$*.png

# Another release of OpenCV, for the tests that compare what both make of the same files.
.opencv4: $(VENV)/.installed
	$(VENV)/bin/python -m pip install --quiet --no-deps --upgrade --target $@ opencv-python-headless==4.10.0.84
	@touch $@

test: $(VENV)/.installed .opencv4
	$(VENV)/bin/python -m pytest

arm64 avx2: $(VENV)/.installed
	$(VENV)/bin/python -m boards $@ --json bench/results/boards/$@.json

check: $(VENV)/.installed
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy
	$(VENV)/bin/lint-imports

$(DOCS_VENV)/.installed: pyproject.toml
	$(PYTHON) -m venv $(DOCS_VENV)
	$(DOCS_VENV)/bin/python -m pip install --quiet --editable ".[docs]"
	@touch $@

docs: $(DOCS_VENV)/.installed
	NO_MKDOCS_2_WARNING=1 $(DOCS_VENV)/bin/mkdocs build --strict --quiet
	@echo "build/site/index.html"

# One after the other: nothing may run beside a measurement.
bench: $(VENV)/.installed
	$(VENV)/bin/python bench/networks.py
	$(VENV)/bin/python bench/frame.py
	$(VENV)/bin/python bench/stream.py
	$(VENV)/bin/python bench/start.py
	$(VENV)/bin/python bench/scaling.py
	$(VENV)/bin/python bench/peers.py
	$(VENV)/bin/python bench/uncertainty_peers.py
	$(VENV)/bin/python bench/speed_tables.py
	$(VENV)/bin/python bench/goals.py

soak: $(VENV)/.installed
	$(VENV)/bin/python bench/soak.py

# One kind alone: .venv/bin/python -m fuzz NAME, or NAME=TRIALS.
fuzz: $(VENV)/.installed
	$(VENV)/bin/python -m fuzz

format: $(VENV)/.installed
	$(VENV)/bin/ruff check --fix .
	$(VENV)/bin/ruff format .

clean:
	rm -rf $(VENV) $(DEMO_VENV) $(DOCS_VENV) .opencv4 .boards build/bench build/site $(addprefix demo-,$(METHODS:=.png)) cvo-edge-demo.png
