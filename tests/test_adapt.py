"""Marking against brute force; refinement, transfer and the loop of all three."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Literal

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from problems import poisson, randomly_refined, uniformly_refined, wavy

import ufl
from thccs_fem import adapt, estimate, fem, generators

Floats = npt.NDArray[np.float64]

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


# ---- Marking, by brute force: sets and loops
#
# Indicators are whole numbers and theta is a power of 1/2, so that sums, roots and products tie exactly where they tie.

seeds = st.integers(0, 999)
thetas = st.sampled_from([0.25, 0.5, 1.0])


@cache
def supports(name: str) -> list[set[int]]:
    """Return the cells of each function: those on a piece of which it does not vanish."""
    V = space(name)
    coefficients = V.cells.local(np.eye(V.num_functions))
    pieces = (np.abs(coefficients) > 1e-10).any(axis=1)
    return [set(V.cells.piece_cell[pieces[:, i]].tolist()) for i in range(V.num_functions)]


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


# ---- Refinement


@each_space
def test_refinement_makes_a_new_space_and_leaves_the_old_one(name: str) -> None:
    V = space(name)
    dofs, cells, keys = V.num_dofs, V.cells, [k.copy() for k in V.hierarchy.refined_keys]
    points = cells.points.copy()
    fine = adapt.refine(V, [0])
    assert fine is not V
    assert fine != V
    assert fine.is_refinement_of(V)
    assert fine.num_cells > V.num_cells
    assert (V.num_dofs, V.cells) == (dofs, cells)
    np.testing.assert_array_equal(V.cells.points, points)
    for before, after in zip(keys, V.hierarchy.refined_keys, strict=True):
        np.testing.assert_array_equal(before, after)


@each_space
def test_the_cells_of_a_function_are_refined(name: str) -> None:
    V = space(name)
    for i in (0, V.num_functions // 2, V.num_functions - 1):
        level = np.searchsorted(V.hierarchy.dof_offsets, i, side="right") - 1
        own = [cell for cell in supports(name)[i] if V.cells.level[cell] == level]
        fine = adapt.refine(V, [i])
        left = set(zip(fine.cells.level.tolist(), keys(fine), strict=True))
        before = list(zip(V.cells.level.tolist(), keys(V), strict=True))
        assert own
        assert {before[cell] for cell in own}.isdisjoint(left)
        # What was not in the support of the function has not changed.
        assert {before[cell] for cell in set(range(V.num_cells)) - supports(name)[i]} <= left


def keys(V: fem.FunctionSpace) -> list[int]:
    """Return a number for each cell by which it is known on its level in all hierarchies of the mesh."""
    levels = [stage.level for stage in V.hierarchy.stages]
    return [int(levels[l].keys[f]) for l, f in zip(V.cells.level, V.cells.level_face, strict=True)]


def test_order_and_repetition_do_not_matter() -> None:
    V = space("refined wheel")
    fine = adapt.refine(V, [7, 3, 3])
    assert fine == adapt.refine(V, np.array([3, 7], dtype=np.int32))


def test_refining_all_functions_refines_all_cells() -> None:
    V = space("grid")
    assert uniformly_refined(V, times=2).num_cells == 16 * V.num_cells


def test_a_vector_valued_space_stays_one() -> None:
    V = fem.FunctionSpace(space("grid").hierarchy, (2,))
    fine = adapt.refine(V, [0])
    assert fine.value_shape == (2,)
    assert fine.num_functions == adapt.refine(space("grid"), [0]).num_functions
    with pytest.raises(ValueError, match=f"functions run from 0 to {V.num_functions - 1}; got 0 to {V.num_functions}"):
        adapt.refine(V, [0, V.num_functions])


@pytest.mark.parametrize("marked", [[-1], [0, 42]])
def test_functions_out_of_range_are_named(marked: list[int]) -> None:
    with pytest.raises(ValueError, match=f"functions run from 0 to 41; got {min(marked)} to {max(marked)}"):
        adapt.refine(space("grid"), marked)


@pytest.mark.parametrize("marked", [[0.5], np.ones(42, dtype=bool)])
def test_marks_are_numbers_of_functions(marked: npt.ArrayLike) -> None:
    with pytest.raises(TypeError, match="marked functions must be integers"):
        adapt.refine(space("grid"), marked)


# ---- Coarsening


@each_space
def test_coarsening_undoes_refinement(name: str) -> None:
    V = space(name)
    fine = adapt.refine(V, [0, 5])
    before = set(zip(V.cells.level.tolist(), keys(V), strict=True))
    new = np.array([cell not in before for cell in zip(fine.cells.level.tolist(), keys(fine), strict=True)])
    assert adapt.coarsen(fine, new) == V
    assert adapt.coarsen(fine, np.flatnonzero(new)[::-1]) == V
    assert adapt.coarsen(fine, []) is fine


def test_coarsening_keeps_the_kind_of_space() -> None:
    fine = adapt.refine(fem.FunctionSpace(space("grid").hierarchy, (2,)), [0])
    coarse = adapt.coarsen(fine, np.ones(fine.num_cells, dtype=bool))
    assert coarse.value_shape == (2,)
    assert fine.is_refinement_of(coarse)
    assert coarse.num_levels == 1
    assert adapt.coarsen(coarse, np.ones(coarse.num_cells, dtype=bool)) is coarse


def test_remeshing_refines_here_and_coarsens_there() -> None:
    V = fem.functionspace(generators.torus((16, 8)), ("THCCS", 3))
    there = adapt.refine(V, [0])
    here = np.flatnonzero(there.hierarchy.dof_functions(0) == 68)  # far from function 0
    everything = np.ones(there.num_cells, dtype=bool)
    assert adapt.remesh(there, here, everything) == adapt.refine(V, [68])
    assert adapt.remesh(there, here, []) == adapt.refine(there, here)
    assert adapt.remesh(there, [], everything) == V
    assert adapt.remesh(there, [], []) is there


@pytest.mark.parametrize(
    ("cells", "error", "message"),
    [
        ([-1], ValueError, "cells run from 0 to 11; got -1 to -1"),
        ([3, 12], ValueError, "cells run from 0 to 11; got 3 to 12"),
        (np.ones(11, dtype=bool), ValueError, r"marks have shape \(11,\); there must be one for each of the 12 cells"),
        ([0.5], TypeError, "marked cells must be integers or bools"),
    ],
)
def test_cells_to_coarsen_are_checked(cells: npt.ArrayLike, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        adapt.coarsen(space("grid"), cells)
    with pytest.raises(error, match=message):
        adapt.remesh(space("grid"), [0], cells)


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


# ---- Transfer


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


# ---- The loop


def solve_poisson(V: fem.FunctionSpace) -> fem.Function:
    exact = wavy(ufl.SpatialCoordinate(V.mesh))
    return poisson(V, exact, 6.25 * exact)


def exact_error(uh: fem.Function) -> Floats:
    return estimate.error(uh, wavy)


def run(**options: object) -> adapt.History:
    return adapt.solve(space("grid"), solve_poisson, exact_error, **{"progress": False, "steps": 3} | options)


def test_history_tells_what_each_step_came_to() -> None:
    solved: list[fem.Function] = []

    def solver(V: fem.FunctionSpace) -> fem.Function:
        solved.append(solve_poisson(V))
        return solved[-1]

    history = adapt.solve(space("grid"), solver, exact_error, steps=3, progress=False)
    assert history.solution is solved[-1]
    assert len(history.steps) == len(solved) == 4
    V = space("grid")
    for number, (step, uh) in enumerate(zip(history.steps, solved, strict=True)):
        assert uh.function_space == V
        assert step.number == number
        assert (step.levels, step.elements, step.dofs) == (V.num_levels, V.num_cells, V.num_dofs)
        assert step.estimate == estimate.norm(V, exact_error(uh))
        assert step.seconds > 0.0
        V = adapt.refine(V, adapt.mark(V, exact_error(uh)))
    assert history.steps[-1].estimate < history.steps[0].estimate / 4


def test_no_steps_is_one_solution() -> None:
    assert len(run(steps=0).steps) == 1


def test_run_ends_at_the_tolerance() -> None:
    estimates = [step.estimate for step in run().steps]
    history = run(tolerance=estimates[1])
    assert [step.estimate for step in history.steps] == estimates[:2]
    assert history.solution.function_space.num_dofs == history.steps[-1].dofs


def test_run_ends_at_max_dofs() -> None:
    dofs = [step.dofs for step in run().steps]
    assert [step.dofs for step in run(max_dofs=dofs[1]).steps] == dofs[:2]
    assert [step.dofs for step in run(max_dofs=dofs[1] + 1).steps] == dofs[:3]
    assert [step.dofs for step in run(max_dofs=1).steps] == dofs[:1]


def test_strategy_and_theta_are_those_of_mark() -> None:
    history = run(strategy="maximum", theta=0.9, steps=1)
    V = space("grid")
    marked = adapt.mark(V, exact_error(solve_poisson(V)), strategy="maximum", theta=0.9)
    assert history.steps[-1].dofs == adapt.refine(V, marked).num_dofs


def test_history_is_printed_as_a_table() -> None:
    steps = [adapt.Step(0, 1, 12, 42, 0.0125, 0.25), adapt.Step(1, 2, 120000, 130000, 3.5e-07, 61.5)]
    assert str(adapt.History(steps)) == (
        "step levels  elements      dofs   estimate  seconds\n"
        "   0      1        12        42  1.250e-02     0.25\n"
        "   1      2    120000    130000  3.500e-07    61.50"
    )
    assert str(adapt.History([replace(steps[0], number=7)])).splitlines()[-1].startswith("   7 ")
    assert str(adapt.History([steps[0], replace(steps[1], imbalance=1.0625)])) == (  # of several ranks
        "step levels  elements      dofs   estimate  seconds imbalance\n"
        "   0      1        12        42  1.250e-02     0.25     1.000\n"
        "   1      2    120000    130000  3.500e-07    61.50     1.062"
    )


def test_a_negative_number_of_steps_is_refused() -> None:
    with pytest.raises(ValueError, match="steps is -1; it must not be negative"):
        run(steps=-1)


@pytest.mark.parametrize(("progress", "shown"), [(True, True), (False, False), (None, False)])
def test_progress_is_shown_on_demand(progress: bool | None, shown: bool, capfd: pytest.CaptureFixture[str]) -> None:
    """None: only in a terminal, which standard error is not here."""
    run(steps=1, progress=progress)
    out, err = capfd.readouterr()
    assert out == ""
    assert ("adaptive run" in err) == shown
    assert ("2/2" in err) == shown


def test_functions_that_are_constant_on_cells_are_not_refined() -> None:
    V = fem.functionspace(generators.torus((5, 4)), ("THCCS", 3))
    D = fem.cellwise(V)
    for what, call in (
        ("refinement", lambda: adapt.refine(D, [0])),  # type: ignore[arg-type]  # what is refused
        ("coarsening", lambda: adapt.coarsen(D, [0])),  # type: ignore[arg-type]
        ("transfer", lambda: adapt.transfer(fem.Function(D), V)),
    ):
        with pytest.raises(TypeError, match=rf"{what} needs a space from .*, got CellwiseSpace"):
            call()
