"""The pure UFL forms, in numbers: integrands of polynomials, evaluated at a point of the plane."""

import pytest

import basix.ufl
import ufl
from thccs_fem.forms import laplace_beltrami, poisson
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
    return apply_derivatives(apply_algebra_lowering(expression))(POINT)


def integrands(form: ufl.Form) -> dict[str, float]:
    return {i.integral_type(): at_point(i.integrand()) for i in form.integrals()}


@pytest.mark.parametrize("equation", [laplace_beltrami, poisson])
@pytest.mark.parametrize(
    ("kappa", "expected"),
    [(1, 1 / 16), (X[0], 1 / 32), (TENSOR, (3 / 16 + 3 / 8) / 2)],
    ids=["one", "scalar", "tensor"],
)
def test_bilinear_form_is_diffusion(equation, kappa: Expr | float, expected: float) -> None:
    assert integrands(equation.a(u, v, kappa)) == {"cell": pytest.approx(expected)}


@pytest.mark.parametrize("equation", [laplace_beltrami, poisson])
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


def test_flux_is_integrated_over_the_boundary() -> None:
    expected = {"cell": pytest.approx(1 / 32), "exterior_facet": pytest.approx(3 / 16)}
    assert integrands(poisson.L(f, v, g=ufl.as_ufl(3.0))) == expected


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
