"""From a hierarchy to what is integrated: cells, their bicubic pieces, and an extraction operator for each piece.

A *cell* is an active element of the hierarchy.  A *piece* is one bicubic patch of it: a regular cell is one piece, an
irregular one is cut into three pieces a level and a cap.  On a piece, with u the dofs of its cell,

    local B-spline coefficients = operator @ u[dofs].

Cells are numbered level by level, within a level in the order of its faces; on several ranks each has a part of them
(see `partition`), and numbers of its own for these.  The local basis is that of `thccs_fem.element`: function i + 4 j,
i along the piece's first edge.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from thccs_fem import element, jit
from thccs_fem.bezier import bezier_masks, spline_grid
from thccs_fem.hierarchy import Hierarchy, Stage
from thccs_fem.index_map import IndexMap
from thccs_fem.joined import Parts, groups, joined_boundaries
from thccs_fem.limit import evaluate_patches
from thccs_fem.partition import Partition, needed_functions, partition
from thccs_fem.positions import CHILD_AXES, CHILD_ORIGIN, child_at, side_points
from thccs_fem.sparse import first_rows, product, rows_of, stacked, summed
from thccs_fem.subdivision import Bools, Ints

__all__ = ["Batch", "Cells", "Rows", "evaluate_pieces", "extract"]

WIDTH = 8  # operators are padded to a multiple of this many columns

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Batch:
    """Cells whose operators have the same width, in the order of their numbers.

    Attributes:
        cells: Cell numbers, shape (n,).
        dofs: Dofs of each cell, ascending, padded with -1 at the end, shape (n, width); where `operators` is None, in
            local order and not padded.
        offsets: Pieces of the k-th cell are offsets[k] .. offsets[k + 1] of this batch, shape (n + 1,).
        nodes: Rows of `Cells.points` for each piece, shape (num_pieces, 16).
        operators: Extraction operators, shape (num_pieces, 16, width); None: identity, one piece a cell.
    """

    cells: Ints
    dofs: Ints
    offsets: Ints
    nodes: Ints
    operators: Floats | None

    def __post_init__(self) -> None:
        for value in self.__dict__.values():
            if isinstance(value, np.ndarray):
                value.setflags(write=False)

    @property
    def num_pieces(self) -> int:
        """Number of pieces."""
        return self.nodes.shape[0]

    @cached_property
    def piece_cells(self) -> Ints:
        """Cell number of each piece, shape (num_pieces,)."""
        return np.repeat(self.cells, np.diff(self.offsets))

    def local(self, u: Floats) -> Floats:
        """Return the local B-spline coefficients of each piece, shape (num_pieces, 16, k), u (num_dofs, k)."""
        if self.operators is None:
            return u[self.dofs]
        values = np.where((self.dofs >= 0)[..., None], u[self.dofs], 0.0)
        return np.matmul(self.operators, np.repeat(values, np.diff(self.offsets), axis=0))


@dataclass(frozen=True, eq=False)
class Cells:
    """Cells of a hierarchy that this rank holds; pieces are numbered batch by batch.

    The cells that it owns come first, then ghosts, both kinds in every batch; the same for functions. Numbers of cells
    and dofs are local, here and in the batches.

    Attributes:
        hierarchy: The hierarchy.
        partition: What this rank owns and holds of it.
        level: Level of each cell, shape (num_cells,).
        level_face: Face of the level's `Level`, shape (num_cells,).
        face: Face of the control mesh, shape (num_cells,).
        points: Control points in the local B-spline basis, shape (num_nodes, gdim).
        batches: The cells by width of their operators; the identity batch first.
        piece_origin: Where the piece's (0, 0) lies in its cell, shape (num_pieces, 2).
        piece_axes: Its edges u and v there, in columns, shape (num_pieces, 2, 2).
        piece_of_face: For each level, the piece that a face of the level is, or -1.
        quadrature_degree: That of the only rule for which integrals over these pieces mean anything; None: any.
    """

    hierarchy: Hierarchy
    partition: Partition
    level: Ints
    level_face: Ints
    face: Ints
    points: Floats
    batches: tuple[Batch, ...]
    piece_origin: Floats
    piece_axes: Floats
    piece_of_face: tuple[Ints, ...]
    quadrature_degree: int | None = None

    @property
    def num_cells(self) -> int:
        """Number of active elements, local, ghosts included."""
        return self.level.size

    @property
    def num_owned(self) -> int:
        """Number of those that this rank owns."""
        return self.partition.cells.size_local

    @property
    def num_dofs(self) -> int:
        """Number of scalar functions, local, ghosts included."""
        return self.partition.functions.numbers.size

    @property
    def num_pieces(self) -> int:
        """Number of bicubic pieces."""
        return self.piece_origin.shape[0]

    @cached_property
    def boundary_pieces(self) -> tuple[Ints, Ints, Ints]:
        """Pieces on the boundary, the side there, and the half-edge of the control mesh it lies on, three (n,) arrays.

        Side k runs from corner k of the piece to corner k + 1.
        """
        sides = []
        for stage, piece_of_face in zip(self.hierarchy.stages, self.piece_of_face, strict=True):
            level = stage.level
            on = np.flatnonzero(level.rim & (piece_of_face[level.face] >= 0))
            sides.append(np.stack([piece_of_face[level.face[on]], on % 4, level.boundary_edge[on]]))
        piece, side, edge = np.concatenate(sides, axis=1).astype(np.int32)
        return piece, side, edge

    def rows(self, pieces: Ints) -> sp.csr_array:
        """Return the extraction operators of given pieces as one matrix, shape (16 n, num_dofs)."""
        first = np.cumsum([0, *(batch.num_pieces for batch in self.batches)])
        row, column, value = [], [], []
        for batch, start in zip(self.batches, first, strict=False):
            mine = np.flatnonzero((pieces >= start) & (pieces < start + batch.num_pieces))
            local = pieces[mine] - start
            dofs = batch.dofs[np.searchsorted(batch.offsets, local, side="right") - 1]
            if batch.operators is None:
                row.append((16 * mine[:, None] + np.arange(16)).ravel())
                column.append(dofs.ravel())
                value.append(np.ones(dofs.size))
            else:
                operators = batch.operators[local]
                i, j, k = np.nonzero(operators)  # padding is zero
                row.append(16 * mine[i] + j)
                column.append(dofs[i, k])
                value.append(operators[i, j, k])
        return summed(list(zip(row, column, value, strict=True)), (16 * pieces.size, self.num_dofs))

    @cached_property
    def cell_dofs(self) -> tuple[Ints, Ints]:
        """Offsets, shape (num_cells + 1,), and the dofs of each cell, in the order of its row in its batch."""
        cells = np.concatenate([batch.cells for batch in self.batches])
        sizes = np.zeros(self.num_cells, dtype=np.int32)
        sizes[cells] = np.concatenate([np.count_nonzero(batch.dofs >= 0, axis=1) for batch in self.batches])
        offsets = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int32)
        dofs = np.zeros(offsets[-1], dtype=np.int32)
        for batch in self.batches:
            place = offsets[batch.cells][:, None] + np.arange(batch.dofs.shape[1], dtype=np.int32)
            used = batch.dofs >= 0
            dofs[place[used]] = batch.dofs[used]
        return offsets, dofs

    @cached_property
    def with_own_dofs(self) -> Bools:
        """Which cells have a function that this rank owns, shape (num_cells,)."""
        marks = np.zeros(self.num_cells, dtype=bool)
        for batch in self.batches:
            own = (batch.dofs >= 0) & (batch.dofs < self.partition.functions.size_local)
            marks[batch.cells[own.any(axis=1)]] = True
        return marks

    @property
    def tag(self) -> Ints:
        """Tag of each cell, that of its face of the control mesh, shape (num_cells,)."""
        return self.hierarchy.mesh.face_tags[self.face]

    @cached_property
    def piece_cell(self) -> Ints:
        """Cell of each piece, shape (num_pieces,)."""
        return np.concatenate([batch.piece_cells for batch in self.batches])

    @cached_property
    def on_cell_edges(self) -> Bools:
        """Which sides of the pieces lie on the edges of their cells, shape (num_pieces, 4)."""
        middles = self.piece_origin[:, None] + side_points([0.5])[:, 0] @ self.piece_axes.transpose(0, 2, 1)
        return ((middles == 0.0) | (middles == 1.0)).any(axis=2)  # dyadic numbers: exact

    @cached_property
    def piece_points(self) -> Floats:
        """Control points of each piece in the local B-spline basis, shape (num_pieces, 16, gdim)."""
        return self.points[np.concatenate([batch.nodes for batch in self.batches])]

    def area_element(self, pieces: Ints, uv: Floats) -> Floats:
        """Return the root of det g, the area of the surface per area of the reference square.

        Args:
            pieces: Pieces, shape (n,).
            uv: Points in the reference square, the same for all, shape (m, 2).

        Returns:
            Shape (n, m).
        """
        control = self.piece_points[pieces]
        du, dv = (
            np.matmul((v[:, :, None] * u[:, None, :]).reshape(len(uv), 16), control)  # i + 4 j: u varies fastest
            for u, v in (
                (element.bspline_slopes(uv[:, 0]), element.bspline_values(uv[:, 1])),
                (element.bspline_values(uv[:, 0]), element.bspline_slopes(uv[:, 1])),
            )
        )
        uu, uv_, vv = ((a * b).sum(axis=2) for a, b in ((du, du), (du, dv), (dv, dv)))
        return np.sqrt(np.maximum(uu * vv - uv_**2, 0.0))

    def local(self, u: Floats) -> Floats:
        """Return the local B-spline coefficients of all pieces, shape (num_pieces, 16, k), u (num_dofs, k)."""
        return np.concatenate([batch.local(u) for batch in self.batches])

    def locate(
        self, faces: npt.ArrayLike, uv: npt.ArrayLike, corner: npt.ArrayLike | None = None
    ) -> tuple[Ints, Floats]:
        """Return the piece that holds each point and the point's coordinates there.

        Args:
            faces: Faces of the control mesh, shape (n,).
            uv: Coordinates in the face, shape (n, 2); see `thccs_fem.limit.evaluate` for the convention.
            corner: Sub-quad of a polygon, shape (n,).

        Returns:
            Pieces, -1 where the point lies on a cell that this rank does not hold, shape (n,), and coordinates in
            [0, 1]^2, shape (n, 2).
        """
        return self.locate_in_roots(*self.hierarchy.root_position(faces, uv, corner))

    def locate_in_roots(self, face: Ints, uv: Floats) -> tuple[Ints, Floats]:
        """Return what `locate` does, for points on faces of level 0, shapes (n,) and (n, 2)."""
        hierarchy = self.hierarchy
        piece = np.full(face.size, -1, dtype=np.int32)
        local = np.zeros_like(uv)
        open_points = np.arange(face.size)
        for stage, piece_of_face in zip(hierarchy.stages, self.piece_of_face, strict=True):
            here = piece_of_face[face]
            done = here >= 0
            piece[open_points[done]], local[open_points[done]] = here[done], uv[done]
            if stage.step is None:
                break
            deeper = ~done & (stage.step.first_child[face] >= 0)  # else it is in a cell that other ranks hold
            open_points, face, uv = open_points[deeper], face[deeper], uv[deeper]
            child, uv = child_at(uv)
            face = stage.step.first_child[face] + child
        return piece, local


def evaluate_pieces(local: Floats, piece: Ints, uv: Floats) -> Floats:
    """Evaluate bicubic pieces.

    Args:
        local: Local B-spline coefficients, shape (num_pieces, 16, k).
        piece: Piece of each point, shape (n,).
        uv: Coordinates in it, shape (n, 2).

    Returns:
        Values, shape (n, k).
    """
    return evaluate_patches(piece, uv, element.TO_BERNSTEIN @ local)[0]


@dataclass(frozen=True, eq=False)
class _Places:
    """Where the faces of one level lie, as far as they are parts of cells."""

    cell: Ints  # -1: of none
    origin: Floats
    axes: Floats

    @classmethod
    def none(cls, num_faces: int) -> _Places:
        """Return places of faces that are parts of no cells."""
        return cls(np.full(num_faces, -1, dtype=np.int32), np.zeros((num_faces, 2)), np.zeros((num_faces, 2, 2)))

    def of_children(self, stage: Stage) -> _Places:
        """Return the places of the faces of the next level: in the cell of the parent where it was cut, else none."""
        assert stage.step is not None
        result = _Places.none(stage.step.fine.num_faces)
        parent = np.flatnonzero(stage.cut)
        child = stage.step.first_child[parent, None] + np.arange(4)
        axes = self.axes[parent, None]
        result.cell[child] = self.cell[parent, None]
        result.origin[child] = self.origin[parent, None] + (axes @ CHILD_ORIGIN[..., None])[..., 0]
        result.axes[child] = axes @ CHILD_AXES / 2.0
        return result


@dataclass(frozen=True, eq=False)
class _Pieces:
    """Pieces of some levels, before they are sorted into batches."""

    level: Ints
    cell: Ints
    face: Ints
    nodes: Ints  # rows of points and of coefficients, 16 a piece
    points: Floats  # the control vertices of the levels, then the points of pieces that are not regular
    coefficients: tuple[sp.csr_array, sp.csr_array]  # both in terms of the dofs
    origin: Floats
    axes: Floats


def extract(hierarchy: Hierarchy, parts: Partition | None = None) -> Cells:
    """Return the cells of a hierarchy with the extraction operators of their pieces.

    Args:
        hierarchy: The hierarchy.
        parts: What this rank holds, where it is not what `partition` says: that of a hierarchy with other caps.
    """
    parts = partition(hierarchy) if parts is None else parts
    numbers = parts.cells.numbers
    level, level_face, face = (of_all[numbers] for of_all in _active_elements(hierarchy))
    pieces = _all_pieces(hierarchy, parts)
    piece_level = np.concatenate([p.level for p in pieces])
    piece_face = np.concatenate([p.face for p in pieces])
    first_node = np.cumsum([0, *(len(p.points) for p in pieces[:-1])])
    nodes = np.concatenate([first + p.nodes for first, p in zip(first_node, pieces, strict=True)]).astype(np.int32)
    points = np.concatenate([p.points for p in pieces])
    cell = np.concatenate([p.cell for p in pieces])
    coefficients = stacked([part for p in pieces for part in p.coefficients])
    if not parts.cells.is_whole:
        nodes, points, coefficients = _without_unused(nodes, points, coefficients)
        coefficients = _in_local_dofs(coefficients, parts.functions)
    batches, order = _batches(cell, nodes, coefficients)
    place = np.zeros(order.size, dtype=np.int32)
    place[order] = np.arange(order.size, dtype=np.int32)
    return Cells(
        hierarchy=hierarchy,
        partition=parts,
        level=level,
        level_face=level_face,
        face=face,
        points=points,
        batches=batches,
        piece_origin=np.concatenate([p.origin for p in pieces])[order],
        piece_axes=np.concatenate([p.axes for p in pieces])[order],
        piece_of_face=tuple(
            _scattered(stage.level.num_faces, piece_face[first:end], place[first:end])
            for stage, (first, end) in zip(
                hierarchy.stages,
                pairwise(np.searchsorted(piece_level, np.arange(len(hierarchy.stages) + 1))),
                strict=True,
            )
        ),
    )


def _scattered(size: int, index: Ints, values: Ints) -> Ints:
    """Return an array of -1 with the values put at the given places."""
    array = np.full(size, -1, dtype=np.int32)
    array[index] = values
    return array


def _without_unused(nodes: Ints, points: Floats, coefficients: sp.csr_array) -> tuple[Ints, Floats, sp.csr_array]:
    """Return nodes numbered anew without those of no piece."""
    used = np.zeros(len(points), dtype=bool)
    used[nodes] = True
    number = np.cumsum(used, dtype=np.int32) - np.int32(1)
    return number[nodes], points[used], rows_of(coefficients, np.flatnonzero(used))


def _in_local_dofs(coefficients: sp.csr_array, functions: IndexMap) -> sp.csr_array:
    """Return coefficients with the columns of the functions that this rank holds, which are all that have entries."""
    columns = functions.local_of(coefficients.indices)
    assert (columns >= 0).all()  # or a function that does not vanish on a cell here is missing
    shape = coefficients.shape[0], functions.numbers.size
    result = sp.csr_array((coefficients.data, columns, coefficients.indptr), shape=shape)
    result.sort_indices()
    return result


def _active_elements(hierarchy: Hierarchy) -> tuple[Ints, Ints, Ints]:
    """Return level, face of the level and face of the control mesh of every cell."""
    faces = [stage.active_faces for stage in hierarchy.stages[: hierarchy.num_levels]]
    level = np.repeat(np.arange(len(faces), dtype=np.int32), [f.size for f in faces])
    root = [
        hierarchy.stages[l].level.keys[f] >> (2 * l)  # each level adds two binary digits to the key
        for l, f in enumerate(faces)
    ]
    return level, np.concatenate(faces), hierarchy.face_of_root[np.concatenate(root)]


def _all_pieces(hierarchy: Hierarchy, parts: Partition) -> list[_Pieces]:
    """Return the pieces, level by level: active faces that are not cut, and the ends of the cuts."""
    numbers = parts.cells.numbers
    local = _scattered(parts.cells.size_global, numbers, np.arange(numbers.size, dtype=np.int32))
    coefficients = _all_coefficients(hierarchy, parts, local >= 0)
    places, first_cell = [], 0
    of_level = _Places.none(hierarchy.root.num_faces)
    for stage in hierarchy.stages:
        faces = stage.active_faces
        of_level.cell[faces] = local[first_cell : first_cell + faces.size]
        of_level.origin[faces], of_level.axes[faces] = 0.0, np.eye(2)
        first_cell += faces.size
        places.append(of_level)
        if stage.step is not None:
            of_level = of_level.of_children(stage)
    return [
        _pieces(hierarchy, range(len(places))[group], places[group], coefficients[group])
        for group in groups([stage.level.num_faces for stage in hierarchy.stages])
    ]


def _all_coefficients(hierarchy: Hierarchy, parts: Partition, cells: Bools) -> Sequence[sp.csr_array]:
    """Return the coefficients of the dofs on each stage, as far as the given cells need them."""
    if parts.cells.is_whole:
        return hierarchy.coefficients
    return hierarchy.coefficient_rows(needed_functions(hierarchy, cells))


def _pieces(
    hierarchy: Hierarchy, levels: Sequence[int], places: Sequence[_Places], of_dofs: Sequence[sp.csr_array]
) -> _Pieces:
    """Return the pieces of some levels.

    Regular interior faces read their 4 x 4 control vertices; all others, caps included, go through the Bezier masks.
    """
    stages = [hierarchy.stages[l] for l in levels]
    ends = [np.flatnonzero((p.cell >= 0) & ~s.cut).astype(np.int32) for p, s in zip(places, stages, strict=True)]
    boundary = joined_boundaries([stage.boundary for stage in stages])
    level = boundary.level
    of_faces = Parts.of([stage.level.num_faces for stage in stages])
    of_vertices = Parts.of([stage.level.num_vertices for stage in stages])
    faces = np.concatenate([end + first for end, first in zip(ends, of_faces.starts, strict=False)])
    coefficients = of_vertices.functions(boundary).joined_rows(of_dofs)
    if boundary.vertex.size:
        coefficients = product(boundary.to_points, coefficients)
    regular = (level.regular & ~level.boundary)[level.quads[faces]].all(axis=1)
    masks = bezier_masks(boundary, faces[~regular])
    num_masked = int(np.count_nonzero(~regular))
    to_spline = _diagonal_blocks(element.TO_BSPLINE, num_masked)
    points = np.concatenate([hierarchy.points[l] for l in levels])
    control = np.concatenate([points, np.zeros((boundary.vertex.size, points.shape[1]))])  # the surface has no delta
    nodes = np.zeros((faces.size, 16), dtype=np.int32)
    nodes[regular] = spline_grid(level, faces[regular])
    nodes[~regular] = level.num_vertices + np.arange(16 * num_masked).reshape(-1, 16)
    return _Pieces(
        level=of_faces.level[faces] + np.int32(levels[0]),
        cell=np.concatenate([p.cell[end] for p, end in zip(places, ends, strict=True)]),
        face=np.concatenate(ends),
        nodes=nodes,
        points=np.concatenate([points, to_spline @ (masks @ control)]),
        coefficients=(first_rows(coefficients, level.num_vertices), product(to_spline, product(masks, coefficients))),
        origin=np.concatenate([p.origin[end] for p, end in zip(places, ends, strict=True)]),
        axes=np.concatenate([p.axes[end] for p, end in zip(places, ends, strict=True)]),
    )


def _diagonal_blocks(block: Floats, count: int) -> sp.csr_array:
    """Return the matrix with copies of a square matrix on its diagonal."""
    rows, columns = np.nonzero(block)
    first = block.shape[0] * np.arange(count, dtype=np.int32)[:, None]
    size = count * block.shape[0]
    copies = (first + rows).ravel(), (first + columns).ravel(), np.tile(block[rows, columns], count)
    return summed([copies], (size, size))


def _batches(cell: Ints, nodes: Ints, coefficients: sp.csr_array) -> tuple[tuple[Batch, ...], Ints]:
    """Sort pieces into batches; return them and the order in which the pieces stand in them."""
    identity, dof = _identity(nodes, coefficients)
    same = np.flatnonzero(identity)
    same = same[np.argsort(cell[same], kind="stable")]
    others = np.flatnonzero(~identity).astype(np.int32)
    batches = []
    if same.size or not others.size:  # there is always a batch, also on a rank without cells
        batches.append(Batch(cell[same], dof[nodes[same]], np.arange(same.size + 1, dtype=np.int32), nodes[same], None))
    others = others[np.argsort(cell[others], kind="stable")]
    general, order = _general_batches(cell[others], nodes[others], coefficients, others)
    return (*batches, *general), np.concatenate([same, *order]).astype(np.int32)


def _identity(nodes: Ints, coefficients: sp.csr_array) -> tuple[Bools, Ints]:
    """Return the pieces whose 16 coefficients are 16 different dofs, and the dof that each node is, or -1."""
    single = np.flatnonzero(np.diff(coefficients.indptr) == 1)
    entry = coefficients.indptr[single]
    one = coefficients.data[entry] == 1.0
    dof = _scattered(coefficients.shape[0], single[one], coefficients.indices[entry[one]])
    identity = (dof[nodes] >= 0).all(axis=1)
    identity[identity] = (np.diff(np.sort(dof[nodes[identity]], axis=1), axis=1) > 0).all(axis=1)
    return identity, dof


def _general_batches(
    cell: Ints, nodes: Ints, coefficients: sp.csr_array, pieces: Ints
) -> tuple[list[Batch], list[Ints]]:
    """Return batches of dense operators for the given pieces, which are sorted by cell, and their pieces."""
    if not pieces.size:
        return [], []
    first = np.flatnonzero(np.diff(cell, prepend=-1)).astype(np.int32)
    cells, count = cell[first], np.diff(first, append=np.int32(pieces.size))
    rows = Rows(16 * np.append(first, np.int32(pieces.size)), nodes.ravel(), coefficients)
    offsets, dofs = rows.columns()
    size = np.diff(offsets)
    width = -(-size // WIDTH) * WIDTH
    # Blocks of equal width follow one another, so that each batch is one piece of memory.
    order = np.argsort(width, kind="stable")
    blocks = 16 * count[order].astype(np.int64) * width[order]
    starts = np.zeros(cells.size, dtype=np.int64)
    starts[order] = np.cumsum(blocks) - blocks
    values = np.zeros(blocks.sum())
    place = np.zeros(coefficients.shape[1], dtype=np.int32)
    rows.run("thccs_dense_rows", coefficients.data, offsets, dofs, width, starts, place, values)
    batches, batch_pieces = [], []
    for w in np.unique(width):
        chosen = order[width[order] == w]
        local_offsets = np.concatenate([[0], np.cumsum(count[chosen])]).astype(np.int32)
        mine = np.repeat(first[chosen] - local_offsets[:-1], count[chosen]) + np.arange(local_offsets[-1])
        padded = np.full((chosen.size, w), -1, dtype=np.int32)
        used = np.arange(w) < size[chosen, None]
        padded[used] = dofs[(offsets[chosen, None] + np.arange(w))[used]]
        begin = starts[chosen[0]]
        operators = values[begin : begin + 16 * mine.size * w].reshape(mine.size, 16, w)
        batches.append(Batch(cells[chosen], padded, local_offsets, nodes[mine], operators))
        batch_pieces.append(pieces[mine])
    return batches, batch_pieces


@dataclass(frozen=True, eq=False)
class Rows:
    """Rows of a matrix, cell by cell, for the loops of kernels.c.

    Attributes:
        offsets: Rows of the k-th cell are rows[offsets[k]] .. rows[offsets[k + 1]], shape (cells + 1,).
        rows: Rows of the matrix.
        matrix: The matrix.
    """

    offsets: Ints
    rows: Ints
    matrix: sp.csr_array

    def columns(self) -> tuple[Ints, Ints]:
        """Return offsets, shape (cells + 1,), and the ascending columns that occur in the rows of each cell."""
        seen = np.full(self.matrix.shape[1], -1, dtype=np.int32)
        offsets = np.zeros(self.offsets.size, dtype=np.int32)
        most = int(np.diff(self.matrix.indptr)[self.rows].sum(dtype=np.int64))
        columns = np.zeros(most, dtype=np.int32)  # what is not used of it is not touched
        self.run("thccs_cell_columns", seen, offsets, columns)
        return offsets, columns[: offsets[-1]].copy()

    def run(self, function: str, *arrays: npt.NDArray[Any] | None) -> None:
        """Call a loop of kernels.c."""
        module = jit.library()
        c_types = {"i4": "int32_t[]", "i8": "int64_t[]", "f8": "double[]"}
        indptr, indices = (a.astype(np.int32, copy=False) for a in (self.matrix.indptr, self.matrix.indices))
        pointers = [
            module.ffi.NULL if a is None else module.ffi.from_buffer(c_types[a.dtype.str[1:]], a)
            for a in (self.offsets, self.rows, indptr, indices, *arrays)
        ]
        getattr(module.lib, function)(self.offsets.size - 1, *pointers)
