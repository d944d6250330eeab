"""Sparse matrices from triplets, products and rows, by the loops of kernels.c.

What SciPy does too, at a tenth of its overhead: a level of a hierarchy needs some thirty of these, mostly small, and
SciPy looks through all indices of every matrix that it makes.  Results are SciPy's `csr_array`, columns ascending.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from thccs_fem import jit

__all__ = [
    "COMPUTED",
    "EMPTY",
    "Triplets",
    "absolute_sums",
    "csr",
    "entries",
    "first_rows",
    "product",
    "restricted",
    "rows_of",
    "stacked",
    "summed",
    "transposed",
    "without_rounding",
]

Ints = npt.NDArray[np.int32]
Floats = npt.NDArray[np.float64]
Triplets = list[tuple[npt.NDArray[np.integer], npt.NDArray[np.integer], Floats | float]]

COMPUTED, EMPTY = -1, -2  # what `product` has in a row that is no unit row
_EMPTY = sp.csr_array((0, 0))


def csr(data: Floats, indices: Ints, indptr: Ints, shape: tuple[int, int]) -> sp.csr_array:
    """Return the matrix of arrays that are known to be right, which are neither looked at nor copied.

    SciPy's constructor takes longer than most of the loops here.
    """
    matrix: sp.csr_array = object.__new__(sp.csr_array)
    matrix.__dict__.update(_EMPTY.__dict__, data=data, indices=indices, indptr=indptr, _shape=shape)
    return matrix


def summed(triplets: Triplets, shape: tuple[int, int]) -> sp.csr_array:
    """Sum (rows, columns, values) into a matrix; negative rows or columns are dropped."""
    rows = np.concatenate([r for r, _, _ in triplets], dtype=np.int32, casting="same_kind")
    columns = np.concatenate([c for _, c, _ in triplets], dtype=np.int32, casting="same_kind")
    values = np.zeros(rows.size)
    first = 0
    for r, _, value in triplets:
        values[first : first + r.size] = value
        first += r.size
    indptr = np.zeros(shape[0] + 1, dtype=np.int32)
    indices, data = np.zeros(rows.size, dtype=np.int32), np.zeros(rows.size)
    _run("thccs_sum_triplets", rows.size, rows, columns, values, shape[0], indptr, indices, data)
    return csr(*_trimmed(data, indices, indptr), shape)


def product(a: sp.csr_array, b: sp.csr_array, unit: Ints | None = None) -> sp.csr_array:
    """Return a @ b without entries that are zero.

    Args:
        a: Shape (m, k).
        b: Shape (k, n).
        unit: For each row COMPUTED, or EMPTY, or the column in which it has a 1, shape (m,); None: all are computed.
    """
    bound = int(np.diff(b.indptr)[a.indices].sum(dtype=np.int64)) + (0 if unit is None else unit.size)
    indptr = np.zeros(a.shape[0] + 1, dtype=np.int32)
    indices, data = np.zeros(bound, dtype=np.int32), np.zeros(bound)
    place = np.full(b.shape[1], -1, dtype=np.int32)
    _run("thccs_product", a.shape[0], *_arrays(a), *_arrays(b), unit, place, indptr, indices, data)
    return csr(*_trimmed(data, indices, indptr), (a.shape[0], b.shape[1]))


def entries(a: sp.csr_array, first_row: int = 0) -> tuple[Ints, Ints, Floats]:
    """Return a matrix as (rows, columns, values), to be `summed` with others, its first row being `first_row`."""
    return np.repeat(np.arange(first_row, first_row + a.shape[0], dtype=np.int32), np.diff(a.indptr)), a.indices, a.data


def rows_of(a: sp.csr_array, rows: npt.NDArray[np.integer]) -> sp.csr_array:
    """Return the given rows, in their order, columns in the order that they had."""
    indptr = np.zeros(rows.size + 1, dtype=np.int32)
    np.cumsum(np.diff(a.indptr)[rows], out=indptr[1:])
    indices, data = np.zeros(indptr[-1], dtype=np.int32), np.zeros(indptr[-1])
    rows = rows.astype(np.int32, copy=False)
    _run("thccs_rows", rows.size, rows, *_arrays(a), indptr, indices, data)
    return csr(data, indices, indptr, (rows.size, a.shape[1]))


def transposed(a: sp.csr_array) -> sp.csr_array:
    """Return the transposed matrix."""
    rows, columns, values = entries(a)
    return summed([(columns, rows, values)], (a.shape[1], a.shape[0]))


def without_rounding(a: sp.csr_array, tolerance: float) -> sp.csr_array:
    """Return a matrix without the entries whose absolute value is less than the tolerance."""
    indptr, indices, data = _arrays(a)
    kept = np.abs(data) >= tolerance
    count = np.zeros(kept.size + 1, dtype=np.int32)
    np.cumsum(kept, out=count[1:])
    return csr(data[kept], indices[kept], count[indptr], a.shape)


def restricted(a: sp.csr_array, rows: npt.NDArray[np.integer], columns: npt.NDArray[np.integer]) -> sp.csr_array:
    """Return the part of a matrix in the given rows and columns, in their order.

    Args:
        a: Shape (m, n).
        rows: Any rows.
        columns: Different columns. Entries of a row stay in the order that they had in a.
    """
    rows, place = rows.astype(np.int32, copy=False), np.full(a.shape[1], -1, dtype=np.int32)
    place[columns] = np.arange(columns.size, dtype=np.int32)
    bound = int(np.diff(a.indptr)[rows].sum(dtype=np.int64))
    indptr = np.zeros(rows.size + 1, dtype=np.int32)
    indices, data = np.zeros(bound, dtype=np.int32), np.zeros(bound)  # memory that is not used is never touched
    _run("thccs_restrict", rows.size, rows, place, *_arrays(a), indptr, indices, data)
    return csr(data[: indptr[-1]], indices[: indptr[-1]], indptr, (rows.size, columns.size))


def absolute_sums(a: sp.csr_array) -> tuple[Floats, Floats]:
    """Return the sums of the absolute values in each row and in each column."""
    of_rows, of_columns = np.zeros(a.shape[0]), np.zeros(a.shape[1])
    _run("thccs_absolute_sums", a.shape[0], *_arrays(a), of_rows, of_columns)
    return of_rows, of_columns


def first_rows(a: sp.csr_array, count: int) -> sp.csr_array:
    """Return the first rows."""
    indptr, indices, data = _arrays(a)
    return csr(data[: indptr[count]], indices[: indptr[count]], indptr[: count + 1], (count, a.shape[1]))


def stacked(matrices: Sequence[sp.csr_array]) -> sp.csr_array:
    """Return matrices with equally many columns, one below the other."""
    if len(matrices) == 1:
        return matrices[0]
    indptrs, indices, data = zip(*(_arrays(m) for m in matrices), strict=True)
    begins = np.cumsum([0, *(m.size for m in data[:-1])], dtype=np.int32)
    indptr = np.concatenate([[0], *(m[1:] + begin for m, begin in zip(indptrs, begins, strict=True))], dtype=np.int32)
    return csr(np.concatenate(data), np.concatenate(indices), indptr, (indptr.size - 1, matrices[0].shape[1]))


def _arrays(a: sp.csr_array) -> tuple[Ints, Ints, Floats]:
    """Return the arrays of a matrix that may be one of SciPy's, which chooses the type of its indices."""
    return a.indptr.astype(np.int32, copy=False), a.indices.astype(np.int32, copy=False), a.data


def _trimmed(data: Floats, indices: Ints, indptr: Ints) -> tuple[Floats, Ints, Ints]:
    """Return the arrays without unused space."""
    nnz = int(indptr[-1])
    return (data, indices, indptr) if data.size == nnz else (data[:nnz].copy(), indices[:nnz].copy(), indptr)


def _run(function: str, *arguments: int | npt.NDArray[Any] | None) -> None:
    """Call a loop of kernels.c."""
    module = jit.library()
    pointer, null = module.ffi.from_buffer, module.ffi.NULL
    c_types = {"i4": "int32_t[]", "f8": "double[]"}
    getattr(module.lib, function)(
        *(null if a is None else a if isinstance(a, int) else pointer(c_types[a.dtype.str[1:]], a) for a in arguments)
    )
