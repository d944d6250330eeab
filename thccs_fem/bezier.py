"""Bezier masks: the 16 Bernstein coefficients of a face as linear combinations of its level's functions.

Three masks give the bicubic patch of a regular face exactly, and a C0 cap at an irregular vertex of valence n:

* face-corner point of corner k: I = (n P_k + 2 P_{k+1} + 2 P_{k-1} + P_{k+2}) / (n + 5), n = 4 on the boundary;
* edge point at a vertex: mean of the two I on either side; (2 P_k + P_neighbour) / 3 along the boundary;
* vertex point: mean of all I around, which is the limit mask; (P- + 4 P + P+) / 6 on a smooth boundary, P at a corner.

Each belongs to a vertex, an edge or a face corner, so neighbouring patches meet.  Coefficients are numbered i + 4 j, i
along the edge from corner 0 to 1, j along that from 0 to 3.  Trace functions change the boundary rows alone.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from thccs_fem.boundary import Boundary
from thccs_fem.sparse import Triplets, csr, entries, product, rows_of, summed
from thccs_fem.subdivision import Ints, Level

__all__ = ["bezier_masks", "spline_grid"]

# Place (i + 4 j) of the points that corner k owns.
VERTEX_PLACE = np.array([0, 3, 15, 12])
EDGE_PLACE_NEXT = np.array([1, 7, 14, 8])  # at corner k towards corner k + 1
EDGE_PLACE_PREVIOUS = np.array([4, 2, 11, 13])  # at corner k towards corner k - 1
FACE_PLACE = np.array([5, 6, 10, 9])


def bezier_masks(boundary: Boundary, faces: Ints) -> sp.csr_array:
    """Return the matrix that takes (P, delta) of a level to Bernstein coefficients.

    Args:
        boundary: Boundary of a quadrilateral level.
        faces: Faces, all of whose vertices are complete in the level, shape (n,).

    Returns:
        Shape (16 n, boundary.num_functions); row 16 k + i + 4 j for coefficient (i, j) of the k-th face.
    """
    level = boundary.level
    half_edges = level.half_edges(faces)
    shape = 4 * half_edges.size, boundary.num_functions
    if not faces.size:
        return sp.csr_array(shape)
    used, averages = _averages(level, half_edges)
    rows = product(averages, _face_corner_points(level, used, boundary.num_functions))
    if level.boundary[level.vertices[half_edges]].any():
        rows = summed([entries(rows), *_rim_rows(boundary, half_edges)], shape)
    # Row 4 * half-edges + (vertex, next, previous, face corner) as built, row 16 * face + place as wanted.
    order = np.zeros((faces.size, 16), dtype=np.int32)
    for kind, place in enumerate((VERTEX_PLACE, EDGE_PLACE_NEXT, EDGE_PLACE_PREVIOUS, FACE_PLACE)):
        order[:, place] = 4 * np.arange(half_edges.size).reshape(-1, 4) + kind
    return rows_of(rows, order.ravel())


def _face_corner_points(level: Level, half_edges: Ints, num_functions: int) -> sp.csr_array:
    """Return the masks I of half-edges, shape (n, num_functions)."""
    opposite = level.following[level.following[half_edges]]
    columns = level.vertices[
        np.stack([half_edges, level.following[half_edges], opposite, level.previous[half_edges]], axis=1)
    ]
    start = level.vertices[half_edges]
    n = np.where(level.boundary[start], 4.0, level.vertex_num_faces[start])
    weights = np.stack([n, np.full_like(n, 2.0), np.ones_like(n), np.full_like(n, 2.0)], axis=1) / (n + 5.0)[:, None]
    indptr = np.arange(0, 4 * n.size + 1, 4, dtype=np.int32)
    return csr(weights.ravel(), columns.ravel(), indptr, (n.size, num_functions))


def _averages(level: Level, half_edges: Ints) -> tuple[Ints, sp.csr_array]:
    """Return half-edges, and the means of their I that are no boundary rows, shape (4 * n, number of these)."""
    row = 4 * np.arange(half_edges.size, dtype=np.int32)
    previous = level.previous[half_edges]
    across, across_previous = level.twins[half_edges], level.twins[previous]
    next_inside, previous_inside = ~level.rim[half_edges], ~level.rim[previous]
    other_next = level.following[across]  # starts at the same vertex, in the face across the edge
    interior = ~level.boundary[level.vertices[half_edges]]
    around, count = _fans(level, level.vertices[half_edges[interior]])
    triplets: Triplets = [
        (np.repeat(row[interior], count), around, np.repeat(1.0 / np.maximum(count, 1), count)),
        (row[next_inside] + 1, half_edges[next_inside], 0.5),
        (row[next_inside] + 1, other_next[next_inside], 0.5),
        (row[previous_inside] + 2, half_edges[previous_inside], 0.5),
        (row[previous_inside] + 2, across_previous[previous_inside], 0.5),
        (row + 3, half_edges, 1.0),
    ]
    marks = np.zeros(level.vertices.size, dtype=bool)
    for _, columns, _ in triplets:
        marks[columns] = True
    used = np.flatnonzero(marks).astype(np.int32)
    number = np.zeros(level.vertices.size, dtype=np.int32)
    number[used] = np.arange(used.size, dtype=np.int32)
    shape = 4 * half_edges.size, used.size
    return used, summed([(rows, number[columns], values) for rows, columns, values in triplets], shape)


def _fans(level: Level, vertices: Ints) -> tuple[Ints, Ints]:
    """Return the half-edges that start at each vertex, one list, and how many belong to each."""
    wanted = np.zeros(level.num_vertices, dtype=bool)
    wanted[vertices] = True
    starts = np.flatnonzero(wanted[level.vertices]).astype(np.int32)
    order = starts[np.argsort(level.vertices[starts], kind="stable")]
    count = np.bincount(level.vertices[starts], minlength=level.num_vertices).astype(np.int32)
    begin = (np.cumsum(count) - count)[vertices]
    count = count[vertices]
    within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    return order[np.repeat(begin, count) + within], count


def _rim_rows(boundary: Boundary, half_edges: Ints) -> Triplets:
    """Return the boundary rows: the crease masks applied to P + delta / 6, rows 4 * half-edges + kind."""
    level = boundary.level
    triplets = _rim_vertex_rows(boundary, half_edges)
    row = 4 * np.arange(half_edges.size)
    start = level.vertices[half_edges]
    previous = level.previous[half_edges]
    out, into = boundary.out_side, boundary.in_side
    for kind, edge, neighbour, own, other in (
        (1, half_edges, level.vertices[level.following[half_edges]], out, into),
        (2, previous, level.vertices[previous], into, out),
    ):
        on = level.rim[edge]
        r, a, b = row[on] + kind, start[on], neighbour[on]
        triplets += [(r, a, 2 / 3), (r, b, 1 / 3), (r, own[a], 1 / 9), (r, other[b], 1 / 18)]
    return triplets


def _rim_vertex_rows(boundary: Boundary, half_edges: Ints) -> Triplets:
    """Vertex points on the boundary: (P- + 4 P + P+) / 6 of P + delta / 6, or the point of the corner."""
    level = boundary.level
    start = level.vertices[half_edges]
    row = 4 * np.arange(half_edges.size, dtype=np.int32)
    at_corner = level.corner[start]
    smooth = level.boundary[start] & ~at_corner
    rim = np.flatnonzero(level.rim)
    before, after = (np.full(level.num_vertices, -1, dtype=np.int32) for _ in range(2))
    a, b = level.vertices[rim], level.vertices[level.following[rim]]
    before[b], after[a] = a, b
    v = start[smooth]
    triplets: Triplets = [(row[at_corner], start[at_corner], 1.0)]
    sides = ((v, boundary.first, 4.0), (before[v], boundary.out_side, 1.0), (after[v], boundary.in_side, 1.0))
    for vertex, side, weight in sides:
        triplets += [(row[smooth], vertex, weight / 6), (row[smooth], side[vertex], weight / 36)]
    free = at_corner & (boundary.first[start] >= 0)
    for shift, value in enumerate((1 / 6, 1 / 6, 1 / 36)):
        triplets += [(row[free], boundary.first[start[free]] + shift, value)]
    return triplets


def spline_grid(level: Level, faces: Ints) -> Ints:
    """Return the 4 x 4 control vertices of regular interior faces, number i + 4 j, shape (n, 16).

    Args:
        level: A quadrilateral level.
        faces: Faces whose corners are regular interior vertices, complete in the level, shape (n,).
    """
    grid = np.zeros((faces.size, 16), dtype=np.int32)
    twins, vertices = level.twins, level.vertices
    # Around corner k: the corner, the two vertices across the edge that follows it, and the one across the corner.
    places = ((5, 1, 2, 0), (6, 7, 11, 3), (10, 14, 13, 15), (9, 8, 4, 12))
    for k, (own, near, far, diagonal) in enumerate(places):
        half_edge = 4 * faces + k
        across = twins[half_edge]
        beyond = level.following[level.following[across]]
        grid[:, own] = vertices[half_edge]
        grid[:, near] = vertices[beyond]
        grid[:, far] = vertices[level.following[beyond]]
        turned = level.following[twins[level.following[across]]]
        grid[:, diagonal] = vertices[level.following[level.following[turned]]]
    return grid
