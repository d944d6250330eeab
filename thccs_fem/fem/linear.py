"""Linear systems of weak forms, whatever solves them: Dirichlet conditions, and constants that nothing fixes.

Conditions leave the matrix its size and pattern: the rows and columns of prescribed dofs become those of the identity,
so that a symmetric matrix stays symmetric, and what the columns held goes to the right-hand side.

On a closed surface without conditions, and for pure Neumann problems, constants are in the kernel of the matrix. Then
the load must have mean zero, and the solution that has mean zero is wanted.

On several ranks vectors have the dofs that a rank owns, and sums go over all ranks: see `layout`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

import ufl
from thccs_fem.fem import blocks
from thccs_fem.fem.assembly import integrals
from thccs_fem.fem.blocks import BlockMatrix
from thccs_fem.fem.checks import lowered
from thccs_fem.fem.entries import Numbering, at_owners
from thccs_fem.fem.forms import Form
from thccs_fem.fem.function import Function
from thccs_fem.fem.layout import Conditions, Layout, constraints
from thccs_fem.fem.space import FunctionSpace
from thccs_fem.parallel import gathered, largest, rank_of, smallest, together, total
from thccs_fem.sparse import absolute_sums
from thccs_fem.subdivision import Bools, Ints

__all__ = [
    "Constants",
    "LinearSystem",
    "check_regular",
    "check_residual",
    "constrain",
    "constraints",
    "drops_constants",
    "is_finite",
    "is_fourth_order",
    "is_symmetric",
    "norm",
    "unfixed_constants",
]

Floats = npt.NDArray[np.float64]

SYMMETRIC = 1e-11  # difference of two entries, relative to the largest one
VANISHING = 1e-13  # sum of a row, relative to that of absolute values; second-order forms come to 3e-15
PRESCRIBED = 1e-6  # the same, where but for prescribed values it is zero by the form; fourth-order ones come to 1e-10
INCOMPATIBLE = 1e-6  # mean of a load, relative to that of its absolute value; less is left by quadrature
ROUNDING = 1e-12  # the same, relative to all components: one may be but rounding of the others
LARGEST_CONDITION = 1e11  # of a scaled matrix; singular ones come to 5e11 and more, fine fourth-order ones to 1e8


class LinearSystem:
    """The equations A u = b of a weak form, or of several: see the problems of `fem.scipy` for the arguments.

    Attributes:
        a: Compiled bilinear forms, row by row.
        L: Compiled linear forms; None where it is zero.
        layout: The dofs of all unknowns.
        bcs: Conditions; others may be put in their place before the next `assemble`.
        unknowns: The unknowns.
        load: What is added to b; None: nothing.
        b: Right-hand side, zero before the first `assemble`, shape (layout.num_owned,).
        constants: Constants in the kernel of A, of which b is cleared; None if there are none.
    """

    def __init__(
        self,
        a: ufl.Form | Form | Sequence[Sequence[ufl.Form | Form | None]],
        L: ufl.Form | Form | Sequence[ufl.Form | Form | None],
        *,
        bcs: Conditions = (),
        u: Function | Sequence[Function] | None = None,
        load: npt.ArrayLike | None = None,
    ):
        bilinear = blocks.rows(a)
        linear = blocks.columns(L, len(bilinear))
        self.layout = Layout(blocks.spaces_of(bilinear, linear))
        spaces = self.layout.spaces
        self.a = [blocks.compiled(row, spaces) for row in bilinear]
        self.L = blocks.compiled(linear, spaces)
        self.unknowns = blocks.unknowns(u, spaces)
        self._is_single = len(spaces) == 1 and not isinstance(a if u is None else u, list | tuple)
        self.bcs = bcs
        self.load = load
        self.b = np.zeros(self.layout.num_owned)
        self.constants: Constants | None = None
        self._tolerance = np.where(drops_constants(self.a, spaces), PRESCRIBED, VANISHING)
        self._dofs, self._values = self.layout.constraints(bcs)
        self._matrix: BlockMatrix | None = None

    @property
    def u(self) -> Any:
        """The unknown, or the list of them."""
        return self.unknowns[0] if self._is_single else self.unknowns

    @property
    def matrix(self) -> BlockMatrix:
        """The matrix as last assembled, with its blocks."""
        if self._matrix is None:
            self.assemble()
        assert self._matrix is not None  # assemble has made it
        return self._matrix

    @property
    def A(self) -> sp.csr_array:
        """The matrix as last assembled; it keeps its memory."""
        return self.matrix.whole

    def assemble(self) -> None:
        """Assemble A and b with the present values of coefficients, constants, conditions and load; collective.

        Raises:
            ValueError: A load that is not zero on average, where constants are in the kernel, or of another shape.
        """
        self._dofs, self._values = self.layout.constraints(self.bcs)
        if self._matrix is None:
            self._matrix = BlockMatrix(self.a, self.layout)
        else:
            self._matrix.assemble()
        A = self._matrix.whole
        self.b[:] = blocks.vector(self.L, self.layout) + together(self.layout.comm, self._checked_load)
        if self._dofs.size:
            prescribed = np.zeros(self.layout.num_local)
            prescribed[self._dofs] = self._values
            self.b -= A @ prescribed
            self._prescribe(self.b)
            constrain(A, self._dofs)
        self.constants = unfixed_constants(A, self.layout, self._tolerance, self._dofs)
        if self.constants is not None:
            self.constants.check_load(self.b)
            self.b[:] = self.constants.cleared(self.b)

    def regular(self) -> sp.csr_array:
        """Return A, or where constants are in its kernel, a regular matrix with the same solution up to constants."""
        return self.A if self.constants is None else self.constants.pinned(self.A)

    def accept(self, x: Floats) -> Any:
        """Return the unknowns with the values that solve the equations, prescribed values exact, free means zero."""
        x = x.copy() if self.constants is None else self.constants.with_mean_zero(x)
        self._prescribe(x)
        self.layout.spread(x, self.unknowns)
        return self.u

    def _prescribe(self, x: Floats) -> None:
        """Put prescribed values in their place in a vector."""
        owned = np.searchsorted(self._dofs, x.size)
        x[self._dofs[:owned]] = self._values[:owned]

    def _checked_load(self) -> Floats | float:
        """Return what is added to b of the dofs that this rank owns."""
        if self.load is None:
            return 0.0
        sizes = [V.num_local_dofs for V in self.layout.spaces]
        load, n = np.asarray(self.load, dtype=np.float64), sum(sizes)
        if load.shape != (n,):
            where = "" if self.layout.is_whole else " on this rank, ghosts included"
            raise ValueError(f"load has shape {load.shape}, but there are {n} dofs{where}: give ({n},)")
        parts = zip(np.split(load, np.cumsum(sizes)[:-1]), self.layout.spaces, strict=True)
        return np.concatenate([part[: V.num_owned_dofs] for part, V in parts])


# ---- Dirichlet conditions --------------------------------------------------------------------------------------------


def constrain(A: sp.csr_array, dofs: Ints, *, columns: bool = True) -> None:
    """Make rows of dofs those of the identity, and columns too, in place; entries off the diagonal stay as zeros.

    Args:
        A: The matrix, with a row for each dof that this rank owns, and columns for ghosts as well.
        dofs: Local dofs, ghosts included.
        columns: Whether columns are changed too.
    """
    prescribed = np.zeros(A.shape[1], dtype=bool)
    prescribed[dofs] = True
    rows = np.repeat(np.arange(A.shape[0], dtype=np.int32), np.diff(A.indptr))
    A.data[prescribed[rows] | (columns & prescribed[A.indices])] = 0.0
    A.data[prescribed[rows] & (rows == A.indices)] = 1.0


# ---- Constants in the kernel -----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Constants:
    """Functions in the kernel of a matrix that are 1 in one component on one connected part of the surface, and else 0.

    Attributes:
        number: Which of them has coefficient 1 at each dof (at most one has), or -1, shape (owned dofs,).
        integrals: Integral of the function of each dof, shape (owned dofs,).
        load: Which load each dof is loaded by, one for all components of an unknown on one connected part of the
            surface, which have one unit; -1 where it is prescribed. Shape (owned dofs,).
        loads: Which load each constant belongs to, shape (num_constants,), the same on all ranks.
        comm: Communicator, or None. Sums go over all its ranks.
    """

    number: Ints
    integrals: Floats
    load: Ints
    loads: Ints
    comm: Any = None

    def __post_init__(self) -> None:
        for array in (self.number, self.integrals, self.load, self.loads):
            array.setflags(write=False)

    @property
    def num_constants(self) -> int:
        """Number of linearly independent ones."""
        return self.loads.size

    @property
    def areas(self) -> Floats:
        """Area of the part of the surface that each is on, shape (num_constants,)."""
        return self.sums(self.integrals)

    def sums(self, x: Floats) -> Floats:
        """Return the sum of x over the dofs of each, shape (num_constants,)."""
        return total(self.comm, np.bincount(self.number + 1, weights=x, minlength=self.num_constants + 1)[1:])

    def spread(self, values: Floats) -> Floats:
        """Return the coefficients of a linear combination, shape (owned dofs,)."""
        return np.append(values, 0.0)[self.number]  # -1 takes the last

    def with_mean_zero(self, x: Floats) -> Floats:
        """Return the coefficients x, shifted so that the function has mean zero."""
        return x - self.spread(self.sums(x * self.integrals) / self.areas)

    def cleared(self, b: Floats) -> Floats:
        """Return a load without its mean."""
        return b - self.integrals * self.spread(self.sums(b) / self.areas)

    def check_load(self, b: Floats) -> None:
        """Raise if the mean of a load is more than what quadrature leaves, and rounding in other components.

        Raises:
            ValueError: It is.
        """
        totals = self.sums(b)
        means = totals / self.areas
        num_loads = int(self.loads.max()) + 1
        of_loads = np.bincount(self.load + 1, weights=np.abs(b), minlength=num_loads + 1)
        of_all = total(self.comm, of_loads[1 : num_loads + 1])[self.loads]
        if (np.abs(totals) > INCOMPATIBLE * self.sums(np.abs(b)) + ROUNDING * of_all).any():
            listed = ", ".join(repr(float(mean)) for mean in means)
            several = (
                "" if means.size == 1 else " (on each connected part of the surface, of each component not prescribed)"
            )
            raise ValueError(
                f"there is no solution: constants are in the kernel of the bilinear form, as on a closed surface "
                f"without Dirichlet conditions, but the mean of the load is {listed}{several} instead of zero. "
                f"Subtract it from the load, or prescribe values somewhere"
            )

    def pinned(self, A: sp.csr_array) -> sp.csr_array:
        """Return A plus a positive multiple of the square of one coefficient of each constant, with A's pattern.

        For a load without mean it has the solution of A that vanishes at these dofs.
        """
        pins = self._pins()
        data = A.data.copy()
        rows = np.repeat(np.arange(A.shape[0], dtype=np.int32), np.diff(A.indptr))
        diagonal = np.flatnonzero((rows == A.indices) & np.isin(rows, pins))
        data[diagonal] *= 2.0
        return sp.csr_array((data, A.indices, A.indptr), shape=A.shape)

    def _pins(self) -> Ints:
        """Return the first dof of each constant, where this rank is the first that has one."""
        found, first = np.unique(self.number, return_index=True)
        has = np.zeros(self.num_constants, dtype=bool)
        has[found[found >= 0]] = True
        mine = np.argmax(gathered(self.comm, has[None]), axis=0) == rank_of(self.comm)
        return first[found >= 0][mine[found[found >= 0]]].astype(np.int32)


def drops_constants(a: Sequence[Sequence[Form | None]], spaces: Sequence[FunctionSpace]) -> Bools:
    """Return for each component whether bilinear forms are zero for constants, on both sides, by their symbols alone.

    Rounding cannot hide that, other than in the matrix: fourth-order forms have entries of any size.

    Args:
        a: Blocks, row by row.
        spaces: Spaces of the unknowns.

    Returns:
        Shape (components of all unknowns,).
    """
    found = []
    for i, V in enumerate(spaces):
        tests = [_drops(block, 0) for block in a[i] if block is not None]
        trials = [_drops(block, 1) for block in (row[i] for row in a) if block is not None]
        found.append(np.all([np.ones(V.block_size, dtype=bool), *tests, *trials], axis=0))
    return np.concatenate(found)


_dropped: dict[tuple[str, int], Bools] = {}


def _drops(a: Form, number: int) -> Bools:
    """Return for each component of one argument whether the form is zero where it is constant.

    That is a matter of symbols, and kept by the compiled module, of which there is one for all forms of a signature.
    """
    key = a.module.__name__, number
    if key not in _dropped:
        _dropped[key] = _found_to_drop(a, number)
    return _dropped[key]


def _found_to_drop(a: Form, number: int) -> Bools:
    form = lowered(a.ufl_form)
    V = a.spaces[number]
    constants = [ufl.as_vector(unit.tolist()) for unit in np.eye(V.block_size)] if V.value_shape else [ufl.as_ufl(1.0)]
    return np.array([ufl.replace(form, {a.ufl_form.arguments()[number]: c}).empty() for c in constants])


def unfixed_constants(A: sp.csr_array, layout: Layout, tolerance: Floats, dofs: Ints | None = None) -> Constants | None:
    """Return the constants in the kernel of a matrix, and of its transpose; None if there are none.

    Args:
        A: The matrix, with conditions.
        layout: Its dofs.
        tolerance: For each component what is zero: sums of rows, relative to sums of absolute values.
        dofs: Prescribed dofs.
    """
    component, k = layout.component, tolerance.size
    is_connected = all(V.mesh.num_components == 1 for V in layout.spaces)
    if k == 1 and is_connected and dofs is not None and total(layout.comm, dofs.size):
        return None
    ones = (component[:, None] == np.arange(k)).astype(np.float64)
    n = layout.num_owned
    of_rows, of_columns = absolute_sums(A)
    size = np.stack([of_rows, layout.without_ghosts(of_columns)], axis=1)
    component = component[:n]
    vanishing = np.abs(A @ ones) <= tolerance * size[:, :1]
    vanishing &= np.abs(layout.without_ghosts(A.T @ ones[:n])) <= tolerance * size[:, 1:]
    if not total(layout.comm, vanishing.any(axis=0).astype(int)).any():
        return None
    part = _parts(layout)
    defects, members = np.zeros((2, layout.spaces[0].mesh.num_components, k), dtype=np.int64)
    np.add.at(defects, part, ~vanishing)
    np.add.at(members, (part, component), 1)
    free = (total(layout.comm, members) > 0) & (total(layout.comm, defects) == 0)
    if not free.any():
        return None
    number = np.where(free, np.cumsum(free).reshape(free.shape) - 1, -1).astype(np.int32)
    unknown_of = np.repeat(np.arange(len(layout.spaces), dtype=np.int32), [V.block_size for V in layout.spaces])
    load_of = unknown_of + len(layout.spaces) * np.arange(free.shape[0], dtype=np.int32)[:, None]
    load = load_of[part, component]
    load[[] if dofs is None else dofs[dofs < n]] = -1
    each = [np.repeat(integrals(FunctionSpace(V.hierarchy)), V.block_size)[: V.num_owned_dofs] for V in layout.spaces]
    return Constants(number[part, component], np.concatenate(each), load, load_of[free], layout.comm)


def _parts(layout: Layout) -> Ints:
    """Return the connected part of the surface that each owned dof is on, shape (num_owned,)."""
    found = []
    for V in layout.spaces:
        mesh, cells = V.mesh, V.cells
        part = np.zeros(cells.num_dofs + 1, dtype=np.int32)
        if mesh.num_components > 1:
            of_faces = mesh.vertex_components[mesh.face_vertices[mesh.face_offsets[:-1]]]
            for batch in cells.batches:  # -1, where there is no dof, is the last
                part[batch.dofs] = of_faces[cells.face[batch.cells], None]
        found.append(np.repeat(part[: V.index_map.size_local], V.block_size))
    return np.concatenate(found)


# ---- Has it worked? --------------------------------------------------------------------------------------------------


def is_symmetric(A: sp.csr_array, numbering: Numbering | None = None) -> bool:
    """Return whether a matrix is symmetric up to rounding; collective.

    Args:
        A: The matrix.
        numbering: Its dofs; None in serial.
    """
    if numbering is None:
        return bool(abs(A - A.T).max() <= SYMMETRIC * abs(A).max())
    n = A.shape[0]
    own, others = A[:, :n], A[:, n:]
    difference = max(_largest(own - own.T), _largest(others - _transposed(others, numbering)))
    return largest(numbering.comm, difference) <= SYMMETRIC * largest(numbering.comm, _largest(A))


def _largest(A: sp.csr_array) -> float:
    return float(np.abs(A.data).max(initial=0.0))


def _transposed(A: sp.csr_array, numbering: Numbering) -> sp.csr_array:
    """Return what other ranks have in the columns of this rank's dofs, as A has what this one has in theirs."""
    own, ghosts = np.split(numbering.numbers, [A.shape[0]])
    entries = A.tocoo()
    rows, columns = ghosts[entries.col], own[entries.row]
    rows, columns, values = at_owners(numbering.comm, numbering.starts, rows, columns, np.asarray(entries.data))
    # Patterns are symmetric: all are there.
    places = np.searchsorted(own, rows), np.searchsorted(ghosts, columns)
    return sp.csr_array((values, places), shape=A.shape)


def norm(comm: Any, x: Floats) -> float:
    """Return the norm of a vector of which each rank has its part."""
    return float(np.sqrt(total(comm, float(np.linalg.norm(x)) ** 2)))


def is_finite(comm: Any, x: Floats) -> bool:
    """Return whether all values are, on all ranks."""
    return smallest(comm, float(np.isfinite(x).all())) > 0.0


def is_fourth_order(a: Sequence[Sequence[Form | None]]) -> bool:
    """Return whether a bilinear form has second derivatives of its arguments."""
    return any(max(block.orders) > 1 for row in a for block in row if block)


def check_regular(A: sp.csr_array, solve: Callable[[Floats], Floats], comm: Any = None) -> None:
    """Raise if a factorised matrix is singular to working precision, which factorisations seldom notice.

    Solved for a random right-hand side, a singular matrix shows: the solution is as large as rounding lets it.

    Args:
        A: The matrix.
        solve: What its factors make of a right-hand side.
        comm: Communicator, or None; each rank has its rows.

    Raises:
        RuntimeError: It is.
    """
    scale = np.sqrt(np.abs(A.diagonal()))
    scale[scale == 0.0] = 1.0
    r = np.random.default_rng(rank_of(comm)).standard_normal(scale.size)
    size = total(comm, scale.size)
    condition = np.sqrt(size) * norm(comm, scale * solve(scale * r)) / norm(comm, r)
    if not condition < LARGEST_CONDITION:  # nor is it NaN
        raise RuntimeError(
            f"the matrix is singular to working precision (condition number about {condition:.0e}), so that there is "
            f"no solution, or many. See that Dirichlet conditions fix all that the bilinear form leaves free (rigid "
            f"motions, regions without an integral), and that no coefficient is zero or an eigenvalue"
        )


def check_residual(A: sp.csr_array, x: Floats, b: Floats, solver: str, comm: Any = None) -> None:
    """Raise if x does not solve A x = b as it should when nothing was iterated.

    Args:
        A: The matrix.
        x: The solution, with ghosts.
        b: The right-hand side.
        solver: Who found it.
        comm: Communicator, or None; each rank has its rows.

    Raises:
        RuntimeError: It is not finite, or its residual is neither small against b nor rounding.
    """
    if not is_finite(comm, x):
        raise RuntimeError(
            f"{solver} gave values that are not finite: see that coefficients and data are, and are not too big"
        )
    residual, load = norm(comm, b - A @ x), norm(comm, b)
    if residual > max(1e-6 * load, 1e-12 * norm(comm, abs(A) @ np.abs(x))):
        raise RuntimeError(
            f"{solver} gave values that leave a residual of norm {residual:.3e}, for a right-hand side of norm "
            f"{load:.3e}: the matrix is too badly conditioned, or this solver does not solve systems by itself"
        )
