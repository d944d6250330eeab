"""Finite elements on truncated hierarchical Catmull-Clark subdivision surfaces (THCCS).

Nothing is imported here: take the modules that you need, as in
``from thccs_fem import fem, generators, io``. PETSc is loaded by :mod:`thccs_fem.fem.petsc` alone.
"""

__version__ = "0.1.0"
