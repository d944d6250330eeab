"""The limit surface as facets, and the sides of the elements as lines.

Every bicubic piece is sampled here on a grid of n x n facets, with exact points, normals and values.  Linear
interpolation on n segments errs by at most 0.75 / n^2 times the largest second difference of Bernstein coefficients.
This gives n: no facet strays from the surface, and no gap opens between pieces, by as much as one could see.

On several ranks each gets the whole surface, from all of them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from thccs_fem import element
from thccs_fem.fem.function import Function
from thccs_fem.fem.space import FunctionSpace
from thccs_fem.parallel import total
from thccs_fem.positions import side_points
from thccs_fem.subdivision import Bools, Ints
from thccs_fem.vtk import cell_numbers, in_space, of_all_ranks

if TYPE_CHECKING:  # imported where it is needed: it takes its time
    import pyvista

__all__ = ["mesh_lines", "space_of", "surface"]

GAP = 1 / 15000  # error of points, of the surface's diameter: a tenth of a pixel of a picture
SHADE = 1 / 500  # error of values, of their range: half a colour of the bar
FACET = 1 / 100  # sides of facets, of the surface's diameter: else the eye finds the kinks in the colours
MOST_SEGMENTS = 64  # on a side of a piece
MOST_FACETS = 2_000_000  # in a picture, which takes some seconds
ROUNDING = 1e-9  # values that differ less, of the largest, are one

Floats = npt.NDArray[np.float64]


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
    V = space_of(uh)
    if isinstance(uh, Function):
        _check_finite(uh)
        values = uh.local_coefficients()
    else:
        values = np.zeros((V.cells.num_pieces, element.NUM_FUNCTIONS, 1))
    everywhere = partial(of_all_ranks, V.cells)
    numbers = {name: everywhere(array) for name, array in cell_numbers(V.cells).items()}
    points = _warped(uh, V.cells.piece_points, values, warp)
    return _Pieces(everywhere(points), everywhere(values), everywhere(V.cells.on_cell_edges), numbers)


def space_of(uh: Function | FunctionSpace) -> FunctionSpace:
    """Return the space of a function, or the space that is given; TypeError for anything else."""
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
