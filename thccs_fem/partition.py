"""Which rank owns which cells and functions of a hierarchy, and of which others it holds copies.

Every rank holds the control mesh and the hierarchy's faces and keys.  What follows from them, cells with their
operators, coefficients, matrices, is there for a rank's part alone.

*Cells* are cut in two by a plane, each part again, until there is one for each rank; all have about the same weight.
Rank 0 cuts for all; the rest each rank finds out by itself.  A refined hierarchy is cut anew.  A *function* belongs to
the lowest rank that has a cell at its vertex.

A rank holds, beside the cells it owns, all those on which one of its functions does not vanish, and those beside them:
so its rows of a matrix are complete without a word from others (integrals over facets between cells included).  And it
holds, beside its functions, all those that do not vanish on one of these cells.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from thccs_fem.hierarchy import Hierarchy, Stage
from thccs_fem.index_map import IndexMap
from thccs_fem.parallel import by_first_rank, rank_of, size_of
from thccs_fem.regions import faces_meeting, functions_meeting
from thccs_fem.subdivision import Bools, Ints, neighbourhood

__all__ = ["Partition", "cell_owners", "needed_functions", "partition"]

Floats = npt.NDArray[np.float64]

# Cost of a piece with an extraction operator, relative to one without. Measured, Laplace and mass: 1.5 in matrices, 3.5
# in vectors, 3 with what is made once for a hierarchy.
OPERATOR_WEIGHT = 2
SAMPLE = 5000  # cells by which directions of planes are compared


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

    @classmethod
    def of(cls, hierarchy: Hierarchy, comm: Any, cell_owners: Ints) -> Partition:
        """Return what a rank owns and holds.

        Args:
            hierarchy: The hierarchy.
            comm: The communicator, of which only the rank and the number of ranks are asked.
            cell_owners: Rank of each cell, the same on all ranks, shape (num_cells,).
        """
        stages = hierarchy.stages[: hierarchy.num_levels]
        of_levels = np.split(cell_owners, np.cumsum([stage.active_faces.size for stage in stages])[:-1])
        function_owners = _function_owners(stages, of_levels)
        owned = _owned_faces(stages, of_levels, rank_of(comm))
        touched = _faces_of(stages, np.split(function_owners == rank_of(comm), hierarchy.dof_offsets[1:-1]))
        held = _with_neighbours(stages, [a | b for a, b in zip(owned, touched, strict=True)])
        cells = np.concatenate([marks[stage.active_faces] for stage, marks in zip(stages, held, strict=True)])
        needed = needed_functions(hierarchy, cells)
        functions = np.concatenate([marks[stage.active] for stage, marks in zip(stages, needed, strict=False)])
        weight_of_ranks = np.bincount(cell_owners, weights=_weights(hierarchy), minlength=size_of(comm))
        return cls(
            cells=IndexMap.spread(comm, cell_owners, cells),
            functions=IndexMap.spread(comm, function_owners, functions),
            imbalance=float(weight_of_ranks.max() / weight_of_ranks.mean()),
        )


def partition(hierarchy: Hierarchy) -> Partition:
    """Return the parts of a hierarchy, made once and kept with it; collective."""
    if "_partition" not in hierarchy.__dict__:
        comm = hierarchy.mesh.comm
        if size_of(comm) == 1:
            num_cells = sum(stage.active_faces.size for stage in hierarchy.stages[: hierarchy.num_levels])
            made = Partition(IndexMap.whole(num_cells, comm), IndexMap.whole(hierarchy.num_dofs, comm), 1.0)
        else:  # rounding decides where much is symmetric: one rank decides for all
            owners = by_first_rank(comm, lambda: cell_owners(hierarchy, size_of(comm)))
            made = Partition.of(hierarchy, comm, owners)
        hierarchy.__dict__["_partition"] = made
    found: Partition = hierarchy.__dict__["_partition"]
    return found


# ---- Cells -----------------------------------------------------------------------------------------------------------


def cell_owners(hierarchy: Hierarchy, parts: int) -> Ints:
    """Return the part that each cell belongs to, of parts of about equal weight, shape (num_cells,)."""
    stages = hierarchy.stages[: hierarchy.num_levels]
    quads = [
        points[stage.level.quads[stage.active_faces]] for points, stage in zip(hierarchy.points, stages, strict=False)
    ]
    corners, weights = np.concatenate(quads), _weights(hierarchy)
    owners = np.zeros(weights.size, dtype=np.int32)
    to_cut = [(np.arange(weights.size), 0, parts)]
    while to_cut:
        cells, first, count = to_cut.pop()
        owners[cells] = first
        if count > 1 and cells.size:
            low, high = _cut(corners[cells], weights[cells], count // 2 / count)
            to_cut += [(cells[low], first, count // 2), (cells[high], first + count // 2, count - count // 2)]
    return owners


def _cut(corners: Floats, weights: Floats, share: float) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Return the cells on either side of a plane, ascending: on one as much of the weight as is given.

    Of planes across the axes, and across the principal axes of the cells' centres, the one that goes through the fewest
    cells.

    Args:
        corners: Shape (n, 4, gdim).
        weights: Shape (n,).
        share: Between 0 and 1.
    """
    sample = slice(None, None, -(-weights.size // SAMPLE))
    few, their_weights = corners[sample], weights[sample]
    offsets = few.mean(axis=1) - np.average(few.mean(axis=1), axis=0, weights=their_weights)
    principal = np.linalg.eigh((their_weights * offsets.T) @ offsets)[1]
    directions = np.concatenate([np.eye(corners.shape[2]), principal[:, ::-1].T])
    direction = min(directions, key=lambda direction: _num_crossed(few @ direction, their_weights, share))
    order, num_low = _halves((corners @ direction).mean(axis=1), weights, share)
    return np.sort(order[:num_low]), np.sort(order[num_low:])


def _halves(heights: Floats, weights: Floats, share: float) -> tuple[npt.NDArray[np.int64], int]:
    """Return the cells in the order of their heights, and how many of the lowest have a share of the weight."""
    order = np.argsort(heights, kind="stable")
    ends = np.cumsum(weights[order])
    return order, int(np.searchsorted(ends - weights[order] / 2, share * ends[-1]))  # by the middles of cells


def _num_crossed(heights: Floats, weights: Floats, share: float) -> int:
    """Return how many cells the plane goes through that has a share of the weight below it; heights (n, 4)."""
    middles = heights.mean(axis=1)
    order, num_low = _halves(middles, weights, share)
    height = middles[order[min(num_low, order.size - 1)]]
    return int(np.count_nonzero((heights.min(axis=1) < height) & (heights.max(axis=1) > height)))


def _weights(hierarchy: Hierarchy) -> Floats:
    """Return what integrals over each cell cost, shape (num_cells,)."""
    weights = []
    for l, stage in enumerate(hierarchy.stages[: hierarchy.num_levels]):
        level, faces = stage.level, stage.active_faces
        cap = np.where(level.control_vertex >= 0, hierarchy.cap_levels[level.control_vertex], 0)
        cuts = np.where(level.regular, 0, np.maximum(cap - l, 0))[level.quads[faces]]
        pieces = np.where(cuts.any(axis=1), 4 + 3 * np.maximum(cuts - 1, 0).sum(axis=1), 1)
        mixed = ~stage.active
        mixed[stage.boundary.vertex] = True  # is not a control point itself
        with_operator = level.touching(level.boundary | ~level.regular) | faces_meeting(stage.boundary, mixed)
        weights.append(np.where(with_operator[faces], OPERATOR_WEIGHT * pieces, 1.0))
    return np.concatenate(weights)


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
        assert before.step is not None  # there is a next level
        down = marks | before.step.marks_of(down)
        found |= neighbourhood(stage.level, down)
    return [found & stage.inside & ~stage.refined for stage, found in zip(stages, result, strict=True)]


def _parents(stage: Stage, children: Bools) -> Bools:
    """Return marks of the faces that have a marked child on the next level."""
    marks = np.zeros(stage.level.num_faces, dtype=bool)
    assert stage.step is not None  # there is a next level
    parents = np.flatnonzero(stage.step.first_child >= 0)
    marks[parents] = children[stage.step.first_child[parents][:, None] + np.arange(4)].any(axis=1)
    return marks


# ---- Functions -------------------------------------------------------------------------------------------------------


def _function_owners(stages: Sequence[Stage], cell_owners: Sequence[Ints]) -> Ints:
    """Return the rank of each function, shape (num_dofs,): the lowest that has a cell at its vertex."""
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
        of_vertices = np.full(level.num_vertices, np.iinfo(np.int32).max, dtype=np.int32)
        np.minimum.at(of_vertices, level.vertices[inside], of_faces[level.face[inside]])
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
    marks = np.zeros(hierarchy.root.num_faces, dtype=bool)
    for stage in hierarchy.stages:
        active = stage.active_faces
        marks[active] = cells[first : first + active.size]
        first += active.size
        result.append(marks & ~stage.cut)
        if stage.step is not None:
            marks = stage.step.marks_of(marks & stage.cut)
    return result


def _pattern(stage: Stage) -> sp.csr_array:
    """Return ones where the stage's matrix has entries."""
    assert stage.matrix is not None  # every stage but the last has one
    ones = np.ones(stage.matrix.nnz, dtype=np.int32)
    return sp.csr_array((ones, stage.matrix.indices, stage.matrix.indptr), shape=stage.matrix.shape)
