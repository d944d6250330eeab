"""Dofs of several unknowns: where they stand in vectors, and conditions on them. On ranks: test_parallel_layout.py."""

from typing import Any

import numpy as np
import pytest

from thccs_fem import adapt, fem, generators
from thccs_fem.fem.layout import Layout
from thccs_fem.fem.space import FunctionSpace


def square(shape: tuple[int, ...] = ()) -> FunctionSpace:
    return fem.functionspace(generators.rectangle((4, 4)), ("THCCS", 3, shape))


def on_mesh_of(V: FunctionSpace, shape: tuple[int, ...] = (), refined: tuple[int, ...] = ()) -> FunctionSpace:
    """Return another space on the same mesh, refined at some functions."""
    W = fem.functionspace(V.mesh, ("THCCS", 3, shape))
    return adapt.refine(W, list(refined)) if refined else W


def fixed(V: FunctionSpace, value: Any = 0.0) -> fem.DirichletBC:
    return fem.dirichletbc(value, fem.boundary_dofs(V), V)


def test_in_serial_dofs_stand_space_after_space() -> None:
    V = square((2,))
    Q = on_mesh_of(V, refined=(0,))
    layout = Layout((V, Q))
    functions = [fem.Function(V), fem.Function(Q)]
    x = np.random.default_rng(0).random(V.num_dofs + Q.num_dofs)
    layout.spread(x, functions)
    np.testing.assert_array_equal(functions[0].x.array, x[: V.num_dofs])
    np.testing.assert_array_equal(functions[1].x.array, x[V.num_dofs :])
    np.testing.assert_array_equal(layout.join(functions), x)
    assert layout.num_dofs == layout.num_owned == layout.num_local == x.size
    assert layout.with_ghosts(x) is x
    assert layout.without_ghosts(x) is x
    assert layout.numbering is None
    np.testing.assert_array_equal(np.concatenate(layout.places), np.arange(x.size))
    np.testing.assert_array_equal(layout.component, [0, 1] * V.num_functions + [2] * Q.num_dofs)


def test_conditions_that_do_not_fit() -> None:
    V = square()
    Q = on_mesh_of(V, (2,))
    layout = Layout((V, Q))
    with pytest.raises(ValueError, match=r"a condition is on .*, but the unknowns are in"):
        layout.constraints([fixed(on_mesh_of(V, (), (0,)))])
    with pytest.raises(TypeError, match="bcs is a single condition"):
        layout.constraints(fixed(V))  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="bcs holds a float"):
        layout.constraints([0.0])  # type: ignore[list-item]
    with pytest.raises(ValueError, match=r"the space of the unknowns \[0, 1\]: give a list of conditions for each"):
        Layout((V, V)).constraints([fixed(V)])


def test_conditions_find_their_unknown() -> None:
    V = square()
    same, Q = on_mesh_of(V), on_mesh_of(V, (2,))
    bc = fem.dirichletbc(1.0, [3], V)
    for spaces, expected in (((Q, V), 2 * 49 + 3), ((V, same), 3), ((same, V), 49 + 3), ((same, Q), 3)):
        dofs, values = Layout(spaces).constraints([bc])
        assert dofs.tolist() == [expected]
        assert values.tolist() == [1.0]
