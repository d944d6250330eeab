"""Effectivity of `estimate.goal` on the problems of tests/goals.py: the value by the error of the goal, which is known.

    OMP_NUM_THREADS=1 python tests/benchmarks/goal_values.py [steps]

On uniform meshes, with the sum of the absolute values of all shares, by the error as well; then in an adaptive run on
the L-domain, with the CPU time of solving the problem and of the estimate, both for the second time.
"""

import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from goals import KNOWN, LINEAR, Problem, l_shaped, value_of
from problems import uniformly_refined

from thccs_fem import adapt, estimate, fem

STEPS = int(sys.argv[1]) if len(sys.argv) > 1 else 4


def exact_value(problem: Problem, V: fem.FunctionSpace) -> float:
    """Return J of the exact solution, integrated on cells that are finer than those of V."""
    V = uniformly_refined(V)
    return fem.assemble_scalar(fem.form(problem.J(problem.exact), quadrature_degree=24, on=V))


def of_space(problem: Problem, V: fem.FunctionSpace, *, is_linear: bool) -> tuple[float, float, float]:
    """Return the error of the goal, the estimate, and the sum of the absolute values of shares."""
    uh = (problem.solve if is_linear else problem.solve_by_newton)(V)
    F, J = problem.forms(uh)
    eta, value = estimate.goal(uh, F, J, fixed=problem.bcs)
    return exact_value(problem, V) - value_of(J), value, float(np.sum(eta**2))


def seconds(work: Callable[[], object]) -> float:
    work()
    start = time.process_time()
    work()
    return time.process_time() - start


def main() -> None:
    print("| goal | dofs | errors | value / error | shares / error |")
    print("|---|---|---|---|---|")
    for name, make in KNOWN.items():
        problem = make()
        V, rows = problem.V, []
        for _ in range(STEPS):
            rows.append(of_space(problem, V, is_linear=name in LINEAR))
            dofs, V = V.num_dofs, uniformly_refined(V)
        error, value, shares = np.transpose(rows)
        columns = [f"{e:.0e}" for e in error], [f"{e:.3f}" for e in value / error]
        columns = *columns, [f"{e:.1f}" for e in shares / np.abs(error)]
        print(f"| {name} | {problem.V.num_dofs} to {dofs} | {' | '.join(', '.join(column) for column in columns)} |")

    problem = l_shaped()
    print("\n| dofs | error | value / error | shares / error | seconds: solve | estimate |")
    print("|---|---|---|---|---|---|")
    V = problem.V
    while V.num_dofs < 2500:
        uh = problem.solve(V)
        F, J = problem.forms(uh)
        eta, _ = estimate.goal(uh, F, J, fixed=problem.bcs)
        if V.num_levels % 4 == 1 or V.num_dofs > 2200:
            error, value, shares = of_space(problem, V, is_linear=True)
            times = [seconds(lambda V=V: problem.solve(V))]
            times.append(seconds(lambda uh=uh, F=F, J=J: estimate.goal(uh, F, J, fixed=problem.bcs)))
            timing = " | ".join(f"{t:.3f}" for t in times)
            print(f"| {V.num_dofs} | {error:.1e} | {value / error:.2f} | {shares / abs(error):.2f} | {timing} |")
        V = adapt.refine(V, adapt.mark(V, eta))


if __name__ == "__main__":
    main()
