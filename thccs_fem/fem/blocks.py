"""Equations in one unknown or several: which form stands where, and one vector and one matrix of them all.

With several unknowns, a[i][j] has test functions of space i and trial functions of space j. Dofs are numbered as in
`layout`. A form over a `ufl.MixedFunctionSpace` is cut into such blocks.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

import ufl
from thccs_fem.fem.assembly import assemble_block, assemble_vector, refill_block
from thccs_fem.fem.forms import Form, form
from thccs_fem.fem.function import Function
from thccs_fem.fem.layout import Layout
from thccs_fem.fem.space import FunctionSpace

__all__ = ["BlockMatrix", "columns", "compiled", "rows", "spaces_of", "unknowns", "vector"]

Floats = npt.NDArray[np.float64]

AnyForm = ufl.Form | Form
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


# ---- One vector and one matrix ---------------------------------------------------------------------------------------


def vector(forms: Sequence[Form | None], layout: Layout) -> Floats:
    """Return the assembled vectors of forms in one, shape (layout.num_owned,); zeros where there is none."""
    given = zip(forms, np.diff(layout.offsets).tolist(), strict=True)
    return np.concatenate([np.zeros(n) if L is None else assemble_vector(L)[:n] for L, n in given])


class BlockMatrix:
    """The matrix of a bilinear form, or of blocks of them, and the matrices of the blocks.

    A block on the diagonal without a form is zero, but has a diagonal: conditions need it.

    Args:
        forms: Blocks, row by row.
        layout: Dofs of the unknowns.

    Attributes:
        blocks: Matrix of each block, None where there is no form. They keep their memory. Columns are those of
            `Layout.index_maps`.
        whole: The matrix of them all, which is the block if there is but one; it keeps its memory. Rows of the dofs
            that this rank owns, columns of all local ones: shape (num_owned, num_local) of the layout.
    """

    def __init__(self, forms: Sequence[Sequence[Form | None]], layout: Layout):
        self._forms, self._maps = forms, layout.index_maps
        self.blocks = [
            [
                assemble_block(a, columns) if a is not None else _zero(layout, i) if i == j else None
                for (j, a), columns in zip(enumerate(row), self._maps, strict=True)
            ]
            for i, row in enumerate(forms)
        ]
        self.whole, self._places = _whole(self.blocks, layout)
        self._gather()

    def assemble(self) -> None:
        """Assemble all blocks with the present values of coefficients and constants."""
        for forms, matrices in zip(self._forms, self.blocks, strict=True):
            for a, A, columns in zip(forms, matrices, self._maps, strict=True):
                if a is not None and A is not None:
                    refill_block(A, a, columns)
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


def _zero(layout: Layout, i: int) -> sp.csr_array:
    n = layout.spaces[i].num_owned_dofs
    indices, indptr = np.arange(n, dtype=np.int32), np.arange(n + 1, dtype=np.int32)
    return sp.csr_array((np.zeros(n), indices, indptr), shape=(n, layout.places[i].size))


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
    columns = np.concatenate(layout.places)[pattern.indices]
    pattern = sp.csr_array((pattern.data, columns, pattern.indptr), shape=pattern.shape)
    pattern.sort_indices()
    indices, indptr = pattern.indices.astype(np.int32), pattern.indptr.astype(np.int32)
    return sp.csr_array((np.zeros(pattern.nnz), indices, indptr), shape=pattern.shape), pattern.data
