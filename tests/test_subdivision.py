"""Catmull-Clark steps on whole levels and on parts: topology, the matrix S, and coordinates in children."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from exact import ExactMesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import KDTree
from zoo import ZOO, grid, half_disc, l_domain, polycube, prism

from thccs_fem import io
from thccs_fem.mesh import ControlMesh
from thccs_fem.positions import CHILD_AXES, CHILD_ORIGIN
from thccs_fem.subdivision import FAR, Level, Step, control_level, neighbourhood, subdivide

Bools = npt.NDArray[np.bool_]
Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]

Builder = Callable[[], ControlMesh]
MESHES = [pytest.param(build, id=name) for name, build in ZOO.items()]


def everything(level: Level) -> Bools:
    return np.ones(level.num_faces, dtype=bool)


def whole_levels(mesh: ControlMesh, number: int) -> list[Level]:
    levels = [control_level(mesh)]
    while len(levels) < number:
        levels.append(subdivide(levels[-1], everything(levels[-1])).fine)
    return levels


@pytest.mark.parametrize("build", MESHES)
def test_two_steps_are_those_of_rational_arithmetic(build: Builder) -> None:
    mesh = build()
    level, x, exact = control_level(mesh), mesh.vertices, ExactMesh.of(mesh)
    for _ in range(2):
        step, exact = subdivide(level, everything(level)), exact.subdivided()
        level, x = step.fine, step.matrix @ x
        assert level.quads.tolist() == exact.faces
        np.testing.assert_allclose(x, exact.points.astype(float), rtol=0, atol=1e-14)  # sums of points below 10
        np.testing.assert_array_equal(level.vertex_num_faces, [len(faces) for faces in exact.faces_at])
        np.testing.assert_array_equal(level.boundary, [bool(rim) for rim in exact.rim_neighbours])
        np.testing.assert_array_equal(level.corner, [exact.is_corner(v) for v in range(len(x))])
        assert level.complete.all()


@pytest.mark.parametrize("build", MESHES)
def test_rows_are_means(build: Builder) -> None:
    level = control_level(build())
    for _ in range(2):
        step = subdivide(level, everything(level))
        np.testing.assert_allclose(step.matrix.sum(axis=1), 1.0, rtol=0, atol=1e-14)  # up to 129 terms at the pole
        assert step.matrix.data.min() >= 0.0
        level = step.fine


@pytest.mark.parametrize("build", MESHES)
def test_old_vertices_then_edge_points_then_face_points(build: Builder) -> None:
    mesh = build()
    level = control_level(mesh)
    step = subdivide(level, everything(level))
    fine = step.fine
    v, e = mesh.num_vertices, mesh.num_edges
    np.testing.assert_array_equal(step.old, np.arange(v))
    assert step.edges.size == e
    assert fine.num_vertices == v + e + mesh.num_faces
    np.testing.assert_array_equal(step.first_child, mesh.face_offsets[:-1])
    np.testing.assert_array_equal(fine.quads[:, 0], mesh.face_vertices)
    np.testing.assert_array_equal(fine.quads[:, 2], v + e + level.face)
    np.testing.assert_array_equal(fine.quads[:, 3], fine.quads[level.previous, 1])
    # An edge point is met by both half-edges of its edge and stands for one of them.
    np.testing.assert_array_equal(fine.quads[step.edges, 1], v + np.arange(e))
    inner = level.twins >= 0
    np.testing.assert_array_equal(fine.quads[inner, 1], fine.quads[level.twins[inner], 1])
    np.testing.assert_array_equal(fine.control_vertex, [*range(v), *[-1] * (e + mesh.num_faces)])


@pytest.mark.parametrize("build", MESHES)
def test_half_edges_of_all_levels_fit(build: Builder) -> None:
    for level in whole_levels(build(), 3):
        start, end = level.vertices, level.vertices[level.following]
        directed = {(int(a), int(b)): h for h, (a, b) in enumerate(zip(start, end, strict=True))}
        assert len(directed) == start.size
        expected = [directed.get((b, a), -1) for a, b in directed]
        np.testing.assert_array_equal(level.twins, expected)
        np.testing.assert_array_equal(level.rim, level.twins < 0)
        np.testing.assert_array_equal(level.following[level.previous], np.arange(start.size))
        np.testing.assert_array_equal(level.face[level.following], level.face)
        assert (np.diff(level.keys) > 0).all()


@pytest.mark.parametrize("build", MESHES)
def test_boundary_edges_descend_from_those_of_the_control_mesh(build: Builder) -> None:
    mesh = build()
    level, x, exact = control_level(mesh), mesh.vertices, control_level(mesh)
    step = subdivide(level, everything(level))
    level, x = step.fine, step.matrix @ x
    for h in np.flatnonzero(level.rim):
        ancestor = level.boundary_edge[h]
        a, b = exact.vertices[ancestor], exact.vertices[exact.following[ancestor]]
        middle = step.old.size + np.flatnonzero(step.edges == ancestor)[0]
        ends = (level.vertices[h], level.vertices[level.following[h]])
        assert ends in ((a, middle), (middle, b))
    count = np.bincount(level.boundary_edge[level.rim], minlength=exact.vertices.size)
    np.testing.assert_array_equal(count, np.where(exact.rim, 2, 0))


@pytest.mark.parametrize("build", MESHES)
def test_rim_distances_up_to_one_are_right_on_every_level(build: Builder) -> None:
    for level in whole_levels(build(), 4):
        irregular = level.boundary & ~level.regular
        rim = np.flatnonzero(level.rim)
        a, b = level.vertices[rim], level.vertices[level.following[rim]]
        near = irregular.copy()
        near[a[irregular[b]]] = near[b[irregular[a]]] = True
        np.testing.assert_array_equal(level.rim_distance == 0, irregular)
        np.testing.assert_array_equal(level.rim_distance <= 1, near)
        assert (level.rim_distance[~level.boundary] == FAR).all()


def test_irregular_vertices_are_corner_0_of_their_faces_from_the_second_level_on() -> None:
    for mesh in (polycube([(0, 0, 0), (1, 0, 0), (0, 1, 0)]), prism(5), half_disc(5)):
        level = whole_levels(mesh, 3)[2]
        assert level.regular[level.quads[:, 1:]].all()


# Parts ----------------------------------------------------------------------------------------------------------------


def matching(part: Level, whole: Level) -> tuple[Ints, Ints]:
    """Return which vertices and which faces of the whole level those of a part are, by the keys of the faces."""
    faces = np.searchsorted(whole.keys, part.keys)
    np.testing.assert_array_equal(whole.keys[faces], part.keys)
    vertices = np.full(part.num_vertices, -1, dtype=np.int32)
    vertices[part.quads] = whole.quads[faces]
    np.testing.assert_array_equal(vertices[part.quads], whole.quads[faces])
    return vertices, faces.astype(np.int32)


def check_part(part: Level, whole: Level) -> Ints:
    """Check that a part has the flags and the topology of the whole level; return its vertices there."""
    vertices, faces = matching(part, whole)
    assert np.unique(vertices).size == part.num_vertices
    for name in ("vertex_num_faces", "boundary", "corner", "control_vertex", "rim_distance", "regular"):
        np.testing.assert_array_equal(getattr(part, name), getattr(whole, name)[vertices])
    half_edges = whole.half_edges(faces)
    np.testing.assert_array_equal(part.boundary_edge, whole.boundary_edge[half_edges])
    local = np.full(whole.vertices.size, -1)
    local[half_edges] = np.arange(half_edges.size)
    twins = whole.twins[half_edges]
    np.testing.assert_array_equal(part.twins, np.where(twins >= 0, local[twins], -1))
    return vertices


def check_rows(step: Step, whole: Step, columns: Ints) -> None:
    """Check that S of a part has the rows of the whole one at complete vertices; columns: coarse vertices there."""
    vertices, _ = matching(step.fine, whole.fine)
    complete = np.flatnonzero(step.fine.complete)
    rows = np.zeros((complete.size, whole.matrix.shape[1]))
    rows[:, columns] = step.matrix[complete].toarray()
    np.testing.assert_allclose(rows, whole.matrix[vertices[complete]].toarray(), rtol=0, atol=1e-15)
    np.testing.assert_allclose(step.matrix.sum(axis=1), 1.0, rtol=0, atol=1e-14)


def children(level: Level, step: Step, faces: Bools) -> Bools:
    half_edges = level.half_edges(np.flatnonzero(faces))
    face = level.face[half_edges]
    marked = np.zeros(step.fine.num_faces, dtype=bool)
    marked[step.first_child[face] + half_edges - level.offsets[face]] = True
    return marked


PARTS = ("grid", "torus", "wheel5", "split_face", "pillow", "tripod", "l_domain_tagged", "polygons", "pentagonal_prism")


@given(st.sampled_from(PARTS), st.integers(0, 10**6), st.floats(0.05, 0.6))
def test_parts_agree_with_the_whole_where_they_are_complete(name: str, seed: int, share: float) -> None:
    mesh = ZOO[name]()
    rng = np.random.default_rng(seed)
    whole, part, x, y = control_level(mesh), control_level(mesh), mesh.vertices, mesh.vertices
    in_whole = np.arange(whole.num_vertices, dtype=np.int32)
    marked = rng.random(part.num_faces) < share
    for _ in range(3):
        held = neighbourhood(part, marked)
        whole_step, step = subdivide(whole, everything(whole)), subdivide(part, held)
        np.testing.assert_array_equal(step.first_child >= 0, held)
        check_rows(step, whole_step, in_whole)
        marked = children(part, step, marked)
        whole, part, x, y = whole_step.fine, step.fine, whole_step.matrix @ x, step.matrix @ y
        in_whole = check_part(part, whole)
        # What the next steps and the Bernstein coefficients of the marked faces' children need is right.
        assert part.complete[part.corners_of(marked)].all()
        needed = part.corners_of(neighbourhood(part, marked))
        np.testing.assert_allclose(y[needed], x[in_whole[needed]], rtol=0, atol=1e-14)
        marked &= rng.random(part.num_faces) < share


@pytest.mark.parametrize("build", MESHES)
def test_faces_that_touch(build: Builder) -> None:
    level = control_level(build())
    faces = [set(part.tolist()) for part in np.split(level.vertices, level.offsets[1:-1])]
    for f in range(0, level.num_faces, 1 + level.num_faces // 10):
        marked = np.arange(level.num_faces) == f
        np.testing.assert_array_equal(neighbourhood(level, marked), [bool(face & faces[f]) for face in faces])
        np.testing.assert_array_equal(np.flatnonzero(level.corners_of(marked)), sorted(faces[f]))
        half_edges = level.half_edges(np.array([f, 0]))
        np.testing.assert_array_equal(level.face[half_edges], [f] * len(faces[f]) + [0] * len(faces[0]))


def test_levels_are_read_only() -> None:
    level = control_level(grid(2, 1))
    with pytest.raises(ValueError, match="read-only"):
        level.vertices[0] = 1


# Coordinates ----------------------------------------------------------------------------------------------------------


def test_children_of_a_square_lie_where_origin_and_axes_say() -> None:
    corners = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])
    level = control_level(ControlMesh(corners, [[0, 1, 2, 3]]))
    step = subdivide(level, everything(level))
    points = (step.matrix @ corners)[step.fine.quads]  # the step moves no vertex here: all are corners
    expected = CHILD_ORIGIN[:, None] + np.einsum("kij,cj->kci", CHILD_AXES, corners) / 2
    np.testing.assert_array_equal(points, expected)


# Tags -----------------------------------------------------------------------------------------------------------------


def test_corners_are_tagged_boundary_vertices_and_those_of_one_face() -> None:
    mesh = l_domain(tagged=True)
    level = control_level(mesh)
    tagged = np.zeros(mesh.num_vertices, dtype=bool)
    tagged[list(mesh.corners)] = True
    np.testing.assert_array_equal(level.corner, tagged | (level.vertex_num_faces == 1))
    assert not level.corner[level.vertex_num_faces == 2].any()


@pytest.mark.parametrize(
    ("tags", "message"),
    [
        ({"creases": {(4, 5): 10.0}}, r"1 creases inside the surface and 0 corners .*first: crease at edge \(4, 5\)"),
        ({"corners": {4: 10.0}}, "0 creases .* and 1 corners .*first: corner at vertex 4"),
        ({"corners": {1: 2.0}}, "0 creases .* and 1 corners .*first: corner at vertex 1"),
    ],
)
def test_unsupported_sharpness_is_refused(tags: dict[str, dict[object, float]], message: str) -> None:
    mesh = grid(2, 2)
    with pytest.raises(NotImplementedError, match=message):
        control_level(ControlMesh(mesh.vertices, mesh.quads, **tags))  # type: ignore[arg-type]  # either kind


def test_harmless_sharpness_is_taken() -> None:
    mesh = grid(2, 2)
    tagged = ControlMesh(mesh.vertices, mesh.quads, creases={(0, 1): 3.0, (4, 5): 0.0}, corners={4: 0.0, 1: 12.0})
    assert control_level(tagged).corner[1]
    assert not control_level(mesh).corner[1]


# A real one -----------------------------------------------------------------------------------------------------------


@pytest.mark.skipif("THCCS_MESHES" not in os.environ, reason="THCCS_MESHES names no folder of control meshes")
def test_spot_is_two_steps_of_its_control_mesh() -> None:
    folder = Path(os.environ["THCCS_MESHES"])
    control, fine = (io.read_mesh(folder / f"spot_{name}.obj") for name in ("control_mesh", "quadrangulated"))
    level, x = control_level(control), control.vertices
    for _ in range(2):
        step = subdivide(level, everything(level))
        level, x = step.fine, step.matrix @ x
    assert len(x) == len(fine.vertices)
    distance, nearest = KDTree(fine.vertices).query(x)
    assert distance.max() < 1e-5  # the file has six digits
    assert np.unique(nearest).size == len(x)
