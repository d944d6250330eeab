"""Exact evaluation against rational arithmetic, B-splines of scipy's, and properties of the surface."""

from collections.abc import Callable, Iterator
from math import comb

import numpy as np
import numpy.typing as npt
import pytest
from exact import ExactMesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import BSpline
from zoo import ZOO, grid, half_disc, polycube, prism, pyramid, torus, wheel

from thccs_fem import limit
from thccs_fem.mesh import ControlMesh
from thccs_fem.positions import CHILD_AXES, CHILD_ORIGIN
from thccs_fem.subdivision import Level, control_level, subdivide

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]

Builder = Callable[[], ControlMesh]
MESHES = [pytest.param(build, id=name) for name, build in ZOO.items()]
FEW_FACES = [param for param in MESHES if param.id not in ("pole", "wheel12")]

EXACT = 1e-14  # rounding of a few products and sums of numbers below 10


def random_points(mesh: ControlMesh, number: int, seed: int = 0) -> tuple[Ints, Floats, Ints | None]:
    """Return faces, coordinates, and on meshes with polygons the corners (none on some of the quads)."""
    rng = np.random.default_rng(seed)
    faces = rng.integers(mesh.num_faces, size=number, dtype=np.int32)
    if mesh.is_quad:
        return faces, rng.random((number, 2)), None
    sizes = mesh.face_sizes[faces]
    corner = np.where((sizes == 4) & (rng.random(number) < 0.5), -1, rng.integers(sizes))
    return faces, rng.random((number, 2)), corner.astype(np.int32)


def first_subdivision(mesh: ControlMesh) -> ControlMesh:
    """Return it as a control mesh; the child at half-edge h is face h."""
    control = control_level(mesh)
    step = subdivide(control, np.ones(control.num_faces, dtype=bool))
    return ControlMesh(step.matrix @ mesh.vertices, step.fine.quads, corners=dict(mesh.corners))


def faces_of_level(mesh: ControlMesh, level: int, named: bool) -> tuple[Ints, Ints, Floats, Floats]:
    """Return for all faces of a level the user's face, the corner, and origin and axes in the user's coordinates.

    These are the sub-quads' if `named`, else (quads only) the faces'.
    """
    face = np.repeat(np.arange(mesh.num_faces, dtype=np.int32), mesh.face_sizes)
    k = np.arange(face.size, dtype=np.int32) - mesh.face_offsets[face]
    if named:
        corner, origin, axes = k, np.zeros((k.size, 2)), np.tile(np.eye(2), (k.size, 1, 1))
    else:
        corner, origin, axes = np.full_like(k, -1), CHILD_ORIGIN[k], CHILD_AXES[k] / 2
    for _ in range(level - 1):
        child = np.tile(np.arange(4), face.size)
        face, corner, origin, axes = (np.repeat(a, 4, axis=0) for a in (face, corner, origin, axes))
        origin = origin + np.einsum("nij,nj->ni", axes, CHILD_ORIGIN[child])
        axes = axes @ CHILD_AXES[child] / 2
    return face, corner, origin, axes


def with_axes(x: Floats, axes: Floats) -> Floats:
    """Return derivatives (rows as `evaluate` returns them) along other axes, given in columns, shape (n, 2, 2)."""
    hessian = x[[3, 4, 4, 5]].reshape(2, 2, *x.shape[1:])
    first = np.einsum("nji,jnc->inc", axes, x[1:3])
    second = np.einsum("nai,nbj,abnc->ijnc", axes, axes, hessian)
    return np.stack([x[0], *first, second[0, 0], second[0, 1], second[1, 1]])


@pytest.mark.parametrize("build", FEW_FACES)
@pytest.mark.parametrize("named", [False, True])
def test_points_at_dyadic_coordinates_are_those_of_rational_arithmetic(build: Builder, named: bool) -> None:
    mesh = build()
    named |= not mesh.is_quad
    fine = ExactMesh.of(mesh).subdivided().subdivided()
    faces, corner, origin, axes = faces_of_level(mesh, 2, named)
    x = with_axes(limit.evaluate(mesh, faces, origin, 2, corner), axes)
    positions = np.array([fine.limit(face[0]) for face in fine.faces]).astype(float)
    np.testing.assert_allclose(x[0], positions, rtol=0, atol=EXACT)
    regular = [f for f, face in enumerate(fine.faces) if fine.is_regular(face[0])]
    derivatives = np.array([fine.derivatives(f) for f in regular]).astype(float)
    if regular:
        np.testing.assert_allclose(x[1:, regular], derivatives.swapaxes(0, 1), rtol=0, atol=10 * EXACT)


@pytest.mark.parametrize("valence", [*range(2, 13), 64])
def test_limit_of_a_vertex_is_the_closed_form(valence: int) -> None:
    mesh = wheel(valence, 1)
    around = mesh.quads
    p, edges, opposite = mesh.vertices[0], mesh.vertices[around[:, 1]], mesh.vertices[around[:, 2]]
    expected = (valence**2 * p + 4 * edges.sum(axis=0) + opposite.sum(axis=0)) / (valence * (valence + 5))
    x = limit.evaluate(mesh, np.arange(valence), np.zeros((valence, 2)), 0)
    np.testing.assert_allclose(x[0], np.tile(expected, (valence, 1)), rtol=0, atol=EXACT)


NEAR = {
    **{f"valence {n}": lambda n=n: wheel(n) for n in (2, 3, 5, 8)},  # type: ignore[misc]
    "boundary with four faces": lambda: half_disc(4),
    "corner of five faces": lambda: half_disc(5, tagged=True),
}


@pytest.mark.parametrize("build", [pytest.param(build, id=name) for name, build in NEAR.items()])
def test_derivatives_near_an_irregular_vertex_are_those_of_rational_arithmetic(build: Builder) -> None:
    mesh = build()
    face, (part, kept) = 0, ExactMesh.of(mesh).near(0)
    for depth in range(51):  # 2^-50 is 9e-16
        fine = part.subdivided()
        if depth in (20, 30, 40, 50):
            # The vertex across the face is regular; child 2 of the face starts there, and backwards.
            here = kept.index(face)
            distance = 2.0**-depth
            x = limit.evaluate(mesh, [0], [(distance, distance)], 2)[:, 0]
            np.testing.assert_allclose(x[0], fine.limit(part.faces[here][2]).astype(float), rtol=0, atol=EXACT)
            exact = fine.derivatives(4 * here + 2)
            lengths = np.array([-2, -2, 4, 4, 4])[:, None] * np.array([2**depth] * 2 + [4**depth] * 3)[:, None]
            derivatives = (exact * lengths).astype(float)
            # Relative to the largest: what is left after the powers of two cancelled.
            for rows, tolerance in ((slice(0, 2), 2e-14), (slice(2, 5), 1e-12)):
                size = np.abs(derivatives[rows]).max()
                np.testing.assert_allclose(x[1:][rows], derivatives[rows], rtol=0, atol=tolerance * size)
        face = 4 * kept.index(face)
        part, kept = fine.near(0)


def test_points_named_by_a_corner_keep_their_distance_to_it() -> None:
    mesh = wheel(5)
    turned = ControlMesh(mesh.vertices, np.roll(mesh.quads, 2, axis=1))  # the vertex is corner 2
    uv = [(1e-12, 3e-13)]
    x, y = limit.evaluate(mesh, [4], uv, 2, [0]), limit.evaluate(turned, [4], uv, 2, [2])
    np.testing.assert_allclose(y[1:], x[1:], rtol=1e-12)  # the same patch, its control points computed in another order
    from_whole_face = limit.evaluate(mesh, [4], np.array(uv) / 2, 2)
    np.testing.assert_allclose(from_whole_face[1:3], 2 * x[1:3], rtol=1e-12)
    np.testing.assert_allclose(from_whole_face[3:], 4 * x[3:], rtol=1e-12)


def test_points_may_be_as_near_to_a_vertex_as_numbers_allow() -> None:
    mesh = wheel(3)
    uv = np.array([[0.0, 0.0], [5e-324, 0.0], [1e-70, 1e-80], [1e-50, 1e-55]])
    x = limit.evaluate(mesh, np.zeros(4, dtype=int), uv, 1)
    assert np.isfinite(x).all()
    np.testing.assert_allclose(x[0], x[0, [0, 0, 0, 0]], rtol=0, atol=EXACT)
    np.testing.assert_array_equal(x[1:, :3], x[1:, [0, 0, 0]])  # at the vertex
    assert np.abs(x[1:, 3]).max() < 1e-10  # derivatives vanish at valence 3, like (2 lambda)^depth


@pytest.mark.parametrize("build", MESHES)
def test_derivatives_are_those_of_central_differences(build: Builder) -> None:
    mesh = build()
    faces, uv, corner = random_points(mesh, 60)
    h, uv = 1e-6, 0.1 + 0.3 * uv
    x = limit.evaluate(mesh, faces, uv, 2, corner)
    for axis, ((first, second), mixed) in enumerate(zip(((1, 3), (2, 5)), (4, 4), strict=True)):
        step = h * np.eye(2)[axis]
        ahead, behind = (limit.evaluate(mesh, faces, uv + s * step, 1, corner) for s in (1, -1))
        difference = (ahead - behind) / (2 * h)
        for row, column in ((first, 0), (second, 1 + axis), (mixed, 2 - axis)):
            # h^2 times third derivatives, and rounding 1e-15 / h
            np.testing.assert_allclose(x[row], difference[column], rtol=1e-7, atol=1e-7)


def spline_patch(points: Floats, u: Floats, v: Floats, du: int, dv: int) -> Floats:
    """Evaluate the uniform bicubic B-spline with control points (m + 3, n + 3, gdim) on [0, n] x [0, m]."""
    values = []
    for t, order, number in ((v, dv, points.shape[0]), (u, du, points.shape[1])):
        knots = np.arange(number + 4.0) - 3.0
        spline = BSpline(knots, np.eye(number), 3)
        values.append(spline(t, nu=order))
    return np.einsum("nj,ni,jic->nc", values[0], values[1], points)


ORDERS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))


def test_a_torus_is_the_periodic_spline_of_its_control_points() -> None:
    mesh = torus(6, 5)
    faces, uv, _ = random_points(mesh, 200)
    points = mesh.vertices.reshape(6, 5, 3)
    i, j = np.divmod(faces, 5)
    rows, columns = np.arange(-1, 8), np.arange(-1, 7)
    points = points[rows % 6][:, columns % 5].swapaxes(0, 1)
    x = limit.evaluate(mesh, faces, uv, 2)
    for row, (du, dv) in enumerate(ORDERS):
        expected = spline_patch(points, i + uv[:, 0], j + uv[:, 1], du, dv)
        np.testing.assert_allclose(x[row], expected, rtol=0, atol=10 * EXACT)


@pytest.mark.parametrize(("n", "m"), [(1, 1), (4, 1), (4, 3)])
def test_a_grid_is_the_spline_with_mirrored_ghost_points(n: int, m: int) -> None:
    mesh = grid(n, m)
    faces, uv, _ = random_points(mesh, 200)
    uv[:50] = uv[:50].round()
    points = mesh.vertices.reshape(m + 1, n + 1, 2)
    for _ in range(2):
        ghosts = 2 * points[[0, -1]] - points[[1, -2]]
        points = np.concatenate([ghosts[:1], points, ghosts[1:]]).swapaxes(0, 1)
    x = limit.evaluate(mesh, faces, uv, 2)
    j, i = np.divmod(faces, n)
    inside = np.arange(faces.size) >= 50  # BSpline takes the other side where second derivatives would jump
    for row, (du, dv) in enumerate(ORDERS):
        expected = spline_patch(points, i + uv[:, 0], j + uv[:, 1], du, dv)
        where = slice(None) if du + dv < 2 else inside
        np.testing.assert_allclose(x[row, where], expected[where], rtol=0, atol=10 * EXACT)


@pytest.mark.parametrize("build", MESHES)
def test_the_boundary_is_the_cubic_spline_of_the_boundary_polygon(build: Builder) -> None:
    mesh = build()
    level = control_level(mesh)
    t = np.array([0.0, 0.2, 0.5, 0.7, 1.0])
    before = {int(level.vertices[level.following[h]]): int(level.vertices[h]) for h in np.flatnonzero(level.rim)}
    after = {a: b for b, a in before.items()}
    for h in np.flatnonzero(level.rim):
        a = int(level.vertices[h])
        b = after[a]
        p, q = mesh.vertices[a], mesh.vertices[b]
        ghost_a = 2 * p - q if level.corner[a] else mesh.vertices[before[a]]
        ghost_b = 2 * q - p if level.corner[b] else mesh.vertices[after[b]]
        curve = BSpline(np.arange(8.0) - 3.0, np.array([ghost_a, p, q, ghost_b]), 3)
        f = level.face[h]
        k = h - level.offsets[f]
        # From the sub-quads at both ends: along u at the first, along v, backwards, at the second.
        next_k = (k + 1) % mesh.face_sizes[f]
        s = t[t <= 0.5]
        first = limit.evaluate(mesh, np.full(s.size, f), np.column_stack([2 * s, 0 * s]), 1, np.full(s.size, k))
        np.testing.assert_allclose(first[0], curve(s), rtol=0, atol=EXACT)
        inside = s > 0
        np.testing.assert_allclose(first[1, inside], curve(s[inside], nu=1) / 2, rtol=0, atol=EXACT)
        s = t[t >= 0.5]
        second = limit.evaluate(
            mesh, np.full(s.size, f), np.column_stack([0 * s, 2 - 2 * s]), 1, np.full(s.size, next_k)
        )
        np.testing.assert_allclose(second[0], curve(s), rtol=0, atol=EXACT)
        inside = s < 1
        np.testing.assert_allclose(second[2, inside], -curve(s[inside], nu=1) / 2, rtol=0, atol=EXACT)
    at = np.flatnonzero(level.corner[level.vertices])
    x = limit.evaluate(mesh, level.face[at], np.zeros((at.size, 2)), 0, at - level.offsets[level.face[at]])
    np.testing.assert_array_equal(x[0], mesh.vertices[level.vertices[at]])


@pytest.mark.parametrize("build", MESHES)
def test_the_first_subdivision_has_the_same_limit(build: Builder) -> None:
    mesh = build()
    fine = first_subdivision(mesh)
    face, corner, origin, axes = faces_of_level(mesh, 1, named=not mesh.is_quad)
    children, uv, _ = random_points(fine, 300)
    uv[:40] *= 1e-8
    x = limit.evaluate(fine, children, uv, 2)
    in_user = origin[children] + np.einsum("nij,nj->ni", axes[children], uv)
    local = np.einsum(
        "nji,nj->ni", axes[children] / np.linalg.det(axes[children])[:, None, None], in_user - origin[children]
    )
    y = with_axes(limit.evaluate(mesh, face[children], in_user, 2, corner[children]), axes[children])
    # Of uv near an irregular vertex those survive that are not rounded away in the coordinates of the whole face.
    kept = (local == uv).all(axis=1)
    assert np.count_nonzero(kept) > 60
    # Relative to the largest: rounding before points are taken relative to the vertex, on level 5 of the mesh, times
    # lambda^-5, which is 1024 at valence 2. Second derivatives are sums of terms that can be much larger.
    for rows, tolerance in ((slice(0, 1), EXACT), (slice(1, 3), 1e-12), (slice(3, 6), 1e-11)):
        scale = np.abs(x[rows]).max(axis=(0, 2))[:, None]
        assert (np.abs(x[rows] - y[rows]) / scale)[:, kept].max() <= tolerance


def edge_twins(mesh: ControlMesh) -> Iterator[tuple[int, int]]:
    """Yield the two half-edges of each inner edge, as (face, corner) pairs flattened to half-edge numbers."""
    level = control_level(mesh)
    for h, twin in enumerate(level.twins):
        if h < twin:
            yield h, int(twin)


def normals(x: Floats) -> Floats:
    """Return unit normals, shape (n, 3); in the plane signs of the determinant, shape (n,)."""
    cross = np.cross(x[1], x[2]) if x.shape[2] == 3 else x[1, :, 0] * x[2, :, 1] - x[1, :, 1] * x[2, :, 0]
    return cross / np.linalg.norm(cross, axis=-1, keepdims=True) if x.shape[2] == 3 else np.sign(cross)


@pytest.mark.parametrize("build", MESHES)
def test_positions_and_normals_are_continuous_across_edges(build: Builder) -> None:
    mesh = build()
    level = control_level(mesh)
    pairs = np.array(list(edge_twins(mesh)), dtype=int).reshape(-1, 2)
    t = np.array([1e-14, 1e-9, 1e-3, 0.3, 1.0])
    h, twin = (np.repeat(side, t.size) for side in pairs.T)
    t = np.tile(t, len(pairs))
    # Near the start of the half-edge: along u there; along v at the corner after its twin.
    other = level.following[twin]
    x = limit.evaluate(mesh, level.face[h], np.column_stack([t, 0 * t]), 1, h - level.offsets[level.face[h]])
    y = limit.evaluate(
        mesh, level.face[other], np.column_stack([0 * t, t]), 1, other - level.offsets[level.face[other]]
    )
    np.testing.assert_allclose(x[0], y[0], rtol=0, atol=EXACT)
    np.testing.assert_allclose(normals(x), normals(y), rtol=0, atol=1e-11)


def irregular_half_edges(level: Level, wanted: npt.NDArray[np.bool_]) -> Ints:
    return np.flatnonzero((~level.regular & wanted)[level.vertices]).astype(np.int32)


PLANES = {name: ZOO[name] for name in ("wheel3", "wheel5", "wheel12", "tripod", "pyramid", "l_domain_smooth")}
PLANES["boundary with three faces"] = lambda: half_disc(3)


@pytest.mark.parametrize("build", [pytest.param(build, id=name) for name, build in PLANES.items()])
def test_tangents_at_vertices_span_the_limit_of_the_tangent_planes(build: Builder) -> None:
    mesh = build()
    level = control_level(mesh)
    h = irregular_half_edges(level, ~level.corner)
    face, k = level.face[h], h - level.offsets[level.face[h]]
    inside = ~level.boundary[level.vertices[h]]
    # Normals converge like the quotient of two eigenvalues a level: 0.91 at valence 12, 0.91^190 = 2e-8; others 0.82.
    # On boundaries the angle between derivatives shrinks, too, and with it their digits: no more levels than needed.
    distance = np.where(level.vertex_num_faces[level.vertices[h]] > 8, 2.0**-190, 2.0**-90)[:, None]
    at, near, on_edge = (limit.evaluate(mesh, face, distance * uv, 2, k) for uv in ((0, 0), (1, 1), (1, 0)))
    np.testing.assert_allclose(normals(at), normals(near), rtol=0, atol=1e-6)
    assert np.isnan(at[3:]).all()
    direction, edge = (x[1, inside] / np.linalg.norm(x[1, inside], axis=1)[:, None] for x in (at, on_edge))
    np.testing.assert_allclose(direction, edge, rtol=0, atol=1e-6)


@pytest.mark.parametrize("build", MESHES)
def test_tangents_at_vertices_turn_and_scale_like_derivatives(build: Builder) -> None:
    mesh = build()
    level = control_level(mesh)
    h = irregular_half_edges(level, np.ones(level.num_vertices, dtype=bool))
    if not mesh.is_quad:
        h = h[mesh.face_sizes[level.face[h]] == 4]
    face = level.face[h]
    k = h - level.offsets[face]
    whole = limit.evaluate(mesh, face, CHILD_ORIGIN[k], 1)
    named = limit.evaluate(mesh, face, np.zeros((h.size, 2)), 1, k)
    np.testing.assert_array_equal(named[0], whole[0])
    # Quarter turns: (u, v) of the sub-quad at corners 0 .. 3 are (u, v), (v, -u), (-u, -v), (-v, u) of the face.
    u, v = whole[1:] / 2
    turned = [(u, v), (v, -u), (-u, -v), (-v, u)]
    for corner, expected in enumerate(turned):
        np.testing.assert_array_equal(named[1:, k == corner], np.array(expected)[:, k == corner])


@pytest.mark.parametrize("mesh", [torus(4, 3), grid(4, 3), grid(1, 1)], ids=["inside", "boundary", "corners"])
def test_tangent_masks_give_the_derivatives_at_regular_vertices(mesh: ControlMesh) -> None:
    level = control_level(mesh)
    half_edges = np.arange(level.vertices.size, dtype=np.int32)
    tangents = limit._limit_tangents(level, mesh.vertices, half_edges)
    x = limit.evaluate(mesh, level.face, np.zeros((half_edges.size, 2)), 1, half_edges % 4)
    np.testing.assert_allclose(tangents, 2 * x[1:], rtol=0, atol=EXACT)


def subdivided_tangents(mesh: ControlMesh, half_edges: Ints) -> tuple[Floats, Floats]:
    """Return the tangents by the masks on the control mesh and on its first subdivision."""
    control = control_level(mesh)
    step = subdivide(control, np.ones(control.num_faces, dtype=bool))
    return (
        limit._limit_tangents(control, mesh.vertices, half_edges),
        limit._limit_tangents(step.fine, step.matrix @ mesh.vertices, 4 * half_edges),
    )


def eigenvalue(theta: float) -> float:
    """Return the subdominant eigenvalue in closed form (Halstead, Kass, DeRose 1993)."""
    c = np.cos(theta)
    return float((5 + c + np.cos(theta / 2) * np.sqrt(2 * (9 + c))) / 16)


@pytest.mark.parametrize("n", [3, 5, 6, 8, 12, 64])
def test_tangent_masks_inside_are_eigenvectors(n: int) -> None:
    control, fine = subdivided_tangents(wheel(n, 1), 4 * np.arange(n, dtype=np.int32))
    np.testing.assert_allclose(fine, eigenvalue(2 * np.pi / n) * control, rtol=0, atol=EXACT)


def test_tangent_masks_on_the_boundary_are_eigenvectors() -> None:
    control, fine = subdivided_tangents(half_disc(3), 16 * np.arange(3, dtype=np.int32))  # first of 4 faces a sector
    along, along_fine = control[0, 0], fine[0, 0]
    np.testing.assert_allclose(along_fine, along / 2, rtol=0, atol=EXACT)
    np.testing.assert_allclose(control[1, 2], -along, rtol=0, atol=EXACT)
    # The edges between are 60 and 120 degrees from the rim: cos = 1/2, -1/2.
    for place, cos in ((1, 0.5), (2, -0.5)):
        across, across_fine = control[0, place] - cos * along, fine[0, place] - cos * along_fine
        np.testing.assert_allclose(across_fine, eigenvalue(np.pi / 3) * across, rtol=0, atol=EXACT)
        np.testing.assert_allclose(across, control[0, 1] - 0.5 * along, rtol=0, atol=EXACT)
        np.testing.assert_array_equal(control[1, place - 1], control[0, place])


@pytest.mark.parametrize("n", [4, 7])
def test_boundaries_of_many_faces_have_tangents_along_the_boundary_alone(n: int) -> None:
    mesh = half_disc(n)
    x = limit.evaluate(mesh, 4 * np.arange(n), np.zeros((n, 2)), 1)
    q, r = mesh.vertices[[mesh.quads[0, 1], mesh.quads[4 * (n - 1), 3]]]
    np.testing.assert_allclose(x[1, 0], (q - r) / 2, rtol=0, atol=EXACT)
    np.testing.assert_allclose(x[2, -1], (r - q) / 2, rtol=0, atol=EXACT)
    assert np.isnan(x[1, 1:]).all()
    assert np.isnan(x[2, :-1]).all()


def test_there_is_no_tangent_plane_where_two_faces_meet() -> None:
    mesh = wheel(2)
    faces, depths = np.zeros(6, dtype=int), 2.0 ** -np.arange(60, 66)
    x = limit.evaluate(mesh, faces, np.column_stack([depths, depths]), 1)
    even, odd = normals(x)[::2], normals(x)[1::2]
    np.testing.assert_allclose(even, even[[0, 0, 0]], rtol=0, atol=1e-6)
    assert np.linalg.norm(even - odd, axis=1).min() > 1e-3
    assert np.isnan(limit.evaluate(mesh, [0], [(0.0, 0.0)], 1)[1:]).all()


@pytest.mark.parametrize("n", [2, 5])
def test_corners_of_several_faces_have_tangents_along_the_boundary_alone(n: int) -> None:
    mesh = half_disc(n, tagged=True)
    at_corner = limit.evaluate(mesh, 4 * np.arange(n), np.zeros((n, 2)), 1)
    p, q, r = mesh.vertices[[0, mesh.quads[0, 1], mesh.quads[4 * (n - 1), 3]]]
    np.testing.assert_allclose(at_corner[1, 0], q - p, rtol=0, atol=EXACT)
    np.testing.assert_allclose(at_corner[2, -1], r - p, rtol=0, atol=EXACT)
    assert np.isnan(at_corner[1, 1:]).all()
    assert np.isnan(at_corner[2, :-1]).all()
    np.testing.assert_array_equal(at_corner[0], np.tile(p, (n, 1)))


def test_the_centre_of_a_polygon_is_an_irregular_vertex() -> None:
    mesh = prism(5)
    corner = np.arange(5)
    pentagon = np.flatnonzero(mesh.face_sizes == 5)[1]
    x = limit.evaluate(mesh, np.full(5, pentagon), np.ones((5, 2)), 2, corner)
    y = limit.evaluate(first_subdivision(mesh), mesh.face_offsets[pentagon] + corner, np.ones((5, 2)), 2)
    np.testing.assert_allclose(x[0], np.tile(x[0, 0], (5, 1)), rtol=0, atol=EXACT)
    np.testing.assert_allclose(normals(x), np.tile(normals(x)[0], (5, 1)), rtol=0, atol=10 * EXACT)
    np.testing.assert_allclose(x[0], y[0], rtol=0, atol=EXACT)
    assert np.isnan(x[3:]).all()
    # v runs along the edge that the next sub-quad's u runs along, and both run as the derivatives beside do.
    np.testing.assert_allclose(x[2], np.roll(x[1], -1, axis=0), rtol=0, atol=10 * EXACT)
    beside = limit.evaluate(mesh, np.full(5, pentagon), np.tile([1 - 1e-9, 1], (5, 1)), 1, corner)
    cosine = (x[1] * beside[1]).sum(axis=1) / np.linalg.norm(x[1], axis=1) / np.linalg.norm(beside[1], axis=1)
    np.testing.assert_allclose(cosine, 1.0, rtol=0, atol=1e-3)


@settings(max_examples=40)
@given(st.data())
def test_affine_maps_go_through(data: st.DataObject) -> None:
    mesh = ZOO[data.draw(st.sampled_from(sorted(ZOO.keys() - {"pole", "wheel12"})))]()
    numbers = st.floats(0.0, 1.0, allow_subnormal=False)
    face = data.draw(st.integers(0, mesh.num_faces - 1))
    corner = data.draw(st.integers(0, int(mesh.face_sizes[face]) - 1))
    uv = data.draw(st.tuples(numbers, numbers))
    rng = np.random.default_rng(data.draw(st.integers(0, 100)))
    linear, shift = np.eye(3)[:, : mesh.gdim] + 0.3 * rng.uniform(-1, 1, (3, mesh.gdim)), rng.uniform(-5, 5, 3)
    image = ControlMesh(
        mesh.vertices @ linear.T + shift,
        np.split(mesh.face_vertices, mesh.face_offsets[1:-1]),
        corners=dict(mesh.corners),
    )
    x, y = (limit.evaluate(m, [face], [uv], 1, [corner]) for m in (mesh, image))
    expected = x @ linear.T
    expected[0] += shift
    scale = np.maximum(np.abs(np.nan_to_num(x)).max(axis=(1, 2)), 1.0)[:, None, None] * 20
    np.testing.assert_allclose(y / scale, expected / scale, rtol=0, atol=10 * EXACT)


def test_many_points_give_what_each_gives_alone() -> None:
    mesh = polycube([(0, 0, 0), (1, 0, 0)])
    faces, uv, _ = random_points(mesh, 40)
    uv[:10] *= 1e-5
    together = limit.evaluate(mesh, faces, uv, 2)
    alone = [limit.evaluate(mesh, faces[[i]], uv[[i]], 2) for i in range(40)]
    scale = np.abs(together).max(axis=2, keepdims=True)
    np.testing.assert_allclose(together / scale, np.concatenate(alone, axis=1) / scale, rtol=0, atol=1e-12)


@pytest.mark.parametrize("derivatives", [0, 1, 2])
def test_shapes_and_orders(derivatives: int) -> None:
    mesh = grid(2, 2)
    rows = (1, 3, 6)[derivatives]
    faces, uv, _ = random_points(mesh, 7)
    x = limit.evaluate(mesh, faces, uv, derivatives)
    assert x.shape == (rows, 7, 2)
    assert x.dtype == np.float64
    np.testing.assert_array_equal(x, limit.evaluate(mesh, faces, uv, 2)[:rows])
    assert limit.evaluate(mesh, faces[:0], uv[:0], derivatives).shape == (rows, 0, 2)


def test_all_points_may_be_at_vertices() -> None:
    x = limit.evaluate(wheel(5), [0], [(0.0, 0.0)], 0)
    assert x.shape == (1, 1, 3)


def bernstein(degree: int, t: Floats) -> Floats:
    return np.stack([comb(degree, i) * t**i * (1 - t) ** (degree - i) for i in range(degree + 1)], axis=1)


@given(size=st.integers(1, 5), derivatives=st.integers(0, 2), seed=st.integers(0, 1000))
def test_patches_of_any_number_of_components(size: int, derivatives: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    coefficients, uv = rng.uniform(-1, 1, (3, 16, size)), rng.random((9, 2))
    patches = rng.integers(3, size=9, dtype=np.int32)
    x = limit.evaluate_patches(patches, uv, coefficients, derivatives)
    points = coefficients[patches].reshape(9, 4, 4, size)
    for row, (du, dv) in enumerate(ORDERS[: (1, 3, 6)[derivatives]]):
        # Derivatives of Bernstein polynomials: differences of coefficients, one degree less each.
        expected, degree = points, [3, 3]
        for axis, order in ((2, du), (1, dv)):
            for _ in range(order):
                expected = degree[2 - axis] * np.diff(expected, axis=axis)
                degree[2 - axis] -= 1
        along_u, along_v = (bernstein(d, t) for d, t in zip(degree, uv.T, strict=True))
        np.testing.assert_allclose(
            x[row], np.einsum("nj,ni,njic->nc", along_v, along_u, expected), rtol=0, atol=10 * EXACT
        )


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        (([0], [(0.5, 0.5)], 3), ValueError, "derivatives is 3; expected .* 0, 1 or 2"),
        (([0.0], [(0.5, 0.5)]), TypeError, "must be integers, got float64"),
        (([0], [(0.5, 0.5)], 1, [0.5]), TypeError, "must be integers, got .* float64"),
        (([0, 9], [(0.5, 0.5)] * 2), ValueError, "point 1 is on face 9; the mesh has faces 0 to 4"),
        (([-1], [(0.5, 0.5)]), ValueError, "point 0 is on face -1"),
        (
            ([0, 1], [(0.5, 0.5)] * 2),
            ValueError,
            "point 1 is on face 1 with 3 corners and names corner -1; .* from 0 to 2",
        ),
        (([1], [(0.5, 0.5)], 1, [3]), ValueError, "point 0 is on face 1 with 3 corners and names corner 3"),
        (([0], [(0.5, 1.5)]), ValueError, r"point 0 has coordinates \[0.5 1.5\]; both must lie in \[0, 1\]"),
        (([0], [(0.5, np.nan)]), ValueError, "point 0 has coordinates"),
        (([0], [(0.5, 0.5, 0.0)]), ValueError, r"uv must have shape \(1, 2\)"),
        (([0, 0], [(0.5, 0.5)]), ValueError, r"uv must have shape \(2, 2\)"),
    ],
)
def test_wrong_arguments_are_refused(
    arguments: tuple[npt.ArrayLike, ...], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        limit.evaluate(pyramid(), *arguments)  # type: ignore[arg-type]  # what is tested


def test_semi_sharp_creases_are_refused() -> None:
    mesh = grid(2, 1)
    crease = ControlMesh(mesh.vertices, mesh.quads, creases={(1, 4): 2.0})
    with pytest.raises(NotImplementedError, match=r"1 creases inside the surface .* crease at edge \(1, 4\)"):
        limit.evaluate(crease, [0], [(0.5, 0.5)])
