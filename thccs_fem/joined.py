"""Levels joined to one with separate parts: what depends on neighbours alone is found for all of them at once.

A hierarchy has many levels of few faces, and numpy takes as long for a short array as for one of some thousand entries.
What is found for joined levels is sorted out by `Parts`; it has the bits that it would have for each level alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from thccs_fem.boundary import Boundary
from thccs_fem.sparse import csr, rows_of, stacked
from thccs_fem.subdivision import Ints, Level

__all__ = ["Parts", "groups", "joined_boundaries", "joined_levels"]

ENOUGH = 1 << 13  # faces from which on nothing is gained


def groups(sizes: Sequence[int]) -> Iterator[slice]:
    """Yield ranges of levels, given their numbers of faces, that are worth joining."""
    first = total = 0
    for k, size in enumerate(sizes):
        if k > first and total + size > ENOUGH:
            yield slice(first, k)
            first, total = k, 0
        total += size
    if sizes:
        yield slice(first, len(sizes))


def joined_levels(levels: Sequence[Level]) -> Level:
    """Return levels of quads as one, in their order; its number and its keys mean nothing."""
    if len(levels) == 1:
        return levels[0]
    first_vertex = _starts([level.num_vertices for level in levels])
    first_half_edge = _starts([level.vertices.size for level in levels])
    twins = [np.where(l.twins >= 0, l.twins + k, np.int32(-1)) for l, k in zip(levels, first_half_edge, strict=False)]
    names = ("keys", "boundary_edge", "vertex_num_faces", "boundary", "corner", "control_vertex", "rim_distance")
    return Level(
        number=levels[0].number,
        offsets=np.arange(0, first_half_edge[-1] + 1, 4, dtype=np.int32),
        vertices=np.concatenate([l.vertices + k for l, k in zip(levels, first_vertex, strict=False)]),
        twins=np.concatenate(twins),
        **{name: np.concatenate([getattr(l, name) for l in levels]) for name in names},
    )


def joined_boundaries(boundaries: Sequence[Boundary]) -> Boundary:
    """Return the trace functions of joined levels."""
    if len(boundaries) == 1:
        return boundaries[0]
    level = joined_levels([boundary.level for boundary in boundaries])
    starts = _starts([boundary.level.num_vertices for boundary in boundaries])
    vertex = np.concatenate([b.vertex + start for b, start in zip(boundaries, starts, strict=False)])
    return Boundary(level, vertex, np.concatenate([boundary.kind for boundary in boundaries]))


def _starts(sizes: Sequence[int]) -> Ints:
    return np.cumsum([0, *sizes], dtype=np.int32)


@dataclass(frozen=True, eq=False)
class Parts:
    """Which level things belong to (vertices, functions) that are numbered for joined levels.

    Within a level they have the order that they have in the level alone.

    Attributes:
        level: Which of the levels, shape (n,).
        num_levels: Number of joined levels.
    """

    level: Ints
    num_levels: int

    @classmethod
    def of(cls, *sizes: Sequence[int]) -> Parts:
        """Return the parts of things of which there are so many of a kind on each level, kind by kind."""
        numbers = np.arange(len(sizes[0]), dtype=np.int32)
        return cls(np.concatenate([np.repeat(numbers, of_kind) for of_kind in sizes]), numbers.size)

    def functions(self, boundary: Boundary) -> Parts:
        """Return the parts of the functions, if these are the parts of the vertices."""
        return Parts(np.concatenate([self.level, self.level[boundary.vertex]]), self.num_levels)

    @cached_property
    def _order(self) -> Ints:
        return np.argsort(self.level, kind="stable").astype(np.int32)

    @cached_property
    def starts(self) -> Ints:
        """Where each level begins when things are sorted by levels, and their number, shape (num_levels + 1,)."""
        return _starts(np.bincount(self.level, minlength=self.num_levels).tolist())

    @cached_property
    def number(self) -> Ints:
        """The number of each thing on its own level, shape (n,)."""
        number = np.zeros_like(self._order)
        number[self._order] = np.arange(number.size, dtype=np.int32) - np.repeat(self.starts[:-1], np.diff(self.starts))
        return number

    def split(self, values: npt.NDArray[Any]) -> list[npt.NDArray[Any]]:
        """Return the values on each level."""
        return [values] if self.num_levels == 1 else np.split(values[self._order], self.starts[1:-1])

    def split_boundary(self, boundary: Boundary, levels: Sequence[Level]) -> list[Boundary]:
        """Return the trace functions of each level, if these are the parts of the vertices."""
        traces = Parts(self.level[boundary.vertex], self.num_levels)
        found = zip(levels, traces.split(self.number[boundary.vertex]), traces.split(boundary.kind), strict=True)
        return [Boundary(*of_level) for of_level in found]

    def split_rows(self, matrix: sp.csr_array, columns: Parts) -> list[sp.csr_array]:
        """Return the matrix of each level, if these are the parts of its rows."""
        if self.num_levels == 1:
            return [matrix]
        rows = rows_of(matrix, self._order)
        indices = columns.number[rows.indices]
        shapes = zip(np.diff(self.starts).tolist(), np.diff(columns.starts).tolist(), strict=True)
        result = []
        for first, shape in zip(self.starts, shapes, strict=False):
            indptr = rows.indptr[first : first + shape[0] + 1]
            entries = slice(indptr[0], indptr[-1])
            result.append(csr(rows.data[entries].copy(), indices[entries].copy(), indptr - indptr[0], shape))
        return result

    def joined_rows(self, matrices: Sequence[sp.csr_array]) -> sp.csr_array:
        """Return the rows of all levels, in the order of the joined numbers; the columns are common to all."""
        stack = stacked(matrices)
        if self.num_levels == 1:
            return stack
        return rows_of(stack, self.starts[self.level] + self.number)
