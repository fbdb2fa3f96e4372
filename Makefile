# `make demo` and `make test` set up what they need the first time and are quick afterwards.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
READY  := $(VENV)/.ready
KERNELS := $(VENV)/.kernels
BENCH  := $(VENV)/.bench-ready

.PHONY: demo virtual-bench test lint bench soak clean help

help:            ## this list
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*##/\t/' | expand -t 16

$(READY): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	  || { echo "Python 3.11 or newer is needed; name it with: make PYTHON=python3.12 …" >&2; exit 2; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	@touch $@

# Numba's cache sees the file of a kernel, not those of the functions it calls: what has changed is compiled anew.
$(KERNELS): $(READY) $(shell grep -lE '^@(njit|_?compiled)' scanner/*.py scanner/*/*.py sim_backend/*.py)
	@find scanner sim_backend \( -name '*.nbi' -o -name '*.nbc' \) -delete
	$(BIN)/python -m scanner.kernels
	@touch $@

demo: $(KERNELS)   ## scan the mirror scene on the simulated bench and compare MFS with TPS
	$(BIN)/scan --config configs/demo.yaml --out demo-result --overwrite
	$(BIN)/scan compare --config configs/demo.yaml --methods mfs,tps --reuse demo-result --out demo-comparison --overwrite

# The real drivers need a virtual X server and a C compiler here; where one is missing, the error names what to install.
virtual-bench: $(KERNELS)  ## the same scan through the real drivers: window, GenICam camera and trigger box, emulated below
	$(BIN)/scan --config configs/virtual_bench.yaml --out virtual-bench-result --overwrite

# Each worker has a core: threads for all of them would wait for one another. What Python compiles, it keeps.
SIDE_BY_SIDE = OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 NUMBA_NUM_THREADS=1 OPENCV_FOR_THREADS_NUM=1 \
	PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest --dist loadfile --no-loadscope-reorder

# The kernels are compiled while style and types are looked at.
test: $(READY)   ## lint, types, arrows and every test
	@$(MAKE) --no-print-directory --jobs=2 lint $(KERNELS)
	$(SIDE_BY_SIDE) -n logical --maxprocesses 4 -m 'not bench and not timed'
	$(SIDE_BY_SIDE) -n 2 -m 'timed and not bench'

lint: $(READY)   ## style, types, and who may import whom
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# The peer package brings a second OpenCV of its own: it is installed without its dependencies.
$(BENCH): $(KERNELS)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check scikit-image sympy pyyaml
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps 'Fringes>=2.1'
	@touch $@

bench: $(BENCH)  ## speed, as ratios to a peer and to reading the frames once
	$(BIN)/python -m pytest tests/benchmarks -m bench -s

soak: $(KERNELS)   ## two thousand scans' worth of sequences with random faults
	$(BIN)/python -m pytest tests/test_soak.py -m bench -s

clean:           ## forget the environment and the demo's output
	rm -rf $(VENV) demo-result demo-comparison virtual-bench-result
