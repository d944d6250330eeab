"""Marks: functions to refine, cells to coarsen.

What is refined is always the support of functions: refining elements that hold no whole support would change nothing
(sec. 4 of the paper).  A function's indicator is the root of the sum of eta^2 over the cells of its support (eq. 32).
In a space refined by rings it is the ring, the faces at the function's vertex, in the place of the support: every
cell lies in the ring of some function, so that marks can carry all of the error.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from thccs_fem.extraction import Cells
from thccs_fem.fem.space import FunctionSpace, check_space
from thccs_fem.hierarchy import Hierarchy, Stage
from thccs_fem.index_map import IndexMap
from thccs_fem.parallel import together
from thccs_fem.partition import Partition, partition

__all__ = [
    "TIE",
    "Marking",
    "Strategy",
    "in_turn",
    "mark",
    "mark_coarsening",
    "on_all_cells",
    "uniform",
    "until_carried",
]

Floats = npt.NDArray[np.float64]
Strategy = Literal["worst", "maximum", "dorfler"]

TIE = 1e-6  # relative difference up to which indicators count as equal: they are small differences of solutions


@dataclass(frozen=True)
class Marking:
    """How a loop marks functions: calling it with a space and indicators is `mark` with these arguments.

    Attributes:
        strategy: See `mark`.
        theta: See `mark`.

    Raises:
        ValueError: If the strategy is unknown or theta out of range.
    """

    strategy: Strategy = "dorfler"
    theta: float = 0.5

    def __post_init__(self) -> None:
        _check_rule(self.strategy, self.theta)

    def __call__(self, V: FunctionSpace, eta: Floats) -> npt.NDArray[np.int64]:
        """Return function numbers, as `mark` does; collective."""
        return mark(V, eta, self.strategy, self.theta)


def mark(V: FunctionSpace, eta: Floats, strategy: Strategy = "dorfler", theta: float = 0.5) -> npt.NDArray[np.int64]:
    """Mark functions for refinement; collective.

    Indicators that differ by a millionth count as equal, and of equal ones the function with the lower number comes
    first. So marks depend neither on the number of ranks nor on a solver's last digits.

    Args:
        V: The space.
        eta: Indicator of each cell that this rank owns, not squared, shape (cells.num_owned,).
        strategy: "worst": the one function with the largest indicator (the paper's rule). "maximum": all whose
            indicator is at least theta times the largest. "dorfler": the fewest functions, the largest indicators
            first, whose supports (rings, in a space that is refined by them) carry theta of the sum of squares.
        theta: Parameter of "maximum" and "dorfler", in (0, 1].

    Returns:
        Function numbers, ascending, those of the whole space on all ranks, shape (m,); empty where eta is zero.

    Raises:
        ValueError: If eta does not fit the cells or is negative or not finite, or strategy or theta is unknown.
    """
    squares = on_all_cells(V, eta) ** 2
    _check_rule(strategy, theta)
    if V.hierarchy.unit == "ring":
        parts, units = _everywhere(V.hierarchy), _rings(V.hierarchy)
    else:
        parts, units = V.cells.partition, _supports(V.cells)
    indicator = np.sqrt(parts.functions.gather(units @ squares[parts.cells.numbers]))
    if not indicator.any():
        return np.zeros(0, dtype=np.int64)
    if strategy == "worst":
        return np.array([np.argmax(_places(indicator))])
    if strategy == "maximum":
        return np.flatnonzero(indicator >= theta * indicator.max() * (1.0 - TIE))
    return _dorfler(parts, units, indicator, squares, theta)


def uniform(V: FunctionSpace, eta: Floats) -> npt.NDArray[np.int64]:
    """Return all functions, whatever their indicators: uniform refinement, to compare adaptive runs with.

    Args:
        V: The space.
        eta: Not looked at.
    """
    return np.arange(V.num_functions)


def mark_coarsening(V: FunctionSpace, eta: Floats, theta: float = 0.05) -> npt.NDArray[np.int64]:
    """Mark cells for coarsening: the most cells, the smallest indicators first, that carry theta of the sum of squares.

    Collective. The counterpart of "dorfler" (Schmidt and Siebert, Design of Adaptive Finite Element Software, 2005,
    sec. 1.5), with the same rule for equal indicators.
    Elements twice as wide have indicators up to 2^3 times as large (2^4 in L2): a small theta leaves room for that.

    Args:
        V: The space.
        eta: Indicator of each cell that this rank owns, not squared, shape (cells.num_owned,).
        theta: What the marked cells may carry, in [0, 1); at 0 those without any error are marked.

    Returns:
        Cells that this rank owns, ascending, local numbers, shape (m,).

    Raises:
        ValueError: If eta does not fit the cells or is negative or not finite, or theta is out of range.
    """
    squares = on_all_cells(V, eta) ** 2
    if not 0.0 <= theta < 1.0:
        raise ValueError(f"theta is {theta}; it must lie in [0, 1)")
    order = np.argsort(_places(squares), kind="stable")
    carried = np.cumsum(squares[order])
    marks = np.zeros(order.size, dtype=bool)
    marks[order] = carried <= theta * carried[-1] * (1.0 + TIE)
    cells = partition(V.hierarchy).cells
    return np.flatnonzero(marks[cells.numbers[: cells.size_local]])


def _check_rule(strategy: Strategy, theta: float) -> None:
    if strategy not in ("worst", "maximum", "dorfler"):
        raise ValueError(f'strategy is {strategy!r}; it must be "worst", "maximum" or "dorfler"')
    if not 0.0 < theta <= 1.0:
        raise ValueError(f"theta is {theta}; it must lie in (0, 1]")


def on_all_cells(V: FunctionSpace, eta: npt.ArrayLike) -> Floats:
    """Return the indicators of all cells, by their numbers in the hierarchy."""
    check_space(V, "marking")
    cells = partition(V.hierarchy).cells
    return cells.gather(together(V.mesh.comm, lambda: _checked(cells.size_local, eta)))


def _checked(num_cells: int, eta: npt.ArrayLike) -> Floats:
    """Return indicators as an array."""
    eta = np.asarray(eta, dtype=np.float64)
    if eta.shape != (num_cells,):
        raise ValueError(f"eta has shape {eta.shape}; it needs one value for each of the {num_cells} cells")
    if not np.isfinite(eta).all() or (eta < 0.0).any():
        bad = int(np.flatnonzero(~np.isfinite(eta) | (eta < 0.0))[0])
        raise ValueError(f"eta of cell {bad} is {eta[bad]}; indicators must be finite and not negative")
    return eta


def _supports(cells: Cells) -> sp.csr_array:
    """Return the incidence of functions and cells, shape (num_functions, num_cells), entries 1."""
    rows = [batch.dofs.ravel() for batch in cells.batches]
    columns = [np.repeat(batch.cells, batch.dofs.shape[1]) for batch in cells.batches]
    row, column = np.concatenate(rows), np.concatenate(columns)
    used = row >= 0
    ones = np.ones(np.count_nonzero(used))
    return sp.csr_array((ones, (row[used], column[used])), shape=(cells.num_dofs, cells.num_cells))


def _everywhere(hierarchy: Hierarchy) -> Partition:
    """Return the numbers of a rank that works on all cells and functions, as each does where that is little."""
    return Partition(IndexMap.whole(hierarchy.cells[0].size), IndexMap.whole(hierarchy.num_dofs), 1.0)


def _rings(hierarchy: Hierarchy) -> sp.csr_array:
    """Return the incidence of functions and the cells in their rings, shape (num_dofs, number of cells), entries 1."""
    levels, keys = hierarchy.cells
    rows, columns = [], []
    for l, stage in enumerate(hierarchy.stages[: hierarchy.num_levels]):
        cells = np.flatnonzero(levels >= l)
        faces = np.searchsorted(stage.level.keys, keys[cells] >> 2 * (levels[cells] - l))  # that cells are, or lie in
        dofs = _dofs_at_vertices(stage, int(hierarchy.dof_offsets[l]))[stage.level.quads[faces]].reshape(cells.size, -1)
        cell, place = np.nonzero(dofs >= 0)
        rows.append(dofs[cell, place])
        columns.append(cells[cell])
    row, column = np.concatenate(rows), np.concatenate(columns)
    return sp.csr_array((np.ones(row.size), (row, column)), shape=(hierarchy.num_dofs, keys.size))


def _dofs_at_vertices(stage: Stage, first: int) -> npt.NDArray[np.int64]:
    """Return the dofs of a level at each vertex, its own and up to three traces, -1 for none, (num_vertices, 1 or 4).

    Args:
        stage: The level.
        first: Its first dof.
    """
    boundary = stage.boundary
    numbers = np.full(boundary.num_functions, -1)
    numbers[stage.active] = first + np.arange(np.count_nonzero(stage.active))
    own, traces = np.split(numbers, [stage.level.num_vertices])
    if not traces.size:
        return own[:, None]
    dofs = np.full((own.size, 4), -1)
    dofs[:, 0] = own
    dofs[boundary.vertex, np.arange(traces.size) - (boundary.first[boundary.vertex] - own.size) + 1] = traces
    return dofs


def _places(values: Floats) -> npt.NDArray[np.int64]:
    """Return the place of each value among all different ones, ascending, shape (n,); ties share one."""
    order = np.argsort(values)
    rising = values[order]
    places = np.zeros(order.size, dtype=np.int64)
    places[order[1:]] = np.cumsum(rising[1:] > rising[:-1] * (1.0 + TIE))
    return places


def _dorfler(
    parts: Partition, units: sp.csr_array, indicator: Floats, squares: Floats, theta: float
) -> npt.NDArray[np.int64]:
    """Take functions by falling indicator until their units carry theta; leave out those that add no cell."""
    order, turn = in_turn(indicator)
    by_cell = sp.csc_array(units)
    turns = turn[parts.functions.numbers[by_cell.indices]]
    first = parts.cells.gather(np.minimum.reduceat(turns, by_cell.indptr[:-1]))
    return until_carried(order, first, squares, theta)


def in_turn(indicator: Floats) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Return the functions by falling indicator, those that tie by number, and the turn of each, shapes (n,)."""
    order = np.argsort(-_places(indicator), kind="stable")
    turn = np.zeros(order.size, dtype=np.int64)
    turn[order] = np.arange(order.size)
    return order, turn


def until_carried(
    order: npt.NDArray[np.int64], first: npt.NDArray[np.int64], squares: Floats, theta: float
) -> npt.NDArray[np.int64]:
    """Return the functions whose turn comes until they carry theta, but for those that add no cell, ascending.

    Args:
        order: The functions in turn, shape (n,).
        first: For each cell the turn of the first function that brings it; n if none does.
        squares: Squared indicators of cells.
        theta: What is to be carried of their sum.
    """
    carried = np.cumsum(np.bincount(first, weights=squares, minlength=order.size)[: order.size])
    last = np.searchsorted(carried, theta * squares.sum() * (1.0 - TIE))
    return np.sort(order[np.unique(first[(first <= last) & (first < order.size)])])
