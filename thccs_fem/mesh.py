"""Control meshes: polygons in the plane or in space, checked once at construction, never changed.

Faces are kept in CSR form. A *corner* is an entry of ``face_vertices``: it belongs to one face,
sits at one vertex, and its edge runs from there to the next corner of the face. Corners run
counter-clockwise around the normal of their face.

Orders: vertices and faces are the user's; edges are pairs (smaller vertex, larger vertex) in
lexicographic order; the two faces of an edge are in ascending order.
"""

import numbers
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeGuard

import numpy as np
import numpy.typing as npt
from scipy.sparse import csgraph, csr_array
from scipy.spatial import KDTree

import ufl
from thccs_fem import element

__all__ = ["ControlMesh", "end_faces", "orient"]

type Bools = npt.NDArray[np.bool_]
type Floats = npt.NDArray[np.float64]
type Ints = npt.NDArray[np.int32]
type Indices = npt.NDArray[np.integer]
type Pair = tuple[int, int]
type Faces = npt.ArrayLike | Sequence[npt.ArrayLike]

COINCIDENT_CORNERS = 1e-12  # two corners of a face this close are an error; of the mesh's diameter
COINCIDENT_RIM = 1e-8  # boundary vertices this close are a crack; of the mesh's diameter
CROSSING_GAP = 0.01  # edges that pass this close cross; of the distance of their ends (0.03 occurs in good meshes)
ZERO_AREA = 1e-12  # of the sum of the squared edge lengths of the face
PARALLEL = 1e-14  # squared sine of the angle of parallel edges: it is a difference of terms near 1


class Domain(ufl.Mesh):
    """What a control mesh is for UFL; it leads back to it, for forms without any function.

    Args:
        mesh: The control mesh, kept as `control_mesh`.
    """

    def __init__(self, mesh: "ControlMesh") -> None:
        super().__init__(element.coordinate_element(mesh.gdim))  # type: ignore[no-untyped-call]  # UFL's
        self.control_mesh = mesh


@dataclass(frozen=True, eq=False, init=False, repr=False)
class ControlMesh:
    """A polygonal control mesh: an oriented manifold of one or more components, with or without rim.

    Two meshes are never equal: each is a UFL domain of its own.

    Args:
        vertices: Finite coordinates, shape (num_vertices, 2) or (num_vertices, 3).
        faces: Vertices of each face, three or more, counted from 0: integers of shape
            (num_faces, corners), or a sequence of sequences. Two faces run along their common edge
            in opposite directions; in the plane all faces run counter-clockwise.
        face_tags: Integers, shape (num_faces,); zeros when None.
        edge_tags: Integers of some edges, ``{(i, j): tag}`` with i and j in any order.
        creases: Sharpness of some edges, ``{(i, j): sharpness}``; 10 and more is infinite.
        corners: Sharpness of some vertices, ``{i: sharpness}``; 10 and more is infinite.
        comm: MPI communicator of the ranks that work on the mesh, each of which holds the whole of
            it; None in serial.

    Attributes:
        vertices: Coordinates, shape (num_vertices, gdim), float64.
        face_offsets: First corner of each face, then the number of corners, shape
            (num_faces + 1,), int32.
        face_vertices: Vertex of each corner, face by face, shape (num_corners,), int32.
        face_edges: Edge from each corner to the next of its face, shape (num_corners,), int32.
        face_tags: Shape (num_faces,), int32.
        edges: Vertices of each edge, shape (num_edges, 2), int32.
        edge_faces: Faces of each edge, shape (num_edges, 2), int32; on the boundary the second is
            -1.
        edge_tags: Tags by (i, j) with i < j.
        creases: Sharpness by (i, j) with i < j.
        corners: Sharpness by vertex.
        comm: The communicator given.

    All arrays and mappings are read-only.

    Raises:
        TypeError: Vertices, faces, tags or sharpnesses are not of the type above.
        ValueError: A shape, an index or a coordinate is wrong; the faces are no oriented manifold;
            a face has no area, crosses itself or is clockwise in the plane; or a tag or a sharpness
            is for an edge or a vertex that is not there.

    Warns:
        UserWarning: Boundary vertices coincide: the mesh has a crack.

    >>> points = [(0, 0), (1, 0), (1, 1), (0, 1)]
    >>> square = ControlMesh(points, [(0, 1, 2, 3)], edge_tags={(1, 0): 7})
    >>> square
    ControlMesh(gdim=2, num_vertices=4, num_edges=4, num_faces=1)
    >>> square.edge_tags[0, 1], square.boundary_loops[0].tolist()
    (7, [0, 1, 2, 3])
    """

    vertices: Floats
    face_offsets: Ints
    face_vertices: Ints
    face_edges: Ints
    face_tags: Ints
    edges: Ints
    edge_faces: Ints
    edge_tags: Mapping[Pair, int]
    creases: Mapping[Pair, float]
    corners: Mapping[int, float]
    comm: Any  # mpi4py is optional, so that its types can't be named here

    def __init__(
        self,
        vertices: npt.ArrayLike,
        faces: Faces,
        face_tags: npt.ArrayLike | None = None,
        edge_tags: Mapping[Pair, int] | None = None,
        creases: Mapping[Pair, float] | None = None,
        corners: Mapping[int, float] | None = None,
        comm: Any = None,
    ) -> None:
        points = _vertex_array(vertices)
        polygons = _polygons(faces, len(points))
        _check_faces(polygons)
        _check_shapes(points, polygons)  # first: a bow-tie also breaks up the fans at its corners
        _check_edges(polygons)
        _check_orientation(polygons)
        _check_fans(polygons)
        self._set(
            vertices=points,
            face_offsets=polygons.offsets,
            face_vertices=polygons.vertices,
            face_edges=polygons.corner_edges,
            face_tags=_face_tag_array(face_tags, polygons.num_faces),
            edges=polygons.edges,
            edge_faces=polygons.edge_faces,
            comm=comm,
        )
        self._set(
            edge_tags=self._on_edges("edge_tags", edge_tags, _tag),
            creases=self._on_edges("creases", creases, _sharpness),
            corners=self._on_vertices("corners", corners, _sharpness),
        )
        if self.gdim == 2:
            self._check_counter_clockwise(_areas(points[polygons.vertices], polygons)[:, 0])
        self._warn_of_cracks()

    def __repr__(self) -> str:
        names = ("gdim", "num_vertices", "num_edges", "num_faces")
        return f"ControlMesh({', '.join(f'{name}={getattr(self, name)}' for name in names)})"

    @property
    def gdim(self) -> int:
        """Dimension of the space that the mesh lies in: 2 or 3."""
        return int(self.vertices.shape[1])

    @property
    def num_vertices(self) -> int:
        """Number of vertices."""
        return len(self.vertices)

    @property
    def num_faces(self) -> int:
        """Number of faces."""
        return len(self.face_tags)

    @property
    def num_edges(self) -> int:
        """Number of edges."""
        return len(self.edges)

    @cached_property
    def face_sizes(self) -> Ints:
        """Number of corners of each face, shape (num_faces,)."""
        return _read_only(np.diff(self.face_offsets))

    @cached_property
    def is_quad(self) -> bool:
        """Whether every face has four corners."""
        return bool((self.face_sizes == 4).all())

    @property
    def quads(self) -> Ints:
        """Vertices of the faces of an all-quad mesh, shape (num_faces, 4).

        Raises:
            ValueError: Some face has another number of corners.
        """
        if not self.is_quad:
            others = _some(np.flatnonzero(self.face_sizes != 4))
            raise ValueError(
                f"faces {others} do not have four corners: the mesh is not all quads. "
                f"Use face_offsets and face_vertices"
            )
        return self.face_vertices.reshape(-1, 4)

    @cached_property
    def boundary_edges(self) -> Ints:
        """Edges of one face only, ascending."""
        return _read_only(np.flatnonzero(self.edge_faces[:, 1] < 0))

    @cached_property
    def boundary_vertices(self) -> Ints:
        """Vertices of the boundary edges, ascending."""
        return _read_only(np.unique(self.edges[self.boundary_edges]))

    @cached_property
    def boundary_loops(self) -> tuple[Ints, ...]:
        """Vertices of each closed loop of boundary edges, walked with the faces to the left.

        A loop begins with its smallest vertex; the loops are in the order of these.
        """
        rim = np.flatnonzero(self.edge_faces[self.face_edges, 1] < 0)
        if not rim.size:
            return ()
        n, following = self.num_vertices, _following(self.face_offsets)
        begin, end = self.face_vertices[rim], self.face_vertices[following[rim]]
        _, loop = csgraph.connected_components(_graph(begin, end, n), directed=False)
        _, where = np.unique(loop[self.boundary_vertices], return_index=True)
        first = self.boundary_vertices[where]
        # From an extra vertex that leads to the first of each loop, a depth-first walk goes round
        # one loop after the other.
        graph = _graph(np.append(begin, np.full(first.size, n)), np.append(end, first), n + 1)
        walk = csgraph.depth_first_order(graph, n, return_predecessors=False)[1:]
        loops = np.split(walk, np.flatnonzero(np.isin(walk, first))[1:])
        return tuple(_read_only(loop) for loop in sorted(loops, key=lambda loop: int(loop[0])))

    @cached_property
    def vertex_num_faces(self) -> Ints:
        """Number of faces at each vertex, shape (num_vertices,)."""
        return _read_only(np.bincount(self.face_vertices))

    @cached_property
    def valences(self) -> Ints:
        """Number of edges at each vertex, shape (num_vertices,)."""
        return _read_only(np.bincount(self.edges.ravel()))

    @cached_property
    def _is_extraordinary(self) -> Bools:
        """Whether each vertex is in the interior and has other than four edges, (num_vertices,)."""
        rim = np.zeros(self.num_vertices, dtype=bool)
        rim[self.boundary_vertices] = True
        return np.asarray(~rim & (self.valences != 4))

    @property
    def extraordinary_vertices(self) -> dict[int, int]:
        """Valences of the interior vertices that have other than four edges, by vertex."""
        vertices = np.flatnonzero(self._is_extraordinary)
        return dict(zip(vertices.tolist(), self.valences[vertices].tolist(), strict=True))

    @cached_property
    def invalid_faces(self) -> Ints:
        """Faces with two or more interior extraordinary vertices ("invalid elements"), ascending."""
        extraordinary = self._is_extraordinary[self.face_vertices].astype(np.int32)
        return _read_only(np.flatnonzero(np.add.reduceat(extraordinary, self.face_offsets[:-1]) >= 2))

    @property
    def num_invalid_faces(self) -> int:
        """Number of `invalid_faces`."""
        return int(self.invalid_faces.size)

    @cached_property
    def vertex_components(self) -> Ints:
        """Connected component of each vertex, shape (num_vertices,)."""
        graph = _graph(self.edges[:, 0], self.edges[:, 1], self.num_vertices)
        return _read_only(csgraph.connected_components(graph, directed=False)[1])

    @property
    def num_components(self) -> int:
        """Number of connected components."""
        return int(self.vertex_components.max()) + 1

    @property
    def euler_characteristic(self) -> int:
        """Number of vertices minus number of edges plus number of faces."""
        return self.num_vertices - self.num_edges + self.num_faces

    @property
    def genus(self) -> int:
        """Number of handles, summed over the components."""
        # Each component has the Euler characteristic 2 - 2 genus - loops.
        loops = len(self.boundary_loops)
        return (2 * self.num_components - loops - self.euler_characteristic) // 2

    def edge_indices(self, pairs: npt.ArrayLike) -> Ints:
        """Find edges by their vertices.

        Args:
            pairs: The two vertices of each edge in any order, integers of shape (m, 2).

        Returns:
            Index of each edge, or -1 where no edge joins the two vertices, shape (m,).
        """
        low, high = np.sort(np.asarray(pairs, dtype=np.int64).reshape(-1, 2), axis=1).T
        n = self.num_vertices
        keys, known = low * n + high, self.edges[:, 0] * np.int64(n) + self.edges[:, 1]
        found = np.searchsorted(known, keys).clip(max=known.size - 1)
        # What is no vertex could make the key of another edge.
        exists = (known[found] == keys) & (low >= 0) & (high < n)
        return np.where(exists, found, -1).astype(np.int32)

    def ufl_domain(self) -> Domain:
        """Return the UFL domain of the mesh, the same object at every call."""
        return self._domain

    @cached_property
    def _domain(self) -> Domain:
        return Domain(self)

    def _set(self, **attributes: object) -> None:
        for name, value in attributes.items():
            if isinstance(value, np.ndarray):
                value.setflags(write=False)
            object.__setattr__(self, name, value)  # the class is frozen

    def _on_edges[T](self, name: str, given: object, checked: Callable[[str, object], T]) -> Mapping[Pair, T]:
        """Return the checked values by ordered pairs of vertices, each of which is an edge."""
        values = _mapping(name, given)
        for key in values:
            if not (isinstance(key, tuple) and len(key) == 2 and all(map(_is_integer, key))):
                raise TypeError(f"{name} has the key {key!r}; expected two vertices, (i, j)")
        edges = self.edge_indices(list(values)).tolist()
        missing = [pair for pair, edge in zip(values, edges, strict=True) if edge < 0]
        if missing:
            raise ValueError(f"{name} has values for {_some(missing)}: the mesh has no such edge")
        ordered: dict[Pair, T] = {}
        for (i, j), given_value in values.items():
            pair, value = (int(min(i, j)), int(max(i, j))), checked(f"{name}[{i}, {j}]", given_value)
            if ordered.setdefault(pair, value) != value:
                both = f"{ordered[pair]} and {value}"
                raise ValueError(f"{name} has two values for edge {pair}, {both}: give one")
        return MappingProxyType(ordered)

    def _on_vertices[T](self, name: str, given: object, checked: Callable[[str, object], T]) -> Mapping[int, T]:
        """Return the checked values by vertices, each of which exists."""
        values = _mapping(name, given)
        for key in values:
            if not _is_integer(key):
                raise TypeError(f"{name} has the key {key!r}; expected a vertex, an integer")
        missing = [vertex for vertex in values if not 0 <= vertex < self.num_vertices]
        if missing:
            raise ValueError(f"{name} has values for {_some(missing)}: vertices are 0 to {self.num_vertices - 1}")
        return MappingProxyType({int(v): checked(f"{name}[{v}]", values[v]) for v in values})

    def _check_counter_clockwise(self, areas: Floats) -> None:
        """Raise ValueError if faces in the plane are clockwise.

        Args:
            areas: Signed areas of the faces, shape (num_faces,).
        """
        clockwise = areas < 0
        if not clockwise.any():
            return
        component = self.vertex_components[self.face_vertices[self.face_offsets[:-1]]]
        size = np.bincount(component)
        number = np.bincount(component[clockwise], minlength=size.size)
        mixed = (number > 0) & (number < size)
        if mixed.any():
            minority = clockwise == (2 * number <= size)[component]
            raise ValueError(
                f"faces {_some(np.flatnonzero(minority & mixed[component]))} are turned over: "
                f"their signed area has not the sign of the faces that they are joined to, "
                f"so the mesh is folded in the plane. Move their vertices"
            )
        which = f"faces {_some(np.flatnonzero(clockwise))}"
        if clockwise.all():
            which = f"all {clockwise.size} faces"
        raise ValueError(
            f"{which} are clockwise; in the plane they must be counter-clockwise. "
            f"mesh.orient(vertices, faces) repairs it"
        )

    def _warn_of_cracks(self) -> None:
        """Warn of boundary vertices that coincide."""
        rim = self.boundary_vertices
        if not rim.size:
            return
        points = self.vertices[rim]
        reach = COINCIDENT_RIM * np.linalg.norm(np.ptp(self.vertices, axis=0))
        # Nearest to a vertex are itself and, if one is in reach, another; rim.size is for none.
        _, near = KDTree(points).query(points, k=2, distance_upper_bound=reach)
        vertex = np.arange(rim.size)
        other = np.where(near[:, 0] == vertex, near[:, 1], near[:, 0])
        pairs = np.column_stack([vertex, other])[other < rim.size]
        if pairs.size:
            pairs = np.unique(np.sort(rim[pairs], axis=1), axis=0)
            warnings.warn(
                f"boundary vertices {_some(_tuples(pairs))} coincide: the mesh has a crack, across "
                f"which nothing is continuous. Merge them unless that is meant",
                skip_file_prefixes=(str(Path(__file__).parent),),
            )


def orient(vertices: npt.ArrayLike, faces: Faces) -> Ints | list[list[int]]:
    """Turn faces over so that every two run along their common edge in opposite directions.

    In the plane all faces become counter-clockwise. In space a closed component gets its normals
    outward (a positive volume), and any other component keeps the side of its first face. A face
    that is turned over keeps its first corner.

    Args:
        vertices: Coordinates, as of a `ControlMesh`.
        faces: Vertices of each face, as of a `ControlMesh`.

    Returns:
        The faces in the order given: int32 of shape (num_faces, corners), or a list of lists if
        they differ in their number of corners.

    Raises:
        TypeError: Vertices or faces are not of the type above.
        ValueError: The surface has one side only, an edge has more than two faces, or a shape, an
            index or a coordinate is wrong.

    >>> points = [(0, 0), (1, 0), (2, 0), (0, 1), (1, 1), (2, 1)]
    >>> orient(points, [(0, 3, 4, 1), (1, 2, 5, 4)]).tolist()
    [[0, 1, 4, 3], [1, 2, 5, 4]]
    """
    points = _vertex_array(vertices)
    polygons = _polygons(faces, len(points))
    _check_faces(polygons)
    _check_edges(polygons)
    component, turned = _sides(polygons)
    content = _signed_content(points, _turned_over(polygons, turned), component)
    oriented = _turned_over(polygons, turned ^ (content < 0)[component])
    if (oriented.sizes == oriented.sizes[0]).all():
        return oriented.vertices.reshape(oriented.num_faces, -1)
    return [face.tolist() for face in np.split(oriented.vertices, oriented.offsets[1:-1])]


def end_faces(mesh: ControlMesh, share: float = 0.02) -> tuple[Ints, Ints]:
    """Find the faces at both ends of a mesh: regions for conditions on a surface that has no tags.

    In each connected component these are the faces whose centres come first and last along its
    longest axis (the first principal one, in the direction of its largest coordinate).

    Args:
        mesh: The mesh.
        share: Part of the faces of a component at either end, at most a half; at least one face.

    Returns:
        The faces at the one end and at the other, ascending.

    Raises:
        ValueError: share is not in (0, 1/2], or a component has a single face.

    >>> from thccs_fem.generators import rectangle
    >>> [faces.tolist() for faces in end_faces(rectangle((5, 2)), share=0.2)]
    [[0, 5], [4, 9]]
    """
    if not 0.0 < share <= 0.5:
        raise ValueError(f"share is {share}: expected a part of the faces at either end, in (0, 1/2]")
    face = np.repeat(np.arange(mesh.num_faces), mesh.face_sizes)
    sums = [np.bincount(face, weights=x) for x in mesh.vertices[mesh.face_vertices].T]
    centres = np.column_stack(sums) / mesh.face_sizes[:, None]
    component = mesh.vertex_components[mesh.face_vertices[mesh.face_offsets[:-1]]]
    ends = []
    for faces in np.split(np.argsort(component, kind="stable"), np.cumsum(np.bincount(component))[:-1]):
        if faces.size < 2:
            raise ValueError(f"face {faces[0]} is a component of its own: it has no two ends")
        x = centres[faces] - centres[faces].mean(axis=0)
        axis = np.linalg.svd(x, full_matrices=False)[2][0]
        order = faces[np.argsort(x @ axis * np.sign(axis[np.abs(axis).argmax()]), kind="stable")]
        count = max(1, int(share * faces.size))
        ends.append((order[:count], order[-count:]))
    first, last = (_read_only(np.sort(np.concatenate(end))) for end in zip(*ends, strict=True))
    return first, last


@dataclass(frozen=True, eq=False)
class _Polygons:
    """Faces in CSR form and the edges that follow from them, be they a manifold or not."""

    offsets: Ints
    vertices: Ints
    num_vertices: int

    @property
    def num_faces(self) -> int:
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
        return _following(self.offsets)

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
        return f"{_some(faces)} (face {faces[0]}: vertices {_some(vertices, 8)})"


def _following(offsets: Ints) -> Ints:
    """Return the next corner of the face, of each corner."""
    following = np.arange(1, offsets[-1] + 1, dtype=np.int32)
    following[offsets[1:] - 1] = offsets[:-1]
    return following


def _turned_over(polygons: _Polygons, turned: Bools) -> _Polygons:
    """Return the polygons, those marked walked the other way round from the same first corner."""
    start = np.repeat(polygons.offsets[:-1], polygons.sizes)
    local = np.arange(polygons.vertices.size, dtype=np.int32) - start
    back = np.where(local == 0, 0, np.repeat(polygons.sizes, polygons.sizes) - local)
    source = start + np.where(turned[polygons.corner_faces], back, local)
    return _Polygons(polygons.offsets, polygons.vertices[source], polygons.num_vertices)


def _sides(polygons: _Polygons) -> tuple[Indices, Bools]:
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
    graph = _graph(np.append(face, face + number), np.append(beyond, behind), 2 * polygons.num_faces)
    front, back = csgraph.connected_components(graph, directed=False)[1].reshape(2, -1)
    one_sided = np.flatnonzero(front == back)
    if one_sided.size:
        raise ValueError(
            f"the surface can't be oriented: like a Moebius strip it has one side only, on the "
            f"component of faces {_some(one_sided)}. Cut it open, or mend the way its faces join"
        )
    _, first, component = np.unique(np.minimum(front, back), return_index=True, return_inverse=True)
    return component, np.asarray(front != front[first][component])


def _signed_content(points: Floats, polygons: _Polygons, component: Indices) -> Floats:
    """Return the signed area of each component in the plane; in space its volume, 0 unless closed."""
    if points.shape[1] == 2:
        return np.bincount(component, _areas(points[polygons.vertices], polygons)[:, 0])
    corners = (points - points.mean(axis=0))[polygons.vertices]
    centres = np.add.reduceat(corners, polygons.offsets[:-1]) / polygons.sizes[:, None]
    volumes = np.bincount(component, (_areas(corners, polygons) * centres).sum(axis=1) / 3)
    rim = polygons.edge_corners[polygons.edge_sizes == 1, 0]
    volumes[component[polygons.corner_faces[rim]]] = 0.0
    return volumes


def _areas(corners: Floats, polygons: _Polygons) -> Floats:
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


def _vertex_array(vertices: npt.ArrayLike) -> Floats:
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
            f"vertices {_some(bad)} have a coordinate that is NaN or infinite "
            f"(vertex {bad[0]}: {points[bad[0]].tolist()})"
        )
    return points.astype(np.float64)


def _polygons(faces: Faces, num_vertices: int) -> _Polygons:
    """Return the faces in CSR form: three corners or more each, all of them vertices."""
    sizes, corners = _face_lists(faces)
    if sizes.size == 0:
        raise ValueError("the mesh is empty, without faces")
    small = np.flatnonzero(sizes < 3)
    if small.size:
        raise ValueError(f"faces {_some(small)} have fewer than three corners (face {small[0]}: {sizes[small[0]]})")
    offsets = np.append(0, np.cumsum(sizes))
    outside = np.flatnonzero((corners < 0) | (corners >= num_vertices))
    if outside.size:
        named = np.unique(np.searchsorted(offsets, outside, side="right") - 1)
        raise ValueError(
            f"faces {_some(named)} have corners out of range (face {named[0]}: "
            f"{corners[outside[0]]}): vertices are 0 to {num_vertices - 1}"
        )
    return _Polygons(offsets.astype(np.int32), corners.astype(np.int32), num_vertices)


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


def _face_tag_array(tags: npt.ArrayLike | None, num_faces: int) -> Ints:
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
            f"face_tags of faces {_some(large)} do not fit in 32 bits (face {large[0]}: {array[large[0]]})"
        )
    return array.astype(np.int32)


def _mapping(name: str, values: object) -> Mapping[Any, object]:
    """Return the mapping; an empty one for None."""
    if values is None:
        return {}
    if not isinstance(values, Mapping):
        raise TypeError(f"{name} is of type {type(values).__name__}; expected a dict")
    return values


def _tag(name: str, value: object) -> int:
    if not _is_integer(value):
        raise TypeError(f"{name} is {value!r}; expected an integer")
    return int(value)


def _sharpness(name: str, value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        raise TypeError(f"{name} is {value!r}; expected a number")
    sharpness = float(value)
    if not sharpness >= 0:  # nor NaN
        raise ValueError(f"{name} is {value}; expected a sharpness from 0 (smooth) to 10 (infinite) or more")
    return sharpness


def _is_integer(value: object) -> TypeGuard[int]:
    return _is_integer_type(type(value))


def _is_integer_type(kind: type) -> bool:
    return issubclass(kind, int | np.integer) and kind is not bool


# What the faces make ------------------------------------------------------------------------------


def _check_faces(polygons: _Polygons) -> None:
    """Raise ValueError if a face repeats a vertex or another face, or if a vertex is isolated."""
    v = polygons.vertices
    twice = [one[v[one] == v[other]] for _, one, other in polygons.corner_pairs()]
    _refuse(polygons, twice, "have a vertex twice: leave one out")
    for size in np.unique(polygons.sizes):
        faces = np.flatnonzero(polygons.sizes == size)
        rows = v[polygons.offsets[faces][:, None] + np.arange(size)]
        rows.sort(axis=1)
        order = np.lexsort(rows.T)
        equal = (rows[order[1:]] == rows[order[:-1]]).all(axis=1)
        if equal.any():
            pairs = np.sort(faces[np.column_stack([order[:-1], order[1:]])[equal]], axis=1)
            raise ValueError(f"faces {_some(_tuples(pairs))} have the same vertices: leave one out")
    number = np.bincount(v, minlength=polygons.num_vertices)
    isolated = np.flatnonzero(number == 0)
    if isolated.size:
        raise ValueError(f"vertices {_some(isolated)} are isolated: no face has them. Leave them out")


def _check_edges(polygons: _Polygons) -> None:
    """Raise ValueError if an edge has more than two faces."""
    edges = np.flatnonzero(polygons.edge_sizes > 2)
    if edges.size:
        pairs = _tuples(polygons.edges[edges])
        faces = polygons.corner_faces[polygons.corner_edges == edges[0]]
        raise ValueError(
            f"edges {_some(pairs)} have more than two faces (edge {pairs[0]}: faces "
            f"{_some(faces)}): the mesh is not a manifold. Leave faces out, or give each sheet "
            f"vertices of its own"
        )


def _check_orientation(polygons: _Polygons) -> None:
    """Raise ValueError if two faces run along an edge in the same direction."""
    one, other = polygons.twins
    same = np.flatnonzero(polygons.vertices[one] == polygons.vertices[other])
    if same.size:
        corner = one[same[0]]
        begin, end = polygons.vertices[[corner, polygons.following[corner]]]
        faces = polygons.corner_faces[[corner, other[same[0]]]]
        more = f" (and so on at {same.size - 1} more edges)" if same.size > 1 else ""
        raise ValueError(
            f"faces {faces[0]} and {faces[1]} run along edge ({begin}, {end}) in the same "
            f"direction{more}: the mesh is not consistently oriented. "
            f"mesh.orient(vertices, faces) repairs it"
        )


def _check_fans(polygons: _Polygons) -> None:
    """Raise ValueError if the faces at a vertex make more than one fan."""
    # In an oriented mesh the corner after a corner's twin is at the same vertex, one face further.
    one, other = polygons.twins
    beyond = polygons.following[np.append(other, one)]
    graph = _graph(np.append(one, other), beyond, polygons.vertices.size)
    number, fan = csgraph.connected_components(graph, directed=False)
    if number == polygons.num_vertices:
        return
    _, corners = np.unique(fan, return_index=True)
    fans = np.bincount(polygons.vertices[corners])
    vertices = np.flatnonzero(fans > 1)
    faces = np.unique(polygons.corner_faces[polygons.vertices == vertices[0]])
    raise ValueError(
        f"vertices {_some(vertices)} join fans of faces that have no edge in common (vertex "
        f"{vertices[0]}: {fans[vertices[0]]} fans of faces {_some(faces)}): the mesh is not a "
        f"manifold. Give each fan a vertex of its own"
    )


# Where the faces lie ------------------------------------------------------------------------------


def _check_shapes(points: Floats, polygons: _Polygons) -> None:
    """Raise ValueError if a face has two corners in one place, crosses itself or has no area."""
    diameter = np.linalg.norm(np.ptp(points, axis=0))
    if diameter == 0:
        raise ValueError(f"the mesh has no area: all its vertices are at {points[0].tolist()}")
    unit = (points - points.mean(axis=0)) / diameter  # squares of these neither overflow nor vanish
    corners = unit[polygons.vertices]
    together, crossing = [], []
    for steps, one, other in polygons.corner_pairs():
        together.append(one[_squared(corners[one] - corners[other]) <= COINCIDENT_CORNERS**2])
        if steps > 1:  # edges that have no corner in common
            crossing.append(one[_crossing(corners, polygons.following, one, other)])
    _refuse(polygons, together, "have two corners in one place: merge the vertices, or move one")
    _refuse(
        polygons,
        crossing,
        "cross themselves like a bow-tie: give the corners in the order around the face",
    )
    _check_areas(corners, polygons)


def _refuse(polygons: _Polygons, corners: Sequence[Indices], what: str) -> None:
    """Raise ValueError for the faces of the corners, if there are any."""
    faces = np.unique(polygons.corner_faces[np.concatenate([*corners, np.zeros(0, np.int64)])])
    if faces.size:
        raise ValueError(f"faces {polygons.named(faces)} {what}")


def _check_areas(corners: Floats, polygons: _Polygons) -> None:
    """Raise ValueError if a face has no area."""
    lengths = _squared(corners[polygons.following] - corners)
    scale = np.add.reduceat(lengths, polygons.offsets[:-1])
    areas = np.linalg.norm(_areas(corners, polygons), axis=1)
    flat = np.flatnonzero(areas <= ZERO_AREA * scale)
    if flat.size == polygons.num_faces:
        raise ValueError("the mesh has no area: the corners of each face lie on a line")
    if flat.size:
        raise ValueError(
            f"faces {polygons.named(flat)} have no area, all corners on a line: move one, or leave the faces out"
        )


def _crossing(corners: Floats, following: Ints, one: Indices, other: Indices) -> Bools:
    """Tell whether the edges from two corners cross, for many twos.

    They do where the nearest points of their lines are inside both, at a distance that is small
    against that of their ends; in the plane it is 0. To project on the mean plane of a face would
    not do in space: that of a bow-tie is arbitrary, and a face far from plane may be good and yet
    cross itself there.
    """
    p, q, r, s = corners[one], corners[following[one]], corners[other], corners[following[other]]
    u, v, w = q - p, s - r, r - p
    uu, vv, uv, uw, vw = _squared(u), _squared(v), _dot(u, v), _dot(u, w), _dot(v, w)
    determinant = uu * vv - uv**2
    parallel = determinant <= PARALLEL * uu * vv
    determinant[parallel] = 1.0
    a, b = (vv * uw - uv * vw) / determinant, (uv * uw - uu * vw) / determinant
    inside = ~parallel & (a > 0) & (a < 1) & (b > 0) & (b < 1)
    gap = _squared(w - a[:, None] * u + b[:, None] * v)
    ends = np.minimum(_squared(q - r), _squared(s - p))
    return np.asarray(inside & (gap < CROSSING_GAP**2 * ends))


def _dot(x: Floats, y: Floats) -> Floats:
    return np.asarray(np.einsum("ij,ij->i", x, y))


def _squared(x: Floats) -> Floats:
    return _dot(x, x)


# Small helpers ------------------------------------------------------------------------------------


def _graph(rows: Indices, columns: Indices, size: int) -> csr_array:
    """Return a graph as a sparse matrix, shape (size, size)."""
    return csr_array((np.ones(rows.size, dtype=bool), (rows, columns)), shape=(size, size))


def _read_only(values: Indices) -> Ints:
    """Return the values as a read-only int32 array."""
    array = values.astype(np.int32)
    array.setflags(write=False)
    return array


def _tuples(rows: Indices) -> list[tuple[int, ...]]:
    """Return the rows as tuples, to be named."""
    return [tuple(row) for row in rows.tolist()]


def _some(items: Iterable[object], limit: int = 5) -> str:
    """Name the first few items and say how many more there are."""
    items = list(items)
    named = ", ".join(map(str, items[:limit]))
    return named if len(items) <= limit else f"{named} and {len(items) - limit} more"
