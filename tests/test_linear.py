"""What all solvers share: Dirichlet conditions in a system, constants that nothing fixes, and checks of solutions."""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st
from zoo import ZOO

import ufl
from thccs_fem import adapt, fem, generators
from thccs_fem.fem.layout import Layout
from thccs_fem.fem.linear import (
    PRESCRIBED,
    VANISHING,
    Constants,
    LinearSystem,
    check_regular,
    check_residual,
    constrain,
    constraints,
    drops_constants,
    is_fourth_order,
    is_symmetric,
    unfixed_constants,
)
from thccs_fem.fem.space import FunctionSpace
from ufl import as_vector, div, dot, dx, grad, inner

Floats = npt.NDArray[np.float64]


def torus(shape: tuple[int, ...] = ()) -> FunctionSpace:
    return fem.functionspace(generators.torus((6, 5)), ("THCCS", 3, shape))


def square(shape: tuple[int, ...] = ()) -> FunctionSpace:
    return fem.functionspace(generators.rectangle((3, 3)), ("THCCS", 3, shape))


def arguments(V: FunctionSpace) -> tuple[ufl.Argument, ufl.Argument]:
    return ufl.TrialFunction(V), ufl.TestFunction(V)


def laplace(V: FunctionSpace) -> ufl.Form:
    u, v = arguments(V)
    return inner(grad(u), grad(v)) * dx


def zero_load(V: FunctionSpace) -> ufl.Form:
    v = ufl.TestFunction(V)
    return inner(fem.Constant(V.mesh, np.zeros(V.value_shape)), v) * dx


def constants_of(form: ufl.Form) -> Constants | None:
    compiled = fem.form(form)
    spaces = compiled.spaces[1:]
    tolerance = np.where(drops_constants([[compiled]], spaces), PRESCRIBED, VANISHING)
    return unfixed_constants(fem.assemble_matrix(compiled), Layout(spaces), tolerance)


def drops(form: ufl.Form) -> list[bool]:
    compiled = fem.form(form)
    return drops_constants([[compiled]], compiled.spaces[1:]).tolist()


def matrix(form: ufl.Form) -> sp.csr_array:
    return fem.assemble_matrix(fem.form(form))


def with_rows_of_the_identity(A: Floats, dofs: npt.NDArray[np.int32]) -> Floats:
    """Return A with rows and columns of dofs those of the identity, the slow way."""
    A = A.copy()
    for dof in dofs:
        A[dof, :] = A[:, dof] = 0.0
        A[dof, dof] = 1.0
    return A


# ---- Conditions


@given(st.lists(st.lists(st.tuples(st.integers(0, 29), st.floats(-9, 9)), max_size=5), max_size=4))
def test_the_later_of_two_conditions_holds(prescribed: list[list[tuple[int, float]]]) -> None:
    V = torus()
    expected: dict[int, float] = {}
    bcs = []
    for pairs in prescribed:
        unique = dict(pairs)
        bcs.append(fem.dirichletbc(list(unique.values()), list(unique), V))
        expected.update(unique)
    dofs, values = constraints(bcs, V)
    assert dict(zip(dofs.tolist(), values.tolist(), strict=True)) == expected
    assert (np.diff(dofs) > 0).all()
    assert dofs.dtype == np.int32


def test_rows_and_columns_become_those_of_the_identity() -> None:
    V = torus((2,))
    u, v = arguments(V)
    A = matrix((inner(grad(u), grad(v)) + u[0].dx(1) * v[1]) * dx)  # not symmetric
    dofs = np.array([0, 7, 8, 59], dtype=np.int32)
    before, data = A.toarray(), A.data
    constrain(A, dofs)
    np.testing.assert_array_equal(A.toarray(), with_rows_of_the_identity(before, dofs))
    assert A.data is data


def test_symmetric_matrices_stay_symmetric() -> None:
    V = square()
    A = matrix(laplace(V))
    constrain(A, fem.boundary_dofs(V))
    assert is_symmetric(A)
    assert np.linalg.eigvalsh(A.toarray())[0] > 0.0


def test_the_system_is_that_of_its_free_dofs() -> None:
    V = square()
    x, v = ufl.SpatialCoordinate(V.mesh), ufl.TestFunction(V)
    a, L = laplace(V), (1 + x[0]) * v * dx
    bcs = [fem.dirichletbc(x[0] * x[1], fem.boundary_dofs(V), V), fem.dirichletbc(5.0, [0, 9], V)]
    system = LinearSystem(a, L, bcs=bcs)
    system.assemble()
    dofs, values = constraints(bcs, V)
    free = np.setdiff1d(np.arange(V.num_dofs), dofs)
    A, b = matrix(a).toarray(), fem.assemble_vector(fem.form(L))
    np.testing.assert_allclose(system.b[free], b[free] - A[np.ix_(free, dofs)] @ values, rtol=1e-12, atol=1e-14)
    np.testing.assert_array_equal(system.b[dofs], values)
    np.testing.assert_array_equal(system.A.toarray(), with_rows_of_the_identity(A, dofs))
    assert system.constants is None
    assert system.regular() is system.A


def test_systems_are_assembled_anew_in_the_same_memory() -> None:
    V = torus()
    u, v = arguments(V)
    k, f = fem.Constant(V.mesh, 2.0), fem.Constant(V.mesh, 3.0)
    system = LinearSystem(k * u * v * dx, f * v * dx)
    A, data, b = system.A, system.A.data, system.b
    first = A.toarray()
    k.value, f.value = 4.0, 9.0
    system.bcs = [fem.dirichletbc(1.0, [3], V)]
    system.assemble()
    assert system.A is A
    assert A.data is data
    assert system.b is b
    np.testing.assert_allclose(A.toarray(), with_rows_of_the_identity(2 * first, np.array([3])), rtol=1e-14)
    system.bcs = []
    system.assemble()
    np.testing.assert_allclose(A.toarray(), 2 * first, rtol=1e-14)
    np.testing.assert_allclose(b, fem.assemble_vector(fem.form(f * v * dx)), rtol=1e-14)


def test_prescribed_values_are_exact_in_the_solution() -> None:
    V = torus()
    system = LinearSystem(laplace(V), zero_load(V), bcs=[fem.dirichletbc(0.1, [3, 4], V)])
    system.assemble()
    u = system.accept(np.arange(30.0))
    assert u is system.u
    assert u.x.array[[2, 3, 4, 5]].tolist() == [2.0, 0.1, 0.1, 5.0]


# ---- What is refused


def test_forms_in_the_wrong_places_are_refused() -> None:
    V = torus()
    with pytest.raises(ValueError, match="a has 1 arguments and L has 2: a is the bilinear form"):
        LinearSystem(zero_load(V), laplace(V))


def test_forms_on_different_spaces_are_refused() -> None:
    V = torus()
    V2 = adapt.refine(V, [0])
    mixed = ufl.TrialFunction(V) * ufl.TestFunction(V2) * dx
    for a, L in ((laplace(V), zero_load(V2)), (mixed, zero_load(V2))):
        with pytest.raises(ValueError, match="an equation needs the same space for all three"):
            LinearSystem(a, L)


def test_unknowns_in_other_spaces_are_refused() -> None:
    V = torus()
    with pytest.raises(ValueError, match=r"u is in .* but the trial function in"):
        LinearSystem(laplace(V), zero_load(V), u=fem.Function(adapt.refine(V, [0])))


def test_conditions_on_other_spaces_are_refused() -> None:
    V = torus()
    other = fem.dirichletbc(0.0, [0], adapt.refine(V, [0]))
    with pytest.raises(ValueError, match=r"a condition is on .* but the unknown is in"):
        LinearSystem(laplace(V), zero_load(V), bcs=[other])


def test_what_is_no_list_of_conditions_is_refused() -> None:
    V = torus()
    bc = fem.dirichletbc(0.0, [0], V)
    with pytest.raises(TypeError, match=r"bcs is a single condition: give a list, bcs=\[bc\]"):
        LinearSystem(laplace(V), zero_load(V), bcs=bc)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="bcs holds a float"):
        LinearSystem(laplace(V), zero_load(V), bcs=[bc, 0.0])  # type: ignore[list-item]


# ---- Constants in the kernel


@pytest.mark.filterwarnings("ignore:the form has second derivatives")  # on shallow caps: deep ones hide kernels
@pytest.mark.parametrize("times", [0, 3])
@pytest.mark.parametrize("order", [2, 4])
@pytest.mark.parametrize("name", [name for name, make in ZOO.items() if make().gdim == 3])
def test_constants_are_found_on_all_surfaces(name: str, order: int, times: int) -> None:
    V = fem.functionspace(ZOO[name](), ("THCCS", 3))
    for _ in range(times):
        V = adapt.refine(V, [0, V.num_functions - 1])
    u, v = arguments(V)
    a = laplace(V) if order == 2 else div(grad(u)) * div(grad(v)) * dx
    constants = constants_of(a)
    assert constants is not None
    assert constants.num_constants == V.mesh.num_components
    assert constants_of(a + 1e-6 * u * v * dx) is None


def test_constants_are_found_if_a_coefficient_makes_them() -> None:
    V = torus()
    u, v = arguments(V)
    c, f = fem.Constant(V.mesh, 0.0), fem.Function(V)
    assert not any(drops(laplace(V) + c * u * v * dx))
    assert constants_of(laplace(V) + (c + f) * u * v * dx) is not None
    c.value = 1e-9
    assert constants_of(laplace(V) + (c + f) * u * v * dx) is None


def test_forms_say_whether_they_drop_constants() -> None:
    V = torus((2,))
    w = fem.Function(V)
    u, v = arguments(V)
    x = ufl.SpatialCoordinate(V.mesh)
    one_sided = inner(grad(u) * as_vector([x[2], x[0], 1.0]), v) * dx
    energy = (inner(grad(w), grad(w)) ** 2 + w[0] ** 2) * dx
    cases = [
        (laplace(V) + inner(div(grad(u)), div(grad(v))) * dx, [True, True]),
        (laplace(V) + u[1] * v[1] * dx, [True, False]),
        (laplace(V) + one_sided, [False, False]),
        (ufl.adjoint(laplace(V) + one_sided), [False, False]),
        (ufl.derivative(ufl.derivative(energy, w, v), w, u), [False, True]),
    ]
    for form, expected in cases:
        assert drops(form) == expected


def test_forms_of_fourth_order_are_recognised() -> None:
    V = torus((2,))
    u, v = arguments(V)
    w = fem.Function(V)
    cases = [
        (inner(div(grad(u)), div(grad(v))) * dx, True),
        (inner(div(grad(u)), v) * dx, True),
        (laplace(V), False),
        (inner(div(grad(w)), u) * w[0] * v[0] * dx, False),
    ]
    for form, expected in cases:
        assert is_fourth_order([[None], [fem.form(form)]]) is expected


def test_each_component_has_its_constant() -> None:
    V = torus((3,))
    constants = constants_of(laplace(V))
    assert constants is not None
    assert constants.number.tolist() == [0, 1, 2] * 30


def test_components_that_are_coupled_have_none() -> None:
    V = torus((2,))
    u, v = arguments(V)
    difference = (u[0] - u[1]) * (v[0] - v[1]) * dx  # (1, 1) is in the kernel, but not what is looked for
    assert constants_of(laplace(V) + difference) is None


def test_components_that_are_prescribed_have_none() -> None:
    V = torus((2,))
    system = LinearSystem(laplace(V), zero_load(V), bcs=[fem.dirichletbc(1.0, [4], V.sub(0))])
    system.assemble()
    assert system.constants is not None
    assert system.constants.number.tolist() == [-1, 0] * 30


def test_parts_of_the_surface_have_their_own() -> None:
    V = fem.functionspace(ZOO["cube_and_torus"](), ("THCCS", 3))
    far = V.reference_points[:, 0] > 5.0
    system = LinearSystem(laplace(V), zero_load(V))
    system.assemble()
    assert system.constants is not None
    assert len(set(system.constants.number[far])) == len(set(system.constants.number[~far])) == 1
    assert set(system.constants.number) == {0, 1}
    system.bcs = [fem.dirichletbc(2.0, np.flatnonzero(far)[:1], V)]
    system.assemble()
    assert system.constants is not None
    np.testing.assert_array_equal(system.constants.number, np.where(far, -1, 0))


def test_convection_with_divergence_has_no_constants() -> None:
    # Constants solve the homogeneous equation, but are not what loads must be orthogonal to.
    V = torus()
    u, v = arguments(V)
    x = ufl.SpatialCoordinate(V.mesh)
    assert constants_of(laplace(V) + dot(as_vector([x[2], x[0], 1.0]), grad(u)) * v * dx) is None


def test_integrals_and_areas() -> None:
    V = torus((2,))
    constants = constants_of(laplace(V))
    assert constants is not None
    area = fem.assemble_scalar(fem.form(fem.Constant(V.mesh, 1.0) * dx))
    np.testing.assert_allclose(constants.areas, [area, area], rtol=1e-13)
    x = np.random.default_rng(0).random(V.num_dofs)
    u = fem.Function(V)
    u.x.array = constants.with_mean_zero(x)
    means = [fem.assemble_scalar(fem.form(u[c] * dx)) / area for c in range(2)]
    np.testing.assert_allclose(means, 0.0, atol=1e-14)
    shift = (x - u.x.array).reshape(-1, 2)
    np.testing.assert_allclose(shift, np.broadcast_to(shift[0], shift.shape), rtol=1e-13)


@pytest.mark.parametrize("mean", [-2.0, 1e-4])
def test_loads_with_a_mean_are_named_with_it(mean: float) -> None:
    V = torus()
    x, v = ufl.SpatialCoordinate(V.mesh), ufl.TestFunction(V)
    area = fem.assemble_scalar(fem.form(fem.Constant(V.mesh, 1.0) * dx))
    centre = fem.assemble_scalar(fem.form(x[0] * dx)) / area
    system = LinearSystem(laplace(V), (x[0] - centre + mean) * v * dx)
    with pytest.raises(ValueError, match="constants are in the kernel of the bilinear form") as raised:
        system.assemble()
    named = float(str(raised.value).split("the mean of the load is ")[1].split()[0])
    assert named == pytest.approx(mean, rel=1e-9)
    LinearSystem(laplace(V), (x[0] - centre + mean - named) * v * dx).assemble()  # as the message says


def test_loads_may_be_rounding_of_other_components() -> None:
    # The third component has nothing but rounding, whose mean is not small against itself.
    V = torus((3,))
    noise = np.zeros(V.num_dofs)
    noise[2::3] = 1e-17
    v = ufl.TestFunction(V)
    x = ufl.SpatialCoordinate(V.mesh)
    first = [fem.dirichletbc(0.0, [0], V.sub(c)) for c in (0, 1)]
    system = LinearSystem(laplace(V), inner(x, ufl.as_vector([1.0, 2.0, 0.0])) * (v[0] + v[1]) * dx, bcs=first)
    system.load = noise
    system.assemble()
    assert system.constants is not None
    assert system.constants.num_constants == 1
    system.load = 1e6 * noise  # 1e-11 is no rounding of loads of 1
    with pytest.raises(ValueError, match="there is no solution"):
        system.assemble()


def test_loads_of_one_unknown_are_no_rounding_of_those_of_another() -> None:
    V = torus()
    u, w = ufl.TrialFunction(V), ufl.TestFunction(V)
    a = [[inner(grad(u), grad(w)) * dx, None], [None, inner(grad(u), grad(w)) * dx + u * w * dx]]
    tiny = fem.Constant(V.mesh, 1e-15)
    with pytest.raises(ValueError, match="there is no solution"):
        LinearSystem(a, [tiny * w * dx, fem.Constant(V.mesh, 1.0) * w * dx]).assemble()


def test_loads_of_components_are_named_with_all_means() -> None:
    V = torus((2,))
    system = LinearSystem(laplace(V), 3.0 * ufl.TestFunction(V)[1] * dx)
    with pytest.raises(ValueError, match=r"the mean of the load is 0\.0, (3\.0|2\.99)\d* \(on each connected part"):
        system.assemble()


def test_what_quadrature_leaves_of_a_mean_is_cleared() -> None:
    V = torus()
    x, v = ufl.SpatialCoordinate(V.mesh), ufl.TestFunction(V)
    system = LinearSystem(laplace(V), (x[2] + 1e-8) * v * dx)
    system.assemble()
    assert abs(system.b.sum()) < 1e-14 * np.abs(system.b).sum()


def test_pinned_matrices_are_regular_and_have_the_same_solutions() -> None:
    V = FunctionSpace(fem.functionspace(ZOO["cube_and_torus"](), ("THCCS", 3)).hierarchy, (2,))
    A = matrix(laplace(V))
    constants = constants_of(laplace(V))
    assert constants is not None
    assert constants.num_constants == 4
    pinned = constants.pinned(A)
    assert np.shares_memory(pinned.indices, A.indices)
    assert np.count_nonzero(pinned.data != A.data) == 4
    assert np.linalg.eigvalsh(A.toarray())[4] > 1e-4 > 1e-12 > abs(np.linalg.eigvalsh(A.toarray())[3])
    assert np.linalg.eigvalsh(pinned.toarray())[0] > 1e-4
    x = np.random.default_rng(0).random(V.num_dofs)
    solution = np.linalg.solve(pinned.toarray(), A @ x)
    np.testing.assert_allclose(constants.with_mean_zero(solution), constants.with_mean_zero(x), atol=1e-11)


# ---- Checks of solutions


def test_symmetry() -> None:
    V = torus()
    u, v = arguments(V)
    A = matrix(u * v * dx)
    assert is_symmetric(A)
    assert not is_symmetric(matrix((u + u.dx(0)) * v * dx))


@pytest.mark.filterwarnings("ignore:the form has second derivatives")  # on shallow caps: deep ones hide kernels
@pytest.mark.parametrize(
    ("form", "regular"),
    [
        (lambda u, v: (inner(grad(u), grad(v)) + u * v) * dx, True),
        (lambda u, v: (inner(grad(u), grad(v)) - u * v) * dx, True),  # indefinite
        (lambda u, v: 1e-9 * u * v * dx, True),  # small is not singular
        (lambda u, v: (1e-6 + ufl.SpatialCoordinate(u)[0] ** 8) * u * v * dx, True),  # nor is uneven
        (lambda u, v: inner(grad(u), grad(v)) * dx, False),
        (lambda u, v: div(grad(u)) * div(grad(v)) * dx, False),
    ],
)
@pytest.mark.parametrize("name", ["torus", "tripod", "pillow"])
def test_singular_matrices_show(form: Callable[..., ufl.Form], regular: bool, name: str) -> None:
    V = adapt.refine(fem.functionspace(ZOO[name](), ("THCCS", 3)), [0])
    A = matrix(form(*arguments(V)))
    factors = sp.linalg.splu(sp.csc_array(A))
    if regular:
        check_regular(A, factors.solve)
    else:
        with pytest.raises(RuntimeError, match="the matrix is singular to working precision"):
            check_regular(A, factors.solve)


def test_factors_without_values_are_singular() -> None:
    with pytest.raises(RuntimeError, match="condition number about nan"):
        check_regular(sp.csr_array(np.eye(3)), lambda b: b * np.nan)


def test_solutions_with_a_residual_are_refused() -> None:
    A, b = sp.csr_array(np.diag([1.0, 2.0, 4.0])), np.ones(3)
    check_residual(A, np.array([1.0, 0.5, 0.25]), b, "guessing")
    with pytest.raises(RuntimeError, match=r"guessing gave values that leave a residual of norm 2\.000e-03"):
        check_residual(A, np.array([1.0, 0.501, 0.25]), b, "guessing")
    with pytest.raises(RuntimeError, match="guessing gave values that are not finite"):
        check_residual(A, np.array([1.0, np.inf, 0.25]), b, "guessing")


def test_residuals_that_are_rounding_pass() -> None:
    # Large entries that cancel: nothing can do better.
    A = sp.csr_array(np.array([[1.0, -1.0], [-1.0, 1.0 + 1e-12]]) * 1e8)
    x = np.array([1.0, 1.0 + 1e-9])
    check_residual(A, x, A @ x + 1e-7, "elimination")
