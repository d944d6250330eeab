"""Ranks that are threads of this process: what is said between ranks, without MPI."""

from __future__ import annotations

import pickle
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

PATIENCE = 20.0  # seconds until a rank that waits for another has waited in vain


@dataclass(frozen=True, eq=False)
class Comm:
    """What we use of a communicator of mpi4py. Everything is pickled, as it is on its way between processes."""

    rank: int
    size: int
    sent: list[bytes]
    meeting: threading.Barrier

    def allgather(self, value: Any) -> list[Any]:
        self.sent[self.rank] = pickle.dumps(value)
        self.meeting.wait()
        values = [pickle.loads(data) for data in self.sent]
        self.meeting.wait()
        return values

    def bcast(self, value: Any, root: int = 0) -> Any:
        return self.allgather(value)[root]

    def alltoall(self, values: list[Any]) -> list[Any]:
        return [given[self.rank] for given in self.allgather(values)]

    def Alltoallv(self, sent: list[Any], received: list[Any]) -> None:
        (values, counts), (result, expected) = sent, received
        parts = self.alltoall(np.split(values.ravel(), np.cumsum(counts)[:-1]))
        assert [part.size for part in parts] == expected.tolist()
        result.ravel()[:] = np.concatenate(parts)


def ranks(size: int) -> list[Comm]:
    sent, meeting = [b""] * size, threading.Barrier(size, timeout=PATIENCE)
    return [Comm(rank, size, sent, meeting) for rank in range(size)]


def on_ranks[T](size: int, work: Callable[[Comm], T]) -> list[T | BaseException]:
    """Return what work returns or raises on each of so many ranks."""

    def outcome(comm: Comm) -> T | BaseException:
        try:
            return work(comm)
        except BaseException as error:  # that of each rank is what is asked for
            return error

    hook = sys.excepthook
    try:
        with ThreadPoolExecutor(size) as pool:
            return list(pool.map(outcome, ranks(size)))
    finally:
        sys.excepthook = hook  # a mesh of several ranks sets it
