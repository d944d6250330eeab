"""Error indicators, one a cell: the exact error, and the residual of the strong form.

Indicators are not squared; `norm` sums them up.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
import numpy.typing as npt

import ufl
from thccs_fem.fem.assembly import assemble_cells
from thccs_fem.fem.forms import form
from thccs_fem.fem.function import Function
from thccs_fem.fem.space import FunctionSpace

__all__ = ["error", "norm", "residual"]

Floats = npt.NDArray[np.float64]
QUADRATURE_DEGREE = 11  # 6 x 6 Gauss points: the error is no polynomial


def error(
    uh: Function,
    u_exact: ufl.core.expr.Expr | Callable[[ufl.SpatialCoordinate], ufl.core.expr.Expr],
    norm: Literal["L2", "H1"] = "L2",
) -> Floats:
    """Return the norm of the error on each cell.

    Args:
        uh: The approximation.
        u_exact: The exact solution: a UFL expression, or a function that makes one of the spatial coordinate.
        norm: "L2", or "H1" (the full norm: values and gradients along the surface).

    Returns:
        Shape (num_cells,), local.

    Raises:
        ValueError: If the norm is unknown.
    """
    V = uh.function_space
    if norm not in ("L2", "H1"):
        raise ValueError(f'norm is {norm!r}; it must be "L2" or "H1"')
    exact = u_exact if isinstance(u_exact, ufl.core.expr.Expr) else u_exact(ufl.SpatialCoordinate(V.mesh))
    e = uh - exact
    density = ufl.inner(e, e)
    if norm == "H1":
        gradient = _tangential(V, ufl.grad(e))
        density += ufl.inner(gradient, gradient)
    return np.sqrt(np.maximum(_over_cells(V, density), 0.0))


def residual(uh: Function, strong_residual: ufl.core.expr.Expr, neumann: ufl.core.expr.Expr | None = None) -> Floats:
    """Return the residual indicators of a second-order problem: h_K times the L2 norm of the strong residual on K.

    The space is C1, so that no jumps across element edges arise.  h_K is the root of the area of the cell.

    Args:
        uh: The approximation; the indicators belong to its cells.
        strong_residual: UFL expression in uh, e.g. f + div(grad(uh)).
        neumann: Not supported yet; the residual of a Neumann condition.

    Returns:
        Shape (num_cells,), local.

    Raises:
        NotImplementedError: If `neumann` is given.
    """
    if neumann is not None:
        raise NotImplementedError("boundary integrals are not supported yet; leave out `neumann`")
    V = uh.function_space
    squares = _over_cells(V, ufl.inner(strong_residual, strong_residual))
    return np.sqrt(_over_cells(V, ufl.as_ufl(1.0)) * np.maximum(squares, 0.0))


def norm(V: FunctionSpace, eta: Floats) -> float:
    """Return the root of the sum of the squared indicators, over all ranks."""
    return float(np.sqrt(np.sum(np.asarray(eta) ** 2)))


def _tangential(V: FunctionSpace, gradient: ufl.core.expr.Expr) -> ufl.core.expr.Expr:
    """Return the part of a gradient that is tangential to the surface.

    That of a THCCS function is tangential already, but UFL's gradient of an expression in the spatial coordinate is the
    one in space: on a surface the difference of the two has a normal part, which has nothing to do with the error.
    """
    if V.mesh.gdim == 2:
        return gradient
    domain = V.mesh.ufl_domain()
    return ufl.dot(gradient, ufl.Jacobian(domain) * ufl.JacobianInverse(domain))  # J times its pseudo-inverse


def _over_cells(V: FunctionSpace, density: ufl.core.expr.Expr) -> Floats:
    """Return the integral of a density over each cell of V, shape (num_cells,).

    Raises:
        ValueError: If the density has functions on finer cells than those of V.
    """
    compiled = form(density * ufl.dx(domain=V.mesh.ufl_domain()), quadrature_degree=QUADRATURE_DEGREE, on=V)
    if compiled.cells is not V.cells:
        raise ValueError("the expression has functions on a refinement of the cells that indicators are wanted for")
    return assemble_cells(compiled)
