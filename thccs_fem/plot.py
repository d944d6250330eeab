"""Pictures by PyVista: the limit surface coloured by a function, with the sides of the elements drawn on it.

Every bicubic piece is sampled here on a grid of n x n facets, at its exact points, with the exact normals and values.  The
error of linear interpolation, at most max |second difference of Bernstein coefficients| * 0.75 / n^2, gives n: no facet
strays from the surface, and so no gap between pieces opens, by as much as one could see.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from thccs_fem import element
from thccs_fem.extraction import Cells
from thccs_fem.fem.function import Function
from thccs_fem.fem.space import FunctionSpace
from thccs_fem.subdivision import Bools, Ints
from thccs_fem.vtk import cell_numbers, in_space

if TYPE_CHECKING:  # imported where it is needed: it takes its time
    import pyvista

__all__ = ["mesh_lines", "plot", "surface"]

GAP = 1 / 15000  # of the diameter of the surface: a tenth of a pixel of a picture
SHADE = 1 / 250  # of the range of values: as many colours are on the bar
MOST_SEGMENTS = 64  # on a side of a piece
MOST_FACETS = 2_000_000  # in a picture, which takes some seconds

# Picture
VIEW, UP = np.array([0.55, -0.95, 0.6]), np.array([0.0, 0.0, 1.0])  # from where surfaces in space are seen
MARGIN = 1.06  # what is seen, in terms of the surface
BAR = 0.14  # part of the picture's width for the scalar bar
PLAIN = "#d5dbe3"  # surface without a function
LINE = "#20242c"

# Corners of a piece; side k runs from corner k to corner k + 1.
CORNERS = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])

Floats = npt.NDArray[np.float64]


def plot(
    uh: Function | FunctionSpace,
    filename: str | os.PathLike[str] | None = None,
    *,
    camera: Any = None,
    clim: Sequence[float] | None = None,
    cmap: Any = "viridis",
    lines: bool = True,
    window_size: tuple[int, int] = (1600, 1200),
) -> None:
    """Draw a function, or only the elements of a space, on the limit surface.

    Args:
        uh: A function (of one with vector values the magnitude is drawn), or a space.
        filename: PNG file to write, also on machines without a display; None opens a window.
        camera: Camera position as PyVista takes it: "xy", "iso", a direction, or (position, focal point, up). By default
            planar surfaces are seen from above, others obliquely with z upwards.
        clim: Values at the ends of the colour map; by default those of the function.
        cmap: Colour map as PyVista takes it.
        lines: Whether to draw the sides of the elements.
        window_size: Width and height in pixels.

    Raises:
        TypeError: If `uh` is neither function nor space.
        ValueError: If the file is not called .png, or the function has values that are not finite.
        OSError: If the file cannot be written, or there is neither a display nor OpenGL to draw without one.
    """
    import pyvista

    path = None if filename is None else _checked(Path(filename))
    drawn = surface(uh)
    with pyvista.vtk_verbosity("off"):  # it would report on each kind of display that it doesn't find
        plotter = pyvista.Plotter(off_screen=path is not None or None, window_size=list(window_size))
    try:
        _check_display(plotter)
        plotter.set_background("white")
        plotter.enable_anti_aliasing("ssaa")
        _add_surface(plotter, drawn, uh, clim, cmap)
        if lines:
            _add_lines(plotter, uh)
        _set_camera(plotter, drawn.points, camera, bar=isinstance(uh, Function))
        if path is None:
            plotter.show()
        else:
            plotter.screenshot(path)
    finally:
        plotter.close()


def surface(uh: Function | FunctionSpace) -> pyvista.PolyData:
    """Return the limit surface as quadrilateral facets, for pictures of one's own.

    Point data are the normals and, by its name, the function; cell data those of `thccs_fem.vtk.cell_numbers`. Pieces
    share no points.

    Raises:
        TypeError: If `uh` is neither function nor space.
        ValueError: If the function has values that are not finite.
    """
    import pyvista

    cells, values = _cells(uh), _values(uh)
    points, normals, sampled, facets, piece = [], [], [], [], []
    for n, chosen, first in _groups(_segments(cells, values)):
        t = np.linspace(0.0, 1.0, n + 1)
        along, slopes = element.bspline_values(t), element.bspline_slopes(t)
        at, local = np.kron(along, along), cells.piece_points[chosen]
        points.append(at @ local)
        normals.append(_normals(np.kron(along, slopes) @ local, np.kron(slopes, along) @ local))
        sampled.append(at @ values[chosen])
        facets.append(first + _numbers(chosen.size, _facets(n), (n + 1) ** 2))
        piece.append(np.repeat(chosen, n * n))
    mesh = pyvista.PolyData.from_regular_faces(in_space(_joined(points)), np.concatenate(facets))
    mesh.point_data["Normals"] = _joined(normals)
    mesh.point_data.active_normals_name = "Normals"
    if isinstance(uh, Function):
        mesh.point_data[uh.name] = _joined(sampled) if uh.function_space.value_shape else _joined(sampled)[:, 0]
    for name, numbers in cell_numbers(cells).items():
        mesh.cell_data[name] = numbers[np.concatenate(piece)]
    return mesh


def mesh_lines(uh: Function | FunctionSpace) -> pyvista.PolyData:
    """Return the sides of the elements as lines on the limit surface, each side of each element for itself.

    The lines run along the facets of `surface`.

    Raises:
        TypeError, ValueError: As for `surface`.
    """
    import pyvista

    cells, values = _cells(uh), _values(uh)
    outer = _on_cell_boundary(cells)
    points, lines, first = [np.zeros((0, cells.points.shape[1]))], [], 0
    for n, chosen, _ in _groups(_segments(cells, values)):
        t = np.arange(n + 1)
        sides = np.stack([t, n + (n + 1) * t, (n + 1) * n + t, (n + 1) * t])
        along = element.bspline_values(t / n)
        piece, side = np.nonzero(outer[chosen])
        on_sides = np.kron(along, along)[sides]
        points.append(np.einsum("psc,psk->pck", on_sides))
    return pyvista.PolyData()
