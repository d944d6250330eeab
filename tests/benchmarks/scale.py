"""Seconds of CPU and peak memory from a control mesh to the file with the solution, for growing numbers of dofs.

-div(grad(u)) + u = x0 x1 on the sphere of six n x n faces, with eight extraordinary vertices of valence 3. Conjugate
gradients with multigrid to 1e-10.

    OMP_NUM_THREADS=1 python tests/benchmarks/scale.py [n ...]

One run of each size, the smallest first, in one process: peak memory is that of all until then. Kernels are
compiled before; "solve" has an assembly of its own in it. On two slow cores:

| dofs | mesh | space | assembly | solve | file | together | iterations | peak GB |
|---|---|---|---|---|---|---|---|---|
| 9602 | 0.03 | 0.03 | 0.03 | 0.11 | 0.09 | 0.28 | 6 | 0.28 |
| 98306 | 0.27 | 0.15 | 0.48 | 1.26 | 1.17 | 3.31 | 5 | 0.75 |
| 1038338 | 3.65 | 1.29 | 5.25 | 14.64 | 14.02 | 38.85 | 5 | 5.60 |
"""

import resource
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import ufl
from thccs_fem import fem, generators, io
from thccs_fem.fem.petsc import LinearProblem

SIZES = (40, 128, 416)
STAGES = ("mesh", "space", "assembly", "solve", "file")


def measured(n: int) -> tuple[int, dict[str, float], int]:
    """Return the number of dofs, CPU seconds of each stage and iterations."""
    seconds: dict[str, float] = {}

    @contextmanager
    def stage(name: str) -> Iterator[None]:
        start = time.process_time()
        yield
        seconds[name] = time.process_time() - start

    with stage("mesh"):
        msh = generators.cube_sphere(n)
    with stage("space"):
        V = fem.functionspace(msh, ("THCCS", 3))
    u, v, x = ufl.TrialFunction(V), ufl.TestFunction(V), ufl.SpatialCoordinate(msh)
    a = fem.form((ufl.inner(ufl.grad(u), ufl.grad(v)) + u * v) * ufl.dx)
    L = fem.form(x[0] * x[1] * v * ufl.dx)
    with stage("assembly"):
        fem.assemble_matrix(a)
        fem.assemble_vector(L)
    options = {"ksp_type": "cg", "pc_type": "mg"}
    problem = LinearProblem(a, L, petsc_options_prefix="scale_", petsc_options=options)
    with stage("solve"):
        uh = problem.solve()
    with stage("file"), tempfile.TemporaryDirectory() as folder:
        io.write_vtu(Path(folder, "u.vtu"), uh)
    return V.num_dofs, seconds, problem.solver.getIterationNumber()


def main() -> None:
    print(f"| dofs | {' | '.join(STAGES)} | together | iterations | peak GB |")
    print("|---" * (len(STAGES) + 4) + "|")
    measured(8)  # compiles
    for n in [int(given) for given in sys.argv[1:]] or SIZES:
        dofs, seconds, iterations = measured(n)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
        figures = [f"{seconds[name]:.2f}" for name in STAGES] + [f"{sum(seconds.values()):.2f}"]
        print(f"| {dofs} | {' | '.join(figures)} | {iterations} | {peak:.2f} |")


if __name__ == "__main__":
    main()
