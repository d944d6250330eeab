"""Dual weighted residuals against solutions in the refined space, known solutions, and shares taken one by one."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from goals import KNOWN, LEFT, LINEAR, NONLINEAR, Problem, bumps, l_shaped, square, value_of
from problems import randomly_refined, refined_towards, uniformly_refined

import ufl
from thccs_fem import adapt, estimate, fem, generators
from thccs_fem.fem.scipy import LinearProblem, NonlinearProblem
from ufl import dx, grad, inner

Floats = npt.NDArray[np.float64]
Make = Callable[[], Problem]

BUMPS = 0.00858483345  # J of `bumps`, by uniform refinement to 50 000 dofs


def solved(problem: Problem, V: fem.FunctionSpace, *, is_linear: bool) -> fem.Function:
    return problem.solve(V) if is_linear else problem.solve_by_newton(V)


def estimated(problem: Problem, uh: fem.Function) -> tuple[Floats, float]:
    return estimate.goal(uh, *problem.forms(uh), fixed=problem.bcs)


def value_and_change(problem: Problem, *, is_linear: bool) -> tuple[fem.Function, float, float]:
    """Return a solution, the value of its goal, and what uniform refinement changes in that."""
    V = randomly_refined(problem.V, 2)
    uh, u = (solved(problem, W, is_linear=is_linear) for W in (V, uniformly_refined(V)))
    return uh, estimated(problem, uh)[1], value_of(problem.J(u)) - value_of(problem.J(uh))


# ---- The value


@pytest.mark.parametrize("make", LINEAR.values(), ids=LINEAR)
def test_value_is_what_uniform_refinement_changes(make: Make) -> None:
    problem = make()
    uh, value, change = value_and_change(problem, is_linear=True)
    # Rounding of J and of solutions: the conditions of these systems are up to 1e6.
    assert value == pytest.approx(change, rel=0, abs=1e-12 * (1.0 + abs(value_of(problem.J(uh)))))


def test_value_where_rings_are_refined() -> None:
    """Rings of all functions need not be all of the surface, but supports are."""
    problem = LINEAR["with advection"]()
    V = fem.functionspace(problem.V.mesh, ("THCCS", 3), unit="ring")
    V = randomly_refined(V, 2)
    with_supports = fem.FunctionSpace(replace(V.hierarchy, unit="support"))
    uh, u = problem.solve(V), problem.solve(uniformly_refined(with_supports))
    assert u.function_space.num_cells == 4 * V.num_cells > uniformly_refined(V).num_cells
    change = value_of(problem.J(u)) - value_of(problem.J(uh))
    assert estimated(problem, uh)[1] == pytest.approx(change, rel=1e-8)


def test_value_where_caps_sink() -> None:
    """Elements at the extraordinary vertex are as small as its cap lets them be: in the refined space it is deeper."""
    problem = LINEAR["with advection"]()
    V = refined_towards(problem.V, (0.0, 0.0), 4)
    W = uniformly_refined(V)
    assert W.hierarchy.cap_levels.max() > V.hierarchy.cap_levels.max()
    uh, u = problem.solve(V), problem.solve(W)
    change = value_of(problem.J(u)) - value_of(problem.J(uh))
    assert estimated(problem, uh)[1] == pytest.approx(change, rel=1e-7)


def test_value_of_forms_with_other_functions() -> None:
    """Data on faces, a coarser function, and a stabilisation with the sizes of cells, which stay those of V."""
    problem = LINEAR["with advection"]()
    coarse, V = problem.V, randomly_refined(problem.V, 2)
    x, msh = ufl.SpatialCoordinate(V.mesh), V.mesh
    h, c, kappa = fem.cell_sizes(V), fem.project(x[0] * x[1], coarse), fem.Function(fem.functionspace(msh, ("DG", 0)))
    kappa.x.array = 1.0 + np.arange(msh.num_faces) % 3
    beta = ufl.as_vector([1.0, x[0]])

    def F(u: ufl.core.expr.Expr, v: ufl.core.expr.Expr) -> ufl.Form:
        along = ufl.dot(beta, grad(u))
        return (kappa * inner(grad(u), grad(v)) + along * (v + 0.1 * h * ufl.dot(beta, grad(v))) - c * v) * dx

    mixed = Problem(V, F, lambda u: (x[0] + c) * u * dx, boundary_zero)
    uh, u = mixed.solve(V), mixed.solve(uniformly_refined(V))
    change = value_of(mixed.J(u)) - value_of(mixed.J(uh))
    assert estimated(mixed, uh)[1] == pytest.approx(change, rel=1e-8)


def test_energy_as_a_goal() -> None:
    """Its derivative is F, so that the dual solution at uh is but an error: the value is of second order."""
    V = randomly_refined(LINEAR["with advection"]().V, 2)

    def energy(u: fem.Function) -> ufl.Form:
        return (0.5 * inner(grad(u), grad(u)) + 0.25 * u**4 - 5.0 * u) * dx

    found = []
    for space in (V, uniformly_refined(V)):
        uh = fem.Function(space)
        NonlinearProblem(ufl.derivative(energy(uh), uh), uh, bcs=boundary_zero(space)).solve()
        found.append(uh)
    uh, u = found
    F = ufl.derivative(energy(uh), uh, ufl.TestFunction(V))
    _, value = estimate.goal(uh, F, energy(uh), fixed=fem.boundary_dofs)
    assert value == pytest.approx(value_of(energy(u)) - value_of(energy(uh)), rel=1e-4)
    assert value < 0


@pytest.mark.parametrize("make", NONLINEAR.values(), ids=NONLINEAR)
def test_value_of_nonlinear_problems_is_that_up_to_a_cubic_error(make: Make) -> None:
    """The quadratic one of the dual solution at uh is between 2 and 70 percent of the value."""
    _, value, change = value_and_change(make(), is_linear=False)
    assert value == pytest.approx(change, rel=1e-4)  # 1e-6 to 3e-6 were measured


@pytest.mark.parametrize("name", KNOWN)
def test_effectivity_on_uniform_meshes(name: str) -> None:
    """It is 1 - 2^-p, with p the order of the goal: 3 of fluxes and at extraordinary vertices, else 4 to 6."""
    problem = KNOWN[name]()
    exact = value_of_exact(problem)
    V, errors = problem.V, []
    for _ in range(2):
        V = uniformly_refined(V)
        uh = solved(problem, V, is_linear=name in LINEAR)
        _, value = estimated(problem, uh)
        errors.append(exact - value_of(problem.J(uh)))
        assert 0.8 < value / errors[-1] < 1.1, (V.num_dofs, value, errors[-1])
    assert abs(errors[1]) < abs(errors[0]) / 2**2.5


def value_of_exact(problem: Problem) -> float:
    V = uniformly_refined(problem.V, 2)
    return fem.assemble_scalar(fem.form(problem.J(problem.exact), quadrature_degree=24, on=V))


def test_goal_sees_what_prescribed_values_miss() -> None:
    """J is the integral over the rim, of which nothing but the conditions knows."""
    msh = square()
    x = ufl.SpatialCoordinate(msh)
    rough = ufl.sin(7 * x[0]) * ufl.cos(5 * x[1])
    V = fem.functionspace(msh, ("THCCS", 3))

    def F(u: ufl.core.expr.Expr, v: ufl.core.expr.Expr) -> ufl.Form:
        return inner(grad(u), grad(v)) * dx - fem.Constant(msh, 0.0) * v * dx

    problem = Problem(V, F, lambda u: x[0] ** 2 * u**2 * ufl.ds, lambda V: boundary_values(V, rough))
    uh, u = problem.solve(V), problem.solve(uniformly_refined(V))
    J = problem.J(uh)
    change = value_of(problem.J(u)) - value_of(J)
    assert estimated(problem, uh)[1] == pytest.approx(change, rel=1e-10)
    _, without = estimate.goal(uh, problem.forms(uh)[0], J, fixed=fem.boundary_dofs)
    assert abs(without) < 0.05 * abs(change)  # the quadrature of J is left


def boundary_values(V: fem.FunctionSpace, g: ufl.core.expr.Expr) -> list[fem.DirichletBC]:
    return [fem.dirichletbc(g, fem.boundary_dofs(V), V)]


def test_ways_to_say_what_is_prescribed() -> None:
    problem = l_shaped()
    V, f = problem.V, fem.Constant(problem.V.mesh, 1.0)
    zero = Problem(V, lambda u, v: inner(grad(u), grad(v)) * dx - f * v * dx, problem.J, boundary_zero)
    uh = zero.solve(V)
    F, J = zero.forms(uh)
    ways = [
        fem.boundary_dofs,
        lambda V: fem.boundary_dofs(V).tolist(),
        boundary_zero,
        lambda V: boundary_zero(V)[0],
        lambda V: tuple(boundary_zero(V)),
    ]
    (eta, value), *others = [estimate.goal(uh, F, J, fixed=fixed) for fixed in ways]
    for other_eta, other in others:
        np.testing.assert_allclose(other_eta, eta, rtol=1e-12)
        assert other == pytest.approx(value, rel=1e-9)


def boundary_zero(V: fem.FunctionSpace) -> list[fem.DirichletBC]:
    return [fem.dirichletbc(0.0, fem.boundary_dofs(V), V)]


def test_petsc_solves_it_as_well() -> None:
    petsc = pytest.importorskip("thccs_fem.fem.petsc")
    problem = LINEAR["displacement of a side"]()
    uh = problem.solve(problem.V)
    eta, value = estimated(problem, uh)
    by_petsc = estimate.goal(uh, *problem.forms(uh), fixed=problem.bcs, problem=petsc.LinearProblem)
    np.testing.assert_allclose(by_petsc[0], eta, rtol=1e-6, atol=1e-6 * eta.max())  # roots of small differences
    assert by_petsc[1] == pytest.approx(value, rel=1e-6)


# ---- Shares


@pytest.mark.parametrize("name", ["with advection", "displacement of a side", "in space with a rim", "clamped plate"])
def test_indicators_are_shares_of_functions(name: str) -> None:
    """With dense algebra, and F of one function after the other."""
    problem = LINEAR[name]()
    V = randomly_refined(problem.V, 1)
    W, uh, k = uniformly_refined(V), problem.solve(V), V.block_size
    P = V_in_W(V, W)
    z, z_h = dual(problem, W), dual(problem, V)
    e = z - np.kron(P, np.eye(k)) @ z_h
    weight, shares = fem.Function(W), np.zeros(V.num_functions)
    carried = adapt.transfer(uh, W)
    residual = fem.form(problem.F(carried, weight))
    for i in range(V.num_functions):
        weight.x.array = np.repeat(P[:, i], k) * e
        shares[i] = -fem.assemble_scalar(residual)
    eta, _ = estimated(problem, uh)
    expected = spread_over_supports(V, np.abs(shares))
    np.testing.assert_allclose(eta**2, expected, rtol=0, atol=1e-7 * expected.max())  # differences of solutions
    weight.x.array = e
    assert shares.sum() == pytest.approx(-fem.assemble_scalar(residual), rel=1e-9)  # partition of unity
    weight.x.array = z
    assert shares.sum() == pytest.approx(-fem.assemble_scalar(residual), rel=1e-3)  # but for quadrature


def V_in_W(V: fem.FunctionSpace, W: fem.FunctionSpace) -> Floats:
    """Return scalar functions of V in terms of those of W, dense."""
    return fem.FunctionSpace(W.hierarchy).prolongation(fem.FunctionSpace(V.hierarchy)).toarray()


def dual(problem: Problem, V: fem.FunctionSpace) -> Floats:
    """Return the dual solution by dense algebra: A^T z = j, without the prescribed dofs."""
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    A = fem.assemble_matrix(fem.form(ufl.lhs(problem.F(u, v)))).toarray()
    j = fem.assemble_vector(fem.form(problem.J(v)))
    prescribed = np.concatenate([bc.dofs for bc in problem.bcs(V)])
    free = np.setdiff1d(np.arange(V.num_dofs), prescribed)
    z = np.zeros(V.num_dofs)
    z[free] = np.linalg.solve(A[np.ix_(free, free)].T, j[free])
    return z


def spread_over_supports(V: fem.FunctionSpace, amounts: Floats) -> Floats:
    """Return the part of each cell, of amounts that are spread as functions are, by integrals of each of these."""
    psi = fem.Function(fem.FunctionSpace(V.hierarchy))
    over_cells = fem.form(psi * dx)
    result = np.zeros(V.num_cells)
    for i, amount in enumerate(amounts):
        psi.x.array = np.arange(amounts.size) == i
        parts = fem.assemble_cells(over_cells)
        result += amount * parts / parts.sum()
    return result


# ---- Adaptive runs


def test_effectivity_on_the_way_to_a_singularity() -> None:
    """At first uniform refinement sees 1 - 2^(-4/3) = 0.6 of the error at the corner, later nearly all that is left."""
    problem = l_shaped()
    exact = value_of_exact(problem)
    rows = []

    def goal(uh: fem.Function) -> tuple[Floats, float]:
        eta, value = estimated(problem, uh)
        rows.append((uh.function_space.num_dofs, exact - value_of(problem.J(uh)), value, np.sum(eta**2)))
        return eta, value

    history = adapt.solve(problem.V, problem.solve, goal, stop=adapt.Stop(dofs=700), progress=False)
    dofs, error, value, absolute = np.transpose(rows)
    np.testing.assert_array_equal(history["estimate"], value)
    effectivity = value / error
    assert 0.55 < effectivity.min() < effectivity.max() < 1.0, effectivity
    assert effectivity[dofs > 450].min() > 0.75, effectivity
    assert (absolute / error).max() < 2.0, absolute / error  # shares cancel by less than that
    slope = np.polyfit(np.log(dofs[8:]), np.log(error[8:]), 1)[0]
    assert -4.5 < slope < -3.0, slope  # twice the order of H1, and what is caught up


def test_goals_take_fewer_dofs_than_energies() -> None:
    """Of two equal bumps of the solution, one is far from what is wanted."""
    problem = bumps()

    def energy(uh: fem.Function) -> Floats:
        V = uh.function_space
        return estimate.bubble(uh, *ufl.system(problem.F(ufl.TrialFunction(V), ufl.TestFunction(V))))

    needed = {}
    for name, indicators, most in (("goal", lambda uh: estimated(problem, uh), 700), ("energy", energy, 1700)):
        errors: dict[int, float] = {}

        def keep(step: adapt.Step, uh: fem.Function, errors: dict[int, float] = errors) -> None:
            errors[step.dofs] = abs(value_of(problem.J(uh)) - BUMPS)

        adapt.solve(problem.V, problem.solve, indicators, stop=adapt.Stop(dofs=most), callback=keep, progress=False)
        needed[name] = 1 + max(dofs for dofs, error in errors.items() if error > 1e-9)  # the sign of errors changes
        assert needed[name] < most
    assert needed["goal"] < 0.5 * needed["energy"], needed


# ---- What is wrong


def test_what_is_refused() -> None:
    problem = LINEAR["mean over a part"]()
    V = problem.V
    uh, other = problem.solve(V), fem.Function(V)
    F, J = problem.forms(uh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    finer = ufl.TestFunction(uniformly_refined(V))
    wrong = [
        (inner(grad(u), grad(v)) * dx, J, ValueError, r"F has 2 arguments; it must have 1: it is the residual that uh"),
        (uh * dx, J, ValueError, r"F has 0 arguments; it must have 1"),
        (F, uh * v * dx, ValueError, r"J has 1 arguments; it must have 0: it is a number computed from uh, such as"),
        (other * v * dx, J, ValueError, r"F does not depend on uh: .*, of linear problems a\(uh, v\) - L\(v\)"),
        (F, other * dx, ValueError, r"J does not depend on uh"),
        (F, ufl.sign(uh) * dx, ValueError, r"the derivative of J by uh is zero"),
        (
            uh * finer * dx,
            J,
            ValueError,
            r"uh is in FunctionSpace.*49 dofs.*, but the test function of F in .*: give it",
        ),
        (fem.form(F), J, TypeError, r"F is a Form, but derivatives of it are needed: give a UFL form"),
        (F, 1.0, TypeError, r"J is a float, but derivatives"),
    ]
    for F_given, J_given, kind, message in wrong:
        with pytest.raises(kind, match=message):
            estimate.goal(uh, F_given, J_given, fixed=fem.boundary_dofs)
    with pytest.raises(TypeError, match=r"fixed is a ndarray, but it is needed in the refined space as well"):
        estimate.goal(uh, F, J, fixed=fem.boundary_dofs(V))
    with pytest.raises(TypeError, match=r"uh is a list; it must be a fem.Function, as goals are of one unknown"):
        estimate.goal([uh], F, J)
    with pytest.raises(TypeError, match=r"goal needs a space from fem.functionspace"):
        estimate.goal(fem.Function(fem.cellwise(V)), F, J)
    with pytest.raises(ValueError, match=r"a condition is on .*, but the unknown is in"):
        estimate.goal(uh, F, J, fixed=lambda W: boundary_zero(V))
    with pytest.raises(TypeError, match=r"fixed returned None: let it return what is prescribed in the space that"):
        estimate.goal(uh, F, J, fixed=lambda W: None)
    with pytest.raises(ValueError, match=r"the form has dx\(77\), but tags") as found:  # nothing to do with `fixed`
        estimate.goal(uh, F, uh * dx(77), fixed=fem.boundary_dofs)
    assert not hasattr(found.value, "__notes__")


def test_dofs_are_found_anew() -> None:
    """In the refined space those of uh's space are others, and the value would be that of another problem."""
    problem = LINEAR["mean over a part"]()
    V = problem.V
    uh = problem.solve(V)
    F, J = problem.forms(uh)
    with pytest.raises(ValueError, match=r"fixed returned the same dofs for the space of uh and for its refinement"):
        estimate.goal(uh, F, J, fixed=lambda W: fem.boundary_dofs(V))
    with pytest.raises(ValueError, match=r"fixed returned the same dofs"):
        estimate.goal(uh, F, J, fixed=lambda W: fem.dirichletbc(0.0, fem.boundary_dofs(V), W))


def test_functions_of_a_vertex_may_have_one_number() -> None:
    """In the refined space, too: it is that of the same place."""
    V = fem.functionspace(generators.torus((6, 6)), ("THCCS", 3))
    vertex = V.reference_points[7]

    def nearest(W: fem.FunctionSpace) -> npt.NDArray[np.int64]:
        return np.argmin(np.linalg.norm(W.reference_points - vertex, axis=1), keepdims=True)

    assert nearest(V).tolist() == nearest(uniformly_refined(V)).tolist() == [7]
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    load = ufl.SpatialCoordinate(V.mesh)[0] * v * dx
    uh = LinearProblem(inner(grad(u), grad(v)) * dx, load, bcs=[fem.dirichletbc(0.0, nearest(V), V)]).solve()
    _, value = estimate.goal(uh, inner(grad(uh), grad(v)) * dx - load, inner(grad(uh), grad(uh)) * dx, fixed=nearest)
    assert 0.0 < value < 0.1 * fem.assemble_scalar(fem.form(inner(grad(uh), grad(uh)) * dx))


def test_conditions_that_were_left_out() -> None:
    problem = LINEAR["displacement of a side"]()
    uh = problem.solve(problem.V)
    F, J = problem.forms(uh)
    with pytest.raises(ValueError, match=r"nothing is prescribed, .* of component 1, so that uh must have mean zero"):
        estimate.goal(uh, F, J, fixed=lambda V: problem.bcs(V)[:1])
    with pytest.raises(RuntimeError, match="singular") as found:
        estimate.goal(uh, F, J, fixed=at_a_corner)
    assert "See that `fixed` returns all that is prescribed" in found.value.__notes__[0]


def at_a_corner(V: fem.FunctionSpace) -> npt.NDArray[np.int32]:
    """Return a function alone, around which the block may turn."""
    return fem.boundary_dofs(V, tag=LEFT)[:1]
