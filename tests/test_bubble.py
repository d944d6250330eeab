"""The bubble estimator against dense quadrature, closed forms, and the energy norm of errors that are known."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pytest
from problems import (
    laplacian,
    lifted,
    poisson,
    projected_in_h1,
    randomly_refined,
    singular,
    smooth,
    tangential,
    uniformly_refined,
    wavy,
)

import ufl
from thccs_fem import adapt, element, estimate, fem, generators, quadrature
from thccs_fem.fem.assembly import assemble_cells
from thccs_fem.mesh import ControlMesh
from ufl import div, dx, grad, inner

Floats = npt.NDArray[np.float64]
Expr = ufl.core.expr.Expr
Make = Callable[[], fem.FunctionSpace]


def tagged(msh: ControlMesh) -> ControlMesh:
    return ControlMesh(msh.vertices, msh.quads, face_tags=np.arange(msh.num_faces) % 3, corners=msh.corners)


def planar(value_shape: tuple[int, ...] = (), times: int = 2) -> fem.FunctionSpace:
    return randomly_refined(fem.functionspace(tagged(generators.wheel(5, 2)), ("THCCS", 3, value_shape)), times)


def on_surface(value_shape: tuple[int, ...] = (), times: int = 2) -> fem.FunctionSpace:
    return randomly_refined(fem.functionspace(tagged(generators.cube_sphere(2)), ("THCCS", 3, value_shape)), times)


def curved(value_shape: tuple[int, ...] = (), times: int = 2) -> fem.FunctionSpace:
    return randomly_refined(fem.functionspace(tagged(lifted(generators.wheel(8, 2))), ("THCCS", 3, value_shape)), times)


SPACES = {"planar": planar, "closed": on_surface, "with a rim in space": curved}
each_space = pytest.mark.parametrize("make", SPACES.values(), ids=SPACES)


def arguments(V: fem.FunctionSpace) -> tuple[ufl.Argument, ufl.Argument]:
    return ufl.TrialFunction(V), ufl.TestFunction(V)


def with_random_values(V: fem.FunctionSpace, seed: int = 0) -> fem.Function:
    function = fem.Function(V)
    function.x.array = np.random.default_rng(seed).standard_normal(V.num_dofs)
    return function


def energy(u: Expr, v: Expr) -> ufl.Form:
    return (inner(grad(u), grad(v)) + u * v) * dx


# ---- The slow path: every term by dense quadrature, cell by cell


@dataclass(frozen=True)
class Problem:
    """The integrals of grad(v) : A grad(u), v . (grad(u) beta), w v . M u, |grad(v)|^2 on tag 1, and v . (x0, x1 ..).

    A and M, of shape (k, k), couple components; neither is symmetric.
    """

    A: Floats
    M: Floats
    beta: Floats
    w: fem.Function

    @classmethod
    def on(cls, V: fem.FunctionSpace, w: fem.Function) -> "Problem":
        rng, k = np.random.default_rng(1), V.block_size
        A, M = (2 * np.eye(k) + 0.3 * rng.standard_normal((k, k)) for _ in range(2))
        return cls(A, M, rng.standard_normal(V.mesh.gdim), w)

    def forms(self, V: fem.FunctionSpace) -> tuple[ufl.Form, ufl.Form]:
        u, v = arguments(V)
        x, msh = ufl.SpatialCoordinate(V.mesh), V.mesh
        A, M = (fem.Constant(msh, m if V.value_shape else m[0, 0]) for m in (self.A, self.M))
        beta = fem.Constant(msh, self.beta)
        product = ufl.dot if V.value_shape else (lambda matrix, right: matrix * right)
        a = inner(product(A, grad(u)), grad(v)) * dx + inner(ufl.dot(grad(u), beta), v) * dx
        a += self.w * inner(product(M, u), v) * dx + inner(grad(u), grad(v)) * dx(1)
        load = ufl.as_vector([x[i % V.mesh.gdim] for i in range(V.block_size)]) if V.value_shape else x[0]
        L = inner(load, v) * dx + inner(load, v) * dx((0, 1))
        return a, L

    def indicators(self, uh: fem.Function) -> Floats:
        V = uh.function_space
        cells, k = V.cells, V.block_size
        K, r = np.zeros((V.num_cells, 4 * k, 4 * k)), np.zeros((V.num_cells, 4 * k))
        w = adapt.transfer(self.w, fem.FunctionSpace(V.hierarchy)).local_coefficients()
        u = uh.local_coefficients()
        for piece, cell in enumerate(cells.piece_cell):
            self._add_piece(V, piece, u, w, int(cells.tag[cell]), K[cell], r[cell])
        return np.array([np.sqrt(abs(r_ @ np.linalg.solve(K_, r_))) for K_, r_ in zip(K, r, strict=True)])

    def _add_piece(
        self, V: fem.FunctionSpace, piece: int, u: Floats, w: Floats, tag: int, K: Floats, r: Floats
    ) -> None:
        cells, k = V.cells, V.block_size
        uv, weights = gauss(4)
        N, slopes = local_basis(uv)
        J = np.einsum("qdi,ic->qcd", slopes, cells.piece_points[piece])
        metric = np.einsum("qcd,qce->qde", J, J)
        dS = weights * np.sqrt(np.linalg.det(metric))
        to_surface = np.einsum("qcd,qde->qce", J, np.linalg.inv(metric))
        axes = cells.piece_axes[piece]
        b, of_cell = cell_bubbles(cells.piece_origin[piece] + uv @ axes.T)
        grad_b = np.einsum("qce,fe,qif->qic", to_surface, axes, of_cell)  # column e of axes is the derivative along e
        value, slope = N @ u[piece], np.einsum("qce,qei,ir->qrc", to_surface, slopes, u[piece])
        x = (N @ cells.piece_points[piece])[:, np.arange(k) % V.mesh.gdim]
        mass = dS * (N @ w[piece])[:, 0]
        # Components (i, r) of the residual, and ((i, r), (j, s)) of the matrix.
        A = self.A + (tag == 1) * np.eye(k)
        loads = 1 + (tag in (0, 1))
        flux, advected = np.einsum("rs,qsc->qrc", A, slope), slope @ self.beta
        of_values = dS[:, None] * (loads * x - advected) - mass[:, None] * (value @ self.M.T)
        r += (np.einsum("qi,qr->ir", b, of_values) - np.einsum("q,qic,qrc->ir", dS, grad_b, flux)).ravel()
        stiffness = np.einsum("q,qic,qjc->ij", dS, grad_b, grad_b)
        advection = np.einsum("q,qi,qjc,c->ij", dS, b, grad_b, self.beta)
        reaction = np.einsum("q,qi,qj->ij", mass, b, b)
        K += np.kron(stiffness, A) + np.kron(advection, np.eye(k)) + np.kron(reaction, self.M)


def gauss(n: int) -> tuple[Floats, Floats]:
    """Return Gauss points of the reference square, shape (n * n, 2), and their weights."""
    t, w = np.polynomial.legendre.leggauss(n)
    x, y = np.meshgrid((t + 1) / 2, (t + 1) / 2)
    return np.column_stack([x.ravel(), y.ravel()]), np.outer(w, w).ravel() / 4


def local_basis(uv: Floats) -> tuple[Floats, Floats]:
    """Return values of the 16 local functions, shape (n, 16), and derivatives along u and v, shape (n, 2, 16)."""
    values, slopes = (function(uv) for function in (element.bspline_values, element.bspline_slopes))

    def products(along_u: Floats, along_v: Floats) -> Floats:
        return (along_v[:, :, None] * along_u[:, None, :]).reshape(-1, 16)

    derivatives = products(slopes[:, 0], values[:, 1]), products(values[:, 0], slopes[:, 1])
    return products(values[:, 0], values[:, 1]), np.stack(derivatives, axis=1)


def cell_bubbles(x: Floats) -> tuple[Floats, Floats]:
    """Return values of the bubbles at points of the cell's square, shape (n, 4), and gradients, shape (n, 4, 2)."""
    f = np.stack([x * (1 - x) ** 2, x**2 * (1 - x)], axis=-1)
    df = np.stack([(1 - x) * (1 - 3 * x), x * (2 - 3 * x)], axis=-1)

    def products(along_x: Floats, along_y: Floats) -> Floats:
        return np.einsum("ni,nj->nij", along_x, along_y).reshape(-1, 4)

    gradients = products(df[:, 0], f[:, 1]), products(f[:, 0], df[:, 1])
    return products(f[:, 0], f[:, 1]), np.stack(gradients, axis=-1)


@each_space
@pytest.mark.parametrize("value_shape", [(), (2,), (3,)], ids=["scalar", "2 components", "3 components"])
def test_dense_quadrature_gives_the_same(make: Callable[..., fem.FunctionSpace], value_shape: tuple[int, ...]) -> None:
    """A form that is not symmetric, with tags and a function of a coarser space."""
    V = make(value_shape)
    w = with_random_values(fem.functionspace(V.mesh, ("THCCS", 3)), 1)
    w.x.array = 1.0 + w.x.array**2
    problem, uh = Problem.on(V, w), with_random_values(V)
    a, L = (fem.form(given, quadrature_degree=7) for given in problem.forms(V))  # 4 x 4 points, as there
    np.testing.assert_allclose(estimate.bubble(uh, a, L), problem.indicators(uh), rtol=1e-9)  # condition < 1e5


# ---- What it must be


def test_bubble_that_is_the_error_is_found_whole() -> None:
    """For a bubble U on a square, the integral of |grad(U)|^2 is 2 B(5, 3) (4/3 - 3 + 9/5)."""
    V = fem.functionspace(generators.rectangle((1, 1)), ("THCCS", 3))
    x, y = ufl.SpatialCoordinate(V.mesh)
    u, v = arguments(V)
    L = inner(grad(x**2 * (1 - x) * y * (1 - y) ** 2), grad(v)) * dx
    eta = estimate.bubble(fem.Function(V), inner(grad(u), grad(v)) * dx, L)
    np.testing.assert_allclose(eta**2, 4 / 1575, rtol=1e-12)


@each_space
def test_zero_for_a_solution_in_the_space(make: Make) -> None:
    V = make()
    u, v = arguments(V)
    uh = with_random_values(V)
    eta = estimate.bubble(uh, energy(u, v), energy(uh, v))
    assert estimate.norm(V, eta) < 1e-12 * estimate.norm(V, estimate.error(uh, ufl.as_ufl(0.0), "H1"))


def test_zero_for_a_linear_function_in_the_plane() -> None:
    """Not by the same sums on both sides, as above: grad(u) . grad(v) integrates to zero."""
    V = planar()
    u, v = arguments(V)
    x = ufl.SpatialCoordinate(V.mesh)
    uh = projected_in_h1(V, 1 + 2 * x[0] - 3 * x[1])
    eta = estimate.bubble(uh, inner(grad(u), grad(v)) * dx, fem.Constant(V.mesh, 0.0) * v * dx)
    assert estimate.norm(V, eta) < 1e-12


@each_space
def test_zero_for_a_solution_in_a_coarser_space(make: Callable[..., fem.FunctionSpace]) -> None:
    coarse = make(times=1)
    exact = with_random_values(coarse)
    V = randomly_refined(coarse)
    u, v = arguments(V)
    eta = estimate.bubble(adapt.transfer(exact, V), energy(u, v), energy(exact, v))
    assert estimate.norm(V, eta) < 1e-12 * estimate.norm(V, estimate.error(adapt.transfer(exact, V), ufl.as_ufl(0.0)))


@each_space
def test_scales_as_energy_norms_do(make: Make) -> None:
    V = make()
    u, v = arguments(V)
    uh, double = with_random_values(V), with_random_values(V)
    double.x.array *= 2.0
    load = ufl.sin(ufl.SpatialCoordinate(V.mesh)[0]) * v * dx
    eta = estimate.bubble(uh, energy(u, v), load)
    np.testing.assert_allclose(estimate.bubble(double, energy(u, v), 2 * load), 2 * eta, rtol=1e-12)
    np.testing.assert_allclose(estimate.bubble(uh, 9 * energy(u, v), 9 * load), 3 * eta, rtol=1e-12)


@each_space
def test_at_most_the_energy_norm_of_the_error_in_every_cell(make: Make) -> None:
    """It is the norm of a projection; with the same quadrature everywhere that holds to rounding."""
    V = make()
    u, v = arguments(V)
    exact = smooth(ufl.SpatialCoordinate(V.mesh)) if V.mesh.gdim == 3 else wavy(ufl.SpatialCoordinate(V.mesh))
    uh = projected_in_h1(V, exact)
    a, L = fem.form(energy(u, v), quadrature_degree=9), fem.form(energy(exact, v), quadrature_degree=9)
    true = energy_error(uh, exact, 1.0, quadrature_degree=9)
    eta = estimate.bubble(uh, a, L)
    assert (eta <= true * (1 + 1e-9)).all()
    assert estimate.norm(V, eta) > 0.3 * estimate.norm(V, true)


def test_components_that_are_not_coupled_add_up() -> None:
    V = on_surface((2,), times=1)
    scalar = fem.FunctionSpace(V.hierarchy)
    parts = [with_random_values(scalar, seed) for seed in (1, 2)]
    both = fem.Function(V)
    both.x.array = np.column_stack([part.x.array for part in parts]).ravel()
    (u, v), (w, z), x = arguments(V), arguments(scalar), ufl.SpatialCoordinate(V.mesh)
    a = (inner(grad(u), grad(v)) + inner(u, v)) * dx
    eta = estimate.bubble(both, a, (x[0] * v[0] + x[2] * v[1]) * dx)
    one, other = (estimate.bubble(p, energy(w, z), x[i] * z * dx) for p, i in zip(parts, (0, 2), strict=True))
    np.testing.assert_allclose(eta, np.hypot(one, other), rtol=1e-12)


def test_other_cells_to_integrate_on() -> None:
    """The paper's rule is 4 x 4 Gauss on regular cells, which 4 x 4 pieces of one point each amount to."""
    V = fem.functionspace(generators.torus((5, 4)), ("THCCS", 3))
    found = []
    for W in (V, V.with_integration(quadrature.paper_cells)):
        u, v = arguments(W)
        found.append(estimate.bubble(with_random_values(W), energy(u, v), ufl.SpatialCoordinate(W.mesh)[0] * v * dx))
    np.testing.assert_allclose(found[1], found[0], rtol=1e-9)


# ---- Singular local problems, values that are not finite


def test_zero_where_there_is_no_equation() -> None:
    V = planar()
    u, v = arguments(V)
    uh = with_random_values(V)
    eta = estimate.bubble(uh, inner(grad(u), grad(v)) * dx(1), v * dx(1))
    np.testing.assert_array_equal(eta[V.cells.tag != 1], 0.0)
    everywhere = estimate.bubble(uh, inner(grad(u), grad(v)) * dx, v * dx)
    np.testing.assert_allclose(eta[V.cells.tag == 1], everywhere[V.cells.tag == 1], rtol=1e-12)


def test_components_without_an_equation_do_not_matter() -> None:
    V = planar((3,))
    scalar = fem.FunctionSpace(V.hierarchy)
    (u, v), (w, z) = arguments(V), arguments(scalar)
    uh, part = with_random_values(V), fem.Function(scalar)
    part.x.array = uh.x.array[1::3]
    eta = estimate.bubble(uh, inner(grad(u[1]), grad(v[1])) * dx, v[1] * dx)
    np.testing.assert_allclose(eta, estimate.bubble(part, inner(grad(w), grad(z)) * dx, z * dx), rtol=1e-11)


def test_equations_that_say_the_same_twice() -> None:
    """The matrix has half its rank, and rounding where it should have zeros."""
    V = planar((2,))
    scalar = fem.FunctionSpace(V.hierarchy)
    (u, v), (w, z) = arguments(V), arguments(scalar)
    uh, total = with_random_values(V), fem.Function(scalar)
    total.x.array = 0.3 * uh.x.array[::2] + 0.7 * uh.x.array[1::2]
    both = [0.3 * g[0] + 0.7 * g[1] for g in (u, v)]
    eta = estimate.bubble(uh, inner(*map(grad, both)) * dx, both[1] * dx)
    np.testing.assert_allclose(eta, estimate.bubble(total, inner(grad(w), grad(z)) * dx, z * dx), rtol=1e-8)


def test_components_of_any_size_are_no_singularity() -> None:
    """Not even where one equation is 1e-20 times the other."""
    V = planar((2,))
    u, v = arguments(V)
    uh = with_random_values(V)
    small = fem.Constant(V.mesh, 1e-20)
    first = estimate.bubble(uh, inner(grad(u[0]), grad(v[0])) * dx, v[0] * dx)
    second = estimate.bubble(uh, inner(grad(u[1]), grad(v[1])) * dx, v[1] * dx)
    a = (inner(grad(u[0]), grad(v[0])) + small * inner(grad(u[1]), grad(v[1]))) * dx
    eta = estimate.bubble(uh, a, (v[0] + small * v[1]) * dx)
    np.testing.assert_allclose(eta, np.hypot(first, 1e-10 * second), rtol=1e-10)
    eta = estimate.bubble(uh, a, small * v[1] * dx + inner(grad(uh[0]), grad(v[0])) * dx)
    np.testing.assert_allclose(eta, 1e-10 * second, rtol=1e-4)  # the rounding of the first component is left


def test_equations_that_say_nearly_the_same_twice() -> None:
    V = planar((2,))
    w = fem.Function(fem.FunctionSpace(V.hierarchy))
    problem = Problem(np.array([[1.0, 1.0], [1.0, 1.0 + 1e-8]]), np.zeros((2, 2)), np.zeros(2), w)
    uh = with_random_values(V)
    a, L = (fem.form(given, quadrature_degree=7) for given in problem.forms(V))
    np.testing.assert_allclose(estimate.bubble(uh, a, L), problem.indicators(uh), rtol=1e-5)  # rounding times 1e8


def test_load_without_an_equation_is_named() -> None:
    V = planar()
    u, v = arguments(V)
    with pytest.raises(ValueError, match=r"of \d+ cells have no solution, the first that of cell \d+ on face"):
        estimate.bubble(with_random_values(V), inner(grad(u), grad(v)) * dx(1), v * dx)
    with pytest.raises(ValueError, match=f"local problems of {V.num_cells} cells have no solution"):
        estimate.bubble(with_random_values(V), fem.Constant(V.mesh, 0.0) * u * v * dx, v * dx)
    W = planar((2,))
    one, other = (0.3 * g[0] + 0.7 * g[1] for g in arguments(W))
    with pytest.raises(ValueError, match=f"local problems of {W.num_cells} cells have no solution"):
        estimate.bubble(with_random_values(W), inner(grad(one), grad(other)) * dx, ufl.TestFunction(W)[0] * dx)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_values_that_are_not_finite_are_seen_and_stay_where_they_are(value: float) -> None:
    V = planar()
    u, v = arguments(V)
    uh = with_random_values(V)
    usual = estimate.bubble(uh, energy(u, v), v * dx)
    uh.x.array[-1] = np.nan
    eta = estimate.bubble(uh, energy(u, v), v * dx)
    near = [batch.cells[(batch.dofs == V.num_dofs - 1).any(axis=1)] for batch in V.cells.batches]
    hit = np.isin(np.arange(V.num_cells), np.concatenate(near))
    assert np.isnan(eta[hit]).all()
    np.testing.assert_array_equal(eta[~hit], usual[~hit])
    zero = fem.Constant(V.mesh, 0.0)
    np.testing.assert_array_equal(estimate.bubble(uh, zero * energy(u, v), zero * v * dx), np.where(hit, np.nan, 0.0))
    kappa = fem.Constant(V.mesh, value)
    assert np.isnan(estimate.bubble(with_random_values(V), kappa * energy(u, v), v * dx)).all()


# ---- What is refused


def test_other_spaces_are_refused() -> None:
    coarse = planar(times=0)
    V = randomly_refined(coarse)
    (u, v), (w, z) = arguments(coarse), arguments(V)
    with pytest.raises(ValueError, match="but the arguments of a are in FunctionSpace"):
        estimate.bubble(fem.Function(V), energy(u, v), v * dx)
    with pytest.raises(ValueError, match="but the arguments of a are in FunctionSpace"):
        estimate.bubble(fem.Function(V), energy(w, z), v * dx)
    with pytest.raises(ValueError, match="but the arguments of a are in FunctionSpace"):
        estimate.bubble(fem.Function(V), energy(w, v), z * dx)


def test_an_equal_space_is_the_same() -> None:
    msh = generators.wheel(5, 2)
    V, W = (randomly_refined(fem.functionspace(msh, ("THCCS", 3))) for _ in range(2))
    assert V == W
    assert V.cells is not W.cells
    u, v = arguments(W)
    usual = estimate.bubble(with_random_values(W), energy(u, v), v * dx)
    np.testing.assert_array_equal(estimate.bubble(with_random_values(V), energy(u, v), v * dx), usual)


def test_forms_of_the_wrong_rank_are_refused() -> None:
    V = planar(times=0)
    u, v = arguments(V)
    with pytest.raises(ValueError, match="a and L have 1 and 2 arguments"):
        estimate.bubble(fem.Function(V), v * dx, energy(u, v))


def test_functions_of_a_finer_space_are_refused() -> None:
    V = planar(times=0)
    u, v = arguments(V)
    finer = with_random_values(randomly_refined(V))
    with pytest.raises(ValueError, match="functions on a refinement of the cells that indicators are wanted for"):
        estimate.bubble(fem.Function(V), energy(u, v), finer * v * dx)


# ---- Fourth order: bubbles without a slope on the edges


def deep(V: fem.FunctionSpace) -> fem.FunctionSpace:
    """Return the space with the caps at level 8, where forms with second derivatives are not warned of."""
    return fem.FunctionSpace(V.hierarchy.with_caps_at(8), V.value_shape)


def curvature_energy(u: Expr, v: Expr) -> ufl.Form:
    return (inner(grad(grad(u)), grad(grad(v))) + u * v) * dx


def hermite(t: Floats) -> Floats:
    """Return the two cubics of each half of [0, 1], and two derivatives, at points (n,), shape (n, 3, 2)."""
    s, sign = np.minimum(t, 1 - t), np.where(t < 0.5, 1.0, -1.0)
    even = [12 * s**2 - 16 * s**3, (24 * s - 48 * s**2) * sign, 24 - 96 * s]
    odd = [(8 * s**3 - 4 * s**2) * sign, 24 * s**2 - 8 * s, (48 * s - 8) * sign]
    return np.moveaxis(np.array([even, odd]), -1, 0).swapaxes(1, 2)


def second_derivatives(along_u: Floats, along_v: Floats) -> tuple[Floats, Floats, Floats]:
    """Return values (n, k), gradients (n, k, 2) and Hessians (n, k, 2, 2) of products; factors are (n, 3, m)."""

    def product(i: int, j: int) -> Floats:
        return (along_v[:, j, :, None] * along_u[:, i, None, :]).reshape(len(along_u), -1)

    hessian = [[product(2, 0), product(1, 1)], [product(1, 1), product(0, 2)]]
    return (
        product(0, 0),
        np.stack([product(1, 0), product(0, 1)], axis=-1),
        np.moveaxis(np.array(hessian), (0, 1), (2, 3)),
    )


def splines(t: Floats) -> Floats:
    """Return the four B-splines and two derivatives, shape (n, 3, 4)."""
    curvature = np.stack([1 - t, 3 * t - 2, 1 - 3 * t, t], axis=-1)
    return np.stack([element.bspline_values(t), element.bspline_slopes(t), curvature], axis=1)


def test_dense_quadrature_gives_the_same_of_fourth_order() -> None:
    """Pieces are of cells that are regular, irregular, and next to finer ones."""
    V = deep(planar())
    u, v = arguments(V)
    uh, cells = with_random_values(V), V.cells
    problem = curvature_energy(u, v), ufl.SpatialCoordinate(V.mesh)[0] * v * dx
    eta = estimate.bubble(uh, *(fem.form(given, quadrature_degree=11) for given in problem))
    quarter, weights = gauss(6)  # of each quarter of each piece
    uv = np.concatenate([(quarter + corner) / 2 for corner in ((0, 0), (1, 0), (0, 1), (1, 1))])
    dS, local = np.tile(weights, 4) / 4, uh.local_coefficients()[:, :, 0]
    N, dN, ddN = second_derivatives(splines(uv[:, 0]), splines(uv[:, 1]))
    K, r = np.zeros((cells.num_cells, 4, 4)), np.zeros((cells.num_cells, 4))
    for piece, cell in enumerate(cells.piece_cell):
        axes, points = cells.piece_axes[piece], cells.piece_points[piece]
        J, JJ = np.einsum("qid,ic->qcd", dN, points), np.einsum("qide,ic->qcde", ddN, points)
        inverse, dA = np.linalg.inv(J), dS * np.abs(np.linalg.det(J))

        def in_the_plane(gradient: Floats, hessian: Floats, inverse: Floats = inverse, JJ: Floats = JJ) -> Floats:
            gradient = np.einsum("qid,qdc->qic", gradient, inverse)
            hessian = hessian - np.einsum("qic,qcde->qide", gradient, JJ)
            return np.einsum("qide,qda,qeb->qiab", hessian, inverse, inverse)

        X = cells.piece_origin[piece] + uv @ axes.T
        b, db, ddb = second_derivatives(hermite(X[:, 0]), hermite(X[:, 1]))
        H = in_the_plane(db @ axes, np.einsum("da,qide,eb->qiab", axes, ddb, axes))
        H_uh = np.einsum("qiab,i->qab", in_the_plane(dN, ddN), local[piece])
        K[cell] += np.einsum("q,qiab,qjab->ij", dA, H, H) + np.einsum("q,qi,qj->ij", dA, b, b)
        load = (N @ points)[:, 0] - N @ local[piece]
        r[cell] += np.einsum("q,qi,q->i", dA, b, load) - np.einsum("q,qiab,qab->i", dA, H, H_uh)
    expected = np.sqrt(np.einsum("ci,ci->c", r, np.linalg.solve(K, r[..., None])[..., 0]))
    np.testing.assert_allclose(eta, expected, rtol=1e-7)  # pieces are curved, and Gauss points others


def test_smooth_bubble_that_is_the_error_is_found_in_part() -> None:
    """Of e = x^2 (1 - x)^2 y^2 (1 - y)^2 on a square, by symmetry one of four bubbles, p(x) p(y), has a part."""
    V = fem.functionspace(generators.rectangle((1, 1)), ("THCCS", 3))
    x, y = ufl.SpatialCoordinate(V.mesh)
    u, v = arguments(V)
    exact = x**2 * (1 - x) ** 2 * y**2 * (1 - y) ** 2
    L = inner(grad(grad(exact)), grad(grad(v))) * dx
    eta = estimate.bubble(fem.Function(V), inner(grad(grad(u)), grad(grad(v))) * dx, L)
    t, w = np.polynomial.legendre.leggauss(6)
    t, w = (t + 1) / 4, w / 4  # the left half of what is symmetric
    p, q = hermite(t)[:, :, 0].T, [t**2 * (1 - t) ** 2, 2 * t * (1 - t) * (1 - 2 * t), 2 - 12 * t + 12 * t**2]
    (pp, pq) = ([2 * np.sum(w * f * g) for f, g in zip(p, other, strict=True)] for other in (p, q))
    a_pp, a_pq = (2 * m[0] * m[2] + 2 * m[1] ** 2 for m in (pp, pq))
    np.testing.assert_allclose(eta**2, a_pq**2 / a_pp, rtol=1e-12)


@pytest.mark.parametrize("name", SPACES)
def test_at_most_the_energy_norm_of_the_error_in_every_cell_at_fourth_order(name: str) -> None:
    V = deep(SPACES[name]())
    u, v = arguments(V)
    x = ufl.SpatialCoordinate(V.mesh)
    exact = smooth(x) if V.mesh.gdim == 3 else wavy(x)
    wanted = laplacian(V.mesh, exact)
    a, L = (div(grad(u)) * div(grad(v)) + u * v) * dx, (wanted * div(grad(v)) + exact * v) * dx
    uh = fem.project(exact, V)
    true = np.sqrt(assemble_cells(fem.form(((div(grad(uh)) - wanted) ** 2 + (uh - exact) ** 2) * dx)))
    eta = estimate.bubble(uh, a, L)
    assert (eta <= true * (1 + 1e-3)).all()  # integrated at other points
    assert estimate.norm(V, eta) > 0.1 * estimate.norm(V, true)


@each_space
def test_zero_for_a_solution_in_a_coarser_space_at_fourth_order(make: Callable[..., fem.FunctionSpace]) -> None:
    coarse = deep(make((2,), times=1))
    exact = with_random_values(coarse)
    V = randomly_refined(coarse)
    u, v = arguments(V)
    eta = estimate.bubble(
        adapt.transfer(exact, V), curvature_energy_of_vectors(u, v), curvature_energy_of_vectors(exact, v)
    )
    usual = estimate.bubble(fem.Function(V), curvature_energy_of_vectors(u, v), curvature_energy_of_vectors(exact, v))
    assert estimate.norm(V, eta) < 1e-9 * estimate.norm(V, usual)  # caps at level 8 lose 4^8 of rounding


def curvature_energy_of_vectors(u: Expr, v: Expr) -> ufl.Form:
    return (inner(grad(grad(u)), grad(grad(v))) + inner(u, v)) * dx


def test_second_derivatives_of_the_trial_function_alone_are_no_fourth_order() -> None:
    V = fem.functionspace(generators.rectangle((3, 3)), ("THCCS", 3))
    u, v = arguments(V)
    one, other = inner(grad(u), grad(v)) * dx, -div(grad(u)) * v * dx  # the same for what vanishes on edges
    L = ufl.SpatialCoordinate(V.mesh)[0] * v * dx
    np.testing.assert_allclose(*(estimate.bubble(with_random_values(V), a, L) for a in (one, other)), rtol=1e-12)


# ---- Nonlinear problems


@each_space
def test_residual_of_a_linear_problem_gives_the_same(make: Make) -> None:
    V = make()
    u, v = arguments(V)
    uh, load = with_random_values(V), ufl.sin(ufl.SpatialCoordinate(V.mesh)[0]) * v * dx
    usual = estimate.bubble(uh, energy(u, v), load)
    np.testing.assert_allclose(estimate.bubble(uh, energy(uh, v) - load), usual, rtol=1e-10)
    np.testing.assert_allclose(estimate.bubble(uh, fem.form(energy(uh, v) - load)), usual, rtol=1e-10)


@each_space
def test_nonlinear_problem_is_linear_close_to_its_solution(make: Make) -> None:
    """What differs from the linear problem for the error is of second order in it."""
    V = make()
    v, exact, shift = ufl.TestFunction(V), with_random_values(V), with_random_values(V, 1)

    def F(u: Expr) -> ufl.Form:
        return ((1 + u**2) * inner(grad(u), grad(v)) + u * v) * dx

    differences = []
    for size in (1e-2, 1e-3):
        uh = fem.Function(V)
        uh.x.array = exact.x.array + size * shift.x.array
        u = ufl.TrialFunction(V)
        eta = estimate.bubble(uh, F(uh) - F(exact))
        linear = estimate.bubble(shift, ufl.derivative(F(exact), exact, u), fem.Constant(V.mesh, 0.0) * v * dx)
        differences.append(np.abs(eta / size - linear).max() / linear.max())
    assert 0.05 * differences[0] < differences[1] < 0.2 * differences[0] < 0.2


def test_residuals_that_do_not_belong_to_a_solution_are_refused() -> None:
    V = planar(times=0)
    u, v = arguments(V)
    uh = with_random_values(V)
    with pytest.raises(ValueError, match=r"the form has 2 arguments and L is left out: give a and L of a linear"):
        estimate.bubble(uh, energy(u, v))
    with pytest.raises(ValueError, match=r"F does not depend on .*: it must have the solution itself"):
        estimate.bubble(uh, energy(with_random_values(V), v))


# ---- Effectivity: the estimate over the energy norm of the error


def energy_error(uh: fem.Function, exact: Expr, c: float, quadrature_degree: int = 11) -> Floats:
    e = uh - exact
    gradient = tangential(uh.function_space.mesh, grad(e))
    density = (inner(gradient, gradient) + c * e * e) * dx
    return np.sqrt(assemble_cells(fem.form(density, quadrature_degree=quadrature_degree)))


@pytest.mark.parametrize("valence", [3, 4, 5, 8])
def test_effectivity_on_all_levels_of_uniform_refinement(valence: int) -> None:
    V = fem.functionspace(generators.wheel(valence, 2), ("THCCS", 3))
    exact = wavy(ufl.SpatialCoordinate(V.mesh))
    found = []
    for _ in range(4):
        V = uniformly_refined(V)
        u, v = arguments(V)
        uh = poisson(V, exact, 6.25 * exact)
        eta = estimate.bubble(uh, inner(grad(u), grad(v)) * dx, 6.25 * exact * v * dx)
        found.append(estimate.norm(V, eta) / estimate.norm(V, energy_error(uh, exact, 0.0)))
    assert 0.35 < min(found)  # 0.68 on the regular mesh, 0.39 at valence 8, where all of the error is at that vertex
    assert max(found) < 0.75


def is_constant(effectivity: Floats) -> bool:
    """Tell whether all are within 20 % of one value."""
    return bool(effectivity.max() / effectivity.min() < 1.2 / 0.8)


def bump_on_a_torus(x: Expr) -> Expr:
    return ufl.exp(-2 * ((x[0] - 3) ** 2 + x[1] ** 2 + x[2] ** 2))


def bump_on_a_sphere(x: Expr) -> Expr:
    return ufl.exp(-10 * sum((x[i] - 3**-0.5) ** 2 for i in range(3)))  # at an extraordinary vertex


CLOSED = {
    "torus": (lambda: generators.torus((16, 8)), bump_on_a_torus),
    "sphere": (lambda: generators.cube_sphere(4), bump_on_a_sphere),
}


@pytest.mark.parametrize(("make", "exact"), CLOSED.values(), ids=CLOSED)
def test_effectivity_is_constant_in_adaptive_runs(
    make: Callable[[], ControlMesh], exact: Callable[[Expr], Expr]
) -> None:
    V = fem.functionspace(make(), ("THCCS", 3))
    solution = exact(ufl.SpatialCoordinate(V.mesh))
    found = []

    def indicators(uh: fem.Function) -> Floats:
        V = uh.function_space
        u, v = arguments(V)
        eta = estimate.bubble(uh, energy(u, v), energy(solution, v))
        found.append(estimate.norm(V, eta) / estimate.norm(V, energy_error(uh, solution, 1.0)))
        return eta

    adapt.solve(V, lambda V: projected_in_h1(V, solution), indicators, stop=adapt.Stop(dofs=1200), progress=False)
    resolved = np.array(found[2:])  # before, a bump is as wide as a cell
    assert resolved.size > 8
    assert is_constant(resolved)
    assert 0.35 < resolved.min() < resolved.max() < 0.65


def test_l_domain() -> None:
    V = fem.functionspace(generators.l_domain(4), ("THCCS", 3), cap_level=16)  # graded quadrature at the corner
    exact = singular(ufl.SpatialCoordinate(V.mesh))
    zero = fem.Constant(V.mesh, 0.0)
    rows = []

    def indicators(uh: fem.Function) -> Floats:
        V = uh.function_space
        u, v = arguments(V)
        eta = estimate.bubble(uh, inner(grad(u), grad(v)) * dx, zero * v * dx)
        true = estimate.norm(V, energy_error(uh, exact, 0.0))
        rows.append((V.num_dofs, true, estimate.norm(V, eta) / true))
        return eta

    adapt.solve(V, lambda V: poisson(V, exact, zero), indicators, stop=adapt.Stop(dofs=1000), progress=False)
    dofs, errors, effectivity = np.array(rows).T
    needed = np.exp(np.interp(-np.log(3e-4), -np.log(errors), np.log(dofs)))
    assert needed < 950  # 885 were measured, and 783 in a run that the error itself drives
    late = dofs > 380
    slope = np.polyfit(np.log(dofs[late]), np.log(errors[late]), 1)[0]
    assert -2.5 < slope < -1.5  # -1.9 was measured; -1.5 is optimal, and what was lost before is caught up
    assert is_constant(effectivity)
    assert 0.35 < effectivity.min() < effectivity.max() < 0.5


def test_integrals_over_edges_do_not_matter() -> None:
    """Bubbles vanish there."""
    V = randomly_refined(fem.functionspace(generators.wheel(5, 2), ("THCCS", 3)))
    u, v, n = ufl.TrialFunction(V), ufl.TestFunction(V), ufl.FacetNormal(V.mesh)
    uh = fem.Function(V)
    uh.x.array = np.random.default_rng(0).random(V.num_dofs)
    a, L = ufl.inner(ufl.grad(u), ufl.grad(v)) * ufl.dx, v * ufl.dx
    expected = estimate.bubble(uh, a, L)
    robin, penalty = u * v * ufl.ds, ufl.jump(ufl.grad(u), n) * ufl.avg(v) * ufl.dS
    np.testing.assert_array_equal(estimate.bubble(uh, a + robin + penalty, L + 3.0 * v * ufl.ds), expected)
