"""Multigrid on several ranks: its levels, its smoother and its iterations are those of one rank."""

import sys
from collections.abc import Callable
from functools import cache
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import pytest
import scipy.sparse as sp
from compared import same_as_in_serial, shared
from problems import graded_l_domain, refined_anywhere, refined_towards, uniformly_refined

import ufl
from thccs_fem import fem, generators
from thccs_fem.fem import petsc
from thccs_fem.fem.levels import LevelMatrix, Levels, owners_of
from thccs_fem.fem.petsc import gauss_seidel
from thccs_fem.fem.petsc.gauss_seidel import GaussSeidel
from thccs_fem.fem.petsc.matrices import values_of
from thccs_fem.fem.space import FunctionSpace
from thccs_fem.forms import biharmonic, laplace_beltrami, linear_elasticity, plate
from thccs_fem.hierarchy import Hierarchy
from thccs_fem.mesh import ControlMesh
from thccs_fem.parallel import gathered, total

# ---- Spaces ----------------------------------------------------------------------------------------------------------


def on(msh: ControlMesh, times: int = 0) -> FunctionSpace:
    return uniformly_refined(fem.functionspace(msh, ("THCCS", 3)), times)


SPACES: dict[str, Callable[[], FunctionSpace]] = {
    "square, coarser meshes": lambda: on(generators.rectangle((32, 32))),
    "sphere": lambda: on(generators.cube_sphere(4), 1),
    "L-domain": lambda: graded_l_domain(6),
    "small square": lambda: refined_towards(on(generators.rectangle((9, 9))), (0.0, 0.0), 2),
    "wheel": lambda: refined_towards(on(generators.wheel(5, 2)), (0.0, 0.0), 4),
    "anywhere": lambda: refined_anywhere(on(generators.torus((12, 6))), 3),
}


@cache
def alone(name: str) -> FunctionSpace:
    return SPACES[name]()


def space(name: str, comm: MPI.Comm, value_shape: tuple[int, ...] = ()) -> FunctionSpace:
    """Return a space on the ranks: refined alike, as it says which faces are refined."""
    hierarchy = alone(name).hierarchy
    msh = shared(hierarchy.mesh, comm)
    keys = hierarchy.refined_keys
    return FunctionSpace(Hierarchy.on(msh, hierarchy.rule, refined_keys=keys), value_shape)


def rows(V: FunctionSpace, form: Callable[..., ufl.Form] = laplace_beltrami.a) -> sp.csr_array:
    """Return the rows of a form's matrix that this rank owns, columns by their numbers."""
    A = fem.assemble_matrix(fem.form(form(ufl.TrialFunction(V), ufl.TestFunction(V))))
    k = V.block_size
    numbers = (k * V.index_map.numbers[:, None] + np.arange(k)).ravel()
    return sp.csr_array((A.data, numbers[A.indices], A.indptr), shape=(A.shape[0], V.num_dofs))


def whole(matrix: LevelMatrix) -> np.ndarray:
    """Return the rows of all ranks."""
    found = np.zeros((matrix.values.shape[1],) * 2)
    found[matrix.owned] = matrix.values.toarray()
    return total(matrix.dofs.comm, found)


# ---- Levels ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["sphere", "anywhere"])
def test_matrices_of_the_levels(name: str) -> None:
    def work(comm: MPI.Comm) -> list[np.ndarray]:
        V = space(name, comm)
        return [whole(matrix) for matrix in Levels.of(V).matrices(rows(V))]

    same_as_in_serial(work, tol=1e-12)


def test_a_function_keeps_its_owner(comm: MPI.Comm) -> None:
    V = space("L-domain", comm, (2,))
    levels = Levels.of(V)
    owner = np.full(levels.finest.size, -1)
    for number, dofs in zip(reversed(levels.numbers), reversed(levels.dofs), strict=True):
        seen = owner[number] >= 0
        np.testing.assert_array_equal(owners_of(dofs)[seen], owner[number[seen]])
        owner[number] = owners_of(dofs)
        assert dofs.num_ghosts == 0
    np.testing.assert_array_equal(levels.dofs[-1].numbers, V.index_map.numbers[: dofs_of(V)].repeat(2) * 2 + parity(V))


def dofs_of(V: FunctionSpace) -> int:
    return V.index_map.size_local


def parity(V: FunctionSpace) -> np.ndarray:
    return np.arange(V.num_owned_dofs) % 2


def test_work_is_spread(comm: MPI.Comm) -> None:
    levels = Levels.of(space("sphere", comm))
    for dofs in levels.dofs:
        assert dofs.size_local < 1.5 * dofs.size_global / comm.size


def test_rows_of_a_matrix_are_those_that_petsc_has(comm: MPI.Comm) -> None:
    V = space("L-domain", comm, (2,))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    form = fem.form(linear_elasticity.a(u, v))
    A, dofs = petsc.assemble_matrix(form), Levels.of(V).dofs[-1]
    rows_of = sys.modules["thccs_fem.fem.petsc.multigrid"]._rows
    expected = rows(V, linear_elasticity.a).toarray()
    for factor in (1.0, 3.0):  # the second one is unknown to us
        if factor != 1.0:
            A.scale(factor)
        assert (values_of(A) is None) == (factor != 1.0)
        np.testing.assert_allclose(rows_of(A, dofs).toarray(), factor * expected, rtol=1e-14)
    petsc.assemble_matrix(A, form)
    assert values_of(A) is not None
    np.testing.assert_allclose(rows_of(A, dofs).toarray(), expected, rtol=1e-14)


# ---- The smoother ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("form", "part"), [(laplace_beltrami.a, 1.0), (biharmonic.a, 0.3), (biharmonic.a, 0.0)])
@pytest.mark.filterwarnings("ignore:the form has second derivatives")  # on shallow caps: the smoother is tested
def test_gauss_seidel(
    monkeypatch: pytest.MonkeyPatch, comm: MPI.Comm, form: Callable[..., ufl.Form], part: float
) -> None:
    monkeypatch.setattr(gauss_seidel, "ALIKE", 1.0)  # one function after the other
    V = space("small square", comm)
    dofs = Levels.of(V).dofs[-1]
    matrix = LevelMatrix(rows(V, form), dofs)
    functions = np.flatnonzero(np.random.default_rng(1).random(V.num_dofs) < part).astype(np.int32)
    A, owners = whole(matrix), owners_of(dofs)
    of_all = applied(GaussSeidel(matrix, functions), dofs)
    of_before = (A != 0) & (owners[:, None] > owners)
    last = functions[of_before[np.ix_(functions, functions)].any(axis=1)]
    order = np.concatenate([np.setdiff1d(functions, last), last[np.argsort(owners[last], kind="stable")]])
    B = A[np.ix_(order, order)]
    M = np.tril(B) @ np.diag(1.0 / np.diag(B)) @ np.triu(B)
    expected = np.zeros_like(A)
    expected[np.ix_(order, order)] = np.linalg.inv(M) if order.size else 0.0
    np.testing.assert_allclose(of_all, expected, rtol=0, atol=1e-11 * np.abs(expected).max(initial=0.0))
    if order.size:
        assert np.linalg.eigvals(of_all @ A).real.max() < 1.0 + 1e-9  # what the method of Chebyshev counts on


def test_gauss_seidel_for_vectors(comm: MPI.Comm) -> None:
    V = space("small square", comm, (2,))
    matrix = LevelMatrix(
        rows(V, lambda u, v: linear_elasticity.a(u, v) + ufl.inner(u, v) * ufl.dx), Levels.of(V).dofs[-1]
    )
    found = applied(GaussSeidel(matrix, np.arange(V.num_dofs, dtype=np.int32)), matrix.dofs)
    np.testing.assert_allclose(found, found.T, rtol=0, atol=1e-12 * np.abs(found).max())
    values = np.linalg.eigvals(found @ whole(matrix)).real
    assert values.min() > 0.0
    assert values.max() < 1.0 + 1e-9


def applied(smoother: GaussSeidel, dofs: Any) -> np.ndarray:
    """Return the matrix of a smoother, column by column."""
    result = np.zeros((dofs.size_global,) * 2)
    b = PETSc.Vec().createMPI((dofs.size_local, dofs.size_global), comm=dofs.comm)
    x = b.duplicate()
    for column in range(dofs.size_global):
        b.array_w[:] = dofs.numbers == column
        x.set(np.nan)
        smoother.apply(PETSc.PC(), b, x)
        result[dofs.numbers, column] = x.array_r
    return total(dofs.comm, result)


# ---- Solving ---------------------------------------------------------------------------------------------------------

MULTIGRID = {"ksp_type": "cg", "pc_type": "mg", "ksp_rtol": 1e-12}
FORMS: dict[str, tuple[Callable[..., ufl.Form], bool]] = {
    "laplace": (laplace_beltrami.a, False),
    "biharmonic": (biharmonic.a, False),
    "clamped plate": (plate.a, True),
    "elasticity": (linear_elasticity.a, False),
}


def problem(V: FunctionSpace, equation: str, **options: object) -> petsc.LinearProblem:
    form, slope = FORMS[equation]
    u, v, x = ufl.TrialFunction(V), ufl.TestFunction(V), ufl.SpatialCoordinate(V.mesh)
    dofs = fem.boundary_dofs(V, slope=slope)
    has_rim = total(V.mesh.comm, dofs.size) > 0
    zero = np.zeros(V.block_size) if V.block_size > 1 else 0.0
    load = x[0] * (v if V.block_size == 1 else v[0] + 2 * v[1]) * ufl.dx  # zero on average where there is no rim
    bcs = [fem.dirichletbc(zero, dofs, V)] if has_rim else []
    options = {**MULTIGRID, **options}
    return petsc.LinearProblem(form(u, v), load, bcs=bcs, petsc_options_prefix="p_", petsc_options=options)


def solved(V: FunctionSpace, equation: str, **options: object) -> tuple[np.ndarray, int]:
    """Return the solution on all ranks, and the number of iterations."""
    of_equation = problem(V, equation, **options)
    values = of_equation.solve().x.array.reshape(-1, V.block_size)
    return V.index_map.gather(values), of_equation.solver.getIterationNumber()


CASES = [
    ("square, coarser meshes", "laplace"),
    ("sphere", "biharmonic"),
    ("L-domain", "clamped plate"),
    ("L-domain", "elasticity"),
    ("wheel", "biharmonic"),
    ("anywhere", "biharmonic"),
]


@pytest.mark.filterwarnings("ignore:the form has second derivatives")  # on shallow caps: the solver is tested
@pytest.mark.parametrize(("name", "equation"), CASES)
def test_solutions_and_iterations(name: str, equation: str) -> None:
    iterations = {}

    def work(comm: MPI.Comm) -> np.ndarray:
        values, iterations[comm.size] = solved(space(name, comm, (2,) if equation == "elasticity" else ()), equation)
        return values

    same_as_in_serial(work)
    found = list(iterations.values())
    assert max(found) - min(found) <= 2  # the order of functions in the smoother matters little
    assert max(found) <= 16


@pytest.mark.parametrize(("option", "kind"), [("mg_levels_pc_type", "jacobi"), ("mg_levels_sub_pc_type", "asm")])
def test_options_of_the_levels(comm: MPI.Comm, option: str, kind: str) -> None:
    V = space("square, coarser meshes", comm)
    usual, other = problem(V, "laplace"), problem(V, "laplace", **{option: "jacobi"})
    found = [each.solve().x.array.copy() for each in (usual, other)]
    np.testing.assert_allclose(*found, rtol=0, atol=1e-10)
    kinds = [each.solver.getPC().getMGSmoother(1).getPC().getType() for each in (usual, other)]
    assert kinds == ["python" if comm.size > 1 else "sor", kind]


def test_large_problems_are_iterated(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(petsc.linear, "LARGEST_DIRECT", 100)
    options = {"ksp_rtol": 1e-12}

    def work(comm: MPI.Comm) -> tuple[str, np.ndarray]:
        V = space("L-domain", comm)
        u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
        bc = fem.dirichletbc(1.0, fem.boundary_dofs(V), V)
        of_equation = petsc.LinearProblem(
            laplace_beltrami.a(u, v), v * ufl.dx, bcs=[bc], petsc_options_prefix="l_", petsc_options=options
        )
        values = of_equation.solve().x.array
        return of_equation.solver.getPC().getType(), V.index_map.gather(values)

    assert same_as_in_serial(work)[0] == "mg"


def test_the_matrix_of_another_space(comm: MPI.Comm) -> None:
    V, W = space("wheel", comm), space("anywhere", comm)
    A = problem(V, "laplace").A
    ksp = PETSc.KSP().create(comm)
    ksp.setOperators(A)
    petsc.multigrid(ksp, W)
    with pytest.raises(PETSc.Error) as raised:
        ksp.solve(A.createVecLeft(), A.createVecRight())
    assert f"has {W.num_dofs} dofs" in str(raised.value.__cause__)
    assert gathered(comm, np.array([1])).size == comm.size  # nobody waits for another one
