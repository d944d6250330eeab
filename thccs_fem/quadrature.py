"""Two other ways to integrate over irregular elements, to compare the bicubic caps with (Wei et al. 2015, sec. 6.3).

The functions of the space are the same, but for the cap itself, and so are their coefficients:

* `paper_cells`: the paper's rule, 4 x 4 Gauss points on each whole element, where functions, map and derivatives are
  evaluated exactly at the points (eq. 9).  It takes an irregular element for as smooth as a regular one.
* `without_caps`: elements are cut as for caps, and what is left at the extraordinary vertices is left out.

Both make `Cells` that forms are integrated on in place of those of the space::

    W = V.with_integration(quadrature.paper_cells)
    uh = LinearProblem(a(W), L(W), bcs=...).solve()

For the paper's rule to work with any form, each Gauss point has a *piece* of its own: the bicubic polynomial that
functions and map are around the point, on a square with the point at its centre and the point's weight as its area.
A kernel with the one-point rule on all these squares is the paper's quadrature, term by term.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from thccs_fem import element
from thccs_fem.extraction import Batch, Cells, extract
from thccs_fem.hierarchy import Hierarchy
from thccs_fem.partition import partition
from thccs_fem.subdivision import Bools

__all__ = ["paper_cells", "without_caps"]

Floats = npt.NDArray[np.float64]

NUM_GAUSS = 4  # points along each side of an element
DEPTH = 4  # cuts after which no Gauss point is left in a cap: they keep 0.069 from the sides, more than 2^-4


def paper_cells(hierarchy: Hierarchy) -> Cells:
    """Return cells whose pieces are Gauss points: 16 a cell, regular or not, to be integrated with degree 1.

    Points in an irregular element lie in regular sub-elements after four cuts at most, whatever the level of the caps.
    Pieces of these cells overlap, and none is at the boundary: they are good for integrals over cells and nothing else.

    Args:
        hierarchy: The hierarchy.
    """
    deep = hierarchy.with_caps_at(max(hierarchy.cap_level, hierarchy.num_levels - 1 + DEPTH))
    cells = extract(deep, partition(hierarchy))
    first = np.cumsum([0, *(batch.num_pieces for batch in cells.batches)])
    batches: list[Batch] = []
    pieces, points, corners, sides = [], [], [], []
    for batch, begin, end in zip(cells.batches, first[:-1], first[1:], strict=True):
        piece, centre, side = _gauss_points(batch, cells.piece_origin[begin:end], cells.piece_axes[begin:end])
        corner = centre - side[:, None] / 2.0
        restriction = element.restrictions(corner, side[:, None, None] * np.eye(2))
        batches.append(_gauss_batch(batch, NUM_GAUSS**2 * sum(b.cells.size for b in batches), piece, restriction))
        points.append(restriction @ cells.piece_points[begin + piece])
        pieces.append(begin + piece)
        corners.append(corner)
        sides.append(side)
    origin, axes = (a[np.concatenate(pieces)] for a in (cells.piece_origin, cells.piece_axes))
    return replace(
        cells,
        points=np.concatenate(points).reshape(-1, cells.points.shape[1]),
        batches=tuple(batches),
        piece_origin=origin + np.einsum("nij,nj->ni", axes, np.concatenate(corners)),
        piece_axes=axes * np.concatenate(sides)[:, None, None],
        piece_of_face=tuple(np.full_like(faces, -1) for faces in cells.piece_of_face),
        quadrature_degree=1,
    )


def _gauss_batch(batch: Batch, num_before: int, piece: npt.NDArray[np.intp], restriction: Floats) -> Batch:
    """Return the batch with a piece for each Gauss point, given the number of points in the batches before."""
    return Batch(
        cells=batch.cells,
        dofs=batch.dofs,
        offsets=np.arange(0, piece.size + 1, NUM_GAUSS**2, dtype=np.int32),
        nodes=np.arange(16 * num_before, 16 * (num_before + piece.size), dtype=np.int32).reshape(-1, 16),
        operators=restriction if batch.operators is None else restriction @ batch.operators[piece],
    )


def _gauss_points(batch: Batch, origin: Floats, axes: Floats) -> tuple[npt.NDArray[np.intp], Floats, Floats]:
    """Return the Gauss points of the cells of a batch, cell by cell.

    Args:
        batch: The batch.
        origin: Where its pieces begin in their cells, shape (num_pieces, 2).
        axes: The edges of its pieces, shape (num_pieces, 2, 2).

    Returns:
        Of each point its piece in the batch, (n,), its coordinates there, (n, 2), and, in units of the piece's sides,
        the side of the square whose area is its weight, (n,).
    """
    t, w = np.polynomial.legendre.leggauss(NUM_GAUSS)
    t, w = (t + 1.0) / 2.0, w / 2.0
    uv, weights = np.stack(np.meshgrid(t, t), axis=-1).reshape(-1, 2), np.outer(w, w).ravel()
    area = np.abs(np.linalg.det(axes))
    # Axes are orthogonal and of equal length: their inverse is the transpose over the area.
    local = np.einsum("pji,pqj->pqi", axes, uv - origin[:, None]) / area[:, None, None]
    piece, point = np.nonzero(((local > 0.0) & (local < 1.0)).all(axis=2))
    assert piece.size == weights.size * batch.cells.size, "a Gauss point lies on an edge of pieces, or in none"
    return piece, local[piece, point], np.sqrt(weights[point] / area[piece])


@functools.cache
def without_caps(depth: int) -> Callable[[Hierarchy], Cells]:
    """Return the rule that cuts irregular elements down to a level and leaves out the sub-elements at the end.

    Args:
        depth: The level, or a deeper one where refinement goes deeper.

    Raises:
        ValueError: If the depth is less than 1.
    """
    if depth < 1:
        raise ValueError(f"depth is {depth}; an irregular element must be cut at least once: give 1 or more")
    return functools.partial(_capless_cells, depth=depth)


def _capless_cells(hierarchy: Hierarchy, depth: int) -> Cells:
    cells = extract(hierarchy.with_caps_at(depth), partition(hierarchy))
    kept = ~_caps(cells)
    number = np.where(kept, np.cumsum(kept) - 1, -1).astype(np.int32)
    of_batches = np.split(kept, np.cumsum([batch.num_pieces for batch in cells.batches])[:-1])
    return replace(
        cells,
        batches=tuple(_reduced(batch, mine) for batch, mine in zip(cells.batches, of_batches, strict=True)),
        piece_origin=cells.piece_origin[kept],
        piece_axes=cells.piece_axes[kept],
        piece_of_face=tuple(np.where(faces >= 0, number[faces], -1) for faces in cells.piece_of_face),
    )


def _caps(cells: Cells) -> Bools:
    """Return the pieces with an irregular vertex, shape (num_pieces,)."""
    caps = np.zeros(cells.num_pieces, dtype=bool)
    for stage, piece_of_face in zip(cells.hierarchy.stages, cells.piece_of_face, strict=True):
        piece = piece_of_face[stage.level.touching(~stage.level.regular)]
        caps[piece[piece >= 0]] = True
    return caps


def _reduced(batch: Batch, kept: Bools) -> Batch:
    """Return the batch with some of its pieces; each cell keeps at least one."""
    if batch.operators is None:
        return batch
    count = np.add.reduceat(kept, batch.offsets[:-1], dtype=np.int32)
    return Batch(
        cells=batch.cells,
        dofs=batch.dofs,
        offsets=np.concatenate([[0], np.cumsum(count)]).astype(np.int32),
        nodes=batch.nodes[kept],
        operators=batch.operators[kept],
    )
