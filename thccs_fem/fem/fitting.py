"""Coefficients of given functions that fit an expression, which is what conditions have in place of interpolation.

No spline interpolates: an expression is projected, in L2 of the boundary edges that the given functions determine, or
of the cells if not all of them reach the boundary. Value and slope are fitted on the boundary together.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
import scipy.sparse.linalg as spla

import ufl
from thccs_fem import element
from thccs_fem.extraction import Cells
from thccs_fem.fem.expression import ValueOrExpression, values_at
from thccs_fem.fem.space import FunctionSpace
from thccs_fem.positions import side_points
from thccs_fem.subdivision import Bools, Ints

__all__ = ["fitted", "side_rows"]

NONZERO = 1e-10  # extraction entries are 0 up to rounding or a good part of 1 in some piece of the cell
AROUND = 1e-6  # weight of a value around the part that is prescribed, against 1 in it
RIDGE = 1e-13  # makes regular what is determined nowhere; no more than rounding elsewhere
NUM_GAUSS = 8  # points in each direction: exact for straight pieces, far below the error of the space for others
SIDES = np.array([[0, 1, 2, 3], [3, 7, 11, 15], [15, 14, 13, 12], [12, 8, 4, 0]])  # coefficients i + 4 j on each side
INWARD = np.array([4, -1, -4, 1])  # from these to the next row inside

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.integer]


def fitted(V: FunctionSpace, functions: Indices, value: ValueOrExpression, k: int, slope: bool) -> Floats:
    """Return the coefficients of the L2 projection of an expression on functions.

    What is fitted by least squares is the value (and the slope) on the part of the boundary or of the surface that the
    given functions determine, together with all other functions there, and, with a small weight, the value around it:
    functions that hardly reach into the part, or that others can stand in for there, are determined by that.

    Args:
        V: The space.
        functions: Function numbers, ascending, shape (n,).
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
    if not functions.size:
        return np.zeros((0, k))
    if slope:
        parts = [_value_and_slope(V, functions, value, k), _on_cells(V, functions, value, k, is_around=True)]
    else:
        parts = [_on_boundary(V, functions, value, k) or _on_cells(V, functions, value, k)]
    mass, load = parts[0].equations()
    for part in parts[1:]:
        more_mass, more_load = part.equations()
        mass, load = mass + more_mass, load + more_load
    present = np.flatnonzero(mass.diagonal() > 0.0)
    mass, load = sp.csc_array(mass[present][:, present]), load[present]
    regular = mass.copy()
    regular.setdiag((1.0 + RIDGE) * mass.diagonal())
    factors = spla.splu(regular)
    fitted = factors.solve(load)
    fitted += factors.solve(load - mass @ fitted)  # takes back what RIDGE has changed
    return fitted[np.searchsorted(present, functions)]


@dataclass(frozen=True, eq=False)
class _Part:
    """Values at points of n sides or pieces, in each of which there are m local functions.

    Attributes:
        rows: Local coefficients of all functions, shape (n m, num_functions).
        basis: Local functions at the points, shape (n or 1, points, m).
        weights: Weights of the points, shape (n, points).
        values: What is to be fitted there, shape (n, points, k).
    """

    rows: sp.csr_array
    basis: Floats
    weights: Floats
    values: Floats

    def equations(self) -> tuple[sp.csr_array, Floats]:
        """Return matrix and right-hand side of the least squares, of all functions."""
        is_finite = np.isfinite(self.values).all(axis=2, keepdims=True)  # around the part, it need not be defined
        weighted = (np.where(is_finite, self.weights[:, :, None], 0.0) * self.basis).swapaxes(1, 2)
        mass, load = weighted @ self.basis, weighted @ np.where(is_finite, self.values, 0.0)
        n, m, _ = mass.shape
        blocks = sp.bsr_array((mass, np.arange(n), np.arange(n + 1)), shape=(n * m, n * m))
        return sp.csr_array(self.rows.T @ (blocks.tocsr() @ self.rows)), self.rows.T @ load.reshape(n * m, -1)


def _on_boundary(V: FunctionSpace, functions: Indices, value: ValueOrExpression, k: int) -> _Part | None:
    """Return the values at Gauss points of the boundary; None if a function has no trace there."""
    piece, side, _ = V.cells.boundary_pieces
    rows = side_rows(V.cells, piece, side, depth=1)
    if not np.isin(functions, rows.indices).all():
        return None
    chosen, is_inside = _blocks(rows, functions, 4)
    sides = _Sides(V, piece[chosen], side[chosen])
    values = sides.values_of(value, k)
    weights = _weighted(sides.lengths, values, is_inside)
    return _Part(_rows_of(rows, chosen, 4), element.bernstein_values(sides.t)[None], weights, values)


def _value_and_slope(V: FunctionSpace, functions: Indices, value: ValueOrExpression, k: int) -> _Part:
    """Return the values at Gauss points of the boundary, then h times the slopes there.

    h is the width of the piece across the boundary, so that values and slopes weigh alike at every size of the cells.

    Raises:
        TypeError: If the value is no UFL expression, which alone can be differentiated.
        ValueError: If a function has neither value nor slope on the boundary.
    """
    if not isinstance(value, ufl.core.expr.Expr):
        raise TypeError(f"slope=True needs a UFL expression, whose gradient is known, got {type(value).__name__}")
    piece, side, _ = V.cells.boundary_pieces
    rows = side_rows(V.cells, piece, side, depth=2)
    inside = functions[~np.isin(functions, rows.indices)]
    if inside.size:
        raise ValueError(
            f"{inside.size} of the {functions.size} dofs have neither value nor slope on the boundary, the first is "
            f"{inside[0]}: slope=True is for dofs of boundary_dofs(V, slope=True)"
        )
    chosen, is_inside = _blocks(rows, functions, 8)
    sides = _Sides(V, piece[chosen], side[chosen])
    values = sides.values_of(value, k)
    gradients = sides.values_of(ufl.grad(value), k * V.mesh.gdim).reshape(*values.shape, V.mesh.gdim)
    slopes = np.einsum("nqkc,nqc->nqk", gradients, sides.across)
    both = np.concatenate([values, slopes], axis=1)
    weights = _weighted(np.tile(sides.lengths, 2), both, is_inside)
    return _Part(_rows_of(rows, chosen, 8), sides.value_and_slope(), weights, both)


def _on_cells(V: FunctionSpace, functions: Indices, value: ValueOrExpression, k: int, is_around: bool = False) -> _Part:
    """Return the values at Gauss points of the pieces that the functions live on.

    With `is_around` all of them are around what is prescribed.
    """
    cells = V.cells
    all_rows = cells.rows(np.arange(cells.num_pieces, dtype=np.int32))
    piece, is_inside = _blocks(all_rows, functions, 16)
    is_inside &= not is_around
    t, w = _gauss()
    points = np.stack(np.meshgrid(t, t, indexing="ij"), axis=-1).reshape(-1, 2)
    weights = cells.area_element(piece, points) * np.outer(w, w).ravel()
    values = values_at(value, V, piece, points, k)
    basis = element.bicubic_values(points)[None]
    return _Part(_rows_of(all_rows, piece, 16), basis, _weighted(weights, values, is_inside), values)


def _blocks(rows: sp.csr_array, functions: Indices, height: int) -> tuple[Ints, Bools]:
    """Return the blocks of `height` rows where given functions occur, and in which of these no others do."""
    given = np.zeros(rows.shape[1], dtype=bool)
    given[functions] = True
    block = np.repeat(np.arange(rows.shape[0]) // height, np.diff(rows.indptr))
    num_given, num_foreign = (
        np.bincount(block, weights=marks[rows.indices], minlength=rows.shape[0] // height) for marks in (given, ~given)
    )
    chosen = np.flatnonzero(num_given).astype(np.int32)
    return chosen, num_foreign[chosen] == 0


def _rows_of(rows: sp.csr_array, blocks: Ints, height: int) -> sp.csr_array:
    """Return blocks of `height` rows."""
    return sp.csr_array(rows[(height * blocks[:, None] + np.arange(height)).ravel()])


def _weighted(weights: Floats, values: Floats, is_inside: Bools) -> Floats:
    """Return the weights of shape (n, points), made small outside."""
    bad = ~np.isfinite(values).all(axis=(1, 2)) & is_inside
    if bad.any():
        raise ValueError(
            f"the value is not finite on {np.count_nonzero(bad)} of the {np.count_nonzero(is_inside)} edges or patches "
            f"of surface that the dofs determine: prescribe finite values"
        )
    return weights * np.where(is_inside, 1.0, AROUND)[:, None]


# ---- Sides of pieces ----------------------------------------------------------------------------------------------


def side_rows(cells: Cells, piece: Ints, side: Ints, depth: int) -> sp.csr_array:
    """Return Bernstein coefficients of all functions at sides of pieces; what is rounding is zero, and not stored.

    Args:
        cells: The cells.
        piece: Piece of each side, shape (n,).
        side: Number of the side in it, from corner k to k + 1, shape (n,).
        depth: 1: the four coefficients on the side. 2: then the four of the next row inside, which make up the slope.

    Returns:
        Shape (4 depth n, num_functions).
    """
    to_bernstein = sp.kron(sp.eye_array(piece.size, format="csr"), sp.csr_array(element.TO_BERNSTEIN), format="csr")
    local = SIDES[side][:, None] + np.arange(depth)[:, None] * INWARD[side][:, None, None]
    rows = 16 * np.arange(piece.size)[:, None] + local.reshape(piece.size, 4 * depth)
    coefficients = sp.csr_array(sp.csr_array(to_bernstein[rows.ravel()]) @ cells.rows(piece))
    coefficients.data[np.abs(coefficients.data) < NONZERO] = 0.0
    coefficients.eliminate_zeros()
    return coefficients


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


def _gauss() -> tuple[Floats, Floats]:
    """Return Gauss points and weights on [0, 1]."""
    t, w = np.polynomial.legendre.leggauss(NUM_GAUSS)
    return (t + 1.0) / 2.0, w / 2.0
