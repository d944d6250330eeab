"""Conjugate gradients for mass matrices: how near they come, also where cells are small."""

import numpy as np
import pytest

import ufl
from thccs_fem import adapt, fem, generators
from thccs_fem.fem import mass
from thccs_fem.fem.space import FunctionSpace


def graded(levels: int) -> FunctionSpace:
    V = fem.functionspace(generators.l_domain(2), ("THCCS", 3))
    while V.num_levels < levels:
        V = adapt.refine(V, [V.num_functions - 1])
    return V


@pytest.mark.parametrize("levels", [1, 5, 12])
def test_any_coefficients_are_found_on_any_level(levels: int) -> None:
    V = graded(levels)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    M = fem.assemble_matrix(fem.form(u * v * ufl.dx))
    x = np.random.default_rng(0).uniform(-1.0, 1.0, (V.num_functions, 3)) * [1.0, 1e-8, 1e8]
    found = mass.conjugate_gradients(mass.product(M, V.index_map), M.diagonal(), M @ x, None)
    # Entry by entry, with entries of M from 1 to 16^-levels: 1e-14 times condition numbers of some hundred.
    np.testing.assert_allclose(found / np.abs(x).max(axis=0), x / np.abs(x).max(axis=0), atol=5e-12)


def test_columns_of_zeros_and_no_rows() -> None:
    found = mass.conjugate_gradients(lambda x: 2.0 * x, np.array([2.0, 2.0]), np.array([[0.0, 1.0], [0.0, 3.0]]), None)
    np.testing.assert_array_equal(found, [[0.0, 0.5], [0.0, 1.5]])
    nothing = np.zeros((0, 2))
    assert mass.conjugate_gradients(lambda x: x, np.zeros(0), nothing, None).shape == (0, 2)


def test_it_gives_up() -> None:
    with pytest.raises(RuntimeError, match="conjugate gradients did not converge in 10000 iterations"):
        mass.conjugate_gradients(lambda x: x[::-1], np.ones(2), np.array([[1.0], [0.0]]), None)
