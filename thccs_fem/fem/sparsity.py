"""Which dofs share a cell, or two cells that meet: the pattern of matrices, and the place in it of each entry.

Patterns are those of scalar functions. They are found once for the cells of a hierarchy, and once more for forms that
couple cells across facets. *Sets* of dofs that share something are numbered: those of cells come first, in their order,
then those of interior facets.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from thccs_fem.extraction import Cells
from thccs_fem.facets import interior_facets
from thccs_fem.jit import library
from thccs_fem.subdivision import Ints

__all__ = ["Pattern", "pattern", "pointer"]

LARGEST_INT = np.iinfo(np.int32).max
LONGEST_ROW = 2**16  # positions in a row are kept as uint16 or uint8

_C_TYPES = {
    np.dtype(np.float64): "double[]",
    np.dtype(np.int32): "int32_t[]",
    np.dtype(np.int64): "int64_t[]",
    np.dtype(np.uint8): "char[]",  # positions, which C takes as void *
    np.dtype(np.uint16): "char[]",
}


def pointer(array: npt.NDArray[Any], memory: list[Any] | None = None) -> Any:
    """Return a pointer to the memory of a contiguous array; kept alive by `memory` or the caller."""
    found = library().ffi.from_buffer(_C_TYPES[array.dtype], array)
    if memory is not None:
        memory.append(found)
    return found


@dataclass(frozen=True, eq=False)
class Pattern:
    """Which dofs share a set, for scalar functions: a row for each dof that this rank owns.

    Attributes:
        indptr: Beginning of each row, shape (owned dofs + 1,).
        indices: Dofs that share a set with the row's, ascending, shape (nnz,).
        starts: First of the positions of each set, shape (num_sets + 1,).
        positions: For a set of n dofs, n * n places in the rows of its dofs, counted from the beginning of the row:
            uint8 where that is enough, else uint16.
    """

    indptr: Ints
    indices: Ints
    starts: npt.NDArray[np.int64]
    positions: npt.NDArray[np.uint8] | npt.NDArray[np.uint16]

    def blocked(self, rows: int, columns: int) -> tuple[Ints, Ints]:
        """Return indptr and indices of the Kronecker product with a dense block, new arrays."""
        nnz = self.indices.size * rows * columns
        if nnz > LARGEST_INT:
            raise ValueError(
                f"the matrix would have {nnz} entries, more than the {LARGEST_INT} that 32-bit indices can count: use "
                f"fewer dofs or components, or assemble the components one by one"
            )
        indptr = np.concatenate([[0], np.cumsum(np.repeat(np.diff(self.indptr) * columns, rows))]).astype(np.int32)
        indices = np.zeros(nnz, dtype=np.int32)
        scalar = pointer(self.indptr), pointer(self.indices)
        library().lib.thccs_blocked_indices(self.indptr.size - 1, rows, columns, *scalar, pointer(indices))
        return indptr, indices


_patterns: WeakKeyDictionary[Cells, dict[bool, Pattern]] = WeakKeyDictionary()


def pattern(cells: Cells, across_facets: bool) -> Pattern:
    """Return a pattern, which is found once and kept as long as the cells are.

    Args:
        cells: The cells.
        across_facets: Whether dofs of cells that meet along a facet belong together too.

    Raises:
        ValueError: If there is more to count than the integers can.
    """
    kept = _patterns.setdefault(cells, {})
    if across_facets not in kept:
        owned = cells.partition.functions.size_local
        kept[across_facets] = _new_pattern(owned, cells.num_dofs, *_sets(cells, across_facets))
    return kept[across_facets]


def _sets(cells: Cells, across_facets: bool) -> tuple[Ints, Ints]:
    """Return the sizes of all sets, and their dofs, set by set."""
    parts = [cells.cell_dofs, interior_facets(cells).dofs] if across_facets else [cells.cell_dofs]
    return np.concatenate([np.diff(offsets) for offsets, _ in parts]), np.concatenate([dofs for _, dofs in parts])


def _new_pattern(num_owned: int, num_dofs: int, sizes: Ints, dofs: Ints) -> Pattern:
    offsets = _offsets(sizes, "dofs of all cells").astype(np.int32)
    local = np.arange(dofs.size, dtype=np.int32) - np.repeat(offsets[:-1], sizes)
    of_dofs = sp.csr_array((local, dofs, offsets), shape=(sizes.size, num_dofs)).tocsc()
    incidence = [pointer(array) for array in (offsets, dofs, of_dofs.indptr, of_dofs.indices)]
    lib = library().lib
    lengths = np.zeros(num_dofs, dtype=np.int32)
    scratch = np.full(num_dofs, -1, dtype=np.int32)
    lib.thccs_sparsity(num_dofs, *incidence, pointer(scratch), pointer(lengths), library().ffi.NULL)
    longest = int(lengths.max(initial=0))
    if longest > LONGEST_ROW:
        others = f"{longest} others, more than {LONGEST_ROW}"
        raise ValueError(f"a dof shares cells with {others}: split the pole that it is at")
    indptr = _offsets(lengths, "entries of the matrix").astype(np.int32)
    indices = np.zeros(indptr[-1], dtype=np.int32)
    scratch[:] = -1
    next_entries = indptr[:-1].copy()
    lib.thccs_sparsity(num_dofs, *incidence, pointer(scratch), pointer(next_entries), pointer(indices))
    starts = np.concatenate([[0], np.cumsum(sizes.astype(np.int64) ** 2)])
    positions = np.zeros(starts[-1], dtype=np.uint8 if longest <= 256 else np.uint16)
    lib.thccs_positions(
        num_dofs,
        *incidence,
        *(pointer(array) for array in (of_dofs.data, indptr, indices, scratch, starts)),
        positions.itemsize,
        pointer(positions),
    )
    if num_owned < num_dofs:
        indptr = indptr[: num_owned + 1].copy()
        indices = indices[: indptr[-1]].copy()
    return Pattern(indptr, indices, starts, positions)


def _offsets(sizes: Ints, of_what: str) -> npt.NDArray[np.int64]:
    """Return the cumulative sums of the sizes, from 0; they must be numbers for int32."""
    offsets = np.concatenate([[0], np.cumsum(sizes, dtype=np.int64)])
    if offsets[-1] > LARGEST_INT:
        raise ValueError(f"{offsets[-1]} {of_what} are more than the {LARGEST_INT} that 32-bit indices can count")
    return offsets
