"""Nonlinear problems on several ranks: the iterates of one, and the same errors everywhere."""

from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
from compared import same_as_in_serial
from spread import CLOSED, WITH_RIM, by_number, space, whole

import ufl
from thccs_fem import fem
from thccs_fem.fem.petsc import NonlinearProblem
from ufl import dx, grad, inner

GMRES = {"ksp_type": "gmres", "pc_type": "jacobi", "ksp_rtol": 1e-13}


@pytest.mark.parametrize("options", [{}, GMRES], ids=["chosen", "gmres"])
@pytest.mark.parametrize("name", WITH_RIM)
def test_prescribed_values(name: str, options: dict[str, Any]) -> None:
    """The initial guess does not satisfy them, so that the first residual has a part of the Jacobian."""

    def work(comm: MPI.Comm) -> list[Any]:
        V = space(WITH_RIM[name], comm)
        u, v = fem.Function(V), ufl.TestFunction(V)
        F = (1.0 + u**2) * inner(grad(u), grad(v)) * dx - by_number(V) * v * dx
        bcs = [fem.dirichletbc(0.3, fem.boundary_dofs(V), V)]
        problem = NonlinearProblem(F, u, bcs=bcs, petsc_options_prefix="w_", petsc_options=options)
        problem.solve()
        return [whole(u), problem.norms[:2]]

    same_as_in_serial(work)


@pytest.mark.parametrize("name", CLOSED)
def test_constants_in_the_kernel(name: str) -> None:
    def work(comm: MPI.Comm) -> list[Any]:
        V = space(CLOSED[name], comm)
        u, v = fem.Function(V), ufl.TestFunction(V)
        F = (1.0 + inner(grad(u), grad(u))) * inner(grad(u), grad(v)) * dx
        F -= 0.1 * inner(grad(by_number(V)), grad(v)) * dx
        NonlinearProblem(F, u, petsc_options_prefix="k_").solve()
        return [whole(u)]

    same_as_in_serial(work)


@pytest.mark.parametrize("kind", ["mpi", "nest"])
def test_two_unknowns(kind: Any) -> None:
    def work(comm: MPI.Comm) -> list[Any]:
        V = space(WITH_RIM["l domain"], comm)
        a, b, v, w = fem.Function(V), fem.Function(V), ufl.TestFunction(V), ufl.TestFunction(V)
        F = [
            inner(grad(a), grad(v)) * dx + (a**3 + b - 1.0) * v * dx,
            inner(grad(b), grad(w)) * dx + (b**3 - a) * w * dx,
        ]
        bcs: Any = [[fem.dirichletbc(0.1, fem.boundary_dofs(V), V)], []]
        options = {} if kind == "mpi" else {"ksp_rtol": 1e-13}
        NonlinearProblem(F, [a, b], bcs=bcs, petsc_options_prefix="b_", petsc_options=options, kind=kind).solve()
        return [whole(a), whole(b)]

    same_as_in_serial(work)


def no_root(comm: MPI.Comm) -> tuple[ufl.Form, fem.Function]:
    V = space(WITH_RIM["l domain"], comm)
    u = fem.Function(V)
    return (u**2 + 1.0) * ufl.TestFunction(V) * dx, u


def values_of_one_rank(comm: MPI.Comm) -> tuple[ufl.Form, fem.Function]:
    F, u = no_root(comm)
    f = by_number(u.function_space)
    if comm.rank == comm.size - 1:
        f.x.array[:] = np.nan
    return F + f * ufl.TestFunction(u.function_space) * dx, u


@pytest.mark.parametrize("make", [no_root, values_of_one_rank])
def test_all_ranks_fail_alike(comm: MPI.Comm, make: Any) -> None:
    F, u = make(comm)
    with pytest.raises(RuntimeError, match="failed after") as caught:
        NonlinearProblem(F, u, petsc_options_prefix="f_").solve()
    assert len(set(comm.allgather(str(caught.value)))) == 1


def test_loads_without_a_solution(comm: MPI.Comm) -> None:
    V = space(CLOSED["torus"], comm)
    u, v = fem.Function(V), ufl.TestFunction(V)
    with pytest.raises(ValueError, match="there is no solution") as caught:
        NonlinearProblem((inner(grad(u), grad(v)) - v) * dx, u, petsc_options_prefix="l_").solve()
    assert len(set(comm.allgather(str(caught.value)))) == 1
