"""Matrices, vectors and linear problems on several ranks: those of one, and the same errors everywhere."""

from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import pytest
from compared import same_as_in_serial
from spread import CLOSED, WITH_RIM, Maker, by_number, refined, space, whole

import ufl
from thccs_fem import fem, generators
from thccs_fem.fem import petsc, scipy
from thccs_fem.fem.layout import Layout
from thccs_fem.fem.linear import is_symmetric
from thccs_fem.fem.petsc import LinearProblem
from thccs_fem.fem.space import FunctionSpace
from thccs_fem.parallel import size_of
from ufl import dS, ds, dx, grad, inner, jump

MUMPS = {"ksp_type": "preonly", "pc_type": "lu", "pc_factor_mat_solver_type": "mumps"}
CG = {"ksp_type": "cg", "pc_type": "jacobi", "ksp_rtol": 1e-13}
GAMG = {"ksp_type": "cg", "pc_type": "gamg", "ksp_rtol": 1e-13}
SOLVERS: dict[str, dict[str, Any]] = {"chosen": {}, "mumps": MUMPS, "cg": CG, "gamg": GAMG}
FIELDS = {
    "ksp_type": "gmres",
    "ksp_rtol": 1e-14,
    "ksp_gmres_restart": 200,
    "pc_type": "fieldsplit",
    **{f"fieldsplit_{i}_pc_type": "jacobi" for i in (0, 1)},
}


def energy(V: FunctionSpace, mass: float = 0.0) -> ufl.Form:
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    return (inner(grad(u), grad(v)) + mass * inner(u, v)) * dx


# ---- Matrices and vectors


@pytest.mark.parametrize("name", WITH_RIM)
@pytest.mark.parametrize("shape", [(), (2,)])
def test_matrices_and_vectors_as_scripts_use_them(name: str, shape: tuple[int, ...]) -> None:
    def work(comm: MPI.Comm) -> list[Any]:
        V = space(WITH_RIM[name], comm, shape)
        f, v = by_number(V), ufl.TestFunction(V)
        a, L = fem.form(energy(V, mass=1.0)), fem.form(inner(f, v) * dx + inner(f, v) * ds)
        bcs = [fem.dirichletbc(0.5, fem.boundary_dofs(V), V.sub(0) if shape else V)]
        A = petsc.assemble_matrix(a, bcs=bcs)
        assert A.getBlockSize() == V.block_size
        assert A.getOwnershipRange() == tuple(V.block_size * n for n in V.index_map.local_range)
        b = petsc.assemble_vector(L)
        petsc.assemble_vector(b, L)
        x0 = b.duplicate()
        x0.set(0.25)
        petsc.apply_lifting(b, [a], [bcs], [x0], 0.5)
        b.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)  # as DOLFINx needs it
        petsc.set_bc(b, bcs, x0)
        u = fem.Function(V)
        x, y = A.createVecs()
        x.array = f.x.array[: V.num_owned_dofs]
        A.mult(x, y)
        u.x.array[: V.num_owned_dofs] = y.array
        u.x.scatter_forward()
        nonzeros = A.getInfo(PETSc.Mat.InfoType.GLOBAL_SUM)["nz_used"]
        petsc.assemble_matrix(A, a)
        rows = V.index_map.gather(b.array.reshape(-1, V.block_size))
        return [rows, whole(u), nonzeros, A.norm()]

    same_as_in_serial(work, tol=1e-13)  # sums in another order


def test_arguments_on_different_hierarchies() -> None:
    """Rows go by the ranks of the test space, columns by those of the trial space: some entries have to travel."""

    def work(comm: MPI.Comm) -> list[Any]:
        coarse = space(WITH_RIM["l domain"], comm)
        fine = refined(coarse)
        finest = FunctionSpace(refined(fine).hierarchy, (2,))
        n, f = ufl.FacetNormal(coarse.mesh), by_number(finest)
        result: list[Any] = []
        for test, trial in ((coarse, fine), (fine, coarse), (coarse, coarse)):
            u, v, g = ufl.TrialFunction(trial), ufl.TestFunction(test), by_number(trial)
            a = fem.form(f[0] * u * v * dx + inner(jump(grad(u), n), jump(grad(v), n)) * dS)
            A = petsc.assemble_matrix(a)
            petsc.assemble_matrix(A, a)
            x, y = A.createVecs()
            x.array = g.x.array[: trial.num_owned_dofs]
            A.mult(x, y)
            b = petsc.assemble_vector(fem.form(v * dx))
            petsc.apply_lifting(b, [a], [[fem.dirichletbc(1.0, fem.boundary_dofs(trial), trial)]])
            result += [test.index_map.gather(vector.array) for vector in (y, b)]
            result.append(A.getInfo(PETSc.Mat.InfoType.GLOBAL_SUM)["nz_used"])
        return result

    same_as_in_serial(work, tol=1e-13)  # as above


def test_columns_that_a_rank_does_not_hold_are_refused() -> None:
    coarse = space(lambda comm: generators.l_domain(4, comm=comm), MPI.COMM_WORLD)
    fine = refined(refined(coarse))
    with pytest.raises(NotImplementedError, match=r"are in columns that it does not hold.* use fem\.petsc\.assemble"):
        fem.assemble_matrix(fem.form(ufl.TrialFunction(fine) * ufl.TestFunction(coarse) * dx))


def test_symmetry_is_seen_across_ranks(comm: MPI.Comm) -> None:
    V = space(CLOSED["torus"], comm)
    A = fem.assemble_matrix(fem.form(energy(V)))
    numbering = Layout((V,)).numbering
    assert numbering is not None
    assert is_symmetric(A, numbering)
    ghosts = np.flatnonzero(A.indices >= V.num_owned_dofs)
    assert ghosts.size
    if comm.rank == comm.size - 1:
        A.data[ghosts[0]] += 1e-6
    assert not is_symmetric(A, numbering)


# ---- Problems


@pytest.mark.parametrize("solver", ["chosen", "cg"])
@pytest.mark.parametrize(("name", "shape"), [("l domain", ()), ("wheel", (2,)), ("one cell", ())])
def test_prescribed_values(name: str, shape: tuple[int, ...], solver: str) -> None:
    def work(comm: MPI.Comm) -> list[Any]:
        V = space(WITH_RIM[name], comm, shape)
        x, v = ufl.SpatialCoordinate(V.mesh), ufl.TestFunction(V)
        g = ufl.as_vector([x[0], ufl.sin(x[1])]) if shape else ufl.sin(x[0])
        bcs = [fem.dirichletbc(g, fem.boundary_dofs(V, lambda x: x[0] < 0.5), V)]
        load = fem.assemble_vector(fem.form(inner(by_number(V, 1), v) * dx))
        L = inner(by_number(V), v) * dx
        problem = LinearProblem(
            energy(V, mass=1.0), L, bcs=bcs, load=load, petsc_options_prefix="w_", petsc_options=SOLVERS[solver]
        )
        first = whole(problem.solve())
        problem.bcs = [fem.dirichletbc(1.0, fem.boundary_dofs(V), V)]
        return [first, whole(problem.solve()), problem.solver.getPC().getType()]

    same_as_in_serial(work)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize(("name", "shape"), [("torus", ()), ("sphere", (3,)), ("few cells", ()), ("two parts", (2,))])
def test_constants_in_the_kernel(name: str, shape: tuple[int, ...], solver: str) -> None:
    """There are as many as parts of the surface times components, and the ranks share them."""

    def work(comm: MPI.Comm) -> list[Any]:
        V = space(CLOSED[name], comm, shape)
        L = inner(grad(by_number(V)), grad(ufl.TestFunction(V))) * dx
        problem = LinearProblem(energy(V), L, petsc_options_prefix="k_", petsc_options=SOLVERS[solver])
        u = whole(problem.solve())
        constants = problem._system.constants
        assert constants is not None
        return [u, constants.num_constants, constants.areas]

    (_, count, _) = same_as_in_serial(work)
    assert count == (2 if name == "two parts" else 1) * int(np.prod(shape))


@pytest.mark.parametrize(("kind", "options"), [("mpi", {}), ("mpi", FIELDS), ("nest", {"ksp_rtol": 1e-14})])
@pytest.mark.parametrize("is_same", [True, False], ids=["one hierarchy", "two hierarchies"])
def test_two_unknowns(is_same: bool, kind: Any, options: dict[str, Any]) -> None:
    def work(comm: MPI.Comm) -> list[Any]:
        Q = space(WITH_RIM["l domain"], comm)
        V = FunctionSpace(Q.hierarchy if is_same else refined(Q).hierarchy, (2,))
        u, v, p, q = ufl.TrialFunction(V), ufl.TestFunction(V), ufl.TrialFunction(Q), ufl.TestFunction(Q)
        a = [[energy(V, mass=1.0), inner(grad(p), v) * dx], [inner(u, grad(q)) * dx, -energy(Q, mass=1.0)]]
        L = [None, by_number(Q) * q * dx]
        load = np.concatenate([fem.assemble_vector(fem.form(inner(by_number(V), v) * dx)), np.zeros(Q.num_local_dofs)])
        bcs = [fem.dirichletbc(0.5, fem.boundary_dofs(V), V)]
        given = {"petsc_options_prefix": "b_", "petsc_options": options, "kind": kind}
        problem = LinearProblem(a, L, bcs=bcs, load=load, **given)
        return [whole(f) for f in problem.solve()]

    same_as_in_serial(work)


def test_options_hold_on_several_ranks() -> None:
    V = space(WITH_RIM["l domain"], MPI.COMM_WORLD)
    L = ufl.TestFunction(V) * dx
    options = {"ksp_type": "minres", "pc_type": "bjacobi", "ksp_rtol": 1e-9}
    problem = LinearProblem(energy(V, mass=1.0), L, petsc_options_prefix="o_", petsc_options=options)
    problem.solve()
    assert (problem.solver.getType(), problem.solver.getPC().getType()) == ("minres", "bjacobi")
    assert problem.solver.getTolerances()[0] == 1e-9


# ---- What goes wrong


def message_of(comm: MPI.Comm, kind: type[Exception], problem: LinearProblem) -> str:
    """Return the message of the error that all ranks must raise."""
    with pytest.raises(kind) as caught:
        problem.solve()
    messages = comm.allgather(str(caught.value))
    assert set(messages) == {messages[0]}
    return messages[0]


def poisson(make: Maker, comm: MPI.Comm, options: dict[str, Any] | None = None) -> LinearProblem:
    V = space(make, comm)
    bcs = [fem.dirichletbc(0.0, fem.boundary_dofs(V), V)] if make in WITH_RIM.values() else []
    L = by_number(V) * ufl.TestFunction(V) * dx
    return LinearProblem(energy(V), L, bcs=bcs, petsc_options_prefix="e_", petsc_options=options)


def test_solvers_that_fail(comm: MPI.Comm) -> None:
    problem = poisson(WITH_RIM["l domain"], comm, {**CG, "ksp_max_it": 2})
    assert "DIVERGED_MAX_IT" in message_of(comm, RuntimeError, problem)


@pytest.mark.parametrize("options", [{}, MUMPS, CG])
def test_values_of_one_rank_that_are_not_finite(comm: MPI.Comm, options: dict[str, Any]) -> None:
    V = space(WITH_RIM["l domain"], comm)
    f = by_number(V)
    if comm.rank == comm.size - 1:
        f.x.array[V.num_owned_dofs // 2] = np.nan
    for L, mass in ((f * ufl.TestFunction(V) * dx, 1.0), (ufl.TestFunction(V) * dx, f)):
        problem = LinearProblem(energy(V, mass), L, petsc_options_prefix="f_", petsc_options=options)
        message_of(comm, RuntimeError, problem)


def test_singular_matrices(comm: MPI.Comm) -> None:
    """Without a condition elastic bodies may turn."""
    V = space(WITH_RIM["wheel"], comm, (2,))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    a = inner(ufl.sym(grad(u)), ufl.sym(grad(v))) * dx
    L = inner(ufl.sym(grad(by_number(V))), ufl.sym(grad(v))) * dx
    problem = LinearProblem(a, L, petsc_options_prefix="r_", petsc_options=MUMPS)
    assert "the matrix is singular to working precision" in message_of(comm, RuntimeError, problem)


def test_loads_without_a_solution(comm: MPI.Comm) -> None:
    assert "there is no solution" in message_of(comm, ValueError, poisson(CLOSED["torus"], comm))


def test_load_of_another_shape_on_one_rank(comm: MPI.Comm) -> None:
    problem = poisson(WITH_RIM["l domain"], comm)
    V = problem.u.function_space
    problem.load = np.zeros(V.num_local_dofs + (comm.rank == 1))
    n = comm.bcast(V.num_local_dofs, root=1)
    assert f"rank 1 of {comm.size}: load has shape ({n + 1},)" in message_of(comm, ValueError, problem)


def test_scipy_is_refused(comm: MPI.Comm) -> None:
    V = fem.functionspace(generators.rectangle((2, 2), comm=comm), ("THCCS", 3))
    u, v = fem.Function(V), ufl.TestFunction(V)
    with pytest.raises(NotImplementedError, match=rf"on {size_of(comm)} ranks: use fem\.petsc\.LinearProblem"):
        scipy.LinearProblem(energy(V), v * dx)
    with pytest.raises(NotImplementedError, match=r"use fem\.petsc\.NonlinearProblem"):
        scipy.NonlinearProblem((u**2 - 1.0) * v * dx, u)
    with pytest.raises(NotImplementedError, match=r"use fem\.petsc\.EigenProblem"):
        scipy.EigenProblem(energy(V))
