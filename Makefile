# Each target sets up what it needs; a fresh machine needs Python >= 3.11 with venv, pip and make.
PYTHON ?= python3
# pip options for installing torch, for example the index of its CPU wheels.
TORCH_PIP_OPTIONS ?=
VENV := .venv
DEMO_VENV := .venv-demo
DOCS_VENV := .venv-docs
RELEASE_VENV := .venv-release
LOWEST_VENV := .venv-lowest
METHODS := scr cjp cqr csp mcqr
BUNDLE := calibration_artifacts/synthetic-room
RUNTIME := $(shell find cvo_edge -type f -not -name "*.pyc")

.PHONY: help demo test coverage check docs bench wrong-frames soak fuzz arm64 avx2 format clean

help: ## list all targets
	@awk -F ':.*## ' '/^[a-z0-9 -]+:.*## / { printf "make %-13s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

# Installed as users do, not editable: the demonstration proves that the wheel holds its data.
$(DEMO_VENV)/.installed: pyproject.toml $(RUNTIME)
	$(PYTHON) -m venv $(DEMO_VENV)
	rm -rf build/lib build/bdist.*
	$(DEMO_VENV)/bin/python -m pip install --quiet .
	@touch $@

$(VENV)/.installed: pyproject.toml export/pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install --quiet $(TORCH_PIP_OPTIONS) torch torchvision
	$(VENV)/bin/python -m pip install --quiet --editable ".[test,check]" --editable "./export[plot,ray,reconstruct,rosbag]"
	@touch $@

demo: $(DEMO_VENV)/.installed $(addprefix demo-,$(METHODS)) ## install the runtime without torch and run the demonstration of every method
	@echo "== the packaged bundle"
	$(DEMO_VENV)/bin/cvo-edge demo

demo-%: $(DEMO_VENV)/.installed
	@echo "== synthetic-room-$*"
	$(DEMO_VENV)/bin/cvo-edge demo $(BUNDLE)-$* --picture demo-$*.png

# A second release of OpenCV, for the tests that compare how both decode the same files.
.opencv4: $(VENV)/.installed
	$(VENV)/bin/python -m pip install --quiet --no-deps --upgrade --target $@ opencv-python-headless==4.10.0.84
	@touch $@

test: $(VENV)/.installed .opencv4 ## install both packages and run all tests (CVO_DATA, CVO_WEIGHTS: optional real data)
	$(VENV)/bin/python -m pytest

# Processes that the tests start are measured, too; below 95 % of all lines it fails. A process that
# may write only small files cannot write its measurement.
coverage: $(VENV)/.installed .opencv4 ## run all tests and list the lines of cvo_edge that no test runs
	$(VENV)/bin/python -m pytest --cov --cov-report=term-missing -k "not fills_up"

arm64 avx2: $(VENV)/.installed ## test the runtime on an emulated processor and compare the numbers (Linux, apt-get, root)
	$(VENV)/bin/python -m boards $@ --json bench/results/boards/$@.json

check: $(VENV)/.installed ## check lint, formatting, types and import rules
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy
	$(VENV)/bin/lint-imports

$(DOCS_VENV)/.installed: pyproject.toml
	$(PYTHON) -m venv $(DOCS_VENV)
	$(DOCS_VENV)/bin/python -m pip install --quiet --editable ".[docs]"
	@touch $@

docs: $(DOCS_VENV)/.installed ## build the documentation into build/site, strictly and without requests
	NO_MKDOCS_2_WARNING=1 $(DOCS_VENV)/bin/mkdocs build --strict --quiet
	@echo "build/site/index.html"

# AGAINST: another checkout of this repository, measured in turns with this one.
AGAINST ?=
bench: $(VENV)/.installed ## measure speed, memory and start-up on a quiet machine, within an hour; goes on where it ended (AGAINST: another checkout)
	$(VENV)/bin/python bench/all.py $(if $(AGAINST),--against $(AGAINST))

# RUNS: run folders to measure instead of the demonstration bundles.
RUNS ?=
wrong-frames: $(VENV)/.installed ## play 79 kinds of wrong frames through the demonstration bundles (RUNS: run folders instead)
ifeq ($(RUNS),)
	$(VENV)/bin/python bench/wrong_frames.py $(BUNDLE)-cjp synthetic:room,flights=100
	$(VENV)/bin/python bench/wrong_frames.py $(BUNDLE)-scr synthetic:room,flights=100
else
	set -e; for run in $(RUNS); do $(VENV)/bin/python bench/wrong_frames.py $$run; done
endif

soak: $(VENV)/.installed ## process a million frames and watch memory; half an hour
	$(VENV)/bin/python bench/soak.py

# A single kind: .venv/bin/python -m fuzz NAME, or NAME=TRIALS.
fuzz: $(VENV)/.installed ## try damaged models, bundles, images and cameras, and killed processes; half an hour
	$(VENV)/bin/python -m fuzz

format: $(VENV)/.installed ## reformat the code
	$(VENV)/bin/ruff check --fix .
	$(VENV)/bin/ruff format .

clean: ## delete everything that these targets create
	rm -rf $(VENV) $(DEMO_VENV) $(DOCS_VENV) $(RELEASE_VENV) $(LOWEST_VENV) .opencv4 .boards build dist export/build
	rm -rf *.egg-info export/*.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	rm -f $(addprefix demo-,$(METHODS:=.png)) cvo-edge-demo.png

# --- Packages -------------------------------------------------------------------------------------

.PHONY: wheel-demo test-lowest constraints release

# setuptools would pack what an earlier build left in build/lib.
wheel-demo: ## build the runtime's wheel, install it alone and run its demonstration in an empty folder
	rm -rf build/lib build/bdist.* build/wheel-demo
	mkdir -p build/wheel-demo/empty
	$(PYTHON) -m venv build/wheel-demo/venv
	build/wheel-demo/venv/bin/python -m pip wheel --quiet --no-deps --wheel-dir build/wheel-demo .
	build/wheel-demo/venv/bin/python -m pip install --quiet build/wheel-demo/cvo_edge-*.whl
	cd build/wheel-demo/empty && env -u PYTHONPATH ../venv/bin/cvo-edge demo

$(LOWEST_VENV)/.installed: pyproject.toml constraints/lowest.txt
	$(PYTHON) -m venv $(LOWEST_VENV)
	$(LOWEST_VENV)/bin/python -m pip install --quiet --constraint constraints/lowest.txt --editable ".[test]" onnx
	@touch $@

# tests/validity/test_coverage.py, tests/export and the documents' commands need the training side.
test-lowest: $(LOWEST_VENV)/.installed ## run the runtime's tests with the lowest versions that pyproject.toml allows
	$(LOWEST_VENV)/bin/python -m pytest tests/edge tests/contract tests/validity/test_oracles.py \
	    --ignore=tests/contract/test_document_commands.py --ignore=tests/contract/test_written_files.py \
	    --ignore-glob="tests/contract/test_wrong_*.py"

constraints: $(VENV)/.installed ## pin the installed dependencies of both packages in constraints/
	$(VENV)/bin/python constraints/refresh.py

$(RELEASE_VENV)/.installed: constraints/release.txt
	$(PYTHON) -m venv $(RELEASE_VENV)
	$(RELEASE_VENV)/bin/python -m pip install --quiet --requirement constraints/release.txt
	@touch $@

# From the last commit, not from the working tree; the same commit gives the same bytes.
release: export SOURCE_DATE_EPOCH = $(shell git log -1 --format=%ct)
release: SOURCE := build/release/source
release: VERSION = $(shell git show HEAD:cvo_edge/vocabulary.py | sed -n 's/^VERSION = "\(.*\)"/\1/p')
release: $(RELEASE_VENV)/.installed ## build wheels and sdists of both packages, SBOMs and checksums into dist/
	rm -rf build/release dist
	mkdir -p $(SOURCE) build/release/sdist dist
	git -c tar.umask=0022 archive HEAD | tar --extract --preserve-permissions --directory=$(SOURCE)
	umask 022; for project in $(SOURCE) $(SOURCE)/export; do \
	    $(RELEASE_VENV)/bin/python -m build --quiet --no-isolation --outdir dist $$project || exit 1; \
	done
	for name in cvo_edge-$(VERSION) cvo_export-$(VERSION); do \
	    tar --extract --file=dist/$$name.tar.gz --directory=build/release/sdist && \
	    tar --create --format=ustar --sort=name --mtime=@$$SOURCE_DATE_EPOCH --owner=0 --group=0 --numeric-owner \
	        --mode=u+rw,go+r,go-w --directory=build/release/sdist $$name | gzip -9 --no-name > dist/$$name.tar.gz || exit 1; \
	done
	$(RELEASE_VENV)/bin/twine check --strict dist/*
	$(PYTHON) -m venv --without-pip build/release/venv
	$(RELEASE_VENV)/bin/python -m pip --python build/release/venv/bin/python install --quiet \
	    --constraint $(SOURCE)/constraints/runtime.txt dist/cvo_edge-$(VERSION)-py3-none-any.whl
	sed -i 's/^dynamic = \["version"\]/version = "$(VERSION)"/' $(SOURCE)/pyproject.toml $(SOURCE)/export/pyproject.toml
	$(RELEASE_VENV)/bin/cyclonedx-py environment --output-reproducible --pyproject $(SOURCE)/pyproject.toml \
	    --output-file dist/cvo_edge-$(VERSION).cdx.json build/release/venv/bin/python
	$(RELEASE_VENV)/bin/cyclonedx-py requirements --output-reproducible --pyproject $(SOURCE)/export/pyproject.toml \
	    --output-file dist/cvo_export-$(VERSION).cdx.json $(SOURCE)/constraints/export.txt
	cd dist && sha256sum *.whl *.tar.gz *.json > SHA256SUMS
