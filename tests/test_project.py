"""L2 projection: what is in the space stays, and what is not comes near at full order."""

import numpy as np
import numpy.typing as npt
import pytest
from refinements import geometry_dofs
from zoo import ZOO

import ufl
from thccs_fem import adapt, fem, generators
from thccs_fem.fem.space import FunctionSpace
from ufl import as_vector, dx, inner

Floats = npt.NDArray[np.float64]


def space(name: str, boundary: str = "clamped", times: int = 0, shape: tuple[int, ...] = ()) -> FunctionSpace:
    V = fem.functionspace(ZOO[name](), ("THCCS", 3, shape), boundary=boundary)
    for _ in range(times):
        V = adapt.refine(V, [0, V.num_functions - 1, V.num_functions // 2])
    return V


@pytest.mark.parametrize("times", [0, 2])
@pytest.mark.parametrize("boundary", ["clamped", "crease"])
@pytest.mark.parametrize("name", ZOO)
def test_the_position_stays_what_it_is(name: str, boundary: str, times: int) -> None:
    V = space(name, boundary, times)
    expected = geometry_dofs(V.hierarchy)
    # Residuals of 1e-13, condition numbers of the mass matrices up to 1e4.
    by_ufl = fem.project(ufl.SpatialCoordinate(V.mesh)[0], V)
    np.testing.assert_allclose(by_ufl.x.array, expected[:, 0], atol=1e-9)
    by_numpy = fem.project(lambda x: x[1], V)
    np.testing.assert_allclose(by_numpy.x.array, expected[:, 1], atol=1e-9)


def test_functions_stay_what_they_are() -> None:
    V = space("wheel5", times=2)
    u = fem.Function(V)
    u.x.array = np.random.default_rng(0).random(V.num_dofs)
    np.testing.assert_allclose(fem.project(u, V).x.array, u.x.array, atol=1e-10)
    np.testing.assert_allclose(fem.project(2 * u + fem.Constant(V.mesh, 1.0), V).x.array, 2 * u.x.array + 1, atol=1e-10)


def test_coarser_functions_are_carried_over() -> None:
    V = space("wheel5")
    u = fem.Function(V)
    u.x.array = np.random.default_rng(0).random(V.num_dofs)
    V2 = adapt.refine(adapt.refine(V, [0]), [3])
    np.testing.assert_allclose(fem.project(u, V2).x.array, adapt.transfer(u, V2).x.array, atol=1e-10)


def test_finer_functions_are_brought_near() -> None:
    V = space("torus")
    V2 = adapt.refine(V, [0, 5])
    coarse, fine = fem.Function(V), fem.Function(V2)
    coarse.x.array = np.random.default_rng(0).random(V.num_dofs)
    there_and_back = fem.project(adapt.transfer(coarse, V2), V)
    # The integrals are over the finer cells on one side only: the difference is that of the quadratures of the area.
    np.testing.assert_allclose(there_and_back.x.array, coarse.x.array, atol=1e-4)
    fine.x.array = np.random.default_rng(1).random(V2.num_dofs)
    v = ufl.TestFunction(V)
    defect = fem.assemble_vector(fem.form(inner(fem.project(fine, V) - fine, v) * dx))
    np.testing.assert_allclose(defect, 0.0, atol=1e-4)


@pytest.mark.parametrize("boundary", ["clamped", "crease"])
def test_the_error_is_orthogonal_to_the_space(boundary: str) -> None:
    V = space("wheel6", boundary, times=1)
    x, v = ufl.SpatialCoordinate(V.mesh), ufl.TestFunction(V)
    value = ufl.exp(x[0]) * ufl.sin(x[1])
    u = fem.project(value, V)
    defect = fem.assemble_vector(fem.form((value - u) * v * dx, quadrature_degree=11))
    np.testing.assert_allclose(defect, 0.0, atol=1e-12)
    np.testing.assert_allclose(fem.project(lambda x: np.exp(x[0]) * np.sin(x[1]), V).x.array, u.x.array, atol=1e-9)


def test_the_error_falls_at_fourth_order() -> None:
    errors = []
    for n in (4, 8, 16):
        msh = generators.torus((2 * n, n))
        x = ufl.SpatialCoordinate(msh)
        value = ufl.sin(x[0] + x[2])
        e = fem.project(value, fem.functionspace(msh, ("THCCS", 3))) - value
        errors.append(np.sqrt(fem.assemble_scalar(fem.form(e**2 * dx, quadrature_degree=11))))
    orders = np.log2(errors[:-1]) - np.log2(errors[1:])
    assert 3.5 < orders[-1] < 5.0
    assert errors[-1] < 2e-3  # sixteen elements in a wave


@pytest.mark.parametrize("shape", [(1,), (2,), (3,)])
def test_components_are_projected_one_by_one(shape: tuple[int, ...]) -> None:
    V = space("wheel5", times=1, shape=shape)
    scalar = FunctionSpace(V.hierarchy)
    x = ufl.SpatialCoordinate(V.mesh)
    parts = [ufl.exp(x[i]) for i in range(*shape)]
    expected = np.stack([fem.project(part, scalar).x.array for part in parts], axis=1)
    by_ufl = fem.project(as_vector(parts), V)
    np.testing.assert_allclose(by_ufl.x.array.reshape(-1, *shape), expected, atol=1e-11)
    by_numpy = fem.project(lambda x: np.exp(x[: shape[0]]), V)
    np.testing.assert_allclose(by_numpy.x.array.reshape(-1, *shape), expected, atol=1e-9)


@pytest.mark.parametrize("value", [2.5, 3, np.float64(2.5), fem.Constant(generators.torus((3, 3)), 1.0).value])
def test_numbers(value: float) -> None:
    V = space("torus", times=1)
    np.testing.assert_allclose(fem.project(value, V).x.array, float(value), rtol=1e-10)


def test_a_number_for_each_component() -> None:
    V = space("torus", shape=(2,))
    np.testing.assert_allclose(fem.project([1.0, -2.0], V).x.array, [1.0, -2.0] * V.num_functions, rtol=1e-10)


def test_zero_is_zero() -> None:
    V = space("torus")
    assert not fem.project(0.0, V).x.array.any()
    assert not fem.project(lambda x: 0 * x[0], V).x.array.any()
    assert not fem.project(0 * ufl.SpatialCoordinate(V.mesh)[0], V).x.array.any()


def test_values_of_another_shape_are_refused() -> None:
    V = space("torus")
    x = ufl.SpatialCoordinate(V.mesh)
    with pytest.raises(ValueError, match=r"a value of shape \(3,\) cannot be projected on functions of shape \(\)"):
        fem.project(x, V)
    with pytest.raises(ValueError, match=r"a value of shape \(\) cannot be projected on functions of shape \(2,\)"):
        fem.project(1.0, FunctionSpace(V.hierarchy, (2,)))
    with pytest.raises(ValueError, match=r"g\(x\) returned shape"):
        fem.project(lambda x: x, V)


@pytest.mark.parametrize("value", ["sin(x)", {}])
def test_what_has_no_values_is_refused(value: object) -> None:
    with pytest.raises(TypeError, match=f"a {type(value).__name__} cannot be projected"):
        fem.project(value, space("torus"))  # type: ignore[arg-type]


def test_values_that_are_not_finite_are_refused() -> None:
    V = space("torus")
    for value in (lambda x: x[0] * np.nan, np.inf, ufl.ln(ufl.SpatialCoordinate(V.mesh)[0])):
        with pytest.raises(ValueError, match="the value is not finite everywhere"):
            fem.project(value, V)


@pytest.mark.parametrize("name", ["torus", "wheel5", "polygons"])
def test_on_cells_it_is_the_mean(name: str) -> None:
    V = space(name, times=2)
    g = ufl.SpatialCoordinate(V.mesh)[0] ** 2
    faces = fem.functionspace(V.mesh, ("DG", 0))
    for W, cell in ((fem.cellwise(V), np.arange(V.num_cells)), (faces, V.cells.face)):
        integrals, areas = (
            np.bincount(cell, weights=fem.assemble_cells(fem.form(f * dx, quadrature_degree=11, on=V)))
            for f in (g, fem.Constant(V.mesh, 1.0))
        )
        finest = g + fem.Function(V)  # integrated on the cells of V, as above
        np.testing.assert_allclose(fem.project(finest, W).x.array, integrals / areas, rtol=1e-12)
        np.testing.assert_allclose(fem.project(lambda x: x[0] ** 2, W).x.array, fem.project(g, W).x.array, rtol=1e-12)
        np.testing.assert_allclose(fem.project(3.5, W).x.array, 3.5, rtol=1e-12)


def test_on_cells_with_components() -> None:
    msh = generators.rectangle((3, 2))
    W = fem.functionspace(msh, ("DG", 0, (2,)))
    x = ufl.SpatialCoordinate(msh)
    centres = msh.vertices[msh.quads].mean(axis=1)
    for value in (x, lambda x: x[:2]):
        np.testing.assert_allclose(fem.project(value, W).x.array.reshape(-1, 2), centres, rtol=1e-12)
    with pytest.raises(ValueError, match="cannot be projected on functions of shape"):
        fem.project(x[0], W)
    with pytest.raises(ValueError, match="not finite"):
        fem.project(lambda x: np.nan * x[:2], W)


def test_on_something_else() -> None:
    with pytest.raises(TypeError, match="project needs a space"):
        fem.project(1.0, generators.rectangle((2, 2)))  # type: ignore[arg-type]  # what is tested
