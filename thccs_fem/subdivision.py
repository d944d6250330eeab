"""One Catmull-Clark step on a mesh or on a part of it: child topology and the sparse matrix S.

A `Level` is a set of faces of one subdivision level in half-edge form.  Half-edge `h` belongs to one face, starts at
`vertices[h]` and runs to the start of `following[h]`; the half-edges of face `f` are `offsets[f] .. offsets[f + 1]`.
Only level 0 of a mesh with polygons has faces other than quads.

After one step the vertices are ordered `[old vertices | edge points | face points]`.  The child at half-edge `h` is
`[old vertex, edge point of h, face point, edge point of the half-edge before h]`: an extraordinary vertex is always
corner 0 of its child, and orientation is kept.

A level may be only a part of the surface.  What a vertex is on the whole surface (`num_faces`, `boundary`, `corner`) is
therefore carried from level to level and never derived again: a vertex on the artificial rim of a part is no boundary
vertex.  Rows of S for such vertices are placeholders (they sum to one); no one may use them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from thccs_fem.mesh import ControlMesh
from thccs_fem.polygons import following_corners, previous_corners
from thccs_fem.sparse import Triplets, entries, product, stacked, summed

__all__ = [
    "Bools",
    "Children",
    "Ints",
    "Level",
    "Step",
    "children",
    "control_level",
    "neighbourhood",
    "rim_distance",
    "subdivide",
    "subdivided",
    "with_matrix",
]

INFINITE_SHARPNESS = 10.0  # at and above this a crease or corner never becomes smooth
FAR = np.int32(1 << 30)  # rim distance of a vertex that has no irregular rim vertex in reach

Ints = npt.NDArray[np.int32]
Bools = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Level:
    """Faces of one level, all of them or a part.

    Attributes:
        number: Level number; 0 is the coarsest.
        offsets: First half-edge of each face, shape (num_faces + 1,).
        vertices: Start vertex of each half-edge, shape (num_half_edges,).
        twins: Opposite half-edge, or -1 on a real or an artificial rim, shape (num_half_edges,).
        keys: Identity of each face on its level whatever part of the level is held: 4 * key of the parent + child;
            ascending, shape (num_faces,), int64.
        boundary_edge: Half-edge of the control mesh that a half-edge on the boundary of the surface descends from, -1
            for those inside, shape (num_half_edges,).
        vertex_num_faces: Faces at each vertex, counted on the whole surface, shape (num_vertices,).
        boundary: Vertices on the boundary of the surface, shape (num_vertices,).
        corner: Boundary vertices that stay where they are: tagged corners and vertices of one face, (num_vertices,).
        control_vertex: Vertex of level 0 that a vertex descends from, or -1, shape (num_vertices,).
        rim_distance: Edges along the rim to the nearest irregular rim vertex (FAR inside), shape (num_vertices,).
    """

    number: int
    offsets: Ints
    vertices: Ints
    twins: Ints
    keys: npt.NDArray[np.int64]
    boundary_edge: Ints
    vertex_num_faces: Ints
    boundary: Bools
    corner: Bools
    control_vertex: Ints
    rim_distance: Ints

    def __post_init__(self) -> None:
        for value in self.__dict__.values():
            if isinstance(value, np.ndarray):
                value.setflags(write=False)

    @property
    def num_faces(self) -> int:
        """Number of faces held."""
        return self.keys.size

    @property
    def num_vertices(self) -> int:
        """Number of vertices held."""
        return self.boundary.size

    @cached_property
    def face(self) -> Ints:
        """Face of each half-edge, shape (num_half_edges,)."""
        return np.repeat(np.arange(self.num_faces, dtype=np.int32), np.diff(self.offsets))

    @cached_property
    def following(self) -> Ints:
        """Next half-edge around the same face, shape (num_half_edges,)."""
        return following_corners(self.offsets)

    @cached_property
    def previous(self) -> Ints:
        """Half-edge before, around the same face, shape (num_half_edges,)."""
        return previous_corners(self.offsets)

    @cached_property
    def rim(self) -> Bools:
        """Half-edges on the boundary of the surface, shape (num_half_edges,)."""
        return self.boundary_edge >= 0

    @cached_property
    def is_quad(self) -> bool:
        """Whether every face has four corners."""
        return bool((np.diff(self.offsets) == 4).all())

    @property
    def quads(self) -> Ints:
        """Vertices of each face, shape (num_faces, 4); quadrilateral levels only."""
        return self.vertices.reshape(-1, 4)

    @cached_property
    def regular(self) -> Bools:
        """Vertices around which the limit surface is a bicubic B-spline, shape (num_vertices,).

        Interior with four faces, on a smooth boundary with two, or a corner with one.
        """
        expected = np.where(self.boundary, np.where(self.corner, 1, 2), 4)
        return self.vertex_num_faces == expected

    @cached_property
    def complete(self) -> Bools:
        """Vertices all of whose faces are held, shape (num_vertices,)."""
        return np.bincount(self.vertices, minlength=self.num_vertices) == self.vertex_num_faces

    def half_edges(self, faces: npt.NDArray[np.integer]) -> Ints:
        """Return the half-edges of the given faces, face by face."""
        sizes = np.diff(self.offsets)[faces]
        starts = np.repeat(self.offsets[:-1][faces], sizes)
        ends = np.cumsum(sizes)
        return (starts + np.arange(starts.size) - np.repeat(ends - sizes, sizes)).astype(np.int32)

    @property
    def dependent_faces(self) -> Bools:
        """Faces with four corners of valence 3, inside, shape (num_faces,).

        On such a face, and on no other, the functions of the level are dependent: S annihilates their alternating
        vector there.
        """
        return ~self.touching(self.boundary | (self.vertex_num_faces != 3))

    def touching(self, vertices: Bools) -> Bools:
        """Return the faces that have at least one of the marked vertices, shape (num_faces,)."""
        hit = np.zeros(self.num_faces, dtype=bool)
        hit[self.face[vertices[self.vertices]]] = True
        return hit

    def corners_of(self, faces: Bools) -> Bools:
        """Return the vertices of the marked faces, shape (num_vertices,)."""
        hit = np.zeros(self.num_vertices, dtype=bool)
        hit[self.vertices[faces[self.face]]] = True
        return hit


def neighbourhood(level: Level, faces: Bools) -> Bools:
    """Return the marked faces and all that touch them, shape (num_faces,)."""
    return level.touching(level.corners_of(faces))


def control_level(mesh: ControlMesh) -> Level:
    """Return the whole control mesh as level 0; its vertices and faces keep their numbers.

    Boundary vertices of a single face are corners, others where the mesh tags them with infinite sharpness.

    Raises:
        NotImplementedError: If the mesh has creases or finite corner sharpness, which the space does not support yet.
    """
    _refuse_unsupported_sharpness(mesh)
    vertices = mesh.face_vertices
    following = following_corners(mesh.face_offsets)
    twins = _twins(mesh)
    rim = twins < 0
    num_faces = mesh.vertex_num_faces
    boundary = np.zeros(mesh.num_vertices, dtype=bool)
    boundary[vertices[rim]] = True
    corner = boundary & (num_faces == 1)
    corner[[v for v, sharpness in mesh.corners.items() if boundary[v]]] = True
    irregular_rim = boundary & (num_faces != np.where(corner, 1, 2))
    return Level(
        number=0,
        offsets=mesh.face_offsets,
        vertices=vertices,
        twins=twins,
        keys=np.arange(mesh.num_faces, dtype=np.int64),
        boundary_edge=np.where(rim, np.arange(rim.size), -1).astype(np.int32),
        vertex_num_faces=num_faces,
        boundary=boundary,
        corner=corner,
        control_vertex=np.arange(mesh.num_vertices, dtype=np.int32),
        rim_distance=rim_distance(irregular_rim, vertices[rim], vertices[following][rim]),
    )


def _refuse_unsupported_sharpness(mesh: ControlMesh) -> None:
    on_boundary = np.zeros(mesh.num_vertices, dtype=bool)
    on_boundary[mesh.boundary_vertices] = True
    boundary_edges = {(int(a), int(b)) for a, b in mesh.edges[mesh.boundary_edges]}
    creases = [edge for edge, s in mesh.creases.items() if s > 0 and edge not in boundary_edges]
    corners = [v for v, s in mesh.corners.items() if s > 0 and not (on_boundary[v] and s >= INFINITE_SHARPNESS)]
    if creases or corners:
        what = f"crease at edge {creases[0]}" if creases else f"corner at vertex {corners[0]}"
        raise NotImplementedError(
            f"the control mesh has {len(creases)} creases inside the surface and {len(corners)} corners that are "
            f"semi-sharp or inside the surface (first: {what}); only corners of sharpness >= "
            f"{INFINITE_SHARPNESS:g} on the boundary are supported so far. Remove these tags to go on without them."
        )


def _twins(mesh: ControlMesh) -> Ints:
    """Return the opposite half-edge of each, -1 where there is none."""
    edge = mesh.face_edges
    half_edges = np.arange(edge.size, dtype=np.int32)
    first, last = (np.zeros(mesh.num_edges, dtype=np.int32) for _ in range(2))
    first[edge[::-1]] = half_edges[::-1]  # of what is written to one place the last value stays
    last[edge] = half_edges
    other = first[edge] + last[edge] - half_edges
    return np.where(other == half_edges, -1, other).astype(np.int32)


def rim_distance(irregular: Bools, start: Ints, end: Ints) -> Ints:
    """Return the distance along rim edges to the nearest irregular rim vertex: 0, 1, or FAR.

    Further than 1 makes no difference (the tied zone is distance <= 1, and distances at least double with each level).
    """
    distance = np.full(irregular.size, FAR, dtype=np.int32)
    distance[end[irregular[start]]] = 1
    distance[start[irregular[end]]] = 1
    distance[irregular] = 0
    return distance


def subdivided(mesh: ControlMesh, times: int = 1) -> ControlMesh:
    """Return the control mesh after some Catmull-Clark steps: all quads, with the same limit surface and tags.

    The child at half-edge h of a mesh (corner h - face_offsets[f] of face f) is face h of the next one; old vertices
    keep their numbers.

    Args:
        mesh: The control mesh.
        times: Number of steps.

    Raises:
        ValueError: If `times` is negative.
        NotImplementedError: If the mesh has creases inside or semi-sharp corners.
    """
    if times < 0:
        raise ValueError(f"times is {times}; a mesh can be subdivided 0 or more times")
    for _ in range(times):
        level = control_level(mesh)
        step = subdivide(level, np.ones(level.num_faces, dtype=bool))
        mesh = ControlMesh(
            step.matrix @ mesh.vertices,
            step.fine.quads,
            face_tags=np.repeat(mesh.face_tags, mesh.face_sizes),
            edge_tags=_on_halves(mesh.edge_tags, level, step),
            creases=_on_halves(mesh.creases, level, step),
            corners=mesh.corners,
            comm=mesh.comm,
        )
    return mesh


def _on_halves[T](values: Mapping[tuple[int, int], T], level: Level, step: Step) -> dict[tuple[int, int], T]:
    """Return values of edges as values of their two halves."""
    ends = np.sort(np.stack([level.vertices[step.edges], level.vertices[level.following[step.edges]]], axis=1), axis=1)
    point = {(int(a), int(b)): step.old.size + k for k, (a, b) in enumerate(ends)} if values else {}
    return {(end, point[edge]): value for edge, value in values.items() for end in edge}


@dataclass(frozen=True, eq=False)
class Children:
    """The topology of one subdivision step from a level to the next.

    Attributes:
        fine: The children.
        first_child: First child of each coarse face (the child at half-edge offsets[f] + k is the first + k), -1 for
            faces that were not subdivided, shape (coarse faces,).
        old: Coarse vertex of each old vertex of the fine level, shape (num_old,).
        edges: Coarse half-edge of each edge point, which follow the old vertices, shape (num_edge_points,).
    """

    fine: Level
    first_child: Ints
    old: Ints
    edges: Ints

    def marks_of(self, faces: Bools) -> Bools:
        """Return the children of marked quads, those that have any, as marks on the fine level."""
        marks = np.zeros(self.fine.num_faces, dtype=bool)
        first = self.first_child[faces]
        marks[first[first >= 0][:, None] + np.arange(4)] = True
        return marks


@dataclass(frozen=True, eq=False)
class Step(Children):
    """One subdivision step from a level to the next.

    Attributes:
        matrix: S, shape (fine.num_vertices, coarse vertices); rows sum to one.
    """

    matrix: sp.csr_array


def subdivide(level: Level, faces: Bools) -> Step:
    """Subdivide the marked faces once by Catmull and Clark's rules.

    Args:
        level: The level that holds the faces.
        faces: Marked faces, shape (level.num_faces,).
    """
    return with_matrix(level, faces, children(level, faces))


def with_matrix(level: Level, faces: Bools, made: Children) -> Step:
    """Return the step that makes the children of the marked faces."""
    matrix = _step_matrix(level, faces, made.old, made.edges)
    return Step(made.fine, made.first_child, made.old, made.edges, matrix)


def children(level: Level, faces: Bools, fine: Level | None = None) -> Children:
    """Return what `subdivide` does, but for S.

    Args:
        level: The level that holds the faces.
        faces: Marked faces, shape (level.num_faces,).
        fine: The level of the children where it is known.
    """
    chosen = np.flatnonzero(faces).astype(np.int32)
    half_edges = level.half_edges(chosen)
    child = np.full(level.vertices.size, -1, dtype=np.int32)
    child[half_edges] = np.arange(half_edges.size, dtype=np.int32)
    old = np.flatnonzero(level.corners_of(faces)).astype(np.int32)
    edge, edges = _number_edges(level, half_edges)
    if fine is None:
        fine = _child_level(level, chosen, half_edges, child, old, edge, edges)
    return Children(fine, np.where(faces, child[level.offsets[:-1]], -1).astype(np.int32), old, edges)


def _number_edges(level: Level, half_edges: Ints) -> tuple[Ints, Ints]:
    """Return the edge number of every half-edge (-1 outside) and the half-edge that stands for each edge."""
    inside = np.zeros(level.vertices.size, dtype=bool)
    inside[half_edges] = True
    twins = level.twins[half_edges]
    paired = (twins >= 0) & inside[twins]
    leader = np.where(paired, np.minimum(half_edges, twins), half_edges)
    edges = half_edges[leader == half_edges]
    edge = np.full(level.vertices.size, -1, dtype=np.int32)
    edge[edges] = np.arange(edges.size, dtype=np.int32)
    edge[half_edges] = edge[leader]
    return edge, edges


def _child_level(
    level: Level, chosen: Ints, half_edges: Ints, child: Ints, old: Ints, edge: Ints, edges: Ints
) -> Level:
    """Return the topology of the children; see `subdivide`."""
    number_of_old = np.full(level.num_vertices, -1, dtype=np.int32)
    number_of_old[old] = np.arange(old.size, dtype=np.int32)
    face_number = np.full(level.num_faces, -1, dtype=np.int32)
    face_number[chosen] = np.arange(chosen.size, dtype=np.int32)
    previous = level.previous[half_edges]
    faces = np.stack(
        [
            number_of_old[level.vertices[half_edges]],
            old.size + edge[half_edges],
            old.size + edges.size + face_number[level.face[half_edges]],
            old.size + edge[previous],
        ],
        axis=1,
    )
    boundary_edge = np.full(faces.shape, -1, dtype=np.int32)
    boundary_edge[:, 0], boundary_edge[:, 3] = level.boundary_edge[half_edges], level.boundary_edge[previous]
    # Keys: a quad's child k is 4 * key + k; the children of a mesh with polygons are numbered by half-edge.
    k = half_edges - level.offsets[level.face[half_edges]]
    keys = 4 * level.keys[level.face[half_edges]] + k if level.is_quad else half_edges.astype(np.int64)
    on_rim = level.rim[edges]
    ends = level.rim_distance[np.stack([level.vertices[edges], level.vertices[level.following[edges]]])]
    far = np.full(chosen.size, FAR, dtype=np.int32)
    return Level(
        number=level.number + 1,
        offsets=np.arange(0, 4 * half_edges.size + 1, 4, dtype=np.int32),
        vertices=faces.ravel(),
        twins=_child_twins(level, half_edges, child),
        keys=keys,
        boundary_edge=boundary_edge.ravel(),
        vertex_num_faces=np.concatenate(
            [level.vertex_num_faces[old], np.where(on_rim, 2, 4), np.diff(level.offsets)[chosen]]
        ).astype(np.int32),
        boundary=np.concatenate([level.boundary[old], on_rim, np.zeros(chosen.size, dtype=bool)]),
        corner=np.concatenate([level.corner[old], np.zeros(edges.size + chosen.size, dtype=bool)]),
        control_vertex=np.concatenate(
            [level.control_vertex[old], np.full(edges.size + chosen.size, -1, dtype=np.int32)]
        ),
        rim_distance=np.concatenate(
            [
                np.minimum(2 * level.rim_distance[old].astype(np.int64), FAR),
                np.where(on_rim, np.minimum(2 * ends.min(axis=0).astype(np.int64) + 1, FAR), FAR),
                far,
            ]
        ).astype(np.int32),
    )


def _child_twins(level: Level, half_edges: Ints, child: Ints) -> Ints:
    """Return the twins of the children's half-edges, read off those of the parents."""

    def through(half_edge: Ints, side: int) -> Ints:
        """Return half-edge `side` of the child at the given parent half-edges, -1 where there is none."""
        number = np.where(half_edge >= 0, child[half_edge], -1)
        return np.where(number >= 0, 4 * number + side, -1)

    before = level.previous[half_edges]
    across = level.twins[half_edges]
    twins = np.stack(
        [
            through(np.where(across >= 0, level.following[across], -1), 3),
            through(level.following[half_edges], 2),
            through(before, 1),
            through(level.twins[before], 0),
        ],
        axis=1,
    )
    return twins.ravel().astype(np.int32)


def _step_matrix(level: Level, faces: Bools, old: Ints, edges: Ints) -> sp.csr_array:
    """Return S, shape (old + edges + marked faces, coarse vertices); see `Children`."""
    chosen = np.flatnonzero(faces).astype(np.int32)
    half_edges = level.half_edges(chosen)
    sizes = np.diff(level.offsets)[chosen]
    face_of_corner = np.repeat(np.arange(chosen.size, dtype=np.int32), sizes)
    face_point = summed(
        [(face_of_corner, level.vertices[half_edges], np.repeat(1.0 / sizes, sizes))], (chosen.size, level.num_vertices)
    )
    face_number = np.full(level.num_faces, -1, dtype=np.int32)
    face_number[chosen] = np.arange(chosen.size, dtype=np.int32)
    vertex_rows = _vertex_rows(level, half_edges, old, face_number, face_point)
    edge_rows = _edge_rows(level, edges, face_number, face_point)
    return stacked([vertex_rows, edge_rows, face_point])


def _edge_rows(level: Level, edges: Ints, face_number: Ints, face_point: sp.csr_array) -> sp.csr_array:
    """Edge points: mean of the ends and the two face points; midpoint on the rim."""
    twins = level.twins[edges]
    inner = np.flatnonzero((twins >= 0) & (face_number[level.face[twins]] >= 0)).astype(np.int32)
    rows = np.arange(edges.size, dtype=np.int32)
    weight = np.full(edges.size, 0.5)
    weight[inner] = 0.25
    sides = summed(
        [(inner, face_number[level.face[side[inner]]], 0.25) for side in (edges, twins)],
        (edges.size, face_point.shape[0]),
    )
    start, end = level.vertices[edges], level.vertices[level.following[edges]]
    ends: Triplets = [(rows, start, weight), (rows, end, weight)]
    return summed([*ends, entries(product(sides, face_point))], (edges.size, level.num_vertices))


def _vertex_rows(
    level: Level, half_edges: Ints, old: Ints, face_number: Ints, face_point: sp.csr_array
) -> sp.csr_array:
    """Vertex points: ((n - 3) P + mean face point + 2 mean edge midpoint) / n inside, (1 6 1) / 8 on a smooth rim.

    Corners stay; so do vertices whose surroundings are not all in this part (placeholders).
    """
    start = level.vertices[half_edges]
    count = np.bincount(start, minlength=level.num_vertices)
    n = level.vertex_num_faces.astype(np.float64)
    inner = ~level.boundary & (count == level.vertex_num_faces)
    row_of = np.full(level.num_vertices, -1, dtype=np.int32)
    row_of[old] = np.arange(old.size, dtype=np.int32)
    corners = half_edges[inner[start]]
    v = level.vertices[corners]
    row, per_face = row_of[v], 1.0 / n[v] ** 2
    around = summed([(row, face_number[level.face[corners]], per_face)], (old.size, face_point.shape[0]))
    rim = half_edges[level.rim[half_edges]]
    a, b = level.vertices[rim], level.vertices[level.following[rim]]
    ends = np.bincount(np.concatenate([a, b]), minlength=level.num_vertices)
    smooth = level.boundary & ~level.corner & (ends == 2)
    own = np.where(inner, (n - 3.0) / n, np.where(smooth, 0.75, 1.0))
    local: Triplets = [
        (row_of[old], old, own[old]),
        (row, v, per_face),
        # Each edge at v is met from both its faces: half of each midpoint from either side.
        (row, level.vertices[level.following[corners]], 0.5 * per_face),
        (row, level.vertices[level.previous[corners]], 0.5 * per_face),
        (row_of[a[smooth[a]]], b[smooth[a]], 0.125),
        (row_of[b[smooth[b]]], a[smooth[b]], 0.125),
    ]
    return summed([*local, entries(product(around, face_point))], (old.size, level.num_vertices))
