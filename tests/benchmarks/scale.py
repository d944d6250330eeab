"""Time and memory from a control mesh to the file with the solution, for growing numbers of dofs and on several ranks.

-div(grad(u)) + u = x0 x1 on the sphere of six n x n faces, with eight extraordinary vertices of valence 3. Beside it
DOLFINx with cubic Lagrange elements on quadrilaterals of degree 3, each in the place of 3 x 3 of our faces, whose
vertices are its nodes: so both have the same number of dofs, and DOLFINx a ninth of the cells. Both integrate with
4 x 4 Gauss points and solve by conjugate gradients to 1e-10: ours with multigrid on the levels of subdivision, DOLFINx
with the algebraic one of PETSc (GAMG).

    OMP_NUM_THREADS=1 python tests/benchmarks/scale.py [n ...] [--ranks 1 2] [--repeats 1]

n is a multiple of 3, for multigrid also of a power of 2. Each run is a process of its own, or one for each rank, so
that its peak of memory is its own; kernels are compiled before. Columns are seconds, of CPU on one rank, else those
that pass ("wall"); those of assembly and solution are the least of the repeats:

- set-up: control mesh, hierarchy, cells; DOLFINx's mesh, with the nodes given, and space
- assembly: a new matrix with its pattern, and the load; again: new values in the same matrix
- solve: preconditioner and iterations
- file: one .vtu; DOLFINx's .pvd
- together: all but "again"; peak GB: of the largest rank, with Python and all libraries

The last row of a case has the exponents by which figures grow between the two largest sizes: 1 is linear.

The second table has MB of arrays on the largest rank, and the third, with one rank among those given, the time that
passes on one rank by that on all of them, which means something only where nothing else runs.

CPU seconds of one rank, all in one run:

| dofs | case | set-up | assembly | again | solve | file | together | iterations | peak GB |
|---|---|---|---|---|---|---|---|---|---|
| 13826 | THCCS | 0.07 | 0.06 | 0.03 | 0.07 | 0.02 | 0.22 | 5 | 0.19 |
| 124418 | THCCS | 0.71 | 0.67 | 0.27 | 0.93 | 0.14 | 2.45 | 5 | 0.45 |
| 1119746 | THCCS | 6.55 | 7.55 | 2.82 | 7.46 | 1.76 | 23.32 | 5 | 2.83 |
| | growth | 1.01 | 1.10 | 1.07 | 0.95 | 1.15 | | | |
| 13826 | Q3, default flags | 0.01 | 0.03 | 0.02 | 0.14 | 0.04 | 0.22 | 38 | 0.18 |
| 124418 | Q3, default flags | 0.05 | 0.18 | 0.13 | 1.26 | 0.28 | 1.77 | 42 | 0.39 |
| 1119746 | Q3, default flags | 0.75 | 1.89 | 1.25 | 11.30 | 1.69 | 15.63 | 43 | 2.14 |
| 1119746 | Q3, our flags | 0.62 | 1.91 | 0.63 | 11.67 | 2.59 | 16.79 | 43 | 2.14 |

So a dof of ours costs more to set up and to assemble than one of Q3, as it has a cell of its own and 49 entries a row
instead of 25, and less to solve for; what it is worth is another question (l_domain.py).

Two ranks, 497666 dofs, wall time of one by that of two (100 % is half the time on two):

| set-up | assembly | again | solve | file |
|---|---|---|---|---|
| 44 % | 103 % | 80 % | 74 % | 78 % |

Set-up is done alike on all ranks, and so are the levels of multigrid. MB of arrays on one rank, and on each of two:
control mesh 50, 50; hierarchy 69, 61; partition 4, 7; cells 117, 60; matrix 293, 147. The peak stays at 1.3 GB, since
on several ranks the values of the matrix are there twice, and Gauss-Seidel's rows as well.
"""

import argparse
import dataclasses
import json
import math
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

from mpi4py import MPI
from petsc4py import PETSc

import dolfinx.fem.petsc
import dolfinx.io
import numpy as np
import numpy.typing as npt

import basix.ufl
import ufl
from thccs_fem import fem, generators, io, jit
from thccs_fem.fem import petsc as fem_petsc
from thccs_fem.partition import partition

SIZES = (48, 144, 432)
SMALL = 6  # of a first run, which compiles
GAUSS = {"quadrature_degree": 7}
STAGES = ("set-up", "assembly", "again", "solve", "file")

type Results = dict[tuple[str, int], list[dict[str, Any]]]  # of each case and number of ranks, for each size


class Clock:
    """Seconds of CPU and of time that passes, for each stage."""

    def __init__(self, comm: MPI.Comm) -> None:
        self.comm = comm
        self.cpu: dict[str, float] = {}
        self.wall: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Measure a stage; of several times the least counts."""
        self.comm.Barrier()
        cpu, wall = time.process_time(), time.perf_counter()
        yield
        spent = time.process_time() - cpu  # not in waiting for others
        self.comm.Barrier()
        for seconds, now in ((self.cpu, spent), (self.wall, time.perf_counter() - wall)):
            seconds[name] = min(self.comm.allreduce(now, op=MPI.MAX), seconds.get(name, math.inf))


def stiffness_and_mass(u: ufl.Argument, v: ufl.Argument) -> ufl.Form:
    return (ufl.inner(ufl.grad(u), ufl.grad(v)) + u * v) * ufl.dx(metadata=GAUSS)


def load(x: ufl.SpatialCoordinate, v: ufl.Argument) -> ufl.Form:
    return x[0] * x[1] * v * ufl.dx(metadata=GAUSS)


class Ours:
    """THCCS functions."""

    def __init__(self, n: int, comm: MPI.Comm, clock: Clock) -> None:
        with clock.stage("set-up"):
            msh = generators.cube_sphere(n, comm=comm)
            self.V = fem.functionspace(msh, ("THCCS", 3))
        u, v, x = ufl.TrialFunction(self.V), ufl.TestFunction(self.V), ufl.SpatialCoordinate(msh)
        self.a, self.L = fem.form(stiffness_and_mass(u, v)), fem.form(load(x, v))
        self.num_dofs = self.V.num_dofs

    def matrix(self) -> PETSc.Mat:
        """Make a matrix with a new pattern, which is kept with the cells."""
        self.a = dataclasses.replace(self.a, cells=dataclasses.replace(self.a.cells))
        return fem_petsc.assemble_matrix(self.a)

    def refill(self, A: PETSc.Mat) -> None:
        fem_petsc.assemble_matrix(A, self.a)

    def vector(self) -> PETSc.Vec:
        return fem_petsc.assemble_vector(self.L)

    def precondition(self, ksp: PETSc.KSP) -> None:
        fem_petsc.multigrid(ksp, self.V)

    def write(self, folder: Path, x: PETSc.Vec) -> None:
        uh = fem.Function(self.V, name="u")
        uh.x.array[: x.getLocalSize()] = x.array_r
        uh.x.scatter_forward()
        io.write_vtu(folder / "u.vtu", uh)


class CubicLagrange:
    """DOLFINx's Q3 on the sphere."""

    def __init__(self, n: int, comm: MPI.Comm, clock: Clock, flags: Sequence[str]) -> None:
        cells, points, element = self.sphere(n) if comm.rank == 0 else self.sphere(0)
        with clock.stage("set-up"):
            self.mesh = dolfinx.mesh.create_mesh(comm, cells, element, points)
            self.V = dolfinx.fem.functionspace(self.mesh, ("Lagrange", 3))
        options = {"cache_dir": jit.cache_directory() / "dolfinx"}
        if flags:
            options["cffi_extra_compile_args"] = list(flags)
        u, v, x = ufl.TrialFunction(self.V), ufl.TestFunction(self.V), ufl.SpatialCoordinate(self.mesh)
        self.a = dolfinx.fem.form(stiffness_and_mass(u, v), jit_options=options)
        self.L = dolfinx.fem.form(load(x, v), jit_options=options)
        self.num_dofs = self.V.dofmap.index_map.size_global

    @staticmethod
    def sphere(n: int) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64], basix.ufl._BlockedElement]:
        """Return cells of 4 x 4 nodes, nodes, and the element; n = 0: no cells."""
        element = basix.ufl.element(
            "Lagrange", "quadrilateral", 3, lagrange_variant=basix.LagrangeVariant.equispaced, shape=(3,)
        )
        if n == 0:
            return np.zeros((0, 16), dtype=np.int64), np.zeros((0, 3)), element
        msh = generators.cube_sphere(n)
        faces = msh.quads.reshape(6, n, n, 4)
        nodes = np.zeros((6, n + 1, n + 1), dtype=np.int64)
        for corner, (i, j) in enumerate([(0, 0), (0, 1), (1, 1), (1, 0)]):
            nodes[:, i : n + i, j : n + j] = faces[..., corner]
        local = np.rint(3 * element.basix_element.points).astype(int)
        first = 3 * np.arange(n // 3)
        cells = nodes[:, (first[:, None] + local[:, 1])[:, None, :], first[:, None] + local[:, 0]]
        return cells.reshape(-1, 16), msh.vertices, element

    def matrix(self) -> PETSc.Mat:
        A = dolfinx.fem.petsc.assemble_matrix(self.a)
        A.assemble()
        return A

    def refill(self, A: PETSc.Mat) -> None:
        A.zeroEntries()
        dolfinx.fem.petsc.assemble_matrix(A, self.a)
        A.assemble()

    def vector(self) -> PETSc.Vec:
        b = dolfinx.fem.petsc.assemble_vector(self.L)
        b.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)
        return b

    def precondition(self, ksp: PETSc.KSP) -> None:
        ksp.getPC().setType("gamg")

    def write(self, folder: Path, x: PETSc.Vec) -> None:
        uh = dolfinx.fem.Function(self.V, name="u")
        uh.x.array[: x.getLocalSize()] = x.array_r
        uh.x.scatter_forward()
        with dolfinx.io.VTKFile(self.mesh.comm, folder / "u.pvd", "w") as file:
            file.write_function(uh)


def megabytes(thing: object, seen: set[int]) -> float:
    """Return how much memory the arrays in an object take, apart from those seen before."""
    while isinstance(thing, np.ndarray) and isinstance(thing.base, np.ndarray):
        thing = thing.base
    if id(thing) in seen:
        return 0.0
    seen.add(id(thing))
    if isinstance(thing, np.ndarray):
        return thing.nbytes / 1e6
    inside = vars(thing) if hasattr(thing, "__dict__") and not isinstance(thing, type) else thing
    values = inside.values() if isinstance(inside, Mapping) else inside if isinstance(inside, list | tuple) else ()
    return sum(megabytes(value, seen) for value in values)


def memory(V: fem.FunctionSpace, A: PETSc.Mat) -> dict[str, float]:
    """Return MB of the components of a space and its matrix, on the largest rank."""
    comm, parts = V.mesh.comm, partition(V.hierarchy)
    seen = {id(comm), id(V.cells), id(parts)}
    sizes = {"control mesh": megabytes(V.mesh, seen), "hierarchy": megabytes(V.hierarchy, seen)}
    seen -= {id(V.cells), id(parts)}
    sizes |= {"partition": megabytes(parts, seen), "cells": megabytes(V.cells, seen)}
    values = np.dtype(PETSc.ScalarType).itemsize + np.dtype(PETSc.IntType).itemsize
    sizes["matrix"] = A.getInfo(PETSc.Mat.InfoType.LOCAL)["nz_used"] * values / 1e6
    return {name: comm.allreduce(size, op=MPI.MAX) for name, size in sizes.items()}


def run(case: str, n: int, repeats: int) -> dict[str, Any]:
    """Return what a run came to, on rank 0."""
    comm = MPI.COMM_WORLD
    CASES[case](SMALL, comm, Clock(comm)).matrix()  # compiles
    clock = Clock(comm)
    problem = CASES[case](n, comm, clock)
    for _ in range(repeats):
        PETSc.garbage_cleanup(comm)  # what several ranks have let go of, they end together
        with clock.stage("assembly"):
            A, b = problem.matrix(), problem.vector()
        with clock.stage("again"):
            problem.refill(A)
    for _ in range(repeats):
        PETSc.garbage_cleanup(comm)
        ksp = PETSc.KSP().create(comm)
        ksp.setOperators(A)
        ksp.setTolerances(rtol=1e-10)
        ksp.setType("cg")
        problem.precondition(ksp)
        x = A.createVecRight()
        with clock.stage("solve"):
            ksp.solve(b, x)
        assert ksp.is_converged
    with tempfile.TemporaryDirectory() as name:
        folder = comm.bcast(name)
        with clock.stage("file"):
            problem.write(Path(folder), x)
    peak = comm.allreduce(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6, op=MPI.MAX)
    found = {"dofs": problem.num_dofs, "iterations": ksp.getIterationNumber(), "peak": peak}
    found |= {"memory": memory(problem.V, A)} if isinstance(problem, Ours) else {}
    return found | {"seconds": clock.cpu if comm.size == 1 else clock.wall, "wall": clock.wall}


CASES: dict[str, Callable[[int, MPI.Comm, Clock], Ours | CubicLagrange]] = {
    "THCCS": Ours,
    "Q3, default flags": partial(CubicLagrange, flags=()),
    "Q3, our flags": partial(CubicLagrange, flags=jit.FLAGS),
}


def measured(case: str, n: int, ranks: int, repeats: int) -> dict[str, Any]:
    """Run in processes of their own, and return what came out."""
    beside = Path(sys.executable).with_name("mpirun")
    launcher = [str(beside) if beside.exists() else shutil.which("mpirun") or "mpirun", "-n", str(ranks)]
    command = [sys.executable, __file__, str(n), "--here", "--cases", case, "--repeats", str(repeats)]
    done = subprocess.run(command if ranks == 1 else launcher + command, check=True, stdout=subprocess.PIPE, text=True)
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def times(results: Results) -> Iterator[str]:
    """Yield the rows of the first table."""
    yield f"| dofs | case | {' | '.join(STAGES)} | together | iterations | peak GB |"
    yield "|---" * (len(STAGES) + 5) + "|"
    for (case, ranks), runs in results.items():
        for found in runs:
            seconds = [found["seconds"][stage] for stage in STAGES]
            figures = " | ".join(f"{s:.2f}" for s in (*seconds, sum(seconds) - found["seconds"]["again"]))
            name = case if ranks == 1 else f"{case}, {ranks} ranks (wall)"
            yield f"| {found['dofs']} | {name} | {figures} | {found['iterations']} | {found['peak']:.2f} |"
        if len(runs) > 1:
            before, after = runs[-2:]
            factors = [after["seconds"][stage] / before["seconds"][stage] for stage in STAGES]
            exponents = np.log(factors) / math.log(after["dofs"] / before["dofs"])
            yield f"| | growth | {' | '.join(f'{e:.2f}' for e in exponents)} | | | |"


def memories(results: Results) -> Iterator[str]:
    """Yield the rows of the second table."""
    runs = {ranks: runs[-1] for (case, ranks), runs in results.items() if case == "THCCS"}
    yield f"| MB, dofs | {' | '.join(f'{found["dofs"]}, {ranks} rank(s)' for ranks, found in runs.items())} |"
    yield "|---" * (len(runs) + 1) + "|"
    for name in next(iter(runs.values()))["memory"] if runs else ():
        yield f"| {name} | {' | '.join(f'{found["memory"][name]:.0f}' for found in runs.values())} |"


def efficiencies(results: Results) -> Iterator[str]:
    """Yield the rows of the third table."""
    yield f"| efficiency | {' | '.join(STAGES)} |"
    yield "|---" * (len(STAGES) + 1) + "|"
    for (case, ranks), runs in results.items():
        if ranks > 1 and (case, 1) in results:
            one, more = results[case, 1][-1]["wall"], runs[-1]["wall"]
            shares = " | ".join(f"{one[stage] / (ranks * more[stage]):.0%}" for stage in STAGES)
            yield f"| {case}, {ranks} ranks, {runs[-1]['dofs']} dofs | {shares} |"


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("sizes", nargs="*", type=int, default=SIZES)
    parser.add_argument("--ranks", nargs="+", type=int, default=[1])
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--cases", nargs="+", choices=CASES, default=CASES)
    parser.add_argument("--here", action="store_true", help="run the first size and case here, and print what came out")
    given = parser.parse_args()
    if given.here:
        found = run(given.cases[0], given.sizes[0], given.repeats)
        if MPI.COMM_WORLD.rank == 0:
            print(json.dumps(found))
        return
    results = {
        (case, ranks): [measured(case, n, ranks, given.repeats) for n in given.sizes]
        for case in given.cases
        for ranks in given.ranks
    }
    for table in (times, memories, efficiencies):
        rows = list(table(results))
        if len(rows) > 2:  # more than its head
            print("\n".join(rows), end="\n\n")


if __name__ == "__main__":
    main()
