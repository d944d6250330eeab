"""Goals on several ranks: value and indicators are what a serial run comes to."""

from collections.abc import Callable
from functools import partial
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
from compared import same_as_in_serial
from goals import LINEAR, NONLINEAR, Problem
from problems import uniformly_refined

from thccs_fem import adapt, estimate, fem
from thccs_fem.fem.petsc import LinearProblem, NonlinearProblem
from thccs_fem.partition import partition

MUMPS = {"ksp_type": "preonly", "pc_type": "lu", "pc_factor_mat_solver_type": "mumps"}
PROBLEMS = [
    "flux through a side",
    "with advection",
    "displacement of a side",
    "with free constants",
    "clamped plate",
    "hot conductor",
]
direct = partial(LinearProblem, petsc_options=MUMPS)


def refined(V: fem.FunctionSpace) -> fem.FunctionSpace:
    for step in range(2):
        V = adapt.refine(V, np.random.default_rng(step).integers(0, V.num_functions, 4))
    return V


@pytest.mark.parametrize("name", PROBLEMS)
def test_value_and_indicators(name: str) -> None:
    make: Callable[[Any], Problem] = (LINEAR | NONLINEAR)[name]

    def found(comm: MPI.Comm) -> dict[str, Any]:
        problem = make(comm)
        V = refined(problem.V)
        if name in LINEAR:
            uh = problem.solve(V, direct)
        else:
            uh = problem.solve_by_newton(V, NonlinearProblem)
        eta, value = estimate.goal(uh, *problem.forms(uh), fixed=problem.bcs, problem=direct)
        assert eta.shape == (V.cells.num_owned,)
        return {"value": value, "squares": partition(V.hierarchy).cells.gather(eta**2)}

    same_as_in_serial(found, tol=1e-5)  # values are differences of goals of size 1, the smallest 1.5e-9


def test_a_run_marks_the_same() -> None:
    def run(comm: MPI.Comm) -> dict[str, Any]:
        problem = LINEAR["L-shaped"](comm)

        def indicators(uh: fem.Function) -> Any:
            return estimate.goal(uh, *problem.forms(uh), fixed=problem.bcs, problem=direct)

        stop = adapt.Stop(steps=4)
        history = adapt.solve(problem.V, lambda V: problem.solve(V, direct), indicators, stop=stop, progress=False)
        return {"dofs": history["dofs"].astype(int), "estimates": history["estimate"]}

    same_as_in_serial(run, tol=1e-8)


def test_scipy_names_who_works_on_several_ranks(comm: MPI.Comm) -> None:
    problem = LINEAR["mean over a part"](comm)
    uh = problem.solve(problem.V, direct)
    if comm.size > 1:
        with pytest.raises(NotImplementedError, match=r"fem\.petsc\.LinearProblem"):
            estimate.goal(uh, *problem.forms(uh), fixed=fem.boundary_dofs)


def test_what_one_rank_gets_wrong_is_refused_by_all(comm: MPI.Comm) -> None:
    problem = LINEAR["mean over a part"](comm)
    uh = problem.solve(problem.V, direct)

    def fixed(V: fem.FunctionSpace) -> Any:
        last = comm.rank == comm.size - 1
        return np.array([V.index_map.numbers.size]) if last else fem.region_dofs(V, [0])

    with pytest.raises((ValueError, RuntimeError), match="dofs run from 0"):
        estimate.goal(uh, *problem.forms(uh), fixed=fixed, problem=direct)
    assert uniformly_refined(problem.V).num_dofs > problem.V.num_dofs  # all ranks are here


def test_dofs_are_found_anew(comm: MPI.Comm) -> None:
    problem = LINEAR["mean over a part"](comm)
    uh, found = problem.solve(problem.V, direct), fem.boundary_dofs(problem.V)
    with pytest.raises(ValueError, match=r"fixed returned the same dofs for the space of uh and for its refinement"):
        estimate.goal(uh, *problem.forms(uh), fixed=lambda W: found, problem=direct)
