"""PETSc: matrices and vectors of forms, and problems solved by any of its solvers.

This package alone imports petsc4py, slepc4py and mpi4py.
"""

import mpi4py.MPI  # noqa: F401  # initialises MPI, and loads the library of it that petsc4py needs

from thccs_fem.fem.petsc.eigen import EigenProblem
from thccs_fem.fem.petsc.linear import LinearProblem
from thccs_fem.fem.petsc.matrices import apply_lifting, assemble_matrix, assemble_vector, set_bc
from thccs_fem.fem.petsc.multigrid import multigrid
from thccs_fem.fem.petsc.nonlinear import NonlinearProblem
from thccs_fem.fem.petsc.timestepping import TimeProblem

__all__ = [
    "EigenProblem",
    "LinearProblem",
    "NonlinearProblem",
    "TimeProblem",
    "apply_lifting",
    "assemble_matrix",
    "assemble_vector",
    "multigrid",
    "set_bc",
]
