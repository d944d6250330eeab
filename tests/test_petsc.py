"""Matrices, vectors and linear problems of PETSc, against those of SciPy and closed forms."""

import gc
import os
import subprocess
import sys
import textwrap
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from zoo import ZOO

import ufl
from thccs_fem import adapt, fem, generators
from thccs_fem.fem import scipy
from thccs_fem.fem.space import FunctionSpace
from ufl import as_vector, div, dx, grad, inner, sym

pytest.importorskip("petsc4py")

from mpi4py import MPI
from petsc4py import PETSc

from thccs_fem.fem import petsc
from thccs_fem.fem.petsc import LinearProblem

Expr = ufl.core.expr.Expr

DIRECT = {"ksp_type": "preonly", "pc_type": "lu"}
MUMPS = {**DIRECT, "pc_factor_mat_solver_type": "mumps"}
CG = {"ksp_type": "cg", "pc_type": "jacobi", "ksp_rtol": 1e-12}
GAMG = {"ksp_type": "cg", "pc_type": "gamg", "ksp_rtol": 1e-12}
SOLVERS: dict[str, dict[str, Any]] = {"chosen": {}, "lu": DIRECT, "mumps": MUMPS, "cg": CG, "gamg": GAMG}


@pytest.fixture(autouse=True)
def _options_stay_as_they_are() -> Iterator[None]:
    before = PETSc.Options().getAll()
    yield
    assert PETSc.Options().getAll() == before


def square(shape: tuple[int, ...] = ()) -> FunctionSpace:
    msh = generators.rectangle((4, 4), lower=(0.0, 0.0), upper=(1.0, 1.0))
    V = fem.functionspace(msh, ("THCCS", 3, shape))
    return adapt.refine(V, [0, V.num_functions - 1])


def torus(shape: tuple[int, ...] = ()) -> FunctionSpace:
    V = fem.functionspace(generators.torus((8, 6)), ("THCCS", 3, shape))
    return adapt.refine(V, [0, V.num_functions - 1])


def arguments(V: FunctionSpace) -> tuple[ufl.Argument, ufl.Argument, ufl.SpatialCoordinate]:
    return ufl.TrialFunction(V), ufl.TestFunction(V), ufl.SpatialCoordinate(V.mesh)


def laplace(V: FunctionSpace) -> ufl.Form:
    u, v, _ = arguments(V)
    return inner(grad(u), grad(v)) * dx


def elasticity(u: Expr, v: Expr) -> ufl.Form:
    return (inner(sym(grad(u)), sym(grad(v))) + div(u) * div(v)) * dx


def random_load(V: FunctionSpace) -> ufl.Form:
    """Return the load of a random function, which has no mean."""
    g = fem.Function(V)
    g.x.array = np.random.default_rng(0).random(V.num_dofs)
    return inner(grad(g), grad(ufl.TestFunction(V))) * dx


def side(axis: int, value: float):
    return lambda x: np.isclose(x[axis], value)


def distance(u: fem.Function, exact: Expr) -> float:
    """Return the L2 norm of the error."""
    return float(np.sqrt(fem.assemble_scalar(fem.form(inner(u - exact, u - exact) * dx, quadrature_degree=11))))


def dense(A: PETSc.Mat) -> np.ndarray:
    return A.convert("dense", PETSc.Mat()).getDenseArray()


# ---- Matrices and vectors


@pytest.mark.parametrize("shape", [(), (2,)])
def test_matrices_are_those_of_assembly(shape: tuple[int, ...]) -> None:
    V = torus(shape)
    a = fem.form(laplace(V))
    A = petsc.assemble_matrix(a)
    assert A.assembled
    assert A.getType() == "seqaij"
    assert A.getBlockSize() == V.block_size
    np.testing.assert_array_equal(dense(A), fem.assemble_matrix(a).toarray())


def test_matrices_share_the_memory_of_assembly() -> None:
    V = torus()
    A = petsc.assemble_matrix(fem.form(laplace(V)))
    csr = A.getAttr("values")
    csr.data[:] = 0.0
    A.stateIncrease()
    assert A.norm() == 0.0
    memory = weakref.ref(csr)
    del csr
    gc.collect()
    assert memory() is not None  # the matrix keeps it
    A.destroy()
    del A
    gc.collect()
    assert memory() is None


def test_matrices_with_conditions() -> None:
    V = torus((2,))
    bcs = [fem.dirichletbc(1.0, [3, 5], V.sub(1)), fem.dirichletbc(2.0, [7], V)]
    A = petsc.assemble_matrix(fem.form(laplace(V)), bcs)
    expected = fem.assemble_matrix(fem.form(laplace(V))).toarray()
    for dof in (7, 11, 14, 15):
        expected[dof, :] = expected[:, dof] = 0.0
        expected[dof, dof] = 1.0
    np.testing.assert_array_equal(dense(A), expected)


def test_matrices_are_filled_anew() -> None:
    V = torus()
    u, v, _ = arguments(V)
    k = fem.Constant(V.mesh, 2.0)
    a = fem.form(k * u * v * dx)
    A = petsc.assemble_matrix(a)
    norm = A.norm()  # PETSc keeps it while it believes that nothing changed
    k.value = 6.0
    assert petsc.assemble_matrix(A, a) is A
    assert A.norm() == pytest.approx(3 * norm, rel=1e-13)
    petsc.assemble_matrix(A, a, bcs=[fem.dirichletbc(0.0, [4], V)])
    assert A.getValue(4, 4) == 1.0
    petsc.assemble_matrix(A, a)
    assert A.norm() == pytest.approx(3 * norm, rel=1e-13)


def test_other_matrices_are_not_filled() -> None:
    V = torus()
    a = fem.form(laplace(V))
    with pytest.raises(ValueError, match="the matrix to be filled does not use memory of ours"):
        petsc.assemble_matrix(PETSc.Mat().createAIJ(V.num_dofs, comm=MPI.COMM_SELF), a)
    with pytest.raises(TypeError, match=r"assemble_matrix needs a form from fem\.form, or a Mat and a form, got Form"):
        petsc.assemble_matrix(laplace(V))


def test_conditions_need_one_space() -> None:
    V = torus()
    V2 = adapt.refine(V, [3])
    a = fem.form(ufl.TrialFunction(V) * ufl.TestFunction(V2) * dx)
    assert petsc.assemble_matrix(a).getSize() == (V2.num_dofs, V.num_dofs)
    with pytest.raises(ValueError, match="conditions need test and trial functions in one space"):
        petsc.assemble_matrix(a, [fem.dirichletbc(0.0, [0], V)])


def test_builds_for_other_numbers_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(PETSc, "ScalarType", np.complex128)
    with pytest.raises(TypeError, match="PETSc was built for complex128"):
        petsc.assemble_matrix(fem.form(laplace(torus())))


def test_vectors_are_those_of_assembly() -> None:
    V = torus()
    L = fem.form(random_load(V))
    b = petsc.assemble_vector(L)
    np.testing.assert_array_equal(b.array, fem.assemble_vector(L))
    assert b.comm.size == 1


def test_lifting_and_setting_make_the_system_of_the_linear_problem() -> None:
    V = square()
    _, v, x = arguments(V)
    bcs = [fem.dirichletbc(x[0] * x[1], fem.boundary_dofs(V), V), fem.dirichletbc(3.0, [5], V)]
    problem = LinearProblem(laplace(V), (1 + x[0]) * v * dx, bcs=bcs, petsc_options_prefix="lifting_")
    problem.solve()
    ((a,),), (L,) = problem._system.a, problem._system.L
    b = petsc.assemble_vector(L)
    petsc.apply_lifting(b, [a], [bcs])
    petsc.set_bc(b, bcs)
    np.testing.assert_allclose(b.array, problem.b.array, rtol=1e-13, atol=1e-15)
    np.testing.assert_array_equal(dense(petsc.assemble_matrix(a, bcs)), dense(problem.A))


def test_lifting_and_setting_for_newton() -> None:
    # As DOLFINx: b - alpha A (g - x0), and alpha (g - x0).
    V = torus()
    a, L = fem.form(laplace(V)), fem.form(random_load(V))
    bcs = [fem.dirichletbc(np.arange(3.0), [2, 4, 6], V)]
    x0 = PETSc.Vec().createWithArray(np.random.default_rng(1).random(V.num_dofs), comm=MPI.COMM_SELF)
    b = petsc.assemble_vector(L)
    assert petsc.apply_lifting(b, [a], [bcs], x0=[x0], alpha=-2.0) is b
    jump = np.zeros(V.num_dofs)
    jump[[2, 4, 6]] = np.arange(3.0) - x0.array[[2, 4, 6]]
    expected = fem.assemble_vector(L) + 2.0 * (fem.assemble_matrix(a) @ jump)
    np.testing.assert_allclose(b.array, expected, rtol=1e-12)
    petsc.set_bc(b, bcs, x0=x0, alpha=-2.0)
    expected[[2, 4, 6]] = -2.0 * jump[[2, 4, 6]]
    np.testing.assert_allclose(b.array, expected, rtol=1e-12)


def test_no_conditions_change_nothing() -> None:
    V = torus()
    b = petsc.assemble_vector(fem.form(random_load(V)))
    before = b.array.copy()
    petsc.apply_lifting(b, [fem.form(laplace(V))], [[]])
    petsc.set_bc(b, [])
    np.testing.assert_array_equal(b.array, before)


def test_lifting_wants_conditions_for_each_form() -> None:
    V = torus()
    b = petsc.assemble_vector(fem.form(random_load(V)))
    with pytest.raises(ValueError, match="zip"):
        petsc.apply_lifting(b, [fem.form(laplace(V))], [])


# ---- Solutions


@pytest.mark.parametrize("name", SOLVERS)
def test_cubic_solutions_are_found_exactly(name: str) -> None:
    V = square()
    _, v, x = arguments(V)
    exact = x[0] ** 3 - 2 * x[0] * x[1] ** 2 + x[1] - 1
    bc = fem.dirichletbc(exact, fem.boundary_dofs(V), V)
    a, L = laplace(V), -2 * x[0] * v * dx
    problem = LinearProblem(a, L, bcs=[bc], petsc_options_prefix="cubic_", petsc_options=SOLVERS[name])
    u = problem.solve()
    assert distance(u, exact) < 1e-10
    np.testing.assert_allclose(u.x.array, scipy.LinearProblem(a, L, bcs=[bc]).solve().x.array, atol=1e-10)
    np.testing.assert_array_equal(u.x.array[bc.dofs], bc.values)


@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize("mesh", ["torus", "tripod", "cube_and_torus"])
def test_closed_surfaces(mesh: str, name: str) -> None:
    V = adapt.refine(fem.functionspace(ZOO[mesh](), ("THCCS", 3)), [0, 5])
    a, L = laplace(V), random_load(V)
    problem = LinearProblem(a, L, petsc_options_prefix="closed_", petsc_options=SOLVERS[name])
    u = problem.solve()
    np.testing.assert_allclose(u.x.array, scipy.LinearProblem(a, L).solve().x.array, atol=1e-10)
    assert abs(fem.assemble_scalar(fem.form(u * dx))) < 1e-11
    assert problem.A.getNullSpace().test(problem.A)


def test_a_null_space_from_outside_stays() -> None:
    # A sheet that nothing holds may turn as well, which is no constant.
    V = square((2,))
    u, v, x = arguments(V)
    motions = [fem.project(as_vector(motion), V) for motion in ([1.0, 0.0], [0.0, 1.0], [-x[1], x[0]])]
    basis = np.linalg.qr(np.stack([motion.x.array for motion in motions], axis=1))[0]
    a, stretch = inner(sym(grad(u)), sym(grad(v))) * dx, fem.Constant(V.mesh, 2.0)
    L = stretch * div(v) * dx  # so that u = stretch x, but for rigid motions
    problem = LinearProblem(a, L, petsc_options_prefix="free_", petsc_options={"ksp_type": "cg", "pc_type": "none"})
    own = PETSc.NullSpace().create(
        vectors=[PETSc.Vec().createWithArray(b, comm=PETSc.COMM_SELF) for b in basis.T.copy()]
    )
    problem.A.setNullSpace(own)
    for value in (2.0, 3.0):
        stretch.value = value
        solution = problem.solve()
        assert problem.A.getNullSpace().handle == own.handle
        miss = solution.x.array - value * fem.project(x, V).x.array
        np.testing.assert_allclose(miss - basis @ (basis.T @ miss), 0.0, atol=1e-8)


def test_communicators_are_those_of_the_mesh() -> None:
    if MPI.COMM_WORLD.size > 1:
        pytest.skip("spaces are serial")
    V = fem.functionspace(generators.torus((5, 4), comm=MPI.COMM_WORLD), ("THCCS", 3))
    problem = LinearProblem(laplace(V), random_load(V), petsc_options_prefix="world_")
    problem.solve()
    assert problem.A.comm == problem.b.comm == problem.solver.comm == PETSc.COMM_WORLD


@pytest.mark.parametrize("module", [petsc, scipy])
def test_coefficients_may_be_finer(module: Any) -> None:
    # Integrals are then over finer cells than those of the unknown.
    V = torus()
    u, v, _ = arguments(V)
    one = fem.Function(adapt.refine(V, [2, 9]))  # zero at first
    same = dx(metadata={"quadrature_degree": 9})  # on both sides, so that constants are exact
    problem = module.LinearProblem(one * u * v * same, 2.0 * one * v * same, petsc_options_prefix="finer_")
    assert problem.A is not None  # assembled
    one.x.array = 1.0
    np.testing.assert_allclose(problem.solve().x.array, 2.0, rtol=1e-9)
    one.x.array = 3.0
    np.testing.assert_allclose(problem.solve().x.array, 2.0, rtol=1e-9)


@pytest.mark.parametrize("name", SOLVERS)
def test_loads_with_a_mean_are_refused(name: str) -> None:
    V = torus()
    v = ufl.TestFunction(V)
    problem = LinearProblem(laplace(V), 2.0 * v * dx, petsc_options_prefix="mean_", petsc_options=SOLVERS[name])
    with pytest.raises(ValueError, match=r"the mean of the load is (2\.0|1\.99)"):
        problem.solve()


@pytest.mark.parametrize("name", SOLVERS)
def test_conditions_on_components(name: str) -> None:
    V = square((2,))
    u, v, x = arguments(V)
    exact = as_vector([x[0] ** 2 * x[1] - x[0], x[1] ** 3 + x[0] * x[1]])
    bcs = [
        fem.dirichletbc(exact[axis], fem.boundary_dofs(V, side(axis, value)), V.sub(axis))
        for axis in (0, 1)
        for value in (0.0, 1.0)
    ]
    problem = LinearProblem(
        elasticity(u, v), elasticity(exact, v), bcs=bcs, petsc_options_prefix="rollers_", petsc_options=SOLVERS[name]
    )
    assert distance(problem.solve(), exact) < 1e-9


@pytest.mark.parametrize("name", SOLVERS)
def test_vectors_on_closed_surfaces(name: str) -> None:
    V = torus((3,))
    a, L = laplace(V), random_load(V)
    problem = LinearProblem(a, L, petsc_options_prefix="vectors_", petsc_options=SOLVERS[name])
    np.testing.assert_allclose(problem.solve().x.array, scipy.LinearProblem(a, L).solve().x.array, atol=1e-10)


def test_two_regions_of_a_closed_surface() -> None:
    V = torus()
    _, v, x = arguments(V)
    bcs = [fem.dirichletbc(1.0, fem.region_dofs(V, [0]), V), fem.dirichletbc(x[2], fem.region_dofs(V, [27]), V)]
    a, L = laplace(V), fem.Constant(V.mesh, 0.0) * v * dx
    u = LinearProblem(a, L, bcs=bcs, petsc_options_prefix="regions_").solve()
    np.testing.assert_allclose(u.x.array, scipy.LinearProblem(a, L, bcs=bcs).solve().x.array, atol=1e-10)
    np.testing.assert_allclose(u.eval([0, 0], [[0.2, 0.3], [1.0, 0.0]]), 1.0, rtol=1e-12)


def test_indefinite_systems() -> None:
    V = torus()
    u, v, _ = arguments(V)
    a, L = laplace(V) - 0.3 * u * v * dx, 0.6 * v * dx
    options = ({}, MUMPS, {"ksp_type": "minres", "pc_type": "jacobi", "ksp_rtol": 1e-12})
    for chosen in options:
        problem = LinearProblem(a, L, petsc_options_prefix="indefinite_", petsc_options=chosen)
        np.testing.assert_allclose(problem.solve().x.array, -2.0, rtol=1e-9)
    with pytest.raises(RuntimeError, match=r"DIVERGED_INDEFINITE_MAT.*use minres or gmres"):
        LinearProblem(a, random_load(V), petsc_options_prefix="indefinite_", petsc_options=CG).solve()


# ---- Which solver


def test_small_systems_are_factorised() -> None:
    V = torus()
    u, v, _ = arguments(V)
    for a, kind in ((u * v * dx, "cholesky"), ((u + u.dx(0)) * v * dx, "lu")):
        problem = LinearProblem(a, 2.0 * v * dx, petsc_options_prefix="small_")
        np.testing.assert_allclose(problem.solve().x.array, 2.0, rtol=1e-10)
        assert (problem.solver.getType(), problem.solver.getPC().getType()) == ("preonly", kind)
        assert problem.solver.getPC().getFactorSolverType() == "mumps"


def test_large_systems_are_iterated(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(petsc.linear, "LARGEST_DIRECT", 10)
    V = torus()
    u, v, _ = arguments(V)
    advected = laplace(V) + (u + u.dx(0)) * v * dx
    for a, kind, pc in ((laplace(V) + u * v * dx, "cg", "mg"), (advected, "gmres", "gamg")):
        problem = LinearProblem(a, 2.0 * v * dx, petsc_options_prefix="large_")
        np.testing.assert_allclose(problem.solve().x.array, 2.0, rtol=1e-8)
        assert (problem.solver.getType(), problem.solver.getPC().getType()) == (kind, pc)
        assert problem.solver.getTolerances()[0] == 1e-10


def test_equations_of_fourth_order_are_factorised_for_longer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(petsc.linear, "LARGEST_DIRECT", 10)
    monkeypatch.setattr(petsc.linear, "has_coarse_level", lambda V: False)
    V = torus()
    u, v, _ = arguments(V)
    problem = LinearProblem((div(grad(u)) * div(grad(v)) + u * v) * dx, 2.0 * v * dx, petsc_options_prefix="fourth_")
    np.testing.assert_allclose(problem.solve().x.array, 2.0, rtol=1e-8)
    assert problem.solver.getPC().getType() == "cholesky"


def test_solvers_may_be_chosen_in_code() -> None:
    V = torus()
    u, v, _ = arguments(V)
    problem = LinearProblem(u * v * dx, 2.0 * v * dx, petsc_options_prefix="code_", petsc_options={"ksp_max_it": 777})
    problem.solver.setType("cg")
    problem.solver.getPC().setType("jacobi")
    problem.solve()
    assert (problem.solver.getType(), problem.solver.getPC().getType()) == ("cg", "jacobi")
    assert problem.solver.getTolerances()[3] == 777


def test_options_reach_what_is_made_when_solving() -> None:
    V = torus()
    u, v, _ = arguments(V)
    options = {**GAMG, "mg_levels_ksp_type": "richardson", "mg_levels_pc_type": "sor", "pc_gamg_coarse_eq_limit": 10}
    problem = LinearProblem(laplace(V) + u * v * dx, 2.0 * v * dx, petsc_options_prefix="deep_", petsc_options=options)
    problem.solve()
    pc = problem.solver.getPC()
    assert pc.getMGLevels() > 1
    assert pc.getMGSmoother(1).getType() == "richardson"


def test_options_come_from_the_command_line() -> None:
    V = torus()
    u, v, _ = arguments(V)
    # As if given as -line_ksp_type minres: PETSc has one database for all.
    options = PETSc.Options("line_")
    options["ksp_type"], options["pc_type"] = "minres", "jacobi"
    try:
        problem = LinearProblem(
            u * v * dx, 2.0 * v * dx, petsc_options_prefix="line_", petsc_options={"ksp_rtol": 1e-9}
        )
        other = LinearProblem(u * v * dx, 2.0 * v * dx, petsc_options_prefix="other_")
        problem.solve()
        other.solve()
    finally:
        options.delValue("ksp_type")
        options.delValue("pc_type")
    assert (problem.solver.getType(), problem.solver.getPC().getType()) == ("minres", "jacobi")
    assert problem.solver.getTolerances()[0] == 1e-9
    assert other.solver.getType() == "preonly"


def test_options_that_nothing_reads_are_reported() -> None:
    V = torus()
    u, v, _ = arguments(V)
    options = {"-ksp_type": "cg", "pc_typ": "jacobi", "ksp_monitor_cancel": None}
    problem = LinearProblem(u * v * dx, 2.0 * v * dx, petsc_options_prefix="typo_", petsc_options=options)
    with pytest.warns(UserWarning, match=r"PETSc made no use of the options \['pc_typ'\]: are they misspelt"):
        problem.solve()
    problem.solve()  # once is enough
    assert problem.solver.getType() == "cg"


def test_prefixes_are_not_empty() -> None:
    V = torus()
    with pytest.raises(ValueError, match="petsc_options_prefix is empty"):
        LinearProblem(laplace(V), random_load(V), petsc_options_prefix="")


# ---- Again, and after


@pytest.mark.parametrize("name", SOLVERS)
def test_problems_are_solved_again_with_new_values(name: str) -> None:
    V = torus()
    u, v, _ = arguments(V)
    k, f = fem.Constant(V.mesh, 2.0), fem.Constant(V.mesh, 3.0)
    a = (inner(grad(u), grad(v)) + k * u * v) * dx
    problem = LinearProblem(a, f * v * dx, petsc_options_prefix="again_", petsc_options=SOLVERS[name])
    np.testing.assert_allclose(problem.solve().x.array, 1.5, rtol=1e-9)
    k.value, f.value = 4.0, -8.0
    np.testing.assert_allclose(problem.solve().x.array, -2.0, rtol=1e-9)
    k.value = f.value = 0.0  # now constants are in the kernel
    np.testing.assert_allclose(problem.solve().x.array, 0.0, atol=1e-9)
    assert problem.A.getNullSpace().test(problem.A)
    k.value = f.value = 1.0  # and now they are not
    np.testing.assert_allclose(problem.solve().x.array, 1.0, rtol=1e-9)
    problem.bcs = [fem.dirichletbc(5.0, [3], V)]
    assert problem.solve().x.array[3] == 5.0


def test_attributes() -> None:
    V = torus()
    u, v, _ = arguments(V)
    given = fem.Function(V, name="mine")
    problem = LinearProblem(u * v * dx, 2.0 * v * dx, u=given, petsc_options_prefix="attributes_")
    A, b = problem.A, problem.b
    assert problem.solve() is problem.u is given
    assert problem.A is A
    assert problem.b is b
    x = A.createVecRight()
    x.array = given.x.array
    np.testing.assert_allclose((A * x).array, b.array, rtol=1e-11)
    assert b.norm() == pytest.approx(np.linalg.norm(b.array), rel=1e-14)
    assert problem.solver.getOptionsPrefix() == "attributes_"


def test_the_unknown_may_be_the_initial_guess() -> None:
    V = torus()
    u, v, _ = arguments(V)
    guess = fem.Function(V)
    guess.x.array = 2.0
    options = {**CG, "ksp_initial_guess_nonzero": True, "ksp_rtol": 1e-8}
    problem = LinearProblem(u * v * dx, 2.0 * v * dx, u=guess, petsc_options_prefix="guess_", petsc_options=options)
    problem.solve()
    assert problem.solver.getIterationNumber() == 0


def test_memory_is_given_back() -> None:
    V = torus()
    u, v, _ = arguments(V)
    problem = LinearProblem(laplace(V) + u * v * dx, 2.0 * v * dx, petsc_options_prefix="memory_")
    solution = problem.solve()
    matrix, system = weakref.ref(problem._system.A), weakref.ref(problem._system)
    A = problem.A
    del problem
    gc.collect()
    assert A.norm() > 0.0  # who holds the matrix may use it
    del A
    gc.collect()
    assert matrix() is None
    assert system() is None
    np.testing.assert_allclose(solution.x.array, 2.0, rtol=1e-10)


PROBLEMS = """
    from thccs_fem.fem.petsc import EigenProblem, LinearProblem, NonlinearProblem, TimeProblem

    import ufl
    from thccs_fem import fem, generators

    V = fem.functionspace(generators.torus((6, 5)), ("THCCS", 3))
    w, v, u, udot = ufl.TrialFunction(V), ufl.TestFunction(V), fem.Function(V), fem.Function(V)
    linear = LinearProblem(w * v * ufl.dx, v * ufl.dx, petsc_options_prefix="fresh_")
    nonlinear = NonlinearProblem((u + u**3 - 2.0) * v * ufl.dx, u, petsc_options_prefix="fresh_")
    eigen = EigenProblem(w * v * ufl.dx, num_eigenvalues=2, petsc_options_prefix="fresh_")
    time = TimeProblem((udot + u) * v * ufl.dx, u, udot, dt=0.1, petsc_options_prefix="fresh_")
    for problem in (linear, nonlinear, eigen):
        problem.solve()
    time.step()
"""


def test_nothing_is_imported_before_and_nothing_left_behind_in_a_process_of_its_own() -> None:
    # Problems that live as long as the process: what PETSc owns then, Python reports as leaked.
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])}
    command = [sys.executable, "-c", textwrap.dedent(PROBLEMS)]
    run = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, check=False)
    assert (run.returncode, run.stdout, run.stderr) == (0, "", "")


# ---- What fails


def test_too_few_iterations() -> None:
    V = torus()
    options = {**CG, "ksp_max_it": 1}
    problem = LinearProblem(laplace(V), random_load(V), petsc_options_prefix="few_", petsc_options=options)
    with pytest.raises(
        RuntimeError, match="cg with the preconditioner jacobi failed after 1 iterations: DIVERGED_MAX_IT"
    ):
        problem.solve()


@pytest.mark.parametrize("name", ["chosen", "lu", "mumps"])
def test_rigid_rotations_make_a_matrix_singular(name: str) -> None:
    V = square((2,))
    u, v, x = arguments(V)
    a, L = elasticity(u, v), (x[0] - 0.5) * v[0] * dx
    problem = LinearProblem(a, L, petsc_options_prefix="rotation_", petsc_options=SOLVERS[name])
    with pytest.raises(RuntimeError, match="singular"):
        problem.solve()


@pytest.mark.parametrize("options", [DIRECT, {"ksp_type": "cg", "pc_type": "lu"}])
def test_empty_rows_are_a_failure_of_the_preconditioner(options: dict[str, Any]) -> None:
    plain = generators.torus((12, 8))
    V = fem.functionspace(type(plain)(plain.vertices, plain.quads, face_tags=np.arange(96) // 8), ("THCCS", 3))
    u, v, _ = arguments(V)
    problem = LinearProblem(u * v * dx(0), v * dx(0), petsc_options_prefix="empty_", petsc_options=options)
    with pytest.raises(RuntimeError, match=r"DIVERGED_PCSETUP_FAILED.*as happens when the matrix is singular"):
        problem.solve()


@pytest.mark.parametrize("pc", ["jacobi", "gamg", "none"])
def test_preconditioners_do_not_solve_by_themselves(pc: str) -> None:
    V = torus()
    options = {"ksp_type": "preonly", "pc_type": pc}
    problem = LinearProblem(laplace(V), random_load(V), petsc_options_prefix="alone_", petsc_options=options)
    with pytest.raises(RuntimeError, match=f"preonly with the preconditioner {pc} gave values that leave a residual"):
        problem.solve()


def test_values_that_are_not_finite() -> None:
    V = torus()
    u, v, _ = arguments(V)
    for name in SOLVERS:
        L = fem.Constant(V.mesh, np.nan) * v * dx
        problem = LinearProblem(u * v * dx, L, petsc_options_prefix="nan_", petsc_options=SOLVERS[name])
        with pytest.raises(RuntimeError, match="not finite"):
            problem.solve()


# ---- Where solvers start from


def torus_problem(u: fem.Function, options: dict[str, Any]) -> LinearProblem:
    trial, v, x = arguments(u.function_space)
    a = inner(grad(trial), grad(v)) * dx + trial * v * dx
    return LinearProblem(a, x[0] * v * dx, u=u, petsc_options_prefix="guess_", petsc_options=options)


@pytest.mark.parametrize("options", [CG, GAMG, {"ksp_type": "gmres", "pc_type": "jacobi", "ksp_rtol": 1e-12}])
def test_iteration_starts_from_u_if_asked_to(options: dict[str, Any]) -> None:
    """It ends at the same residual, relative to the right-hand side: a better guess takes fewer iterations."""
    V = torus()
    exact = torus_problem(fem.Function(V), MUMPS).solve()
    iterations, solutions = [], []
    for part in (0.0, 1.0, 1.0 - 1e-6, 1.0):
        u = fem.Function(V)
        u.x.array = part * exact.x.array
        problem = torus_problem(u, options)
        if part > 0.0 and len(iterations) != 1:
            assert problem.start_from_u() is True
        solutions.append(problem.solve().x.array)
        iterations.append(problem.solver.getIterationNumber())
    unasked, better, exactly = iterations[1:]
    assert unasked == iterations[0]
    assert better < 0.8 * unasked  # half of the digits are there
    assert exactly <= 1
    for solution in solutions:
        np.testing.assert_allclose(solution, exact.x.array, rtol=0, atol=1e-9 * np.abs(exact.x.array).max())


@pytest.mark.parametrize("options", [{}, DIRECT, MUMPS])
def test_factorisations_start_from_nothing(options: dict[str, Any]) -> None:
    u = fem.Function(torus())
    problem = torus_problem(u, options)
    assert problem.start_from_u() is False
    u.x.array[:] = 1e9
    np.testing.assert_array_equal(
        problem.solve().x.array, torus_problem(fem.Function(torus()), options).solve().x.array
    )


def test_a_chosen_solver_starts_from_u_where_it_iterates(monkeypatch: pytest.MonkeyPatch) -> None:
    """Large systems are expected to be iterated; where that turns out otherwise, no harm is done."""
    monkeypatch.setattr("thccs_fem.fem.petsc.linear.LARGEST_DIRECT", 10)
    V = torus()
    problem = torus_problem(fem.Function(V), {})
    assert problem.start_from_u() is True
    expected = problem.solve().x.array.copy()
    assert problem.solver.getInitialGuessNonzero()
    monkeypatch.setattr("thccs_fem.fem.petsc.linear.LARGEST_DIRECT", 10**9)
    other = torus_problem(fem.Function(V), {})
    other.solver.setInitialGuessNonzero(True)
    np.testing.assert_allclose(other.solve().x.array, expected, rtol=0, atol=1e-8 * np.abs(expected).max())
    assert not other.solver.getInitialGuessNonzero()
