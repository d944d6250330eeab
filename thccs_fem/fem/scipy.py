"""Linear problems solved by SciPy, on one rank: nothing needs to be installed for it.

Matrices with up to `LARGEST_DIRECT` entries, and all that are not symmetric, are factorised by SuperLU; for larger
ones there are conjugate gradients with Jacobi's preconditioner, which do for second-order problems.
`thccs_fem.fem.petsc` has more to choose from.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
import scipy.sparse.linalg as spla

import ufl
from thccs_fem.fem.bcs import DirichletBC
from thccs_fem.fem.forms import Form
from thccs_fem.fem.function import Function
from thccs_fem.fem.linear import LinearSystem, check_regular, check_residual, is_symmetric

__all__ = ["LinearProblem", "conjugate_gradients", "solve"]

Floats = npt.NDArray[np.float64]

LARGEST_DIRECT = 5_000_000  # 100 000 dofs of a scalar equation: 10 seconds and 1 GB
TOLERANCE = 1e-10  # of conjugate gradients, relative to the right-hand side
MOST_ITERATIONS = 10_000


class LinearProblem:
    """Find u with a(u, v) = L(v) for all v, and Dirichlet conditions.

    Where constants are in the kernel of a, as on a closed surface without conditions, u is the solution with mean zero.

    Args:
        a: Bilinear form.
        L: Linear form.
        bcs: Conditions; where two prescribe the same dof, the later one holds.
        u: Function that takes the solution; None: a new one.
        petsc_options_prefix: Ignored. It is here, as the next one, so that the import alone decides who solves.
        petsc_options: Ignored.

    Attributes:
        bcs: The conditions; others may be put in their place before the next `solve`.

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
        petsc_options_prefix: str = "",
        petsc_options: Mapping[str, Any] | None = None,
    ):
        self._system = LinearSystem(a, L, bcs=bcs, u=u)
        self.bcs = bcs

    @property
    def A(self) -> sp.csr_array:
        """The matrix of the last `solve`, or assembled now; rows of prescribed dofs are the identity's."""
        return self._system.A

    @property
    def b(self) -> Floats:
        """The right-hand side of the last `solve`, prescribed values included, shape (num_dofs,)."""
        return self._system.b

    @property
    def u(self) -> Function:
        """The solution."""
        return self._system.u

    def solve(self) -> Function:
        """Assemble with the present values of coefficients, constants and conditions, and solve.

        Raises:
            ValueError: The load is not zero on average, where constants are in the kernel.
            RuntimeError: The matrix is singular, or the iteration does not converge.
        """
        self._system.bcs = self.bcs
        self._system.assemble()
        return self._system.accept(solve(self._system.regular(), self._system.b))


def solve(A: sp.csr_array, b: Floats) -> Floats:
    """Return the solution of A x = b, for a matrix with the pattern of a symmetric one.

    Args:
        A: Shape (n, n).
        b: Shape (n,).

    Raises:
        RuntimeError: The matrix is singular, or the iteration does not converge.
    """
    if A.nnz > LARGEST_DIRECT and is_symmetric(A):
        return conjugate_gradients(A, b, TOLERANCE)
    return _direct(A, b)


def conjugate_gradients(A: sp.csr_array, b: Floats, tolerance: float) -> Floats:
    """Return the solution of A x = b for a symmetric positive definite matrix, with Jacobi's preconditioner.

    Args:
        A: Shape (n, n).
        b: Shape (n,).
        tolerance: For the norm of the residual, relative to that of b.

    Raises:
        RuntimeError: The matrix is not positive definite, or the iteration does not converge.
    """
    diagonal = A.diagonal()
    if not (diagonal > 0.0).all():
        raise RuntimeError(
            "the matrix is not positive definite, as its diagonal shows, so that conjugate gradients cannot solve the "
            "system: use thccs_fem.fem.petsc with another solver"
        )
    x, info = spla.cg(A, b, rtol=tolerance, maxiter=MOST_ITERATIONS, M=sp.diags_array(1.0 / diagonal))
    if info != 0 or not np.isfinite(x).all():
        residual = np.linalg.norm(b - A @ x) / np.linalg.norm(b)
        raise RuntimeError(
            f"conjugate gradients did not converge in {MOST_ITERATIONS} iterations: the residual is {residual:.1e} of "
            f"the right-hand side, not {tolerance:.0e}. Use thccs_fem.fem.petsc with another solver"
        )
    return np.asarray(x)


def _direct(A: sp.csr_array, b: Floats) -> Floats:
    transposed = sp.csc_array((A.data, A.indices, A.indptr), shape=A.shape)  # no copy
    try:
        factors = spla.splu(
            transposed, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.01, options={"SymmetricMode": True}
        )
    except RuntimeError as error:
        raise RuntimeError(
            f"SuperLU failed ({error}): the matrix is singular. See that Dirichlet conditions fix all that the "
            f"bilinear form leaves free, and that there is an integral over all of the surface"
        ) from error
    check_regular(A, lambda r: factors.solve(r, "T"))
    x: Floats = factors.solve(b, "T")
    check_residual(A, x, b, "SuperLU")
    return x
