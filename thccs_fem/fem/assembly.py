"""Assembly: sums of compiled integrals over cells and facets, into numbers, vectors and matrices.

Kernels run on the 16 local B-splines of a piece, or on the 32 of two pieces that meet; what they return for a cell
u -> operator @ u[dofs] is operator^T A operator, summed over its pieces. The loops are in kernels.c. Matrices go into
scipy's CSR arrays whose pattern, and the place in it of every entry of every cell, are found once for the cells of a
hierarchy.
"""

from __future__ import annotations

from typing import overload

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

import ufl
from thccs_fem.fem.entries import at_owners
from thccs_fem.fem.forms import Form
from thccs_fem.fem.forms import form as compile_form
from thccs_fem.fem.function import Function
from thccs_fem.fem.loops import cell_loops, loops
from thccs_fem.fem.space import FunctionSpace
from thccs_fem.fem.sparsity import Pattern, pattern, pointer
from thccs_fem.index_map import IndexMap
from thccs_fem.jit import library
from thccs_fem.parallel import together
from thccs_fem.subdivision import Ints

__all__ = [
    "assemble_block",
    "assemble_cells",
    "assemble_matrix",
    "assemble_scalar",
    "assemble_vector",
    "bubble_energies",
    "integrals",
    "refill_block",
]

Floats = npt.NDArray[np.float64]


def assemble_scalar(form: Form, /) -> float:
    """Return the value of a form without arguments, of this rank's cells: the sum over ranks is that of the form.

    Raises:
        ValueError: The form has arguments.
    """
    return float(assemble_cells(form).sum())


def assemble_cells(form: Form, /) -> Floats:
    """Return the integrals of a form without arguments over each cell that this rank owns, shape (cells.num_owned,).

    An integral over a facet on the boundary counts for its cell, one over a facet between cells for both, by half.

    Raises:
        ValueError: The form has arguments.
    """
    _check_rank(form, 0)
    values = np.zeros(form.cells.num_cells)
    for loop in loops(form):
        loop.run(library().lib.thccs_assemble_cells, pointer(values))
    return values[: form.cells.num_owned]


def assemble_vector(form: Form, /) -> Floats:
    """Return the vector of a form with a test function, shape (num_local_dofs of its space,).

    The part of dofs that this rank owns is complete, without communication; entries of ghosts have no meaning.

    Raises:
        ValueError: The form has not exactly one argument.
    """
    _check_rank(form, 1)
    (test,) = form.spaces
    values = np.zeros((form.cells.num_dofs, test.block_size))
    for loop in loops(form):
        loop.run(library().lib.thccs_assemble_vector, test.block_size, pointer(values))
    transfer = form.transfers.get(test.hierarchy)
    return (values if transfer is None else transfer.transposed(values)).ravel()


@overload
def assemble_matrix(form: Form, /) -> sp.csr_array: ...


@overload
def assemble_matrix(A: sp.csr_array, form: Form, /) -> sp.csr_array: ...


def assemble_matrix(form: Form | sp.csr_array, refilling: Form | None = None, /) -> sp.csr_array:
    """Assemble a matrix, or give an assembled one new values.

    ``A = assemble_matrix(form)`` has an entry for each pair of dofs that share a cell, or two cells that meet where the
    form has integrals over ``dS``, zero or not; its column indices are sorted, and int32. ``assemble_matrix(A, form)``
    writes ``A.data`` in place: who shares its memory sees the new values.

    Returns:
        Rows of the dofs that this rank owns, columns of those that it holds: shape (num_owned_dofs of the test space,
        num_local_dofs of the trial space).

    Raises:
        ValueError: The form has not exactly two arguments; the matrix to be refilled was not assembled from a form with
            the same spaces; or there are more entries than int32 can count.
    """
    if refilling is None:
        _check_rank(form, 2)
        return assemble_block(form, form.spaces[1].index_map)
    _check_rank(refilling, 2)
    refill_block(form, refilling, refilling.spaces[1].index_map)
    return form


def assemble_block(form: Form, columns: IndexMap) -> sp.csr_array:
    """Return the matrix of a form in terms of more trial functions than this rank holds in their space.

    It needs more where trial and test functions are on different hierarchies, each spread in its own way.

    Args:
        form: Compiled form with two arguments.
        columns: The trial functions; see `Layout.index_maps`.

    Raises:
        NotImplementedError: Some trial functions that are needed are not there.
    """
    _check_rank(form, 2)
    indptr, indices = _structure(form)
    values = np.zeros(indices.size)
    _add_matrix(form, values)
    trial = form.spaces[1]
    A = sp.csr_array((values, indices, indptr), shape=(indptr.size - 1, form.cells.num_dofs * trial.block_size))
    if _is_coarser(form):
        return _on_coarser(A, form, columns)
    if columns is not trial.index_map:
        held = _dofs(trial, columns.local_of(trial.index_map.numbers))  # as ascending as they were
        A = sp.csr_array((values, held[indices], indptr), shape=(A.shape[0], trial.block_size * columns.numbers.size))
    return A


def refill_block(A: sp.csr_array, form: Form, columns: IndexMap) -> None:
    """Give a matrix that `assemble_block` has made new values."""
    if _is_coarser(form) or columns is not form.spaces[1].index_map:
        new = assemble_block(form, columns)
        _check_structure(A, new.indptr, new.indices)
        A.data[:] = new.data
    else:
        _check_structure(A, *_structure(form))
        A.data[:] = 0.0
        _add_matrix(form, A.data)


def integrals(V: FunctionSpace) -> Floats:
    """Return the integral of each scalar function of V, as `form` integrates if nothing is said.

    Returns:
        Shape (functions,), local, ghosts included.
    """
    values = assemble_vector(compile_form(ufl.TestFunction(FunctionSpace(V.hierarchy, (), V.integration)) * ufl.dx))
    V.index_map.scatter_forward(values)
    return values


def bubble_energies(a: Form, L: Form, u: Function | None) -> Floats:
    """Return r^T K^-1 r for each cell, with K_ij = a(b_j, b_i) and r_i = L(b_i) - a(u, b_i) for its bubbles b.

    Bubbles are, in each component, the products of two cubics along the sides of the cell: of the Bernstein polynomials
    1 and 2, which vanish on facets; or, where a or L has second derivatives of the test function, of Hermite's that
    have value or slope 1 in the middle of the side, and no normal derivative on facets either. Over these nothing is
    integrated.

    Args:
        a: Bilinear form.
        L: Linear form.
        u: Function in the space of all arguments, on whose cells both forms are integrated; None for zero.

    Returns:
        Shape (cells.num_owned,): infinite where K is singular and the equations for K^-1 r have no solution.
    """
    cells, block_size = a.cells, a.spaces[0].block_size
    size, are_smooth = 4 * block_size, max(a.orders[0], L.orders[0]) > 1
    K, r = np.zeros((cells.num_cells, size, size)), np.zeros((cells.num_cells, size))
    values = np.zeros((cells.num_dofs, block_size)) if u is None else u.x.array.reshape(-1, block_size)
    places = cells.piece_origin, cells.piece_axes
    for form in (a, L):
        for loop in cell_loops(form):
            of_pieces = [pointer(array[loop.first_piece :]) for array in places]
            local = pointer(loop.batch.local(values)) if form is a else library().ffi.NULL
            kind = block_size, are_smooth
            loop.run(library().lib.thccs_assemble_on_bubbles, *kind, *of_pieces, local, pointer(K), pointer(r))
    energies = np.zeros(cells.num_cells)
    library().lib.thccs_solve_local(energies.size, size, *(pointer(array) for array in (K, r, r.copy(), energies)))
    return energies[: cells.num_owned]


def _check_rank(form: Form, rank: int) -> None:
    if not isinstance(form, Form):
        raise TypeError(f"a compiled form is needed, fem.form(...), got {type(form).__module__}.{type(form).__name__}")
    if form.rank != rank:
        what = ("a scalar has no arguments", "a vector has a test function", "a matrix has a test and a trial function")
        raise ValueError(f"the form of {what[rank]}, but this one has {form.rank} arguments")


def _is_coarser(form: Form) -> bool:
    """Return whether an argument is on a coarser hierarchy than that which is integrated on."""
    return any(space.hierarchy in form.transfers for space in form.spaces)


def _on_coarser(A: sp.csr_array, form: Form, known: IndexMap) -> sp.csr_array:
    """Return the matrix of a form in terms of its arguments' dofs; collective, as several ranks contribute to a row.

    Args:
        A: The matrix in terms of the dofs of the form's finest hierarchy.
        form: The form.
        known: Trial functions that may be columns.
    """
    (test, trial), (T, U) = form.spaces, (form.transfers.get(space.hierarchy) for space in form.spaces)
    T_owned = None if T is None else _blocked(T.matrix, test)[: A.shape[0]]
    entries = _carried(A, T_owned, None if U is None else _blocked(U.matrix, trial)).tocoo()
    rows, columns, values = entries.row, entries.col, np.asarray(entries.data)
    columns = _dofs(trial, trial.index_map.numbers if U is None else U.wanted)[columns]
    if T is not None:
        starts = test.block_size * test.index_map.starts
        rows = _dofs(test, _global(test.index_map, T.wanted))[rows]
        rows, columns, values = at_owners(test.mesh.comm, starts, rows, columns, values)
        rows = rows - test.block_size * test.index_map.local_range[0]
    local = known.local_of(columns // trial.block_size)
    together(trial.mesh.comm, lambda: _check_known(local))
    columns = trial.block_size * local + columns % trial.block_size
    A = sp.csr_array((values, (rows, columns)), shape=(test.num_owned_dofs, trial.block_size * known.numbers.size))
    A.sort_indices()
    return A


def _check_known(local: Ints) -> None:
    if (local < 0).any():
        raise NotImplementedError(
            f"{np.count_nonzero(local < 0)} entries of this rank's rows are in columns that it does not hold, as test "
            f"and trial functions are on different hierarchies: use fem.petsc.assemble_matrix"
        )


def _carried(A: sp.csr_array, test: sp.csr_array | None, trial: sp.csr_array | None) -> sp.csr_array:
    """Return test^T A trial, with an entry wherever there can be one: SciPy's product leaves out zeros.

    None stands for the identity.
    """

    def product(A: sp.csr_array, test: sp.csr_array | None, trial: sp.csr_array | None) -> sp.csr_array:
        A = A if test is None else sp.csr_array(test.T @ A)
        A = A if trial is None else sp.csr_array(A @ trial)
        A.sort_indices()
        return A

    def keys(A: sp.csr_array) -> npt.NDArray[np.int64]:
        return np.repeat(np.arange(A.shape[0]), np.diff(A.indptr)) * A.shape[1] + A.indices

    ones = sp.csr_array((np.ones(A.nnz), A.indices, A.indptr), shape=A.shape)
    places = product(ones, *(None if T is None else abs(T) for T in (test, trial)))
    values = product(A, test, trial)
    places.data[:] = 0.0
    places.data[np.searchsorted(keys(places), keys(values))] = values.data
    return places


def _check_structure(A: sp.csr_array, indptr: Ints, indices: Ints) -> None:
    if not (np.array_equal(A.indptr, indptr) and np.array_equal(A.indices, indices)):
        raise ValueError(
            f"the matrix to be refilled has {A.nnz} entries in {A.shape[0]} rows, the form {indices.size} in "
            f"{indptr.size - 1}, or in other places: give a matrix that was assembled from a form with the same spaces"
        )


def _add_matrix(form: Form, values: Floats) -> None:
    """Add the integrals to the values of a matrix with the form's structure."""
    scalar, block_sizes = _pattern(form), [space.block_size for space in form.spaces]
    for loop in loops(form):
        loop.run(
            library().lib.thccs_assemble_matrix,
            *block_sizes,
            scalar.indptr.size - 1,
            pointer(scalar.indptr),
            pointer(scalar.starts[loop.sets]),
            scalar.positions.itemsize,
            pointer(scalar.positions),
            pointer(values),
        )


def _structure(form: Form) -> tuple[Ints, Ints]:
    """Return indptr and indices of the form's matrix on its finest hierarchy, new arrays."""
    test, trial = form.spaces
    return _pattern(form).blocked(test.block_size, trial.block_size)


def _pattern(form: Form) -> Pattern:
    """Return the pattern for scalar functions: across facets as well where the form has integrals over these."""
    return pattern(form.cells, any(integral.kind == "interior_facet" for integral in form.integrals))


def _blocked(scalar: sp.csr_array, space: FunctionSpace) -> sp.csr_array:
    """Return what carries every component as `scalar` carries one."""
    return sp.csr_array(sp.kron(scalar, sp.eye_array(space.block_size), format="csr"))


def _dofs(space: FunctionSpace, functions: Ints) -> Ints:
    """Return the numbers of the dofs of functions, from theirs."""
    components = np.arange(space.block_size, dtype=np.int32)
    return np.asarray(space.block_size * functions[:, None] + components, dtype=np.int32).ravel()


def _global(index_map: IndexMap, numbers: Ints) -> Ints:
    """Return PETSc's numbers of things, from those in the hierarchy."""
    return numbers if index_map.global_numbers is None else index_map.global_numbers[numbers]
