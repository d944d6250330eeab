"""Entries of matrices that travel to the ranks that own their rows."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["at_owners"]

Floats = npt.NDArray[np.float64]
Numbers = npt.NDArray[np.integer]


def at_owners(
    comm: Any, starts: Numbers, rows: Numbers, columns: Numbers, values: Floats
) -> tuple[Numbers, Numbers, Floats]:
    """Send entries to the owners of their rows; collective.

    Args:
        comm: The communicator, None in serial.
        starts: First row of each rank, and how many rows there are, shape (ranks + 1,).
        rows: Global number of the row of each entry, shape (n,).
        columns: Any number of its column, the same on all ranks, shape (n,).
        values: Its value, shape (n,).

    Returns:
        Rows, columns and values of the entries of this rank's rows, in the order of the ranks that they come from.
    """
    if starts.size == 2:  # one rank
        return rows, columns, values
    owner = np.searchsorted(starts, rows, side="right") - 1
    order = np.argsort(owner, kind="stable")
    ends = np.searchsorted(owner[order], np.arange(1, starts.size - 1))
    parts = zip(*(np.split(array[order], ends) for array in (rows, columns, values)), strict=True)
    received = zip(*comm.alltoall(list(parts)), strict=True)
    found_rows, found_columns, found_values = (np.concatenate(arrays) for arrays in received)
    return found_rows, found_columns, found_values
