"""Equations in one unknown or several: which form stands where, and one vector and one matrix of them all.

With several unknowns, a[i][j] has test functions of space i and trial functions of space j. Dofs are numbered space
after space. A form over a `ufl.MixedFunctionSpace` is cut into such blocks.

On several ranks the vectors of equations have what this rank owns, space after space; ghosts follow where columns of
matrices and prescribed dofs are numbered.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

import ufl
from thccs_fem.fem.assembly import assemble_matrix, assemble_vector
from thccs_fem.fem.bcs import DirichletBC
from thccs_fem.fem.forms import Form, form
from thccs_fem.fem.function import Function
from thccs_fem.fem.space import FunctionSpace
from thccs_fem.parallel import rank_of, together
from thccs_fem.subdivision import Ints

__all__ = ["BlockMatrix", "Layout", "columns", "compiled", "constraints", "rows", "spaces_of", "unknowns"]

Floats = npt.NDArray[np.float64]
AnyForm = ufl.Form | Form
Conditions = Sequence[DirichletBC] | Sequence[Sequence[DirichletBC]]
Unknown = Function | Sequence[Function]

NO_FORM = (type(None), ufl.ZeroBaseForm)  # where a block is zero


# ---- Which form stands where -----------------------------------------------------------------------------------------


def columns(L: AnyForm | Sequence[AnyForm | None], count: int | None = None) -> list[AnyForm | None]:
    """Return the linear forms of the equations, one for each test function; None: zero.

    Args:
        L: A form, one over a `ufl.MixedFunctionSpace`, or a list.
        count: Number of equations, where the form need not tell.

    Raises:
        ValueError: The number of forms is not `count`.
    """
    if isinstance(L, list | tuple):
        found = [None if isinstance(block, NO_FORM) else block for block in L]
    elif parts := _parts(L):
        found = [parts.get((i,)) for i in range(count or 1 + max(i for (i,) in parts))]
    else:
        found = [L]
    if count is not None and len(found) != count:
        raise ValueError(f"there are {count} equations, but {len(found)} linear forms: give one for each, or None")
    return found


def rows(a: AnyForm | Sequence[Sequence[AnyForm | None]]) -> list[list[AnyForm | None]]:
    """Return the bilinear forms of the equations, row by row; None: zero.

    Raises:
        ValueError: There are not as many columns as rows.
    """
    if isinstance(a, list | tuple):
        found = [[None if isinstance(block, NO_FORM) else block for block in row] for row in a]
    elif parts := _parts(a):
        n = 1 + max(map(max, parts))
        found = [[parts.get((i, j)) for j in range(n)] for i in range(n)]
    else:
        found = [[a]]
    if any(len(row) != len(found) for row in found):
        raise ValueError(
            f"a has {len(found)} rows of {[len(row) for row in found]} blocks: give as many in each row as there are "
            f"rows, [[a00, a01], [a10, a11]], None where there is no form"
        )
    return found


def _parts(whole: Any) -> dict[tuple[int, ...], ufl.Form]:
    """Return the blocks of a form over a `ufl.MixedFunctionSpace` by their places; none for other forms."""
    arguments = whole.arguments() if isinstance(whole, ufl.Form) else ()
    if not arguments or any(argument.part() is None for argument in arguments):
        return {}
    blocks = ufl.extract_blocks(whole)
    flat = [block for row in blocks for block in (row if isinstance(row, tuple) else (row,))]
    return {tuple(v.part() for v in block.arguments()): block for block in flat if not isinstance(block, NO_FORM)}


def spaces_of(
    a: Sequence[Sequence[AnyForm | None]], L: Sequence[AnyForm | None], names: tuple[str, str] = ("a", "L")
) -> tuple[FunctionSpace, ...]:
    """Return the spaces of the unknowns.

    Args:
        a: Bilinear forms, row by row.
        L: Linear forms.
        names: What messages call them.

    Raises:
        ValueError: The forms have not the arguments of an equation, or an unknown has no form.
    """
    found = []
    for i, (row, load) in enumerate(zip(a, L, strict=True)):
        name_a, name_L = (name + (f"[{i}]" if len(L) > 1 else "") for name in names)
        bilinear = [_spaces(block) for block in row if block is not None]
        column = [_spaces(block) for block in (other[i] for other in a) if block is not None]
        linear = [] if load is None else [_spaces(load)]
        if any(len(spaces) != 2 for spaces in bilinear + column) or any(len(spaces) != 1 for spaces in linear):
            ranks = [len(spaces) for spaces in (bilinear + column)[:1] + linear]
            raise ValueError(
                f"{name_a} has {ranks[0]} arguments and {name_L} has {ranks[-1]}: {names[0]} is the bilinear form, in "
                f"a trial and a test function, and {names[1]} the linear one, in a test function alone"
            )
        same = [spaces[0] for spaces in bilinear + linear] + [spaces[1] for spaces in column]
        if not bilinear or not column:
            raise ValueError(f"row or column {i} of {names[0]} has no form: equation and unknown {i} need one each")
        if any(V != same[0] for V in same):
            raise ValueError(
                f"the trial function of {name_a} is in {column[0][1]}, its test function in {bilinear[0][0]} and that "
                f"of {name_L} in {linear[0][0] if linear else 'none'}: an equation needs the same space for all three"
            )
        found.append(same[-1])
    return tuple(found)


def _spaces(block: AnyForm) -> tuple[FunctionSpace, ...]:
    if isinstance(block, Form):
        return block.spaces
    return tuple(argument.ufl_function_space() for argument in block.arguments())


def compiled(blocks: Sequence[AnyForm | None], spaces: Sequence[FunctionSpace]) -> list[Form | None]:
    """Compile forms, all for the cells of the finest of the spaces, so that they are integrated alike."""
    finest = next((V for V in spaces if all(V.is_refinement_of(other) for other in spaces)), None)
    on = finest if len(spaces) > 1 else None
    return [None if block is None else form(block, on=on) for block in blocks]


def unknowns(u: Unknown | None, spaces: Sequence[FunctionSpace]) -> list[Function]:
    """Return the functions that take the solution, new ones where none are given.

    Raises:
        ValueError: A function is in another space, or there are not as many as spaces.
    """
    given = [u] if isinstance(u, Function) else [Function(V) for V in spaces] if u is None else list(u)
    if len(given) != len(spaces):
        raise ValueError(f"there are {len(given)} unknowns u for {len(spaces)} trial functions: give one for each")
    for function, V in zip(given, spaces, strict=True):
        if function.function_space != V:
            raise ValueError(
                f"u is in {function.function_space}, but the trial function in {V}: give a fem.Function of that space"
            )
    return given


# ---- Dofs of all unknowns --------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Layout:
    """Dofs of several spaces, one space after the other.

    On several ranks local numbers are those of the dofs that this rank owns, space after space, then those of all
    ghosts, ascending by PETSc's numbers. These go rank after rank, and within a rank space after space.

    Attributes:
        spaces: The spaces.
    """

    spaces: tuple[FunctionSpace, ...]

    @property
    def comm(self) -> Any:
        """The communicator, None in serial."""
        return self.spaces[0].mesh.comm

    @cached_property
    def offsets(self) -> Ints:
        """Number of the first owned dof of each space, and their number in all, shape (len(spaces) + 1,)."""
        return np.cumsum([0, *(V.num_owned_dofs for V in self.spaces)]).astype(np.int32)

    @cached_property
    def starts(self) -> npt.NDArray[np.int64]:
        """First of PETSc's numbers of each rank, and how many there are, shape (ranks + 1,)."""
        return np.sum([V.block_size * V.index_map.starts for V in self.spaces], axis=0)

    @property
    def num_dofs(self) -> int:
        """Number of dofs in all, global."""
        return int(self.starts[-1])

    @property
    def num_owned(self) -> int:
        """Number of dofs that this rank owns."""
        return int(self.offsets[-1])

    @property
    def num_local(self) -> int:
        """Number of dofs that this rank owns or has as ghosts."""
        return sum(V.num_local_dofs for V in self.spaces)

    @property
    def is_whole(self) -> bool:
        """Whether this rank owns all dofs, by their numbers."""
        return all(V.index_map.is_whole for V in self.spaces)

    @cached_property
    def global_numbers(self) -> Ints:
        """PETSc's number of each local dof, shape (num_local,)."""
        own = self.starts[0 if self.is_whole else rank_of(self.comm)] + np.arange(self.num_owned)
        return np.concatenate([own, self._ghosts[self._order]]).astype(np.int32)

    @cached_property
    def local(self) -> list[Ints]:
        """Local number here of each local dof of each space, in the order of that space."""
        ghosts = np.zeros(self._order.size, dtype=np.int32)
        ghosts[self._order] = np.arange(self.num_owned, self.num_local, dtype=np.int32)
        ends = np.cumsum([V.num_local_dofs - V.num_owned_dofs for V in self.spaces])
        owned = np.split(np.arange(self.num_owned, dtype=np.int32), self.offsets[1:-1])
        return [np.concatenate(parts) for parts in zip(owned, np.split(ghosts, ends[:-1]), strict=True)]

    @cached_property
    def component(self) -> Ints:
        """Which of all components of all spaces each local dof belongs to, shape (num_local,)."""
        component, first = np.zeros(self.num_local, dtype=np.int32), 0
        for V, local in zip(self.spaces, self.local, strict=True):
            component[local] = first + np.arange(V.num_local_dofs) % V.block_size
            first += V.block_size
        return component

    @cached_property
    def _ghosts(self) -> npt.NDArray[np.int64]:
        """PETSc's numbers of the ghosts of all spaces, space after space."""
        found, before = [np.zeros(0, dtype=np.int64)], np.zeros(self.starts.size - 1, dtype=np.int64)
        for V in self.spaces:
            starts = V.block_size * V.index_map.starts
            shift = self.starts[:-1] + before - starts[:-1]
            blocks = V.block_size * V.index_map.ghosts.astype(np.int64) + shift[V.index_map.owners]
            found.append((blocks[:, None] + np.arange(V.block_size)).ravel())
            before += np.diff(starts)
        return np.concatenate(found)

    @cached_property
    def _order(self) -> npt.NDArray[np.intp]:
        return np.argsort(self._ghosts)

    def split(self, x: Floats) -> list[Floats]:
        """Return the part of a vector of owned dofs that belongs to each space, views."""
        return np.split(x, self.offsets[1:-1])

    def join(self, functions: Sequence[Function]) -> Floats:
        """Return the coefficients of functions in one vector, a new one, shape (num_owned,)."""
        owned = zip(functions, self.spaces, strict=True)
        return np.concatenate([function.x.array[: V.num_owned_dofs] for function, V in owned])

    def spread(self, x: Floats, functions: Sequence[Function]) -> None:
        """Give functions their coefficients, shape (num_owned,), and their ghosts too; collective."""
        for function, values in zip(functions, self.split(x), strict=True):
            function.x.array[: values.size] = values
            function.x.scatter_forward()

    def with_ghosts(self, x: Floats) -> Floats:
        """Return a vector of all local dofs; collective.

        Args:
            x: Values of the owned ones, shape (num_owned,) or with k columns.
        """
        if self.is_whole:
            return x
        result = np.zeros((self.num_local, *x.shape[1:]))
        for V, local, owned in zip(self.spaces, self.local, self.split(x), strict=True):
            values = np.zeros((V.num_local_dofs, *x.shape[1:]))
            values[: V.num_owned_dofs] = owned
            V.index_map.scatter_forward(values.reshape(V.index_map.numbers.size, -1))
            result[local] = values
        return result

    def without_ghosts(self, x: Floats) -> Floats:
        """Return a vector of owned dofs, with what stands at their ghosts on other ranks added to them; collective.

        Args:
            x: Contributions to all local dofs, shape (num_local,) or with k columns.
        """
        if self.is_whole:
            return x
        parts = []
        for V, local in zip(self.spaces, self.local, strict=True):
            values = x[local]
            V.index_map.reverse_add(values.reshape(V.index_map.numbers.size, -1))
            parts.append(values[: V.num_owned_dofs])
        return np.concatenate(parts)

    def vector(self, forms: Sequence[Form | None]) -> Floats:
        """Return the assembled vectors of forms in one, shape (num_owned,); zeros where there is none."""
        sizes = np.diff(self.offsets).tolist()
        given = zip(forms, sizes, strict=True)
        return np.concatenate([np.zeros(n) if L is None else assemble_vector(L)[:n] for L, n in given])

    def constraints(self, bcs: Conditions) -> tuple[Ints, Floats]:
        """Return the prescribed dofs by their local numbers, ascending, ghosts included, and their values; collective.

        Args:
            bcs: Conditions, each for the unknown in whose space it is; or a list of them for each unknown.

        Raises:
            TypeError: A condition is none.
            ValueError: A condition is on a space of no unknown, or of two.
        """
        given = together(self.comm, lambda: self._sorted(bcs or ()))
        found = [constraints(of_space, V) for of_space, V in zip(given, self.spaces, strict=True)]
        dofs = np.concatenate([local[dofs] for local, (dofs, _) in zip(self.local, found, strict=True)])
        values = np.concatenate([values for _, values in found])
        order = np.argsort(dofs)
        return dofs[order], values[order]

    def _sorted(self, bcs: Conditions) -> list[list[Any]]:
        """Return the conditions on each space."""
        if len(self.spaces) == 1 or isinstance(bcs, DirichletBC):
            return [bcs for _ in self.spaces]  # type: ignore[misc]  # constraints says what is wrong with a single one
        if len(bcs) == len(self.spaces) and all(isinstance(some, list | tuple) for some in bcs):
            return [list(some) for some in bcs]  # type: ignore[arg-type]  # as was just asked
        of_space: list[list[Any]] = [[] for _ in self.spaces]
        for bc in bcs:
            of_space[self._place(bc)].append(bc)
        return of_space

    def _place(self, bc: Any) -> int:
        """Return the number of the space that a condition is on."""
        given = bc.function_space if isinstance(bc, DirichletBC) else None
        places = [i for i, V in enumerate(self.spaces) if V is given]
        places = places or [i for i, V in enumerate(self.spaces) if V == given]
        if len(places) > 1:
            raise ValueError(
                f"a condition is on {given}, which is the space of the unknowns {places}: give a list of conditions "
                f"for each unknown, bcs=[[...], [...]]"
            )
        if not places and given is not None:
            listed = " and ".join(str(V) for V in self.spaces)
            raise ValueError(f"a condition is on {given}, but the unknowns are in {listed}")
        return places[0] if places else 0  # where constraints refuses it


def constraints(bcs: Sequence[DirichletBC], V: FunctionSpace) -> tuple[Ints, Floats]:
    """Return the prescribed dofs, ascending, local, and their values; collective.

    Where two conditions prescribe a dof, the later one holds. For ghosts their owners' conditions do: a rank need not
    see from its own cells that a ghost is on the boundary.

    Raises:
        TypeError: If a condition is none of ours.
        ValueError: If a condition is on another space.
    """
    dofs, values = together(V.mesh.comm, lambda: _local_constraints(bcs, V))
    if V.index_map.is_whole:
        return dofs, values
    marked = np.zeros((V.num_local_dofs, 2))
    marked[dofs, 0], marked[dofs, 1] = 1.0, values
    V.index_map.scatter_forward(marked.reshape(V.index_map.numbers.size, -1))
    dofs = np.flatnonzero(marked[:, 0]).astype(np.int32)
    return dofs, marked[dofs, 1]


def _local_constraints(bcs: Sequence[DirichletBC], V: FunctionSpace) -> tuple[Ints, Floats]:
    if isinstance(bcs, DirichletBC):
        raise TypeError("bcs is a single condition: give a list, bcs=[bc]")
    for bc in bcs:
        if not isinstance(bc, DirichletBC):
            raise TypeError(f"bcs holds a {type(bc).__name__}: make conditions with fem.dirichletbc(value, dofs, V)")
        if bc.function_space != V:
            where = "" if bc.function_space.mesh is V.mesh else " of another mesh"
            raise ValueError(
                f"a condition is on {bc.function_space}{where}, but the unknown is in {V}: make it with "
                f"fem.dirichletbc(value, dofs, V) for that space, with dofs found for it"
            )
    dofs = np.concatenate([np.zeros(0, dtype=np.int32), *(bc.dofs for bc in reversed(bcs))])
    values = np.concatenate([np.zeros(0), *(bc.values for bc in reversed(bcs))])
    dofs, first = np.unique(dofs, return_index=True)
    return dofs, values[first]


# ---- One matrix ------------------------------------------------------------------------------------------------------


class BlockMatrix:
    """The matrix of a bilinear form, or of blocks of them, and the matrices of the blocks.

    A block on the diagonal without a form is zero, but has a diagonal: conditions need it.

    Args:
        forms: Blocks, row by row.
        layout: Dofs of the unknowns.

    Attributes:
        blocks: Matrix of each block, None where there is no form. They keep their memory.
        whole: The matrix of them all, which is the block if there is but one; it keeps its memory. Rows of the dofs
            that this rank owns, columns of all local ones: shape (num_owned, num_local) of the layout.
    """

    def __init__(self, forms: Sequence[Sequence[Form | None]], layout: Layout):
        self._forms = forms
        self.blocks = [
            [assemble_matrix(a) if a is not None else _zero(V) if i == j else None for j, a in enumerate(row)]
            for (i, row), V in zip(enumerate(forms), layout.spaces, strict=True)
        ]
        self.whole, self._places = _whole(self.blocks, layout)
        self._gather()

    def assemble(self) -> None:
        """Assemble all blocks with the present values of coefficients and constants."""
        for forms, matrices in zip(self._forms, self.blocks, strict=True):
            for a, A in zip(forms, matrices, strict=True):
                if a is not None and A is not None:
                    assemble_matrix(A, a)
        self._gather()

    def scatter(self) -> None:
        """Give the blocks the values that `whole` has now."""
        if len(self.blocks) > 1:
            values = np.zeros(self.whole.nnz)
            values[self._places] = self.whole.data
            ends = np.cumsum([A.nnz for A in self._stored])
            for A, own in zip(self._stored, np.split(values, ends[:-1]), strict=True):
                A.data[:] = own

    @property
    def _stored(self) -> list[sp.csr_array]:
        return [A for row in self.blocks for A in row if A is not None]

    def _gather(self) -> None:
        if len(self.blocks) > 1:
            self.whole.data[:] = np.concatenate([A.data for A in self._stored])[self._places]


def _zero(V: FunctionSpace) -> sp.csr_array:
    n = V.num_owned_dofs
    indices, indptr = np.arange(n, dtype=np.int32), np.arange(n + 1, dtype=np.int32)
    return sp.csr_array((np.zeros(n), indices, indptr), shape=(n, V.num_local_dofs))


def _whole(
    blocks: Sequence[Sequence[sp.csr_array | None]], layout: Layout
) -> tuple[sp.csr_array, npt.NDArray[np.int64]]:
    """Return the matrix of all blocks, and for each of its entries the place in the values of all blocks, in a row."""
    if len(blocks) == 1:
        (((A,),),) = (blocks,)
        assert A is not None  # a single block is on the diagonal
        return A, np.zeros(0, dtype=np.int64)
    first = 0
    numbered: list[list[sp.csr_array | None]] = []
    for row in blocks:
        numbered.append([])
        for A in row:
            places = None if A is None else np.arange(first, first + A.nnz)
            numbered[-1].append(None if A is None else sp.csr_array((places, A.indices, A.indptr), shape=A.shape))
            first += 0 if A is None else A.nnz
    pattern = sp.csr_array(sp.block_array(numbered, format="csr"))
    columns = np.concatenate(layout.local)[pattern.indices]
    pattern = sp.csr_array((pattern.data, columns, pattern.indptr), shape=pattern.shape)
    pattern.sort_indices()
    indices, indptr = pattern.indices.astype(np.int32), pattern.indptr.astype(np.int32)
    return sp.csr_array((np.zeros(pattern.nnz), indices, indptr), shape=pattern.shape), pattern.data
