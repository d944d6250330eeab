"""Iterations that an adaptive run saves where each solution is the initial guess of the next one.

    OMP_NUM_THREADS=1 python tests/benchmarks/initial_guess.py [dofs]

Each run is done twice, from zero in each step and from the last solution. Iterations are those of the first and the
last step and of all together, of conjugate gradients to a residual of 1e-10 of the right-hand side, or of Newton's
method to its own end; seconds of CPU are those of the whole loop, forms compiled before.
"""

import sys
import time
from collections.abc import Callable
from typing import Any

from mpi4py import MPI  # noqa: F401  # petsc4py wants it loaded

import numpy as np

import ufl
from thccs_fem import adapt, estimate, fem, generators
from thccs_fem.fem.petsc import LinearProblem, NonlinearProblem
from thccs_fem.forms import minimal_surface, poisson
from ufl import div, dx, grad, inner

DOFS = int(sys.argv[1]) if len(sys.argv) > 1 else 4000
LAYER = 0.1  # width of the layer between -1 and 1

l_domain = generators.l_domain(2)
square = generators.rectangle((4, 4), (-1.0, -1.0), (1.0, 1.0))
one = fem.Constant(l_domain, 1.0)


def membrane(options: dict[str, Any]) -> Callable[[fem.FunctionSpace], LinearProblem]:
    def problem(V: fem.FunctionSpace) -> LinearProblem:
        u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
        rim = fem.dirichletbc(0.0, fem.boundary_dofs(V), V)
        forms = poisson.a(u, v), poisson.L(one, v)
        return LinearProblem(*forms, bcs=[rim], petsc_options=options, petsc_options_prefix="membrane_")

    return problem


def scherk(x: Any) -> Any:
    """Return Scherk's minimal surface."""
    return ufl.ln(ufl.cos(1.4 * x[0]) / ufl.cos(1.4 * x[1])) / 1.4


def film(V: fem.FunctionSpace) -> NonlinearProblem:
    u, v = fem.Function(V), ufl.TestFunction(V)
    frame = fem.dirichletbc(scherk(ufl.SpatialCoordinate(square)), fem.boundary_dofs(V), V)
    return NonlinearProblem(minimal_surface.F(u, v), u, bcs=[frame], petsc_options_prefix="film_")


def layer(V: fem.FunctionSpace) -> NonlinearProblem:
    """Return Allen and Cahn's equation at rest, from a linear function where there is nothing better."""
    x, v = ufl.SpatialCoordinate(square), ufl.TestFunction(V)
    u = fem.project(2.0 * (x[0] - x[1]), V)
    profile = ufl.tanh((x[0] - x[1]) / (2.0 * LAYER))
    bcs = [fem.dirichletbc(profile, fem.boundary_dofs(V), V)]
    F = (LAYER**2 * inner(grad(u), grad(v)) + (u**3 - u) * v) * dx
    return NonlinearProblem(F, u, bcs=bcs, petsc_options_prefix="layer_")


def iterations(problem: Any) -> int:
    """Return how many the last solution took."""
    is_nonlinear = isinstance(problem, NonlinearProblem)
    return len(problem.norms) - 1 if is_nonlinear else problem.solver.getIterationNumber()


def run(make: Any, estimator: Any, guess: bool) -> tuple[adapt.History, float]:
    """Return the history, with iterations, and seconds of CPU."""
    V = fem.functionspace(l_domain if estimator is of_membrane else square, ("THCCS", 3))
    problems: list[Any] = []

    def problem(V: fem.FunctionSpace) -> Any:
        problems.append(make(V))
        if not guess:
            problems[-1].start_from_u = lambda: False
        return problems[-1]

    def count(step: adapt.Step, u: fem.Function) -> dict[str, float]:
        return {"iterations": iterations(problems[-1])}

    start = time.process_time()
    history = adapt.solve(V, problem, estimator, stop=adapt.Stop(dofs=DOFS), callback=count, progress=False)
    return history, time.process_time() - start


def of_membrane(u: fem.Function) -> np.ndarray:
    return estimate.residual(u, poisson.strong_residual(u, one))


def of_film(u: fem.Function) -> np.ndarray:
    return estimate.residual(u, minimal_surface.strong_residual(u))


def of_layer(u: fem.Function) -> np.ndarray:
    return estimate.residual(u, LAYER**2 * div(grad(u)) - u**3 + u)


def main() -> None:
    cases: dict[str, tuple[Any, Any]] = {
        f"membrane over an L, {name}": (membrane({"ksp_type": "cg", "pc_type": name}), of_membrane)
        for name in ("mg", "gamg", "jacobi")
    }
    cases |= {"soap film, Newton": (film, of_film), "layer, Newton": (layer, of_layer)}
    print("| problem | steps | dofs | from zero: first, last, all | from the last solution | CPU s |")
    print("|---|---|---|---|---|---|")
    for name, case in cases.items():
        run(*case, guess=True)  # compiles
        (cold, before), (warm, after) = (run(*case, guess=guess) for guess in (False, True))
        counts = (
            "{:.0f}, {:.0f}, {:.0f}".format(*h["iterations"][[0, -1]], h["iterations"].sum()) for h in (cold, warm)
        )
        size = f"{len(warm.steps) - 1} | {warm.steps[-1].dofs}"
        print(f"| {name} | {size} | {' | '.join(counts)} | {before:.1f}, {after:.1f} |")


if __name__ == "__main__":
    main()
