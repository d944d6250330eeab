"""Scripts and tests on several ranks, in processes of their own, which end in time."""

import functools
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

__all__ = ["run_on_ranks"]

ROOT = Path(__file__).parents[2]
TIME_LIMIT = 180.0  # seconds; ranks that wait for each other wait for ever


@functools.cache
def launcher() -> str:
    """Return the mpirun of mpi4py's MPI: that of the same environment, else the one on the path."""
    pytest.importorskip("mpi4py.MPI")
    pytest.importorskip("petsc4py")
    beside = Path(sys.executable).with_name("mpirun")
    found = str(beside) if beside.exists() else shutil.which("mpirun")
    if found is None:
        pytest.skip("there is no mpirun")
    script = "from mpi4py import MPI; assert MPI.COMM_WORLD.size == 2"
    probe = [found, "-n", "2", sys.executable, "-c", script]
    done = subprocess.run(probe, capture_output=True, text=True, timeout=TIME_LIMIT, check=False)
    if done.returncode:
        pytest.fail(f"{found} does not start 2 ranks that find each other: is it of mpi4py's MPI?\n{done.stderr}")
    return found


def run_on_ranks(
    size: int, *arguments: str | os.PathLike[str], time_limit: float = TIME_LIMIT, cwd: Path = ROOT, **environ: str
) -> tuple[int, str]:
    """Run Python with the arguments on so many ranks; skip the test without MPI, fail it if they don't end in time.

    Args:
        size: Number of ranks.
        arguments: Of each Python.
        time_limit: Seconds.
        cwd: Where to run.
        environ: More of the environment.

    Returns:
        The exit code, and all that the ranks wrote to stdout and stderr.
    """
    command = [launcher(), "-n", str(size), sys.executable, *arguments]
    # Ranks of MPICH that wait keep their processor busy, others want it where there are more ranks than processors.
    ours = {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT), "MPIR_CVAR_CH4_PROGRESS_THROTTLE": "1"}
    variables = {**os.environ, **ours, **environ}
    with subprocess.Popen(
        command,
        cwd=cwd,
        env=variables,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    ) as process:
        try:
            output, _ = process.communicate(timeout=time_limit)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            output, _ = process.communicate()
            pytest.fail(f"{size} ranks have not ended within {time_limit} s, and were killed:\n{output}", pytrace=False)
    return process.returncode, output
