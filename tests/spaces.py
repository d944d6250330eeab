"""Spaces that tests of adaptivity share, by name, and what they know of them by brute force."""

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from hypothesis import strategies as st
from problems import randomly_refined

from thccs_fem import fem, generators

SPACES: dict[str, Callable[[], fem.FunctionSpace]] = {
    "grid": lambda: fem.functionspace(generators.rectangle((4, 3)), ("THCCS", 3)),
    "grid, crease": lambda: fem.functionspace(generators.rectangle((4, 3)), ("THCCS", 3), boundary="crease"),
    "refined wheel": lambda: randomly_refined(fem.functionspace(generators.wheel(5, 2), ("THCCS", 3)), times=3),
    "refined cube": lambda: randomly_refined(fem.functionspace(generators.cube_sphere(2), ("THCCS", 3)), times=2),
}
each_space = pytest.mark.parametrize("name", SPACES)
some_space = st.sampled_from(list(SPACES))


@cache
def space(name: str) -> fem.FunctionSpace:
    return SPACES[name]()


@cache
def supports(name: str) -> list[set[int]]:
    """Return the cells of each function: those on a piece of which it does not vanish."""
    V = space(name)
    coefficients = V.cells.local(np.eye(V.num_functions))
    pieces = (np.abs(coefficients) > 1e-10).any(axis=1)
    return [set(V.cells.piece_cell[pieces[:, i]].tolist()) for i in range(V.num_functions)]
