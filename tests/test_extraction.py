"""Cells and their pieces: partition of unity, geometry, independence, nestedness, smoothness across edges."""

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from refinements import (
    CASES,
    CORNERS,
    MESHES,
    STEPS,
    bernstein_mass,
    bernstein_rows,
    coarsest,
    derivatives_across,
    edge_points,
    geometry_dofs,
    random_positions,
    random_vector,
    refinements,
    scaled_eigenvalue,
)

from thccs_fem import limit
from thccs_fem.extraction import WIDTH, evaluate_pieces, extract
from thccs_fem.hierarchy import Hierarchy
from thccs_fem.subdivision import Level

EXACT = 1e-12  # sums of some dozen products of numbers up to 1
NESTED = 1e-11  # a few levels of them
INDEPENDENT = 1e-4  # least scaled eigenvalue of the mass matrix: 4.9e-4 at the worst of 1500, 1e-15 if dependent


@pytest.mark.parametrize(("name", "rule"), CASES)
@settings(max_examples=3)
@given(steps=STEPS)
def test_the_functions_are_a_basis_that_holds_the_surface(name, rule, steps):
    hierarchies = refinements(name, rule, steps)
    hierarchy = hierarchies[-1]
    cells = extract(hierarchy)
    rows = bernstein_rows(cells)
    assert rows.data.min() >= -1e-13  # no negative entry
    np.testing.assert_allclose(rows @ np.ones(hierarchy.num_dofs), 1.0, rtol=0, atol=EXACT)
    # The surface: its dofs by truncation, the same by prolongation, and the control points of every piece.
    points = geometry_dofs(hierarchy)
    size = np.ptp(MESHES[name].vertices, axis=0).max()
    carried = hierarchy.prolongation(hierarchies[0]) @ geometry_dofs(hierarchies[0])
    np.testing.assert_allclose(carried, points, rtol=0, atol=EXACT * size)
    np.testing.assert_allclose(cells.local(points), cells.piece_points, rtol=0, atol=EXACT * size)
    assert independence(cells, rows) > INDEPENDENT


def independence(cells, rows) -> float:
    """The least scaled eigenvalue of the mass matrix in the parameters of the control mesh."""
    area = np.abs(np.linalg.det(cells.piece_axes)) * 4.0 ** -cells.level[cells.piece_cell]
    mass = sp.kron(sp.diags_array(area), sp.csr_array(np.kron(bernstein_mass(), bernstein_mass())), format="csr")
    return scaled_eigenvalue((rows.T @ mass @ rows).toarray())


def test_faces_with_four_corners_of_valence_3_are_never_all_that_is_left_of_level_0(monkeypatch):
    # The support of the function at the inner corner holds all faces but the ends of the two arms. There subdivision
    # takes +1 and -1 at alternate vertices to zero, so that the functions left would be dependent.
    coarse = coarsest("l_tricube", "crease")
    (support,) = coarse.support(np.array([0]))
    assert np.count_nonzero(~support) == 2
    assert coarse.refined(np.array([0])).refined_keys[0].size == coarse.root.num_faces
    far = np.array([10])  # a function elsewhere: what is left has other faces too, and still these two go with it
    assert not coarse.support(far)[0][~support].all()
    assert np.isin(np.flatnonzero(~support), coarse.refined(far).refined_keys[0]).all()

    monkeypatch.setattr(Level, "dependent_faces", property(lambda root: np.zeros(root.num_faces, dtype=bool)))
    cells = extract(coarse.refined(np.array([0])))
    assert independence(cells, bernstein_rows(cells)) < 1e-12


@pytest.mark.parametrize(("name", "rule"), CASES)
@settings(max_examples=2)
@given(steps=STEPS)
def test_spaces_are_nested(name, rule, steps):
    hierarchies = refinements(name, rule, steps)
    coarse, middle, fine = chosen = hierarchies[0], hierarchies[len(hierarchies) // 2], hierarchies[-1]
    cells = [extract(hierarchy) for hierarchy in chosen]
    places = [c.locate(*random_positions(coarse, 300)) for c in cells]
    for k in (0, 1):
        prolongation = chosen[k + 1].prolongation(chosen[k])
        assert abs(prolongation.sum(axis=1) - 1.0).max() < EXACT
        u = random_vector(chosen[k].num_dofs)
        before = evaluate_pieces(cells[k].local(u), *places[k])
        after = evaluate_pieces(cells[k + 1].local(prolongation @ u), *places[k + 1])
        np.testing.assert_allclose(after, before, rtol=0, atol=NESTED)
    composed = fine.prolongation(middle) @ middle.prolongation(coarse)
    np.testing.assert_allclose(composed.toarray(), fine.prolongation(coarse).toarray(), rtol=0, atol=EXACT)


@pytest.mark.parametrize(("name", "rule"), CASES)
@settings(max_examples=2)
@given(steps=STEPS)
def test_functions_are_smooth_across_all_edges(name, rule, steps):
    hierarchy = refinements(name, rule, steps)[-1]
    cells = extract(hierarchy)
    local = cells.local(random_vector(hierarchy.num_dofs))
    points = edge_points(cells)
    one, other = (derivatives_across(local, points, side) for side in (0, 1))
    np.testing.assert_allclose(other[0], one[0], rtol=0, atol=NESTED)
    # C2 where no cap is near: also across hanging edges, and on the faces around an extraordinary vertex.
    regular = points.regular
    assert regular.any() or name == "single_quad"
    np.testing.assert_allclose(other[1:, regular], one[1:, regular], rtol=0, atol=NESTED)


def test_caps_are_continuous_only():
    cells = extract(coarsest("wheel5", "crease"))
    points = edge_points(cells)
    local = cells.local(random_vector(cells.num_dofs))
    one, other = (derivatives_across(local, points, side) for side in (0, 1))
    jumps = np.abs(other - one)[..., 0]
    assert jumps[0].max() < NESTED
    assert jumps[1, ~points.regular].max() > 1e-3  # what the test above would see if a cap passed for regular
    assert jumps[1, points.regular].max() < NESTED


@pytest.mark.parametrize(
    ("name", "rule"), [("wheel5", "crease"), ("polygons", "clamped"), ("tripod", "crease"), ("torus_of_nine", "crease")]
)
@settings(max_examples=3)
@given(steps=STEPS)
def test_cells_pieces_and_batches_fit_together(name, rule, steps):
    hierarchy = refinements(name, rule, steps)[-1]
    cells = extract(hierarchy)
    # Cells: the active elements, level by level.
    expected = [(l, f) for l in range(hierarchy.num_levels) for f in hierarchy.stages[l].active_faces.tolist()]
    assert list(zip(cells.level.tolist(), cells.level_face.tolist(), strict=True)) == expected
    # Pieces cover each cell once: their areas sum to 1.
    area = np.abs(np.linalg.det(cells.piece_axes))
    np.testing.assert_allclose(np.bincount(cells.piece_cell, area, cells.num_cells), 1.0, rtol=0, atol=EXACT)
    far = cells.piece_origin + cells.piece_axes.sum(axis=2)
    assert cells.piece_origin.min() >= 0.0
    assert cells.piece_origin.max() <= 1.0
    assert far.min() >= 0.0
    assert far.max() <= 1.0
    # Batches: all cells, each once, ascending; dofs ascending and padded at the end.
    every = np.concatenate([batch.cells for batch in cells.batches])
    assert np.array_equal(np.sort(every), np.arange(cells.num_cells))
    for batch in cells.batches:
        assert (np.diff(batch.cells) > 0).all()
        assert batch.offsets[0] == 0
        assert batch.offsets[-1] == batch.num_pieces
        assert (np.diff(batch.offsets) > 0).all()
        if batch.operators is None:
            assert batch.dofs.shape[1] == 16
            assert np.array_equal(batch.offsets, np.arange(batch.num_pieces + 1))
            continue
        assert batch.dofs.shape[1] % WIDTH == 0
        used = batch.dofs >= 0
        assert (np.diff(used.astype(int), axis=1) <= 0).all()
        assert (np.diff(batch.dofs, axis=1)[used[:, 1:]] > 0).all()
        assert used.sum(axis=1).min() > batch.dofs.shape[1] - WIDTH  # no wider than need be
        padding = np.repeat(~used, np.diff(batch.offsets), axis=0)
        assert not np.swapaxes(batch.operators, 1, 2)[padding].any()
        # Every dof listed has a nonzero entry somewhere in its cell.
        seen = np.logical_or.reduceat((batch.operators != 0.0).any(axis=1), batch.offsets[:-1], axis=0)
        assert np.array_equal(seen, used)


@settings(max_examples=5)
@given(steps=STEPS)
def test_rows_are_the_local_coefficients(steps):
    cells = extract(refinements("wheel3", "clamped", steps)[-1])
    u = random_vector(cells.num_dofs)
    some = np.random.default_rng(0).permutation(cells.num_pieces)[:20].astype(np.int32)
    found = (cells.rows(some) @ u).reshape(20, 16, 1)
    np.testing.assert_allclose(found, cells.local(u)[some], rtol=0, atol=1e-13)  # the same sums in another order


@pytest.mark.parametrize("name", ["grid", "wheel5", "polygons", "cube", "l_domain_tagged"])
@settings(max_examples=2)
@given(steps=STEPS)
def test_a_point_is_located_where_its_piece_says(name, steps):
    hierarchy = refinements(name, "crease", steps)[-1]
    cells = extract(hierarchy)
    faces, uv, corner = random_positions(hierarchy, 200)
    piece, inner = cells.locate(faces, uv, corner)
    assert piece.min() >= 0
    assert np.array_equal(cells.face[cells.piece_cell[piece]], faces)
    # In the cell, then up the tree by the digits of its key, to the face of level 0.
    cell = cells.piece_cell[piece]
    place = cells.piece_origin[piece] + np.einsum("nij,nj->ni", cells.piece_axes[piece], inner)
    key = np.array([hierarchy.stages[l].level.keys[f] for l, f in zip(cells.level, cells.level_face, strict=True)])
    key = key[cell]
    for n in range(faces.size):
        for _ in range(cells.level[cell[n]]):
            k, key[n] = key[n] % 4, key[n] // 4
            along, inward = CORNERS[(k + 1) % 4] - CORNERS[k], CORNERS[k - 1] - CORNERS[k]
            place[n] = CORNERS[k] + 0.5 * (place[n, 0] * along + place[n, 1] * inward)
    root, expected = hierarchy.root_position(faces, uv, corner)
    assert np.array_equal(key, root)
    np.testing.assert_allclose(place, expected, rtol=0, atol=1e-14)  # halves and quarters: nearly no rounding


@pytest.mark.parametrize("name", ["grid", "wheel5", "tripod", "polygons", "l_domain_tagged", "rim_of_four"])
def test_away_from_caps_the_pieces_are_the_limit_surface(name):
    hierarchy = Hierarchy.on(MESHES[name], "crease").refined(np.array([0, 5]))
    cells = extract(hierarchy)
    positions = random_positions(hierarchy, 300)
    piece, uv = cells.locate(*positions)
    capped = np.zeros(cells.num_pieces, dtype=bool)
    for stage, piece_of_face in zip(hierarchy.stages, cells.piece_of_face, strict=True):
        whole = np.flatnonzero(piece_of_face >= 0)
        capped[piece_of_face[whole]] = ~stage.level.regular[stage.level.quads[whole]].all(axis=1)
    smooth = ~capped[piece]
    assert np.count_nonzero(smooth) > 250  # a cap of level 4 is 1/256 of a face
    found = evaluate_pieces(cells.piece_points, piece, uv)
    exact = limit.evaluate(MESHES[name], *positions[:2], corner=positions[2], derivatives=0)
    exact = np.asarray(exact).reshape(found.shape)
    size = np.ptp(MESHES[name].vertices, axis=0).max()
    np.testing.assert_allclose(found[smooth], exact[smooth], rtol=0, atol=EXACT * size)


@pytest.mark.parametrize("name", ["wheel2", "wheel3", "wheel12", "pole", "split_face", "l_tricube", "torus_of_nine"])
def test_caps_meet_the_limit_surface_at_their_vertices(name):
    hierarchy = coarsest(name, "crease")
    cells = extract(hierarchy)
    mesh = MESHES[name]
    compared = 0
    for v in np.setdiff1d(np.arange(mesh.num_vertices), mesh.boundary_vertices):
        faces, corners = np.nonzero(mesh.quads == v)
        n = faces.size
        along, across = mesh.quads[faces, (corners + 1) % 4], mesh.quads[faces, (corners + 2) % 4]
        # Halstead, Kass, DeRose (1993): n^2 times the vertex, 4 times those across edges, those across faces.
        weighted = n * n * mesh.vertices[v] + 4.0 * mesh.vertices[along].sum(0) + mesh.vertices[across].sum(0)
        found = evaluate_pieces(cells.piece_points, *cells.locate(faces, CORNERS[corners]))
        np.testing.assert_allclose(found, np.tile(weighted / (n * (n + 5)), (n, 1)), rtol=0, atol=EXACT)
        compared += n != 4
    assert compared or name == "torus_of_nine"


@pytest.mark.parametrize("name", ["grid", "tripod", "wheel5"])
def test_area_element(name):
    cells = extract(coarsest(name, "crease"))
    pieces = np.arange(min(cells.num_pieces, 30), dtype=np.int32)
    uv = np.random.default_rng(0).uniform(0.1, 0.9, (4, 2))
    step = 1e-5

    def x(shift):
        piece = np.repeat(pieces, 4)
        return evaluate_pieces(cells.piece_points, piece, np.tile(uv, (pieces.size, 1)) + shift)

    du, dv = ((x(step * e) - x(-step * e)) / (2 * step) for e in np.eye(2))
    metric = (du * du).sum(1) * (dv * dv).sum(1) - (du * dv).sum(1) ** 2
    expected = np.sqrt(metric).reshape(pieces.size, 4)
    # Central differences: h^2 times third derivatives, and 1e-16 / h, relative to tangents of length up to 1.
    np.testing.assert_allclose(cells.area_element(pieces, uv), expected, rtol=1e-6)


def test_boundary_pieces_go_round_the_rim_once():
    hierarchy = coarsest("polygons", "clamped").refined(np.array([0, 20]))
    cells = extract(hierarchy)
    piece, side, half_edge = cells.boundary_pieces
    ends = cells.piece_origin[piece][:, None] + np.einsum(
        "nij,nkj->nki", cells.piece_axes[piece], CORNERS[np.stack([side, (side + 1) % 4], axis=1)]
    )
    # Lengths in the control mesh: an edge is cut in two halves, the edges of level 0.
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) * 0.5 ** cells.level[cells.piece_cell[piece]]
    mesh = MESHES["polygons"]
    rim = np.flatnonzero(np.isin(mesh.face_edges, mesh.boundary_edges))
    assert np.array_equal(np.unique(half_edge), rim)
    np.testing.assert_allclose(np.bincount(half_edge, length)[rim], 2.0, rtol=0, atol=EXACT)
    faces = np.searchsorted(mesh.face_offsets, half_edge, "right") - 1
    assert np.array_equal(cells.face[cells.piece_cell[piece]], faces)


def test_arrays_of_batches_are_read_only():
    batch = extract(coarsest("wheel3", "crease")).batches[-1]
    with pytest.raises(ValueError, match="read-only"):
        batch.operators[0, 0, 0] = 1.0
