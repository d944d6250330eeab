"""Solve, estimate, mark and refine, again and again."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from thccs_fem import checkpoint, estimate
from thccs_fem.adapt.marking import Strategy, mark
from thccs_fem.adapt.remeshing import refine
from thccs_fem.fem.function import Function
from thccs_fem.fem.space import FunctionSpace, cellwise
from thccs_fem.parallel import by_first_rank, largest, rank_of
from thccs_fem.partition import partition

__all__ = ["History", "Step", "solve"]

Floats = npt.NDArray[np.float64]


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
