"""The pure UFL forms, in numbers: integrands of polynomials, evaluated at a point of the plane."""

import pytest

import basix.ufl
import ufl
from thccs_fem.forms import (
    allen_cahn,
    biharmonic,
    cahn_hilliard,
    eigenmodes,
    heat,
    helmholtz,
    laplace_beltrami,
    linear_elasticity,
    minimal_surface,
    plate,
    poisson,
    reaction_diffusion,
)
from ufl.algorithms.apply_algebra_lowering import apply_algebra_lowering
from ufl.algorithms.apply_derivatives import apply_derivatives
from ufl.core.expr import Expr

# Lagrange elements of Basix: the forms know nothing of the project's own.
ELEMENT = basix.ufl.element("Lagrange", "quadrilateral", 1)
PLANE = ufl.Mesh(basix.ufl.element("Lagrange", "quadrilateral", 1, shape=(2,)))
X = ufl.SpatialCoordinate(PLANE)
POINT = (0.5, 0.25)
TENSOR = ufl.as_matrix([[2, 1], [1, 3]])

u = X[0] ** 3 * X[1]  # at POINT: value 1/32, gradient (3/16, 1/8), Hessian [[3/4, 3/4], [3/4, 0]]
v = X[1] ** 2  # at POINT: value 1/16, gradient (0, 1/2)
f = X[0]  # at POINT: 1/2


def at_point(expression: Expr) -> float:
    return apply_derivatives(apply_algebra_lowering(expression))(POINT, {ufl.FacetNormal(PLANE): (0.6, 0.8)})


def integrands(form: ufl.Form) -> dict[str, float]:
    totals: dict[str, float] = {}
    for i in form.integrals():
        totals[i.integral_type()] = totals.get(i.integral_type(), 0.0) + at_point(i.integrand())
    return totals


@pytest.mark.parametrize("equation", [eigenmodes, laplace_beltrami, poisson])
@pytest.mark.parametrize(
    ("kappa", "expected"),
    [(1, 1 / 16), (X[0], 1 / 32), (TENSOR, (3 / 16 + 3 / 8) / 2)],
    ids=["one", "scalar", "tensor"],
)
def test_bilinear_form_is_diffusion(equation, kappa: Expr | float, expected: float) -> None:
    assert integrands(equation.a(u, v, kappa)) == {"cell": pytest.approx(expected)}


@pytest.mark.parametrize("equation", [helmholtz, laplace_beltrami, poisson])
def test_load_is_source_times_test_function(equation) -> None:
    assert integrands(equation.L(f, v)) == {"cell": pytest.approx(1 / 32)}


@pytest.mark.parametrize("equation", [laplace_beltrami, poisson])
@pytest.mark.parametrize(
    ("kappa", "divergence"),
    # div(x0 grad u) = x0 lap u + d0 u; with the tensor, the double contraction with the Hessian.
    [(1, 3 / 4), (X[0], 3 / 8 + 3 / 16), (TENSOR, 2 * 3 / 4 + 2 * 3 / 4)],
    ids=["one", "scalar", "tensor"],
)
def test_strong_residual_has_the_sign_of_the_source(equation, kappa: Expr | float, divergence: float) -> None:
    assert at_point(equation.strong_residual(u, f, kappa)) == pytest.approx(1 / 2 + divergence)


def test_reaction_enters_form_and_residual() -> None:
    assert integrands(poisson.a(u, v, c=8)) == {"cell": pytest.approx(1 / 16 + 8 / 32 / 16)}
    assert at_point(poisson.strong_residual(u, f, c=8)) == pytest.approx(1 / 2 + 3 / 4 - 8 / 32)


@pytest.mark.parametrize("equation", [helmholtz, laplace_beltrami, poisson])
def test_flux_is_integrated_over_the_boundary(equation) -> None:
    expected = {"cell": pytest.approx(1 / 32), "exterior_facet": pytest.approx(3 / 16)}
    assert integrands(equation.L(f, v, g=ufl.as_ufl(3.0))) == expected


def on_part(form: ufl.Form) -> dict[str, object]:
    return {i.integral_type(): i.subdomain_id() for i in form.integrals()}


def test_boundary_terms_are_where_ds_says() -> None:
    g, ds, both = ufl.as_ufl(3.0), ufl.ds(7), {"cell": "everywhere", "exterior_facet": 7}
    loads = [equation.L(f, v, g, ds) for equation in (helmholtz, laplace_beltrami, poisson)]
    for form in (*loads, helmholtz.a(u, v, 1, z=2, ds=ds), heat.F(u, udot, v, f, g, ds=ds)):
        assert on_part(form) == both
    assert on_part(cahn_hilliard.contact(u, v, 0.5, 0.1, ds=ds)) == {"exterior_facet": 7}


@pytest.mark.parametrize("equation", [laplace_beltrami, poisson])
@pytest.mark.parametrize(
    ("kappa", "flux_u", "flux_v", "across"),
    # kappa grad(u) . n, kappa grad(v) . n and n . kappa n for the normal n = (3/5, 4/5).
    [(1, 0.2125, 0.4, 1.0), (X[0], 0.10625, 0.2, 0.5), (TENSOR, 0.75, 1.5, 3.6)],
    ids=["one", "scalar", "tensor"],
)
def test_nitsche_is_consistency_symmetry_and_penalty(
    equation, kappa: Expr | float, flux_u: float, flux_v: float, across: float
) -> None:
    miss = 1 / 32 - 5  # u - g
    expected = -flux_u / 16 - flux_v * miss + 10 * across / 0.5 * miss / 16
    form = equation.nitsche(u, v, 5, 0.5, kappa, gamma=10)
    assert integrands(form) == {"exterior_facet": pytest.approx(expected)}
    assert on_part(equation.nitsche(u, v, 5, 0.5, ds=ufl.ds(7))) == {"exterior_facet": 7}


@pytest.mark.parametrize("equation", [laplace_beltrami, poisson])
def test_nitsche_is_symmetric_in_trial_and_test_function(equation) -> None:
    symmetric = integrands(equation.nitsche(u, v, 0, 0.5)) == integrands(equation.nitsche(v, u, 0, 0.5))
    assert symmetric


def test_waves_have_less_than_the_stiffness() -> None:
    expected = {"cell": pytest.approx(1 / 16 - 16 / 512), "exterior_facet": pytest.approx(8 / 512)}
    assert integrands(helmholtz.a(u, v, k=4, z=8)) == expected
    assert integrands(helmholtz.a(u, v, k=4)) == {"cell": expected["cell"]}
    assert at_point(helmholtz.strong_residual(u, f, k=4)) == pytest.approx(1 / 2 + 3 / 4 + 16 / 32)


def test_modes_have_stiffness_and_mass() -> None:
    assert integrands(eigenmodes.m(u, v, rho=8)) == {"cell": pytest.approx(8 / 512)}
    assert at_point(eigenmodes.strong_residual(u, 10, rho=2)) == pytest.approx(20 / 32 + 3 / 4)
    assert at_point(eigenmodes.strong_residual(u, 10, kappa=X[0])) == pytest.approx(10 / 32 + 3 / 8 + 3 / 16)


def test_stress_and_work_of_a_displacement() -> None:
    U = ufl.as_vector([u, v])  # strain at POINT: [[3/16, 1/16], [1/16, 1/2]]
    V = ufl.as_vector([X[1] ** 2, X[0] * X[1]])  # strain at POINT: [[0, 3/8], [3/8, 1/2]]
    strain = [[3 / 16, 1 / 16], [1 / 16, 1 / 2]]
    stress = [[5 / 2, 3 / 8], [3 / 8, 35 / 8]]  # lmbda = 2, mu = 3: 2 * 11/16 on the diagonal, and 6 times the strain
    for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
        assert at_point(linear_elasticity.epsilon(U)[i, j]) == pytest.approx(strain[i][j])
        assert at_point(linear_elasticity.sigma(U, 2, 3)[i, j]) == pytest.approx(stress[i][j])
    work = 2 * 3 / 8 * 3 / 8 + 35 / 8 / 2
    assert integrands(linear_elasticity.a(U, V, 2, 3)) == {"cell": pytest.approx(work)}
    # (lmbda + mu) grad(div(U)) + mu div(grad(U)) = 5 (3/4, 11/4) + 3 (3/4, 2)
    residual = linear_elasticity.strong_residual(U, ufl.as_vector([1, 2]), 2, 3)
    assert [at_point(residual[i]) for i in (0, 1)] == [pytest.approx(1 + 6), pytest.approx(2 + 79 / 4)]
    load = linear_elasticity.L(ufl.as_vector([f, 0]), V, t=ufl.as_vector([0, f]))
    assert integrands(load) == {"cell": pytest.approx(1 / 32), "exterior_facet": pytest.approx(1 / 16)}


def test_constants_of_sheets() -> None:
    assert linear_elasticity.plane_strain(E=1, nu=0.25) == (pytest.approx(0.4), pytest.approx(0.4))
    assert linear_elasticity.plane_stress(E=1, nu=0.25) == (pytest.approx(4 / 15), pytest.approx(0.4))


def test_bending_of_plates() -> None:
    # H(u) = [[3/4, 3/4], [3/4, 0]], H(v) = [[0, 0], [0, 2]]; div(grad(div(grad(u)))) = 0, of u * y it is 24 x
    assert integrands(biharmonic.a(u, v, kappa=2)) == {"cell": pytest.approx(2 * 3 / 4 * 2)}
    assert integrands(biharmonic.L(f, v)) == integrands(plate.L(f, v)) == {"cell": pytest.approx(1 / 32)}
    D, nu = 2, 0.25
    m = [[3 / 2, 9 / 8], [9 / 8, 3 / 8]]  # 2 (3/4 H(u) + 1/4 3/4 I)
    for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
        assert at_point(plate.moments(u, D, nu)[i, j]) == pytest.approx(m[i][j])
    assert integrands(plate.a(u, v, D, nu)) == {"cell": pytest.approx(2 * 3 / 8)}
    assert at_point(plate.strong_residual(u * X[1], f, D, nu)) == pytest.approx(1 / 2 - D * 24 / 2)
    assert at_point(biharmonic.strong_residual(u * X[1], f, kappa=3)) == pytest.approx(1 / 2 - 3 * 24 / 2)
    with pytest.raises(ValueError, match="5 is no function on a mesh, so it has no Hessian"):
        plate.hessian(ufl.as_ufl(5))


def test_edges_of_plates() -> None:
    # With n = (3/5, 4/5), s = (-4/5, 3/5), nu = 1/4 and D = 1, div(m) = grad(div(grad(u))) = (6 y, 6 x) and zero for v.
    m_nn, m_ns = 0.75 * 0.99 + 0.1875, -0.75 * 0.57  # H_nn = 3/4 33/25, H_ns = -3/4 19/25
    m_nn_v, m_ns_v = 0.75 * 1.28 + 0.5, 0.75 * 2 * 0.48
    slope_u, along_u, slope_v, along_v = 0.2125, -0.075, 0.4, 0.3
    reaction = 1.5 * 0.6 + 3 * 0.8
    miss = 1 / 32 - 5
    support = reaction / 16 - m_ns * along_v - m_ns_v * along_u + 10 / 0.125 * miss / 16
    form = plate.supported(u, v, 5, 0.5, nu=0.25, gamma=10)
    assert integrands(form) == {"exterior_facet": pytest.approx(support)}
    clamp = -m_nn * slope_v - m_nn_v * slope_u + 0.02 * 10 / 0.5 * slope_u * slope_v
    form = plate.clamped(u, v, 5, 0.5, nu=0.25, gamma=10, ds=ufl.ds(7))
    assert sum(at_point(i.integrand()) for i in form.integrals()) == pytest.approx(support + clamp)
    assert {i.subdomain_id() for i in form.integrals()} == {7}


def test_area_of_a_graph_and_its_derivative() -> None:
    w = 2 * X[0] ** 2 + 2 * X[1]  # at POINT: gradient (2, 2), so W = 3
    assert integrands(minimal_surface.area(w)) == {"cell": pytest.approx(3)}
    assert integrands(minimal_surface.F(w, v)) == {"cell": pytest.approx(1 / 3)}
    assert integrands(minimal_surface.F(w, v, f)) == {"cell": pytest.approx(1 / 3 - 1 / 32)}
    # div(grad(w) / W) = div(grad(w)) / W - grad(w) . Hessian grad(w) / W^3, the Hessian being [[4, 0], [0, 0]]
    assert at_point(minimal_surface.strong_residual(w, f)) == pytest.approx(1 / 2 + 4 / 3 - 16 / 27)


def test_residual_of_a_graph_is_the_derivative_of_its_area() -> None:
    more, less = (integrands(minimal_surface.area(u + e * v))["cell"] for e in (1e-5, -1e-5))
    derivative = (more - less) / 2e-5  # errs by e^2, and by rounding / e
    assert integrands(minimal_surface.F(u, v)) == {"cell": pytest.approx(derivative, abs=1e-9)}


@pytest.mark.parametrize("equation", [laplace_beltrami, poisson])
@pytest.mark.parametrize("gdim", [2, 3])
def test_forms_take_arguments_of_any_space(equation, gdim: int) -> None:
    domain = ufl.Mesh(basix.ufl.element("Lagrange", "quadrilateral", 1, shape=(gdim,)))
    V = ufl.FunctionSpace(domain, ELEMENT)
    trial, test, source = ufl.TrialFunction(V), ufl.TestFunction(V), ufl.Coefficient(V)
    assert equation.a(trial, test).arguments() == (test, trial)
    assert equation.L(source, test).arguments() == (test,)
    assert equation.L(source, test).coefficients() == (source,)
    assert equation.strong_residual(source, source).ufl_shape == ()


# ---- Equations in time

udot = X[0] * X[1]  # at POINT: 1/8


def at_points(expression: Expr) -> list[float]:
    return [at_point(expression[i]) for i in range(expression.ufl_shape[0])]


@pytest.mark.parametrize(
    ("kappa", "diffusion", "divergence"),
    [(1, 1 / 16, 3 / 4), (X[0], 1 / 32, 3 / 8 + 3 / 16), (TENSOR, (3 / 16 + 3 / 8) / 2, 3)],
    ids=["one", "scalar", "tensor"],
)
def test_heat(kappa: Expr | float, diffusion: float, divergence: float) -> None:
    inside = pytest.approx(1 / 128 + diffusion - 1 / 32)
    assert integrands(heat.F(u, udot, v, f, kappa=kappa)) == {"cell": inside}
    assert integrands(heat.F(u, udot, v, f, ufl.as_ufl(3), kappa)) == {
        "cell": inside,
        "exterior_facet": pytest.approx(-3 / 16),
    }
    assert at_point(heat.strong_residual(u, udot, f, kappa)) == pytest.approx(1 / 2 + divergence - 1 / 8)


def test_reactions_and_diffusion_of_two_substances() -> None:
    state, rate, test = (ufl.as_vector(pair) for pair in ([u, v], [udot, X[1]], [v, X[1]]))
    reaction = ufl.as_vector([f, 1])
    expected = (1 / 8 - 1 / 2) / 16 + (1 / 4 - 1) / 4 + 2 / 16 + 3 / 2
    assert integrands(reaction_diffusion.F(state, rate, test, reaction, (2, 3))) == {"cell": pytest.approx(expected)}
    residual = reaction_diffusion.strong_residual(state, rate, reaction, (2, 3))
    assert at_points(residual) == [pytest.approx(1 / 2 + 2 * 3 / 4 - 1 / 8), pytest.approx(1 + 3 * 2 - 1 / 4)]


def test_kinetics() -> None:
    state = ufl.as_vector([2 + 0 * X[0], 3])
    schnakenberg = reaction_diffusion.schnakenberg(state, a=0.1, b=0.9, gamma=10)
    assert at_points(schnakenberg) == [pytest.approx(10 * (0.1 - 2 + 12)), pytest.approx(10 * (0.9 - 12))]
    gray_scott = reaction_diffusion.gray_scott(state, feed=0.04, kill=0.06)
    assert at_points(gray_scott) == [pytest.approx(-0.04 - 18), pytest.approx(18 - 0.3)]
    at_rest = reaction_diffusion.schnakenberg(ufl.as_vector([1.2, 0.8 / 1.2**2]), a=0.4, b=0.8)
    assert at_points(at_rest) == pytest.approx([0, 0], abs=1e-15)
    assert at_points(reaction_diffusion.gray_scott(ufl.as_vector([1, 0]))) == [0, 0]


def test_phases() -> None:
    slope = (1 / 32) ** 3 - 1 / 32  # W'(u)
    expected = 1 / 128 + 1 / 16 + 4 * slope / 16
    assert integrands(allen_cahn.F(u, udot, v, epsilon=0.5)) == {"cell": pytest.approx(expected)}
    assert at_point(allen_cahn.strong_residual(u, udot, 0.5)) == pytest.approx(3 / 4 - 4 * slope - 1 / 8)
    interface = ufl.tanh((X[0] - 0.4) / (ufl.sqrt(2) * 0.1))
    assert at_point(allen_cahn.strong_residual(interface, ufl.as_ufl(0), 0.1)) == pytest.approx(0, abs=1e-12)  # of 40


def test_unmixing() -> None:
    local = (3 / 32**2 - 1) / 4 / 16  # of W''(u) M grad(u) . grad(v), and div(M grad(v)) is 1
    expected = 1 / 128 + local + 3 / 4 / 4
    assert integrands(cahn_hilliard.F(u, udot, v, epsilon=0.5, M=X[1])) == {"cell": pytest.approx(expected)}
    potential = (1 / 32) ** 3 - 1 / 32 - 3 / 4 / 4
    assert at_point(cahn_hilliard.chemical_potential(u, 0.5)) == pytest.approx(potential)
    expected = 1 / 4 / 4 * (-3 / 4 * 0.4 - 2 * 0.2125 + 10 * 0.2125 * 0.4 / 0.1)
    contact = cahn_hilliard.contact(u, v, epsilon=0.5, h=0.1, M=X[1], gamma=10)
    assert integrands(contact) == {"exterior_facet": pytest.approx(expected)}


def test_energies_of_phases_and_their_derivatives() -> None:
    well = (1 / 32**2 - 1) ** 2 / 4
    gradient = (9 / 256 + 1 / 64) / 2
    assert integrands(allen_cahn.energy(u, 0.5)) == {"cell": pytest.approx(gradient + 4 * well)}
    assert integrands(cahn_hilliard.energy(u, 0.5)) == {"cell": pytest.approx(gradient / 4 + well)}
    more, less = (integrands(allen_cahn.energy(u + e * v, 0.5))["cell"] for e in (1e-5, -1e-5))
    derivative = (more - less) / 2e-5  # errs by e^2, and by rounding / e
    assert integrands(allen_cahn.F(u, udot, v, 0.5)) == {"cell": pytest.approx(1 / 128 + derivative, abs=1e-9)}
