"""Indicators, one a cell: integrals over each, and their sum."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

import ufl
from thccs_fem.fem.assembly import assemble_cells
from thccs_fem.fem.forms import form
from thccs_fem.fem.function import Function
from thccs_fem.fem.space import FunctionSpace
from thccs_fem.parallel import total

__all__ = ["check_function", "norm", "over_cells"]

Floats = npt.NDArray[np.float64]
QUADRATURE_DEGREE = 11  # 6 x 6 Gauss points: the error is no polynomial


def norm(V: FunctionSpace, eta: Floats) -> float:
    """Return the root of the sum of the squared indicators, over all ranks; collective."""
    return float(np.sqrt(total(V.mesh.comm, np.sum(np.asarray(eta) ** 2))))


def check_function(uh: object) -> None:
    """Raise if the approximation is none.

    Raises:
        TypeError: It is no function.
    """
    wrong = f"uh is of type {type(uh).__name__}; it must be a fem.Function."
    if isinstance(uh, list | tuple):
        raise TypeError(
            f"{wrong} Of several unknowns give one at a time, and add their squares: np.hypot(eta_u, eta_p)"
        )
    if not isinstance(uh, Function):
        raise TypeError(wrong)


def over_cells(V: FunctionSpace, integrals: ufl.Form) -> Floats:
    """Return the integrals of a form over each cell of V, and its edges, shape (cells.num_owned,).

    Raises:
        ValueError: If the form has functions on finer cells than those of V.
    """
    compiled = form(integrals, quadrature_degree=QUADRATURE_DEGREE, on=V)
    if compiled.cells is not V.integration_cells:
        raise ValueError("the expression has functions on a refinement of the cells that indicators are wanted for")
    return assemble_cells(compiled)
