"""Runs that are killed (SIGKILL) and started again: ``python killing.py WHAT FOLDER``, for test_checkpoint.py.

Each run is a process forked from this one, which has all imported and compiled by then.  A process of its own, since to
fork is safe only where there are no threads and no MPI.
"""

import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

import ufl
from thccs_fem import adapt, checkpoint, estimate, fem, generators
from thccs_fem.fem.scipy import LinearProblem
from thccs_fem.forms import poisson
from thccs_fem.mesh import ControlMesh

STEPS = 5
MODULE = str(Path(checkpoint.__file__))


def forked(work: Callable[[], object]) -> int:
    """Start work in a process of its own, and return its number."""
    child = os.fork()
    if child == 0:
        try:
            work()
            os._exit(0)
        finally:
            os._exit(1)
    return child


def was_killed(child: int) -> bool:
    """Wait for a process; return whether it was killed, rather than done."""
    _, status = os.waitpid(child, 0)
    assert os.WIFSIGNALED(status) or os.WEXITSTATUS(status) == 0, "a run failed by itself"
    return os.WIFSIGNALED(status)


def killed_after(seconds: float, work: Callable[[], object]) -> bool:
    """Do work and kill it after some time; return whether it was not done by then."""
    child = forked(work)
    time.sleep(seconds)
    os.kill(child, signal.SIGKILL)
    return was_killed(child)


def killed_at_line(number: int, work: Callable[[], object]) -> bool:
    """Do work and kill it when it has run so many lines of checkpoint.py; return whether it was not done by then."""
    left = number

    def trace(frame: FrameType, event: str, argument: Any) -> Any:
        nonlocal left
        if frame.f_code.co_filename != MODULE:
            return None
        if event == "line":
            left -= 1
        if left == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        return trace

    def traced() -> None:
        sys.settrace(trace)
        work()

    return was_killed(forked(traced))


def state(V: fem.FunctionSpace, step: int) -> fem.Function:
    """Return a function that tells which step it is of, in every value."""
    u = fem.Function(V, "u")
    u.x.array[:] = step
    return u


def step_in(path: Path, msh: ControlMesh) -> int:
    """Return the step that a checkpoint is of, if it is whole; -1 if there is none."""
    if not path.exists():
        return -1
    saved = checkpoint.read(path, mesh=msh)
    step: int = saved.attributes["step"]
    assert (saved.functions["u"].x.array == step).all(), "values of several steps"
    return step


def at_every_line(folder: Path) -> None:
    """Kill a write at every line: what is there then is the state before or, from some line on, the new one."""
    path = folder / "state.h5"
    V = fem.functionspace(generators.rectangle((3, 3)), ("THCCS", 3))
    checkpoint.write(path, state(V, 0), {"step": 0})
    line, last, is_new = 0, 0, []
    killed = True
    while killed:
        line += 1
        killed = killed_at_line(line, lambda step=line: checkpoint.write(path, state(V, step), {"step": step}))
        found = step_in(path, V.mesh)
        assert found in (last, line), "neither the state before nor the new one"
        is_new.append(found == line)
        last = found
    assert is_new == sorted(is_new)
    assert is_new.index(True) > 50, "not killed at every line"
    assert list(folder.iterdir()) == [path], "leftovers"


def while_writing(folder: Path) -> None:
    """Kill a run that only writes at random moments: what is there is a whole state, no older than before."""
    path = folder / "state.h5"
    V = fem.functionspace(generators.torus((24, 24)), ("THCCS", 3))
    last, rng = -1, np.random.default_rng(1)

    def run() -> None:
        for step in range(last + 1, 10**9):
            checkpoint.write(path, state(V, step), {"step": step})

    drafts = 0
    for seconds in rng.uniform(0.0, 0.05, 60):
        assert killed_after(seconds, run)
        drafts += path.with_name(path.name + ".part").exists()
        found = step_in(path, V.mesh)
        assert found >= last, "older than before"
        last = found
    assert drafts > 0, "never killed while writing"


def adaptive(folder: Path) -> None:
    """Kill an adaptive run at random moments until it is done: its result is that of a run without an interruption."""
    msh = generators.l_domain(2)
    V = fem.functionspace(msh, ("THCCS", 3))
    f = fem.Constant(msh, 1.0)

    def solver(V: fem.FunctionSpace) -> fem.Function:
        u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
        bc = fem.dirichletbc(0.0, fem.boundary_dofs(V), V)
        return LinearProblem(poisson.a(u, v), poisson.L(f, v), bcs=[bc]).solve()

    def run(path: Path | None) -> adapt.History:
        return adapt.solve(
            V,
            solver,
            lambda u: estimate.residual(u, poisson.strong_residual(u, f)),
            stop=adapt.Stop(steps=STEPS),
            progress=False,
            checkpoint=path,
        )

    run(None)  # compiles what is not compiled yet
    start = time.perf_counter()
    whole = run(None)
    seconds = time.perf_counter() - start
    rng, kills = np.random.default_rng(2), 0
    for trial in range(2):
        path, most = folder / f"{trial}.h5", 0.7 * seconds
        while killed_after(rng.uniform(0.0, most), lambda path=path: run(path)):
            kills, most = kills + 1, 1.1 * most  # once it is long enough, however slow the machine gets
        history = run(path)  # reads only
        assert [s.number for s in history.steps] == list(range(STEPS + 1))
        for step, expected in zip(history.steps, whole.steps, strict=True):
            assert (step.levels, step.elements, step.dofs) == (expected.levels, expected.elements, expected.dofs)
            assert step.estimate == expected.estimate
        np.testing.assert_array_equal(history.solution.x.array, whole.solution.x.array)
    assert kills > 0, "never killed"


if __name__ == "__main__":
    runs = {"at_every_line": at_every_line, "while_writing": while_writing, "adaptive": adaptive}
    runs[sys.argv[1]](Path(sys.argv[2]))
