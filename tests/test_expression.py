"""Values of UFL expressions and of functions g(x), against what they say."""

import numpy as np
import numpy.typing as npt
import pytest
from zoo import ZOO

import ufl
from thccs_fem import adapt, fem, generators, limit
from thccs_fem.extraction import evaluate_pieces
from thccs_fem.fem.expression import values_at
from thccs_fem.fem.space import FunctionSpace
from ufl import as_vector, cos, div, dot, exp, grad, inner, sin

Floats = npt.NDArray[np.float64]

SCALAR = ("THCCS", 3)
POINTS = np.array([[0.0, 0.0], [0.25, 0.5], [1.0, 0.3]])


def every_piece(V: FunctionSpace) -> npt.NDArray[np.int32]:
    return np.arange(V.cells.num_pieces, dtype=np.int32)


def positions(V: FunctionSpace) -> Floats:
    """Where the points lie, shape (pieces, points, 3)."""
    x = np.zeros((V.cells.num_pieces, len(POINTS), 3))
    for q, point in enumerate(POINTS):
        where = np.tile(point, (V.cells.num_pieces, 1))
        x[:, q, : V.mesh.gdim] = evaluate_pieces(V.cells.piece_points, every_piece(V), where)
    return x


def with_random_values(V: FunctionSpace, seed: int = 0) -> fem.Function:
    u = fem.Function(V)
    u.x.array = np.random.default_rng(seed).random(V.num_dofs)
    return u


@pytest.mark.parametrize("name", ["grid", "torus", "wheel5", "polygons"])
def test_functions_of_position(name: str) -> None:
    V = fem.functionspace(ZOO[name](), SCALAR)
    x = ufl.SpatialCoordinate(V.mesh)
    values = fem.Expression(sin(x[0]) * exp(x[1]), POINTS).eval(V, every_piece(V))
    X = positions(V)
    np.testing.assert_allclose(values[..., 0], np.sin(X[..., 0]) * np.exp(X[..., 1]), atol=1e-13)


def test_pieces_are_those_that_were_asked_for() -> None:
    V = fem.functionspace(ZOO["wheel5"](), SCALAR)
    expression = fem.Expression(ufl.SpatialCoordinate(V.mesh)[1], POINTS)
    every = expression.eval(V, every_piece(V))
    some = np.array([7, 0, 7], dtype=np.int32)
    np.testing.assert_array_equal(expression.eval(V, some), every[some])
    assert expression.eval(V, some[:0]).shape == (0, len(POINTS), 1)


def test_functions_and_constants_keep_their_places() -> None:
    # Several of each, in an order that is not that of their making, vectors among them.
    msh = generators.torus((5, 4))
    V, W = fem.functionspace(msh, SCALAR), fem.functionspace(msh, ("THCCS", 3, (2,)))
    u, w, unused, v = (with_random_values(S, seed) for seed, S in enumerate((V, W, V, V)))
    c, d = fem.Constant(msh, 3.0), fem.Constant(msh, (5.0, 7.0))
    expression = fem.Expression(v * c + dot(d, w) * u + 0 * unused, POINTS)

    def expected() -> Floats:
        at = [evaluate_each(f) for f in (u, w, v)]
        return at[2][..., 0] * c.value + (at[1] @ d.value) * at[0][..., 0]

    def evaluate_each(f: fem.Function) -> Floats:
        S, local = f.function_space, f.local_coefficients()
        where = [np.tile(p, (S.cells.num_pieces, 1)) for p in POINTS]
        return np.stack([evaluate_pieces(local, every_piece(S), p) for p in where], axis=1)

    np.testing.assert_allclose(expression.eval(V, every_piece(V))[..., 0], expected(), rtol=1e-13)
    u.x.array += 1.0  # values are read at each evaluation
    c.value = -2.0
    np.testing.assert_allclose(expression.eval(V, every_piece(V))[..., 0], expected(), rtol=1e-13, atol=1e-14)


def test_components_come_in_the_order_of_the_value() -> None:
    V = fem.functionspace(ZOO["wheel5"](), SCALAR)
    x = ufl.SpatialCoordinate(V.mesh)
    X = positions(V)
    values = fem.Expression(ufl.as_matrix([[x[0], 2.0], [x[1], x[2]]]), POINTS).eval(V, every_piece(V))
    expected = np.stack([X[..., 0], np.full(X.shape[:2], 2.0), X[..., 1], X[..., 2]], axis=-1)
    np.testing.assert_allclose(values, expected, rtol=1e-14, atol=1e-15)


def test_gradients_are_along_the_surface() -> None:
    V = fem.functionspace(generators.torus((6, 5)), SCALAR)
    x = ufl.SpatialCoordinate(V.mesh)
    u = fem.project(x[2], V)
    normal = ufl.CellNormal(V.mesh)
    values = fem.Expression(as_vector([dot(grad(u), normal), grad(u)[2] + normal[2] ** 2]), POINTS)
    # The tangential gradient of z is e_z - n_z n.
    expected = np.broadcast_to([0.0, 1.0], (30, 3, 2))
    np.testing.assert_allclose(values.eval(V, every_piece(V)), expected, atol=1e-11)


def test_coarser_functions_are_evaluated_on_finer_pieces() -> None:
    coarse = fem.functionspace(ZOO["torus"](), SCALAR)
    fine = adapt.refine(adapt.refine(coarse, [0]), [20])
    u = with_random_values(coarse)
    same = adapt.transfer(u, fine)
    values = fem.Expression(u, POINTS).eval(fine, every_piece(fine))
    np.testing.assert_allclose(values, fem.Expression(same, POINTS).eval(fine, every_piece(fine)), atol=1e-13)


def test_finer_functions_have_no_values_on_coarser_pieces() -> None:
    coarse = fem.functionspace(ZOO["torus"](), SCALAR)
    u = with_random_values(adapt.refine(coarse, [0]))
    with pytest.raises(ValueError, match="nested"):
        fem.Expression(u, POINTS).eval(coarse, every_piece(coarse))


def test_test_functions_have_no_values() -> None:
    V = fem.functionspace(generators.torus((4, 4)), SCALAR)
    with pytest.raises(ValueError, match="an expression with test or trial functions has no values"):
        fem.Expression(2 * ufl.TestFunction(V), POINTS)


# ---- values_at


def test_callables_get_three_coordinates_in_the_plane_too() -> None:
    V = fem.functionspace(ZOO["grid"](), SCALAR)
    seen: list[Floats] = []

    def g(x: Floats) -> Floats:
        seen.append(x)
        return x[0] + 10 * x[2]

    X = positions(V)
    np.testing.assert_allclose(values_at(g, V, every_piece(V), POINTS, 1)[..., 0], X[..., 0], rtol=1e-14)
    assert seen[0].shape == (3, X[..., 0].size)


def test_callables_and_expressions_agree() -> None:
    V = fem.functionspace(ZOO["wheel5"](), SCALAR)
    x = ufl.SpatialCoordinate(V.mesh)
    as_ufl = values_at(as_vector([cos(x[0]), x[1] * x[2]]), V, every_piece(V), POINTS, 2)
    as_numpy = values_at(lambda x: np.stack([np.cos(x[0]), x[1] * x[2]]), V, every_piece(V), POINTS, 2)
    np.testing.assert_allclose(as_ufl, as_numpy, rtol=1e-13, atol=1e-15)


def test_one_row_of_values_goes_to_all_components() -> None:
    V = fem.functionspace(ZOO["wheel5"](), SCALAR)
    values = values_at(lambda x: x[0], V, every_piece(V), POINTS, 2)
    np.testing.assert_array_equal(values[..., 0], values[..., 1])


def test_values_of_another_shape_are_refused() -> None:
    V = fem.functionspace(ZOO["grid"](), SCALAR)
    x = ufl.SpatialCoordinate(V.mesh)
    with pytest.raises(ValueError, match=r"the expression has shape \(2,\); 1 components are needed"):
        values_at(x, V, every_piece(V), POINTS, 1)
    with pytest.raises(ValueError, match=r"g\(x\) returned shape \(3, 36\) for x of shape \(3, 36\); it must return"):
        values_at(lambda x: x, V, every_piece(V), POINTS, 1)
    with pytest.raises(TypeError, match=r"a UFL expression or a function g\(x\) is needed, got float"):
        values_at(1.0, V, every_piece(V), POINTS, 1)


def test_the_laplacian_on_curved_cells_is_that_of_the_surface() -> None:
    # Of the position it is the mean curvature vector: along the normal.
    V = fem.functionspace(generators.torus((6, 5)), SCALAR)
    x = [fem.project(ufl.SpatialCoordinate(V.mesh)[i], V) for i in range(3)]
    curvature, n = as_vector([div(grad(u)) for u in x]), ufl.CellNormal(V.mesh)
    tangential = curvature - inner(curvature, n) * n
    np.testing.assert_allclose(fem.Expression(tangential, POINTS).eval(V, every_piece(V)), 0.0, atol=1e-10)


def test_points_on_pieces_are_points_on_faces() -> None:
    V = fem.functionspace(generators.torus((6, 5)), SCALAR)
    u = with_random_values(V)
    faces = np.arange(30)
    piece, uv = V.cells.locate(faces, np.tile(POINTS[1], (30, 1)))
    assert (uv == POINTS[1]).all()
    values = fem.Expression(u, POINTS[1:2]).eval(V, piece)[:, 0, 0]
    np.testing.assert_allclose(values, u.eval(faces, uv), rtol=1e-13)
    x = fem.Expression(ufl.SpatialCoordinate(V.mesh), POINTS[1:2]).eval(V, piece)[:, 0]
    np.testing.assert_allclose(x, limit.evaluate(V.mesh, faces, uv)[0], atol=1e-14)


def test_functions_that_are_constant_on_cells() -> None:
    V = fem.functionspace(ZOO["wheel5"](), SCALAR)
    fine = adapt.refine(V, [0, 5])
    k, r = fem.Function(fem.functionspace(V.mesh, ("DG", 0))), fem.Function(fem.cellwise(V, (2,)))
    k.x.array, r.x.array = np.arange(V.mesh.num_faces), np.random.default_rng(0).random(2 * V.num_cells)
    u = with_random_values(fine)
    values = fem.Expression(k * u * r, POINTS).eval(fine, every_piece(fine))
    factor = k.x.array[:, None] * r.x.array.reshape(-1, 2)  # cells of V are the faces
    expected = (
        fem.Expression(u, POINTS).eval(fine, every_piece(fine)) * factor[fine.cells.face[fine.cells.piece_cell], None]
    )
    np.testing.assert_allclose(values, expected, rtol=1e-13)
    assert not fem.Expression(grad(k), POINTS).eval(fine, every_piece(fine)).any()
