"""Faces as a user gives them, turned into arrays: CSR form, the edges that follow, areas, orientation.

A *corner* is an entry of `Polygons.vertices`, as in `thccs_fem.mesh`. Nothing here asks whether the faces are a mesh.
"""

import numbers
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from typing import Any, TypeGuard

import numpy as np
import numpy.typing as npt
from scipy.sparse import csgraph, csr_array

type Bools = npt.NDArray[np.bool_]
type Floats = npt.NDArray[np.float64]
type Ints = npt.NDArray[np.int32]
type Indices = npt.NDArray[np.integer]
type Pair = tuple[int, int]
type Faces = npt.ArrayLike | Sequence[npt.ArrayLike]


@dataclass(frozen=True, eq=False)
class Polygons:
    """Faces in CSR form and the edges that follow from them, be they a manifold or not."""

    offsets: Ints
    vertices: Ints
    num_vertices: int

    @property
    def num_faces(self) -> int:
        """Number of faces."""
        return self.offsets.size - 1

    @cached_property
    def sizes(self) -> Ints:
        """Number of corners of each face."""
        return np.diff(self.offsets)

    @cached_property
    def corner_faces(self) -> Ints:
        """Face of each corner."""
        return np.repeat(np.arange(self.num_faces, dtype=np.int32), self.sizes)

    @cached_property
    def following(self) -> Ints:
        """Next corner of the face, of each corner."""
        return following_corners(self.offsets)

    @cached_property
    def _edge_table(self) -> tuple[Indices, Indices, Indices]:
        """The corners sorted by edges, where each edge begins among these, and its key."""
        ends = self.vertices, self.vertices[self.following]
        keys = np.minimum(*ends) * np.int64(self.num_vertices) + np.maximum(*ends)
        order = np.argsort(keys, kind="stable")
        keys = keys[order]
        first = np.flatnonzero(np.diff(keys, prepend=-1))
        return order, first, keys[first]

    @cached_property
    def edges(self) -> Ints:
        """Smaller and larger vertex of each edge, shape (num_edges, 2)."""
        return np.column_stack(np.divmod(self._edge_table[2], self.num_vertices)).astype(np.int32)

    @cached_property
    def edge_sizes(self) -> Indices:
        """Number of faces of each edge."""
        return np.diff(self._edge_table[1], append=self.vertices.size)

    @cached_property
    def corner_edges(self) -> Ints:
        """Edge of each corner."""
        edges = np.zeros(self.vertices.size, dtype=np.int32)
        edges[self._edge_table[0]] = np.repeat(np.arange(self.edge_sizes.size), self.edge_sizes)
        return edges

    @cached_property
    def edge_corners(self) -> Ints:
        """First two corners of each edge, ascending, shape (num_edges, 2); -1 for no second."""
        order, first, _ = self._edge_table
        second = order[(first + 1).clip(max=order.size - 1)]
        second[self.edge_sizes == 1] = -1
        return np.column_stack([order[first], second]).astype(np.int32)

    @property
    def edge_faces(self) -> Ints:
        """First two faces of each edge, ascending, shape (num_edges, 2); -1 for no second."""
        corners = self.edge_corners
        return np.asarray(np.where(corners < 0, -1, self.corner_faces[corners]))

    @cached_property
    def twins(self) -> Ints:
        """The two corners of each edge with two faces, shape (2, number of these edges)."""
        return np.asarray(self.edge_corners[self.edge_sizes == 2].T)

    def corner_pairs(self) -> Iterator[tuple[int, Indices, Indices]]:
        """Yield every two corners of a face once, as those 1, 2, ... steps apart: steps, one, other."""
        start = np.repeat(self.offsets[:-1], self.sizes)
        size = np.repeat(self.sizes, self.sizes)
        local = np.arange(self.vertices.size, dtype=np.int32) - start
        for steps in range(1, int(self.sizes.max()) // 2 + 1):
            one = np.flatnonzero((2 * steps < size) | ((2 * steps == size) & (local < steps)))
            yield steps, one, start[one] + (local[one] + steps) % size[one]

    def named(self, faces: Indices) -> str:
        """Name a few of the faces, and the vertices of the first."""
        vertices = self.vertices[self.offsets[faces[0]] : self.offsets[faces[0] + 1]]
        return f"{some_of(faces)} (face {faces[0]}: vertices {some_of(vertices, 8)})"


def following_corners(offsets: Ints) -> Ints:
    """Return the next corner of the face, of each corner."""
    following = np.arange(1, offsets[-1] + 1, dtype=np.int32)
    following[offsets[1:] - 1] = offsets[:-1]
    return following


def previous_corners(offsets: Ints) -> Ints:
    """Return the corner before each, around its face."""
    previous = np.arange(-1, offsets[-1] - 1, dtype=np.int32)
    previous[offsets[:-1]] = offsets[1:] - 1
    return previous


def turned_over(polygons: Polygons, turned: Bools) -> Polygons:
    """Return the polygons, those marked walked the other way round from the same first corner."""
    start = np.repeat(polygons.offsets[:-1], polygons.sizes)
    local = np.arange(polygons.vertices.size, dtype=np.int32) - start
    back = np.where(local == 0, 0, np.repeat(polygons.sizes, polygons.sizes) - local)
    source = start + np.where(turned[polygons.corner_faces], back, local)
    return Polygons(polygons.offsets, polygons.vertices[source], polygons.num_vertices)


def face_sides(polygons: Polygons) -> tuple[Indices, Bools]:
    """Return the component of each face, and whether to turn it over to match the first of that.

    Raises:
        ValueError: A component has one side only.
    """
    # A face f has two sides, f and f + F. Across an edge each goes on in the same side of the other
    # face, or in its other side if the two faces run along the edge in the same direction. So an
    # orientable component makes two sheets of sides; on a one-sided one they are a single sheet.
    one, other = polygons.twins
    face, neighbour = polygons.corner_faces[one], polygons.corner_faces[other]
    same = polygons.vertices[one] == polygons.vertices[other]
    number = np.int32(polygons.num_faces)
    beyond = np.where(same, neighbour + number, neighbour)
    behind = np.where(same, neighbour, neighbour + number)
    graph = graph_of(np.append(face, face + number), np.append(beyond, behind), 2 * polygons.num_faces)
    front, back = csgraph.connected_components(graph, directed=False)[1].reshape(2, -1)
    one_sided = np.flatnonzero(front == back)
    if one_sided.size:
        raise ValueError(
            f"the surface can't be oriented: like a Moebius strip it has one side only, on the "
            f"component of faces {some_of(one_sided)}. Cut it open, or mend the way its faces join"
        )
    _, first, component = np.unique(np.minimum(front, back), return_index=True, return_inverse=True)
    return component, np.asarray(front != front[first][component])


def signed_content(points: Floats, polygons: Polygons, component: Indices) -> Floats:
    """Return the signed area of each component in the plane; in space its volume, 0 unless closed."""
    if points.shape[1] == 2:
        return np.bincount(component, face_areas(points[polygons.vertices], polygons)[:, 0])
    corners = (points - points.mean(axis=0))[polygons.vertices]
    centres = np.add.reduceat(corners, polygons.offsets[:-1]) / polygons.sizes[:, None]
    volumes = np.bincount(component, (face_areas(corners, polygons) * centres).sum(axis=1) / 3)
    rim = polygons.edge_corners[polygons.edge_sizes == 1, 0]
    volumes[component[polygons.corner_faces[rim]]] = 0.0
    return volumes


def face_areas(corners: Floats, polygons: Polygons) -> Floats:
    """Return the area of each face times its normal, (num_faces, 3); signed in 2D, (num_faces, 1).

    Args:
        corners: Coordinates of the corners, shape (num_corners, gdim).
        polygons: The faces.
    """
    starts = polygons.offsets[:-1]
    # From the first corner of each face, so that it does not matter where the mesh lies.
    x = corners - np.repeat(corners[starts], polygons.sizes, axis=0)
    y = x[polygons.following]
    planar = x.shape[1] == 2
    normals = x[:, :1] * y[:, 1:] - x[:, 1:] * y[:, :1] if planar else np.cross(x, y)
    return np.asarray(np.add.reduceat(normals, starts) / 2)


# What is given ------------------------------------------------------------------------------------


def vertex_array(vertices: npt.ArrayLike) -> Floats:
    """Return a copy of the coordinates: finite, float64, shape (n, 2) or (n, 3)."""
    expected = "expected coordinates of shape (num_vertices, 2) or (num_vertices, 3)"
    try:
        points = np.array(vertices)
    except ValueError as error:
        raise ValueError(f"vertices differ in their number of coordinates; {expected}") from error
    if points.size == 0:
        raise ValueError(f"the mesh is empty, without vertices; {expected}")
    if points.dtype.kind not in "iuf":
        raise TypeError(f"vertices are of type {points.dtype}; {expected}")
    if points.ndim != 2 or points.shape[1] not in (2, 3):
        raise ValueError(f"vertices have the shape {points.shape}; {expected}")
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if bad.size:
        raise ValueError(
            f"vertices {some_of(bad)} have a coordinate that is NaN or infinite "
            f"(vertex {bad[0]}: {points[bad[0]].tolist()})"
        )
    return points.astype(np.float64)


def read_polygons(faces: Faces, num_vertices: int) -> Polygons:
    """Return the faces in CSR form: three corners or more each, all of them vertices."""
    sizes, corners = _face_lists(faces)
    if sizes.size == 0:
        raise ValueError("the mesh is empty, without faces")
    small = np.flatnonzero(sizes < 3)
    if small.size:
        raise ValueError(f"faces {some_of(small)} have fewer than three corners (face {small[0]}: {sizes[small[0]]})")
    offsets = np.append(0, np.cumsum(sizes))
    outside = np.flatnonzero((corners < 0) | (corners >= num_vertices))
    if outside.size:
        named = np.unique(np.searchsorted(offsets, outside, side="right") - 1)
        raise ValueError(
            f"faces {some_of(named)} have corners out of range (face {named[0]}: "
            f"{corners[outside[0]]}): vertices are 0 to {num_vertices - 1}"
        )
    return Polygons(offsets.astype(np.int32), corners.astype(np.int32), num_vertices)


def _face_lists(faces: Any) -> tuple[Indices, Indices]:
    """Return the number of corners of each face, and all corners face by face."""
    expected = "expected integers of shape (num_faces, corners), or sequences of integers"
    if isinstance(faces, np.ndarray) and faces.dtype != object:
        if faces.ndim != 2:
            raise ValueError(f"faces have the shape {faces.shape}; {expected}")
        if faces.dtype.kind not in "iu":
            raise TypeError(f"faces are of type {faces.dtype}; {expected}")
        return np.full(faces.shape[0], faces.shape[1]), faces.ravel()
    try:
        sizes = np.fromiter(map(len, faces), dtype=np.int64)
        corners = list(chain.from_iterable(faces))
    except TypeError as error:
        raise TypeError(f"faces are not sequences ({error}); {expected}") from error
    wrong = {kind for kind in set(map(type, corners)) if not _is_integer_type(kind)}
    if wrong:
        where = next(i for i, corner in enumerate(corners) if type(corner) in wrong)
        face = np.searchsorted(np.cumsum(sizes), where, side="right")
        raise TypeError(f"face {face} has the corner {corners[where]!r}; {expected}")
    return sizes, np.array(corners, dtype=np.int64)


def face_tag_array(tags: npt.ArrayLike | None, num_faces: int) -> Ints:
    """Return a copy of the tags, int32 of shape (num_faces,)."""
    if tags is None:
        return np.zeros(num_faces, dtype=np.int32)
    array = np.asarray(tags)
    if array.shape != (num_faces,):
        raise ValueError(f"face_tags have the shape {array.shape}; expected ({num_faces},)")
    if array.dtype.kind not in "iu":
        raise TypeError(f"face_tags are of type {array.dtype}; expected integers")
    bounds = np.iinfo(np.int32)
    large = np.flatnonzero((array < bounds.min) | (array > bounds.max))
    if large.size:
        raise ValueError(
            f"face_tags of faces {some_of(large)} do not fit in 32 bits (face {large[0]}: {array[large[0]]})"
        )
    return array.astype(np.int32)


def as_mapping(name: str, values: object) -> Mapping[Any, object]:
    """Return the mapping; an empty one for None."""
    if values is None:
        return {}
    if not isinstance(values, Mapping):
        raise TypeError(f"{name} is of type {type(values).__name__}; expected a dict")
    return values


def as_tag(name: str, value: object) -> int:
    """Return a tag as an integer; raise TypeError if it is none."""
    if not is_integer(value):
        raise TypeError(f"{name} is {value!r}; expected an integer")
    return int(value)


def as_sharpness(name: str, value: object) -> float:
    """Return a sharpness as a number; raise TypeError or ValueError if it is none, or negative."""
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        raise TypeError(f"{name} is {value!r}; expected a number")
    sharpness = float(value)
    if not sharpness >= 0:  # nor NaN
        raise ValueError(f"{name} is {value}; expected a sharpness from 0 (smooth) to 10 (infinite) or more")
    return sharpness


def is_integer(value: object) -> TypeGuard[int]:
    """Return whether a value is an integer; booleans are not."""
    return _is_integer_type(type(value))


def _is_integer_type(kind: type) -> bool:
    return issubclass(kind, int | np.integer) and kind is not bool


# What the faces make ------------------------------------------------------------------------------


def graph_of(rows: Indices, columns: Indices, size: int) -> csr_array:
    """Return a graph as a sparse matrix, shape (size, size)."""
    return csr_array((np.ones(rows.size, dtype=bool), (rows, columns)), shape=(size, size))


def read_only(values: Indices) -> Ints:
    """Return the values as a read-only int32 array."""
    array = values.astype(np.int32)
    array.setflags(write=False)
    return array


def as_tuples(rows: Indices) -> list[tuple[int, ...]]:
    """Return the rows as tuples, to be named."""
    return [tuple(row) for row in rows.tolist()]


def some_of(items: Iterable[object], limit: int = 5) -> str:
    """Name the first few items and say how many more there are."""
    items = list(items)
    named = ", ".join(map(str, items[:limit]))
    return named if len(items) <= limit else f"{named} and {len(items) - limit} more"
