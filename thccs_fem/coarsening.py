"""Coarser control meshes: Catmull-Clark steps taken back.

A mesh of quads is the subdivision of a coarser one if each face is [old vertex, edge point, face point, edge point],
and each vertex has the same role in all of its faces. That is a matter of topology alone, and so are the functions of
the coarser mesh: combinations of those of the finer one, by S, wherever the vertices lie. Multigrid needs no more of
coarser meshes, as it makes their matrices from that of the finest level.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from scipy.sparse import csgraph

from thccs_fem.boundary import Boundary, BoundaryRule, subdivision_matrix, to_dofs
from thccs_fem.sparse import product, rows_of
from thccs_fem.subdivision import Bools, Ints, Level, rim_distance, subdivide

__all__ = ["coarsened"]


def coarsened(level: Level, rule: BoundaryRule) -> tuple[Level, sp.csr_array] | None:
    """Return the mesh of quads that a level is the subdivision of, and the subdivision matrix; None if there is none.

    Where there are several, as for a torus, it is the one that keeps the first vertex, of those on a rim if it has one.
    Meshes with a face whose corners are inside and of valence 3 are passed over, as their functions may be dependent.

    Args:
        level: A whole level, of quads.
        rule: "clamped" or "crease".

    Returns:
        The coarser level and S in terms of the dof functions, shape (functions of the level, functions of the coarser
        one).
    """
    old = _old_vertices(level)
    if old is None:
        return None
    coarse, children = _parents(level, old)
    if coarse.dependent_faces.any():
        return None
    return coarse, _matrix(coarse, level, children, rule)


def _old_vertices(level: Level) -> Bools | None:
    """Return which vertices are old, shape (num_vertices,), or None."""
    size, quads = level.num_vertices, level.quads
    part, first = _parts(level)
    side = _sides(size, quads, np.roll(quads, -1, axis=1))
    if side is None:
        return None
    even = side == side[first][part]  # old vertices and face points: the others are edge points
    diagonals = np.where(even[quads[:, :1]], quads[:, [0, 2]], quads[:, [1, 3]])
    side = _sides(size, diagonals[:, 0], diagonals[:, 1])
    if side is None:
        return None
    old = even & (side == side[first][part])
    fits = old | (level.regular & ~(even & level.boundary))
    return old if fits.all() else None


def _parts(level: Level) -> tuple[Ints, npt.NDArray[np.integer]]:
    """Return the connected part of each vertex, and in each part the vertex that is old if there are any."""
    graph = _graph(level.num_vertices, level.vertices, level.vertices[level.following])
    _, part = csgraph.connected_components(graph, directed=False)
    rank = np.where(level.regular & ~level.corner, np.where(level.boundary, 1, 2), 0)
    order = np.lexsort((rank, part))  # those that are nothing but old come first, then the rim
    _, first = np.unique(part[order], return_index=True)
    return part, order[first]


def _sides(size: int, a: Ints, b: Ints) -> npt.NDArray[np.bool_] | None:
    """Return sides such that each a is on the other side than its b, shape (size,); None if there are none.

    There are if no walk along the pairs comes back on the other side: v and v + size are then in different parts.
    """
    a, b = a.ravel(), b.ravel()
    twice = _graph(2 * size, np.concatenate([a, a + size]), np.concatenate([b + size, b]))
    _, part = csgraph.connected_components(twice, directed=False)
    if (part[:size] == part[size:]).any():
        return None
    return np.asarray(part[:size] < part[size:])


def _graph(size: int, a: Ints, b: Ints) -> sp.csr_array:
    return sp.csr_array((np.ones(a.size, dtype=np.int8), (a, b)), shape=(size, size))


def _parents(level: Level, old: Bools) -> tuple[Level, Ints]:
    """Return the coarser level, and for each of its half-edges that of the level which starts at the same vertex."""
    faces = np.arange(level.num_faces)
    start = (4 * faces + old[level.quads].argmax(axis=1)).astype(np.int32)
    beside = level.face[level.twins[level.following[start]]]  # the next child around the face point
    around = np.stack([faces, beside, beside[beside], beside[beside[beside]]], axis=1)
    children = start[around[around.argmin(axis=1) == 0].ravel()]
    number = np.zeros(level.num_faces, dtype=np.int32)
    number[level.face[children]] = faces
    # Across its first half-edge a child meets the one at the half-edge that follows the twin.
    across = level.twins[children]
    follower = number[level.face[across]]
    twins = np.where(across < 0, -1, np.where(follower % 4 == 0, follower + 3, follower - 1)).astype(np.int32)
    kept = np.flatnonzero(old).astype(np.int32)
    new = np.cumsum(old, dtype=np.int32) - 1
    vertices = new[level.vertices[children]]
    ends = np.roll(vertices.reshape(-1, 4), -1, axis=1).ravel()
    rim = twins < 0
    coarse = Level(
        number=level.number - 1,
        offsets=np.arange(0, faces.size + 1, 4, dtype=np.int32),
        vertices=vertices,
        twins=twins,
        keys=np.arange(faces.size // 4, dtype=np.int64),
        boundary_edge=np.where(rim, faces, -1).astype(np.int32),
        vertex_num_faces=level.vertex_num_faces[kept],
        boundary=level.boundary[kept],
        corner=level.corner[kept],
        control_vertex=np.arange(kept.size, dtype=np.int32),
        rim_distance=rim_distance(level.boundary[kept] & ~level.regular[kept], vertices[rim], ends[rim]),
    )
    return coarse, children


def _matrix(coarse: Level, level: Level, children: Ints, rule: BoundaryRule) -> sp.csr_array:
    """Return the subdivision matrix, with rows in the order of the level's functions."""
    step = subdivide(coarse, np.ones(coarse.num_faces, dtype=bool))
    corners = children[:, None] // 4 * 4 + (children[:, None] + np.arange(4)) % 4
    vertex = np.zeros(level.num_vertices, dtype=np.int32)  # of the level, for each vertex of the step
    vertex[step.fine.vertices] = level.vertices[corners].ravel()
    before, after, own = (Boundary.of(of, rule) for of in (coarse, step.fine, level))
    nth = np.arange(after.vertex.size) + level.num_vertices - after.first[after.vertex]
    functions = np.concatenate([vertex, own.first[vertex[after.vertex]] + nth])
    matrix = step.matrix
    if before.vertex.size or after.vertex.size:
        matrix = product(product(to_dofs(after), subdivision_matrix(before, after, step)), before.to_points)
    return rows_of(matrix, np.argsort(functions))
