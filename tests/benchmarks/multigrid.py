"""Iterations and CPU seconds of multigrid, beside algebraic multigrid, Jacobi's method and a direct solver.

    OMP_NUM_THREADS=1 python tests/benchmarks/multigrid.py [most dofs]

Conjugate gradients until the energy norm of the residual, as the preconditioner sees it, is 1e-10 of that of the load
of a random function; seconds of set-up (prolongations and matrices of all levels included) and solution together.
"error" is the largest energy error that multigrid and GAMG leave. Zero is prescribed on boundaries, slopes too for the
plate; where there is none, the Laplace and biharmonic equations have constants in the kernel. A run of more than 2000
iterations is not counted, and Jacobi is left out from half of the most dofs on. With the environment variable
THCCS_MESHES the table has meshes of that folder as well.
"""

import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).parents[1]))

import mpi4py.MPI  # noqa: F401  # loads the library that petsc4py needs
from petsc4py import PETSc

import numpy as np
import scipy.sparse as sp
from problems import graded_l_domain, refined_anywhere, refined_towards, uniformly_refined

import ufl
from thccs_fem import fem, generators, io
from thccs_fem.fem.linear import constrain
from thccs_fem.fem.petsc.multigrid import multigrid
from thccs_fem.fem.space import FunctionSpace
from thccs_fem.forms import biharmonic, laplace_beltrami, linear_elasticity, plate
from thccs_fem.mesh import ControlMesh

MOST_DOFS = int(sys.argv[1]) if len(sys.argv) > 1 else 40_000
MOST_ITERATIONS = 2000
FOLDER = os.environ.get("THCCS_MESHES")
ORIGIN = (0.0, 0.0)

FORMS: dict[str, tuple[Callable[..., ufl.Form], bool]] = {
    "Laplace": (laplace_beltrami.a, False),
    "biharmonic": (biharmonic.a, False),
    "clamped plate": (plate.a, True),
    "elasticity": (linear_elasticity.a, False),
}
CLOSED, OPEN = ("Laplace", "biharmonic"), ("Laplace", "biharmonic", "clamped plate")


# ---- Spaces ----------------------------------------------------------------------------------------------------------


def on(msh: ControlMesh, times: int = 0) -> FunctionSpace:
    return uniformly_refined(fem.functionspace(msh, ("THCCS", 3)), times)


def spaces() -> Iterator[tuple[str, FunctionSpace, tuple[str, ...]]]:
    """Yield names, spaces, and forms to solve; the sizes of a kind one after the other."""
    for n in (32, 64, 128, 256, 512, 1024):
        if n * n <= MOST_DOFS:
            yield f"square, {n} x {n}", on(generators.rectangle((n, n))), OPEN
    for times in (2, 4):
        yield f"square, 8 x 8, refined {times} times", on(generators.rectangle((8, 8)), times), OPEN
    for n in (32, 128):
        yield f"torus, {n} x {n // 2}", on(generators.torus((n, n // 2))), CLOSED
    for n in (12, 48):
        yield f"sphere, 6 x {n} x {n}", on(generators.cube_sphere(n)), CLOSED
    for times in (1, 3):
        yield f"sphere, 6 x 6 x 6, refined {times} times", on(generators.cube_sphere(6), times), CLOSED
    yield "genus 3, refined", on(generators.genus3(), 1), CLOSED
    for n in (2, 5, 10, 15, 20, 25):
        yield "L-domain, graded", graded_l_domain(n), OPEN
    for valence in (3, 5, 6, 8, 12):
        for n in (4, 12):
            V = refined_towards(on(generators.wheel(valence, 4)), ORIGIN, n)
            yield f"wheel of valence {valence}, centre", V, OPEN
    for n in (3, 6, 9):
        yield "torus, anywhere", refined_anywhere(on(generators.torus((16, 8))), n), CLOSED
    for n in (32, 96):
        scalar = refined_towards(on(generators.rectangle((n, n))), ORIGIN, 4)
        yield f"square, {n} x {n}, corner", FunctionSpace(scalar.hierarchy, (2,)), ("elasticity",)
    for name in ("koala_instant", "nefertiti_voxel", "bob_control_mesh", "spot_control_mesh", "skull_quads"):
        path = Path(FOLDER or "") / f"{name}.obj"
        if FOLDER and path.is_file():
            for times in (1, 2):
                yield f"{name}, refined {times} times", on(io.read_mesh(path), times), CLOSED


# ---- Solvers ---------------------------------------------------------------------------------------------------------


def matrix(V: FunctionSpace, name: str) -> sp.csr_array:
    form, slope = FORMS[name]
    A = fem.assemble_matrix(fem.form(form(ufl.TrialFunction(V), ufl.TestFunction(V))))
    functions = fem.boundary_dofs(V, slope=slope)
    constrain(A, (V.block_size * functions[:, None] + np.arange(V.block_size)).ravel())
    return A


def as_mat(A: sp.csr_array) -> PETSc.Mat:
    mat = PETSc.Mat().createAIJWithArrays(A.shape, (A.indptr, A.indices, A.data), comm=PETSc.COMM_SELF)
    if np.abs(A @ np.ones(A.shape[1])).max() < 1e-8 * abs(A).max():
        mat.setNullSpace(PETSc.NullSpace().create(constant=True, comm=PETSc.COMM_SELF))
    return mat


def solved(V: FunctionSpace, A: sp.csr_array, kind: str) -> tuple[int, float, float]:
    """Return iterations (0 for too many), seconds and error."""
    mat = as_mat(A)
    has_kernel = bool(mat.getNullSpace().handle)
    exact = np.random.default_rng(0).standard_normal(A.shape[0])
    b = PETSc.Vec().createWithArray(A @ exact, comm=PETSc.COMM_SELF)
    x = b.duplicate()
    ksp = PETSc.KSP().create(PETSc.COMM_SELF)
    ksp.setOptionsPrefix("bench_")
    ksp.setType("cg")
    ksp.setNormType(PETSc.KSP.NormType.NATURAL)
    ksp.setTolerances(rtol=1e-10, max_it=MOST_ITERATIONS)
    start = time.process_time()
    if kind == "direct":
        ksp.setType("preonly")
        ksp.getPC().setType("cholesky")
        ksp.getPC().setFactorSolverType("mumps")
        regular = A.copy()
        regular[0, 0] *= 2.0 if has_kernel else 1.0
        ksp.setOperators(mat, as_mat(regular))
    else:
        ksp.setOperators(mat)
        if kind == "multigrid":
            multigrid(ksp, V)
        else:
            ksp.getPC().setType(kind)
    ksp.solve(b, x)
    seconds = time.process_time() - start
    error = x.array - exact
    if has_kernel:
        error -= error.mean()
    relative = np.sqrt(np.abs(error @ (A @ error)) / (exact @ (A @ exact)))
    return ksp.getIterationNumber() if ksp.getConvergedReason() > 0 else 0, seconds, float(relative)


def main() -> None:
    kinds = ("multigrid", "gamg", "jacobi", "direct")
    columns = "space dofs levels equation multigrid s us/dof error GAMG s error Jacobi s MUMPS,s"
    print(f"| {' | '.join(columns.split())} |")
    print("|---" * 14 + "|")
    for name, V, forms in spaces():
        for form in forms:
            A = matrix(V, form)
            small = V.num_dofs <= MOST_DOFS / 2
            found = {kind: solved(V, A, kind) if small or kind != "jacobi" else (0, 0.0, 0.0) for kind in kinds}
            texts = {k: (str(n or "-"), f"{s:.3f}", f"{e:.0e}") for k, (n, s, e) in found.items()}
            ours = [texts["multigrid"][0], texts["multigrid"][1], f"{1e6 * found['multigrid'][1] / V.num_dofs:.0f}"]
            others = [*texts["gamg"], *texts["jacobi"][:2], texts["direct"][1]]
            cells = [name, str(V.num_dofs), str(V.num_levels), form, *ours, texts["multigrid"][2], *others]
            print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
