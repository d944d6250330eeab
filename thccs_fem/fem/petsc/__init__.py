"""PETSc: matrices and vectors of forms, and problems solved by any of its solvers.

This package alone imports petsc4py, slepc4py and mpi4py.
"""

from thccs_fem.fem.petsc.linear import LinearProblem
from thccs_fem.fem.petsc.matrices import apply_lifting, assemble_matrix, assemble_vector, set_bc

__all__ = ["LinearProblem", "apply_lifting", "assemble_matrix", "assemble_vector", "set_bc"]
