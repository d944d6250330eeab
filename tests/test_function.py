"""Functions and constants: values, and where they are evaluated."""

import numpy as np
import pytest
from refinements import geometry_dofs, random_positions
from zoo import ZOO

import ufl
from thccs_fem import adapt, fem, generators, limit
from thccs_fem.fem.space import FunctionSpace

SCALAR = ("THCCS", 3)


def refined(name: str, shape: tuple[int, ...] = (), boundary: str = "clamped") -> FunctionSpace:
    V = fem.functionspace(ZOO[name](), ("THCCS", 3, shape), boundary=boundary)
    for _ in range(2):
        V = adapt.refine(V, [V.num_functions - 1, V.num_functions // 2])
    return V


def test_functions_are_zero_at_first_and_named() -> None:
    V = fem.functionspace(generators.torus((4, 5)), SCALAR)
    u = fem.Function(V, name="u")
    assert (u.name, str(u), fem.Function(V).name) == ("u", "u", "f")
    assert u.function_space is V
    assert u.x.array.shape == (20,)
    assert u.x.array.dtype == np.float64
    assert not u.x.array.any()


def test_values_are_written_in_place() -> None:
    u = fem.Function(fem.functionspace(generators.torus((4, 5)), SCALAR))
    array = u.x.array
    u.x.array = 2.0
    u.x.array[3] = 5.0
    assert u.x.array is array
    assert array.sum() == 19 * 2.0 + 5.0
    with pytest.raises(ValueError, match="broadcast"):
        u.x.array = np.ones(19)


def test_copies_are_independent() -> None:
    u = fem.Function(fem.functionspace(generators.torus((4, 5)), SCALAR), name="u")
    u.x.array = 1.0
    v = u.copy()
    w = u.copy(name="w")
    v.x.array[:] = 7.0
    assert (v.name, w.name) == ("u", "w")
    assert u.x.array.tolist() == w.x.array.tolist() == [1.0] * 20
    assert v != u  # other coefficients of forms


@pytest.mark.parametrize("boundary", ["clamped", "crease"])
@pytest.mark.parametrize("name", ZOO)
def test_the_constant_is_constant(name: str, boundary: str) -> None:
    u = fem.Function(refined(name, boundary=boundary))
    u.x.array = 3.0
    np.testing.assert_allclose(u.eval(*random_positions(u.function_space.hierarchy, 50)), 3.0, rtol=1e-13)


@pytest.mark.parametrize("boundary", ["clamped", "crease"])
@pytest.mark.parametrize("name", ["grid", "torus", "torus_of_nine", "strip"])
def test_the_position_is_that_of_the_limit_surface(name: str, boundary: str) -> None:
    # On meshes without caps, which are not exactly the limit surface.
    msh = ZOO[name]()
    V = refined(name, (msh.gdim,), boundary)
    x = fem.Function(V)
    x.x.array = geometry_dofs(V.hierarchy).ravel()
    faces, uv, _ = random_positions(V.hierarchy, 100)
    values = x.eval(faces, uv)
    assert values.shape == (100, msh.gdim)
    np.testing.assert_allclose(values, limit.evaluate(V.mesh, faces, uv)[0], atol=1e-13)


def test_scalars_have_one_value_a_point() -> None:
    u = fem.Function(refined("wheel5"))
    assert u.eval([0, 1, 1], [[0.0, 0.0], [0.5, 0.1], [1.0, 1.0]]).shape == (3,)
    assert u.eval(np.zeros(0, dtype=int), np.zeros((0, 2))).shape == (0,)


def test_components_do_not_mix() -> None:
    V = refined("wheel5", (3,))
    scalar = FunctionSpace(V.hierarchy)
    u, rng = fem.Function(V), np.random.default_rng(0)
    u.x.array = rng.random(V.num_dofs)
    positions = random_positions(V.hierarchy, 30)
    for c in range(3):
        component = fem.Function(scalar)
        component.x.array = u.x.array[c::3]
        np.testing.assert_allclose(u.eval(*positions)[:, c], component.eval(*positions), rtol=1e-14)


@pytest.mark.parametrize(
    ("faces", "uv", "match"),
    [([12], [[0.5, 0.5]], "face"), ([-1], [[0.5, 0.5]], "face"), ([0], [[1.5, 0.5]], r"\[0, 1\]")],
)
def test_points_that_are_not_there_are_refused(faces: list[int], uv: list[list[float]], match: str) -> None:
    u = fem.Function(fem.functionspace(ZOO["grid"](), SCALAR))
    with pytest.raises(ValueError, match=match):
        u.eval(faces, uv)


def test_what_is_no_space_is_refused() -> None:
    with pytest.raises(TypeError, match=r"a Function needs a space from fem\.functionspace, got ControlMesh"):
        fem.Function(generators.torus((4, 4)))  # type: ignore[arg-type]


def test_constants_keep_their_shape() -> None:
    msh = generators.torus((4, 4))
    c, v = fem.Constant(msh, 2), fem.Constant(msh, (1, 2, 3))
    assert (c.ufl_shape, v.ufl_shape) == ((), (3,))
    assert float(c) == 2.0
    c.value = 4.5
    v.value = [3.0, 2.0, 1.0]
    v.value[0] += 1.0
    assert float(c) == 4.5
    assert v.value.tolist() == [4.0, 2.0, 1.0]
    with pytest.raises(ValueError, match="broadcast"):
        v.value = np.ones(2)


# ---- Constant on each cell


@pytest.mark.parametrize("name", ["wheel5", "polygons", "cube"])
def test_cellwise_values_are_those_of_the_face_or_cell(name: str) -> None:
    V = refined(name)
    faces, uv, corners = random_positions(V.hierarchy, 200)
    on_faces = fem.Function(fem.functionspace(V.mesh, ("DG", 0)), name="k")
    on_faces.x.array = np.arange(V.mesh.num_faces)
    np.testing.assert_array_equal(on_faces.eval(faces, uv, corners), faces)
    on_cells = fem.Function(fem.cellwise(V, (2,)))
    on_cells.x.array = np.arange(2 * V.num_cells)
    piece, _ = V.cells.locate(faces, uv, corners)
    cell = V.cells.piece_cell[piece]
    np.testing.assert_allclose(on_cells.eval(faces, uv, corners), np.column_stack([2 * cell, 2 * cell + 1]), rtol=1e-13)
    assert on_cells.copy().function_space == on_cells.function_space
    assert on_cells.local_coefficients().shape == (V.cells.num_pieces, 16, 2)


def test_sizes_of_cells_are_roots_of_areas() -> None:
    V = adapt.refine(fem.functionspace(generators.rectangle((4, 2)), SCALAR), [0])
    h = fem.cell_sizes(V)
    assert h.name == "h"
    np.testing.assert_allclose(h.x.array, np.sqrt(1 / 8) * 0.5**V.cells.level, rtol=1e-14)
    sphere = refined("tripod")
    areas = fem.assemble_cells(fem.form(1.0 * ufl.dx(domain=sphere.mesh), on=sphere))
    np.testing.assert_allclose(fem.cell_sizes(sphere).x.array ** 2, areas, rtol=1e-13)  # the same 4 x 4 points
