"""Refinement and coarsening of spaces."""

import numpy as np
import numpy.typing as npt
import pytest
from problems import uniformly_refined
from spaces import each_space, space, supports

from thccs_fem import adapt, fem, generators

# ---- Refinement


@each_space
def test_refinement_makes_a_new_space_and_leaves_the_old_one(name: str) -> None:
    V = space(name)
    dofs, cells, keys = V.num_dofs, V.cells, [k.copy() for k in V.hierarchy.refined_keys]
    points = cells.points.copy()
    fine = adapt.refine(V, [0])
    assert fine is not V
    assert fine != V
    assert fine.is_refinement_of(V)
    assert fine.num_cells > V.num_cells
    assert (V.num_dofs, V.cells) == (dofs, cells)
    np.testing.assert_array_equal(V.cells.points, points)
    for before, after in zip(keys, V.hierarchy.refined_keys, strict=True):
        np.testing.assert_array_equal(before, after)


@each_space
def test_the_cells_of_a_function_are_refined(name: str) -> None:
    V = space(name)
    for i in (0, V.num_functions // 2, V.num_functions - 1):
        level = np.searchsorted(V.hierarchy.dof_offsets, i, side="right") - 1
        own = [cell for cell in supports(name)[i] if V.cells.level[cell] == level]
        fine = adapt.refine(V, [i])
        left = set(zip(fine.cells.level.tolist(), keys(fine), strict=True))
        before = list(zip(V.cells.level.tolist(), keys(V), strict=True))
        assert own
        assert {before[cell] for cell in own}.isdisjoint(left)
        # What was not in the support of the function has not changed.
        assert {before[cell] for cell in set(range(V.num_cells)) - supports(name)[i]} <= left


def keys(V: fem.FunctionSpace) -> list[int]:
    """Return a number for each cell by which it is known on its level in all hierarchies of the mesh."""
    levels = [stage.level for stage in V.hierarchy.stages]
    return [int(levels[l].keys[f]) for l, f in zip(V.cells.level, V.cells.level_face, strict=True)]


def test_order_and_repetition_do_not_matter() -> None:
    V = space("refined wheel")
    fine = adapt.refine(V, [7, 3, 3])
    assert fine == adapt.refine(V, np.array([3, 7], dtype=np.int32))


def test_refining_all_functions_refines_all_cells() -> None:
    V = space("grid")
    assert uniformly_refined(V, times=2).num_cells == 16 * V.num_cells


def test_a_vector_valued_space_stays_one() -> None:
    V = fem.FunctionSpace(space("grid").hierarchy, (2,))
    fine = adapt.refine(V, [0])
    assert fine.value_shape == (2,)
    assert fine.num_functions == adapt.refine(space("grid"), [0]).num_functions
    with pytest.raises(ValueError, match=f"functions run from 0 to {V.num_functions - 1}; got 0 to {V.num_functions}"):
        adapt.refine(V, [0, V.num_functions])


@pytest.mark.parametrize("marked", [[-1], [0, 42]])
def test_functions_out_of_range_are_named(marked: list[int]) -> None:
    with pytest.raises(ValueError, match=f"functions run from 0 to 41; got {min(marked)} to {max(marked)}"):
        adapt.refine(space("grid"), marked)


@pytest.mark.parametrize("marked", [[0.5], np.ones(42, dtype=bool)])
def test_marks_are_numbers_of_functions(marked: npt.ArrayLike) -> None:
    with pytest.raises(TypeError, match="marked functions must be integers"):
        adapt.refine(space("grid"), marked)


def test_how_marks_become_numbers_is_said() -> None:
    with pytest.raises(TypeError, match=r"got bool: np.flatnonzero\(marks\) makes numbers of marks"):
        adapt.refine(space("grid"), np.ones(42, dtype=bool))


# ---- Coarsening


@each_space
def test_coarsening_undoes_refinement(name: str) -> None:
    V = space(name)
    fine = adapt.refine(V, [0, 5])
    before = set(zip(V.cells.level.tolist(), keys(V), strict=True))
    new = np.array([cell not in before for cell in zip(fine.cells.level.tolist(), keys(fine), strict=True)])
    assert adapt.coarsen(fine, new) == V
    assert adapt.coarsen(fine, np.flatnonzero(new)[::-1]) == V
    assert adapt.coarsen(fine, []) is fine


def test_coarsening_keeps_the_kind_of_space() -> None:
    fine = adapt.refine(fem.FunctionSpace(space("grid").hierarchy, (2,)), [0])
    coarse = adapt.coarsen(fine, np.ones(fine.num_cells, dtype=bool))
    assert coarse.value_shape == (2,)
    assert fine.is_refinement_of(coarse)
    assert coarse.num_levels == 1
    assert adapt.coarsen(coarse, np.ones(coarse.num_cells, dtype=bool)) is coarse


def test_remeshing_refines_here_and_coarsens_there() -> None:
    V = fem.functionspace(generators.torus((16, 8)), ("THCCS", 3))
    there = adapt.refine(V, [0])
    here = np.flatnonzero(there.hierarchy.dof_functions(0) == 68)  # far from function 0
    everything = np.ones(there.num_cells, dtype=bool)
    assert adapt.remesh(there, here, everything) == adapt.refine(V, [68])
    assert adapt.remesh(there, here, []) == adapt.refine(there, here)
    assert adapt.remesh(there, [], everything) == V
    assert adapt.remesh(there, [], []) is there


@pytest.mark.parametrize(
    ("cells", "error", "message"),
    [
        ([-1], ValueError, "cells run from 0 to 11; got -1 to -1"),
        ([3, 12], ValueError, "cells run from 0 to 11; got 3 to 12"),
        (np.ones(11, dtype=bool), ValueError, r"marks have shape \(11,\); there must be one for each of the 12 cells"),
        ([0.5], TypeError, "marked cells must be integers or bools"),
    ],
)
def test_cells_to_coarsen_are_checked(cells: npt.ArrayLike, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        adapt.coarsen(space("grid"), cells)
    with pytest.raises(error, match=message):
        adapt.remesh(space("grid"), [0], cells)


def test_functions_that_are_constant_on_cells_are_not_refined() -> None:
    V = fem.functionspace(generators.torus((5, 4)), ("THCCS", 3))
    D = fem.cellwise(V)
    for what, call in (
        ("refinement", lambda: adapt.refine(D, [0])),  # type: ignore[arg-type]  # what is refused
        ("coarsening", lambda: adapt.coarsen(D, [0])),  # type: ignore[arg-type]
        ("transfer", lambda: adapt.transfer(fem.Function(D), V)),
    ):
        with pytest.raises(TypeError, match=rf"{what} needs a space from .*, got CellwiseSpace"):
            call()
