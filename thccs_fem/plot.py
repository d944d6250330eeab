"""Pictures by PyVista: the limit surface coloured by a function, with the sides of the elements drawn on it.

Every bicubic piece is sampled here on a grid of n x n facets, with exact points, normals and values.  Linear
interpolation on n segments errs by at most 0.75 / n^2 times the largest second difference of Bernstein coefficients.
This gives n: no facet strays from the surface, and no gap opens between pieces, by as much as one could see.

On several ranks each gets the whole surface, from all of them, and rank 0 draws.

`convergence` draws what adaptive runs came to, by Matplotlib.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt

from thccs_fem import element
from thccs_fem.fem.function import Function
from thccs_fem.fem.space import FunctionSpace
from thccs_fem.parallel import by_first_rank, together, total
from thccs_fem.positions import side_points
from thccs_fem.subdivision import Bools, Ints
from thccs_fem.vtk import cell_numbers, in_space, of_all_ranks, one_for_each_cell

if TYPE_CHECKING:  # imported where they are needed: they take their time
    import pyvista
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["convergence", "mesh_lines", "plot", "surface"]

GAP = 1 / 15000  # error of points, of the surface's diameter: a tenth of a pixel of a picture
SHADE = 1 / 500  # error of values, of their range: half a colour of the bar
FACET = 1 / 100  # sides of facets, of the surface's diameter: else the eye finds the kinks in the colours
MOST_SEGMENTS = 64  # on a side of a piece
MOST_FACETS = 2_000_000  # in a picture, which takes some seconds

TOWARDS = np.array([0.55, -0.95, 0.8])  # the viewer of a surface in space
SHOWN = "shown"  # name of the values that colours stand for
LIGHT: dict[str, Any] = {"ambient": 0.4, "diffuse": 0.65, "specular": 0.1, "specular_power": 20.0}
MARGIN = 1.06  # what is seen, in terms of the surface
BAR = 0.14  # part of the picture's width that is left to the scalar bar
PLAIN = "#d5dbe3"  # colour of a surface without a function
FAINT = 20.0  # pixels: where cells are smaller, lines are faint, else one would see them alone
INK = "#20242c"  # colour of letters and of lines on it
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # of red, green and blue
ROUNDING = 1e-9  # values that differ less, of the largest, are one
STYLES = ("o-", "s--", "^:", "D-.")  # of curves

Floats = npt.NDArray[np.float64]


def plot(
    uh: Function | FunctionSpace,
    filename: str | os.PathLike[str] | None = None,
    *,
    cell_data: Mapping[str, npt.ArrayLike] | None = None,
    camera: Any = None,
    clim: Sequence[float] | None = None,
    cmap: Any = "viridis",
    lines: bool = True,
    warp: float = 0.0,
    window_size: tuple[int, int] = (1600, 1200),
) -> None:
    """Draw a function, or only the elements of a space, on the limit surface; collective, and rank 0 draws.

    Args:
        uh: A function (of one with vector values the magnitude is drawn), or a space.
        filename: PNG file to write, also on a machine without a display; None opens a window.
        cell_data: Colour the elements by this instead: one name and the values for each of them that this rank owns,
            such as estimates, of shape (cells.num_owned,), which is (num_cells,) in serial. On a scale of powers of
            ten: {"log10 of the error": np.log10(eta)}.
        camera: Camera position as PyVista takes it: "xy", "iso", ..., a direction towards the viewer, or (position,
            focal point, up). By default planar surfaces are seen from above, others obliquely with z upwards.
        clim: Values at the ends of the colour map; by default the least and the largest there are.
        cmap: Colour map as PyVista takes it.
        lines: Whether to draw the sides of the elements.
        warp: Draw a function on a planar domain as a graph, this times the values high; move the points of the surface
            by this times a function with as many components as they have.
        window_size: Width and height in pixels.

    Raises:
        TypeError: If `uh` is neither function nor space.
        ValueError: If the file is not called .png, the function or cell data have values that are not finite, cell data
            have more than one name or not one value for each element, the function can not warp the surface, or `clim`
            is no interval.
        OSError: If the file cannot be written, or there is nothing to draw on.
    """
    import pyvista

    comm = _space(uh).mesh.comm
    path = None if filename is None else by_first_rank(comm, lambda: _checked(Path(filename)))
    shown = _shown(uh, cell_data)
    facets, sides = surface(uh, warp=warp), mesh_lines(uh, warp=warp) if lines else None

    def draw() -> None:
        with pyvista.vtk_verbosity("off"):  # it would complain of every kind of display that it doesn't find
            plotter: Any = pyvista.Plotter(off_screen=path is not None or None, window_size=list(window_size))
        try:
            _check_there_is_something_to_draw_on(plotter)
            plotter.set_background("white")
            plotter.enable_anti_aliasing("ssaa")
            if shown is None:
                _draw(plotter, facets, sides, {"color": PLAIN}, {"color": INK})
            else:
                _draw_coloured(plotter, shown, facets, sides, clim, cmap)
            _set_camera(plotter, facets.points, camera, 0.0 if shown is None else BAR)
            if path is None:
                plotter.show()
            else:
                plotter.screenshot(path)
        finally:
            if path is not None:  # else show() has closed it, unless it lives on in a notebook
                plotter.close()

    by_first_rank(comm, draw)


class Table(Protocol):
    """Columns by name, as an `adapt.History` has them, or a dict of arrays."""

    def __getitem__(self, column: str, /) -> npt.ArrayLike:
        """Return a column, shape (num_steps,)."""


def convergence(
    histories: Table | Mapping[str, Table],
    filename: str | os.PathLike[str],
    *,
    columns: str | Sequence[str] = "estimate",
    slopes: Sequence[float] = (1.5, 2.0),
    title: str = "",
) -> Figure:
    """Draw columns of one or several adaptive runs over their dofs, on logarithmic scales; collective, rank 0 writes.

    Where a column has a sign its absolute value is drawn, and nothing where it is zero or not a number.

    Args:
        histories: What `adapt.solve` returned, or several runs by name: ``{"adaptive": one, "uniform": other}``. A dict
            of arrays, "dofs" one of them, does for a run as well.
        filename: The file to write, of any type that Matplotlib writes, such as PNG, PDF and SVG.
        columns: Their names, see `adapt.History.columns`; what a run lacks is left out.
        slopes: Rates r to compare with, in lines that fall like dofs^-r. Cubic functions come to 3/2 in H1, to 2 in L2.
        title: Title of the picture.

    Returns:
        The figure, which may be changed and written again; its ``axes[0]`` has the curves.

    Raises:
        KeyError: A column is in none of the runs.
        ValueError: There is nothing to draw, or Matplotlib does not write files of this type.
        OSError: The file cannot be written.
    """
    from matplotlib.figure import Figure

    runs = _runs(histories)
    names = [columns] if isinstance(columns, str) else list(columns)
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
    _draw_slopes(axes, curves, slopes)
    axes.set(xlabel="dofs", ylabel=names[0] if len(names) == 1 else "", title=title)
    axes.grid(which="major", color="0.9")
    if len(curves) > 1:
        axes.legend(frameon=False)
    path = Path(filename)
    endings = [f".{ending}" for ending in figure.canvas.get_supported_filetypes()]
    by_first_rank(_comm(runs), lambda: figure.savefig(_checked(path, endings), dpi=150))
    return figure


def surface(uh: Function | FunctionSpace, *, warp: float = 0.0) -> pyvista.PolyData:
    """Return the limit surface as facets, for pictures of one's own; collective, and the whole of it on every rank.

    Point data are the normals and, by its name, the function; cell data are the numbers of `vtk.cell_numbers`. Pieces
    share no points.

    Args:
        uh: The function, or a space.
        warp: As for `plot`.

    Raises:
        TypeError: If `uh` is neither function nor space.
        ValueError: If the function has values that are not finite or can not warp the surface.
    """
    import pyvista

    drawn = _pieces(uh, warp)
    points, normals, sampled, facets, piece = [], [], [], [], []
    num_points = 0
    for n, pieces in _by_segments(drawn.points, drawn.values):
        t = np.linspace(0.0, 1.0, n + 1)
        along, slopes = element.bspline_values(t), element.bspline_slopes(t)
        local = drawn.points[pieces]
        points.append(_on_grid(along, along, local))
        normals.append(_normals(_on_grid(slopes, along, local), _on_grid(along, slopes, local)))
        sampled.append(_on_grid(along, along, drawn.values[pieces]))
        facets.append(num_points + _grid_facets(pieces.size, n))
        piece.append(np.repeat(pieces, n * n))
        num_points += len(points[-1])
    faces: Any = np.concatenate(facets)  # pyvista's types want Python's int
    mesh = pyvista.PolyData.from_regular_faces(in_space(np.concatenate(points)), faces)
    mesh.point_data.active_normals = np.concatenate(normals)
    _add_values(mesh, uh, np.concatenate(sampled))
    piece_of_facet = np.concatenate(piece)
    for name, numbers in drawn.numbers.items():
        mesh.cell_data[name] = numbers[piece_of_facet]
    return mesh


def mesh_lines(uh: Function | FunctionSpace, *, warp: float = 0.0) -> pyvista.PolyData:
    """Return the sides of the elements as lines along the facets of `surface`; elements share no lines. Collective.

    Point data are the function, by its name; cell data the number "cell" of the element.

    Args:
        uh: The function, or a space.
        warp: As for `plot`.

    Raises:
        TypeError, ValueError: As for `surface`.
    """
    import pyvista

    drawn = _pieces(uh, warp)
    points, sampled, lines, cell = [], [], [], []
    num_points = 0
    for n, pieces in _by_segments(drawn.points, drawn.values):
        k, side = np.nonzero(drawn.on_cell_edges[pieces])
        piece, on_sides = pieces[k], _on_sides(n)[side]
        points.append((on_sides @ drawn.points[piece]).reshape(-1, drawn.points.shape[2]))
        sampled.append((on_sides @ drawn.values[piece]).reshape(-1, drawn.values.shape[2]))
        number = num_points + np.arange(len(points[-1])).reshape(-1, n + 1)
        lines.append(np.insert(number, 0, n + 1, axis=1).ravel())
        cell.append(drawn.numbers["cell"][piece])
        num_points += number.size
    mesh = pyvista.PolyData(in_space(np.concatenate(points)), lines=np.concatenate(lines))
    _add_values(mesh, uh, np.concatenate(sampled))
    mesh.cell_data["cell"] = np.concatenate(cell)
    return mesh


def _add_values(mesh: pyvista.PolyData, uh: Function | FunctionSpace, values: Floats) -> None:
    if isinstance(uh, Function):
        mesh.point_data[uh.name] = values if uh.function_space.value_shape else values[:, 0]


@dataclass(frozen=True, eq=False)
class _Pieces:
    """What is drawn: the pieces of all ranks.

    Attributes:
        points: Local B-spline coefficients of the points, shape (num_pieces, 16, 2 or 3).
        values: Those of the values, shape (num_pieces, 16, k); zero for a space.
        on_cell_edges: Which sides lie on the edges of cells, shape (num_pieces, 4).
        numbers: Those of `vtk.cell_numbers`.
    """

    points: Floats
    values: Floats
    on_cell_edges: Bools
    numbers: Mapping[str, Ints]


def _pieces(uh: Function | FunctionSpace, warp: float) -> _Pieces:
    """Return the pieces of all ranks; collective."""
    V = _space(uh)
    if isinstance(uh, Function):
        _check_finite(uh)
        values = uh.local_coefficients()
    else:
        values = np.zeros((V.cells.num_pieces, element.NUM_FUNCTIONS, 1))
    everywhere = partial(of_all_ranks, V.cells)
    numbers = {name: everywhere(array) for name, array in cell_numbers(V.cells).items()}
    points = _warped(uh, V.cells.piece_points, values, warp)
    return _Pieces(everywhere(points), everywhere(values), everywhere(V.cells.on_cell_edges), numbers)


def _space(uh: Function | FunctionSpace) -> FunctionSpace:
    if not isinstance(uh, Function | FunctionSpace):
        raise TypeError(f"expected a Function or a FunctionSpace, got {type(uh).__name__}")
    return uh.function_space if isinstance(uh, Function) else uh


def _check_finite(uh: Function) -> None:
    """Raise ValueError if there are coefficients that are none; collective."""
    V = uh.function_space
    strange = total(V.mesh.comm, np.count_nonzero(~np.isfinite(uh.x.array[: V.num_owned_dofs])))
    if strange:
        raise ValueError(
            f"{strange} of the {V.num_dofs} coefficients of {uh.name!r} are infinite or not a number: see how they "
            f"were computed (did the solver diverge?)"
        )


def _warped(uh: Function | FunctionSpace, points: Floats, values: Floats, warp: float) -> Floats:
    """Return local B-spline coefficients of the points to draw, from those of the surface and of the values."""
    if warp == 0.0:
        return points
    if not np.isfinite(warp):
        raise ValueError(f"warp is {warp}; expected a finite factor")
    size, gdim = values.shape[2], points.shape[2]
    if isinstance(uh, FunctionSpace) or not (size == gdim or (size == 1 and gdim == 2)):
        what = "a space" if isinstance(uh, FunctionSpace) else f"{uh.name!r}, with {size} component(s),"
        raise ValueError(
            f"{what} can not warp a surface in {gdim} dimensions: warp draws the graph of a function on a planar "
            f"domain, or moves points by a function with as many components as they have; leave warp out"
        )
    return points + warp * values if size == gdim else np.concatenate([points, warp * values], axis=2)


def _by_segments(points: Floats, values: Floats) -> Iterator[tuple[int, Ints]]:
    """Yield numbers of segments along a side and the pieces that are to have so many."""
    diameter, value_range = (np.linalg.norm(np.ptp(x, axis=(0, 1))) for x in (points, values))
    seen = max(SHADE * value_range, ROUNDING * np.abs(values).max(), np.finfo(float).tiny)
    squared = 0.75 * np.maximum(_difference(points, 2) / (GAP * diameter), _difference(values, 2) / seen)
    wanted = np.maximum(np.sqrt(squared), 3.0 * _difference(points, 1) / (FACET * diameter))
    segments = 2 ** np.ceil(np.log2(np.clip(wanted, 1, MOST_SEGMENTS))).astype(np.int64)
    while np.sum(segments**2) > MOST_FACETS and segments.max() > 1:
        segments = np.maximum(segments // 2, 1)
    for n in np.unique(segments):
        yield int(n), np.flatnonzero(segments == n).astype(np.int32)


def _difference(local: Floats, order: int) -> Floats:
    """Return the largest difference of that order of Bernstein coefficients along u or v, shape (num_pieces,)."""
    bernstein = (element.TO_BERNSTEIN @ local).reshape(-1, 4, 4, local.shape[2])
    differences = [np.linalg.norm(np.diff(bernstein, order, axis=axis), axis=-1) for axis in (1, 2)]
    return np.maximum(*(d.max(axis=(1, 2)) for d in differences))


def _on_grid(along_u: Floats, along_v: Floats, local: Floats) -> Floats:
    """Return values on the grids of pieces, u fastest, shape (num_pieces (n + 1)^2, k), given B-splines on u and v."""
    return (np.kron(along_v, along_u) @ local).reshape(-1, local.shape[2])


def _normals(du: Floats, dv: Floats) -> Floats:
    """Return the unit normals, shape (n, 3), from derivatives; zero where these are parallel."""
    normals = np.cross(in_space(du), in_space(dv))
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return normals / np.where(length > 0.0, length, 1.0)


def _grid_facets(num_pieces: int, n: int) -> npt.NDArray[np.int_]:
    """Return the corners of the facets on the grids of all pieces, shape (num_pieces n^2, 4)."""
    first = np.add.outer(np.arange(num_pieces) * (n + 1) ** 2, np.add.outer(np.arange(n) * (n + 1), np.arange(n)))
    return np.add.outer(first, [0, 1, n + 2, n + 1]).reshape(-1, 4)


def _on_sides(n: int) -> Floats:
    """Return the B-splines on the sides of a piece, from corner to corner, shape (4, n + 1, 16)."""
    return element.bicubic_values(side_points(np.linspace(0.0, 1.0, n + 1)))


def _checked(path: Path, endings: Sequence[str] = (".png",)) -> Path:
    """Return the path of a picture if it can be one."""
    if path.suffix not in endings:
        raise ValueError(f"the picture is to be called {str(path)!r}, but the name must end in {', '.join(endings)}")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"there is no directory {str(path.parent)!r} for {path.name!r}; make it first")
    return path


def _check_there_is_something_to_draw_on(plotter: pyvista.Plotter) -> None:
    """Raise OSError where VTK would crash or wait for ever."""
    if plotter.off_screen:
        window: Any = plotter.render_window
        window.Initialize()
        if not window.IsCurrent():
            raise OSError(
                "VTK found no OpenGL to draw with: install Mesa's EGL or OSMesa (on Debian and Ubuntu: apt install "
                "libegl1 libgl1-mesa-dri), or run under xvfb-run"
            )
    elif sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
        raise OSError(
            "there is no display to open a window on (DISPLAY is not set): give a filename to write a picture"
        )


@dataclass(frozen=True)
class _Shown:
    """What colours stand for: its name, and values at the points of facets or lines, or for these themselves."""

    title: str
    values: Callable[[pyvista.PolyData], Floats]
    of_cells: bool

    def add_to(self, drawn: pyvista.PolyData) -> Floats:
        values = self.values(drawn)
        (drawn.cell_data if self.of_cells else drawn.point_data)[SHOWN] = values
        return values


def _shown(uh: Function | FunctionSpace, cell_data: Mapping[str, npt.ArrayLike] | None) -> _Shown | None:
    """Return what is to be shown on the elements, None for nothing; collective."""
    V = _space(uh)
    if cell_data is not None:
        if len(cell_data) != 1:
            raise ValueError(f"cell data have the names {list(cell_data)}: a picture can show one; give that")
        ((name, given),) = cell_data.items()
        owned = together(V.mesh.comm, lambda: one_for_each_cell(V.cells, name, given).astype(np.float64))
        values = V.cells.partition.cells.gather(owned)
        if not np.isfinite(values).all():
            first = int(np.flatnonzero(~np.isfinite(values))[0])
            raise ValueError(f"cell data {name!r} of cell {first} are {values[first]}: give finite values")
        return _Shown(name, lambda drawn: values[drawn.cell_data["cell"]], of_cells=True)
    if isinstance(uh, FunctionSpace):
        return None
    title = f"magnitude of {uh.name}" if uh.function_space.value_shape else uh.name
    return _Shown(title, lambda drawn: _magnitude(drawn.point_data[uh.name]), of_cells=False)


def _draw_coloured(
    plotter: pyvista.Plotter,
    shown: _Shown,
    facets: pyvista.PolyData,
    sides: pyvista.PolyData | None,
    clim: Sequence[float] | None,
    cmap: Any,
) -> None:
    """Draw a surface with colours that stand for values, and lines that stand out on these colours."""
    import pyvista

    value = shown.add_to(facets)
    low, high = _range(value) if clim is None else _checked_range(clim)
    table = pyvista.LookupTable(cmap, scalar_range=(low, high))
    preference = "cell" if shown.of_cells else "point"
    line_colours = {}
    if sides is not None:
        line_colours = {"scalars": _standing_out(table(shown.values(sides))), "rgb": True, "preference": preference}
    colours = {"scalars": SHOWN, "cmap": table, "show_scalar_bar": False, "preference": preference}
    actor = _draw(plotter, facets, sides, colours, line_colours)
    _add_bar(plotter, actor.mapper, shown.title, low, high)


def _draw(
    plotter: pyvista.Plotter,
    facets: pyvista.PolyData,
    sides: pyvista.PolyData | None,
    colours: dict[str, Any],
    line_colours: dict[str, Any],
) -> pyvista.Actor:
    """Draw a surface, shaded unless it is flat, and lines on it; return the surface drawn."""
    # Neighbours with different n leave holes of a pixel's size. Lines in the colours of the surface close them.
    seams = facets.extract_feature_edges(
        boundary_edges=True, non_manifold_edges=False, feature_edges=False, manifold_edges=False
    )
    actors = [
        plotter.add_mesh(drawn, lighting=not _is_flat(facets.points), line_width=1.0, **LIGHT, **colours)
        for drawn in (facets, seams)
    ]
    for actor in actors:
        actor.prop.interpolation = "Phong"  # with the normals given
        actor.mapper.SetResolveCoincidentTopologyToPolygonOffset()
    # What is at one place is drawn in this order: lines, seams, facets.
    actors[0].mapper.SetRelativeCoincidentTopologyPolygonOffsetParameters(2.0, 4.0)
    actors[1].mapper.SetRelativeCoincidentTopologyLineOffsetParameters(1.0, 2.0)
    if sides is not None:
        width, height = plotter.window_size
        cell_size = np.sqrt(width * height / (1 + facets.cell_data["cell"].max()))  # in pixels, roughly
        faint = {"opacity": max(cell_size / FAINT, 0.2)} if cell_size < FAINT else {}
        plotter.add_mesh(sides, lighting=False, line_width=max(height / 600.0, 2.0), **faint, **line_colours)
    return actors[0]


def _standing_out(colours: Floats) -> npt.NDArray[np.uint8]:
    """Return colours of lines that can be seen on those given, shape (n, 3): darker, or lighter than what is dark."""
    rgb = colours[:, :3]
    dark = (rgb @ LUMINANCE)[:, None] < 0.15
    return (255 * np.where(dark, 0.7 * rgb + 0.3, 0.25 * rgb)).astype(np.uint8)


def _magnitude(values: Floats) -> Floats:
    return np.asarray(values if values.ndim == 1 else np.linalg.norm(values, axis=1))


def _range(values: Floats) -> tuple[float, float]:
    """Return the least and the largest value, or an interval around them where these are the same to rounding."""
    low, high = float(values.min()), float(values.max())
    largest = max(abs(low), abs(high))
    if high - low > ROUNDING * largest:
        return low, high
    return low - (largest or 1.0) / 2.0, high + (largest or 1.0) / 2.0


def _checked_range(clim: Sequence[float]) -> tuple[float, float]:
    low, high = clim
    if not -np.inf < low < high < np.inf:
        raise ValueError(f"clim is {clim!r}; expected two finite numbers, the lower one first")
    return low, high


def _add_bar(plotter: pyvista.Plotter, mapper: pyvista.DataSetMapper, title: str, low: float, high: float) -> None:
    """Add a scalar bar with round numbers on the right."""
    import pyvista

    width, height = plotter.window_size
    left, bottom, tall = 1.0 - BAR + 0.01, 0.15, 0.7
    letters = min(height / 32.0, BAR * width / (0.6 * max(len(title), 1)))  # a letter is about 0.6 as wide as high
    plotter.add_text(
        title, position=(left, bottom + tall + 0.02), viewport=True, font_size=int(letters / 2.0), color=INK
    )
    ticks, form = _ticks(low, high)
    bar = plotter.scalar_bars.add_scalar_bar(
        mapper=mapper,
        vertical=True,
        color=INK,
        fmt=form,
        position_x=left,
        position_y=bottom,
        width=BAR - 0.02,
        height=tall,
        label_font_size=height // 38,
    )
    bar.SetBarRatio(0.25)
    bar.SetTextPad(height // 200)
    bar.SetUseCustomLabels(True)
    bar.SetCustomLabels(pyvista.convert_array(ticks))


def _ticks(low: float, high: float) -> tuple[Floats, str]:
    """Return four to ten round numbers in an interval, and a format that tells them apart."""
    power = 10.0 ** np.floor(np.log10((high - low) / 4.0))
    step = power * max(k for k in (1.0, 2.0, 5.0) if 4.0 * k * power <= (high - low) * (1.0 + 1e-9))
    ticks = step * np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1.0) + 0.0  # no -0
    digits = np.floor(np.log10(np.abs(ticks).max())) - np.floor(np.log10(power)) + 1.0
    return ticks, f"%.{int(digits)}g"


def _set_camera(plotter: pyvista.Plotter, points: Floats, camera: Any, bar: float) -> None:
    """Look as the user wants, or so that the surface fills what the bar leaves of the picture."""
    view = plotter.camera
    if camera is not None:
        plotter.camera_position = camera
        if not isinstance(camera, str) and np.ndim(camera) != 1:
            return
        towards, up = np.array(view.position) - view.focal_point, np.array(view.up)
    elif _is_flat(points):
        towards, up = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0])
    else:
        towards, up = TOWARDS, np.array([0.0, 0.0, 1.0])
    towards = towards / np.linalg.norm(towards)
    right = np.cross(up, towards)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(towards, right), towards])
    seen = points @ axes.T
    low, high = seen.min(axis=0), seen.max(axis=0)
    size = high - low
    aspect = plotter.window_size[0] / plotter.window_size[1]
    height = MARGIN * max(size[1], size[0] / (aspect * (1.0 - bar)))
    focus = (low + high) / 2.0 + np.array([bar / 2.0 * aspect * height, 0.0, 0.0])
    view.parallel_projection = True
    view.parallel_scale = height / 2.0
    view.focal_point = focus @ axes
    view.position = (focus + np.array([0.0, 0.0, 2.0 * np.linalg.norm(size)])) @ axes
    view.up = axes[1]
    plotter.reset_camera_clipping_range()


def _is_flat(points: Floats) -> bool:
    return not points[:, 2].any()


# ---- Curves ----------------------------------------------------------------------------------------------------------


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
    return runs


def _points(run: Any, column: str) -> tuple[Floats, Floats] | None:
    """Return dofs and values of a column that has some to draw."""
    try:
        values = np.abs(np.asarray(run[column], dtype=np.float64))
    except KeyError:
        return None
    used = np.isfinite(values) & (values > 0.0)
    return (np.asarray(run["dofs"], dtype=np.float64)[used], values[used]) if used.any() else None


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
