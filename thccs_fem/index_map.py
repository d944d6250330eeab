"""Which numbers a rank owns of something that is spread over ranks, which it holds copies of, and how values travel.

Things are numbered in three ways.  Their *numbers* are those of the whole, the same whatever the number of ranks, as in
a serial run.  *Global* ones are those of PETSc: rank after rank, within a rank in the order of the numbers.  *Local*
ones count what a rank holds: first what it owns, then its ghosts, which other ranks own.  In serial all three agree.

The names are those of DOLFINx's `IndexMap`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from thccs_fem.parallel import rank_of, size_of

__all__ = ["Fetch", "IndexMap"]

Ints = npt.NDArray[np.int32]
Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class IndexMap:
    """What a rank holds of `size_global` things.

    Attributes:
        comm: The communicator, None in serial.
        numbers: Number of each local index, owned ones ascending, then ghosts in the order of their global numbers,
            shape (size_local + num_ghosts,).
        starts: First global number of each rank, and how many there are, shape (ranks + 1,).
        global_numbers: Global number of each thing, shape (size_global,); None where these are the numbers.
    """

    comm: Any
    numbers: Ints
    starts: npt.NDArray[np.int64]
    global_numbers: Ints | None

    @classmethod
    def whole(cls, size: int, comm: Any = None) -> IndexMap:
        """Return the map of things that this rank holds all of."""
        return cls(comm, np.arange(size, dtype=np.int32), np.array([0, size]), None)

    @classmethod
    def spread(cls, comm: Any, owners: npt.NDArray[np.integer], held: npt.NDArray[np.bool_]) -> IndexMap:
        """Return the map of things that are spread over ranks.

        Args:
            comm: The communicator.
            owners: Rank that owns each thing, the same on all ranks, shape (size_global,).
            held: What this rank wants to hold, shape (size_global,); what it owns it holds in any case.
        """
        order = np.argsort(owners, kind="stable").astype(np.int32)
        global_numbers = np.zeros(order.size, dtype=np.int32)
        global_numbers[order] = np.arange(order.size, dtype=np.int32)
        starts = np.searchsorted(owners[order], np.arange(size_of(comm) + 1)).astype(np.int64)
        mine = owners == rank_of(comm)
        ghosts = np.sort(global_numbers[held & ~mine])
        numbers = np.concatenate([np.flatnonzero(mine), order[ghosts]]).astype(np.int32)
        return cls(comm, numbers, starts, global_numbers)

    @property
    def is_whole(self) -> bool:
        """Whether this rank owns everything, by its numbers."""
        return self.global_numbers is None

    @property
    def _rank(self) -> int:
        return 0 if self.global_numbers is None else rank_of(self.comm)

    @property
    def size_global(self) -> int:
        """How many there are, on all ranks."""
        return int(self.starts[-1])

    @property
    def size_local(self) -> int:
        """How many this rank owns."""
        begin, end = self.local_range
        return end - begin

    @property
    def num_ghosts(self) -> int:
        """How many it holds that others own."""
        return self.numbers.size - self.size_local

    @property
    def local_range(self) -> tuple[int, int]:
        """The first of the global numbers that this rank owns, and the one after the last."""
        return int(self.starts[self._rank]), int(self.starts[self._rank + 1])

    @cached_property
    def ghosts(self) -> Ints:
        """Global numbers of the ghosts, ascending, shape (num_ghosts,)."""
        return self.local_to_global(np.arange(self.size_local, self.numbers.size))

    @property
    def owners(self) -> Ints:
        """Ranks that own the ghosts, shape (num_ghosts,)."""
        return (np.searchsorted(self.starts, self.ghosts, side="right") - 1).astype(np.int32)

    def local_to_global(self, local: npt.NDArray[np.integer]) -> Ints:
        """Return the global numbers of local indices, of the same shape."""
        numbers = self.numbers[local]
        return numbers if self.global_numbers is None else self.global_numbers[numbers]

    @cached_property
    def _order(self) -> Ints:
        return np.argsort(self.numbers).astype(np.int32)

    def local_of(self, numbers: npt.NDArray[np.integer]) -> Ints:
        """Return the local indices of numbers, -1 for those that this rank does not hold, of the same shape."""
        if self.global_numbers is None:
            return numbers.astype(np.int32)
        if not self.numbers.size:
            return np.full(numbers.shape, -1, dtype=np.int32)
        place = np.minimum(np.searchsorted(self.numbers, numbers, sorter=self._order), self.numbers.size - 1)
        local = self._order[place]
        return np.where(self.numbers[local] == numbers, local, -1).astype(np.int32)

    @cached_property
    def _to_ghosts(self) -> Fetch:
        return Fetch(self, self.numbers[self.size_local :])

    def scatter_forward(self, values: npt.NDArray[np.float64]) -> None:
        """Give ghosts the values that their owners have; collective.

        Args:
            values: Values of all local indices, changed in place, shape (size_local + num_ghosts,) or with k columns.
        """
        if self.global_numbers is not None:
            values[self.size_local :] = self._to_ghosts(values)

    def reverse_add(self, values: npt.NDArray[np.float64]) -> None:
        """Add what stands at ghosts to the values of their owners, and put zeros at ghosts; collective.

        Args:
            values: Values of all local indices, changed in place, shape (size_local + num_ghosts,) or with k columns.
        """
        if self.global_numbers is not None:
            self._to_ghosts.add_back(values[self.size_local :].copy(), values)
            values[self.size_local :] = 0.0

    def gather(self, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return the values of all things in the order of their numbers, on every rank; collective.

        Args:
            values: Values of what this rank owns, and maybe of ghosts, shape (size_local or more,) or with k columns.
        """
        if self.global_numbers is None:
            return values.copy()
        parts = self.comm.allgather(np.ascontiguousarray(values[: self.size_local]))
        return np.concatenate(parts)[self.global_numbers]


class Fetch:
    """How a rank gets the values of things that it names by their numbers, from the ranks that own them.

    Making one is collective, and so is its use.

    Args:
        index_map: Where the values are.
        wanted: Numbers, in any order, repeated or not, shape (n,); other ranks want others.
    """

    def __init__(self, index_map: IndexMap, wanted: npt.NDArray[np.integer]):
        self._comm = index_map.comm
        self._is_whole = index_map.global_numbers is None
        if self._is_whole:
            self._inverse = wanted.astype(np.int32)
            return
        assert index_map.global_numbers is not None
        unique, inverse = np.unique(index_map.global_numbers[wanted], return_inverse=True)
        self._inverse = inverse.astype(np.int32)
        ends = np.searchsorted(unique, index_map.starts)
        asked = [unique[begin:end] for begin, end in pairwise(ends)]
        first = index_map.local_range[0]
        self._received = np.diff(ends).astype(np.int32)
        answers: Sequence[Ints] = self._comm.alltoall(asked)
        self._sent = np.array([numbers.size for numbers in answers], dtype=np.int32)
        self._source = (np.concatenate(answers) - first).astype(np.int32)

    def __call__(self, values: Floats) -> Floats:
        """Return the values of what is wanted.

        Args:
            values: Values of what this rank owns, and maybe of ghosts, shape (size_local or more,) or with k columns.

        Returns:
            Shape (n,) or (n, k).
        """
        if self._is_whole:
            return values[self._inverse]
        return self._exchanged(values[self._source], self._sent, self._received)[self._inverse]

    def add_back(self, contributions: Floats, values: Floats) -> None:
        """Add contributions to the values of what was wanted, at its owners: the transpose of a call.

        Args:
            contributions: Shape (n,) or (n, k).
            values: Values of what this rank owns, and maybe of ghosts, changed in place.
        """
        if self._is_whole:
            np.add.at(values, self._inverse, contributions)
            return
        summed = np.zeros((int(self._received.sum()), *contributions.shape[1:]))
        np.add.at(summed, self._inverse, contributions)
        np.add.at(values, self._source, self._exchanged(summed, self._received, self._sent))

    def _exchanged(self, values: Floats, sent: Ints, received: Ints) -> Floats:
        """Send rows to the ranks, so many to each, and return those that come from them."""
        k = int(np.prod(values.shape[1:], dtype=int))
        result = np.zeros((int(received.sum()), *values.shape[1:]))
        self._comm.Alltoallv([np.ascontiguousarray(values), sent * k], [result, received * k])
        return result
