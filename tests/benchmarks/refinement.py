"""What supports, rings and classes of admissibility take for equal errors, and what the spaces are like that come out.

    OMP_NUM_THREADS=1 python tests/benchmarks/refinement.py [problem ...]
    OMP_NUM_THREADS=1 python tests/benchmarks/refinement.py cells.png

Adaptive runs with Doerfler's marks. "dofs" are those at which the error reaches each of the tolerances, interpolated
between steps (logarithms of both), "steps" and "CPU s" those of the run to the last one. Of the last space: the most
functions on a cell, entries a row of the stiffness matrix (mean, most), its condition with the diagonal scaled to 1
(conditions left out), iterations of conjugate gradients to 1e-10 with multigrid, and the most levels that meet on a
cell. Tables are in docs/adaptivity.md. Given the name of a picture it draws the cells of four runs instead.
"""

import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).parents[1]))

import mpi4py.MPI  # noqa: F401  # loads the library that petsc4py needs

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from problems import singular
from refinements import levels_on_cells, most_functions
from scipy.sparse.linalg import eigsh

import ufl
from thccs_fem import adapt, estimate, fem, generators
from thccs_fem.fem.petsc import LinearProblem, multigrid
from thccs_fem.fem.space import FunctionSpace
from thccs_fem.mesh import ControlMesh
from thccs_fem.regions import Unit
from ufl import div, dx, grad, inner

DIRECT = {"ksp_type": "preonly", "pc_type": "lu", "pc_factor_mat_solver_type": "mumps"}
RULES: list[tuple[Unit, int | None, tuple[float, ...]]] = [  # unit, class, values of theta
    ("support", None, (0.3, 0.5, 0.7)),
    ("support", 3, (0.3, 0.5, 0.7)),
    ("support", 2, (0.5,)),
    ("ring", None, (0.3, 0.5, 0.7)),
    ("ring", 3, (0.5,)),
    ("ring", 2, (0.5,)),
]
MOST_STEPS, MOST_DOFS = 80, 12_000

Expr = ufl.core.expr.Expr
Floats = npt.NDArray[np.float64]


# ---- Problems --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Problem:
    """-div(grad(u)) = f, or with + u on surfaces, Dirichlet data on boundaries.

    Attributes:
        mesh: The control mesh.
        exact: The solution.
        norm: The error that is to be small.
        tolerances: Descending.
        residual: Let the residual drive, not the exact error in this norm.
        harmonic: f is zero.
        options: Of the space.
    """

    mesh: ControlMesh
    exact: Callable[[Expr], Expr]
    norm: str
    tolerances: tuple[float, ...]
    residual: bool = False
    harmonic: bool = False
    options: dict[str, Any] = field(default_factory=dict)

    def forms(self, V: FunctionSpace) -> tuple[ufl.Form, ufl.Form]:
        u, v, exact = ufl.TrialFunction(V), ufl.TestFunction(V), self.exact(ufl.SpatialCoordinate(V.mesh))
        a, L = inner(grad(u), grad(v)), fem.Constant(V.mesh, 0.0) * v
        if V.mesh.gdim == 3:  # the load is a(exact, v), which needs no curvature
            return (a + u * v) * dx, (inner(grad(exact), grad(v)) + exact * v) * dx
        return a * dx, (L if self.harmonic else -div(grad(exact)) * v) * dx

    def equations(self, V: FunctionSpace, options: dict[str, Any]) -> LinearProblem:
        exact, bcs = self.exact(ufl.SpatialCoordinate(V.mesh)), []
        if V.mesh.boundary_edges.size:
            bcs = [fem.dirichletbc(exact, fem.boundary_dofs(V), V)]
        return LinearProblem(*self.forms(V), bcs=bcs, petsc_options_prefix="r_", petsc_options=options)

    def drive(self, uh: fem.Function, error: Floats) -> Floats:
        if not self.residual:
            return error
        exact = self.exact(ufl.SpatialCoordinate(uh.function_space.mesh))
        return estimate.residual(uh, div(grad(uh)) - (0.0 if self.harmonic else div(grad(exact))))


def layer(x: Expr) -> Expr:
    return ufl.atan(40 * (ufl.sqrt((x[0] + 0.05) ** 2 + (x[1] + 0.05) ** 2) - 0.7))


def bump(x: Expr) -> Expr:
    return ufl.exp(-30 * ((x[0] - 0.6) ** 2 + (x[1] - 0.5) ** 2 + (x[2] - 0.62) ** 2))


def wave(x: Expr) -> Expr:
    return ufl.sin(3 * x[0] + 1) * ufl.cos(2.5 * x[1])


L_DOMAIN = generators.l_domain(4)
GRADED = {"cap_level": 16}  # quadrature that gets finer towards the corner
PROBLEMS = {
    "L-domain, L2": Problem(L_DOMAIN, singular, "L2", (2.5e-6, 1e-6, 6.7e-8), harmonic=True, options=GRADED),
    "L-domain, residual": Problem(L_DOMAIN, singular, "H1", (2e-2, 2e-3, 2e-4), True, True, GRADED),
    "layer": Problem(generators.rectangle((8, 8)), layer, "H1", (1e-1, 2e-2)),
    "wheel of 8": Problem(generators.wheel(8, 4), wave, "H1", (1e-3, 1e-4)),
    "bump on a sphere": Problem(generators.cube_sphere(4), bump, "H1", (1e-2, 1e-3)),
}


# ---- Runs ------------------------------------------------------------------------------------------------------------


def steps(
    problem: Problem, unit: Unit, admissibility: int | None, theta: float, tolerance: float
) -> tuple[list[tuple[float, float]], FunctionSpace]:
    """Return dofs and errors of the steps of a run, and its last space."""
    V = fem.functionspace(problem.mesh, ("THCCS", 3), unit=unit, admissibility=admissibility, **problem.options)
    rows: list[tuple[float, float]] = []
    while True:
        uh = problem.equations(V, DIRECT).solve()
        error = estimate.error(uh, problem.exact, problem.norm)  # type: ignore[arg-type]  # "L2" or "H1"
        rows.append((V.num_dofs, estimate.norm(V, error)))
        if rows[-1][1] <= tolerance or len(rows) == MOST_STEPS or V.num_dofs > MOST_DOFS:
            return rows, V
        V = adapt.refine(V, adapt.mark(V, problem.drive(uh, error), theta=theta))


def run(problem: Problem, unit: Unit, admissibility: int | None, theta: float) -> str:
    start = time.process_time()
    rows, V = steps(problem, unit, admissibility, theta, problem.tolerances[-1])
    seconds = time.process_time() - start
    dofs = " | ".join(dofs_at(np.array(rows), tolerance) for tolerance in problem.tolerances)
    return f"{unit} | {admissibility or 'free'} | {theta} | {dofs} | {len(rows)} | {seconds:.1f} | {shape(problem, V)}"


def dofs_at(rows: Floats, tolerance: float) -> str:
    after = int(np.argmax(rows[:, 1] <= tolerance))
    if rows[after, 1] > tolerance or not after:
        return "-"
    dofs, errors = np.log(rows[after - 1 : after + 1]).T
    return f"{np.exp(np.interp(-np.log(tolerance), -errors, dofs)):.0f}"


def shape(problem: Problem, V: FunctionSpace) -> str:
    A = fem.assemble_matrix(fem.form(problem.forms(V)[0]))
    entries = np.diff(A.indptr)
    free = np.setdiff1d(np.arange(V.num_dofs), fem.boundary_dofs(V))
    inner_part = sp.csc_array(A[free][:, free])
    scaled = sp.diags_array(inner_part.diagonal() ** -0.5)
    K = sp.csc_matrix(scaled @ inner_part @ scaled)
    largest, smallest = (eigsh(K, 1, sigma=sigma, which="LM", v0=np.ones(free.size))[0][0] for sigma in (None, 0.0))
    return (
        f"{most_functions(V.cells)} | {entries.mean():.0f}, {entries.max()} | {largest / smallest:.1e} | "
        f"{iterations(problem, V)} | {levels_on_cells(V.cells).max()}"
    )


def iterations(problem: Problem, V: FunctionSpace) -> int:
    made = problem.equations(V, {"ksp_type": "cg", "ksp_rtol": 1e-10, "ksp_norm_type": "natural"})
    multigrid(made.solver, V)
    made.solve()
    return int(made.solver.getIterationNumber())


# ---- A picture -------------------------------------------------------------------------------------------------------


def picture(path: str) -> None:
    """Draw the cells that an L2 error of 1e-6 takes on the L-domain, with both units, free and of class 2."""
    from matplotlib.collections import PolyCollection
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 2.9), layout="constrained")
    for axes, (unit, admissibility) in zip(
        figure.subplots(1, 4), [("support", None), ("support", 2), ("ring", None), ("ring", 2)], strict=True
    ):
        _, V = steps(PROBLEMS["L-domain, L2"], unit, admissibility, 0.5, 1e-6)  # type: ignore[arg-type]  # they are units
        levels = [(V.hierarchy.points[l], V.hierarchy.stages[l]) for l in range(V.num_levels)]
        corners = np.concatenate([points[stage.level.quads[stage.active_faces]] for points, stage in levels])
        axes.add_collection(PolyCollection(corners, facecolors="white", edgecolors="black", linewidths=0.35))
        axes.set_title(
            f"{unit}, {'free' if admissibility is None else 'class 2'}\n{V.num_dofs} dofs", fontsize=9, pad=4
        )
        axes.autoscale_view()
        axes.set_aspect("equal")
        axes.axis("off")
    figure.savefig(path, dpi=130)


def main() -> None:
    if len(sys.argv) > 1 and sys.argv[1].endswith(".png"):
        picture(sys.argv[1])
        return
    for name in sys.argv[1:] or PROBLEMS:
        problem = PROBLEMS[name]
        tolerances = " | ".join(f"dofs, {problem.norm} {tolerance:g}" for tolerance in problem.tolerances)
        head = f"| unit | class | theta | {tolerances} | steps | CPU s | functions | entries a row | condition "
        head += "| iterations | levels |"
        print(f"\n{name}\n\n{head}\n{'|---' * (head.count('|') - 1)}|")
        for unit, admissibility, thetas in RULES:
            for theta in thetas:
                print(f"| {run(problem, unit, admissibility, theta)} |", flush=True)


if __name__ == "__main__":
    main()
