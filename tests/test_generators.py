"""Counts, symmetry, orientation and shape of the meshes; and that their limits do not fold."""

import math
from collections import Counter
from collections.abc import Callable
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ranks import ranks
from scipy.spatial import KDTree

from thccs_fem import generators, limit, subdivision
from thccs_fem.mesh import ControlMesh

Floats = npt.NDArray[np.float64]


def lattice_surface(*slices: list[str], **arguments: Any) -> ControlMesh:
    """Surface of unit cubes, one a "#": slices along x of rows along y of columns along z."""
    inside = np.array([[list(row) for row in rows] for rows in slices]) == "#"
    values = np.pad(np.where(inside, 1.0, -1.0), 1, constant_values=-1.0)
    upper = np.array(values.shape) - 1.0
    return generators.implicit_surface(lambda x: values.ravel(), values.shape, np.zeros(3), upper, **arguments)


CLOSED = {
    "torus": generators.torus((5, 3)),
    "cube": generators.cube_sphere(1),
    "cube_sphere": generators.cube_sphere(4),
    "trapezohedron": generators.trapezohedron(7, 2),
    "genus3_base": generators.genus3(levels=0),
    "genus3": generators.genus3(),
    "cubes": lattice_surface(["##", "#."], ["..", "#."]),
}
L_DOMAINS = {
    "l_domain_coarse": generators.l_domain(1),
    "l_domain": generators.l_domain(),
    "l_domain1": generators.l_domain1(),
    "l_domain2": generators.l_domain2(),
}
PLANAR = {
    "rectangle": generators.rectangle((3, 2), (-1, 0), (2, 5)),
    **{f"disc{n}": generators.disc(n) for n in (1, 2, 5)},
    **{f"wheel{valence}": generators.wheel(valence, 2) for valence in range(3, 13)},
    **L_DOMAINS,
}


def on(meshes: dict[str, ControlMesh]) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("mesh", meshes.values(), ids=meshes.keys())


def corner_sines(vertices: Floats, quads: npt.NDArray[np.int32]) -> Floats:
    """Sine of the angle at each corner of planar quads, negative where it is turned over."""
    edges = np.roll(vertices[quads], -1, axis=1) - vertices[quads]
    edges /= np.linalg.norm(edges, axis=2, keepdims=True)
    before = np.roll(edges, 1, axis=1)
    return before[..., 0] * edges[..., 1] - before[..., 1] * edges[..., 0]


def volume(mesh: ControlMesh) -> float:
    """Volume inside the quads, each a bilinear surface; positive if normals are outward."""
    a, b, c, d = mesh.vertices[mesh.quads].swapaxes(0, 1)
    # Exact: the mean of both ways to cut each quad into triangles.
    triangles = [(a, b, c), (a, c, d), (a, b, d), (b, c, d)]
    return float(sum(np.einsum("fi,fi->", p, np.cross(q, r)) for p, q, r in triangles) / 12)


def areas(mesh: ControlMesh) -> Floats:
    in_space = np.pad(mesh.vertices, ((0, 0), (0, 3 - mesh.gdim)))
    a, b, c, d = in_space[mesh.quads].swapaxes(0, 1)
    return np.linalg.norm(np.cross(c - a, d - b), axis=1) / 2


def valences(mesh: ControlMesh) -> dict[int, int]:
    return Counter(mesh.extraordinary_vertices.values())


def same_points(one: npt.ArrayLike, other: npt.ArrayLike) -> bool:
    """Whether two lists of points, in any order and multiplicity, are the same set."""
    a, b = np.asarray(one, dtype=float), np.asarray(other, dtype=float)
    far = max(KDTree(a).query(b)[0].max(), KDTree(b).query(a)[0].max())
    return bool(far < 1e-12)  # coordinates are sums of a few numbers below 10


# Closed surfaces


@pytest.mark.parametrize(
    ("name", "counts", "extraordinary"),
    [
        ("torus", (15, 15, 1), {}),
        ("cube", (8, 6, 0), {3: 8}),
        ("cube_sphere", (98, 96, 0), {3: 8}),
        ("trapezohedron", (58, 56, 0), {3: 14, 7: 2}),
        ("genus3_base", (44, 48, 3), {8: 4}),
        ("genus3", (3068, 3072, 3), {8: 4}),
        ("cubes", (20, 18, 0), {3: 12, 5: 2, 6: 1}),
    ],
)
def test_closed_counts(name: str, counts: tuple[int, ...], extraordinary: dict[int, int]) -> None:
    mesh = CLOSED[name]
    assert (mesh.num_vertices, mesh.num_faces, mesh.genus) == counts
    assert (mesh.num_components, mesh.boundary_loops) == (1, ())
    assert valences(mesh) == extraordinary
    assert set(mesh.valences) <= {3, 4, *extraordinary}


@on(CLOSED)
def test_closed_normals_are_outward(mesh: ControlMesh) -> None:
    assert volume(mesh) > 0


def test_torus_is_a_torus_numbered_row_by_row() -> None:
    mesh = generators.torus((40, 30), R=3.0, r=0.5)
    x, y, z = mesh.vertices.T
    np.testing.assert_allclose(np.hypot(np.hypot(x, y) - 3.0, z), 0.5, atol=1e-14)
    # Second order in the number of faces: (2 pi / 30)^2 = 0.04.
    assert volume(mesh) == pytest.approx(2 * math.pi**2 * 3.0 * 0.5**2, rel=0.02)
    assert mesh.quads[0].tolist() == [0, 30, 31, 1]
    # All neighbours but those across the ends of a row or of the whole are at most a row away.
    assert np.mean(np.ptp(mesh.quads, axis=1) <= 31) > 0.9


def test_cube_sphere_is_equiangular() -> None:
    mesh = generators.cube_sphere(6)
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 1.0, rtol=1e-15)
    middle = mesh.vertices[(abs(mesh.vertices[:, 2]) < 1e-12) & (mesh.vertices[:, 0] > 0.7)]
    angles = np.sort(np.arctan2(middle[:, 1], middle[:, 0]))
    np.testing.assert_allclose(np.diff(angles), math.pi / 12, rtol=1e-12)
    assert same_points(mesh.vertices, mesh.vertices[:, [1, 2, 0]])
    assert areas(mesh).min() > 0.6 * areas(mesh).max()


@pytest.mark.parametrize("valence", [3, 4, 12])
def test_trapezohedron_has_two_poles(valence: int) -> None:
    mesh = generators.trapezohedron(valence, 3)
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 1.0, rtol=1e-15)
    np.testing.assert_allclose(mesh.vertices[[0, 16]], [[0, 0, 1], [0, 0, -1]])
    assert mesh.valences[[0, 16]].tolist() == [valence, valence]
    turn = np.exp(1j * np.pi / valence)  # and over: so one pole goes to the other
    x, y, z = mesh.vertices.T
    turned = (x + 1j * y) * turn
    assert same_points(mesh.vertices, np.column_stack([turned.real, turned.imag, -z]))


def test_trapezohedron_of_valence_3_is_the_cube() -> None:
    cube, other = generators.cube_sphere(1), generators.trapezohedron(3, 1)
    gram = [np.sort((mesh.vertices @ mesh.vertices.T).round(12), axis=1) for mesh in (cube, other)]
    np.testing.assert_allclose(*gram, atol=1e-11)


# Implicit surfaces


def ball(n: int, **arguments: Any) -> ControlMesh:
    return generators.implicit_surface(lambda x: 0.64 - (x**2).sum(axis=0), (n, n, n), **arguments)


@pytest.mark.parametrize("n", [10, 20, 40])
def test_implicit_surface_approximates_and_is_as_symmetric_as_its_function(n: int) -> None:
    mesh, h = ball(n), 2 / (n - 1)
    radius = np.linalg.norm(mesh.vertices, axis=1)
    assert radius.max() < 0.8  # a mean of points that are interpolated linearly: both lie inside of what is convex
    # Points of a cell are within sqrt(3) h / 2 of their mean, which lies (3 h^2 / 4) / (2 r) under the sphere at most;
    # linear interpolation of f has an error of h^2 / 4, of a position that over the slope 2 r.
    assert radius.min() > 0.8 - h**2 / (2 * 0.8)
    assert same_points(mesh.vertices, mesh.vertices[:, [1, 2, 0]] * [1, -1, 1])
    assert volume(mesh) == pytest.approx(4 / 3 * math.pi * 0.8**3, rel=3 * h**2)


def test_implicit_surface_has_hundreds_of_extraordinary_vertices_and_invalid_faces() -> None:
    mesh = ball(20)
    assert 0.3 < len(mesh.extraordinary_vertices) / mesh.num_vertices < 0.6
    assert 0.5 < mesh.num_invalid_faces / mesh.num_faces
    assert set(valences(mesh)) == {3, 5, 6}
    assert mesh.genus == 0


def test_implicit_surface_of_a_box_is_a_cube_with_eight_extraordinary_vertices() -> None:
    def box(x: Floats) -> Floats:
        return 0.5 - abs(x).max(axis=0)

    mesh = generators.implicit_surface(box, (9, 13, 17))
    assert valences(mesh) == {3: 8}
    # Positive are |x| < 0.5: 3, 5 and 7 points, at whose middles faces lie; f is linear across the sides.
    assert mesh.num_faces == 2 * (3 * 5 + 3 * 7 + 5 * 7)
    smooth = mesh.valences[mesh.quads].min(axis=1) == 4
    inner = np.abs(mesh.vertices).max(axis=1)[np.unique(mesh.quads[smooth])]
    np.testing.assert_allclose(inner.max(), 0.5, rtol=1e-14)


def test_implicit_surface_finds_genus_and_components() -> None:
    def tori(x: Floats) -> Floats:
        return 0.1 - np.hypot(np.hypot(abs(x[0]) - 1.0, x[1]) - 0.5, x[2])

    mesh = generators.implicit_surface(tori, (70, 41, 10), (-2, -1, -0.2), (2, 1, 0.2))
    assert (mesh.num_components, mesh.genus) == (2, 2)


def test_cubes_that_meet_in_an_edge_or_a_corner_only_are_joined() -> None:
    for slices in (
        (["##", "#."],),  # in a face: nothing is added
        (["#.", ".#"],),  # in an edge
        (["#.", ".."], ["..", ".#"]),  # in a corner
        (["##", "##"], ["#.", "##"], ["##", "##"]),
        (["..", "##"], [".#", "##"], ["##", "##"]),
        ([".#", "##"], ["##", "#."]),  # all but the ends of a diagonal
    ):
        mesh = lattice_surface(*slices)
        assert (mesh.num_components, mesh.genus) == (1, 0)
    assert lattice_surface(["#.", ".#"]).num_faces == lattice_surface(["##", "##"]).num_faces
    assert lattice_surface(["#.", ".."], ["..", ".#"]).num_faces == 24
    assert lattice_surface(["##", "#."]).num_faces == 14


@given(st.integers(0, 10_000), st.floats(0.1, 0.9))
def test_implicit_surface_is_manifold_whatever_the_signs(seed: int, share: float) -> None:
    inside = np.random.default_rng(seed).random((5, 4, 4)) < share
    slices = [["".join(".#"[point] for point in row) for row in rows] for rows in inside.astype(int)]
    if not inside.any():
        slices = [["#"]]
    mesh = lattice_surface(*slices)  # raises if an edge has not two faces or a vertex not one fan of them
    assert not mesh.boundary_edges.size
    assert set(mesh.valences) <= {3, 4, 5, 6}
    assert volume(mesh) > 0


def test_smoothing_rounds_off_and_keeps_the_volume() -> None:
    cube = ["#" * 8] * 8
    sharp, rounded = lattice_surface(*[cube] * 8), lattice_surface(*[cube] * 8, smoothing=80)
    np.testing.assert_array_equal(rounded.quads, sharp.quads)
    assert volume(rounded) == pytest.approx(volume(sharp), rel=0.05)
    reach_before, reach_after = (np.linalg.norm(mesh.vertices - 4.5, axis=1).max() for mesh in (sharp, rounded))
    assert reach_after < 0.95 * reach_before
    assert volume(ball(20, smoothing=20)) == pytest.approx(volume(ball(20)), rel=0.01)


# Genus 3


@pytest.mark.parametrize("levels", [0, 1, 3])
def test_genus3_is_symmetric(levels: int) -> None:
    mesh = generators.genus3(levels)
    assert mesh.num_faces == 48 * 4**levels
    for signs in product([1, -1], repeat=3):
        assert same_points(mesh.vertices * signs, mesh.vertices)


def test_genus3_extraordinary_vertices_are_above_and_below_the_bridges() -> None:
    mesh = generators.genus3()
    x, y, z = mesh.vertices[list(mesh.extraordinary_vertices)].T
    assert max(mesh.extraordinary_vertices) < 44
    np.testing.assert_allclose(y, 0.0, atol=1e-15)
    assert sorted(zip(np.sign(x), np.sign(z), strict=True)) == list(product([-1, 1], repeat=2))


def test_genus3_is_embedded() -> None:
    """The upper half is a graph over the plane, and the lower one its mirror image."""
    mesh = generators.genus3()
    upper = mesh.vertices[mesh.quads][..., 2].mean(axis=1) > 0
    assert np.count_nonzero(upper) == mesh.num_faces / 2
    used, faces = np.unique(mesh.quads[upper], return_inverse=True)
    half = ControlMesh(mesh.vertices[used][:, :2], faces)  # raises if any face is turned over
    loops = [half.vertices[loop] for loop in half.boundary_loops]
    # The rims of the graph are simple, disjoint curves, so that no sheet of it covers another.
    outside, *holes = sorted(loops, key=lambda loop: -np.ptp(loop[:, 0]))
    assert len(holes) == 3
    for hole in holes:
        a = hole - (hole.min(axis=0) + hole.max(axis=0)) / 2
        b = np.roll(a, -1, axis=0)
        assert (a[:, 0] * b[:, 1] < a[:, 1] * b[:, 0]).all()  # clockwise around its middle
    outside = np.roll(outside, -np.argmax(outside[:, 0]), axis=0)
    back = outside[outside[:, 1] > -1e-12]
    assert (np.diff(back[:, 0]) < 0).all()  # one y for each x; the front is its mirror image
    holes.sort(key=lambda hole: hole[:, 0].mean())
    ends = [x for hole in holes for x in (hole[:, 0].min(), hole[:, 0].max())]
    gaps = np.diff([outside[:, 0].min(), *ends, outside[:, 0].max()])
    assert gaps.min() > 0.5


def test_genus3_faces_are_of_similar_size() -> None:
    """Limited by the valence of 8: edges there shrink by 0.66 a step and not by 0.5."""
    sizes = areas(generators.genus3())
    assert sizes.min() > 0.12 * sizes.max()
    assert sizes.std() < 0.4 * sizes.mean()


def test_genus3_levels_are_subdivisions_of_one_another() -> None:
    coarse, fine = generators.genus3(2), generators.genus3(3)
    level = subdivision.control_level(coarse)
    step = subdivision.subdivide(level, np.ones(coarse.num_faces, dtype=bool))
    np.testing.assert_allclose(fine.vertices, step.matrix @ coarse.vertices, atol=1e-14)
    np.testing.assert_array_equal(fine.quads, step.fine.quads)
    np.testing.assert_array_equal(fine.face_tags, np.repeat(coarse.face_tags, 4))


@pytest.mark.parametrize("levels", [1, 2, 3])
def test_genus3_tagged_regions_are_mirrored_squares_at_the_ends(levels: int) -> None:
    mesh = generators.genus3(levels)
    assert Counter(mesh.face_tags.tolist()) == {
        0: (48 - 2) * 4**levels,
        1: 4**levels,
        2: 4**levels,
    }
    left, right = (np.unique(mesh.quads[mesh.face_tags == tag]) for tag in (1, 2))
    assert len(left) == (2**levels + 1) ** 2
    assert same_points(mesh.vertices[left] * [-1, 1, 1], mesh.vertices[right])
    assert mesh.vertices[left][:, 0].min() == mesh.vertices[:, 0].min()
    assert mesh.vertices[right][:, 0].min() > 4.0


def test_genus3_base_has_no_tags() -> None:
    assert not generators.genus3(levels=0).face_tags.any()


# Shells


SHELLS = {
    "cylinder": generators.cylinder((8, 3), R=2.0, length=5.0),
    "strip": generators.cylinder((6, 3), R=2.0, length=5.0, angle=1.5, rim=0.5),
    "zone": generators.spherical_zone((9, 4), R=2.0),
    "graded zone": generators.spherical_zone((9, 4), R=2.0, polar=(0.5, 2.5), rim=0.3),
    "hemisphere": generators.hemisphere(3, R=2.0),
}


@pytest.mark.parametrize(
    ("name", "counts", "extraordinary"),
    [
        ("cylinder", (32, 24, 2), {}),
        ("strip", (28, 18, 1), {}),
        ("zone", (45, 36, 2), {}),
        ("graded zone", (45, 36, 2), {}),
        ("hemisphere", (121, 108, 1), {3: 4}),
    ],
)
def test_shell_counts(name: str, counts: tuple[int, ...], extraordinary: dict[int, int]) -> None:
    mesh = SHELLS[name]
    assert (mesh.num_vertices, mesh.num_faces, len(mesh.boundary_loops)) == counts
    assert valences(mesh) == extraordinary


@pytest.mark.parametrize("name", SHELLS)
def test_shell_normals_are_outward(name: str) -> None:
    mesh = SHELLS[name]
    a, b, c, d = mesh.vertices[mesh.quads].swapaxes(0, 1)
    outward = (a + b + c + d) * ([1, 1, 0] if name in ("cylinder", "strip") else [1, 1, 1])
    assert (np.einsum("fi,fi->f", np.cross(c - a, d - b), outward) > 0).all()


def test_cylinder_is_a_cylinder_numbered_row_by_row() -> None:
    strip = SHELLS["strip"]
    x, y, z = strip.vertices.reshape(4, 7, 3).T
    np.testing.assert_allclose(np.hypot(x, y), 2.0, rtol=1e-14)
    np.testing.assert_allclose(z, np.broadcast_to(np.linspace(-2.5, 2.5, 4), (7, 4)), atol=1e-14)
    angle = np.arctan2(y, x)[:, 0]
    np.testing.assert_allclose(angle[[0, 3, 6]], [-0.75, 0.0, 0.75], atol=1e-14)
    assert (np.diff(angle, 2)[:2] > 0.0).all()  # narrow faces at the straight edges, wide ones in the middle
    closed = SHELLS["cylinder"].vertices.reshape(4, 8, 3)
    np.testing.assert_allclose(closed[0, [0, 4]], [[-2.0, 0.0, -2.5], [2.0, 0.0, -2.5]], atol=1e-14)


@pytest.mark.parametrize("rim", [0.1, 0.5, 1.0])
def test_rim_is_the_width_there_compared_to_equal_faces(rim: float) -> None:
    n = 400
    strip = generators.cylinder((n, 1), angle=1.0, rim=rim)
    x, y, _ = strip.vertices[: n + 1].T
    widths = np.diff(np.arctan2(y, x))
    np.testing.assert_allclose(widths, widths[::-1], atol=1e-14)
    assert widths[0] * n == pytest.approx(rim, abs=1e-4)  # 10 (1 - rim) / n^2 more
    assert widths[0] == widths.min() or rim == 1.0


def test_spherical_zone_is_between_two_circles() -> None:
    for name, circles in (("zone", (math.pi / 10, math.pi / 2)), ("graded zone", (0.5, 2.5))):
        vertices = SHELLS[name].vertices
        np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 2.0, rtol=1e-14)
        polar = np.arccos(vertices[:, 2] / 2.0).reshape(5, 9)
        np.testing.assert_allclose(polar[[-1, 0], 0], circles, rtol=1e-14)
        np.testing.assert_allclose(vertices[::9, 1], 0.0, atol=1e-14)


def test_hemisphere_is_symmetric_with_an_even_rim() -> None:
    mesh = SHELLS["hemisphere"]
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 2.0, rtol=1e-14)
    for mirrored in ([-1, 1, 1], [1, -1, 1]):
        assert same_points(mesh.vertices, mesh.vertices * mirrored)
    assert same_points(mesh.vertices, mesh.vertices[:, [1, 0, 2]])
    x, y, z = mesh.vertices[mesh.boundary_vertices].T
    np.testing.assert_allclose(z, 0.0, atol=1e-14)
    np.testing.assert_allclose(np.diff(np.sort(np.arctan2(y, x))), 2.0 * math.pi / 24, rtol=1e-12)
    assert areas(mesh).max() < 2.5 * areas(mesh).min()


# Limits that pass through the vertices


def at_corners(mesh: ControlMesh) -> Floats:
    """Limit points of the corners of all faces, shape (num_faces, 4, 3)."""
    uv = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    faces = np.repeat(np.arange(mesh.num_faces), 4)
    return limit.evaluate(mesh, faces, np.tile(uv, (mesh.num_faces, 1)), derivatives=0)[0].reshape(-1, 4, mesh.gdim)


@on({**SHELLS, **CLOSED, **PLANAR})
def test_interpolated_limits_pass_through_the_vertices(mesh: ControlMesh) -> None:
    moved = generators.interpolated(mesh)
    np.testing.assert_allclose(at_corners(moved), mesh.vertices[mesh.quads], atol=1e-11)  # condition number up to 1e2


@pytest.mark.parametrize(
    ("make", "distance", "order"),
    [
        (lambda n: generators.cylinder((4 * n, n)), lambda x: np.hypot(x[:, 0], x[:, 1]) - 1.0, 4),
        (lambda n: generators.torus((4 * n, 2 * n)), lambda x: np.hypot(np.hypot(*x.T[:2]) - 2.0, x[:, 2]) - 1.0, 4),
        (lambda n: generators.spherical_zone((4 * n, n)), lambda x: np.linalg.norm(x, axis=1) - 1.0, 2),
        (lambda n: generators.hemisphere(n), lambda x: np.linalg.norm(x, axis=1) - 1.0, 2),
    ],
    ids=["cylinder", "torus", "zone", "hemisphere"],
)
def test_interpolated_limits_are_near_the_surface(
    make: Callable[[int], ControlMesh], distance: Callable[[Floats], Floats], order: int
) -> None:
    errors = []
    for n in (4, 8, 16):
        mesh = generators.interpolated(make(n))
        uv = np.random.default_rng(0).random((20 * mesh.num_faces, 2))
        x = limit.evaluate(mesh, np.repeat(np.arange(mesh.num_faces), 20), uv, derivatives=0)[0]
        errors.append(np.abs(distance(x)).max())
    slopes = np.log2(np.divide(errors[:-1], errors[1:]))
    assert ((slopes > order - 0.3) & (slopes < order + 0.4)).all(), slopes


def test_interpolated_meshes_keep_what_is_tagged() -> None:
    plain = generators.l_domain(2)
    given = ControlMesh(
        plain.vertices, plain.quads, [3] * 12, {(0, 1): 5}, corners=dict(plain.corners), comm=ranks(1)[0]
    )
    moved = generators.interpolated(given)
    assert moved.face_tags.tolist() == given.face_tags.tolist()
    assert (dict(moved.edge_tags), dict(moved.corners), moved.comm) == (
        dict(given.edge_tags),
        dict(given.corners),
        given.comm,
    )
    triangle = ControlMesh([(0, 0), (1, 0), (0, 1)], [(0, 1, 2)])
    with pytest.raises(ValueError, match="not all quads"):
        generators.interpolated(triangle)


def test_fitted_limits_lie_on_the_surface() -> None:
    """Near a vertex of valence 8 to the second order of the size of its rings, the subdominant eigenvalue's powers."""
    distances = []
    for times in (3, 4):
        given = subdivision.subdivided(generators.trapezohedron(8, 1), times)
        mesh = generators.fitted(given, lambda x: 2.0 * x / np.linalg.norm(x, axis=0))
        np.testing.assert_allclose(np.linalg.norm(at_corners(mesh), axis=2), 2.0, atol=1e-11)
        uv = np.random.default_rng(0).random((20 * mesh.num_faces, 2))
        x = limit.evaluate(mesh, np.repeat(np.arange(mesh.num_faces), 20), uv, derivatives=0)[0]
        distances.append(np.abs(np.linalg.norm(x, axis=1) - 2.0).max())
    assert np.log2(distances[0] / distances[1]) == pytest.approx(2 * 0.713, abs=0.1)  # log2(1 / 0.610)


def test_fitted_meshes_need_a_point_for_each_vertex() -> None:
    mesh = generators.cube_sphere(2)
    with pytest.raises(ValueError, match=r"shape \(26,\) for points of shape \(3, 26\)"):
        generators.fitted(mesh, lambda x: x[0])
    with pytest.raises(ValueError, match="all of them finite"):
        generators.fitted(mesh, lambda x: x * np.nan)


# Planar domains


@pytest.mark.parametrize(
    ("name", "counts", "extraordinary"),
    [
        ("rectangle", (12, 6, 10), {}),
        ("disc1", (8, 5, 4), {3: 4}),
        ("disc2", (25, 20, 8), {3: 4}),
        ("disc5", (136, 125, 20), {3: 4}),
        ("wheel3", (19, 12, 12), {3: 1}),
        ("wheel4", (25, 16, 16), {}),
        ("wheel12", (73, 48, 48), {12: 1}),
        ("l_domain_coarse", (8, 3, 8), {}),
        ("l_domain", (65, 48, 32), {}),
        ("l_domain1", (153, 128, 48), {}),
        ("l_domain2", (221, 192, 56), {3: 2, 5: 2}),
    ],
)
def test_planar_counts(name: str, counts: tuple[int, ...], extraordinary: dict[int, int]) -> None:
    mesh = PLANAR[name]
    assert (mesh.num_vertices, mesh.num_faces, len(mesh.boundary_edges)) == counts
    assert (mesh.euler_characteristic, len(mesh.boundary_loops)) == (1, 1)
    assert valences(mesh) == extraordinary


@on(PLANAR)
def test_planar_faces_are_convex_on_all_levels(mesh: ControlMesh) -> None:
    level, vertices = subdivision.control_level(mesh), mesh.vertices
    for _ in range(4):
        assert corner_sines(vertices, level.quads).min() > 0.4
        step = subdivision.subdivide(level, np.ones(level.num_faces, dtype=bool))
        level, vertices = step.fine, step.matrix @ vertices


@given(st.integers(1, 6), st.integers(1, 6))
def test_rectangle_has_equal_faces(n: int, m: int) -> None:
    mesh = generators.rectangle((n, m), lower=(-1.0, 2.0), upper=(3.0, 3.0))
    assert (mesh.num_vertices, mesh.num_faces) == ((n + 1) * (m + 1), n * m)
    np.testing.assert_allclose(areas(mesh), 4.0 / (n * m), rtol=1e-12)
    assert mesh.quads[0].tolist() == [0, 1, n + 2, n + 1]
    np.testing.assert_allclose(mesh.vertices[1], [-1 + 4 / n, 2.0], rtol=1e-14, atol=1e-15)


def test_rectangle_far_from_the_origin_keeps_its_vertices() -> None:
    assert generators.rectangle((10, 1), (1e9, 1e9), (1e9 + 1, 1e9 + 1)).num_vertices == 22


@pytest.mark.parametrize("n", [1, 2, 3, 8])
def test_disc_rim_is_smooth_and_its_limit_is_on_the_unit_circle(n: int) -> None:
    mesh = generators.disc(n)
    (rim,) = mesh.boundary_loops
    assert (mesh.vertex_num_faces[rim] == 2).all()
    p = mesh.vertices[rim]
    limit = (np.roll(p, 1, axis=0) + 4 * p + np.roll(p, -1, axis=0)) / 6
    np.testing.assert_allclose(np.linalg.norm(limit, axis=1), 1.0, rtol=1e-14)
    angles = np.unwrap(np.arctan2(p[:, 1], p[:, 0]))
    np.testing.assert_allclose(np.diff(angles), math.pi / (2 * n), rtol=1e-12)
    assert same_points(mesh.vertices[:, ::-1] * [-1, 1], mesh.vertices)  # a quarter turn
    assert not mesh.corners


@given(st.integers(3, 12), st.integers(1, 4))
def test_wheel_is_a_regular_polygon_around_one_vertex(valence: int, n: int) -> None:
    mesh = generators.wheel(valence, n)
    assert mesh.vertices[0].tolist() == [0.0, 0.0]
    assert mesh.valences[0] == valence
    assert mesh.extraordinary_vertices == ({} if valence == 4 else {0: valence})
    assert mesh.num_faces == valence * n**2
    corners = np.flatnonzero(mesh.vertex_num_faces == 1)
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices[corners], axis=1), 1.0, rtol=1e-14)
    exact = valence / 2 * math.sin(2 * math.pi / valence)
    assert areas(mesh).sum() == pytest.approx(exact, rel=1e-13)


# L-domains


@on(L_DOMAINS)
def test_l_domain_fills_three_quadrants(mesh: ControlMesh) -> None:
    assert areas(mesh).sum() == pytest.approx(3.0, rel=1e-13)
    assert same_points(mesh.vertices, mesh.vertices[:, ::-1])
    x, y = mesh.vertices.T
    assert not ((x > 1e-12) & (y > 1e-12)).any()
    assert (x.min(), x.max(), y.min(), y.max()) == (-1, 1, -1, 1)


@on(L_DOMAINS)
def test_l_domain_corners_are_tagged(mesh: ControlMesh) -> None:
    corners = [(0, 0), (0, 1), (-1, 1), (-1, -1), (1, -1), (1, 0)]
    assert len(mesh.corners) == 6
    assert same_points(mesh.vertices[list(mesh.corners)], corners)
    assert set(mesh.corners.values()) == {math.inf}
    (reentrant,) = np.flatnonzero(~mesh.vertices.any(axis=1))
    assert mesh.vertex_num_faces[reentrant] == 3
    one_face = set(np.flatnonzero(mesh.vertex_num_faces == 1).tolist())
    assert one_face == set(mesh.corners) - {reentrant}


@on(L_DOMAINS)
def test_l_domain_zero_set_of_the_solution_is_at_the_reentrant_edges(mesh: ControlMesh) -> None:
    x, y = mesh.vertices[mesh.boundary_vertices].T
    theta = np.arctan2(y, x)
    theta = np.where(theta < math.pi / 2 - 1e-9, theta + 2 * math.pi, theta)
    u = np.hypot(x, y) ** (2 / 3) * np.sin(2 * theta / 3 - math.pi / 3)
    zero = ((x == 0) & (y >= 0)) | ((y == 0) & (x >= 0))
    assert np.count_nonzero(zero) >= 3
    np.testing.assert_allclose(u[zero], 0.0, atol=1e-15)
    assert (u[~zero] > 0.05).all()


@pytest.mark.parametrize(
    ("mesh", "side"),
    [
        (generators.l_domain(5), 1 / 5),
        (generators.l_domain1(), 1 / 8),
        (generators.l_domain2(), 1 / 14),
    ],
    ids=["l_domain", "l_domain1", "l_domain2"],
)
def test_l_domain_faces_at_the_corner_are_squares(mesh: ControlMesh, side: float) -> None:
    reentrant = np.flatnonzero(~mesh.vertices.any(axis=1))
    ring = mesh.vertices[mesh.quads[np.isin(mesh.quads, reentrant).any(axis=1)]]
    expected = [(i, j) for i, j in product([-1, 0, 1], repeat=2) if i <= 0 or j <= 0]
    assert same_points(ring.reshape(-1, 2) / side, expected)


def fan_sines(mesh: ControlMesh, depth: int) -> list[float]:
    """Least corner sine of the faces near the vertex at the origin, level by level."""
    (origin,) = np.flatnonzero(~mesh.vertices.any(axis=1))
    level, vertices, sines = subdivision.control_level(mesh), mesh.vertices, []
    for _ in range(depth):
        near = level.touching(level.control_vertex == origin)
        around = subdivision.neighbourhood(level, subdivision.neighbourhood(level, near))
        step = subdivision.subdivide(level, around)
        level, vertices = step.fine, step.matrix @ vertices
        inside = level.touching(level.control_vertex == origin)
        sines.append(float(corner_sines(vertices, level.quads[inside]).min()))
    return sines


@on(L_DOMAINS)
def test_l_domain_limit_does_not_fold_at_the_reentrant_corner(mesh: ControlMesh) -> None:
    assert min(fan_sines(mesh, depth=14)) > 0.7


def test_l_domain1_with_other_spacing_would_fold() -> None:
    """Why the columns widen: with widths of 1/8 and 1/4 the faces at the corner turn over."""
    mesh = generators.l_domain1()
    k = np.arange(-8, 5)
    lines = np.where(k < 0, k / 8, k * (k + 2) / 24)
    uniform = np.where(k < 0, k / 8, k / 4)
    stretched = np.interp(mesh.vertices, lines, uniform)
    sines = fan_sines(ControlMesh(stretched, mesh.quads, corners=mesh.corners), depth=14)
    assert sines[0] > 0.5
    assert min(sines) < 0


def test_l_domain2_rim_is_spaced_evenly_outside_and_grows_from_the_corner() -> None:
    mesh = generators.l_domain2()
    a, b = mesh.vertices[mesh.edges[mesh.boundary_edges]].swapaxes(0, 1)
    lengths = np.linalg.norm(b - a, axis=1)
    inner = ((abs(a) < 1e-12) & (abs(b) < 1e-12)).any(axis=1) & (np.maximum(a, b).max(axis=1) > 0)
    np.testing.assert_allclose(lengths[~inner], 1 / 7, rtol=1e-12)
    growing = np.repeat(np.arange(3, 10) / 42, 2)
    np.testing.assert_allclose(np.sort(lengths[inner]), growing, rtol=1e-12)


# Arguments

MAKERS: dict[str, Callable[..., ControlMesh]] = {
    "ball": lambda **comm: ball(10, smoothing=3, **comm),
    "torus": lambda **comm: generators.torus((4, 3), **comm),
    "cube_sphere": lambda **comm: generators.cube_sphere(1, **comm),
    "trapezohedron": lambda **comm: generators.trapezohedron(5, 1, **comm),
    "genus3": lambda **comm: generators.genus3(**comm),
    "genus3_base": lambda **comm: generators.genus3(0, **comm),
    "rectangle": lambda **comm: generators.rectangle((1, 1), **comm),
    "disc": lambda **comm: generators.disc(1, **comm),
    "wheel": lambda **comm: generators.wheel(3, 1, **comm),
    "l_domain": lambda **comm: generators.l_domain(1, **comm),
    "l_domain1": lambda **comm: generators.l_domain1(**comm),
    "l_domain2": lambda **comm: generators.l_domain2(**comm),
    "cylinder": lambda **comm: generators.cylinder((5, 2), **comm),
    "spherical_zone": lambda **comm: generators.spherical_zone((5, 2), **comm),
    "hemisphere": lambda **comm: generators.hemisphere(2, **comm),
}


@pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS.keys())
def test_communicator_is_handed_on(make: Callable[..., ControlMesh]) -> None:
    (comm,) = ranks(1)
    assert make(comm=comm).comm is comm
    assert make().comm is None


@pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS.keys())
def test_meshes_are_repeatable(make: Callable[..., ControlMesh]) -> None:
    one, other = make(), make()
    np.testing.assert_array_equal(one.vertices, other.vertices)
    np.testing.assert_array_equal(one.quads, other.quads)


@pytest.mark.parametrize(
    ("call", "error", "match"),
    [
        (lambda make: make.torus(5), TypeError, r"shape is 5: expected two integers"),
        (lambda make: make.torus((5, 4, 3)), TypeError, r"expected two integers \(n, m\)"),
        (lambda make: make.torus((5, 4.0)), TypeError, r"shape\[1\] is 4.0: expected an integer"),
        (lambda make: make.torus((2, 4)), ValueError, r"shape\[0\] is 2: expected 3 or more"),
        (lambda make: make.torus((5, 4), R=1.0), ValueError, r"R = 1.0 and r = 1.0: expected 0 <"),
        (lambda make: make.torus((5, 4), r=-1.0), ValueError, r"expected 0 < r < R"),
        (lambda make: make.torus((5, 4), R=math.inf), ValueError, r"both finite"),
        (lambda make: make.cube_sphere(0), ValueError, r"n is 0: expected 1 or more"),
        (lambda make: make.trapezohedron(2, 1), ValueError, r"valence is 2: expected 3 or more"),
        (lambda make: make.trapezohedron(5, 1.5), TypeError, r"n is 1.5: expected an integer"),
        (lambda make: make.genus3(-1), ValueError, r"levels is -1: expected 0 or more"),
        (lambda make: make.genus3(True), TypeError, r"levels is True: expected an integer"),
        (lambda make: make.rectangle((0, 1)), ValueError, r"shape\[0\] is 0: expected 1 or more"),
        (lambda make: make.rectangle((1, 1), (0, 0), (1, 0)), ValueError, r"lower less than"),
        (lambda make: make.rectangle((1, 1), (0, 0, 0)), ValueError, r"two finite coordinates"),
        (lambda make: make.rectangle((1, 1), (0, math.nan)), ValueError, r"two finite coord"),
        (lambda make: make.implicit_surface(abs, (3, 3)), TypeError, r"expected three integers \(n, m, k\)"),
        (lambda make: make.implicit_surface(abs, (3, 2, 3)), ValueError, r"shape\[1\] is 2: expected 3 or more"),
        (lambda make: make.implicit_surface(abs, (3, 3, 3), (0, 0)), ValueError, r"three finite coordinates"),
        (lambda make: make.implicit_surface(abs, (3, 3, 3), smoothing=-1), ValueError, r"smoothing is -1"),
        (lambda make: make.implicit_surface(lambda x: x[0], (3, 3, 3)), ValueError, r"positive on the sides"),
        (lambda make: make.implicit_surface(lambda x: -(x[0] ** 2), (3, 3, 3)), ValueError, r"positive at no point"),
        (lambda make: make.implicit_surface(lambda x: x[0] * np.nan, (3, 3, 3)), ValueError, r"27 values that are not"),
        (lambda make: make.implicit_surface(lambda x: x, (3, 3, 3)), ValueError, r"f returned 81 values for 27 points"),
        (lambda make: make.cylinder((0, 1), angle=1.0), ValueError, r"shape\[0\] is 0: expected 1 or more"),
        (lambda make: make.cylinder((2, 1)), ValueError, r"shape\[0\] of a closed cylinder is 2: expected 3 or more"),
        (lambda make: make.cylinder((4, 1), R=0.0), ValueError, r"R = 0.0, length = 1.0 and angle"),
        (lambda make: make.cylinder((4, 1), angle=6.3), ValueError, r"an angle of at most 2 pi"),
        (lambda make: make.cylinder((4, 1), rim=0.5), ValueError, r"closed cylinder has no straight edges"),
        (lambda make: make.cylinder((4, 1), angle=1.0, rim=0.0), ValueError, r"rim is 0.0: expected a share above 0"),
        (lambda make: make.spherical_zone((2, 1)), ValueError, r"shape\[0\] is 2: expected 3 or more"),
        (lambda make: make.spherical_zone((4, 1), polar=(1.0, 0.5)), ValueError, r"0 < upper < lower < pi"),
        (lambda make: make.spherical_zone((4, 1), rim=1.5), ValueError, r"rim is 1.5"),
        (lambda make: make.hemisphere(0), ValueError, r"n is 0: expected 1 or more"),
        (lambda make: make.hemisphere(2, R=-1.0), ValueError, r"the radius is -1.0"),
        (lambda make: make.disc("3"), TypeError, r"n is '3': expected an integer"),
        (lambda make: make.wheel(2, 3), ValueError, r"valence is 2: expected 3 or more"),
        (lambda make: make.wheel(5, 0), ValueError, r"n is 0: expected 1 or more"),
        (lambda make: make.l_domain(0), ValueError, r"n is 0: expected 1 or more"),
    ],
)
def test_wrong_arguments_are_named(call: Any, error: type[Exception], match: str) -> None:
    with pytest.raises(error, match=match):
        call(generators)


def test_numpy_integers_are_counts() -> None:
    make: Any = generators
    assert make.rectangle(np.array([2, 3])).num_faces == 6
    assert make.disc(np.int32(2)).num_faces == 20
