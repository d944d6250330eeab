"""Coordinates in faces, sub-quads and children."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from zoo import grid, polygons

from thccs_fem.positions import CHILD_AXES, CHILD_ORIGIN, child_at, in_quads, in_sub_quads, side_points

COORDINATE = st.floats(0.0, 1.0)


@given(COORDINATE, COORDINATE)
def test_coordinates_in_children_are_exact(u: float, v: float) -> None:
    child, local = child_at(np.array([[u, v]]))
    assert ((local >= 0) & (local <= 1)).all()
    # Twice the distance from the corner, which is exact: u - 1 for u >= 1/2 does not round.
    assert sorted(local[0]) == sorted([2 * u if u < 0.5 else 2 * (1 - u), 2 * v if v < 0.5 else 2 * (1 - v)])
    back = CHILD_ORIGIN[child] + np.einsum("nij,nj->ni", CHILD_AXES[child], local) / 2
    np.testing.assert_array_equal(back, [(u, v)])


def test_positions_in_sub_quads_and_in_quads() -> None:
    mesh = grid(2, 1)
    faces, uv = np.array([1, 0, 1]), np.array([(0.25, 0.125), (0.75, 0.25), (0.5, 1.0)])
    half_edges, local = in_sub_quads(mesh, faces, uv)
    np.testing.assert_array_equal(half_edges, [4, 1, 6])
    np.testing.assert_array_equal(local, [(0.5, 0.25), (0.5, 0.5), (1.0, 0.0)])
    faces_again, uv_again = in_quads(mesh, half_edges // 4, local, half_edges % 4)
    np.testing.assert_array_equal(faces_again, faces)
    np.testing.assert_array_equal(uv_again, uv)
    np.testing.assert_array_equal(in_quads(mesh, faces, uv)[1], uv)
    half_edges, local = in_sub_quads(mesh, faces, uv, [-1, 2, 0])
    np.testing.assert_array_equal(half_edges, [4, 2, 4])
    np.testing.assert_array_equal(local, [(0.5, 0.25), (0.75, 0.25), (0.5, 1.0)])


@pytest.mark.parametrize("function", [in_quads, in_sub_quads])
def test_wrong_positions_are_refused(function: Callable[..., object]) -> None:
    mesh = polygons()
    with pytest.raises(ValueError, match="point 1 is on face 5; the mesh has faces 0 to 4"):
        function(mesh, [1, 5], [(0.0, 0.0)] * 2)
    with pytest.raises(ValueError, match=r"face 4 with 5 corners and names corner -1; .* corner from 0 to 4"):
        function(mesh, [4], [(0.0, 0.0)])
    with pytest.raises(ValueError, match=r"point 0 has coordinates \[-0.1  0. \]"):
        function(mesh, [1], [(-0.1, 0.0)])
    with pytest.raises(ValueError, match=r"uv must have shape \(1, 2\)"):
        function(mesh, [1], (0.0, 0.0))
    with pytest.raises(TypeError, match="must be integers"):
        function(mesh, [1.5], [(0.0, 0.0)])


@pytest.mark.parametrize("function", [in_quads, in_sub_quads])
def test_there_may_be_no_positions(function: Callable[..., tuple[np.ndarray, np.ndarray]]) -> None:
    for corner in (None, []):
        faces, uv = function(polygons(), [], [], corner)
        assert (faces.shape, faces.dtype, uv.shape) == ((0,), np.int32, (0, 2))


def test_points_on_sides_run_from_corner_to_corner() -> None:
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    points = side_points([0.0, 0.25, 1.0])
    following = np.roll(corners, -1, axis=0)
    np.testing.assert_array_equal(points, np.stack([corners, 0.75 * corners + 0.25 * following, following], axis=1))
