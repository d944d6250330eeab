"""Predicted indicators: rates that are seen, what they promise, and fewer solutions on the way to a tolerance."""

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from problems import poisson, singular
from spaces import each_space, some_space, space

import ufl
from thccs_fem import adapt, estimate, fem, generators
from ufl import grad

Floats = npt.NDArray[np.float64]
type Marking = adapt.Marking | adapt.MarkingAhead

CORNER = (0.0, 0.0)


def power(V: fem.FunctionSpace, rate: float) -> Floats:
    """Return indicators that fall by this rate everywhere: 2^-rate for the four children of a cell together."""
    return 2.0 ** -((rate + 1.0) * V.cells.level)


def halved(V: fem.FunctionSpace, rate: float) -> Floats:
    """Return indicators of a singularity at a point: at corners of cells that are there, r^rate, and else less."""
    level, face = V.cells.level, V.cells.level_face
    eta = np.zeros(level.size)
    for l, points in enumerate(V.hierarchy.points[: V.num_levels]):
        mine = level == l
        corners = points[V.hierarchy.stages[l].level.quads[face[mine]]]
        distance = np.linalg.norm(corners - np.array(CORNER), axis=2).min(axis=1)
        eta[mine] = 2.0 ** (-rate * l) / (1.0 + 2.0**l * distance) ** 4
    return eta


def all_refined(V: fem.FunctionSpace) -> fem.FunctionSpace:
    return adapt.refine(V, np.arange(V.num_functions))


# ---- Rates -----------------------------------------------------------------------------------------------------------


@each_space
@pytest.mark.parametrize("rate", [1.0, 2.5, 3.0])
def test_rates_are_seen_where_something_was_refined(name: str, rate: float) -> None:
    V = space(name)
    first = adapt.predict(V, power(V, rate))
    np.testing.assert_array_equal(first.rates, 3.0)
    W = adapt.refine(V, np.arange(0, V.num_functions, 7))
    second = adapt.predict(W, power(W, rate) * 2.0, before=adapt.predict(V, power(V, rate) * 2.0))
    finer = np.isin(W.cells.level, V.cells.level, invert=True)
    assert finer.any() or W.num_levels == V.num_levels
    # A child has half of what all four have together: its rate is larger by one, and no larger than that of theory.
    np.testing.assert_allclose(second.rates[finer], min(rate + 1.0, 3.0), rtol=1e-12)
    third = adapt.predict(W, power(W, rate), before=second)
    np.testing.assert_array_equal(third.rates, second.rates)  # nothing refined, nothing learned


def test_rates_are_bounded() -> None:
    V = space("grid")
    before = adapt.predict(V, np.ones(V.num_cells), order=4.0)
    W = all_refined(V)
    np.testing.assert_array_equal(adapt.predict(W, np.zeros(W.num_cells), before).rates, 3.0)
    np.testing.assert_array_equal(adapt.predict(W, np.full(W.num_cells, 9.0), before).rates, 0.25)


# ---- What is refined -------------------------------------------------------------------------------------------------


@settings(max_examples=20)
@given(st.integers(0, 999), st.sampled_from([0.3, 0.5, 1.0]))
def test_one_round_is_doerflers(seed: int, theta: float) -> None:
    V = space("grid, crease")  # without traces, and with one level: indicators of functions are those of `mark`
    eta = np.random.default_rng(seed).integers(1, 9, V.num_cells).astype(float)
    found = adapt.predict(V, eta).refined(reduction=0.999, theta=theta)
    expected = adapt.refine(V, adapt.mark(V, eta, theta=theta))
    assert found.hierarchy.same_as(expected.hierarchy)


@settings(max_examples=20)
@given(some_space, st.integers(0, 999), st.sampled_from([0.1, 0.3, 0.7]))
def test_what_is_predicted_is_as_small_as_was_asked_for(name: str, seed: int, reduction: float) -> None:
    V = space(name)
    eta = 10.0 ** np.random.default_rng(seed).uniform(-3, 0, V.num_cells)
    W = adapt.predict(V, eta).refined(reduction, theta=0.5)
    assert W.hierarchy.is_refinement_of(V.hierarchy)
    assert W.num_levels <= V.num_levels + 8
    # What becomes of the indicators of a smooth solution: those of the four children together fall by 2^-3.
    of_cell = {key: value for key, value in zip(keys(V), eta, strict=True)}
    squares = 0.0
    for level, key in keys(W):
        up = next(k for k in range(level + 1) if (level - k, key >> 2 * k) in of_cell)
        squares += (of_cell[level - up, key >> 2 * up] * 2.0 ** (-4 * up)) ** 2
    assert np.sqrt(squares) <= reduction * np.linalg.norm(eta) * (1.0 + 1e-6)


def keys(V: fem.FunctionSpace) -> list[tuple[int, int]]:
    stages = V.hierarchy.stages[: V.num_levels]
    return [(l, int(key)) for l, stage in enumerate(stages) for key in stage.level.keys[stage.active_faces]]


def test_a_corner_is_refined_by_several_levels_once_it_has_shown_its_rate() -> None:
    V = fem.functionspace(generators.l_domain(3), ("THCCS", 3))
    before = None
    levels = []
    for _ in range(4):
        before = adapt.predict(V, halved(V, 2 / 3), before)
        V = before.refined(reduction=0.3)
        levels.append(V.num_levels)
    # It falls by 2^(-2/3) a level, so that 0.3 needs two to three of them; a smooth one would need one.
    assert levels[0] == 2
    assert (np.diff(levels) >= 2).all()
    assert (np.diff(levels) <= 4).all()


def test_nothing_is_refined_without_indicators() -> None:
    V = space("grid")
    assert adapt.predict(V, np.zeros(V.num_cells)).refined() is V


def test_rings_and_classes_are_kept() -> None:
    for options in ({"unit": "ring"}, {"admissibility": 2}):
        V = fem.functionspace(generators.l_domain(3), ("THCCS", 3), **options)
        before = adapt.predict(V, halved(V, 2 / 3))
        W = before.refined(reduction=0.05)
        assert W.num_levels > 2
        assert (W.hierarchy.unit, W.hierarchy.admissibility) == (V.hierarchy.unit, V.hierarchy.admissibility)
        assert W.hierarchy._is_closed()


# ---- What it is for --------------------------------------------------------------------------------------------------


def on_the_l_domain(V: fem.FunctionSpace, marking: Marking, tolerance: float) -> adapt.History:
    """Run until the L2 error is small enough, driven by the residual with one more power of h than in H1."""
    exact = singular(ufl.SpatialCoordinate(V.mesh))

    def estimator(uh: fem.Function) -> tuple[Floats, float]:
        V = uh.function_space
        eta = estimate.residual(uh, ufl.div(grad(uh))) * 2.0**-V.cells.level
        return eta, estimate.norm(V, estimate.error(uh, exact, "L2"))

    def solve(V: fem.FunctionSpace) -> fem.Function:
        return poisson(V, exact, fem.Constant(V.mesh, 0.0))

    return adapt.solve(V, solve, estimator, marking=marking, stop=adapt.Stop(tolerance, steps=60), progress=False)


def test_half_of_the_solutions_do_with_no_more_dofs() -> None:
    V = fem.functionspace(generators.l_domain(4), ("THCCS", 3))
    ahead = on_the_l_domain(V, adapt.MarkingAhead(order=4.0), 2.5e-6)
    one_by_one = on_the_l_domain(V, adapt.Marking(theta=0.8), 2.5e-6)
    for history in (ahead, one_by_one):
        assert abs(history["estimate"][-1]) <= 2.5e-6
    assert 2 * len(ahead.steps) <= len(one_by_one.steps)
    # The last step may go beyond the tolerance, by up to 0.3.
    assert ahead["dofs"][-1] <= 1.2 * one_by_one["dofs"][-1]


def test_marking_ahead_remembers_within_a_run_alone() -> None:
    """As `predict` and `refined` by hand; in the next run, of a space that does not refine the last one, anew."""
    V = start = fem.functionspace(generators.l_domain(4), ("THCCS", 3))
    rule, before = adapt.MarkingAhead(order=4.0, reduction=0.4, theta=0.7), None
    for _ in range(3):
        eta = halved(V, 1.0)
        before = adapt.predict(V, eta, before, order=4.0)
        V, W = before.refined(0.4, 0.7), rule(V, eta)
        assert W.hierarchy.same_as(V.hierarchy)
    first = adapt.predict(start, halved(start, 1.0), order=4.0).refined(0.4, 0.7)
    assert rule(start, halved(start, 1.0)).hierarchy.same_as(first.hierarchy)
    torus = fem.functionspace(generators.torus((6, 4)), ("THCCS", 3))
    assert rule(torus, np.ones(torus.num_cells)).num_dofs > torus.num_dofs


@pytest.mark.parametrize("options", [{"order": 0.1}, {"reduction": 1.0}, {"theta": 0.0}])
def test_marking_ahead_checks_its_arguments_at_once(options: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=f"{next(iter(options))} is "):
        adapt.MarkingAhead(**options)


# ---- What is refused -------------------------------------------------------------------------------------------------


def test_wrong_arguments() -> None:
    V = space("grid")
    eta = np.ones(V.num_cells)
    with pytest.raises(ValueError, match=r"order is 0.*3 in H1, 4 in L2"):
        adapt.predict(V, eta, order=0)
    with pytest.raises(ValueError, match=r"eta has shape \(3,\)"):
        adapt.predict(V, np.ones(3))
    with pytest.raises(TypeError, match=r"before is of type FunctionSpace: give what predict has returned, or None"):
        adapt.predict(V, eta, V)  # type: ignore[arg-type]  # the wrong argument
    with pytest.raises(TypeError, match=r"prediction needs a space from .*, got ControlMesh"):
        adapt.predict(V.mesh, eta)  # type: ignore[arg-type]  # the wrong argument
    with pytest.raises(ValueError, match=r"which .* does not refine: give None"):
        adapt.predict(V, eta, before=adapt.predict(space("refined wheel"), np.ones(space("refined wheel").num_cells)))
    with pytest.raises(ValueError, match=r"reduction is 1.0; it must lie between 0 and 1"):
        adapt.predict(V, eta).refined(reduction=1.0)
    with pytest.raises(ValueError, match=r"theta is 0.0; it must lie"):
        adapt.predict(V, eta).refined(theta=0.0)
