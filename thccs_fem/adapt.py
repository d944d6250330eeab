"""Adaptive refinement: mark functions, refine their supports, carry functions over, and the loop of all three.

What is refined is always the support of functions: refining elements that hold no whole support would change nothing
(sec. 4 of the paper).  A function's indicator is the root of the sum of eta^2 over the cells of its support (eq. 32).

What is coarsened are cells, by one level: those marked, as far as whole functions of the coarser level allow.  Between
two time steps `remesh` does both and `transfer` carries the solution over.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from thccs_fem import checkpoint, estimate
from thccs_fem.extraction import Cells
from thccs_fem.fem.assembly import integrals
from thccs_fem.fem.function import Function
from thccs_fem.fem.project import projector
from thccs_fem.fem.space import FunctionSpace, cellwise, check_space
from thccs_fem.hierarchy import Hierarchy
from thccs_fem.parallel import by_first_rank, gathered, largest, rank_of, together, total
from thccs_fem.partition import Partition, partition
from thccs_fem.prolongation import Prolongation

__all__ = ["History", "Step", "coarsen", "mark", "mark_coarsening", "refine", "remesh", "solve", "transfer"]

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


def refine(V: FunctionSpace, marked: npt.ArrayLike) -> FunctionSpace:
    """Return the space in which the supports of the marked functions are refined; V is unchanged. Collective.

    Args:
        V: The space.
        marked: Function numbers in the whole space, shape (m,); what any rank gives is marked.

    Raises:
        ValueError: If a number is out of range.
        TypeError: If the numbers are no integers.
    """
    functions = _functions(V, marked)
    return V.with_hierarchy(V.hierarchy.refined(functions)) if functions.size else V


def coarsen(V: FunctionSpace, cells: npt.ArrayLike) -> FunctionSpace:
    """Return the space in which the marked cells are coarsened by one level, where whole functions allow it.

    A cell that is marked may stay; one that is not never goes. V is unchanged, and refines the result. Collective.

    Args:
        V: The space.
        cells: Cells that this rank owns, local numbers, shape (m,), or marks, bool, shape (cells.num_owned,).

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
    functions is done. Collective.

    Args:
        V: The space.
        marked: Function numbers as for `refine`, shape (m,).
        cells: Cells that this rank owns, numbers, shape (n,), or marks, as for `coarsen`.

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
    """Return the functions that some rank has marked, ascending."""
    check_space(V, "refinement")
    comm = V.mesh.comm
    return np.unique(gathered(comm, together(comm, lambda: _checked_functions(V, marked))))


def _checked_functions(V: FunctionSpace, marked: npt.ArrayLike) -> npt.NDArray[np.int64]:
    """Return marked functions as numbers, ascending."""
    functions = np.unique(np.asarray(marked))
    if functions.size and not np.issubdtype(functions.dtype, np.integer):
        raise TypeError(f"marked functions must be integers (see adapt.mark), got {functions.dtype}")
    if functions.size and (functions[0] < 0 or functions[-1] >= V.num_functions):
        raise ValueError(f"functions run from 0 to {V.num_functions - 1}; got {functions[0]} to {functions[-1]}")
    return functions.astype(np.int64)


def _cells(V: FunctionSpace, cells: npt.ArrayLike) -> npt.NDArray[np.int64]:
    """Return the cells that the ranks have marked as numbers in the hierarchy, rank after rank."""
    check_space(V, "coarsening")
    comm, owned = V.mesh.comm, partition(V.hierarchy).cells
    local = together(comm, lambda: _checked_cells(owned.size_local, cells))
    return gathered(comm, owned.numbers[local].astype(np.int64))


def _checked_cells(num_cells: int, cells: npt.ArrayLike) -> npt.NDArray[np.int64]:
    """Return marked cells as numbers, ascending."""
    marked = np.asarray(cells)
    if marked.dtype == np.bool_:
        if marked.shape != (num_cells,):
            raise ValueError(f"marks have shape {marked.shape}; there must be one for each of the {num_cells} cells")
        return np.flatnonzero(marked)
    numbers = np.unique(marked)
    if numbers.size and not np.issubdtype(numbers.dtype, np.integer):
        raise TypeError(f"marked cells must be integers or bools (see adapt.mark_coarsening), got {numbers.dtype}")
    if numbers.size and (numbers[0] < 0 or numbers[-1] >= num_cells):
        raise ValueError(f"cells run from 0 to {num_cells - 1}; got {numbers[0]} to {numbers[-1]}")
    return numbers.astype(np.int64)


def transfer(
    u: Function, V: FunctionSpace, projection: Literal["L2", "H1"] = "L2", *, conserve: bool = False
) -> Function:
    """Return u in another space of the same mesh: the same function if V refines the space of u, else the nearest.

    Collective. The projection is over the cells of the coarsest refinement of both spaces. It keeps functions that lie
    in V, and the integral of u over these cells to rounding (with "H1" too: constants are test functions, and have no
    gradient). Integrals over the cells of either space differ from it by what quadrature leaves, also those of a
    function that is carried over exactly: by 1e-6 of them where cells are coarse and curved. With `conserve` a constant
    makes up for it, so that ``assemble_scalar(form(u * dx))`` stays what it was, as it does in time steps that
    conserve; use it for all transfers of a run, or the constants add up.

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
        carried = Prolongation(V.hierarchy, W.hierarchy)(values)
    else:
        carried = projector(W.hierarchy, V, projection)(values)
    if conserve:
        found = _integral(V, np.column_stack([carried, np.ones(len(carried))]))
        carried += (_integral(W, values) - found[:-1]) / found[-1]
    result = Function(V, u.name)
    result.x.array = carried.ravel()
    return result


def _integral(V: FunctionSpace, values: Floats) -> Floats:
    """Return the integrals of functions, one in each column, over the cells of all ranks, shape (k,)."""
    owned = V.index_map.size_local
    return total(V.mesh.comm, integrals(V)[:owned] @ values[:owned])


@dataclass(frozen=True)
class Step:
    """What one step of an adaptive run came to.

    Seconds are of wall time, on the slowest rank. The imbalance is the weight of the cells of the rank that has most,
    relative to the mean.
    """

    number: int
    levels: int
    elements: int
    dofs: int
    estimate: float
    seconds: float
    imbalance: float = 1.0


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
        if any(s.imbalance != 1.0 for s in self.steps):  # on several ranks
            head += f" {'imbalance':>9}"
            rows = [f"{row} {s.imbalance:9.3f}" for row, s in zip(rows, self.steps, strict=True)]
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
    checkpoint: str | os.PathLike[str] | None = None,
) -> History:
    """Solve, estimate, mark and refine, again and again; collective.

    With a checkpoint each step is written to a file when it is done; if the file is there at the beginning, the run
    goes on after the last step in it, and comes to the same as one without an interruption. Arguments may have changed,
    and hold from there on: with more steps, or a smaller tolerance, a run that was at its end is continued. Only the
    space to begin with must be the same. Remove the file to begin anew.

    Args:
        V: The space to begin with.
        solver: Takes a space, returns the solution in it.
        estimator: Takes a solution, returns the indicator of each cell that this rank owns, shape (cells.num_owned,).
        steps: Number of refinements; the problem is solved once more than that.
        strategy: See `mark`.
        theta: See `mark`.
        tolerance: Stop when the estimate (the norm of all indicators) is at most this.
        max_dofs: Stop when the space has at least so many dofs.
        progress: Show a progress bar (rank 0 does); None: only in a terminal.
        checkpoint: The file to write to, and to go on from. `checkpoint.read` finds the solution in it, too.

    Returns:
        The history with the last solution.

    Raises:
        ValueError: If the checkpoint is of another loop, space or mesh, or none that `checkpoint.read` can read.
    """
    from tqdm import tqdm

    if steps < 0:
        raise ValueError(f"steps is {steps}; it must not be negative")
    history, V, eta = (History(), V, np.zeros(0)) if checkpoint is None else _resumed(checkpoint, V)

    def is_over() -> bool:
        last = history.steps[-1]
        return last.number >= steps or last.estimate <= tolerance or (max_dofs is not None and last.dofs >= max_dofs)

    with tqdm(
        total=steps + 1,
        initial=len(history.steps),
        desc="adaptive run",
        unit="step",
        disable=rank_of(V.mesh.comm) > 0 or (None if progress is None else not progress),
    ) as bar:
        while not history.steps or not is_over():
            start = time.perf_counter()
            if history.steps:
                V = refine(V, mark(V, eta, strategy=strategy, theta=theta))
            u = solver(V)
            eta = estimator(u)
            total = estimate.norm(V, eta)
            seconds = largest(V.mesh.comm, time.perf_counter() - start)
            size = V.num_levels, V.num_cells, V.num_dofs
            imbalance = partition(V.hierarchy).imbalance
            history.steps.append(Step(len(history.steps), *size, total, seconds, imbalance))
            history.solution = u
            if checkpoint is not None:
                _save(checkpoint, history, V, eta)
            bar.set_postfix(dofs=V.num_dofs, estimate=f"{total:.2e}")
            bar.update()
    return history


def _save(path: str | os.PathLike[str], history: History, V: FunctionSpace, eta: Floats) -> None:
    """Write what `solve` needs to go on."""
    assert history.solution is not None  # after a step
    indicators = Function(cellwise(V), name=f"indicators of {history.solution.name}")
    indicators.x.array[: eta.size] = eta
    run = {"steps": [asdict(step) for step in history.steps], "solution": history.solution.name}
    checkpoint.write(path, [history.solution, indicators], {"adapt.solve": run})


def _resumed(path: str | os.PathLike[str], V: FunctionSpace) -> tuple[History, FunctionSpace, Floats]:
    """Return what `_save` has written; if it has written nothing, a new history, and V."""
    if not by_first_rank(V.mesh.comm, Path(path).exists):
        return History(), V, np.zeros(0)
    saved = checkpoint.read(path, mesh=V.mesh)
    if "adapt.solve" not in saved.attributes:
        raise ValueError(f"{path} was not written by adapt.solve: give another name, or remove it to begin anew")
    run = saved.attributes["adapt.solve"]
    steps = [Step(**step) for step in run["steps"]]
    indicators = saved.functions[f"indicators of {run['solution']}"]
    found = indicators.function_space.hierarchy
    if steps[0].dofs != V.num_dofs or not found.is_refinement_of(V.hierarchy):
        raise ValueError(
            f"{path} is of a run that began with {steps[0].dofs} dofs in another space than {V}: begin with the same, "
            f"or give another name, or remove the file to begin anew"
        )
    eta = indicators.x.array[: indicators.x.index_map.size_local]
    return History(steps, saved.functions[run["solution"]]), V.with_hierarchy(found), eta
