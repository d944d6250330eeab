"""Assembly against closed forms, a slow path in numpy, and DOLFINx."""

import dataclasses
import functools
import gc
import weakref
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st

import basix.ufl
import ufl
from thccs_fem import element, fem, generators, jit
from thccs_fem.extraction import Batch, Cells
from thccs_fem.fem import sparsity
from thccs_fem.fem.forms import Form
from thccs_fem.fem.space import FunctionSpace
from thccs_fem.index_map import IndexMap
from thccs_fem.mesh import ControlMesh
from thccs_fem.partition import Partition
from ufl import div, dx, grad, inner

Floats = npt.NDArray[np.float64]


def refined(V: FunctionSpace, dofs: npt.ArrayLike) -> FunctionSpace:
    return V.with_hierarchy(V.hierarchy.refined(np.asarray(dofs)))


def randomly_refined(V: FunctionSpace, times: int = 2, seed: int = 0) -> FunctionSpace:
    rng = np.random.default_rng(seed)
    for _ in range(times):
        V = refined(V, rng.choice(V.num_functions, size=3, replace=False))
    return V


def with_random_values(V: FunctionSpace, seed: int = 0) -> fem.Function:
    function = fem.Function(V)
    function.x.array[:] = np.random.default_rng(seed).random(V.num_dofs)
    return function


def tagged(msh: ControlMesh) -> ControlMesh:
    return ControlMesh(msh.vertices, msh.quads, face_tags=np.arange(msh.num_faces) % 3)


ZOO: dict[str, Callable[[], FunctionSpace]] = {
    "torus": lambda: fem.functionspace(generators.torus((8, 6)), ("THCCS", 3)),
    "refined torus": lambda: randomly_refined(fem.functionspace(tagged(generators.torus((8, 8))), ("THCCS", 3))),
    "cube": lambda: fem.functionspace(tagged(generators.cube_sphere(2)), ("THCCS", 3)),
    "refined wheel": lambda: randomly_refined(fem.functionspace(tagged(generators.wheel(5, 3)), ("THCCS", 3))),
    "L, crease": lambda: fem.functionspace(tagged(generators.l_domain(2)), ("THCCS", 3), boundary="crease"),
}


@pytest.fixture(params=ZOO.values(), ids=ZOO, scope="module")
def V(request: pytest.FixtureRequest) -> FunctionSpace:
    return request.param()


# ---- The slow path: dense, a piece at a time, in Python


def slowly(form: Form) -> Floats:
    """Return what the form sums up to, as a dense array of shape (dofs, ...) on the form's cells."""
    block_sizes = [space.block_size for space in form.spaces]
    total = np.zeros([form.cells.num_dofs * bs for bs in block_sizes])
    for cell, dofs, operator, points in pieces(form.cells):
        maps = [np.zeros((16 * bs, form.cells.num_dofs * bs)) for bs in block_sizes]
        for bs, matrix in zip(block_sizes, maps, strict=True):
            for c in range(bs):
                np.add.at(matrix[c::bs].T, bs * dofs + c, operator.T)
        for integral in form.integrals:
            if integral.tag is None or form.cells.tag[cell] == integral.tag:
                tensor = tabulate(form, integral.kernel, dofs, operator, points)
                for matrix in maps:  # A -> C^T A; then, of its transpose, C^T (C^T A)^T
                    tensor = np.tensordot(tensor, matrix, axes=(0, 0))
                total += tensor
    return total


def pieces(cells: Cells) -> list[tuple[int, npt.NDArray[np.int32], Floats, Floats]]:
    """Return cell, dofs, operator and control points of each piece, without padding."""
    found = []
    for batch in cells.batches:
        for k, cell in enumerate(batch.cells):
            used = batch.dofs[k] >= 0
            for piece in range(batch.offsets[k], batch.offsets[k + 1]):
                operator = np.eye(16) if batch.operators is None else batch.operators[piece][:, used]
                found.append((cell, batch.dofs[k][used], operator, cells.points[batch.nodes[piece]]))
    return found


def tabulate(form: Form, kernel: object, dofs: npt.NDArray[np.int32], operator: Floats, points: Floats) -> Floats:
    """Call an FFCx kernel for one piece."""
    ffi = jit.library().ffi
    w = np.concatenate([np.zeros(0), *((operator @ values(form, f)[dofs]).ravel() for f in form.coefficients)])
    c = np.concatenate([np.zeros(0), *(constant.value.ravel() for constant in form.constants)])
    x = np.zeros((16, 3))
    x[:, : points.shape[1]] = points
    tensor = np.zeros([16 * space.block_size for space in form.spaces])
    pointers = [ffi.cast("double *", array.ctypes.data) for array in (tensor, w, c, x)]
    kernel(*pointers, ffi.NULL, ffi.NULL, ffi.NULL)
    return tensor


def values(form: Form, f: fem.Function) -> Floats:
    V = f.function_space
    transfer = form.transfers.get(V.hierarchy)
    array = f.x.array.reshape(-1, V.block_size)
    return array if transfer is None else transfer @ array


def fast(form: Form) -> Floats:
    if form.rank == 2:
        return fem.assemble_matrix(form).toarray()
    return fem.assemble_vector(form) if form.rank == 1 else np.array(fem.assemble_scalar(form))


def forms_on(V: FunctionSpace) -> dict[str, ufl.Form]:
    """Return forms of every kind: ranks, coefficients, constants, tags, block sizes."""
    W = FunctionSpace(V.hierarchy, (2,))
    u, v, U, Z = ufl.TrialFunction(V), ufl.TestFunction(V), ufl.TrialFunction(W), ufl.TestFunction(W)
    f, g = with_random_values(V, seed=1), with_random_values(W, seed=2)
    c, k = fem.Constant(V.mesh, [[2.0, 0.5], [0.25, 3.0]]), fem.Constant(V.mesh, 0.75)
    x = ufl.SpatialCoordinate(V.mesh)
    tag = int(V.mesh.face_tags.max())
    return {
        "scalar": f * g[1] * dx + x[0] * dx(tag, domain=V.mesh),
        "vector": f * v * dx + inner(grad(f), grad(v)) * dx(tag),
        "vector, two components": inner(ufl.dot(c, Z), g) * dx + Z[0].dx(0) * dx,
        "matrix": u * v.dx(0) * dx + k * f * inner(grad(u), grad(v)) * dx + g[0] * u * v * dx(tag),
        "matrix, two components": inner(ufl.dot(c, U), Z) * dx + f * U[0].dx(1) * Z[1] * dx,
        "matrix, scalar test and vector trial": inner(g, U) * v * dx(tag) + k * U[1] * v.dx(0) * dx,
        "matrix, vector test and scalar trial": u.dx(1) * Z[1] * dx,
    }


KINDS = list(forms_on(fem.functionspace(generators.torus((3, 3)), ("THCCS", 3))))


@pytest.mark.parametrize("kind", KINDS)
def test_all_kinds_of_forms_as_the_slow_path_does(V: FunctionSpace, kind: str) -> None:
    form = fem.form(forms_on(V)[kind])
    expected = slowly(form)
    assert np.abs(expected).max() > 0
    np.testing.assert_allclose(fast(form), expected, atol=1e-13 * np.abs(expected).max())  # sums in another order


@dataclass(eq=False)
class RandomCells:
    """Cells with operators that no hierarchy has: not monotone, with dofs in any order, some of them twice."""

    num_dofs: int
    num_cells: int
    tag: npt.NDArray[np.int32]
    points: Floats
    batches: tuple[Batch, ...]
    cell_dofs = Cells.cell_dofs
    num_owned = Cells.num_owned
    with_own_dofs = Cells.with_own_dofs

    @property
    def partition(self) -> Partition:
        return Partition(IndexMap.whole(self.num_cells), IndexMap.whole(self.num_dofs), 1.0)


def random_cells(num_dofs: int, width: int, num_cells: int = 7, seed: int = 0) -> RandomCells:
    rng = np.random.default_rng(seed)
    points = np.column_stack([grid.ravel() for grid in np.meshgrid(*2 * [np.arange(-1.0, 3.0)])])
    points = np.concatenate([points + 0.1 * rng.random((16, 2)) for _ in range(5)])  # invertible maps
    order = rng.permutation(num_cells).astype(np.int32)
    batches = []
    for cells, wide in ((order[:3], False), (order[3:], True)):
        w = width if wide else 16
        dofs = rng.integers(num_dofs, size=(len(cells), w)).astype(np.int32)
        counts = rng.integers(1, 4, size=len(cells)) if wide else np.ones(len(cells), dtype=int)
        operators = rng.standard_normal((counts.sum(), 16, w)) if wide else None
        offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
        if wide:
            for k in range(len(cells)):  # from none to all of the last eight columns are padding
                dofs[k, w - 2 * k :] = -1
                operators[offsets[k] : offsets[k + 1], :, w - 2 * k :] = 0.0
        nodes = (16 * rng.integers(5, size=counts.sum())[:, None] + np.arange(16)).astype(np.int32)
        batches.append(Batch(cells, dofs, offsets, nodes, operators))
    tag = (np.arange(num_cells) % 2).astype(np.int32)
    return RandomCells(num_dofs, num_cells, tag, points, tuple(batches))


@functools.cache
def form_on_a_grid(kind: str) -> Form:
    msh = generators.rectangle((4, 4))
    msh = ControlMesh(msh.vertices, msh.quads, face_tags=np.arange(msh.num_faces) % 2)
    return fem.form(forms_on(fem.functionspace(msh, ("THCCS", 3)))[kind])


@settings(max_examples=40)
@given(kind=st.sampled_from(KINDS), width=st.sampled_from([16, 24, 32, 40]), seed=st.integers(0, 2**32 - 1))
def test_random_operators_as_the_slow_path_does(kind: str, width: int, seed: int) -> None:
    form = form_on_a_grid(kind)
    form = dataclasses.replace(form, cells=random_cells(form.cells.num_dofs, width, seed=seed))
    expected = slowly(form)
    np.testing.assert_allclose(fast(form), expected, atol=1e-13 * np.abs(expected).max())  # sums in another order


def test_rows_too_long_for_8_bit_positions() -> None:
    """The row of a dof that shares cells with more than 256 others takes positions of 16 bits."""
    V = fem.functionspace(generators.rectangle((20, 20)), ("THCCS", 3))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    form = fem.form(u * v.dx(0) * dx)
    for width, dtype in ((24, np.uint8), (304, np.uint16)):
        form = dataclasses.replace(form, cells=random_cells(V.num_dofs, width))
        expected = slowly(form)
        np.testing.assert_allclose(fast(form), expected, atol=1e-13 * np.abs(expected).max())
        assert sparsity.pattern(form.cells, False).positions.dtype == dtype


# ---- Closed forms


def test_rows_of_interior_functions_of_a_uniform_grid() -> None:
    """Mass, stiffness and bending matrices are Kronecker products of the integrals of uniform cubic B-splines."""
    n = 9
    V = fem.functionspace(generators.rectangle((n, n)), ("THCCS", 3))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    h = 1 / n
    values = scipy.linalg.toeplitz([2416, 1191, 120, 1, *[0] * (n - 3)]) * h / 5040
    slopes = scipy.linalg.toeplitz([80, -15, -24, -1, *[0] * (n - 3)]) / h / 120
    bends = scipy.linalg.toeplitz([16, -9, 0, 1, *[0] * (n - 3)]) / h**3 / 6
    points = np.rint(V.reference_points * n).astype(int)
    at = np.full((n + 1, n + 1), -1)
    at[tuple(points.T)] = np.arange(V.num_dofs)
    inside = at[4:-4, 4:-4].ravel()  # their splines do not reach the functions that are altered at the rim
    whole = at[1:-1, 1:-1].ravel()
    cut = np.ix_(np.arange(4, n - 3), np.arange(1, n))

    def kron(a: Floats, b: Floats) -> Floats:
        return np.kron(a[cut], b[cut])

    cases = {
        u * v: kron(values, values),
        inner(grad(u), grad(v)): kron(slopes, values) + kron(values, slopes),
        div(grad(u)) * div(grad(v)): kron(bends, values) + 2 * kron(slopes, slopes) + kron(values, bends),
    }
    for integrand, expected in cases.items():
        actual = fem.assemble_matrix(fem.form(integrand * dx)).toarray()[np.ix_(inside, whole)]
        np.testing.assert_allclose(actual, expected, atol=1e-12 * np.abs(expected).max())  # 1/h^4 = 6561 times rounding


@pytest.mark.parametrize("gdim", [2, 3])
def test_polynomials_of_a_flat_patch(gdim: int) -> None:
    msh = generators.rectangle((3, 2))
    vertices = np.column_stack([msh.vertices, np.zeros((msh.num_vertices, gdim - 2))])
    msh = ControlMesh(vertices, msh.quads)
    x = ufl.SpatialCoordinate(msh)
    integrals = {1.0: 1.0, x[0] ** 3 * x[1]: 1 / 8, x[0] ** 7 * x[1] ** 6: 1 / 56}  # 4 points: exact to degree 7
    for integrand, expected in integrals.items():
        assert fem.assemble_scalar(fem.form(integrand * dx(domain=msh))) == pytest.approx(expected, rel=1e-13)


def test_partition_of_unity(V: FunctionSpace) -> None:
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    area = fem.assemble_scalar(fem.form(1.0 * dx(domain=V.mesh), on=V))
    mass, load = fem.assemble_matrix(fem.form(u * v * dx)), fem.assemble_vector(fem.form(v * dx))
    stiffness = fem.assemble_matrix(fem.form(inner(grad(u), grad(v)) * dx))
    ones = np.ones(V.num_dofs)
    np.testing.assert_allclose(mass @ ones, load, atol=1e-13 * load.max())
    assert load.sum() == pytest.approx(area, rel=1e-13)
    np.testing.assert_allclose(stiffness @ ones, 0.0, atol=1e-12 * abs(stiffness).max())  # 1e-15 times 200 neighbours


def test_integrals_over_cells_and_tags_add_up(V: FunctionSpace) -> None:
    f = with_random_values(V)
    whole = fem.assemble_cells(fem.form(f * dx))
    assert whole.shape == (V.num_cells,)
    assert fem.assemble_scalar(fem.form(f * dx)) == whole.sum()
    for tag in np.unique(V.mesh.face_tags):
        part = fem.assemble_cells(fem.form(f * dx(int(tag))))
        np.testing.assert_array_equal(part, np.where(V.cells.tag == tag, whole, 0.0))


# ---- DOLFINx


def test_as_dolfinx_does_on_the_pieces() -> None:
    """DOLFINx assembles on the pieces as cubic quadrilaterals that hang together nowhere; then C^T A C."""
    MPI = pytest.importorskip("mpi4py.MPI")
    dolfinx = pytest.importorskip("dolfinx")
    V = ZOO["refined wheel"]()
    equispaced = basix.LagrangeVariant.equispaced
    lagrange = basix.ufl.element("Lagrange", "quadrilateral", 3, lagrange_variant=equispaced)
    nodes = lagrange.basix_element.points
    at_nodes = element.bspline().tabulate(0, nodes)[0]  # B-spline coefficients -> values at the nodes
    ours = pieces(V.cells)
    points = np.concatenate([at_nodes @ p for *_, p in ours])
    geometry = basix.ufl.blocked_element(lagrange, shape=(V.mesh.gdim,))
    msh = dolfinx.mesh.create_mesh(MPI.COMM_SELF, np.arange(len(points)).reshape(-1, 16), geometry, points)
    Q = dolfinx.fem.functionspace(msh, lagrange)
    extraction = np.zeros((Q.dofmap.index_map.size_local, V.num_dofs))
    for c, original in enumerate(msh.topology.original_cell_index):
        _, dofs, operator, _ = ours[original]
        extraction[np.ix_(Q.dofmap.cell_dofs(c), dofs)] = at_nodes @ operator

    def integrand(space: ufl.FunctionSpace) -> ufl.Form:
        u, v = ufl.TrialFunction(space), ufl.TestFunction(space)
        x = ufl.SpatialCoordinate(space.ufl_domain())
        return (ufl.exp(x[0]) * inner(grad(u), grad(v)) + x[1] * u * v.dx(0)) * dx(metadata={"quadrature_degree": 7})

    expected = extraction.T @ dolfinx.fem.assemble_matrix(dolfinx.fem.form(integrand(Q))).to_dense() @ extraction
    actual = fem.assemble_matrix(fem.form(integrand(V))).toarray()
    np.testing.assert_allclose(actual, expected, atol=1e-12 * np.abs(expected).max())  # two bases, one quadrature


# ---- Spaces of several hierarchies


def test_coarser_functions_are_carried_over() -> None:
    coarse = ZOO["torus"]()
    fine = randomly_refined(coarse)
    P = fine.prolongation(coarse)
    u, v, U, Z = (make(S) for S in (coarse, fine) for make in (ufl.TrialFunction, ufl.TestFunction))
    f = with_random_values(coarse)
    on_fine = fem.Function(fine)
    on_fine.x.array[:] = P @ f.x.array
    A = fem.assemble_matrix(fem.form(on_fine * inner(grad(U), grad(Z)) * dx)).toarray()
    b = fem.assemble_vector(fem.form(on_fine**2 * Z * dx))
    scale = 1e-13 * np.abs(A).max()  # sums in another order
    np.testing.assert_allclose(fast(fem.form(f * inner(grad(U), grad(Z)) * dx)), A, atol=scale)
    np.testing.assert_allclose(fast(fem.form(f * inner(grad(u), grad(Z)) * dx)), A @ P, atol=scale)
    np.testing.assert_allclose(fast(fem.form(on_fine * inner(grad(U), grad(v)) * dx)), P.T @ A, atol=scale)
    np.testing.assert_allclose(fast(fem.form(on_fine * inner(grad(u), grad(v)) * dx)), P.T @ A @ P, atol=scale)
    np.testing.assert_allclose(fast(fem.form(f**2 * Z * dx)), b, atol=1e-13 * np.abs(b).max())
    np.testing.assert_allclose(fast(fem.form(on_fine**2 * v * dx)), P.T @ b, atol=1e-13 * np.abs(b).max())


def test_coarser_vector_valued_arguments_are_carried_over() -> None:
    coarse = fem.functionspace(generators.torus((8, 6)), ("THCCS", 3, (3,)))
    fine = randomly_refined(FunctionSpace(coarse.hierarchy))
    v, u = ufl.TestFunction(fine), ufl.TrialFunction(coarse)
    P = FunctionSpace(fine.hierarchy, (3,)).prolongation(coarse)
    U = ufl.TrialFunction(FunctionSpace(fine.hierarchy, (3,)))
    expected = fem.assemble_matrix(fem.form(u_dot(U) * v * dx)) @ P
    actual = fem.assemble_matrix(fem.form(u_dot(u) * v * dx))
    assert actual.shape == (fine.num_dofs, coarse.num_dofs)
    np.testing.assert_allclose(actual.toarray(), expected.toarray(), atol=1e-14 * abs(expected).max())


def u_dot(u: ufl.core.expr.Expr) -> ufl.core.expr.Expr:
    return u[0] + 2 * u[1] + 3 * u[2]


# ---- Matrices


def test_matrix_is_sorted_csr_of_int32(V: FunctionSpace) -> None:
    W = FunctionSpace(V.hierarchy, (2,))
    u, v, Z = ufl.TrialFunction(V), ufl.TestFunction(V), ufl.TestFunction(W)
    for integrand, shape in ((u * v, (1, 1)), (u * Z[1], (2, 1))):
        A = fem.assemble_matrix(fem.form(integrand * dx))
        assert A.shape == (V.num_dofs * shape[0], V.num_dofs * shape[1])
        assert (A.indptr.dtype, A.indices.dtype) == (np.int32, np.int32)
        for row in range(A.shape[0]):
            assert (np.diff(A.indices[A.indptr[row] : A.indptr[row + 1]]) > 0).all()


def test_pattern_is_all_pairs_of_dofs_that_share_a_cell(V: FunctionSpace) -> None:
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    expected = np.zeros((V.num_dofs, V.num_dofs), dtype=bool)
    for _, dofs, _, _ in pieces(V.cells):
        expected[np.ix_(dofs, dofs)] = True
    A = fem.assemble_matrix(fem.form(u * v * dx))
    A.data[:] = 1.0
    np.testing.assert_array_equal(A.toarray() != 0, expected)


@pytest.mark.parametrize("kind", ["matrix", "matrix, two components", "matrix, vector test and scalar trial"])
def test_refilling_writes_in_place(V: FunctionSpace, kind: str) -> None:
    form = fem.form(forms_on(V)[kind])
    A = fem.assemble_matrix(form)
    before, memory = A.copy(), A.data
    for f in form.coefficients:
        f.x.array[:] *= 2.0
    for c in form.constants:
        c.value = c.value + 1.0
    assert fem.assemble_matrix(A, form) is A
    assert A.data is memory
    np.testing.assert_array_equal(A.toarray(), fem.assemble_matrix(form).toarray())  # bit for bit
    if form.coefficients or form.constants:
        assert abs(A - before).max() > 0


def test_refilling_the_product_of_a_coarser_space() -> None:
    coarse = ZOO["torus"]()
    f = with_random_values(randomly_refined(coarse))
    form = fem.form(f * ufl.TrialFunction(coarse) * ufl.TestFunction(coarse) * dx)
    A = fem.assemble_matrix(form)
    memory, twice = A.data, 2 * A.data
    f.x.array[:] *= 2.0
    fem.assemble_matrix(A, form)
    assert A.data is memory
    np.testing.assert_array_equal(A.data, twice)  # powers of two are exact


def test_matrices_do_not_share_memory(V: FunctionSpace) -> None:
    form = fem.form(ufl.TrialFunction(V) * ufl.TestFunction(V) * dx)
    A, B = fem.assemble_matrix(form), fem.assemble_matrix(form)
    for name in ("data", "indices", "indptr"):
        assert not np.shares_memory(getattr(A, name), getattr(B, name))


def test_same_input_same_bits(V: FunctionSpace) -> None:
    for form in map(fem.form, forms_on(V).values()):
        np.testing.assert_array_equal(fast(form), fast(form))


def test_threads_do_not_disturb_each_other(V: FunctionSpace) -> None:
    forms = [fem.form(ufl_form) for ufl_form in forms_on(V).values()]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(fast, 4 * forms))
    for i, result in enumerate(together):
        np.testing.assert_array_equal(result, fast(forms[i % len(forms)]))


def test_pattern_is_found_once_and_goes_with_the_cells() -> None:
    V = ZOO["torus"]()
    assert sparsity.pattern(V.cells, False) is sparsity.pattern(V.cells, False)
    cells, pattern = weakref.ref(V.cells), weakref.ref(sparsity.pattern(V.cells, False))
    del V
    gc.collect()
    assert cells() is None
    assert pattern() is None


def test_matrix_for_petsc_without_a_copy() -> None:
    pytest.importorskip("mpi4py.MPI")
    PETSc = pytest.importorskip("petsc4py.PETSc")
    V = ZOO["torus"]()
    form = fem.form(ufl.TrialFunction(V) * ufl.TestFunction(V) * dx)
    A = fem.assemble_matrix(form)
    mat = PETSc.Mat().createAIJWithArrays(A.shape, (A.indptr, A.indices, A.data), comm=PETSc.COMM_SELF)
    A.data *= 2.0
    assert mat.norm() == pytest.approx(np.linalg.norm(A.data), rel=1e-14)
    mat.destroy()


# ---- Errors


def test_wrong_rank_is_named() -> None:
    V = ZOO["torus"]()
    u, v, f = ufl.TrialFunction(V), ufl.TestFunction(V), fem.Function(V)
    with pytest.raises(ValueError, match="form of a scalar has no arguments, but this one has 1"):
        fem.assemble_scalar(fem.form(v * dx))
    with pytest.raises(ValueError, match="form of a vector has a test function, but this one has 2"):
        fem.assemble_vector(fem.form(u * v * dx))
    with pytest.raises(ValueError, match="form of a matrix has a test and a trial function, but this one has 0"):
        fem.assemble_matrix(fem.form(f * dx))


def test_matrix_of_other_spaces_is_not_refilled() -> None:
    V = ZOO["torus"]()
    fine = randomly_refined(V)
    forms = [fem.form(ufl.TrialFunction(S) * ufl.TestFunction(S) * dx) for S in (V, fine)]
    carried = fem.form(fem.Function(fine) * ufl.TrialFunction(V) * ufl.TestFunction(V) * dx)
    for wrong, refilling in (forms, (forms[1], carried)):
        with pytest.raises(ValueError, match="give a matrix that was assembled from a form with the same spaces"):
            fem.assemble_matrix(fem.assemble_matrix(wrong), refilling)


@pytest.mark.parametrize(("length", "dtype"), [(256, np.uint8), (257, np.uint16)])
def test_positions_in_the_longest_row_of_each_type(length: int, dtype: type) -> None:
    dofs = np.arange(length, dtype=np.int32)
    pattern = sparsity._new_pattern(length, length, np.array([length], dtype=np.int32), dofs)
    assert pattern.positions.dtype == dtype
    np.testing.assert_array_equal(pattern.positions.reshape(length, length), np.tile(dofs, (length, 1)))


def test_too_many_entries_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    V = ZOO["torus"]()
    W = FunctionSpace(V.hierarchy, (3,))
    scalar = fem.form(ufl.TrialFunction(V) * ufl.TestFunction(V) * dx)
    blocked = fem.form(inner(ufl.TrialFunction(W), ufl.TestFunction(W)) * dx)
    entries = fem.assemble_matrix(scalar).nnz
    monkeypatch.setattr(sparsity, "LARGEST_INT", 2 * entries)
    with pytest.raises(ValueError, match=f"the matrix would have {9 * entries} entries, more than the {2 * entries}"):
        fem.assemble_matrix(blocked)
    monkeypatch.setattr(sparsity, "LARGEST_INT", entries - 1)
    with pytest.raises(ValueError, match=f"{entries} entries of the matrix are more than the {entries - 1}"):
        sparsity.pattern(dataclasses.replace(V.cells), False)


def test_longest_row_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    V = ZOO["torus"]()
    monkeypatch.setattr(sparsity, "LONGEST_ROW", 36)  # 48 dofs, of which each reaches 7 x 6
    with pytest.raises(ValueError, match="a dof shares cells with 42 others, more than 36: split the pole"):
        sparsity.pattern(dataclasses.replace(V.cells), False)


# ---- Facets


def test_matrices_with_facets_have_a_pattern_of_their_own(V: FunctionSpace) -> None:
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    forms = [u * v * dx, u * v * dx + u * v * ufl.ds, u * v * dx + ufl.jump(grad(u))[0] * ufl.avg(v) * ufl.dS]
    inside, around, across = (fem.assemble_matrix(fem.form(form)) for form in forms)
    np.testing.assert_array_equal(inside.indices, around.indices)
    assert across.nnz > inside.nnz
    for A, form in zip((inside, around, across), forms, strict=True):
        expected = A.copy()
        A.data[:] = np.nan
        assert fem.assemble_matrix(A, fem.form(form)) is A
        np.testing.assert_array_equal(A.data, expected.data)
    with pytest.raises(ValueError, match="give a matrix that was assembled from a form with the same spaces"):
        fem.assemble_matrix(inside, fem.form(forms[2]))


def test_facets_of_the_finest_cells_with_coarser_arguments() -> None:
    """On the coarse space, forms with functions on finer cells: the facets are those of the finer ones."""
    V = randomly_refined(fem.functionspace(generators.wheel(5, 3), ("THCCS", 3)), 1)
    fine = randomly_refined(V, 2)
    u, v, n = ufl.TrialFunction(V), ufl.TestFunction(V), ufl.FacetNormal(V.mesh)
    U, Z = ufl.TrialFunction(fine), ufl.TestFunction(fine)
    f = fem.Function(fine)
    f.x.array = np.random.default_rng(0).random(fine.num_dofs)

    def form(u: ufl.Argument, v: ufl.Argument) -> Form:
        kinks = ufl.jump(f * grad(u), n) * ufl.avg(ufl.dot(grad(v), grad(f)))
        return fem.form(f * u * v * ufl.ds + kinks * ufl.dS)

    P = fine.prolongation(V)
    A, B = fem.assemble_matrix(form(u, v)), P.T @ fem.assemble_matrix(form(U, Z)) @ P
    np.testing.assert_allclose(A.toarray(), B.toarray(), atol=1e-13 * abs(A.toarray()).max())
    again = A.copy()
    fem.assemble_matrix(again, form(u, v))
    assert (again != A).nnz == 0


def test_derivatives_of_integrals_over_facets() -> None:
    """Of a functional with ds and dS, against central differences, and lhs, rhs, action and adjoint."""
    V = randomly_refined(fem.functionspace(generators.wheel(5, 2), ("THCCS", 3)), 1)
    n, k, x = ufl.FacetNormal(V.mesh), fem.Constant(V.mesh, [[2.0, 0.5], [-0.5, 1.0]]), ufl.SpatialCoordinate(V.mesh)
    h, w, d = fem.cell_sizes(V), fem.Function(V), fem.Function(V)
    rng = np.random.default_rng(0)
    w.x.array, d.x.array = rng.random(V.num_dofs), rng.random(V.num_dofs)
    flux = ufl.dot(k, grad(w))
    J = w**4 * ufl.ds + ufl.avg(h) * ufl.jump(h * flux, n) ** 2 * ufl.dS + x[0] * w**2 * dx
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    F = ufl.derivative(J, w, v)
    b, A = fem.assemble_vector(fem.form(F)), fem.assemble_matrix(fem.form(ufl.derivative(F, w, u)))
    compiled, values, eps = [fem.form(form) for form in (J, F)], w.x.array.copy(), 1e-4
    ends = []
    for sign in (1.0, -1.0):
        w.x.array = values + sign * eps * d.x.array
        ends.append((fem.assemble_scalar(compiled[0]), fem.assemble_vector(compiled[1])))
    w.x.array = values
    assert (ends[0][0] - ends[1][0]) / (2 * eps) == pytest.approx(b @ d.x.array, rel=1e-6)
    slope = (ends[0][1] - ends[1][1]) / (2 * eps)
    np.testing.assert_allclose(slope, A @ d.x.array, atol=1e-6 * abs(slope).max())  # eps^2
    a = u * ufl.dot(grad(v), n) * ufl.ds + ufl.jump(h * grad(u), n) * ufl.avg(v) * ufl.dS
    M, T = fem.assemble_matrix(fem.form(a)), fem.assemble_matrix(fem.form(ufl.adjoint(a)))
    np.testing.assert_allclose(M.toarray(), T.toarray().T, atol=1e-14 * abs(M.toarray()).max())
    np.testing.assert_allclose(fem.assemble_vector(fem.form(ufl.action(a, d))), M @ d.x.array, atol=1e-12)
    load = w * v * ufl.ds
    left, right = ufl.system(a - load)
    assert (fem.assemble_matrix(fem.form(left)) != M).nnz == 0
    np.testing.assert_array_equal(fem.assemble_vector(fem.form(right)), fem.assemble_vector(fem.form(load)))
    replaced = fem.form(ufl.replace(load, {w: d}))
    np.testing.assert_array_equal(fem.assemble_vector(replaced), fem.assemble_vector(fem.form(d * v * ufl.ds)))
