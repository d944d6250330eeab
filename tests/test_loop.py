"""The loop of solving, estimating, marking and refining, and its history."""

from collections.abc import Callable, Mapping
from dataclasses import FrozenInstanceError, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from problems import poisson, wavy
from spaces import space

import ufl
from thccs_fem import adapt, checkpoint, estimate, fem, generators
from thccs_fem.fem.scipy import LinearProblem, NonlinearProblem
from ufl import dx, grad, inner

Floats = npt.NDArray[np.float64]
THREE = adapt.Stop(steps=3)


def solve_poisson(V: fem.FunctionSpace) -> fem.Function:
    exact = wavy(ufl.SpatialCoordinate(V.mesh))
    return poisson(V, exact, 6.25 * exact)


def poisson_problem(V: fem.FunctionSpace, u: fem.Function | None = None) -> LinearProblem:
    """Return the problem that `solve_poisson` solves."""
    exact = wavy(ufl.SpatialCoordinate(V.mesh))
    trial, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    bc = fem.dirichletbc(exact, fem.boundary_dofs(V), V)
    return LinearProblem(inner(grad(trial), grad(v)) * dx, 6.25 * exact * v * dx, bcs=[bc], u=u)


def exact_error(uh: fem.Function) -> Floats:
    return estimate.error(uh, wavy)


def run(
    problem: Callable[[fem.FunctionSpace], Any] = solve_poisson,
    estimator: Callable[[Any], Any] = exact_error,
    stop: Callable[[adapt.History], str | None] = THREE,
    **options: Any,
) -> adapt.History:
    return adapt.solve(space("grid"), problem, estimator, stop=stop, **{"progress": False} | options)


def sizes(history: adapt.History) -> list[tuple[int, int, int, int]]:
    return [(s.number, s.levels, s.elements, s.dofs) for s in history.steps]


# ---- Steps


def test_history_tells_what_each_step_came_to() -> None:
    solved: list[fem.Function] = []

    def problem(V: fem.FunctionSpace) -> fem.Function:
        solved.append(solve_poisson(V))
        return solved[-1]

    history = run(problem)
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


def test_histories_do_not_change() -> None:
    history = run(stop=adapt.Stop(steps=0))
    with pytest.raises(FrozenInstanceError):
        history.reason = "none"  # type: ignore[misc]  # what is refused
    with pytest.raises(FrozenInstanceError):
        history.steps[0].dofs = 1  # type: ignore[misc]  # as above


# ---- The end


def test_no_steps_is_one_solution() -> None:
    history = run(stop=adapt.Stop(steps=0))
    assert len(history.steps) == 1
    assert history.reason == "0 of 0 steps"


def test_run_ends_at_the_tolerance() -> None:
    estimates = [step.estimate for step in run().steps]
    history = run(stop=adapt.Stop(tolerance=estimates[1]))
    assert [step.estimate for step in history.steps] == estimates[:2]
    assert history.solution.function_space.num_dofs == history.steps[-1].dofs
    assert history.reason == f"estimate {estimates[1]:.3e}, within the tolerance {estimates[1]:.3e}"


def test_run_ends_at_so_many_dofs() -> None:
    dofs = [step.dofs for step in run().steps]
    for limit, steps in ((dofs[1], 2), (dofs[1] + 1, 3), (1, 1)):
        history = run(stop=adapt.Stop(dofs=limit))
        assert [step.dofs for step in history.steps] == dofs[:steps]
        assert history.reason == f"{dofs[steps - 1]} of {limit} dofs"


def test_run_ends_at_so_many_levels() -> None:
    history = run(stop=adapt.Stop(levels=3))
    levels = [step.levels for step in history.steps]
    assert levels[-1] == 3
    assert max(levels[:-1]) == 2
    assert history.reason == "3 of 3 levels"
    assert len(run(stop=adapt.Stop(levels=1)).steps) == 1


def test_run_ends_after_so_many_seconds() -> None:
    """Those of the steps together."""
    history = run(stop=adapt.Stop(seconds=1e-9))
    assert len(history.steps) == 1
    assert "of 0.0 seconds" in history.reason
    stop = adapt.Stop(seconds=1.0)
    steps = tuple(adapt.Step(i, 1, 1, 1, 1.0, 0.4) for i in range(3))
    assert stop(adapt.History(steps[:2])) is None
    assert stop(adapt.History(steps)) == "1.2 of 1.0 seconds"


def test_the_first_condition_that_holds_ends_a_run() -> None:
    for stop in (adapt.Stop(dofs=10**6, steps=2), adapt.Stop(tolerance=1e-12, levels=50, seconds=1e6, steps=2)):
        history = run(stop=stop)
        assert len(history.steps) == 3
        assert history.reason == "2 of 2 steps"


def test_anything_that_looks_at_the_history_may_end_a_run() -> None:
    def stop(history: adapt.History) -> str | None:
        return "slow" if len(history.steps) > 2 and history.rate(last=2) < 100.0 else None

    history = run(stop=stop)
    assert (len(history.steps), history.reason) == (3, "slow")


@pytest.mark.parametrize("returned", [False, True, 0.5], ids=repr)
def test_an_end_has_its_reason(returned: Any) -> None:
    """A comparison that is False would end the run, too, as it is not None."""
    with pytest.raises(TypeError, match=f"stop returned {returned}: return text, why the run ends, or None to go on"):
        run(stop=lambda history: returned)


def test_run_ends_where_nothing_is_wrong() -> None:
    history = run(lambda V: fem.Function(V), lambda u: np.zeros(u.function_space.num_cells))
    assert (len(history.steps), history.steps[0].estimate) == (1, 0.0)
    assert history.reason == "no function is marked, or none that can be refined"
    few = run(marking=lambda V, eta: [0] if V.num_levels == 1 else [])
    assert (len(few.steps), few.reason) == (2, history.reason)


@pytest.mark.parametrize("looks_ahead", [False, True])
def test_run_ends_where_levels_do(looks_ahead: bool) -> None:
    """What it came to is not lost; also where it is the estimator that refines, by a level more."""

    def estimator(u: fem.Function) -> Floats:
        V = u.function_space
        if looks_ahead:
            adapt.refine(V, [V.num_functions - 1])
        return np.ones(V.num_cells)

    history = run(fem.Function, estimator, adapt.Stop(steps=99), marking=lambda V, eta: [V.num_functions - 1])
    assert history["levels"].tolist() == list(range(1, 30 - looks_ahead))
    assert history.reason.startswith(
        "30 levels below the 12 faces of level 0 are more than 64-bit face keys can number"
    )
    with pytest.raises(ValueError, match="30 levels below the 12 faces"):  # nothing has been done, and may be lost
        run(lambda V: fem.functionspace(V.mesh, ("THCCS", 3), cap_level=30), estimator)


@pytest.mark.parametrize(
    ("given", "error", "message"),
    [
        ({}, ValueError, r"nothing would end the run: give Stop a tolerance \(above 0\), dofs, levels, seconds or st"),
        ({"tolerance": 0.0}, ValueError, "nothing would end the run"),
        ({"tolerance": -1e-3}, ValueError, "tolerance is -0.001; it must be finite and not negative"),
        ({"tolerance": np.nan}, ValueError, "tolerance is nan"),
        ({"steps": -1}, ValueError, "steps is -1; it must be at least 0"),
        ({"dofs": 0}, ValueError, "dofs is 0; it must be at least 1"),
        ({"levels": 0}, ValueError, "levels is 0; it must be at least 1"),
        ({"dofs": 1e4}, TypeError, "dofs is 10000.0; it must be an integer"),
        ({"seconds": 0.0}, ValueError, "seconds is 0.0; it must be positive"),
        ({"seconds": np.nan, "steps": 1}, ValueError, "seconds is nan"),
        ({"seconds": "1"}, TypeError, "seconds is '1'; it must be a number"),
        ({"tolerance": None, "steps": 1}, TypeError, "tolerance is None; it must be a number"),
    ],
)
def test_ends_are_checked(given: Mapping[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        adapt.Stop(**given)
    assert adapt.Stop(dofs=np.int64(5)).dofs == 5  # type: ignore[arg-type]  # counts of NumPy are counts


# ---- Problems, and where they start from


def test_a_problem_is_solved() -> None:
    history, expected = run(poisson_problem), run()
    assert sizes(history) == sizes(expected)
    np.testing.assert_array_equal(history["estimate"], expected["estimate"])
    np.testing.assert_array_equal(history.solution.x.array, expected.solution.x.array)


@dataclass
class Own:
    """Somebody's own problem, which writes down what it starts from."""

    u: Any
    starts: list[Any]

    def solve(self) -> None:
        for function in self.u if isinstance(self.u, list) else [self.u]:
            self.starts.append(function.copy())
            function.x.array = solve_poisson(function.function_space).x.array


def test_each_solution_is_the_next_initial_guess() -> None:
    starts: list[fem.Function] = []
    solutions: list[fem.Function] = []

    def problem(V: fem.FunctionSpace) -> Own:
        u = fem.Function(V)
        u.x.array[:] = 7.0
        return Own(u, starts)

    run(problem, callback=lambda step, u: solutions.append(u))
    assert (starts[0].x.array == 7.0).all()  # its own
    for before, start in zip(solutions, starts[1:], strict=False):
        np.testing.assert_array_equal(start.x.array, adapt.transfer(before, start.function_space).x.array)
        faces, uv = np.arange(12), np.full((12, 2), 0.3)
        np.testing.assert_allclose(start.eval(faces, uv), before.eval(faces, uv), rtol=0.0, atol=1e-13)  # rounding


@pytest.mark.parametrize("looks", [True, False])
def test_no_guess_is_made_that_nobody_looks_at(looks: bool) -> None:
    starts: list[fem.Function] = []

    class Picky(Own):
        def start_from_u(self) -> bool:
            return looks

    run(lambda V: Picky(fem.Function(V), starts))
    assert [start.x.array.any() for start in starts] == [False, looks, looks, looks]


def test_a_direct_solver_looks_at_no_guess(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object) -> None:
        raise AssertionError("a function was carried over for nothing")

    monkeypatch.setattr("thccs_fem.adapt.loop.transfer", refused)
    assert poisson_problem(space("grid")).start_from_u() is False
    run(poisson_problem)


def newton(V: fem.FunctionSpace) -> NonlinearProblem:
    u, v, f = fem.Function(V), ufl.TestFunction(V), 50.0 * wavy(ufl.SpatialCoordinate(V.mesh))
    F = inner(grad(u), grad(v)) * dx + (u**3 - f) * v * dx
    return NonlinearProblem(F, u, bcs=[fem.dirichletbc(0.0, fem.boundary_dofs(V), V)])


def newton_residual(u: fem.Function) -> Floats:
    f = 50.0 * wavy(ufl.SpatialCoordinate(u.function_space.mesh))
    return estimate.residual(u, f + ufl.div(grad(u)) - u**3)


def iterations(problem: Callable[[fem.FunctionSpace], Any], guess: bool) -> tuple[adapt.History, list[int]]:
    problems: list[Any] = []

    def posed(V: fem.FunctionSpace) -> Any:
        problems.append(problem(V))
        if not guess:
            problems[-1].start_from_u = lambda: False
        return problems[-1]

    history = run(posed, newton_residual, adapt.Stop(steps=5))
    return history, [len(p.norms) - 1 for p in problems]


def test_newton_starts_from_the_last_solution() -> None:
    """Which the next one is near to: fewer iterations, and the same solution."""
    (warm, few), (cold, many) = (iterations(newton, guess) for guess in (True, False))
    assert sizes(warm) == sizes(cold)
    np.testing.assert_allclose(warm["estimate"], cold["estimate"], rtol=1e-7)  # both end at 1e-10, of other residuals
    assert few[0] == many[0]
    assert all(n <= m for n, m in zip(few, many, strict=True))
    assert few[-1] <= many[-1] - 2


def test_a_guess_may_be_the_solution() -> None:
    """Where nothing is left to do, Newton's method does nothing, however small the first residual is."""
    problems: list[NonlinearProblem] = []

    def problem(V: fem.FunctionSpace) -> NonlinearProblem:
        u, v, x = fem.Function(V), ufl.TestFunction(V), ufl.SpatialCoordinate(V.mesh)[0]
        bc = fem.dirichletbc(x, fem.boundary_dofs(V), V)
        problems.append(NonlinearProblem(inner(grad(u), grad(v)) * dx + (u**3 - x**3) * v * dx, u, bcs=[bc]))
        return problems[-1]

    history = run(problem, lambda u: np.ones(u.function_space.num_cells))
    assert len(problems[0].norms) > 3
    assert max(len(p.norms) - 1 for p in problems[1:]) <= 1
    assert estimate.error(history.solution, lambda x: x[0]).max() < 1e-13  # rounding


def test_a_run_that_goes_on_starts_from_the_same_guess(tmp_path: Path) -> None:
    """Newton's iterates depend on it, to the last digit."""
    whole = run(newton, newton_residual, adapt.Stop(steps=4))
    for steps in (1, 3, 4):
        history = run(newton, newton_residual, adapt.Stop(steps=steps), checkpoint=tmp_path / "run.h5")
        assert history.reason == f"{steps} of {steps} steps"
    assert sizes(history) == sizes(whole)
    np.testing.assert_array_equal(history["estimate"], whole["estimate"])
    np.testing.assert_array_equal(history.solution.x.array, whole.solution.x.array)


def two_unknowns(V: fem.FunctionSpace) -> LinearProblem:
    """Return the equation u - Laplace u = f, with a vector (u, -u) that goes along as an unknown of its own."""
    W = fem.FunctionSpace(V.hierarchy, (2,))
    u, v, w, z = ufl.TrialFunction(V), ufl.TestFunction(V), ufl.TrialFunction(W), ufl.TestFunction(W)
    f = wavy(ufl.SpatialCoordinate(V.mesh))
    a = [
        [inner(grad(u), grad(v)) * dx + u * v * dx, None],
        [-inner(ufl.as_vector([u, -u]), z) * dx, inner(w, z) * dx],
    ]
    return LinearProblem(a, [f * v * dx, None])


def of_the_first(u: list[fem.Function]) -> Floats:
    f = wavy(ufl.SpatialCoordinate(u[0].function_space.mesh))
    return estimate.residual(u[0], f + ufl.div(grad(u[0])) - u[0])


def test_several_unknowns(tmp_path: Path) -> None:
    """Given as a problem or as a solution, also with a checkpoint, although they have one name."""
    whole = run(two_unknowns, of_the_first)
    assert [function.name for function in whole.solution] == ["f", "f"]
    V = whole.solution[0].function_space
    assert whole.steps[-1].dofs == 3 * V.num_dofs
    solved = run(lambda V: two_unknowns(V).solve(), of_the_first)
    assert sizes(solved) == sizes(whole)

    path = tmp_path / "run.h5"
    run(two_unknowns, of_the_first, adapt.Stop(steps=1), checkpoint=path)
    continued = run(two_unknowns, of_the_first, checkpoint=path)
    assert sizes(continued) == sizes(whole)
    saved = adapt.solve(space("grid"), two_unknowns, of_the_first, stop=THREE, checkpoint=path, progress=False)
    assert saved.steps == continued.steps
    for history in (solved, continued, saved):
        for function, expected in zip(history.solution, whole.solution, strict=True):
            assert function.name == "f"
            assert function.function_space == expected.function_space
            np.testing.assert_array_equal(function.x.array, expected.x.array)


def test_all_unknowns_get_their_guess() -> None:
    starts: list[fem.Function] = []

    class Both(Own):
        def solve(self) -> None:
            starts.extend(function.copy() for function in self.u)
            for number, function in enumerate(self.u):
                function.x.array[:] = number + 1.0

    def problem(V: fem.FunctionSpace) -> Both:
        return Both([fem.Function(V), fem.Function(fem.FunctionSpace(V.hierarchy, (3,)))], [])

    run(problem, lambda u: exact_error(u[0]), adapt.Stop(steps=1))
    assert [set(np.round(start.x.array, 12)) for start in starts] == [{0.0}, {0.0}, {1.0}, {2.0}]
    assert starts[3].function_space.value_shape == (3,)


@pytest.mark.parametrize("posed", [None, "u", 3.0, [], [1.0], Own(None, [])], ids=repr)
def test_what_is_no_problem_is_refused(posed: object) -> None:
    with pytest.raises(TypeError, match=r"the problem in FunctionSpace\(.*\) is of type \w+: give something that"):
        run(lambda V: posed)


def test_a_solution_in_another_space_is_refused() -> None:
    once = solve_poisson(space("grid"))
    with pytest.raises(ValueError, match=r"called with FunctionSpace\(.* 2 levels, .*solution is in .* 1 levels, 42"):
        run(lambda V: once)
    other = fem.functionspace(generators.rectangle((4, 3)), ("THCCS", 3))
    with pytest.raises(
        ValueError, match=r"its solution is in FunctionSpace\(.* dofs\) on another mesh: make its forms"
    ):
        run(lambda V: fem.Function(other))
    for constant in (fem.functionspace(other.mesh, ("DG", 0)), fem.space.cellwise(other)):
        with pytest.raises(ValueError, match=r"its solution is in CellwiseSpace\("):
            run(lambda V, constant=constant: fem.Function(constant))


def test_some_unknowns_may_be_in_finer_spaces(tmp_path: Path) -> None:
    """As velocities are, of pressures in V, whichever comes first; also from a checkpoint."""

    def problem(V: fem.FunctionSpace) -> list[fem.Function]:
        finer = adapt.refine(V, np.arange(V.num_functions))
        return [fem.Function(fem.FunctionSpace(finer.hierarchy, (2,)), "velocity"), solve_poisson(V)]

    def of_the_second(u: list[fem.Function]) -> Floats:
        return exact_error(u[1])

    alone = run(stop=adapt.Stop(steps=2))
    whole = run(problem, of_the_second, adapt.Stop(steps=2))
    run(problem, of_the_second, adapt.Stop(steps=1), checkpoint=tmp_path / "run.h5")
    continued = run(problem, of_the_second, adapt.Stop(steps=2), checkpoint=tmp_path / "run.h5")
    assert sizes(whole) == sizes(continued)
    assert whole["elements"].tolist() == alone["elements"].tolist()
    assert whole.steps[0].dofs == 42 + 2 * adapt.refine(space("grid"), np.arange(42)).num_dofs


def test_unknowns_stay_the_same(tmp_path: Path) -> None:
    run(stop=adapt.Stop(steps=1), checkpoint=tmp_path / "run.h5")
    for unknowns, shapes in (([(), ()], r"\[\(\), \(\)\]"), ([(2,)], r"\[\(2,\)\]")):

        def problem(V: fem.FunctionSpace, unknowns: Any = unknowns) -> Own:
            return Own([fem.Function(fem.FunctionSpace(V.hierarchy, shape)) for shape in unknowns], [])

        with pytest.raises(
            ValueError, match=rf"unknowns with values of shape {shapes}, the last solution \[\(\)\]: pose"
        ):
            run(problem, checkpoint=tmp_path / "run.h5")


@pytest.mark.parametrize("options", [{"unit": "ring"}, {"admissibility": 2}, {"boundary": "crease"}], ids=repr)
def test_a_run_goes_on_in_the_space_that_it_began_with(tmp_path: Path, options: dict[str, Any]) -> None:
    """A space that is refined in another way would be left as it was in the file, and nobody told."""
    run(stop=adapt.Stop(steps=1), checkpoint=tmp_path / "run.h5")
    V = fem.functionspace(space("grid").mesh, ("THCCS", 3), **options)
    with pytest.raises(ValueError, match="of a run that began with 42 dofs in another space than FunctionSpace"):
        adapt.solve(V, solve_poisson, exact_error, stop=THREE, checkpoint=tmp_path / "run.h5", progress=False)


@pytest.mark.parametrize(
    ("name", "given", "message"),
    [
        ("problem", Own(None, []), "problem is of type Own: give a function of the space, such as lambda V: Lin"),
        ("estimator", np.ones(12), "estimator is of type ndarray: give a function of the solution"),
        ("marking", "dorfler", r'marking is of type str: give a function of .*, such as adapt.Marking\("dorfler", 0.5'),
        ("stop", 1e-3, r"stop is of type float: give a function of the history, such as adapt.Stop\(tolerance"),
        ("callback", [print], "callback is of type list: give a function of the step and the solution"),
        ("V", space("grid").mesh, r"adapt.solve needs a space from fem.functionspace\(.*, got ControlMesh"),
    ],
)
def test_arguments_are_checked_before_anything_is_solved(name: str, given: Any, message: str) -> None:
    def refused(V: fem.FunctionSpace) -> fem.Function:
        raise AssertionError("solved")

    arguments = {"V": space("grid"), "problem": refused, "estimator": exact_error, "stop": THREE} | {name: given}
    with pytest.raises(TypeError, match=message):
        adapt.solve(**arguments)


# ---- Estimates and marks


def test_an_estimate_need_not_be_the_norm_of_the_indicators() -> None:
    """That of a goal has a sign; it is its absolute value that falls."""
    values = iter([-0.5, 0.25, -0.125, 0.0625])
    history = run(estimator=lambda u: (exact_error(u), next(values)), stop=adapt.Stop(tolerance=0.125))
    assert history["estimate"].tolist() == [-0.5, 0.25, -0.125]
    assert history.reason == "estimate 1.250e-01, within the tolerance 1.250e-01"
    assert "-0.5" not in str(history)
    assert sizes(history) == sizes(run())[:3]


@pytest.mark.parametrize("returned", [np.ones(5), np.ones((12, 1)), (np.ones(5), 1.0)])
def test_indicators_are_one_a_cell(returned: Any) -> None:
    with pytest.raises(ValueError, match=r"indicators of shape .*; it needs one for each of the 12 cells"):
        run(estimator=lambda u: returned)


@pytest.mark.parametrize(
    ("returned", "kind"),
    [
        (None, "a NoneType"),
        (1j * np.ones(12), "a ndarray"),
        ([np.ones(12), 1.0], "a list"),
        ((np.ones(12),), r"a tuple \(ndarray\)"),
        ((np.ones(12), 1.0, 2.0), r"a tuple \(ndarray, float, float\)"),
        ((np.ones(12), "small"), r"a tuple \(ndarray, str\)"),
        ((np.ones(12), np.ones(1)), r"a tuple \(ndarray, ndarray\)"),
        ((), r"a tuple \(\)"),
    ],
)
def test_indicators_are_real_numbers(returned: Any, kind: str) -> None:
    with pytest.raises(TypeError, match=f"the estimator returned {kind}; it must return real indicators, one for each"):
        run(estimator=lambda u: returned)


@pytest.mark.parametrize("marking", [adapt.Marking(), adapt.uniform])
@pytest.mark.parametrize(
    ("returned", "message"),
    [
        (
            np.full(12, np.nan),
            "the estimator returned nan for cell 0, and 12 such of 12 indicators: they must be finite",
        ),
        (np.array([1.0] * 11 + [-0.5]), "the estimator returned -0.5 for cell 11, and 1 such of 12 indicators"),
        ((np.ones(12), np.inf), "the estimator returned the estimate inf: it must be finite"),
    ],
)
def test_what_went_wrong_is_in_no_checkpoint(tmp_path: Path, marking: Any, returned: Any, message: str) -> None:
    """Or no run could go on from there."""
    with pytest.raises(ValueError, match=message):
        run(estimator=lambda u: returned, marking=marking, checkpoint=tmp_path / "run.h5")
    assert not (tmp_path / "run.h5").exists()


def test_marking_is_that_of_mark() -> None:
    V = space("grid")
    eta = exact_error(solve_poisson(V))
    rule = adapt.Marking("maximum", 0.9)
    history = run(stop=adapt.Stop(steps=1), marking=rule)
    marked = adapt.mark(V, eta, strategy="maximum", theta=0.9)
    np.testing.assert_array_equal(rule(V, eta), marked)
    assert history.steps[-1].dofs == adapt.refine(V, marked).num_dofs
    np.testing.assert_array_equal(adapt.Marking()(V, eta), adapt.mark(V, eta))
    for wrong, message in (({"strategy": "best"}, "strategy is 'best'"), ({"theta": 0.0}, "theta is 0.0; it must lie")):
        with pytest.raises(ValueError, match=message):
            adapt.Marking(**wrong)  # type: ignore[arg-type]  # what is refused


def test_any_rule_marks() -> None:
    seen = []

    def first(V: fem.FunctionSpace, eta: Floats) -> list[int]:
        seen.append((V.num_dofs, eta.size))
        return [0]

    history = run(marking=first)
    assert seen == [(step.dofs, step.elements) for step in history.steps[:-1]]
    V = space("grid")
    for _ in range(3):
        V = adapt.refine(V, [0])
    assert history.solution.function_space == V


def test_uniform_refinement_is_a_rule() -> None:
    history = run(marking=adapt.uniform, stop=adapt.Stop(steps=2))
    assert history["elements"].tolist() == [12, 48, 192]


def test_a_rule_may_return_the_refined_space() -> None:
    by_space = run(marking=lambda V, eta: adapt.refine(V, adapt.mark(V, eta)))
    np.testing.assert_array_equal(by_space["dofs"], run()["dofs"])
    assert run(marking=lambda V, eta: V).reason == "no function is marked, or none that can be refined"


@pytest.mark.parametrize(
    ("returned", "message"),
    [
        (lambda V: fem.functionspace(V.mesh, ("THCCS", 3), boundary="crease"), "which is no refinement of"),
        (lambda V: fem.functionspace(generators.torus((6, 4)), ("THCCS", 3)), "on another mesh, which is no refinem"),
    ],
)
def test_a_space_that_is_no_refinement_is_refused(returned: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        run(marking=lambda V, eta: returned(V))


# ---- Callbacks


def test_a_callback_sees_each_step_and_adds_columns(tmp_path: Path) -> None:
    seen = []

    def callback(step: adapt.Step, u: fem.Function) -> dict[str, float] | None:
        assert u.function_space.num_dofs == step.dofs
        seen.append(step)
        if step.number == 1:
            return None
        return {"error": estimate.norm(u.function_space, exact_error(u)), "twice": np.int64(2 * step.number)}

    path = tmp_path / "run.h5"
    run(stop=adapt.Stop(steps=1), callback=callback, checkpoint=path)
    history = run(callback=callback, checkpoint=path)
    assert [step.number for step in seen] == [0, 1, 2, 3]
    assert history.columns[-2:] == ("error", "twice")
    np.testing.assert_array_equal(history["error"], np.where([1, 0, 1, 1], history["estimate"], np.nan))
    np.testing.assert_array_equal(history["twice"], [0, np.nan, 4, 6])
    assert [replace(step, values={}) for step in history.steps] == seen
    saved = checkpoint.read(path).attributes["adapt.solve"]["steps"]
    assert [adapt.Step(**step) for step in saved] == list(history.steps)


@pytest.mark.parametrize(
    ("returned", "error", "message"),
    [
        (0.5, TypeError, "the callback returned a float: return None, or numbers by name"),
        ({"dofs": 1.0}, ValueError, "the callback names a number 'dofs', as a column that is there: take another name"),
        ({"rate": 1.0}, ValueError, "the callback names a number 'rate'"),
        ({"error": "small"}, TypeError, "returned 'small' under the name 'error': return real numbers by name"),
        ({"error": 1j}, TypeError, "returned 1j under the name 'error'"),
        ({"errors": [1.0, 2.0]}, TypeError, r"returned \[1.0, 2.0\] under the name 'errors'"),
        ({1: 2.0}, TypeError, "returned 2.0 under the name 1: return real numbers by name"),
    ],
)
def test_what_callbacks_return_is_checked(returned: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        run(callback=lambda step, u: returned)


# ---- The history


def history_of(dofs: npt.ArrayLike, estimates: npt.ArrayLike, **columns: npt.ArrayLike) -> adapt.History:
    """Return a history with these columns."""
    numbers = enumerate(zip(np.asarray(dofs).tolist(), np.asarray(estimates).tolist(), strict=True))
    values = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)] or None
    return adapt.History(
        tuple(
            adapt.Step(i, i + 1, 2 * n, n, eta, 0.25, values={} if values is None else values[i])
            for i, (n, eta) in numbers
        )
    )


def test_columns_are_arrays() -> None:
    history = history_of([10, 20], [0.5, 0.25], error=[0.1, 0.05])
    for name, expected in {
        "step": [0, 1],
        "levels": [1, 2],
        "elements": [20, 40],
        "dofs": [10, 20],
        "estimate": [0.5, 0.25],
        "seconds": [0.25, 0.25],
        "imbalance": [1.0, 1.0],
        "error": [0.1, 0.05],
    }.items():
        np.testing.assert_array_equal(history[name], expected)
        assert name in history.columns
    assert history["dofs"].dtype == np.int64
    assert ("error" in history, "eror" in history) == (True, False)
    assert list(dict(history)) == list(history.columns)
    assert len(history) == 8
    with pytest.raises(KeyError, match=r"no column 'rate'; .*, imbalance.*; rates of a column are rates\(column\)"):
        history["rate"]
    with pytest.raises(KeyError, match="there is no column 'errors'; there are step, levels, elements, dofs, estimat"):
        history["errors"]


@pytest.mark.parametrize("rate", [0.5, 1.5, 2.0])
def test_rates_of_powers_are_their_exponents(rate: float) -> None:
    dofs = np.array([10, 23, 80, 85, 300, 1000, 1700])
    history = history_of(dofs, -3.0 * dofs**-rate, error=5.0 * dofs ** (-2.0 * rate))
    assert history.rate() == pytest.approx(rate, abs=1e-12)
    assert history.rate("error", last=2) == pytest.approx(2.0 * rate, abs=1e-12)
    np.testing.assert_allclose(history.rates()[1:], rate, rtol=1e-11)  # dofs 80 and 85 are near to each other
    assert np.isnan(history.rates()[0])


def test_a_rate_is_that_of_the_last_steps() -> None:
    dofs = 10 * 2 ** np.arange(8)
    history = history_of(dofs, np.where(dofs < 100, 1.0, 100.0 / dofs))
    assert history.rate(last=4) == pytest.approx(1.0)
    assert history.rate(last=8) < 0.9
    assert history.rate(last=100) == history.rate(last=8)


def test_there_may_be_no_rate() -> None:
    np.testing.assert_array_equal(history_of([5, 5, 9], [1.0, 0.5, 0.0]).rates(), [np.nan] * 3)
    for dofs, estimates, last in (([5], [1.0], 5), ([5, 9], [1.0, 0.0], 5), ([5, 9], [1.0, 1.0], 1)):
        with pytest.raises(ValueError, match=rf"the last {last} of . steps have not two values of 'estimate' at"):
            history_of(dofs, estimates).rate(last=last)
    with pytest.raises(KeyError, match="there is no column 'error'"):
        history_of([5, 9], [1.0, 0.5]).rate("error")


def test_history_is_printed_as_a_table() -> None:
    steps = (adapt.Step(0, 1, 12, 42, 0.0125, 0.25), adapt.Step(1, 2, 120000, 130000, -3.5e-07, 61.5))
    assert str(adapt.History(steps, reason="enough")) == (
        "step levels  elements      dofs   estimate  rate  seconds\n"
        "   0      1        12        42  1.250e-02           0.25\n"
        "   1      2    120000    130000  3.500e-07  1.30    61.50\n"
        "ended: enough"
    )
    assert str(adapt.History((replace(steps[0], number=7),))).splitlines()[-1].startswith("   7 ")
    values = replace(steps[0], values={"error": 0.05, "iterations": 12.0, "b": -0.25})
    assert str(adapt.History((values, replace(steps[1], imbalance=1.0625)))) == (  # of several ranks
        "step levels  elements      dofs   estimate  rate      error iterations        b  seconds imbalance\n"
        "   0      1        12        42  1.250e-02        5.000e-02         12 -0.25000     0.25     1.000\n"
        "   1      2    120000    130000  3.500e-07  1.30                                   61.50     1.062"
    )
    assert str(adapt.History()) == "step levels  elements      dofs   estimate  rate  seconds"


@pytest.mark.parametrize(("progress", "shown"), [(True, True), (False, False), (None, False)])
def test_progress_is_shown_on_demand(progress: bool | None, shown: bool, capfd: pytest.CaptureFixture[str]) -> None:
    """None: only in a terminal, which standard error is not here."""
    run(stop=adapt.Stop(steps=1), progress=progress)
    out, err = capfd.readouterr()
    assert out == ""
    assert ("adaptive run" in err) == shown
    assert ("2/2" in err) == shown
    run(stop=adapt.Stop(dofs=100), progress=progress)  # nobody knows how many steps these are
    assert ("adaptive run" in capfd.readouterr().err) == shown
