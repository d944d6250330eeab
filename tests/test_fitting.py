"""Prescribed values that are expressions: what is fitted to them, and how well."""

import warnings

import numpy as np
import pytest
from refinements import geometry_dofs
from rim import WITH_RIM, slopes_on_the_rim, space, unit_square, with_random_values
from zoo import ZOO

import ufl
from thccs_fem import fem, generators, limit
from thccs_fem.fem.space import FunctionSpace
from ufl import as_vector, sin, sqrt

SCALAR = ("THCCS", 3)

# The position is in the space, so that its projection must find its coefficients, on any part of the surface, whatever
# the refinement. Tolerance: functions that hardly reach into the part are determined by what has a weight of 1e-6.
TOLERANCE = 1e-8


@pytest.mark.parametrize("times", [0, 2])
@pytest.mark.parametrize("boundary", ["clamped", "crease"])
@pytest.mark.parametrize("name", WITH_RIM)
def test_the_position_on_the_boundary(name: str, boundary: str, times: int) -> None:
    V = space(name, boundary, times)
    dofs = fem.boundary_dofs(V)
    x = ufl.SpatialCoordinate(V.mesh)
    expected = geometry_dofs(V.hierarchy)[dofs]
    np.testing.assert_allclose(fem.dirichletbc(x[1], dofs, V).values, expected[:, 1], atol=TOLERANCE)
    np.testing.assert_allclose(fem.dirichletbc(lambda x: x[0], dofs, V).values, expected[:, 0], atol=TOLERANCE)


@pytest.mark.parametrize("times", [0, 2])
@pytest.mark.parametrize("boundary", ["clamped", "crease"])
@pytest.mark.parametrize("name", ZOO)
def test_the_position_on_one_face(name: str, boundary: str, times: int) -> None:
    V = space(name, boundary, times)
    dofs = fem.region_dofs(V, [0])
    values = fem.dirichletbc(ufl.SpatialCoordinate(V.mesh)[0], dofs, V).values
    np.testing.assert_allclose(values, geometry_dofs(V.hierarchy)[dofs, 0], atol=TOLERANCE)


@pytest.mark.parametrize("times", [0, 2])
def test_the_position_at_single_functions(times: int) -> None:
    V = space("wheel5", times=times)
    x = ufl.SpatialCoordinate(V.mesh)
    expected = geometry_dofs(V.hierarchy)
    for dof in range(0, V.num_functions, 7):
        np.testing.assert_allclose(fem.dirichletbc(x[2], [dof], V).values, expected[[dof], 2], atol=TOLERANCE)


def test_parts_of_the_boundary_are_fitted_for_themselves() -> None:
    # Zero on the left side, but not zero, or not even defined, beside it.
    V = unit_square(times=1)
    left = fem.boundary_dofs(V, lambda x: np.isclose(x[0], 0.0))
    x = ufl.SpatialCoordinate(V.mesh)
    jump = fem.dirichletbc(ufl.conditional(ufl.gt(x[0], 1e-9), 1e3, 0.0), left, V)
    np.testing.assert_allclose(jump.values, 0.0, atol=0.1)  # 1e3 with the weight 1e-6
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        undefined = fem.dirichletbc(lambda x: np.where(x[0] > 1e-9, np.nan, 3.0), left, V)
    np.testing.assert_allclose(undefined.values, 3.0, rtol=1e-12)


def test_values_of_a_region_are_those_of_the_expression() -> None:
    # Smooth, but not in the space: the projection comes near it in the region at full order.
    errors = []
    for n in (8, 16):
        msh = generators.torus((2 * n, n))
        V = fem.functionspace(msh, SCALAR)
        x = ufl.SpatialCoordinate(msh)
        faces = np.flatnonzero(msh.vertices[msh.quads].mean(axis=1)[:, 0] > 1.5)
        u = fem.Function(V)
        bc = fem.dirichletbc(sin(x[0] + 2 * x[1]), fem.region_dofs(V, faces), V)
        u.x.array[bc.dofs] = bc.values
        uv = np.random.default_rng(0).random((faces.size, 2))
        X = limit.evaluate(msh, faces, uv)[0]
        errors.append(np.abs(u.eval(faces, uv) - np.sin(X[:, 0] + 2 * X[:, 1])).max())
    assert errors[1] < 0.02
    assert 3.0 < np.log2(errors[0] / errors[1]) < 5.5  # fourth order, of the maximum over random points


def test_expressions_with_functions() -> None:
    V = space("wheel5", times=1)
    u = with_random_values(V, np.arange(V.num_functions))
    c = fem.Constant(V.mesh, 2.0)
    dofs = fem.boundary_dofs(V)
    np.testing.assert_allclose(fem.dirichletbc(c * u, dofs, V).values, 2.0 * u.x.array[dofs], atol=TOLERANCE)
    np.testing.assert_allclose(fem.dirichletbc(u, dofs, V).values, u.x.array[dofs], atol=TOLERANCE)


def test_expressions_with_components() -> None:
    scalar = space("wheel5")
    V = FunctionSpace(scalar.hierarchy, (2,))
    x = ufl.SpatialCoordinate(V.mesh)
    dofs = fem.boundary_dofs(V)
    first, second = (fem.dirichletbc(x[i], dofs, scalar).values for i in range(2))
    both = fem.dirichletbc(as_vector([x[0], x[1]]), dofs, V)
    np.testing.assert_allclose(both.values.reshape(-1, 2), np.stack([first, second], axis=1), atol=1e-12)
    one = fem.dirichletbc(lambda x: x[1], dofs, V.sub(1))
    np.testing.assert_array_equal(one.dofs, 2 * dofs + 1)
    np.testing.assert_allclose(one.values, second, atol=1e-12)


def test_expressions_of_another_shape_are_refused() -> None:
    V = unit_square()
    with pytest.raises(ValueError, match=r"the expression has shape \(2,\); 1 components are needed"):
        fem.dirichletbc(ufl.SpatialCoordinate(V.mesh), fem.boundary_dofs(V), V)


def test_expressions_are_finite_where_they_are_prescribed() -> None:
    V = unit_square()
    x = ufl.SpatialCoordinate(V.mesh)
    with pytest.raises(ValueError, match="the value is not finite on 8 of the 16 edges"):
        fem.dirichletbc(sqrt(x[1] - 0.5), fem.boundary_dofs(V), V)


def test_conditions_hold_at_points_of_the_rim() -> None:
    V = space("wheel6", times=2)
    x = ufl.SpatialCoordinate(V.mesh)
    u, dofs = fem.Function(V), fem.boundary_dofs(V)
    u.x.array = np.random.default_rng(0).random(V.num_functions)
    bc = fem.dirichletbc(x[0] - x[2], dofs, V)
    u.x.array[bc.dofs] = bc.values
    edges = np.flatnonzero(V.mesh.edge_faces[:, 1] < 0)
    faces, uv = [], []
    for edge in edges:
        face = V.mesh.edge_faces[edge, 0]
        k = next(k for k in range(4) if set(np.roll(V.mesh.quads[face], -k)[:2]) == set(V.mesh.edges[edge]))
        faces.append(face)
        uv.append([[0.3, 0.0], [1.0, 0.3], [0.7, 1.0], [0.0, 0.7]][k])
    X = limit.evaluate(V.mesh, faces, uv)[0]
    np.testing.assert_allclose(u.eval(faces, uv), X[:, 0] - X[:, 2], atol=1e-9)


# ---- Slopes


@pytest.mark.parametrize("times", [0, 2])
@pytest.mark.parametrize("boundary", ["clamped", "crease"])
@pytest.mark.parametrize("name", WITH_RIM)
def test_value_and_slope_determine_what_is_in_the_space(name: str, boundary: str, times: int) -> None:
    # Random coefficients: nothing is smooth here that could help.
    V = space(name, boundary, times)
    u = with_random_values(V, np.arange(V.num_functions))
    dofs = fem.boundary_dofs(V, slope=True)
    bc = fem.dirichletbc(u, dofs, V, slope=True)
    np.testing.assert_array_equal(bc.dofs, dofs)
    np.testing.assert_allclose(bc.values, u.x.array[dofs], atol=TOLERANCE)


@pytest.mark.parametrize("times", [0, 2])
def test_slopes_on_a_part_of_the_boundary(times: int) -> None:
    V = unit_square(times=times)
    dofs = fem.boundary_dofs(V, lambda x: np.isclose(x[0], 0.0), slope=True)
    x = ufl.SpatialCoordinate(V.mesh)
    u = fem.Function(V)
    u.x.array[dofs] = fem.dirichletbc(1.0 + 2.0 * x[0], dofs, V, slope=True).values
    value, slope = slopes_on_the_rim(u)
    on_left = slopes_on_the_rim(fem.project(x[0], V))[0] < 1e-9
    assert np.count_nonzero(on_left) >= 4
    np.testing.assert_allclose(value[on_left], 1.0, atol=TOLERANCE)
    np.testing.assert_allclose(slope[on_left], 2.0, atol=10 * TOLERANCE)  # cells of width 1/16 at least


def test_values_and_slopes_are_fitted_at_full_order() -> None:
    errors = []
    for n in (4, 8):
        msh = generators.disc(n)
        V = fem.functionspace(msh, SCALAR)
        x = ufl.SpatialCoordinate(msh)
        u, dofs = fem.Function(V), fem.boundary_dofs(V, slope=True)
        exact = sin(2 * x[0] + 1) * ufl.cos(1.5 * x[1])
        u.x.array[dofs] = fem.dirichletbc(exact, dofs, V, slope=True).values
        value, slope = slopes_on_the_rim(u)
        # The exact ones, from the position and the conormal: both are values of functions of the space.
        X, N = np.transpose([slopes_on_the_rim(fem.project(x[i], V)) for i in range(2)], (1, 2, 0))
        a, b = 2 * X[:, 0] + 1, 1.5 * X[:, 1]
        gradient = np.stack([2 * np.cos(a) * np.cos(b), -1.5 * np.sin(a) * np.sin(b)], axis=1)
        errors.append([np.abs(value - np.sin(a) * np.cos(b)).max(), np.abs(slope - (gradient * N).sum(axis=1)).max()])
    rates = np.log2(np.divide(*errors))
    assert ((3.0 < rates) & (rates < 6.0)).all(), rates  # 4 for values; for slopes 3, or 4 where they superconverge
    assert (np.array(errors[1]) < [1e-4, 1e-3]).all(), errors


def test_zero_value_and_slope_are_zero_coefficients() -> None:
    # (1 - x^2)^2 (1 - y^2)^2 and both its derivatives vanish on the rim; inside it is not small, nor in the space.
    V = fem.functionspace(generators.rectangle((5, 5)), SCALAR)
    x = ufl.SpatialCoordinate(V.mesh)
    lower, upper = V.mesh.vertices.min(axis=0), V.mesh.vertices.max(axis=0)
    bump = np.prod([16 * ((x[i] - lower[i]) * (upper[i] - x[i])) ** 2 / (upper[i] - lower[i]) ** 4 for i in (0, 1)])
    dofs = fem.boundary_dofs(V, slope=True)
    np.testing.assert_allclose(fem.dirichletbc(bump, dofs, V, slope=True).values, 0.0, atol=TOLERANCE)
    assert np.abs(fem.dirichletbc(bump, dofs, V).values).max() > 1e-4  # fitted on the cells, it is merely near


def test_slopes_of_vectors() -> None:
    scalar = space("wheel5")
    V = FunctionSpace(scalar.hierarchy, (2,))
    x = ufl.SpatialCoordinate(V.mesh)
    dofs = fem.boundary_dofs(V, slope=True)
    both = fem.dirichletbc(as_vector([sin(x[0]), x[1] * x[2]]), dofs, V, slope=True).values.reshape(-1, 2)
    for c, g in enumerate((sin(x[0]), x[1] * x[2])):
        np.testing.assert_allclose(fem.dirichletbc(g, dofs, scalar, slope=True).values, both[:, c], atol=1e-10)
    one = fem.dirichletbc(x[1] * x[2], dofs, V.sub(1), slope=True)
    np.testing.assert_array_equal(one.dofs, 2 * dofs + 1)
    np.testing.assert_allclose(one.values, both[:, 1], atol=1e-10)


def test_slopes_that_cannot_be_had_are_refused() -> None:
    V = unit_square()
    dofs = fem.boundary_dofs(V, slope=True)
    with pytest.raises(TypeError, match="slope=True needs a UFL expression, whose gradient is known, got function"):
        fem.dirichletbc(lambda x: x[0], dofs, V, slope=True)
    x = ufl.SpatialCoordinate(V.mesh)
    with pytest.raises(ValueError, match="9 of the 49 dofs have neither value nor slope on the boundary, the first is"):
        fem.dirichletbc(x[0], np.arange(49), V, slope=True)
    with pytest.raises(ValueError, match="the value is not finite on 8 of the 16 edges"):
        fem.dirichletbc(sqrt(x[1] - 0.5), dofs, V, slope=True)
