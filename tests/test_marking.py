"""Marking against brute force: sets and loops.

Indicators are whole numbers and theta is a power of 1/2, so that sums, roots and products tie exactly where they tie.
"""

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from spaces import each_space, some_space, space, supports

from thccs_fem import adapt, fem

Floats = npt.NDArray[np.float64]

seeds = st.integers(0, 999)
thetas = st.sampled_from([0.25, 0.5, 1.0])


def indicators(name: str, seed: int) -> tuple[Floats, list[float]]:
    """Return indicators of cells, many of them equal or zero, and the squares of those of functions (eq. 32)."""
    eta = np.random.default_rng(seed).integers(-2, 4, space(name).num_cells).clip(0).astype(float)
    eta[0] = 1.0
    return eta, [sum(eta[cell] ** 2 for cell in support) for support in supports(name)]


@given(some_space, seeds)
def test_worst_is_the_first_of_the_largest(name: str, seed: int) -> None:
    eta, squares = indicators(name, seed)
    marked = adapt.mark(space(name), eta, strategy="worst")
    assert marked.tolist() == [squares.index(max(squares))]


@given(some_space, seeds, thetas)
def test_maximum_marks_what_is_large_enough(name: str, seed: int, theta: float) -> None:
    eta, squares = indicators(name, seed)
    marked = adapt.mark(space(name), eta, strategy="maximum", theta=theta)
    assert marked.tolist() == [i for i, square in enumerate(squares) if square >= theta**2 * max(squares)]


@given(some_space, seeds, thetas)
def test_dorfler_takes_the_largest_until_their_supports_carry_theta(name: str, seed: int, theta: float) -> None:
    eta, squares = indicators(name, seed)
    chosen, carried = [], set()
    for i in sorted(range(len(squares)), key=lambda i: (-squares[i], i)):
        if not supports(name)[i] <= carried:
            chosen.append(i)
            carried |= supports(name)[i]
        if carries(eta, carried, theta):
            break
    marked = adapt.mark(space(name), eta, strategy="dorfler", theta=theta)
    assert marked.tolist() == sorted(chosen)
    assert not carries(eta, set().union(*(supports(name)[i] for i in chosen[:-1])), theta)


def carries(eta: Floats, cells: set[int], theta: float) -> bool:
    return sum(eta[cell] ** 2 for cell in cells) >= theta * (eta**2).sum()


@pytest.mark.parametrize("theta", [0.3, 0.7, 1.0])
@each_space
def test_dorfler_carries_theta_of_any_indicators(name: str, theta: float) -> None:
    V = space(name)
    eta = np.random.default_rng(3).random(V.num_cells) ** 4
    marked = adapt.mark(V, eta, theta=theta)
    cells = set().union(*(supports(name)[i] for i in marked))
    assert sum(eta[cell] ** 2 for cell in cells) >= theta * (eta**2).sum() * (1 - 1e-12)  # rounding
    assert marked.size < V.num_functions


@pytest.mark.parametrize("strategy", ["worst", "maximum", "dorfler"])
@each_space
def test_equal_indicators_are_marked_alike_each_time(name: str, strategy: adapt.Strategy) -> None:
    V = space(name)
    eta = np.ones(V.num_cells)
    marked = adapt.mark(V, eta, strategy=strategy)
    assert np.issubdtype(marked.dtype, np.integer)
    assert (np.diff(marked) > 0).all()
    for _ in range(3):
        np.testing.assert_array_equal(adapt.mark(V, eta, strategy=strategy), marked)


@pytest.mark.parametrize("strategy", ["worst", "maximum", "dorfler"])
@each_space
def test_nothing_is_marked_where_nothing_is_wrong(name: str, strategy: adapt.Strategy) -> None:
    V = space(name)
    marked = adapt.mark(V, np.zeros(V.num_cells), strategy=strategy)
    assert (marked.shape, marked.dtype) == ((0,), np.int64)
    assert adapt.refine(V, marked) is V


@pytest.mark.parametrize("strategy", ["worst", "maximum", "dorfler"])
@each_space
def test_indicators_that_differ_by_rounding_are_equal(name: str, strategy: adapt.Strategy) -> None:
    """Of equal ones the first functions are marked, whatever a solver's last digits are."""
    V = space(name)
    for exact in (np.ones(V.num_cells), 2.0 ** (np.arange(V.num_cells) % 4)):
        for seed in range(3):
            eta = exact * (1.0 + np.random.default_rng(seed).uniform(-1e-9, 1e-9, V.num_cells))
            np.testing.assert_array_equal(adapt.mark(V, eta, strategy), adapt.mark(V, exact, strategy))
            cells = adapt.mark_coarsening(V, eta, theta=0.25)
            np.testing.assert_array_equal(cells, adapt.mark_coarsening(V, exact, theta=0.25))


def test_functions_not_components_are_marked() -> None:
    scalar = space("grid")
    V = fem.FunctionSpace(scalar.hierarchy, (2,))
    eta = np.arange(V.num_cells, dtype=float)
    np.testing.assert_array_equal(adapt.mark(V, eta), adapt.mark(scalar, eta))


def test_defaults_are_dorfler_and_one_half() -> None:
    V = space("grid")
    eta = np.arange(V.num_cells, dtype=float)
    np.testing.assert_array_equal(adapt.mark(V, eta), adapt.mark(V, eta, strategy="dorfler", theta=0.5))


@pytest.mark.parametrize(
    ("eta", "options", "message"),
    [
        (np.ones(5), {}, r"eta has shape \(5,\); it needs one value for each of the 12 cells"),
        (np.array([*np.ones(11), -1.0]), {}, "eta of cell 11 is -1.0; indicators must be finite and not negative"),
        (np.array([np.nan, *np.ones(11)]), {}, "eta of cell 0 is nan"),
        (np.array([1.0, np.inf, *np.ones(10)]), {}, "eta of cell 1 is inf"),
        (np.ones(12), {"theta": 0.0}, r"theta is 0.0; it must lie in \(0, 1\]"),
        (np.ones(12), {"theta": 1.5}, "theta is 1.5"),
        (np.ones(12), {"strategy": "doerfler"}, "strategy is 'doerfler'; it must be"),
        (np.zeros(12), {"strategy": "doerfler"}, "strategy is 'doerfler'; it must be"),
    ],
)
def test_wrong_arguments_of_mark_are_named(eta: Floats, options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        adapt.mark(space("grid"), eta, **options)


def test_marks_are_those_of_a_space() -> None:
    for mark in (adapt.mark, adapt.mark_coarsening):
        with pytest.raises(TypeError, match=r"marking needs a space from fem.functionspace\(.*, got ControlMesh"):
            mark(space("grid").mesh, np.ones(12))  # type: ignore[operator]  # the wrong argument


# ---- Marking for coarsening


@given(some_space, seeds, st.sampled_from([0.0, 0.125, 0.5]))
def test_the_most_cells_that_carry_little_are_marked_for_coarsening(name: str, seed: int, theta: float) -> None:
    eta, _ = indicators(name, seed)
    marked = adapt.mark_coarsening(space(name), eta, theta)
    allowed, carried, count = theta * sum(eta**2), 0.0, 0
    for square in sorted((eta**2).tolist()):
        carried += square
        count += carried <= allowed
    assert marked.size == count
    assert sum(eta[marked] ** 2) <= allowed
    rest = np.delete(eta, marked)
    assert not marked.size or eta[marked].max() <= rest.min(initial=np.inf)
    assert (np.diff(marked) > 0).all()


def test_marking_for_coarsening_checks_its_arguments() -> None:
    V = space("grid")
    for theta in (-0.1, 1.0):
        with pytest.raises(ValueError, match=rf"theta is {theta}; it must lie in \[0, 1\)"):
            adapt.mark_coarsening(V, np.ones(12), theta)
    with pytest.raises(ValueError, match="it needs one value for each of the 12 cells"):
        adapt.mark_coarsening(V, np.ones(11))
