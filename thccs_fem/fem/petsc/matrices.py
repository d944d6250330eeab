"""Matrices and vectors of forms in PETSc. They use the memory of the arrays that assembly fills, without a copy.

On several ranks PETSc keeps columns that a rank owns apart from those of ghosts. It uses memory that is cut in this
way, into which `changed` copies what assembly has made.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import singledispatch
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from thccs_fem.fem import assembly
from thccs_fem.fem.bcs import DirichletBC
from thccs_fem.fem.blocks import BlockMatrix
from thccs_fem.fem.entries import Numbering
from thccs_fem.fem.forms import Form
from thccs_fem.fem.layout import Layout, constraints
from thccs_fem.fem.linear import constrain
from thccs_fem.fem.space import FunctionSpace
from thccs_fem.fem.sparsity import pointer
from thccs_fem.index_map import IndexMap
from thccs_fem.jit import library
from thccs_fem.parallel import total
from thccs_fem.subdivision import Ints

__all__ = [
    "apply_lifting",
    "assemble_matrix",
    "assemble_vector",
    "changed",
    "comm_of",
    "new_block_mat",
    "new_ghosted_vec",
    "new_mat",
    "new_vec",
    "set_bc",
    "sharing",
    "solver_comm",
    "values_of",
]

Floats = npt.NDArray[np.float64]


@singledispatch
def assemble_matrix(form: Any, *args: Any, **kwargs: Any) -> PETSc.Mat:
    """Return the matrix of a form, ``assemble_matrix(a, bcs)``, or fill it anew, ``assemble_matrix(A, a, bcs)``.

    Rows and columns of dofs with a condition are those of the identity. The matrix is ready for use.

    Args:
        form: Compiled bilinear form; or the matrix to be filled anew, then the form.
        *args: The form, if the matrix came first, and conditions.
        **kwargs: Conditions by name, `bcs`.

    Raises:
        TypeError: The first argument is neither form nor matrix.
        ValueError: The form has not two arguments; conditions are on another space than they; or the matrix to be
            filled was not assembled here, or from a form with other spaces.
    """
    raise TypeError(f"assemble_matrix needs a form from fem.form, or a Mat and a form, got {type(form).__name__}")


@assemble_matrix.register
def _(form: Form, bcs: Sequence[DirichletBC] = ()) -> PETSc.Mat:
    columns = _columns(form)
    A = assembly.assemble_block(form, columns)
    _constrain(A, form, bcs)
    return new_mat(A, form.spaces, columns)


@assemble_matrix.register
def _(A: PETSc.Mat, form: Form, bcs: Sequence[DirichletBC] = ()) -> PETSc.Mat:
    values = A.getAttr("values")
    if not isinstance(values, sp.csr_array):
        raise ValueError("the matrix to be filled does not use memory of ours: make it with assemble_matrix(form)")
    assembly.refill_block(values, form, _columns(form))
    _constrain(values, form, bcs)
    changed(A)
    return A


def assemble_vector(form: Form | PETSc.Vec, added: Form | None = None, /) -> PETSc.Vec:
    """Return the vector of a form, ``assemble_vector(L)``, or add it to one, ``assemble_vector(b, L)``.

    On several ranks it has ghosts, which are zero: its entries are complete, and a ``ghostUpdate`` of a script for
    DOLFINx, which adds ghosts to them, does no harm.

    Args:
        form: Compiled form with a test function; or the vector that is added to.
        added: The form, if the vector came first.

    Raises:
        TypeError: The form is no compiled form.
        ValueError: The form has not one argument.
    """
    if isinstance(form, PETSc.Vec):
        values = assembly.assemble_vector(added)  # type: ignore[arg-type]  # it says what else is given
        form.array_w[:] += values[: form.getLocalSize()]
        return form
    return new_ghosted_vec(assembly.assemble_vector(form), form.spaces[0])


def apply_lifting(
    b: PETSc.Vec,
    a: Sequence[Form],
    bcs: Sequence[Sequence[DirichletBC]],
    x0: Sequence[PETSc.Vec] = (),
    alpha: float = 1.0,
) -> PETSc.Vec:
    """Subtract from b what prescribed values contribute to the equations, alpha A (g - x0).

    Each A is assembled for this, without conditions. Entries of prescribed dofs are left to `set_bc`.

    Args:
        b: The vector, changed in place.
        a: Bilinear forms whose test space is that of b.
        bcs: For each form the conditions on its trial space.
        x0: For each form a vector whose values are subtracted from the prescribed ones; none: zero.
        alpha: Factor.

    Raises:
        ValueError: A condition is on another space, or there are not as many of one thing as of the other.
    """
    states = [x.array_r for x in x0] or [np.zeros(form.spaces[1].num_owned_dofs) for form in a]
    for form, conditions, state in zip(a, bcs, states, strict=True):
        V, columns = form.spaces[1], _columns(form)
        dofs, values = constraints(conditions, V)
        if total(V.mesh.comm, dofs.size):
            owned = np.searchsorted(dofs, V.num_owned_dofs)
            jump = np.zeros((columns.numbers.size, V.block_size))
            jump.ravel()[dofs[:owned]] = values[:owned] - state[dofs[:owned]]
            columns.scatter_forward(jump)
            b.array_w[:] -= alpha * (assembly.assemble_block(form, columns) @ jump.ravel())
    return b


def set_bc(b: PETSc.Vec, bcs: Sequence[DirichletBC], x0: PETSc.Vec | None = None, alpha: float = 1.0) -> None:
    """Set the entries of prescribed dofs to alpha (g - x0).

    Args:
        b: The vector, changed in place.
        bcs: Conditions; where two prescribe the same dof, the later one holds.
        x0: A vector whose values are subtracted from the prescribed ones; None: zero.
        alpha: Factor.
    """
    if bcs:
        dofs, values = constraints(bcs, bcs[0].function_space)
        owned = np.searchsorted(dofs, b.getLocalSize())
        dofs, values = dofs[:owned], values[:owned]
        b.array_w[dofs] = alpha * (values if x0 is None else values - x0.array_r[dofs])


def _columns(form: Form) -> IndexMap:
    """Return the trial functions of a matrix."""
    return Layout(form.spaces).index_maps[-1]


def _constrain(A: sp.csr_array, form: Form, bcs: Sequence[DirichletBC]) -> None:
    if bcs:
        test, trial = form.spaces
        if test != trial:
            raise ValueError(f"conditions need test and trial functions in one space, not in {test} and {trial}")
        constrain(A, constraints(bcs, trial)[0])


def comm_of(V: FunctionSpace) -> Any:  # petsc4py takes mpi4py's, but its stubs say otherwise
    """Return the communicator of the mesh; without one that of this process alone."""
    return MPI.COMM_SELF if V.mesh.comm is None else V.mesh.comm


def solver_comm(V: FunctionSpace) -> Any:
    """Return `comm_of` for a new solver, and free what Python has let go of before; collective.

    On several ranks objects of PETSc go all ranks together or not at all, so that PETSc keeps them until it is told to
    look which ones all ranks have let go of: 4 MB a problem with 1500 dofs.
    """
    comm = comm_of(V)
    if comm.size > 1:
        PETSc.garbage_cleanup(comm)
    return comm


def new_vec(array: Any, comm: Any) -> PETSc.Vec:
    """Return a vector that uses the memory of an array; of several ranks the array of each is its part."""
    return PETSc.Vec().createWithArray(array, comm=comm)


def new_ghosted_vec(array: Floats, V: FunctionSpace) -> PETSc.Vec:
    """Return a vector that uses the memory of an array with ghosts, which become zero, shape (V.num_local_dofs,)."""
    if V.index_map.is_whole:
        return new_vec(array, comm_of(V))
    array[V.num_owned_dofs :] = 0.0
    ghosts: Any = V.index_map.ghosts.astype(PETSc.IntType)  # sequences, say the stubs
    values: Any = array
    size = V.num_owned_dofs, V.num_dofs
    return PETSc.Vec().createGhostWithArray(ghosts, values, size=size, bsize=V.block_size, comm=comm_of(V))


def new_mat(A: sp.csr_array, spaces: Sequence[FunctionSpace], columns: IndexMap | None = None) -> PETSc.Mat:
    """Return a matrix that uses the memory of A.

    Args:
        A: The values, as `assembly.assemble_block` returns them.
        spaces: Spaces of rows and columns.
        columns: The functions that are columns; None: those that this rank holds in their space.
    """
    test, trial = spaces
    mat = sharing(A, comm_of(test), Numbering.of(trial.index_map if columns is None else columns, trial.block_size))
    mat.setBlockSizes(test.block_size, trial.block_size)
    return mat


def new_block_mat(A: BlockMatrix | sp.csr_array, layout: Layout, kind: str = "mpi") -> PETSc.Mat:
    """Return a matrix for several unknowns that uses the memory of A.

    Args:
        A: The matrix, for "nest" with its blocks.
        layout: Its dofs.
        kind: "mpi" for one matrix, "nest" for one of matrices.

    Raises:
        ValueError: The kind is none of these, or there is nothing to nest.
    """
    spaces, whole = layout.spaces, A.whole if isinstance(A, BlockMatrix) else A
    if kind == "mpi":
        if len(spaces) == 1:
            return new_mat(whole, (spaces[0], spaces[0]))
        return sharing(whole, comm_of(spaces[0]), layout.numbering)
    if kind != "nest" or not isinstance(A, BlockMatrix) or len(spaces) == 1:
        raise ValueError(f'kind is {kind!r}; it must be "mpi", or "nest" for several unknowns')
    A.scatter()
    mats: Any = [  # None where there is no block, other than the stubs say
        [
            None if block is None else new_mat(block, (test, trial), columns)
            for block, trial, columns in zip(row, spaces, layout.index_maps, strict=True)
        ]
        for row, test in zip(A.blocks, spaces, strict=True)
    ]
    nest = PETSc.Mat().createNest(mats, comm=comm_of(spaces[0]))
    nest.setAttr("blocks", A)
    nest.assemble()
    return nest


def sharing(A: sp.csr_array, comm: Any, columns: Numbering | None = None) -> PETSc.Mat:
    """Return a matrix that uses the memory of A, of whatever dofs.

    On several ranks it uses memory of its own, for entries in columns that this rank owns and for the others; `changed`
    fills it with what is in A.

    Args:
        A: The values, on several ranks a row for each dof that this rank owns, and columns for its ghosts, too.
        comm: Communicator.
        columns: What PETSc calls the columns; None in serial.
    """
    if np.dtype(PETSc.ScalarType) != np.float64:
        raise TypeError(
            f"PETSc was built for {np.dtype(PETSc.ScalarType)}; forms here are real, double precision: use such a build"
        )
    if columns is None:
        mat = PETSc.Mat().createAIJWithArrays(A.shape, _csr(A.indptr, A.indices, A.data), comm=comm)
        mat.setAttr("values", A)
        mat.setAttr("state", mat.stateGet())
        return mat
    own, others = _split(A, columns)
    size: Any = (A.shape[0], None), (columns.num_owned, None)  # None: whatever it is, other than the stubs say
    mat = PETSc.Mat().createAIJWithArrays(size, (own, others), comm=comm)
    mat.setAttr("values", A)
    mat.setAttr("parts", (columns.num_owned, own[2], others[2]))
    mat.setAttr("columns", columns)
    mat.setAttr("state", mat.stateGet())
    return mat


def values_of(mat: PETSc.Mat) -> sp.csr_array | None:
    """Return the values that a matrix uses the memory of, or is filled with; None if PETSc has others now.

    On several ranks PETSc's numbers of their columns are the attribute "columns" of the matrix, a `Numbering`.
    """
    values: Any = mat.getAttr("values")
    return values if mat.getAttr("state") == mat.stateGet() else None


def _split(A: sp.csr_array, columns: Numbering) -> tuple[Any, Any]:
    """Return the entries of A in columns that this rank owns, and the others, by PETSc's numbers of the columns."""
    num_others = int(np.count_nonzero(A.indices >= columns.num_owned))
    sizes = A.indices.size - num_others, num_others
    (own_indptr, own_indices), (other_indptr, other_indices) = (
        (np.zeros(A.shape[0] + 1, dtype=np.int32), np.zeros(size, dtype=np.int32)) for size in sizes
    )
    numbers = columns.numbers[columns.num_owned :].astype(np.int32)
    arrays = A.indptr, A.indices, numbers, own_indptr, own_indices, other_indptr, other_indices
    library().lib.thccs_split_pattern(A.shape[0], columns.num_owned, *(pointer(array) for array in arrays))
    own, others = (np.zeros(size) for size in sizes)
    _split_values(A, columns.num_owned, own, others)
    return _csr(own_indptr, own_indices, own), _csr(other_indptr, other_indices, others)


def _split_values(A: sp.csr_array, num_owned: int, own: Floats, others: Floats) -> None:
    arrays = A.indices, A.data, own, others
    library().lib.thccs_split_values(A.indices.size, num_owned, *(pointer(array) for array in arrays))


def _csr(indptr: Ints, indices: Ints, data: Floats) -> Any:  # sequences, say the stubs
    """Return arrays as PETSc takes them."""
    return indptr.astype(PETSc.IntType, copy=False), indices.astype(PETSc.IntType, copy=False), data


def changed(mat: PETSc.Mat) -> None:
    """Tell PETSc that values were written to the memory of a matrix, or of that whose blocks are nested in it."""
    if mat.getType() == "nest":
        nested: Any = mat.getAttr("blocks")
        nested.scatter()
        rows, columns = mat.getNestSize()
        for i in range(rows):
            for j in range(columns):
                block = mat.getNestSubMatrix(i, j)
                if block:
                    changed(block)
    parts: Any = mat.getAttr("parts")
    if parts is not None:
        A: Any = mat.getAttr("values")
        _split_values(A, *parts)
    mat.assemble()
    mat.stateIncrease()
    mat.setAttr("state", mat.stateGet())
