"""Microseconds a cell for assembling a matrix, beside DOLFINx with cubic Lagrange elements on a torus of n x n cells.

Our cells are those of a torus, all regular, and of a sphere made of triangles, with an extraordinary vertex at every
corner of every face, adaptively refined: there a cell has several pieces, each with an extraction operator.

    OMP_NUM_THREADS=1 python tests/benchmarks/assembly.py [n]

CPU time of one thread, the least of several runs, forms compiled before. "First" includes the sparsity pattern;
"repeated" writes new values into the same matrix after the geometry has changed. Both sides integrate the same UFL form
with 4 x 4 Gauss points on cubic geometry in space. A cubic Lagrange space has nine dofs a cell, a spline space one.
"""

import dataclasses
import os
import sys
import time
from collections.abc import Callable

os.environ.setdefault("OMP_NUM_THREADS", "1")

from mpi4py import MPI
from petsc4py import PETSc

import dolfinx.fem.petsc
import numpy as np
from scipy.spatial import ConvexHull

import basix.ufl
import ufl
from thccs_fem import adapt, fem, generators, jit
from thccs_fem.mesh import ControlMesh, orient

REPEATS = 7
N = int(sys.argv[1]) if len(sys.argv) > 1 else 128


def stiffness(u: ufl.Argument, v: ufl.Argument) -> ufl.Form:
    return ufl.inner(ufl.grad(u), ufl.grad(v)) * ufl.dx(metadata={"quadrature_degree": 7})


def stiffness_and_mass(u: ufl.Argument, v: ufl.Argument) -> ufl.Form:
    return stiffness(u, v) + u * v * ufl.dx(metadata={"quadrature_degree": 7})


def bending(u: ufl.Argument, v: ufl.Argument) -> ufl.Form:
    return ufl.div(ufl.grad(u)) * ufl.div(ufl.grad(v)) * ufl.dx(metadata={"quadrature_degree": 7})


FORMS = {"stiffness": stiffness, "stiffness + mass": stiffness_and_mass, "bending": bending}


def rough_sphere(num_points: int = 2000) -> ControlMesh:
    """Return a sphere of triangles between points on a spiral."""
    z = 1 - (2 * np.arange(num_points) + 1) / num_points
    turn = np.pi * (1 + 5**0.5) * np.arange(num_points)
    points = np.column_stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z])
    return ControlMesh(points, orient(points, ConvexHull(points).simplices))


def refined_towards_a_circle(V: fem.FunctionSpace, steps: int = 3) -> fem.FunctionSpace:
    """Refine the functions near the plane x = 0.3, nearer with each step."""
    for step in range(steps):
        V = adapt.refine(V, np.flatnonzero(np.abs(V.reference_points[:, 0] - 0.3) < 0.2 * 2.0**-step))
    return V


def least(action: Callable[[], object], prepare: Callable[[], object], num_cells: int) -> float:
    """Return the least CPU time of an action, in microseconds a cell."""
    times = []
    for _ in range(REPEATS):
        prepare()
        start = time.process_time()
        action()
        times.append(time.process_time() - start)
    return min(times) / num_cells * 1e6


class Ours:
    """Splines: into scipy's CSR array, which PETSc gets without a copy."""

    def __init__(self, V: fem.FunctionSpace) -> None:
        self.V = V
        self.points = self.V.cells.points
        self.points.setflags(write=True)

    def times(self, make: Callable[..., ufl.Form]) -> dict[str, tuple[float, float]]:
        form = fem.form(make(ufl.TrialFunction(self.V), ufl.TestFunction(self.V)))
        fresh = [form]

        def forget_pattern() -> None:
            fresh[0] = dataclasses.replace(form, cells=dataclasses.replace(form.cells))

        def to_petsc() -> None:
            A = fem.assemble_matrix(fresh[0])
            PETSc.Mat().createAIJWithArrays(A.shape, (A.indptr, A.indices, A.data), comm=PETSc.COMM_SELF).destroy()

        A = fem.assemble_matrix(form)
        mat = PETSc.Mat().createAIJWithArrays(A.shape, (A.indptr, A.indices, A.data), comm=PETSc.COMM_SELF)

        def refill_petsc() -> None:
            fem.assemble_matrix(A, form)
            mat.stateIncrease()

        n = self.V.num_cells
        return {
            "ours, scipy": (
                least(lambda: fem.assemble_matrix(fresh[0]), forget_pattern, n),
                least(lambda: fem.assemble_matrix(A, form), self.change_geometry, n),
            ),
            "ours, PETSc": (least(to_petsc, forget_pattern, n), least(refill_petsc, self.change_geometry, n)),
        }

    def change_geometry(self) -> None:
        self.points *= 1.001


class Dolfinx:
    """Cubic Lagrange elements: into a PETSc matrix, and into DOLFINx's own."""

    def __init__(self) -> None:
        element = basix.ufl.element(
            "Lagrange", "quadrilateral", 3, lagrange_variant=basix.LagrangeVariant.equispaced, shape=(3,)
        )
        lattice = np.arange(3 * N)
        i, j = (index.ravel() for index in np.meshgrid(lattice, lattice, indexing="ij"))
        a, b = 2 * np.pi * i / (3 * N), 2 * np.pi * j / (3 * N)
        points = np.column_stack([(2 + np.cos(b)) * np.cos(a), (2 + np.cos(b)) * np.sin(a), np.sin(b)])
        local = np.rint(3 * element.basix_element.points).astype(int)
        corner = 3 * np.array([(i, j) for i in range(N) for j in range(N)])
        cells = (corner[:, None, :] + local) % (3 * N) @ [3 * N, 1]
        self.mesh = dolfinx.mesh.create_mesh(MPI.COMM_SELF, cells.astype(np.int64), element, points)
        self.V = dolfinx.fem.functionspace(self.mesh, ("Lagrange", 3))

    def times(self, make: Callable[..., ufl.Form], name: str, **flags: list[str]) -> dict[str, tuple[float, float]]:
        ufl_form = make(ufl.TrialFunction(self.V), ufl.TestFunction(self.V))
        options = {"cache_dir": jit.cache_directory() / "dolfinx", **flags}
        form = dolfinx.fem.form(ufl_form, jit_options=options)

        def first_petsc() -> None:
            A = dolfinx.fem.petsc.assemble_matrix(form)
            A.assemble()
            A.destroy()

        A = dolfinx.fem.petsc.assemble_matrix(form)
        B = dolfinx.fem.assemble_matrix(form)

        def refill_petsc() -> None:
            A.zeroEntries()
            dolfinx.fem.petsc.assemble_matrix(A, form)
            A.assemble()

        def refill_own() -> None:
            B.set_value(0.0)
            dolfinx.fem.assemble_matrix(B, form)

        return {
            f"DOLFINx {name}, PETSc": (
                least(first_petsc, self.change_geometry, N**2),
                least(refill_petsc, self.change_geometry, N**2),
            ),
            f"DOLFINx {name}, own CSR": (
                least(lambda: dolfinx.fem.assemble_matrix(form), self.change_geometry, N**2),
                least(refill_own, self.change_geometry, N**2),
            ),
        }

    def change_geometry(self) -> None:
        self.mesh.geometry.x[:] *= 1.001


def main() -> None:
    torus = Ours(fem.functionspace(generators.torus((N, N)), ("THCCS", 3)))
    rough = Ours(refined_towards_a_circle(fem.functionspace(rough_sphere(), ("THCCS", 3))))
    theirs = Dolfinx()
    print(f"torus {N} x {N}: {N**2} cells, {torus.V.num_dofs} spline and {9 * N**2} Lagrange dofs")
    print(
        f"rough sphere: {rough.V.num_cells} cells of {rough.V.cells.num_pieces} pieces, {rough.V.num_levels} levels, "
        f"{rough.V.num_dofs} dofs"
    )
    print(f"CPU us a cell; our flags: {' '.join(jit.FLAGS)}")
    print("\n| form | matrix | first | repeated | times ours, first | repeated |")
    print("|---|---|---|---|---|---|")
    for form, make in FORMS.items():
        rows = torus.times(make)
        base = rows["ours, PETSc"]
        rows |= {f"{name}, rough sphere": times for name, times in rough.times(make).items()}
        rows |= theirs.times(make, "default flags")
        rows |= theirs.times(make, "our flags", cffi_extra_compile_args=list(jit.FLAGS))
        for name, (first, repeated) in rows.items():
            ratios = f"{first / base[0]:.1f} | {repeated / base[1]:.1f}"
            print(f"| {form} | {name} | {first:.2f} | {repeated:.2f} | {ratios} |")


if __name__ == "__main__":
    main()
