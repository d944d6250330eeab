"""What users' scripts do besides solving: ask for nothing, give functions that fail, integrate in other ways."""

import warnings
from collections.abc import Callable

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
import pytest
from compared import same_as_in_serial
from spread import by_number, refined, whole

import ufl
from thccs_fem import fem, generators, parallel, quadrature
from thccs_fem.extraction import Cells
from thccs_fem.fem.petsc import LinearProblem
from thccs_fem.hierarchy import Hierarchy
from thccs_fem.mesh import ControlMesh
from ufl import dx, grad, inner

Floats = npt.NDArray[np.float64]


def test_a_rank_may_ask_for_no_values(comm: MPI.Comm) -> None:
    u = by_number(fem.functionspace(generators.torus((6, 4), comm=comm), ("THCCS", 3)))
    expected = u.eval([0, 3], [(0.5, 0.5), (0.1, 0.2)])
    asks = comm.rank == 1
    found = u.eval([0, 3], [(0.5, 0.5), (0.1, 0.2)]) if asks else u.eval([], [])
    np.testing.assert_allclose(found, expected if asks else np.zeros(0), rtol=0, atol=1e-14)


def test_region_that_fails_on_one_rank_fails_on_all(comm: MPI.Comm) -> None:
    def ball(x: Floats) -> Floats:
        if comm.rank == 1:
            raise ArithmeticError("no value")
        return 0.5 - (x**2).sum(axis=0)

    with pytest.raises(ArithmeticError, match=rf"^rank 1 of {comm.size}: no value$"):
        generators.implicit_surface(ball, (6, 6, 6), comm=comm)


def test_ranks_know_whether_all_arrive(comm: MPI.Comm, monkeypatch: pytest.MonkeyPatch) -> None:
    own = comm.Dup()  # on which one message is on its way until the last rank comes
    assert parallel.all_arrive(own)
    monkeypatch.setattr(parallel, "PATIENCE", 0.1)
    if comm.rank == 1:
        comm.barrier()
        assert parallel.all_arrive(own)
    else:
        assert not parallel.all_arrive(own)
        comm.barrier()


def warnings_of(work: Callable[[], object]) -> list[str]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        work()
    return [str(w.message) for w in caught]


def test_rank_0_warns_of_shallow_caps(comm: MPI.Comm) -> None:
    V = fem.functionspace(generators.cube_sphere(2, comm=comm), ("THCCS", 3))
    v = ufl.TestFunction(V)
    found = warnings_of(lambda: fem.form(ufl.div(grad(v)) * dx))
    assert [text[:31] for text in found] == ["the form has second derivatives"] * (comm.rank == 0)


def test_rank_0_warns_of_options_without_use(comm: MPI.Comm) -> None:
    V = fem.functionspace(generators.torus((6, 4), comm=comm), ("THCCS", 3))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    problem = LinearProblem(u * v * dx, v * dx, petsc_options_prefix="unused_", petsc_options={"ksp_tipe": "cg"})
    found = warnings_of(problem.solve)
    assert [text[:36] for text in found] == ["PETSc made no use of the options ['k"] * (comm.rank == 0)
    assert not warnings_of(problem.solve)


@pytest.mark.parametrize("rule", [quadrature.paper_cells, quadrature.without_caps(3)], ids=["paper", "without caps"])
def test_solution_with_another_integration(rule: Callable[[Hierarchy], Cells]) -> None:
    def solved(comm: MPI.Comm) -> list[Floats]:
        msh: ControlMesh = generators.cube_sphere(2, comm=comm)
        V = refined(fem.functionspace(msh, ("THCCS", 3))).with_integration(rule)
        u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
        a, L = inner(grad(u), grad(v)) * dx + u * v * dx, ufl.SpatialCoordinate(msh)[0] * v * dx
        uh = LinearProblem(a, L, petsc_options_prefix="rule_").solve()
        return [whole(uh), uh.eval([0, 9], [(0.5, 0.5), (0.0, 0.0)])]

    same_as_in_serial(solved)
