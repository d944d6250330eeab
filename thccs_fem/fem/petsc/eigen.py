"""Eigenvalue problems solved by any EPS of SLEPc."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from petsc4py import PETSc
from slepc4py import SLEPc

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

import ufl
from thccs_fem.fem.bcs import DirichletBC
from thccs_fem.fem.eigen import EigenSystem
from thccs_fem.fem.forms import Form
from thccs_fem.fem.function import Function
from thccs_fem.fem.linear import check_regular
from thccs_fem.fem.petsc.linear import factorises, solved
from thccs_fem.fem.petsc.matrices import new_vec, sharing, solver_comm
from thccs_fem.fem.petsc.options import Options

__all__ = ["EigenProblem"]

Floats = npt.NDArray[np.float64]

TOLERANCE = 1e-12  # of eigenvalues, relative: eigenfunctions are then right to its root


class EigenProblem:
    """Find the numbers lambda and functions u with a(u, v) = lambda m(u, v) for all v, by an EPS of SLEPc.

    Options are those in `petsc_options`, and those on the command line (and in PETSc's other sources) with the prefix;
    and what is set in code on `solver`. If nothing is said, the eigenvalues are those nearest to a target, by the
    Krylov-Schur method with shift and invert (``st_type`` "sinvert"), factorised by MUMPS if PETSc has it, to
    ``eps_tol`` 1e-12. Where the target is an eigenvalue, as zero on a closed surface, the shift is moved a little below
    it.

    None is missing, which Krylov's methods do not see to where eigenvalues are multiple: they are counted, by two
    factorisations more, and searched for again until their number is right. Of the last one, which may be multiple,
    there are as many copies as were asked for. With other transforms, and other ``eps_which``, nothing is counted.

    Args:
        a: Symmetric bilinear form.
        m: Symmetric positive bilinear form; None: the inner product of L2.
        bcs: Conditions, all with value zero. Their dofs are left out of the problem.
        num_eigenvalues: How many are wanted.
        target: Number that they are nearest to.
        petsc_options_prefix: What distinguishes the options of this problem, usually with "_" at the end.
        petsc_options: Options without the prefix, as ``{"eps_ncv": 40}``. They hold for this problem, and before those
            on the command line.

    Attributes:
        bcs: The conditions; others may be put in their place before the next `solve`.

    Raises:
        TypeError: A form is no form, or a condition none.
        ValueError: The forms are not bilinear forms on one space, a condition is in another one, no eigenvalue is
            wanted, or the prefix is empty.
    """

    def __init__(
        self,
        a: ufl.Form | Form,
        m: ufl.Form | Form | None = None,
        *,
        bcs: Sequence[DirichletBC] = (),
        num_eigenvalues: int = 6,
        target: float = 0.0,
        petsc_options_prefix: str,
        petsc_options: Mapping[str, Any] | None = None,
    ):
        self._options = Options(petsc_options_prefix, petsc_options)
        self._system = EigenSystem(a, m, bcs=bcs, num_eigenvalues=num_eigenvalues, target=target)
        self.bcs = bcs
        self._comm = solver_comm(self._system.a.spaces[0])
        self._solver = SLEPc.EPS().create(self._comm)
        self._solver.setOptionsPrefix(petsc_options_prefix)
        self._solver.setProblemType(SLEPc.EPS.ProblemType.GHEP)
        self._solver.setDimensions(num_eigenvalues)
        self._solver.setTarget(target)
        self._solver.setTolerances(tol=TOLERANCE)
        self._solver.setWhichEigenpairs(SLEPc.EPS.Which.TARGET_MAGNITUDE)
        transform = self._solver.getST()
        transform.setType(SLEPc.ST.Type.SINVERT)
        transform.getKSP().setType("preonly")
        pc = transform.getKSP().getPC()
        pc.setType("cholesky")
        if PETSc.Sys.hasExternalPackage("mumps"):
            pc.setFactorSolverType("mumps")
        with self._options.in_place():
            self._solver.setFromOptions()
        self._system.num_eigenvalues, _, _ = self._solver.getDimensions()
        self._system.target = self._solver.getTarget()

    @property
    def solver(self) -> SLEPc.EPS:
        """The EPS."""
        return self._solver

    def solve(self) -> tuple[Floats, list[Function]]:
        """Assemble with the present values of coefficients, constants and conditions, and solve.

        Returns:
            Eigenvalues in ascending order, shape (num_eigenvalues,), and their functions, m-orthonormal. The first of
            the largest coefficients of each is positive; of functions with one eigenvalue the choice is the solver's.

        Raises:
            ValueError: A matrix is not symmetric, that of m not positive, a prescribed value not zero, or there are not
                as many eigenvalues as wanted.
            RuntimeError: Not all converge, or some are missing.
        """
        system, solver = self._system, self._solver
        system.bcs = self.bcs
        system.assemble()
        A, M = (sharing(matrix, self._comm, system.numbering) for matrix in (system.A, system.M))
        with self._options.in_place():
            solver.reset()  # the size may be another one
            solver.setOperators(A, M)
            solver.getST().setShift(self._shift())
        is_nearest = solver.getWhichEigenpairs() == SLEPc.EPS.Which.TARGET_MAGNITUDE
        count = self._count if is_nearest and self._inverts() else None
        try:
            values, vectors = system.complete(self._search, count, accuracy=solver.getTolerances()[0])
        finally:
            solver.setDimensions(system.num_eigenvalues)
        self._options.warn_unused(self._comm)
        return system.accept(
            values, vectors, f"SLEPc's {solver.getType()}, after {solver.getIterationNumber()} iterations,"
        )

    def _shift(self) -> float:
        """Return a shift at which the shifted matrix can be factorised."""
        system, pc = self._system, self._solver.getST().getKSP().getPC()
        if not self._inverts():
            return system.target
        shifted = system.shifted(system.target)
        trial = self._factorisation(shifted, pc.getType(), pc.getFactorSolverType() or "petsc")
        trial.setOptionsPrefix(pc.getOptionsPrefix())
        try:
            trial.setUp()
            check_regular(shifted, lambda r: solved(trial.getFactorMatrix(), r), system.a.spaces[1].mesh.comm)
        except RuntimeError:  # ours, or PETSc's own, if there are no factors
            return system.shift_beside()
        return system.target

    def _inverts(self) -> bool:
        """Return whether shifted matrices are factorised."""
        transform = self._solver.getST()
        return transform.getType() == SLEPc.ST.Type.SINVERT and factorises(transform.getKSP().getPC())

    def _factorisation(self, A: sp.csr_array, kind: str, solver: str) -> PETSc.PC:
        """Return a direct solver, not set up yet."""
        pc = PETSc.PC().create(self._comm)
        pc.setType(kind)
        pc.setFactorSolverType(solver)
        pc.setOperators(sharing(A, self._comm, self._system.numbering))
        return pc

    def _count(self, number: float) -> int:
        """Return how many eigenvalues there are below a number."""
        solver = "mumps" if PETSc.Sys.hasExternalPackage("mumps") else "petsc"
        pc = self._factorisation(self._system.shifted(number), "cholesky", solver)
        if solver == "mumps":
            pc.setFactorSetUpSolverType()
            pc.getFactorMatrix().setMumpsIcntl(24, 1)  # looks for zero pivots, without which it does not count
        pc.setUp()
        return int(pc.getFactorMatrix().getInertia()[0])

    def _search(self, number: int, found: Floats, start: Floats) -> tuple[Floats, Floats]:
        """Return eigenvalues that converge, and their vectors as columns, m-orthogonal to those that were found."""
        solver = self._solver
        solver.setDimensions(number)
        solver.setDeflationSpace([new_vec(vector, self._comm) for vector in found.T.copy()])
        solver.setInitialSpace([new_vec(start, self._comm)])
        with self._options.in_place():
            solver.solve()
        return self._converged()

    def _converged(self) -> tuple[Floats, Floats]:
        """Return the eigenvalues that converged, and their vectors as columns."""
        solver, n = self._solver, self._system.num_owned
        count = solver.getConverged()
        vectors = np.zeros((count, n))
        values = np.array([solver.getEigenpair(i, new_vec(row, self._comm)) for i, row in enumerate(vectors)])
        return values.real, vectors.T
