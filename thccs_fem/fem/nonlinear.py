"""Systems of nonlinear weak forms, whatever solves them: residuals and Jacobians, with Dirichlet conditions.

With conditions u = g on some dofs the equations are u - g = 0 there, and F = 0 elsewhere. So that the Jacobian stays
symmetric, its columns of prescribed dofs are those of the identity as well, and what they held goes to the residual:
J (g - u) is added, which vanishes as soon as the conditions hold. Newton's step is the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

import ufl
from thccs_fem.fem import blocks
from thccs_fem.fem.blocks import BlockMatrix
from thccs_fem.fem.forms import Form
from thccs_fem.fem.function import Function
from thccs_fem.fem.layout import Conditions, Layout
from thccs_fem.fem.linear import PRESCRIBED, Constants, constrain, drops_constants, norm, unfixed_constants
from thccs_fem.parallel import total
from ufl.algorithms import expand_derivatives

__all__ = ["NonlinearSystem", "failure"]

Floats = npt.NDArray[np.float64]

RELATIVE = 1e-10  # norm of the residual, relative to that of the initial guess
STEP = 1e-10  # norm of the last step, relative to that of the solution: what remains is the square of it
MAX_ITERATIONS = 50
MET = 1e-14  # how far a value may be from the prescribed one, relative to both: rounding of the step towards it
ROUNDING = 1e-12  # norm of a residual that no step can lower, relative to that of |J| |u|


class NonlinearSystem:
    """The equations F(u) = 0 of a weak form, or of several: see the problems of `fem.scipy` for the arguments.

    Attributes:
        residuals: Compiled residuals; None where it is zero.
        jacobians: Compiled Jacobians, row by row; None where it is zero.
        layout: The dofs of all unknowns.
        bcs: Conditions; others may be put in their place before the next `start`.
        unknowns: The unknowns.
        constants: Constants in the kernel of the Jacobian; None if there are none.
    """

    def __init__(
        self,
        F: ufl.Form | Form | Sequence[ufl.Form | Form | None],
        u: Function | Sequence[Function],
        *,
        bcs: Conditions = (),
        J: ufl.Form | Form | Sequence[Sequence[ufl.Form | Form | None]] | None = None,
    ):
        self._is_single = isinstance(u, Function)
        given = [u] if isinstance(u, Function) else list(u)
        for function in given:
            if not isinstance(function, Function):
                raise TypeError(
                    f"u holds a {type(function).__name__}: the unknown is a fem.Function, or a list of them"
                )
        residuals = blocks.columns(F, len(given))
        jacobians = _derivatives(residuals, given) if J is None else blocks.rows(J)
        self.layout = Layout(blocks.spaces_of(jacobians, residuals, names=("J", "F")))
        spaces = self.layout.spaces
        self.unknowns = blocks.unknowns(given, spaces)
        self.residuals = blocks.compiled(residuals, spaces)
        self.jacobians = [blocks.compiled(row, spaces) for row in jacobians]
        self.bcs = bcs
        self.constants: Constants | None = None
        self._drops = drops_constants(self.jacobians, spaces)
        self._dofs, self._values = self.layout.constraints(bcs)
        self._matrix: BlockMatrix | None = None

    @property
    def u(self) -> Any:
        """The unknown, or the list of them."""
        return self.unknowns[0] if self._is_single else self.unknowns

    @property
    def F(self) -> Any:
        """The compiled residual, or the list of them."""
        return self.residuals[0] if self._is_single else self.residuals

    @property
    def J(self) -> Any:
        """The compiled Jacobian, or the rows of them."""
        return self.jacobians[0][0] if self._is_single else self.jacobians

    @property
    def matrix(self) -> BlockMatrix:
        """The Jacobian as last assembled, with its blocks."""
        if self._matrix is None:
            self.jacobian(self.layout.join(self.unknowns))
        assert self._matrix is not None  # jacobian has made it
        return self._matrix

    @property
    def A(self) -> sp.csr_array:
        """The Jacobian as last assembled; it keeps its memory."""
        return self.matrix.whole

    def start(self) -> Floats:
        """Read the conditions, look for constants in the kernel, and return the coefficients of the initial guess.

        Raises:
            ValueError: The residual is not zero on average, where constants are in the kernel of the Jacobian: then no
                step changes that.
        """
        self._dofs, self._values = self.layout.constraints(self.bcs)
        x = self.layout.join(self.unknowns)
        self.constants = None
        if self._drops.any():
            self.jacobian(x)
            tolerance = np.where(self._drops, PRESCRIBED, -1.0)  # a Jacobian that happens to be singular is no reason
            self.constants = unfixed_constants(self.A, self.layout, tolerance, self._dofs)
        if self.constants is not None:
            b = blocks.vector(self.residuals, self.layout)
            if not self.is_rounding(x, b):
                self.constants.check_load(b)
        return x

    def residual(self, x: Floats) -> Floats:
        """Return the residual for coefficients x, which become those of the unknowns; collective."""
        self.layout.spread(x, self.unknowns)
        b = blocks.vector(self.residuals, self.layout)
        present = self.layout.with_ghosts(x)[self._dofs]
        jump = np.zeros(self.layout.num_local)
        jump[self._dofs] = self._values - present
        missed = (np.abs(self._values - present) > MET * (np.abs(self._values) + np.abs(present))).any()
        if total(self.layout.comm, int(missed)):
            # Not in `A`, which may still be in use: solvers may keep a Jacobian for several steps.
            b += BlockMatrix(self.jacobians, self.layout).whole @ jump
        owned = self._dofs[self._dofs < x.size]
        b[owned] = -jump[owned]
        return b if self.constants is None else self.constants.cleared(b)

    def jacobian(self, x: Floats) -> sp.csr_array:
        """Return the Jacobian for coefficients x, which become those of the unknowns; rows of conditions are I's."""
        self.layout.spread(x, self.unknowns)
        if self._matrix is None:
            self._matrix = BlockMatrix(self.jacobians, self.layout)
        else:
            self._matrix.assemble()
        constrain(self._matrix.whole, self._dofs)
        return self._matrix.whole

    def regular(self) -> sp.csr_array:
        """Return the Jacobian, or where constants are in its kernel, a regular matrix that makes the same steps."""
        return self.A if self.constants is None else self.constants.pinned(self.A)

    def is_rounding(self, x: Floats, b: Floats) -> bool:
        """Return whether a residual is as small as rounding lets it be, by the last Jacobian."""
        comm, size = self.layout.comm, np.abs(self.layout.with_ghosts(x))
        return norm(comm, b) <= ROUNDING * norm(comm, abs(self.A) @ size)

    def accept(self, x: Floats) -> Any:
        """Return the unknowns with coefficients x, prescribed values exact, free means zero."""
        x = x.copy() if self.constants is None else self.constants.with_mean_zero(x)
        owned = np.searchsorted(self._dofs, x.size)
        x[self._dofs[:owned]] = self._values[:owned]
        self.layout.spread(x, self.unknowns)
        return self.u


def _derivatives(residuals: Sequence[ufl.Form | Form | None], u: Sequence[Function]) -> list[list[ufl.Form | None]]:
    """Return the derivative of each residual by each unknown; None: zero."""
    forms = [residual.ufl_form if isinstance(residual, Form) else residual for residual in residuals]
    return [[None if F is None else _derivative(F, function, j) for j, function in enumerate(u)] for F in forms]


def _derivative(F: ufl.Form, u: Function, number: int) -> ufl.Form | None:
    if u not in F.coefficients():
        return None
    (test,) = F.arguments() or (None,)
    if test is None:
        raise ValueError("F has no test function: for an energy write F = ufl.derivative(energy, u)")
    # UFL does not mix arguments of a mixed space with others.
    trial = ufl.Argument(u.function_space, 1, None if test.part() is None else number)
    form = expand_derivatives(ufl.derivative(F, u, trial))
    return None if form.empty() else form


def failure(solver: str, iterations: int, why: str, norm: float, first: float) -> str:
    """Return what to say of an iteration that failed, with the norms of its last and its first residual."""
    return (
        f"{solver} failed after {iterations} iterations: {why}. The residual has norm {norm:.3e}, that of the initial "
        f"guess {first:.3e}. What may help: an initial guess nearer to a solution, as that for a smaller load; fixing "
        f"what the equations leave free; and where J was given, that it is the derivative of F"
    )
