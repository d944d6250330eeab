"""Pictures of the limit surface coloured by a function, with the sides of the elements drawn on it."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from thccs_fem.fem.function import Function
from thccs_fem.fem.space import FunctionSpace
from thccs_fem.parallel import by_first_rank, together
from thccs_fem.plot import paths
from thccs_fem.plot.surfaces import ROUNDING, mesh_lines, space_of, surface
from thccs_fem.vtk import one_for_each_cell

if TYPE_CHECKING:  # imported where it is needed: it takes its time
    import pyvista

__all__ = ["plot"]

TOWARDS = np.array([0.55, -0.95, 0.8])  # the viewer of a surface in space
SHOWN = "shown"  # name of the values that colours stand for
LIGHT: dict[str, Any] = {"ambient": 0.4, "diffuse": 0.65, "specular": 0.1, "specular_power": 20.0}
MARGIN = 1.06  # what is seen, in terms of the surface
BAR = 0.14  # part of the picture's width that is left to the scalar bar
PLAIN = "#d5dbe3"  # colour of a surface without a function
FAINT = 20.0  # pixels: where cells are smaller, lines are faint, else one would see them alone
INK = "#20242c"  # colour of letters and of lines on it
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # of red, green and blue

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

    comm = space_of(uh).mesh.comm
    path = None if filename is None else by_first_rank(comm, lambda: paths.checked(Path(filename)))
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
    V = space_of(uh)
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
