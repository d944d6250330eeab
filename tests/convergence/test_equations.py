"""The equations of `thccs_fem.forms`, solved: closed forms, patch tests, and rates of uniform refinement."""

from collections.abc import Callable

import numpy as np
import pytest
import scipy.linalg
from problems import errors, lifted, moved_inside, randomly_refined, uniformly_refined, wavy

import ufl
from thccs_fem import fem, generators
from thccs_fem.fem.scipy import EigenProblem, LinearProblem, NonlinearProblem
from thccs_fem.forms import eigenmodes, helmholtz, laplace_beltrami, linear_elasticity, minimal_surface, plate, poisson
from thccs_fem.mesh import ControlMesh
from ufl import as_vector, cos, dot, grad, sin

Expr = ufl.core.expr.Expr

FULL = (4.0, 3.0)  # orders in L2 and H1
TOLERANCE = 0.2  # of rates: what terms of higher order still change on these levels
ROUNDING = 1e-12  # condition numbers of some hundreds times values of size 1


def check_rates(
    solve: Callable[[fem.FunctionSpace], fem.Function],
    exact: Callable[[Expr], Expr],
    V: fem.FunctionSpace,
    last: tuple[float, float],
    levels: int = 4,
) -> None:
    """Refine uniformly: rates are full on the last three levels, and the last errors those that were measured."""
    found = []
    for level in range(levels):
        V = uniformly_refined(V) if level else V
        found.append(errors(solve(V), exact(ufl.SpatialCoordinate(V.mesh))))
    rates = -np.polyfit(np.arange(3), np.log2(found[-3:]), 1)[0]
    np.testing.assert_allclose(rates, FULL, atol=TOLERANCE)
    assert (np.array(found[-1]) < 1.1 * np.array(last)).all()


def box(
    shape: tuple[int, int], lower: tuple[float, float] = (0, 0), upper: tuple[float, float] = (1, 1)
) -> ControlMesh:
    """Return a rectangle whose left side has edge tag 1, its right side 2, the lower side 3 and the upper 4."""
    msh = generators.rectangle(shape, lower=lower, upper=upper)
    middle = msh.vertices[msh.edges].mean(axis=1)
    sides = [middle[:, 0] == lower[0], middle[:, 0] == upper[0], middle[:, 1] == lower[1], middle[:, 1] == upper[1]]
    tags = {(i, j): tag for tag, side in enumerate(sides, start=1) for i, j in msh.edges[side].tolist()}
    return ControlMesh(msh.vertices, msh.quads, edge_tags=tags)


# ---- Poisson's equation by Nitsche's method


def by_nitsche(V: fem.FunctionSpace) -> fem.Function:
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    exact = wavy(ufl.SpatialCoordinate(V.mesh))
    F = poisson.a(u, v) - poisson.L(6.25 * exact, v) + poisson.nitsche(u, v, exact, fem.cell_sizes(V))
    return LinearProblem(*ufl.system(F)).solve()


def test_nitsche_converges() -> None:
    check_rates(by_nitsche, wavy, fem.functionspace(generators.rectangle((4, 4)), ("THCCS", 3)), last=(8.5e-9, 1.8e-6))


def test_nitsche_on_a_part_of_the_boundary() -> None:
    """A strong condition on the left, Nitsche's on the right, a flux above and none below: a quadratic function."""
    msh = box((3, 2))
    V = randomly_refined(fem.functionspace(msh, ("THCCS", 3)), times=2)
    u, v, x = ufl.TrialFunction(V), ufl.TestFunction(V), ufl.SpatialCoordinate(msh)
    exact = x[0] + 2 * x[1] ** 2
    kappa, zero = 3.0, fem.Constant(msh, 0.0)
    F = poisson.a(u, v, kappa) - poisson.L(-4 * kappa + zero, v, g=4 * kappa + zero, ds=ufl.ds(4))
    F += poisson.nitsche(u, v, exact, fem.cell_sizes(V), kappa, ds=ufl.ds(2))
    bc = fem.dirichletbc(exact, fem.boundary_dofs(V, tag=1), V)
    uh = LinearProblem(*ufl.system(F), bcs=[bc]).solve()
    assert max(errors(uh, exact)) < 10 * ROUNDING


def test_nitsche_on_a_surface_tends_to_the_strong_solution() -> None:
    """By fourth order in L2, third in H1, as both tend to the exact one; their difference a little faster."""
    V = fem.functionspace(lifted(generators.disc(2)), ("THCCS", 3))
    found = []
    for level in range(4):
        V = uniformly_refined(V) if level else V
        u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
        value = ufl.SpatialCoordinate(V.mesh)[2] ** 2
        a, L = laplace_beltrami.a(u, v), laplace_beltrami.L(fem.Constant(V.mesh, 1.0), v)
        strong = LinearProblem(a, L, bcs=[fem.dirichletbc(value, fem.boundary_dofs(V), V)]).solve()
        F = a - L + laplace_beltrami.nitsche(u, v, value, fem.cell_sizes(V))
        found.append(errors(LinearProblem(*ufl.system(F)).solve(), strong))
    rates = -np.polyfit(np.arange(3), np.log2(found[-3:]), 1)[0]
    assert (np.abs(rates - FULL - 0.2) < 2 * TOLERANCE).all()
    assert (np.array(found[-1]) < 1.1 * np.array((6.7e-9, 8.5e-7))).all()


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(
    ("msh", "first"),
    # pi^2 (1 + 1), and the square of the first zero of the Bessel function J_0.
    [(generators.rectangle((4, 4)), 2 * np.pi**2), (generators.disc(2), 2.404825557695773**2)],
    ids=["square", "disc"],
)
def test_nitsche_is_positive_with_the_default_penalty(msh: ControlMesh, first: float, seed: int) -> None:
    """The first eigenvalue is that of the strong condition; with too small a penalty it is large and negative."""
    V = randomly_refined(fem.functionspace(moved_inside(msh, 0.15, seed), ("THCCS", 3)), times=2, seed=seed)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    weak = poisson.a(u, v) + poisson.nitsche(u, v, 0, fem.cell_sizes(V))
    matrix, mass = (fem.assemble_matrix(fem.form(a)).toarray() for a in (weak, u * v * ufl.dx))
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-12 * np.abs(matrix).max())
    assert scipy.linalg.eigvalsh(matrix, mass)[0] == pytest.approx(first, rel=2e-3)  # the rim is no exact circle


# ---- Helmholtz


def plane_wave(x: Expr) -> Expr:
    return cos(12 * (0.8 * x[0] + 0.6 * x[1]))


def wave(V: fem.FunctionSpace) -> fem.Function:
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    bc = fem.dirichletbc(plane_wave(ufl.SpatialCoordinate(V.mesh)), fem.boundary_dofs(V), V)
    return LinearProblem(helmholtz.a(u, v, k=12), helmholtz.L(fem.Constant(V.mesh, 0.0), v), bcs=[bc]).solve()


def test_plane_waves_converge() -> None:
    check_rates(wave, plane_wave, fem.functionspace(generators.rectangle((8, 8)), ("THCCS", 3)), last=(3.5e-7, 1.4e-4))


def test_source_of_waves() -> None:
    """-div(grad(u)) - 4 u = 2.25 u for the wavy function: the source has another sign than k^2 u."""

    def solve(V: fem.FunctionSpace) -> fem.Function:
        u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
        exact = wavy(ufl.SpatialCoordinate(V.mesh))
        bc = fem.dirichletbc(exact, fem.boundary_dofs(V), V)
        return LinearProblem(helmholtz.a(u, v, k=2), helmholtz.L(2.25 * exact, v), bcs=[bc]).solve()

    check_rates(solve, wavy, fem.functionspace(generators.rectangle((4, 4)), ("THCCS", 3)), last=(8.5e-9, 1.8e-6))


def test_waves_converge_between_walls_that_give_way() -> None:
    """An impedance all around, two of the walls with another one."""

    def solve(V: fem.FunctionSpace) -> fem.Function:
        u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
        exact, n = plane_wave(ufl.SpatialCoordinate(V.mesh)), ufl.FacetNormal(V.mesh)
        a = helmholtz.a(u, v, k=12, z=3) + 2 * u * v * ufl.ds(1)
        L = helmholtz.L(fem.Constant(V.mesh, 0.0), v, g=dot(grad(exact), n) + 3 * exact) + 2 * exact * v * ufl.ds(1)
        return LinearProblem(a, L).solve()

    check_rates(solve, plane_wave, fem.functionspace(box((8, 8)), ("THCCS", 3)), last=(3.5e-7, 1.4e-4))


# ---- Elasticity


def linear(x: Expr) -> Expr:
    return as_vector([0.1 + 0.3 * x[0] - 0.2 * x[1], 0.4 * x[0] + 0.5 * x[1]])


def curved(x: Expr) -> Expr:
    return as_vector([sin(2 * x[0] + x[1]), cos(x[0] - 1.5 * x[1])])


def force(x: Expr, lmbda: float, mu: float) -> Expr:
    """Return -div(sigma) of the curved displacement, by hand."""
    s, c = sin(2 * x[0] + x[1]), cos(x[0] - 1.5 * x[1])
    laplacians = as_vector([-5 * s, -3.25 * c])
    # div(u) = 2 cos(2 x0 + x1) + 1.5 sin(x0 - 1.5 x1)
    gradient = as_vector([-4 * s + 1.5 * c, -2 * s - 2.25 * c])
    return -mu * laplacians - (lmbda + mu) * gradient


def displacement(V: fem.FunctionSpace, exact: Expr, f: Expr, lmbda: float, mu: float) -> fem.Function:
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    bc = fem.dirichletbc(exact, fem.boundary_dofs(V), V)
    problem = LinearProblem(linear_elasticity.a(u, v, lmbda, mu), linear_elasticity.L(f, v), bcs=[bc])
    return problem.solve()


@pytest.mark.parametrize("valence", [3, 5, 8])
def test_constant_strain_passes_the_patch_test(valence: int) -> None:
    msh = moved_inside(generators.wheel(valence, 3), 0.2)
    V = randomly_refined(fem.functionspace(msh, ("THCCS", 3, (2,))), times=2)
    exact = linear(ufl.SpatialCoordinate(msh))
    uh = displacement(V, exact, fem.Constant(msh, (0.0, 0.0)), 2.0, 1.0)
    assert max(errors(uh, exact)) < 10 * ROUNDING


def test_displacements_converge() -> None:
    constants = linear_elasticity.plane_strain(E=1.0, nu=0.3)

    def solve(V: fem.FunctionSpace) -> fem.Function:
        x = ufl.SpatialCoordinate(V.mesh)
        return displacement(V, curved(x), force(x, *constants), *constants)

    V = fem.functionspace(generators.rectangle((4, 4)), ("THCCS", 3, (2,)))
    check_rates(solve, curved, V, last=(1.3e-8, 2.5e-6))


def test_tension_of_a_sheet() -> None:
    """Held on two sides across, pulled on the third: constant stress, and the sheet gets narrower by nu."""
    E, nu = 5.0, 0.25
    msh = box((4, 2), upper=(2, 1))
    V = randomly_refined(fem.functionspace(msh, ("THCCS", 3, (2,))), times=2)
    u, v, x = ufl.TrialFunction(V), ufl.TestFunction(V), ufl.SpatialCoordinate(msh)
    constants = linear_elasticity.plane_stress(E, nu)
    a = linear_elasticity.a(u, v, *constants)
    L = linear_elasticity.L(fem.Constant(msh, (0.0, 0.0)), v, t=fem.Constant(msh, (1.0, 0.0)), ds=ufl.ds(2))
    held = [fem.dirichletbc(0.0, fem.boundary_dofs(V, tag=tag), V.sub(tag // 2)) for tag in (1, 3)]
    uh = LinearProblem(a, L, bcs=held).solve()
    assert max(errors(uh, as_vector([x[0] / E, -nu * x[1] / E]))) < ROUNDING


def test_cantilever() -> None:
    """Timoshenko and Goodier, Theory of elasticity (3rd ed., 1970), art. 21: cubic, so that it is in the space."""
    E, nu, length, depth, P = 10.0, 0.3, 4.0, 1.0, 0.05
    inertia = depth**3 / 12
    msh = box((4, 2), lower=(0, -depth / 2), upper=(length, depth / 2))
    V = fem.functionspace(msh, ("THCCS", 3, (2,)))
    u, v, (x, y) = ufl.TrialFunction(V), ufl.TestFunction(V), ufl.SpatialCoordinate(msh)
    deflection = 3 * nu * y**2 * (length - x) + (4 + 5 * nu) * depth**2 * x / 4 + (3 * length - x) * x**2
    along = y * ((6 * length - 3 * x) * x + (2 + nu) * (y**2 - depth**2 / 4))
    exact = P / (6 * E * inertia) * as_vector([along, -deflection])
    shear = as_vector([0, -P / (2 * inertia) * (depth**2 / 4 - y**2)])
    a = linear_elasticity.a(u, v, *linear_elasticity.plane_stress(E, nu))
    L = linear_elasticity.L(fem.Constant(msh, (0.0, 0.0)), v, t=shear, ds=ufl.ds(2))
    uh = LinearProblem(a, L, bcs=[fem.dirichletbc(exact, fem.boundary_dofs(V, tag=1), V)]).solve()
    assert max(errors(uh, exact)) < 10 * ROUNDING


def test_force_is_what_the_strong_residual_wants() -> None:
    msh = generators.rectangle((2, 2))
    x = ufl.SpatialCoordinate(msh)
    residual = linear_elasticity.strong_residual(curved(x), force(x, 2.0, 1.0), 2.0, 1.0)
    assert fem.assemble_scalar(fem.form(dot(residual, residual) * ufl.dx)) < ROUNDING**2


# ---- Minimal surfaces


def scherk(x: Expr) -> Expr:
    """Return Scherk's surface of 1834, which goes to infinity at x, y = pi / 2."""
    return ufl.ln(cos(x[0]) / cos(x[1]))


def cap(x: Expr) -> Expr:
    """Return a sphere of radius 2: mean curvature 1/2 everywhere."""
    return ufl.sqrt(4 - x[0] ** 2 - x[1] ** 2)


@pytest.mark.parametrize(
    ("exact", "f", "last"),
    [(scherk, 0.0, (1.35e-8, 3.1e-6)), (cap, 1.0, (1.3e-9, 2.9e-7))],
    ids=["Scherk", "sphere"],
)
def test_films_converge(exact: Callable[[Expr], Expr], f: float, last: tuple[float, float]) -> None:
    def solve(V: fem.FunctionSpace) -> fem.Function:
        v, x = ufl.TestFunction(V), ufl.SpatialCoordinate(V.mesh)
        bc = fem.dirichletbc(exact(x), fem.boundary_dofs(V), V)
        uh = fem.Function(V)
        NonlinearProblem(minimal_surface.F(uh, v, f), uh, bcs=[bc]).solve()
        return uh

    V = fem.functionspace(generators.rectangle((4, 4), (-0.9, -0.9), (0.9, 0.9)), ("THCCS", 3))
    check_rates(solve, exact, V, last, levels=5)


def test_strong_residual_of_films_vanishes() -> None:
    msh = generators.rectangle((2, 2), (-0.5, -0.5), (0.5, 0.5))
    x = ufl.SpatialCoordinate(msh)
    for exact, f in ((scherk(x), 0.0), (cap(x), 1.0)):
        residual = minimal_surface.strong_residual(exact, f)
        assert fem.assemble_scalar(fem.form(residual**2 * ufl.dx)) < ROUNDING**2


def test_film_has_less_area_than_its_neighbours() -> None:
    V = fem.functionspace(generators.rectangle((4, 4), (-0.9, -0.9), (0.9, 0.9)), ("THCCS", 3))
    v, x = ufl.TestFunction(V), ufl.SpatialCoordinate(V.mesh)
    dofs = fem.boundary_dofs(V)
    uh = fem.Function(V)
    NonlinearProblem(minimal_surface.F(uh, v), uh, bcs=[fem.dirichletbc(scherk(x), dofs, V)]).solve()
    area = fem.form(minimal_surface.area(uh))
    least, film = fem.assemble_scalar(area), uh.x.array.copy()
    for seed in range(3):
        change = np.random.default_rng(seed).uniform(-0.05, 0.05, V.num_dofs)
        change[dofs] = 0.0
        uh.x.array = film + change
        assert fem.assemble_scalar(area) > least


# ---- Modes


def test_tones_of_a_square_drum() -> None:
    """pi^2 (m^2 + n^2), right to sixth order: the square of the order in H1; and a mode has a mass of 1."""
    exact = np.pi**2 * np.array([2.0, 5.0, 5.0, 8.0])
    V = fem.functionspace(generators.rectangle((4, 4)), ("THCCS", 3))
    found = []
    for level in range(3):
        V = uniformly_refined(V) if level else V
        u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
        held = [fem.dirichletbc(0.0, fem.boundary_dofs(V), V)]
        problem = EigenProblem(eigenmodes.a(u, v), eigenmodes.m(u, v), bcs=held, num_eigenvalues=4)
        eigenvalues, modes = problem.solve()
        found.append(eigenvalues / exact - 1)
    rates = -np.polyfit(np.arange(3), np.log2(found), 1)[0]
    np.testing.assert_allclose(rates, 6.0, atol=0.5)  # on meshes as coarse as these; finer ones come to rounding
    assert (np.array(found) > 0).all()  # from above: Rayleigh and Ritz
    assert fem.assemble_scalar(fem.form(eigenmodes.m(modes[0], modes[0]))) == pytest.approx(1.0)
    sine = 2 * sin(np.pi * ufl.SpatialCoordinate(V.mesh)[0]) * sin(np.pi * ufl.SpatialCoordinate(V.mesh)[1])
    assert errors(modes[0], sine)[0] < 1e-5


def test_tones_of_a_heavy_membrane() -> None:
    """Tension 3 and mass 2 a unit area, held at the left side alone: quarter waves across, none along."""
    V = fem.functionspace(box((8, 2)), ("THCCS", 3))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    held = [fem.dirichletbc(0.0, fem.boundary_dofs(V, tag=1), V)]
    problem = EigenProblem(eigenmodes.a(u, v, kappa=3), eigenmodes.m(u, v, rho=2), bcs=held, num_eigenvalues=1)
    (eigenvalue,), (mode,) = problem.solve()
    assert eigenvalue == pytest.approx(3 / 2 * (np.pi / 2) ** 2, rel=1e-8)
    residual = eigenmodes.strong_residual(mode, eigenvalue, kappa=3, rho=2)
    assert fem.assemble_scalar(fem.form(residual**2 * ufl.dx)) < 1e-4


def test_tones_of_a_supported_plate() -> None:
    """The squares of those of the drum of the same shape: supported edges that are straight do not feel nu."""
    V = fem.functionspace(generators.rectangle((8, 8)), ("THCCS", 3))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    held = [fem.dirichletbc(0.0, fem.boundary_dofs(V), V)]
    eigenvalues, _ = EigenProblem(plate.a(u, v), eigenmodes.m(u, v), bcs=held, num_eigenvalues=3).solve()
    exact = (np.pi**2 * np.array([2.0, 5.0, 5.0])) ** 2
    np.testing.assert_allclose(eigenvalues, exact, rtol=5e-4)  # fourth order, on 8 cells
