"""What an adaptive run came to, step by step, and when it is to end."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from numbers import Real
from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["History", "Step", "Stop"]

Floats = npt.NDArray[np.float64]

# Columns of the table, and what of a step they show; callbacks add others.
COLUMNS = {"step": "number"} | {
    name: name for name in ("levels", "elements", "dofs", "estimate", "seconds", "imbalance")
}
FORMATS = {  # width and kind
    "step": (4, "d"),
    "levels": (6, "d"),
    "elements": (9, "d"),
    "dofs": (9, "d"),
    "estimate": (10, ".3e"),
    "rate": (5, ".2f"),
    "seconds": (8, ".2f"),
    "imbalance": (9, ".3f"),
}
COUNTS, NEAR_ONE, OTHERS = (8, ".0f"), (8, ".5f"), (10, ".3e")  # of columns from callbacks, by their numbers


@dataclass(frozen=True)
class Step:
    """What one step of an adaptive run came to.

    Attributes:
        number: Its number, from 0.
        levels: Number of levels of the space.
        elements: Number of active elements.
        dofs: Number of dofs of all unknowns.
        estimate: Estimate of the error; one of a goal may be negative.
        seconds: Wall time, on the slowest rank, without callback and checkpoint.
        imbalance: Weight of the cells of the rank that has most, relative to the mean.
        values: What the callback has returned, numbers by name.
    """

    number: int
    levels: int
    elements: int
    dofs: int
    estimate: float
    seconds: float
    imbalance: float = 1.0
    values: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Stop:
    """When an adaptive run is to end: as soon as one of these holds after a step. At least one is to be given.

    Attributes:
        tolerance: The estimate is, in absolute value, at most this; 0: whatever it is.
        dofs: There are at least so many dofs.
        levels: The space has at least so many levels.
        seconds: The steps took at least so long (`Step.seconds`), those before a resumption included.
        steps: The space was refined so many times; the problem was solved once more than that.

    Raises:
        ValueError: Nothing is given, or a value is out of range.
        TypeError: A count is no integer, or another value no number.
    """

    tolerance: float = 0.0
    dofs: int | None = None
    levels: int | None = None
    seconds: float | None = None
    steps: int | None = None

    def __post_init__(self) -> None:
        for name, least in (("dofs", 1), ("levels", 1), ("steps", 0)):
            count = getattr(self, name)
            if count is not None and not isinstance(count, int | np.integer):
                raise TypeError(f"{name} is {count!r}; it must be an integer")
            if count is not None and count < least:
                raise ValueError(f"{name} is {count}; it must be at least {least}")
        for name in ("tolerance", "seconds"):
            value = getattr(self, name)
            if not isinstance(value, Real) and not (name == "seconds" and value is None):
                raise TypeError(f"{name} is {value!r}; it must be a number")
        if not (np.isfinite(self.tolerance) and self.tolerance >= 0.0):
            raise ValueError(f"tolerance is {self.tolerance}; it must be finite and not negative")
        if self.seconds is not None and not self.seconds > 0.0:
            raise ValueError(f"seconds is {self.seconds}; it must be positive")
        if self.tolerance == 0.0 and all(x is None for x in (self.dofs, self.levels, self.seconds, self.steps)):
            raise ValueError(
                "nothing would end the run: give Stop a tolerance (above 0), dofs, levels, seconds or steps, or several"
            )

    def __call__(self, history: History) -> str | None:
        """Return why a run with this history ends; None: it goes on."""
        last, seconds = history.steps[-1], sum(step.seconds for step in history.steps)
        if 0.0 < self.tolerance and abs(last.estimate) <= self.tolerance:
            return f"estimate {abs(last.estimate):.3e}, within the tolerance {self.tolerance:.3e}"
        if self.dofs is not None and last.dofs >= self.dofs:
            return f"{last.dofs} of {self.dofs} dofs"
        if self.levels is not None and last.levels >= self.levels:
            return f"{last.levels} of {self.levels} levels"
        if self.seconds is not None and seconds >= self.seconds:
            return f"{seconds:.1f} of {self.seconds:.1f} seconds"
        if self.steps is not None and last.number >= self.steps:
            return f"{last.number} of {self.steps} steps"
        return None


@dataclass(frozen=True)
class History(Mapping[str, npt.NDArray[Any]]):
    """Steps of an adaptive run and the last solution: a mapping of columns, ``history["dofs"]``.

    ``print(history)`` shows them as a table, `plot.convergence` draws them, and ``dict(history)`` is what others take.

    Attributes:
        steps: The steps.
        solution: The last solution, a `Function`, or a list of them; None before the first step.
        reason: Why the run has ended; empty if it has not.
    """

    steps: tuple[Step, ...] = ()
    solution: Any = None
    reason: str = ""

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns: those that each run has, and those that the callback has named."""
        return tuple(dict.fromkeys([*COLUMNS, *(name for step in self.steps for name in step.values)]))

    def __getitem__(self, column: str) -> npt.NDArray[Any]:
        """Return a column, a number for each step, shape (num_steps,); NaN where the callback did not give it.

        Raises:
            KeyError: There is no such column.
        """
        if column in COLUMNS:
            return np.array([getattr(step, COLUMNS[column]) for step in self.steps])
        if column not in self.columns:
            rates = "; rates of a column are rates(column)" * (column == "rate")
            raise KeyError(f"there is no column {column!r}; there are {', '.join(self.columns)}{rates}")
        return np.array([step.values.get(column, np.nan) for step in self.steps])

    def __iter__(self) -> Iterator[str]:
        return iter(self.columns)

    def __len__(self) -> int:
        """Return the number of columns."""
        return len(self.columns)

    def rates(self, column: str = "estimate") -> Floats:
        """Return the rate r of a column that falls like dofs^-r from each step to the next, shape (num_steps,).

        The first is NaN, and so are those where the column is zero or the number of dofs stays the same.
        """
        rates = np.full(len(self.steps), np.nan)
        with np.errstate(divide="ignore", invalid="ignore"):
            falls, grows = np.diff(np.log(np.abs(self[column]))), np.diff(np.log(self["dofs"]))
            rates[1:] = np.where(np.isfinite(falls) & (grows != 0.0), -falls / grows, np.nan)
        return rates

    def rate(self, column: str = "estimate", last: int = 5) -> float:
        """Return the rate r of a column that falls like dofs^-r, by least squares over the logarithms of both.

        Args:
            column: Its name; signs are ignored, steps where it is zero or missing left out.
            last: Number of steps, counted from the end; fewer if there are no more.

        Raises:
            KeyError: There is no such column.
            ValueError: There are no two steps with different dofs.
        """
        values, dofs = np.abs(self[column][-last:]), self["dofs"][-last:]
        used = (values > 0.0) & np.isfinite(values)
        if last < 2 or np.unique(dofs[used]).size < 2:
            raise ValueError(
                f"the last {last} of {len(self.steps)} steps have not two values of {column!r} at different dofs: a "
                f"rate needs two"
            )
        return -float(np.polyfit(np.log(dofs[used]), np.log(values[used]), 1)[0])

    def __str__(self) -> str:
        others = [name for name in self.columns if name not in COLUMNS]
        shown = ["step", "levels", "elements", "dofs", "estimate", "rate", *others, "seconds"]
        if any(step.imbalance != 1.0 for step in self.steps):  # on several ranks
            shown.append("imbalance")
        columns = [self._printed(name) for name in shown]
        table = [" ".join(row) for row in zip(*columns, strict=True)]
        return "\n".join([*table, f"ended: {self.reason}"] if self.reason else table)

    def _printed(self, column: str) -> list[str]:
        """Return the head of a column and its numbers, all equally wide; blank where there is none."""
        values = self.rates() if column == "rate" else self[column]
        if column == "estimate":
            values = np.abs(values)
        width, kind = FORMATS.get(column, _format(values))
        width = max(width, len(column))
        return [f"{column:>{width}}", *(" " * width if np.isnan(x) else f"{x:{width}{kind}}" for x in values)]


def _format(values: Floats) -> tuple[int, str]:
    """Return width and kind for numbers of a callback."""
    sizes = np.abs(values[~np.isnan(values)])
    if (sizes == np.round(sizes)).all() and (sizes < 1e8).all():
        return COUNTS
    return NEAR_ONE if (sizes >= 0.1).all() and (sizes < 100.0).all() else OTHERS
