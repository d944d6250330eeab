"""Linear systems of weak forms, whatever solves them: Dirichlet conditions, and constants that nothing fixes.

Conditions leave the matrix its size and pattern: the rows and columns of prescribed dofs become those of the identity,
so that a symmetric matrix stays symmetric, and what the columns held goes to the right-hand side.

On a closed surface without conditions, and for pure Neumann problems, constants are in the kernel of the matrix. Then
the load must have mean zero, and the solution that has mean zero is wanted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from scipy.sparse import csgraph

import ufl
from thccs_fem.fem.assembly import assemble_matrix, assemble_vector
from thccs_fem.fem.bcs import DirichletBC
from thccs_fem.fem.forms import Form, form
from thccs_fem.fem.function import Function
from thccs_fem.fem.space import FunctionSpace
from thccs_fem.subdivision import Bools, Ints
from ufl.algorithms import apply_algebra_lowering, apply_derivatives

__all__ = [
    "Constants",
    "LinearSystem",
    "check_regular",
    "check_residual",
    "constrain",
    "constraints",
    "drops_constants",
    "is_symmetric",
    "unfixed_constants",
]

Floats = npt.NDArray[np.float64]

SYMMETRIC = 1e-11  # difference of two entries, relative to the largest one
VANISHING = 1e-13  # sum of a row, relative to that of absolute values; second-order forms come to 3e-15
PRESCRIBED = 1e-6  # the same, where but for prescribed values it is zero by the form; fourth-order ones come to 1e-10
INCOMPATIBLE = 1e-6  # mean of a load, relative to that of its absolute value; less is left by quadrature
LARGEST_CONDITION = 1e12  # of a scaled matrix; singular ones come to 1e13 and more, fine fourth-order ones to 1e8


class LinearSystem:
    """The equations A u = b of a weak form.

    Args:
        a: Bilinear form.
        L: Linear form.
        bcs: Conditions on the space of the unknown; where two prescribe the same dof, the later one holds.
        u: The unknown; None: a new function.

    Attributes:
        a: Compiled bilinear form.
        L: Compiled linear form.
        bcs: Conditions; others may be put in their place before the next `assemble`.
        u: The unknown.
        b: Right-hand side, zero before the first `assemble`.
        constants: Constants in the kernel of A, of which b is cleared; None if there are none.

    Raises:
        TypeError: A form is no form, or a condition none.
        ValueError: The forms have not the arguments of an equation, or u or a condition is in another space.
    """

    def __init__(
        self,
        a: ufl.Form | Form,
        L: ufl.Form | Form,
        *,
        bcs: Sequence[DirichletBC] = (),
        u: Function | None = None,
    ):
        self.a, self.L = form(a), form(L)
        V = _unknown_space(self.a, self.L)
        if u is not None and u.function_space != V:
            raise ValueError(
                f"u is in {u.function_space}, but the trial function in {V}: give a fem.Function of that space"
            )
        self.u = Function(V) if u is None else u
        self.bcs = bcs
        self.b = np.zeros(V.num_dofs)
        self.constants: Constants | None = None
        self._drops_constants = drops_constants(self.a)
        self._dofs, self._values = constraints(bcs, V)
        self._A: sp.csr_array | None = None

    @property
    def A(self) -> sp.csr_array:
        """The matrix as last assembled; it keeps its memory."""
        if self._A is None:
            self.assemble()
        assert self._A is not None  # assemble has made it
        return self._A

    def assemble(self) -> None:
        """Assemble A and b with the present values of coefficients, constants and conditions.

        Raises:
            ValueError: A load that is not zero on average, where constants are in the kernel.
        """
        V = self.u.function_space
        self._dofs, self._values = constraints(self.bcs, V)
        if self._A is None:
            self._A = assemble_matrix(self.a)
        else:
            assemble_matrix(self._A, self.a)
        self.b[:] = assemble_vector(self.L)
        if self._dofs.size:
            prescribed = np.zeros(V.num_dofs)
            prescribed[self._dofs] = self._values
            self.b -= self._A @ prescribed
            self.b[self._dofs] = self._values
            constrain(self._A, self._dofs)
        is_fixed = self._dofs.size > 0 and V.block_size == V.mesh.num_components == 1
        self.constants = None if is_fixed else unfixed_constants(self._A, V, self._drops_constants)
        if self.constants is not None:
            self.b[:] = self.constants.cleared(self.b)

    def regular(self) -> sp.csr_array:
        """Return A, or where constants are in its kernel, a regular matrix with the same solution up to constants."""
        return self.A if self.constants is None else self.constants.pinned(self.A)

    def accept(self, x: Floats) -> Function:
        """Return the unknown with the values that solve the equations, prescribed values exact, free means zero."""
        self.u.x.array = x if self.constants is None else self.constants.with_mean_zero(x)
        self.u.x.array[self._dofs] = self._values
        return self.u


def _unknown_space(a: Form, L: Form) -> FunctionSpace:
    if a.rank != 2 or L.rank != 1:
        raise ValueError(
            f"a has {a.rank} arguments and L has {L.rank}: a is the bilinear form, in a trial and a test function, and "
            f"L the linear one, in a test function alone"
        )
    test, trial = a.spaces
    if test != trial or L.spaces[0] != test:
        raise ValueError(
            f"the trial function of a is in {trial}, its test function in {test} and that of L in {L.spaces[0]}: an "
            f"equation needs the same space for all three"
        )
    return trial


# ---- Dirichlet conditions --------------------------------------------------------------------------------------------


def constraints(bcs: Sequence[DirichletBC], V: FunctionSpace) -> tuple[Ints, Floats]:
    """Return the prescribed dofs, ascending, and their values; where two conditions prescribe a dof, the later one's.

    Raises:
        TypeError: If a condition is none of ours.
        ValueError: If a condition is on another space.
    """
    if isinstance(bcs, DirichletBC):
        raise TypeError("bcs is a single condition: give a list, bcs=[bc]")
    for bc in bcs:
        if not isinstance(bc, DirichletBC):
            raise TypeError(f"bcs holds a {type(bc).__name__}: make conditions with fem.dirichletbc(value, dofs, V)")
        if bc.function_space != V:
            raise ValueError(
                f"a condition is on {bc.function_space}, but the unknown is in {V}: make it with "
                f"fem.dirichletbc(value, dofs, V) for that space, with dofs found for it"
            )
    dofs = np.concatenate([np.zeros(0, dtype=np.int32), *(bc.dofs for bc in reversed(bcs))])
    values = np.concatenate([np.zeros(0), *(bc.values for bc in reversed(bcs))])
    dofs, first = np.unique(dofs, return_index=True)
    return dofs, values[first]


def constrain(A: sp.csr_array, dofs: Ints) -> None:
    """Make rows and columns of dofs those of the identity, in place; entries off the diagonal stay as zeros."""
    prescribed = np.zeros(A.shape[0], dtype=bool)
    prescribed[dofs] = True
    rows = np.repeat(np.arange(A.shape[0], dtype=np.int32), np.diff(A.indptr))
    A.data[prescribed[rows] | prescribed[A.indices]] = 0.0
    A.data[prescribed[rows] & (rows == A.indices)] = 1.0


# ---- Constants in the kernel -----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Constants:
    """Functions in the kernel of a matrix that are 1 in one component on one connected part of the surface, and else 0.

    Attributes:
        number: Which of them has coefficient 1 at each dof (at most one has), or -1, shape (num_dofs,).
        integrals: Integral of the function of each dof, shape (num_dofs,).
    """

    number: Ints
    integrals: Floats

    def __post_init__(self) -> None:
        self.number.setflags(write=False)
        self.integrals.setflags(write=False)

    @property
    def num_constants(self) -> int:
        """Number of linearly independent ones."""
        return int(self.number.max()) + 1

    @property
    def areas(self) -> Floats:
        """Area of the part of the surface that each is on, shape (num_constants,)."""
        return self.sums(self.integrals)

    def sums(self, x: Floats) -> Floats:
        """Return the sum of x over the dofs of each, shape (num_constants,)."""
        return np.bincount(self.number + 1, weights=x, minlength=self.num_constants + 1)[1:]

    def spread(self, values: Floats) -> Floats:
        """Return the coefficients of a linear combination, shape (num_dofs,)."""
        return np.append(values, 0.0)[self.number]  # -1 takes the last

    def with_mean_zero(self, x: Floats) -> Floats:
        """Return the coefficients x, shifted so that the function has mean zero."""
        return x - self.spread(self.sums(x * self.integrals) / self.areas)

    def cleared(self, b: Floats) -> Floats:
        """Return a load without the small mean that quadrature leaves.

        Raises:
            ValueError: If the mean is not small.
        """
        totals = self.sums(b)
        means = totals / self.areas
        if (np.abs(totals) > INCOMPATIBLE * self.sums(np.abs(b))).any():
            listed = ", ".join(repr(float(mean)) for mean in means)
            several = (
                "" if means.size == 1 else " (on each connected part of the surface, of each component not prescribed)"
            )
            raise ValueError(
                f"there is no solution: constants are in the kernel of the bilinear form, as on a closed surface "
                f"without Dirichlet conditions, but the mean of the load is {listed}{several} instead of zero. "
                f"Subtract it from the load, or prescribe values somewhere"
            )
        return b - self.integrals * self.spread(means)

    def pinned(self, A: sp.csr_array) -> sp.csr_array:
        """Return A plus a positive multiple of the square of one coefficient of each constant, with A's pattern.

        For a load without mean it has the solution of A that vanishes at these dofs.
        """
        _, first = np.unique(self.number, return_index=True)
        pins = first[-self.num_constants :]
        data = A.data.copy()
        rows = np.repeat(np.arange(A.shape[0], dtype=np.int32), np.diff(A.indptr))
        diagonal = np.flatnonzero((rows == A.indices) & np.isin(rows, pins))
        data[diagonal] *= 2.0
        return sp.csr_array((data, A.indices, A.indptr), shape=A.shape)


def drops_constants(a: Form) -> Bools:
    """Return for each component whether a bilinear form is zero for constants, on both sides, by its symbols alone.

    Rounding cannot hide that, other than in the matrix: fourth-order forms have entries of any size.
    """
    lowered = apply_derivatives.apply_derivatives(apply_algebra_lowering.apply_algebra_lowering(a.ufl_form))
    k = a.spaces[1].block_size
    constants = [ufl.as_vector(unit.tolist()) for unit in np.eye(k)] if a.spaces[1].value_shape else [ufl.as_ufl(1.0)]
    zero = [[ufl.replace(lowered, {u: c}).empty() for u in lowered.arguments()] for c in constants]
    return np.array(zero).all(axis=1)


def unfixed_constants(A: sp.csr_array, V: FunctionSpace, dropped: Bools) -> Constants | None:
    """Return the constants in the kernel of a matrix, and of its transpose; None if there are none.

    Args:
        A: A matrix on V, with conditions.
        V: The space.
        dropped: What `drops_constants` says of the form.
    """
    k = V.block_size
    ones = np.tile(np.eye(k), (V.num_functions, 1))
    tolerance = np.where(dropped, PRESCRIBED, VANISHING)
    vanishing = _vanishing(A, ones, tolerance) & _vanishing(A.T, ones, tolerance)
    if not vanishing.any(axis=0).any():
        return None
    part = np.zeros(V.num_functions, dtype=np.int32)
    if V.mesh.num_components > 1:
        _, part_of_dofs = csgraph.connected_components(A, directed=False)  # stored zeros connect as well
        part = part_of_dofs[::k]
    defects = np.zeros((int(part.max()) + 1, k), dtype=np.int64)
    np.add.at(defects, np.repeat(part, k), ~vanishing)
    free = defects == 0
    if not free.any():
        return None
    number = np.where(free, np.cumsum(free).reshape(free.shape) - 1, -1).astype(np.int32)
    return Constants(number[part].ravel(), _integrals(V))


def _vanishing(A: Any, ones: Floats, tolerance: Floats) -> Bools:
    """Return where A @ ones is but rounding."""
    return np.abs(A @ ones) <= tolerance * (abs(A) @ np.ones(A.shape[1]))[:, None]


def _integrals(V: FunctionSpace) -> Floats:
    scalar = FunctionSpace(V.hierarchy)
    return np.repeat(assemble_vector(form(ufl.TestFunction(scalar) * ufl.dx)), V.block_size)


# ---- Has it worked? --------------------------------------------------------------------------------------------------


def is_symmetric(A: sp.csr_array) -> bool:
    """Return whether a matrix is symmetric up to rounding."""
    return bool(abs(A - A.T).max() <= SYMMETRIC * abs(A).max())


def check_regular(A: sp.csr_array, solve: Callable[[Floats], Floats]) -> None:
    """Raise if a factorised matrix is singular to working precision, which factorisations seldom notice.

    Solved for a random right-hand side, a singular matrix shows: the solution is as large as rounding lets it.

    Args:
        A: The matrix.
        solve: What its factors make of a right-hand side.

    Raises:
        RuntimeError: It is.
    """
    scale = np.sqrt(np.abs(A.diagonal()))
    scale[scale == 0.0] = 1.0
    r = np.random.default_rng(0).standard_normal(scale.size)
    condition = np.sqrt(scale.size) * np.linalg.norm(scale * solve(scale * r)) / np.linalg.norm(r)
    if not condition < LARGEST_CONDITION:  # nor is it NaN
        raise RuntimeError(
            f"the matrix is singular to working precision (condition number about {condition:.0e}), so that there is "
            f"no solution, or many. See that Dirichlet conditions fix all that the bilinear form leaves free (rigid "
            f"motions, regions without an integral), and that no coefficient is zero or an eigenvalue"
        )


def check_residual(A: sp.csr_array, x: Floats, b: Floats, solver: str) -> None:
    """Raise if x does not solve A x = b as it should when nothing was iterated.

    Raises:
        RuntimeError: It is not finite, or its residual is neither small against b nor rounding.
    """
    if not np.isfinite(x).all():
        raise RuntimeError(
            f"{solver} gave values that are not finite: see that coefficients and data are, and are not too big"
        )
    residual, load = np.linalg.norm(b - A @ x), np.linalg.norm(b)
    if residual > max(1e-6 * load, 1e-12 * np.linalg.norm(abs(A) @ np.abs(x))):
        raise RuntimeError(
            f"{solver} gave values that leave a residual of norm {residual:.3e}, for a right-hand side of norm "
            f"{load:.3e}: the matrix is too badly conditioned, or this solver does not solve systems by itself"
        )
