"""Tests that several ranks run together: `mpirun -n 2 python -m pytest tests/parallel/test_x.py`.

Each rank runs all tests, and what comes out of a test is the same on all: it fails everywhere where it failed
anywhere. Rank 0 prints for all. A rank that fails while others wait for it, in the middle of a test, ends all of them;
so does a time limit. `tests/mpi/test_on_ranks.py` runs all files on 2 and on 3 ranks.
"""

import faulthandler
import os
import time
from collections.abc import Generator
from pathlib import Path
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import pytest

TIME_LIMIT = 120.0  # seconds a test; on two processors, idle otherwise, the longest takes ten
PATIENCE = 10.0  # seconds that a rank on which a test failed waits for the others to end the test
OUTCOMES = ("passed", "skipped", "failed")


@pytest.fixture
def comm() -> MPI.Comm:
    """All ranks."""
    return MPI.COMM_WORLD


@pytest.fixture
def folder(comm: MPI.Comm, tmp_path: Path) -> Path:
    """An empty folder, the same one on all ranks."""
    return comm.bcast(tmp_path)


@pytest.hookimpl(trylast=True)  # once there is a terminal reporter
def pytest_configure(config: pytest.Config) -> None:
    config.pluginmanager.register(Together(config))


class Together:
    """Makes of the ranks' runs one. It talks on a communicator of its own, out of the way of the tests'."""

    def __init__(self, config: pytest.Config) -> None:
        self.comm = MPI.COMM_WORLD.Dup()
        self.stderr = os.fdopen(os.dup(2), "w")  # the terminal: nothing is captured yet
        if self.comm.rank:
            config.pluginmanager.unregister(name="terminalreporter")

    def pytest_collection_finish(self, session: pytest.Session) -> None:
        collected = self.comm.allgather((session.testsfailed, [item.nodeid for item in session.items]))
        if any(other != collected[0] for other in collected):
            counts = [(f"{len(names)} tests, {errors} errors") for errors, names in collected]
            pytest.exit(f"the ranks have not collected the same: {counts}", returncode=1)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self) -> Generator[None, object, object]:
        # Ranks that wait for each other for ever: each shows where it is, and then the first ends them.
        is_first = self.comm.rank == 0
        faulthandler.dump_traceback_later(TIME_LIMIT + 2 * is_first, exit=is_first, file=self.stderr)
        result = yield
        faulthandler.cancel_dump_traceback_later()
        PETSc.garbage_cleanup()  # frees what Python has let go of, which is up to all ranks together
        return result

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(
        self, item: pytest.Item, call: pytest.CallInfo[None]
    ) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        report = yield
        outcomes = self._outcomes(report)
        if len(set(outcomes)) > 1 or report.failed:
            texts = self.comm.allgather(f"{report.outcome}\n{_text(report)}")
            report.outcome = "failed"
            report.longrepr = "\n".join(f"rank {rank} of {len(texts)}: {text}" for rank, text in enumerate(texts))
        return report

    def _outcomes(self, report: pytest.TestReport) -> list[Any]:
        """Return the outcome of each rank."""
        mine = np.array([OUTCOMES.index(report.outcome)])
        outcomes = np.zeros(self.comm.size, dtype=mine.dtype)
        request = self.comm.Iallgather(mine, outcomes)
        start = time.monotonic()
        while not request.Test():
            time.sleep(1e-3)  # so that who waits is not in the way of who works
            if report.failed and time.monotonic() > start + PATIENCE:
                rank, size = self.comm.rank, self.comm.size
                self.stderr.write(
                    f"rank {rank} of {size}: {report.nodeid} failed, and others did not end it within {PATIENCE} s:\n"
                    f"{_text(report)}\n"
                )
                self.stderr.flush()
                self.comm.Abort(1)
        return outcomes.tolist()


def _text(report: pytest.TestReport) -> str:
    """Return all that there is to say of a test on this rank."""
    sections = [f"--- {name}\n{content}" for name, content in report.sections]
    return "\n".join([report.longreprtext, *sections])
