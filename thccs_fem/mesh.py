"""Control meshes: polygons in the plane or in space, checked once at construction, never changed.

Faces are kept in CSR form. A *corner* is an entry of ``face_vertices``: it belongs to one face,
sits at one vertex, and its edge runs from there to the next corner of the face. Corners run
counter-clockwise around the normal of their face.

Orders: vertices and faces are the user's; edges are pairs (smaller vertex, larger vertex) in
lexicographic order; the two faces of an edge are in ascending order.
"""

import hashlib
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import csgraph
from scipy.spatial import KDTree

import ufl
from thccs_fem import element
from thccs_fem.absent import Absent
from thccs_fem.parallel import end_together, rank_of, size_of, together
from thccs_fem.polygons import (
    Bools,
    Faces,
    Floats,
    Ints,
    Pair,
    as_mapping,
    as_sharpness,
    as_tag,
    as_tuples,
    face_areas,
    face_sides,
    face_tag_array,
    following_corners,
    graph_of,
    is_integer,
    read_only,
    read_polygons,
    signed_content,
    some_of,
    turned_over,
    vertex_array,
)
from thccs_fem.validation import check_edges, check_faces, check_fans, check_orientation, check_shapes

__all__ = ["ControlMesh", "end_faces", "orient"]

COINCIDENT_RIM = 1e-8  # boundary vertices this close are a crack; of the mesh's diameter


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
        comm: MPI communicator of the ranks that work on the mesh, one of mpi4py; None in serial. Each
            rank gives the whole mesh, the same as the others. Collective.

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
            is for an edge or a vertex that is not there; or ranks give different meshes.

    Warns:
        UserWarning: Boundary vertices coincide: the mesh has a crack. On rank 0 alone.

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
        if not (comm is None or hasattr(comm, "allgather")):
            raise TypeError(f"comm is {comm!r}; expected a communicator of mpi4py, such as MPI.COMM_WORLD, or None")
        self._set(comm=comm)
        end_together(comm)
        together(comm, lambda: self._make(vertices, faces, face_tags, edge_tags, creases, corners))
        self._check_that_ranks_agree()

    def _make(
        self,
        vertices: npt.ArrayLike,
        faces: Faces,
        face_tags: npt.ArrayLike | None,
        edge_tags: Mapping[Pair, int] | None,
        creases: Mapping[Pair, float] | None,
        corners: Mapping[int, float] | None,
    ) -> None:
        """Check what is given, and keep it."""
        points = vertex_array(vertices)
        polygons = read_polygons(faces, len(points))
        check_faces(polygons)
        check_shapes(points, polygons)  # first: a bow-tie also breaks up the fans at its corners
        check_edges(polygons)
        check_orientation(polygons)
        check_fans(polygons)
        self._set(
            vertices=points,
            face_offsets=polygons.offsets,
            face_vertices=polygons.vertices,
            face_edges=polygons.corner_edges,
            face_tags=face_tag_array(face_tags, polygons.num_faces),
            edges=polygons.edges,
            edge_faces=polygons.edge_faces,
        )
        self._set(
            edge_tags=self._on_edges("edge_tags", edge_tags, as_tag),
            creases=self._on_edges("creases", creases, as_sharpness),
            corners=self._on_vertices("corners", corners, as_sharpness),
        )
        if self.gdim == 2:
            self._check_counter_clockwise(face_areas(points[polygons.vertices], polygons)[:, 0])
        if rank_of(self.comm) == 0:
            self._warn_of_cracks()

    def _check_that_ranks_agree(self) -> None:
        """Raise ValueError unless the mesh is the same on all ranks. Collective."""
        if size_of(self.comm) == 1:
            return
        first, *others = self.comm.allgather(self._digests())
        for rank, digests in enumerate(others, start=1):
            names = [name for name, digest in digests.items() if digest != first[name]]
            if names:
                raise ValueError(
                    f"rank {rank} of {self.comm.size} gives a mesh with other {', '.join(names)} than rank 0; expected "
                    f"the whole mesh, the same on all ranks. io.read_mesh(path, comm) reads a file on rank 0 for all"
                )

    def _digests(self) -> dict[str, str]:
        """Return what differs if an argument differs, by the name of the argument."""
        given = {
            "vertices": bytes([self.gdim]) + self.vertices.tobytes(),
            "faces": self.face_offsets.tobytes() + self.face_vertices.tobytes(),
            "face_tags": self.face_tags.tobytes(),
            "edge_tags": repr(sorted(self.edge_tags.items())).encode(),
            "creases": repr(sorted(self.creases.items())).encode(),
            "corners": repr(sorted(self.corners.items())).encode(),
        }
        return {name: hashlib.sha256(data).hexdigest() for name, data in given.items()}

    geometry = Absent(
        "msh.vertices are the control points, msh.gdim their dimension; limit.evaluate has points of the surface"
    )
    topology = Absent("msh.quads, msh.edges and msh.edge_faces say what is next to what; surfaces are of dimension 2")

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
        return read_only(np.diff(self.face_offsets))

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
            others = some_of(np.flatnonzero(self.face_sizes != 4))
            raise ValueError(
                f"faces {others} do not have four corners: the mesh is not all quads. "
                f"Use face_offsets and face_vertices"
            )
        return self.face_vertices.reshape(-1, 4)

    @cached_property
    def boundary_edges(self) -> Ints:
        """Edges of one face only, ascending."""
        return read_only(np.flatnonzero(self.edge_faces[:, 1] < 0))

    @cached_property
    def boundary_vertices(self) -> Ints:
        """Vertices of the boundary edges, ascending."""
        return read_only(np.unique(self.edges[self.boundary_edges]))

    @cached_property
    def boundary_loops(self) -> tuple[Ints, ...]:
        """Vertices of each closed loop of boundary edges, walked with the faces to the left.

        A loop begins with its smallest vertex; the loops are in the order of these.
        """
        rim = np.flatnonzero(self.edge_faces[self.face_edges, 1] < 0)
        if not rim.size:
            return ()
        n, following = self.num_vertices, following_corners(self.face_offsets)
        begin, end = self.face_vertices[rim], self.face_vertices[following[rim]]
        _, loop = csgraph.connected_components(graph_of(begin, end, n), directed=False)
        _, where = np.unique(loop[self.boundary_vertices], return_index=True)
        first = self.boundary_vertices[where]
        # From an extra vertex that leads to the first of each loop, a depth-first walk goes round
        # one loop after the other.
        graph = graph_of(np.append(begin, np.full(first.size, n)), np.append(end, first), n + 1)
        walk = csgraph.depth_first_order(graph, n, return_predecessors=False)[1:]
        loops = np.split(walk, np.flatnonzero(np.isin(walk, first))[1:])
        return tuple(read_only(loop) for loop in sorted(loops, key=lambda loop: int(loop[0])))

    @cached_property
    def vertex_num_faces(self) -> Ints:
        """Number of faces at each vertex, shape (num_vertices,)."""
        return read_only(np.bincount(self.face_vertices))

    @cached_property
    def valences(self) -> Ints:
        """Number of edges at each vertex, shape (num_vertices,)."""
        return read_only(np.bincount(self.edges.ravel()))

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
        return read_only(np.flatnonzero(np.add.reduceat(extraordinary, self.face_offsets[:-1]) >= 2))

    @property
    def num_invalid_faces(self) -> int:
        """Number of `invalid_faces`."""
        return int(self.invalid_faces.size)

    @cached_property
    def vertex_components(self) -> Ints:
        """Connected component of each vertex, shape (num_vertices,)."""
        graph = graph_of(self.edges[:, 0], self.edges[:, 1], self.num_vertices)
        return read_only(csgraph.connected_components(graph, directed=False)[1])

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
        values = as_mapping(name, given)
        for key in values:
            if not (isinstance(key, tuple) and len(key) == 2 and all(map(is_integer, key))):
                raise TypeError(f"{name} has the key {key!r}; expected two vertices, (i, j)")
        edges = self.edge_indices(list(values)).tolist()
        missing = [pair for pair, edge in zip(values, edges, strict=True) if edge < 0]
        if missing:
            raise ValueError(f"{name} has values for {some_of(missing)}: the mesh has no such edge")
        ordered: dict[Pair, T] = {}
        for (i, j), given_value in values.items():
            pair, value = (int(min(i, j)), int(max(i, j))), checked(f"{name}[{i}, {j}]", given_value)
            if ordered.setdefault(pair, value) != value:
                both = f"{ordered[pair]} and {value}"
                raise ValueError(f"{name} has two values for edge {pair}, {both}: give one")
        return MappingProxyType(ordered)

    def _on_vertices[T](self, name: str, given: object, checked: Callable[[str, object], T]) -> Mapping[int, T]:
        """Return the checked values by vertices, each of which exists."""
        values = as_mapping(name, given)
        for key in values:
            if not is_integer(key):
                raise TypeError(f"{name} has the key {key!r}; expected a vertex, an integer")
        missing = [vertex for vertex in values if not 0 <= vertex < self.num_vertices]
        if missing:
            raise ValueError(f"{name} has values for {some_of(missing)}: vertices are 0 to {self.num_vertices - 1}")
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
                f"faces {some_of(np.flatnonzero(minority & mixed[component]))} are turned over: "
                f"their signed area has not the sign of the faces that they are joined to, "
                f"so the mesh is folded in the plane. Move their vertices"
            )
        which = f"faces {some_of(np.flatnonzero(clockwise))}"
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
                f"boundary vertices {some_of(as_tuples(pairs))} coincide: the mesh has a crack, across "
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
    points = vertex_array(vertices)
    polygons = read_polygons(faces, len(points))
    check_faces(polygons)
    check_edges(polygons)
    component, turned = face_sides(polygons)
    content = signed_content(points, turned_over(polygons, turned), component)
    oriented = turned_over(polygons, turned ^ (content < 0)[component])
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
    first, last = (read_only(np.sort(np.concatenate(end))) for end in zip(*ends, strict=True))
    return first, last
