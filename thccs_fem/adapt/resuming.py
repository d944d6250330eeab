"""Adaptive runs in a checkpoint: where they are, and how they go on from there.

Indicators are kept, not marks, so that a run that was at its end can go on with another rule or another end.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from thccs_fem import checkpoint
from thccs_fem.adapt.history import History, Step
from thccs_fem.fem.function import Function
from thccs_fem.fem.space import FunctionSpace, cellwise
from thccs_fem.parallel import by_first_rank

__all__ = ["Run", "Solution", "begun", "listed", "resumed", "save"]

Floats = npt.NDArray[np.float64]
type Solution = Function | Sequence[Function]


@dataclass(frozen=True, eq=False)
class Run:
    """Where a run is.

    Attributes:
        V: The last space.
        history: The steps, with the solution in that space.
        eta: Indicators of it, shape (cells.num_owned,); empty before the first step.
        began_with: Number of dofs of the space that it began with.
    """

    V: FunctionSpace
    history: History
    eta: Floats
    began_with: int


def begun(V: FunctionSpace) -> Run:
    """Return a run without any steps."""
    return Run(V, History(), np.zeros(0), V.num_dofs)


def listed(u: Solution) -> list[Function]:
    """Return the functions of a solution, one or several."""
    return [u] if isinstance(u, Function) else list(u)


def save(path: str | os.PathLike[str], run: Run) -> None:
    """Write what `solve` needs to go on."""
    u = run.history.solution
    names = [function.name for function in listed(u)]
    stored = names if len(set(names)) == len(names) else [f"{name} {i}" for i, name in enumerate(names)]
    functions = [f if f.name == name else f.copy(name) for f, name in zip(listed(u), stored, strict=True)]
    indicators = Function(cellwise(run.V), name=f"indicators of {stored[0]}")
    indicators.x.array[: run.eta.size] = run.eta
    attributes = {
        "steps": [asdict(step) for step in run.history.steps],
        "solution": stored[0] if isinstance(u, Function) else stored,
        "names": names,
        "began with": run.began_with,
    }
    checkpoint.write(path, [*functions, indicators], {"adapt.solve": attributes})


def resumed(path: str | os.PathLike[str], V: FunctionSpace) -> Run:
    """Return what `save` has written; if it has written nothing, a new run."""
    if not by_first_rank(V.mesh.comm, Path(path).exists):
        return begun(V)
    saved = checkpoint.read(path, mesh=V.mesh)
    if "adapt.solve" not in saved.attributes:
        raise ValueError(f"{path} was not written by adapt.solve: give another name, or remove it to begin anew")
    run = saved.attributes["adapt.solve"]
    stored = [run["solution"]] if isinstance(run["solution"], str) else run["solution"]
    unknowns = [saved.functions[name] for name in stored]
    indicators = saved.functions[f"indicators of {stored[0]}"]
    found = indicators.function_space.hierarchy
    kept = (found.unit, found.admissibility) == (V.hierarchy.unit, V.hierarchy.admissibility)
    if run["began with"] != V.num_dofs or not (kept and found.is_refinement_of(V.hierarchy)):
        raise ValueError(
            f"{path} is of a run that began with {run['began with']} dofs in another space than {V}: begin with the "
            f"same, or give another name, or remove the file to begin anew"
        )
    for function, name in zip(unknowns, run["names"], strict=True):
        function.name = name
    steps = tuple(Step(**step) for step in run["steps"])
    eta = indicators.x.array[: indicators.x.index_map.size_local]
    solution = unknowns[0] if isinstance(run["solution"], str) else unknowns
    return Run(V.with_hierarchy(found), History(steps, solution), eta, V.num_dofs)
