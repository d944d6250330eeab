"""Nonlinear problems solved by any SNES of PETSc."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property, partial
from typing import Any, Literal
from weakref import proxy

from petsc4py import PETSc

import numpy as np
import numpy.typing as npt

import ufl
from thccs_fem.fem import nonlinear
from thccs_fem.fem.forms import Form
from thccs_fem.fem.function import Function
from thccs_fem.fem.layout import Conditions
from thccs_fem.fem.linear import check_regular, is_finite, is_fourth_order
from thccs_fem.fem.nonlinear import MAX_ITERATIONS, RELATIVE, STEP, NonlinearSystem
from thccs_fem.fem.petsc import linear
from thccs_fem.fem.petsc.matrices import changed, new_block_mat, new_vec, solver_comm
from thccs_fem.fem.petsc.options import Options

__all__ = ["NonlinearProblem"]

Floats = npt.NDArray[np.float64]

REASONS = {value: name for name, value in vars(PETSc.SNES.ConvergedReason).items() if name.startswith("DIVERGED")}
MEANING = {
    "DIVERGED_LINE_SEARCH": "no step along the direction makes the residual smaller",
    "DIVERGED_MAX_IT": "there were too many iterations (snes_max_it)",
    "DIVERGED_FUNCTION_COUNT": "the residual was asked for too often (snes_max_funcs)",
    "DIVERGED_FUNCTION_NANORINF": "the residual is not finite",
    "DIVERGED_DTOL": "the residual grows",
    "DIVERGED_LOCAL_MIN": "it came to a minimum of the residual that is no zero",
}


class NonlinearProblem:
    """Find u with F(u; v) = 0 for all v, and Dirichlet conditions, by a SNES of PETSc.

    Options are those in `petsc_options`, and those on the command line (and in PETSc's other sources) with the prefix;
    and what is set in code on `solver`. If nothing is said, it is Newton's method with a backtracking line search
    (``snes_type`` "newtonls", ``snes_linesearch_type`` "bt"), which ends when the residual is 1e-10 of that of the
    initial guess (``snes_rtol``), a step 1e-10 of u (``snes_stol``), or a residual that no step can lower is rounding.
    Systems with up to 50 000 dofs are factorised (250 000 with second derivatives of the arguments; by MUMPS, if PETSc
    has it), larger ones solved by GMRES with algebraic multigrid.

    Where the Jacobian is zero for constants, as on a closed surface without conditions, u has mean zero.

    With several unknowns, F and u are lists, None where F is zero; or F is a form over a `ufl.MixedFunctionSpace`.

    Args:
        F: Residual, a form in a test function and u.
        u: The unknown, or a list of them; it has the initial guess and takes the solution.
        bcs: Conditions; where two prescribe the same dof, the later one holds. The initial guess need not satisfy them.
            With several unknowns they are for that in whose space they are; where two are in the same one, give a list
            of conditions for each unknown.
        J: Jacobian, a bilinear form, or rows of them; None: ``ufl.derivative(F, u)``.
        petsc_options_prefix: What distinguishes the options of this problem, usually with "_" at the end.
        petsc_options: Options without the prefix, as ``{"snes_linesearch_type": "cp", "ksp_type": "cg"}``. They hold
            for this problem, and before those on the command line.
        kind: "mpi": one matrix for all unknowns. "nest": a matrix for each block, which ``pc_type`` "fieldsplit" (the
            default then, with GMRES) uses as they are, and which cannot be factorised as a whole.

    Attributes:
        bcs: The conditions; others may be put in their place before the next `solve`.
        norms: Norms of the residuals of all iterates of the last `solve`.

    Raises:
        TypeError: A form is no form, u is no function, or a condition none.
        ValueError: The forms have not the arguments of an equation, u or a condition is in another space, or the prefix
            is empty.
    """

    def __init__(
        self,
        F: ufl.Form | Form | Sequence[ufl.Form | Form | None],
        u: Function | Sequence[Function],
        *,
        bcs: Conditions = (),
        J: ufl.Form | Form | Sequence[Sequence[ufl.Form | Form | None]] | None = None,
        petsc_options_prefix: str,
        petsc_options: Mapping[str, Any] | None = None,
        kind: Literal["mpi", "nest"] = "mpi",
    ):
        self._options = Options(petsc_options_prefix, petsc_options)
        self._system = NonlinearSystem(F, u, bcs=bcs, J=J)
        self.bcs = bcs
        self.norms: list[float] = []
        self._kind = kind
        layout = self._system.layout
        self._comm = solver_comm(layout.spaces[0])
        self._b = np.zeros(layout.num_owned)
        self._solver = PETSc.SNES().create(self._comm)
        self._solver.setOptionsPrefix(petsc_options_prefix)
        self._solver.setTolerances(rtol=RELATIVE, stol=STEP, max_it=MAX_ITERATIONS)
        self._solver.setConvergenceHistory()
        self._solver.getKSP().setTolerances(rtol=linear.TOLERANCE)
        self._is_chosen = self._options.have("ksp_type", "pc_type")
        self._is_ready = False

    @property
    def F(self) -> Any:
        """The compiled residual, or a list of them."""
        return self._system.F

    @property
    def J(self) -> Any:
        """The compiled Jacobian, or rows of them."""
        return self._system.J

    @cached_property
    def A(self) -> PETSc.Mat:
        """The Jacobian that was assembled last; rows of prescribed dofs are the identity's."""
        return new_block_mat(self._system.matrix, self._system.layout, self._kind)

    @cached_property
    def b(self) -> PETSc.Vec:
        """The residual that was assembled last, u - g at dofs prescribed to be g."""
        return new_vec(self._b, self._comm)

    @property
    def u(self) -> Any:
        """The solution: a `Function`, or a list of them."""
        return self._system.u

    @property
    def solver(self) -> PETSc.SNES:
        """The SNES."""
        return self._solver

    def solve(self) -> Any:
        """Solve, from the present values of u, with those of coefficients, constants and conditions.

        Returns:
            `u`.

        Raises:
            ValueError: The residual is not zero on average, where the Jacobian is zero for constants.
            RuntimeError: The solver fails; the message has PETSc's reason. The values of u are then those of the last
                iterate.
        """
        system = self._system
        system.bcs = self.bcs
        x = system.start()
        with self._options.in_place():
            self._set_up()
            self._solver.solve(None, new_vec(x, self._comm))
        self.norms = self._solver.getConvergenceHistory()[0].tolist()
        system.layout.spread(x, system.unknowns)
        self._check(x)
        self._options.warn_unused(self._comm)
        return system.accept(x)

    def _set_up(self) -> None:
        """Read options, choose a linear solver unless the user did so, and hand over matrices."""
        system, ksp = self._system, self._solver.getKSP()
        if not self._is_ready:
            if not self._is_chosen:
                # Not symmetric: what one Jacobian is says nothing about the next.
                linear.choose(ksp, self.A, symmetric=False, fourth_order=is_fourth_order(system.jacobians))
            self._solver.setFromOptions()
            linear.set_fields(ksp.getPC(), system.layout)
            linear.set_levels(ksp, system.layout.spaces)
            self._is_ready = True
        self._solver.setConvergenceHistory(reset=True)
        mats = linear.operators(self.A, system.matrix, system.constants, system.layout, ksp.getPC())
        self._solver.setFunction(partial(_residual, proxy(system)), self.b)
        self._solver.setJacobian(partial(_jacobian, proxy(system)), *mats)

    def _check(self, x: Floats) -> None:
        """Raise if there is no solution."""
        solver = self._solver
        reason: Any = solver.getConvergedReason()  # an int, other than the stubs say
        name = REASONS.get(reason, str(reason))
        if reason > 0 and is_finite(self._system.layout.comm, x):
            return
        if name == "DIVERGED_LINE_SEARCH" and self._system.is_rounding(x, self._system.residual(x)):
            return  # nothing can lower it
        why = MEANING.get(name, name)
        if name == "DIVERGED_LINEAR_SOLVE":
            ksp_reason: Any = solver.getKSP().getConvergedReason()
            why = f"{linear.failure(solver.getKSP())}. {linear.help_for(ksp_reason)}"
        if linear.factorises(solver.getKSP().getPC()):
            why += self._singular()
        first = self.norms[0] if self.norms else np.nan
        raise RuntimeError(
            nonlinear.failure(
                f"PETSc's {solver.getType()}",
                solver.getIterationNumber(),
                f"{name}, {why}",
                solver.getFunctionNorm(),
                first,
            )
        )

    def _singular(self) -> str:
        """Return what to say if the last Jacobian that was factorised is singular, which MUMPS seldom notices."""
        factors = self._solver.getKSP().getPC()
        try:
            solve = partial(linear.solved, factors.getFactorMatrix())
            check_regular(self._system.regular(), solve, self._system.layout.comm)
        except PETSc.Error:  # there are no factors
            return ""
        except RuntimeError as error:
            return f" ({error})"
        return ""


# A SNES must not own its problem, which would then never be freed; nor forms, which Python, when it ends, cannot take
# back from PETSc any more.


def _residual(system: NonlinearSystem, _: PETSc.SNES, x: PETSc.Vec, b: PETSc.Vec) -> None:
    b.array_w[:] = system.residual(np.asarray(x.array_r, dtype=np.float64))


def _jacobian(system: NonlinearSystem, _: PETSc.SNES, x: PETSc.Vec, A: PETSc.Mat, to_factorise: PETSc.Mat) -> None:
    system.jacobian(np.asarray(x.array_r, dtype=np.float64))
    changed(A)
    if to_factorise.handle != A.handle:
        values: Any = to_factorise.getAttr("values")
        values.data[:] = system.regular().data
        changed(to_factorise)
