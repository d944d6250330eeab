"""Function spaces, functions, forms, assembly and boundary conditions.

The solvers are optional parts and must be imported explicitly: `thccs_fem.fem.petsc` needs petsc4py and mpi4py,
`thccs_fem.fem.scipy` nothing more than SciPy.
"""

from thccs_fem.fem.assembly import assemble_cells, assemble_matrix, assemble_scalar, assemble_vector
from thccs_fem.fem.bcs import DirichletBC, boundary_dofs, dirichletbc, locate_dofs_geometrical, region_dofs
from thccs_fem.fem.expression import Expression
from thccs_fem.fem.forms import Form, form
from thccs_fem.fem.function import Constant, Function
from thccs_fem.fem.project import project
from thccs_fem.fem.space import FunctionSpace, functionspace

__all__ = [
    "Constant",
    "DirichletBC",
    "Expression",
    "Form",
    "Function",
    "FunctionSpace",
    "assemble_cells",
    "assemble_matrix",
    "assemble_scalar",
    "assemble_vector",
    "boundary_dofs",
    "dirichletbc",
    "form",
    "functionspace",
    "locate_dofs_geometrical",
    "project",
    "region_dofs",
]
