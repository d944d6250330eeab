"""Problems in several unknowns, against the same in one vector-valued space, dense matrices, and one another."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp

import ufl
from thccs_fem import adapt, fem, generators
from thccs_fem.fem import scipy
from thccs_fem.fem.linear import LinearSystem
from thccs_fem.fem.nonlinear import NonlinearSystem
from thccs_fem.fem.space import FunctionSpace
from ufl import div, dx, grad, inner

Maker = Callable[..., Any]
SPLIT = {
    "ksp_type": "gmres",
    "ksp_rtol": 1e-12,
    "pc_type": "fieldsplit",
    "pc_fieldsplit_type": "multiplicative",
    "fieldsplit_ksp_type": "preonly",
    "fieldsplit_pc_type": "lu",
}


def petsc(kind: str, options: dict[str, Any] | None = None, problem: str = "LinearProblem") -> Maker:
    """Return what makes PETSc's problem of a kind; it skips where there is no PETSc."""

    def make(*args: Any, **kwargs: Any) -> Any:
        pytest.importorskip("petsc4py")
        from thccs_fem.fem import petsc

        made = getattr(petsc, problem)
        return made(*args, petsc_options_prefix="blocks_", petsc_options=options, kind=kind, **kwargs)

    return make


LINEAR = {
    "scipy": scipy.LinearProblem,
    "mpi": petsc("mpi"),
    "nest": petsc("nest", SPLIT),
    "fields": petsc("mpi", SPLIT),
}
NONLINEAR = {
    "scipy": scipy.NonlinearProblem,
    "mpi": petsc("mpi", problem="NonlinearProblem"),
    "nest": petsc("nest", SPLIT, "NonlinearProblem"),
}
EACH_LINEAR = pytest.mark.parametrize("make", LINEAR.values(), ids=LINEAR)
EACH_NONLINEAR = pytest.mark.parametrize("make", NONLINEAR.values(), ids=NONLINEAR)


def square(shape: tuple[int, ...] = (), n: int = 4) -> FunctionSpace:
    return fem.functionspace(generators.rectangle((n, n)), ("THCCS", 3, shape))


def on_mesh_of(V: FunctionSpace, shape: tuple[int, ...] = (), refined: tuple[int, ...] = ()) -> FunctionSpace:
    """Return another space on the same mesh, refined at some functions."""
    W = fem.functionspace(V.mesh, ("THCCS", 3, shape))
    return adapt.refine(W, list(refined)) if refined else W


def fixed(V: FunctionSpace, value: Any = 0.0) -> fem.DirichletBC:
    return fem.dirichletbc(value, fem.boundary_dofs(V), V)


def coupled(V: FunctionSpace, Q: FunctionSpace) -> tuple[ufl.Form, ufl.Form]:
    """Return the forms of a scalar and a vector field that react with one another, over a mixed space."""
    W = ufl.MixedFunctionSpace(V, Q)
    (u, p), (v, q) = ufl.TrialFunctions(W), ufl.TestFunctions(W)
    x = ufl.SpatialCoordinate(V.mesh)
    a = (inner(grad(u), grad(v)) + u * v + p[0].dx(1) * v) * dx
    a += (2.0 * inner(grad(p), grad(q)) + inner(p, q) - 3.0 * u * q[1]) * dx
    return a, x[0] * v * dx + (q[0] - x[1] * q[1]) * dx


# ---- The same as in one space


@EACH_LINEAR
def test_two_fields_are_a_vector_field(make: Maker) -> None:
    # Two coupled reaction-diffusion equations.
    V = square()
    Q = on_mesh_of(V)
    Y = on_mesh_of(V, (2,))
    x = ufl.SpatialCoordinate(V.mesh)

    def forms(u: Any, w: Any, v: Any, y: Any) -> tuple[ufl.Form, ufl.Form]:
        a = (inner(grad(u), grad(v)) + (2.0 * u - w) * v + 3.0 * inner(grad(w), grad(y)) + (w + 4.0 * u) * y) * dx
        return a, (x[0] * v + ufl.exp(x[1]) * y) * dx

    y, z = ufl.TrialFunction(Y), ufl.TestFunction(Y)
    vector = scipy.LinearProblem(*forms(*y, *z), bcs=[fixed(Y, ufl.as_vector([x[0], -x[1]]))]).solve()
    W = ufl.MixedFunctionSpace(V, Q)
    u, w = make(
        *forms(*ufl.TrialFunctions(W), *ufl.TestFunctions(W)), bcs=[[fixed(V, x[0])], [fixed(Q, -x[1])]]
    ).solve()
    fields = np.column_stack([u.x.array, w.x.array]).ravel()
    np.testing.assert_allclose(fields, vector.x.array, atol=1e-9)


@EACH_LINEAR
def test_biharmonic_equation_as_two_of_second_order(make: Maker) -> None:
    # sigma = -div(grad(u)), -div(grad(sigma)) = f, both zero on the boundary: u = sin(pi x) sin(pi y).
    errors = []
    for n in (4, 8):
        V = square(n=n)
        Q = on_mesh_of(V)
        u, sigma = ufl.TrialFunction(V), ufl.TrialFunction(Q)
        v, tau = ufl.TestFunction(V), ufl.TestFunction(Q)
        x = ufl.SpatialCoordinate(V.mesh)
        exact = ufl.sin(np.pi * x[0]) * ufl.sin(np.pi * x[1])
        a = [[inner(grad(u), grad(v)) * dx, -sigma * v * dx], [None, inner(grad(sigma), grad(tau)) * dx]]
        L = [None, 4.0 * np.pi**4 * exact * tau * dx]
        uh, sigma_h = make(a, L, bcs=[[fixed(V)], [fixed(Q)]]).solve()
        both = ((uh, exact), (sigma_h, 2.0 * np.pi**2 * exact))
        errors.append([np.sqrt(fem.assemble_scalar(fem.form((f - g) ** 2 * dx))) for f, g in both])
    rates = np.log2(np.divide(*errors))
    assert ((3.7 < rates) & (rates < 4.7)).all()  # 4 in theory
    assert errors[-1][0] < 2e-5  # of 0.5


@pytest.mark.parametrize("make", [LINEAR["scipy"], LINEAR["mpi"]], ids=["scipy", "mpi"])
def test_saddle_points(make: Maker) -> None:
    # -div(grad(u)) = f as a first-order system: (sigma, tau) + (div(tau), u) = 0, (div(sigma), v) = -(f, v), sigma two
    # components on a finer hierarchy than u. The block of u and v is zero; of the solution sigma = grad(u) holds.
    V = square(n=4)
    S = uniformly_refined(on_mesh_of(V, (2,)))
    x = ufl.SpatialCoordinate(V.mesh)
    exact = x[0] * (1.0 - x[0]) * x[1] * (1.0 - x[1])
    W = ufl.MixedFunctionSpace(S, V)
    (sigma, u), (tau, v) = ufl.TrialFunctions(W), ufl.TestFunctions(W)
    a = (inner(sigma, tau) + div(tau) * u + div(sigma) * v) * dx
    sigma_h, u_h = make(a, div(grad(exact)) * v * dx).solve()
    assert fem.assemble_scalar(fem.form((u_h - exact) ** 2 * dx)) < 1e-4**2
    assert fem.assemble_scalar(fem.form((sigma_h - grad(exact)) ** 2 * dx)) < 1e-3**2


def uniformly_refined(V: FunctionSpace) -> FunctionSpace:
    return adapt.refine(V, np.arange(V.num_functions))


# ---- Different spaces


@EACH_LINEAR
@pytest.mark.parametrize("finer", ["first", "second", "neither"])
def test_solutions_are_those_of_the_dense_system(make: Maker, finer: str) -> None:
    V = square()
    V, Q = on_mesh_of(V, (), (0, 9) if finer == "first" else ()), on_mesh_of(V, (2,), (3,) if finer == "second" else ())
    a, L = coupled(V, Q)
    bcs = [fixed(V, 1.0), fem.dirichletbc(0.5, fem.boundary_dofs(Q), Q.sub(1))]
    u, p = make(a, L, bcs=bcs).solve()
    finest = V if finer == "first" else Q
    A = np.block(
        [[fem.assemble_matrix(f).toarray() for f in row] for row in fem.form(ufl.extract_blocks(a), on=finest)]
    )
    b = np.concatenate([fem.assemble_vector(f) for f in fem.form(ufl.extract_blocks(L), on=finest)])
    dofs = np.concatenate([bcs[0].dofs, V.num_dofs + bcs[1].dofs])
    A[dofs] = np.eye(b.size)[dofs]
    b[dofs] = np.concatenate([bc.values for bc in bcs])
    np.testing.assert_allclose(np.concatenate([u.x.array, p.x.array]), np.linalg.solve(A, b), atol=1e-9)


def test_all_blocks_are_integrated_on_the_finest_cells() -> None:
    V = square()
    Q = on_mesh_of(V, (2,), (3,))
    system = LinearSystem(*coupled(V, Q))
    forms = [block for row in [*system.a, system.L] for block in row if block is not None]
    assert len(forms) == 6
    assert all(block.cells is Q.integration_cells for block in forms)


def test_spaces_that_are_not_nested_may_stand_side_by_side() -> None:
    V = square()
    V, Q = on_mesh_of(V, (), (0,)), on_mesh_of(V, (), (40,))
    (u, v), (p, q) = ((ufl.TrialFunction(X), ufl.TestFunction(X)) for X in (V, Q))
    found = scipy.LinearProblem([[u * v * dx, None], [None, p * q * dx]], [2.0 * v * dx, 3.0 * q * dx]).solve()
    for function, value in zip(found, (2.0, 3.0), strict=True):
        np.testing.assert_allclose(function.x.array, value, rtol=1e-10)


# The blocks on the diagonal are singular as well: they cannot be factorised.
ITERATED = {**SPLIT, "fieldsplit_pc_type": "jacobi"}


@pytest.mark.parametrize(
    "make", [LINEAR["scipy"], LINEAR["mpi"], petsc("nest", ITERATED)], ids=["scipy", "mpi", "nest"]
)
def test_constants_of_each_field_on_closed_surfaces(make: Maker) -> None:
    V = fem.functionspace(generators.torus((8, 6)), ("THCCS", 3))
    Q = on_mesh_of(V, (), (0, 3))
    (u, v), (p, q) = ((ufl.TrialFunction(X), ufl.TestFunction(X)) for X in (V, Q))
    x = ufl.SpatialCoordinate(V.mesh)
    laplace = inner(grad(u), grad(v)) * dx
    a = [[laplace, 0.5 * inner(grad(p), grad(v)) * dx], [None, inner(grad(p), grad(q)) * dx]]
    L = [x[2] * v * dx, x[1] * q * dx]
    uh, ph = make(a, L).solve()
    for function in (uh, ph):
        assert abs(fem.assemble_scalar(fem.form(function * dx))) < 1e-10
    scalar = scipy.LinearProblem(a[1][1], L[1]).solve()
    np.testing.assert_allclose(ph.x.array, scalar.x.array, atol=1e-9)
    # With the mass of one field, only the other has a constant.
    a[0][0] = laplace + u * v * dx
    assert abs(fem.assemble_scalar(fem.form(make(a, L).solve()[1] * dx))) < 1e-10
    system = LinearSystem(a, L)
    system.assemble()
    assert system.constants is not None
    assert set(system.constants.number[: V.num_dofs]) == {-1}
    assert set(system.constants.number[V.num_dofs :]) == {0}


# ---- Nonlinear


def reaction(V: FunctionSpace, Q: FunctionSpace) -> tuple[ufl.Form, list[fem.Function]]:
    """Return the residual of two fields, of which the first one diffuses the faster the larger the second one is."""
    u, p = fem.Function(V), fem.Function(Q)
    v, q = ufl.TestFunctions(ufl.MixedFunctionSpace(V, Q))
    x = ufl.SpatialCoordinate(V.mesh)
    F = (inner((1.0 + p[0] ** 2) * grad(u), grad(v)) - x[0] * v + inner(grad(p), grad(q)) + inner(p, q)) * dx
    return F + (u**2 * q[0] - 5.0 * p[1] * u * q[1] - 4.0 * q[0] - q[1]) * dx, [u, p]


@EACH_NONLINEAR
@pytest.mark.parametrize("refined", [(), (3, 20)], ids=["equal", "finer"])
def test_nonlinear_fields(make: Maker, refined: tuple[int, ...]) -> None:
    V = square()
    Q = on_mesh_of(V, (2,), refined)
    F, (u, p) = reaction(V, Q)
    bcs = [fixed(V, 0.3), fixed(Q, ufl.as_vector([0.2, ufl.SpatialCoordinate(V.mesh)[0]]))]
    problem = make(F, [u, p], bcs=bcs)
    assert problem.solve() == [u, p]
    norms = np.array(problem.norms)
    assert norms.size <= 6
    assert norms[-1] < 1e-9 * norms[0]
    residuals = [fem.assemble_vector(f) for f in problem.F]
    for residual, bc in zip(residuals, bcs, strict=True):
        assert np.linalg.norm(np.delete(residual, bc.dofs)) <= 1e-10 * norms[0]  # that is where it stops
        assert np.abs(residual[bc.dofs]).max() > 1e-3
    np.testing.assert_array_equal(u.x.array[bcs[0].dofs], 0.3)


def test_nonlinear_fields_agree() -> None:
    V = square()
    found = []
    for name in ("scipy", "mpi", "nest"):
        F, unknowns = reaction(V, on_mesh_of(V, (2,), (3,)))
        bcs = [fixed(function.function_space) for function in unknowns]
        NONLINEAR[name](list(ufl.extract_blocks(F)), unknowns, bcs=bcs).solve()
        found.append(np.concatenate([function.x.array for function in unknowns]))
    np.testing.assert_allclose(found[1], found[0], atol=1e-9)
    np.testing.assert_allclose(found[2], found[0], atol=1e-9)


def test_jacobians_of_fields_are_derivatives() -> None:
    V = square()
    F, unknowns = reaction(V, on_mesh_of(V, (2,), (3,)))
    system = NonlinearSystem(F, unknowns)
    rng = np.random.default_rng(0)
    x = system.start() + rng.standard_normal(system.layout.num_dofs)
    direction, t = rng.standard_normal(x.size), 1e-6
    difference = (system.residual(x + t * direction) - system.residual(x - t * direction)) / (2 * t)
    np.testing.assert_allclose(system.jacobian(x) @ direction, difference, atol=1e-7 * np.abs(difference).max())


def test_fields_that_are_independent_have_no_jacobian_between_them() -> None:
    V = square()
    u, p = fem.Function(V), fem.Function(V)
    v = ufl.TestFunction(V)
    system = NonlinearSystem([u**3 * v * dx, (p + u) * v * dx], [u, p])
    assert [[block is None for block in row] for row in system.jacobians] == [[False, True], [False, False]]


# ---- Matrices


def test_whole_matrices_are_their_blocks() -> None:
    V = square()
    a, L = coupled(V, on_mesh_of(V, (2,), (3,)))
    k = fem.Constant(V.mesh, 1.0)
    system = LinearSystem([[k * block if block else None for block in row] for row in ufl.extract_blocks(a)], L)
    matrix = system.matrix
    expected = sp.block_array(matrix.blocks).toarray()
    np.testing.assert_array_equal(matrix.whole.toarray(), expected)
    values, data = matrix.whole, matrix.whole.data
    k.value = 2.0
    system.assemble()
    np.testing.assert_allclose(system.A.toarray(), 2.0 * expected, rtol=1e-14)
    assert system.A is values
    assert system.A.data is data
    data[:] = np.arange(data.size)
    matrix.scatter()
    np.testing.assert_array_equal(sp.block_array(matrix.blocks).toarray(), matrix.whole.toarray())


def test_nested_matrices_have_the_values_of_the_last_solution() -> None:
    pytest.importorskip("petsc4py")
    V = square()
    Q = on_mesh_of(V, (2,), (3,))
    W = ufl.MixedFunctionSpace(V, Q)
    (u, p), (v, q) = ufl.TrialFunctions(W), ufl.TestFunctions(W)
    k = fem.Constant(V.mesh, 1.0)
    a, L = (k * u * v + k * inner(p, q) + u * q[0]) * dx, 2.0 * v * dx + q[1] * dx
    problem = LINEAR["nest"](a, L, bcs=[fixed(Q)])
    for value in (1.0, 4.0):
        k.value = value
        uh, ph = problem.solve()
        assert problem.A.getType() == "nest"
        x = problem.A.createVecRight()
        x.setArray(np.concatenate([uh.x.array, ph.x.array]))
        np.testing.assert_allclose((problem.A * x).getArray(), problem.b.array, atol=1e-10)
        np.testing.assert_allclose(uh.x.array, 2.0 / value, rtol=1e-9)


def test_loads_are_added() -> None:
    V = square()
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    a, L = (inner(grad(u), grad(v)) + u * v) * dx, fem.Constant(V.mesh, 0.0) * v * dx
    load = fem.assemble_vector(fem.form(3.0 * v * dx))
    for make in (LINEAR["scipy"], LINEAR["mpi"]):
        problem = make(a, L, load=load)
        np.testing.assert_allclose(problem.solve().x.array, 3.0, rtol=1e-10)
        problem.load = 2.0 * load
        np.testing.assert_allclose(problem.solve().x.array, 6.0, rtol=1e-10)
        problem.load = None
        np.testing.assert_allclose(problem.solve().x.array, 0.0, atol=1e-10)
        bc = fixed(V, 3.0)
        np.testing.assert_allclose(make(a, L, load=load, bcs=[bc]).solve().x.array, 3.0, rtol=1e-10)
        with pytest.raises(ValueError, match=r"load has shape \(3,\), but there are 49 dofs: give \(49,\)"):
            make(a, L, load=np.ones(3)).solve()


def test_forms_are_compiled_in_lists() -> None:
    V = square()
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    compiled = fem.form([[u * v * dx, None], [None, inner(grad(u), grad(v)) * dx]])
    assert [[block is None for block in row] for row in compiled] == [[False, True], [True, False]]
    assert compiled[1][1].rank == 2
    found = scipy.LinearProblem(compiled, fem.form([v * dx, None]), bcs=[[], [fixed(V, 2.0)]]).solve()
    np.testing.assert_allclose(np.array([f.x.array for f in found]), [[1.0] * 49, [2.0] * 49], rtol=1e-10)


def test_one_unknown_may_be_in_a_list() -> None:
    V = square()
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    (found,) = scipy.LinearProblem([[u * v * dx]], [v * dx]).solve()
    np.testing.assert_allclose(found.x.array, 1.0, rtol=1e-10)
    u = fem.Function(V)
    u.x.array = 1.0
    problem = scipy.NonlinearProblem([(u**3 - 8.0) * v * dx], [u])
    assert problem.solve() == [u]
    assert [problem.F[0].rank, problem.J[0][0].rank] == [1, 2]
    np.testing.assert_allclose(u.x.array, 2.0, rtol=1e-9)


# ---- What is refused


def test_forms_that_do_not_fit() -> None:
    V = square()
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    m, L = u * v * dx, v * dx
    with pytest.raises(ValueError, match=r"a has 2 rows of \[2, 1\] blocks"):
        LinearSystem([[m, None], [m]], [L, L])
    with pytest.raises(ValueError, match="there are 2 equations, but 1 linear forms"):
        LinearSystem([[m, None], [None, m]], [L])
    with pytest.raises(ValueError, match="row or column 1 of a has no form"):
        LinearSystem([[m, m], [None, None]], [L, L])
    with pytest.raises(ValueError, match=r"a\[1\] has 2 arguments and L\[1\] has 2"):
        LinearSystem([[m, None], [None, m]], [L, m])
    with pytest.raises(ValueError, match="there are 1 unknowns u for 2 trial functions"):
        LinearSystem([[m, None], [None, m]], [L, L], u=[fem.Function(V)])
    other = ufl.TestFunction(on_mesh_of(V, (), (0,))) * dx
    with pytest.raises(ValueError, match=r"the trial function of a\[1\] is in .* an equation needs the same space"):
        LinearSystem([[m, None], [None, m]], [L, other])


@pytest.mark.parametrize(("kind", "unknowns"), [("nest", 1), ("aij", 2)])
def test_kinds_that_are_refused(kind: str, unknowns: int) -> None:
    V = square()
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    a = [[u * v * dx if i == j else None for j in range(unknowns)] for i in range(unknowns)]
    with pytest.raises(ValueError, match=f"kind is '{kind}'; it must be"):
        petsc(kind)(a, [v * dx] * unknowns).solve()
