"""Dirichlet conditions: which functions, and which values; for values that are expressions see test_fitting.py."""

import numpy as np
import numpy.typing as npt
import pytest
from refinements import bernstein_rows
from rim import WITH_RIM, slopes_on_the_rim, space, unit_square, with_random_values
from zoo import ZOO

import ufl
from thccs_fem import adapt, fem, generators, limit
from thccs_fem.fem.space import FunctionSpace
from thccs_fem.mesh import ControlMesh

Floats = npt.NDArray[np.float64]

SCALAR = ("THCCS", 3)
SIDES = [[0, 1, 2, 3], [3, 7, 11, 15], [15, 14, 13, 12], [12, 8, 4, 0]]


def others(V: FunctionSpace, functions: npt.NDArray[np.int32]) -> npt.NDArray[np.int64]:
    return np.setdiff1d(np.arange(V.num_functions), functions)


def on_the_rim(V: FunctionSpace) -> Floats:
    """Bernstein coefficients of all functions on all boundary edges, dense, shape (4 edges, num_functions)."""
    piece, side, _ = V.cells.boundary_pieces
    rows = bernstein_rows(V.cells)
    return rows[(16 * piece[:, None] + np.array(SIDES)[side]).ravel()].toarray()


# ---- locate_dofs_geometrical


def test_marked_functions_are_found() -> None:
    V = unit_square()
    found = fem.locate_dofs_geometrical(V, lambda x: x[0] < 1e-10)
    assert found.dtype == np.int32
    np.testing.assert_array_equal(found, np.flatnonzero(V.reference_points[:, 0] < 1e-10))
    assert found.size == 7
    assert fem.locate_dofs_geometrical(V, lambda x: x[2] != 0.0).size == 0  # z is zero in the plane


def test_functions_at_the_rim_have_the_trace() -> None:
    V = unit_square()
    at_rim = fem.locate_dofs_geometrical(V, lambda x: np.isclose(np.abs(x[:2] - 0.5).max(axis=0), 0.5))
    np.testing.assert_array_equal(at_rim, fem.boundary_dofs(V))


def test_markers_of_another_shape_are_refused() -> None:
    with pytest.raises(ValueError, match=r"the marker returned shape \(3, 49\) for 49 points; it must return \(49,\)"):
        fem.locate_dofs_geometrical(unit_square(), lambda x: x < 0.5)


# ---- boundary_dofs


@pytest.mark.parametrize("times", [0, 2])
@pytest.mark.parametrize("boundary", ["clamped", "crease"])
@pytest.mark.parametrize("name", WITH_RIM)
def test_boundary_dofs_are_those_with_a_trace(name: str, boundary: str, times: int) -> None:
    V = space(name, boundary, times)
    found = fem.boundary_dofs(V)
    largest = np.abs(on_the_rim(V)).max(axis=0)
    np.testing.assert_array_equal(found, np.flatnonzero(largest > 1e-10))
    assert largest[found].min() > 1e-3  # nothing in between
    assert found.size


def test_numbers_of_boundary_dofs_are_those_of_splines() -> None:
    V = unit_square()
    assert fem.boundary_dofs(V).size == 4 * 6  # 7 x 7 tensor-product splines, the outermost ring
    assert fem.boundary_dofs(V, lambda x: np.isclose(x[1], 0.0)).size == 7


def test_closed_surfaces_have_no_boundary_dofs() -> None:
    found = fem.boundary_dofs(space("torus"))
    assert (found.size, found.dtype) == (0, np.int32)


@pytest.mark.parametrize("times", [0, 2])
def test_parts_of_the_boundary(times: int) -> None:
    V = unit_square(times=times)
    left = fem.boundary_dofs(V, lambda x: np.isclose(x[0], 0.0))
    assert set(left) < set(fem.boundary_dofs(V))
    y = np.linspace(0.0, 1.0, 40)
    faces, uv = 4 * np.minimum((4 * y).astype(int), 3), np.stack([0 * y, 4 * y - np.minimum((4 * y).astype(int), 3)], 1)
    np.testing.assert_allclose(limit.evaluate(V.mesh, faces, uv)[0], np.stack([0 * y, y], 1), atol=1e-14)
    np.testing.assert_allclose(with_random_values(V, others(V, left)).eval(faces, uv), 0.0, atol=1e-14)
    assert (with_random_values(V, left).eval(faces, uv) >= 1.0 - 1e-12).all()  # a partition of unity on this side


def test_an_edge_counts_where_ends_and_middle_are_marked() -> None:
    V = unit_square()
    assert (
        fem.boundary_dofs(V, lambda x: np.isclose(x[0] * (1 - x[0]), 0.0) & np.isclose(x[1] * (1 - x[1]), 0.0)).size
        == 0
    )
    half = fem.boundary_dofs(V, lambda x: np.isclose(x[1], 0.0) & (x[0] < 0.6))
    assert half.size == 5  # two edges of an end-interpolating spline


def test_tagged_edges() -> None:
    plain = generators.rectangle((4, 3))
    loop = plain.boundary_loops[0]
    pairs = [tuple(sorted(pair)) for pair in zip(loop.tolist(), np.roll(loop, -1).tolist(), strict=True)]
    bottom = [pair for pair in pairs if max(pair) <= 4]
    inside = tuple(sorted((6, 7)))  # tags of edges inside are no boundary
    tags = {**dict.fromkeys(bottom, 7), **dict.fromkeys(set(pairs) - set(bottom), 8), inside: 7}
    msh = ControlMesh(plain.vertices, plain.quads, edge_tags=tags, corners=plain.corners)
    V = adapt.refine(fem.functionspace(msh, SCALAR), [0, 5])
    expected = fem.boundary_dofs(V, lambda x: np.isclose(x[1], msh.vertices[:, 1].min()))
    np.testing.assert_array_equal(fem.boundary_dofs(V, tag=7), expected)
    rest = np.union1d(fem.boundary_dofs(V, tag=7), fem.boundary_dofs(V, tag=8))
    np.testing.assert_array_equal(rest, fem.boundary_dofs(V))
    with pytest.raises(ValueError, match=r"no edge of the mesh has the tag 9; tags of edges are \["):
        fem.boundary_dofs(V, tag=9)


def test_tagged_edges_of_polygons() -> None:
    plain = ZOO["polygons"]()
    loop = plain.boundary_loops[0].tolist()
    pairs = list(zip(loop, [*loop[1:], loop[0]], strict=True))
    msh = ControlMesh(plain.vertices, np.split(plain.face_vertices, plain.face_offsets[1:-1]), edge_tags={pairs[0]: 1})
    V = fem.functionspace(msh, SCALAR, boundary="crease")
    a, b = msh.vertices[list(pairs[0])]
    tagged = fem.boundary_dofs(V, tag=1)
    assert 4 <= tagged.size <= 6  # two edges of cubic splines, with two more at ends that are no corners
    assert np.isin(tagged, fem.boundary_dofs(V)).all()
    assert np.linalg.norm(V.reference_points[tagged] - (a + b) / 2, axis=1).max() < 1.6 * np.linalg.norm(a - b)


def test_a_marker_and_a_tag_are_refused() -> None:
    with pytest.raises(ValueError, match="give a marker or a tag, not both"):
        fem.boundary_dofs(unit_square(), lambda x: x[0] < 1, tag=3)


# ---- boundary_dofs with slope


@pytest.mark.parametrize("times", [0, 2])
@pytest.mark.parametrize("boundary", ["clamped", "crease"])
@pytest.mark.parametrize("name", WITH_RIM)
def test_all_other_functions_have_no_value_and_no_slope(name: str, boundary: str, times: int) -> None:
    V = space(name, boundary, times)
    found = fem.boundary_dofs(V, slope=True)
    assert set(fem.boundary_dofs(V)) <= set(found)
    value, slope = slopes_on_the_rim(with_random_values(V, others(V, found)))
    np.testing.assert_allclose(value, 0.0, atol=1e-12)
    np.testing.assert_allclose(slope, 0.0, atol=1e-11)  # differences of values of size 2, over cells of size 0.1


@pytest.mark.parametrize("times", [0, 2])
def test_each_of_these_functions_has_a_value_or_a_slope(times: int) -> None:
    for name in ("grid", "wheel6", "l_domain_tagged", "rim_of_four"):
        V = space(name, times=times)
        for dof in fem.boundary_dofs(V, slope=True):
            value, slope = slopes_on_the_rim(with_random_values(V, [dof]))
            assert max(np.abs(value).max(), np.abs(slope).max()) > 1e-4, dof


def test_numbers_of_slope_dofs_are_those_of_splines() -> None:
    V = unit_square()
    assert fem.boundary_dofs(V, slope=True).size == 4 * 6 + 4 * 4  # the two outermost rings of 7 x 7
    assert fem.boundary_dofs(V, lambda x: np.isclose(x[1], 0.0), slope=True).size == 2 * 7


# ---- region_dofs


@pytest.mark.parametrize("times", [0, 2])
@pytest.mark.parametrize("name", ["grid", "torus", "wheel6", "tripod", "polygons", "cube_and_torus"])
def test_region_dofs_are_those_that_do_not_vanish_there(name: str, times: int) -> None:
    V = space(name, times=times)
    faces = [0, 2]
    found = fem.region_dofs(V, faces)
    rows = bernstein_rows(V.cells)
    there = np.repeat(np.isin(V.cells.face[V.cells.piece_cell], faces), 16)
    largest = abs(rows[there]).max(axis=0).toarray().ravel()
    np.testing.assert_array_equal(found, np.flatnonzero(largest > 1e-10))
    assert found.dtype == np.int32


def test_regions_by_tag() -> None:
    plain = generators.torus((6, 5))
    msh = ControlMesh(plain.vertices, plain.quads, face_tags=np.arange(30) % 7)
    V = adapt.refine(fem.functionspace(msh, SCALAR), [4])
    np.testing.assert_array_equal(fem.region_dofs(V, tag=3), fem.region_dofs(V, np.arange(3, 30, 7)))
    with pytest.raises(ValueError, match=r"no face of the mesh has the tag 8; tags of faces are \["):
        fem.region_dofs(V, tag=8)
    assert fem.region_dofs(V, []).size == 0


@pytest.mark.parametrize("arguments", [{}, {"faces": [0], "tag": 1}])
def test_regions_are_named_once(arguments: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="give the faces of the region, or their tag"):
        fem.region_dofs(space("torus"), **arguments)  # type: ignore[arg-type]


def test_faces_that_are_not_there_are_refused() -> None:
    V = space("torus")
    with pytest.raises(ValueError, match="faces run from 0 to 19; got 0 to 20"):
        fem.region_dofs(V, [0, 20])
    with pytest.raises(TypeError, match="faces must be integers"):
        fem.region_dofs(V, np.arange(20) == 3)


# ---- Values given


def test_a_number_goes_to_all() -> None:
    V = unit_square()
    bc = fem.dirichletbc(2.5, [4, 1, 4], V)
    assert bc.function_space is V
    assert (bc.dofs.tolist(), bc.values.tolist()) == ([1, 4], [2.5, 2.5])
    assert (bc.dofs.dtype, bc.values.dtype) == (np.int32, np.float64)


def test_values_go_with_their_dofs() -> None:
    bc = fem.dirichletbc([1.0, 2.0, 3.0], [7, 5, 6], unit_square())
    assert (bc.dofs.tolist(), bc.values.tolist()) == ([5, 6, 7], [2.0, 3.0, 1.0])


def test_vectors_by_component_and_by_dof() -> None:
    V = unit_square(shape=(2,))
    by_component = fem.dirichletbc((1.0, 2.0), [3, 5, 4], V)
    assert by_component.dofs.tolist() == [6, 7, 8, 9, 10, 11]
    assert by_component.values.tolist() == [1.0, 2.0] * 3
    by_dof = fem.dirichletbc([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]], [3, 5, 4], V)
    assert by_dof.values.tolist() == [1.0, 2.0, 5.0, 6.0, 3.0, 4.0]
    assert fem.dirichletbc(9.0, [3], V).values.tolist() == [9.0, 9.0]


def test_one_component() -> None:
    V = unit_square(shape=(2,))
    bc = fem.dirichletbc([1.0, 2.0], [3, 5], V.sub(1))
    assert bc.function_space is V
    assert (bc.dofs.tolist(), bc.values.tolist()) == ([7, 11], [1.0, 2.0])


def test_constants_are_read_at_once() -> None:
    V = unit_square()
    c = fem.Constant(V.mesh, 3.0)
    for dofs in ([3], [3, 4]):
        bc = fem.dirichletbc(c, dofs, V)
        c.value = 4.0
        assert set(bc.values) == {3.0}
        c.value = 3.0


def test_no_dofs_are_no_condition() -> None:
    V = unit_square()
    for value in (1.0, ufl.SpatialCoordinate(V.mesh)[0], lambda x: x[0]):
        bc = fem.dirichletbc(value, [], V)
        assert bc.dofs.shape == bc.values.shape == (0,)


@pytest.mark.parametrize("dofs", [[-1], [49], [0, 50]])
def test_dofs_that_are_not_there_are_refused(dofs: list[int]) -> None:
    with pytest.raises(ValueError, match=f"dofs run from 0 to 48; got {min(dofs)} to {max(dofs)}"):
        fem.dirichletbc(0.0, dofs, unit_square())


@pytest.mark.parametrize("dofs", [[0.5], np.ones(49, dtype=bool), [[1, 2]]])
def test_dofs_are_a_row_of_integers(dofs: npt.ArrayLike) -> None:
    with pytest.raises(TypeError, match="dofs must be integers of shape"):
        fem.dirichletbc(0.0, dofs, unit_square())


def test_values_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match=r"a value of shape \(3,\) does not fit 2 dofs with 1 components"):
        fem.dirichletbc([1.0, 2.0, 3.0], [4, 5], unit_square())
    with pytest.raises(ValueError, match=r"a value of shape \(2, 3\) does not fit 2 dofs with 2 components"):
        fem.dirichletbc(np.ones((2, 3)), [4, 5], unit_square(shape=(2,)))


def test_values_are_finite() -> None:
    with pytest.raises(ValueError, match="the value nan is not finite"):
        fem.dirichletbc(np.nan, [4, 5], unit_square())


def test_conditions_are_on_spaces() -> None:
    with pytest.raises(
        TypeError, match=r"dirichletbc needs a space from fem\.functionspace, or V\.sub\(c\), got Function"
    ):
        fem.dirichletbc(0.0, [4, 5], fem.Function(unit_square()))  # type: ignore[arg-type]


def test_functions_that_are_constant_on_cells_have_no_conditions() -> None:
    D = fem.functionspace(unit_square().mesh, ("DG", 0))
    for name, find in (
        ("locate_dofs_geometrical", lambda V: fem.locate_dofs_geometrical(V, lambda x: x[0] < 1.0)),
        ("boundary_dofs", fem.boundary_dofs),
        ("region_dofs", lambda V: fem.region_dofs(V, [0])),
        ("point_values", lambda V: fem.point_values(V, [0], [[0.5, 0.5]])),
    ):
        with pytest.raises(TypeError, match=rf"{name} needs a space .* got CellwiseSpace\(values \(\), 16 cells of a"):
            find(D)
    with pytest.raises(TypeError, match="dirichletbc needs a space from"):
        fem.dirichletbc(1.0, [0], D)  # type: ignore[arg-type]  # what is refused
