"""Function spaces: what they count, where their functions sit, which of them are the same."""

import numpy as np
import pytest
from scipy.spatial import KDTree
from zoo import ZOO

from thccs_fem import adapt, fem, generators, limit
from thccs_fem.fem.space import Component, FunctionSpace
from thccs_fem.mesh import ControlMesh

SCALAR = ("THCCS", 3)


def space(name: str, boundary: str = "clamped") -> FunctionSpace:
    return fem.functionspace(ZOO[name](), SCALAR, boundary=boundary)


def test_numbers_on_a_rectangle_are_those_of_tensor_product_splines() -> None:
    msh = generators.rectangle((5, 4))
    V = fem.functionspace(msh, SCALAR)
    assert (V.num_dofs, V.num_functions, V.num_cells, V.num_levels) == (8 * 7, 8 * 7, 20, 1)
    assert fem.functionspace(msh, SCALAR, boundary="crease").num_dofs == 6 * 5


def test_vectors_have_a_dof_for_each_component() -> None:
    V = fem.functionspace(generators.torus((4, 5)), ("THCCS", 3, (2,)))
    assert (V.num_dofs, V.num_functions, V.block_size, V.value_shape) == (40, 20, 2, (2,))


def test_spaces_are_on_the_domain_of_their_mesh() -> None:
    msh = generators.torus((4, 5))
    V = fem.functionspace(msh, SCALAR)
    assert V.mesh is msh
    assert V.ufl_domain() is msh.ufl_domain()


def test_cells_are_made_once_for_all_value_shapes() -> None:
    V = fem.functionspace(generators.torus((4, 5)), SCALAR)
    assert FunctionSpace(V.hierarchy, (3,)).cells is V.cells


# ---- Reference points


@pytest.mark.parametrize("name", [name for name, make in ZOO.items() if make().is_quad and not name.startswith("cube")])
def test_functions_sit_at_the_limit_points_of_their_vertices(name: str) -> None:
    V = space(name, "crease")
    msh = V.mesh
    assert V.num_functions == msh.num_vertices  # what has a cube is subdivided first
    for corner, uv in enumerate([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]):
        points = limit.evaluate(msh, np.arange(msh.num_faces), np.tile(uv, (msh.num_faces, 1)))[0]
        # Masks against a subdivision that goes deeper until the corner is regular.
        np.testing.assert_allclose(V.reference_points[msh.quads[:, corner]], points, atol=1e-8)


def test_trace_functions_sit_at_the_rim_and_the_ones_beside_them_a_third_inside() -> None:
    V = fem.functionspace(generators.rectangle((3, 2), lower=(0.0, 0.0), upper=(3.0, 2.0)), SCALAR)
    line = [[0.0, 1 / 3, 1.0, 2.0, 3 - 1 / 3, 3.0], [0.0, 1 / 3, 1.0, 2 - 1 / 3, 2.0]]
    expected = np.stack(np.meshgrid(*line), axis=-1).reshape(-1, 2)
    distance, nearest = KDTree(V.reference_points).query(expected)
    assert distance.max() < 1e-14
    assert sorted(nearest) == list(range(V.num_functions))


def test_functions_of_finer_levels_sit_at_finer_points() -> None:
    msh = generators.torus((4, 5))
    V = adapt.refine(fem.functionspace(msh, SCALAR), [3])
    faces, ends = np.repeat(np.arange(20), 9), np.array([0.0, 0.5, 1.0])
    uv = np.tile(np.stack(np.meshgrid(ends, ends), axis=-1).reshape(-1, 2), (20, 1))
    distance, _ = KDTree(limit.evaluate(msh, faces, uv)[0]).query(V.reference_points)
    assert V.num_levels == 2
    assert distance.max() < 1e-14


# ---- The same or not


def test_spaces_are_equal_if_their_functions_are() -> None:
    msh = generators.torus((6, 5))
    V = fem.functionspace(msh, SCALAR)
    same = fem.functionspace(msh, SCALAR)
    assert V == same
    assert hash(V) == hash(same)
    one, other = adapt.refine(V, [0]), adapt.refine(same, [0])
    assert one == other
    assert hash(one) == hash(other)
    different = [one, adapt.refine(V, [1]), fem.functionspace(msh, ("THCCS", 3, (1,)))]
    different.append(fem.functionspace(generators.torus((6, 5)), SCALAR))
    assert all(V != W for W in different)
    assert len({V, same, *different}) == 5


def test_boundary_rules_tell_spaces_apart() -> None:
    msh = generators.rectangle((3, 3))
    assert fem.functionspace(msh, SCALAR) != fem.functionspace(msh, SCALAR, boundary="crease")


def test_refinements_are_refinements_of_what_they_refine() -> None:
    V = space("wheel5")
    V2 = adapt.refine(V, [0])
    assert V2.is_refinement_of(V)
    assert not V.is_refinement_of(V2)


@pytest.mark.parametrize("shape", [(), (2,)])
def test_prolongation_carries_every_component(shape: tuple[int, ...]) -> None:
    V = fem.functionspace(generators.torus((5, 4)), ("THCCS", 3, shape))
    V2 = adapt.refine(V, [0, 7])
    P = V2.prolongation(V)
    assert P.shape == (V2.num_dofs, V.num_dofs)
    values = np.arange(1.0, V.block_size + 1)  # a constant in each component
    np.testing.assert_allclose(P @ np.tile(values, V.num_functions), np.tile(values, V2.num_functions), rtol=1e-14)


def test_prolongation_between_different_values_is_refused() -> None:
    V = fem.functionspace(generators.torus((5, 4)), SCALAR)
    with pytest.raises(ValueError, match=r"values of shape \(\) cannot be carried to shape \(2,\)"):
        FunctionSpace(V.hierarchy, (2,)).prolongation(V)


# ---- Components


def test_components_know_their_space() -> None:
    V = fem.functionspace(generators.torus((5, 4)), ("THCCS", 3, (2,)))
    component = V.sub(1)
    assert isinstance(component, Component)
    assert (component.space, component.component) == (V, 1)


@pytest.mark.parametrize(("shape", "component"), [((), 0), ((2,), 2), ((2,), -1)])
def test_components_that_are_not_there_are_refused(shape: tuple[int, ...], component: int) -> None:
    V = fem.functionspace(generators.torus((5, 4)), ("THCCS", 3, shape))
    with pytest.raises(IndexError, match=f"component {component} of a space"):
        V.sub(component)


# ---- What is refused


def test_what_is_no_mesh_is_refused() -> None:
    with pytest.raises(TypeError, match=r"needs a thccs_fem\.mesh\.ControlMesh, got str"):
        fem.functionspace("mesh.obj", SCALAR)  # type: ignore[arg-type]


def test_unknown_boundary_rules_are_refused() -> None:
    with pytest.raises(ValueError, match='boundary is \'smooth\'; it must be "clamped" or "crease"'):
        fem.functionspace(generators.torus((4, 4)), SCALAR, boundary="smooth")  # type: ignore[arg-type]


@pytest.mark.parametrize("element", [("Lagrange", 3), ("THCCS", 2), ("THCCS",), "THCCS", ("THCCS", 3, (2,), 1)])
def test_other_elements_are_refused(element: object) -> None:
    with pytest.raises(ValueError, match="the element is"):
        fem.functionspace(generators.torus((4, 4)), element)  # type: ignore[arg-type]


@pytest.mark.parametrize("shape", [3, (0,), (2, 2), (1.5,)])
def test_other_value_shapes_are_refused(shape: object) -> None:
    with pytest.raises(ValueError, match="the value shape is"):
        fem.functionspace(generators.torus((4, 4)), ("THCCS", 3, shape))


def test_caps_need_a_cut() -> None:
    with pytest.raises(TypeError, match=r"cap_level is 4.5; it must be an integer"):
        fem.functionspace(generators.rectangle((2, 2)), ("THCCS", 3), cap_level=4.5)  # type: ignore[call-overload]
    with pytest.raises(ValueError, match="cap_level is 0"):
        fem.functionspace(generators.torus((4, 4)), SCALAR, cap_level=0)


def test_planes_that_fold_are_refused() -> None:
    vertices = generators.rectangle((4, 4)).vertices.copy()
    vertices[12] += [0.9, 0.9]  # the centre goes past its neighbours
    with pytest.raises(ValueError, match="fold"):
        fem.functionspace(ControlMesh(vertices, generators.rectangle((4, 4)).quads), SCALAR)


# ---- Functions that are constant on cells


def test_cellwise_spaces_count_faces_or_cells() -> None:
    msh = generators.rectangle((3, 2))
    on_faces = fem.functionspace(msh, ("DG", 0))
    assert (on_faces.num_dofs, on_faces.num_cells, on_faces.block_size, on_faces.value_shape) == (6, 6, 1, ())
    V = fem.functionspace(msh, SCALAR)
    fine = adapt.refine(V, [0, V.num_functions // 2])
    on_cells = fem.cellwise(fine, (3,))
    assert (on_cells.num_dofs, on_cells.num_cells) == (3 * fine.num_cells, fine.num_cells)
    assert on_cells.cells is fine.cells
    assert fem.functionspace(msh, ("DG", 0, (2,))).num_dofs == 12


def test_cellwise_spaces_are_the_same_if_their_cells_are() -> None:
    msh = generators.rectangle((3, 2))
    V = fem.functionspace(msh, SCALAR)
    fine = adapt.refine(V, [0])
    on_faces, on_cells = fem.functionspace(msh, ("DG", 0)), fem.cellwise(V)
    assert on_faces == fem.functionspace(msh, ("DG", 0))
    assert hash(on_cells) == hash(fem.cellwise(fem.functionspace(msh, SCALAR)))
    assert on_cells == fem.cellwise(fem.functionspace(msh, SCALAR))
    others = [
        on_faces,
        fem.cellwise(V, (2,)),
        fem.cellwise(fine),
        fem.functionspace(generators.torus((4, 5)), ("DG", 0)),
    ]
    for other in others:
        assert on_cells != other
    assert str(on_cells) == "CellwiseSpace(values (), 6 cells of a hierarchy of 1 levels)"
    assert str(on_faces) == "CellwiseSpace(values (), 6 cells of a control mesh)"


@pytest.mark.parametrize("name", ["grid", "wheel5", "polygons", "tetrahedron", "cube"])
def test_cells_inherit_what_their_ancestors_have(name: str) -> None:
    coarse = adapt.refine(space(name), [0, 1])
    fine = coarse
    for step in range(2):
        fine = adapt.refine(fine, np.arange(step, fine.num_functions, 3))
    dofs = fem.cellwise(coarse).numbers_of(fine.cells)
    np.testing.assert_array_equal(coarse.cells.face[dofs], fine.cells.face)
    np.testing.assert_array_equal(fem.cellwise(fine).numbers_of(fine.cells), np.arange(fine.num_cells))
    np.testing.assert_array_equal(fem.functionspace(fine.mesh, ("DG", 0)).numbers_of(fine.cells), fine.cells.face)
    areas = [fem.cell_sizes(V).x.array ** 2 for V in (coarse, fine)]
    # Caps sink where cells come near: areas of irregular cells change a little.
    np.testing.assert_allclose(np.bincount(dofs, weights=areas[1]), areas[0], rtol=1e-4)
    with pytest.raises(ValueError, match=r"values of .* cells are not known: .* goes over to finer cells only"):
        fem.cellwise(fine).numbers_of(coarse.cells)


@pytest.mark.parametrize("element", [("DG", 1), ("DG",), ("DP", 0)])
def test_elements_like_cellwise_ones_are_refused(element: object) -> None:
    with pytest.raises(
        ValueError, match=r'it must be .* or \("DG", 0\) for coefficients that are constant on each face'
    ):
        fem.functionspace(generators.torus((4, 4)), element)  # type: ignore[call-overload]
