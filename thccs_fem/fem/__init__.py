"""Function spaces, functions, forms, assembly and boundary conditions.

Linear problems are solved by `thccs_fem.fem.scipy`, or by `thccs_fem.fem.petsc`, which must be imported explicitly: it
needs petsc4py and mpi4py.
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
