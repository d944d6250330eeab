"""Projection, and what else has values on the ranks' cells: the same as in a serial run."""

from collections.abc import Callable
from typing import Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
import pytest
from compared import same_as_in_serial, shared
from spread import whole
from zoo import ZOO

import ufl
from thccs_fem import adapt, fem, generators
from thccs_fem.fem import mass
from thccs_fem.fem.space import CellwiseSpace, FunctionSpace
from thccs_fem.mesh import ControlMesh
from thccs_fem.parallel import gathered
from ufl import as_vector, exp, sin

Floats = npt.NDArray[np.float64]

MESHES: dict[str, Callable[[], Any]] = {
    "tube": lambda: generators.torus((20, 4)),  # long enough that no rank holds all of it
    "wheel5": ZOO["wheel5"],
    "polygons": ZOO["polygons"],
}
SEVERAL = pytest.mark.parametrize("name", MESHES)


def space(comm: MPI.Comm, name: str, times: int = 2, shape: tuple[int, ...] = ()) -> FunctionSpace:
    V = fem.functionspace(shared(MESHES[name](), comm), ("THCCS", 3, shape))
    for _ in range(times):
        V = adapt.refine(V, [0, V.num_functions - 1, V.num_functions // 2])
    return V


def some_function(V: FunctionSpace | CellwiseSpace) -> fem.Function:
    """Return a function that is the same however many ranks there are."""
    u = fem.Function(V)
    k = V.block_size
    u.x.array = np.sin(k * V.index_map.numbers[:, None] + np.arange(k)).ravel()
    return u


@pytest.mark.parametrize(
    ("name", "small"), [*((name, mass.SMALL) for name in MESHES), ("wheel5", 0)], ids=[*MESHES, "wheel5, iterated"]
)
def test_projections(name: str, small: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mass, "SMALL", small)

    def projected(comm: MPI.Comm) -> list[Floats]:
        V = space(comm, name)
        x, on_cells = ufl.SpatialCoordinate(V.mesh), some_function(fem.cellwise(V))
        values = (
            exp(x[0]) * x[1],
            lambda x: np.sin(2 * x[0]) + x[1],
            some_function(V) ** 2,
            x[0] + some_function(FunctionSpace(V.hierarchy.truncated_to(1))),
            x[0] * on_cells + some_function(fem.functionspace(V.mesh, ("DG", 0))),
        )
        return [whole(fem.project(value, V)) for value in values]

    same_as_in_serial(projected)


def test_projections_of_vectors() -> None:
    def projected(comm: MPI.Comm) -> list[Floats]:
        V = space(comm, "wheel5", shape=(2,))
        x = ufl.SpatialCoordinate(V.mesh)
        values = as_vector([x[0] * x[1], 1e-6 * sin(x[0])]), lambda x: x[:2], (0.0, 2.0), 0.0 * as_vector([x[0], 1])
        return [whole(fem.project(value, V)) for value in values]

    same_as_in_serial(projected)


def test_constants_stay_constant_on_many_levels(comm: MPI.Comm) -> None:
    V = fem.functionspace(generators.l_domain(2, comm=comm), ("THCCS", 3))
    for _ in range(8):
        V = adapt.refine(V, [V.num_functions - 1])
    assert V.num_levels == 9
    # 1e-14 of the residual, condition numbers of a few hundred; by a norm of the residual, 1e-8 would be left.
    np.testing.assert_allclose(fem.project(1.5, V).x.array, 1.5, rtol=1e-11)


def test_runs_give_the_same_bits(comm: MPI.Comm) -> None:
    V = space(comm, "tube")
    first, again = (fem.project(exp(ufl.SpatialCoordinate(V.mesh)[0]), V).x.array for _ in range(2))
    np.testing.assert_array_equal(first, again)


@SEVERAL
def test_means_on_cells_and_faces(name: str) -> None:
    def means(comm: MPI.Comm) -> list[Floats]:
        V = space(comm, name)
        coarse = FunctionSpace(V.hierarchy.truncated_to(1))
        x = ufl.SpatialCoordinate(V.mesh)
        spaces = fem.cellwise(V), fem.cellwise(coarse), fem.functionspace(V.mesh, ("DG", 0))
        values: tuple[Any, ...] = exp(x[0]), lambda x: x[0] ** 2, 3.5, 0.0
        found = [whole(fem.project(value, W)) for W in spaces for value in values]
        finer = [whole(fem.project(x[1] * some_function(V), W)) for W in spaces]
        vectors = [
            whole(fem.project(value, W))
            for W in (fem.cellwise(V, (2,)), fem.functionspace(V.mesh, ("DG", 0, (2,))))
            for value in (as_vector([x[0], x[1]]), lambda x: x[:2])
        ]
        return [*found, *finer, *vectors, whole(fem.cell_sizes(V))]

    same_as_in_serial(means, tol=1e-13)  # sums over cells, in another order


def test_faces_of_the_mesh_have_the_same_bits_on_all_ranks(comm: MPI.Comm) -> None:
    V = space(comm, "tube")
    u = fem.project(some_function(V), fem.functionspace(V.mesh, ("DG", 0)))
    assert len({array.tobytes() for array in comm.allgather(u.x.array)}) == 1


# ---- Values at points


@SEVERAL
def test_forces_at_points(name: str) -> None:
    def load(comm: MPI.Comm) -> tuple[Floats, Floats]:
        V = space(comm, name)
        rng = np.random.default_rng(0)
        faces = rng.integers(0, V.mesh.num_faces, 30)
        corner = None if V.mesh.is_quad else rng.integers(0, V.mesh.face_sizes[faces])
        points = faces, rng.random((30, 2)), corner
        B = fem.point_values(V, *points)
        assert B.shape == (30, V.num_local_dofs)
        u = some_function(V)
        rows = np.diff(B.indptr) > 0  # of the points on cells that this rank holds
        np.testing.assert_allclose((B @ u.x.array)[rows], u.eval(*points)[rows], atol=1e-13)
        assert gathered(V.mesh.comm, np.flatnonzero(rows)).size >= 30
        return u.eval(*points), V.index_map.gather(B.T @ rng.random((30, 2)))

    same_as_in_serial(load, tol=1e-13)


def test_expressions_at_points_of_pieces() -> None:
    def squares(comm: MPI.Comm) -> Floats:
        V = space(comm, "wheel5")
        u, coarse = some_function(V), some_function(FunctionSpace(V.hierarchy.truncated_to(1)))
        expression = fem.Expression(u * ufl.grad(coarse)[0] + some_function(fem.cellwise(V)), [[0.5, 0.5], [0.1, 0.2]])
        own = np.flatnonzero(V.cells.piece_cell < V.cells.num_owned).astype(np.int32)
        values = expression.eval(V, own).reshape(own.size, -1)
        of_cells = np.zeros((V.cells.num_owned, 2))
        np.add.at(of_cells, V.cells.piece_cell[own], values**2)
        assert expression.eval(V, own[:0]).shape == (0, 2, 1)
        return V.cells.partition.cells.gather(of_cells)

    same_as_in_serial(squares, tol=1e-13)


def test_copies_have_ghosts(comm: MPI.Comm) -> None:
    u = some_function(space(comm, "tube"))
    v = u.copy("v")
    np.testing.assert_array_equal(v.x.array, u.x.array)
    v.x.array[:] = 0.0
    assert u.x.array.any()


# ---- Errors


def test_values_that_are_not_finite_on_one_rank(comm: MPI.Comm) -> None:
    V = space(comm, "tube")
    x = ufl.SpatialCoordinate(V.mesh)
    for W in (V, fem.cellwise(V), fem.functionspace(V.mesh, ("DG", 0))):
        for value in (ufl.ln(x[0] + 2.5), lambda x: np.where(x[0] > -2.5, 1.0, np.nan)):  # at one end alone
            with pytest.raises(ValueError, match="the value is not finite everywhere on the surface"):
                fem.project(value, W)


def test_functions_that_fail_on_one_rank(comm: MPI.Comm) -> None:
    V = space(comm, "tube")

    def value(x: Floats) -> Floats:
        if comm.rank == 0:
            raise ZeroDivisionError("so it is")
        return x[0]

    for W in (V, fem.cellwise(V)):
        with pytest.raises(ZeroDivisionError, match="so it is"):
            fem.project(value, W)


def test_surfaces_that_fold_are_refused_as_in_a_serial_run(comm: MPI.Comm) -> None:
    strip = generators.rectangle((3, 1), (0.0, 0.0), (3.0, 1.0))
    dart = strip.vertices.copy()
    dart[-1] = [2.2, 0.2]  # drawn inwards beyond the diagonal of the last face
    points = (dart + np.array([[0.0, 10.0 * k] for k in range(10)])[:, None]).reshape(-1, 2)
    faces = np.vstack([strip.quads + strip.num_vertices * k for k in range(10)])
    with pytest.raises(
        ValueError, match=r"^the planar surface folds .* on 10 of 30 faces, first \[2, 5, 8, 11, 14, 17"
    ):
        fem.functionspace(ControlMesh(points, faces, comm=comm), ("THCCS", 3))


def test_surfaces_that_fold_on_one_rank_alone(comm: MPI.Comm) -> None:
    grid = generators.rectangle((6, 6), (0.0, 0.0), (6.0, 6.0))
    points = grid.vertices.copy()
    corner = np.flatnonzero((points == 6.0).all(axis=1))
    points[corner] = [5.2, 5.2]
    with pytest.raises(ValueError, match=r"^the planar surface folds .* on 1 of 36 faces, first \[35\]"):
        fem.functionspace(ControlMesh(points, grid.quads, comm=comm), ("THCCS", 3))
