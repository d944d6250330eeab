"""Ranks that work together: sums over them, and errors that all of them see.

A communicator is what the user gave to the mesh: one of mpi4py, which is imported nowhere here, or None in serial. All
functions but `size_of`, `rank_of` and `end_together` are collective: every rank of the communicator calls them, in the
same order. What they return is the same on all ranks to the last bit, so that every rank decides alike.
"""

import os
import pickle
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from operator import add
from types import TracebackType
from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = [
    "all_arrive",
    "by_first_rank",
    "end_together",
    "gathered",
    "largest",
    "rank_of",
    "size_of",
    "smallest",
    "together",
    "total",
]

PATIENCE = 2.0  # seconds that a rank that fails waits for others to fail as well, before it ends them
FIRST = "first_rank"  # attribute of errors that were raised on another rank: of that rank
FAILED = 29_876  # tag of the messages of ranks that fail; any number that users do not happen to use

type Report = tuple[bytes, str]  # a class, pickled, and a message
type Hook = Callable[[type[BaseException], BaseException, TracebackType | None], Any]


def size_of(comm: Any) -> int:
    """Return the number of ranks: 1 in serial, where `comm` is None."""
    return 1 if comm is None else int(comm.size)


def rank_of(comm: Any) -> int:
    """Return the number of this rank, from 0; 0 in serial, where `comm` is None."""
    return 0 if comm is None else int(comm.rank)


def total[T](comm: Any, value: T) -> T:
    """Return the sum over the ranks, added in their order. Collective.

    Args:
        comm: Communicator, or None.
        value: A number, or an array of the same shape on all ranks.

    >>> total(None, 3.0)
    3.0
    """
    return value if size_of(comm) == 1 else reduce(add, comm.allgather(value))


def largest(comm: Any, value: float) -> float:
    """Return the largest of the numbers of all ranks, nan if one is. Collective."""
    return value if size_of(comm) == 1 else np.max(comm.allgather(value)).item()


def smallest(comm: Any, value: float) -> float:
    """Return the smallest of the numbers of all ranks, nan if one is. Collective."""
    return value if size_of(comm) == 1 else np.min(comm.allgather(value)).item()


def gathered[T: np.generic](comm: Any, array: npt.NDArray[T]) -> npt.NDArray[T]:
    """Return the arrays of all ranks one after the other, on all of them. Collective.

    Args:
        comm: Communicator, or None.
        array: The array of this rank, of any length; the other axes are the same on all.
    """
    return array if size_of(comm) == 1 else np.concatenate(comm.allgather(array))


# Errors -------------------------------------------------------------------------------------------


def together[T](comm: Any, work: Callable[[], T]) -> T:
    """Do work on every rank, and return what it returned; if it raised somewhere, raise everywhere. Collective.

    Without this the ranks on which nothing went wrong would wait for the others for ever. `work` itself must not
    communicate: a rank that failed half-way would miss what the others still say.

    Args:
        comm: Communicator, or None.
        work: What to do on this rank.

    Raises:
        Exception: If all ranks raised the same, each its own. Else the first one that was raised, with its rank before
            its message, on all ranks: of the same class, or of the first base of it that is made from a message alone.
    """
    if size_of(comm) == 1:
        return work()
    try:
        result, raised = work(), None
    # An exit, too: it shows no other rank that it happens. An interrupt must not wait for others: see `end_together`.
    except (Exception, SystemExit) as error:
        raised = error
    reports: list[Report | None] = comm.allgather(None if raised is None else _report(raised))
    if raised is not None and all(report == reports[0] for report in reports):
        raise raised
    for rank, report in enumerate(reports):
        if report is not None:
            kind, message = report
            shared = pickle.loads(kind)(f"rank {rank} of {comm.size}: {message}")
            vars(shared)[FIRST] = rank
            raise shared.with_traceback(raised.__traceback__ if raised else None) from None
    return result


def by_first_rank[T](comm: Any, work: Callable[[], T]) -> T:
    """Do work on rank 0 alone; return or raise on every rank what it returned or raised. Collective.

    Args:
        comm: Communicator, or None.
        work: What to do; called on rank 0 only. What it returns can be pickled.
    """
    if size_of(comm) == 1:
        return work()
    raised: Exception | SystemExit | None = None
    sent: tuple[Any, bytes | None] | None = None
    if comm.rank == 0:
        try:
            sent = work(), None
        except (Exception, SystemExit) as error:
            raised, sent = error, (None, _pickled(error))
    result, failure = comm.bcast(sent, root=0)
    if failure is not None:
        raise pickle.loads(failure) if raised is None else raised
    return result


def all_arrive(comm: Any) -> bool:
    """Return whether all ranks call this at about the same time: did what failed here fail everywhere?

    To be asked before what failed is undone together, where it may have failed on one rank alone. Of all functions here
    this is the only one that does not wait for ever.

    Args:
        comm: Communicator, or None.
    """
    if size_of(comm) == 1:
        return True
    request = comm.Ibarrier()
    end = time.monotonic() + PATIENCE
    while not (arrived := bool(request.Test())) and time.monotonic() < end:
        time.sleep(0.01)
    return arrived


def _report(error: BaseException) -> Report:
    """Return what other ranks need to raise an exception like this one."""
    message = str(error)
    for kind in type(error).__mro__:  # classes of functions can't be pickled, some are not made from a message
        try:
            found = pickle.dumps(kind)
            if pickle.loads(found)(message).args == (message,):
                return found, message
        except Exception:  # whatever constructors raise
            continue
    return pickle.dumps(Exception), message  # for the bare BaseException


def _pickled(error: BaseException) -> bytes:
    """Return the exception, or one like it if it can't be made again from what is pickled of it."""
    try:
        data = pickle.dumps(error)
        if str(pickle.loads(data)) == str(error):
            return data
    except Exception:  # whatever constructors raise
        pass
    kind, message = _report(error)
    return pickle.dumps(pickle.loads(kind)(message))


def end_together(comm: Any) -> None:
    """From now on end all ranks when an exception leaves the script on one of them, with one traceback.

    Python would end that rank alone, and the others would wait for it. Nothing is done in serial, nor where someone
    types: IPython and pytest catch exceptions anyway.

    Args:
        comm: Communicator of the ranks to end, or None. The largest one given counts.
    """
    if size_of(comm) == 1 or hasattr(sys, "ps1"):
        return
    hook = sys.excepthook
    if not isinstance(hook, _EndTogether):
        sys.excepthook = _EndTogether(comm, hook)
    elif hook.comm.size < comm.size:
        sys.excepthook = _EndTogether(comm, hook.shows)


@dataclass(frozen=True)
class _EndTogether:
    """A `sys.excepthook` of all ranks.

    A rank that fails tells the others, which read it only when they fail as well: all of them, if the error is one that
    all see. Then each ends by itself. Else the first of them ends all, wherever the others are: they may wait for a
    message that will never come.

    Attributes:
        comm: Communicator.
        shows: The hook that was there before.
    """

    comm: Any
    shows: Hook

    def __call__(self, kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        try:
            failed = self._failed(f"{kind.__name__}: {error}")
        except Exception:  # the communicator is no longer there: who ends without MPI's leave ends the others, too
            self.shows(kind, error, trace)
            sys.stderr.flush()
            os._exit(1)
        first = getattr(error, FIRST, -1)  # which has the traceback that leads to where it happened
        # All of MPI's ranks wait for each other at the end, so that those outside of the communicator count.
        world = getattr(sys.modules.get(type(self.comm).__module__), "COMM_WORLD", self.comm)
        some_go_on = len(failed) < world.size
        if self.comm.rank == (first if first in failed else min(failed)):
            self._show(failed, kind, error, trace)
        elif some_go_on:
            time.sleep(5 * PATIENCE)  # the first ends us meanwhile
        if some_go_on:
            world.Abort(1)

    def _failed(self, line: str) -> dict[int, str]:
        """Return the ranks that fail at about this time, and how each."""
        size, rank = self.comm.size, self.comm.rank
        others = [r for r in range(size) if r != rank]
        sent = [self.comm.isend(line, dest=r, tag=FAILED) for r in others]
        failed = {rank: line}
        end = time.monotonic() + PATIENCE
        while len(failed) < size and time.monotonic() < end:
            for r in others:
                if r not in failed and self.comm.iprobe(source=r, tag=FAILED):
                    failed[r] = self.comm.recv(source=r, tag=FAILED)
            time.sleep(0.01)
        for request in sent:
            request.test()
        return failed

    def _show(
        self, failed: dict[int, str], kind: type[BaseException], error: BaseException, trace: TracebackType | None
    ) -> None:
        size, rank = self.comm.size, self.comm.rank
        alike = len(failed) == size and len(set(failed.values())) == 1
        if not alike:
            sys.stderr.write(f"rank {rank} of {size}:\n")
        self.shows(kind, error, trace)
        for other in sorted(failed.keys() - {rank}) if not alike else ():
            sys.stderr.write(f"rank {other} of {size} failed, too: {failed[other]}\n")
        sys.stderr.flush()
