"""The exact error of each cell."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
import numpy.typing as npt

import ufl
from thccs_fem.estimate.indicators import check_function, over_cells
from thccs_fem.fem.function import Function
from thccs_fem.fem.space import FunctionSpace

__all__ = ["error"]

Floats = npt.NDArray[np.float64]
Expr = ufl.core.expr.Expr


def error(
    uh: Function,
    u_exact: Expr | float | Callable[[ufl.SpatialCoordinate], Expr | float],
    norm: Literal["L2", "H1"] = "L2",
) -> Floats:
    """Return the norm of the error on each cell.

    Args:
        uh: The approximation.
        u_exact: The exact solution: a UFL expression or a number, or a function that makes one of the spatial
            coordinate.
        norm: "L2", or "H1" (the full norm: values and gradients along the surface).

    Returns:
        Shape (cells.num_owned,), those of the cells that this rank owns.

    Raises:
        TypeError: If uh is no function.
        ValueError: If the norm is unknown.
    """
    check_function(uh)
    V = uh.function_space
    if norm not in ("L2", "H1"):
        raise ValueError(f'norm is {norm!r}; it must be "L2" or "H1"')
    exact = u_exact if isinstance(u_exact, Expr | float | int) else u_exact(ufl.SpatialCoordinate(V.mesh))
    e = uh - ufl.as_ufl(exact)
    density = ufl.inner(e, e)
    if norm == "H1":
        gradient = _tangential(V, ufl.grad(e))
        density += ufl.inner(gradient, gradient)
    return np.sqrt(np.maximum(over_cells(V, density * ufl.dx(domain=V.mesh.ufl_domain())), 0.0))


def _tangential(V: FunctionSpace, gradient: Expr) -> Expr:
    """Return the part of a gradient that is tangential to the surface.

    That of a THCCS function is tangential already, but UFL's gradient of an expression in the spatial coordinate is the
    one in space: on a surface the difference of the two has a normal part, which has nothing to do with the error.
    """
    if V.mesh.gdim == 2:
        return gradient
    domain = V.mesh.ufl_domain()
    return ufl.dot(gradient, ufl.Jacobian(domain) * ufl.JacobianInverse(domain))  # J times its pseudo-inverse
