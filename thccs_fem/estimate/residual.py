"""The residual of the strong form in each cell."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

import ufl
from thccs_fem.estimate.indicators import over_cells
from thccs_fem.fem.function import Function

__all__ = ["residual"]

Floats = npt.NDArray[np.float64]
Expr = ufl.core.expr.Expr


def residual(
    uh: Function,
    strong_residual: Expr,
    neumann: Expr | Mapping[int, Expr] | None = None,
    flux: Expr | None = None,
) -> Floats:
    """Return the residual indicators of a second-order problem.

    With h the root of the area of the cell K,

        eta^2 = h^2 |strong residual|^2_K + h |residual of the Neumann condition|^2 + h / 2 |jump of the flux|^2

    in L2 norms over K and over its edges on the boundary and inside. For -div(kappa grad(u)) = f with
    kappa grad(u).n = g on the edges tagged 2, say ::

        n, sigma = ufl.FacetNormal(msh), kappa * grad(uh)
        estimate.residual(uh, f + div(sigma), neumann={2: g - dot(sigma, n)}, flux=sigma)

    Where kappa is smooth the flux jumps only at the bicubic caps of extraordinary vertices, along the edges that leave
    these: the space is C1 elsewhere. Jumps are small there, and `flux` may be left out. Where kappa jumps it may not.

    Near a reentrant corner second derivatives are not square-integrable: there the residual grows with the level of the
    caps.

    Args:
        uh: The approximation; the indicators belong to its cells.
        strong_residual: UFL expression in uh, e.g. f + div(grad(uh)).
        neumann: Likewise on the boundary, where no values are prescribed: on all of it, or one for each edge tag.
        flux: The vector (of a system: the tensor) whose normal part must not jump.

    Returns:
        Shape (cells.num_owned,), those of the cells that this rank owns.

    Raises:
        ValueError: If an expression has functions on finer cells, or an edge tag is unknown.
    """
    V = uh.function_space
    h = np.sqrt(over_cells(V, ufl.as_ufl(1.0)))
    squares = h**2 * over_cells(V, _square(strong_residual))
    conditions = neumann.items() if isinstance(neumann, Mapping) else [("everywhere", neumann)]
    for tag, condition in conditions:
        if condition is not None:
            squares += h * over_cells(V, _square(condition), ufl.ds(tag))
    if flux is not None:
        jump = ufl.jump(flux, ufl.FacetNormal(V.mesh.ufl_domain()))
        squares += h * over_cells(V, _square(jump), ufl.dS)  # which counts for both cells by half
    return np.sqrt(np.maximum(squares, 0.0))


def _square(value: Expr) -> Expr:
    return ufl.inner(value, value)
