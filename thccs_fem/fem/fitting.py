"""Coefficients of given functions that fit an expression, which is what conditions have in place of interpolation.

No spline interpolates: an expression is projected, in L2 of the boundary edges that the given functions determine, or
of the cells if not all of them reach the boundary. Value and slope are fitted on the boundary together.

On several ranks each evaluates on the cells that it owns; then all of them have all of that, in the order of the
hierarchy, and solve the same equations.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
import scipy.sparse.linalg as spla

import ufl
from thccs_fem import element
from thccs_fem.extraction import Cells
from thccs_fem.fem.expression import ValueOrExpression, values_at
from thccs_fem.fem.space import FunctionSpace
from thccs_fem.parallel import gathered
from thccs_fem.positions import side_points
from thccs_fem.sparse import csr, product, restricted, rows_of, transposed, without_rounding
from thccs_fem.subdivision import Bools, Ints

__all__ = ["boundary_rows", "fitted"]

NONZERO = 1e-10  # extraction entries are 0 up to rounding or a good part of 1 in some piece of the cell
AROUND = 1e-6  # weight of a value around the part that is prescribed, against 1 in it
RIDGE = 1e-13  # makes regular what is determined nowhere; no more than rounding elsewhere
NUM_GAUSS = 8  # points in each direction: exact for straight pieces, far below the error of the space for others
SIDES = np.array([[0, 1, 2, 3], [3, 7, 11, 15], [15, 14, 13, 12], [12, 8, 4, 0]])  # coefficients i + 4 j on each side
INWARD = np.array([4, -1, -4, 1])  # from these to the next row inside

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.integer]


def fitted(V: FunctionSpace, functions: Indices, value: ValueOrExpression, k: int, slope: bool) -> Floats:
    """Return the coefficients of the L2 projection of an expression on functions; collective.

    What is fitted by least squares is the value (and the slope) on the part of the boundary or of the surface that the
    given functions determine, together with all other functions there, and, with a small weight, the value around it:
    functions that hardly reach into the part, or that others can stand in for there, are determined by that.

    Args:
        V: The space.
        functions: Function numbers, ascending, shape (n,), local, ghosts included.
        value: UFL expression, or callable g(x) with x of shape (3, m).
        k: Number of its components.
        slope: Whether the slope on the boundary is fitted as well.

    Returns:
        Shape (n, k).

    Raises:
        TypeError: The slope of something without gradient is wanted.
        ValueError: The value has another shape, or is not finite where the functions determine it; or the slope is
            wanted for functions that have neither value nor slope on the boundary.
    """
    numbers = V.index_map.numbers[functions]
    given = np.unique(gathered(V.mesh.comm, numbers))
    if not given.size:
        return np.zeros((0, k))
    if slope:
        parts = [_value_and_slope(V, given, value, k), _on_cells(V, given, value, k, is_around=True)]
    else:
        parts = [_on_boundary(V, given, value, k) or _on_cells(V, given, value, k)]
    mass, load = parts[0].equations()
    for part in parts[1:]:
        more_mass, more_load = part.equations()
        mass, load = mass + more_mass, load + more_load
    present = np.flatnonzero(mass.diagonal() > 0.0)
    mass, load = restricted(mass, present, present), load[present]
    is_diagonal = np.repeat(np.arange(present.size), np.diff(mass.indptr)) == mass.indices
    regular = np.where(is_diagonal, (1.0 + RIDGE) * mass.data, mass.data)
    factors = spla.splu(sp.csc_array((regular, mass.indices, mass.indptr), shape=mass.shape))  # of the transposed
    fitted = factors.solve(load, "T")
    fitted += factors.solve(load - mass @ fitted, "T")  # takes back what RIDGE has changed
    return fitted[np.searchsorted(present, numbers)]


@dataclass(frozen=True, eq=False)
class _Part:
    """Values at points of n sides or pieces, in each of which there are m local functions.

    Attributes:
        keys: What orders the sides or pieces, shape (n,).
        rows: Local coefficients of all functions, shape (n m, num_functions).
        basis: Local functions at the points, shape (n, points, m), or (points, m) if they are the same in all.
        weights: Weights of the points, shape (n, points).
        values: What is to be fitted there, shape (n, points, k).
        is_inside: Whether the given functions alone determine it; else it is around what is prescribed, shape (n,).
    """

    keys: npt.NDArray[np.int64]
    rows: sp.csr_array
    basis: Floats
    weights: Floats
    values: Floats
    is_inside: Bools

    def equations(self) -> tuple[sp.csr_array, Floats]:
        """Return matrix and right-hand side of the least squares, of all functions.

        Raises:
            ValueError: A value is not finite inside.
        """
        is_finite = np.isfinite(self.values).all(axis=2, keepdims=True)  # around the part, it need not be defined
        bad = np.count_nonzero(~is_finite.all(axis=(1, 2)) & self.is_inside)
        if bad:
            raise ValueError(
                f"the value is not finite on {bad} of the {np.count_nonzero(self.is_inside)} edges or patches of "
                f"surface that the dofs determine: prescribe finite values"
            )
        weights = self.weights * np.where(self.is_inside, 1.0, AROUND)[:, None]
        weighted = (np.where(is_finite, weights[:, :, None], 0.0) * self.basis).swapaxes(1, 2)
        mass, load = weighted @ self.basis, weighted @ np.where(is_finite, self.values, 0.0)
        n, m, _ = mass.shape
        columns = np.repeat(np.arange(n * m, dtype=np.int32).reshape(n, m), m, axis=0)
        blocks = csr(mass.ravel(), columns.ravel(), m * np.arange(n * m + 1, dtype=np.int32), (n * m, n * m))
        to_functions = transposed(self.rows)
        return product(to_functions, product(blocks, self.rows)), to_functions @ load.reshape(n * m, -1)


def _of_all_ranks(V: FunctionSpace, part: _Part) -> _Part:
    """Return a part with local functions in its rows as that of all ranks, the same on each, in the order of its keys.

    So sums over it are those of a serial run to the last bit, which matters where functions are hardly determined.
    """
    comm, functions = V.mesh.comm, V.index_map
    keys = gathered(comm, part.keys)
    order = np.argsort(keys)
    sizes, indices, data = (
        gathered(comm, array)
        for array in (np.diff(part.rows.indptr), functions.numbers[part.rows.indices], part.rows.data)
    )
    indptr = np.append(0, np.cumsum(sizes)).astype(np.int32)
    rows = csr(data, indices.astype(np.int32, copy=False), indptr, (sizes.size, functions.size_global))
    height = part.basis.shape[-1]
    basis = part.basis if part.basis.ndim == 2 else gathered(comm, part.basis)[order]
    weights, values = (gathered(comm, array)[order] for array in (part.weights, part.values))
    is_inside = gathered(comm, part.is_inside)[order]
    return _Part(keys[order], _rows_of(rows, order, height), basis, weights, values, is_inside)


def _on_boundary(V: FunctionSpace, given: Indices, value: ValueOrExpression, k: int) -> _Part | None:
    """Return the values at Gauss points of the boundary; None if a function has no trace there."""
    piece, side, rows = _own_sides(V.cells, depth=1)
    if _without_rows(V, given, rows).size:
        return None
    chosen, is_inside = _blocks(V, rows, given, 4)
    sides = _Sides(V, piece[chosen], side[chosen])
    values = sides.values_of(value, k)
    basis = element.bernstein_values(sides.t)
    return _of_all_ranks(V, _Part(sides.keys, _rows_of(rows, chosen, 4), basis, sides.lengths, values, is_inside))


def _value_and_slope(V: FunctionSpace, given: Indices, value: ValueOrExpression, k: int) -> _Part:
    """Return the values at Gauss points of the boundary, then h times the slopes there.

    h is the width of the piece across the boundary, so that values and slopes weigh alike at every size of the cells.

    Raises:
        TypeError: If the value is no UFL expression, which alone can be differentiated.
        ValueError: If a function has neither value nor slope on the boundary.
    """
    if not isinstance(value, ufl.core.expr.Expr):
        raise TypeError(f"slope=True needs a UFL expression, whose gradient is known, got {type(value).__name__}")
    piece, side, rows = _own_sides(V.cells, depth=2)
    inside = _without_rows(V, given, rows)
    if inside.size:
        raise ValueError(
            f"{inside.size} of the {given.size} dofs have neither value nor slope on the boundary, the first is "
            f"{inside[0]}: slope=True is for dofs of boundary_dofs(V, slope=True)"
        )
    chosen, is_inside = _blocks(V, rows, given, 8)
    sides = _Sides(V, piece[chosen], side[chosen])
    values = sides.values_of(value, k)
    gradients = sides.values_of(ufl.grad(value), k * V.mesh.gdim).reshape(*values.shape, V.mesh.gdim)
    slopes = np.einsum("nqkc,nqc->nqk", gradients, sides.across)
    both = np.concatenate([values, slopes], axis=1)
    weights = np.tile(sides.lengths, 2)
    return _of_all_ranks(
        V, _Part(sides.keys, _rows_of(rows, chosen, 8), sides.value_and_slope(), weights, both, is_inside)
    )


def _on_cells(V: FunctionSpace, given: Indices, value: ValueOrExpression, k: int, is_around: bool = False) -> _Part:
    """Return the values at Gauss points of the pieces that the functions live on.

    With `is_around` all of them are around what is prescribed.
    """
    cells = V.cells
    near = _own_pieces_near(V, given)
    all_rows = cells.rows(near)
    chosen, is_inside = _blocks(V, all_rows, given, 16)
    is_inside &= not is_around
    piece = near[chosen]
    t, w = _gauss()
    points = np.stack(np.meshgrid(t, t, indexing="ij"), axis=-1).reshape(-1, 2)
    weights = cells.area_element(piece, points) * np.outer(w, w).ravel()
    values = values_at(value, V, piece, points, k)
    basis = element.bicubic_values(points)
    keys = _piece_keys(cells)[piece]
    return _of_all_ranks(V, _Part(keys, _rows_of(all_rows, chosen, 16), basis, weights, values, is_inside))


def _own_sides(cells: Cells, depth: int) -> tuple[Ints, Ints, sp.csr_array]:
    """Return the pieces of this rank's own cells on the boundary, their sides there, both (n,), and `boundary_rows`."""
    piece, side, _ = cells.boundary_pieces
    own = np.flatnonzero(cells.piece_cell[piece] < cells.num_owned)
    return piece[own], side[own], _rows_of(boundary_rows(cells, depth), own, 4 * depth)


def _own_pieces_near(V: FunctionSpace, given: Indices) -> Ints:
    """Return the pieces of those of this rank's own cells on which given functions may not vanish."""
    cells = V.cells
    offsets, dofs = cells.cell_dofs
    cell = np.repeat(np.arange(cells.num_cells), np.diff(offsets))
    is_near = np.zeros(cells.num_cells, dtype=bool)
    is_near[cell[np.isin(V.index_map.numbers[dofs], given)]] = True
    is_near[cells.num_owned :] = False
    return np.flatnonzero(is_near[cells.piece_cell]).astype(np.int32)


def _piece_keys(cells: Cells) -> npt.NDArray[np.int64]:
    """Return a number for each piece by its level and face, the same on all ranks, shape (num_pieces,)."""
    keys = np.zeros(cells.num_pieces, dtype=np.int64)
    first = 0
    for piece_of_face in cells.piece_of_face:
        held = np.flatnonzero(piece_of_face >= 0)
        keys[piece_of_face[held]] = first + held
        first += piece_of_face.size
    return keys


def _without_rows(V: FunctionSpace, given: Indices, rows: sp.csr_array) -> Indices:
    """Return those of the given functions that have no entry in the rows of any rank."""
    numbers = V.index_map.numbers[np.unique(rows.indices)]
    found = gathered(V.mesh.comm, numbers[np.isin(numbers, given)])
    return given[~np.isin(given, found)]


def _blocks(V: FunctionSpace, rows: sp.csr_array, functions: Indices, height: int) -> tuple[Ints, Bools]:
    """Return the blocks of `height` rows where given functions occur, and in which of these no others do."""
    given = np.isin(V.index_map.numbers, functions)
    block = np.repeat(np.arange(rows.shape[0]) // height, np.diff(rows.indptr))
    num_given, num_foreign = (
        np.bincount(block, weights=marks[rows.indices], minlength=rows.shape[0] // height) for marks in (given, ~given)
    )
    chosen = np.flatnonzero(num_given).astype(np.int32)
    return chosen, num_foreign[chosen] == 0


def _rows_of(rows: sp.csr_array, blocks: Indices, height: int) -> sp.csr_array:
    """Return blocks of `height` rows."""
    return rows_of(rows, (height * blocks[:, None] + np.arange(height)).ravel())


# ---- Sides of pieces ----------------------------------------------------------------------------------------------


_boundary_rows: WeakKeyDictionary[Cells, dict[int, sp.csr_array]] = WeakKeyDictionary()


def boundary_rows(cells: Cells, depth: int) -> sp.csr_array:
    """Return Bernstein coefficients of all functions at the sides of pieces that are on the boundary.

    What is rounding is zero, and not stored. They are found once and kept as long as the cells are.

    Args:
        cells: The cells; their `boundary_pieces` are the n sides.
        depth: 1: the four coefficients on the side. 2: then the four of the next row inside, which make up the slope.

    Returns:
        Shape (4 depth n, num_functions).
    """
    kept = _boundary_rows.setdefault(cells, {})
    if depth not in kept:
        kept[depth] = _new_boundary_rows(cells, depth)
    return kept[depth]


def _new_boundary_rows(cells: Cells, depth: int) -> sp.csr_array:
    piece, side, _ = cells.boundary_pieces
    local = SIDES[side][:, None] + np.arange(depth)[:, None] * INWARD[side][:, None, None]
    num_rows = local.size
    columns = np.repeat(np.arange(16 * piece.size, dtype=np.int32).reshape(-1, 16), 4 * depth, axis=0)
    to_bernstein = csr(
        element.TO_BERNSTEIN[local.ravel()].ravel(),
        columns.ravel(),
        16 * np.arange(num_rows + 1, dtype=np.int32),
        (num_rows, 16 * piece.size),
    )
    return without_rounding(product(to_bernstein, cells.rows(piece)), NONZERO)


class _Sides:
    """Gauss points on sides of pieces, and the geometry there.

    Attributes:
        t: Points along a side, shape (q,).
        tangent: Derivative of the position along the side, shape (n, q, gdim).
        inward: Derivative of the position along the other parameter, shape (n, q, gdim).
    """

    def __init__(self, V: FunctionSpace, piece: Ints, side: Ints):
        self.V, self.piece, self.side = V, piece, side
        self.t, self.w = _gauss()
        control = element.TO_BERNSTEIN @ V.cells.piece_points[piece]
        first, second = (
            control[np.arange(piece.size)[:, None], SIDES[side] + j * INWARD[side][:, None]] for j in (0, 1)
        )
        self.tangent = np.einsum("qi,nic->nqc", element.bernstein_slopes(self.t), first)
        self.inward = np.einsum("qi,nic->nqc", element.bernstein_values(self.t), 3.0 * (second - first))

    @property
    def keys(self) -> npt.NDArray[np.int64]:
        """A number for each side, the same on all ranks, shape (n,)."""
        return 4 * _piece_keys(self.V.cells)[self.piece] + self.side

    @property
    def lengths(self) -> Floats:
        """Weights of the Gauss points in integrals over the sides, shape (n, q)."""
        return np.linalg.norm(self.tangent, axis=2) * self.w

    @cached_property
    def shear(self) -> Floats:
        """What of the tangent is in `inward`, shape (n, q)."""
        return (self.inward * self.tangent).sum(axis=2) / (self.tangent**2).sum(axis=2)

    @property
    def across(self) -> Floats:
        """The conormal, as long as the piece is wide, inwards, shape (n, q, gdim)."""
        return self.inward - self.shear[..., None] * self.tangent

    def values_of(self, value: ValueOrExpression, k: int) -> Floats:
        """Return values with k components, shape (n, q, k)."""
        values = values_at(value, self.V, self.piece, side_points(self.t).reshape(-1, 2), k)
        return values.reshape(self.piece.size, 4, self.t.size, k)[np.arange(self.piece.size), self.side]

    def value_and_slope(self) -> Floats:
        """Return the eight functions of two rows at the points, then their derivatives along `across`, (n, 2 q, 8)."""
        value = np.broadcast_to(element.bernstein_values(self.t), (*self.shear.shape, 4))
        along = self.shear[..., None] * element.bernstein_slopes(self.t)
        first = np.concatenate([value, -3.0 * value - along], axis=1)
        second = np.concatenate([np.zeros_like(value), 3.0 * value], axis=1)
        return np.concatenate([first, second], axis=2)


@cache
def _gauss() -> tuple[Floats, Floats]:
    """Return Gauss points and weights on [0, 1]."""
    t, w = np.polynomial.legendre.leggauss(NUM_GAUSS)
    points, weights = (t + 1.0) / 2.0, w / 2.0
    for array in (points, weights):
        array.setflags(write=False)
    return points, weights
