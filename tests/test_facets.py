"""Facets: where they are, that both sides see the same points, Green's and Stokes' formulas on every cell, and tags."""

import dataclasses
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from problems import lifted, moved_inside, randomly_refined, uniformly_refined
from refinements import CASES, STEPS, refinements
from zoo import ZOO

import ufl
from thccs_fem import element, fem, generators
from thccs_fem.extraction import Cells, evaluate_pieces
from thccs_fem.facets import Facets, boundary_facets, interior_facets
from thccs_fem.mesh import ControlMesh
from ufl import avg, cross, dot, dS, ds, dx, grad, inner, jump

Floats = npt.NDArray[np.float64]

SPACES: dict[str, Callable[[], fem.FunctionSpace]] = {
    "rectangle": lambda: fem.functionspace(moved_inside(generators.rectangle((4, 3)), 0.2), ("THCCS", 3)),
    "wheel5": lambda: fem.functionspace(generators.wheel(5, 3), ("THCCS", 3)),
    "disc, crease": lambda: fem.functionspace(generators.disc(2), ("THCCS", 3), boundary="crease"),
    "polygons": lambda: fem.functionspace(ZOO["polygons"](), ("THCCS", 3)),
    "lifted wheel3": lambda: fem.functionspace(lifted(generators.wheel(3, 2)), ("THCCS", 3)),
    "torus": lambda: fem.functionspace(ZOO["torus"](), ("THCCS", 3)),
    "cube": lambda: fem.functionspace(ZOO["cube"](), ("THCCS", 3)),
    "genus 3": lambda: fem.functionspace(generators.genus3(levels=1), ("THCCS", 3)),
}


@pytest.fixture(params=SPACES.values(), ids=SPACES, scope="module")
def V(request: pytest.FixtureRequest) -> fem.FunctionSpace:
    space = randomly_refined(request.param(), times=3)
    assert space.num_levels >= 3
    return space


def every(facets: Facets) -> npt.NDArray[np.int32]:
    return np.arange(facets.num_facets, dtype=np.int32)


def on_sides(facets: Facets, u: Floats, t: Floats) -> tuple[list[Floats], list[Floats]]:
    """Return points, shape (n, t, 3), and values of u (num_dofs, 1), shape (n, t, 1), of each side of facets."""
    points, values = ([np.zeros((facets.num_facets, t.size, k)) for _ in range(2)] for k in (3, 1))
    for part in facets.batches(every(facets)):
        n = part.facets.size
        local = part.batch.local(u).reshape(n, facets.num_sides, 16, 1)
        control = part.points.reshape(n, facets.num_sides, 16, -1)
        piece = np.repeat(np.arange(n, dtype=np.int32), t.size)
        for side in range(facets.num_sides):
            uv = np.tile(np.column_stack([t, np.full(t.size, float(side))]), (n, 1))
            x = evaluate_pieces(control[:, side], piece, uv).reshape(n, t.size, -1)
            points[side][part.facets, :, : x.shape[2]] = x
            values[side][part.facets] = evaluate_pieces(local[:, side], piece, uv).reshape(n, t.size, 1)
    return points, values


# ---- Where they are


@settings(max_examples=10)
@given(case=st.sampled_from(CASES), steps=STEPS)
def test_both_sides_of_random_refinements_see_the_same_points_and_values(
    case: tuple[str, str], steps: list[list[tuple[str, bool, int]]]
) -> None:
    hierarchy = refinements(*case, steps)[-1]
    V = fem.FunctionSpace(hierarchy)
    facets = interior_facets(V.cells)
    u = np.random.default_rng(0).standard_normal((V.num_dofs, 1))
    points, values = on_sides(facets, u, np.linspace(0.0, 1.0, 4))
    np.testing.assert_allclose(points[0], points[1], atol=1e-12)  # rounding, in meshes of diameter 10
    np.testing.assert_allclose(values[0], values[1], atol=1e-12)
    assert sides_of_cells(V.cells) == sides_of_facets(V.cells)


def sides_of_cells(cells: Cells) -> float:
    """Return four for each cell."""
    return 4.0 * cells.num_cells


def sides_of_facets(cells: Cells) -> float:
    """Return the sum of the lengths of all facets, in the coordinates of each cell there: dyadic numbers."""
    total = 0.0
    for facets in (boundary_facets(cells), interior_facets(cells)):
        along = np.abs(facets.axes[facets.squares][..., 0]).sum(axis=2)
        total += float((along * np.abs(cells.piece_axes[facets.pieces][..., 0]).sum(axis=2)).sum())
    return total


def test_no_facet_is_there_twice_and_none_lies_inside_a_cell(V: fem.FunctionSpace) -> None:
    facets = interior_facets(V.cells)
    assert (facets.facet_cells[:, 0] != facets.facet_cells[:, 1]).all()
    sides = np.concatenate([facets.pieces, facets.squares], axis=1)
    assert len(np.unique(sides, axis=0)) == facets.num_facets


def test_plus_is_on_one_side_of_an_edge_of_the_control_mesh(V: fem.FunctionSpace) -> None:
    facets = interior_facets(V.cells)
    on_edges = facets.edge >= 0
    faces = V.cells.face[facets.facet_cells[on_edges]]
    # Both faces of the edge, the one with the smaller number first.
    np.testing.assert_array_equal(faces, V.mesh.edge_faces[facets.edge[on_edges]])
    same = V.cells.face[facets.facet_cells[~on_edges]]
    np.testing.assert_array_equal(same[:, 0], same[:, 1])


def test_operators_of_some_facets_are_those_of_all(V: fem.FunctionSpace) -> None:
    facets = interior_facets(V.cells)
    u = np.random.default_rng(0).standard_normal((V.num_dofs, 1))
    local = np.zeros((facets.num_facets, 32, 1))
    for part in facets.batches(every(facets)):
        local[part.facets] = part.batch.local(u)
    chosen = every(facets)[::-7]
    for part in facets.batches(chosen):
        np.testing.assert_array_equal(part.batch.local(u), local[part.facets])
        chosen = np.setdiff1d(chosen, part.facets)
    assert chosen.size == 0


def test_restrictions_are_the_same_polynomial_in_other_coordinates() -> None:
    rng = np.random.default_rng(0)
    coefficients = rng.standard_normal((1, 16, 1))
    uv = rng.random((20, 2))
    turns = np.array([[[1, 0], [0, 1]], [[0, -1], [1, 0]], [[-1, 0], [0, -1]], [[0, 1], [-1, 0]]], dtype=float)
    axes, origins = 0.375 * turns, rng.random((4, 2))
    piece = np.zeros(20, dtype=np.int32)
    for matrix, origin, axis in zip(element.restrictions(origins, axes), origins, axes, strict=True):
        expected = evaluate_pieces(coefficients, piece, origin + uv @ axis.T)
        np.testing.assert_allclose(evaluate_pieces(matrix @ coefficients, piece, uv), expected, atol=1e-13)


# ---- Formulas of Green and Stokes on every cell


def indicator(V: fem.FunctionSpace) -> fem.Function:
    """Return random values on the cells: a formula with this factor is one for each cell."""
    q = fem.Function(fem.cellwise(V), name="q")
    q.x.array = np.random.default_rng(3).standard_normal(V.num_cells)
    return q


def test_formula_of_green_or_stokes_on_every_cell(V: fem.FunctionSpace) -> None:
    """The sum of q(K) (int_K div F - int_dK F.n), or of curl F.N and F.t; polynomials of degree 5, so to rounding."""
    q, n, x = indicator(V), ufl.FacetNormal(V.mesh), ufl.SpatialCoordinate(V.mesh)
    matrix = np.array([[2.0, 0.5, -1.0], [-0.25, 1.0, 0.75], [1.5, 0.5, -0.5]])[: V.mesh.gdim, : V.mesh.gdim]
    field = dot(fem.Constant(V.mesh, matrix), x)
    if V.mesh.gdim == 2:
        inside = fem.form(q * fem.Constant(V.mesh, np.trace(matrix)) * dx)
        flux = dot(field, n)
    else:
        skew = matrix - matrix.T
        curl = fem.Constant(V.mesh, [skew[2, 1], skew[0, 2], skew[1, 0]])
        normal = ufl.CellNormal(V.mesh)
        inside = fem.form(q * dot(curl, normal) * dx)
        flux = dot(field, cross(normal, n))
    around = fem.form(q * flux * ds + (q("+") * flux("+") + q("-") * flux("-")) * dS)
    one = fem.Constant(V.mesh, 1.0)
    size = np.abs(V.mesh.vertices).max() * fem.assemble_scalar(fem.form(one * ds + 2.0 * one * dS, on=V))
    assert abs(fem.assemble_scalar(inside) - fem.assemble_scalar(around)) < 1e-14 * size


def test_greens_formula_for_functions_of_the_space() -> None:
    """As matrices, int v div(grad(u)) + grad(u).grad(v) is the integral of v grad(u).n over the boundary alone."""
    V = randomly_refined(fem.functionspace(generators.rectangle((4, 3)), ("THCCS", 3)), times=3)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    left = fem.assemble_matrix(fem.form((ufl.div(grad(u)) * v + inner(grad(u), grad(v))) * dx))
    right = fem.assemble_matrix(fem.form(dot(grad(u), ufl.FacetNormal(V.mesh)) * v * ds))
    scale = abs(right.toarray()).max()
    np.testing.assert_allclose(left.toarray(), right.toarray(), atol=1e-12 * scale)  # degree 6: rounding
    assert (left.indices.size, left.indptr.size) == (right.indices.size, right.indptr.size)


# ---- Lengths and jumps


def test_length_of_the_boundary() -> None:
    disc = uniformly_refined(fem.functionspace(generators.disc(3), ("THCCS", 3)))
    one = ufl.as_ufl(1.0)
    length = fem.assemble_scalar(fem.form(one * ds(domain=disc.mesh)))
    assert length == pytest.approx(2 * np.pi, rel=2e-4)  # that of the limit curve, no circle
    square = randomly_refined(fem.functionspace(generators.rectangle((3, 2)), ("THCCS", 3)))
    assert fem.assemble_scalar(fem.form(one * ds(domain=square.mesh), on=square)) == pytest.approx(4.0, rel=1e-13)


def test_a_closed_surface_has_no_boundary() -> None:
    V = fem.functionspace(generators.torus((4, 5)), ("THCCS", 3))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    assert fem.assemble_scalar(fem.form(1.0 * ds(domain=V.mesh))) == 0.0
    assert not fem.assemble_vector(fem.form(v * ds)).any()
    A, B = fem.assemble_matrix(fem.form(u * v * dx + u * v * ds)), fem.assemble_matrix(fem.form(u * v * dx))
    assert (A != B).nnz == 0


@pytest.mark.parametrize("name", ["torus", "rectangle"])
def test_smooth_functions_have_no_jumps_where_there_is_no_cap(name: str) -> None:
    V = randomly_refined(SPACES[name](), times=3)
    w = fem.Function(V)
    w.x.array = np.random.default_rng(0).standard_normal(V.num_dofs)
    n = ufl.FacetNormal(V.mesh)
    kink = lambda f: fem.assemble_scalar(fem.form(jump(grad(f), n) ** 2 * dS, on=V))  # noqa: E731  # used twice
    size = fem.assemble_scalar(fem.form(avg(inner(grad(w), grad(w))) * dS))
    assert kink(w) < 1e-24 * size  # the square of rounding
    q = indicator(V)
    assert fem.assemble_scalar(fem.form(jump(q) ** 2 * dS)) > 1.0


def test_jump_of_an_indicator_is_the_length_of_the_interface() -> None:
    msh = generators.rectangle((4, 4))
    V = randomly_refined(fem.functionspace(msh, ("THCCS", 3)), times=3)
    chi = fem.Function(fem.functionspace(msh, ("DG", 0)))
    centres = msh.vertices[msh.quads].mean(axis=1)
    chi.x.array = centres[:, 0] > 0.5
    jumps = fem.assemble_cells(fem.form(jump(chi) ** 2 * dS, on=V))
    assert jumps.sum() == pytest.approx(1.0, rel=1e-13)
    # Half of it on each side.
    left = chi.x.array[V.cells.face] == 0.0
    assert jumps[left].sum() == pytest.approx(0.5, rel=1e-13)


# ---- Tags


def tagged(msh: ControlMesh, tag_of: Callable[[Floats], int]) -> ControlMesh:
    """Return the mesh with tags of edges that are a function of their midpoints; 0 is none."""
    midpoints = msh.vertices[msh.edges].mean(axis=1)
    tags = {tuple(map(int, edge)): tag_of(x) for edge, x in zip(msh.edges, midpoints, strict=True)}
    faces = [msh.face_vertices[a:b] for a, b in zip(msh.face_offsets, msh.face_offsets[1:], strict=False)]
    return ControlMesh(msh.vertices, faces, edge_tags={e: t for e, t in tags.items() if t}, corners=msh.corners)


def side_or_middle(x: Floats) -> int:
    return 7 if x[0] == 0.5 else 2 if x[1] == 0.0 else 3 if x[0] == 1.0 else 0


def on_three_faces(triangles: bool) -> ControlMesh:
    """Return the unit square cut in the middle, as two quads, or one quad and two triangles."""
    points = [(0, 0), (0.5, 0), (1, 0), (1, 1), (0.5, 1), (0, 1)]
    right = [[1, 2, 3], [1, 3, 4]] if triangles else [[1, 2, 3, 4]]
    corners = dict.fromkeys([0, 2, 3, 5], 10.0)
    return tagged(ControlMesh(points, [[0, 1, 4, 5], *right], corners=corners), side_or_middle)


MESHES = {
    "rectangle": lambda: tagged(generators.rectangle((4, 4)), side_or_middle),
    "quads": lambda: on_three_faces(triangles=False),
    "polygons": lambda: on_three_faces(triangles=True),
}


@pytest.mark.parametrize("times", [0, 3])
@pytest.mark.parametrize("name", MESHES)
def test_tags_of_edges_are_inherited(name: str, times: int) -> None:
    V = randomly_refined(fem.functionspace(MESHES[name](), ("THCCS", 3)), times)
    x, n, one = ufl.SpatialCoordinate(V.mesh), ufl.FacetNormal(V.mesh), fem.Constant(V.mesh, 1.0)

    def total(form: ufl.Form) -> float:
        return fem.assemble_scalar(fem.form(form, on=V))

    assert total(one * ds(2)) == pytest.approx(1.0, rel=1e-12)
    assert total(x[0] * ds(2)) == pytest.approx(0.5, rel=1e-12)
    assert total(x[0] * ds((2, 3))) == pytest.approx(1.5, rel=1e-12)
    assert total(dot(ufl.as_vector([1.0, 2.0]), n) * ds(3)) == pytest.approx(1.0, rel=1e-12)
    if name == "rectangle":  # the limit of the edge between a quad and triangles is no straight line
        assert total(x[1] * dS(7)) == pytest.approx(0.5, rel=1e-12)
        assert total(n("+")[0] * dS(7)) == pytest.approx(1.0, rel=1e-12)  # '+' has the face of smaller number
    assert set(interior_facets(V.cells).tag) - {-1} == {7}
    assert set(boundary_facets(V.cells).tag) == {-1, 2, 3}


def test_unknown_tags_are_named() -> None:
    msh = MESHES["rectangle"]()
    v = ufl.TestFunction(fem.functionspace(msh, ("THCCS", 3)))
    with pytest.raises(ValueError, match=r"the form has ds\(7\), but tags .* of edges on its boundary are \[2, 3\]"):
        fem.form(v * ds(7))
    with pytest.raises(ValueError, match=r"the form has dS\(2\), but tags are from 0, and .* inside it are \[7\]"):
        fem.form(avg(v) * dS((7, 2)))
    with pytest.raises(ValueError, match=r"the form has ds\(-1\), but tags are from 0"):
        fem.form(v * ds(-1))


# ---- Batches


def test_chunks_make_no_difference(monkeypatch: pytest.MonkeyPatch) -> None:
    V = randomly_refined(SPACES["wheel5"](), times=2)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    form = fem.form(jump(grad(u), ufl.FacetNormal(V.mesh)) * avg(v) * dS + u * v * ds)
    expected = fem.assemble_matrix(form).toarray()
    monkeypatch.setattr("thccs_fem.facets.CHUNK", 5)
    np.testing.assert_allclose(fem.assemble_matrix(form).toarray(), expected, atol=1e-14 * abs(expected).max())


def test_facets_are_made_once_and_go_with_the_cells() -> None:
    V = SPACES["torus"]()
    assert interior_facets(V.cells) is interior_facets(V.cells)
    assert interior_facets(dataclasses.replace(V.cells)) is not interior_facets(V.cells)
