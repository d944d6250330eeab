"""What the user's functions return to an adaptive loop: the same on all ranks, or an error on all of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from thccs_fem import estimate
from thccs_fem.adapt.history import COLUMNS
from thccs_fem.adapt.remeshing import refine
from thccs_fem.fem.space import FunctionSpace
from thccs_fem.parallel import by_first_rank, largest, size_of, smallest, together, total
from thccs_fem.partition import partition

__all__ = ["check_called", "estimated", "next_space", "numbers_of", "reason_of"]

Floats = npt.NDArray[np.float64]

SAME = 1e-6  # relative difference of the estimates on the ranks that may be rounding
CALLED = {  # what arguments are functions of, and what does for one
    "problem": "the space, such as lambda V: LinearProblem(...) with forms in V",
    "estimator": "the solution, such as lambda uh: estimate.bubble(uh, a, L)",
    "marking": 'the space and the indicators, such as adapt.Marking("dorfler", 0.5)',
    "stop": "the history, such as adapt.Stop(tolerance=1e-3, dofs=10_000)",
    "callback": "the step and the solution",
}


def check_called(**given: object) -> None:
    """Raise TypeError where an argument of the loop, by name, is no function, other than a callback of None."""
    for name, value in given.items():
        if not callable(value) and not (name == "callback" and value is None):
            raise TypeError(f"{name} is of type {type(value).__name__}: give a function of {CALLED[name]}")


def estimated(V: FunctionSpace, returned: Any) -> tuple[Floats, float]:
    """Return the indicators and the estimate."""
    comm = V.mesh.comm
    eta, value = together(comm, lambda: _checked(partition(V.hierarchy).cells.size_local, returned))
    if not total(comm, int(value is not None)):
        return eta, estimate.norm(V, eta)
    mine = np.nan if value is None else value
    least, most = smallest(comm, mine), largest(comm, mine)
    for each in (least, most):
        if not np.isfinite(each):
            raise ValueError(f"the estimator returned the estimate {each}: it must be finite, on all ranks")
    if most - least > SAME * max(abs(least), abs(most)):
        raise ValueError(
            f"the estimator returned the estimate {least} on one rank, {most} on another: each must return that of the "
            f"whole, as V.mesh.comm.allreduce makes it of integrals over parts"
        )
    return eta, by_first_rank(comm, lambda: mine)


def _checked(num_cells: int, returned: Any) -> tuple[Floats, float | None]:
    """Return the indicators and the estimate, None where it is their norm."""
    wanted = f"one for each of the {num_cells} cells, ({num_cells},), or these and the estimate, (eta, estimate)"
    parts = returned if isinstance(returned, tuple) else (returned, 0.0)
    eta, value = (_real(part) for part in parts) if len(parts) == 2 else (None, None)
    if eta is None or value is None or value.shape:
        kinds = ", ".join(type(part).__name__ for part in parts)
        kind = f"a tuple ({kinds})" if parts is returned else f"a {type(returned).__name__}"
        raise TypeError(f"the estimator returned {kind}; it must return real indicators, {wanted}")
    if eta.shape != (num_cells,):
        raise ValueError(f"the estimator returned indicators of shape {eta.shape}; it needs {wanted}")
    bad = np.flatnonzero(~(np.isfinite(eta) & (eta >= 0.0)))
    if bad.size:
        raise ValueError(
            f"the estimator returned {eta[bad[0]]} for cell {bad[0]}, and {bad.size} such of {num_cells} indicators: "
            f"they must be finite and not negative; is the solution finite?"
        )
    return eta, float(value) if parts is returned else None


def _real(given: Any) -> Floats | None:
    """Return real numbers as an array; None if they are none."""
    try:
        array = np.asarray(given)
    except ValueError:  # of lists of arrays, say
        return None
    return array.astype(np.float64) if array.dtype.kind in "biuf" else None


def next_space(V: FunctionSpace, returned: Any) -> FunctionSpace:
    """Return the space that the marking has returned, or V refined where it has marked functions."""
    num_spaces = total(V.mesh.comm, int(isinstance(returned, FunctionSpace)))
    if not num_spaces:
        return refine(V, returned)
    if num_spaces < size_of(V.mesh.comm):
        raise ValueError("the marking returned a space on some ranks, functions on others: return the same on all")
    if returned.mesh is not V.mesh or not returned.hierarchy.is_refinement_of(V.hierarchy):
        elsewhere = " on another mesh" if returned.mesh is not V.mesh else ""
        raise ValueError(
            f"the marking returned {returned}{elsewhere}, which is no refinement of {V}: return functions of that to "
            f"refine, or a space that adapt.refine or a Prediction has made of it"
        )
    return returned


def reason_of(V: FunctionSpace, returned: object) -> str | None:
    """Return why the run ends, as rank 0 was told, on all ranks: clocks of others may say something else."""

    def checked() -> str | None:
        if not isinstance(returned, str | None):
            raise TypeError(f"stop returned {returned!r}: return text, why the run ends, or None to go on")
        return returned

    return by_first_rank(V.mesh.comm, checked)


def numbers_of(V: FunctionSpace, returned: Any) -> Mapping[str, float]:
    """Return the numbers of a callback, those of rank 0 on all ranks."""

    def checked() -> dict[str, float]:
        if not isinstance(returned, Mapping | None):
            raise TypeError(f"the callback returned a {type(returned).__name__}: return None, or numbers by name")
        for name, value in (returned or {}).items():
            if not isinstance(name, str) or (number := _real(value)) is None or number.shape:
                raise TypeError(f"the callback returned {value!r} under the name {name!r}: return real numbers by name")
            if name in COLUMNS or name == "rate":
                raise ValueError(f"the callback names a number {name!r}, as a column that is there: take another name")
        return {name: float(value) for name, value in (returned or {}).items()}

    return by_first_rank(V.mesh.comm, checked)
