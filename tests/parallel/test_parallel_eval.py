"""Values at points: each rank gets those that it asks for, wherever they lie."""

from collections.abc import Callable
from typing import Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
import pytest
from compared import same_as_in_serial, shared
from problems import refined_anywhere
from zoo import ZOO

import ufl
from thccs_fem import fem, generators

Ints = npt.NDArray[np.integer]
Floats = npt.NDArray[np.float64]

MESHES: dict[str, Callable[[MPI.Comm], Any]] = {
    "L-domain": lambda comm: generators.l_domain(3, comm=comm),
    "closed": lambda comm: generators.cube_sphere(3, comm=comm),
    "polygons": lambda comm: shared(ZOO["polygons"](), comm),
    "one cell": lambda comm: generators.rectangle((1, 1), comm=comm),
}
each_mesh = pytest.mark.parametrize("make", MESHES.values(), ids=MESHES)


def functions(make: Callable[[MPI.Comm], Any], comm: MPI.Comm) -> list[fem.Function]:
    """Return functions of all kinds of spaces, the same whatever the ranks."""
    V = refined_anywhere(fem.functionspace(make(comm), ("THCCS", 3)), 3)
    W = fem.FunctionSpace(V.hierarchy, (2,))
    found = []
    for space in (V, W, fem.cellwise(V, (3,)), fem.functionspace(V.mesh, ("DG", 0))):
        u = fem.Function(space)
        rows = np.random.default_rng(0).uniform(-1.0, 1.0, (u.x.index_map.size_global, space.block_size))
        u.x.array = rows[u.x.index_map.numbers].ravel()
        found.append(u)
    return found


def points(msh: Any, count: int) -> tuple[Ints, Floats, Ints]:
    """Return points, some on the edges and corners of faces, in sub-quads of polygons."""
    rng = np.random.default_rng(1)
    faces = rng.integers(0, msh.num_faces, count)
    uv = rng.random((count, 2))
    uv[:10] = np.round(uv[:10])
    uv[10:20, 0] = np.round(uv[10:20, 0])
    return faces, uv, rng.integers(0, msh.face_sizes[faces])


@each_mesh
def test_values_are_those_of_a_serial_run(make: Callable[[MPI.Comm], Any]) -> None:
    def values(comm: MPI.Comm) -> list[Floats]:
        us = functions(make, comm)
        return [u.eval(*points(u.function_space.mesh, 200)) for u in us]

    same_as_in_serial(values)


@each_mesh
def test_each_rank_asks_for_other_points(make: Callable[[MPI.Comm], Any], comm: MPI.Comm) -> None:
    """Some of them for none."""
    for u in functions(make, comm):
        faces, uv, corners = points(u.function_space.mesh, 60)
        whole = u.eval(faces, uv, corners)
        part = slice(0, 0) if comm.rank == comm.size - 1 else slice(comm.rank, None, 2)
        np.testing.assert_array_equal(u.eval(faces[part], uv[part], corners[part]), whole[part])


def test_points_that_one_rank_gets_wrong_are_refused_by_all(comm: MPI.Comm) -> None:
    (u, *_) = functions(MESHES["L-domain"], comm)
    face = 10_000 if comm.rank == 0 else 0
    with pytest.raises(ValueError, match=f"rank 0 of {comm.size}: .*10000"):
        u.eval([face], [[0.5, 0.5]])


@each_mesh
def test_projections_have_the_values_that_they_are_of(make: Callable[[MPI.Comm], Any]) -> None:
    def values(comm: MPI.Comm) -> Floats:
        V = refined_anywhere(fem.functionspace(make(comm), ("THCCS", 3)), 3)
        x = ufl.SpatialCoordinate(V.mesh)
        return fem.project(1.0 + 2.0 * x[0] - x[1], V).eval(*points(V.mesh, 50))

    same_as_in_serial(values)
