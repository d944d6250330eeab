"""Function spaces, functions, forms, assembly and boundary conditions.

Linear, nonlinear and eigenvalue problems are solved by `thccs_fem.fem.scipy`, or by `thccs_fem.fem.petsc`, which must
be imported explicitly: it needs petsc4py and mpi4py.
"""

from thccs_fem.fem.assembly import assemble_cells, assemble_matrix, assemble_scalar, assemble_vector
from thccs_fem.fem.bcs import DirichletBC, boundary_dofs, dirichletbc, locate_dofs_geometrical, region_dofs
from thccs_fem.fem.expression import Expression
from thccs_fem.fem.forms import Form, form
from thccs_fem.fem.function import Constant, Function, cell_sizes
from thccs_fem.fem.points import point_values
from thccs_fem.fem.project import project
from thccs_fem.fem.space import CellwiseSpace, FunctionSpace, cellwise, functionspace

__all__ = [
    "CellwiseSpace",
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
    "cell_sizes",
    "cellwise",
    "dirichletbc",
    "form",
    "functionspace",
    "locate_dofs_geometrical",
    "point_values",
    "project",
    "region_dofs",
]
