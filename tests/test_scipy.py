"""Linear problems solved by SciPy, against closed forms."""

import numpy as np
import pytest
import scipy.sparse as sp
from zoo import ZOO

import ufl
from thccs_fem import adapt, fem, generators
from thccs_fem.fem import scipy
from thccs_fem.fem.scipy import LinearProblem, conjugate_gradients, solve
from thccs_fem.fem.space import FunctionSpace
from ufl import as_vector, div, dx, grad, inner, sym

Expr = ufl.core.expr.Expr


def square(shape: tuple[int, ...] = (), times: int = 1) -> FunctionSpace:
    msh = generators.rectangle((4, 4), lower=(0.0, 0.0), upper=(1.0, 1.0))
    V = fem.functionspace(msh, ("THCCS", 3, shape))
    for _ in range(times):
        V = adapt.refine(V, [0, V.num_functions - 1])
    return V


def torus(shape: tuple[int, ...] = (), times: int = 1) -> FunctionSpace:
    V = fem.functionspace(generators.torus((8, 6)), ("THCCS", 3, shape))
    for _ in range(times):
        V = adapt.refine(V, [0, V.num_functions - 1])
    return V


def laplace(V: FunctionSpace) -> ufl.Form:
    return inner(grad(ufl.TrialFunction(V)), grad(ufl.TestFunction(V))) * dx


def elasticity(u: Expr, v: Expr) -> ufl.Form:
    return (inner(sym(grad(u)), sym(grad(v))) + div(u) * div(v)) * dx


def side(axis: int, value: float):
    return lambda x: np.isclose(x[axis], value)


def distance(u: fem.Function, exact: Expr) -> float:
    """Return the L2 norm of the error."""
    return float(np.sqrt(fem.assemble_scalar(fem.form(inner(u - exact, u - exact) * dx, quadrature_degree=11))))


def test_cubic_solutions_are_found_exactly() -> None:
    # -div(grad(u)) = f with values on the boundary; u is in the space.
    V = square()
    x, v = ufl.SpatialCoordinate(V.mesh), ufl.TestFunction(V)
    exact = x[0] ** 3 - 2 * x[0] * x[1] ** 2 + x[1] - 1
    bc = fem.dirichletbc(exact, fem.boundary_dofs(V), V)
    u = LinearProblem(laplace(V), -2 * x[0] * v * dx, bcs=[bc]).solve()
    assert distance(u, exact) < 1e-12


def test_smooth_solutions_are_found_nearly() -> None:
    msh = generators.disc(6)
    V = fem.functionspace(msh, ("THCCS", 3))
    x, v = ufl.SpatialCoordinate(msh), ufl.TestFunction(V)
    exact = ufl.sin(2 * x[0]) * ufl.exp(x[1])
    bc = fem.dirichletbc(exact, fem.boundary_dofs(V), V)
    u = LinearProblem(laplace(V), 3 * exact * v * dx, bcs=[bc]).solve()
    assert 1e-6 < distance(u, exact) < 2e-3  # some twelve elements across; the lower bound: it is not in the space


def test_loads_on_closed_surfaces() -> None:
    # The load is that of a known function; its mean is free.
    V = torus()
    g = fem.Function(V)
    g.x.array = np.random.default_rng(0).random(V.num_dofs)
    u = LinearProblem(laplace(V), inner(grad(g), grad(ufl.TestFunction(V))) * dx).solve()
    assert abs(fem.assemble_scalar(fem.form(u * dx))) < 1e-12
    assert np.ptp(u.x.array - g.x.array) < 1e-11  # a constant


def test_loads_with_a_mean_on_closed_surfaces_are_refused() -> None:
    V = torus()
    problem = LinearProblem(laplace(V), 2.0 * ufl.TestFunction(V) * dx)
    with pytest.raises(ValueError, match=r"the mean of the load is (2\.0|1\.99)"):
        problem.solve()


def test_conditions_on_components() -> None:
    # Rollers: each side holds the component across it. The load is that of a known field, natural terms included.
    V = square((2,))
    u, v, x = ufl.TrialFunction(V), ufl.TestFunction(V), ufl.SpatialCoordinate(V.mesh)
    exact = as_vector([x[0] ** 2 * x[1] - x[0], x[1] ** 3 + x[0] * x[1]])
    bcs = [
        fem.dirichletbc(exact[axis], fem.boundary_dofs(V, side(axis, value)), V.sub(axis))
        for axis in (0, 1)
        for value in (0.0, 1.0)
    ]
    solution = LinearProblem(elasticity(u, v), elasticity(exact, v), bcs=bcs).solve()
    assert distance(solution, exact) < 1e-12


def test_two_regions_of_a_closed_surface() -> None:
    msh = generators.torus((12, 8))
    V = fem.functionspace(msh, ("THCCS", 3))
    x = ufl.SpatialCoordinate(msh)
    middle = msh.vertices[msh.quads].mean(axis=1)
    right, left = np.flatnonzero(middle[:, 0] > 2.0), np.flatnonzero(middle[:, 0] < -2.0)
    bcs = [fem.dirichletbc(1.0, fem.region_dofs(V, right), V), fem.dirichletbc(x[2], fem.region_dofs(V, left), V)]
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    solution = LinearProblem(laplace(V), fem.Constant(msh, 0.0) * v * dx, bcs=bcs).solve()
    uv = np.random.default_rng(0).random((96, 2))
    np.testing.assert_allclose(solution.eval(right, uv[: right.size]), 1.0, rtol=1e-12)
    z = fem.project(x[2], V)
    np.testing.assert_allclose(solution.eval(left, uv[: left.size]), z.eval(left, uv[: left.size]), atol=1e-8)
    prescribed = np.concatenate([bc.dofs for bc in bcs])
    residual = fem.assemble_matrix(fem.form(inner(grad(u), grad(v)) * dx)) @ solution.x.array
    np.testing.assert_allclose(np.delete(residual, prescribed), 0.0, atol=1e-12)
    assert np.abs(residual[prescribed]).max() > 0.1


def test_the_later_condition_holds() -> None:
    V = torus()
    bcs = [fem.dirichletbc(value, [3, 4 + value], V) for value in (1, 2)]
    u = LinearProblem(laplace(V), fem.Constant(V.mesh, 0.0) * ufl.TestFunction(V) * dx, bcs=bcs).solve()
    assert u.x.array[[3, 5, 6]].tolist() == [2.0, 1.0, 2.0]


def test_problems_are_solved_again_with_new_values() -> None:
    V = torus()
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    k, f = fem.Constant(V.mesh, 2.0), fem.Constant(V.mesh, 3.0)
    problem = LinearProblem((inner(grad(u), grad(v)) + k * u * v) * dx, f * v * dx)
    np.testing.assert_allclose(problem.solve().x.array, 1.5, rtol=1e-11)
    k.value, f.value = 4.0, -8.0
    solution = problem.solve()
    assert solution is problem.u
    np.testing.assert_allclose(solution.x.array, -2.0, rtol=1e-11)
    problem.bcs = [fem.dirichletbc(5.0, [3], V)]
    assert problem.solve().x.array[3] == 5.0


def test_attributes() -> None:
    V = torus()
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    given = fem.Function(V, name="mine")
    problem = LinearProblem(
        u * v * dx, 2.0 * v * dx, u=given, petsc_options_prefix="x_", petsc_options={"ksp_type": "cg"}
    )
    A = problem.A
    assert problem.solve() is problem.u is given
    assert problem.A is A
    np.testing.assert_allclose(problem.A @ given.x.array, problem.b, rtol=1e-12)


def test_matrices_that_are_not_symmetric() -> None:
    V = square()
    u, v, x = ufl.TrialFunction(V), ufl.TestFunction(V), ufl.SpatialCoordinate(V.mesh)
    exact = x[0] ** 2 + x[1] ** 3
    # -div(grad(u)) + 30 u_x = f
    a = laplace(V) + 30 * u.dx(0) * v * dx
    bc = fem.dirichletbc(exact, fem.boundary_dofs(V), V)
    solution = LinearProblem(a, (60 * x[0] - 2 - 6 * x[1]) * v * dx, bcs=[bc]).solve()
    assert distance(solution, exact) < 1e-12


def test_indefinite_matrices() -> None:
    V = torus()
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    a = laplace(V) - 0.3 * u * v * dx
    assert np.linalg.eigvalsh(fem.assemble_matrix(fem.form(a)).toarray())[[0, -1]].prod() < 0
    np.testing.assert_allclose(LinearProblem(a, 0.6 * v * dx).solve().x.array, -2.0, rtol=1e-11)


# ---- What has no solution


def test_rigid_rotations_make_a_matrix_singular() -> None:
    # Translations are constants, and taken care of; rotations are not.
    V = square((2,))
    u, v, x = ufl.TrialFunction(V), ufl.TestFunction(V), ufl.SpatialCoordinate(V.mesh)
    with pytest.raises(RuntimeError, match=r"singular.*See that Dirichlet conditions fix all"):
        LinearProblem(elasticity(u, v), (x[0] - 0.5) * v[0] * dx).solve()


def test_regions_without_an_integral_make_a_matrix_singular() -> None:
    plain = generators.torus((12, 8))
    msh = type(plain)(plain.vertices, plain.quads, face_tags=np.arange(96) // 8)
    V = fem.functionspace(msh, ("THCCS", 3))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    with pytest.raises(RuntimeError, match="singular"):
        LinearProblem(u * v * dx(0), v * dx(0)).solve()


def test_values_that_are_not_finite_are_refused() -> None:
    V = torus()
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    with pytest.raises(RuntimeError, match="SuperLU gave values that are not finite"):
        LinearProblem(u * v * dx, fem.Constant(V.mesh, np.nan) * v * dx).solve()


# ---- Conjugate gradients


def test_large_systems_are_solved_by_iteration(monkeypatch: pytest.MonkeyPatch) -> None:
    V = FunctionSpace(fem.functionspace(ZOO["cube_and_torus"](), ("THCCS", 3)).hierarchy)
    g = fem.Function(V)
    g.x.array = np.random.default_rng(0).random(V.num_dofs)
    problem = LinearProblem(laplace(V), inner(grad(g), grad(ufl.TestFunction(V))) * dx)
    direct = problem.solve().x.array.copy()
    monkeypatch.setattr(scipy.linear, "LARGEST_DIRECT", 10)
    iterated = problem.solve().x.array
    assert 0.0 < np.abs(iterated - direct).max() < 1e-7  # tolerance 1e-10, condition number below 1000


def test_large_systems_that_are_not_symmetric_are_factorised(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scipy.linear, "LARGEST_DIRECT", 1)
    A = sp.csr_array(np.array([[2.0, 1.0], [-1.0, 3.0]]))
    np.testing.assert_allclose(solve(A, np.array([4.0, 5.0])), [1.0, 2.0], rtol=1e-14)


def test_iterations_that_do_not_converge_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scipy.linear, "MOST_ITERATIONS", 3)
    A = sp.csr_array(np.diag(np.arange(1.0, 20.0)) + np.eye(19, k=1) + np.eye(19, k=-1) + 3 * np.eye(19))
    with pytest.raises(RuntimeError, match="conjugate gradients did not converge in 3 iterations: the residual is"):
        conjugate_gradients(A, np.ones(19), 1e-12)


def test_iterations_need_a_positive_diagonal() -> None:
    with pytest.raises(RuntimeError, match="the matrix is not positive definite"):
        conjugate_gradients(sp.csr_array(np.diag([1.0, -1.0])), np.ones(2), 1e-12)


def test_nothing_comes_from_nothing() -> None:
    assert conjugate_gradients(sp.csr_array(np.eye(2)), np.zeros(2), 1e-12).tolist() == [0.0, 0.0]


def test_matrices_with_empty_rows_are_singular() -> None:
    with pytest.raises(RuntimeError, match=r"SuperLU failed \(Factor is exactly singular\): the matrix is singular"):
        solve(sp.csr_array(np.diag([1.0, 0.0])), np.ones(2))
