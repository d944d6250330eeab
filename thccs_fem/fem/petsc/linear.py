"""Linear problems solved by any KSP of PETSc."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from itertools import pairwise
from typing import Any, Literal

from petsc4py import PETSc

import numpy as np
import numpy.typing as npt

import ufl
from thccs_fem.fem.blocks import BlockMatrix
from thccs_fem.fem.forms import Form
from thccs_fem.fem.function import Function
from thccs_fem.fem.layout import Conditions, Layout
from thccs_fem.fem.linear import (
    Constants,
    LinearSystem,
    check_regular,
    check_residual,
    is_finite,
    is_fourth_order,
    is_symmetric,
    norm,
)
from thccs_fem.fem.petsc.matrices import changed, comm_of, new_block_mat, new_vec, solver_comm
from thccs_fem.fem.petsc.multigrid import has_coarse_level, multigrid
from thccs_fem.fem.petsc.options import Options
from thccs_fem.fem.space import FunctionSpace
from thccs_fem.parallel import rank_of

__all__ = ["LinearProblem", "choose", "failure", "null_space", "operators", "set_fields", "set_levels", "solved"]

Floats = npt.NDArray[np.float64]

# Dofs; more are solved by iteration if nothing is said. MUMPS solves 17 000 in 0.3 s and 265 000 in 11 s, multigrid in
# 0.2 and 4 s. Where that has no levels and algebraic multigrid would take hundreds of iterations, as for fourth order
# (670, 7 s, for 50 000), MUMPS goes on.
LARGEST_DIRECT, LARGEST_DIRECT_FOURTH_ORDER = 50_000, 250_000
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
    If neither says what ``ksp_type`` or ``pc_type`` is, systems with up to 50 000 dofs are factorised (250 000 with
    second derivatives of the arguments and no levels; by MUMPS, if PETSc has it), and larger ones solved by conjugate
    gradients with multigrid on the levels of the space (``pc_type`` "mg", see `multigrid`). Algebraic multigrid is used
    where there are no levels, or several unknowns, and with GMRES where the matrix is not symmetric. ``ksp_rtol`` is
    1e-10 by default.

    With several unknowns, a is a list of rows ``[[a00, a01], [a10, a11]]`` and L a list, None where there is no form;
    or both are forms over a `ufl.MixedFunctionSpace`. The fields of ``pc_type`` "fieldsplit" are then called 0, 1, ...

    Args:
        a: Bilinear form.
        L: Linear form.
        bcs: Conditions; where two prescribe the same dof, the later one holds. With several unknowns they are for that
            in whose space they are; where two are in the same one, give a list of conditions for each unknown.
        u: Function that takes the solution, and has the initial guess if ``ksp_initial_guess_nonzero`` is set or
            `start_from_u` was called, or a list of them; None: new ones.
        load: Vector that is added to the right-hand side, as of point loads, shape (num_dofs,); on several ranks local,
            as `fem.assemble_vector` returns it.
        petsc_options_prefix: What distinguishes the options of this problem, usually with "_" at the end.
        petsc_options: Options without the prefix, as ``{"ksp_type": "cg", "pc_type": "gamg"}``. They hold for this
            problem, and before those on the command line.
        kind: "mpi": one matrix for all unknowns. "nest": a matrix for each block, which ``pc_type`` "fieldsplit" (the
            default then, with GMRES) uses as they are, and which cannot be factorised as a whole.

    Attributes:
        bcs: The conditions; others may be put in their place before the next `solve`.
        load: The vector; likewise.

    Raises:
        TypeError: A form is no form, or a condition none.
        ValueError: The forms have not the arguments of an equation, u or a condition is in another space, or the prefix
            is empty.
    """

    def __init__(
        self,
        a: ufl.Form | Form | Sequence[Sequence[ufl.Form | Form | None]],
        L: ufl.Form | Form | Sequence[ufl.Form | Form | None],
        *,
        bcs: Conditions = (),
        u: Function | Sequence[Function] | None = None,
        load: npt.ArrayLike | None = None,
        petsc_options_prefix: str,
        petsc_options: Mapping[str, Any] | None = None,
        kind: Literal["mpi", "nest"] = "mpi",
    ):
        self._options = Options(petsc_options_prefix, petsc_options)
        self._system = LinearSystem(a, L, bcs=bcs, u=u, load=load)
        self.bcs = bcs
        self.load = load
        self._kind = kind
        self._comm = solver_comm(self._system.layout.spaces[0])
        self._solver = PETSc.KSP().create(self._comm)
        self._solver.setOptionsPrefix(petsc_options_prefix)
        self._solver.setTolerances(rtol=TOLERANCE)
        self._is_ready = False
        self._is_chosen = self._options.have("ksp_type", "pc_type")
        if self._is_chosen:
            with self._options.in_place():
                self._solver.setFromOptions()

    @cached_property
    def A(self) -> PETSc.Mat:
        """The matrix of the last `solve`, or assembled now; rows of prescribed dofs are the identity's."""
        return new_block_mat(self._system.matrix, self._system.layout, self._kind)

    @cached_property
    def b(self) -> PETSc.Vec:
        """The right-hand side of the last `solve`, prescribed values included."""
        return new_vec(self._system.b, self._comm)

    @property
    def u(self) -> Any:
        """The solution: a `Function`, or a list of them."""
        return self._system.u

    @property
    def solver(self) -> PETSc.KSP:
        """The KSP."""
        return self._solver

    def start_from_u(self) -> bool:
        """Let `solve` start from the values of u, as ``ksp_initial_guess_nonzero`` does; return whether it will.

        A direct solver does not look at them. An iterative one is done at the same residual as without, relative to the
        right-hand side: the nearer to the solution the values are, the fewer iterations it takes.
        """
        chosen: Any = self._solver.getType()  # or None, other than the stubs say
        is_large = self._kind == "nest" or self._system.layout.num_dofs > LARGEST_DIRECT
        iterates = is_large if chosen is None else chosen != "preonly"
        self._solver.setInitialGuessNonzero(iterates)
        return iterates

    def solve(self) -> Any:
        """Assemble with the present values of coefficients, constants and conditions, and solve.

        Returns:
            `u`.

        Raises:
            ValueError: The load is not zero on average, where constants are in the kernel, or has another shape.
            RuntimeError: The solver fails; the message has PETSc's reason. The values of u are then those of the last
                iteration.
        """
        system = self._system
        system.bcs, system.load = self.bcs, self.load
        system.assemble()
        changed(self.A)
        self.b.stateIncrease()
        x = system.layout.join(system.unknowns)
        with self._options.in_place():
            if not self._is_ready:
                self._make_ready()
            constants = system.constants
            self._solver.setOperators(*operators(self.A, system.matrix, constants, system.layout, self._solver.getPC()))
            self._solver.solve(self.b, new_vec(x, self._comm))
        system.layout.spread(x, system.unknowns)
        self._check(x)
        self._options.warn_unused(self._comm)
        return system.accept(x)

    def _make_ready(self) -> None:
        """Choose a solver unless the user did so, read options, and say which dofs belong together."""
        spaces = self._system.layout.spaces
        if not self._is_chosen:
            symmetric = is_symmetric(self._system.A, self._system.layout.numbering)
            V = spaces[0] if symmetric and len(spaces) == 1 else None
            choose(self._solver, self.A, symmetric, is_fourth_order(self._system.a), V)
            self._solver.setFromOptions()
        set_fields(self._solver.getPC(), self._system.layout)
        set_levels(self._solver, spaces)
        self._is_ready = True

    def _check(self, x: Floats) -> None:
        """Raise if there is no solution."""
        solver, pc, system = self._solver, self._solver.getPC(), self._system
        reason: Any = solver.getConvergedReason()  # an int, other than the stubs say
        if reason <= 0:
            raise RuntimeError(
                f"{failure(solver)}, for a right-hand side of norm {self.b.norm():.3e}. {help_for(reason)}"
            )
        comm = system.layout.comm
        if factorises(pc):
            check_regular(system.A, lambda r: solved(pc.getFactorMatrix(), r), comm)
        # "Converged by iterations" means that nobody looked.
        if reason == PETSc.KSP.ConvergedReason.CONVERGED_ITS or not is_finite(comm, x):
            check_residual(system.A, system.layout.with_ghosts(x), system.b, name_of(solver), comm)


# ---- What nonlinear problems need as well ----------------------------------------------------------------------------


def choose(
    solver: PETSc.KSP, A: PETSc.Mat, symmetric: bool, fourth_order: bool = False, V: FunctionSpace | None = None
) -> None:
    """Choose a solver for a matrix, unless the user did so in code; V is a space whose levels suit multigrid."""
    pc, size = solver.getPC(), A.getSize()[0]
    if solver.getType() is not None or pc.getType() is not None:
        return
    has_levels = size > LARGEST_DIRECT and V is not None and has_coarse_level(V)
    if A.getType() == "nest":
        solver.setType("gmres")
        pc.setType("fieldsplit")
    elif has_levels:
        solver.setType("cg")
        pc.setType("mg")
    elif size <= (LARGEST_DIRECT_FOURTH_ORDER if fourth_order else LARGEST_DIRECT):
        solver.setType("preonly")
        solver.setInitialGuessNonzero(False)  # or PETSc would refuse it
        pc.setType("cholesky" if symmetric else "lu")
        if PETSc.Sys.hasExternalPackage("mumps"):
            pc.setFactorSolverType("mumps")
    else:
        solver.setType("cg" if symmetric else "gmres")
        pc.setType("gamg")


def factorises(pc: PETSc.PC) -> bool:
    """Return whether a preconditioner is a direct solver."""
    return pc.getType() in ("lu", "cholesky")


def set_fields(pc: PETSc.PC, layout: Layout) -> None:
    """Tell a preconditioner which dofs belong to which of several unknowns."""
    if len(layout.spaces) > 1 and pc.getType() == "fieldsplit":  # other types forget it
        comm, begin = comm_of(layout.spaces[0]), layout.starts[0 if layout.is_whole else rank_of(layout.comm)]
        ends = pairwise((begin + layout.offsets).tolist())
        fields = [PETSc.IS().createStride(end - first, first, comm=comm) for first, end in ends]
        pc.setFieldSplitIS(*((str(i), field) for i, field in enumerate(fields)))


def set_levels(solver: PETSc.KSP, spaces: Sequence[FunctionSpace]) -> None:
    """Give multigrid the levels of the space, where it has none."""
    pc = solver.getPC()
    if len(spaces) == 1 and pc.getType() == "mg" and pc.getMGLevels() <= 1:
        multigrid(solver, spaces[0])


def operators(
    A: PETSc.Mat, matrix: BlockMatrix, constants: Constants | None, layout: Layout, pc: PETSc.PC
) -> tuple[PETSc.Mat, PETSc.Mat]:
    """Return the matrix, and a regular one like it to be factorised where constants are in its kernel.

    A null space that was set from outside, as that of rigid motions, stays.
    """
    if A.getAttr("constants") is not None or not A.getNullSpace().handle:
        A.setNullSpace(null_space(constants, comm_of(layout.spaces[0])))
        A.setTransposeNullSpace(null_space(constants, comm_of(layout.spaces[0])))
        A.setAttr("constants", constants)
    if constants is None or not factorises(pc):
        return A, A
    return A, new_block_mat(constants.pinned(matrix.whole), layout)


def null_space(constants: Constants | None, comm: Any) -> PETSc.NullSpace:
    """Return the null space that constants span."""
    if constants is None:
        return PETSc.NullSpace()  # takes away what was set before
    vectors = [constants.spread(unit) for unit in np.eye(constants.num_constants)]
    return PETSc.NullSpace().create(vectors=[new_vec(v / norm(constants.comm, v), comm) for v in vectors], comm=comm)


def name_of(solver: PETSc.KSP) -> str:
    """Return what messages call a solver."""
    return f"PETSc's {solver.getType()} with the preconditioner {solver.getPC().getType()}"


def failure(solver: PETSc.KSP) -> str:
    """Return why a solver failed."""
    reason: Any = solver.getConvergedReason()  # an int, other than the stubs say
    return (
        f"{name_of(solver)} failed after {solver.getIterationNumber()} iterations: {REASONS.get(reason, reason)}, with "
        f"a residual of norm {solver.getResidualNorm():.3e}"
    )


def help_for(reason: int) -> str:
    """Return advice for a reason of failure."""
    advice = ADVICE.get(REASONS.get(reason, ""), "another solver")
    return f"What may help: {advice}; or solve directly, petsc_options={DIRECT}"


def solved(factors: PETSc.Mat, b: Floats) -> Floats:
    """Return the solution for a right-hand side, from the factors of a matrix."""
    x = np.zeros_like(b)
    factors.solve(new_vec(b, factors.comm), new_vec(x, factors.comm))
    return x
