"""The residual of the strong form in each cell."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

import ufl
from thccs_fem.estimate.indicators import check_function, over_cells
from thccs_fem.fem.function import Function, cell_sizes
from thccs_fem.fem.space import FunctionSpace

__all__ = ["residual"]

Floats = npt.NDArray[np.float64]
Expr = ufl.core.expr.Expr
Conditions = Expr | Mapping[int, Expr] | None


@dataclass(frozen=True)
class _Weights:
    """What the squares of residuals are multiplied by, as powers of h: see `residual`.

    Attributes:
        strong: Factor of the strong residual; the power of h is the order of the equation.
        flux: Factor of residuals of one derivative less, the power likewise.
        moment: Factor of residuals of two derivatives less than these, of power 1.
        of_piece: Exponent with which the size of the piece enters h, the rest is that of the cell.
    """

    strong: float
    flux: float
    moment: float
    of_piece: float


# Of cubic splines on a line with knots 1 apart. The error of a solution with a smooth u'''' is a Bernoulli polynomial
# in each cell: u' is wrong by u'''' B_3 / 6 and u'' by u'''' B_2 / 2, which is the residual of -u'' = f, and the jumps
# of u''' are u''''. Where u' or u'' itself jumps by 1, it is that far from quadratic and linear splines, squared.
_OF_ORDER = {
    2: _Weights(strong=1 / 42, flux=0.0749, moment=0.0, of_piece=0.5),
    4: _Weights(strong=1 / 720, flux=1 / 720, moment=0.1443, of_piece=1.0),
}


def residual(
    uh: Function,
    strong_residual: Expr,
    neumann: Conditions = None,
    flux: Expr | None = None,
    *,
    order: int = 2,
    moment: Conditions = None,
    moments: Expr | None = None,
    stiffness: Expr | float = 1.0,
    reaction: Expr | float = 0.0,
) -> Floats:
    """Return the residual indicators of a problem of second or fourth order, linear or not.

    With K the cell, sums over its edges on the boundary and inside, and norms in L2,

        order 2:  eta^2 = (h^2 |strong residual|_K^2 + 3.1 h |flux condition|^2 + 1.6 h |jump of the flux|^2) / 42
        order 4:  eta^2 = (h^4 |strong residual|_K^2 + h^3 |flux condition|^2 + 0.5 h^3 |jump of the flux|^2
                           + 104 h |moment condition|^2 + 52 h |jump of the moment|^2) / 720

    They estimate the error of grad(u), and of grad(grad(u)): the factors are those for which this would be exact on
    a line. Two examples, -div(kappa grad(u)) = f with kappa grad(u).n = g on the edges tagged 2, and a plate that is
    simply supported there, in the notation of `thccs_fem.forms.plate` ::

        n, sigma = ufl.FacetNormal(msh), kappa * grad(uh)
        estimate.residual(uh, f + div(sigma), {2: g - dot(sigma, n)}, sigma)

        m = plate.moments(uh, D, nu)
        estimate.residual(uh, f - div(div(m)), flux=div(m), order=4, moment={2: dot(dot(m, n), n)})

    Where kappa is smooth the flux of a second-order problem jumps only at the bicubic caps of extraordinary vertices,
    along the edges that leave these: jumps are small there, and `flux` may be left out. Where kappa jumps it may not.
    That of a fourth-order problem has third derivatives, which jump across all edges: give it, as there are errors
    that are seen nowhere else, as that of u = x^4 - y^4.

    h is the root of the area of K, unless K consists of several pieces. At order 4 it is the size of the piece, the
    root of |det J| at each point: near an extraordinary vertex fourth derivatives are not square-integrable. Nor are
    second ones at a reentrant corner: at order 2 it is the geometric mean of both sizes. So indicators do not grow with
    the level of the caps. (Where solutions are smooth they get smaller with it, to a third at a vertex of valence 8.)

    Where `reaction` c is large an error reaches no farther than the length (stiffness / c)^(1 / order), and h^p / F, F
    the factor of the term, is to be read as 1 / (F / h^p + (c / stiffness)^(p / order)). So the energy norm is
    estimated, grad(u) with the weight kappa and u with c, however small kappa is (Verfürth, Robust a posteriori
    error estimators for a singularly perturbed reaction-diffusion equation, Numer. Math. 78 (1998), 479-493).

    Args:
        uh: The approximation; the indicators belong to its cells.
        strong_residual: UFL expression in uh, e.g. f + div(grad(uh)), of a nonlinear problem likewise.
        neumann: Likewise the residual of a condition on the flux, where no values are prescribed: on all of the
            boundary, or one for each edge tag.
        flux: The vector (of a system: the tensor) whose normal part must not jump; at order 4 div(m), m the moments.
        order: That of the equation: 2, or 4.
        moment: Residual of a condition on the moment, at order 4, where no slopes are prescribed; as `neumann`.
        moments: The tensor whose normal part in both indices must not jump, at order 4: where the stiffness does.
        stiffness: What the flux is of the gradient (at order 4 the moment of the second derivatives), kappa or D, by
            which the squares are divided: then energy norms are estimated. Else residuals should be divided by it.
        reaction: Coefficient c of a term c u in the equation, not negative.

    Returns:
        Shape (cells.num_owned,), those of the cells that this rank owns.

    Raises:
        TypeError: If uh is no function, or the strong residual no expression.
        ValueError: If an expression has functions on finer cells, an edge tag is unknown, the order is neither 2 nor 4,
            or there are moments at order 2, or stiffness or reaction is a number out of range.
    """
    if order not in _OF_ORDER:
        raise ValueError(f"order is {order!r}; residuals of equations of order 2 and 4 are known")
    if order == 2 and not (moment is None and moments is None):
        raise ValueError("moment or moments are given, but the order is 2: of plates and shells it is order=4")
    check_function(uh)
    _check_values(strong_residual, stiffness, reaction)
    V, weights = uh.function_space, _OF_ORDER[order]
    n = ufl.FacetNormal(V.mesh.ufl_domain())
    terms = [(strong_residual, weights.strong, order, ufl.dx)]
    terms += [(value, weights.flux, order - 1, ds) for value, ds in _on_boundary(neumann)]
    terms += [(value, weights.moment, 1, ds) for value, ds in _on_boundary(moment)]
    if flux is not None:
        terms.append((ufl.jump(flux, n), weights.flux, order - 1, ufl.dS))
    if moments is not None:
        across = ufl.inner(moments, ufl.outer(n, n))
        terms.append((across("+") - across("-"), weights.moment, 1, ufl.dS))
    sizes = [ufl.as_ufl(size) for size in (_size(V, weights.of_piece), stiffness, reaction)]
    integrals = ufl.Form([])
    for value, factor, power, over in terms:
        h, k, c = (ufl.avg(size) for size in sizes) if over.integral_type() == "interior_facet" else sizes
        weight = 1 / (k / (factor * h**power) + k * (c / k) ** (power / order))
        integrals += weight * ufl.inner(value, value) * over(domain=V.mesh.ufl_domain())
    return np.sqrt(np.maximum(over_cells(V, integrals), 0.0))


def _check_values(strong_residual: object, stiffness: object, reaction: object) -> None:
    if not isinstance(strong_residual, Expr | float | int):
        kind = type(strong_residual).__name__
        raise TypeError(f"the strong residual is of type {kind}: give an expression, such as f + div(grad(uh))")
    if isinstance(stiffness, float | int) and not stiffness > 0.0:
        raise ValueError(f"stiffness is {stiffness}; it must be positive, as squares are divided by it")
    if isinstance(reaction, float | int) and not reaction >= 0.0:
        raise ValueError(f"reaction is {reaction}; it must not be negative: leave out what is not coercive")


def _on_boundary(conditions: Conditions) -> Iterator[tuple[Expr, ufl.Measure]]:
    """Yield the residuals of conditions, and what each is integrated over."""
    if isinstance(conditions, Mapping):
        yield from ((condition, ufl.ds(tag)) for tag, condition in conditions.items())
    elif conditions is not None:
        yield conditions, ufl.ds


def _size(V: FunctionSpace, of_piece: float) -> Expr:
    """Return h, the size of the piece to a power and that of the cell to the rest of it."""
    if V.integration_cells.quadrature_degree is not None:  # pieces are points, which have no size
        return cell_sizes(V)
    size = ufl.sqrt(ufl.algebra.Abs(ufl.JacobianDeterminant(V.mesh.ufl_domain())))
    return size if of_piece == 1.0 else size**of_piece * cell_sizes(V) ** (1.0 - of_piece)
