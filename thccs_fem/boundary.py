"""The clamped boundary: the Catmull-Clark ("crease") boundary plus one scalar function per rim vertex.

At a boundary vertex v with two faces the crease rule continues the surface by a phantom point 2 P_v - P_w, w the vertex
across.  The clamped space frees that point: delta_v is how far the ghost lies from the phantom.  Its functions are
N_i(s) (1 - t)^3 / 6 along the rim, and all of its algebra is a correction to the crease rule on the rim alone.  A
corner of one face has three such scalars: along its outgoing rim edge (A), its incoming one (B), and mixed (M).

The degrees of freedom that make it clamped, written q, are values of the trace and a third of an edge inside:

    q0 = P_v + delta_v / 6,   q1 = (2 P_v + P_w) / 3,   q2 = P_w,

a non-negative partition of unity in which Dirichlet data enter through q0 alone.  Within one edge of an irregular rim
vertex delta is tied to 0, on every level; `boundary="crease"` ties it everywhere.

Functions of a level are numbered vertices first (q1 or P), then traces (q0), the traces in order of their vertices.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from thccs_fem.sparse import Triplets, entries, product, summed
from thccs_fem.subdivision import Bools, Ints, Level, Step

__all__ = [
    "Boundary",
    "BoundaryRule",
    "from_dofs",
    "subdivision_matrix",
    "support_of_traces",
    "to_dofs",
    "traces_meeting",
]

BoundaryRule = Literal["clamped", "crease"]

SMOOTH, CORNER_OUT, CORNER_IN, CORNER_MIXED = 0, 1, 2, 3  # kinds of trace functions: q0, q10, q01, q00
TIED_ZONE = 1  # edges along the rim from an irregular vertex within which delta is 0

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Boundary:
    """Trace functions of one level.

    Attributes:
        level: The level.
        vertex: Rim vertex of each trace function, ascending, shape (num_traces,).
        kind: SMOOTH, or the three kinds of a corner, in this order for each corner, shape (num_traces,).
    """

    level: Level
    vertex: Ints
    kind: Ints

    @classmethod
    def of(cls, level: Level, rule: BoundaryRule) -> Boundary:
        """Return the trace functions that the rule frees on this level."""
        if rule == "crease":
            return cls(level, np.zeros(0, dtype=np.int32), np.zeros(0, dtype=np.int32))
        free = level.boundary & level.regular & level.complete & (level.rim_distance > TIED_ZONE)
        corner = level.corner & free
        # Two corners joined by a rim edge would share their functions: tied on this level, free from the next one on.
        joined = level.rim & corner[level.vertices] & corner[level.vertices[level.following]]
        free[level.vertices[joined]] = False
        free[level.vertices[level.following[joined]]] = False
        count = np.where(free, np.where(level.corner, 3, 1), 0)
        vertex = np.repeat(np.arange(level.num_vertices, dtype=np.int32), count)
        kind = np.where(level.corner[vertex], np.arange(vertex.size) - (np.cumsum(count) - count)[vertex] + 1, SMOOTH)
        return cls(level, vertex, kind.astype(np.int32))

    @property
    def num_functions(self) -> int:
        """Functions of the level: one a vertex and the traces."""
        return self.level.num_vertices + self.vertex.size

    @cached_property
    def first(self) -> Ints:
        """Function number of the first trace of each vertex, -1 for none, shape (num_vertices,)."""
        first = np.full(self.level.num_vertices, -1, dtype=np.int32)
        starts = np.flatnonzero((self.kind == SMOOTH) | (self.kind == CORNER_OUT))
        first[self.vertex[starts]] = self.level.num_vertices + starts
        return first

    @property
    def out_side(self) -> Ints:
        """Trace function met along the rim edge that leaves a vertex, -1 for none, shape (num_vertices,)."""
        return self.first

    @cached_property
    def in_side(self) -> Ints:
        """Trace function met along the rim edge that enters a vertex, -1 for none, shape (num_vertices,)."""
        return np.where((self.first >= 0) & self.level.corner, self.first + 1, self.first).astype(np.int32)

    @cached_property
    def to_points(self) -> sp.csr_array:
        """T of `from_dofs`, made once."""
        return from_dofs(self)

    @cached_property
    def smooth_edges(self) -> tuple[Ints, Ints]:
        """Free smooth rim vertices and the vertex w across from each, two arrays of the same shape."""
        level = self.level
        leaving = np.flatnonzero(level.rim & (self.first[level.vertices] >= 0) & ~level.corner[level.vertices])
        return level.vertices[leaving], level.vertices[level.previous[leaving]]

    @cached_property
    def corner_faces(self) -> Ints:
        """Free corners and the other vertices of their faces, [c, x1, w, y1], shape (num_corners, 4)."""
        level = self.level
        at = np.flatnonzero(level.corner[level.vertices] & (self.first[level.vertices] >= 0))
        following = level.following
        return level.vertices[np.stack([at, following[at], following[following[at]], level.previous[at]], axis=1)]

    def trace_or_vertex(self, trace: Ints, vertex: Ints) -> Ints:
        """Return the trace function, or the function of the vertex where its delta is tied."""
        return np.where(trace >= 0, trace, vertex)


def subdivision_matrix(coarse: Boundary, fine: Boundary, step: Step) -> sp.csr_array:
    """Return the subdivision matrix of (P, delta), shape (fine.num_functions, coarse.num_functions)."""
    shape = (fine.num_functions, coarse.num_functions)
    level = coarse.level
    fine_of_old = np.full(level.num_vertices, -1, dtype=np.int32)
    fine_of_old[step.old] = np.arange(step.old.size, dtype=np.int32)
    on_rim = np.flatnonzero(level.rim[step.edges])
    edges = step.edges[on_rim]
    a, b = level.vertices[edges], level.vertices[level.following[edges]]
    point = (step.old.size + on_rim).astype(np.int32)
    triplets: Triplets = [entries(step.matrix)]
    for side in (coarse.out_side[a], coarse.in_side[b]):
        triplets += [(point, side, 1 / 16), (fine.first[point], side, 1 / 8)]
    triplets += _old_rim_rows(coarse, fine, fine_of_old, a, b)
    triplets += _old_corner_rows(coarse, fine, fine_of_old)
    return summed(triplets, shape)


def _old_rim_rows(coarse: Boundary, fine: Boundary, fine_of_old: Ints, a: Ints, b: Ints) -> Triplets:
    """(d- + 6 d + d+) / 64 for the point and / 32 for its delta, at smooth rim vertices; a -> b are the rim edges."""
    smooth = coarse.level.boundary & ~coarse.level.corner
    triplets: Triplets = []
    v = np.flatnonzero(smooth & (fine_of_old >= 0)).astype(np.int32)
    for vertex, trace, weight in (
        (v, coarse.first[v], 6.0),
        (b[smooth[b]], coarse.out_side[a[smooth[b]]], 1.0),
        (a[smooth[a]], coarse.in_side[b[smooth[a]]], 1.0),
    ):
        row = fine_of_old[vertex]
        triplets += [(row, trace, weight / 64), (fine.first[row], trace, weight / 32)]
    return triplets


def _old_corner_rows(coarse: Boundary, fine: Boundary, fine_of_old: Ints) -> Triplets:
    """P' = P + (dA + dB)/8 + dM/64, dA' = (dA + dM/8)/4, dB' likewise, dM' = dM/16."""
    c = coarse.corner_faces[:, 0]
    row, out = fine_of_old[c], coarse.first[c]
    fine_out = np.where(row >= 0, fine.first[row], -1)
    fine_in, fine_mixed = (np.where(fine_out >= 0, fine_out + k, -1) for k in (1, 2))
    return [
        (row, out, 1 / 8),
        (row, out + 1, 1 / 8),
        (row, out + 2, 1 / 64),
        (fine_out, out, 1 / 4),
        (fine_out, out + 2, 1 / 32),
        (fine_in, out + 1, 1 / 4),
        (fine_in, out + 2, 1 / 32),
        (fine_mixed, out + 2, 1 / 16),
    ]


def to_dofs(boundary: Boundary) -> sp.csr_array:
    """Return T^-1, the matrix that takes (P, delta) to q, shape (num_functions, num_functions)."""
    size = boundary.num_functions
    if not boundary.vertex.size:
        return sp.eye_array(size, format="csr")
    v, w = boundary.smooth_edges
    q0 = boundary.first[v]
    c, x1, opposite, y1 = boundary.corner_faces.T
    q10 = boundary.first[c]
    others = np.flatnonzero(boundary.first < 0)
    triplets: Triplets = [(others, others, 1.0), (v, v, 2 / 3), (v, w, 1 / 3), (q0, v, 1.0), (q0, q0, 1 / 6)]
    triplets += [(c, c, 4 / 9), (c, x1, 2 / 9), (c, y1, 2 / 9), (c, opposite, 1 / 9)]
    for row, delta, neighbour, side in (
        (q10, q10, x1, boundary.in_side[x1]),
        (q10 + 1, q10 + 1, y1, boundary.out_side[y1]),
    ):
        triplets += [(row, c, 2 / 3), (row, delta, 1 / 9), (row, neighbour, 1 / 3), (row, side, 1 / 18)]
    triplets += [(q10 + 2, c, 1.0), (q10 + 2, q10, 1 / 6), (q10 + 2, q10 + 1, 1 / 6), (q10 + 2, q10 + 2, 1 / 36)]
    return summed(triplets, (size, size))


def from_dofs(boundary: Boundary) -> sp.csr_array:
    """Return T, the matrix that takes q to (P, delta), shape (num_functions, num_functions)."""
    size = boundary.num_functions
    if not boundary.vertex.size:
        return sp.eye_array(size, format="csr")
    points = _points_from_dofs(boundary)
    v, _ = boundary.smooth_edges
    q0 = boundary.first[v]
    c, x1, _, y1 = boundary.corner_faces.T
    q10, q01, q00 = boundary.first[c], boundary.first[c] + 1, boundary.first[c] + 2
    # delta = (a combination of q) + (a combination of the points P just found)
    of_dofs: Triplets = [(q0, q0, 6.0), (q10, q10, 9.0), (q01, q01, 9.0)]
    of_points: Triplets = [(q0, v, -6.0), (q10, c, -6.0), (q01, c, -6.0)]
    for row, neighbour, side in ((q10, x1, boundary.in_side[x1]), (q01, y1, boundary.out_side[y1])):
        of_dofs += [(row, boundary.trace_or_vertex(side, neighbour), -3.0)]
    # dM = 36 q00 - 36 P_c - 6 (dA + dB), with dA and dB as above
    of_dofs += [(q00, q00, 36.0), (q00, q10, -54.0), (q00, q01, -54.0)]
    of_points += [(q00, c, 36.0)]
    for neighbour, side in ((x1, boundary.in_side[x1]), (y1, boundary.out_side[y1])):
        of_dofs += [(q00, boundary.trace_or_vertex(side, neighbour), 18.0)]
    return summed([entries(points), *of_dofs, entries(product(summed(of_points, (size, size)), points))], (size, size))


def _points_from_dofs(boundary: Boundary) -> sp.csr_array:
    """Return the rows P of T; the rows of the traces are empty."""
    size = boundary.num_functions
    v, w = boundary.smooth_edges
    # In a strip one face wide both of the rims are free.
    across_free = (boundary.first[w] >= 0) & ~boundary.level.corner[w]
    c = boundary.corner_faces[:, 0]
    others = np.flatnonzero(boundary.first < 0)
    rims: Triplets = [
        (others, others, 1.0),
        (v, v, np.where(across_free, 2.0, 1.5)),
        (v, w, np.where(across_free, -1.0, -0.5)),
    ]
    corners: Triplets = [(c, c, 2.25)]
    around: Triplets = [
        (c, neighbour, weight)
        for neighbour, weight in zip(boundary.corner_faces.T[1:], (-0.5, -0.25, -0.5), strict=True)
    ]
    of_rims = product(summed(around, (size, size)), summed(rims, (size, size)))
    return summed([*rims, *corners, entries(of_rims)], (size, size))


def traces_meeting(boundary: Boundary, faces: Bools) -> Bools:
    """Return the trace functions whose support meets the marked faces, shape (num_traces,).

    The support of a smooth trace i are the faces of the rim edges i - 2 .. i + 2; of a corner's q10 and q01 those of
    the two edges along its rim; of q00 its one face.
    """
    if not boundary.vertex.size:
        return np.zeros(0, dtype=bool)
    level = boundary.level
    a, b, hit = _rim_edges(level, faces)
    reached = _one_edge_further(level, a, b, hit)
    entered, left, of_face = (np.zeros(level.num_vertices, dtype=bool) for _ in range(3))
    left[a[reached]] = True
    entered[b[reached]] = True
    of_face[a[hit]] = True
    v = boundary.vertex
    return np.select(
        [boundary.kind == SMOOTH, boundary.kind == CORNER_OUT, boundary.kind == CORNER_IN],
        [entered[v] | left[v], left[v], entered[v]],
        default=of_face[v],
    ).astype(bool)


def support_of_traces(boundary: Boundary, traces: Bools) -> Bools:
    """Return the faces in the support of any of the marked trace functions, shape (num_faces,)."""
    level = boundary.level
    if not traces.any():
        return np.zeros(level.num_faces, dtype=bool)
    a, b, _ = _rim_edges(level, np.zeros(level.num_faces, dtype=bool))
    leaving, entering, of_face = (np.zeros(level.num_vertices, dtype=bool) for _ in range(3))
    smooth = boundary.kind == SMOOTH
    leaving[boundary.vertex[traces & (smooth | (boundary.kind == CORNER_OUT))]] = True
    entering[boundary.vertex[traces & (smooth | (boundary.kind == CORNER_IN))]] = True
    of_face[boundary.vertex[traces & (boundary.kind == CORNER_MIXED)]] = True
    edges = _one_edge_further(level, a, b, leaving[a] | entering[b]) | of_face[a]
    faces = np.zeros(level.num_faces, dtype=bool)
    faces[level.face[np.flatnonzero(level.rim)[edges]]] = True
    return faces


def _rim_edges(level: Level, faces: Bools) -> tuple[Ints, Ints, Bools]:
    """Return start and end of the rim edges, and which of them belong to a marked face."""
    rim = np.flatnonzero(level.rim)
    return level.vertices[rim], level.vertices[level.following[rim]], faces[level.face[rim]]


def _one_edge_further(level: Level, a: Ints, b: Ints, edges: Bools) -> Bools:
    """Return the marked rim edges a -> b and those next to them.

    Walks may turn a free corner: its two rim edges have the same face.
    """
    passing = np.zeros(level.num_vertices, dtype=bool)
    passing[a[edges]] = passing[b[edges]] = True
    return edges | passing[a] | passing[b]
