"""Eigenvalue problems of symmetric weak forms, whatever solves them.

Prescribed dofs are left out of the matrices: rows of the identity in their place would add eigenvalues of their own.
The spectrum is transformed by (A - s M)^-1, which needs a shift s at which that matrix is regular.

From one vector, Krylov methods come to but one eigenvector of a multiple eigenvalue; to the others rounding leads them,
sooner or later, and a copy may be missing when they stop. So eigenvalues are counted: where A - s M = L D L^T, as many
are below s as D has negative entries (Sylvester's law of inertia; Grimes, Lewis and Simon, A shifted block Lanczos
algorithm, SIAM J. Matrix Anal. Appl. 15, 1994, sec. 3.3). What is missing is searched for beside what was found.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

import ufl
from thccs_fem.fem.assembly import assemble_matrix
from thccs_fem.fem.bcs import DirichletBC
from thccs_fem.fem.entries import Numbering
from thccs_fem.fem.forms import Form, form
from thccs_fem.fem.function import Function
from thccs_fem.fem.layout import Layout
from thccs_fem.fem.linear import constraints, is_symmetric
from thccs_fem.parallel import gathered, largest, rank_of, smallest, total
from thccs_fem.subdivision import Ints

__all__ = ["EigenSystem"]

Floats = npt.NDArray[np.float64]

AWAY = 0.1  # how far the shift goes below the target, in units of the Rayleigh quotient of a long wave
EQUAL = 1e-6  # relative difference of coefficients that count as equally large when the sign is chosen
SAME = 1e-6  # relative difference of distances from the target that count as one
ROUNDING = 1e-12  # of eigenvalues, relative to the largest of all
ROUNDS = 20  # searches for missing eigenvalues, of which each finds one at least

Search = Callable[[int, Floats, Floats], tuple[Floats, Floats]]


class EigenSystem:
    """The equations A x = lambda M x of two symmetric forms: see the problems of `fem.scipy` for the arguments.

    Attributes:
        a: Compiled bilinear form.
        m: Compiled mass form.
        bcs: Conditions; others may be put in their place before the next `assemble`.
        num_eigenvalues: How many eigenvalues are wanted.
        target: They are the nearest to this number.
        free: Dofs that no condition prescribes, local, shape (n,).
        A: Matrix of a, without prescribed dofs; rows of those that this rank owns, columns of ghosts too.
        M: That of m.
        numbering: PETSc's numbers of the free dofs; None in serial.
    """

    def __init__(
        self,
        a: ufl.Form | Form,
        m: ufl.Form | Form | None = None,
        *,
        bcs: Sequence[DirichletBC] = (),
        num_eigenvalues: int = 6,
        target: float = 0.0,
    ):
        self.a = form(a)
        if self.a.rank != 2 or self.a.spaces[0] != self.a.spaces[1]:
            raise ValueError(
                f"a has arguments in {[str(V) for V in self.a.spaces]}: give a bilinear form, in a trial and a test "
                f"function of the same space"
            )
        V = self.a.spaces[1]
        mass = ufl.inner(ufl.TrialFunction(V), ufl.TestFunction(V)) * ufl.dx
        self.m = form(mass if m is None else m)
        if self.m.spaces != self.a.spaces:
            raise ValueError(f"m has arguments in {[str(V) for V in self.m.spaces]}, but those of a are in {V}")
        if num_eigenvalues < 1 or num_eigenvalues != int(num_eigenvalues):
            raise ValueError(f"num_eigenvalues is {num_eigenvalues}: ask for one or more, a whole number")
        if not np.isfinite(target):
            raise ValueError(f"target is {target}: give the number that the eigenvalues are to be nearest to")
        self.bcs = bcs
        self.num_eigenvalues = int(num_eigenvalues)
        self.target = target
        self.free: Ints = np.zeros(0, dtype=np.int32)
        self.A = self.M = sp.csr_array((0, 0))
        self.numbering: Numbering | None = None
        self._comm = V.mesh.comm
        self._layout = Layout((V,))
        constraints(bcs, V)  # says early what is wrong with them

    @property
    def num_owned(self) -> int:
        """How many free dofs this rank owns."""
        return self.A.shape[0]

    def assemble(self) -> None:
        """Assemble both matrices with the present values of coefficients, constants and conditions; collective.

        Raises:
            ValueError: A matrix is not symmetric, that of m not positive, a prescribed value not zero, or there are not
                as many eigenvalues as wanted.
        """
        V = self.a.spaces[1]
        dofs, values = constraints(self.bcs, V)
        largest_value = largest(self._comm, np.abs(values).max(initial=0.0))
        if largest_value > 0.0:
            raise ValueError(
                f"conditions prescribe values up to {largest_value:g}: eigenfunctions vanish where something is "
                f"prescribed, so prescribe 0.0"
            )
        self.free = np.setdiff1d(np.arange(V.num_local_dofs, dtype=np.int32), dofs)
        self.numbering = self._numbered()
        size = self.free.size if self.numbering is None else int(self.numbering.starts[-1])
        if self.num_eigenvalues >= size:
            raise ValueError(
                f"{self.num_eigenvalues} eigenvalues are wanted of {size} dofs without a condition: refine the space, "
                f"or ask for fewer"
            )
        self.A, self.M = (self._matrix(compiled) for compiled in (self.a, self.m))
        for name, matrix in (("a", self.A), ("m", self.M)):
            if not is_symmetric(matrix, self.numbering):
                raise ValueError(
                    f"{name} is not symmetric, so that eigenvalues may be complex: only symmetric forms are implemented"
                )
        if not smallest(self._comm, self.M.diagonal().min(initial=np.inf)) > 0.0:
            raise ValueError(
                "m is not positive: eigenvalues need a norm. If a is positive, swap the forms: the eigenvalues become "
                "their inverses"
            )

    def shifted(self, shift: float) -> sp.csr_array:
        """Return A - shift M."""
        return sp.csr_array(self.A - shift * self.M) if shift else self.A

    def shift_beside(self) -> float:
        """Return a number a little below the target, for a target that is itself an eigenvalue.

        What is little, the Rayleigh quotient of half a wave tells that is as long as the surface: it is of the size of
        the first eigenvalues that are not zero, whatever the order of the form and the units of its coefficients.
        """
        V = self.a.spaces[1]
        points = V.reference_points
        ends = gathered(self._comm, np.stack([points.min(axis=0, initial=np.inf), points.max(axis=0, initial=-np.inf)]))
        extents = np.ptp(ends, axis=0)
        along = int(np.argmax(extents))
        wave = np.cos(np.pi * (points[:, along] - ends[:, along].min()) / extents.max())
        w = np.repeat(wave, V.block_size)[self.free]
        owned = w[: self.num_owned]
        quotient = total(self._comm, float(owned @ (self.A @ w))) / total(self._comm, float(owned @ (self.M @ w)))
        return self.target - AWAY * abs(quotient)

    def complete(
        self, search: Search, count: Callable[[float], int] | None, accuracy: float = 0.0
    ) -> tuple[Floats, Floats]:
        """Return the eigenvalues nearest to the target, none of them missing, or fewer if a search finds fewer.

        The last of them may be copies of one eigenvalue that has more.

        Args:
            search: Returns at least as many eigenvalues as wanted, if they converge, and their vectors as columns, from
                their number, the vectors (shape (num_owned, k)) to which theirs are to be m-orthogonal, and a vector to
                start from.
            count: Returns how many eigenvalues there are below a number; None: what the first search finds is taken.
            accuracy: Of the eigenvalues found, relative to their distances from the target.

        Returns:
            Eigenvalues, those wanted first, shape (k,), and their vectors, shape (num_owned, k).

        Raises:
            RuntimeError: The numbers of those found and those counted never agree.
        """
        values, vectors = np.zeros(0), np.zeros((self.num_owned, 0))
        missing = self.num_eigenvalues
        if count is None:
            return search(missing, vectors, self._start_vector(0))
        for seed in range(ROUNDS):
            more = search(missing, vectors, self._start_vector(seed))
            values, vectors = np.append(values, more[0]), np.hstack([vectors, more[1]])
            nearest = np.argsort(np.abs(values - self.target), kind="stable")
            values, vectors = values[nearest], vectors[:, nearest]
            if values.size < self.num_eigenvalues:
                return values, vectors
            missing = self._missing(values, count, max(SAME, 10.0 * accuracy))
            if missing == 0:
                return values, vectors
            if missing < 0 or more[0].size == 0:
                break
        raise RuntimeError(
            f"of the {self.num_eigenvalues} eigenvalues nearest to {self.target:g}, {abs(missing)} "
            f"{'are missing' if missing > 0 else 'are too many'}, as the signs of pivots of A - s M tell. What may "
            f"help: another target; see that m is positive, as the square of a norm"
        )

    def _missing(self, eigenvalues: Floats, count: Callable[[float], int], relative: float) -> int:
        """Return how many more eigenvalues there are nearer to the target than the last one wanted, and its copies.

        Args:
            eigenvalues: The nearest first.
            count: As above.
            relative: Difference of distances from the target that count as one.
        """
        distances = np.abs(eigenvalues - self.target)[: self.num_eigenvalues]
        ratios = np.abs(self.A.diagonal()) / self.M.diagonal()
        same = max(relative * distances[-1], ROUNDING * largest(self._comm, ratios.max(initial=0.0)))
        first = int(np.flatnonzero(np.diff(distances, prepend=-np.inf) > same)[-1])  # of the last one's copies
        radius = distances[first] - same / 2.0
        if radius <= 0.0:
            return 0
        return count(self.target + radius) - count(self.target - radius) - first

    def accept(self, eigenvalues: Floats, vectors: Floats, solver: str) -> tuple[Floats, list[Function]]:
        """Return eigenvalues in ascending order, and their functions with m-norm 1 and a sign of our choice.

        Args:
            eigenvalues: Those that converged, those wanted first, shape (k,).
            vectors: Eigenvectors, shape (num_owned, k).
            solver: Who found them, for messages.

        Raises:
            RuntimeError: There are fewer than wanted.
        """
        if eigenvalues.size < self.num_eigenvalues:
            raise RuntimeError(
                f"{solver} found {eigenvalues.size} of {self.num_eigenvalues} eigenvalues near {self.target:g}. What "
                f"may help: more iterations, a larger subspace (eps_ncv), or a target nearer to what is wanted"
            )
        order = np.argsort(eigenvalues[: self.num_eigenvalues], kind="stable")
        return eigenvalues[order], [self._function(vectors[:, i]) for i in order]

    def _function(self, vector: Floats) -> Function:
        """Return an eigenfunction; the first of its largest coefficients, by dofs of the whole, is positive."""
        V, owned = self.a.spaces[1], self.free[: self.num_owned]
        x = vector / np.sqrt(total(self._comm, float(vector @ (self.M @ self._with_ghosts(vector)))))
        size = largest(self._comm, np.abs(x).max(initial=0.0))
        candidates = np.flatnonzero(np.abs(x) >= (1.0 - EQUAL) * size)
        dofs = V.block_size * V.index_map.numbers[owned // V.block_size] + owned % V.block_size
        first = smallest(self._comm, float(dofs[candidates].min(initial=V.num_dofs)))
        function = Function(V)
        function.x.array[owned] = x * total(self._comm, float(np.sign(x[dofs == first]).sum()))
        function.x.scatter_forward()
        return function

    def _matrix(self, compiled: Form) -> sp.csr_array:
        whole = assemble_matrix(compiled)
        if self.free.size == whole.shape[1]:
            return whole
        return sp.csr_array(whole[self.free[self.free < whole.shape[0]]][:, self.free])

    def _numbered(self) -> Numbering | None:
        """Return the numbers of the free dofs."""
        V = self.a.spaces[1]
        if V.index_map.is_whole:
            return None
        owned = self.free[self.free < V.num_owned_dofs]
        starts = np.concatenate([[0], np.cumsum(gathered(self._comm, np.array([owned.size])))])
        numbers = np.zeros(V.num_owned_dofs)
        numbers[owned] = starts[self._comm.rank] + np.arange(owned.size)
        return Numbering(self._comm, starts, self._layout.with_ghosts(numbers)[self.free].astype(np.int32))

    def _with_ghosts(self, x: Floats) -> Floats:
        """Return the values at all free dofs from those that this rank owns; collective."""
        if self.numbering is None:
            return x
        values = np.zeros(self._layout.num_owned)
        values[self.free[: self.num_owned]] = x
        return self._layout.with_ghosts(values)[self.free]

    def _start_vector(self, seed: int) -> Floats:
        """Return what Krylov methods start from: the same for the same seed, with a part along every eigenvector."""
        rng = np.random.default_rng(seed + ROUNDS * rank_of(self._comm))
        return np.asarray(self.M @ self._with_ghosts(rng.standard_normal(self.num_owned)))
