"""Adaptive refinement: mark functions, refine their supports, carry functions over, and the loop of all three.

What is refined is always the support of functions: refining elements that hold no whole support would change nothing
(sec. 4 of the paper).  A function's indicator is the root of the sum of eta^2 over the cells of its support (eq. 32).

What is coarsened are cells, by one level: those marked, as far as whole functions of the coarser level allow.  Between
two time steps `remesh` does both and `transfer` carries the solution over.
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
from thccs_fem.fem.assembly import integrals
from thccs_fem.fem.function import Function
from thccs_fem.fem.project import projector
from thccs_fem.fem.space import FunctionSpace, check_space
from thccs_fem.hierarchy import Hierarchy

__all__ = ["History", "Step", "coarsen", "mark", "mark_coarsening", "refine", "remesh", "solve", "transfer"]

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
    eta = _checked(cells, eta)
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


def mark_coarsening(V: FunctionSpace, eta: Floats, theta: float = 0.05) -> npt.NDArray[np.int64]:
    """Mark cells for coarsening: the most cells, the smallest indicators first, that carry theta of the sum of squares.

    The counterpart of "dorfler" (Schmidt and Siebert, Design of Adaptive Finite Element Software, 2005, sec. 1.5).
    Elements twice as wide have indicators up to 2^3 times as large (2^4 in L2): a small theta leaves room for that.

    Args:
        V: The space.
        eta: Indicator of each cell, not squared, shape (num_cells,), local.
        theta: What the marked cells may carry, in [0, 1); at 0 those without any error are marked.

    Returns:
        Cell numbers, ascending, local, shape (m,).

    Raises:
        ValueError: If eta does not fit the cells or is negative or not finite, or theta is out of range.
    """
    squares = _checked(V.cells, eta) ** 2
    if not 0.0 <= theta < 1.0:
        raise ValueError(f"theta is {theta}; it must lie in [0, 1)")
    order = np.argsort(squares, kind="stable")
    carried = np.cumsum(squares[order])
    return np.sort(order[carried <= theta * carried[-1]])


def _checked(cells: Cells, eta: npt.ArrayLike) -> Floats:
    """Return indicators as an array."""
    eta = np.asarray(eta, dtype=np.float64)
    if eta.shape != (cells.num_cells,):
        raise ValueError(f"eta has shape {eta.shape}; it needs one value for each of the {cells.num_cells} cells")
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
    functions = _functions(V, marked)
    return V.with_hierarchy(V.hierarchy.refined(functions)) if functions.size else V


def coarsen(V: FunctionSpace, cells: npt.ArrayLike) -> FunctionSpace:
    """Return the space in which the marked cells are coarsened by one level, where whole functions allow it.

    A cell that is marked may stay; one that is not never goes. V is unchanged, and refines the result.

    Args:
        V: The space.
        cells: Cell numbers, local, shape (m,), or marks, bool, shape (num_cells,).

    Returns:
        The space; V itself if nothing changes.

    Raises:
        ValueError: If a number is out of range, or the marks are not one for each cell.
        TypeError: If the cells are neither integers nor marks.
    """
    return _on(V, V.hierarchy.coarsened(_cells(V, cells)))


def remesh(V: FunctionSpace, marked: npt.ArrayLike, cells: npt.ArrayLike) -> FunctionSpace:
    """Return the space refined where functions are marked and coarsened where cells are, where that undoes none of it.

    Cells that the refinement needs stay, marked or not: what `refine` would have done to the supports of the marked
    functions is done.

    Args:
        V: The space.
        marked: Function numbers as for `refine`, shape (m,).
        cells: Cell numbers, shape (n,), or marks, as for `coarsen`.

    Returns:
        The space; V itself if nothing changes.

    Raises:
        ValueError: If a number is out of range, or the marks are not one for each cell.
        TypeError: If the functions are no integers, or the cells neither integers nor marks.
    """
    return _on(V, V.hierarchy.remeshed(_functions(V, marked), _cells(V, cells)))


def _on(V: FunctionSpace, hierarchy: Hierarchy) -> FunctionSpace:
    return V if hierarchy is V.hierarchy else V.with_hierarchy(hierarchy)


def _functions(V: FunctionSpace, marked: npt.ArrayLike) -> npt.NDArray[np.int64]:
    """Return marked functions as numbers, ascending."""
    check_space(V, "refinement")
    functions = np.unique(np.asarray(marked))
    if functions.size and not np.issubdtype(functions.dtype, np.integer):
        raise TypeError(f"marked functions must be integers (see adapt.mark), got {functions.dtype}")
    if functions.size and (functions[0] < 0 or functions[-1] >= V.num_functions):
        raise ValueError(f"functions run from 0 to {V.num_functions - 1}; got {functions[0]} to {functions[-1]}")
    return functions.astype(np.int64)


def _cells(V: FunctionSpace, cells: npt.ArrayLike) -> npt.NDArray[np.int64]:
    """Return marked cells as numbers, ascending."""
    check_space(V, "coarsening")
    marked = np.asarray(cells)
    if marked.dtype == np.bool_:
        if marked.shape != (V.num_cells,):
            raise ValueError(f"marks have shape {marked.shape}; there must be one for each of the {V.num_cells} cells")
        return np.flatnonzero(marked)
    numbers = np.unique(marked)
    if numbers.size and not np.issubdtype(numbers.dtype, np.integer):
        raise TypeError(f"marked cells must be integers or bools (see adapt.mark_coarsening), got {numbers.dtype}")
    if numbers.size and (numbers[0] < 0 or numbers[-1] >= V.num_cells):
        raise ValueError(f"cells run from 0 to {V.num_cells - 1}; got {numbers[0]} to {numbers[-1]}")
    return numbers.astype(np.int64)


def transfer(
    u: Function, V: FunctionSpace, projection: Literal["L2", "H1"] = "L2", *, conserve: bool = False
) -> Function:
    """Return u in another space of the same mesh: the same function if V refines the space of u, else the nearest.

    The projection is over the cells of the coarsest refinement of both spaces. It keeps functions that lie in V, and
    the integral of u over these cells to rounding (with "H1" too: constants are test functions, and have no gradient).
    Integrals over the cells of either space differ from it by what quadrature leaves, also those of a function that is
    carried over exactly: by 1e-6 of them where cells are coarse and curved. With `conserve` a constant makes up for it,
    so that ``assemble_scalar(form(u * dx))`` stays what it was, as it does in time steps that conserve; use it for all
    transfers of a run, or the constants add up.

    Where a cap at an extraordinary vertex sinks or rises (elements at or below `cap_level`), the spaces are on surfaces
    that differ inside the cap: coefficients are carried over as they are. A space made with a larger `cap_level` avoids
    it.

    Args:
        u: The function.
        V: The space, from that of u by `refine`, `coarsen` and `remesh`.
        projection: The norm in which the result is nearest to u: "L2", or "H1", that of (u, v) + (grad u, grad v).
        conserve: Add a constant to each component that keeps its integral as it is measured, to rounding.

    Raises:
        ValueError: If the spaces are not on the same mesh with the same boundary rule, or their values have different
            shapes, or the projection is none of ours.
    """
    W = u.function_space
    for space in (W, V):
        check_space(space, "transfer")
    if projection not in ("L2", "H1"):
        raise ValueError(f'projection is {projection!r}; it must be "L2" or "H1"')
    if W.value_shape != V.value_shape:
        raise ValueError(f"values of shape {W.value_shape} cannot be carried to shape {V.value_shape}")
    values = u.x.array.reshape(-1, W.block_size)
    if V.hierarchy.common_refinement(W.hierarchy) is V.hierarchy:
        carried = V.hierarchy.prolongation(W.hierarchy) @ values
    else:
        carried = projector(W.hierarchy, V, projection)(values)
    if conserve:
        there = integrals(V)
        carried += (integrals(W) @ values - there @ carried) / there.sum()
    result = Function(V, u.name)
    result.x.array = carried.ravel()
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
