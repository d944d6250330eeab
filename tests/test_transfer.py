"""Functions carried over from one space to another."""

from typing import Literal

import numpy as np
import pytest
from problems import randomly_refined
from spaces import each_space, space

from thccs_fem import adapt, fem


def with_random_values(V: fem.FunctionSpace) -> fem.Function:
    u = fem.Function(V, name="v")
    u.x.array = np.random.default_rng(0).uniform(-1.0, 1.0, V.num_dofs)
    return u


def largest_difference(u: fem.Function, v: fem.Function) -> float:
    """Return the largest difference at random points, each function evaluated on its own cells."""
    rng = np.random.default_rng(1)
    faces, uv = rng.integers(0, u.function_space.mesh.num_faces, 3000), rng.random((3000, 2))
    return float(np.abs(u.eval(faces, uv) - v.eval(faces, uv)).max())


@pytest.mark.parametrize("seed", [1, 2])
@each_space
def test_transfer_is_exact(name: str, seed: int) -> None:
    V = space(name)
    fine = randomly_refined(V, times=2, seed=seed)
    u = with_random_values(V)
    transferred = adapt.transfer(u, fine)
    assert transferred.function_space is fine
    assert transferred.name == "v"
    assert largest_difference(transferred, u) < 1e-13  # rounding of values up to 1


def test_transfer_of_all_components() -> None:
    V = fem.FunctionSpace(space("refined cube").hierarchy, (3,))
    fine = adapt.refine(V, [1, 5])
    u = with_random_values(V)
    assert largest_difference(adapt.transfer(u, fine), u) < 1e-13


def test_transfer_to_the_same_space_copies() -> None:
    u = with_random_values(space("grid"))
    copy = adapt.transfer(u, space("grid"))
    np.testing.assert_array_equal(copy.x.array, u.x.array)
    copy.x.array[:] = 0.0
    assert u.x.array.any()


def test_transfer_to_an_unrelated_space_is_refused() -> None:
    V = space("grid")
    with pytest.raises(ValueError, match="the hierarchies have no common refinement"):
        adapt.transfer(with_random_values(V), space("grid, crease"))
    with pytest.raises(ValueError, match=r"values of shape \(\) cannot be carried to shape \(2,\)"):
        adapt.transfer(with_random_values(V), fem.FunctionSpace(V.hierarchy, (2,)))
    with pytest.raises(TypeError, match=r"u is of type list; it must be a fem.Function: of several give one at a time"):
        adapt.transfer([with_random_values(V)], V)  # type: ignore[arg-type]  # the wrong argument
    with pytest.raises(ValueError, match='projection is \'L1\'; it must be "L2" or "H1"'):
        adapt.transfer(with_random_values(V), V, projection="L1")  # type: ignore[arg-type]


@pytest.mark.parametrize("projection", ["L2", "H1"])
def test_transfer_to_a_coarser_space_projects(projection: Literal["L2", "H1"]) -> None:
    """What came from the coarser space comes back, and zero is zero; test_remeshing.py has the rest."""
    V = space("refined cube")
    fine = randomly_refined(V, times=2, seed=1)
    u = with_random_values(V)
    back = adapt.transfer(adapt.transfer(u, fine), V, projection=projection)
    assert (back.function_space, back.name) == (V, "v")
    np.testing.assert_allclose(back.x.array, u.x.array, atol=1e-11)  # scaled condition numbers up to 10^4
    assert not adapt.transfer(fem.Function(fine), V, projection=projection).x.array.any()
