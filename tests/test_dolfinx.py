"""The bridge to DOLFINx: the same surface, the same functions, and C^T A C the same matrices."""

from collections.abc import Callable

import numpy as np
import pytest
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from problems import lifted, moved_inside, randomly_refined

import ufl
from thccs_fem import adapt, fem, generators
from thccs_fem.extraction import evaluate_pieces
from thccs_fem.fem.scipy import LinearProblem
from ufl import dx, grad, inner

pytest.importorskip("mpi4py.MPI")
pytest.importorskip("petsc4py")
pytest.importorskip("dolfinx")

import dolfinx.fem.petsc

from thccs_fem import dolfinx as bridge

SPACES: dict[str, Callable[[], fem.FunctionSpace]] = {
    "rectangle": lambda: fem.functionspace(generators.rectangle((4, 3)), ("THCCS", 3)),
    "wheel5": lambda: fem.functionspace(moved_inside(generators.wheel(5, 3), 0.1), ("THCCS", 3)),
    "disc, crease": lambda: fem.functionspace(generators.disc(2), ("THCCS", 3), boundary="crease"),
    "lifted wheel3": lambda: fem.functionspace(lifted(generators.wheel(3, 2)), ("THCCS", 3)),
    "cube sphere": lambda: fem.functionspace(generators.cube_sphere(2), ("THCCS", 3)),
    "genus 3": lambda: fem.functionspace(generators.genus3(levels=1), ("THCCS", 3)),
}


@pytest.fixture(params=SPACES.values(), ids=SPACES, scope="module")
def V(request: pytest.FixtureRequest) -> fem.FunctionSpace:
    V = randomly_refined(request.param(), times=2)
    assert V.num_levels > 1
    return V


def random_function(V: fem.FunctionSpace, seed: int = 0) -> fem.Function:
    u = fem.Function(V, name="u")
    u.x.array = np.random.default_rng(seed).uniform(-1.0, 1.0, V.num_dofs)
    return u


def with_values(V: fem.FunctionSpace, k: int) -> fem.FunctionSpace:
    return fem.FunctionSpace(V.hierarchy, (k,))


def to_scipy(C) -> sp.csr_array:
    indptr, indices, data = C.getValuesCSR()
    return sp.csr_array((data, indices, indptr), shape=C.getSize())


def test_points_of_the_surface_are_the_same(V: fem.FunctionSpace) -> None:
    msh = bridge.mesh(V)
    piece = msh.topology.original_cell_index
    assert sorted(piece) == list(range(V.cells.num_pieces))
    assert (msh.geometry.dim, msh.topology.dim) == (V.mesh.gdim, 2)
    uv = np.random.default_rng(1).random((6, 2))
    for cell in range(0, piece.size, 7):
        x = msh.geometry.x[msh.geometry.dofmaps[0][cell]][:, : V.mesh.gdim]
        points = msh.geometry.cmaps[0].push_forward(uv, np.ascontiguousarray(x))
        ours = evaluate_pieces(V.cells.piece_points, np.full(6, piece[cell]), uv)
        np.testing.assert_allclose(points, ours, atol=1e-13 * np.abs(x).max(), rtol=0)  # sums of 16 terms of that size


@pytest.mark.parametrize("k", [None, 2, 3])
def test_functions_have_the_same_values(V: fem.FunctionSpace, k: int | None) -> None:
    u = random_function(V if k is None else with_values(V, k))
    theirs = bridge.function(u)
    assert theirs.name == "u"
    assert theirs.function_space.mesh is bridge.mesh(V)
    uv = np.random.default_rng(2).random((5, 2))
    piece = bridge.mesh(V).topology.original_cell_index.astype(np.int32)
    values = dolfinx.fem.Expression(theirs, uv).eval(bridge.mesh(V), np.arange(piece.size, dtype=np.int32))
    expected = evaluate_pieces(u.local_coefficients(), np.repeat(piece, 5), np.tile(uv, (piece.size, 1)))
    np.testing.assert_allclose(values.reshape(expected.shape), expected, atol=1e-13, rtol=0)  # |u| is up to 1


def test_integrals_are_the_same(V: fem.FunctionSpace) -> None:
    u = random_function(V)
    theirs = bridge.function(u)
    rule = dx(metadata={"quadrature_degree": 9})
    for integrand in (
        lambda u: u**2,
        lambda u: inner(grad(u), grad(u)),
        lambda u: ufl.SpatialCoordinate(u.function_space.mesh)[1] ** 2 * u,
    ):
        expected = dolfinx.fem.assemble_scalar(dolfinx.fem.form(integrand(theirs) * rule))
        # Rounding in two bases; gradients in small pieces amplify it.
        assert fem.assemble_scalar(fem.form(integrand(u) * rule)) == pytest.approx(expected, rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("k", [None, 2])
def test_matrices_and_vectors_are_those_of_dolfinx(V: fem.FunctionSpace, k: int | None) -> None:
    if k is not None:
        V = with_values(V, k)
    C, Q = bridge.extraction_matrix(V), bridge.functionspace(V)
    assert C.getSize() == (Q.dofmap.index_map.size_global * Q.dofmap.index_map_bs, V.num_dofs)
    assert C.getBlockSizes() == (V.block_size, V.block_size)
    rule = dx(metadata={"quadrature_degree": 9})

    def a(W):
        u, v = ufl.TrialFunction(W), ufl.TestFunction(W)
        return (inner(grad(u), grad(v)) + (1 + ufl.SpatialCoordinate(W.mesh)[0] ** 2) * inner(u, v)) * rule

    def L(W):
        v, x = ufl.TestFunction(W), ufl.SpatialCoordinate(W.mesh)
        return x[1] * (v if k is None else v[1]) * rule

    A = dolfinx.fem.petsc.assemble_matrix(dolfinx.fem.form(a(Q)))
    A.assemble()
    ours = fem.assemble_matrix(fem.form(a(V))).toarray()
    np.testing.assert_allclose(to_scipy(A.PtAP(C)).toarray(), ours, atol=1e-12 * np.abs(ours).max(), rtol=0)
    b = dolfinx.fem.assemble_vector(dolfinx.fem.form(L(Q))).array
    ours = fem.assemble_vector(fem.form(L(V)))
    np.testing.assert_allclose(to_scipy(C).T @ b, ours, atol=1e-13 * np.abs(ours).max(), rtol=0)


@pytest.mark.parametrize("k", [None, 2])
def test_extraction_matrix_makes_the_dofs_of_the_function(V: fem.FunctionSpace, k: int | None) -> None:
    V = V if k is None else with_values(V, k)
    u = random_function(V)
    values = to_scipy(bridge.extraction_matrix(V)) @ u.x.array
    np.testing.assert_allclose(values, bridge.function(u).x.array, atol=1e-14, rtol=0)


def test_a_problem_assembled_by_dolfinx_has_the_same_solution() -> None:
    V = randomly_refined(fem.functionspace(generators.disc(2), ("THCCS", 3)), times=1)
    rule = dx(metadata={"quadrature_degree": 9})

    def forms(W) -> tuple[ufl.Form, ufl.Form]:
        u, v, x = ufl.TrialFunction(W), ufl.TestFunction(W), ufl.SpatialCoordinate(W.mesh)
        return (inner(grad(u), grad(v)) + u * v) * rule, ufl.sin(x[0]) * v * rule

    C = to_scipy(bridge.extraction_matrix(V))
    a, L = (dolfinx.fem.form(form) for form in forms(bridge.functionspace(V)))
    A = sp.csc_array(C.T @ dolfinx.fem.assemble_matrix(a).to_scipy() @ C)
    solution = spla.spsolve(A, C.T @ dolfinx.fem.assemble_vector(L).array)
    ours = LinearProblem(*forms(V)).solve().x.array
    np.testing.assert_allclose(solution, ours, atol=1e-11, rtol=0)  # the matrix has a condition number of 1e3


def test_cells_may_have_another_order_than_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    """DOLFINx need not keep the order, though it does on meshes whose cells have no neighbours."""
    V = fem.functionspace(generators.wheel(5, 2), ("THCCS", 3, (2,)))
    u = fem.project(lambda x: np.stack([x[0] ** 2, x[1]]), V)
    create, Topology = dolfinx.mesh.create_mesh, dolfinx.mesh.Topology
    order = np.random.default_rng(3).permutation(V.cells.num_pieces)
    original = property(lambda topology: order[topology._cpp_object.original_cell_index])
    monkeypatch.setattr(
        dolfinx.mesh, "create_mesh", lambda comm, cells, e, x, **kw: create(comm, cells[order], e, x, **kw)
    )
    monkeypatch.setattr(Topology, "original_cell_index", original)
    piece = bridge.mesh(V).topology.original_cell_index
    assert (piece != np.arange(piece.size)).any()
    theirs = bridge.function(u)
    np.testing.assert_allclose(to_scipy(bridge.extraction_matrix(V)) @ u.x.array, theirs.x.array, atol=1e-14, rtol=0)
    x = ufl.SpatialCoordinate(bridge.mesh(V))
    error = dolfinx.fem.form((theirs - ufl.as_vector([x[0] ** 2, x[1]])) ** 2 * dx)
    assert np.sqrt(dolfinx.fem.assemble_scalar(error)) < 0.1  # 1.0 if pieces are mistaken for one another


def test_cellwise_functions_are_constant_on_pieces(V: fem.FunctionSpace) -> None:
    """With the sizes of the cells the integral of 1 / h^2 is the number of cells."""
    h = bridge.function(fem.cell_sizes(V))
    assert h.function_space.mesh is bridge.mesh(V)
    count = dolfinx.fem.assemble_scalar(dolfinx.fem.form(1 / h**2 * dx(metadata={"quadrature_degree": 11})))
    assert count == pytest.approx(V.num_cells, rel=1e-6)  # quadrature of areas that are no polynomials


def test_one_mesh_for_the_same_pieces() -> None:
    V = fem.functionspace(generators.rectangle((2, 2)), ("THCCS", 3))
    assert bridge.mesh(V) is bridge.mesh(with_values(V, 2))
    assert bridge.mesh(adapt.refine(V, [0])) is not bridge.mesh(V)
    assert bridge.functionspace(V).value_shape == ()
    assert tuple(bridge.functionspace(with_values(V, 2)).value_shape) == (2,)


def test_what_is_no_space_is_refused() -> None:
    Q = bridge.functionspace(fem.functionspace(generators.rectangle((2, 2)), ("THCCS", 3)))
    with pytest.raises(TypeError, match=r"a space from thccs_fem\.fem\.functionspace is needed, got FunctionSpace"):
        bridge.mesh(Q)
