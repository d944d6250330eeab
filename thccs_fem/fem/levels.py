"""Nested spaces below a space, for multigrid: what takes functions from each to the next, and their matrices.

V_l is the space without anything finer than level l. Its functions are the active ones of the levels before l, and all
selected ones of level l. So the prolongation from V_{l-1} to V_l has a unit row for each function that V_l keeps, and
for the new ones the rows of S_{l-1} C_{l-1}, where C_{l-1} are the coefficients of V_{l-1} on its last level. Below V_0
are the functions of coarser control meshes, as long as the control mesh is the subdivision of one (`coarsening`).

Level l smooths the functions that do not vanish on Omega^l: the new ones, and older ones around them. Without the older
ones, whose truncation changes, the number of iterations would grow with the refinement; with all functions of V_l the
work would, with the number of levels. Of a level's Galerkin matrix P^T A P only rows and columns of smoothed functions
are used, so that only these are made: together they have little more entries than A, for any number of levels.

On several ranks each has the prolongations as a whole, as it has the subdivision matrices, and its own rows of the
matrices. A function that two levels share has the same owner on both; another one has that of the function of the next
level that is most like it. To make the matrix of a level, ranks send what they know of rows that others own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from thccs_fem.boundary import BoundaryRule, traces_meeting
from thccs_fem.coarsening import coarsened
from thccs_fem.fem.space import FunctionSpace
from thccs_fem.hierarchy import Hierarchy
from thccs_fem.index_map import IndexMap
from thccs_fem.parallel import rank_of
from thccs_fem.sparse import entries, rows_of, summed
from thccs_fem.subdivision import Bools, Ints, Level, neighbourhood

__all__ = ["LevelMatrix", "Levels", "owners_of", "prolongations_below"]

SMALL = 500  # functions; a direct solver is as fast as any smoother then, and there is no need for coarser meshes
ROUNDING = 1e-14  # entries of prolongations up to this are zero but for rounding; true ones are 1e-4 and more
NOTHING = (np.zeros(0, dtype=np.int32), np.zeros(0, dtype=np.int32), np.zeros(0))  # rows, columns and values

Levelwise = npt.NDArray[np.int8]
Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LevelMatrix:
    """Rows of a level's matrix that this rank owns.

    Attributes:
        values: Entries, shape (owned, dofs of the level); columns by their number on the level.
        dofs: Which dofs of the level this rank owns.
    """

    values: sp.csr_array
    dofs: IndexMap

    @property
    def owned(self) -> Ints:
        """Dof of each row."""
        return self.dofs.numbers

    @property
    def rows(self) -> Ints:
        """Row of each entry, counted from 0."""
        return np.repeat(np.arange(self.owned.size, dtype=np.int32), np.diff(self.values.indptr))

    @property
    def diagonal(self) -> Floats:
        """Entry on the diagonal of each row."""
        if self.dofs.is_whole:
            return self.values.diagonal()
        on = np.flatnonzero(self.values.indices == np.repeat(self.owned, np.diff(self.values.indptr)))
        rows = np.searchsorted(self.values.indptr, on, side="right") - 1
        return np.bincount(rows, self.values.data[on], minlength=self.owned.size)

    def owned_rows(self, P: sp.csr_array) -> sp.csr_array:
        """Return the rows of a prolongation for the dofs that this rank owns."""
        return P if self.dofs.is_whole else P[self.owned]

    def with_diagonal(self, factor: float) -> LevelMatrix:
        """Return the matrix with a diagonal so many times larger."""
        data = self.values.data.copy()
        data[self.values.indices == self.owned[self.rows]] *= factor
        values = sp.csr_array((data, self.values.indices, self.values.indptr), shape=self.values.shape)
        return LevelMatrix(values, self.dofs)

    def carried_to(self, P: sp.csr_array, coarse: IndexMap) -> LevelMatrix:
        """Return P^T A P, of dofs that are spread as given. Collective."""
        product = sp.csr_array(self.owned_rows(P).T.tocsr() @ (self.values @ P))
        return LevelMatrix(_sent_to_owners(product, coarse), coarse)


def _sent_to_owners(A: sp.csr_array, dofs: IndexMap) -> sp.csr_array:
    """Return the owned rows of the sum of all ranks' matrices."""
    if dofs.is_whole:
        return A
    in_order = np.argsort(owners_of(dofs), kind="stable")
    sent = [entries(rows_of(A, in_order[a:b])) for a, b in pairwise(dofs.starts)]
    rank = rank_of(dofs.comm)
    own, sent[rank] = sent[rank], NOTHING
    return summed([own, *dofs.comm.alltoall(sent)], (dofs.size_local, A.shape[1]))


@dataclass(frozen=True, eq=False)
class Levels:
    """Nested spaces, the coarsest first, and what is smoothed on each.

    A function that one level has from the one before keeps its number through all of them, from the finest level on.

    Attributes:
        prolongations: From each level to the next, of all dofs.
        dofs: Which dofs of each level this rank owns; it holds no others.
        new: Marks of the dofs of each level that the one before has not; of the coarsest all.
        smoothed: Dofs of each level that it smooths, ascending; all of the coarsest.
        numbers: Number of each dof of each level; those of the last are 0, 1, ...
        finest: The last level that smooths each function, shape (functions of all levels,).
        coarser: For each dof in `smoothed` the last level before that smooths it as well; 0 if there is none.
    """

    prolongations: Sequence[sp.csr_array]
    dofs: Sequence[IndexMap]
    new: Sequence[Bools]
    smoothed: Sequence[Ints]
    numbers: Sequence[Ints]
    finest: Levelwise
    coarser: Sequence[Levelwise]

    @classmethod
    def of(cls, V: FunctionSpace) -> Levels:
        """Return the levels of a space, down to the coarsest mesh that its control mesh is a subdivision of."""
        prolongations = prolongations_below(V.hierarchy)
        marks = [np.ones(P.shape[0], dtype=bool) for P in prolongations]
        coefficients = _coefficients(V)
        for l in range(1, V.num_levels):
            prolongations.append(_prolongation(V.hierarchy, l, coefficients[l - 1]))
            marks.append(_meeting(V.hierarchy, l, coefficients[l]) | ~_copies(prolongations[-1]))
        k = V.block_size
        if k > 1:
            prolongations = [sp.csr_array(sp.kron(P, sp.eye_array(k), format="csr")) for P in prolongations]
            marks = [np.repeat(mark, k) for mark in marks]
        numbers, total = _numbers(prolongations, V.num_dofs)
        everything = np.ones(numbers[0].size, dtype=bool)
        new = [everything, *(~_copies(P) for P in prolongations)]
        marks.insert(0, everything)
        smoothed = [np.flatnonzero(mark).astype(np.int32) for mark in marks]
        finest, coarser = np.zeros(total, dtype=np.int8), []
        for l, (chosen, number) in enumerate(zip(smoothed, numbers, strict=True)):
            coarser.append(finest[number[chosen]])
            finest[number[chosen]] = l
        dofs = _spread(V, prolongations)
        return cls(tuple(prolongations), dofs, tuple(new), tuple(smoothed), tuple(numbers), finest, tuple(coarser))

    @property
    def sizes(self) -> tuple[int, ...]:
        """Dofs of each level."""
        return tuple(number.size for number in self.numbers)

    def matrices(self, A: sp.csr_array) -> list[LevelMatrix]:
        """Return the Galerkin matrix of each level without the entries of two functions that it does not smooth.

        An entry of a level's matrix is used on the first level, from the finest on, that smooths one of the two
        functions, or makes others of them. So each is kept for that level, by the numbers of its functions. Collective.

        Args:
            A: Rows of the finest level's matrix that this rank owns, shape (owned, dofs).
        """
        kept: list[list[tuple[Ints, Ints, Floats]]] = [[] for _ in self.numbers]
        level_of = self.finest.copy()
        place, row_of = (np.zeros(level_of.size, dtype=np.int32) for _ in range(2))
        matrix = LevelMatrix(A, self.dofs[-1])
        matrices = []
        for l in reversed(range(len(self.numbers))):
            number, smoothed = self.numbers[l], self.smoothed[l]
            if smoothed.size < number.size or kept[l]:
                _keep(matrix, number, level_of, kept)
                place[number] = np.arange(number.size)
                row_of[number[matrix.owned]] = np.arange(matrix.owned.size)
                rows, columns, values = (np.concatenate(parts) for parts in zip(NOTHING, *kept[l], strict=True))
                used = sp.csr_array((values, (row_of[rows], place[columns])), shape=matrix.values.shape)
                matrix = LevelMatrix(used, matrix.dofs)
                kept[l].clear()
            matrices.append(matrix)
            level_of[number[smoothed]] = self.coarser[l]
            if l:
                matrix = matrix.carried_to(self.prolongations[l - 1], self.dofs[l - 1])
        return matrices[::-1]


def _keep(A: LevelMatrix, number: Ints, level_of: Levelwise, kept: Sequence[list[Any]]) -> None:
    """Keep the entries of a matrix for the levels that use them first."""
    rows, columns = number[A.owned][A.rows], number[A.values.indices]
    level = np.maximum(level_of[rows], level_of[columns])
    order = np.argsort(level, kind="stable")  # by radix, as these are bytes
    ends = np.cumsum(np.bincount(level, minlength=len(kept)))
    for chosen, of_level in zip(np.split(order, ends[:-1]), kept, strict=True):
        if chosen.size:
            of_level.append((rows[chosen], columns[chosen], A.values.data[chosen]))


def _spread(V: FunctionSpace, prolongations: Sequence[sp.csr_array]) -> tuple[IndexMap, ...]:
    """Return which dofs of each level this rank owns."""
    if V.index_map.is_whole:
        return tuple(IndexMap.whole(size) for size in (*(P.shape[1] for P in prolongations), V.num_dofs))
    owners = np.repeat(owners_of(V.index_map), V.block_size)
    dofs = [_owned(V.mesh.comm, owners)]
    for P in reversed(prolongations):
        owners = owners[_most_like(P)]
        dofs.insert(0, _owned(V.mesh.comm, owners))
    return tuple(dofs)


def owners_of(dofs: IndexMap) -> Ints:
    """Return the rank that owns each dof."""
    numbers = dofs.numbers if dofs.global_numbers is None else dofs.global_numbers
    return (np.searchsorted(dofs.starts, numbers, side="right") - 1).astype(np.int32)


def _owned(comm: Any, owners: Ints) -> IndexMap:
    return IndexMap.spread(comm, owners, np.zeros(owners.size, dtype=bool))


def _most_like(P: sp.csr_array) -> Ints:
    """Return for each column the row of its largest entry, the first of them."""
    columns = sp.csc_array(P)
    largest = np.maximum.reduceat(columns.data, columns.indptr[:-1])
    found = np.flatnonzero(columns.data == np.repeat(largest, np.diff(columns.indptr)))
    return columns.indices[found[np.searchsorted(found, columns.indptr[:-1])]]


def _numbers(prolongations: Sequence[sp.csr_array], size: int) -> tuple[list[Ints], int]:
    """Return the numbers of the dofs on each level, and how many there are."""
    numbers = [np.arange(size, dtype=np.int32)]
    for P in reversed(prolongations):
        copies = _copies(P)
        coarse = np.full(P.shape[1], -1, dtype=np.int32)
        coarse[P.indices[P.indptr[:-1][copies]]] = numbers[0][copies]
        others = np.flatnonzero(coarse < 0)
        coarse[others] = np.arange(size, size + others.size)
        size += others.size
        numbers.insert(0, coarse)
    return numbers, size


def _copies(P: sp.csr_array) -> Bools:
    """Return the rows of a prolongation whose function is one of the coarser level's: nothing else is made of that."""
    uses = np.bincount(P.indices, minlength=P.shape[1])
    rows = np.flatnonzero(np.diff(P.indptr) == 1)
    entries = P.indptr[rows]
    copies = np.zeros(P.shape[0], dtype=bool)
    copies[rows] = (P.data[entries] == 1.0) & (uses[P.indices[entries]] == 1)
    return copies


def prolongations_below(hierarchy: Hierarchy) -> list[sp.csr_array]:
    """Return the prolongations from coarser meshes up to level 0, until one has few functions; once for a mesh."""
    known = _below.setdefault(hierarchy.root, {})
    if hierarchy.rule not in known:
        known[hierarchy.rule] = _made_below(hierarchy)
    return list(known[hierarchy.rule])


_below: WeakKeyDictionary[Level, dict[BoundaryRule, list[sp.csr_array]]] = WeakKeyDictionary()  # by level 0


def _made_below(hierarchy: Hierarchy) -> list[sp.csr_array]:
    prolongations: list[sp.csr_array] = []
    level, size = hierarchy.root, hierarchy.stages[0].boundary.num_functions
    while size > SMALL and (found := coarsened(level, hierarchy.rule)) is not None:
        level, matrix = found
        prolongations.insert(0, _without_rounding(matrix))
        size = matrix.shape[1]
    return prolongations


def _coefficients(V: FunctionSpace) -> Sequence[sp.csr_array]:
    """Return C_l of each level, on several ranks without keeping them."""
    hierarchy = V.hierarchy
    if V.num_levels == 1:
        return ()  # nobody asks for them
    if V.index_map.is_whole:
        return hierarchy.coefficients
    marks = [np.full(stage.selected.size, l < V.num_levels) for l, stage in enumerate(hierarchy.stages)]
    return hierarchy.coefficient_rows(marks)


def _prolongation(hierarchy: Hierarchy, l: int, of_before: sp.csr_array) -> sp.csr_array:
    """Return the prolongation from V_{l-1} to V_l, of C_{l-1}."""
    before, stage = hierarchy.stages[l - 1], hierarchy.stages[l]
    first, selected = int(hierarchy.dof_offsets[l - 1]), np.flatnonzero(before.selected)
    assert before.matrix is not None  # every stage but the last has a step
    last = np.arange(selected.size)
    units = sp.csr_array((np.ones(last.size), (selected, last)), shape=(before.selected.size, last.size))
    coefficients = sp.hstack([of_before[:, :first], units], format="csr")
    new = _without_rounding(before.matrix[np.flatnonzero(stage.selected)] @ coefficients)
    kept = np.concatenate([np.arange(first), first + last[before.active[selected]]])
    units = sp.csr_array((np.ones(kept.size), (np.arange(kept.size), kept)), shape=(kept.size, new.shape[1]))
    return sp.csr_array(sp.vstack([units, new], format="csr"))


def _without_rounding(P: sp.csr_array) -> sp.csr_array:
    P.data[np.abs(P.data) <= ROUNDING] = 0.0
    P.eliminate_zeros()
    return P


def _meeting(hierarchy: Hierarchy, l: int, coefficients: sp.csr_array) -> Bools:
    """Return the functions of V_l that do not vanish on Omega^l, of C_l."""
    stage, first = hierarchy.stages[l], int(hierarchy.dof_offsets[l])
    vertices = stage.level.corners_of(neighbourhood(stage.level, stage.inside))
    functions = np.concatenate([vertices, traces_meeting(stage.boundary, stage.inside)])
    used = coefficients[np.flatnonzero(functions)].indices
    older = np.bincount(used, minlength=first)[:first] > 0
    return np.concatenate([older, np.ones(np.count_nonzero(stage.selected), dtype=bool)])
