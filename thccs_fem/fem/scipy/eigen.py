"""Eigenvalue problems solved by ARPACK, through SciPy."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse.linalg as spla

import ufl
from thccs_fem.fem.bcs import DirichletBC
from thccs_fem.fem.eigen import EigenSystem
from thccs_fem.fem.forms import Form
from thccs_fem.fem.function import Function
from thccs_fem.fem.scipy.linear import check_serial, factorised, num_negative

__all__ = ["EigenProblem"]

Floats = npt.NDArray[np.float64]


class EigenProblem:
    """Find the numbers lambda and functions u with a(u, v) = lambda m(u, v) for all v, by Lanczos' method.

    The eigenvalues are those nearest to a target, by shift and invert. Where the target is one of them, as zero on a
    closed surface, the shift is moved a little below it.

    None is missing, which Lanczos' method does not see to where eigenvalues are multiple: they are counted, by two
    factorisations more, and searched for again until their number is right. Of the last one, which may be multiple,
    there are as many copies as were asked for.

    Args:
        a: Symmetric bilinear form.
        m: Symmetric positive bilinear form; None: the inner product of L2.
        bcs: Conditions, all with value zero. Their dofs are left out of the problem.
        num_eigenvalues: How many are wanted.
        target: Number that they are nearest to.
        petsc_options_prefix: Ignored. It is here, as the next one, so that the import alone decides who solves.
        petsc_options: Ignored.

    Attributes:
        bcs: The conditions; others may be put in their place before the next `solve`.

    Raises:
        TypeError: A form is no form, or a condition none.
        ValueError: The forms are not bilinear forms on one space, a condition is in another one, or no eigenvalue is
            wanted.
        NotImplementedError: The mesh is on several ranks.
    """

    def __init__(
        self,
        a: ufl.Form | Form,
        m: ufl.Form | Form | None = None,
        *,
        bcs: Sequence[DirichletBC] = (),
        num_eigenvalues: int = 6,
        target: float = 0.0,
        petsc_options_prefix: str = "",
        petsc_options: Mapping[str, Any] | None = None,
    ):
        self._system = EigenSystem(a, m, bcs=bcs, num_eigenvalues=num_eigenvalues, target=target)
        check_serial(self._system.a.spaces[1].mesh.comm, "EigenProblem")
        self.bcs = bcs

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
        system = self._system
        system.bcs = self.bcs
        system.assemble()
        shift, solved = self._inverse()

        def search(number: int, found: Floats, start: Floats) -> tuple[Floats, Floats]:
            def beside(b: Floats) -> Floats:
                x = solved(b)
                return x - found @ (found.T @ (system.M @ x))

            inverse = spla.LinearOperator(system.A.shape, matvec=beside, dtype=np.float64)
            try:
                values, vectors = spla.eigsh(system.A, number, system.M, sigma=shift, OPinv=inverse, v0=beside(start))
            except spla.ArpackNoConvergence as error:
                values, vectors = error.eigenvalues, error.eigenvectors
            return values, vectors

        values, vectors = system.complete(search, lambda s: num_negative(system.shifted(s)))
        return system.accept(values, vectors, "ARPACK")

    def _inverse(self) -> tuple[float, Callable[[Floats], Floats]]:
        """Return a shift and what solves systems with the shifted matrix."""
        system = self._system
        try:
            return system.target, factorised(system.shifted(system.target))
        except RuntimeError:  # singular
            shift = system.shift_beside()
            return shift, factorised(system.shifted(shift))
