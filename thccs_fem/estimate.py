"""Error indicators, one a cell: the exact error, the residual of the strong form, and local problems on bubbles.

Indicators are not squared; `norm` sums them up. On several ranks each has those of the cells that it owns; all
functions are collective.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Literal

import numpy as np
import numpy.typing as npt

import ufl
from thccs_fem.fem.assembly import assemble_cells, bubble_energies
from thccs_fem.fem.forms import Form, form
from thccs_fem.fem.function import Function
from thccs_fem.fem.space import FunctionSpace
from thccs_fem.parallel import gathered, total

__all__ = ["bubble", "error", "norm", "residual"]

Floats = npt.NDArray[np.float64]
Expr = ufl.core.expr.Expr
QUADRATURE_DEGREE = 11  # 6 x 6 Gauss points: the error is no polynomial


def error(
    uh: Function,
    u_exact: Expr | Callable[[ufl.SpatialCoordinate], Expr],
    norm: Literal["L2", "H1"] = "L2",
) -> Floats:
    """Return the norm of the error on each cell.

    Args:
        uh: The approximation.
        u_exact: The exact solution: a UFL expression, or a function that makes one of the spatial coordinate.
        norm: "L2", or "H1" (the full norm: values and gradients along the surface).

    Returns:
        Shape (cells.num_owned,), those of the cells that this rank owns.

    Raises:
        ValueError: If the norm is unknown.
    """
    V = uh.function_space
    if norm not in ("L2", "H1"):
        raise ValueError(f'norm is {norm!r}; it must be "L2" or "H1"')
    exact = u_exact if isinstance(u_exact, Expr) else u_exact(ufl.SpatialCoordinate(V.mesh))
    e = uh - exact
    density = ufl.inner(e, e)
    if norm == "H1":
        gradient = _tangential(V, ufl.grad(e))
        density += ufl.inner(gradient, gradient)
    return np.sqrt(np.maximum(_over_cells(V, density), 0.0))


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
    h = np.sqrt(_over_cells(V, ufl.as_ufl(1.0)))
    squares = h**2 * _over_cells(V, _square(strong_residual))
    conditions = neumann.items() if isinstance(neumann, Mapping) else [("everywhere", neumann)]
    for tag, condition in conditions:
        if condition is not None:
            squares += h * _over_cells(V, _square(condition), ufl.ds(tag))
    if flux is not None:
        jump = ufl.jump(flux, ufl.FacetNormal(V.mesh.ufl_domain()))
        squares += h * _over_cells(V, _square(jump), ufl.dS)  # which counts for both cells by half
    return np.sqrt(np.maximum(squares, 0.0))


def _square(value: Expr) -> Expr:
    return ufl.inner(value, value)


def bubble(uh: Function, a: ufl.Form | Form, L: ufl.Form | Form) -> Floats:
    """Return the bubble indicators: the energy norms of the error's projections onto four bubble functions a cell.

    In each cell, for all components together, the local problem for a combination z of bubbles is

        a(z, b) = L(b) - a(uh, b)    for all bubbles b of the cell,        eta^2 = |a(z, z)|,

    the problem that uh solves, as it was written, with its quadrature. Bubbles are the bicubic Bernstein polynomials of
    the cell that vanish on its edges: they are continuous, but not in the space, which is smoother. An irregular cell
    has four as well, over all its pieces.

    If a is symmetric and positive definite, eta is at most the energy norm of the error in the cell, up to quadrature;
    what it misses is the part of the error that lives on the edges. It is an indicator for second-order equations
    in a coercive form: of a pure advection a(z, z) is zero.

    Args:
        uh: The approximation; the indicators belong to its cells.
        a: Bilinear form in trial and test functions of the space of uh.
        L: Linear form in a test function of that space. Bubbles do not see integrals over edges.

    Returns:
        Shape (cells.num_owned,), those of the cells that this rank owns.

    Raises:
        ValueError: If forms and uh have different spaces, functions on finer cells, or second derivatives of the test
            function; or the local problem of a cell has no solution.
    """
    V, a, L = uh.function_space, form(a), form(L)
    _check_problem(V, a, L)
    squares = np.abs(bubble_energies(a, L, uh))
    _check_solved(V, np.flatnonzero(np.isinf(squares)))
    return np.sqrt(squares)


def _check_solved(V: FunctionSpace, singular: npt.NDArray[np.integer]) -> None:
    numbers = V.cells.partition.cells.numbers[singular]
    found = gathered(V.mesh.comm, np.stack([numbers, V.cells.face[singular]], axis=1))
    if found.size:
        cell, face = found[np.argmin(found[:, 0])]
        raise ValueError(
            f"the local problems of {len(found)} cells have no solution, the first that of cell {cell} on "
            f"face {face} of the control mesh: L has an integral there, or one of a component, "
            f"that a has none of, or the coefficients of a are zero"
        )


def _check_problem(V: FunctionSpace, a: Form, L: Form) -> None:
    if (a.rank, L.rank) != (2, 1):
        raise ValueError(f"a and L have {a.rank} and {L.rank} arguments; the bilinear form has 2, the linear form 1")
    if any(space != V for space in (*a.spaces, *L.spaces)):
        raise ValueError(
            f"uh is in {V}, but the arguments of a are in {a.spaces[1]} and {a.spaces[0]} and that of L in "
            f"{L.spaces[0]}: give the forms that uh solves, with TrialFunction(V) and TestFunction(V) of its space"
        )
    for given in (a, L):
        if not given.hierarchy.same_as(V.hierarchy):
            raise ValueError("a or L has functions on a refinement of the cells that indicators are wanted for")
        if given.orders[0] > 1:
            raise ValueError(
                "a or L has second derivatives of the test function, but bubbles are not smooth enough across edges "
                'for fourth-order equations: see "Estimating the error" in docs/fourth_order.md for residuals weighted '
                "piece by piece"
            )


def norm(V: FunctionSpace, eta: Floats) -> float:
    """Return the root of the sum of the squared indicators, over all ranks; collective."""
    return float(np.sqrt(total(V.mesh.comm, np.sum(np.asarray(eta) ** 2))))


def _tangential(V: FunctionSpace, gradient: Expr) -> Expr:
    """Return the part of a gradient that is tangential to the surface.

    That of a THCCS function is tangential already, but UFL's gradient of an expression in the spatial coordinate is the
    one in space: on a surface the difference of the two has a normal part, which has nothing to do with the error.
    """
    if V.mesh.gdim == 2:
        return gradient
    domain = V.mesh.ufl_domain()
    return ufl.dot(gradient, ufl.Jacobian(domain) * ufl.JacobianInverse(domain))  # J times its pseudo-inverse


def _over_cells(V: FunctionSpace, density: Expr, measure: ufl.Measure = ufl.dx) -> Floats:
    """Return the integral of a density over each cell of V, or its edges, shape (cells.num_owned,).

    Raises:
        ValueError: If the density has functions on finer cells than those of V.
    """
    compiled = form(density * measure(domain=V.mesh.ufl_domain()), quadrature_degree=QUADRATURE_DEGREE, on=V)
    if compiled.cells is not V.integration_cells:
        raise ValueError("the expression has functions on a refinement of the cells that indicators are wanted for")
    return assemble_cells(compiled)
