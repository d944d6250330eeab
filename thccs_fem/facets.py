"""Sides of pieces that integrals run over: those on the boundary, and those where different cells meet.

A *facet* is a side of one piece on the boundary of the surface, or a side where two pieces of different cells meet.
Where levels differ it is the shorter side, and the coarser piece is cut down to a square along it. Sides between pieces
of one cell are no facets.

Kernels see one position only. The piece of a boundary facet is turned until the facet is its side y = 0; so is the
first piece, '+', where two meet, and the second one, '-', until it is side y = 1: then x runs alike in both. A turned
or cut piece is the same bicubic polynomial in other coordinates, so its local coefficients and control points
are those of the piece times a 16 x 16 matrix, of which there are few different ones.

Of two pieces '+' is that whose face has the smaller key on the finer one's level: along an edge of the control mesh '+'
is on the same side from end to end, however the cells are refined.

Facets on the boundary stand in the order of `Cells.boundary_pieces`, others level by level in the order of half-edges.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from thccs_fem import element
from thccs_fem.extraction import WIDTH, Batch, Cells, Rows
from thccs_fem.hierarchy import Hierarchy
from thccs_fem.polygons import previous_corners
from thccs_fem.positions import CHILD_AXES, CHILD_ORIGIN
from thccs_fem.subdivision import Ints, Level

__all__ = ["FacetBatch", "Facets", "boundary_facets", "interior_facets"]

CHUNK = 4096  # facets whose operators are made at a time: at most some ten kilobytes each

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class FacetBatch:
    """Some facets as the pieces of a `Batch`, one a "cell".

    Attributes:
        facets: Numbers of the facets, shape (n,).
        batch: Their cells, shape (n, sides), dofs, and operators, shape (n, 16 * sides, width).
        points: Control points for the batch's nodes, shape (16 * sides * n, gdim).
    """

    facets: Ints
    batch: Batch
    points: Floats


@dataclass(frozen=True, eq=False)
class Facets:
    """Facets with one side, on the boundary, or two.

    Attributes:
        cells: The cells.
        pieces: Piece on each side, shape (num_facets, sides).
        squares: Which of the squares they are cut to and turned by, shape (num_facets, sides).
        origins: Where (0, 0) of the squares lies in the piece, shape (num_squares, 2).
        axes: Their edges there, in columns, shape (num_squares, 2, 2).
        edge: Edge of the control mesh that each facet lies on, -1 inside its faces, shape (num_facets,).
    """

    cells: Cells
    pieces: Ints
    squares: Ints
    origins: Floats
    axes: Floats
    edge: Ints

    @property
    def num_facets(self) -> int:
        """Number of facets."""
        return self.edge.size

    @property
    def num_sides(self) -> int:
        """1 on the boundary, else 2."""
        return self.pieces.shape[1]

    @cached_property
    def tag(self) -> Ints:
        """Tag of each facet, that of its edge of the control mesh, -1 where there is none, shape (num_facets,)."""
        mesh = self.cells.hierarchy.mesh
        of_edges = np.full(mesh.num_edges + 1, -1, dtype=np.int32)  # the last one stands for edge -1
        if mesh.edge_tags:
            of_edges[mesh.edge_indices(np.array(list(mesh.edge_tags), dtype=np.int32))] = list(mesh.edge_tags.values())
        return of_edges[self.edge]

    @cached_property
    def facet_cells(self) -> Ints:
        """Cell on each side, shape (num_facets, sides)."""
        return self.cells.piece_cell[self.pieces]

    @cached_property
    def dofs(self) -> tuple[Ints, Ints]:
        """Offsets, shape (num_facets + 1,), and the dofs of each facet.

        Those of its cell in the order that they have there; of two cells together, ascending.
        """
        offsets, dofs = self.cells.cell_dofs
        if self.num_sides == 1:
            number, entries = _ranges(offsets, self.facet_cells[:, 0])
            return np.searchsorted(number, np.arange(self.num_facets + 1)).astype(np.int32), dofs[entries]
        cells = np.arange(0, 2 * self.num_facets + 1, 2, dtype=np.int32)
        shape = self.cells.num_cells, self.cells.num_dofs
        return Rows(cells, self.facet_cells.ravel(), sp.csr_array((np.ones(dofs.size), dofs, offsets), shape)).columns()

    @cached_property
    def _restrictions(self) -> Floats:
        """Matrices for the local coefficients of the squares, shape (num_squares, 16, 16)."""
        return element.restrictions(self.origins, self.axes)

    def batches(self, facets: Ints) -> Iterator[FacetBatch]:
        """Yield the given facets by the width of their operators, some thousands at a time.

        All operators at once would need far more memory than those of the cells.
        """
        width = -(-np.diff(self.dofs[0])[facets] // WIDTH) * WIDTH
        for w in np.unique(width):
            same = facets[width == w]
            for begin in range(0, same.size, CHUNK):
                yield self._batch(same[begin : begin + CHUNK], int(w))

    def _batch(self, facets: Ints, width: int) -> FacetBatch:
        number, entries = _ranges(self.dofs[0], facets)
        dofs = np.full((facets.size, width), -1, dtype=np.int32)
        dofs[number, entries - self.dofs[0][facets][number]] = self.dofs[1][entries]
        sides = [self._side(facets, dofs, side) for side in range(self.num_sides)]
        size = 16 * self.num_sides
        batch = Batch(
            cells=self.facet_cells[facets],
            dofs=dofs,
            offsets=np.arange(facets.size + 1, dtype=np.int32),
            nodes=np.arange(size * facets.size, dtype=np.int32).reshape(-1, size),
            operators=np.concatenate([operators for operators, _ in sides], axis=1),
        )
        points = np.concatenate([points for _, points in sides], axis=1)
        return FacetBatch(facets, batch, points.reshape(size * facets.size, -1))

    def _side(self, facets: Ints, dofs: Ints, side: int) -> tuple[Floats, Floats]:
        """Return operators for the given dofs, shape (n, 16, width), and control points, (n, 16, gdim), of one side."""
        cells, pieces = self.cells, self.pieces[facets, side]
        restriction = self._restrictions[self.squares[facets, side]]
        operators = np.zeros((facets.size, 16, dofs.shape[1] + 1))  # the last column takes what is padding
        first = 0
        for batch in cells.batches:
            mine = np.flatnonzero((pieces >= first) & (pieces < first + batch.num_pieces))
            local = pieces[mine] - first
            first += batch.num_pieces
            if not mine.size:
                continue
            own = restriction[mine]
            if batch.operators is not None:
                own = own @ batch.operators[local]
            place = self._places(dofs[mine], batch.dofs[np.searchsorted(batch.offsets, local, side="right") - 1])
            operators[mine[:, None, None], np.arange(16)[:, None], place[:, None]] = own
        return operators[:, :, :-1], restriction @ cells.piece_points[pieces]

    def _places(self, dofs: Ints, of_cells: Ints) -> Ints:
        """Return where the dofs of cells are in the rows of the facets' dofs, the width of these for padding."""
        if self.num_sides == 1:
            return np.broadcast_to(np.arange(dofs.shape[1], dtype=np.int32), dofs.shape)
        row = np.arange(len(dofs), dtype=np.int64)[:, None] * self.cells.num_dofs
        used, wanted = dofs >= 0, of_cells >= 0
        begin = np.cumsum(used.sum(axis=1)) - used.sum(axis=1)
        places = np.searchsorted((row + dofs)[used], row + of_cells) - begin[:, None]
        return np.where(wanted, places, dofs.shape[1]).astype(np.int32)


def _ranges(offsets: Ints, chosen: Ints) -> tuple[Ints, Ints]:
    """Return the entries offsets[c] .. offsets[c + 1] of each chosen c, and the number in `chosen` each belongs to."""
    sizes = np.diff(offsets)[chosen]
    number = np.repeat(np.arange(chosen.size, dtype=np.int32), sizes)
    before = np.cumsum(sizes) - sizes
    return number, (np.arange(number.size) + (offsets[:-1][chosen] - before)[number]).astype(np.int32)


def boundary_facets(cells: Cells) -> Facets:
    """Return the sides of pieces on the boundary of the surface, made once and kept with the cells."""
    return _kept(cells, _boundary_facets)


def interior_facets(cells: Cells) -> Facets:
    """Return the sides where pieces of different cells meet, made once and kept with the cells."""
    return _kept(cells, _interior_facets)


def _kept(cells: Cells, make: Callable[[Cells], Facets]) -> Facets:
    kept: dict[Callable[[Cells], Facets], Facets] = cells.__dict__.setdefault("_facets", {})
    if make not in kept:
        kept[make] = make(cells)
    return kept[make]


def _boundary_facets(cells: Cells) -> Facets:
    piece, side, half_edge = cells.boundary_pieces
    edge = cells.hierarchy.mesh.face_edges[half_edge]
    return Facets(cells, piece[:, None], side[:, None], CHILD_ORIGIN, CHILD_AXES, edge)


def _interior_facets(cells: Cells) -> Facets:
    levels = [_meeting(cells, l) for l in range(len(cells.piece_of_face))]
    pieces, squares, edges = (np.concatenate(arrays) for arrays in zip(*levels, strict=True))
    different, squares = np.unique(squares.reshape(-1, 6), axis=0, return_inverse=True)
    return Facets(
        cells=cells,
        pieces=pieces,
        squares=squares.reshape(-1, 2).astype(np.int32),
        origins=different[:, :2],
        axes=different[:, 2:].reshape(-1, 2, 2),
        edge=edges,
    )


def _meeting(cells: Cells, l: int) -> tuple[Ints, Floats, Ints]:
    """Return the facets whose shorter side is a piece of level l: pieces (n, 2), squares (n, 2, 6), and edges (n,)."""
    level, piece_of_face = cells.hierarchy.stages[l].level, cells.piece_of_face[l]
    own: Ints = np.flatnonzero((level.twins >= 0) & (piece_of_face[level.face] >= 0)).astype(np.int32)
    own = own[cells.on_cell_edges[piece_of_face[level.face[own]], own % 4]]
    twin = level.twins[own]
    other, origin, axes = _held_by(cells, l, level.face[twin])
    # Where pieces of one level meet, one of the two half-edges stands for both; where none is found, pieces are finer.
    kept = (other >= 0) & ((own < twin) | (piece_of_face[level.face[twin]] < 0))
    own, twin, other, origin, axes = own[kept], twin[kept], other[kept], origin[kept], axes[kept]
    pieces = np.stack([piece_of_face[level.face[own]], other], axis=1)
    is_second = (own > twin).astype(np.int32)
    turn = own % 4 + 2 * is_second, twin % 4 + 2 * (1 - is_second)
    whole = np.zeros_like(origin), np.broadcast_to(np.eye(2), axes.shape)
    squares = np.stack([_turned(*whole, turn[0]), _turned(origin, axes, turn[1])], axis=1)
    swap = np.stack([is_second, 1 - is_second], axis=1)
    return (
        np.take_along_axis(pieces, swap, axis=1),
        np.take_along_axis(squares, swap[:, :, None], axis=1),
        _control_edges(cells.hierarchy, level, own),
    )


def _held_by(cells: Cells, l: int, face: Ints) -> tuple[Ints, Floats, Floats]:
    """Return the piece that each face of level l is or lies in, -1 for none, and origin and axes of the face there."""
    piece = cells.piece_of_face[l][face]
    origin, axes = np.zeros((face.size, 2)), np.tile(np.eye(2), (face.size, 1, 1))
    open_faces = np.flatnonzero(piece < 0)
    key = cells.hierarchy.stages[l].level.keys[face]
    for coarse in range(l - 1, -1, -1):
        child = key[open_faces] % 4
        key[open_faces] //= 4
        turn = CHILD_AXES[child] / 2.0
        origin[open_faces] = CHILD_ORIGIN[child] + np.einsum("nij,nj->ni", turn, origin[open_faces])
        axes[open_faces] = turn @ axes[open_faces]
        parent = np.searchsorted(cells.hierarchy.stages[coarse].level.keys, key[open_faces])
        piece[open_faces] = cells.piece_of_face[coarse][parent]
        open_faces = open_faces[piece[open_faces] < 0]
    return piece, origin, axes


def _turned(origin: Floats, axes: Floats, turn: Ints) -> Floats:
    """Return origin and axes, in one row of 6, of squares turned by right angles."""
    turn = turn % 4
    corner = origin + np.einsum("nij,nj->ni", axes, CHILD_ORIGIN[turn])
    return np.concatenate([corner, (axes @ CHILD_AXES[turn]).reshape(-1, 4)], axis=1)


def _control_edges(hierarchy: Hierarchy, level: Level, half_edges: Ints) -> Ints:
    """Return the edges of the control mesh that half-edges of a level lie on, -1 for those inside its faces.

    Side 0 of child k lies on side k of its parent, side 3 on side k - 1, the others inside.
    """
    mesh = hierarchy.mesh
    key, side = level.keys[level.face[half_edges]], half_edges % 4
    inside = np.zeros(side.size, dtype=bool)
    for _ in range(level.number):
        inside |= (side == 1) | (side == 2)
        side = np.where(side == 0, key % 4, (key - 1) % 4)
        key = key // 4
    if hierarchy.root_is_subdivided:  # face h of level 0 is the child at corner h
        inside |= (side == 1) | (side == 2)
        corner = np.where(side == 0, key, previous_corners(mesh.face_offsets)[key])
    else:
        corner = mesh.face_offsets[key] + side
    return np.where(inside, -1, mesh.face_edges[corner]).astype(np.int32)
