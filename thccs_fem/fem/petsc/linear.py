"""Linear problems solved by any KSP of PETSc."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cached_property
from typing import Any

from petsc4py import PETSc

import numpy as np
import numpy.typing as npt

import ufl
from thccs_fem.fem.bcs import DirichletBC
from thccs_fem.fem.forms import Form
from thccs_fem.fem.function import Function
from thccs_fem.fem.linear import Constants, LinearSystem, check_regular, check_residual, is_symmetric
from thccs_fem.fem.petsc.matrices import changed, comm_of, new_mat, new_vec

__all__ = ["LinearProblem"]

Floats = npt.NDArray[np.float64]

LARGEST_DIRECT = 50_000  # dofs; more are solved by conjugate gradients if nothing is said
TOLERANCE = 1e-10  # of iterative solvers, if nothing is said; PETSc's own 1e-5 is more than the error of cubics
REASONS = {value: name for name, value in vars(PETSc.KSP.ConvergedReason).items() if name.startswith("DIVERGED")}
ADVICE = {
    "DIVERGED_MAX_IT": "allow more iterations (ksp_max_it) or take a better preconditioner (pc_type)",
    "DIVERGED_INDEFINITE_MAT": "the matrix is not positive definite: use minres or gmres (ksp_type)",
    "DIVERGED_INDEFINITE_PC": "the preconditioner is not positive definite: use gmres (ksp_type), or another pc_type",
    "DIVERGED_PCSETUP_FAILED": "the preconditioner could not be made, as happens when the matrix is singular: see that "
    "Dirichlet conditions fix all that the bilinear form leaves free",
    "DIVERGED_NANORINF": "values are not finite: see that coefficients and data are",
}
DIRECT = {"ksp_type": "preonly", "pc_type": "lu", "pc_factor_mat_solver_type": "mumps"}


class LinearProblem:
    """Find u with a(u, v) = L(v) for all v, and Dirichlet conditions, by a KSP of PETSc.

    Where constants are in the kernel of a, as on a closed surface without conditions, u is the solution with mean zero.

    Options are those in `petsc_options`, and those on the command line (and in PETSc's other sources) with the prefix.
    If neither says what ``ksp_type`` or ``pc_type`` is, systems with up to `LARGEST_DIRECT` dofs are factorised (by
    MUMPS, if PETSc has it), and larger ones solved by conjugate gradients, or GMRES where the matrix is not symmetric,
    with algebraic multigrid. ``ksp_rtol`` is `TOLERANCE` by default.

    Args:
        a: Bilinear form.
        L: Linear form.
        bcs: Conditions; where two prescribe the same dof, the later one holds.
        u: Function that takes the solution, and has the initial guess if ``ksp_initial_guess_nonzero`` is set; None: a
            new one.
        petsc_options_prefix: What distinguishes the options of this problem, usually with "_" at the end.
        petsc_options: Options without the prefix, as ``{"ksp_type": "cg", "pc_type": "gamg"}``. They hold for this
            problem, and before those on the command line.

    Attributes:
        bcs: The conditions; others may be put in their place before the next `solve`.

    Raises:
        TypeError: A form is no form, or a condition none.
        ValueError: The forms have not the arguments of an equation, u or a condition is in another space, or the prefix
            is empty.
    """

    def __init__(
        self,
        a: ufl.Form | Form,
        L: ufl.Form | Form,
        *,
        bcs: Sequence[DirichletBC] = (),
        u: Function | None = None,
        petsc_options_prefix: str,
        petsc_options: Mapping[str, Any] | None = None,
    ):
        if not petsc_options_prefix:
            raise ValueError('petsc_options_prefix is empty: give a name that is the problem\'s own, as "poisson_"')
        self._system = LinearSystem(a, L, bcs=bcs, u=u)
        self.bcs = bcs
        self._options = {name.removeprefix("-"): value for name, value in (petsc_options or {}).items()}
        self._unused = set(self._options)
        self._comm = comm_of(self.u.function_space)
        self._solver = PETSc.KSP().create(self._comm)
        self._solver.setOptionsPrefix(petsc_options_prefix)
        self._solver.setTolerances(rtol=TOLERANCE)
        with self._options_in_place() as options:
            self._is_chosen = options.hasName("ksp_type") or options.hasName("pc_type")
            if self._is_chosen:
                self._solver.setFromOptions()

    @cached_property
    def A(self) -> PETSc.Mat:
        """The matrix of the last `solve`, or assembled now; rows of prescribed dofs are the identity's."""
        return new_mat(self._system.A, self._system.a.spaces)

    @cached_property
    def b(self) -> PETSc.Vec:
        """The right-hand side of the last `solve`, prescribed values included."""
        return new_vec(self._system.b, self._comm)

    @property
    def u(self) -> Function:
        """The solution."""
        return self._system.u

    @property
    def solver(self) -> PETSc.KSP:
        """The KSP."""
        return self._solver

    def solve(self) -> Function:
        """Assemble with the present values of coefficients, constants and conditions, and solve.

        Raises:
            ValueError: The load is not zero on average, where constants are in the kernel.
            RuntimeError: The solver fails; the message has PETSc's reason. The values of u are then those of the last
                iteration.
        """
        self._system.bcs = self.bcs
        self._system.assemble()
        changed(self.A)
        self.b.stateIncrease()
        x = new_vec(self.u.x.array, self._comm)
        with self._options_in_place():
            if not self._is_chosen:
                self._choose()
            self._set_operators()
            self._solver.solve(self.b, x)
        self._check(self.u.x.array)
        if self._unused:
            warnings.warn(f"PETSc made no use of the options {sorted(self._unused)}: are they misspelt?", stacklevel=2)
            self._unused.clear()
        return self._system.accept(self.u.x.array)

    @contextmanager
    def _options_in_place(self) -> Iterator[PETSc.Options]:
        """Put the options into PETSc's database, which keeps them for as long only as they may be read."""
        prefix = self._solver.getOptionsPrefix()
        options = PETSc.Options(prefix)
        for name, value in self._options.items():
            options.setValue(name, value)
        try:
            yield options
        finally:
            for name in self._options:
                if PETSc.Options().used(f"{prefix}{name}"):
                    self._unused.discard(name)
                options.delValue(name)

    def _choose(self) -> None:
        """Choose a solver, unless the user did so in code, and read options."""
        pc = self._solver.getPC()
        if self._solver.getType() is None and pc.getType() is None:
            symmetric = is_symmetric(self._system.A)
            if self._system.b.size <= LARGEST_DIRECT:
                self._solver.setType("preonly")
                pc.setType("cholesky" if symmetric else "lu")
                if PETSc.Sys.hasExternalPackage("mumps"):
                    pc.setFactorSolverType("mumps")
            else:
                self._solver.setType("cg" if symmetric else "gmres")
                pc.setType("gamg")
        self._solver.setFromOptions()
        self._is_chosen = True

    @property
    def _factorises(self) -> bool:
        return self._solver.getPC().getType() in ("lu", "cholesky")

    def _set_operators(self) -> None:
        """Hand over the matrix, and a regular one like it to be factorised where constants are in its kernel."""
        constants, to_factorise = self._system.constants, self.A
        self.A.setNullSpace(_null_space(constants, self._comm))
        self.A.setTransposeNullSpace(_null_space(constants, self._comm))
        if constants is not None and self._factorises:
            to_factorise = new_mat(self._system.regular(), self._system.a.spaces)
        self._solver.setOperators(self.A, to_factorise)

    def _check(self, x: Floats) -> None:
        """Raise if there is no solution."""
        solver, pc = self._solver, self._solver.getPC()
        name = f"PETSc's {solver.getType()} with the preconditioner {pc.getType()}"
        reason: Any = solver.getConvergedReason()  # an int, other than the stubs say
        if reason <= 0:
            why = REASONS.get(reason, str(reason))
            raise RuntimeError(
                f"{name} failed after {solver.getIterationNumber()} iterations: {why}, with a residual of norm "
                f"{solver.getResidualNorm():.3e} for a right-hand side of norm {np.linalg.norm(self._system.b):.3e}. "
                f"What may help: {ADVICE.get(why, 'another solver')}; or solve directly, petsc_options={DIRECT}"
            )
        if self._factorises:
            check_regular(self._system.A, lambda r: _solved(pc.getFactorMatrix(), r))
        # "Converged by iterations" means that nobody looked.
        if reason == PETSc.KSP.ConvergedReason.CONVERGED_ITS or not np.isfinite(x).all():
            check_residual(self._system.A, x, self._system.b, name)


def _null_space(constants: Constants | None, comm: Any) -> PETSc.NullSpace:
    if constants is None:
        return PETSc.NullSpace()  # takes away what was set before
    vectors = [constants.spread(unit) for unit in np.eye(constants.num_constants)]
    return PETSc.NullSpace().create(vectors=[new_vec(v / np.linalg.norm(v), comm) for v in vectors], comm=comm)


def _solved(factors: PETSc.Mat, b: Floats) -> Floats:
    """Return the solution for a right-hand side, from the factors of a matrix."""
    x = np.zeros_like(b)
    factors.solve(new_vec(b, factors.comm), new_vec(x, factors.comm))
    return x
