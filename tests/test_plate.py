"""Plates: against closed forms, polynomials, identities, and the C0 interior penalty method of DOLFINx."""

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from problems import lifted, moved_inside, uniformly_refined

import ufl
from thccs_fem import fem, generators, limit
from thccs_fem.fem.scipy import LinearProblem
from thccs_fem.forms import biharmonic, plate
from thccs_fem.mesh import ControlMesh
from ufl import div, dot, dx, grad, inner, jump

Floats = npt.NDArray[np.float64]
Expr = ufl.core.expr.Expr

DEEP = 8  # cap level


def space(msh: ControlMesh, times: int = 0) -> fem.FunctionSpace:
    return uniformly_refined(fem.functionspace(msh, ("THCCS", 3), cap_level=DEEP), times)


def unit_square(n: int = 4) -> ControlMesh:
    return generators.rectangle((n, n), lower=(0.0, 0.0), upper=(1.0, 1.0))


def loaded(V: fem.FunctionSpace, *, slope: bool, nu: float = 0.3, D: float = 1.0) -> fem.Function:
    """Return the deflection of a plate under the load 1; clamped, or else simply supported."""
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    bc = fem.dirichletbc(0.0, fem.boundary_dofs(V, slope=slope), V)
    return LinearProblem(plate.a(u, v, D, nu), plate.L(fem.Constant(V.mesh, 1.0), v), bcs=[bc]).solve()


def value_at(u: fem.Function, point: tuple[float, float]) -> float:
    """Return the value at a point that is a corner of faces."""
    msh = u.function_space.mesh
    faces = np.repeat(np.arange(msh.num_faces), 4)
    uv = np.tile([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]], (msh.num_faces, 1))
    nearest = np.linalg.norm(limit.evaluate(msh, faces, uv)[0] - point, axis=1).argmin()
    np.testing.assert_allclose(limit.evaluate(msh, faces[[nearest]], uv[[nearest]])[0], [point], atol=1e-12)
    return float(u.eval(faces[[nearest]], uv[[nearest]])[0])


# ---- Closed forms: Timoshenko and Woinowsky-Krieger


def test_clamped_circular_plate() -> None:
    # (1 - r^2)^2 / 64, whatever nu is. The rim is inside the circle by 3.4e-5 on average, to the fourth power.
    for nu in (0.0, 0.45):
        V = space(generators.disc(4), 1)
        u = loaded(V, slope=True, nu=nu, D=2.0)
        assert value_at(u, (0.0, 0.0)) == pytest.approx(1 / 128, rel=3e-4)
        x = ufl.SpatialCoordinate(V.mesh)
        error = fem.form((u - (1 - x[0] ** 2 - x[1] ** 2) ** 2 / 128) ** 2 * dx, quadrature_degree=11)
        assert np.sqrt(fem.assemble_scalar(error)) < 4e-4 / 128


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.45])
def test_supported_circular_plate(nu: float) -> None:
    # (1 - r^2) ((5 + nu) / (1 + nu) - r^2) / 64
    u = loaded(space(generators.disc(4), 1), slope=False, nu=nu)
    assert value_at(u, (0.0, 0.0)) == pytest.approx((5 + nu) / (1 + nu) / 64, rel=3e-4)


def test_clamped_square_plate() -> None:
    # 0.00126532: Taylor and Govindjee, Solution of clamped rectangular plate problems (2004)
    u = loaded(space(unit_square(), 2), slope=True)
    assert value_at(u, (0.5, 0.5)) == pytest.approx(0.001265319, rel=1e-5)


def test_supported_square_plate() -> None:
    m, n = np.meshgrid(np.arange(1, 200, 2), np.arange(1, 200, 2))
    sign = (-1.0) ** ((m + n) // 2 - 1)
    navier = 16 / np.pi**6 * (sign / (m * n * (m**2 + n**2) ** 2)).sum()
    assert navier == pytest.approx(0.00406235, rel=1e-5)  # Timoshenko's table 8
    for nu in (0.0, 0.3):  # does not matter: all edges are straight
        u = loaded(space(unit_square(), 2), slope=False, nu=nu)
        assert value_at(u, (0.5, 0.5)) == pytest.approx(navier, rel=1e-5)


# ---- Polynomials


def test_linear_deflections_bend_nothing() -> None:
    # Around extraordinary vertices and with moved vertices: the patch test of fourth order.
    for msh in (generators.wheel(5, 2), moved_inside(generators.wheel(3, 3), 0.15), generators.disc(2)):
        V = space(msh)
        x = ufl.SpatialCoordinate(msh)
        u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
        exact = 1 + 2 * x[0] - 3 * x[1]
        bc = fem.dirichletbc(exact, fem.boundary_dofs(V, slope=True), V, slope=True)
        uh = LinearProblem(plate.a(u, v), plate.L(fem.Constant(msh, 0.0), v), bcs=[bc]).solve()
        assert np.sqrt(fem.assemble_scalar(fem.form((uh - exact) ** 2 * dx))) < 1e-8  # as the conditions' fit


def test_bicubic_deflections_are_found() -> None:
    V = space(unit_square(3))
    x = ufl.SpatialCoordinate(V.mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    exact, f = x[0] ** 3 * x[1] ** 3 - x[0] ** 2, 72 * x[0] * x[1]
    bc = fem.dirichletbc(exact, fem.boundary_dofs(V, slope=True), V, slope=True)
    h = fem.cell_sizes(V)
    weak = ufl.system(plate.a(u, v) - plate.L(f, v) + plate.clamped(u, v, exact, h))
    for uh in (
        LinearProblem(plate.a(u, v), plate.L(f, v), bcs=[bc]).solve(),
        LinearProblem(biharmonic.a(u, v), biharmonic.L(f, v), bcs=[bc]).solve(),
        LinearProblem(*weak).solve(),
    ):
        assert np.sqrt(fem.assemble_scalar(fem.form((uh - exact) ** 2 * dx))) < 1e-9
        assert np.abs(fem.Expression(plate.strong_residual(uh, f), [[0.3, 0.6]]).eval(V, np.arange(9))).max() < 1e-4


def test_supports_hold_corners_down() -> None:
    # xy has moments m_xy alone: no load, no m_nn at the edges of the square, but forces in its corners.
    V = space(unit_square(3))
    x = ufl.SpatialCoordinate(V.mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    exact = x[0] * x[1]
    a, L = ufl.system(plate.a(u, v) + plate.supported(u, v, exact, fem.cell_sizes(V)))
    bc = fem.dirichletbc(exact, fem.boundary_dofs(V), V)
    for uh in (
        LinearProblem(a, L).solve(),
        LinearProblem(plate.a(u, v), plate.L(fem.Constant(V.mesh, 0.0), v), bcs=[bc]).solve(),
    ):
        assert np.sqrt(fem.assemble_scalar(fem.form((uh - exact) ** 2 * dx))) < 1e-9


# ---- Identities


def test_free_plates_move_rigidly() -> None:
    V = space(generators.wheel(5, 2))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    K, M = (fem.assemble_matrix(fem.form(a)).toarray() for a in (plate.a(u, v, nu=0.3), u * v * dx))
    scale = np.sqrt(np.diag(M))
    eigenvalues = np.linalg.eigvalsh((K + K.T) / 2 / np.outer(scale, scale))
    np.testing.assert_allclose(eigenvalues[:3] / eigenvalues[-1], 0.0, atol=1e-10)
    assert eigenvalues[3] / eigenvalues[-1] > 1e-6


def test_poissons_ratio_does_not_matter_inside() -> None:
    # Of functions with neither value nor slope on the boundary, |H(u)|^2 and (tr H(u))^2 have the same integral.
    V = space(unit_square())
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    inside = np.setdiff1d(np.arange(V.num_functions), fem.boundary_dofs(V, slope=True))
    forms = [plate.a(u, v, nu=0.0), plate.a(u, v, nu=0.4), biharmonic.a(u, v)]
    first, *others = [fem.assemble_matrix(fem.form(a)).toarray()[np.ix_(inside, inside)] for a in forms]
    for other in others:
        np.testing.assert_allclose(other, first, atol=1e-12 * np.abs(first).max())


def test_tangential_hessian() -> None:
    # On the graph of a quadratic z, which the space contains, Hess(x_i) = n_i (second fundamental form).
    plain = generators.rectangle((7, 7))
    A = np.array([[1.0, 0.2], [0.2, 0.6]])
    z = np.einsum("ni,ij,nj->n", plain.vertices, A, plain.vertices) / 2
    msh = ControlMesh(np.column_stack([plain.vertices, z]), plain.quads)
    V = space(msh)
    u = fem.project(ufl.SpatialCoordinate(msh)[0], V)
    faces = np.array([24, 17, 23])  # inside, where a quadratic in the control points is one on the surface
    pieces, uv = V.cells.locate(faces, np.full((3, 2), 0.3))
    points = uv[:1]
    H = fem.Expression(plate.hessian(u), points).eval(V, pieces).reshape(3, 3, 3)
    X = fem.Expression(ufl.SpatialCoordinate(msh), points).eval(V, pieces)[:, 0]
    for k in range(3):
        slope = A @ X[k, :2]
        size = np.sqrt(1.0 + slope @ slope)
        tangents = np.array([[1.0, 0.0], [0.0, 1.0], slope])
        inverse = np.linalg.inv(tangents.T @ tangents) @ tangents.T
        np.testing.assert_allclose(H[k], -slope[0] / size * inverse.T @ (A / size) @ inverse, atol=1e-8)
    laplacian = fem.Expression(div(grad(u)), points).eval(V, pieces)[:, 0, 0]
    np.testing.assert_allclose(laplacian, np.trace(H, axis1=1, axis2=2), atol=1e-12)


# ---- Nitsche's method


@pytest.mark.parametrize("edge", [plate.clamped, plate.supported])
def test_weak_conditions_are_symmetric_and_positive(edge: Callable[..., ufl.Form]) -> None:
    for msh in (moved_inside(generators.wheel(5, 2), 0.1), generators.disc(2)):
        V = space(msh)
        u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
        a, _ = ufl.system(plate.a(u, v) + edge(u, v, 0.0, fem.cell_sizes(V)) - v * dx)
        K = fem.assemble_matrix(fem.form(a)).toarray()
        np.testing.assert_allclose(K, K.T, atol=1e-9 * np.abs(K).max())  # rounding in the caps
        assert np.linalg.eigvalsh((K + K.T) / 2)[0] > 0


@pytest.mark.parametrize("nu", [0.0, 0.3])
def test_moments_obey_greens_formula_on_a_curved_patch(nu: float) -> None:
    msh = ControlMesh([[0.0, 0.0, 0.0], [1.0, 0.0, 0.3], [1.0, 1.0, 0.7], [0.0, 1.0, 0.1]], [[0, 1, 2, 3]])
    V = space(msh)
    u, v, n = fem.Function(V), fem.Function(V), ufl.FacetNormal(msh.ufl_domain())
    for f, seed in ((u, 0), (v, 1)):
        f.x.array = np.random.default_rng(seed).standard_normal(V.num_dofs)
    m = plate.moments(u, 1.0, nu)
    work, edge, inside = (
        fem.assemble_scalar(fem.form(w, quadrature_degree=21))
        for w in (
            inner(m, plate.hessian(v)) * dx,
            dot(dot(m, n), grad(v)) * ufl.ds,
            inner(div(m), grad(v)) * dx,
        )
    )
    assert work == pytest.approx(edge - inside, abs=1e-12 * (abs(edge) + abs(inside)))


@pytest.mark.parametrize("mesh", ["plane", "bowl"])
@pytest.mark.parametrize("slope", [True, False])
def test_weak_conditions_do_as_strong_ones(mesh: str, slope: bool) -> None:
    msh = generators.disc(2)
    V = space(msh if mesh == "plane" else lifted(msh), 2)
    strong = loaded(V, slope=slope)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    edge = plate.clamped if slope else plate.supported
    weak = LinearProblem(*ufl.system(plate.a(u, v) - v * dx + edge(u, v, 0.0, fem.cell_sizes(V)))).solve()
    difference, size = (np.sqrt(fem.assemble_scalar(fem.form(w**2 * dx))) for w in (strong - weak, strong))
    assert difference < 2e-3 * size
    assert difference > 1e-9 * size  # they are two methods


# ---- An independent path


def interior_penalty(msh: ControlMesh, degree: int = 3) -> Callable[[Floats], float]:
    """Return the deflection of a clamped plate under the load 1, by C0 elements of DOLFINx on the control mesh."""
    MPI = pytest.importorskip("mpi4py.MPI")
    dolfinx: Any = pytest.importorskip("dolfinx")
    basix_ufl = pytest.importorskip("basix.ufl")
    from dolfinx.fem.petsc import LinearProblem as Problem

    cells = msh.quads[:, [0, 1, 3, 2]].astype(np.int64)
    geometry = basix_ufl.element("Lagrange", "quadrilateral", 1, shape=(2,))
    domain = dolfinx.mesh.create_mesh(MPI.COMM_SELF, cells, geometry, msh.vertices)
    V = dolfinx.fem.functionspace(domain, ("Lagrange", degree))
    u, v, n = ufl.TrialFunction(V), ufl.TestFunction(V), ufl.FacetNormal(domain)
    h = ufl.sqrt(abs(ufl.JacobianDeterminant(domain)))

    def moment(w: Expr) -> Expr:
        return dot(dot(grad(grad(w)), n), n)

    def on_edges(w: Expr, z: Expr) -> ufl.Form:
        inside = -ufl.avg(moment(w)) * jump(grad(z), n) * ufl.dS
        return inside - moment(w) * dot(grad(z), n) * ufl.ds

    a = inner(grad(grad(u)), grad(grad(v))) * dx + on_edges(u, v) + on_edges(v, u)
    a += 30 / ufl.avg(h) * jump(grad(u), n) * jump(grad(v), n) * ufl.dS
    a += 30 / h * dot(grad(u), n) * dot(grad(v), n) * ufl.ds
    domain.topology.create_connectivity(1, 2)
    rim = dolfinx.fem.locate_dofs_topological(V, 1, dolfinx.mesh.exterior_facet_indices(domain.topology))
    problem = Problem(
        a,
        v * dx,
        bcs=[dolfinx.fem.dirichletbc(0.0, rim, V)],
        petsc_options_prefix="oracle_",
        petsc_options={"ksp_type": "preonly", "pc_type": "lu"},
    )
    uh = problem.solve()
    return lambda point: float(uh.x.array[np.linalg.norm(V.tabulate_dof_coordinates() - point, axis=1).argmin()])


def test_pentagonal_plate_as_by_interior_penalties() -> None:
    at = interior_penalty(generators.wheel(5, 8))(np.zeros(3))
    u = loaded(space(generators.wheel(5, 2), 3), slope=True)
    assert value_at(u, (0.0, 0.0)) == pytest.approx(at, rel=2e-4)
