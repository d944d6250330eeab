"""Assembly: sums of compiled integrals over cells, into numbers, vectors and matrices.

Kernels run on the 16 local B-splines of a piece; what they return for a cell u -> operator @ u[dofs] is
operator^T A operator, summed over its pieces. The loops are in kernels.c. Matrices go into scipy's CSR arrays whose
pattern, and the place in it of every entry of every cell, are found once for the cells of a hierarchy.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, overload
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from thccs_fem.extraction import Batch, Cells
from thccs_fem.fem.forms import Form, Integral
from thccs_fem.fem.function import Function
from thccs_fem.fem.space import FunctionSpace
from thccs_fem.jit import library

__all__ = ["assemble_cells", "assemble_matrix", "assemble_scalar", "assemble_vector", "bubble_energies"]

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]

LARGEST_INT = np.iinfo(np.int32).max
LONGEST_ROW = 2**16  # positions in a row are kept as uint16 or uint8


def assemble_scalar(form: Form, /) -> float:
    """Return the value of a form without arguments (of this rank's cells, in parallel).

    Raises:
        ValueError: The form has arguments.
    """
    return float(assemble_cells(form).sum())


def assemble_cells(form: Form, /) -> Floats:
    """Return the integrals of a form without arguments over each cell, shape (num_cells,).

    Raises:
        ValueError: The form has arguments.
    """
    _check_rank(form, 0)
    values = np.zeros(form.cells.num_cells)
    for loop in _loops(form):
        loop.run(library().lib.thccs_assemble_cells, _pointer(values))
    return values


def assemble_vector(form: Form, /) -> Floats:
    """Return the vector of a form with a test function, shape (num_dofs of its space,).

    Raises:
        ValueError: The form has not exactly one argument.
    """
    _check_rank(form, 1)
    (test,) = form.spaces
    values = np.zeros((form.cells.num_dofs, test.block_size))
    for loop in _loops(form):
        loop.run(library().lib.thccs_assemble_vector, test.block_size, _pointer(values))
    transfer = form.transfers.get(test.hierarchy)
    return (values if transfer is None else transfer.T @ values).ravel()


@overload
def assemble_matrix(form: Form, /) -> sp.csr_array: ...


@overload
def assemble_matrix(A: sp.csr_array, form: Form, /) -> sp.csr_array: ...


def assemble_matrix(form: Form | sp.csr_array, refilling: Form | None = None, /) -> sp.csr_array:
    """Assemble a matrix, or give an assembled one new values.

    ``A = assemble_matrix(form)`` has an entry for each pair of dofs that share a cell, zero or not; its column indices
    are sorted, and int32. ``assemble_matrix(A, form)`` writes ``A.data`` in place: who shares its memory sees the new
    values.

    Returns:
        Shape (num_dofs of the test space, num_dofs of the trial space).

    Raises:
        ValueError: The form has not exactly two arguments; the matrix to be refilled was not assembled from a form with
            the same spaces; or there are more entries than int32 can count.
    """
    if refilling is None:
        return _new_matrix(form)
    _refill(form, refilling)
    return form


def bubble_energies(a: Form, L: Form, u: Function) -> Floats:
    """Return r^T K^-1 r for each cell, with K_ij = a(b_j, b_i) and r_i = L(b_i) - a(u, b_i) for its bubbles b.

    Bubbles are the products of the cubic Bernstein polynomials 1 and 2 along the sides of the cell, in each component.

    Args:
        a: Bilinear form.
        L: Linear form.
        u: Function in the space of all arguments, on whose cells both forms are integrated.

    Returns:
        Shape (num_cells,): infinite where K is singular and the equations for K^-1 r have no solution.
    """
    cells, block_size = a.cells, u.function_space.block_size
    size = 4 * block_size
    K, r = np.zeros((cells.num_cells, size, size)), np.zeros((cells.num_cells, size))
    places = cells.piece_origin, cells.piece_axes
    for form in (a, L):
        for loop in _loops(form):
            batch = cells.batches[loop.number]
            of_pieces = [_pointer(array[loop.first_piece :]) for array in places]
            local = _pointer(batch.local(u.x.array.reshape(-1, block_size))) if form is a else library().ffi.NULL
            loop.run(library().lib.thccs_assemble_on_bubbles, block_size, *of_pieces, local, _pointer(K), _pointer(r))
    energies = np.zeros(cells.num_cells)
    library().lib.thccs_solve_local(energies.size, size, *(_pointer(array) for array in (K, r, r.copy(), energies)))
    return energies


def _check_rank(form: Form, rank: int) -> None:
    if form.rank != rank:
        what = ("a scalar has no arguments", "a vector has a test function", "a matrix has a test and a trial function")
        raise ValueError(f"the form of {what[rank]}, but this one has {form.rank} arguments: {form.spaces}")


def _new_matrix(form: Form) -> sp.csr_array:
    _check_rank(form, 2)
    indptr, indices = _structure(form)
    values = np.zeros(indices.size)
    _add_matrix(form, values)
    shape = tuple(form.cells.num_dofs * space.block_size for space in form.spaces)
    A = sp.csr_array((values, indices, indptr), shape=shape)
    test, trial = (_blocked_transfer(form, space) for space in form.spaces)
    if test is not None:
        A = sp.csr_array(test.T @ A)
    if trial is not None:
        A = sp.csr_array(A @ trial)
    A.sort_indices()
    return A


def _refill(A: sp.csr_array, form: Form) -> None:
    _check_rank(form, 2)
    if any(space.hierarchy in form.transfers for space in form.spaces):
        new = _new_matrix(form)
        _check_structure(A, new.indptr, new.indices)
        A.data[:] = new.data
    else:
        _check_structure(A, *_structure(form))
        A.data[:] = 0.0
        _add_matrix(form, A.data)


def _check_structure(A: sp.csr_array, indptr: Ints, indices: Ints) -> None:
    if not (np.array_equal(A.indptr, indptr) and np.array_equal(A.indices, indices)):
        raise ValueError(
            f"the matrix to be refilled has {A.nnz} entries in {A.shape[0]} rows, the form {indices.size} in "
            f"{indptr.size - 1}, or in other places: give a matrix that was assembled from a form with the same spaces"
        )


def _add_matrix(form: Form, values: Floats) -> None:
    """Add the integrals to the values of a matrix with the form's structure."""
    pattern, block_sizes = _pattern(form.cells), [space.block_size for space in form.spaces]
    for loop in _loops(form):
        loop.run(
            library().lib.thccs_assemble_matrix,
            *block_sizes,
            _pointer(pattern.indptr),
            _pointer(pattern.starts[loop.first_cell :]),
            pattern.positions.itemsize,
            _pointer(pattern.positions),
            _pointer(values),
        )


def _structure(form: Form) -> tuple[Ints, Ints]:
    """Return indptr and indices of the form's matrix on its finest hierarchy, new arrays."""
    test, trial = form.spaces
    return _pattern(form.cells).blocked(test.block_size, trial.block_size)


def _blocked_transfer(form: Form, space: FunctionSpace) -> sp.csr_array | None:
    scalar = form.transfers.get(space.hierarchy)
    return None if scalar is None else sp.csr_array(sp.kron(scalar, sp.eye_array(space.block_size), format="csr"))


# ---- Loops over cells ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Loop:
    """One integral over the cells of one batch.

    Attributes:
        batch: Pointer to a `thccs_batch`.
        integral: Pointer to a `thccs_integral`.
        number: Number of the batch.
        first_cell: Number of cells in the batches before.
        first_piece: Number of pieces in them.
        memory: What these structs point to.
    """

    batch: Any
    integral: Any
    number: int
    first_cell: int
    first_piece: int
    memory: list[Any]

    def run(self, function: Callable[..., int], *arguments: Any) -> None:
        """Call one of the C loops."""
        if function(self.batch, self.integral, *arguments):
            raise MemoryError("there is no memory for the tensors of a single cell")


def _loops(form: Form) -> Iterator[_Loop]:
    """Yield the loops that together integrate the form."""
    coefficients = [_values(form, i) for i in range(len(form.coefficients))]
    block_sizes = np.array([f.function_space.block_size for f in form.coefficients], dtype=np.int32)
    constants = np.concatenate([np.ravel(c.value) for c in form.constants] or [np.zeros(0)]).astype(np.float64)
    first_cell = first_piece = 0
    for number, batch in enumerate(form.cells.batches):
        memory: list[Any] = []
        c_batch = _c_batch(batch, form.cells, memory)
        for integral in form.integrals:
            chosen = _chosen(form.cells, batch, integral)
            if chosen is None or chosen.size:
                c_integral = _c_integral(integral, coefficients, block_sizes, constants, memory)
                c_integral.num_cells = batch.cells.size if chosen is None else chosen.size
                c_integral.cells = library().ffi.NULL if chosen is None else _pointer(chosen, memory)
                yield _Loop(c_batch, c_integral, number, first_cell, first_piece, memory)
        first_cell += batch.cells.size
        first_piece += batch.num_pieces


def _chosen(cells: Cells, batch: Batch, integral: Integral) -> Ints | None:
    """Return the cells of the batch that an integral is over, as positions in the batch; None for all."""
    if integral.tag is None:
        return None
    return np.flatnonzero(cells.tag[batch.cells] == integral.tag).astype(np.int32)


def _values(form: Form, i: int) -> Floats:
    """Return the values of a coefficient at the dofs of the form's cells, shape (num_dofs, block_size)."""
    function = form.coefficients[i]
    values = function.x.array.reshape(-1, function.function_space.block_size)
    transfer = form.transfers.get(function.function_space.hierarchy)
    return values if transfer is None else transfer @ values


def _c_batch(batch: Batch, cells: Cells, memory: list[Any]) -> Any:
    ffi = library().ffi
    return ffi.new(
        "thccs_batch *",
        {
            "width": batch.dofs.shape[1],
            "gdim": cells.points.shape[1],
            "cells": _pointer(batch.cells, memory),
            "dofs": _pointer(batch.dofs, memory),
            "offsets": _pointer(batch.offsets, memory),
            "nodes": _pointer(batch.nodes, memory),
            "operators": ffi.NULL if batch.operators is None else _pointer(batch.operators, memory),
            "points": _pointer(cells.points, memory),
        },
    )


def _c_integral(
    integral: Integral, coefficients: list[Floats], block_sizes: Ints, constants: Floats, memory: list[Any]
) -> Any:
    ffi = library().ffi
    read = [_pointer(w, memory) if reads else ffi.NULL for w, reads in zip(coefficients, integral.reads, strict=True)]
    values = ffi.new("double *[]", read)
    memory.append(values)
    return ffi.new(
        "thccs_integral *",
        {
            "kernel": integral.kernel,
            "constants": _pointer(constants, memory),
            "num_coefficients": len(coefficients),
            "block_sizes": _pointer(block_sizes, memory),
            "coefficients": values,
        },
    )


_C_TYPES = {
    np.dtype(np.float64): "double[]",
    np.dtype(np.int32): "int32_t[]",
    np.dtype(np.int64): "int64_t[]",
    np.dtype(np.uint8): "char[]",  # positions, which C takes as void *
    np.dtype(np.uint16): "char[]",
}


def _pointer(array: npt.NDArray[Any], memory: list[Any] | None = None) -> Any:
    """Return a pointer to the memory of a contiguous array; kept alive by `memory` or the caller."""
    pointer = library().ffi.from_buffer(_C_TYPES[array.dtype], array)
    if memory is not None:
        memory.append(pointer)
    return pointer


# ---- Sparsity pattern ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Pattern:
    """Which dofs share a cell, for scalar functions.

    Attributes:
        indptr: Beginning of each row, shape (num_dofs + 1,).
        indices: Dofs that share a cell with the row's, ascending, shape (nnz,).
        starts: First of the positions of each cell, in the order of the batches, shape (num_cells + 1,).
        positions: For a cell with n dofs, n * n places in the rows of its dofs, counted from the beginning of the row:
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
        scalar = _pointer(self.indptr), _pointer(self.indices)
        library().lib.thccs_blocked_indices(self.indptr.size - 1, rows, columns, *scalar, _pointer(indices))
        return indptr, indices


_patterns: WeakKeyDictionary[Cells, _Pattern] = WeakKeyDictionary()


def _pattern(cells: Cells) -> _Pattern:
    """Return the pattern of the cells, which is found once and kept as long as they are."""
    if cells not in _patterns:
        _patterns[cells] = _new_pattern(cells)
    return _patterns[cells]


def _new_pattern(cells: Cells) -> _Pattern:
    sizes = np.concatenate([np.count_nonzero(batch.dofs >= 0, axis=1) for batch in cells.batches])
    offsets = _offsets(sizes, "dofs of all cells").astype(np.int32)
    dofs = np.concatenate([batch.dofs[batch.dofs >= 0] for batch in cells.batches])
    local = np.arange(dofs.size, dtype=np.int32) - np.repeat(offsets[:-1], sizes)
    of_dofs = sp.csr_array((local, dofs, offsets), shape=(sizes.size, cells.num_dofs)).tocsc()
    incidence = [_pointer(array) for array in (offsets, dofs, of_dofs.indptr, of_dofs.indices)]
    lib, num_dofs = library().lib, cells.num_dofs
    lengths = np.zeros(num_dofs, dtype=np.int32)
    scratch = np.full(num_dofs, -1, dtype=np.int32)
    lib.thccs_sparsity(num_dofs, *incidence, _pointer(scratch), _pointer(lengths), library().ffi.NULL)
    if lengths.max() > LONGEST_ROW:
        others = f"{lengths.max()} others, more than {LONGEST_ROW}"
        raise ValueError(f"a dof shares cells with {others}: split the pole that it is at")
    indptr = _offsets(lengths, "entries of the matrix").astype(np.int32)
    indices = np.zeros(indptr[-1], dtype=np.int32)
    scratch[:] = -1
    next_entries = indptr[:-1].copy()
    lib.thccs_sparsity(num_dofs, *incidence, _pointer(scratch), _pointer(next_entries), _pointer(indices))
    starts = np.concatenate([[0], np.cumsum(sizes.astype(np.int64) ** 2)])
    positions = np.zeros(starts[-1], dtype=np.uint8 if lengths.max() <= 256 else np.uint16)
    lib.thccs_positions(
        num_dofs,
        *incidence,
        *(_pointer(array) for array in (of_dofs.data, indptr, indices, scratch, starts)),
        positions.itemsize,
        _pointer(positions),
    )
    return _Pattern(indptr, indices, starts, positions)


def _offsets(sizes: Ints, of_what: str) -> npt.NDArray[np.int64]:
    """Return the cumulative sums of the sizes, from 0; they must be numbers for int32."""
    offsets = np.concatenate([[0], np.cumsum(sizes, dtype=np.int64)])
    if offsets[-1] > LARGEST_INT:
        raise ValueError(f"{offsets[-1]} {of_what} are more than the {LARGEST_INT} that 32-bit indices can count")
    return offsets
