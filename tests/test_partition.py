"""Parts of hierarchies, all of them in one process: a rank is asked for no more than its number."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from problems import graded_l_domain, refined_anywhere
from ranks import Comm, on_ranks
from refinements import CASES, STEPS, Choice, random_vector, refinements
from zoo import ZOO

from thccs_fem import fem, generators
from thccs_fem.extraction import Cells, extract
from thccs_fem.facets import Facets, boundary_facets, interior_facets
from thccs_fem.hierarchy import Hierarchy
from thccs_fem.mesh import ControlMesh
from thccs_fem.partition import OPERATOR_WEIGHT, Partition, cell_owners, partition

Ints = npt.NDArray[np.integer]
Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Rank:
    rank: int
    size: int


def parts_of(hierarchy: Hierarchy, size: int) -> tuple[Ints, list[Partition]]:
    """Return the rank of each cell, and what each of so many ranks owns and holds."""
    owners = cell_owners(hierarchy, size)
    return owners, [Partition.of(hierarchy, Rank(rank, size), owners) for rank in range(size)]


def deep() -> Hierarchy:
    """Return a graded hierarchy of 26 levels, around a reentrant corner, on one face of which there are most cells."""
    hierarchy = Hierarchy.on(generators.l_domain(2))
    for _ in range(25):
        finest = hierarchy.dof_offsets[-2]
        hierarchy = hierarchy.refined(np.arange(finest, min(finest + 6, hierarchy.num_dofs)))
    assert hierarchy.num_levels == 26
    return hierarchy


HIERARCHIES: dict[str, Callable[[], Hierarchy]] = {
    "deep": deep,
    "graded": lambda: graded_l_domain(8).hierarchy,
    "polygons": lambda: refined_anywhere(fem.functionspace(ZOO["polygons"](), ("THCCS", 3)), 4).hierarchy,
    "components": lambda: refined_anywhere(fem.functionspace(ZOO["cube_and_torus"](), ("THCCS", 3)), 4).hierarchy,
    "single face": lambda: Hierarchy.on(ZOO["single_quad"]()),
}


@cache
def hierarchy_of(name: str) -> Hierarchy:
    return HIERARCHIES[name]()


# ---- What ranks own and hold


@settings(max_examples=12)
@given(case=st.sampled_from(CASES), steps=STEPS, size=st.integers(2, 7))
def test_parts_of_random_refinements(case: tuple[str, str], steps: list[list[Choice]], size: int) -> None:
    check_parts(refinements(*case, steps)[-1], size)


@pytest.mark.parametrize("size", [2, 5])
@pytest.mark.parametrize("name", HIERARCHIES)
def test_parts(name: str, size: int) -> None:
    check_parts(hierarchy_of(name), size)


def test_more_ranks_than_cells() -> None:
    check_parts(Hierarchy.on(ZOO["strip"]()), 9)


def check_parts(hierarchy: Hierarchy, size: int) -> None:
    owners, parts = parts_of(hierarchy, size)
    cells = extract(hierarchy)
    used = uses(cells)
    met = meeting(cells)
    for what in ("cells", "functions"):
        maps = [getattr(part, what) for part in parts]
        owned = np.concatenate([m.numbers[: m.size_local] for m in maps])
        np.testing.assert_array_equal(np.sort(owned), np.arange(maps[0].size_global))
        for m in maps:  # the same numbers on all ranks: rank after rank, ascending within each
            np.testing.assert_array_equal(m.local_to_global(np.arange(m.size_local)), np.arange(*m.local_range))
            np.testing.assert_array_equal(owned[m.ghosts], m.numbers[m.size_local :])
            assert (np.diff(m.numbers[: m.size_local]) > 0).all()
            assert (np.diff(m.ghosts) > 0).all()
    for rank, part in enumerate(parts):
        np.testing.assert_array_equal(part.cells.numbers[: part.cells.size_local], np.flatnonzero(owners == rank))
        held = np.isin(np.arange(cells.num_cells), part.cells.numbers)
        mine = np.isin(np.arange(cells.num_dofs), part.functions.numbers[: part.functions.size_local])
        reached = used[:, mine].any(axis=1) | (owners == rank)
        assert held[reached].all()
        assert held[met[reached].any(axis=0)].all()  # and cells beside these
        np.testing.assert_array_equal(
            used[held].any(axis=0), np.isin(np.arange(cells.num_dofs), part.functions.numbers)
        )


def uses(cells: Cells) -> npt.NDArray[np.bool_]:
    """Return the functions that do not vanish on each cell, shape (num_cells, num_dofs)."""
    offsets, dofs = cells.cell_dofs
    result = np.zeros((cells.num_cells, cells.num_dofs), dtype=bool)
    result[np.repeat(np.arange(cells.num_cells), np.diff(offsets)), dofs] = True
    return result


def meeting(cells: Cells) -> npt.NDArray[np.bool_]:
    """Return which cells share a facet, shape (num_cells, num_cells)."""
    a, b = interior_facets(cells).facet_cells.T
    result = np.zeros((cells.num_cells, cells.num_cells), dtype=bool)
    result[a, b] = result[b, a] = True
    return result


# ---- What is made of them


@settings(max_examples=8)
@given(case=st.sampled_from(CASES), steps=STEPS, size=st.integers(2, 4))
def test_cells_and_facets_of_ranks_are_those_of_the_whole(
    case: tuple[str, str], steps: list[list[Choice]], size: int
) -> None:
    check_cells(refinements(*case, steps)[-1], size)


@pytest.mark.parametrize("name", HIERARCHIES)
def test_cells_and_facets_of_ranks(name: str) -> None:
    check_cells(hierarchy_of(name), 3)


def check_cells(hierarchy: Hierarchy, size: int) -> None:
    whole = extract(hierarchy)
    u = random_vector(hierarchy.num_dofs)
    owners, parts = parts_of(hierarchy, size)
    found = [0, 0]
    for rank, part in enumerate(parts):
        cells = extract(hierarchy, part)
        numbers = part.cells.numbers
        for name in ("level", "level_face", "face"):
            np.testing.assert_array_equal(getattr(cells, name), getattr(whole, name)[numbers])
        same = pieces_in(whole, cells)
        np.testing.assert_array_equal(whole.piece_cell[same], numbers[cells.piece_cell])
        local = cells.local(u[part.functions.numbers])
        np.testing.assert_allclose(local, whole.local(u)[same], atol=1e-13)  # sums of some ten terms of size 1
        np.testing.assert_array_equal(cells.piece_points, whole.piece_points[same])
        for kind, facets_of in enumerate((boundary_facets, interior_facets)):
            mine, all_of_them = facets_of(cells), facets_of(whole)
            if not all_of_them.num_facets:
                continue
            ours = np.column_stack([same[mine.pieces], squares(mine), mine.edge])  # '+' and '-' as in the whole
            theirs = np.column_stack([all_of_them.pieces, squares(all_of_them), all_of_them.edge])
            assert rows(ours) <= rows(theirs)
            # All that an owned cell has are there; over all ranks each counts where its first cell is owned.
            touching = (mine.facet_cells < cells.num_owned).any(axis=1)
            here = np.isin(all_of_them.facet_cells, np.flatnonzero(owners == rank)).any(axis=1)
            assert rows(ours[touching]) == rows(theirs[here])
            found[kind] += int(np.count_nonzero(mine.facet_cells[:, 0] < cells.num_owned))
    assert found == [facets_of(whole).num_facets for facets_of in (boundary_facets, interior_facets)]


def pieces_in(whole: Cells, cells: Cells) -> Ints:
    """Return the piece of the whole that each of the given cells is."""
    places = {key: piece for piece, key in enumerate(piece_keys(whole, np.arange(whole.num_cells)))}
    return np.array([places[key] for key in piece_keys(cells, cells.partition.cells.numbers)], dtype=int)


def piece_keys(cells: Cells, numbers: Ints) -> list[bytes]:
    return rows_of(np.column_stack([numbers[cells.piece_cell], cells.piece_origin, cells.piece_axes.reshape(-1, 4)]))


def squares(facets: Facets) -> Floats:
    """Return which part of its piece each side is, shape (num_facets, 6 * sides)."""
    places = np.column_stack([facets.origins, facets.axes.reshape(-1, 4)])
    return places[facets.squares].reshape(facets.num_facets, 6 * facets.num_sides)


def rows_of(array: Floats) -> list[bytes]:
    return [row.tobytes() for row in np.ascontiguousarray(array + 0.0)]  # no negative zeros


def rows(array: Floats) -> set[bytes]:
    result = set(rows_of(array))
    assert len(result) == len(array)
    return result


# ---- Weights and cuts


@pytest.mark.parametrize("size", [2, 3, 8])
@pytest.mark.parametrize("name", ["deep", "graded", "polygons", "components"])
def test_parts_have_the_same_weight(name: str, size: int) -> None:
    """A cut is off by half a cell at the most, and so is what comes of the cuts after it."""
    hierarchy = hierarchy_of(name)
    owners, parts = parts_of(hierarchy, size)
    weights = pieces_with_operators(extract(hierarchy))
    of_parts = np.bincount(owners, weights=weights, minlength=size)
    assert of_parts.max() <= of_parts.mean() + weights.max()
    for part in parts:
        assert part.imbalance == pytest.approx(of_parts.max() / of_parts.mean(), rel=1e-12)


def pieces_with_operators(cells: Cells) -> Floats:
    """Return the cost of each cell, counted in the batches."""
    weights = np.zeros(cells.num_cells)
    for batch in cells.batches:
        weights[batch.cells] += np.diff(batch.offsets) * (1 if batch.operators is None else OPERATOR_WEIGHT)
    return weights


@settings(max_examples=15)
@given(case=st.sampled_from(CASES), steps=STEPS)
def test_weights_are_those_of_pieces(case: tuple[str, str], steps: list[list[Choice]]) -> None:
    hierarchy = refinements(*case, steps)[-1]
    owners, (part, _) = parts_of(hierarchy, 2)
    of_parts = np.bincount(owners, weights=pieces_with_operators(extract(hierarchy)), minlength=2)
    assert part.imbalance == pytest.approx(of_parts.max() / of_parts.mean(), rel=1e-12)


def num_cut(hierarchy: Hierarchy, owners: Ints) -> int:
    """Return the number of facets between the cells of different ranks."""
    a, b = interior_facets(extract(hierarchy)).facet_cells.T
    return int(np.count_nonzero(owners[a] != owners[b]))


@pytest.mark.parametrize("size", [2, 4, 8])
def test_a_torus_is_cut_across_its_tube(size: int) -> None:
    hierarchy = Hierarchy.on(generators.torus((64, 16)))
    assert num_cut(hierarchy, cell_owners(hierarchy, size)) == size * 16


@pytest.mark.parametrize(("size", "cut"), [(2, 32), (4, 64)])
def test_a_square_is_cut_in_squares(size: int, cut: int) -> None:
    hierarchy = Hierarchy.on(generators.rectangle((32, 32)), "crease")
    assert num_cut(hierarchy, cell_owners(hierarchy, size)) == cut


def test_a_turned_bar_is_cut_across() -> None:
    bar = generators.rectangle((40, 4))
    turn = np.array([[1.0, 2.0], [-2.0, 1.0]]) / np.sqrt(5.0)
    bar = ControlMesh(np.column_stack([10.0 * bar.vertices[:, 0], bar.vertices[:, 1]]) @ turn.T, bar.quads)
    hierarchy = Hierarchy.on(bar)
    assert num_cut(hierarchy, cell_owners(hierarchy, 2)) == 4


# ---- One for each hierarchy


def test_a_single_rank_has_all_in_the_order_of_the_hierarchy() -> None:
    hierarchy = Hierarchy.on(ZOO["cube_and_torus"]())
    parts = partition(hierarchy)
    assert partition(hierarchy) is parts
    assert parts.cells.is_whole
    assert parts.functions.is_whole
    assert (parts.cells.size_local, parts.cells.num_ghosts) == (extract(hierarchy).num_cells, 0)
    assert (parts.functions.size_local, parts.functions.num_ghosts) == (hierarchy.num_dofs, 0)
    assert parts.imbalance == 1.0


def test_ranks_agree() -> None:
    tripod = ZOO["tripod"]()

    def owned(comm: Comm) -> Sequence[Ints]:
        parts = partition(Hierarchy.on(ControlMesh(tripod.vertices, tripod.quads, comm=comm)))
        return [m.numbers[: m.size_local] for m in (parts.cells, parts.functions)]

    found = on_ranks(3, owned)
    _, parts = parts_of(Hierarchy.on(tripod), 3)
    for ours, part in zip(found, parts, strict=True):
        assert not isinstance(ours, BaseException), ours
        for numbers, m in zip(ours, (part.cells, part.functions), strict=True):
            np.testing.assert_array_equal(numbers, m.numbers[: m.size_local])
