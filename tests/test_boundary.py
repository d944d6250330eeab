"""The clamped boundary: the table of its algebra, tensor-product splines as an oracle, traces, and the tied zone."""

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from refinements import (
    MESHES,
    STEPS,
    WITH_RIM,
    bernstein_mass,
    bernstein_rows,
    coarsest,
    random_positions,
    random_vector,
    refinements,
    scaled_eigenvalue,
)
from scipy.interpolate import BSpline

from thccs_fem import boundary, generators
from thccs_fem.boundary import Boundary, from_dofs, subdivision_matrix, to_dofs
from thccs_fem.extraction import evaluate_pieces, extract
from thccs_fem.hierarchy import Hierarchy
from thccs_fem.subdivision import control_level, subdivide

EXACT = 1e-13  # sums of a few products of numbers up to 54
CLAMPED = [name for name in WITH_RIM if name != "pole"]  # 64 corners and nothing else: the slow loops are for others

# The rim rows of the 16 Bernstein coefficients, i + 4 j: side k from corner k to k + 1.
SIDES = np.array([[0, 1, 2, 3], [3, 7, 11, 15], [15, 14, 13, 12], [12, 8, 4, 0]])


def uniform(name: str, levels: int = 3) -> tuple[list[Boundary], list]:
    """Whole levels of a mesh and the steps between them."""
    level = coarsest(name, "clamped").root
    bounds, steps = [Boundary.of(level, "clamped")], []
    for _ in range(levels - 1):
        steps.append(subdivide(level, np.ones(level.num_faces, dtype=bool)))
        level = steps[-1].fine
        bounds.append(Boundary.of(level, "clamped"))
    return bounds, steps


def trace_functions(bound: Boundary) -> np.ndarray:
    """Marks of the functions with a trace: q0 where it is free, else the function of the rim vertex."""
    vertices = bound.level.boundary.copy()
    vertices[bound.vertex] = False
    return np.concatenate([vertices, np.ones(bound.vertex.size, dtype=bool)])


# The table: algebra of whole levels


@pytest.mark.parametrize("name", WITH_RIM)
def test_changes_of_basis_are_inverse_to_each_other(name):
    for bound in uniform(name)[0]:
        product = (to_dofs(bound) @ from_dofs(bound)).toarray()
        np.testing.assert_allclose(product, np.eye(bound.num_functions), rtol=0, atol=EXACT)
        assert to_dofs(bound).data.min() > 0.0  # q are means


@pytest.mark.parametrize("name", WITH_RIM)
def test_subdivision_of_dofs_is_non_negative_and_traces_see_traces_alone(name):
    bounds, steps = uniform(name)
    for coarse, fine, step in zip(bounds, bounds[1:], steps, strict=False):
        matrix = (to_dofs(fine) @ subdivision_matrix(coarse, fine, step) @ from_dofs(coarse)).toarray()
        np.testing.assert_allclose(matrix.sum(axis=1), 1.0, rtol=0, atol=EXACT)
        assert matrix.min() > -1e-14
        nonzero = np.abs(matrix) > 1e-14
        assert matrix[nonzero].min() > 1e-5  # 4e-3 is the least but for 1 / (4 n^2) at a vertex of valence n
        assert not nonzero[trace_functions(fine)][:, ~trace_functions(coarse)].any()
        assert nonzero[trace_functions(fine)].any(axis=1).all()


@pytest.mark.parametrize("name", WITH_RIM)
def test_only_trace_functions_have_a_trace_and_it_is_independent(name):
    cells = extract(coarsest(name, "clamped"))
    rim = rim_rows(cells).toarray()
    marks = trace_functions(cells.hierarchy.stages[0].boundary)
    assert np.abs(rim[:, ~marks]).max(initial=0.0) < EXACT
    mass = np.kron(np.eye(len(rim) // 4), bernstein_mass())
    # 8e-2 as a rule; two corners on one edge and short rims have more, never less than 1e-2.
    assert scaled_eigenvalue(rim[:, marks].T @ mass @ rim[:, marks]) > 1e-2


def rim_rows(cells) -> sp.csr_array:
    """The trace on every rim edge of a piece: four Bernstein rows each."""
    piece, side, _ = cells.boundary_pieces
    return bernstein_rows(cells)[(16 * piece[:, None] + SIDES[side]).ravel()]


@pytest.mark.parametrize("shape", [(2, 2), (4, 3), (3, 6)])
def test_dofs_of_a_grid_are_those_of_the_tensor_product_space(shape):
    mesh = generators.rectangle(shape)
    assert Hierarchy.on(mesh, "clamped").num_dofs == (shape[0] + 3) * (shape[1] + 3)
    assert Hierarchy.on(mesh, "crease").num_dofs == (shape[0] + 1) * (shape[1] + 1)


def test_a_single_quad_and_the_ends_of_a_strip_are_tied_for_one_level():
    for name, free_on_level_0 in (("single_quad", 0), ("strip", 6)):
        bounds, _ = uniform(name)
        assert bounds[0].vertex.size == free_on_level_0
        # From level 1 on every rim vertex is free, the four corners with three functions each.
        for bound in bounds[1:]:
            assert bound.vertex.size == np.count_nonzero(bound.level.boundary) + 2 * 4


def test_rim_vertices_within_one_edge_of_an_irregular_one_are_tied_on_every_level():
    bounds, _ = uniform("l_domain_smooth")
    for bound in bounds:
        level = bound.level
        irregular = np.flatnonzero(level.boundary & ~level.regular)
        assert irregular.size == 1
        edges = np.stack([level.vertices, level.vertices[level.following]], axis=1)[level.rim]
        near = np.unique(edges[(edges == irregular).any(axis=1)])
        tied = np.setdiff1d(np.flatnonzero(level.boundary), bound.vertex)
        assert near.size == 3
        assert np.array_equal(tied, near)


def test_the_crease_rule_has_no_trace_functions():
    assert not Boundary.of(control_level(MESHES["grid"]), "crease").vertex.size


# Tensor-product splines as an oracle


N, M = 5, 4


def tensor_product_coefficients(bound: Boundary, state: np.ndarray) -> np.ndarray:
    """Coefficients (-1 .. N + 1, -1 .. M + 1) of tensor-product B-splines from (P, delta), by the definition.

    A ghost is the crease phantom 2 P_v - P_w plus delta_v; the deltas of a side go on beyond its corner likewise, plus
    dM.
    """
    vertex = np.arange((N + 1) * (M + 1)).reshape(M + 1, N + 1).T  # [i, j]
    kinds = zip(bound.vertex.tolist(), bound.kind.tolist(), strict=True)
    delta = dict(zip(kinds, state[vertex.size :], strict=True))

    def along(line: np.ndarray) -> np.ndarray:
        """The deltas of a side, its vertices counter-clockwise: leaving the first corner, entering the last."""
        start, *middle, end = line.tolist()
        inner = [delta[v, boundary.SMOOTH] for v in middle]
        return np.array([delta[start, boundary.CORNER_OUT], *inner, delta[end, boundary.CORNER_IN]])

    grid = np.zeros((N + 3, M + 3))
    grid[1:-1, 1:-1] = state[vertex]
    sides = {0: along(vertex[0, ::-1])[::-1], -1: along(vertex[-1])}  # left and right, upwards
    grid[1:-1, 0] = 2.0 * grid[1:-1, 1] - grid[1:-1, 2] + along(vertex[:, 0])
    grid[1:-1, -1] = 2.0 * grid[1:-1, -2] - grid[1:-1, -3] + along(vertex[::-1, -1])[::-1]
    for i, (next_i, after_i) in {0: (1, 2), -1: (-2, -3)}.items():
        grid[i, 1:-1] = 2.0 * grid[next_i, 1:-1] - grid[after_i, 1:-1] + sides[i]
        for j, next_j in ((0, 1), (-1, -2)):
            beyond = 2.0 * sides[i][j] - sides[i][next_j] + delta[int(vertex[i, j]), boundary.CORNER_MIXED]
            grid[i, j] = 2.0 * grid[next_i, j] - grid[after_i, j] + beyond
    return grid


def splines(n: int, x: np.ndarray) -> np.ndarray:
    """The uniform cubic B-splines centred at -1 .. n + 1, shape (n + 3, points)."""
    return np.nan_to_num(
        [BSpline.basis_element(i + np.arange(-2.0, 3.0), extrapolate=False)(x) for i in range(-1, n + 2)]
    )


def test_clamped_functions_on_a_grid_are_tensor_product_b_splines():
    cells = extract(Hierarchy.on(generators.rectangle((N, M)), "clamped"))
    bound = cells.hierarchy.stages[0].boundary
    u = random_vector(bound.num_functions)
    coefficients = tensor_product_coefficients(bound, (from_dofs(bound) @ u)[:, 0])
    points = np.random.default_rng(0).uniform(0.0, 1.0, (300, 2)) * [N, M]
    low = np.floor(points).astype(int)
    piece, uv = cells.locate(low[:, 1] * N + low[:, 0], points - low)
    expected = np.einsum("in,jn,ij->n", splines(N, points[:, 0]), splines(M, points[:, 1]), coefficients)
    values = evaluate_pieces(cells.local(u), piece, uv)[:, 0]
    np.testing.assert_allclose(values, expected, rtol=0, atol=1e-12)  # coefficients are up to 200


@settings(max_examples=5)
@given(steps=STEPS)
def test_refined_grids_reproduce_bicubic_polynomials_up_to_the_rim(steps):
    hierarchy = refinements("grid", "clamped", steps)[-1]
    cells = extract(hierarchy)
    # In the parameters of the control mesh (4 x 3 faces), which the vertices that were moved do not change.
    faces, uv, _ = random_positions(hierarchy, 2500)
    x, y = (np.column_stack([faces % 4, faces // 4]) + uv).T / 4.0
    table = evaluate_pieces(cells.local(np.eye(hierarchy.num_dofs)), *cells.locate(faces, uv))
    targets = np.stack([x**i * y**j for i in range(4) for j in range(4)], axis=1)
    fitted = table @ np.linalg.lstsq(table, targets, rcond=1e-14)[0]
    np.testing.assert_allclose(fitted, targets, rtol=0, atol=1e-10)  # condition of the fit times 1e-16


def test_the_crease_rule_does_not_reproduce_squares():
    cells = extract(coarsest("grid", "crease"))
    faces, uv, _ = random_positions(cells.hierarchy, 1000)
    table = evaluate_pieces(cells.local(np.eye(cells.num_dofs)), *cells.locate(faces, uv))
    square = ((faces % 4 + uv[:, 0]) / 4.0) ** 2
    assert np.abs(table @ np.linalg.lstsq(table, square, rcond=None)[0] - square).max() > 1e-3


def test_a_delta_is_a_cubic_b_spline_along_the_rim_times_a_cube_across():
    # A side of wheel8 has four edges: the delta of its middle vertex reaches the corners at both its ends.
    cells = extract(coarsest("wheel8", "clamped"))
    bound = cells.hierarchy.stages[0].boundary
    level = bound.level
    next_of = dict(zip(level.vertices[level.rim], level.vertices[level.following[level.rim]], strict=True))
    corner = int(np.flatnonzero(level.corner)[0])
    line = [corner]
    while len(line) < 5:
        line.append(int(next_of[line[-1]]))
    assert level.corner[line[4]]
    unit = np.zeros((bound.num_functions, 1))
    unit[bound.first[line[2]]] = 1.0
    local = cells.local(to_dofs(bound) @ unit)
    spline = BSpline.basis_element(np.arange(5.0), extrapolate=False)
    starts = {int(level.vertices[h]): int(h) for h in np.flatnonzero(level.rim)}
    rim_faces = np.array([starts[v] // 4 for v in line[:4]])
    s, t = np.random.default_rng(0).random((2, 50))
    for k, v in enumerate(line[:4]):
        half_edge = starts[v]
        # Coordinates s along the rim edge, t inwards, turned into those of the face.
        turns = half_edge % 4
        u, w = s - 0.5, t - 0.5
        for _ in range(turns):
            u, w = -w, u
        piece, inner = cells.locate(np.full(50, half_edge // 4), np.stack([u, w], axis=1) + 0.5)
        expected = spline(k + s) * (1.0 - t) ** 3 / 6.0
        np.testing.assert_allclose(evaluate_pieces(local, piece, inner)[:, 0], expected, rtol=0, atol=EXACT)
    elsewhere = ~np.isin(cells.face[cells.piece_cell], rim_faces)
    assert np.abs(local[elsewhere]).max() < EXACT


# Traces in hierarchies


@pytest.mark.parametrize("name", CLAMPED)
@settings(max_examples=3)
@given(steps=STEPS)
def test_free_traces_never_vanish_and_traces_are_independent(name, steps):
    hierarchy = refinements(name, "clamped", steps)[-1]
    cells = extract(hierarchy)
    rim = rim_rows(cells)
    lengths = rim_lengths(cells)
    has_trace = np.zeros(hierarchy.num_dofs, dtype=bool)
    has_trace[rim.tocoo().col[np.abs(rim.data) > 1e-14]] = True
    for l in range(hierarchy.num_levels):
        mine = slice(hierarchy.dof_offsets[l], hierarchy.dof_offsets[l + 1])
        functions, bound = hierarchy.dof_functions(l), hierarchy.stages[l].boundary
        free = functions >= bound.level.num_vertices
        assert has_trace[mine][free].all()
        # Whoever has a trace is a trace function of its level (a tied one may have lost it to finer ones).
        assert trace_functions(bound)[functions[has_trace[mine]]].all()
    mass = sp.kron(sp.diags_array(lengths), sp.csr_array(bernstein_mass()), format="csr")
    gram = (rim.T @ mass @ rim).toarray()[np.ix_(has_trace, has_trace)]
    assert scaled_eigenvalue(gram) > 1e-3  # 1.6e-2 as a rule; 1e-16 if dependent


def rim_lengths(cells) -> np.ndarray:
    """The length of each rim edge of a piece, that of an edge of the control mesh being 1."""
    piece, side, _ = cells.boundary_pieces
    edge = cells.piece_axes[piece, :, side % 2]
    return np.linalg.norm(edge, axis=1) * 0.5 ** cells.level[cells.piece_cell[piece]]


# The tied zone: one edge is needed, and enough


def nestedness_error(name: str) -> float:
    """How far random functions move when everything is refined once."""
    hierarchy = Hierarchy.on(MESHES[name], "clamped")
    finer = hierarchy.refined(np.arange(hierarchy.num_dofs))
    u = random_vector(hierarchy.num_dofs)
    positions = random_positions(hierarchy, 500)
    values = []
    for h, x in ((hierarchy, u), (finer, finer.prolongation(hierarchy) @ u)):
        cells = extract(h)
        values.append(evaluate_pieces(cells.local(x), *cells.locate(*positions)))
    return float(np.abs(values[1] - values[0]).max())


SMOOTH_IRREGULAR = ["l_domain_smooth", "rim_of_four"]


@pytest.mark.parametrize("name", SMOOTH_IRREGULAR)
def test_freeing_deltas_next_to_a_smooth_irregular_rim_vertex_loses_all_promises(name, monkeypatch):
    # Its trace is the mean (1 6 1) / 8 of crease points, and P_v = (3 q1 - q2) / 2 of a free neighbour is no trace.
    monkeypatch.setattr(boundary, "TIED_ZONE", 0)
    bounds, steps = uniform(name, 2)
    matrix = (to_dofs(bounds[1]) @ subdivision_matrix(*bounds, steps[0]) @ from_dofs(bounds[0])).toarray()
    assert matrix.min() < -1e-2
    assert np.abs(matrix[trace_functions(bounds[1])][:, ~trace_functions(bounds[0])]).max() > 1e-2
    assert bernstein_rows(extract(Hierarchy.on(MESHES[name], "clamped"))).data.min() < -1e-2


@pytest.mark.parametrize("name", ["l_domain_tagged", *SMOOTH_IRREGULAR])
def test_the_tied_zone_shrinks_with_the_level(name, monkeypatch):
    assert nestedness_error(name) < 1e-11
    # Were two edges tied on every level, functions of level 0 would need deltas that level 1 does not have.
    monkeypatch.setattr(boundary, "TIED_ZONE", 2)
    assert nestedness_error(name) > 1e-3
