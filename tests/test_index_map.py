"""Numbers on several ranks, which are threads here, and values on their way between them."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from ranks import Comm, on_ranks

from thccs_fem.index_map import Fetch, IndexMap

Floats = npt.NDArray[np.float64]

COUNT = 40
# Ranks, how many of them own anything, and the columns of values.
CASES = pytest.mark.parametrize(
    ("size", "owning", "k"), [(1, 1, ()), (2, 2, ()), (3, 3, (2,)), (4, 3, (1,)), (3, 1, ())]
)


def spread(comm: Comm, owning: int) -> IndexMap:
    """Return a map with owners, and ghosts of the rank, by chance."""
    owners = np.random.default_rng(0).integers(0, owning, COUNT)
    return IndexMap.spread(comm, owners, np.random.default_rng(1 + comm.rank).random(COUNT) < 0.3)


def on_maps[T](size: int, owning: int, work: Callable[[IndexMap], T]) -> Sequence[T]:
    """Return what work makes of the map of each rank."""
    outcomes = on_ranks(size, lambda comm: work(spread(comm, owning)))
    for outcome in outcomes:
        if isinstance(outcome, BaseException):
            raise outcome
    return outcomes  # type: ignore[return-value]  # none is an exception


def values_of(index_map: IndexMap, shape: tuple[int, ...], seed: int) -> Floats:
    """Return random values, other ones on each rank."""
    rng = np.random.default_rng([seed, index_map.comm.rank])
    return rng.standard_normal((index_map.numbers.size, *shape))


def whole_values(shape: tuple[int, ...]) -> Floats:
    return np.random.default_rng(7).standard_normal((COUNT, *shape))


@CASES
def test_three_ways_to_number(size: int, owning: int, k: tuple[int, ...]) -> None:
    maps = on_maps(size, owning, lambda index_map: index_map)
    owned = [m.numbers[: m.size_local] for m in maps]
    np.testing.assert_array_equal(np.sort(np.concatenate(owned)), np.arange(COUNT))
    by_global = np.concatenate(owned)
    for rank, m in enumerate(maps):
        local = np.arange(m.numbers.size)
        assert m.size_global == COUNT
        assert m.size_local + m.num_ghosts == m.numbers.size
        assert m.local_range == (sum(map(len, owned[:rank])), sum(map(len, owned[: rank + 1])))
        np.testing.assert_array_equal(by_global[m.local_to_global(local)], m.numbers)
        np.testing.assert_array_equal(m.local_to_global(local[m.size_local :]), m.ghosts)
        assert (np.diff(m.ghosts) > 0).all()
        for ghost, owner in zip(m.numbers[m.size_local :], m.owners, strict=True):
            assert owner != rank
            assert ghost in owned[owner]
        np.testing.assert_array_equal(m.local_of(m.numbers), local)
        others = np.setdiff1d(np.arange(COUNT), m.numbers)
        np.testing.assert_array_equal(m.local_of(others), np.full(others.size, -1))
        assert m.local_of(np.arange(COUNT).reshape(5, 8)).shape == (5, 8)
    assert sum(m.size_local == 0 for m in maps) == size - owning


@CASES
def test_ghosts_get_the_values_of_their_owners(size: int, owning: int, k: tuple[int, ...]) -> None:
    whole = whole_values(k)

    def scattered(index_map: IndexMap) -> tuple[Floats, Floats]:
        values = whole[index_map.numbers]
        values[index_map.size_local :] = np.nan
        index_map.scatter_forward(values)
        return values, whole[index_map.numbers]

    for found, expected in on_maps(size, owning, scattered):
        np.testing.assert_array_equal(found, expected)


@CASES
def test_adding_ghosts_to_their_owners_is_the_transpose(size: int, owning: int, k: tuple[int, ...]) -> None:
    def products(index_map: IndexMap) -> tuple[float, float, float]:
        x, y = values_of(index_map, k, 1), values_of(index_map, k, 2)
        x[index_map.size_local :] = 0.0
        there, back = x.copy(), y.copy()
        index_map.scatter_forward(there)
        index_map.reverse_add(back)
        return float((there * y).sum()), float((x * back).sum()), float(np.abs(back[index_map.size_local :]).sum())

    forth, back, left = np.sum(on_maps(size, owning, products), axis=0)
    assert forth == pytest.approx(back, abs=1e-12)  # some hundred products of size 1
    assert left == 0.0


@CASES
def test_gathered_values_stand_in_the_order_of_numbers(size: int, owning: int, k: tuple[int, ...]) -> None:
    whole = whole_values(k)

    def gathered(index_map: IndexMap) -> list[npt.NDArray[Any]]:
        held = whole[index_map.numbers]
        held[index_map.size_local :] = np.nan  # not asked for
        owned = index_map.numbers[: index_map.size_local]
        return [index_map.gather(held), index_map.gather(held[: owned.size]), index_map.gather(owned % 2 == 0)]

    for of_held, of_owned, marks in on_maps(size, owning, gathered):
        np.testing.assert_array_equal(of_held, whole)
        np.testing.assert_array_equal(of_owned, whole)
        np.testing.assert_array_equal(marks, np.arange(COUNT) % 2 == 0)
        assert marks.dtype == np.bool_


def wanted_of(index_map: IndexMap) -> npt.NDArray[np.integer]:
    """Return numbers by chance, some of them twice, and none on rank 1."""
    rank = index_map.comm.rank
    return np.random.default_rng(rank).integers(0, COUNT, 0 if rank == 1 else 30)


@CASES
def test_what_is_wanted_is_fetched(size: int, owning: int, k: tuple[int, ...]) -> None:
    whole = whole_values(k)

    def fetched(index_map: IndexMap) -> tuple[Floats, Floats]:
        wanted = wanted_of(index_map)
        held = whole[index_map.numbers]
        held[index_map.size_local :] = np.nan  # not asked for
        return Fetch(index_map, wanted)(held), whole[wanted]

    for found, expected in on_maps(size, owning, fetched):
        np.testing.assert_array_equal(found, expected)


@CASES
def test_adding_back_is_the_transpose_of_fetching(size: int, owning: int, k: tuple[int, ...]) -> None:
    def products(index_map: IndexMap) -> tuple[float, float]:
        fetch = Fetch(index_map, wanted_of(index_map))
        x = values_of(index_map, k, 1)
        x[index_map.size_local :] = 0.0
        there = fetch(x)
        y = np.random.default_rng([3, index_map.comm.rank]).standard_normal(there.shape)
        back = np.zeros_like(x)
        fetch.add_back(y, back)
        return float((there * y).sum()), float((x * back).sum())

    forth, back = np.sum(on_maps(size, owning, products), axis=0)
    assert forth == pytest.approx(back, abs=1e-12)  # some hundred products of size 1


def test_in_serial_all_numbers_are_one() -> None:
    whole = IndexMap.whole(5)
    assert whole.is_whole
    assert (whole.size_global, whole.size_local, whole.num_ghosts, whole.local_range) == (5, 5, 0, (0, 5))
    for numbers in (whole.numbers, whole.local_to_global(np.arange(5)), whole.local_of(np.arange(5))):
        np.testing.assert_array_equal(numbers, np.arange(5))
    assert (whole.ghosts.size, whole.owners.size) == (0, 0)
    values = np.arange(5.0)
    for call in (whole.scatter_forward, whole.reverse_add):
        call(values)
        np.testing.assert_array_equal(values, np.arange(5.0))
    copy = whole.gather(values)
    np.testing.assert_array_equal(copy, values)
    assert not np.shares_memory(copy, values)
    fetch = Fetch(whole, np.array([4, 0, 4]))
    np.testing.assert_array_equal(fetch(values), [4.0, 0.0, 4.0])
    fetch.add_back(np.ones(3), values)
    np.testing.assert_array_equal(values, [1.0, 1.0, 2.0, 3.0, 6.0])


def test_what_all_ranks_hold_whole_is_owned_by_each() -> None:
    """Such are the faces of a control mesh."""

    def sizes(comm: Comm) -> tuple[int, int, tuple[int, int]]:
        whole = IndexMap.whole(4, comm)
        return whole.size_local, whole.num_ghosts, whole.local_range

    assert on_ranks(3, sizes) == [(4, 0, (0, 4))] * 3
