"""Eigenvalue problems, by ARPACK and by SLEPc: closed forms, dense matrices, and one against the other."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse.linalg
from problems import randomly_refined

import ufl
from thccs_fem import fem, generators
from thccs_fem.fem import scipy as fem_scipy
from thccs_fem.fem.eigen import EigenSystem
from thccs_fem.fem.scipy.linear import num_negative
from thccs_fem.fem.space import FunctionSpace
from ufl import div, dx, grad, inner, sym

SIDES = (1.0, 1.3)  # of the rectangle: no eigenvalue is double


def slepc_problem(*args: Any, **kwargs: Any) -> Any:
    """Make SLEPc's problem; skip where there is none."""
    pytest.importorskip("slepc4py")
    from thccs_fem.fem import petsc

    return petsc.EigenProblem(*args, petsc_options_prefix="eigen_", **kwargs)


Maker = Callable[..., Any]
BOTH = pytest.mark.parametrize("make", [fem_scipy.EigenProblem, slepc_problem], ids=["scipy", "slepc"])


def rectangle(n: int = 8, shape: tuple[int, ...] = (), sides: tuple[float, float] = SIDES) -> FunctionSpace:
    return fem.functionspace(generators.rectangle((n, n), (0.0, 0.0), sides), ("THCCS", 3, shape))


def sphere(n: int = 4) -> FunctionSpace:
    return fem.functionspace(generators.cube_sphere(n), ("THCCS", 3))


def arguments(V: FunctionSpace) -> tuple[ufl.Argument, ufl.Argument]:
    return ufl.TrialFunction(V), ufl.TestFunction(V)


def laplace(V: FunctionSpace) -> ufl.Form:
    u, v = arguments(V)
    return inner(grad(u), grad(v)) * dx


def fixed(V: FunctionSpace) -> list[fem.DirichletBC]:
    return [fem.dirichletbc(0.0, fem.boundary_dofs(V), V)]


def of_rectangle(first: int, count: int) -> np.ndarray:
    """Return pi^2 ((i / a)^2 + (j / b)^2) for i, j from `first` on, ascending."""
    i, j = np.mgrid[first:12, first:12]
    return np.sort(np.pi**2 * ((i / SIDES[0]) ** 2 + (j / SIDES[1]) ** 2).ravel())[:count]


# ---- Closed forms


@BOTH
def test_rectangles_with_conditions(make: Maker) -> None:
    V = rectangle()
    values, functions = make(laplace(V), bcs=fixed(V)).solve()
    np.testing.assert_allclose(values, of_rectangle(1, 6), rtol=2e-4)  # 8 faces: at most 3 half waves across them
    assert (values > of_rectangle(1, 6)).all()  # Rayleigh and Ritz: from above
    assert abs(values[0] / of_rectangle(1, 1)[0] - 1.0) < 1e-6
    x = ufl.SpatialCoordinate(V.mesh)
    wave = 2.0 / np.sqrt(SIDES[0] * SIDES[1]) * ufl.sin(np.pi * x[0] / SIDES[0]) * ufl.sin(np.pi * x[1] / SIDES[1])
    assert fem.assemble_scalar(fem.form((functions[0] - wave) ** 2 * dx)) < 1e-8


@BOTH
def test_rectangles_without_conditions(make: Maker) -> None:
    V = rectangle()
    values, functions = make(laplace(V), num_eigenvalues=5).solve()
    np.testing.assert_allclose(values, of_rectangle(0, 5), rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(functions[0].x.array, 1.0 / np.sqrt(SIDES[0] * SIDES[1]), rtol=1e-8)


@BOTH
def test_squares_have_double_eigenvalues(make: Maker) -> None:
    V = rectangle(8, sides=(1.0, 1.0))
    values, _ = make(laplace(V), bcs=fixed(V), num_eigenvalues=8).solve()
    np.testing.assert_allclose(values / np.pi**2, [2, 5, 5, 8, 10, 10, 13, 13], rtol=2e-4)
    np.testing.assert_allclose(values[[1, 4, 6]], values[[2, 5, 7]], rtol=1e-10)  # by symmetry of the mesh


@BOTH
def test_spheres_have_multiplets(make: Maker) -> None:
    # The limit surface is a little inside of the unit sphere, 4 % of the radius for n = 4: values are in proportion.
    V = sphere()
    values, _ = make(laplace(V), num_eigenvalues=16).solve()
    area = fem.assemble_scalar(fem.form(fem.Constant(V.mesh, 1.0) * dx))
    scaled = values * area / (4.0 * np.pi)
    multiplets = np.split(scaled, [1, 4, 9])
    for l, multiplet in enumerate(multiplets):
        np.testing.assert_allclose(multiplet, l * (l + 1), rtol=0.02, atol=1e-9)
        assert np.ptp(multiplet) <= 0.02 * l * (l + 1) + 1e-9
    np.testing.assert_allclose(values[1:4], values[1], rtol=1e-9)  # the cube's symmetry keeps l = 1 together


@BOTH
@pytest.mark.parametrize("number", [3, 6, 9, 13, 16, 25])
def test_no_copy_is_missing(make: Maker, number: int) -> None:
    # On this surface Krylov's method stops with a copy of 6 missing where 9 are wanted, and one of 12 where it is 16.
    V = fem.functionspace(generators.interpolated(generators.cube_sphere(8)), ("THCCS", 3))
    values, functions = make(laplace(V), num_eigenvalues=number).solve()
    A, M = (fem.assemble_matrix(fem.form(form)) for form in (laplace(V), inner(*arguments(V)) * dx))
    exact = scipy.linalg.eigh(A.toarray(), M.toarray(), eigvals_only=True)
    np.testing.assert_allclose(values, exact[:number], rtol=1e-9, atol=1e-10)
    X = np.stack([function.x.array for function in functions])
    np.testing.assert_allclose(X @ M @ X.T, np.eye(number), atol=1e-9)


@BOTH
def test_no_copy_is_missing_on_either_side_of_a_target(make: Maker) -> None:
    V = fem.functionspace(generators.interpolated(generators.cube_sphere(8)), ("THCCS", 3))
    values, _ = make(laplace(V), num_eigenvalues=12, target=9.0).solve()  # 6 five times, 12 seven times
    np.testing.assert_allclose(values, 5 * [6.0] + 7 * [12.0], rtol=1e-3)


@pytest.mark.parametrize("tolerance", [1e-2, 1e-4, 1e-6])
def test_eigenvalues_that_are_wanted_roughly_are_counted_roughly(tolerance: float) -> None:
    V = fem.functionspace(generators.interpolated(generators.cube_sphere(8)), ("THCCS", 3))
    options = {"eps_tol": tolerance, "eps_ncv": 11}  # with a subspace as small as that they are no better than wanted
    values, _ = slepc_problem(laplace(V), num_eigenvalues=9, petsc_options=options).solve()
    np.testing.assert_allclose(values, [0.0] + 3 * [2.0] + 5 * [6.0], rtol=1e-3 + tolerance, atol=1e-3)


def test_searches_go_on_until_the_count_is_right() -> None:
    V = rectangle(4)
    system = EigenSystem(laplace(V), bcs=fixed(V), num_eigenvalues=4)
    system.assemble()
    exact, vectors = scipy.linalg.eigh(system.A.toarray(), system.M.toarray())
    asked = []

    def search(number: int, found: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        # Misses the first and third at the first time, and finds one of them each time after that.
        asked.append((number, found.shape[1]))
        chosen = [[1, 3, 4, 5], [2], [0]][len(asked) - 1]
        return exact[chosen], vectors[:, chosen]

    values, found = system.complete(search, lambda s: int(np.count_nonzero(exact < s)))
    np.testing.assert_array_equal(values[:4], exact[:4])
    np.testing.assert_array_equal(found[:, :4], vectors[:, :4])
    assert asked == [(4, 0), (2, 4), (1, 5)]


def test_counts_that_never_agree_are_an_error() -> None:
    V = rectangle(4)
    system = EigenSystem(laplace(V), bcs=fixed(V), num_eigenvalues=4)
    system.assemble()
    exact, vectors = scipy.linalg.eigh(system.A.toarray(), system.M.toarray())

    def search(number: int, found: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        chosen = np.arange(4, exact.size) if found.shape[1] == 0 else []
        return exact[chosen], vectors[:, chosen]

    with pytest.raises(RuntimeError, match=r"of the 4 eigenvalues nearest to 0, 4 are missing"):
        system.complete(search, lambda s: int(np.count_nonzero(exact < s)))
    with pytest.raises(RuntimeError, match=r"of the 4 eigenvalues nearest to 0, 3 are too many"):
        system.complete(lambda number, *_: (exact[:number], vectors[:, :number]), lambda s: 0)


def test_shifts_at_which_nothing_can_be_counted() -> None:
    with pytest.raises(RuntimeError, match="SuperLU met a zero on the diagonal"):
        num_negative(scipy.sparse.csr_array([[0.0, 1.0], [1.0, 0.0]]))
    assert num_negative(scipy.sparse.csr_array([[1.0, 2.0], [2.0, 1.0]])) == 1


@BOTH
def test_targets_in_the_middle(make: Maker) -> None:
    V = sphere()
    all_values, _ = make(laplace(V), num_eigenvalues=16).solve()
    values, _ = make(laplace(V), num_eigenvalues=5, target=6.0).solve()
    np.testing.assert_allclose(values, all_values[4:9], rtol=1e-10)
    exactly, _ = make(laplace(V), num_eigenvalues=5, target=float(all_values[4])).solve()
    np.testing.assert_allclose(exactly, values, rtol=1e-9)


@BOTH
def test_rigid_motions_have_eigenvalue_zero(make: Maker) -> None:
    V = rectangle(4, (2,))
    u, v = arguments(V)
    values, _ = make((inner(sym(grad(u)), sym(grad(v))) + div(u) * div(v)) * dx, num_eigenvalues=5).solve()
    np.testing.assert_allclose(values[:3], 0.0, atol=1e-8)
    assert values[3] > 1.0


@BOTH
def test_free_plates(make: Maker) -> None:
    # Linear functions bend nothing; the next eigenvalue is far from them.
    V = rectangle(6)
    u, v = arguments(V)
    values, _ = make(inner(grad(grad(u)), grad(grad(v))) * dx, num_eigenvalues=4).solve()
    np.testing.assert_allclose(values[:3], 0.0, atol=1e-6 * values[3])
    assert values[3] > 10.0


# ---- Matrices


@BOTH
@pytest.mark.parametrize("shape", [(), (2,)])
def test_dense_matrices_have_the_same_spectrum(make: Maker, shape: tuple[int, ...]) -> None:
    V = randomly_refined(fem.functionspace(generators.wheel(5, 2), ("THCCS", 3, shape)))
    u, v = arguments(V)
    x = ufl.SpatialCoordinate(V.mesh)
    a, m = inner(grad(u), grad(v)) * dx + (1.0 + x[0] ** 2) * inner(u, v) * dx, (2.0 + x[1]) * inner(u, v) * dx
    dofs = fem.boundary_dofs(V, lambda x: x[0] > 0.0)
    bcs = [fem.dirichletbc(0.0, dofs, V if not shape else V.sub(0))]
    values, functions = make(a, m, bcs=bcs, num_eigenvalues=7).solve()
    free = np.setdiff1d(np.arange(V.num_dofs), bcs[0].dofs)
    A, M = (fem.assemble_matrix(fem.form(form)).toarray()[np.ix_(free, free)] for form in (a, m))
    np.testing.assert_allclose(values, scipy.linalg.eigh(A, M, eigvals_only=True)[:7], rtol=1e-9)
    for value, function in zip(values, functions, strict=True):
        x_free = function.x.array[free]
        np.testing.assert_allclose(A @ x_free, value * (M @ x_free), atol=1e-6 * np.abs(A @ x_free).max())
        np.testing.assert_array_equal(function.x.array[bcs[0].dofs], 0.0)


@BOTH
def test_functions_are_orthonormal_with_a_sign(make: Maker) -> None:
    V = sphere()
    values, functions = make(laplace(V), num_eigenvalues=9).solve()
    X = np.stack([function.x.array for function in functions])
    u, v = arguments(V)
    M = fem.assemble_matrix(fem.form(u * v * dx))
    np.testing.assert_allclose(X @ M @ X.T, np.eye(9), atol=1e-9)
    assert (np.diff(values) >= 0.0).all()
    for x in X:
        largest = np.flatnonzero(np.abs(x) > (1.0 - 1e-6) * np.abs(x).max())[0]
        assert x[largest] > 0.0


def test_vectors_are_normalised_and_turned() -> None:
    V = rectangle(4)
    system = EigenSystem(laplace(V), bcs=fixed(V), num_eigenvalues=2)
    system.assemble()
    vectors = -7.0 * np.abs(np.random.default_rng(0).standard_normal((system.free.size, 3)))
    values, functions = system.accept(np.array([5.0, 4.0, 1.0]), vectors, "nobody")
    assert values.tolist() == [4.0, 5.0]  # ascending, and no more than are wanted
    for function in functions:
        assert fem.assemble_scalar(fem.form(function**2 * dx)) == pytest.approx(1.0, rel=1e-12)
        assert (function.x.array[system.free] > 0.0).all()


@BOTH
def test_results_are_the_same_each_time(make: Maker) -> None:
    V = sphere()
    problem = make(laplace(V))
    first, second, third = problem.solve(), problem.solve(), make(laplace(V)).solve()
    for other in (second, third):
        np.testing.assert_array_equal(first[0], other[0])
        for f, g in zip(first[1], other[1], strict=True):
            np.testing.assert_array_equal(f.x.array, g.x.array)


def test_both_solvers_agree() -> None:
    V = randomly_refined(rectangle(5))
    found = [make(laplace(V), bcs=fixed(V)).solve() for make in (fem_scipy.EigenProblem, slepc_problem)]
    np.testing.assert_allclose(found[0][0], found[1][0], rtol=1e-10)
    for f, g in zip(found[0][1], found[1][1], strict=True):
        np.testing.assert_allclose(f.x.array, g.x.array, atol=1e-7)


@BOTH
def test_values_and_conditions_may_change(make: Maker) -> None:
    V = rectangle()
    u, v = arguments(V)
    k = fem.Constant(V.mesh, 1.0)
    problem = make(k * inner(grad(u), grad(v)) * dx, bcs=fixed(V), num_eigenvalues=2)
    first, _ = problem.solve()
    k.value = 3.0
    np.testing.assert_allclose(problem.solve()[0], 3.0 * first, rtol=1e-10)
    problem.bcs = []
    np.testing.assert_allclose(problem.solve()[0], 3.0 * of_rectangle(0, 2), rtol=1e-4, atol=1e-9)


# ---- What is refused


@BOTH
def test_forms_that_are_no_eigenvalue_problem(make: Maker) -> None:
    V = rectangle(3)
    W = rectangle(3, (2,))
    u, v = arguments(V)
    with pytest.raises(ValueError, match="give a bilinear form, in a trial and a test function of the same space"):
        make(v * dx)
    with pytest.raises(ValueError, match="m has arguments in"):
        make(laplace(V), inner(*arguments(W)) * dx)
    with pytest.raises(ValueError, match="a is not symmetric, so that eigenvalues may be complex"):
        make((inner(grad(u), grad(v)) + u.dx(0) * v) * dx).solve()
    with pytest.raises(ValueError, match="m is not symmetric"):
        make(laplace(V), (u + u.dx(0)) * v * dx).solve()
    with pytest.raises(ValueError, match="m is not positive"):
        make(laplace(V), -u * v * dx).solve()


@BOTH
def test_numbers_and_conditions_that_are_refused(make: Maker) -> None:
    V = rectangle(3)
    with pytest.raises(ValueError, match="num_eigenvalues is 0"):
        make(laplace(V), num_eigenvalues=0)
    with pytest.raises(ValueError, match=r"num_eigenvalues is 2\.5: ask for one or more, a whole number"):
        make(laplace(V), num_eigenvalues=2.5)
    with pytest.raises(ValueError, match="target is nan"):
        make(laplace(V), target=float("nan"))
    with pytest.raises(ValueError, match="36 eigenvalues are wanted of 36 dofs"):
        make(laplace(V), num_eigenvalues=36).solve()
    with pytest.raises(ValueError, match=r"conditions prescribe values up to 2: .* prescribe 0\.0"):
        make(laplace(V), bcs=[fem.dirichletbc(-2.0, [0], V)]).solve()
    with pytest.raises(ValueError, match="a condition is on"):
        make(laplace(V), bcs=fixed(rectangle(4)))


def test_arpack_that_does_not_converge(monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(A: Any, k: int, *args: Any, **kwargs: Any) -> None:
        raise scipy.sparse.linalg.ArpackNoConvergence("no", np.ones(2), np.ones((A.shape[0], 2)))

    monkeypatch.setattr(scipy.sparse.linalg, "eigsh", failing)
    V = rectangle(3)
    with pytest.raises(RuntimeError, match=r"ARPACK found 2 of 6 eigenvalues near 0\. What may help"):
        fem_scipy.EigenProblem(laplace(V)).solve()


def test_slepc_that_does_not_converge() -> None:
    V = rectangle(12)
    options = {"eps_max_it": 1, "eps_ncv": 8, "eps_mpd": 8}
    with pytest.raises(RuntimeError, match=r"SLEPc's krylovschur, after \d iterations, found \d of 6 eigenvalues"):
        slepc_problem(laplace(V), bcs=fixed(V), petsc_options=options).solve()


# ---- Options of SLEPc


def test_options_choose_the_solver() -> None:
    V = rectangle()
    options = {
        "eps_type": "subspace",
        "eps_tol": 1e-9,
        "eps_nev": 3,
        "eps_target": 1.0,
        "st_pc_type": "lu",
        "st_pc_factor_mat_solver_type": "petsc",
    }
    problem = slepc_problem(laplace(V), bcs=fixed(V), petsc_options=options)
    values, _ = problem.solve()
    assert problem.solver.getType() == "subspace"
    assert problem.solver.getTarget() == problem.solver.getST().getShift() == 1.0
    assert problem.solver.getST().getKSP().getPC().getFactorSolverType() == "petsc"
    np.testing.assert_allclose(values, of_rectangle(1, 3), rtol=1e-4)


def test_options_that_nothing_reads_are_reported() -> None:
    V = rectangle(4)
    problem = slepc_problem(laplace(V), bcs=fixed(V), petsc_options={"eps_nvc": 30})
    with pytest.warns(UserWarning, match=r"PETSc made no use of the options \['eps_nvc'\]"):
        problem.solve()


def test_singular_matrices_are_noticed_by_any_factorisation() -> None:
    V = sphere(3)
    options = {"st_pc_type": "lu", "st_pc_factor_mat_solver_type": "petsc"}
    values, _ = slepc_problem(laplace(V), num_eigenvalues=4, petsc_options=options).solve()
    assert abs(values[0]) < 1e-9
    np.testing.assert_allclose(values[1:], values[1], rtol=1e-8)
