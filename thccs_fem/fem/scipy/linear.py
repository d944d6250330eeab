"""Linear problems solved by SciPy.

Matrices with up to `LARGEST_DIRECT` entries, and all that are not symmetric, are factorised by SuperLU; for larger
ones there are conjugate gradients with Jacobi's preconditioner, which do for second-order problems.
`thccs_fem.fem.petsc` has more to choose from, and works on several ranks.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
import scipy.sparse.linalg as spla

import ufl
from thccs_fem.fem.forms import Form
from thccs_fem.fem.function import Function
from thccs_fem.fem.layout import Conditions
from thccs_fem.fem.linear import LinearSystem, check_regular, check_residual, is_symmetric
from thccs_fem.parallel import size_of

__all__ = ["LinearProblem", "check_serial", "conjugate_gradients", "factorised", "num_negative", "solve", "solver"]

Floats = npt.NDArray[np.float64]

LARGEST_DIRECT = 5_000_000  # 100 000 dofs of a scalar equation: 10 seconds and 1 GB
TOLERANCE = 1e-10  # of conjugate gradients, relative to the right-hand side
MOST_ITERATIONS = 10_000


class LinearProblem:
    """Find u with a(u, v) = L(v) for all v, and Dirichlet conditions.

    Where constants are in the kernel of a, as on a closed surface without conditions, u is the solution with mean zero.

    With several unknowns, a is a list of rows ``[[a00, a01], [a10, a11]]`` and L a list, None where there is no form;
    or both are forms over a `ufl.MixedFunctionSpace`.

    Args:
        a: Bilinear form.
        L: Linear form.
        bcs: Conditions; where two prescribe the same dof, the later one holds. With several unknowns they are for that
            in whose space they are; where two are in the same one, give a list of conditions for each unknown.
        u: Function that takes the solution, or a list of them; None: new ones.
        load: Vector that is added to the right-hand side, as of point loads, shape (num_dofs,).
        petsc_options_prefix: Ignored. It is here, as the next ones, so that the import alone decides who solves.
        petsc_options: Ignored.
        kind: Ignored.

    Attributes:
        bcs: The conditions; others may be put in their place before the next `solve`.
        load: The vector; likewise.

    Raises:
        TypeError: A form is no form, or a condition none.
        ValueError: The forms have not the arguments of an equation, or u or a condition is in another space.
        NotImplementedError: The mesh is on several ranks.
    """

    def __init__(
        self,
        a: ufl.Form | Form | Sequence[Sequence[ufl.Form | Form | None]],
        L: ufl.Form | Form | Sequence[ufl.Form | Form | None],
        *,
        bcs: Conditions = (),
        u: Function | Sequence[Function] | None = None,
        load: npt.ArrayLike | None = None,
        petsc_options_prefix: str = "",
        petsc_options: Mapping[str, Any] | None = None,
        kind: str = "mpi",
    ):
        self._system = LinearSystem(a, L, bcs=bcs, u=u, load=load)
        check_serial(self._system.layout.comm, "LinearProblem")
        self.bcs = bcs
        self.load = load

    @property
    def A(self) -> sp.csr_array:
        """The matrix of the last `solve`, or assembled now; rows of prescribed dofs are the identity's."""
        return self._system.A

    @property
    def b(self) -> Floats:
        """The right-hand side of the last `solve`, prescribed values included, shape (num_dofs,)."""
        return self._system.b

    @property
    def u(self) -> Any:
        """The solution: a `Function`, or a list of them."""
        return self._system.u

    def start_from_u(self) -> bool:
        """Return False: no solver here starts from the values of u. That of `fem.petsc` may, and returns whether."""
        return False

    def solve(self) -> Any:
        """Assemble with the present values of coefficients, constants and conditions, and solve.

        Returns:
            `u`.

        Raises:
            ValueError: The load is not zero on average, where constants are in the kernel, or has another shape.
            RuntimeError: The matrix is singular, or the iteration does not converge.
        """
        self._system.bcs, self._system.load = self.bcs, self.load
        self._system.assemble()
        return self._system.accept(solve(self._system.regular(), self._system.b))


def check_serial(comm: Any, problem: str) -> None:
    """Raise if there are several ranks.

    Args:
        comm: Communicator, or None.
        problem: Class of the problem.

    Raises:
        NotImplementedError: There are.
    """
    if size_of(comm) > 1:
        raise NotImplementedError(
            f"fem.scipy.{problem} works in one process, but the mesh is on {size_of(comm)} ranks: "
            f"use fem.petsc.{problem}, which takes the same arguments and a petsc_options_prefix"
        )


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


def solver(A: sp.csr_array, tolerance: float = TOLERANCE) -> Callable[[Floats], Floats]:
    """Return what solves A x = b for any b, shape (n,) or (n, k), for a symmetric positive definite matrix.

    It is factorised but once, or if it is large, solved by conjugate gradients.

    Args:
        A: Shape (n, n).
        tolerance: Of conjugate gradients, for the norm of the residual, relative to that of b.

    Raises:
        RuntimeError: The matrix is singular, to working precision.
    """
    if A.nnz <= LARGEST_DIRECT:
        return factorised(A)

    def iterated(b: Floats) -> Floats:
        columns = [conjugate_gradients(A, column, tolerance) for column in b.reshape(b.shape[0], -1).T]
        return np.stack(columns, axis=1).reshape(b.shape)

    return iterated


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


def factorised(A: sp.csr_array) -> Callable[[Floats], Floats]:
    """Return what solves A x = b for any b, for a matrix with the pattern of a symmetric one.

    Raises:
        RuntimeError: The matrix is singular, to working precision.
    """
    try:
        factors = _factors(A, 0.01)
    except RuntimeError as error:
        raise RuntimeError(
            f"SuperLU failed ({error}): the matrix is singular. See that Dirichlet conditions fix all that the "
            f"bilinear form leaves free, and that there is an integral over all of the surface"
        ) from error

    def solved(b: Floats) -> Floats:
        return np.asarray(factors.solve(b, "T"))

    check_regular(A, solved)
    return solved


def num_negative(A: sp.csr_array) -> int:
    """Return the number of negative eigenvalues of a symmetric matrix.

    With pivots from the diagonal alone, the factors L U are L D L^T, and D has as many negative entries as A has
    negative eigenvalues (Sylvester). They are those of a matrix that differs from A by rounding times the growth of the
    pivots.

    Raises:
        RuntimeError: There is no such factorisation.
    """
    factors = _factors(A, 0.0)
    if not np.array_equal(factors.perm_r, factors.perm_c):
        raise RuntimeError(
            "SuperLU met a zero on the diagonal, so that eigenvalues cannot be counted: move the target a little"
        )
    return int(np.count_nonzero(factors.U.diagonal() < 0.0))


def _factors(A: sp.csr_array, threshold: float) -> spla.SuperLU:
    """Return the factors of the transpose, with pivots on the diagonal where they are at least so large, relatively."""
    transposed = sp.csc_array((A.data, A.indices, A.indptr), shape=A.shape)  # no copy
    options = {"SymmetricMode": True}
    return spla.splu(transposed, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=threshold, options=options)


def _direct(A: sp.csr_array, b: Floats) -> Floats:
    x = factorised(A)(b)
    check_residual(A, x, b, "SuperLU")
    return x
