"""Error indicators against closed forms, quadrature by hand and what they must vanish on."""

from collections.abc import Callable
from math import sqrt

import numpy as np
import numpy.typing as npt
import pytest
from problems import errors, poisson, projected_in_h1, randomly_refined, singular, smooth, uniformly_refined, wavy

import ufl
from thccs_fem import estimate, fem, generators
from thccs_fem.estimate.indicators import over_cells
from thccs_fem.extraction import evaluate_pieces
from thccs_fem.fem.scipy import LinearProblem
from thccs_fem.mesh import ControlMesh
from ufl import div, grad

Floats = npt.NDArray[np.float64]
Make = Callable[[], fem.FunctionSpace]


def planar(times: int = 2) -> fem.FunctionSpace:
    return randomly_refined(fem.functionspace(generators.wheel(5, 2), ("THCCS", 3)), times)


def on_surface(times: int = 2) -> fem.FunctionSpace:
    return randomly_refined(fem.functionspace(generators.cube_sphere(2), ("THCCS", 3)), times)


SPACES = {"planar": planar, "on a surface": on_surface}
each_space = pytest.mark.parametrize("make", SPACES.values(), ids=SPACES)


def with_random_values(V: fem.FunctionSpace, seed: int = 0) -> fem.Function:
    function = fem.Function(V)
    function.x.array = np.random.default_rng(seed).standard_normal(V.num_dofs)
    return function


def coordinate(V: fem.FunctionSpace) -> fem.Function:
    """Return the function that is the first coordinate, which every space holds."""
    return projected_in_h1(V, ufl.SpatialCoordinate(V.mesh)[0])


# ---- The exact error


def test_error_of_a_constant_is_the_root_of_the_area() -> None:
    V = fem.functionspace(generators.rectangle((4, 2)), ("THCCS", 3))
    eta = estimate.error(fem.Function(V), ufl.as_ufl(2.0))
    np.testing.assert_allclose(eta, 2.0 * np.sqrt(1 / 8), rtol=1e-14)
    assert estimate.norm(V, eta) == pytest.approx(2.0, rel=1e-14)


def test_error_of_a_polynomial() -> None:
    V = fem.functionspace(generators.rectangle((1, 2)), ("THCCS", 3))
    x = ufl.SpatialCoordinate(V.mesh)
    eta = estimate.error(fem.Function(V), x[0] ** 2 * x[1])  # int x^4 = 1/5; int y^2 = 1/24 and 7/24
    np.testing.assert_allclose(eta**2, [1 / 120, 7 / 120], rtol=1e-13)
    eta = estimate.error(fem.Function(V), x[0] ** 2 * x[1], "H1")  # gradient (2 x y, x^2)
    np.testing.assert_allclose(eta**2, [1 / 120 + 4 / 72 + 1 / 10, 7 / 120 + 28 / 72 + 1 / 10], rtol=1e-13)


def test_exact_solution_may_be_a_function_of_the_coordinate() -> None:
    V = planar()
    uh = with_random_values(V)
    expected = estimate.error(uh, wavy(ufl.SpatialCoordinate(V.mesh)), "H1")
    np.testing.assert_array_equal(estimate.error(uh, wavy, "H1"), expected)


@each_space
def test_error_in_l2_by_hand(make: Make) -> None:
    V = make()
    uh = with_random_values(V)
    points, weights = gauss(6)
    pieces = np.arange(V.cells.num_pieces)
    at = np.repeat(pieces, len(points)), np.tile(points, (pieces.size, 1))
    x = evaluate_pieces(V.cells.piece_points, *at).T
    difference = evaluate_pieces(uh.local_coefficients(), *at)[:, 0] - np.cos(x[0]) * x[1]
    squares = difference.reshape(pieces.size, -1) ** 2 * V.cells.area_element(pieces, points) @ weights
    expected = np.sqrt(np.bincount(V.cells.piece_cell, weights=squares))
    actual = estimate.error(uh, lambda x: ufl.cos(x[0]) * x[1])
    np.testing.assert_allclose(actual, expected, rtol=1e-12)  # the same points: rounding


def gauss(n: int) -> tuple[Floats, Floats]:
    """Return Gauss points of the reference square, shape (n * n, 2), and their weights."""
    t, w = np.polynomial.legendre.leggauss(n)
    x, y = np.meshgrid((t + 1) / 2, (t + 1) / 2)
    return np.column_stack([x.ravel(), y.ravel()]), np.outer(w, w).ravel() / 4


@each_space
@pytest.mark.parametrize("norm", ["L2", "H1"])
def test_error_of_what_the_space_holds_is_zero(make: Make, norm: str) -> None:
    """On a surface as well, where UFL's gradient of x[0] has a normal part that no function on the surface has."""
    V = make()
    assert estimate.norm(V, estimate.error(coordinate(V), lambda x: x[0], norm)) < 1e-12


@pytest.mark.parametrize("norm", ["L2", "H1"])
def test_errors_add_up_over_components(norm: str) -> None:
    V = on_surface(times=1)
    W = fem.functionspace(V.mesh, ("THCCS", 3, (2,))).with_hierarchy(V.hierarchy)
    u, v, w = with_random_values(V, 1), with_random_values(V, 2), fem.Function(W)
    w.x.array = np.column_stack([u.x.array, v.x.array]).ravel()
    x = ufl.SpatialCoordinate(V.mesh)
    one, other = smooth(x), ufl.sin(x[2])
    expected = np.hypot(estimate.error(u, one, norm), estimate.error(v, other, norm))
    np.testing.assert_allclose(estimate.error(w, ufl.as_vector([one, other]), norm), expected, rtol=1e-12)


def test_error_against_a_function_of_a_coarser_space_is_on_the_cells_of_uh() -> None:
    coarse = planar(times=0)
    fine = randomly_refined(coarse, times=2)
    exact = with_random_values(coarse)
    eta = estimate.error(fem.Function(fine), exact)
    assert eta.shape == (fine.num_cells,)
    assert estimate.norm(fine, eta) == pytest.approx(estimate.norm(coarse, estimate.error(exact, ufl.as_ufl(0.0))))


def test_error_against_a_function_of_a_finer_space_is_refused() -> None:
    coarse = planar(times=0)
    with pytest.raises(ValueError, match="functions on a refinement of the cells that indicators are wanted for"):
        estimate.error(fem.Function(coarse), with_random_values(randomly_refined(coarse)))


def test_exact_solutions_may_be_numbers() -> None:
    V = planar(times=0)
    u = with_random_values(V)
    for exact in (2.0, 2, lambda x: 2.0, fem.Constant(V.mesh, 2.0)):
        np.testing.assert_allclose(estimate.error(u, exact, "H1"), estimate.error(u, ufl.as_ufl(2.0), "H1"), rtol=1e-14)


@pytest.mark.parametrize("estimator", [estimate.error, estimate.residual, estimate.bubble])
def test_what_is_estimated_is_one_function(estimator: Callable[..., Floats]) -> None:
    uh = fem.Function(planar(times=0))
    with pytest.raises(TypeError, match=r"uh is of type list; it must be a fem.Function. Of several unknowns give one"):
        estimator([uh], uh)
    with pytest.raises(TypeError, match=r"uh is of type FunctionSpace; it must be a fem.Function.$"):
        estimator(uh.function_space, uh)


def test_unknown_norm_is_named() -> None:
    with pytest.raises(ValueError, match="norm is 'H2'; it must be"):
        estimate.error(fem.Function(planar(times=0)), wavy, "H2")


def test_norm_is_the_root_of_the_sum_of_squares() -> None:
    assert estimate.norm(planar(times=0), np.array([3.0, 0.0, 4.0])) == 5.0


# ---- The residual


def test_residual_is_the_root_of_the_area_times_the_norm() -> None:
    V = fem.functionspace(generators.rectangle((4, 2)), ("THCCS", 3))
    eta = estimate.residual(fem.Function(V), fem.Constant(V.mesh, 3.0))  # h = sqrt(1/8), |f| = 3 sqrt(1/8)
    np.testing.assert_allclose(eta, 3 / 8 / sqrt(42), rtol=1e-14)
    eta = estimate.residual(fem.Function(V), fem.Constant(V.mesh, 3.0), order=4)
    np.testing.assert_allclose(eta, 3 / 8**1.5 / sqrt(720), rtol=1e-14)
    eta = estimate.residual(fem.Function(V), fem.Constant(V.mesh, 3.0), stiffness=4.0)
    np.testing.assert_allclose(eta, 3 / 16 / sqrt(42), rtol=1e-14)


@each_space
def test_residual_of_a_solution_in_the_space_is_zero(make: Make) -> None:
    """A linear function in the plane; a constant on a surface, where linear ones are not harmonic."""
    V = make()
    x = ufl.SpatialCoordinate(V.mesh)
    uh = projected_in_h1(V, 1 + 2 * x[0] - 3 * x[1] if V.mesh.gdim == 2 else fem.Constant(V.mesh, 1.0))
    assert estimate.norm(V, estimate.residual(uh, div(grad(uh)))) < 1e-10  # rounding times 1/h in pieces of side 1/50


def test_residual_sees_what_is_missing() -> None:
    V = planar()
    uh = fem.Function(V)
    x = ufl.SpatialCoordinate(V.mesh)
    dx = ufl.dx(domain=V.mesh.ufl_domain())
    area = over_cells(V, 1.0 * dx)
    for order, of_piece in ((2, 0.5), (4, 1.0)):
        eta = estimate.residual(uh, x[0] + div(grad(uh)), order=order)
        J = abs(ufl.JacobianDeterminant(V.mesh.ufl_domain()))
        expected = over_cells(V, J ** (of_piece * order / 2) * x[0] ** 2 * dx) * area ** ((1 - of_piece) * order / 2)
        np.testing.assert_allclose(eta**2, expected / {2: 42, 4: 720}[order], rtol=1e-12)
        whole = np.bincount(V.cells.piece_cell) == 1
        by_area = area ** (order / 2) * estimate.error(uh, x[0]) ** 2 / {2: 42, 4: 720}[order]
        np.testing.assert_allclose(eta[whole] ** 2, by_area[whole], rtol=0.1)  # of |det J| that varies in a cell
        assert (eta[~whole] ** 2 < by_area[~whole]).all()


@pytest.mark.parametrize(("valence", "lower", "upper"), [(4, 0.95, 1.1), (5, 0.45, 1.05), (8, 0.6, 1.4)])
def test_residual_is_as_large_as_the_error_on_all_levels(valence: int, lower: float, upper: float) -> None:
    """1.00 to 1.03, 0.53 to 0.94 and 0.66 to 1.29, which rises as elements come to the level of the caps."""
    V = fem.functionspace(generators.wheel(valence, 2), ("THCCS", 3))
    exact = wavy(ufl.SpatialCoordinate(V.mesh))
    effectivities = []
    for _ in range(4):
        V = uniformly_refined(V)
        uh = poisson(V, exact, 6.25 * exact)
        estimated = estimate.norm(V, estimate.residual(uh, 6.25 * exact + div(grad(uh))))
        effectivities.append(estimated / errors(uh, exact)[1])
    assert lower < min(effectivities) < max(effectivities) < upper


def test_residual_of_a_neumann_condition() -> None:
    V = fem.functionspace(tagged_rectangle(), ("THCCS", 3))  # 4 x 2 cells of 1/4 x 1/2 on the unit square
    f, g = fem.Constant(V.mesh, 3.0), fem.Constant(V.mesh, 2.0)
    h, area = np.sqrt(1 / 8), 1 / 8
    at_left, at_bottom = np.arange(8) % 4 == 0, np.arange(8) < 4
    right, top = np.arange(8) % 4 == 3, np.arange(8) >= 4
    around = 0.5 * at_left + 0.5 * right + 0.25 * at_bottom + 0.25 * top  # lengths
    inside, on_edges = h**2 * 9.0 * area / 42, 0.0749 * h
    eta = estimate.residual(fem.Function(V), f, g)
    np.testing.assert_allclose(eta**2, inside + on_edges * 4.0 * around, rtol=1e-13)
    eta = estimate.residual(fem.Function(V), f, {1: g, 2: 2.0 * g})
    np.testing.assert_allclose(eta**2, inside + on_edges * (4.0 * 0.5 * at_left + 16.0 * 0.25 * at_bottom), rtol=1e-13)
    vector = estimate.residual(fem.Function(V), f, {1: ufl.as_vector([g, f])})
    np.testing.assert_allclose(vector**2, inside + on_edges * 13.0 * 0.5 * at_left, rtol=1e-13)
    with pytest.raises(ValueError, match=r"the form has ds\(5\), but tags"):
        estimate.residual(fem.Function(V), f, {5: g})


def tagged_rectangle() -> ControlMesh:
    """Return the unit square of 4 x 2 faces with tags 1 on the left and 2 at the bottom."""
    msh = generators.rectangle((4, 2))
    x = msh.vertices[msh.edges].mean(axis=1)
    tags = {tuple(map(int, e)): 1 if m[0] == 0.0 else 2 for e, m in zip(msh.edges, x, strict=True) if 0.0 in m}
    return ControlMesh(msh.vertices, msh.quads, edge_tags=tags, corners=msh.corners)


def test_jumps_of_the_flux() -> None:
    """With u = x[0], and kappa 5 on the right half, kappa grad(u).n jumps by 4 in the middle."""
    V = fem.functionspace(generators.rectangle((4, 2)), ("THCCS", 3))
    kappa = fem.Function(fem.functionspace(V.mesh, ("DG", 0)))
    kappa.x.array = np.tile([1.0, 1.0, 5.0, 5.0], 2)
    uh, f, h = coordinate(V), fem.Constant(V.mesh, 3.0), np.sqrt(1 / 8)
    eta = estimate.residual(uh, f, flux=kappa * grad(uh))
    at_middle = np.isin(np.arange(8) % 4, [1, 2])
    np.testing.assert_allclose(eta**2, h**2 * 9 / 8 / 42 + 0.0749 * h / 2 * 16.0 * 0.5 * at_middle, rtol=1e-11)


def test_jumps_of_a_tensor() -> None:
    V = fem.functionspace(generators.rectangle((4, 2)), ("THCCS", 3))
    kappa = fem.Function(fem.functionspace(V.mesh, ("DG", 0)))
    kappa.x.array = np.tile([1.0, 1.0, 5.0, 5.0], 2)
    uh, f = coordinate(V), fem.Constant(V.mesh, 3.0)
    scalar = estimate.residual(uh, f, flux=kappa * grad(uh))
    tensor = kappa * grad(ufl.as_vector([0.6 * uh, 0.8 * uh]))
    np.testing.assert_allclose(estimate.residual(uh, f, flux=tensor), scalar, rtol=1e-13)


def test_jumps_at_caps_are_a_small_part() -> None:
    V = uniformly_refined(fem.functionspace(generators.wheel(5, 2), ("THCCS", 3)))
    exact = wavy(ufl.SpatialCoordinate(V.mesh))
    uh = poisson(V, exact, 6.25 * exact)
    strong = 6.25 * exact + div(grad(uh))
    without, together = (estimate.residual(uh, strong, flux=flux) for flux in (None, grad(uh)))
    assert (together >= without).all()
    added = together**2 - without**2
    irregular = V.cells.level_face[np.argsort(-added)[:5]]  # the cells around the vertex of valence 5
    level = V.hierarchy.stages[V.cells.level.max()].level
    assert (~level.regular)[level.quads[irregular]].any(axis=1).all()
    assert 1e-3 < added.sum() / (without**2).sum() < 0.03  # 0.017 where the caps are two levels below the cells


@pytest.mark.parametrize(("valence", "lower", "upper"), [(4, 0.95, 1.1), (5, 0.45, 1.15)])
def test_residual_with_a_neumann_condition_is_as_large_as_the_error_on_all_levels(
    valence: int, lower: float, upper: float
) -> None:
    """-div(grad(u)) + u = f with grad(u).n = g on the whole boundary: 1.01 to 1.04, and 0.54 to 1.07."""
    V = fem.functionspace(generators.wheel(valence, 2), ("THCCS", 3))
    exact, n = wavy(ufl.SpatialCoordinate(V.mesh)), ufl.FacetNormal(V.mesh)
    f, g = 7.25 * exact, ufl.dot(grad(exact), n)
    effectivities = []
    for _ in range(4):
        V = uniformly_refined(V)
        u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
        a, L = (ufl.inner(grad(u), grad(v)) + u * v) * ufl.dx, f * v * ufl.dx + g * v * ufl.ds
        uh = LinearProblem(a, L).solve()
        eta = estimate.residual(uh, f + div(grad(uh)) - uh, g - ufl.dot(grad(uh), n), grad(uh))
        effectivities.append(estimate.norm(V, eta) / errors(uh, exact)[1])
    assert lower < min(effectivities) < max(effectivities) < upper


def test_terms_of_fourth_order() -> None:
    """With u = x[0] and kappa 5 on the right half, what is across the middle jumps by 4."""
    V = fem.functionspace(tagged_rectangle(), ("THCCS", 3))
    kappa = fem.Function(fem.functionspace(V.mesh, ("DG", 0)))
    kappa.x.array = np.tile([1.0, 1.0, 5.0, 5.0], 2)
    uh, f, h = coordinate(V), fem.Constant(V.mesh, 3.0), np.sqrt(1 / 8)
    at_middle, at_left = np.isin(np.arange(8) % 4, [1, 2]), np.arange(8) % 4 == 0
    inside = h**4 * 9 / 8 / 720
    eta = estimate.residual(uh, f, order=4, flux=kappa * grad(uh))
    np.testing.assert_allclose(eta**2, inside + h**3 / 720 / 2 * 16 * 0.5 * at_middle, rtol=1e-11)
    eta = estimate.residual(uh, f, order=4, moments=kappa * ufl.outer(grad(uh), grad(uh)))
    np.testing.assert_allclose(eta**2, inside + 0.1443 * h / 2 * 16 * 0.5 * at_middle, rtol=1e-11)
    eta = estimate.residual(uh, f, {1: f}, order=4, moment={1: 2 * f})
    on_edges = (h**3 / 720 * 9 + 0.1443 * h * 36) * 0.5
    np.testing.assert_allclose(eta**2, inside + on_edges * at_left, rtol=1e-11)
    eta = estimate.residual(uh, f, order=4, flux=kappa * grad(uh), stiffness=kappa)
    jumps = h**3 / 720 / 2 * 16 * 0.5 / 3.0 * at_middle  # 3: the mean of 1 and 5
    np.testing.assert_allclose(eta**2, inside / kappa.x.array + jumps, rtol=1e-11)


def test_reaction_bounds_the_weights() -> None:
    """At its largest what is left of c u = f, over c; and what the flux of exp(-|x| sqrt(c / kappa)) jumps by."""
    V = fem.functionspace(generators.rectangle((2, 1)), ("THCCS", 3))  # 2 cells of 1/2 x 1
    uh, f, h, kappa, c = coordinate(V), fem.Constant(V.mesh, 3.0), np.sqrt(1 / 2), 1e-3, 7.0
    for order, numbers in ((2, (1 / 42, 0.0749)), (4, (1 / 720, 1 / 720))):
        eta = estimate.residual(uh, f, order=order, stiffness=kappa, reaction=c)
        inside = 9 / 2 / (kappa / (numbers[0] * h**order) + c)
        np.testing.assert_allclose(eta**2, inside, rtol=1e-12)
        eta = estimate.residual(uh, f, f, order=order, stiffness=kappa, reaction=c)
        power = order - 1
        rim = 9 * 2.0 / (kappa / (numbers[1] * h**power) + kappa ** (1 / order) * c ** (power / order))
        np.testing.assert_allclose(eta**2, inside + rim, rtol=1e-12)


def test_factors_are_those_of_splines_on_a_line() -> None:
    """Of a long strip of cells the residual is the error: of x^4 / 24, and of 1 and x^2 / 2 on one side of a knot."""
    V = fem.functionspace(generators.rectangle((64, 1), (-32.0, 0.0), (32.0, 1.0)), ("THCCS", 3))
    x, v = ufl.SpatialCoordinate(V.mesh)[0], ufl.TestFunction(V)
    u, one, inside = ufl.TrialFunction(V), fem.Constant(V.mesh, 1.0), abs(V.cells.face - 31.5) < 8
    right = fem.Function(fem.functionspace(V.mesh, ("DG", 0)))
    right.x.array = 1.0 * (np.arange(64) >= 32)

    def solved(derivative: Callable[[ufl.core.expr.Expr], ufl.core.expr.Expr], wanted: ufl.core.expr.Expr) -> Floats:
        """Return the solution for which derivative(u) is closest to what is wanted, by u and slope at the ends."""
        a, L = ufl.inner(derivative(u), derivative(v)) * ufl.dx, wanted * derivative(v) * ufl.dx
        bc = fem.dirichletbc(0.0, fem.locate_dofs_geometrical(V, lambda p: p[0] < -31.5), V)
        return LinearProblem(a, L, bcs=[bc]).solve()

    def across(w: ufl.core.expr.Expr) -> ufl.core.expr.Expr:
        return grad(w)[0]

    uh = solved(across, x**3 / 6)
    eta, true = (
        estimate.residual(uh, x**2 / 2 - across(across(uh))),
        over_cells(V, (x**3 / 6 - across(uh)) ** 2 * ufl.dx),
    )
    np.testing.assert_allclose(eta[inside] ** 2, true[inside], rtol=1e-3)
    uh = solved(across, right * one)
    true = over_cells(V, (right - across(uh)) ** 2 * ufl.dx)
    eta = estimate.residual(uh, 0 * x, flux=right * grad(ufl.SpatialCoordinate(V.mesh)[0]))
    assert estimate.norm(V, eta) ** 2 == pytest.approx(true[inside].sum(), rel=1e-3)


def test_level_of_the_caps_does_not_matter() -> None:
    """At a reentrant corner second derivatives are not square-integrable, near any vertex no fourth ones are."""
    found = []
    for cap_level in (4, 8, 16):
        V = fem.functionspace(generators.l_domain(4), ("THCCS", 3), cap_level=cap_level)
        uh = poisson(V, singular(ufl.SpatialCoordinate(V.mesh)), fem.Constant(V.mesh, 0.0))
        found.append(estimate.norm(V, estimate.residual(uh, div(grad(uh)))))
    assert max(found) < 1.1 * min(found)  # by the size of the cell alone, 7 times


def test_a_form_is_no_strong_residual() -> None:
    uh = fem.Function(planar(times=0))
    strong, v = div(grad(uh)), ufl.TestFunction(uh.function_space)
    with pytest.raises(TypeError, match=r"the strong residual is of type Form: give an expression, such as f"):
        estimate.residual(uh, strong * v * ufl.dx)  # type: ignore[arg-type]  # what is refused


@pytest.mark.parametrize("weight", [{"stiffness": 0.0}, {"stiffness": -1.0}, {"reaction": -1}, {"stiffness": np.nan}])
def test_negative_weights_are_refused(weight: dict[str, float]) -> None:
    """Indicators would be zero, and runs end as if nothing was wrong."""
    (name,) = weight
    with pytest.raises(ValueError, match=rf"{name} is \S+; it must "):
        estimate.residual(fem.Function(planar(times=0)), ufl.as_ufl(1.0), **weight)


def test_unknown_orders_and_moments_of_the_second_order_are_refused() -> None:
    uh = fem.Function(planar(times=0))
    with pytest.raises(ValueError, match="order is 3; residuals of equations of order 2 and 4 are known"):
        estimate.residual(uh, ufl.as_ufl(1.0), order=3)
    for given in ({"moment": ufl.as_ufl(1.0)}, {"moments": ufl.Identity(2)}):
        with pytest.raises(ValueError, match="but the order is 2: of plates and shells it is order=4"):
            estimate.residual(uh, ufl.as_ufl(1.0), **given)


def test_functions_on_finer_cells_are_refused_on_edges() -> None:
    coarse = planar(times=0)
    with pytest.raises(ValueError, match="functions on a refinement of the cells"):
        estimate.residual(fem.Function(coarse), ufl.as_ufl(1.0), with_random_values(randomly_refined(coarse)))
