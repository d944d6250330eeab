"""What adaptive runs came to, over their dofs."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt

from thccs_fem.fem.function import Function
from thccs_fem.parallel import by_first_rank
from thccs_fem.plot import paths

if TYPE_CHECKING:  # imported where it is needed: it takes its time
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["convergence"]

STYLES = ("o-", "s--", "^:", "D-.")  # of curves
DATELESS = {".svg": {"Date": None}, ".svgz": {"Date": None}, ".pdf": {"CreationDate": None}}  # the same file each time

Floats = npt.NDArray[np.float64]


class Table(Protocol):
    """Columns by name, as an `adapt.History` has them, or a dict of arrays."""

    def __getitem__(self, column: str, /) -> npt.ArrayLike:
        """Return a column, shape (num_steps,)."""


def convergence(
    histories: Table | Mapping[str, Table],
    filename: str | os.PathLike[str],
    *,
    columns: str | Sequence[str] = "estimate",
    slopes: float | Sequence[float] = (1.5, 2.0),
    title: str = "",
) -> Figure:
    """Draw columns of one or several adaptive runs over their dofs, on logarithmic scales; collective, rank 0 writes.

    Where a column has a sign its absolute value is drawn, and nothing where it is zero or not a number.

    Args:
        histories: What `adapt.solve` returned, or several runs by name: ``{"adaptive": one, "uniform": other}``. A dict
            of arrays, "dofs" one of them, does for a run as well.
        filename: The file to write, of any type that Matplotlib writes, such as PNG, PDF and SVG.
        columns: Their names, see `adapt.History.columns`; what a run lacks is left out.
        slopes: Rates r to compare with, one or several, in lines that fall like dofs^-r; () for none. Cubic functions
            come to 3/2 in H1, to 2 in L2.
        title: Title of the picture.

    Returns:
        The figure, which may be changed and written again; its ``axes[0]`` has the curves.

    Raises:
        KeyError: A column is in none of the runs.
        TypeError: A run is no table with a column of dofs.
        ValueError: There is nothing to draw, or a column is not as long as that of the dofs, or Matplotlib does not
            write files of this type.
        OSError: The file cannot be written.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    runs = _runs(histories)
    names = [columns] if isinstance(columns, str) else list(columns)
    if not names:
        raise ValueError("there are no columns to draw: give a name or several")
    curves = [_Curve(run, name, *found) for run in runs for name in names if (found := _points(runs[run], name))]
    missing = [name for name in names if name not in {curve.column for curve in curves}]
    if missing:
        raise KeyError(f"no run has a column {missing[0]!r} with values to draw")
    figure = Figure(figsize=(7.0, 5.0), layout="constrained")
    axes = figure.subplots()
    for curve in curves:
        i, j = list(runs).index(curve.run), names.index(curve.column)
        label = ", ".join(part for part, many in ((curve.run, runs), (curve.column, names)) if len(many) > 1)
        colour = f"C{i if len(runs) > 1 else j}"
        axes.loglog(curve.dofs, curve.values, STYLES[j % len(STYLES)], color=colour, markersize=4.0, label=label)
    _draw_slopes(axes, curves, [slopes] if isinstance(slopes, float | int) else slopes)
    axes.set(xlabel="dofs", ylabel=names[0] if len(names) == 1 else "", title=title)
    axes.grid(which="major", color="0.9")
    if len(curves) > 1:
        axes.legend(frameon=False)
    path = Path(filename)
    endings = [f".{ending}" for ending in figure.canvas.get_supported_filetypes()]

    def write() -> None:
        with rc_context({"svg.hashsalt": "convergence"}):  # or names in it would be random
            figure.savefig(paths.checked(path, endings), dpi=150, metadata=DATELESS.get(path.suffix.lower()))

    by_first_rank(_comm(runs), write)
    return figure


@dataclass(frozen=True, eq=False)
class _Curve:
    """A column of a run: where it is not zero, shapes (n,)."""

    run: str
    column: str
    dofs: Floats
    values: Floats


def _runs(histories: Any) -> dict[str, Any]:
    """Return the runs by name."""
    several = isinstance(histories, Mapping) and "dofs" not in histories
    runs = dict(histories) if several else {"": histories}
    if not runs:
        raise ValueError("there are no runs to draw: give a history, or several by name")
    for name, run in runs.items():
        try:
            run["dofs"]
        except (KeyError, IndexError, TypeError):
            which = f" {name!r}" if several else ""
            raise TypeError(
                f'the run{which}, of type {type(run).__name__}, has no column "dofs": give a history, or several by '
                f'name, as {{"adaptive": one, "uniform": other}}'
            ) from None
    return runs


def _points(run: Any, column: str) -> tuple[Floats, Floats] | None:
    """Return dofs and values of a column that has some to draw."""
    try:
        values = np.abs(np.asarray(run[column], dtype=np.float64))
    except KeyError:
        return None
    dofs = np.asarray(run["dofs"], dtype=np.float64)
    if values.shape != dofs.shape:
        raise ValueError(f"the column {column!r} has shape {values.shape}, that of the dofs {dofs.shape}")
    used = np.isfinite(values) & (values > 0.0)
    return (dofs[used], values[used]) if used.any() else None


def _comm(runs: Mapping[str, Any]) -> Any:
    """Return the communicator of the runs; None if none of them knows it."""
    for run in runs.values():
        u = getattr(run, "solution", None)
        if u is not None:
            return (u if isinstance(u, Function) else u[0]).function_space.mesh.comm
    return None


def _draw_slopes(axes: Axes, curves: Sequence[_Curve], slopes: Sequence[float]) -> None:
    """Draw lines that fall like dofs^-r from one point on, below all curves."""
    x, y = (np.concatenate([getattr(curve, name) for curve in curves]) for name in ("dofs", "values"))
    end = x.max()
    start = np.sqrt(x.min() * end)
    if not len(slopes) or start == end:
        return
    right = x >= start
    axes.set_xlim(right=end * (end / x.min()) ** 0.1)  # room for letters
    top = 0.5 * np.min(y[right] * (x[right] / start) ** min(slopes))
    for slope in slopes:
        bottom = top * (end / start) ** -slope
        axes.loglog([start, end], [top, bottom], color="0.5", linewidth=1.0)
        rate = Fraction(slope).limit_denominator(6)
        text = f"$N^{{-{rate if abs(rate - slope) < 1e-3 else f'{slope:.2g}'}}}$"
        axes.annotate(text, (end, bottom), (4, 0), textcoords="offset points", color="0.4", va="center")
