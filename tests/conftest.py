"""Set-up of every test run: no window, no chance."""

import contextlib
import os

os.environ.setdefault("PYVISTA_OFF_SCREEN", "true")  # read by pyvista when it is imported

with contextlib.suppress(ImportError):  # comes with PETSc, which is optional
    from mpi4py import MPI  # noqa: F401  # initialises MPI, which petsc4py must find done

from hypothesis import settings

# The same examples in every run. No deadline: the first example pays for compiling kernels.
settings.register_profile("repeatable", derandomize=True, deadline=None, database=None)
settings.load_profile("repeatable")

collect_ignore = ["benchmarks", "parallel"]  # run by `make bench` and, on several ranks, by tests in `tests/mpi`
