"""L2 projection into a space, which is what splines have in place of interpolation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal
from weakref import WeakKeyDictionary, ref

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

import basix
import ufl
from thccs_fem import element
from thccs_fem.extraction import Cells
from thccs_fem.fem.assembly import assemble_cells, assemble_matrix, assemble_vector
from thccs_fem.fem.expression import ValueOrExpression, values_at
from thccs_fem.fem.forms import form
from thccs_fem.fem.function import Constant, Function
from thccs_fem.fem.scipy.linear import conjugate_gradients, solver
from thccs_fem.fem.space import CellwiseSpace, FunctionSpace, check_space
from thccs_fem.hierarchy import Hierarchy

__all__ = ["Projection", "project", "projector"]

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]
Norm = Literal["L2", "H1"]
Rule = Callable[[Hierarchy], Cells]

DEGREE = 11  # of the quadrature, 6 x 6 points: the same on both sides, so that functions of V stay what they are
TOLERANCE = 1e-13  # mass matrices are scaled by their diagonal: 100 to 300 iterations on any mesh and refinement


def project(value: ValueOrExpression, V: FunctionSpace | CellwiseSpace) -> Function:
    """Return the L2 projection: of all functions of V the one nearest to a value, in the L2 norm over the surface.

    In a space of functions that are constant on cells it has the mean of the value on each.

    Args:
        value: UFL expression in the spatial coordinate, constants and functions (of V, or of refinements or coarsenings
            of it); or g(x) with x of shape (3, m) (the last row is zero in the plane), which returns shape (m,), or
            (k, m) for k components; or a number, or one for each component.
        V: The space.

    Raises:
        TypeError: The value is none of these, or V is no space.
        ValueError: The value has another shape than the functions of V, or is not finite somewhere.
    """
    if isinstance(V, CellwiseSpace):
        return _cell_means(value, V)
    check_space(V, "project")
    if callable(value) and not isinstance(value, ufl.core.expr.Expr):
        load, scalar = _load_at_points(value, V), FunctionSpace(V.hierarchy)
    else:
        load, scalar = _load(_as_ufl(value, V), V), FunctionSpace(V.hierarchy, (), V.integration)
    _check_finite(load)
    mass = assemble_matrix(
        form(ufl.inner(ufl.TrialFunction(scalar), ufl.TestFunction(scalar)) * ufl.dx, quadrature_degree=DEGREE)
    )
    result = Function(V)
    components = [conjugate_gradients(mass, b, TOLERANCE) for b in load.T]
    result.x.array = np.stack(components, axis=1).ravel()
    return result


class Projection:
    """The projection from one space to another, all integrals being over the cells of a refinement of both.

    With G the inner products of the functions of `common`, and P and Q the prolongations to it from the target and from
    the source, P^T G P x = P^T G Q u. Constants lie in all three spaces, so that either norm keeps the integral of u
    (over these cells). What the solver leaves of the residual against constants, a constant takes away.

    Args:
        common: Scalar space that refines both.
        source: Where functions are.
        target: Where they are wanted.
        norm: "L2": (x, v). "H1": (x, v) + (grad x, grad v).
    """

    def __init__(self, common: FunctionSpace, source: Hierarchy, target: Hierarchy, norm: Norm):
        trial, test = ufl.TrialFunction(common), ufl.TestFunction(common)
        product = ufl.inner(trial, test)
        if norm == "H1":
            product += ufl.inner(ufl.grad(trial), ufl.grad(test))
        G = assemble_matrix(form(product * ufl.dx, quadrature_degree=DEGREE))
        P, self._from_source = (common.hierarchy.prolongation(hierarchy) for hierarchy in (target, source))
        self._to_target = sp.csr_array(P.T @ G)
        self._matrix = sp.csr_array(self._to_target @ P)
        self._solve = solver(self._matrix, TOLERANCE)

    def __call__(self, values: Floats) -> Floats:
        """Return the coefficients of the projections of functions, one in each column."""
        load = self._to_target @ (self._from_source @ values)
        x = self._solve(load)
        return x + (load - self._matrix @ x).sum(axis=0) / self._matrix.sum()


# The last projection from each hierarchy, for as long as that lives: several functions are carried over at once, but
# one after the other.
_last: WeakKeyDictionary[Hierarchy, tuple[ref[Hierarchy], Rule, Norm, Projection]] = WeakKeyDictionary()


def projector(source: Hierarchy, V: FunctionSpace, norm: Norm) -> Projection:
    """Return the projection from a hierarchy to that of V; the same one if asked for again.

    Args:
        source: Where functions are.
        V: The space where they are wanted; its rule of integration is used.
        norm: "L2" or "H1".

    Raises:
        ValueError: They have no common refinement.
    """
    target, rule = V.hierarchy, V.integration
    if source in _last:
        known, *key, found = _last[source]
        if known() is target and key == [rule, norm]:
            return found
    made = Projection(FunctionSpace(target.common_refinement(source), (), rule), source, target, norm)
    _last[source] = ref(target), rule, norm, made
    return made


def _check_finite(integrals: Floats) -> None:
    if not np.isfinite(integrals).all():
        raise ValueError("the value is not finite everywhere on the surface: give one that is")


def _as_ufl(value: object, V: FunctionSpace | CellwiseSpace) -> ufl.core.expr.Expr:
    """Return a value as an expression with the shape of functions in V."""
    if not isinstance(value, ufl.core.expr.Expr):
        value = _as_constant(value, V)
    if value.ufl_shape != V.value_shape:
        raise ValueError(
            f"a value of shape {value.ufl_shape} cannot be projected on functions of shape {V.value_shape}"
        )
    return value


def _as_constant(value: object, V: FunctionSpace | CellwiseSpace) -> Constant:
    try:
        numbers = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise TypeError(
            f"a {type(value).__name__} cannot be projected: give a UFL expression, a function g(x), or numbers"
        ) from error
    return Constant(V.mesh, numbers)


def _load(value: ufl.core.expr.Expr, V: FunctionSpace) -> Floats:
    """Return the integrals of the value times each function, shape (num_functions, block_size)."""
    if isinstance(value, ufl.classes.Zero):
        return np.zeros((V.num_functions, V.block_size))
    L = form(ufl.inner(value, ufl.TestFunction(V)) * ufl.dx, quadrature_degree=DEGREE)
    return assemble_vector(L).reshape(-1, V.block_size)


def _load_at_points(value: ValueOrExpression, V: FunctionSpace) -> Floats:
    """Return the same for g(x)."""
    pieces, points, areas = _quadrature(V.cells)
    values = values_at(value, V, pieces, points, V.block_size) * areas[:, :, None]
    local = np.einsum("qi,pqc->pic", element.bicubic_values(points), values).reshape(-1, V.block_size)
    return V.cells.rows(pieces).T @ local


def _quadrature(cells: Cells) -> tuple[Ints, Floats, Floats]:
    """Return all pieces, the points of the rule, shape (q, 2), and the area that each stands for, (num_pieces, q)."""
    pieces = np.arange(cells.num_pieces, dtype=np.int32)
    points, weights = (np.asarray(a) for a in basix.make_quadrature(basix.CellType.quadrilateral, DEGREE))
    return pieces, points, cells.area_element(pieces, points) * weights


def _cell_means(value: ValueOrExpression, V: CellwiseSpace) -> Function:
    if callable(value) and not isinstance(value, ufl.core.expr.Expr):
        pieces, points, areas = _quadrature(V.cells)
        values = values_at(value, FunctionSpace(V.cells.hierarchy), pieces, points, V.block_size)
        integrals = np.einsum("pqc,pq->cp", values, areas)
        means = [_means(V, V.cells, V.cells.piece_cell, component) for component in integrals]
    else:
        means = [_mean(density, V) for density in _components(_as_ufl(value, V))]
    result = Function(V)
    result.x.array = np.stack(means, axis=1).ravel()
    return result


def _components(value: ufl.core.expr.Expr) -> list[ufl.core.expr.Expr]:
    return [value[c] for c in range(value.ufl_shape[0])] if value.ufl_shape else [value]


def _mean(density: ufl.core.expr.Expr, V: CellwiseSpace) -> Floats:
    """Return the mean of a scalar on each face or cell, integrated on the cells of the finest function in it."""
    if isinstance(density, ufl.classes.Zero):
        return np.zeros(V.num_cells)
    on = None if V.hierarchy is None else FunctionSpace(V.hierarchy)
    compiled = form(density * ufl.dx(domain=V.mesh.ufl_domain()), quadrature_degree=DEGREE, on=on)
    return _means(V, compiled.cells, np.arange(compiled.cells.num_cells), assemble_cells(compiled))


def _means(V: CellwiseSpace, cells: Cells, of_cells: npt.NDArray[np.integer], integrals: Floats) -> Floats:
    """Return sums of integrals over given cells, or parts of them, divided by the area of the face or cell of V."""
    _check_finite(integrals)
    number = V.numbers_of(cells)
    areas = _quadrature(cells)[2].sum(axis=1)
    sums, area = (
        np.bincount(number[part], weights=weights, minlength=V.num_cells)
        for part, weights in ((of_cells, integrals), (cells.piece_cell, areas))
    )
    return sums / area
