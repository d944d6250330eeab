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
from thccs_fem.fem.mass import conjugate_gradients, is_small, solved, whole
from thccs_fem.fem.scipy.linear import solver
from thccs_fem.fem.space import CellwiseSpace, FunctionSpace, check_space
from thccs_fem.hierarchy import Hierarchy
from thccs_fem.index_map import Fetch
from thccs_fem.parallel import together, total
from thccs_fem.prolongation import Prolongation

__all__ = ["Projection", "project", "projector"]

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]
Norm = Literal["L2", "H1"]
Rule = Callable[[Hierarchy], Cells]

DEGREE = 11  # of the quadrature, 6 x 6 points: the same on both sides, so that functions of V stay what they are
TOLERANCE = 1e-13  # where a matrix that is made is too large to be factorised


def project(value: ValueOrExpression, V: FunctionSpace | CellwiseSpace) -> Function:
    """Return the L2 projection: of all functions of V the one nearest to a value, in the L2 norm; collective.

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
    owned = load[: V.index_map.size_local]
    together(V.mesh.comm, lambda: _check_finite(owned))
    mass = assemble_matrix(
        form(ufl.inner(ufl.TrialFunction(scalar), ufl.TestFunction(scalar)) * ufl.dx, quadrature_degree=DEGREE)
    )
    result = Function(V)
    result.x.array[: V.num_owned_dofs] = solved(mass, owned, V.index_map).ravel()
    result.x.scatter_forward()
    return result


class Projection:
    """The projection from one space to another, all integrals being over the cells of a refinement of both.

    With G the inner products of the functions of `common`, and P and Q the prolongations to it from the target and from
    the source, P^T G P x = P^T G Q u. Constants lie in all three spaces, so that either norm keeps the integral of u
    (over these cells). What the solver leaves of the residual against constants, a constant takes away.

    Making one is collective, and so is its use. Where spaces on several ranks, which have different parts of the three,
    are large, P^T G P is not made but applied.

    Args:
        common: Scalar space that refines both.
        source: Where functions are.
        target: Where they are wanted.
        norm: "L2": (x, v). "H1": (x, v) + (grad x, grad v).
    """

    def __init__(self, common: FunctionSpace, source: Hierarchy, target: Hierarchy, norm: Norm):
        trial, test = ufl.TrialFunction(common), ufl.TestFunction(common)
        inner = ufl.inner(trial, test)
        if norm == "H1":
            inner += ufl.inner(ufl.grad(trial), ufl.grad(test))
        self._comm, self._functions = common.mesh.comm, FunctionSpace(target).index_map
        self._gram = assemble_matrix(form(inner * ufl.dx, quadrature_degree=DEGREE))
        self._from_target, self._from_source = (Prolongation(common.hierarchy, coarse) for coarse in (target, source))
        self._solve = self._factorised() if is_small(self._functions) else self._iterated(self._diagonal())
        self._area = total(self._comm, self._applied(np.ones((self._functions.numbers.size, 1))).sum())

    def __call__(self, values: Floats) -> Floats:
        """Return the coefficients of the projections of functions, one in each column, shape (local, k), collective."""
        load = self._tested(self._from_source(values))
        x = self._solve(load)
        x += total(self._comm, (load - self._applied(x)).sum(axis=0)) / self._area
        result = np.zeros((self._functions.numbers.size, x.shape[1]))
        result[: len(x)] = x
        self._functions.scatter_forward(result)
        return result

    def _tested(self, values: Floats) -> Floats:
        """Return the inner products of functions in the common space with those that this rank owns of the target."""
        return self._from_target.transposed(self._gram @ values)[: self._functions.size_local]

    def _applied(self, x: Floats) -> Floats:
        """Return P^T G P x, owned parts both."""
        return self._tested(self._from_target(x))

    def _factorised(self) -> Callable[[Floats], Floats]:
        """Return what solves the equations by the whole matrix, on each rank."""
        P, wanted, functions = self._from_target.matrix, self._from_target.wanted, self._functions
        matrix = sp.csr_array(sp.csr_array(P[: self._gram.shape[0]].T @ self._gram) @ P)
        if functions.is_whole:
            return solver(matrix, TOLERANCE)
        solve, owned = (
            solver(whole(matrix, wanted, wanted, functions), TOLERANCE),
            functions.numbers[: functions.size_local],
        )
        return lambda load: solve(functions.gather(load))[owned]

    def _iterated(self, diagonal: Floats) -> Callable[[Floats], Floats]:
        """Return what solves them by applying it."""
        return lambda load: conjugate_gradients(self._applied, diagonal, load, self._comm)

    def _diagonal(self) -> Floats:
        """Return the diagonal of P^T G P, owned part."""
        P = self._from_target.matrix
        entries = P[: self._gram.shape[0]] * (self._gram @ P)
        return self._from_target.gathered(entries.sum(axis=0))[: self._functions.size_local]


# The last projection from each hierarchy, for as long as that lives: several functions are carried over at once, but
# one after the other.
_last: WeakKeyDictionary[Hierarchy, tuple[ref[Hierarchy], Rule, Norm, Projection]] = WeakKeyDictionary()


def projector(source: Hierarchy, V: FunctionSpace, norm: Norm) -> Projection:
    """Return the projection from a hierarchy to that of V; the same one if asked for again. Collective.

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
    """Return the integrals of the value times each function, shape (local, block_size), right where owned."""
    if isinstance(value, ufl.classes.Zero):
        return np.zeros((V.index_map.numbers.size, V.block_size))
    L = form(ufl.inner(value, ufl.TestFunction(V)) * ufl.dx, quadrature_degree=DEGREE)
    return assemble_vector(L).reshape(-1, V.block_size)


def _load_at_points(value: ValueOrExpression, V: FunctionSpace) -> Floats:
    """Return the same for g(x)."""
    pieces, points, areas = _quadrature(V.cells)
    values = values_at(value, V, pieces, points, V.block_size) * areas[:, :, None]
    local = np.einsum("qi,pqc->pic", element.bicubic_values(points), values).reshape(-1, V.block_size)
    return V.cells.rows(pieces).T @ local


def _quadrature(cells: Cells) -> tuple[Ints, Floats, Floats]:
    """Return all local pieces, the points of the rule, shape (q, 2), and the area that each stands for, (pieces, q)."""
    pieces = np.arange(cells.num_pieces, dtype=np.int32)
    points, weights = (np.asarray(a) for a in basix.make_quadrature(basix.CellType.quadrilateral, DEGREE))
    return pieces, points, cells.area_element(pieces, points) * weights


def _cell_means(value: ValueOrExpression, V: CellwiseSpace) -> Function:
    if callable(value) and not isinstance(value, ufl.core.expr.Expr):
        cells = V.cells
        pieces, points, areas = _quadrature(cells)
        values = values_at(value, FunctionSpace(cells.hierarchy), pieces, points, V.block_size)
        integrals = np.einsum("pqc,pq->cp", values, areas)
        of_cells = [np.bincount(cells.piece_cell, weights=w, minlength=cells.num_cells) for w in integrals]
        means = [_means(V, cells, component[: cells.num_owned]) for component in of_cells]
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
        return np.zeros(V.index_map.numbers.size)
    on = None if V.hierarchy is None else FunctionSpace(V.hierarchy)
    compiled = form(density * ufl.dx(domain=V.mesh.ufl_domain()), quadrature_degree=DEGREE, on=on)
    return _means(V, compiled.cells, assemble_cells(compiled))


def _means(V: CellwiseSpace, cells: Cells, integrals: Floats) -> Floats:
    """Return sums of integrals over cells, shape (cells.num_owned,), divided by the area of the face or cell of V."""
    comm, own = V.mesh.comm, cells.num_owned
    together(comm, lambda: _check_finite(integrals))
    numbers = together(comm, lambda: V.numbers_of(cells))[:own]
    areas = np.bincount(cells.piece_cell, weights=_quadrature(cells)[2].sum(axis=1), minlength=own)[:own]
    sums = np.zeros((V.index_map.numbers.size, 2))
    Fetch(V.index_map, numbers).add_back(np.stack([integrals, areas], axis=1), sums)
    if V.hierarchy is None:  # all ranks hold all faces, and cells of some
        sums = total(comm, sums)
    V.index_map.scatter_forward(sums)
    return np.asarray(sums[:, 0] / sums[:, 1])
