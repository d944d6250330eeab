"""Effectivities of the estimators on one problem of each kind, and what they cost.

    OMP_NUM_THREADS=1 python tests/benchmarks/effectivity.py [part of a name]

The effectivity is the estimate over the energy norm of the error: smallest and largest on levels of uniform refinement
and in a run that the estimator drives, until the number of dofs that is given, with the rate of the error in dofs over
its second half. The cost is CPU time over that of one assembly and solution, by SciPy, on the finest uniform level,
forms compiled before. The problems are those of tests/estimated.py; the table is in docs/adaptivity.md.
"""

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
from estimated import PROBLEMS, Problem, adaptive, uniform
from problems import uniformly_refined


def seconds(action: Callable[[], object]) -> float:
    """Return the CPU time of one call, the least of three."""
    times = []
    for _ in range(3):
        begin = time.process_time()
        action()
        times.append(time.process_time() - begin)
    return min(times)


def row(problem: Problem, estimator: str) -> str:
    """Return the part of a row of the table that is numbers."""
    even, (dofs, errors, driven) = uniform(problem, estimator), adaptive(problem, estimator)
    late = dofs > dofs[-1] / 4
    rate = -np.polyfit(np.log(dofs[late]), np.log(errors[late]), 1)[0]
    V = uniformly_refined(problem.make(), problem.levels)
    uh = problem.solve(V)
    cost = seconds(lambda: problem.estimators[estimator](uh)) / seconds(lambda: problem.solve(V))
    return (
        f"{even.min():.2f} .. {even.max():.2f} | {driven.min():.2f} .. {driven.max():.2f} | {rate:.1f} | "
        f"{100 * cost:.0f} %"
    )


def main() -> None:
    wanted = sys.argv[1] if len(sys.argv) > 1 else ""
    print("| problem | estimator | uniform | adaptive | rate | cost |")
    print("|---|---|---|---|---|---|")
    for name, make in PROBLEMS.items():
        if wanted in name:
            problem = make()
            for estimator in problem.estimators:
                print(f"| {name} | {estimator} | {row(problem, estimator)} |", flush=True)


if __name__ == "__main__":
    main()
