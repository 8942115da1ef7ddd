# Two commands do everything, set-up included: `make demo` and `make test`.
# PYTHON must be a Python 3.11 (what Blender 5.0's module needs); TORCH may name another build of torch.

PYTHON ?= python3
# Blender 5.2's module needs a Python 3.13; empty where there is none.
PYTHON313 ?= $(shell python3.13 -c "import sys; print(sys.executable)" 2>/dev/null \
	|| ls $$(pyenv root 2>/dev/null)/versions/3.13*/bin/python3.13 2>/dev/null | tail -1)
TORCH ?= $(shell sed '/^\#/d' requirements/torch.txt)
DEMO ?= build/demo
DEMO_MINUTES ?= 2.4

ifeq ($(OS),Windows_NT)
BIN = Scripts
else
BIN = bin
endif
BACKEND = .venv/$(BIN)/python
BLENDER = .venv-bpy/$(BIN)/python
HEADLESS = $(BLENDER) headless.py
# Blender's own tool for extensions, as its module brings it.
EXTENSION_TOOL = site-packages/bpy/*/scripts/addons_core/bl_pkg/cli/blender_ext.py
BLENDER_EXT = $(BLENDER) $(wildcard .venv-bpy/lib/python*/$(EXTENSION_TOOL) .venv-bpy/Lib/$(EXTENSION_TOOL))

export OBJECTGS_PYTHON = $(abspath $(BACKEND))

# Compiled once, by `make venv`, for whatever runs the backend.
export NUMBA_CACHE_DIR ?= $(abspath .venv/kernels)

# Where `make gpu` looks for a torch that sees a GPU: in PYTHON where it is given, else in these.
GPU_PYTHONS = $(if $(filter command environment,$(firstword $(origin PYTHON))),$(PYTHON),$(BACKEND) python3)
# Two processes of the tests; one that has nothing left to do takes tests from the other.
WORKERS = -n 2 --dist worksteal
# Further options for the window tests, such as -m "not slow".
WINDOW ?=
# How long `make fuzz` tries random cases.
MINUTES ?= 10
# The longest time of the tests, and of the measurements, on a GPU.
GPU_SECONDS ?= 240
# The capture that benchmarks/gpu.py trains on, where there is one.
CAPTURE ?= $(wildcard build/demo/capture)

.PHONY: help venv lock demo demo-photos zip manual test test-long test-slow test-window test-blenders lint benchmarks gpu gpu-with clean

help:
	@echo "make demo           a capture made by Blender becomes objects in a .blend, with a report, in $(DEMO)"
	@echo "make demo-photos    the same from the photos alone, in $(DEMO)-photos"
	@echo "make zip            the extension to install in Blender, in build/"
	@echo "make manual         docs/manual/manual.html anew, after a change of the manual or the guide"
	@echo "make test           the tests, within ten minutes"
	@echo "make test-long      the other tests of CI: each takes many seconds"
	@echo "make test-slow      tests that take minutes, such as those of the cache of kernels"
	@echo "make test-window    the tests that drive a Blender with a window, where there is one"
	@echo "make test-blenders  the tests of the Blender side in more versions of Blender"
	@echo "make lint           what a change must pass beside the tests"
	@echo "make venv           the backend's environment, .venv, alone"
	@echo "make lock           requirements/locked/ anew, after a change of the backend's packages"
	@echo "make benchmarks     speed of the rasterizer and of training"
	@echo "make fuzz           hostile inputs, kills and races for MINUTES=10; writes docs/reliability.md"
	@echo "make gpu            tests and benchmarks on an NVIDIA GPU; CAPTURE may name what to train on"
	@echo "make clean          remove environments and build/"

venv: .venv/ready

.venv/ready: requirements/torch.txt requirements/backend.txt requirements/dev.txt
	$(PYTHON) -m venv .venv
	$(BACKEND) -m pip install --quiet --disable-pip-version-check "$(TORCH)"
	$(BACKEND) -m pip install --quiet --disable-pip-version-check -r requirements/backend.txt -r requirements/dev.txt
	$(BACKEND) -m backend doctor
	@touch $@

lock: .venv/ready
	$(BACKEND) requirements/lock.py

.venv-bpy/ready: requirements/blender.txt
	$(PYTHON) -m venv .venv-bpy
	$(BLENDER) -m pip install --quiet --disable-pip-version-check -r requirements/blender.txt
	@touch $@

.venv-bpy-%/ready: requirements/blender-%.txt
	$(if $(filter 5.2,$*),$(PYTHON313),$(PYTHON)) -m venv .venv-bpy-$*
	.venv-bpy-$*/$(BIN)/python -m pip install --quiet --disable-pip-version-check -r $<
	@touch $@

demo: .venv/ready .venv-bpy/ready
	$(HEADLESS) demo $(DEMO)/capture
	$(BACKEND) -m backend check $(DEMO)/capture
	$(HEADLESS) run $(DEMO)/capture --out $(DEMO) --minutes $(DEMO_MINUTES)
	@echo "Done: see $(DEMO)/report.md and $(DEMO)/objectgs.blend"

demo-photos: .venv/ready .venv-bpy/ready
	$(HEADLESS) demo $(DEMO)/capture
	$(BACKEND) -m backend sfm $(DEMO)/capture --out $(DEMO)-photos/capture
	$(HEADLESS) run $(DEMO)-photos/capture --out $(DEMO)-photos --minutes $(DEMO_MINUTES)
	@echo "Done: see $(DEMO)-photos/report.md and $(DEMO)-photos/objectgs.blend"

zip: .venv-bpy/ready
	@mkdir -p build
	$(BLENDER_EXT) build --source-dir . --output-dir build
	$(BLENDER_EXT) validate build/objectgs-*.zip

manual: .venv/ready
	$(BACKEND) docs/build_manual.py

test: .venv/ready .venv-bpy/ready
	$(BACKEND) -m pytest $(WORKERS) -m "not long and not slow" tests/backend
	$(BLENDER) -m pytest $(WORKERS) -m "not long and not slow" tests/blender

test-long: .venv/ready .venv-bpy/ready
	$(BACKEND) -m pytest $(WORKERS) -m "long and not slow" tests/backend tests/fuzz
	$(BLENDER) -m pytest $(WORKERS) -m "long and not slow" tests/blender

test-slow: .venv/ready .venv-bpy/ready
	$(BACKEND) -m pytest $(WORKERS) -m slow tests/backend
	$(BLENDER) -m pytest $(WORKERS) -m slow tests/blender

test-window: .venv/ready .venv-bpy/ready
	$(BACKEND) -m pytest $(WINDOW) tests/window

test-blenders: .venv/ready .venv-bpy-4.2/ready
	.venv-bpy-4.2/$(BIN)/python -m pytest $(WORKERS) tests/blender
	@if [ -n "$(PYTHON313)" ]; then \
		$(MAKE) .venv-bpy-5.2/ready && .venv-bpy-5.2/$(BIN)/python -m pytest $(WORKERS) tests/blender; \
	else \
		echo "There is no Python 3.13 here, so Blender 5.2 was left out; PYTHON313 may name one."; \
	fi
	$(BACKEND) -m pytest tests/window --all-blenders

fuzz: .venv/ready
	$(BACKEND) -m tests.fuzz --minutes $(MINUTES) --write

lint: .venv/ready
	$(BACKEND) -m ruff check .
	$(BACKEND) -m ruff format --check .
	$(BACKEND) -m mypy

benchmarks: .venv/ready
	$(BACKEND) benchmarks/raster.py
	$(BACKEND) benchmarks/train.py

# Nothing is installed here: it works without a network, with whatever the Python has.
gpu:
	@for python in $(GPU_PYTHONS); do \
		if "$$python" -c "import sys, torch; sys.exit(not torch.cuda.is_available())" >/dev/null 2>&1; then \
			exec $(MAKE) --no-print-directory gpu-with GPU_PYTHON="$$python"; \
		fi; \
	done; \
	if nvidia-smi -L >/dev/null 2>&1; then \
		echo "There is an NVIDIA GPU, but the torch of $(GPU_PYTHONS) does not see it; name a Python whose does (PYTHON=...)."; \
		exit 1; \
	fi; \
	echo "There is no NVIDIA GPU here, so nothing was run, and nothing counts as passed."

gpu-with:
	$(GPU_PYTHON) -c "import sys; from backend.raster import devices; sys.exit(devices.why_not_cuda())"
	@# A failing test does not end the measurements, of which build/gpu.json keeps those that are done.
	@timeout $(GPU_SECONDS) $(GPU_PYTHON) -m pytest tests/gpu; tests=$$?; \
	timeout $(GPU_SECONDS) $(GPU_PYTHON) benchmarks/gpu.py --out build/gpu.json $(if $(CAPTURE),--demo "$(CAPTURE)") \
	&& exit $$tests

clean:
	rm -rf .venv .venv-bpy .venv-bpy-4.2 .venv-bpy-5.2 build
