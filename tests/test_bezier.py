"""Bezier masks: exact on regular faces of either boundary, continuous everywhere."""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest
from exact import ExactMesh
from hypothesis import given
from hypothesis import strategies as st
from zoo import ZOO, grid, torus

from thccs_fem.bezier import bezier_masks, spline_grid
from thccs_fem.boundary import Boundary, BoundaryRule, subdivision_matrix
from thccs_fem.element import TO_BERNSTEIN
from thccs_fem.mesh import ControlMesh
from thccs_fem.subdivision import Level, control_level, neighbourhood, subdivide

Bools = npt.NDArray[np.bool_]
Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]

Builder = Callable[[], ControlMesh]
MESHES = [pytest.param(build, id=name) for name, build in ZOO.items()]
RULES = pytest.mark.parametrize("rule", ["crease", "clamped"])

ROUNDING = 1e-14  # of sums of numbers of size 1

# Coefficients i + 4 j along the edges of a face from corners 0, 1, 2, 3, and the rows next to them inside.
EDGES = np.array([[0, 1, 2, 3], [3, 7, 11, 15], [15, 14, 13, 12], [12, 8, 4, 0]])
SECOND = np.array([[4, 5, 6, 7], [2, 6, 10, 14], [11, 10, 9, 8], [13, 9, 5, 1]])
THIRD = np.array([[8, 9, 10, 11], [1, 5, 9, 13], [7, 6, 5, 4], [14, 10, 6, 2]])


def everything(level: Level) -> Bools:
    return np.ones(level.num_faces, dtype=bool)


def all_faces(level: Level) -> Ints:
    return np.arange(level.num_faces, dtype=np.int32)


def quad_level(mesh: ControlMesh) -> Level:
    """Return the control level, or the first subdivision of a mesh with other polygons."""
    level = control_level(mesh)
    return level if level.is_quad else subdivide(level, everything(level)).fine


def subdivided(level: Level, number: int) -> Level:
    for _ in range(number):
        level = subdivide(level, everything(level)).fine
    return level


def regular_faces(level: Level) -> Ints:
    return np.flatnonzero(~level.touching(~level.regular)).astype(np.int32)


@pytest.mark.parametrize("build", MESHES)
def test_coefficients_are_means_of_the_points(build: Builder) -> None:
    level = quad_level(build())
    masks = bezier_masks(Boundary.of(level, "crease"), all_faces(level))
    assert masks.shape == (16 * level.num_faces, level.num_vertices)
    assert masks.data.min() >= 0.0
    np.testing.assert_allclose(masks.sum(axis=1), 1.0, rtol=0, atol=ROUNDING)


def quarters(coefficients: Floats) -> Floats:
    """Return the coefficients of the four children, by de Casteljau, shape (n, 4, 16, k)."""
    grid = coefficients.reshape(-1, 4, 4, coefficients.shape[-1])  # [face, j, i, component]
    low = np.array([[8, 0, 0, 0], [4, 4, 0, 0], [2, 4, 2, 0], [1, 3, 3, 1]]) / 8
    high = low[::-1, ::-1]
    children = []
    for k, (along_u, along_v) in enumerate(((low, low), (high, low), (high, high), (low, high))):
        child = np.einsum("lj,mi,fjic->flmc", along_v, along_u, grid)
        # Child k has its corner 0 at corner k of the face: its axes are turned by k quarters.
        children.append(np.rot90(child, k, axes=(1, 2)).reshape(coefficients.shape))
    return np.stack(children, axis=1)


@RULES
@pytest.mark.parametrize("build", MESHES)
def test_a_quarter_of_a_regular_face_is_its_child(build: Builder, rule: BoundaryRule) -> None:
    coarse = quad_level(build())
    for _ in range(3):  # the first levels of some have no regular face
        boundary = Boundary.of(coarse, rule)
        step = subdivide(coarse, everything(coarse))
        fine = Boundary.of(step.fine, rule)
        values = np.random.default_rng(0).uniform(-1, 1, (boundary.num_functions, 2))
        faces = regular_faces(coarse)
        children = (step.first_child[faces][:, None] + np.arange(4)).ravel().astype(np.int32)
        parent = (bezier_masks(boundary, faces) @ values).reshape(-1, 16, 2)
        child = bezier_masks(fine, children) @ (subdivision_matrix(boundary, fine, step) @ values)
        np.testing.assert_allclose(child.reshape(-1, 4, 16, 2), quarters(parent), rtol=0, atol=ROUNDING)
        coarse = step.fine
    assert faces.size


def check_edges(level: Level, coefficients: Floats) -> None:
    """Check that patches of shape (faces, 16, k) meet, and that they are C2 where the edge ends are regular."""
    h = np.flatnonzero(level.twins >= 0)
    twin = level.twins[h]
    own, others = (coefficients.reshape(-1, 16, coefficients.shape[-1])[side // 4] for side in (h, twin))
    places = np.arange(h.size)[:, None]
    edge, second, third = (own[places, table[h % 4]] for table in (EDGES, SECOND, THIRD))
    edge2, second2, third2 = (others[places, table[twin % 4][:, ::-1]] for table in (EDGES, SECOND, THIRD))
    np.testing.assert_allclose(edge, edge2, rtol=0, atol=ROUNDING)
    smooth = level.regular[level.vertices[h]] & level.regular[level.vertices[level.following[h]]]
    np.testing.assert_allclose((edge - second)[smooth], (second2 - edge2)[smooth], rtol=0, atol=ROUNDING)
    # Across the edge the faces may have irregular vertices elsewhere: second derivatives need regular faces.
    whole = ~level.touching(~level.regular)
    smooth = whole[level.face[h]] & whole[level.face[twin]]
    jump = (edge - 2 * second + third) - (edge2 - 2 * second2 + third2)
    np.testing.assert_allclose(jump[smooth], 0.0, rtol=0, atol=10 * ROUNDING)


@RULES
@pytest.mark.parametrize("build", MESHES)
def test_patches_meet_and_are_smooth_between_regular_vertices(build: Builder, rule: BoundaryRule) -> None:
    level = quad_level(build())
    for _ in range(2):
        boundary = Boundary.of(level, rule)
        values = np.random.default_rng(1).uniform(-1, 1, (boundary.num_functions, 2))
        check_edges(level, bezier_masks(boundary, all_faces(level)) @ values)
        level = subdivide(level, everything(level)).fine


@pytest.mark.parametrize("build", MESHES)
def test_vertex_points_are_limit_points(build: Builder) -> None:
    mesh = build()
    control = control_level(mesh)
    step = subdivide(control, everything(control))
    level, exact = step.fine, ExactMesh.of(mesh).subdivided()
    coefficients = bezier_masks(Boundary.of(level, "crease"), all_faces(level)) @ (step.matrix @ mesh.vertices)
    corners = coefficients.reshape(-1, 16, mesh.gdim)[:, EDGES[:, 0]]
    limits = np.array([exact.limit(v) for v in range(level.num_vertices)]).astype(float)
    np.testing.assert_allclose(corners, limits[level.quads], rtol=0, atol=ROUNDING)


@pytest.mark.parametrize(("n", "m"), [(1, 1), (4, 1), (3, 2)])
def test_a_square_grid_is_the_identity(n: int, m: int) -> None:
    level = control_level(grid(n, m))
    y, x = np.divmod(np.arange((n + 1) * (m + 1)), n + 1)
    coefficients = bezier_masks(Boundary.of(level, "crease"), all_faces(level)) @ np.column_stack([x, y])
    j, i = np.divmod(np.arange(16), 4)
    face_j, face_i = np.divmod(np.arange(n * m), n)
    expected = np.stack([face_i[:, None] + i / 3, face_j[:, None] + j / 3], axis=-1)
    np.testing.assert_allclose(coefficients.reshape(-1, 16, 2), expected, rtol=0, atol=ROUNDING)


@pytest.mark.parametrize("build", MESHES)
def test_the_crease_boundary_has_no_second_derivative_across(build: Builder) -> None:
    level = quad_level(build())
    values = np.random.default_rng(2).uniform(-1, 1, (level.num_vertices, 2))
    coefficients = (bezier_masks(Boundary.of(level, "crease"), all_faces(level)) @ values).reshape(-1, 16, 2)
    whole = ~level.touching(~level.regular)
    h = np.flatnonzero(level.rim & whole[level.face])
    rows = (coefficients[(h // 4)[:, None], table[h % 4]] for table in (EDGES, SECOND, THIRD))
    first, second, third = rows
    np.testing.assert_allclose(first - 2 * second + third, 0.0, rtol=0, atol=ROUNDING)


def test_spline_grids_of_a_torus() -> None:
    n, m = 6, 5
    level = control_level(torus(n, m))
    i, j = np.divmod(all_faces(level), m)
    b, a = np.divmod(np.arange(16), 4)
    expected = (i[:, None] + a - 1) % n * m + (j[:, None] + b - 1) % m
    np.testing.assert_array_equal(spline_grid(level, all_faces(level)), expected)


@pytest.mark.parametrize("build", MESHES)
def test_spline_grids_give_the_same_patches_as_masks(build: Builder) -> None:
    level = subdivided(quad_level(build()), 1)
    faces = np.flatnonzero(~level.touching(~level.regular | level.boundary)).astype(np.int32)
    values = np.random.default_rng(3).uniform(-1, 1, (level.num_vertices, 2))
    by_masks = (bezier_masks(Boundary.of(level, "crease"), faces) @ values).reshape(-1, 16, 2)
    by_grid = np.einsum("bp,fpc->fbc", TO_BERNSTEIN, values[spline_grid(level, faces)])
    np.testing.assert_allclose(by_grid, by_masks, rtol=0, atol=ROUNDING)


PARTS = ("grid", "strip", "torus", "wheel5", "split_face", "pillow", "tripod", "l_domain_tagged", "pentagonal_prism")


@given(st.sampled_from(PARTS), st.integers(0, 10**6), st.sampled_from(["crease", "clamped"]))
def test_masks_on_parts_are_those_of_the_whole(name: str, seed: int, rule: BoundaryRule) -> None:
    level = quad_level(ZOO[name]())
    marked = np.random.default_rng(seed).random(level.num_faces) < 0.3
    whole, part = subdivide(level, everything(level)).fine, subdivide(level, neighbourhood(level, marked)).fine
    faces = np.flatnonzero(np.isin(part.keys // 4, level.keys[marked])).astype(np.int32)
    in_whole = np.searchsorted(whole.keys, part.keys[faces]).astype(np.int32)
    on_whole, on_part = Boundary.of(whole, rule), Boundary.of(part, rule)
    vertices = np.zeros(part.num_vertices, dtype=np.int32)
    vertices[part.quads] = whole.quads[np.searchsorted(whole.keys, part.keys)]
    first = on_whole.first[vertices[on_part.vertex]]
    assert (first >= 0).all()
    trace = np.arange(on_part.vertex.size) - (on_part.first[on_part.vertex] - part.num_vertices)
    values = np.random.default_rng(seed).uniform(-1, 1, (on_whole.num_functions, 1))
    own = bezier_masks(on_part, faces) @ np.concatenate([values[vertices], values[first + trace]])
    np.testing.assert_allclose(own, bezier_masks(on_whole, in_whole) @ values, rtol=0, atol=ROUNDING)
