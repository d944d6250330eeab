"""Conditions on several ranks: all know the same dofs, ghosts included, and the same values, those of a serial run."""

from collections.abc import Callable
from typing import Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
import pytest
from compared import same_as_in_serial, shared
from zoo import ZOO

import ufl
from thccs_fem import adapt, fem, generators
from thccs_fem.fem.space import FunctionSpace
from thccs_fem.parallel import gathered
from ufl import as_vector, sin

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.integer]

# Boundaries with regular and irregular vertices, with corners, and with polygons.
MESHES = {
    **{name: ZOO[name] for name in ("wheel5", "l_domain_tagged", "corner_of_five", "polygons")},
    "strip": lambda: generators.rectangle((24, 2)),  # long enough that no rank holds all of it
}


def space(comm: MPI.Comm, name: str, boundary: str = "clamped", times: int = 0) -> FunctionSpace:
    V = fem.functionspace(shared(MESHES[name](), comm), ("THCCS", 3), boundary=boundary)
    for _ in range(times):
        V = adapt.refine(V, [0, V.num_functions - 1, V.num_functions // 2])
    return V


def square(comm: MPI.Comm, n: int = 4, shape: tuple[int, ...] = ()) -> FunctionSpace:
    msh = generators.rectangle((n, n), lower=(0.0, 0.0), upper=(1.0, 1.0), comm=comm)
    return fem.functionspace(msh, ("THCCS", 3, shape))


def everywhere(V: FunctionSpace, functions: Ints) -> Ints:
    """Return the numbers of functions that ranks have found, once each rank is seen to have all that it holds."""
    numbers = V.index_map.numbers[functions]
    found = np.unique(gathered(V.mesh.comm, numbers))
    np.testing.assert_array_equal(functions, np.flatnonzero(np.isin(V.index_map.numbers, found)))
    return found


def of_all_ranks(bc: fem.DirichletBC) -> tuple[Ints, Floats]:
    """Return dofs by their numbers in the hierarchy, and values, once all ranks are seen to agree on them."""
    V = bc.function_space
    k, held = V.block_size, V.index_map.numbers
    marks, values = np.zeros(k * held.size), np.zeros(k * held.size)
    marks[bc.dofs], values[bc.dofs] = 1.0, bc.values
    of_owners = marks.copy().reshape(-1, k), values.copy().reshape(-1, k)
    for array, own in zip(of_owners, (marks, values), strict=True):
        V.index_map.scatter_forward(array)
        np.testing.assert_array_equal(array.ravel(), own)
    all_marks, all_values = (V.index_map.gather(array).ravel() for array in of_owners)
    dofs = np.flatnonzero(all_marks)
    return dofs, all_values[dofs]


@pytest.mark.parametrize("boundary", ["clamped", "crease"])
@pytest.mark.parametrize("name", MESHES)
def test_dofs_are_found_by_all_who_hold_them(name: str, boundary: str) -> None:
    def found(comm: MPI.Comm) -> list[Ints]:
        V = space(comm, name, boundary, times=2)
        return [
            everywhere(V, dofs)
            for dofs in (
                fem.boundary_dofs(V),
                fem.boundary_dofs(V, slope=True),
                fem.boundary_dofs(V, lambda x: x[0] < 0.7),
                fem.boundary_dofs(V, lambda x: x[0] < 0.7, slope=True),
                fem.region_dofs(V, [0]),
                fem.locate_dofs_geometrical(V, lambda x: x[1] > 0.2),
            )
        ]

    same_as_in_serial(found)


def test_dofs_of_tags() -> None:
    def found(comm: MPI.Comm) -> list[Ints]:
        msh = ZOO["wheel5"]()
        edges = {(int(i), int(j)): 1 + (k > 3) for k, (i, j) in enumerate(msh.edges[msh.boundary_edges])}
        tags = (np.arange(msh.num_faces) > 12).astype(np.int32)
        tagged = type(msh)(msh.vertices, msh.quads, tags, edges, comm=comm)
        V = fem.functionspace(tagged, ("THCCS", 3))
        every = [everywhere(V, fem.boundary_dofs(V, tag=tag)) for tag in (1, 2)]
        return [*every, everywhere(V, fem.region_dofs(V, tag=1))]

    same_as_in_serial(found)


def numbers_as_values(V: FunctionSpace) -> fem.Function:
    u = fem.Function(V)
    u.x.array = np.sin(V.index_map.numbers)
    return u


VALUES: dict[str, Callable[[FunctionSpace, Any], Any]] = {
    "number": lambda V, x: 2.5,
    "constant": lambda V, x: fem.Constant(V.mesh, 3.5),
    "expression": lambda V, x: sin(3 * x[0]) + x[1],
    "callable": lambda V, x: lambda x: np.exp(x[0]),
}


@pytest.mark.parametrize("name", ["wheel5", "corner_of_five", "strip"])
@pytest.mark.parametrize("value", VALUES)
def test_values_are_those_of_a_serial_run(value: str, name: str) -> None:
    def conditions(comm: MPI.Comm) -> list[tuple[Ints, Floats]]:
        V = space(comm, name, times=1)
        given = VALUES[value](V, ufl.SpatialCoordinate(V.mesh))
        parts = fem.boundary_dofs(V), fem.boundary_dofs(V, lambda x: x[0] > 0.5), fem.region_dofs(V, [0])
        return [of_all_ranks(fem.dirichletbc(given, dofs, V)) for dofs in parts]

    same_as_in_serial(conditions, tol=1e-12)  # the sums are the same, in the same order


def test_values_and_slopes() -> None:
    def conditions(comm: MPI.Comm) -> list[tuple[Ints, Floats]]:
        V = space(comm, "wheel5", times=1)
        W = FunctionSpace(V.hierarchy, (2,))
        x = ufl.SpatialCoordinate(V.mesh)
        dofs = fem.boundary_dofs(V, slope=True)
        part = fem.boundary_dofs(V, lambda x: x[0] > 0.0, slope=True)
        given = (
            (x[0] * sin(x[1]), dofs, V),
            (x[0] * sin(x[1]), part, V),
            (as_vector([x[0] * x[1], sin(x[1])]), dofs, W),
            (x[0] ** 2, part, W.sub(1)),
        )
        return [of_all_ranks(fem.dirichletbc(value, dofs, V, slope=True)) for value, dofs, V in given]

    same_as_in_serial(conditions, tol=1e-12)


def test_functions_and_components() -> None:
    def conditions(comm: MPI.Comm) -> list[tuple[Ints, Floats]]:
        V = space(comm, "wheel5", times=1)
        coarse = FunctionSpace(V.hierarchy.truncated_to(1))
        W = FunctionSpace(V.hierarchy, (2,))
        dofs = fem.boundary_dofs(V)
        x = ufl.SpatialCoordinate(V.mesh)
        given = (
            (numbers_as_values(V), dofs, V),
            (2 * numbers_as_values(coarse) + x[0], dofs, V),
            (as_vector([x[0], x[1]]), dofs, W),
            (lambda x: (x[0], x[1]), dofs, W),
            (numbers_as_values(V), dofs, W.sub(1)),
            ([1.0, 2.0], dofs, W),
        )
        return [of_all_ranks(fem.dirichletbc(value, dofs, V)) for value, dofs, V in given]

    # Values of functions are sums over local dofs, in another order on each rank; where functions can stand in for one
    # another, with a weight of 1e-6, rounding grows.
    same_as_in_serial(conditions, tol=1e-10)


def test_arrays_have_one_value_for_each_local_dof(comm: MPI.Comm) -> None:
    V = space(comm, "wheel5", times=1)
    W = FunctionSpace(V.hierarchy, (3,))
    dofs = fem.boundary_dofs(V)[::-1]
    one = fem.dirichletbc(V.reference_points[dofs, 0], dofs, V)
    np.testing.assert_array_equal(one.dofs, dofs[::-1])
    np.testing.assert_array_equal(one.values, V.reference_points[one.dofs, 0])
    three = fem.dirichletbc(V.reference_points[dofs], dofs, W)
    np.testing.assert_array_equal(three.values.reshape(-1, 3), V.reference_points[dofs[::-1]])


def test_ranks_without_any_dofs(comm: MPI.Comm) -> None:
    V = square(comm, n=16)
    dofs = fem.boundary_dofs(V, lambda x: (x[0] < 0.1) & (x[1] < 1e-9))
    counts = comm.allgather(dofs.size)
    assert 0 in counts
    assert max(counts) > 0
    x = ufl.SpatialCoordinate(V.mesh)
    for value in (1.0, x[0], lambda x: x[0], V.reference_points[dofs, 0]):
        assert fem.dirichletbc(value, dofs, V).values.shape == dofs.shape


# ---- Errors


def test_a_marker_that_fails_on_one_rank_fails_on_all(comm: MPI.Comm) -> None:
    V = square(comm)

    def marker(x: Floats) -> npt.NDArray[np.bool_]:
        if comm.rank == comm.size - 1:
            raise KeyError("no such place")
        return x[0] > 0.5

    for find in (fem.boundary_dofs, fem.locate_dofs_geometrical):
        with pytest.raises(KeyError, match="no such place"):
            find(V, marker)


def test_values_that_one_rank_finds_bad(comm: MPI.Comm) -> None:
    V = square(comm)
    dofs = fem.boundary_dofs(V)
    last = comm.rank == comm.size - 1
    with pytest.raises(ValueError, match=f"rank {comm.size - 1} of {comm.size}: the value nan is not finite"):
        fem.dirichletbc(np.nan if last else 1.0, dofs, V)
    with pytest.raises(ValueError, match=f"rank {comm.size - 1} of {comm.size}: dofs run from 0 to"):
        fem.dirichletbc(1.0, [-1] if last else dofs, V)
    with pytest.raises(ValueError, match=f"rank {comm.size - 1} of {comm.size}: g.x. returned shape"):
        fem.dirichletbc(lambda x: x[0, 1:] if last else x[0], dofs, V)


def test_what_no_rank_sees_whole_is_told_as_in_a_serial_run(comm: MPI.Comm) -> None:
    V = square(comm)
    x = ufl.SpatialCoordinate(V.mesh)
    with pytest.raises(ValueError, match=r"^the value is not finite on 8 of the 16 edges"):
        fem.dirichletbc(ufl.sqrt(x[1] - 0.5), fem.boundary_dofs(V), V)
    everything = np.arange(V.num_local_dofs)
    with pytest.raises(
        ValueError, match=r"^9 of the 49 dofs have neither value nor slope on the boundary, the first is"
    ):
        fem.dirichletbc(x[0], everything, V, slope=True)
