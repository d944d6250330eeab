"""DOLFINx as an oracle: it assembles on the pieces, taken as a mesh of cubic cells that hang together nowhere.

Only the pieces, their control points and their operators C are taken from the package: C^T A C, with A the matrix of
DOLFINx in the discontinuous cubic space, is what ours must be. For integrals over the edges between cells the mesh
consists of pairs of cells, one for each facet, that hang together there.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import scipy.sparse as sp
from problems import lifted, moved_inside, randomly_refined
from scipy.interpolate import BSpline

import ufl
from thccs_fem import fem, generators
from thccs_fem.facets import boundary_facets, interior_facets
from ufl import avg, div, dot, grad, inner, jump

MPI = pytest.importorskip("mpi4py.MPI")
dolfinx = pytest.importorskip("dolfinx")
basix_ufl = pytest.importorskip("basix.ufl")

Floats = npt.NDArray[np.float64]

RULE = {"quadrature_degree": 9}  # on both sides the same 5 x 5 points, 5 on edges
dx = ufl.dx(metadata=RULE)

SPACES: dict[str, Callable[[], fem.FunctionSpace]] = {
    "wheel5": lambda: fem.functionspace(generators.wheel(5, 3), ("THCCS", 3)),
    "wheel8, moved": lambda: fem.functionspace(moved_inside(generators.wheel(8, 2), 0.1), ("THCCS", 3)),
    "disc": lambda: fem.functionspace(generators.disc(2), ("THCCS", 3)),
    "disc, crease": lambda: fem.functionspace(generators.disc(2), ("THCCS", 3), boundary="crease"),
    "lifted wheel3": lambda: fem.functionspace(lifted(generators.wheel(3, 2)), ("THCCS", 3)),
    "cube sphere": lambda: fem.functionspace(generators.cube_sphere(2), ("THCCS", 3)),
    "genus 3": lambda: fem.functionspace(generators.genus3(levels=1), ("THCCS", 3)),
}


@dataclass(frozen=True, eq=False)
class Oracle:
    """A THCCS space, and the discontinuous space of DOLFINx on its pieces."""

    V: fem.FunctionSpace
    Q: Any
    C: sp.csr_array  # values at the nodes of Q in terms of the functions of V
    cells: npt.NDArray[np.int32]  # the cell of V that each cell of DOLFINx is a part of
    entities: npt.NDArray[np.int32]  # of integrals over facets: cell and local facet, once or twice

    def measure(self, kind: str) -> tuple[ufl.Measure, ufl.Measure]:
        """Return ours and that of DOLFINx."""
        data = [(1, self.entities.ravel())]
        return ufl.Measure(kind, metadata=RULE), ufl.Measure(kind, subdomain_data=data, subdomain_id=1, metadata=RULE)


@pytest.fixture(params=SPACES.values(), ids=SPACES, scope="module")
def oracle(request: pytest.FixtureRequest) -> Oracle:
    V = randomly_refined(request.param(), times=3)
    assert V.num_levels >= 3
    cells = V.cells
    piece, Q = on_pieces(cells.piece_points, np.arange(16 * cells.num_pieces).reshape(-1, 16))
    C = at_nodes(Q, cells.rows(piece))
    facets = boundary_facets(cells)
    cell_of_piece = np.argsort(piece)
    entities = np.column_stack([cell_of_piece[facets.pieces[:, 0]], np.array([0, 2, 3, 1])[facets.squares[:, 0]]])
    return Oracle(V, Q, C, cells.piece_cell[piece], entities.astype(np.int32))


WITH_PAIRS = ("wheel5", "disc, crease", "lifted wheel3", "cube sphere")


@pytest.fixture(params=[SPACES[name] for name in WITH_PAIRS], ids=WITH_PAIRS, scope="module")
def pairs(request: pytest.FixtureRequest) -> Oracle:
    V = randomly_refined(request.param(), times=3)
    facets = interior_facets(V.cells)
    points, rows = np.zeros((facets.num_facets, 2, 16, V.mesh.gdim)), np.zeros((facets.num_facets, 32, V.num_dofs))
    for part in facets.batches(np.arange(facets.num_facets, dtype=np.int32)):
        points[part.facets] = part.points.reshape(-1, 2, 16, V.mesh.gdim)
        rows[part.facets] = part.batch.local(np.eye(V.num_dofs))
    nodes = np.arange(32 * facets.num_facets).reshape(-1, 2, 16)
    x, y = LAGRANGE.basix_element.points.T
    along = np.argsort(x, kind="stable")
    nodes[:, 1, along[y[along] == 1.0]] = nodes[:, 0, along[y[along] == 0.0]]
    side, Q = on_pieces(points.reshape(-1, 16, V.mesh.gdim), nodes.reshape(-1, 16))
    C = at_nodes(Q, sp.csr_array(rows.reshape(-1, 16, V.num_dofs)[side].reshape(-1, V.num_dofs)))
    number = np.argsort(side).reshape(-1, 2)
    entities = np.column_stack([number[:, 0], np.full(len(number), 0), number[:, 1], np.full(len(number), 3)])
    return Oracle(V, Q, C, facets.facet_cells.ravel()[side], entities.astype(np.int32))


LAGRANGE = basix_ufl.element("Lagrange", "quadrilateral", 3)


def on_pieces(control: Floats, nodes: npt.NDArray[np.int64]) -> tuple[npt.NDArray[np.int32], Any]:
    """Return DOLFINx's discontinuous space on cubic cells, and which of the given pieces each cell is.

    Args:
        control: Control points in the local B-spline basis, shape (n, 16, gdim).
        nodes: Numbers of their nodes: what hangs together has some in common, shape (n, 16).
    """
    points = np.einsum("qk,pkc->pqc", bsplines(LAGRANGE.basix_element.points), control)
    gdim = points.shape[2]
    _, first, inverse = np.unique(nodes, return_index=True, return_inverse=True)
    msh = dolfinx.mesh.create_mesh(
        MPI.COMM_SELF,
        inverse.reshape(nodes.shape),
        basix_ufl.blocked_element(LAGRANGE, shape=(gdim,)),
        points.reshape(-1, gdim)[first],
    )
    piece = msh.topology.original_cell_index.astype(np.int32)  # of each cell, since DOLFINx sorts them anew
    assert sorted(piece) == list(range(len(points)))
    np.testing.assert_allclose(msh.geometry.x[msh.geometry.dofmaps[0]][..., :gdim], points[piece], atol=1e-14)
    return piece, dolfinx.fem.functionspace(msh, ("DQ", 3))


def at_nodes(Q: Any, rows: sp.csr_array) -> sp.csr_array:
    """Return the values at the nodes of Q of functions with the given local coefficients on its cells."""
    num_cells = Q.dofmap.list.shape[0]
    values = sp.kron(sp.eye_array(num_cells), bsplines(Q.element.interpolation_points)) @ rows
    return sp.csr_array(values)[np.argsort(Q.dofmap.list.ravel())]


def bsplines(points: Floats) -> Floats:
    """Return the 16 uniform bicubic B-splines at points of the reference square, shape (points, 16)."""
    along_x, along_y = (BSpline.design_matrix(t, np.arange(-3.0, 5.0), 3).toarray() for t in points[:, :2].T)
    return np.einsum("qj,qi->qji", along_y, along_x).reshape(-1, 16)


@dataclass(frozen=True, eq=False)
class Problem:
    """What the forms are made of, the same for both."""

    u: ufl.Argument
    v: ufl.Argument
    U: ufl.Argument
    Z: ufl.Argument
    f: ufl.Coefficient
    g: ufl.Coefficient
    q: ufl.Coefficient  # constant on each cell
    r: ufl.Coefficient  # likewise, two components
    k: ufl.Constant
    K: ufl.Constant

    @property
    def x(self) -> ufl.SpatialCoordinate:
        return ufl.SpatialCoordinate(self.u)

    @property
    def n(self) -> ufl.FacetNormal:
        return ufl.FacetNormal(self.u.ufl_function_space().ufl_domain())


TENSOR = np.array([[2.0, 0.5], [-0.25, 3.0]])

FORMS: dict[str, Callable[[Problem], ufl.Form]] = {
    "area": lambda p: p.k * dx,
    "functional": lambda p: (p.f**2 * ufl.sin(p.x[0]) + inner(grad(p.f), grad(p.g[1])) + p.x[1] ** 3) * dx,
    "load": lambda p: (p.f**2 * p.k + p.x[0]) * p.v * dx,
    "load of gradients": lambda p: inner(p.f * grad(p.g[0]), grad(p.v)) * dx,
    "load of Laplacians": lambda p: div(grad(p.f)) * p.v * dx,
    "load, two components": lambda p: inner(dot(p.K, p.g) + p.f * p.g, p.Z) * dx,
    "mass": lambda p: p.u * p.v * dx,
    "stiffness": lambda p: inner(grad(p.u), grad(p.v)) * dx,
    "coefficients": lambda p: (
        ((p.f**2 + p.k) * ufl.exp(p.x[0]) * inner(grad(p.u), grad(p.v)) + p.x[1] * p.g[0] * p.u * p.v.dx(0)) * dx
    ),
    "two components": lambda p: (
        (inner(grad(p.U), grad(p.Z)) + inner(dot(p.K, p.U), p.Z) + p.f * p.U[0].dx(1) * p.Z[1]) * dx
    ),
    "bending": lambda p: div(grad(p.u)) * div(grad(p.v)) * dx,
    "cellwise functional": lambda p: (p.q * p.f**2 * p.r[0] + p.r[1]) * dx,
    "cellwise load": lambda p: p.f * p.q * inner(p.r, p.Z) * dx,
    "cellwise coefficients": lambda p: (p.q * inner(grad(p.u), grad(p.v)) + p.r[1] * p.f * p.u * p.v) * dx,
}

ON_BOUNDARY: dict[str, Callable[[Problem, ufl.Measure], ufl.Form]] = {
    "functional": lambda p, ds: (p.f**2 * ufl.sin(p.x[0]) + p.q * dot(grad(p.f), p.n)) * ds,
    "load": lambda p, ds: (p.f**2 * p.k + p.x[0] * p.n[0] + p.r[1]) * p.v * ds,
    "load, two components": lambda p, ds: inner(dot(p.K, p.g) + p.q * p.n[0] * p.g, p.Z) * ds,
    "Robin": lambda p, ds: p.q * p.u * p.v * ds,
    "Nitsche": lambda p, ds: (dot(grad(p.u), p.n) * p.v + p.u * dot(grad(p.v), p.n) + p.f * p.q * p.u * p.v) * ds,
    "two components": lambda p, ds: (inner(dot(p.K, p.U), p.Z) + p.n[0] * p.U[0].dx(1) * p.Z[1]) * ds,
}

BETWEEN_CELLS: dict[str, Callable[[Problem, ufl.Measure], ufl.Form]] = {
    "functional": lambda p, dS: (jump(p.q) ** 2 * avg(p.f) + dot(grad(p.f)("+"), p.n("-")) * p.q("-")) * dS,
    "load": lambda p, dS: (jump(p.q * grad(p.f), p.n) + p.x[0]) * avg(p.v) * dS,
    "load of one side": lambda p, dS: p.q("-") * p.n("+")[0] * dot(grad(p.v)("+"), grad(p.f)("-")) * dS,
    "load, two components": lambda p, dS: inner(dot(p.K, p.g("+")) + p.r("-"), p.Z("-")) * dS,
    "mass": lambda p, dS: p.u("+") * p.v("-") * dS,
    "interior penalty": lambda p, dS: (
        (inner(jump(p.q * p.u, p.n), avg(p.f * grad(p.v))) + jump(p.q * grad(p.u), p.n) * jump(p.q * grad(p.v), p.n))
        * dS
    ),
    "two components": lambda p, dS: (
        (inner(dot(p.K, p.U("-")), p.Z("+")) + inner(grad(p.U)("+"), jump(p.r[0] * grad(p.Z)))) * dS
    ),
}


def problem(on: Any, scalars: Any, vectors: Any, f: Floats, g: Floats, cells: npt.NDArray[np.int32] | None) -> Problem:
    """Return the problem in DOLFINx's spaces or in ours.

    Args:
        on: The module with their functions and constants.
        scalars: The space.
        vectors: That of functions with two components.
        f: Values of the scalar function.
        g: Values of the other.
        cells: The cell of ours that each of theirs lies in; None for ours.
    """
    make = (ufl.TrialFunction, ufl.TestFunction)
    if cells is None:
        constant = [fem.cellwise(scalars), fem.cellwise(scalars, (2,))]
        dofs: Any = slice(None)
    else:
        constant = [dolfinx.fem.functionspace(scalars.mesh, ("DG", 0, *shape)) for shape in ((), ((2,),))]
        dofs = constant[0].dofmap.list.ravel()  # the same for both
    constants = [on.Constant(scalars.mesh, value) for value in (0.75, TENSOR)]
    p = Problem(
        *(kind(space) for space in (scalars, vectors) for kind in make),
        on.Function(scalars),
        on.Function(vectors),
        *map(on.Function, constant),
        *constants,
    )
    p.f.x.array[:], p.g.x.array[:] = f, g
    for function, values in ((p.q, lambda c: np.sin(1.0 + c)), (p.r, lambda c: np.cos(2.0 * c + [[0.0, 1.0]]))):
        given = np.arange(function.x.array.size // function.ufl_function_space().value_size) if cells is None else cells
        function.x.array.reshape(given.size, -1)[dofs] = values(given[:, None])
    return p


@pytest.mark.filterwarnings("ignore:the form has second derivatives")  # on shallow caps: whatever the pieces
@pytest.mark.parametrize("kind", FORMS)
def test_forms_as_dolfinx_assembles_them(oracle: Oracle, kind: str) -> None:
    make = FORMS[kind]
    # Of fourth order |C|^T |A| |C| is up to 3e4 times as large as C^T A C.
    check(oracle, (make, make), tolerance=1e-11 if kind == "bending" else 1e-12)


@pytest.mark.parametrize("kind", ON_BOUNDARY)
def test_forms_on_the_boundary_as_dolfinx_assembles_them(oracle: Oracle, kind: str) -> None:
    if not oracle.entities.size:
        return  # closed surfaces: test_facets.py
    check(oracle, [functools.partial(ON_BOUNDARY[kind], **{"ds": ds}) for ds in oracle.measure("ds")])


@pytest.mark.parametrize("kind", BETWEEN_CELLS)
def test_forms_between_cells_as_dolfinx_assembles_them(pairs: Oracle, kind: str) -> None:
    check(pairs, [functools.partial(BETWEEN_CELLS[kind], **{"dS": dS}) for dS in pairs.measure("dS")])


def check(oracle: Oracle, make: Sequence[Callable[[Problem], ufl.Form]], tolerance: float = 1e-12) -> None:
    """Compare our tensors with DOLFINx's. The tolerance is for two bases and sums in two orders."""
    V, Q, C = oracle.V, oracle.Q, oracle.C
    rng = np.random.default_rng(1)
    f, g = rng.standard_normal(V.num_dofs), rng.standard_normal(2 * V.num_dofs)
    blocked = sp.csr_array(sp.kron(C, np.eye(2)))
    ours = fem.form(make[0](problem(fem, V, fem.FunctionSpace(V.hierarchy, (2,)), f, g, None)), on=V)
    Q2 = dolfinx.fem.functionspace(Q.mesh, ("DQ", 3, (2,)))
    theirs = make[1](problem(dolfinx.fem, Q, Q2, C @ f, blocked @ g, oracle.cells))
    theirs = dolfinx.fem.form(theirs)
    maps = [C if space.dofmap.index_map_bs == 1 else blocked for space in theirs.function_spaces]
    if ours.rank == 0:
        actual, expected = fem.assemble_scalar(ours), dolfinx.fem.assemble_scalar(theirs)
    elif ours.rank == 1:
        actual, expected = fem.assemble_vector(ours), maps[0].T @ dolfinx.fem.assemble_vector(theirs).array
    else:
        A = dolfinx.fem.assemble_matrix(theirs).to_scipy()
        actual, expected = fem.assemble_matrix(ours).toarray(), (maps[0].T @ A @ maps[1]).toarray()
    scale = np.abs(expected).max()
    assert scale > 0
    np.testing.assert_allclose(actual, expected, atol=tolerance * scale, rtol=0)
