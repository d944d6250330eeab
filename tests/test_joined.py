"""What is found for levels joined, or taken over from another hierarchy, has the bits that it has alone and anew."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st
from refinements import CASES, MESHES

from thccs_fem import generators, joined
from thccs_fem.bezier import bezier_masks
from thccs_fem.boundary import Boundary, to_dofs
from thccs_fem.extraction import Cells, extract
from thccs_fem.hierarchy import Hierarchy
from thccs_fem.joined import Parts, groups, joined_boundaries, joined_levels
from thccs_fem.regions import functions_meeting

CELLS = ("level", "level_face", "face", "points", "batches", "piece_origin", "piece_axes", "piece_of_face")


def arrays(thing: Any, name: str) -> Iterator[tuple[str, Any]]:
    """Yield all arrays and other values in a tree of dataclasses, with a name for each."""
    if isinstance(thing, sp.csr_array):
        yield f"{name}.shape", thing.shape
        for part in ("data", "indices", "indptr"):
            yield f"{name}.{part}", getattr(thing, part)
    elif dataclasses.is_dataclass(thing):
        for part in dataclasses.fields(thing):
            yield from arrays(getattr(thing, part.name), f"{name}.{part.name}")
    elif isinstance(thing, (tuple, list)):
        yield f"{name}.size", len(thing)
        for i, part in enumerate(thing):
            yield from arrays(part, f"{name}[{i}]")
    else:
        yield name, thing


def everything(hierarchy: Hierarchy, cells: Cells | None = None) -> Iterator[tuple[str, Any]]:
    for name in ("stages", "coefficients", "points"):
        yield from arrays(getattr(hierarchy, name), name)
    for name in CELLS if cells else ():
        yield from arrays(getattr(cells, name), name)


def check_same(ours: Iterator[tuple[str, Any]], others: Iterator[tuple[str, Any]]) -> None:
    for (name, a), (other, b) in zip(ours, others, strict=True):
        assert name == other
        if isinstance(a, np.ndarray):
            assert (a.dtype, a.shape) == (b.dtype, b.shape), name
            assert a.tobytes() == b.tobytes(), name
        else:
            assert a == b, name


def remeshed(hierarchy: Hierarchy, seed: int) -> Hierarchy:
    """The hierarchy with a few functions refined, or half of its cells coarsened."""
    rng = np.random.default_rng(seed)
    if hierarchy.num_levels < 6 and hierarchy.num_dofs < 2000 and rng.random() < 0.7:
        return hierarchy.refined(rng.choice(hierarchy.num_dofs, rng.integers(1, 4), replace=False))
    num_cells = sum(stage.active_faces.size for stage in hierarchy.stages[: hierarchy.num_levels])
    return hierarchy.coarsened(rng.choice(num_cells, num_cells // 2, replace=False))


@settings(max_examples=12)
@given(
    case=st.sampled_from(CASES),
    seeds=st.lists(st.integers(0, 2**32 - 1), min_size=2, max_size=8),
    cap=st.integers(4, 6),
)
def test_remeshed_hierarchies_have_the_bits_of_those_made_anew(case, seeds, cap):
    name, rule = case
    hierarchy = Hierarchy.on(MESHES[name], rule, cap_level=cap)
    for seed in seeds:
        hierarchy = remeshed(hierarchy, seed)
    anew = Hierarchy.on(MESHES[name], rule, cap_level=cap, refined_keys=hierarchy.refined_keys)
    check_same(everything(hierarchy, extract(hierarchy)), everything(anew, extract(anew)))
    deeper = Hierarchy.on(MESHES[name], rule, cap_level=cap + 2, refined_keys=hierarchy.refined_keys)
    check_same(everything(hierarchy.with_caps_at(cap + 2)), everything(deeper))


@settings(max_examples=8)
@given(case=st.sampled_from(CASES), seeds=st.lists(st.integers(0, 2**32 - 1), min_size=1, max_size=4))
def test_completed_outlines_have_the_bits_of_hierarchies_that_were_whole_all_along(case, seeds):
    name, rule = case
    whole = Hierarchy.on(MESHES[name], rule)
    whole = whole.refined(np.arange(0, whole.num_dofs, 3))
    outline = whole.outlined()
    for seed in seeds:
        dofs = np.random.default_rng(seed).choice(whole.num_dofs, 2, replace=False)
        whole, outline = whole.refined(dofs), outline.refined(dofs)
        assert [stage.active.tolist() for stage in outline.stages] == [stage.active.tolist() for stage in whole.stages]
    assert any(not stage.is_whole for stage in outline.stages)
    check_same(everything(outline.completed()), everything(whole))


def test_a_refined_part_that_moves_takes_nothing_over():
    mesh = generators.torus((16, 8))  # where all places look alike: parts have equally many faces everywhere
    hierarchy = Hierarchy.on(mesh).refined(np.array([0]))
    num_cells = sum(stage.active_faces.size for stage in hierarchy.stages)
    moved = hierarchy.remeshed(hierarchy.dof_offsets[[1]] - 1, np.arange(num_cells))
    assert [stage.level.num_faces for stage in moved.stages] == [stage.level.num_faces for stage in hierarchy.stages]
    assert not np.array_equal(moved.refined_keys[0], hierarchy.refined_keys[0])
    check_same(everything(moved), everything(Hierarchy.on(mesh, refined_keys=moved.refined_keys)))


@pytest.mark.parametrize(("name", "rule"), CASES)
def test_levels_may_be_joined_or_not(name, rule, monkeypatch):
    hierarchy = remeshed(remeshed(Hierarchy.on(MESHES[name], rule), 1), 2)
    together = list(everything(hierarchy, extract(hierarchy)))
    monkeypatch.setattr(joined, "ENOUGH", 0)
    alone = Hierarchy.on(MESHES[name], rule, refined_keys=hierarchy.refined_keys)
    cells = extract(alone)
    # Control points that no piece reads stand elsewhere.
    found = {name: value for name, value in everything(alone, cells) if "nodes" not in name and name != "points"}
    check_same(iter(found.items()), ((name, value) for name, value in together if name in found))


def test_only_stages_where_something_changes_are_made_anew():
    hierarchy = Hierarchy.on(generators.l_domain(8), cap_level=16)
    for _ in range(4):  # the functions around the reentrant corner, and nothing else
        stage, first = hierarchy.stages[hierarchy.num_levels - 1], hierarchy.dof_offsets[-2]
        near = functions_meeting(stage.boundary, stage.level.touching(~stage.level.regular))
        hierarchy = hierarchy.refined(first + np.flatnonzero(near[stage.active]))
    for l in (0, 1, 3):
        after = hierarchy.refined(hierarchy.dof_offsets[[l]])
        made = [k for k, (a, b) in enumerate(zip(hierarchy.stages, after.stages, strict=True)) if a is not b]
        assert made == [l, l + 1]  # of 17


# ---- Joined levels


def levels_of(name: str, rule: str) -> list[Boundary]:
    return [stage.boundary for stage in remeshed(Hierarchy.on(MESHES[name], rule), 3).stages]


@pytest.mark.parametrize(("name", "rule"), CASES)
def test_what_depends_on_neighbours_is_found_for_joined_levels(name, rule):
    boundaries = levels_of(name, rule)
    levels = [boundary.level for boundary in boundaries]
    whole = joined_boundaries(boundaries)
    again = Boundary.of(joined_levels(levels), rule)
    np.testing.assert_array_equal(whole.vertex, again.vertex)
    np.testing.assert_array_equal(whole.kind, again.kind)
    vertices = Parts.of([level.num_vertices for level in levels])
    functions = vertices.functions(whole)
    for apart, boundary in zip(vertices.split_boundary(whole, levels), boundaries, strict=True):
        np.testing.assert_array_equal(apart.vertex, boundary.vertex)
        np.testing.assert_array_equal(apart.kind, boundary.kind)
    check_same(
        arrays(functions.split_rows(to_dofs(whole), functions), "matrix"),
        arrays([to_dofs(boundary) for boundary in boundaries], "matrix"),
    )
    marks = [np.arange(level.num_faces) % 5 == 0 for level in levels]
    check_same(
        arrays(functions.split(functions_meeting(whole, np.concatenate(marks))), "marks"),
        arrays([functions_meeting(boundary, m) for boundary, m in zip(boundaries, marks, strict=True)], "marks"),
    )
    complete = [np.flatnonzero(level.complete[level.quads].all(axis=1)).astype(np.int32) for level in levels]
    starts = Parts.of([level.num_faces for level in levels]).starts
    masks = bezier_masks(whole, np.concatenate([f + start for f, start in zip(complete, starts, strict=False)]))
    rows = Parts.of([16 * faces.size for faces in complete])
    check_same(
        arrays(rows.split_rows(masks, functions), "masks"),
        arrays([bezier_masks(boundary, faces) for boundary, faces in zip(boundaries, complete, strict=True)], "masks"),
    )


def test_things_of_several_kinds_are_sorted_out():
    parts = Parts.of([2, 0, 1], [1, 2, 0])  # numbers 0 0 2, then 0 1 1
    assert parts.level.tolist() == [0, 0, 2, 0, 1, 1]
    assert parts.number.tolist() == [0, 1, 0, 2, 0, 1]
    assert parts.starts.tolist() == [0, 3, 5, 6]
    assert [part.tolist() for part in parts.split(np.arange(6))] == [[0, 1, 3], [4, 5], [2]]


def test_large_levels_stay_alone():
    assert list(groups([])) == []
    assert list(groups([10, 20, joined.ENOUGH, 5, 5])) == [slice(0, 2), slice(2, 3), slice(3, 5)]
    assert list(groups([3 * joined.ENOUGH])) == [slice(0, 1)]
