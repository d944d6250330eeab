"""Which rank owns which cells and functions of a hierarchy, and of which others it holds copies.

Every rank holds the control mesh and the hierarchy's faces and keys, so that each finds out by itself what is owned by
whom.  What follows from them, cells with their operators, coefficients, matrices, is there for a rank's part alone.

*Cells* are put in a row along a space-filling curve, through the faces of level 0 and then through the quarters of each
in turn, and the row is cut into pieces of equal weight.  A refined hierarchy is cut anew.  A *function* belongs to a
rank that has cells at its vertex.

A rank holds, beside the cells it owns, all those on which one of its functions does not vanish, and those beside them:
so its rows of a matrix are complete without a word from others (integrals over facets between cells included).  And it
holds, beside its functions, all those that do not vanish on one of these cells.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from thccs_fem.hierarchy import Hierarchy, Stage, faces_meeting, functions_meeting
from thccs_fem.index_map import IndexMap
from thccs_fem.parallel import rank_of, size_of
from thccs_fem.subdivision import Bools, Ints, neighbourhood

__all__ = ["Partition", "needed_functions", "partition"]

CURVE_BITS = 20  # of each coordinate: 60 in space
CUT_WEIGHT = 2  # cost of a piece of a cell that is cut, relative to a cell that is not


@dataclass(frozen=True, eq=False)
class Partition:
    """Parts of a hierarchy on the ranks of its mesh's communicator.

    Attributes:
        cells: Which cells this rank owns and holds, by their number in the hierarchy.
        functions: Which functions.
        imbalance: Weight of the heaviest part, relative to the mean.
    """

    cells: IndexMap
    functions: IndexMap
    imbalance: float


def partition(hierarchy: Hierarchy) -> Partition:
    """Return the parts of a hierarchy, made once and kept with it."""
    if "_partition" not in hierarchy.__dict__:
        hierarchy.__dict__["_partition"] = _partition(hierarchy)
    found: Partition = hierarchy.__dict__["_partition"]
    return found


def _partition(hierarchy: Hierarchy) -> Partition:
    comm = hierarchy.mesh.comm
    stages = hierarchy.stages[: hierarchy.num_levels]
    num_cells = sum(stage.active_faces.size for stage in stages)
    if size_of(comm) == 1:
        return Partition(IndexMap.whole(num_cells, comm), IndexMap.whole(hierarchy.num_dofs, comm), 1.0)
    cell_owners, imbalance = _cut(_along_curve(hierarchy), _weights(hierarchy), size_of(comm))
    of_levels = np.split(cell_owners, np.cumsum([stage.active_faces.size for stage in stages])[:-1])
    function_owners = _function_owners(stages, of_levels)
    owned = _owned_faces(stages, of_levels, rank_of(comm))
    split = np.split(function_owners == rank_of(comm), hierarchy.dof_offsets[1:-1])
    touched = _faces_of(stages, split)
    held = _with_neighbours(stages, [a | b for a, b in zip(owned, touched, strict=True)])
    cells = np.concatenate([marks[stage.active_faces] for stage, marks in zip(stages, held, strict=True)])
    needed = needed_functions(hierarchy, cells)
    functions = np.concatenate([marks[stage.active] for stage, marks in zip(stages, needed, strict=False)])
    return Partition(
        IndexMap.spread(comm, cell_owners, cells), IndexMap.spread(comm, function_owners, functions), imbalance
    )


# ---- Cells -----------------------------------------------------------------------------------------------------------


def _along_curve(hierarchy: Hierarchy) -> npt.NDArray[np.int64]:
    """Return a number for each cell by which they stand in a row, shape (num_cells,)."""
    centres = hierarchy.points[0][hierarchy.root.quads].mean(axis=1)
    place = np.zeros(centres.shape[0], dtype=np.int64)
    place[np.argsort(_hilbert(centres), kind="stable")] = np.arange(place.size)
    deepest = hierarchy.num_levels - 1
    numbers = []
    for l, stage in enumerate(hierarchy.stages[: hierarchy.num_levels]):
        keys = stage.level.keys[stage.active_faces]
        path = (keys & (4**l - 1)) << 2 * (deepest - l)
        numbers.append((place[keys >> 2 * l] << 2 * deepest) + path)
    return np.concatenate(numbers)


def _hilbert(points: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
    """Return the distances of points along a Hilbert curve through their bounding box, shape (n,).

    Skilling, Programming the Hilbert curve, AIP Conference Proceedings 707 (2004), for all points at once.
    """
    n = points.shape[1]
    low, high = points.min(axis=0), points.max(axis=0)
    scale = (2**CURVE_BITS - 1) / max(float((high - low).max()), np.finfo(float).tiny)
    x = list(((points - low) * scale).astype(np.int64).T.copy())
    bit = 1 << (CURVE_BITS - 1)
    while bit > 1:  # undo the turns and mirrors of each level of the curve
        for i in range(n):
            mirrored = (x[i] & bit) != 0
            swapped = np.where(mirrored, 0, (x[0] ^ x[i]) & (bit - 1))
            x[0] = np.where(mirrored, x[0] ^ (bit - 1), x[0] ^ swapped)
            x[i] = x[i] ^ swapped
        bit >>= 1
    for i in range(1, n):  # Gray code
        x[i] = x[i] ^ x[i - 1]
    flips = np.zeros_like(x[0])
    bit = 1 << (CURVE_BITS - 1)
    while bit > 1:
        flips ^= np.where((x[n - 1] & bit) != 0, bit - 1, 0)
        bit >>= 1
    distance = np.zeros_like(flips)
    for b in range(CURVE_BITS - 1, -1, -1):
        for i in range(n):
            distance = (distance << 1) | (((x[i] ^ flips) >> b) & 1)
    return distance


def _weights(hierarchy: Hierarchy) -> npt.NDArray[np.int64]:
    """Return what integrals over each cell cost, shape (num_cells,)."""
    weights = []
    for l, stage in enumerate(hierarchy.stages[: hierarchy.num_levels]):
        level = stage.level
        cap = np.where(level.control_vertex >= 0, hierarchy.cap_levels[level.control_vertex], 0)
        cuts = np.where(level.regular, 0, np.maximum(cap - l, 0))
        pieces = 3 * cuts[level.quads[stage.active_faces]].sum(axis=1, dtype=np.int64)
        weights.append(np.where(pieces > 0, CUT_WEIGHT * (pieces + 1), 1))
    return np.concatenate(weights)


def _cut(place: npt.NDArray[np.int64], weights: npt.NDArray[np.int64], parts: int) -> tuple[Ints, float]:
    """Return the part of each cell, of parts that follow one another, and the weight of the heaviest over the mean."""
    order = np.argsort(place)
    ends = np.cumsum(weights[order])
    total = int(ends[-1])
    owners = np.zeros(order.size, dtype=np.int32)
    owners[order] = (2 * ends - weights[order]) * parts // (2 * total)  # where the middle of each cell lies
    return owners, float(np.bincount(owners, weights=weights).max() * parts / total)


def _owned_faces(stages: Sequence[Stage], owners: Sequence[Ints], rank: int) -> list[Bools]:
    """Return for each level marks of the faces that are cells of a rank."""
    result = []
    for stage, of_cells in zip(stages, owners, strict=True):
        marks = np.zeros(stage.level.num_faces, dtype=bool)
        marks[stage.active_faces[of_cells == rank]] = True
        result.append(marks)
    return result


def _with_neighbours(stages: Sequence[Stage], cells: Sequence[Bools]) -> list[Bools]:
    """Return marks of cells and of those beside them, on each level; of coarser ones maybe some more."""
    result = [marks.copy() for marks in cells]
    up = cells[-1]
    for stage, marks, found in zip(stages[::-1], cells[::-1], result[::-1], strict=True):
        if stage is not stages[-1]:
            up = marks | _parents(stage, up)
        found |= neighbourhood(stage.level, up)
    down = cells[0]
    for before, stage, marks, found in zip(stages, stages[1:], cells[1:], result[1:], strict=False):
        down = marks | _children(before, stage, down)
        found |= neighbourhood(stage.level, down)
    return [found & stage.inside & ~stage.refined for stage, found in zip(stages, result, strict=True)]


def _parents(stage: Stage, children: Bools) -> Bools:
    """Return marks of the faces that have a marked child on the next level."""
    marks = np.zeros(stage.level.num_faces, dtype=bool)
    assert stage.step is not None  # there is a next level
    parents = np.flatnonzero(stage.step.first_child >= 0)
    marks[parents] = children[stage.step.first_child[parents][:, None] + np.arange(4)].any(axis=1)
    return marks


def _children(stage: Stage, fine: Stage, faces: Bools) -> Bools:
    """Return marks of the children of marked faces, where there are any."""
    marks = np.zeros(fine.level.num_faces, dtype=bool)
    assert stage.step is not None  # there is a next level
    first = stage.step.first_child[faces]
    marks[first[first >= 0][:, None] + np.arange(4)] = True
    return marks


# ---- Functions -------------------------------------------------------------------------------------------------------


def _function_owners(stages: Sequence[Stage], cell_owners: Sequence[Ints]) -> Ints:
    """Return the rank of each function, shape (num_dofs,): one that has a cell at its vertex.

    Where several have, the lowest and the highest one take turns, so that none gets all that is between two.
    """
    result = []
    of_children: Ints = np.zeros(0, dtype=np.int32)
    for stage, owners in zip(reversed(stages), reversed(cell_owners), strict=True):
        level = stage.level
        of_faces = np.full(level.num_faces, -1, dtype=np.int32)
        of_faces[stage.active_faces] = owners
        if stage.refined.any():
            assert stage.step is not None  # it has children
            of_faces[stage.refined] = of_children[stage.step.first_child[stage.refined]]
        of_children = of_faces
        inside = stage.inside[level.face]
        vertex, owner = level.vertices[inside], of_faces[level.face[inside]]
        lowest = np.full(level.num_vertices, np.iinfo(np.int32).max, dtype=np.int32)
        highest = np.full(level.num_vertices, -1, dtype=np.int32)
        np.minimum.at(lowest, vertex, owner)
        np.maximum.at(highest, vertex, owner)
        of_vertices = np.where(np.arange(level.num_vertices) % 2 == 0, lowest, highest)
        of_functions = np.concatenate([of_vertices, of_vertices[stage.boundary.vertex]])
        result.append(of_functions[stage.active])
    return np.concatenate(result[::-1]).astype(np.int32)


def _faces_of(stages: Sequence[Stage], dofs: Sequence[Bools]) -> list[Bools]:
    """Return for each level marks of the faces where one of the given dofs, marked level by level, does not vanish."""
    result = []
    reached = np.zeros(stages[0].selected.size, dtype=bool)
    for stage, chosen in zip(stages, dofs, strict=True):
        reached[stage.selected] = False  # the truncation
        reached[np.flatnonzero(stage.active)[chosen]] = True
        result.append(faces_meeting(stage.boundary, reached) & stage.inside & ~stage.refined)
        if stage is not stages[-1]:
            reached = _pattern(stage) @ reached.astype(np.int32) > 0
    return result


def needed_functions(hierarchy: Hierarchy, cells: Bools) -> list[Bools]:
    """Return for each stage marks of the functions whose coefficients make the functions on the given cells.

    They are the rows of the coefficient matrices that are needed there; and the active ones among them are the dofs
    that do not vanish on these cells.

    Args:
        hierarchy: The hierarchy.
        cells: Marks of the cells, shape (num_cells,).
    """
    faces = _piece_faces(hierarchy, cells)
    result = [functions_meeting(stage.boundary, marks) for stage, marks in zip(hierarchy.stages, faces, strict=True)]
    for l in range(len(result) - 1, 0, -1):
        carried = result[l] & ~hierarchy.stages[l].selected  # rows of selected functions are truncated
        result[l - 1] |= _pattern(hierarchy.stages[l - 1]).T @ carried.astype(np.int32) > 0
    return result


def _piece_faces(hierarchy: Hierarchy, cells: Bools) -> list[Bools]:
    """Return for each stage marks of the faces that are pieces of the given cells."""
    result, first = [], 0
    cut: Bools = np.zeros(0, dtype=bool)
    before: Stage | None = None
    for stage in hierarchy.stages:
        active = stage.active_faces
        marks = np.zeros(stage.level.num_faces, dtype=bool) if before is None else _children(before, stage, cut)
        marks[active] = cells[first : first + active.size]
        first += active.size
        cut = marks & stage.cut
        result.append(marks & ~stage.cut)
        before = stage
    return result


def _pattern(stage: Stage) -> sp.csr_array:
    """Return ones where the stage's matrix has entries."""
    assert stage.matrix is not None  # every stage but the last has one
    ones = np.ones(stage.matrix.nnz, dtype=np.int32)
    return sp.csr_array((ones, stage.matrix.indices, stage.matrix.indptr), shape=stage.matrix.shape)
