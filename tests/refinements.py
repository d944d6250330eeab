"""Random refinements of the meshes of the zoo, drawn by Hypothesis, and what is measured on them."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from hypothesis import strategies as st
from zoo import ZOO

from thccs_fem import element
from thccs_fem.boundary import to_dofs
from thccs_fem.extraction import Cells
from thccs_fem.hierarchy import CAP_LEVEL, Hierarchy, Stage

# Levels 0 .. 3: no cap has to sink below CAP_LEVEL, so that all hierarchies of a mesh have the same caps.
MAX_LEVELS = 4
assert MAX_LEVELS <= CAP_LEVEL

PLACES = ("any", "rim", "irregular")
# A step refines a few functions: where, whether among the finest, and which.
Choice = tuple[str, bool, int]
CHOICES = st.tuples(st.sampled_from(PLACES), st.sampled_from((True, False)), st.integers(0, 9999))
STEPS = st.lists(st.lists(CHOICES, min_size=1, max_size=3), min_size=3, max_size=5)

MESHES = {name: build() for name, build in ZOO.items()}
WITH_RIM = [name for name, mesh in MESHES.items() if mesh.boundary_edges.size]
# Without a rim both rules are one.
CASES = [(name, "crease") for name in ZOO] + [(name, "clamped") for name in WITH_RIM]


@functools.cache
def coarsest(name: str, rule: str) -> Hierarchy:
    return Hierarchy.on(MESHES[name], rule)


def refinements(name: str, rule: str, steps: list[list[Choice]]) -> list[Hierarchy]:
    """The hierarchy of a mesh with nothing refined, and what each step makes of the one before."""
    hierarchies = [coarsest(name, rule)]
    for step in steps:
        dofs = [chosen(hierarchies[-1], *choice) for choice in step]
        hierarchies.append(hierarchies[-1].refined(np.concatenate(dofs)))
    return hierarchies


def chosen(hierarchy: Hierarchy, place: str, finest: bool, number: int, most_levels: int = MAX_LEVELS) -> np.ndarray:
    """One of the dofs at a place that `most_levels` allows to be refined; if none is there, one elsewhere, or none."""
    levels = hierarchy.stages[: min(hierarchy.num_levels, most_levels - 1)]
    marks = np.concatenate([_at(place, stage)[stage.active] for stage in levels])
    if finest:
        marks[: hierarchy.dof_offsets[len(levels) - 1]] = False
    dofs = np.flatnonzero(marks) if marks.any() else np.arange(marks.size)
    return dofs[[number % dofs.size]] if dofs.size else dofs


def _at(place: str, stage: Stage) -> np.ndarray:
    level = stage.level
    if place == "rim":
        vertices = level.boundary
    elif place == "irregular":
        vertices = level.corners_of(level.touching(~level.regular))
    else:
        vertices = np.ones(level.num_vertices, dtype=bool)
    return np.concatenate([vertices, vertices[stage.boundary.vertex]])


def geometry_dofs(hierarchy: Hierarchy) -> np.ndarray:
    """The dofs of the surface itself (delta = 0), shape (num_dofs, gdim): truncation preserves coefficients."""
    values = []
    for l in range(hierarchy.num_levels):
        stage, points = hierarchy.stages[l], hierarchy.points[l]
        no_delta = np.zeros((stage.boundary.vertex.size, points.shape[1]))
        values.append((to_dofs(stage.boundary) @ np.vstack([points, no_delta]))[hierarchy.dof_functions(l)])
    return np.concatenate(values)


def levels_on_cells(cells: Cells) -> np.ndarray:
    """How many levels lie between that of a cell and the coarsest of a function on it, both counted, (num_cells,)."""
    level_of_dof = np.repeat(np.arange(cells.hierarchy.num_levels), np.diff(cells.hierarchy.dof_offsets))
    coarsest = np.zeros(cells.num_cells, dtype=int)
    for batch in cells.batches:
        levels = np.where(batch.dofs >= 0, level_of_dof[batch.dofs], cells.hierarchy.num_levels)
        coarsest[batch.cells] = levels.min(axis=1)
    return cells.level - coarsest + 1


def most_functions(cells: Cells) -> int:
    """The largest number of functions on a cell."""
    return max(int((batch.dofs >= 0).sum(axis=1).max()) for batch in cells.batches)


def random_positions(hierarchy: Hierarchy, count: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points all over the control mesh: faces, coordinates, and corners (for sub-quads of polygons too)."""
    rng = np.random.default_rng(seed)
    faces = rng.integers(0, hierarchy.mesh.num_faces, count)
    corners = rng.integers(0, hierarchy.mesh.face_sizes[faces])
    return faces, rng.random((count, 2)), corners


def random_vector(size: int, seed: int = 2) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (size, 1))


def bernstein_rows(cells: Cells) -> sp.csr_array:
    """The extraction operators of all pieces in the Bernstein basis, shape (16 num_pieces, num_dofs)."""
    every = np.arange(cells.num_pieces, dtype=np.int32)
    change = sp.kron(sp.eye_array(every.size), sp.csr_array(element.TO_BERNSTEIN), format="csr")
    return sp.csr_array(change @ cells.rows(every))


def bernstein_mass() -> np.ndarray:
    """Integrals of the products of the four cubic Bernstein polynomials over [0, 1]."""
    return np.array(
        [[math.comb(3, i) * math.comb(3, j) / (7 * math.comb(6, i + j)) for j in range(4)] for i in range(4)]
    )


def scaled_eigenvalue(gram: np.ndarray) -> float:
    """The smallest eigenvalue of a Gram matrix with its diagonal scaled to one; 0 if a function vanishes."""
    diagonal = np.diag(gram)
    if diagonal.min() <= 0.0:
        return 0.0
    return float(np.linalg.eigvalsh(gram / np.sqrt(np.outer(diagonal, diagonal)))[0])


CORNERS = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
ALONG = np.roll(CORNERS, -1, axis=0) - CORNERS  # side k runs from corner k to corner k + 1
INWARD = np.roll(ALONG, -1, axis=0)


@dataclass(frozen=True)
class EdgePoints:
    """Points on common edges of pieces, seen from both sides: pieces, coordinates, the vector that crosses the edge,
    and whether both pieces are faces with four regular corners."""

    piece: np.ndarray
    uv: np.ndarray
    across: np.ndarray
    regular: np.ndarray


def regular_pieces(cells: Cells) -> np.ndarray:
    """Marks of the pieces that are faces with four regular corners: the others are caps, or beside one."""
    regular = np.zeros(cells.num_pieces, dtype=bool)
    for stage, piece_of_face in zip(cells.hierarchy.stages, cells.piece_of_face, strict=True):
        whole = np.flatnonzero(piece_of_face >= 0)
        regular[piece_of_face[whole]] = stage.level.regular[stage.level.quads[whole]].all(axis=1)
    return regular


def edge_points(cells: Cells, per_side: int = 2, seed: int = 3) -> EdgePoints:
    """Random points on all edges between pieces; arrays of shape (2, n, ...), first the coarser or equal side.

    `across` is one unit of the first piece, the same vector of the surface's parameters on both sides.
    """
    rng = np.random.default_rng(seed)
    found = []
    regular = regular_pieces(cells)
    for m, (stage, piece_of_face) in enumerate(zip(cells.hierarchy.stages, cells.piece_of_face, strict=True)):
        level = stage.level
        side = np.flatnonzero(np.repeat(piece_of_face >= 0, 4) & ~level.rim)
        side = np.repeat(side, per_side)
        twin = level.twins[side]
        assert (twin >= 0).all(), "a piece has no neighbour held"
        s = rng.random((side.size, 1))
        face, k = side // 4, side % 4
        uv = CORNERS[k] + s * ALONG[k]
        k = twin % 4
        other = _followed(cells, m, twin // 4, CORNERS[k] + (1.0 - s) * ALONG[k], INWARD[k])
        known = other[0] >= 0  # others lie in coarser pieces, and are seen from there
        found.append(
            (
                np.stack([piece_of_face[face], other[0]])[:, known],
                np.stack([uv, other[1]])[:, known],
                np.stack([-INWARD[side % 4], other[2]])[:, known],
            )
        )
    piece, uv, across = (np.concatenate(parts, axis=1) for parts in zip(*found, strict=True))
    return EdgePoints(piece, uv, across, regular[piece].all(axis=0))


def _followed(cells: Cells, m: int, face: np.ndarray, uv: np.ndarray, across: np.ndarray):
    """The pieces below the given faces of stage m that hold the points (-1 if the face lies in a piece)."""
    piece = np.full(face.size, -1)
    uv, across = uv.copy(), across.copy()
    todo = np.arange(face.size)
    for stage, piece_of_face in zip(cells.hierarchy.stages[m:], cells.piece_of_face[m:], strict=True):
        piece[todo] = piece_of_face[face]
        opened = (stage.refined | stage.cut)[face]
        todo, face = todo[opened], face[opened]
        if not todo.size:
            break
        right, upper = uv[todo].T >= 0.5
        child = np.where(upper, np.where(right, 2, 3), np.where(right, 1, 0))
        frame = np.stack([ALONG[child], INWARD[child]], axis=1)  # the child's axes, in rows
        uv[todo] = 2.0 * np.einsum("nij,nj->ni", frame, uv[todo] - CORNERS[child])
        across[todo] = 2.0 * np.einsum("nij,nj->ni", frame, across[todo])
        face = stage.step.first_child[face] + child
    return piece, uv, across


def derivatives_across(local: np.ndarray, points: EdgePoints, side: int) -> np.ndarray:
    """Value, first and second derivative along `across` at the points, shape (3, n, k)."""
    grid = local[points.piece[side]].reshape(points.piece.shape[1], 4, 4, -1)  # [point, j, i, component]
    u, v = points.uv[side].T
    tables = [(f(u), f(v)) for f in (element.bspline_values, element.bspline_slopes, _bspline_curvatures)]

    def at(du: int, dv: int) -> np.ndarray:
        return np.einsum("ni,nj,njik->nk", tables[du][0], tables[dv][1], grid)

    x, y = points.across[side].T[:, :, None]
    return np.stack(
        [at(0, 0), x * at(1, 0) + y * at(0, 1), x * x * at(2, 0) + 2.0 * x * y * at(1, 1) + y * y * at(0, 2)]
    )


def _bspline_curvatures(t: np.ndarray) -> np.ndarray:
    return np.stack([1.0 - t, 3.0 * t - 2.0, 1.0 - 3.0 * t, t], axis=-1)
