# `make demo` and `make test` are all that one needs: the first run of either sets up .venv, which takes
# a minute or two, and later runs start at once. It wants Python >= 3.12 with its C headers (PYTHON=...
# names one), a C compiler and a package index.

# The systems of the demos and tests are small: more threads only get in each other's way.
export OMP_NUM_THREADS := 1

python := .venv/bin/python
ready := .venv/.ready

.PHONY: demo test lint bench clean

demo: $(ready)
	$(python) demos/laplace_on_surface.py

# What runs on several ranks comes after the rest: ranks that wait keep their processors busy.
test: $(ready)
	$(python) -m pytest --numprocesses=auto --dist=loadfile --ignore=tests/mpi
	$(python) -m pytest tests/mpi

lint: $(ready)
	$(python) -m ruff check .
	$(python) -m ruff format --check .
	$(python) -m mypy

bench: $(ready)
	set -e; for script in tests/benchmarks/*.py; do $(python) $$script; done

clean:
	rm -rf .venv build dist out *.egg-info .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# True (exit code 0) for a Python that will do. Kernels are compiled against the headers.
will_do := import ensurepip, os, sys, sysconfig, venv; \
	headers = os.path.join(sysconfig.get_path('include'), 'Python.h'); \
	sys.exit(sys.version_info < (3, 12) or not os.path.exists(headers))

# Written last, so that a set-up that failed half-way is done again; from scratch, so that the
# outcome does not depend on what was there.
$(ready): pyproject.toml
	@found=; for candidate in $(or $(PYTHON),python3 python3.12 python3.13 python3.14 python); do \
	    if "$$candidate" -c "$(will_do)" 2>/dev/null; then found="$$candidate"; break; fi; \
	done; \
	if [ -z "$$found" ]; then \
	    echo "No Python >= 3.12 with its venv module and its C headers (Python.h) was found." >&2; \
	    echo "Install one (on Debian and Ubuntu: apt install python3-dev python3-venv)," >&2; \
	    echo "or say where it is: make PYTHON=/path/to/python3.12 $(MAKECMDGOALS)" >&2; \
	    exit 1; \
	fi; \
	echo "Setting up .venv with $$("$$found" --version); this takes a minute or two."; \
	"$$found" -m venv --clear .venv
	$(python) -m pip install --disable-pip-version-check --editable ".[dev,petsc]"
	@touch $@
