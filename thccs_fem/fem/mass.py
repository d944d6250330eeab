"""Equations with mass matrices, solved by conjugate gradients over the ranks.

Scaled by its diagonal a mass matrix is well conditioned, whatever the mesh and the refinement, so that nothing else is
needed. Where spaces are small each rank has the whole matrix, since it solves faster than it hears of others some
hundred times.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from thccs_fem.index_map import IndexMap
from thccs_fem.parallel import gathered, total

__all__ = ["conjugate_gradients", "is_small", "product", "solved", "whole"]

Ints = npt.NDArray[np.int32]
Floats = npt.NDArray[np.float64]

SMALL = 20_000  # functions of a space whose matrix each rank has the whole of: some ten megabytes
TOLERANCE = 1e-14  # errors are some hundred times as large, up to 2e-12 of the values
MOST_ITERATIONS = 10_000  # 200 to 400 are enough on any mesh and refinement, for the H1 product the diameter over h


def is_small(index_map: IndexMap) -> bool:
    """Return whether each rank has the whole of a matrix for these functions."""
    return index_map.is_whole or index_map.size_global <= SMALL


def solved(M: sp.csr_array, load: Floats, index_map: IndexMap) -> Floats:
    """Return the solutions of M x = b for a mass matrix; collective.

    Args:
        M: Owned rows, local columns.
        load: Vectors b, owned part, shape (size_local, k).
        index_map: What this rank owns and holds.

    Returns:
        Owned part, shape (size_local, k).

    Raises:
        RuntimeError: It does not converge.
    """
    if index_map.is_whole or not is_small(index_map):
        return conjugate_gradients(product(M, index_map), M.diagonal(), load, index_map.comm)
    owned = index_map.numbers[: index_map.size_local]
    M = whole(M, owned, index_map.numbers, index_map)
    return conjugate_gradients(M.__matmul__, M.diagonal(), index_map.gather(load), None)[owned]


def whole(A: sp.csr_array, rows: Ints, columns: Ints, index_map: IndexMap) -> sp.csr_array:
    """Return the sum of the matrices of all ranks, on each of them the same; collective.

    Args:
        A: That of this rank.
        rows: Numbers of its rows, shape (n,).
        columns: Numbers of its columns, shape (m,).
        index_map: That of rows and columns.

    Returns:
        Shape (size_global, size_global).
    """
    entries = sp.coo_array(A)
    row, column = (gathered(index_map.comm, numbers) for numbers in (rows[entries.row], columns[entries.col]))
    size = index_map.size_global
    return sp.csr_array((gathered(index_map.comm, entries.data), (row, column)), shape=(size, size))


def product(A: sp.csr_array, index_map: IndexMap) -> Callable[[Floats], Floats]:
    """Return what multiplies vectors by a matrix of owned rows and local columns; collective.

    Args:
        A: Shape (size_local, size_local + num_ghosts).
        index_map: What this rank owns and holds.

    Returns:
        Takes the owned part of vectors, shape (size_local, k), and returns that of the products.
    """
    if index_map.is_whole:
        return A.__matmul__

    def multiplied(x: Floats) -> Floats:
        values = np.zeros((index_map.numbers.size, x.shape[1]))
        values[: index_map.size_local] = x
        index_map.scatter_forward(values)
        return A @ values

    return multiplied


def conjugate_gradients(apply: Callable[[Floats], Floats], diagonal: Floats, load: Floats, comm: Any) -> Floats:
    """Return the solutions of A x = b for a symmetric positive definite matrix; collective.

    What is left of the residual is measured relative to the diagonal, by its largest entry: where cells are small so
    are the entries of b, and a norm of the residual would say nothing of them.

    Args:
        apply: Multiplies vectors by A, shape (n, k), in which each rank has the rows that it owns.
        diagonal: That of A, shape (n,).
        load: Vectors b, shape (n, k).
        comm: The communicator, or None.

    Returns:
        Shape (n, k), the same to the last bit in each run on as many ranks.

    Raises:
        RuntimeError: It does not converge.
    """
    x = np.zeros_like(load)
    residual = load.copy()
    scaled = residual / diagonal[:, None]
    direction = scaled.copy()
    square, size = _measured(comm, residual, scaled)
    goal = TOLERANCE * size
    for _ in range(MOST_ITERATIONS):
        if (size <= goal).all():
            return x
        image = apply(direction)
        step = _quotient(square, total(comm, (direction * image).sum(axis=0)))
        x += step * direction
        residual -= step * image
        scaled = residual / diagonal[:, None]
        before = square
        square, size = _measured(comm, residual, scaled)
        direction = scaled + _quotient(square, before) * direction
    raise RuntimeError(
        f"conjugate gradients did not converge in {MOST_ITERATIONS} iterations: see that the values are finite, and no "
        f"larger than 1e150"
    )


def _measured(comm: Any, residual: Floats, scaled: Floats) -> tuple[Floats, Floats]:
    """Return the inner product of two vectors and the largest entry of the second, for each column, both (k,)."""
    here = np.stack([(residual * scaled).sum(axis=0), np.abs(scaled).max(axis=0, initial=0.0)])
    of_ranks = gathered(comm, here[None])
    return of_ranks[:, 0].sum(axis=0), of_ranks[:, 1].max(axis=0)


def _quotient(a: Floats, b: Floats) -> Floats:
    """Return a / b, 0 where b is: there nothing is left to be done."""
    return np.divide(a, b, out=np.zeros_like(a), where=b != 0.0)
