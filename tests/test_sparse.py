"""Our sparse matrices against SciPy's."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from thccs_fem.sparse import (
    COMPUTED,
    EMPTY,
    Triplets,
    absolute_sums,
    csr,
    entries,
    first_rows,
    product,
    restricted,
    rows_of,
    stacked,
    summed,
    transposed,
    without_rounding,
)

SEEDS = st.integers(0, 2**32 - 1)
ROUNDING = 1e-14  # sums of some dozen products of numbers up to 1


def random(seed: int, shape: tuple[int, int], count: int) -> tuple[Triplets, sp.csr_array]:
    """Triplets in any order, with places that occur several times and some that are negative, and SciPy's sum."""
    rng = np.random.default_rng(seed)
    rows, columns = (rng.integers(-1, n, count) if n else np.full(count, -1) for n in shape)
    values = rng.uniform(-1.0, 1.0, count)
    used = (rows >= 0) & (columns >= 0)
    expected = sp.csr_array((values[used], (rows[used], columns[used])), shape=shape)
    half = count // 2
    return [(rows[:half], columns[:half], values[:half]), (rows[half:], columns[half:], values[half:])], expected


def check(matrix: sp.csr_array, expected: sp.csr_array) -> None:
    """It is a whole matrix of SciPy's, with ascending columns and int32 indices, and equal to the other one."""
    assert matrix.shape == expected.shape
    assert matrix.indices.dtype == matrix.indptr.dtype == np.int32
    again = sp.csr_array((matrix.data, matrix.indices, matrix.indptr), shape=matrix.shape)
    again.check_format(full_check=True)
    assert all(np.all(np.diff(matrix.indices[a:b]) > 0) for a, b in zip(matrix.indptr, matrix.indptr[1:], strict=False))
    np.testing.assert_allclose(matrix.toarray(), expected.toarray(), rtol=0, atol=ROUNDING)


@settings(max_examples=30)
@given(seed=SEEDS, shape=st.tuples(st.integers(0, 6), st.integers(0, 6)), count=st.integers(0, 60))
def test_sums_of_triplets(seed, shape, count):
    triplets, expected = random(seed, shape, count)
    check(summed(triplets, shape), expected)


def test_one_value_for_many_places():
    zeros, twos = np.zeros(3, dtype=int), np.full(3, 2)
    np.testing.assert_array_equal(summed([(zeros, twos, 0.5)], (1, 3)).toarray(), [[0.0, 0.0, 1.5]])


@settings(max_examples=30)
@given(seed=SEEDS, sizes=st.tuples(*[st.integers(1, 7)] * 3))
def test_products_and_rows(seed, sizes):
    m, k, n = sizes
    (_, a), (_, b) = random(seed, (m, k), 3 * m), random(seed + 1, (k, n), 3 * k)
    check(product(a, b), sp.csr_array(a @ b))
    rows = np.random.default_rng(seed).integers(0, m, 5)
    check(rows_of(a, rows), a[rows])
    check(first_rows(a, m // 2), a[: m // 2])
    check(stacked([a, a, first_rows(a, 0)]), sp.csr_array(sp.vstack([a, a])))
    check(summed([entries(a), entries(a, m)], (2 * m, k)), sp.csr_array(sp.vstack([a, a])))


@settings(max_examples=30)
@given(seed=SEEDS, sizes=st.tuples(*[st.integers(1, 7)] * 3))
def test_products_with_rows_given(seed, sizes):
    m, k, n = sizes
    (_, a), (_, b) = random(seed, (m, k), 3 * m), random(seed + 1, (k, n), 3 * k)
    unit = np.random.default_rng(seed).choice([COMPUTED, EMPTY, *range(n)], m).astype(np.int32)
    expected = (a @ b).toarray()
    expected[unit == EMPTY] = 0.0
    expected[unit >= 0] = np.eye(n)[unit[unit >= 0]]
    check(product(a, b, unit), sp.csr_array(expected))


def test_products_have_no_zeros():
    a, b = sp.csr_array([[1.0, -1.0], [1.0, 1.0]]), sp.csr_array([[0.5, 1.0], [0.5, 2.0]])
    assert product(a, b).nnz == 3


@settings(max_examples=30)
@given(seed=SEEDS, shape=st.tuples(st.integers(1, 9), st.integers(1, 9)))
def test_parts_in_rows_and_columns(seed, shape):
    _, a = random(seed, shape, 40)
    rng = np.random.default_rng(seed)
    rows = rng.integers(0, shape[0], rng.integers(0, 7))
    columns = np.sort(rng.permutation(shape[1])[: rng.integers(0, shape[1] + 1)])
    check(restricted(a, rows, columns), a[rows][:, columns])


@settings(max_examples=30)
@given(seed=SEEDS, shape=st.tuples(st.integers(0, 9), st.integers(1, 9)))
def test_absolute_sums(seed, shape):
    _, a = random(seed, shape, 40)
    for found, axis in zip(absolute_sums(a), (1, 0), strict=True):
        np.testing.assert_allclose(found, np.abs(a.toarray()).sum(axis=axis), rtol=0, atol=ROUNDING)


@given(seed=SEEDS, shape=st.tuples(st.integers(0, 9), st.integers(0, 9)))
def test_transposed(seed, shape):
    triplets, expected = random(seed, shape, 40)
    check(transposed(summed(triplets, shape)), sp.csr_array(expected.T))


@given(seed=SEEDS, shape=st.tuples(st.integers(0, 9), st.integers(1, 9)), tolerance=st.sampled_from([0.0, 0.5, 9.0]))
def test_without_rounding(seed, shape, tolerance):
    triplets, expected = random(seed, shape, 40)
    a = summed(triplets, shape)
    found = without_rounding(a, tolerance)
    check(found, sp.csr_array(np.where(np.abs(a.toarray()) >= tolerance, a.toarray(), 0.0)))
    assert (np.abs(found.data) >= tolerance).all()
    assert a.nnz >= found.nnz  # and a is as it was
    np.testing.assert_allclose(a.toarray(), expected.toarray(), rtol=0, atol=ROUNDING)


@pytest.mark.parametrize("columns", [1, 40, 4000])
def test_long_rows(columns):
    order = np.random.default_rng(columns).permutation(columns)
    np.testing.assert_array_equal(
        summed([(0 * order, order, order / 1.0)], (1, columns)).toarray(), [np.arange(columns)]
    )


def test_a_matrix_of_ours_can_be_used_as_any_of_scipys():
    ours = csr(np.array([1.0, 2.0]), np.array([1, 0], np.int32), np.array([0, 1, 2], np.int32), (2, 3))
    other = sp.csr_array([[0.0, 1.0, 0.0], [2.0, 0.0, 0.0]])
    assert ours.shape == other.shape
    assert ours.nnz == 2
    assert ours.has_sorted_indices
    for result, expected in (
        (ours @ np.ones(3), other @ np.ones(3)),
        *(((f(ours)).toarray(), f(other).toarray()) for f in (lambda a: a.T, abs, lambda a: a + a, lambda a: a @ a.T)),
        (ours[1:].toarray(), other[1:].toarray()),
        (ours.tocsc().toarray(), other.toarray()),
        (ours.copy().toarray(), other.toarray()),
    ):
        np.testing.assert_array_equal(result, expected)
    assert str(ours) == str(other)
