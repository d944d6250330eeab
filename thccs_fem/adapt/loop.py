"""Solve, estimate, mark and refine, again and again."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from thccs_fem.adapt.history import History, Step
from thccs_fem.adapt.marking import Marking
from thccs_fem.adapt.resuming import Solution, begun, listed, resumed, save
from thccs_fem.adapt.returned import check_called, estimated, next_space, numbers_of, reason_of
from thccs_fem.adapt.transfer import transfer
from thccs_fem.fem.function import Function
from thccs_fem.fem.space import FunctionSpace, check_space
from thccs_fem.hierarchy import TooDeepError
from thccs_fem.parallel import largest, rank_of
from thccs_fem.partition import partition

__all__ = ["Problem", "solve"]

Floats = npt.NDArray[np.float64]


class Problem(Protocol):
    """What is to be solved in a space: a LinearProblem or NonlinearProblem of `fem.petsc` or `fem.scipy`, or your own.

    A method ``start_from_u()`` may be there as well: it lets `solve` start from the values of `u`, and returns whether
    it will; if it won't, nobody has to provide them.
    """

    @property
    def u(self) -> Any:
        """The solution, a `Function` or a list of them, which has the initial guess before."""

    def solve(self) -> Any:
        """Give `u` the values that solve the problem."""


def solve(
    V: FunctionSpace,
    problem: Callable[[FunctionSpace], Problem | Solution],
    estimator: Callable[[Any], npt.ArrayLike | tuple[npt.ArrayLike, float]],
    *,
    marking: Callable[[FunctionSpace, Floats], npt.ArrayLike | FunctionSpace] = Marking(),  # noqa: B008  # frozen
    stop: Callable[[History], str | None],
    callback: Callable[[Step, Any], Mapping[str, float] | None] | None = None,
    progress: bool | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
) -> History:
    """Solve, estimate, mark and refine, again and again; collective.

    Each solution is the initial guess for the next one: exactly the same function, on the refined space.

    With a checkpoint each step is written to a file when it is done; if the file is there at the beginning, the run
    goes on after the last step in it, and comes to the same as one without an interruption. Arguments may have changed,
    and hold from there on: with more steps, or a smaller tolerance, a run that was at its end is continued. Only the
    space to begin with must be the same. Remove the file to begin anew.

    Args:
        V: The space to begin with.
        problem: Takes a space and returns a `Problem` in it, whose `u` gets the initial guess; or returns the solution
            itself, a function or a list of those of several unknowns.
        estimator: Takes a solution, returns the indicator of each cell that this rank owns, shape (cells.num_owned,);
            or these and the estimate of the error, where that is not their norm. It may have a sign, as that of a goal.
        marking: Takes the space and the indicators, returns the functions to refine, as `mark` does; or the refined
            space itself, as `MarkingAhead` does. What it remembers is in no checkpoint.
        stop: When to end, a `Stop`; or takes the history after each step, and returns why the run ends, or None.
        callback: Called after each step with the `Step` and the solution. It may return numbers by name, as
            ``{"error": 1e-4}``, which become columns of the history; those of rank 0 count.
        progress: Show a progress bar (rank 0 does); None: only in a terminal.
        checkpoint: The file to write to, and to go on from. `checkpoint.read` finds the solution in it, too.

    Returns:
        The history with the last solution. The run ends as well where nothing can be refined, or levels would be finer
        than there are numbers for (30 or so).

    Raises:
        TypeError: If V is no space, or another argument no function; the problem is neither a problem nor a solution,
            or the indicators are no numbers; or `stop` returns no text, or the callback no numbers by name.
        ValueError: If the checkpoint is of another loop, space or mesh, or none that `checkpoint.read` can read; or the
            solution is in another space than the problem was made for, or has other unknowns than that before; or
            indicators are not one a cell, negative or not finite; or ranks have different estimates; or a name from the
            callback is taken.
    """
    check_space(V, "adapt.solve")
    check_called(problem=problem, estimator=estimator, marking=marking, stop=stop, callback=callback)
    run = begun(V) if checkpoint is None else resumed(checkpoint, V)
    V, reason = run.V, reason_of(run.V, stop(run.history)) if run.history.steps else None
    with _progress_bar(V, getattr(stop, "steps", None), len(run.history.steps), progress) as bar:
        while reason is None:
            start = time.perf_counter()
            try:
                if run.history.steps:
                    V = next_space(run.V, marking(run.V, run.eta))
                    if V.num_cells == run.V.num_cells:
                        reason = "no function is marked, or none that can be refined"
                        break
                u = _solution(V, problem(V), run.history.solution)
                eta, error = estimated(V, estimator(u))
            except TooDeepError as end:  # also of what estimators refine
                if not run.history.steps:
                    raise
                reason = str(end)
                break
            step = _step(V, u, len(run.history.steps), error, largest(V.mesh.comm, time.perf_counter() - start))
            if callback is not None:
                step = replace(step, values=numbers_of(V, callback(step, u)))
            run = replace(run, V=V, history=History((*run.history.steps, step), u), eta=eta)
            if checkpoint is not None:
                save(checkpoint, run)
            reason = reason_of(V, stop(run.history))
            bar.set_postfix(dofs=step.dofs, estimate=f"{abs(error):.2e}")
            bar.update()
    return replace(run.history, reason=reason)


def _progress_bar(V: FunctionSpace, most: int | None, done: int, progress: bool | None) -> Any:
    """Return a bar of a run that is to take at most so many steps after the first, if that is known."""
    from tqdm import tqdm

    return tqdm(
        total=None if most is None else most + 1,
        initial=done,
        desc="adaptive run",
        unit="step",
        disable=rank_of(V.mesh.comm) > 0 or (None if progress is None else not progress),
    )


def _step(V: FunctionSpace, u: Solution, number: int, error: float, seconds: float) -> Step:
    dofs = sum(function.function_space.num_dofs for function in listed(u))
    return Step(number, V.num_levels, V.num_cells, dofs, error, seconds, partition(V.hierarchy).imbalance)


def _is_solution(given: object) -> bool:
    several = isinstance(given, list | tuple) and len(given) > 0 and all(isinstance(u, Function) for u in given)
    return several or isinstance(given, Function)


def _solution(V: FunctionSpace, posed: Any, last: Any) -> Any:
    """Return the solution of what was posed in a space, from the last one if it looks at it."""
    if not _is_solution(posed):
        if not (hasattr(posed, "solve") and _is_solution(getattr(posed, "u", None))):
            raise TypeError(
                f"the problem in {V} is of type {type(posed).__name__}: give something that has a method solve() and "
                f"the function u that it solves for, as a LinearProblem does; or return the solution, a fem.Function "
                f"or a list of them"
            )
        if last is not None and (not hasattr(posed, "start_from_u") or posed.start_from_u()):
            _guess(posed.u, last)
        posed.solve()
        posed = posed.u
    spaces = [u.function_space for u in listed(posed)]
    # Of several unknowns others may be in spaces of their own, such as finer ones for velocities.
    if not any(_is_in(V, W) for W in spaces):
        elsewhere = "" if spaces[0].mesh is V.mesh else " on another mesh"
        raise ValueError(
            f"the problem was called with {V}, but its solution is in {spaces[0]}{elsewhere}: make its forms, "
            f"conditions and functions anew in the space that it is called with"
        )
    return posed


def _is_in(V: FunctionSpace, W: object) -> bool:
    return isinstance(W, FunctionSpace) and (W.hierarchy is V.hierarchy or W.hierarchy.same_as(V.hierarchy))


def _guess(u: Solution, last: Solution) -> None:
    """Give the unknowns the values of the last solution."""
    now, then = ([f.function_space.value_shape for f in listed(each)] for each in (u, last))
    if now != then:
        raise ValueError(
            f"the problem has unknowns with values of shape {now}, the last solution {then}: pose a problem for the "
            f"same unknowns in each step; if the last one is from the checkpoint of another problem, remove that"
        )
    for function, before in zip(listed(u), listed(last), strict=True):
        function.x.array = transfer(before, function.function_space).x.array
