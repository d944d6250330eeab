"""DOLFINx as an oracle: it assembles on the pieces, taken as a mesh of cubic cells that hang together nowhere.

Only the pieces, their control points and their operators C are taken from the package: C^T A C, with A the matrix of
DOLFINx in the discontinuous cubic space, is what ours must be.
"""

from collections.abc import Callable
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
from ufl import div, dot, grad, inner

MPI = pytest.importorskip("mpi4py.MPI")
dolfinx = pytest.importorskip("dolfinx")
basix_ufl = pytest.importorskip("basix.ufl")

Floats = npt.NDArray[np.float64]

dx = ufl.dx(metadata={"quadrature_degree": 9})  # on both sides the same 5 x 5 points

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


@pytest.fixture(params=SPACES.values(), ids=SPACES, scope="module")
def oracle(request: pytest.FixtureRequest) -> Oracle:
    V = randomly_refined(request.param(), times=3)
    assert V.num_levels >= 3
    cells = V.cells
    lagrange = basix_ufl.element("Lagrange", "quadrilateral", 3)
    points = np.einsum("qk,pkc->pqc", bsplines(lagrange.basix_element.points), cells.piece_points)
    msh = dolfinx.mesh.create_mesh(
        MPI.COMM_SELF,
        np.arange(16 * cells.num_pieces).reshape(-1, 16),
        basix_ufl.blocked_element(lagrange, shape=(V.mesh.gdim,)),
        points.reshape(-1, V.mesh.gdim),
    )
    piece = msh.topology.original_cell_index.astype(np.int32)  # of each cell, since DOLFINx sorts them anew
    assert sorted(piece) == list(range(cells.num_pieces))
    np.testing.assert_array_equal(msh.geometry.x[msh.geometry.dofmaps[0]][..., : V.mesh.gdim], points[piece])
    Q = dolfinx.fem.functionspace(msh, ("DQ", 3))
    values = sp.kron(sp.eye_array(piece.size), bsplines(Q.element.interpolation_points)) @ cells.rows(piece)
    row_of_node = np.argsort(Q.dofmap.list.ravel())
    return Oracle(V, Q, sp.csr_array(values)[row_of_node])


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
    k: ufl.Constant
    K: ufl.Constant

    @property
    def x(self) -> ufl.SpatialCoordinate:
        return ufl.SpatialCoordinate(self.u)


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
}


def problem(on: Any, scalars: Any, vectors: Any, f: Floats, g: Floats) -> Problem:
    """Return the problem in DOLFINx's spaces or in ours; `on` is the module with their functions and constants."""
    make = (ufl.TrialFunction, ufl.TestFunction)
    constants = [on.Constant(scalars.mesh, value) for value in (0.75, TENSOR)]
    p = Problem(
        *(kind(space) for space in (scalars, vectors) for kind in make),
        on.Function(scalars),
        on.Function(vectors),
        *constants,
    )
    p.f.x.array[:], p.g.x.array[:] = f, g
    return p


@pytest.mark.parametrize("kind", FORMS)
def test_forms_as_dolfinx_assembles_them(oracle: Oracle, kind: str) -> None:
    V, Q, C, make = oracle.V, oracle.Q, oracle.C, FORMS[kind]
    rng = np.random.default_rng(1)
    f, g = rng.standard_normal(V.num_dofs), rng.standard_normal(2 * V.num_dofs)
    blocked = sp.csr_array(sp.kron(C, np.eye(2)))
    ours = fem.form(make(problem(fem, V, fem.FunctionSpace(V.hierarchy, (2,)), f, g)), on=V)
    Q2 = dolfinx.fem.functionspace(Q.mesh, ("DQ", 3, (2,)))
    theirs = make(problem(dolfinx.fem, Q, Q2, C @ f, blocked @ g))
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
    # Two bases, sums in two orders; of fourth order |C|^T |A| |C| is up to 3e4 times as large as C^T A C.
    tolerance = 1e-11 if kind == "bending" else 1e-12
    np.testing.assert_allclose(actual, expected, atol=tolerance * scale, rtol=0)
