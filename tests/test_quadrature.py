"""The paper's rule against sums over Gauss points of Stam's evaluation, and what is left when caps are dropped."""

import numpy as np
import numpy.typing as npt
import pytest
import zoo
from problems import moved_inside, poisson, randomly_refined
from zoo import ZOO

import ufl
from thccs_fem import adapt, estimate, fem, generators, limit, quadrature, stam
from thccs_fem.boundary import BoundaryRule
from thccs_fem.extraction import extract
from thccs_fem.hierarchy import Hierarchy
from thccs_fem.mesh import ControlMesh
from ufl import dx, grad, inner

Floats = npt.NDArray[np.float64]

ROUNDING = 1e-12  # polynomials are continued to squares up to 3 times as wide as their sub-element
GAUSS = (np.polynomial.legendre.leggauss(4)[0] + 1) / 2
WEIGHTS = np.polynomial.legendre.leggauss(4)[1] / 2
POINTS = np.array([(u, v) for v in GAUSS for u in GAUSS])
POINT_WEIGHTS = np.array([wu * wv for wv in WEIGHTS for wu in WEIGHTS])
THCCS = ("THCCS", 3)


def paper_space(mesh: ControlMesh, rule: BoundaryRule = "crease", cap_level: int = 4) -> fem.FunctionSpace:
    V = fem.functionspace(mesh, THCCS, boundary=rule, cap_level=cap_level)
    return V.with_integration(quadrature.paper_cells)


def with_random_values(V: fem.FunctionSpace) -> fem.Function:
    u = fem.Function(V)
    u.x.array = np.random.default_rng(3).uniform(-1.0, 1.0, V.num_dofs)
    return u


def planar_wheel(valence: int, n: int = 3) -> ControlMesh:
    return moved_inside(generators.wheel(valence, n), 0.2)


def by_stam(u: fem.Function, second: bool) -> dict[int, float]:
    """Sum u^2 + |grad u|^2 (+ |Laplace u|^2 in the plane) over the Gauss points of each cell at vertex 0."""
    V, hierarchy = u.function_space, u.function_space.hierarchy
    sums = {}
    for cell, (l, face) in enumerate(zip(V.cells.level, V.cells.level_face, strict=True)):
        stage = hierarchy.stages[l]
        level = stage.level
        corner = np.flatnonzero(level.control_vertex[level.quads[face]] == 0)
        if not corner.size:
            continue
        assert corner[0] == 0  # of a face that begins at the extraordinary vertex
        vertices = stam.stencil(level, np.array([4 * face], dtype=np.int32))[0]
        coefficients = (stage.boundary.to_points @ (hierarchy.coefficients[l] @ u.x.array))[vertices]
        functions = stam.evaluate(len(vertices) // 2 - 4, POINTS, 2)
        x, w = functions @ hierarchy.points[l][vertices], functions @ coefficients
        J = x[1:3].transpose(1, 2, 0)  # [point, coordinate, parameter]
        metric = J.swapaxes(1, 2) @ J
        area = np.sqrt(np.linalg.det(metric))
        slope = np.linalg.solve(metric, w[1:3].T[..., None])[..., 0]  # parametric components of the gradient
        density = w[0] ** 2 + np.einsum("qi,qi->q", w[1:3].T, slope)
        if second:  # w_ij - Gamma^k_ij w_k, traced by the inverse metric
            hessian = (w - np.einsum("qc,rqc->rq", np.einsum("qci,qi->qc", J, slope), x))[[3, 4, 4, 5]]
            inverse = np.linalg.inv(metric).reshape(-1, 4)
            density = density + np.einsum("qi,iq->q", inverse, hessian) ** 2
        sums[cell] = float(POINT_WEIGHTS @ (density * area))
    return sums


def density(u: fem.Function, second: bool) -> ufl.core.expr.Expr:
    value = u**2 + inner(grad(u), grad(u))
    return value + ufl.div(grad(u)) ** 2 if second else value


# ---- The paper's rule


@pytest.mark.parametrize("rule", ["crease", "clamped"])
@pytest.mark.parametrize("valence", [3, 5, 8])
@pytest.mark.parametrize("cap_level", [1, 4])
def test_integrals_are_sums_over_gauss_points(valence: int, rule: BoundaryRule, cap_level: int) -> None:
    """Whatever the level of the caps, in the plane and with second derivatives."""
    u = with_random_values(paper_space(planar_wheel(valence), rule, cap_level))
    expected = by_stam(u, second=True)
    assert len(expected) == valence
    found = fem.assemble_cells(fem.form(density(u, second=True) * dx))
    for cell, value in expected.items():
        assert found[cell] == pytest.approx(value, rel=ROUNDING)


@pytest.mark.parametrize("valence", [3, 5, 8])
def test_integrals_on_a_refined_surface(valence: int) -> None:
    """Cells of levels 0 and 2 at the extraordinary vertex, with truncated functions."""
    mesh = zoo.wheel(valence, 4)
    W = paper_space(mesh, "clamped")
    for level, face in enumerate([10, 5]):  # its corner 0 is vertex (2, 2) / 2^level of the first sector
        near = np.linalg.norm(W.reference_points - limit.evaluate(mesh, [face], [(0.0, 0.0)])[0], axis=1)
        near[: W.hierarchy.dof_offsets[level]] = np.inf
        W = adapt.refine(W, [near.argmin()])
    u = with_random_values(W)
    expected = by_stam(u, second=False)
    assert np.array_equal(np.unique(W.cells.level[list(expected)]), [0, 2])
    found = fem.assemble_cells(fem.form(density(u, second=False) * dx))
    for cell, value in expected.items():
        assert found[cell] == pytest.approx(value, rel=ROUNDING)


@pytest.mark.parametrize("name", ["tripod", "wheel12", "polygons", "rim_of_four", "l_domain_tagged", "pillow", "cube"])
def test_pieces_are_points_of_the_limit_surface(name: str) -> None:
    """On any element, with several extraordinary vertices or at the rim: positions, and derivatives times weights."""
    hierarchy = Hierarchy.on(ZOO[name](), "crease")
    cells = quadrature.paper_cells(hierarchy)
    centre = cells.piece_origin + cells.piece_axes.sum(axis=2) / 2
    assert np.array_equal(np.bincount(cells.piece_cell), np.full(cells.num_cells, 16))
    order = np.lexsort((centre[:, 0].round(9), centre[:, 1].round(9), cells.piece_cell))
    np.testing.assert_allclose(centre[order], np.tile(POINTS, (cells.num_cells, 1)), rtol=0, atol=1e-14)
    area = np.linalg.det(cells.piece_axes)
    np.testing.assert_allclose(area[order], np.tile(POINT_WEIGHTS, cells.num_cells), rtol=1e-13)
    face = cells.face[cells.piece_cell]
    level_zero = cells.level_face[cells.piece_cell]
    named = level_zero - hierarchy.mesh.face_offsets[face] if hierarchy.root_is_subdivided else np.full(face.size, -1)
    x = limit.evaluate(hierarchy.mesh, face, centre, 1, named)
    spline = np.array([1 / 48, 23 / 48, 23 / 48, 1 / 48])
    slope = np.array([-1 / 8, -5 / 8, 5 / 8, 1 / 8])
    local = cells.piece_points.reshape(-1, 4, 4, hierarchy.mesh.gdim)
    tables = ((spline, spline), (slope, spline), (spline, slope))
    found = np.stack([np.einsum("i,j,pjic->pc", u, v, local) for u, v in tables])
    expected = np.stack([x[0], *np.einsum("pij,ipc->jpc", cells.piece_axes, x[1:])])
    size = np.ptp(hierarchy.mesh.vertices, axis=0).max()
    np.testing.assert_allclose(found, expected, rtol=0, atol=ROUNDING * size)
    assert cells.boundary_pieces[0].size == 0  # they are no pieces of the surface
    assert (cells.locate(face, centre, named)[0] == -1).all()


@pytest.mark.parametrize("rule", ["crease", "clamped"])
def test_on_regular_elements_it_is_the_usual_rule(rule: BoundaryRule) -> None:
    V = randomly_refined(fem.functionspace(moved_inside(generators.rectangle((5, 4)), 0.2), THCCS, boundary=rule))
    W = V.with_integration(quadrature.paper_cells)

    def forms(space: fem.FunctionSpace) -> list[fem.Form]:
        u, v = ufl.TrialFunction(space), ufl.TestFunction(space)
        x = ufl.SpatialCoordinate(space.mesh)
        return [fem.form(f * dx, quadrature_degree=7) for f in (inner(grad(u), grad(v)) + u * v, ufl.exp(x[0]) * v)]

    (A, b), (A_usual, b_usual) = ((fem.assemble_matrix(a), fem.assemble_vector(L)) for a, L in map(forms, (W, V)))
    assert abs(A - A_usual).max() < ROUNDING
    np.testing.assert_allclose(b, b_usual, rtol=0, atol=ROUNDING)


def test_vectors_matrices_and_components_agree() -> None:
    W = paper_space(ZOO["tripod"]())
    W = fem.FunctionSpace(W.hierarchy, (2,), W.integration)
    w = with_random_values(W)
    u, v = ufl.TrialFunction(W), ufl.TestFunction(W)
    A = fem.assemble_matrix(fem.form(inner(grad(u), grad(v)) * dx))
    assert abs(A - A.T).max() < ROUNDING
    b = fem.assemble_vector(fem.form(inner(grad(w), grad(v)) * dx))
    np.testing.assert_allclose(A @ w.x.array, b, rtol=0, atol=ROUNDING)
    energy = fem.assemble_scalar(fem.form(inner(grad(w), grad(w)) * dx))
    assert w.x.array @ b == pytest.approx(energy, rel=ROUNDING)


def patch_error(V: fem.FunctionSpace) -> float:
    x = ufl.SpatialCoordinate(V.mesh)
    uh = poisson(V, 1 + 2 * x[0] - 3 * x[1], fem.Constant(V.mesh, 0.0))
    return float(np.abs(uh.x.array - (1 + V.mesh.vertices @ [2, -3])).max())


@pytest.mark.parametrize("valence", [3, 5, 8, 12])
def test_the_patch_test_fails(valence: int) -> None:
    """Sec. 6.3: by 1e-4 to some 1e-3, where with caps rounding is all there is (test_patch.py)."""
    assert 1e-4 < patch_error(paper_space(planar_wheel(valence))) < 5e-3


def test_the_patch_test_holds_without_extraordinary_vertex() -> None:
    assert patch_error(paper_space(moved_inside(generators.rectangle((6, 6)), 0.2))) < ROUNDING


# ---- Caps left out


@pytest.mark.parametrize("depth", [1, 2, 5])
def test_without_caps_a_square_is_missing(depth: int) -> None:
    V = fem.functionspace(planar_wheel(5), THCCS, boundary="crease", cap_level=depth)
    cells = quadrature.without_caps(depth)(V.hierarchy)
    covered = np.bincount(cells.piece_cell, np.linalg.det(cells.piece_axes))
    irregular = (V.mesh.quads == 0).any(axis=1)
    np.testing.assert_allclose(covered[~irregular], 1.0, rtol=1e-15)
    np.testing.assert_allclose(covered[irregular], 1.0 - 4.0**-depth, rtol=1e-15)


@pytest.mark.parametrize("name", ["wheel5", "tripod", "rim_of_four"])
def test_without_caps_the_other_pieces_are_the_same(name: str) -> None:
    hierarchy = Hierarchy.on(ZOO[name](), "crease", cap_level=3).refined(np.array([0, 5]))
    whole, rest = extract(hierarchy), quadrature.without_caps(3)(hierarchy)
    caps = np.zeros(whole.num_pieces, dtype=bool)
    for stage, piece_of_face in zip(whole.hierarchy.stages, whole.piece_of_face, strict=True):
        faces = np.flatnonzero((piece_of_face >= 0) & (~stage.level.regular[stage.level.quads]).any(axis=1))
        caps[piece_of_face[faces]] = True
    assert 0 < np.count_nonzero(caps) == whole.num_pieces - rest.num_pieces
    kept = np.flatnonzero(~caps).astype(np.int32)
    assert np.array_equal(rest.piece_cell, whole.piece_cell[kept])
    assert np.array_equal(rest.piece_points, whole.piece_points[kept])
    assert np.array_equal(rest.piece_origin, whole.piece_origin[kept])
    assert np.array_equal(rest.piece_axes, whole.piece_axes[kept])
    every = np.arange(rest.num_pieces, dtype=np.int32)
    assert abs(rest.rows(every) - whole.rows(kept)).max() == 0.0
    faces, uv = np.zeros(2, dtype=int), np.array([[0.7, 0.8], [0.01, 0.01]])
    corner = np.zeros(2, dtype=int)
    found, known = (cells.locate(faces, uv, corner)[0] for cells in (rest, whole))
    assert kept[found[0]] == known[0]
    if name == "wheel5":
        assert found[1] == -1  # in the hole


def test_what_is_left_out_shrinks_by_the_square_of_the_eigenvalue() -> None:
    V = fem.functionspace(planar_wheel(5), THCCS, boundary="crease")
    constant = fem.Constant(V.mesh, 1.0)
    whole = fem.assemble_scalar(fem.form(constant * dx))
    holes = []
    for depth in (5, 6, 7):
        W = V.with_integration(quadrature.without_caps(depth))
        one = fem.Function(W)
        one.x.array[:] = 1.0
        holes.append(whole - fem.assemble_scalar(fem.form(one * dx)))
    ratios = np.array(holes[1:]) / holes[:-1]
    np.testing.assert_allclose(ratios, stam.eigenstructure(5).eigenvalues[1] ** 2, rtol=0.02)


def test_the_patch_test_without_caps_needs_many_levels() -> None:
    """Sec. 6.3: the error falls by the square of the subdominant eigenvalue a level."""
    V = fem.functionspace(planar_wheel(5), THCCS, boundary="crease")
    errors = [patch_error(V.with_integration(quadrature.without_caps(depth))) for depth in (2, 8, 12)]
    assert errors[0] > 1e-2
    rate = (errors[2] / errors[1]) ** (1 / 4)
    assert rate == pytest.approx(stam.eigenstructure(5).eigenvalues[1] ** 2, rel=0.02)


@pytest.mark.parametrize("depth", [0, -1])
def test_at_least_one_cut(depth: int) -> None:
    with pytest.raises(ValueError, match=f"depth is {depth}; an irregular element must be cut at least once"):
        quadrature.without_caps(depth)


# ---- Hierarchies with other caps


@pytest.mark.parametrize("name", ["wheel5", "tripod", "l_domain_smooth"])
@pytest.mark.parametrize("rule", ["crease", "clamped"])
def test_caps_do_not_change_the_order_of_functions(name: str, rule: BoundaryRule) -> None:
    """Nor functions outside of the caps: values of all of them on pieces that both hierarchies have."""
    V = randomly_refined(fem.functionspace(ZOO[name](), THCCS, boundary=rule, cap_level=1), times=4)
    assert V.num_levels > 2
    cells, deep = extract(V.hierarchy), extract(V.hierarchy.with_caps_at(V.num_levels + 3))
    assert deep.num_dofs == cells.num_dofs
    assert deep.num_pieces > cells.num_pieces
    assert np.array_equal(deep.level, cells.level)
    key, deep_key = (
        {
            (c, *o, *a): p
            for p, (c, o, a) in enumerate(zip(g.piece_cell, g.piece_origin, g.piece_axes[:, 0], strict=True))
        }
        for g in (cells, deep)
    )
    common = np.array([(key[k], deep_key[k]) for k in key if k in deep_key], dtype=np.int32)
    assert len(common) >= 0.5 * cells.num_pieces
    assert abs(cells.rows(common[:, 0]) - deep.rows(common[:, 1])).max() < 1e-15


def test_caps_are_not_above_the_first_level() -> None:
    with pytest.raises(ValueError, match="cap_level is 0; a cap needs at least one cut"):
        Hierarchy.on(ZOO["wheel5"]()).with_caps_at(0)


# ---- Spaces with a rule of their own


def test_spaces_with_other_rules_are_others() -> None:
    V = fem.functionspace(ZOO["wheel5"](), THCCS)
    W = V.with_integration(quadrature.paper_cells)
    assert V.with_integration(quadrature.paper_cells) == W != V
    assert V.with_integration(quadrature.without_caps(3)) == V.with_integration(quadrature.without_caps(3))
    assert V.with_integration(quadrature.without_caps(3)) != V.with_integration(quadrature.without_caps(4))
    assert W.with_integration(extract) == V
    assert W.cells is V.cells
    assert W.integration_cells is not V.integration_cells is V.cells
    assert adapt.refine(W, [0]).integration is quadrature.paper_cells
    assert adapt.refine(W, [0]).is_refinement_of(W)
    assert not adapt.refine(W, [0]).is_refinement_of(V)


def test_one_form_has_one_rule() -> None:
    V = fem.functionspace(ZOO["wheel5"](), THCCS)
    W = V.with_integration(quadrature.paper_cells)
    with pytest.raises(ValueError, match=r"none is a refinement of all the others.*\n.*\n.*\n.*copy x.array"):
        fem.form(fem.Function(V) * ufl.TestFunction(W) * dx)


def test_degrees_of_ones_own_are_refused() -> None:
    """But defaults, such as those of the estimators, give way."""
    v = ufl.TestFunction(paper_space(ZOO["wheel5"]()))
    points = fem.form(v * dx, quadrature_degree=9)
    assert points.ufl_form.integrals()[0].metadata() == {"quadrature_degree": 1}
    again = fem.form(v * dx(metadata={"quadrature_degree": 1}))
    np.testing.assert_array_equal(fem.assemble_vector(again), fem.assemble_vector(points))
    for metadata in ({"quadrature_degree": 7}, {"quadrature_rule": "vertex"}):
        with pytest.raises(ValueError, match=r"ask for a rule of their own, but the cells .* degree 1 alone"):
            fem.form(v * dx(metadata=metadata))


@pytest.mark.parametrize("rule", [quadrature.paper_cells, quadrature.without_caps(6)], ids=["paper", "without caps"])
def test_projection_and_errors(rule: object) -> None:
    """A function of the space is its own projection, given as an expression or by its values at points."""
    W = fem.functionspace(planar_wheel(5), THCCS).with_integration(rule)  # type: ignore[arg-type]
    linear = fem.project(lambda x: x[0] - 2 * x[1], W)
    assert estimate.norm(W, estimate.error(linear, lambda x: x[0] - 2 * x[1], "H1")) < 1e-10  # by CG
    again = fem.project(linear, W)
    np.testing.assert_allclose(again.x.array, linear.x.array, rtol=0, atol=1e-10)
    assert again.function_space == W


def test_other_estimators_and_marking_work_on_the_points() -> None:
    W = paper_space(planar_wheel(5))
    x = ufl.SpatialCoordinate(W.mesh)
    uh = poisson(W, ufl.sin(2 * x[0]), 4 * ufl.sin(2 * x[0]))
    residual = estimate.residual(uh, ufl.div(grad(uh)) + 4 * ufl.sin(2 * x[0]))
    assert residual.shape == (W.num_cells,)
    refined = adapt.refine(W, adapt.mark(W, residual))
    spaces = (W, refined, refined.with_integration(extract))
    solutions = [poisson(space, ufl.sin(2 * x[0]), 4 * ufl.sin(2 * x[0])) for space in spaces]
    errors = [estimate.norm(u.function_space, estimate.error(u, ufl.sin(2 * x[0]))) for u in solutions]
    assert errors[1] < 0.8 * errors[0]
    assert errors[1] == pytest.approx(errors[2], rel=0.02)  # on so coarse a mesh both rules do
