"""Problems in time: the formulas of the schemes, what is conserved, changes of space, and failures. For orders see
tests/convergence/test_time.py."""

import gc
import weakref
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from problems import randomly_refined

import ufl
from thccs_fem import adapt, fem, generators
from thccs_fem.fem.space import FunctionSpace
from thccs_fem.forms import allen_cahn, cahn_hilliard, heat
from ufl import dx, inner

pytest.importorskip("petsc4py")

from petsc4py import PETSc

from thccs_fem.fem import assembly
from thccs_fem.fem.petsc import TimeProblem, linear

SCHEMES = ["implicit_euler", "bdf2", "crank_nicolson"]
EXACT = {"snes_rtol": 1e-13}

each_scheme = pytest.mark.parametrize("scheme", SCHEMES)


@pytest.fixture(autouse=True)
def _options_stay_as_they_are() -> Iterator[None]:
    before = PETSc.Options().getAll()
    yield
    assert PETSc.Options().getAll() == before


def square(shape: tuple[int, ...] = ()) -> FunctionSpace:
    return fem.functionspace(generators.rectangle((2, 2)), ("THCCS", 3, shape))


def torus(shape: tuple[int, ...] = ()) -> FunctionSpace:
    return randomly_refined(fem.functionspace(generators.torus((8, 6)), ("THCCS", 3, shape)), 1)


def functions(V: FunctionSpace, value: Any = 1.0) -> tuple[fem.Function, fem.Function, ufl.Argument]:
    """Return u with a value, constant or an expression, udot, and a test function."""
    u = fem.project(value, V) if isinstance(value, ufl.core.expr.Expr) else fem.Function(V)
    if not isinstance(value, ufl.core.expr.Expr):
        u.x.array = np.tile(value, V.num_functions)  # functions sum to one
    return u, fem.Function(V), ufl.TestFunction(V)


def decay(V: FunctionSpace, dt: float = 0.1, **kwargs: Any) -> TimeProblem:
    """Return du/dt = -u, where constants stay constant in space, from u = 1."""
    u, udot, v = functions(V)
    kwargs = {"petsc_options_prefix": "decay_", **kwargs}
    return TimeProblem((udot + u) * v * dx, u, udot, dt=dt, **kwargs)


def integral(u: fem.Function) -> float:
    return fem.assemble_scalar(fem.form(u * dx))


def distance(u: fem.Function, other: fem.Function) -> float:
    return float(np.sqrt(fem.assemble_scalar(fem.form((u - other) ** 2 * dx))))


def wavy(V: FunctionSpace) -> ufl.core.expr.Expr:
    x = ufl.SpatialCoordinate(V.mesh)
    return 0.1 + 0.5 * ufl.sin(2 * x[0] + x[1]) * ufl.cos(2 * x[1])


def projected(u: fem.Function, V: FunctionSpace) -> fem.Function:
    return fem.project(u, V)


# ---- The formulas


def test_implicit_euler() -> None:
    problem = decay(square(), scheme="implicit_euler")
    values = [float(u.x.array[0]) for u in problem.steps(0.5)]
    np.testing.assert_allclose(values, 1.1 ** -np.arange(1.0, 6.0), rtol=1e-12)


def test_crank_nicolson() -> None:
    problem = decay(square(), scheme="crank_nicolson")
    values = [float(u.x.array[0]) for u in problem.steps(0.5)]
    np.testing.assert_allclose(values, (0.95 / 1.05) ** np.arange(1.0, 6.0), rtol=1e-12)


def test_bdf2() -> None:
    problem = decay(square())
    values = [1.0, *(float(u.x.array[0]) for u in problem.steps(0.5))]
    half = 1 / 1.05  # it starts with half a step of implicit Euler
    expected = [1.0, (4 * half - 1) / (3 + 0.1)]
    for _ in range(4):
        expected.append((4 * expected[-1] - expected[-2]) / (3 + 2 * 0.1))
    np.testing.assert_allclose(values, expected, rtol=1e-12)


def test_bdf2_with_another_step() -> None:
    problem = decay(square())
    before, now = (float(problem.step().x.array[0]) for _ in range(2))
    problem.dt = 0.3
    # The parabola through three values at -0.1, 0 and 0.3 has at 0.3 the slope -value.
    weights = np.linalg.solve(np.vander([-0.1, 0.0, 0.3], increasing=True).T, [0.0, 1.0, 0.6])
    expected = -(weights[0] * before + weights[1] * now) / (weights[2] + 1)
    assert problem.step().x.array[0] == pytest.approx(expected, rel=1e-12)


def test_nonlinear_reaction() -> None:
    V = square()
    u, udot, v = functions(V, 0.2)
    problem = TimeProblem(
        (udot - u * (1 - u)) * v * dx, u, udot, dt=0.5, scheme="implicit_euler", petsc_options_prefix="logistic_"
    )
    expected = 0.2
    for _ in range(4):  # dt w^2 + (1 - dt) w = u
        expected = (-0.5 + np.sqrt(0.25 + 2 * expected)) / 1.0
        np.testing.assert_allclose(problem.step().x.array, expected, rtol=1e-9)


def test_crank_nicolson_conserves_what_turns() -> None:
    u, udot, v = functions(square((2,)), np.array([0.6, 0.8]))
    problem = TimeProblem(
        inner(udot - 2 * ufl.as_vector([-u[1], u[0]]), v) * dx,
        u,
        udot,
        dt=0.05,
        scheme="crank_nicolson",
        petsc_options_prefix="turn_",
        petsc_options=EXACT,
    )
    problem.solve(1.0)
    values = u.x.array.reshape(-1, 2)
    np.testing.assert_allclose(np.linalg.norm(values, axis=1), 1.0, rtol=1e-11)
    turned = 20 * 2 * np.arctan(0.05) + np.arctan2(0.8, 0.6)  # each step turns by a little less than 2 dt
    np.testing.assert_allclose(values, np.broadcast_to([np.cos(turned), np.sin(turned)], values.shape), rtol=1e-10)


@each_scheme
def test_time_in_the_form(scheme: str) -> None:
    V = square()
    t = fem.Constant(V.mesh, 2.0)
    u, udot, v = functions(V, 4.0)
    problem = TimeProblem((udot - 2 * t) * v * dx, u, udot, dt=0.25, t=t, scheme=scheme, petsc_options_prefix="time_")
    problem.solve(3.0)
    assert problem.time == float(t) == 3.0  # sums of 1/4
    # 2 t is taken at the ends of steps, of length 1 together; half a step like that, with which BDF2 starts, errs by
    # dt^2 / 4, the first step by 4/3 of it, and BDF2 goes on with e_(n+1) = (4 e_n - e_(n-1)) / 3.
    start = 0.25**2 / 3
    error = {"implicit_euler": 0.25, "bdf2": start * 1.5 * (1 - 3.0**-4), "crank_nicolson": 0.0}[scheme]
    np.testing.assert_allclose(u.x.array, 9.0 + error, rtol=1e-10)


# ---- Steps


def test_steps_end_where_they_should() -> None:
    problem = decay(square(), dt=0.3, scheme="implicit_euler")
    times = [problem.time for _ in problem.steps(1.0)]
    np.testing.assert_allclose(times, [0.3, 0.6, 0.9, 1.0], rtol=1e-14)
    assert (problem.dt, problem.step_number) == (0.3, 4)
    np.testing.assert_allclose(problem.u.x.array, 1.3**-3 / 1.1, rtol=1e-12)
    assert list(problem.steps(1.0)) == []
    problem.dt = 0.1
    assert len(list(problem.steps(2.0))) == 10  # whatever 1.0 + 0.1 + ... is in floating point
    assert problem.solve(2.55) is problem.u
    assert problem.time == pytest.approx(2.55, rel=1e-14)


@each_scheme
def test_steps_of_a_size_that_petsc_chooses(scheme: str) -> None:
    errors, numbers = [], []
    for tolerance in (1e-4, 1e-6):
        options = {"ts_adapt_type": "basic", "ts_rtol": tolerance, "ts_atol": tolerance}
        problem = decay(square(), dt=1e-3, scheme=scheme, petsc_options=options)
        sizes = [problem.dt for _ in problem.steps(2.0)]
        assert max(sizes) > 2 * min(sizes)
        errors.append(abs(problem.u.x.array[0] - np.exp(-2.0)))
        numbers.append(problem.step_number)
    order = 3 if scheme == "bdf2" else 2  # of PETSc's estimate for one step
    assert numbers[1] / numbers[0] == pytest.approx(100 ** (1 / order), rel=0.3)
    assert errors[1] < errors[0] < 0.01


def test_values_from_outside_are_where_the_next_step_starts() -> None:
    problem = decay(square())
    problem.step()
    problem.step()
    problem.u.x.array = 1.0  # as at the start: no memory of what was before
    again = [float(problem.step().x.array[0]) for _ in range(3)]
    other = decay(square())
    np.testing.assert_allclose(again, [float(other.step().x.array[0]) for _ in range(3)], rtol=1e-12)


def test_the_matrix_is_assembled_where_something_changed(monkeypatch: pytest.MonkeyPatch) -> None:
    V = square()
    u, udot, v = functions(V)
    k = fem.Constant(V.mesh, 2.0)
    problem = TimeProblem(
        (udot + k * u) * v * dx, u, udot, dt=0.1, scheme="implicit_euler", petsc_options_prefix="once_"
    )
    calls = []
    fill = assembly.assemble_matrix
    monkeypatch.setattr(assembly, "assemble_matrix", lambda *args: calls.append(0) or fill(*args))
    problem.solve(1.0)
    assert len(calls) == 1
    problem.dt = 0.2
    problem.solve(1.4)
    assert len(calls) == 2
    k.value = 3.0
    np.testing.assert_allclose(problem.solve(1.6).x.array, 1.2**-10 / 1.4**2 / 1.6, rtol=1e-12)
    assert len(calls) == 3


def test_large_systems_are_iterated(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(linear, "LARGEST_DIRECT", 10)
    V = torus()
    u, udot, v = functions(V, wavy(V))
    problem = TimeProblem(heat.F(u, udot, v), u, udot, dt=0.1, petsc_options_prefix="large_")
    iterated = problem.solve(0.3).x.array.copy()
    assert problem.solver.getSNES().getKSP().getType() == "gmres"
    monkeypatch.undo()
    u.x.array = fem.project(wavy(V), V).x.array
    direct = TimeProblem(heat.F(u, udot, v), u, udot, dt=0.1, petsc_options_prefix="direct_")
    np.testing.assert_allclose(iterated, direct.solve(0.3).x.array, atol=1e-9)
    assert direct.solver.getSNES().getKSP().getType() == "preonly"


def test_options_reach_all_solvers() -> None:
    options = {"-snes_max_it": 7, "ksp_type": "cg", "pc_type": "jacobi", "ts_typo": 3}
    PETSc.Options().setValue("decay_snes_stol", 1e-5)
    try:
        problem = decay(square(), petsc_options=options)
    finally:
        PETSc.Options().delValue("decay_snes_stol")
    with pytest.warns(UserWarning, match=r"PETSc made no use of the options \['ts_typo'\]: are they misspelt"):
        problem.step()
    snes = problem.solver.getSNES()
    problem.step()  # once is enough
    assert (snes.getTolerances()[2:], snes.getKSP().getType()) == ((1e-5, 7), "cg")
    assert snes.getKSP().getPC().getType() == "jacobi"
    assert (problem.solver.getOptionsPrefix(), problem.solver.getType()) == ("decay_", "bdf")


# ---- What is conserved, and what falls


@each_scheme
def test_heat_is_conserved(scheme: str) -> None:
    V = torus()
    u, udot, v = functions(V, wavy(V))
    before = integral(u)
    problem = TimeProblem(heat.F(u, udot, v), u, udot, dt=0.2, scheme=scheme, petsc_options_prefix="heat_")
    for _ in problem.steps(2.0):
        assert integral(u) == pytest.approx(before, abs=1e-12)


@each_scheme
def test_what_unmixes_is_conserved_and_loses_energy(scheme: str) -> None:
    V = torus()
    u, udot, v = functions(V, wavy(V))
    problem = TimeProblem(
        cahn_hilliard.F(u, udot, v, epsilon=0.5),
        u,
        udot,
        dt=0.02,
        scheme=scheme,
        petsc_options_prefix="unmixing_",
        petsc_options=EXACT,
    )
    energy = fem.form(cahn_hilliard.energy(u, epsilon=0.5))
    before, energies = integral(u), [fem.assemble_scalar(energy)]
    for _ in problem.steps(0.4):
        assert integral(u) == pytest.approx(before, abs=1e-12)
        energies.append(fem.assemble_scalar(energy))
    assert (np.diff(energies) < 0.0).all()
    assert energies[-1] < 0.95 * energies[0]


def test_waves_of_a_mixture_grow_as_they_should_between_walls() -> None:
    # cos(pi x) has grad(u) . n = 0 and no flux; it grows like exp(s t) with s = -k^2 (W''(0) + epsilon^2 k^2), k = pi.
    V = fem.functionspace(generators.rectangle((4, 4)), ("THCCS", 3))
    wave = ufl.cos(np.pi * ufl.SpatialCoordinate(V.mesh)[0])
    u, udot, v = functions(V, 1e-4 * wave)
    F = cahn_hilliard.F(u, udot, v, epsilon=0.2) + cahn_hilliard.contact(u, v, epsilon=0.2, h=fem.cell_sizes(V))
    problem = TimeProblem(F, u, udot, dt=1e-3, scheme="crank_nicolson", petsc_options_prefix="walls_")
    amplitude = fem.form(u * wave * dx)
    before = fem.assemble_scalar(amplitude)
    problem.solve(0.02)
    rate = np.log(fem.assemble_scalar(amplitude) / before) / 0.02
    assert rate == pytest.approx(np.pi**2 * (1 - 0.04 * np.pi**2), rel=1e-3)  # 2.7e-4, 1.6e-5 on half the faces' size
    assert integral(u) == pytest.approx(0.0, abs=1e-16)


def test_phases_lose_the_energy_that_their_motion_takes() -> None:
    # The steepest descent loses the integral of (du/dt)^2 in a unit of time; implicit Euler for dt < epsilon^2 at least
    # that of its difference quotient, twice for small dt and half of it for large.
    V = torus()
    u, udot, v = functions(V, wavy(V))
    problem = TimeProblem(
        allen_cahn.F(u, udot, v, epsilon=0.4), u, udot, dt=0.01, scheme="implicit_euler", petsc_options_prefix="phases_"
    )
    energy, last = fem.form(allen_cahn.energy(u, epsilon=0.4)), u.copy()
    power = fem.form(((u - last) / problem.dt) ** 2 * dx)
    for _ in range(20):
        last.x.array, before = u.x.array, fem.assemble_scalar(energy)
        problem.step()
        lost = before - fem.assemble_scalar(energy)
        assert lost == pytest.approx(problem.dt * fem.assemble_scalar(power), rel=0.25)
        assert lost > 0.0


# ---- Conditions


@each_scheme
@pytest.mark.parametrize("changing", [False, True])
def test_prescribed_values_hold_after_each_step(scheme: str, changing: bool) -> None:
    V = square()
    u, udot, v = functions(V, 7.0)
    t, dofs = fem.Constant(V.mesh, 1.0), fem.boundary_dofs(V)
    given = [fem.dirichletbc(1.0, dofs, V)]
    problem = TimeProblem(
        heat.F(u, udot, v),
        u,
        udot,
        dt=0.1,
        t=t,
        scheme=scheme,
        bcs=(lambda V, time: [fem.dirichletbc(time * t, dofs, V)]) if changing else given,
        petsc_options_prefix="prescribed_",
    )
    for _ in problem.steps(1.5):
        np.testing.assert_allclose(u.x.array[dofs], problem.time**2 if changing else 1.0, rtol=1e-13)
    assert np.delete(u.x.array, dofs).max() < 5.0  # from 7


def test_conditions_are_asked_for_once_a_step() -> None:
    V, times = square(), []

    def bcs(V: FunctionSpace, time: float) -> list[fem.DirichletBC]:
        times.append(time)
        return [fem.dirichletbc(time, fem.boundary_dofs(V), V)]

    decay(V, bcs=bcs, scheme="implicit_euler").solve(0.3)
    np.testing.assert_allclose(times, [0.0, 0.1, 0.2, 0.3], rtol=1e-14)


# ---- Changes of space


@each_scheme
def test_the_same_space_changes_nothing(scheme: str) -> None:
    V = torus()
    u, udot, v = functions(V, wavy(V))
    problem = TimeProblem(
        heat.F(u, udot, v), u, udot, dt=0.1, scheme=scheme, petsc_options_prefix="same_", petsc_options=EXACT
    )
    problem.solve(0.3)
    other = problem.with_space(V, adapt.transfer)
    for _ in range(3):
        np.testing.assert_allclose(other.step().x.array, problem.step().x.array, rtol=0, atol=1e-13)
    assert other.u is not problem.u


def test_a_problem_goes_on_in_another_space() -> None:
    V = square()
    t = fem.Constant(V.mesh, 0.5)
    u, udot, v = functions(V, wavy(V))
    u.name = "temperature"
    source = fem.project(1.0, V)  # stays where it is
    F = heat.F(u, udot, v, t * source)
    problem = TimeProblem(F, u, udot, dt=0.1, t=t, petsc_options_prefix="on_", petsc_options={"snes_max_it": 9})
    problem.dt = 0.05
    problem.solve(0.7)
    fine = adapt.refine(V, [0])
    finer = problem.with_space(fine, adapt.transfer)
    assert finer.u.function_space == finer.udot.function_space == fine
    assert (finer.time, finer.dt, finer.step_number, finer.u.name) == (problem.time, 0.05, 4, "temperature")
    assert finer.solver.getSNES().getTolerances()[3] == 9
    coarser = finer.with_space(V, projected)
    assert distance(coarser.u, u) < 1e-10  # there and back again: projections are iterated to 1e-13
    for other in (finer, coarser, problem):  # they share the time, one after the other
        t.value = problem.time
        other.step()
    assert distance(coarser.u, u) < 1e-9  # 20 times in du/dt
    assert 1e-9 < distance(finer.u, u) < 1e-3


def test_heat_is_conserved_where_the_space_changes() -> None:
    V = square()  # flat: on curved cells what quadrature leaves of an integral is another part on finer ones
    u, udot, v = functions(V, wavy(V))
    problem = TimeProblem(heat.F(u, udot, v), u, udot, dt=0.1, petsc_options_prefix="moving_", petsc_options=EXACT)
    before = integral(u)
    for number in range(6):
        problem.step()
        problem = problem.with_space(randomly_refined(V, 2, seed=number), adapt.transfer)  # finer here, coarser there
    assert integral(problem.u) == pytest.approx(before, abs=1e-12)


def test_conditions_in_another_space() -> None:
    V = square()
    fine = adapt.refine(V, [0])
    problem = decay(V, bcs=[fem.dirichletbc(1.0, fem.boundary_dofs(V), V)])
    problem.step()
    with pytest.raises(ValueError, match=r"the conditions are a list for the dofs of the old space: give bcs=\[...\]"):
        problem.with_space(fine, adapt.transfer)
    dofs = fem.boundary_dofs(fine)
    other = problem.with_space(fine, adapt.transfer, bcs=[fem.dirichletbc(2.0, dofs, fine)])
    np.testing.assert_array_equal(other.u.x.array[dofs], 2.0)
    np.testing.assert_allclose(other.step().x.array[dofs], 2.0, rtol=1e-13)


# ---- What fails


def explosion(dt: float, **kwargs: Any) -> TimeProblem:
    """Return du/dt = u^2 from 1: a step of implicit Euler has a solution for dt < 1/4 only."""
    u, udot, v = functions(square())
    kwargs = {"scheme": "implicit_euler", "petsc_options_prefix": "explosion_", **kwargs}
    return TimeProblem((udot - u**2) * v * dx, u, udot, dt=dt, **kwargs)


def test_a_step_without_a_solution_may_be_tried_again() -> None:
    problem = explosion(dt=0.1)
    problem.step()
    after = problem.u.x.array.copy()
    problem.dt = 0.5
    with pytest.raises(
        RuntimeError,
        match=r"PETSc's beuler failed in the step from t = 0.1 with dt = 0.5: DIVERGED_L\w+, .*, after \d+ iterations, "
        r"with a residual of norm .*What may help: a smaller dt",
    ):
        problem.step()
    assert (problem.time, problem.step_number, problem.dt) == (0.1, 1, 0.5)
    np.testing.assert_array_equal(problem.u.x.array, after)
    problem.dt = 0.1
    np.testing.assert_allclose(problem.step().x.array, (1 - np.sqrt(1 - 0.4 * after)) / 0.2, rtol=1e-9)
    assert problem.step_number == 2


def test_a_last_step_that_fails_leaves_the_size_of_steps() -> None:
    problem = explosion(dt=1.0)
    with pytest.raises(RuntimeError, match=r"from t = 0 with dt = 0\.5"):
        problem.solve(0.5)
    assert (problem.time, problem.dt) == (0.0, 1.0)


def test_data_may_be_others_when_a_step_is_tried_again() -> None:
    V = square()
    u, udot, v = functions(V)
    k, g, dofs = fem.Constant(V.mesh, 1.0), fem.Constant(V.mesh, 1.0), fem.boundary_dofs(V)
    problem = TimeProblem(
        (udot + k * u) * v * dx,
        u,
        udot,
        dt=0.1,
        bcs=lambda V, time: [fem.dirichletbc(g, dofs, V)],
        petsc_options_prefix="others_",
    )
    problem.step()
    k.value = np.nan
    with pytest.raises(RuntimeError, match="not finite"):
        problem.step()
    k.value, g.value = 1.0, 2.0
    np.testing.assert_allclose(problem.step().x.array[dofs], 2.0, rtol=1e-13)


def test_bdf2_keeps_its_history_over_a_failure() -> None:
    smooth, failing = (explosion(dt=0.1, scheme="bdf2", petsc_options=EXACT) for _ in range(2))
    for problem in (smooth, failing):
        problem.solve(0.3)
    failing.dt = 5.0
    with pytest.raises(RuntimeError, match="DIVERGED"):
        failing.step()
    failing.dt = 0.1
    np.testing.assert_allclose(failing.step().x.array, smooth.step().x.array, rtol=1e-12)


def test_too_few_iterations_of_the_linear_solver() -> None:
    V = torus()
    u, udot, v = functions(V, wavy(V))
    options = {"ksp_type": "cg", "pc_type": "none", "ksp_max_it": 1}
    problem = TimeProblem(heat.F(u, udot, v), u, udot, dt=1.0, petsc_options_prefix="few_", petsc_options=options)
    with pytest.raises(
        RuntimeError,
        match="DIVERGED_LINEAR_SOLVE, PETSc's cg with the preconditioner none failed after 1 iterations: DIVERGED_MAX",
    ):
        problem.step()


def test_values_that_are_not_finite() -> None:
    u, udot, v = functions(square())
    problem = TimeProblem((udot - ufl.sqrt(u - 2)) * v * dx, u, udot, dt=0.1, petsc_options_prefix="nan_")
    with pytest.raises(RuntimeError, match="DIVERGED_FUNCTION_NANORINF, the residual is not finite"):
        problem.step()
    np.testing.assert_allclose(u.x.array, 1.0, rtol=1e-12)


def test_steps_that_are_rejected_again_and_again() -> None:
    options = {"ts_adapt_type": "basic", "ts_rtol": 1e-13, "ts_atol": 1e-13, "ts_max_step_rejections": 2}
    problem = decay(square(), dt=1.0, petsc_options=options)
    with pytest.raises(RuntimeError, match=r"DIVERGED_STEP_REJECTED.*loosen ts_rtol and ts_atol"):
        problem.solve(2.0)


def test_errors_in_conditions_come_through() -> None:
    def bcs(V: FunctionSpace, time: float) -> list[fem.DirichletBC]:
        if time > 0.15:
            raise ValueError("no data after 0.15")
        return []

    problem = decay(square(), bcs=bcs)
    problem.step()
    with pytest.raises(ValueError, match=r"no data after 0\.15"):
        problem.step()


def test_memory_is_given_back() -> None:
    problem = decay(square())
    problem.step()
    equations, ts = weakref.ref(problem._equations), problem.solver
    del problem
    gc.collect()
    assert equations() is None
    assert ts.getStepNumber() == 1  # who holds the TS may ask it, though it cannot go on


# ---- What is refused


def test_arguments_are_checked() -> None:
    V = square()
    W = fem.functionspace(V.mesh, ("THCCS", 3, (2,)))
    u, udot, v = functions(V)
    F = (udot + u) * v * dx

    def problem(F: Any = F, u: Any = u, udot: Any = udot, **kwargs: Any) -> TimeProblem:
        return TimeProblem(F, u, udot, **{"dt": 0.1, "petsc_options_prefix": "refused_", **kwargs})

    with pytest.raises(ValueError, match="petsc_options_prefix is empty"):
        problem(petsc_options_prefix="")
    with pytest.raises(ValueError, match="the scheme is 'rk4'; it must be one of implicit_euler, bdf2, crank_nicolson"):
        problem(scheme="rk4")
    for dt in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="steps go forward, give a positive size"):
            problem(dt=dt)
    with pytest.raises(TypeError, match="F is a Form: give a UFL form"):
        problem(fem.form(F))
    with pytest.raises(ValueError, match="but udot in FunctionSpace"):
        problem(udot=fem.Function(W))
    with pytest.raises(ValueError, match=r"F has the arguments \(\): it needs a test function in FunctionSpace"):
        problem(udot * u * dx)
    with pytest.raises(ValueError, match="it needs a test function in FunctionSpace"):
        problem((udot + u) * ufl.TestFunction(W)[0] * dx)
    with pytest.raises(ValueError, match="F does not contain udot"):
        problem(u * v * dx)
    with pytest.raises(TypeError, match="bcs is a single condition"):
        problem(bcs=fem.dirichletbc(0.0, [0], V)).step()
    with pytest.raises(ValueError, match="a condition is on FunctionSpace"):
        problem(bcs=[fem.dirichletbc(0.0, [0], W)]).step()


def test_crank_nicolson_needs_a_constant_mass() -> None:
    u, udot, v = functions(square())
    for F in (u * udot * v * dx, (1 + udot**2) * udot * v * dx):
        with pytest.raises(ValueError, match=r'the terms with udot depend on \w+, .* use scheme="bdf2"'):
            TimeProblem(F, u, udot, dt=0.1, scheme="crank_nicolson", petsc_options_prefix="mass_")
    # u du/dt = -u^2: the others do it.
    problem = TimeProblem((u * udot + u**2) * v * dx, u, udot, dt=0.1, petsc_options_prefix="mass_")
    np.testing.assert_allclose(problem.solve(1.0).x.array, np.exp(-1.0), rtol=5e-3)
