"""The local basis and its changes of basis."""

from fractions import Fraction

import numpy as np
import numpy.typing as npt
import pytest

from thccs_fem import element

POINTS = np.random.default_rng(0).random((40, 2))


def uniform_bspline(i: int, t: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the i-th uniform cubic B-spline on [0, 1], written out."""
    formulas = [(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3]
    return formulas[i] / 6


def uniform_bspline_derivative(i: int, t: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    return [-((1 - t) ** 2), 3 * t**2 - 4 * t, -3 * t**2 + 2 * t + 1, t**2][i] / 2


def test_values_are_products_with_the_first_index_along_x() -> None:
    values = element.bspline().tabulate(0, POINTS)[0]
    x, y = POINTS.T
    for i in range(4):
        for j in range(4):
            expected = uniform_bspline(i, x) * uniform_bspline(j, y)
            np.testing.assert_allclose(values[:, i + 4 * j], expected, atol=4e-15)  # Basix' Legendre sums: 16 terms


def test_first_derivatives() -> None:
    _, along_x, along_y = element.bspline().tabulate(1, POINTS)
    x, y = POINTS.T
    for i in range(4):
        for j in range(4):
            dx = uniform_bspline_derivative(i, x) * uniform_bspline(j, y)
            dy = uniform_bspline(i, x) * uniform_bspline_derivative(j, y)
            np.testing.assert_allclose(along_x[:, i + 4 * j], dx, atol=2e-14)  # as above, times 6 or so
            np.testing.assert_allclose(along_y[:, i + 4 * j], dy, atol=2e-14)


def test_one_dimensional_values() -> None:
    t = np.linspace(0.0, 1.0, 11)
    for i in range(4):
        np.testing.assert_allclose(element.bspline_values(t)[:, i], uniform_bspline(i, t), atol=3e-16)
    assert element.bspline_values(0.5).shape == (4,)
    np.testing.assert_allclose(element.bernstein_values(t).sum(axis=-1), 1.0, atol=3e-16)
    np.testing.assert_array_equal(element.bernstein_values([0.0, 1.0]), [[1, 0, 0, 0], [0, 0, 0, 1]])


def test_changes_of_basis_are_inverse_to_one_another_exactly() -> None:
    times_36 = [[Fraction(round(36 * x)) for x in row] for row in element.TO_BERNSTEIN]
    np.testing.assert_allclose(np.array(times_36, dtype=float) / 36, element.TO_BERNSTEIN, rtol=1e-16)
    product = np.array(times_36, dtype=object) @ element.TO_BSPLINE.astype(int).astype(object)
    assert (product == 36 * np.eye(16, dtype=int)).all()
    assert (element.TO_BSPLINE == np.rint(element.TO_BSPLINE)).all()


def test_bernstein_coefficients_give_the_same_function() -> None:
    coefficients = np.random.default_rng(1).random(16)
    x, y = POINTS.T
    bernstein = np.einsum("pj,pi->pji", element.bernstein_values(y), element.bernstein_values(x)).reshape(-1, 16)
    by_bspline = element.bspline().tabulate(0, POINTS)[0] @ coefficients
    np.testing.assert_allclose(bernstein @ (element.TO_BERNSTEIN @ coefficients), by_bspline, atol=1e-14)


def test_constants_of_the_module_are_read_only() -> None:
    for matrix in (element.TO_BERNSTEIN, element.TO_BSPLINE):
        with pytest.raises(ValueError, match="read-only"):
            matrix[0, 0] = 1.0


@pytest.mark.parametrize("shape", [(), (2,), (3,), (2, 2)])
def test_blocked_elements_are_made_once(shape: tuple[int, ...]) -> None:
    assert element.blocked(shape) is element.blocked(shape)
    assert element.blocked(shape).dim == 16 * int(np.prod(shape, dtype=int))
    assert element.blocked(shape).reference_value_shape == shape


def test_coordinate_element_has_a_component_for_each_dimension() -> None:
    assert element.coordinate_element(3) is element.blocked((3,))


def test_function_i_plus_4_j_is_a_product() -> None:
    points = np.random.default_rng(0).random((2, 3, 2))
    values = element.bicubic_values(points)
    assert values.shape == (2, 3, 16)
    for i in range(4):
        for j in range(4):
            product = uniform_bspline(i, points[..., 0]) * uniform_bspline(j, points[..., 1])
            np.testing.assert_allclose(values[..., i + 4 * j], product, atol=1e-15)
