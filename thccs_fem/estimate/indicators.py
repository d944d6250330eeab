"""Indicators, one a cell: integrals over each, and their sum."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

import ufl
from thccs_fem.fem.assembly import assemble_cells
from thccs_fem.fem.forms import form
from thccs_fem.fem.space import FunctionSpace
from thccs_fem.parallel import total

__all__ = ["norm", "over_cells"]

Floats = npt.NDArray[np.float64]
QUADRATURE_DEGREE = 11  # 6 x 6 Gauss points: the error is no polynomial


def norm(V: FunctionSpace, eta: Floats) -> float:
    """Return the root of the sum of the squared indicators, over all ranks; collective."""
    return float(np.sqrt(total(V.mesh.comm, np.sum(np.asarray(eta) ** 2))))


def over_cells(V: FunctionSpace, integrals: ufl.Form) -> Floats:
    """Return the integrals of a form over each cell of V, and its edges, shape (cells.num_owned,).

    Raises:
        ValueError: If the form has functions on finer cells than those of V.
    """
    compiled = form(integrals, quadrature_degree=QUADRATURE_DEGREE, on=V)
    if compiled.cells is not V.integration_cells:
        raise ValueError("the expression has functions on a refinement of the cells that indicators are wanted for")
    return assemble_cells(compiled)
