"""Marks: functions to refine, cells to coarsen.

What is refined is always the support of functions: refining elements that hold no whole support would change nothing
(sec. 4 of the paper).  A function's indicator is the root of the sum of eta^2 over the cells of its support (eq. 32).
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from thccs_fem.extraction import Cells
from thccs_fem.fem.space import FunctionSpace
from thccs_fem.parallel import together
from thccs_fem.partition import Partition, partition

__all__ = ["Strategy", "mark", "mark_coarsening"]

Floats = npt.NDArray[np.float64]
Strategy = Literal["worst", "maximum", "dorfler"]

TIE = 1e-6  # relative difference up to which indicators count as equal: they are small differences of solutions


def mark(V: FunctionSpace, eta: Floats, strategy: Strategy = "dorfler", theta: float = 0.5) -> npt.NDArray[np.int64]:
    """Mark functions for refinement; collective.

    Indicators that differ by a millionth count as equal, and of equal ones the function with the lower number comes
    first. So marks depend neither on the number of ranks nor on a solver's last digits.

    Args:
        V: The space.
        eta: Indicator of each cell that this rank owns, not squared, shape (cells.num_owned,).
        strategy: "worst": the one function with the largest indicator (the paper's rule). "maximum": all whose
            indicator is at least theta times the largest. "dorfler": the fewest functions, the largest indicators
            first, whose supports together carry theta of the sum of squares.
        theta: Parameter of "maximum" and "dorfler", in (0, 1].

    Returns:
        Function numbers, ascending, those of the whole space on all ranks, shape (m,); empty where eta is zero.

    Raises:
        ValueError: If eta does not fit the cells or is negative or not finite, or strategy or theta is unknown.
    """
    squares = _gathered(V, eta) ** 2
    if strategy not in ("worst", "maximum", "dorfler"):
        raise ValueError(f'strategy is {strategy!r}; it must be "worst", "maximum" or "dorfler"')
    if not 0.0 < theta <= 1.0:
        raise ValueError(f"theta is {theta}; it must lie in (0, 1]")
    parts, supports = V.cells.partition, _supports(V.cells)
    indicator = np.sqrt(parts.functions.gather(supports @ squares[parts.cells.numbers]))
    if not indicator.any():
        return np.zeros(0, dtype=np.int64)
    if strategy == "worst":
        return np.array([np.argmax(_places(indicator))])
    if strategy == "maximum":
        return np.flatnonzero(indicator >= theta * indicator.max() * (1.0 - TIE))
    return _dorfler(parts, supports, indicator, squares, theta)


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
    squares = _gathered(V, eta) ** 2
    if not 0.0 <= theta < 1.0:
        raise ValueError(f"theta is {theta}; it must lie in [0, 1)")
    order = np.argsort(_places(squares), kind="stable")
    carried = np.cumsum(squares[order])
    marks = np.zeros(order.size, dtype=bool)
    marks[order] = carried <= theta * carried[-1] * (1.0 + TIE)
    cells = partition(V.hierarchy).cells
    return np.flatnonzero(marks[cells.numbers[: cells.size_local]])


def _gathered(V: FunctionSpace, eta: npt.ArrayLike) -> Floats:
    """Return the indicators of all cells, by their numbers in the hierarchy."""
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


def _places(values: Floats) -> npt.NDArray[np.int64]:
    """Return the place of each value among all different ones, ascending, shape (n,); ties share one."""
    order = np.argsort(values)
    rising = values[order]
    places = np.zeros(order.size, dtype=np.int64)
    places[order[1:]] = np.cumsum(rising[1:] > rising[:-1] * (1.0 + TIE))
    return places


def _dorfler(
    parts: Partition, supports: sp.csr_array, indicator: Floats, squares: Floats, theta: float
) -> npt.NDArray[np.int64]:
    """Take functions by falling indicator until their supports carry theta; leave out those that add no cell."""
    order = np.argsort(-_places(indicator), kind="stable")
    turn = np.zeros(order.size, dtype=np.int64)
    turn[order] = np.arange(order.size)
    by_cell = sp.csc_array(supports)
    turns = turn[parts.functions.numbers[by_cell.indices]]
    first = parts.cells.gather(np.minimum.reduceat(turns, by_cell.indptr[:-1]))
    carried = np.cumsum(np.bincount(first, weights=squares, minlength=order.size))
    last = np.searchsorted(carried, theta * carried[-1] * (1.0 - TIE))
    return np.sort(order[np.unique(first[first <= last])])
