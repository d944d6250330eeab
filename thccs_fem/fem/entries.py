"""How PETSc numbers dofs that are spread over ranks, and how entries of matrices get to the owners of their rows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from thccs_fem.index_map import IndexMap
from thccs_fem.parallel import rank_of
from thccs_fem.subdivision import Ints

__all__ = ["Numbering", "at_owners"]

Floats = npt.NDArray[np.float64]
Numbers = npt.NDArray[np.integer]


@dataclass(frozen=True, eq=False)
class Numbering:
    """PETSc's numbers of the dofs that a rank holds: those of the ranks follow one another.

    Attributes:
        comm: The communicator, of several ranks.
        starts: First number of each rank, and how many there are, shape (ranks + 1,).
        numbers: Number of each dof, owned ones first, then ghosts, both ascending, shape (n,).
    """

    comm: Any
    starts: npt.NDArray[np.int64]
    numbers: Ints

    @classmethod
    def of(cls, index_map: IndexMap, block_size: int) -> Numbering | None:
        """Return the numbers of all components of functions; None where they are those that the functions have."""
        if index_map.is_whole:
            return None
        functions = index_map.local_to_global(np.arange(index_map.numbers.size))
        numbers = block_size * functions[:, None] + np.arange(block_size)
        return cls(index_map.comm, block_size * index_map.starts, numbers.ravel().astype(np.int32))

    @property
    def num_owned(self) -> int:
        """How many dofs this rank owns."""
        rank = rank_of(self.comm)
        return int(self.starts[rank + 1] - self.starts[rank])


def at_owners(
    comm: Any, starts: Numbers, rows: Numbers, columns: Numbers, values: Floats
) -> tuple[Numbers, Numbers, Floats]:
    """Send entries to the owners of their rows; collective.

    Args:
        comm: The communicator, None in serial.
        starts: First row of each rank, and how many rows there are, shape (ranks + 1,).
        rows: PETSc's number of the row of each entry, shape (n,).
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
