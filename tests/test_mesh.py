"""Control meshes: their arrays, statistics and orientation, and every way to refuse one."""

import json
import os
import re
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ranks import ranks

import ufl
from thccs_fem import generators, io
from thccs_fem.mesh import ControlMesh, end_faces, orient

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]

SQUARE = [(0, 0), (1, 0), (1, 1), (0, 1)]
CUBE = np.array([(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)], dtype=float)
CUBE_FACES = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]


def grid(n: int, m: int) -> tuple[Floats, Ints]:
    """Return the vertices i + (n + 1) j of an n x m grid of unit squares in the plane, and its faces."""
    x, y = np.meshgrid(np.arange(n + 1.0), np.arange(m + 1.0))
    i, j = np.meshgrid(np.arange(n), np.arange(m))
    corner = (i + (n + 1) * j).ravel()
    faces = np.column_stack([corner, corner + 1, corner + n + 2, corner + n + 1])
    return np.column_stack([x.ravel(), y.ravel()]), faces.astype(np.int32)


def torus(n: int, m: int) -> tuple[Floats, Ints]:
    i, j = (k.ravel() for k in np.meshgrid(np.arange(n), np.arange(m), indexing="ij"))
    a, b = 2 * np.pi * i / n, 2 * np.pi * j / m
    r = 2 + np.cos(b)
    vertices = np.column_stack([r * np.cos(a), r * np.sin(a), np.sin(b)])
    right, up = (i + 1) % n, (j + 1) % m
    faces = np.column_stack([i * m + j, right * m + j, right * m + up, i * m + up])
    return vertices, faces.astype(np.int32)


def moebius(n: int) -> tuple[Floats, Ints]:
    """Return a strip of n quads with half a turn, as consistent as it can be."""
    a = 2 * np.pi * np.arange(n) / n
    across = np.column_stack([np.cos(a / 2) * np.cos(a), np.cos(a / 2) * np.sin(a), np.sin(a / 2)])
    middle = np.column_stack([2 * np.cos(a), 2 * np.sin(a), 0 * a])
    vertices = np.concatenate([middle - across, middle + across])
    k = np.arange(n)
    faces = np.column_stack([k, k + 1, n + k + 1, n + k])
    faces[-1] = (n - 1, n, 0, 2 * n - 1)
    return vertices, faces.astype(np.int32)


def turned(faces: npt.ArrayLike, which: Iterable[int]) -> Ints:
    """Return the faces, those of which turned over from the same first corner."""
    result = np.array(faces, dtype=np.int32)
    rows = list(which)
    result[rows, 1:] = result[rows, :0:-1]
    return result


def bad(vertices: Any, faces: Any, **more: Any) -> str:
    """Return the message of the ValueError that the mesh must raise."""
    with pytest.raises(ValueError) as caught:  # noqa: PT011  # the callers match the message
        ControlMesh(vertices, faces, **more)
    return str(caught.value)


def badly_typed(vertices: Any, faces: Any, **more: Any) -> str:
    """Return the message of the TypeError that the mesh must raise."""
    with pytest.raises(TypeError) as caught:
        ControlMesh(vertices, faces, **more)
    return str(caught.value)


# Arrays and statistics


def test_arrays_of_a_grid() -> None:
    msh = ControlMesh(*grid(2, 1))
    assert msh.vertices.dtype == np.float64
    assert (msh.gdim, msh.num_vertices, msh.num_edges, msh.num_faces) == (2, 6, 7, 2)
    assert msh.face_offsets.tolist() == [0, 4, 8]
    assert msh.face_vertices.tolist() == [0, 1, 4, 3, 1, 2, 5, 4]
    assert msh.edges.tolist() == [[0, 1], [0, 3], [1, 2], [1, 4], [2, 5], [3, 4], [4, 5]]
    assert msh.edge_faces.tolist() == [[0, -1], [0, -1], [1, -1], [0, 1], [1, -1], [0, -1], [1, -1]]
    assert msh.face_edges.tolist() == [0, 3, 5, 1, 2, 4, 6, 3]
    assert msh.face_sizes.tolist() == [4, 4]
    assert msh.quads.tolist() == [[0, 1, 4, 3], [1, 2, 5, 4]]
    assert msh.boundary_edges.tolist() == [0, 1, 2, 4, 5, 6]
    assert msh.boundary_vertices.tolist() == [0, 1, 2, 3, 4, 5]
    assert msh.vertex_num_faces.tolist() == [1, 2, 1, 1, 2, 1]
    assert msh.valences.tolist() == [2, 3, 2, 2, 3, 2]
    assert [loop.tolist() for loop in msh.boundary_loops] == [[0, 1, 2, 5, 4, 3]]
    assert msh.face_tags.tolist() == [0, 0]
    assert (msh.edge_tags, msh.creases, msh.corners, msh.comm) == ({}, {}, {}, None)


def test_all_arrays_are_read_only_int32_and_the_mesh_is_frozen() -> None:
    vertices, faces = grid(2, 2)
    tags = np.arange(4)
    msh = ControlMesh(vertices, faces, tags, {(0, 1): 3})
    vertices[0], faces[0], tags[0] = 9, 9, 9  # copies were taken
    assert (msh.vertices[0].tolist(), msh.face_vertices[0], msh.face_tags[0]) == ([0, 0], 0, 0)
    names = "face_offsets face_vertices face_edges face_tags edges edge_faces face_sizes quads"
    names += " boundary_edges boundary_vertices vertex_num_faces valences"
    arrays = {name: getattr(msh, name) for name in names.split()}
    arrays |= {"loop": msh.boundary_loops[0]}
    assert {name: array.dtype for name, array in arrays.items()} == dict.fromkeys(arrays, np.int32)
    assert not any(array.flags.writeable for array in arrays.values())
    assert not msh.vertices.flags.writeable
    with pytest.raises(AttributeError):
        msh.comm = 1  # type: ignore[misc]  # that it can't be set is what is tested
    with pytest.raises(TypeError):
        msh.edge_tags[0, 1] = 4  # type: ignore[index]  # as above


def test_faces_of_several_sizes_in_any_kind_of_sequence() -> None:
    # A pyramid with a square base, and one with a pentagon.
    faces: list[Any] = [np.array([3, 2, 1, 0]), (0, 1, 4), [1, 2, 4], [2, 3, np.int64(4)], [3, 0, 4]]
    msh = ControlMesh([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0.5, 0.5, 1)], faces)
    assert msh.face_sizes.tolist() == [4, 3, 3, 3, 3]
    assert msh.face_offsets.tolist() == [0, 4, 7, 10, 13, 16]
    assert not msh.is_quad
    assert (msh.euler_characteristic, msh.genus) == (2, 0)
    assert msh.extraordinary_vertices == {0: 3, 1: 3, 2: 3, 3: 3}
    assert (msh.invalid_faces.tolist(), msh.num_invalid_faces) == ([0, 1, 2, 3, 4], 5)
    with pytest.raises(ValueError, match="faces 1, 2, 3, 4 do not have four corners"):
        _ = msh.quads


def test_statistics_of_a_closed_surface() -> None:
    msh = ControlMesh(*torus(5, 4))
    assert (msh.euler_characteristic, msh.genus, msh.num_components) == (0, 1, 1)
    assert (msh.boundary_loops, msh.boundary_vertices.size) == ((), 0)
    assert (msh.extraordinary_vertices, msh.num_invalid_faces) == ({}, 0)
    numbers = (msh.genus, msh.num_components, msh.euler_characteristic, msh.num_invalid_faces)
    assert {type(number) for number in numbers} == {int}


def test_invalid_faces_have_two_extraordinary_vertices_inside() -> None:
    # The cube's vertices are three faces apart after a cut of each edge into three, and one after none.
    assert generators.cube_sphere(1).invalid_faces.tolist() == [0, 1, 2, 3, 4, 5]
    assert generators.cube_sphere(3).invalid_faces.tolist() == []
    assert generators.wheel(5, 2).invalid_faces.tolist() == []  # vertices on the rim are not counted


def test_end_faces_are_at_both_ends_of_each_component() -> None:
    plane, faces = grid(10, 2)
    above = plane @ np.array([[0.0, 1.0], [-1.0, 0.0]]) + np.array([0.0, 100.0])  # along y, upwards
    msh = ControlMesh(np.concatenate([plane, above]), np.concatenate([faces, faces + len(plane)]))
    centres = msh.vertices[msh.quads].mean(axis=1)
    first, last = end_faces(msh, share=0.1)
    assert (first.size, last.size) == (4, 4)
    assert (np.diff(first) > 0).all()
    np.testing.assert_allclose(np.sort(centres[first, 0])[-2:], plane[:, 0].min() + 0.5)
    for own, coordinate in ((centres[:, 1] < 50, 0), (centres[:, 1] > 50, 1)):
        low, high = (centres[end[own[end]], coordinate] for end in (first, last))
        assert low.size == high.size == 2
        assert low.max() == centres[own, coordinate].min()
        assert high.min() == centres[own, coordinate].max()


def test_end_faces_are_one_at_least_and_need_two() -> None:
    first, last = end_faces(ControlMesh(*grid(2, 1)))
    assert (first.tolist(), last.tolist()) == ([0], [1])
    with pytest.raises(ValueError, match="face 0 is a component of its own"):
        end_faces(ControlMesh(*grid(1, 1)))
    for share in (0.0, 0.6):
        with pytest.raises(ValueError, match=rf"share is {share}: expected"):
            end_faces(ControlMesh(*grid(2, 1)), share)


def test_components_and_loops_are_counted_over_all_of_them() -> None:
    plane, faces = grid(3, 3)
    ring = np.delete(faces, 4, axis=0)
    far = np.column_stack([plane + np.array([10, 0]), 0 * plane[:, 0]])
    torus_vertices, torus_faces = torus(4, 3)
    vertices = np.concatenate([torus_vertices, far])
    msh = ControlMesh(vertices, np.concatenate([torus_faces, ring + len(torus_vertices)]))
    assert (msh.num_components, msh.genus, msh.euler_characteristic) == (2, 1, 0)
    outer, inner = ((loop - len(torus_vertices)).tolist() for loop in msh.boundary_loops)
    assert outer == [0, 1, 2, 3, 7, 11, 15, 14, 13, 12, 8, 4]
    assert inner == [5, 9, 10, 6]  # the other way round, with the faces to the left


def test_many_loops_are_in_the_order_of_their_smallest_vertices() -> None:
    n = 40
    rng = np.random.default_rng(1)
    order = rng.permutation(4 * n)
    x = np.array([(2 * k + a, b) for k in range(n) for a, b in SQUARE])
    number = np.argsort(order)
    msh = ControlMesh(x[order], number[np.arange(4 * n).reshape(n, 4)][rng.permutation(n)])
    quads = [np.roll(quad, -np.argmin(quad)).tolist() for quad in msh.quads]
    assert [loop.tolist() for loop in msh.boundary_loops] == sorted(quads)
    assert msh.num_components == n


def test_edge_indices() -> None:
    msh = ControlMesh(*grid(2, 1))
    # (-1, 11) and (0, 7) have the keys 5 and 7 of vertices (0, 5) and the edge (1, 1): none.
    pairs = [(4, 1), (0, 1), (0, 2), (-1, 11), (0, 9), (0, 6), (5, 4)]
    assert msh.edge_indices(pairs).tolist() == [3, 0, -1, -1, -1, -1, 6]
    assert msh.edge_indices([]).shape == (0,)
    assert msh.edge_indices([(-1, 7)]).tolist() == [-1]  # has the key of edge (0, 1): -6 + 7


def test_tags_are_kept_by_ordered_pairs() -> None:
    edge_tags: Any = {(4, 1): 7, (1, 4): np.int64(7), (0, 1): -1}
    creases: Any = {(np.int32(2), 1): 2.5, (0, 3): 10, (4, 5): float("inf")}
    corners: Any = {np.int64(5): 0, 0: 12}
    msh = ControlMesh(*grid(2, 1), [3, -4], edge_tags, creases, corners)
    assert msh.face_tags.tolist() == [3, -4]
    assert msh.edge_tags == {(1, 4): 7, (0, 1): -1}
    assert msh.creases == {(1, 2): 2.5, (0, 3): 10.0, (4, 5): float("inf")}
    assert msh.corners == {5: 0.0, 0: 12.0}
    assert {type(k) for pair in [*msh.edge_tags, *msh.creases] for k in pair} == {int}


def test_repr_and_comm() -> None:
    (comm,) = ranks(1)
    msh = ControlMesh(*grid(2, 1), comm=comm)
    assert repr(msh) == "ControlMesh(gdim=2, num_vertices=6, num_edges=7, num_faces=2)"
    assert msh.comm is comm


@pytest.mark.parametrize("vertices", [grid(2, 1)[0], np.pad(grid(2, 1)[0], ((0, 0), (0, 1)))])
def test_each_mesh_is_one_ufl_domain(vertices: Floats) -> None:
    first, second = (ControlMesh(vertices, grid(2, 1)[1]) for _ in range(2))
    assert first != second
    assert first.ufl_domain() is first.ufl_domain()
    assert first.ufl_domain().control_mesh is first
    assert first.ufl_domain() != second.ufl_domain()
    ids = {msh.ufl_domain().ufl_id() for msh in (first, second)}  # type: ignore[attr-defined]  # UFL adds it
    assert len(ids) == 2
    assert ufl.SpatialCoordinate(first).ufl_shape == (vertices.shape[1],)


# What is refused: kinds and shapes


@pytest.mark.parametrize("vertices", [np.zeros((0, 2)), [], np.zeros((0, 3))])
def test_no_vertices(vertices: Any) -> None:
    assert "the mesh is empty, without vertices" in bad(vertices, [(0, 1, 2)])


@pytest.mark.parametrize("faces", [[], np.zeros((0, 4), dtype=int), ()])
def test_no_faces(faces: Any) -> None:
    assert bad(SQUARE, faces) == "the mesh is empty, without faces"


@pytest.mark.parametrize(
    ("vertices", "message"),
    [
        (np.zeros((4, 4)), r"vertices have the shape \(4, 4\); expected coordinates of shape"),
        (np.zeros(4), r"vertices have the shape \(4,\)"),
        ([(0, 0), (1, 0), (1, 1, 0), (0, 1)], "vertices differ in their number of coordinates"),
        ([(0, 0), (np.nan, 0), (1, 1), (0, np.inf)], r"vertices 1, 3 have .* \(vertex 1: \[nan, 0"),
    ],
)
def test_wrong_vertices(vertices: Any, message: str) -> None:
    assert re.search(message, bad(vertices, [(0, 1, 2, 3)]))


@pytest.mark.parametrize("vertices", [np.zeros((4, 2), dtype=complex), [["a", "b"]] * 4, [None]])
def test_vertices_that_are_no_numbers(vertices: Any) -> None:
    assert "vertices are of type" in badly_typed(vertices, [(0, 1, 2, 3)])


@pytest.mark.parametrize(
    ("faces", "message"),
    [
        (np.array([0, 1, 2, 3]), r"faces have the shape \(4,\); expected integers of shape"),
        ([(0, 1, 2, 3), (0, 1)], r"faces 1 have fewer than three corners \(face 1: 2\)"),
        (np.zeros((5, 2), dtype=int), r"faces 0, 1, 2, 3, 4 have fewer than three"),
        ([(0, 1, 2, 3)] * 9 + [()] * 7, r"faces 9, 10, 11, 12, 13 and 2 more have fewer"),
        ([(0, 1, 2), (0, 2, 4)], r"faces 1 have corners out of range \(face 1: 4\): .* 0 to 3"),
        ([(0, 1, 2), (0, -1, 3)], r"faces 1 have corners out of range \(face 1: -1\)"),
    ],
)
def test_wrong_faces(faces: Any, message: str) -> None:
    assert re.search(message, bad(SQUARE, faces))


@pytest.mark.parametrize(
    ("faces", "message"),
    [
        (np.array([[0, 1, 2, 3.0]]), "faces are of type float64; expected integers"),
        (np.ones((1, 4), dtype=bool), "faces are of type bool"),
        ([(0, 1, 2), (0, 2, 1.5)], "face 1 has the corner 1.5; expected integers"),
        ([(0, True, 2, 3)], "face 0 has the corner True"),
        ([(0, np.True_, 2, 3)], r"face 0 has the corner np.True_"),
        (["abc"], "face 0 has the corner 'a'"),
        ([0, 1, 2, 3], "faces are not sequences"),
        (7, "faces are not sequences"),
    ],
)
def test_faces_that_are_no_integers(faces: Any, message: str) -> None:
    assert message in badly_typed(SQUARE, faces)


# What is refused: faces that make no manifold


def test_vertex_twice_in_a_face() -> None:
    vertices, faces = grid(3, 1)
    faces[1] = (1, 2, 6, 1)
    faces[2] = (2, 3, 2, 6)
    assert "faces 1, 2 (face 1: vertices 1, 2, 6, 1) have a vertex twice" in bad(vertices, faces)


@pytest.mark.parametrize("copy", [(1, 2, 6, 5), (5, 6, 2, 1), (1, 6, 2, 5)])
def test_two_faces_with_the_same_vertices(copy: tuple[int, ...]) -> None:
    vertices, faces = grid(3, 1)
    faces = np.concatenate([faces, [copy]])
    assert "faces (1, 3) have the same vertices" in bad(vertices, faces)


def test_isolated_vertices() -> None:
    vertices, faces = grid(2, 1)
    assert "vertices 6, 7 are isolated" in bad(np.append(vertices, [(5, 5), (6, 6)], axis=0), faces)
    assert "vertices 0 are isolated" in bad(np.insert(vertices, 0, 9, axis=0), faces + 1)


def test_edge_of_three_faces() -> None:
    vertices = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (0, -1, 0)], dtype=float)
    message = bad(vertices, [(0, 1, 2), (1, 0, 3), (0, 1, 4)])
    assert message.startswith("edges (0, 1) have more than two faces (edge (0, 1): faces 0, 1, 2): the mesh is not a")


def test_faces_in_the_same_direction() -> None:
    vertices, faces = grid(3, 1)
    message = bad(vertices, turned(faces, [1]))
    assert message == (
        "faces 0 and 1 run along edge (1, 5) in the same direction (and so on at 1 more edges): "
        "the mesh is not consistently oriented. mesh.orient(vertices, faces) repairs it"
    )


@pytest.mark.parametrize("closed", [False, True])
def test_bow_tie_at_a_vertex(closed: bool) -> None:
    if closed:  # two tetrahedra with a common tip: no boundary edge tells of it
        tip = np.array([(0, 0, 0), (1, 0, 1), (0, 1, 1), (-1, -1, 1)], dtype=float)
        vertices = np.concatenate([tip, -tip[1:]])
        one = np.array([(0, 2, 1), (0, 3, 2), (0, 1, 3), (1, 2, 3)])
        other = np.where(one > 0, one + 3, 0)[:, ::-1]
        message = bad(vertices, np.concatenate([one, other]))
        assert "vertices 0 join fans" in message
        assert "(vertex 0: 2 fans of faces 0, 1, 2, 4, 5 and 1 more)" in message
    else:
        vertices = np.array([*SQUARE, (2, 1), (2, 2), (1, 2)], dtype=float)
        message = bad(vertices, [(0, 1, 2, 3), (2, 4, 5, 6)])
        assert "vertices 2 join fans" in message
        assert "(vertex 2: 2 fans of faces 0, 1): the mesh is not a manifold" in message


# What is refused: where the faces lie


@pytest.mark.parametrize("scale", [1e-150, 1.0, 1e150])
@pytest.mark.parametrize("gdim", [2, 3])
def test_corners_in_one_place(gdim: int, scale: float) -> None:
    vertices = np.pad(grid(2, 1)[0], ((0, 0), (0, gdim - 2))) * scale
    vertices[2] = vertices[5] + 1e-14 * scale  # far below the limit of 1e-12 of the diameter
    message = bad(vertices, grid(2, 1)[1])
    assert "faces 1 (face 1: vertices 1, 2, 5, 4) have two corners in one place" in message


@pytest.mark.parametrize("shift", [0.0, 1e3])
def test_bow_tie_face_in_the_plane(shift: float) -> None:
    vertices, faces = grid(3, 1)
    faces[2] = (2, 3, 6, 7)
    message = bad(vertices + shift, faces)
    assert "faces 2 (face 2: vertices 2, 3, 6, 7) cross themselves like a bow-tie" in message


def test_bow_tie_face_in_space() -> None:
    rng = np.random.default_rng(2)
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    quad = np.array([(0, 0, 0), (3, 0, 0), (0, 1, 0), (3, 1.2, 0)]) @ rotation
    assert "cross themselves" in bad(quad, [(0, 1, 2, 3)])
    # The rounding of a file with six digits leaves it a bow-tie, though not a plane one.
    assert "cross themselves" in bad(np.round(quad, 6), [(0, 1, 2, 3)])


def test_self_crossing_polygon() -> None:
    angle = 2 * np.pi * np.arange(7) / 7
    star = np.column_stack([np.cos(angle), np.sin(angle)])
    assert "cross themselves" in bad(star, [np.arange(7) * 3 % 7])
    assert ControlMesh(star, [np.arange(7)]).num_faces == 1


@given(st.floats(0.0, 178.0), st.floats(0.1, 10.0), st.integers(0, 2**32 - 1))
def test_a_twisted_quad_is_no_bow_tie(twist: float, length: float, seed: int) -> None:
    # Its two edges along the twist pass each other at cos(twist / 2) > 0.017 of their distance.
    a = np.radians(twist)
    quad = np.array([(0, -1, 0), (length, -np.cos(a), -np.sin(a)), (length, np.cos(a), np.sin(a))])
    quad = np.concatenate([quad, [(0, 1, 0)]])
    rotation, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    assert ControlMesh(quad @ rotation, [(0, 1, 2, 3)]).num_faces == 1


def test_concave_faces_and_corners_of_180_degrees_are_good() -> None:
    assert ControlMesh([(0, 0), (2, 0), (0.5, 0.5), (0, 2)], [(0, 1, 2, 3)]).num_faces == 1
    assert ControlMesh([(0, 0), (1, 0), (2, 0), (0, 2)], [(0, 1, 2, 3)]).num_faces == 1


@pytest.mark.parametrize("direction", [(1.0, 0.0), (0.3, 0.7), (1.0, 0.1, 0.2)])
def test_faces_without_area(direction: tuple[float, ...]) -> None:
    t = np.array([0, 1, 2, 3, 4, 5.0])
    line = t[:, None] * np.array(direction)
    assert "the corners of each face lie on a line" in bad(line, [(0, 1, 2, 3), (3, 2, 4, 5)])
    up = np.zeros_like(line[:4])
    up[:, -1] = 1.0
    vertices = np.concatenate([line[:4], (line[:4] + up)])
    vertices = np.concatenate([vertices, line[3:4] / 2 - up[:1]])
    faces = [(0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (0, 3, 2, 1)]
    message = bad(vertices[:8], faces)
    assert "faces 3 (face 3: vertices 0, 3, 2, 1) have no area" in message


def test_all_vertices_in_one_place() -> None:
    assert "all its vertices are at [1.0, 2.0]" in bad([(1, 2)] * 4, [(0, 1, 2, 3)])


def test_clockwise_faces_in_the_plane() -> None:
    vertices, faces = grid(2, 1)
    assert bad(vertices, faces[:, ::-1]) == (
        "all 2 faces are clockwise; in the plane they must be counter-clockwise. "
        "mesh.orient(vertices, faces) repairs it"
    )
    in_space = np.pad(vertices, ((0, 0), (0, 1)))
    assert ControlMesh(in_space, faces[:, ::-1]).num_faces == 2


def test_clockwise_component_in_the_plane() -> None:
    vertices, faces = grid(2, 1)
    two = np.concatenate([vertices, vertices + 5]), np.concatenate([faces, faces[:, ::-1] + 6])
    message = bad(*two)
    assert message.startswith("faces 2, 3 are clockwise; in the plane")
    assert "mesh.orient" in message
    assert np.array_equal(orient(*two)[2:], [[9, 6, 7, 10], [10, 7, 8, 11]])


@pytest.mark.parametrize("clockwise", [False, True])
def test_folded_faces_in_the_plane(clockwise: bool) -> None:
    vertices, faces = grid(3, 1)
    vertices[[3, 7], 0] = 1.5  # the last face lies back upon the one before
    message = bad(vertices, faces[:, ::-1] if clockwise else faces)
    assert message.startswith("faces 2 are turned over: their signed area has not the sign")
    assert "orient" not in message  # would be of no help


# What is refused: tags


@pytest.mark.parametrize(
    ("tags", "message"),
    [
        ({"face_tags": [1]}, r"face_tags have the shape \(1,\); expected \(2,\)"),
        ({"face_tags": [1, 2**31]}, r"face_tags of faces 1 do not fit in 32 bits \(face 1: 214748"),
        ({"edge_tags": {(0, 4): 1, (0, 1): 1}}, r"edge_tags has values for \(0, 4\): .* no such edge"),
        ({"edge_tags": {(0, 99): 1}}, r"edge_tags has values for \(0, 99\)"),
        ({"edge_tags": {(0, 1): 1, (1, 0): 2}}, r"edge_tags has two values for edge \(0, 1\), 1 and 2"),
        ({"creases": {(3, 5): 1.0}}, r"creases has values for \(3, 5\)"),
        ({"creases": {(0, 1): -1}}, r"creases\[0, 1\] is -1; expected a sharpness from 0"),
        ({"creases": {(1, 0): np.nan}}, r"creases\[1, 0\] is nan"),
        ({"corners": {6: 1.0, -1: 1.0}}, "corners has values for 6, -1: vertices are 0 to 5"),
        ({"corners": {0: -0.5}}, r"corners\[0\] is -0.5; expected a sharpness"),
    ],
)
def test_wrong_tags(tags: dict[str, Any], message: str) -> None:
    assert re.search(message, bad(*grid(2, 1), **tags))


@pytest.mark.parametrize(
    ("tags", "message"),
    [
        ({"face_tags": [1.0, 2.0]}, "face_tags are of type float64; expected integers"),
        ({"edge_tags": [(0, 1)]}, "edge_tags is of type list; expected a dict"),
        ({"edge_tags": {(0, 1): 1.5}}, "edge_tags[0, 1] is 1.5; expected an integer"),
        ({"edge_tags": {(0, 1): True}}, "edge_tags[0, 1] is True; expected an integer"),
        ({"edge_tags": {0: 1}}, "edge_tags has the key 0; expected two vertices, (i, j)"),
        ({"creases": {(0, 1.0): 1}}, "creases has the key (0, 1.0); expected two vertices"),
        ({"creases": {(0, 1): "sharp"}}, "creases[0, 1] is 'sharp'; expected a number"),
        ({"corners": {(0, 1): 1}}, "corners has the key (0, 1); expected a vertex"),
        ({"corners": {0: True}}, "corners[0] is True; expected a number"),
    ],
)
def test_badly_typed_tags(tags: dict[str, Any], message: str) -> None:
    assert message in badly_typed(*grid(2, 1), **tags)


# Cracks


def test_a_crack_is_warned_of() -> None:
    vertices, faces = grid(2, 2)
    # Vertex 3, in the middle of the left side, is doubled: a crack from (0, 1) to (1, 1) opens.
    vertices = np.append(vertices, [vertices[3] + 1e-10], axis=0)
    faces[2, 0] = 9
    with pytest.warns(UserWarning, match=r"boundary vertices \(3, 9\) coincide: the mesh has a"):
        msh = ControlMesh(vertices, faces)
    assert msh.boundary_vertices.size == 10


def test_faces_that_are_not_joined_at_all_are_warned_of() -> None:
    vertices, faces = grid(2, 1)
    names = r"\(1, 4\), \(2, 7\)"  # the two vertices of the edge between, twice each
    with pytest.warns(UserWarning, match=names) as caught:
        ControlMesh(vertices[faces.ravel()], np.arange(8).reshape(2, 4))
    assert caught[0].filename == __file__  # not a line of the library


def test_near_vertices_are_no_crack() -> None:
    vertices, faces = grid(2, 2)
    vertices = np.append(vertices, [vertices[3] + (0, 1e-6)], axis=0)
    faces[2, 0] = 9
    assert ControlMesh(vertices, faces).num_vertices == 10  # pytest makes a warning an error


# Orientation


@given(st.sets(st.integers(0, 19)))
def test_orient_mends_a_torus(flipped: set[int]) -> None:
    vertices, faces = torus(5, 4)
    broken = turned(faces, sorted(flipped))
    assert np.array_equal(orient(vertices, broken), faces)  # outward, whatever the first face was


@given(st.sets(st.integers(0, 5)), st.booleans())
def test_orient_of_an_open_surface_keeps_the_side_of_its_first_face(flipped: set[int], planar: bool) -> None:
    vertices, faces = grid(3, 2)
    broken = turned(faces, sorted(flipped))
    if not planar:
        vertices = np.column_stack([vertices, vertices[:, 0] ** 2])
    oriented = orient(vertices, broken)
    kept = planar or 0 not in flipped
    assert np.array_equal(oriented, faces if kept else turned(faces, range(6)))


def test_orient_of_polygons_and_components() -> None:
    faces: list[Any] = [*CUBE_FACES[:5], (1, 3, 7), (1, 7, 5)]
    shifted = [[v + 8 for v in face[::-1]] for face in faces]
    oriented = orient(np.concatenate([CUBE, CUBE + 3]), [*faces, *shifted])
    assert isinstance(oriented, list)
    assert oriented[:7] == [list(face) for face in faces]
    assert oriented[7] == [9, 8, 10, 11]  # (9, 11, 10, 8) from the same first corner
    msh = ControlMesh(np.concatenate([CUBE, CUBE + 3]), oriented)
    x = msh.vertices[msh.face_vertices[msh.face_offsets[:-1]]]
    assert msh.num_components == 2
    assert x.shape == (14, 3)


def test_orient_a_one_sided_surface() -> None:
    vertices, faces = moebius(8)
    with pytest.raises(ValueError, match=r"like a Moebius strip it has one side only, .* 0, 1, 2"):
        orient(vertices, faces)
    assert "run along edge" in bad(vertices, faces)


def test_orient_refuses_what_a_mesh_refuses_before() -> None:
    with pytest.raises(ValueError, match="corners out of range"):
        orient(SQUARE, [(0, 1, 2, 4)])
    vertices = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (0, -1, 0)]
    with pytest.raises(ValueError, match="more than two faces"):
        orient(vertices, [(0, 1, 2), (1, 0, 3), (0, 1, 4)])


# Invariants


@given(st.integers(1, 5), st.integers(1, 5), st.integers(0, 2**32 - 1))
def test_numbering_does_not_matter(n: int, m: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    vertices, faces = grid(n, m)
    order = rng.permutation(len(vertices))
    number = np.argsort(order)
    turns = rng.integers(0, 4, len(faces))[:, None] + np.arange(4)
    shuffled = number[np.take_along_axis(faces, turns % 4, axis=1)][rng.permutation(len(faces))]
    msh, other = ControlMesh(vertices, faces), ControlMesh(vertices[order], shuffled)
    assert np.array_equal(msh.valences[order], other.valences)
    assert np.array_equal(msh.vertex_num_faces[order], other.vertex_num_faces)
    assert msh.num_edges == other.num_edges == n * (m + 1) + m * (n + 1)
    assert [loop.size for loop in other.boundary_loops] == [2 * (n + m)]
    # Each corner's edge joins it to the next of its face, and knows the face.
    following = np.roll(other.quads, -1, axis=1).ravel()
    ends = np.sort(np.column_stack([other.face_vertices, following]), axis=1)
    assert np.array_equal(other.edges[other.face_edges], ends)
    faces_of = other.edge_faces[other.face_edges]
    assert (faces_of == np.repeat(np.arange(n * m), 4)[:, None]).any(axis=1).all()
    assert np.array_equal(other.edge_indices(other.edges[:, ::-1]), np.arange(other.num_edges))
    assert np.array_equal(other.edges, np.unique(other.edges, axis=0))  # lexicographic


FOLDER = Path(os.environ.get("THCCS_MESHES", "missing"))
NAMES = sorted(path.name for path in FOLDER.glob("*.obj"))


@pytest.mark.skipif(not NAMES, reason="THCCS_MESHES names no folder with meshes")
@pytest.mark.parametrize("name", NAMES)
def test_statistics_of_real_meshes(name: str) -> None:
    # A warning of a crack would be an error: none of them has one.
    msh = io.read_mesh(FOLDER / name)
    known = json.loads((FOLDER / "stats.json").read_text())[name]
    valences = Counter(str(valence) for valence in msh.extraordinary_vertices.values())
    rim = Counter(str(number) for number in msh.vertex_num_faces[msh.boundary_vertices])
    found = {
        "vertices": msh.num_vertices,
        "faces": msh.num_faces,
        "edges": msh.num_edges,
        "face_sizes": Counter(str(size) for size in msh.face_sizes),
        "extraordinary_interior": valences,
        "boundary_vertices_by_faces": rim,
        "invalid_faces": msh.num_invalid_faces,
        "boundary_loops": len(msh.boundary_loops),
        "components": msh.num_components,
        "euler": msh.euler_characteristic,
        "genus": msh.genus,
    }
    assert found == {key: known[key] for key in found}
    faces = np.split(msh.face_vertices, msh.face_offsets[1:-1])
    oriented = orient(msh.vertices, faces)
    assert all(np.array_equal(a, b) for a, b in zip(faces, oriented, strict=True))
