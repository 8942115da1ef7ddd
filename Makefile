# Two commands do everything, set-up included: `make demo` and `make test`.
# PYTHON must be a Python 3.11 (what Blender 5.0's module needs); TORCH may name another build of torch.

PYTHON ?= python3
TORCH ?= torch==2.13.0
DEMO ?= build/demo
DEMO_MINUTES ?= 2.4

ifeq ($(OS),Windows_NT)
BIN = Scripts
else
BIN = bin
endif
BACKEND = .venv/$(BIN)/python
BLENDER = .venv-bpy/$(BIN)/python

.PHONY: help venv demo test lint benchmarks clean

help:
	@echo "make demo        a capture made by Blender becomes labelled splats, with a report, in $(DEMO)"
	@echo "make test        the tests"
	@echo "make venv        the backend's environment, .venv, alone"
	@echo "make benchmarks  speed of the rasterizer and of training"
	@echo "make clean       remove environments and build/"

venv: .venv/ready

.venv/ready: requirements/backend.txt requirements/dev.txt
	$(PYTHON) -m venv .venv
	$(BACKEND) -m pip install --quiet --disable-pip-version-check "$(TORCH)"
	$(BACKEND) -m pip install --quiet --disable-pip-version-check -r requirements/backend.txt -r requirements/dev.txt
	$(BACKEND) -m backend doctor
	@touch $@

.venv-bpy/ready: requirements/blender.txt
	$(PYTHON) -m venv .venv-bpy
	$(BLENDER) -m pip install --quiet --disable-pip-version-check -r requirements/blender.txt
	@touch $@

demo: .venv/ready .venv-bpy/ready
	$(BLENDER) headless.py demo $(DEMO)/capture
	$(BACKEND) -m backend check $(DEMO)/capture
	$(BACKEND) -m backend vote $(DEMO)/capture --out $(DEMO)
	$(BACKEND) -m backend train $(DEMO)/capture --out $(DEMO) --minutes $(DEMO_MINUTES)
	$(BACKEND) -m backend evaluate $(DEMO)
	$(BACKEND) -m backend report $(DEMO)
	@echo "Done: see $(DEMO)/report.md"

test: .venv/ready .venv-bpy/ready
	$(BACKEND) -m pytest tests/backend
	$(BLENDER) -m pytest tests/blender

lint: .venv/ready
	$(BACKEND) -m ruff check .
	$(BACKEND) -m ruff format --check backend tests/backend benchmarks
	$(BACKEND) -m mypy

benchmarks: .venv/ready
	$(BACKEND) benchmarks/raster.py
	$(BACKEND) benchmarks/train.py

clean:
	rm -rf .venv .venv-bpy build
