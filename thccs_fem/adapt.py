"""Adaptive refinement: mark functions, refine their supports, carry functions over, and the loop of all three.

What is refined is always the support of functions: refining elements that hold no whole support would change nothing
(sec. 4 of the paper).  A function's indicator is the root of the sum of eta^2 over the cells of its support (eq. 32).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from thccs_fem import estimate
from thccs_fem.extraction import Cells
from thccs_fem.fem.function import Function
from thccs_fem.fem.space import FunctionSpace

__all__ = ["History", "Step", "mark", "refine", "solve", "transfer"]

Floats = npt.NDArray[np.float64]
Strategy = Literal["worst", "maximum", "dorfler"]


def mark(V: FunctionSpace, eta: Floats, strategy: Strategy = "dorfler", theta: float = 0.5) -> npt.NDArray[np.int64]:
    """Mark functions for refinement.

    Args:
        V: The space.
        eta: Indicator of each cell, not squared, shape (num_cells,), local.
        strategy: "worst": the one function with the largest indicator (the paper's rule). "maximum": all whose
            indicator is at least theta times the largest. "dorfler": the fewest functions, the largest indicators
            first, whose supports together carry theta of the sum of squares.
        theta: Parameter of "maximum" and "dorfler", in (0, 1].

    Returns:
        Function numbers, ascending, global, shape (m,); empty where eta is zero.

    Raises:
        ValueError: If eta does not fit the cells or is negative or not finite, or strategy or theta is unknown.
    """
    cells = V.cells
    eta = np.asarray(eta, dtype=np.float64)
    if eta.shape != (cells.num_cells,):
        raise ValueError(f"eta has shape {eta.shape}; it needs one value for each of the {cells.num_cells} cells")
    if not np.isfinite(eta).all() or (eta < 0.0).any():
        bad = int(np.flatnonzero(~np.isfinite(eta) | (eta < 0.0))[0])
        raise ValueError(f"eta of cell {bad} is {eta[bad]}; indicators must be finite and not negative")
    if strategy not in ("worst", "maximum", "dorfler"):
        raise ValueError(f'strategy is {strategy!r}; it must be "worst", "maximum" or "dorfler"')
    if not 0.0 < theta <= 1.0:
        raise ValueError(f"theta is {theta}; it must lie in (0, 1]")
    supports = _supports(cells)
    indicator = np.sqrt(supports @ eta**2)
    if not indicator.any():
        return np.zeros(0, dtype=np.int64)
    if strategy == "worst":
        return np.array([np.argmax(indicator)])
    if strategy == "maximum":
        return np.flatnonzero(indicator >= theta * indicator.max())
    return _dorfler(supports, indicator, eta**2, theta)


def _supports(cells: Cells) -> sp.csr_array:
    """Return the incidence of functions and cells, shape (num_functions, num_cells), entries 1."""
    rows = [batch.dofs.ravel() for batch in cells.batches]
    columns = [np.repeat(batch.cells, batch.dofs.shape[1]) for batch in cells.batches]
    row, column = np.concatenate(rows), np.concatenate(columns)
    used = row >= 0
    ones = np.ones(np.count_nonzero(used))
    return sp.csr_array((ones, (row[used], column[used])), shape=(cells.num_dofs, cells.num_cells))


def _dorfler(supports: sp.csr_array, indicator: Floats, squares: Floats, theta: float) -> npt.NDArray[np.int64]:
    """Take functions by falling indicator until their supports carry theta; leave out those that add no cell."""
    order = np.argsort(-indicator, kind="stable")
    rank = np.zeros(order.size)
    rank[order] = np.arange(order.size)
    by_cell = sp.csc_array(supports)
    first = np.minimum.reduceat(rank[by_cell.indices], by_cell.indptr[:-1]).astype(np.int64)
    carried = np.cumsum(np.bincount(first, weights=squares, minlength=order.size))
    last = np.searchsorted(carried, theta * carried[-1] * (1.0 - 1e-12))
    return np.sort(order[np.unique(first[first <= last])])


def refine(V: FunctionSpace, marked: npt.ArrayLike) -> FunctionSpace:
    """Return the space in which the supports of the marked functions are refined; V is unchanged.

    Args:
        V: The space.
        marked: Function numbers, global, shape (m,).

    Raises:
        ValueError: If a number is out of range.
        TypeError: If the numbers are no integers.
    """
    functions = np.unique(np.asarray(marked))
    if functions.size and not np.issubdtype(functions.dtype, np.integer):
        raise TypeError(f"marked functions must be integers (see adapt.mark), got {functions.dtype}")
    if functions.size and (functions[0] < 0 or functions[-1] >= V.num_functions):
        raise ValueError(f"functions run from 0 to {V.num_functions - 1}; got {functions[0]} to {functions[-1]}")
    return V.with_hierarchy(V.hierarchy.refined(functions)) if functions.size else V


def transfer(u: Function, V: FunctionSpace) -> Function:
    """Return u in a refined space: the same function of the surface, since the spaces are nested.

    Raises:
        ValueError: If V is no refinement of the space of u.
    """
    result = Function(V, u.name)
    result.x.array = V.prolongation(u.function_space) @ u.x.array
    return result


@dataclass(frozen=True)
class Step:
    """What one step of an adaptive run came to; seconds are of wall time."""

    number: int
    levels: int
    elements: int
    dofs: int
    estimate: float
    seconds: float


@dataclass
class History:
    """Steps of an adaptive run and the last solution; `print(history)` shows a table."""

    steps: list[Step] = field(default_factory=list)
    solution: Function | None = None

    def __str__(self) -> str:
        head = f"{'step':>4} {'levels':>6} {'elements':>9} {'dofs':>9} {'estimate':>10} {'seconds':>8}"
        rows = [
            f"{s.number:4d} {s.levels:6d} {s.elements:9d} {s.dofs:9d} {s.estimate:10.3e} {s.seconds:8.2f}"
            for s in self.steps
        ]
        return "\n".join([head, *rows])


def solve(
    V: FunctionSpace,
    solver: Callable[[FunctionSpace], Function],
    estimator: Callable[[Function], Floats],
    *,
    steps: int,
    strategy: Strategy = "dorfler",
    theta: float = 0.5,
    tolerance: float = 0.0,
    max_dofs: int | None = None,
    progress: bool | None = None,
) -> History:
    """Solve, estimate, mark and refine, again and again.

    Args:
        V: The space to begin with.
        solver: Takes a space, returns the solution in it.
        estimator: Takes a solution, returns the indicator of each cell, shape (num_cells,).
        steps: Number of refinements; the problem is solved once more than that.
        strategy: See `mark`.
        theta: See `mark`.
        tolerance: Stop when the estimate (the norm of all indicators) is at most this.
        max_dofs: Stop when the space has at least so many dofs.
        progress: Show a progress bar; None: only in a terminal.

    Returns:
        The history with the last solution.
    """
    from tqdm import tqdm

    if steps < 0:
        raise ValueError(f"steps is {steps}; it must not be negative")
    history = History()
    with tqdm(
        total=steps + 1, desc="adaptive run", unit="step", disable=None if progress is None else not progress
    ) as bar:
        for number in range(steps + 1):
            start = time.perf_counter()
            u = solver(V)
            eta = estimator(u)
            total = estimate.norm(V, eta)
            last = number == steps or total <= tolerance or (max_dofs is not None and V.num_dofs >= max_dofs)
            refined = V if last else refine(V, mark(V, eta, strategy=strategy, theta=theta))
            seconds = time.perf_counter() - start
            history.steps.append(Step(number, V.num_levels, V.num_cells, V.num_dofs, total, seconds))
            history.solution = u
            bar.set_postfix(dofs=V.num_dofs, estimate=f"{total:.2e}")
            bar.update()
            if last:
                break
            V = refined
    return history
