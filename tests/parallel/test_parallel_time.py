"""Problems in time on several ranks: the states of one, also where the space changes."""

from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
from compared import same_as_in_serial
from spread import CLOSED, WITH_RIM, by_number, refined, space, whole

import ufl
from thccs_fem import adapt, fem
from thccs_fem.fem.petsc import TimeProblem
from thccs_fem.fem.space import FunctionSpace
from ufl import dx, grad, inner

TIGHT = {"snes_rtol": 1e-13}
SCHEMES = ["implicit_euler", "bdf2", "crank_nicolson"]


def rising(V: FunctionSpace, time: float) -> list[fem.DirichletBC]:
    return [fem.dirichletbc(np.sin(time), fem.boundary_dofs(V), V)]


@pytest.mark.parametrize("scheme", SCHEMES)
def test_spaces_may_change(scheme: Any) -> None:
    def work(comm: MPI.Comm) -> list[Any]:
        V = space(WITH_RIM["l domain"], comm)
        u, udot, v = by_number(V), fem.Function(V), ufl.TestFunction(V)
        F = (udot + u**3 - u) * v * dx + 0.1 * inner(grad(u), grad(v)) * dx
        problem = TimeProblem(
            F, u, udot, dt=0.02, scheme=scheme, bcs=rising, petsc_options_prefix="t_", petsc_options=TIGHT
        )
        states = [whole(problem.solve(0.04))]
        problem = problem.with_space(refined(V), adapt.transfer)
        states.append(whole(problem.solve(0.06)))
        problem.u.x.array[:] *= 0.5  # what was before is no history
        return [*states, whole(problem.solve(0.08))]

    same_as_in_serial(work)


def test_adaptive_steps_on_a_closed_surface() -> None:
    """Step sizes are the same on all ranks, and the mass stays."""

    def work(comm: MPI.Comm) -> list[Any]:
        V = space(CLOSED["sphere"], comm)
        u, udot, v = by_number(V), fem.Function(V), ufl.TestFunction(V)
        F = udot * v * dx + inner(grad(u), grad(v)) * dx
        options = {**TIGHT, "ts_adapt_type": "basic"}
        problem = TimeProblem(F, u, udot, dt=0.01, petsc_options_prefix="a_", petsc_options=options)
        mass = fem.form(u * dx)
        before = comm.allreduce(fem.assemble_scalar(mass))
        for _ in range(2):
            problem.step()
        assert comm.allreduce(fem.assemble_scalar(mass)) == pytest.approx(before, abs=1e-12)
        return [whole(u), problem.time, problem.dt]

    same_as_in_serial(work)


@pytest.mark.parametrize("is_nan", [True, False])
def test_all_ranks_fail_alike_and_go_back(comm: MPI.Comm, is_nan: bool) -> None:
    V = space(WITH_RIM["l domain"], comm)
    u, udot, v = by_number(V), fem.Function(V), ufl.TestFunction(V)
    f = fem.Function(V)
    F = (udot + f * u**2) * v * dx if is_nan else (udot**2 + 1.0) * v * dx
    if comm.rank == comm.size - 1:
        f.x.array[:] = np.nan
    before = u.x.array.copy()
    problem = TimeProblem(F, u, udot, dt=0.1, petsc_options_prefix="f_")
    with pytest.raises(RuntimeError, match=r"failed in the step from t = 0 with dt = 0\.1") as caught:
        problem.step()
    assert len(set(comm.allgather(str(caught.value)))) == 1
    np.testing.assert_array_equal(u.x.array, before)
    assert problem.time == 0.0
