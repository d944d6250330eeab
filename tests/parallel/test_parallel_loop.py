"""The adaptive loop on several ranks: each step, mark and number is that of a serial run."""

from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
import pytest
from compared import same_as_in_serial
from problems import singular

import ufl
from thccs_fem import adapt, estimate, fem, generators, plot
from thccs_fem.fem.petsc import LinearProblem, NonlinearProblem
from thccs_fem.partition import partition
from ufl import div, dx, grad, inner

Floats = npt.NDArray[np.float64]

MUMPS = {"ksp_type": "preonly", "pc_type": "lu", "pc_factor_mat_solver_type": "mumps"}


def of_all(history: adapt.History) -> dict[str, Any]:
    """Return what a run came to, in an order that knows nothing of ranks."""
    u = history.solution
    unknowns = [u] if isinstance(u, fem.Function) else u
    columns = {name: history[name] for name in history.columns if name not in ("seconds", "imbalance")}
    keys = unknowns[0].function_space.hierarchy.refined_keys
    return (
        columns
        | {f"level {level}": found for level, found in enumerate(keys)}
        | {f"values {i}": f.x.index_map.gather(f.x.array.reshape(-1, f.x.block_size)) for i, f in enumerate(unknowns)}
        | {"reason": history.reason}
    )


def on_the_l_domain(V: fem.FunctionSpace) -> LinearProblem:
    """Return Laplace's equation with r^(2/3) on the boundary."""
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    exact = singular(ufl.SpatialCoordinate(V.mesh))
    bc = fem.dirichletbc(exact, fem.boundary_dofs(V), V)
    a, L = inner(grad(u), grad(v)) * dx, fem.Constant(V.mesh, 0.0) * v * dx
    return LinearProblem(a, L, bcs=[bc], petsc_options=MUMPS, petsc_options_prefix="laplace_")


def test_an_adaptive_run_marks_and_refines_the_same() -> None:
    """Residuals of a solution with a singularity, to nine levels: marks, hierarchies, estimates and the solution."""

    def run(comm: MPI.Comm) -> dict[str, Any]:
        V = fem.functionspace(generators.l_domain(2, comm=comm), ("THCCS", 3))
        marks: dict[str, Any] = {}

        def marking(V: fem.FunctionSpace, eta: Floats) -> npt.NDArray[np.int64]:
            marks[f"marks {len(marks)}"] = found = adapt.mark(V, eta)
            return found

        history = adapt.solve(
            V,
            on_the_l_domain,
            lambda uh: estimate.residual(uh, div(grad(uh))),
            marking=marking,
            stop=adapt.Stop(steps=14),
            progress=False,
        )
        space = history.solution.function_space
        assert space.num_levels >= 9
        assert history["imbalance"][-1] == partition(space.hierarchy).imbalance < 1.1
        assert history.steps == comm.bcast(history.steps)  # seconds, too
        assert ("imbalance" in str(history)) == (comm.size > 1)
        return marks | of_all(history)

    same_as_in_serial(run)


def test_time_is_up_on_all_ranks_at_once(comm: MPI.Comm) -> None:
    """Whatever the clock of each says."""
    V = fem.functionspace(generators.rectangle((3, 3), comm=comm), ("THCCS", 3))
    history = adapt.solve(
        V,
        on_the_l_domain,
        lambda uh: estimate.residual(uh, div(grad(uh))),
        stop=adapt.Stop(seconds=0.3),
        progress=False,
    )
    assert history.reason == comm.bcast(history.reason)
    assert "of 0.3 seconds" in history.reason
    assert history["seconds"][:-1].sum() < 0.3 <= history["seconds"].sum()


def test_iterative_solvers_start_from_the_last_solution() -> None:
    """Each rank's part of it: as many iterations fewer as in serial, nearly."""

    def run(comm: MPI.Comm, guess: bool = True) -> tuple[dict[str, Any], list[int]]:
        V = fem.functionspace(generators.torus((12, 8), comm=comm), ("THCCS", 3))
        x = ufl.SpatialCoordinate(V.mesh)
        f = ufl.exp(-8.0 * ((x[0] - 3.0) ** 2 + x[1] ** 2 + x[2] ** 2))
        problems: list[LinearProblem] = []

        def problem(V: fem.FunctionSpace) -> LinearProblem:
            u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
            options = {"ksp_type": "cg", "pc_type": "jacobi", "ksp_rtol": 1e-12}
            a = inner(grad(u), grad(v)) * dx + u * v * dx
            problems.append(LinearProblem(a, f * v * dx, petsc_options=options, petsc_options_prefix="cg_"))
            if not guess:
                problems[-1].start_from_u = lambda: False  # type: ignore[method-assign]  # as a direct solver says
            return problems[-1]

        history = adapt.solve(
            V,
            problem,
            lambda uh: estimate.residual(uh, f + div(grad(uh)) - uh),
            stop=adapt.Stop(steps=4),
            progress=False,
        )
        return of_all(history), [p.solver.getIterationNumber() for p in problems]

    results = same_as_in_serial(lambda comm: run(comm)[0], tol=1e-9)  # residuals to 1e-12, condition numbers of 1e3
    (_, warm), (cold, many) = run(MPI.COMM_WORLD), run(MPI.COMM_WORLD, guess=False)
    assert results["dofs"].tolist() == cold["dofs"].tolist()
    assert warm[0] == many[0]
    assert warm[-1] < 0.9 * many[-1]


def test_newton_starts_from_the_last_solution() -> None:
    """With a callback that adds a column, the same on all ranks."""

    def run(comm: MPI.Comm) -> dict[str, Any]:
        V = fem.functionspace(generators.rectangle((4, 3), comm=comm), ("THCCS", 3))
        x = ufl.SpatialCoordinate(V.mesh)
        f = 60.0 * ufl.sin(3.0 * x[0]) * ufl.exp(x[1])
        problems: list[NonlinearProblem] = []

        def problem(V: fem.FunctionSpace) -> NonlinearProblem:
            u, v = fem.Function(V), ufl.TestFunction(V)
            F = inner(grad(u), grad(v)) * dx + (u**3 - f) * v * dx
            bcs = [fem.dirichletbc(0.0, fem.boundary_dofs(V), V)]
            problems.append(NonlinearProblem(F, u, bcs=bcs, petsc_options=MUMPS, petsc_options_prefix="newton_"))
            return problems[-1]

        def callback(step: adapt.Step, u: fem.Function) -> dict[str, float]:
            return {"iterations": len(problems[-1].norms) - 1.0, "rank": comm.rank}

        history = adapt.solve(
            V,
            problem,
            lambda uh: estimate.residual(uh, f + div(grad(uh)) - uh**3),
            stop=adapt.Stop(steps=5),
            callback=callback,
            progress=False,
        )
        assert history["iterations"][-1] <= history["iterations"][0] - 2
        assert not history["rank"].any()  # the numbers of rank 0
        return of_all(history)

    same_as_in_serial(run, tol=1e-8)  # Newton's method ends at 1e-10 of residuals


@pytest.mark.parametrize("goes_on_on", ["all ranks", "each rank alone"])
def test_several_unknowns_go_on_from_a_checkpoint(comm: MPI.Comm, folder: Path, goes_on_on: str) -> None:
    def run(comm: MPI.Comm, path: Path | None, steps: int) -> adapt.History:
        V = fem.functionspace(generators.rectangle((3, 4), comm=comm), ("THCCS", 3))
        f = ufl.exp(ufl.SpatialCoordinate(V.mesh)[0])

        def problem(V: fem.FunctionSpace) -> LinearProblem:
            W = fem.FunctionSpace(V.hierarchy, (2,))
            (u, v), (w, z) = ((ufl.TrialFunction(X), ufl.TestFunction(X)) for X in (V, W))
            a = [
                [inner(grad(u), grad(v)) * dx + u * v * dx, None],
                [-inner(ufl.as_vector([u, -u]), z) * dx, inner(w, z) * dx],
            ]
            return LinearProblem(a, [f * v * dx, None], petsc_options=MUMPS, petsc_options_prefix="two_")

        def estimator(u: list[fem.Function]) -> tuple[Floats, float]:
            eta = estimate.residual(u[0], f + div(grad(u[0])) - u[0])
            return eta, -estimate.norm(u[0].function_space, eta)

        return adapt.solve(
            V,
            problem,
            estimator,
            stop=adapt.Stop(steps=steps),
            callback=lambda step, u: {"twice": 2.0 * step.dofs},
            checkpoint=path,
            progress=False,
        )

    whole = of_all(run(MPI.COMM_SELF, None, 4))
    path = folder / "run.h5"
    run(comm, path, 2)
    if goes_on_on == "all ranks":
        found = run(comm, path, 4)
    else:
        own = folder / f"{comm.rank}.h5"
        own.write_bytes(path.read_bytes())
        found = run(MPI.COMM_SELF, own, 4)
    expected = {name: value for name, value in whole.items() if name != "reason"}
    assert (of_all(found) | {"reason": ""}).keys() == whole.keys()
    for name, value in expected.items():
        scale = np.abs(value).max(initial=0.0) if np.asarray(value).dtype.kind == "f" else 0.0
        np.testing.assert_allclose(of_all(found)[name], value, rtol=0, atol=1e-10 * scale, err_msg=name)


def test_progress_is_shown_by_the_first_rank(comm: MPI.Comm, capfd: pytest.CaptureFixture[str]) -> None:
    V = fem.functionspace(generators.torus((6, 6), comm=comm), ("THCCS", 3))
    adapt.solve(
        V,
        lambda V: fem.Function(V),
        lambda u: np.ones(u.function_space.cells.num_owned),
        stop=adapt.Stop(steps=1),
        progress=True,
    )
    err = capfd.readouterr().err
    assert ("adaptive run" in err) == (comm.rank == 0)


def test_what_fails_on_one_rank_fails_on_all(comm: MPI.Comm) -> None:
    V = fem.functionspace(generators.torus((6, 6), comm=comm), ("THCCS", 3))

    def estimator(u: fem.Function) -> Floats:
        return np.ones(u.function_space.cells.num_owned + (comm.rank == comm.size - 1))

    with pytest.raises(ValueError, match="the estimator returned indicators of shape"):
        adapt.solve(V, lambda V: fem.Function(V), estimator, stop=adapt.Stop(steps=1), progress=False)
    with pytest.raises(TypeError, match="the callback returned a float: return None, or numbers by name"):
        adapt.solve(
            V,
            lambda V: fem.Function(V),
            lambda u: np.ones(u.function_space.cells.num_owned),
            stop=adapt.Stop(steps=1),
            callback=lambda step, u: 0.5,  # type: ignore[arg-type,return-value]  # what is refused
            progress=False,
        )


def test_estimates_are_those_of_the_whole(comm: MPI.Comm) -> None:
    """Or ranks would end at different steps, and those that go on would wait for ever."""
    V = fem.functionspace(generators.torus((6, 6), comm=comm), ("THCCS", 3))

    def part(u: fem.Function) -> tuple[Floats, float]:
        eta = np.ones(u.function_space.cells.num_owned)
        return eta, float(comm.rank + 1)

    def run(estimator: Any, stop: Any) -> adapt.History:
        return adapt.solve(V, lambda V: fem.Function(V), estimator, stop=stop, progress=False)

    with pytest.raises(
        ValueError, match=rf"returned the estimate 1.0 on one rank, {comm.size}.0 on another: each must"
    ):
        run(part, adapt.Stop(tolerance=1.0))

    for other in (lambda u: part(u)[0], lambda u: (part(u)[0], np.nan)):
        with pytest.raises(
            ValueError, match="the estimator returned the estimate nan: it must be finite, on all ranks"
        ):
            run(lambda u, other=other: part(u) if comm.rank else other(u), adapt.Stop(steps=1))

    history = run(lambda u: (part(u)[0], 1.0 + 1e-12 * comm.rank), adapt.Stop(tolerance=1.0))  # rounding
    assert (len(history.steps), history["estimate"][0]) == (1, 1.0)


def test_the_first_rank_knows_when_to_end(comm: MPI.Comm) -> None:
    """Rules of users may look at a clock, or at a number of the rank."""
    V = fem.functionspace(generators.torus((6, 6), comm=comm), ("THCCS", 3))
    history = adapt.solve(
        V,
        lambda V: fem.Function(V),
        lambda u: np.ones(u.function_space.cells.num_owned),
        stop=lambda history: f"rank {comm.rank}" if len(history.steps) > 1 + comm.rank else None,
        progress=False,
    )
    assert (len(history.steps), history.reason) == (2, "rank 0")


def test_curves_are_written_by_the_first_rank(comm: MPI.Comm, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    V = fem.functionspace(generators.torus((6, 6), comm=comm), ("THCCS", 3))
    history = adapt.solve(
        V,
        lambda V: fem.Function(V),
        lambda u: np.ones(u.function_space.cells.num_owned),
        stop=adapt.Stop(steps=1),
        progress=False,
    )
    written = []
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", lambda *arguments, **_: written.append(arguments[1]))
    figure = plot.convergence({"one": history, "other": {"dofs": [1, 2], "estimate": [2, 1]}}, folder / "a.png")
    assert len(written) == (comm.rank == 0)
    assert len(figure.axes[0].lines) > 1
