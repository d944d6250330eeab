"""Nonlinear problems, by Newton's method of our own and by PETSc's: closed forms, and one against the other."""

import gc
import weakref
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

import ufl
from thccs_fem import adapt, fem, generators
from thccs_fem.fem import scipy
from thccs_fem.fem.nonlinear import NonlinearSystem
from thccs_fem.fem.space import FunctionSpace
from ufl import div, dx, exp, grad, inner, sqrt

Expr = ufl.core.expr.Expr


def petsc_problem(*args: Any, **kwargs: Any) -> Any:
    """Make PETSc's problem; skip where there is no PETSc."""
    pytest.importorskip("petsc4py")
    from thccs_fem.fem import petsc

    return petsc.NonlinearProblem(*args, petsc_options_prefix="nonlinear_", **kwargs)


Maker = Callable[..., Any]
BOTH = pytest.mark.parametrize("make", [scipy.NonlinearProblem, petsc_problem], ids=["scipy", "petsc"])


def square(n: int = 6, lower: float = 0.0) -> FunctionSpace:
    msh = generators.rectangle((n, n), lower=(lower, lower), upper=(1.0, 1.0))
    return fem.functionspace(msh, ("THCCS", 3))


def torus() -> FunctionSpace:
    return adapt.refine(fem.functionspace(generators.torus((10, 8)), ("THCCS", 3)), [0, 5])


def distance(u: fem.Function, exact: Expr) -> float:
    """Return the L2 norm of the error."""
    return float(np.sqrt(fem.assemble_scalar(fem.form((u - exact) ** 2 * dx, quadrature_degree=11))))


def boundary(V: FunctionSpace, value: Any) -> list[fem.DirichletBC]:
    return [fem.dirichletbc(value, fem.boundary_dofs(V), V)]


# ---- Model problems: the residual of a function, and a solution


def quasilinear(u: fem.Function, v: ufl.Argument) -> tuple[ufl.Form, Expr]:
    """-div((1 + u^2) grad(u)) = f, for a solution of the space."""
    x = ufl.SpatialCoordinate(v.ufl_function_space().mesh)
    exact = x[0] ** 3 - 2.0 * x[0] * x[1] ** 2 + x[1] - 1.0
    f = -div((1.0 + exact**2) * grad(exact))
    rule = {"quadrature_degree": 17}  # exact on straight cells: 2 * 3 + 3 + 2 in each direction and more
    return (inner((1.0 + u**2) * grad(u), grad(v)) - f * v) * dx(metadata=rule), exact


def minimal_surface(u: fem.Function, v: ufl.Argument) -> tuple[ufl.Form, Expr]:
    """div(grad(u) / sqrt(1 + |grad(u)|^2)) = 0: Scherk's surface."""
    x = ufl.SpatialCoordinate(v.ufl_function_space().mesh)
    exact = ufl.ln(ufl.cos(x[1]) / ufl.cos(x[0]))
    return inner(grad(u), grad(v)) / sqrt(1.0 + inner(grad(u), grad(u))) * dx, exact


def p_laplacian(u: fem.Function, v: ufl.Argument) -> tuple[ufl.Form, Expr]:
    """-div(|grad(u)|^2 grad(u)) = 0: the fundamental solution |x - x0|^((p - n) / (p - 1)), p = 4, n = 2."""
    x = ufl.SpatialCoordinate(v.ufl_function_space().mesh)
    exact = ((x[0] + 2.0) ** 2 + (x[1] + 1.0) ** 2) ** (1.0 / 3.0)
    return inner(grad(u), grad(u)) * inner(grad(u), grad(v)) * dx, exact


def liouville(u: fem.Function, v: ufl.Argument) -> tuple[ufl.Form, Expr]:
    """-div(grad(u)) = 2 exp(u) (Bratu's equation): Liouville's solution -2 ln(1 + |x|^2 / 4)."""
    x = ufl.SpatialCoordinate(v.ufl_function_space().mesh)
    return (inner(grad(u), grad(v)) - 2.0 * exp(u) * v) * dx, -2.0 * ufl.ln(1.0 + (x[0] ** 2 + x[1] ** 2) / 4.0)


# Problem, and the largest error in L2 on 6 x 6 faces.
MODELS: dict[str, tuple[Callable[..., tuple[ufl.Form, Expr]], float]] = {
    "quasilinear": (quasilinear, 1e-11),
    "minimal surface": (minimal_surface, 1e-4),
    "p-Laplacian": (p_laplacian, 1e-5),
    "Liouville": (liouville, 1e-4),
}


def posed(name: str, n: int = 6) -> tuple[ufl.Form, fem.Function, list[fem.DirichletBC], Expr]:
    V = square(n, -0.5)
    x = ufl.SpatialCoordinate(V.mesh)
    u = fem.project(0.3 * x[0] + 0.2 * x[1], V)  # no zero of the gradient, at which the p-Laplacian is degenerate
    F, exact = MODELS[name][0](u, ufl.TestFunction(V))
    return F, u, boundary(V, exact), exact


@BOTH
@pytest.mark.parametrize("name", MODELS)
def test_known_solutions_are_found(name: str, make: Maker) -> None:
    F, u, bcs, exact = posed(name)
    assert make(F, u, bcs=bcs).solve() is u
    assert distance(u, exact) < MODELS[name][1]


@pytest.mark.parametrize("name", ["minimal surface", "p-Laplacian", "Liouville"])
def test_errors_fall_with_the_order_of_cubics(name: str) -> None:
    found = []
    for n in (4, 8, 16):
        F, u, bcs, exact = posed(name, n)
        scipy.NonlinearProblem(F, u, bcs=bcs).solve()
        found.append(distance(u, exact))
    rate = -np.polyfit(np.arange(3), np.log2(found), 1)[0]
    assert 3.7 < rate < 4.6  # 4 in theory; coarse levels are a little better
    assert found[-1] < MODELS[name][1] / 20


@BOTH
@pytest.mark.parametrize("name", MODELS)
def test_convergence_is_quadratic(name: str, make: Maker) -> None:
    F, u, bcs, _ = posed(name)
    problem = make(F, u, bcs=bcs)
    problem.solve()
    norms = np.array(problem.norms)
    assert norms.size <= 12
    # Each small residual above rounding is a multiple of the square of the one before: linear convergence, of a tenth
    # at each step, would end with a multiple of 1e8.
    multiples = [b / a**2 for a, b in pairwise(norms / norms[0]) if a < 0.05 and b > 1e-13]
    assert len(multiples) >= 2
    assert max(multiples) < 100.0


@pytest.mark.parametrize("name", MODELS)
def test_both_solvers_agree(name: str) -> None:
    solutions = []
    for make in (scipy.NonlinearProblem, petsc_problem):
        F, u, bcs, _ = posed(name)
        make(F, u, bcs=bcs).solve()
        solutions.append(u.x.array)
    np.testing.assert_allclose(*solutions, rtol=1e-9, atol=1e-9)


# ---- Conditions


@BOTH
def test_the_initial_guess_need_not_satisfy_the_conditions(make: Maker) -> None:
    # A linear problem: one step of Newton's method solves it, so that conditions and equations go together.
    V = square()
    u, v, x = fem.Function(V), ufl.TestFunction(V), ufl.SpatialCoordinate(V.mesh)
    problem = make((inner(grad(u), grad(v)) + 6.0 * x[0] * v) * dx, u, bcs=boundary(V, x[0] ** 3 + x[1]))
    problem.solve()
    assert distance(u, x[0] ** 3 + x[1]) < 1e-12
    assert len(problem.norms) == 2


@BOTH
def test_prescribed_values_are_exact_and_exchangeable(make: Maker) -> None:
    F, u, bcs, _ = posed("Liouville")
    problem = make(F, u, bcs=bcs)
    problem.solve()
    first = u.x.array.copy()
    np.testing.assert_array_equal(first[bcs[0].dofs], bcs[0].values)
    problem.bcs = boundary(u.function_space, -1.0)
    problem.solve()
    np.testing.assert_array_equal(u.x.array[bcs[0].dofs], -1.0)
    problem.bcs = bcs
    problem.solve()
    np.testing.assert_allclose(u.x.array, first, atol=1e-10)


def test_jacobians_are_symmetric_and_residuals_lifted() -> None:
    F, u, bcs, _ = posed("minimal surface")
    system = NonlinearSystem(F, u, bcs=bcs)
    x = system.start()
    rng = np.random.default_rng(0)
    x += 0.1 * rng.standard_normal(x.size)
    dofs, values = bcs[0].dofs, bcs[0].values
    free = np.setdiff1d(np.arange(x.size), dofs)
    b = system.residual(x)
    J = system.jacobian(x).copy()
    assert abs(J - J.T).max() < 1e-12
    np.testing.assert_array_equal(b[dofs], x[dofs] - values)
    # The step is that of the system with rows alone replaced.
    u.x.array = x
    whole = fem.assemble_matrix(fem.form(ufl.derivative(F, u, ufl.TrialFunction(u.function_space)))).toarray()
    rows = whole.copy()
    rows[dofs] = np.eye(x.size)[dofs]
    right = fem.assemble_vector(fem.form(F))
    right[dofs] = x[dofs] - values
    np.testing.assert_allclose(np.linalg.solve(J.toarray(), b), np.linalg.solve(rows, right), atol=1e-11)
    # Where the conditions hold, the residual is that of the form.
    x[dofs] = values
    b = system.residual(x)
    np.testing.assert_allclose(b[free], fem.assemble_vector(fem.form(F))[free], atol=1e-15)


def test_jacobians_are_derivatives_of_residuals() -> None:
    F, u, _, _ = posed("minimal surface")
    system = NonlinearSystem(F, u)
    x, rng = system.start(), np.random.default_rng(0)
    direction = rng.standard_normal(x.size)
    t = 1e-5
    difference = (system.residual(x + t * direction) - system.residual(x - t * direction)) / (2 * t)
    np.testing.assert_allclose(system.jacobian(x) @ direction, difference, atol=1e-7 * np.abs(difference).max())


# ---- Closed surfaces


@BOTH
def test_constants_on_closed_surfaces(make: Maker) -> None:
    V = torus()
    u, v, x = fem.Function(V), ufl.TestFunction(V), ufl.SpatialCoordinate(V.mesh)
    u.x.array = 7.0
    F = (sqrt(1.0 + inner(grad(u), grad(u))) * inner(grad(u), grad(v)) - x[2] * v) * dx
    problem = make(F, u)
    problem.solve()
    assert abs(fem.assemble_scalar(fem.form(u * dx))) < 1e-11
    residual = fem.assemble_vector(fem.form(F))
    mean = residual.sum()
    # What quadrature leaves of the mean of z is all that remains.
    assert np.linalg.norm(residual) < 1e-9 * problem.norms[0] + abs(mean)
    before = u.x.array.copy()
    problem.solve()  # from the solution
    np.testing.assert_allclose(u.x.array, before, atol=1e-10)


@BOTH
def test_loads_with_a_mean_on_closed_surfaces_are_refused(make: Maker) -> None:
    V = torus()
    u, v = fem.Function(V), ufl.TestFunction(V)
    one = fem.Constant(V.mesh, 1.0)
    problem = make((exp(inner(grad(u), grad(u))) * inner(grad(u), grad(v)) - one * v) * dx, u)
    with pytest.raises(ValueError, match="there is no solution: constants are in the kernel"):
        problem.solve()


@BOTH
def test_a_jacobian_that_happens_to_be_singular_is_no_reason_to_fix_the_mean(make: Maker) -> None:
    # At p = 1 the Jacobian of (p - 1)^3 is zero for constants, as that of u always is, but for other p it is not.
    V = torus()
    u, p, v = fem.Function(V), fem.Function(V), ufl.TestFunction(V)
    F = [inner(grad(u), grad(v)) * dx, (inner(grad(p), grad(v)) + ((p - 1.0) ** 3 - 8.0) * v) * dx]
    p.x.array = 2.0
    problem = make(F, [u, p])
    problem.solve()
    np.testing.assert_allclose(p.x.array, 3.0, rtol=1e-9)
    np.testing.assert_allclose(u.x.array, 0.0, atol=1e-9)
    p.x.array = 1.0
    with pytest.raises(RuntimeError, match="singular"):
        problem.solve()


# ---- Again, and what is there


@BOTH
def test_solutions_are_recognised(make: Maker) -> None:
    F, u, bcs, _ = posed("minimal surface")
    problem = make(F, u, bcs=bcs)
    problem.solve()
    before = u.x.array.copy()
    problem.solve()
    assert len(problem.norms) <= 3
    np.testing.assert_allclose(u.x.array, before, atol=1e-12)


@BOTH
def test_constants_may_change_between_solutions(make: Maker) -> None:
    V = torus()
    u, v = fem.Function(V), ufl.TestFunction(V)
    f = fem.Constant(V.mesh, 2.0)
    problem = make((inner(grad(u), grad(v)) + (u + u**3 - f) * v) * dx, u)
    for value, solution in ((2.0, 1.0), (10.0, 2.0), (-2.0, -1.0)):
        f.value = value
        np.testing.assert_allclose(problem.solve().x.array, solution, rtol=1e-9)


@BOTH
def test_jacobians_may_be_given(make: Maker) -> None:
    V = torus()
    u, v, du = fem.Function(V), ufl.TestFunction(V), ufl.TrialFunction(V)
    F = (inner(grad(u), grad(v)) + (u + u**3 - 2.0) * v) * dx
    picard = (inner(grad(du), grad(v)) + 3.0 * du * v) * dx
    u.x.array = 1.2
    problem = make(F, u, J=picard)
    problem.solve()
    np.testing.assert_allclose(u.x.array, 1.0, rtol=1e-8)
    assert len(problem.norms) > 6  # not Newton's
    assert problem.J.ufl_form.coefficients() == ()
    assert problem.F.rank == 1


@BOTH
def test_attributes(make: Maker) -> None:
    F, u, bcs, _ = posed("Liouville")
    problem = make(F, u, bcs=bcs)
    problem.solve()
    assert problem.u is u
    assert (problem.F.rank, problem.J.rank) == (1, 2)
    size = problem.A.shape if hasattr(problem.A, "shape") else problem.A.getSize()
    assert size == (u.x.array.size, u.x.array.size)
    b = problem.b if isinstance(problem.b, np.ndarray) else problem.b.array
    assert np.linalg.norm(b) == pytest.approx(problem.norms[-1], rel=1e-10)


# ---- What fails


@BOTH
def test_equations_without_a_solution(make: Maker) -> None:
    V = square()
    u, v = fem.Function(V), ufl.TestFunction(V)
    problem = make((inner(grad(u), grad(v)) - 20.0 * exp(u) * v) * dx, u, bcs=boundary(V, 0.0))  # the fold is at 6.8
    with pytest.raises(
        RuntimeError, match=r"failed after \d+ iterations: .*no step along .* direction makes the residual"
    ):
        problem.solve()
    assert np.isfinite(u.x.array).all()


@BOTH
def test_residuals_that_are_not_finite(make: Maker) -> None:
    V = square()
    u, v = fem.Function(V), ufl.TestFunction(V)
    with pytest.raises(RuntimeError, match=r"the residual.* is not finite"):
        make((inner(grad(u), grad(v)) + ufl.ln(u) * v) * dx, u, bcs=boundary(V, 0.0)).solve()


@BOTH
def test_singular_jacobians(make: Maker) -> None:
    # Zero is where the Jacobian of u^3 vanishes.
    V = torus()
    u, v = fem.Function(V), ufl.TestFunction(V)
    with pytest.raises(RuntimeError, match="singular"):
        make((u**3 - 1.0) * v * dx, u).solve()


@BOTH
def test_what_is_no_problem_is_refused(make: Maker) -> None:
    V = torus()
    u, v = fem.Function(V), ufl.TestFunction(V)
    F = (inner(grad(u), grad(v)) + (u**3 - 1.0) * v) * dx
    with pytest.raises(TypeError, match="u holds a str"):
        make(F, ["u"])
    with pytest.raises(ValueError, match=r"u is in .* but the trial function in"):
        make(F, fem.Function(adapt.refine(V, [0])), J=ufl.derivative(F, u))
    with pytest.raises(ValueError, match=r"row or column 0 of J has no form"):
        make(F, fem.Function(V))
    with pytest.raises(ValueError, match="F has no test function: for an energy write"):
        make(u**4 * dx, u)
    with pytest.raises(ValueError, match="J has 1 arguments and F has 2"):
        make(ufl.derivative(F, u), u, J=F)


# ---- PETSc alone


def test_options_choose_the_solver() -> None:
    F, u, bcs, exact = posed("minimal surface")
    options = {
        "snes_linesearch_type": "cp",
        "ksp_type": "cg",
        "pc_type": "jacobi",
        "ksp_rtol": 1e-12,
        "snes_rtol": 1e-8,
    }
    problem = petsc_problem(F, u, bcs=bcs, petsc_options=options)
    problem.solve()
    assert problem.solver.getLineSearch().getType() == "cp"
    assert problem.solver.getKSP().getType() == "cg"
    assert problem.solver.getTolerances()[0] == 1e-8
    assert distance(u, exact) < MODELS["minimal surface"][1]


def test_solvers_may_be_chosen_in_code() -> None:
    F, u, bcs, exact = posed("minimal surface")
    problem = petsc_problem(F, u, bcs=bcs)
    problem.solver.setType("newtontr")
    problem.solver.getKSP().setType("gmres")
    problem.solver.getKSP().getPC().setType("ilu")
    problem.solve()
    assert problem.solver.getType() == "newtontr"
    assert problem.solver.getKSP().getPC().getType() == "ilu"
    assert distance(u, exact) < MODELS["minimal surface"][1]


def test_jacobians_may_be_lagged() -> None:
    # Short steps leave conditions unmet, and residuals lifted by another Jacobian than that which is in use.
    V = fem.functionspace(generators.rectangle((4, 4)), ("THCCS", 3))
    u, v, x = fem.Function(V), ufl.TestFunction(V), ufl.SpatialCoordinate(V.mesh)
    bc = fem.dirichletbc(6 * ufl.sin(2 * x[0]) * x[1], fem.boundary_dofs(V), V)
    F = inner(grad(u), grad(v)) / ufl.sqrt(1 + inner(grad(u), grad(u))) * dx
    petsc_problem(F, u, bcs=[bc]).solve()
    expected = u.x.array.copy()
    u.x.array = 0.0
    options = {"snes_lag_jacobian": 2, "ksp_type": "gmres", "pc_type": "jacobi"}
    petsc_problem(F, u, bcs=[bc], petsc_options=options).solve()
    np.testing.assert_allclose(u.x.array, expected, atol=1e-8)


def test_chosen_is_a_direct_solver_with_a_line_search() -> None:
    F, u, bcs, _ = posed("minimal surface")
    problem = petsc_problem(F, u, bcs=bcs)
    problem.solve()
    pc = problem.solver.getKSP().getPC()
    assert (problem.solver.getType(), problem.solver.getLineSearch().getType()) == ("newtonls", "bt")
    assert (pc.getType(), pc.getFactorSolverType()) == ("lu", "mumps")


def test_options_that_nothing_reads_are_reported() -> None:
    F, u, bcs, _ = posed("minimal surface")
    problem = petsc_problem(F, u, bcs=bcs, petsc_options={"snes_rtoll": 1e-8})
    with pytest.warns(UserWarning, match=r"PETSc made no use of the options \['snes_rtoll'\]"):
        problem.solve()


@pytest.mark.parametrize("package", ["mumps", "petsc"])
def test_singular_jacobians_are_noticed_by_any_factorisation(package: str) -> None:
    V = torus()
    u, v = fem.Function(V), ufl.TestFunction(V)
    options = {"ksp_type": "preonly", "pc_type": "lu", "pc_factor_mat_solver_type": package}
    problem = petsc_problem((inner(grad(u), grad(v)) + (u**3 - 1.0) * v) * dx, u, petsc_options=options)
    with pytest.raises(RuntimeError, match="singular"):
        problem.solve()


def test_memory_and_options_are_given_back() -> None:
    petsc4py = pytest.importorskip("petsc4py.PETSc")
    before = petsc4py.Options().getAll()
    F, u, bcs, _ = posed("minimal surface")
    problem = petsc_problem(F, u, bcs=bcs, petsc_options={"snes_rtol": 1e-8})
    problem.solve()
    assert petsc4py.Options().getAll() == before
    system, matrix = weakref.ref(problem._system), weakref.ref(problem._system.A)
    del problem
    gc.collect()
    assert system() is None
    assert matrix() is None


def test_too_few_iterations() -> None:
    F, u, bcs, _ = posed("minimal surface")
    problem = petsc_problem(F, u, bcs=bcs, petsc_options={"snes_max_it": 1})
    with pytest.raises(RuntimeError, match=r"newtonls failed after 1 iterations: DIVERGED_MAX_IT, there were too many"):
        problem.solve()


def test_linear_solvers_that_fail_are_named() -> None:
    F, u, bcs, _ = posed("minimal surface")
    options = {"ksp_type": "cg", "pc_type": "none", "ksp_max_it": 1}
    problem = petsc_problem(F, u, bcs=bcs, petsc_options=options)
    with pytest.raises(
        RuntimeError, match=r"DIVERGED_LINEAR_SOLVE, PETSc's cg .* DIVERGED_MAX_IT.*allow more iterations"
    ):
        problem.solve()


def test_iterative_solvers_on_closed_surfaces() -> None:
    V = torus()
    u, v, x = fem.Function(V), ufl.TestFunction(V), ufl.SpatialCoordinate(V.mesh)
    F = (sqrt(1.0 + inner(grad(u), grad(u))) * inner(grad(u), grad(v)) - x[2] * v) * dx
    scipy.NonlinearProblem(F, u).solve()
    direct = u.x.array.copy()
    u.x.array = 0.0
    petsc_problem(F, u, petsc_options={"ksp_type": "cg", "pc_type": "gamg"}).solve()
    np.testing.assert_allclose(u.x.array, direct, atol=1e-9)
