"""Rates at extraordinary vertices: uniform, graded and adaptive refinement, and meshes fitted to sphere and torus.

    OMP_NUM_THREADS=1 python tests/benchmarks/rates.py

The problems are those of tests/extraordinary.py. Rates are in dofs, in L2 and H1: of uniform refinement over the last
two levels, of graded meshes over the last two, of adaptive runs (Doerfler's marking, half of the error) over the steps
with more than a tenth of the last dofs. Dofs are those at which the H1 error is that of the last uniform mesh, by
interpolation. The tables are in docs/adaptivity.md.
"""

import os
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
import numpy.typing as npt
from extraordinary import Fitted, Plane, Problem, closed, on_sphere, on_torus, plane, rates, row
from problems import errors, rates_at_extraordinary, uniformly_refined

from thccs_fem import adapt, estimate, fem, generators
from thccs_fem.mesh import ControlMesh

Floats = npt.NDArray[np.float64]
MAX_DOFS = 6000


def uniform(problem: Problem, levels: int) -> Floats:
    V, rows = problem.V, []
    for level in range(levels):
        V = uniformly_refined(V) if level else V
        rows.append(row(problem, V))
    return np.array(rows)


def graded(problem: Problem, levels: int) -> Floats:
    return np.array([row(problem, adapt.grade_extraordinary(problem.V, level)) for level in range(levels)])


def adaptive(problem: Problem, estimator: Callable[[fem.Function], Floats], dofs: int = MAX_DOFS) -> Floats:
    rows: list[tuple[float, ...]] = []
    adapt.solve(
        problem.V,
        problem.solve,
        estimator,
        stop=adapt.Stop(dofs=dofs),
        callback=lambda step, uh: rows.append((step.dofs, *errors(uh, problem.exact))),
        progress=False,
    )
    return np.array(rows)


def late_rates(rows: Floats) -> Floats:
    return rates(rows[rows[:, 0] > rows[-1, 0] / 10])


def estimators(problem: Problem) -> list[Callable[[fem.Function], Floats]]:
    return [problem.residual, problem.bubble, lambda uh: estimate.error(uh, problem.exact, "H1")]


def dofs_at(rows: Floats, error: float) -> str:
    """Return the dofs at which the H1 error is the given one."""
    dofs, found = np.log(rows[:, 0]), np.log(rows[:, 2])
    return f"{np.exp(np.interp(-np.log(error), -found, dofs)):.0f}"


def shown(pair: Floats | tuple[float, float]) -> str:
    return "{:.2f} / {:.2f}".format(*pair)


def valences() -> None:
    print(
        "\n| | valence | theory | uniform | graded | residual | bubble | exact H1 error | error | dofs, in this order |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    for make, name in ((plane, "wheel"), (closed, "closed")):
        for valence in (3, 5, 6, 8, 12):
            problem = make(valence)
            even = uniform(problem, 6 if (name, valence) == ("closed", 5) else 5)
            fine = graded(problem, 5 if isinstance(problem, Plane) else 4)
            runs = [adaptive(problem, estimator) for estimator in estimators(problem)]
            theory = np.array(rates_at_extraordinary(valence)) / 2
            figures = [theory, rates(even[-2:]), rates(fine[-2:]), *map(late_rates, runs)]
            dofs = [f"{even[-1, 0]:.0f}", *(dofs_at(rows, even[-1, 2]) for rows in (fine, *runs))]
            print(
                "|", " | ".join([name, str(valence), *map(shown, figures), f"{even[-1, 2]:.1e}", ", ".join(dofs)]), "|"
            )


def asymptotics() -> None:
    print("\n| levels | dofs | L2 error | H1 error | rates |\n|---|---|---|---|---|")
    rows = graded(plane(5), 6)[1:]
    for level, (before, now) in enumerate(pairwise(rows), start=2):
        dofs, l2, h1 = now
        print(f"| {level} | {dofs:.0f} | {l2:.1e} | {h1:.1e} | {shown(rates([before, now]))} |")


def ball(n: int) -> ControlMesh:
    """Return a ball of cubes on a lattice of n points: many extraordinary vertices."""
    return generators.implicit_surface(lambda x: 0.8 - (x**2).sum(axis=0), (n, n, n))


def fits() -> None:
    """Rates from one fit to the next, finer one; adaptive runs end with as many dofs as the graded meshes have."""
    cages = {
        "cube": (generators.cube_sphere(1), 4),
        **{f"valence {valence}": (generators.trapezohedron(valence, 1), 4) for valence in (5, 6, 8, 12)},
        "ball of cubes": (ball(6), 2),
        "finer ball of cubes": (ball(8), 2),
    }
    print(
        "\n| mesh | extraordinary | dofs | L2 error | H1 error | rates | graded: dofs | L2 error | H1 error |", end=""
    )
    print(" rates | adaptive: dofs | L2 error | H1 error | rates |")
    print("|---" * 14 + "|")
    tori = [row(problem := on_torus(n), problem.V) for n in (24, 48)]
    print("| torus | 0", *_columns(tori), *["|"] * 8, "|")
    for name, (cage, times) in cages.items():
        given = [(on_sphere(cage, k), k) for k in (times - 1, times)]
        plain = [row(problem, problem.V) for problem, _ in given]
        fine = [row(p, adapt.grade_extraordinary(p.V, 0, subdivided=k - 1)) for p, k in given]
        driven = [_driven(problem, dofs) for (problem, _), (dofs, *_) in zip(given, fine, strict=True)]
        extraordinary = len(cage.extraordinary_vertices)
        print(f"| {name} | {extraordinary}", *_columns(plain), *_columns(fine), *_columns(driven), "|")


def _driven(problem: Fitted, dofs: float) -> tuple[float, float, float]:
    return tuple(adaptive(problem, problem.bubble, int(dofs))[-1])


def _columns(rows: list[tuple[float, float, float]]) -> list[str]:
    dofs, l2, h1 = rows[-1]
    return [f"| {dofs:.0f} | {l2:.1e} | {h1:.1e} | {shown(rates(rows))}"]


if __name__ == "__main__":
    valences()
    asymptotics()
    fits()
