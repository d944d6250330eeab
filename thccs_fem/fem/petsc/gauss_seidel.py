"""Symmetric Gauss-Seidel on several ranks, as good a smoother as on one.

Gauss-Seidel takes functions one after the other, in any order. Here those come last that share an entry with one of a
rank before: of the others no two on different ranks do, so that each rank takes its own on its own. The last ones are
few, beside the borders between ranks, and every rank takes all of them, alike: all that ranks tell each other is one
sum of vectors of their number. With M = (D + L) D^-1 (D + U) in this order, M - A is positive semidefinite as in
serial, so that no eigenvalue of M^-1 A is above 1. Gauss-Seidel within each rank alone, Schwarz's method, has
eigenvalues up to 2.
"""

from __future__ import annotations

from typing import Any

from petsc4py import PETSc

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from thccs_fem.fem.levels import LevelMatrix, owners_of
from thccs_fem.fem.petsc.matrices import sharing
from thccs_fem.parallel import gathered, rank_of
from thccs_fem.sparse import restricted, rows_of, stacked
from thccs_fem.subdivision import Bools, Ints

__all__ = ["GaussSeidel"]

Floats = npt.NDArray[np.float64]

SWEEP: Any = PETSc.Mat.SORType  # numbers, other than the stubs say
FORWARD = SWEEP.LOCAL_FORWARD_SWEEP | SWEEP.ZERO_INITIAL_GUESS
BACKWARD = SWEEP.LOCAL_BACKWARD_SWEEP | SWEEP.ZERO_INITIAL_GUESS
BOTH = SWEEP.LOCAL_SYMMETRIC_SWEEP | SWEEP.ZERO_INITIAL_GUESS
ALIKE = 0.2  # part of the rows that have the same columns as the row before, from which on PETSc takes blocks of them


class GaussSeidel:
    """The context of a PC of type "python": one symmetric sweep over some functions, from zero. Collective.

    Args:
        matrix: A symmetric matrix, on several ranks.
        functions: Dofs to be smoothed, the same on all ranks.
    """

    def __init__(self, matrix: LevelMatrix, functions: Ints):
        A, owned, self._comm = matrix.values, matrix.owned, matrix.dofs.comm
        smoothed = np.zeros(A.shape[1], dtype=bool)
        smoothed[functions] = True
        before = smoothed & (owners_of(matrix.dofs) < rank_of(self._comm))
        meets = _has_entries(restricted(A, np.arange(owned.size), np.flatnonzero(before)))
        self._inner = np.flatnonzero(smoothed[owned] & ~meets)
        self._last = np.flatnonzero(smoothed[owned] & meets)
        of_all = gathered(self._comm, owned[self._last])
        counts = self._comm.allgather(self._last.size)
        first = sum(counts[: rank_of(self._comm)])
        self._place = slice(first, first + self._last.size)
        between = restricted(A, self._inner, of_all)
        self._beside = np.flatnonzero(_has_entries(between))
        self._between = rows_of(between, self._beside)
        self._sweep = _Sweep(restricted(A, self._inner, owned[self._inner]))
        self._sweep_last = _Sweep(stacked(self._comm.allgather(restricted(A, self._last, of_all))))

    def apply(self, pc: PETSc.PC, b: PETSc.Vec, x: PETSc.Vec) -> None:
        """Set x to M^-1 b, which is zero for functions that are not smoothed."""
        load: Any = b.array_r  # float64, other than the stubs say
        of_inner, of_last = load[self._inner], np.zeros(self._sweep_last.size)
        of_last[self._place] = load[self._last]
        forward = self._sweep.forward(of_inner)
        of_last -= self._between.T @ forward[self._beside]
        last = self._sweep_last.both(self._summed(of_last))
        change = np.zeros_like(forward)
        change[self._beside] = self._between @ last
        result = x.array_w
        result[:] = 0.0
        result[self._inner] = self._sweep.backward(forward, of_inner, change)
        result[self._last] = last[self._place]

    def _summed(self, values: Floats) -> Floats:
        result = np.zeros_like(values)
        self._comm.Allreduce(values, result)
        return result


class _Sweep:
    """Sweeps over all functions of a matrix of this rank.

    PETSc takes functions with the same neighbours together, if there are many, as those of a vector's components. D has
    blocks then, which only PETSc knows: without them going back costs half as much.
    """

    def __init__(self, A: sp.csr_array):
        A.sort_indices()
        self.size = A.shape[0]
        self._mat = sharing(A, PETSc.COMM_SELF)
        self._diagonal = None if _has_rows_alike(A) else A.diagonal()
        inodes: Any = PETSc.Mat.Option.USE_INODES
        self._mat.setOption(inodes, self._diagonal is None)

    def forward(self, load: Floats) -> Floats:
        """Return (D + L)^-1 load."""
        return self._swept(load, np.zeros(self.size), FORWARD)

    def backward(self, forward: Floats, load: Floats, change: Floats) -> Floats:
        """Return (D + U)^-1 (D forward - change), of the result of `forward` for a load."""
        if self._diagonal is None:
            return self._swept(load - change, forward.copy(), SWEEP.LOCAL_BACKWARD_SWEEP)
        return self._swept(self._diagonal * forward - change, np.zeros(self.size), BACKWARD)

    def both(self, load: Floats) -> Floats:
        """Return (D + U)^-1 D (D + L)^-1 load."""
        return self._swept(load, np.zeros(self.size), BOTH)

    def _swept(self, load: Floats, x: Floats, kind: Any) -> Floats:
        """Change x by a sweep, and return it."""
        if self.size:
            arrays: Any = load, x  # sequences, say the stubs
            right, left = (PETSc.Vec().createWithArray(array, comm=PETSc.COMM_SELF) for array in arrays)
            self._mat.SOR(right, left, sortype=kind)
        return x


def _has_rows_alike(A: sp.csr_array) -> bool:
    """Return whether many rows have entries in the columns of the row before, by three of their columns."""
    first, last = A.indptr[:-1], A.indptr[1:] - 1
    seen = A.indices[np.stack([first, (first + last) // 2, last])]  # no row is without its diagonal
    alike = (np.diff(A.indptr, 2) == 0) & (np.diff(seen) == 0).all(axis=0)
    return bool(np.count_nonzero(alike) > ALIKE * A.shape[0])


def _has_entries(A: sp.csr_array) -> Bools:
    """Return for each row whether there is any."""
    return np.diff(A.indptr) > 0
