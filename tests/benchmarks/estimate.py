"""Microseconds a piece for the estimators, beside those for assembling the matrix and the load of the same problem.

On the torus of n x n cells a cell is one piece; on the sphere of triangles, adaptively refined, it has several, each
with an extraction operator (see assembly.py).

    OMP_NUM_THREADS=1 python tests/benchmarks/estimate.py [n]

CPU time of one thread, the least of several runs, forms compiled before. "Assembly" writes new values into the same
matrix, and makes the load.
"""

import numpy as np
from assembly import N, least, refined_towards_a_circle, rough_sphere

import ufl
from thccs_fem import estimate, fem, generators


def times(V: fem.FunctionSpace) -> dict[str, float]:
    """Return microseconds a piece for -div(grad(u)) + u = x0 x1 in each component."""
    u, v, x = ufl.TrialFunction(V), ufl.TestFunction(V), ufl.SpatialCoordinate(V.mesh)
    load = ufl.as_vector([x[0] * x[1]] * V.block_size) if V.value_shape else x[0] * x[1]
    a = fem.form((ufl.inner(ufl.grad(u), ufl.grad(v)) + ufl.inner(u, v)) * ufl.dx)
    L = fem.form(ufl.inner(load, v) * ufl.dx)
    uh = fem.Function(V)
    uh.x.array = np.random.default_rng(0).standard_normal(V.num_dofs)
    A = fem.assemble_matrix(a)
    actions = {
        "matrix": lambda: fem.assemble_matrix(A, a),
        "load": lambda: fem.assemble_vector(L),
        "bubble": lambda: estimate.bubble(uh, a, L),
        "residual": lambda: estimate.residual(uh, load + ufl.div(ufl.grad(uh)) - uh),
    }
    return {name: least(action, lambda: None, V.cells.num_pieces) for name, action in actions.items()}


def main() -> None:
    mesh = generators.torus((N, N))
    spaces = {
        "torus": fem.functionspace(mesh, ("THCCS", 3)),
        "rough sphere": refined_towards_a_circle(fem.functionspace(rough_sphere(), ("THCCS", 3))),
        "torus, 3 components": fem.functionspace(mesh, ("THCCS", 3, (3,))),
    }
    print("| surface | cells | pieces | matrix | load | bubble | residual | bubble / assembly |")
    print("|---|---|---|---|---|---|---|---|")
    for name, V in spaces.items():
        found = times(V)
        ratio = found["bubble"] / (found["matrix"] + found["load"])
        figures = " | ".join(f"{figure:.2f}" for figure in (*found.values(), ratio))
        print(f"| {name} | {V.num_cells} | {V.cells.num_pieces} | {figures} |")


if __name__ == "__main__":
    main()
