"""Who owns what, asked on real ranks, and values that travel between them; tests/test_partition.py has the rest."""

from collections.abc import Callable

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
import pytest
from compared import shared
from problems import refined_anywhere
from zoo import ZOO

from thccs_fem import adapt, fem, generators
from thccs_fem.index_map import Fetch, IndexMap
from thccs_fem.partition import Partition, cell_owners, partition
from thccs_fem.prolongation import Prolongation

Floats = npt.NDArray[np.float64]

SPACES: dict[str, Callable[[MPI.Comm], fem.FunctionSpace]] = {
    "torus": lambda comm: fem.functionspace(generators.torus((12, 6), comm=comm), ("THCCS", 3)),
    "L-domain": lambda comm: anywhere(fem.functionspace(generators.l_domain(3, comm=comm), ("THCCS", 3))),
    "components": lambda comm: anywhere(fem.functionspace(shared(ZOO["cube_and_torus"](), comm), ("THCCS", 3))),
    "one cell": lambda comm: fem.functionspace(generators.rectangle((1, 1), comm=comm), ("THCCS", 3)),
}
each_space = pytest.mark.parametrize("make", SPACES.values(), ids=SPACES)


def anywhere(V: fem.FunctionSpace) -> fem.FunctionSpace:
    return refined_anywhere(V, 4)


def maps(V: fem.FunctionSpace) -> list[IndexMap]:
    parts = partition(V.hierarchy)
    return [parts.cells, parts.functions]


@each_space
def test_ranks_own_what_is_theirs(make: Callable[[MPI.Comm], fem.FunctionSpace], comm: MPI.Comm) -> None:
    V = make(comm)
    owners = comm.bcast(cell_owners(V.hierarchy, comm.size))
    expected = Partition.of(V.hierarchy, comm, owners)
    assert partition(V.hierarchy).imbalance == expected.imbalance
    for ours, theirs in zip(maps(V), (expected.cells, expected.functions), strict=True):
        np.testing.assert_array_equal(ours.numbers, theirs.numbers)
        assert comm.allreduce(ours.size_local) == ours.size_global
        assert (ours.local_range[0] == 0) == (comm.exscan(ours.size_local) in (None, 0))
        everywhere = comm.allgather(ours.numbers[: ours.size_local])
        for ghost, owner in zip(ours.numbers[ours.size_local :], ours.owners, strict=True):
            assert ghost in everywhere[owner]


@each_space
@pytest.mark.parametrize("shape", [(), (3,)], ids=str)
def test_values_travel(make: Callable[[MPI.Comm], fem.FunctionSpace], shape: tuple[int, ...], comm: MPI.Comm) -> None:
    for m in maps(make(comm)):
        whole = np.random.default_rng(0).standard_normal((m.size_global, *shape))
        values = whole[m.numbers]
        values[m.size_local :] = np.nan
        m.scatter_forward(values)
        np.testing.assert_array_equal(values, whole[m.numbers])
        np.testing.assert_array_equal(m.gather(values), whole)
        wanted = np.random.default_rng(comm.rank).integers(0, m.size_global, 20)
        fetch = Fetch(m, wanted)
        np.testing.assert_array_equal(fetch(values), whole[wanted])
        # <fetch(x), y> = <x, add_back(y)>, and the same of ghosts
        y, x = np.random.default_rng([1, comm.rank]).standard_normal((20, *shape)), whole[m.numbers]
        back, ghosts = np.zeros_like(values), np.random.default_rng([2, comm.rank]).standard_normal(values.shape)
        fetch.add_back(y, back)
        added = ghosts.copy()
        m.reverse_add(added)
        owned = slice(m.size_local)
        sums = [
            (fetch(x) * y).sum(),
            (x[owned] * back[owned]).sum(),
            (x * ghosts).sum(),
            (x[owned] * added[owned]).sum(),
        ]
        forth, fro, here, there = comm.allreduce(np.array(sums))
        assert forth == pytest.approx(fro, abs=1e-11)  # some thousand products of size 1
        assert here == pytest.approx(there, abs=1e-11)


@each_space
def test_prolongation_is_that_of_one_rank(make: Callable[[MPI.Comm], fem.FunctionSpace], comm: MPI.Comm) -> None:
    V = make(comm)
    fine = adapt.refine(V, np.arange(0, V.num_functions, 3))
    T = Prolongation(fine.hierarchy, V.hierarchy)
    whole = fine.hierarchy.prolongation(V.hierarchy)
    x = np.random.default_rng(0).standard_normal((V.num_functions, 2))
    y = np.random.default_rng(1).standard_normal((fine.num_functions, 2))
    (_, coarse), (_, finer) = maps(V), maps(fine)
    np.testing.assert_allclose(T(x[coarse.numbers]), (whole @ x)[finer.numbers], atol=1e-13)  # means of size 1
    found = coarse.gather(T.transposed(y[finer.numbers]))
    np.testing.assert_allclose(found, whole.T @ y, atol=1e-12)


def test_one_rank_may_ask_for_sizes(comm: MPI.Comm) -> None:
    """Making a space is collective, to print how large it is is not."""
    V = adapt.refine(SPACES["torus"](comm), [0, 5])
    if comm.rank == 0:
        assert V.num_cells > 72
        assert V.num_dofs > V.num_owned_dofs > 0
        assert V.index_map.size_global == V.num_functions
