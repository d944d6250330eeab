"""Orders in time, where space contributes nothing: solutions that are quadratic in space, or of the discrete system."""

from typing import Any

import numpy as np
import pytest
import scipy.linalg as la
from problems import randomly_refined
from scipy.integrate import solve_ivp

import ufl
from thccs_fem import fem, generators
from thccs_fem.fem.space import FunctionSpace
from thccs_fem.forms import heat, reaction_diffusion
from ufl import dx, grad, inner

pytest.importorskip("petsc4py")

from thccs_fem.fem.petsc import TimeProblem

ORDERS = {"implicit_euler": 1.0, "bdf2": 2.0, "crank_nicolson": 2.0}
TOLERANCE = 0.1  # of orders: what terms of higher order still change
MARGIN = 1.1  # of the last errors, which are those that were measured
END = 0.8  # from 0.3
LAST = {"implicit_euler": 1.97e-3, "bdf2": 8.1e-5, "crank_nicolson": 1.97e-5}  # of `quadratic`, with dt = 1/64
EXACT = {"snes_rtol": 1e-13}


def order(errors: list[float]) -> float:
    """Return the slope of errors between the last steps and twice as long ones."""
    return float(np.log2(errors[-2] / errors[-1]))


@pytest.mark.parametrize("scheme", ORDERS)
def test_modes_of_the_heat_equation_decay(scheme: str) -> None:
    V = randomly_refined(fem.functionspace(generators.torus((8, 6)), ("THCCS", 3)), 1)
    w, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    matrices = [fem.assemble_matrix(fem.form(form)).toarray() for form in (inner(grad(w), grad(v)) * dx, w * v * dx)]
    rates, modes = la.eigh(*matrices)
    chosen = [0, 1, 5, 12]
    errors = []
    for n in (40, 80):
        u, udot = fem.Function(V), fem.Function(V)
        u.x.array = modes[:, chosen].sum(axis=1)
        problem = TimeProblem(
            heat.F(u, udot, v), u, udot, dt=1 / n, scheme=scheme, petsc_options_prefix="modes_", petsc_options=EXACT
        )
        problem.solve(1.0)
        amplitudes = modes.T @ matrices[1] @ u.x.array
        assert amplitudes[0] == pytest.approx(1.0, abs=1e-12)  # the constants
        errors.append(float(np.abs(amplitudes[chosen] - np.exp(-rates[chosen])).max()))
    assert order(errors) == pytest.approx(ORDERS[scheme], abs=TOLERANCE)
    assert errors[-1] < MARGIN * {"implicit_euler": 3.3e-3, "bdf2": 4.2e-5, "crank_nicolson": 1.6e-5}[scheme]


def quadratic(V: FunctionSpace, scheme: str, dt: float) -> tuple[TimeProblem, ufl.core.expr.Expr]:
    """Return a problem with data on the boundary and inside that change, and its solution, which V has at each time."""
    x, t = ufl.SpatialCoordinate(V.mesh), fem.Constant(V.mesh, 0.3)
    profile = 1 + x[0] ** 2 - x[0] * x[1]
    exact = profile * ufl.cos(3 * t)
    u, udot = fem.project(exact, V), fem.Function(V)
    f = -3 * ufl.sin(3 * t) * profile - 2 * ufl.cos(3 * t) + (u**3 - exact**3)
    problem = TimeProblem(
        heat.F(u, udot, ufl.TestFunction(V), f),
        u,
        udot,
        dt=dt,
        scheme=scheme,
        t=t,
        bcs=lambda V, time: [fem.dirichletbc(exact, fem.boundary_dofs(V), V)],
        petsc_options_prefix="quadratic_",
        petsc_options=EXACT,
    )
    return problem, exact


def distance(u: fem.Function, exact: ufl.core.expr.Expr) -> float:
    return float(np.sqrt(fem.assemble_scalar(fem.form((u - exact) ** 2 * dx))))


@pytest.mark.parametrize("scheme", ORDERS)
def test_data_that_change_with_time(scheme: str) -> None:
    errors = []
    for n in (32, 64):
        problem, exact = quadratic(fem.functionspace(generators.rectangle((3, 3)), ("THCCS", 3)), scheme, 1 / n)
        errors.append(distance(problem.solve(END), exact))
    assert order(errors) == pytest.approx(ORDERS[scheme], abs=TOLERANCE)
    assert errors[-1] < MARGIN * LAST[scheme]


@pytest.mark.parametrize("every", [1, 5])
@pytest.mark.parametrize("scheme", ["bdf2", "crank_nicolson"])
def test_order_and_error_stay_where_the_space_changes(scheme: str, every: int) -> None:
    # A TSBDF that starts again has order 0.92 and 7.8 times the error if it does so every step; 1.45 and 3.6 every 5.
    coarse = fem.functionspace(generators.rectangle((3, 3)), ("THCCS", 3))
    spaces = [coarse, randomly_refined(coarse, 1), randomly_refined(coarse, 2)]
    errors = []
    for n in (32, 64):
        problem, exact = quadratic(coarse, scheme, 1 / n)
        while problem.time < END - 1e-9:
            problem.step()
            if problem.step_number % every == 0:
                problem = problem.with_space(spaces[(problem.step_number // every) % 3], lambda u, V: fem.project(u, V))
        errors.append(distance(problem.u, exact))
    assert order(errors) == pytest.approx(ORDERS[scheme], abs=TOLERANCE)
    assert errors[-1] < MARGIN * LAST[scheme]


@pytest.mark.parametrize("scheme", ["bdf2", "crank_nicolson"])
def test_order_stays_where_steps_vary(scheme: str) -> None:
    errors = []
    for n in (64, 128):
        problem, exact = quadratic(fem.functionspace(generators.rectangle((3, 3)), ("THCCS", 3)), scheme, 1 / n)
        while problem.time < END - 1e-9:
            problem.dt = (0.5, 1.5, 1.0, 1.0)[problem.step_number % 4] / n
            problem.step()
        errors.append(distance(problem.u, exact))
    assert order(errors) == pytest.approx(2.0, abs=TOLERANCE)


def test_reaction_and_diffusion_as_an_independent_integrator_has_them() -> None:
    V = fem.functionspace(generators.torus((6, 4)), ("THCCS", 3, (2,)))
    u, udot, v = fem.Function(V), fem.Function(V), ufl.TestFunction(V)
    start = np.array([0.9, 1.1]) + np.random.default_rng(0).uniform(-0.3, 0.3, (V.num_functions, 2))
    reaction = reaction_diffusion.schnakenberg(u, gamma=4)
    F = reaction_diffusion.F(u, udot, v, reaction, (0.1, 1.0))
    reference = integrated(F, u, udot, start.ravel(), 1.0)
    last = {"implicit_euler": 1.7e-2, "bdf2": 5.2e-4, "crank_nicolson": 1.4e-4}
    for scheme, expected in ORDERS.items():
        errors = []
        for n in (40, 80):
            u.x.array = start.ravel()
            TimeProblem(F, u, udot, dt=1 / n, scheme=scheme, petsc_options_prefix="rd_", petsc_options=EXACT).solve(1.0)
            errors.append(float(np.abs(u.x.array - reference).max()))
        assert order(errors) == pytest.approx(expected, abs=TOLERANCE), scheme
        assert errors[-1] < MARGIN * last[scheme], scheme


def integrated(F: ufl.Form, u: fem.Function, udot: fem.Function, start: np.ndarray, until: float) -> np.ndarray:
    """Return the state of M du/dt = -F(u, 0), by SciPy's Radau."""
    V = u.function_space
    compiled = fem.form(F)  # with its quadrature: that of the product with the mass matrix is the same
    mass, stiffness = (
        fem.form(ufl.derivative(compiled.ufl_form, function, ufl.TrialFunction(V))) for function in (udot, u)
    )
    factors = la.cho_factor(fem.assemble_matrix(mass).toarray())
    udot.x.array = 0.0

    def rate(t: float, values: np.ndarray) -> Any:
        u.x.array = values
        return -la.cho_solve(factors, fem.assemble_vector(compiled))

    def jacobian(t: float, values: np.ndarray) -> Any:  # else there are as many rates as dofs
        u.x.array = values
        return -la.cho_solve(factors, fem.assemble_matrix(stiffness).toarray())

    return solve_ivp(rate, (0.0, until), start, method="Radau", rtol=1e-9, atol=1e-11, jac=jacobian).y[:, -1]
