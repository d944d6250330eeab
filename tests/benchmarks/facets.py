"""Microseconds a facet for integrals over the edges between cells, on a torus of n x n cells and a rough sphere.

    OMP_NUM_THREADS=1 python tests/benchmarks/facets.py [n]

CPU time of one thread, the least of several runs, forms compiled before. "Operators" is what each assembly spends on
the 32 x width operators, which are made anew, some thousands at a time: the last column is the memory all would need.
"""

import time
from collections.abc import Callable

import assembly
import numpy as np

import ufl
from thccs_fem import fem, generators
from thccs_fem.facets import _interior_facets, interior_facets
from ufl import avg, dS, grad, jump

REPEATS = 3


def least(action: Callable[[], object], num_facets: int) -> float:
    """Return the least CPU time of an action, in microseconds a facet."""
    times = []
    for _ in range(REPEATS):
        start = time.process_time()
        action()
        times.append(time.process_time() - start)
    return min(times) / num_facets * 1e6


def row(name: str, V: fem.FunctionSpace) -> str:
    facets = interior_facets(V.cells)
    n, every = facets.num_facets, np.arange(facets.num_facets, dtype=np.int32)
    u, v, normal = ufl.TrialFunction(V), ufl.TestFunction(V), ufl.FacetNormal(V.mesh)
    penalty = fem.form(avg(fem.cell_sizes(V)) * jump(grad(u), normal) * jump(grad(v), normal) * dS)
    kinks = fem.form(jump(grad(fem.Function(V)), normal) ** 2 * dS)
    A = fem.assemble_matrix(penalty)
    sizes = [0]

    def operators() -> None:
        sizes[0] = sum(part.batch.operators.nbytes for part in facets.batches(every))

    actions = (
        lambda: _interior_facets(V.cells),
        operators,
        lambda: fem.assemble_matrix(A, penalty),
        lambda: fem.assemble_cells(kinks),
    )
    times = " | ".join(f"{least(action, n):.1f}" for action in actions)
    return f"| {name} | {n} | {times} | {sizes[0] / 1e6:.0f} MB |"


def main() -> None:
    print("| mesh | facets | find | operators | matrix | indicator | all operators |\n|---|---|---|---|---|---|---|")
    size = assembly.N
    print(row(f"torus {size}", fem.functionspace(generators.torus((size, size)), ("THCCS", 3))))
    sphere = fem.functionspace(assembly.rough_sphere(), ("THCCS", 3))
    print(row("rough sphere", assembly.refined_towards_a_circle(sphere)))


if __name__ == "__main__":
    main()
