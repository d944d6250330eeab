"""Nonlinear problems solved by Newton's method with a line search."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

import ufl
from thccs_fem.fem.forms import Form
from thccs_fem.fem.function import Function
from thccs_fem.fem.layout import Conditions
from thccs_fem.fem.nonlinear import MAX_ITERATIONS, RELATIVE, STEP, NonlinearSystem, failure
from thccs_fem.fem.scipy.linear import check_serial, solve

__all__ = ["NonlinearProblem"]

Floats = npt.NDArray[np.float64]

DECREASE = 1e-4  # of the norm of the residual, relative to that of the linear model: Nocedal and Wright, sec. 3.1
SHORTEST = 1e-6  # step, relative to Newton's


class NonlinearProblem:
    """Find u with F(u; v) = 0 for all v, and Dirichlet conditions, by Newton's method with a line search.

    A step is shortened until the norm r of the residual falls by a part of what the linear model promises, r(t) <=
    (1 - 1e-4 t) r(0) (Armijo's rule, for Newton's direction: Dennis and Schnabel, Numerical Methods for Unconstrained
    Optimization and Nonlinear Equations, 1983, alg. A6.3.1), where t is the minimum of a parabola, but at least a tenth
    and at most half of the one before. It ends when the residual is 1e-10 of that of the initial guess, a step 1e-10 of
    u, or the residual is rounding.

    Where the Jacobian is zero for constants, as on a closed surface without conditions, u has mean zero.

    With several unknowns, F and u are lists, None where F is zero; or F is a form over a `ufl.MixedFunctionSpace`.

    Args:
        F: Residual, a form in a test function and u.
        u: The unknown, or a list of them; it has the initial guess and takes the solution.
        bcs: Conditions; where two prescribe the same dof, the later one holds. The initial guess need not satisfy them.
            With several unknowns they are for that in whose space they are; where two are in the same one, give a list
            of conditions for each unknown.
        J: Jacobian, a bilinear form, or rows of them; None: ``ufl.derivative(F, u)``.
        petsc_options_prefix: Ignored. It is here, as the next ones, so that the import alone decides who solves.
        petsc_options: Ignored.
        kind: Ignored.

    Attributes:
        bcs: The conditions; others may be put in their place before the next `solve`.
        b: The residual at the last iterate, shape (num_dofs,).
        norms: Norms of the residuals of all iterates of the last `solve`.

    Raises:
        TypeError: A form is no form, u is no function, or a condition none.
        ValueError: The forms have not the arguments of an equation, or u or a condition is in another space.
        NotImplementedError: The mesh is on several ranks.
    """

    def __init__(
        self,
        F: ufl.Form | Form | Sequence[ufl.Form | Form | None],
        u: Function | Sequence[Function],
        *,
        bcs: Conditions = (),
        J: ufl.Form | Form | Sequence[Sequence[ufl.Form | Form | None]] | None = None,
        petsc_options_prefix: str = "",
        petsc_options: Mapping[str, Any] | None = None,
        kind: str = "mpi",
    ):
        self._system = NonlinearSystem(F, u, bcs=bcs, J=J)
        check_serial(self._system.layout.comm, "NonlinearProblem")
        self.bcs = bcs
        self.b = np.zeros(self._system.layout.num_owned)
        self.norms: list[float] = []

    @property
    def F(self) -> Any:
        """The compiled residual, or a list of them."""
        return self._system.F

    @property
    def J(self) -> Any:
        """The compiled Jacobian, or rows of them."""
        return self._system.J

    @property
    def A(self) -> sp.csr_array:
        """The Jacobian that was assembled last; rows of prescribed dofs are the identity's."""
        return self._system.A

    @property
    def u(self) -> Any:
        """The solution: a `Function`, or a list of them."""
        return self._system.u

    def solve(self) -> Any:
        """Solve, from the present values of u, with those of coefficients, constants and conditions.

        Returns:
            `u`.

        Raises:
            ValueError: The residual is not zero on average, where the Jacobian is zero for constants.
            RuntimeError: A Jacobian is singular, or the iteration does not converge. The values of u are then those of
                the last iterate.
        """
        system = self._system
        system.bcs = self.bcs
        x = system.start()
        self.b = system.residual(x)
        self.norms = [float(np.linalg.norm(self.b))]
        if not np.isfinite(self.norms[0]):
            raise RuntimeError(self._failure("the residual of the initial guess is not finite"))
        for _ in range(MAX_ITERATIONS):
            if self.norms[-1] <= RELATIVE * self.norms[0]:
                return system.accept(x)
            system.jacobian(x)
            if system.is_rounding(x, self.b):
                return system.accept(x)
            step = solve(system.regular(), self.b)
            t = self._searched(x, step)
            x = x - t * step
            if t * np.linalg.norm(step) <= STEP * np.linalg.norm(x):
                return system.accept(x)
        raise RuntimeError(self._failure(f"there were {MAX_ITERATIONS} iterations"))

    def _searched(self, x: Floats, step: Floats) -> float:
        """Return how far to go along Newton's step; the residual is then that of where it ends."""
        t, before = 1.0, self.norms[-1]
        while True:
            self.b = self._system.residual(x - t * step)
            with np.errstate(over="ignore"):  # too far is no mistake
                norm = float(np.linalg.norm(self.b))
            if norm <= (1.0 - DECREASE * t) * before:
                self.norms.append(norm)
                return t
            # Minimum of the parabola through the squares of both norms, with slope -2 before^2 at the beginning.
            best = before**2 * t**2 / (norm**2 - before**2 * (1.0 - 2.0 * t)) if np.isfinite(norm) else 0.0
            t = min(max(best, 0.1 * t), 0.5 * t)
            if t < SHORTEST:
                self.b = self._system.residual(x)
                raise RuntimeError(self._failure("no step along Newton's direction makes the residual smaller"))

    def _failure(self, why: str) -> str:
        return failure("Newton's method", len(self.norms) - 1, why, self.norms[-1], self.norms[0])
