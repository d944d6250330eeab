"""An adaptive run on 2 ranks, all of them killed, goes on on 1 rank and on 3: to where it would have come by itself."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from launch import run_on_ranks

RUN = """
import os, signal, sys, threading
from mpi4py import MPI
import numpy as np
import ufl
from thccs_fem import adapt, checkpoint, estimate, fem, generators
from thccs_fem.fem.petsc import LinearProblem
from thccs_fem.forms import poisson

DIRECT = {"ksp_type": "preonly", "pc_type": "lu", "pc_factor_mat_solver_type": "mumps"}


def run(comm, path, kill_in=None, seconds=0.0):
    msh = generators.l_domain(2, comm=comm)
    f, done = fem.Constant(msh, 1.0), 0

    def solver(V):
        u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
        bc = fem.dirichletbc(0.0, fem.boundary_dofs(V), V)
        a, L = poisson.a(u, v), poisson.L(f, v)
        return LinearProblem(a, L, bcs=[bc], petsc_options_prefix="run_", petsc_options=DIRECT).solve()

    def estimator(u):
        nonlocal done
        done += 1
        if done == kill_in:
            threading.Timer(seconds, os.kill, (os.getpid(), signal.SIGKILL)).start()
        return estimate.residual(u, poisson.strong_residual(u, f))

    V = fem.functionspace(msh, ("THCCS", 3))
    history = adapt.solve(V, solver, estimator, stop=adapt.Stop(steps=4), checkpoint=path, progress=False)
    u = history.solution
    return done, [(s.dofs, s.elements) for s in history.steps], [s.estimate for s in history.steps], (
        u.x.index_map.gather(u.x.array)
    )


"""
KILLED = RUN + "run(MPI.COMM_WORLD, sys.argv[1], int(sys.argv[2]), float(sys.argv[3]))"
CONTINUED = (
    RUN
    + """
several = run(MPI.COMM_WORLD, "on_3.h5")
if MPI.COMM_WORLD.rank == 0:
    solved, sizes, estimates, values = run(MPI.COMM_SELF, None)
    for done, *found in several, run(MPI.COMM_SELF, "on_1.h5"):
        assert done < solved == 5
        assert found[0] == sizes
        np.testing.assert_allclose(found[1], estimates, rtol=1e-10)
        np.testing.assert_allclose(found[2], values, atol=1e-10 * abs(values).max())
    print("as it would have come by itself")
"""
)


@pytest.mark.parametrize("seed", [1])
def test_run_goes_on_on_other_ranks(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    (tmp_path / "killed.py").write_text(KILLED)
    (tmp_path / "continued.py").write_text(CONTINUED)
    when = str(rng.integers(2, 5)), str(rng.uniform(0.0, 0.05))  # the step, and seconds after its solution is there
    code, output = run_on_ranks(2, "killed.py", "run.h5", *when, cwd=tmp_path)
    assert "KILLED BY SIGNAL: 9" in output or "EXIT CODE: 9" in output, (code, output)
    for name in ("on_1.h5", "on_3.h5"):
        shutil.copy(tmp_path / "run.h5", tmp_path / name)
    code, output = run_on_ranks(3, "continued.py", cwd=tmp_path)
    assert (code, output) == (0, "as it would have come by itself\n")
