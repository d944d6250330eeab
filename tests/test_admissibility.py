"""Admissible refinement: at most m successive levels meet on a cell, and no more is refined than that takes."""

from pathlib import Path

import h5py
import numpy as np
import numpy.typing as npt
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from refinements import CASES, MESHES, STEPS, Choice, chosen, levels_on_cells, most_functions
from slow_hierarchy import SlowLevel, slow_stages, whole_levels
from test_moving_fronts import drop, fitted, remeshed

from thccs_fem import adapt, checkpoint, fem, generators
from thccs_fem.extraction import extract
from thccs_fem.hierarchy import CAP_LEVEL, Hierarchy
from thccs_fem.regions import Unit

EXACT = 1e-12  # coefficients that are more than rounding
CLASSES = [2, 3]
each_class = pytest.mark.parametrize("m", CLASSES)

Keys = tuple[npt.NDArray[np.int64], ...]


def refined(hierarchy: Hierarchy, steps: list[list[Choice]]) -> Hierarchy:
    for step in steps:
        hierarchy = hierarchy.refined(np.concatenate([chosen(hierarchy, *choice) for choice in step]))
    return hierarchy


def at_a_corner(hierarchy: Hierarchy, times: int) -> Hierarchy:
    """Refine the function at the corner of the finest region, again and again: there all levels of free ones meet."""
    for _ in range(times):
        l = hierarchy.num_levels - 1
        points = hierarchy.points[l][hierarchy.dof_functions(l)]
        hierarchy = hierarchy.refined(hierarchy.dof_offsets[l] + np.array([np.argmin(points @ [1.0, 1.01])]))
    return hierarchy


# ---- How many levels meet


@pytest.mark.parametrize(("name", "rule"), CASES)
@each_class
@settings(max_examples=2)
@given(steps=STEPS)
def test_at_most_m_levels_meet_on_a_cell(name: str, rule: str, m: int, steps: list[list[Choice]]) -> None:
    """As the operators of all cells have it; that these are right others test."""
    start = Hierarchy.on(MESHES[name], rule, admissibility=m)
    assert levels_on_cells(extract(refined(start, steps))).max() <= m


@pytest.mark.parametrize("name", ["torus", "wheel5", "l_tricube", "grid"])
@each_class
@settings(max_examples=3)
@given(steps=STEPS)
def test_an_oracle_counts_as_many(name: str, m: int, steps: list[list[Choice]]) -> None:
    """The coefficients of whole levels by the definitions, functions on each face by the pattern of supports."""
    hierarchy = refined(Hierarchy.on(MESHES[name], "crease", admissibility=m), steps[:3])
    levels = slow_levels(hierarchy)
    stages = slow_stages(levels, list(hierarchy.refined_keys))
    level_of_dof = np.repeat(np.arange(hierarchy.num_levels), np.diff(hierarchy.dof_offsets))
    for l, (level, stage) in enumerate(zip(levels, stages, strict=False)):
        refined_here = np.isin(np.arange(len(level.faces)), [*hierarchy.refined_keys, []][l])
        there = sp.csr_array(level.supports.astype(float)) @ sp.csr_array(np.abs(stage.coefficients) > EXACT)
        for face in np.flatnonzero(stage.inside & ~refined_here):
            found = level_of_dof[there.indices[there.indptr[face] : there.indptr[face + 1]]]
            assert found.max() - found.min() < m
            assert found.min() > l - m


@pytest.mark.parametrize("unit", ["support", "ring"])
@pytest.mark.parametrize("times", [3, 6])
def test_free_refinement_knows_no_bound(unit: str, times: int) -> None:
    """At the common corner of nested regions all levels meet; an admissible hierarchy grows instead."""
    mesh = generators.rectangle((12, 12), (0.0, 0.0), (12.0, 12.0))
    free, *closed = (
        at_a_corner(Hierarchy.on(mesh, "crease", unit=unit, admissibility=m).refined(np.array([90])), times)
        for m in (None, *CLASSES)
    )
    found = [int(levels_on_cells(extract(h)).max()) for h in (free, *closed)]
    assert found == [times + 2, *CLASSES]
    assert free.num_dofs < closed[1].num_dofs < closed[0].num_dofs
    if unit == "support":
        assert [most_functions(extract(h)) for h in (free, *closed)] == [32, 21, 28]  # 16 where one level is alone


# ---- What is refined for it


def slow_levels(hierarchy: Hierarchy) -> list[SlowLevel]:
    root = hierarchy.root
    return whole_levels(root.quads, root.num_vertices, np.flatnonzero(root.corner), hierarchy.num_levels)


def closure(levels: list[SlowLevel], keys: Keys, m: int) -> list[set[int]]:
    """The least regions of faces by Buffa and Giannelli's definition, with these in them, by loops until all is there.

    For a refined face of level j, the functions of level k = j - m + 2 that meet the face of that level which it lies
    in must be selected: their supports lie in Omega^k.
    """
    regions = [set(k.tolist()) for k in keys]
    reach = [(level.supports.astype(int) @ level.supports.T.astype(int)).tocsr() for level in levels]
    for j in range(len(regions) - 1, 0, -1):
        regions[j - 1] |= {face // 4 for face in regions[j]}
        k = j - m + 2
        if k >= 1:
            for face in {face // 4 ** (j - k) for face in regions[j]}:
                rows = reach[k].indptr[face : face + 2]
                regions[k - 1] |= {int(f) // 4 for f in reach[k].indices[slice(*rows)]}
    return regions


@pytest.mark.parametrize("name", ["torus", "wheel5", "wheel3", "l_tricube", "grid"])
@each_class
@settings(max_examples=3)
@given(steps=STEPS)
def test_regions_are_closed_by_the_definition(name: str, m: int, steps: list[list[Choice]]) -> None:
    hierarchy = refined(Hierarchy.on(MESHES[name], "crease", admissibility=m), steps[:3])
    keys = hierarchy.refined_keys
    assert closure(slow_levels(hierarchy), keys, m) == [set(k.tolist()) for k in keys]


@each_class
@settings(max_examples=5)
@given(steps=STEPS)
def test_where_all_is_regular_no_face_is_refined_in_vain(m: int, steps: list[list[Choice]]) -> None:
    """On a torus the least regions of faces are unions of supports already."""
    start = Hierarchy.on(generators.torus((9, 8)), admissibility=m)
    for step in steps[:3]:
        dofs = np.concatenate([chosen(start, *choice) for choice in step])
        after = start.refined(dofs)
        marked = [
            np.union1d(stage.level.keys[stage.refined], stage.level.keys[support])
            for stage, support in zip(start.stages, start.support(dofs), strict=False)
        ]
        expected = closure(slow_levels(after), tuple(k for k in marked if k.size), m)
        assert [set(k.tolist()) for k in after.refined_keys] == expected
        start = after


@each_class
def test_a_class_refines_the_next_and_all_refine_the_free_one(m: int) -> None:
    steps: list[list[Choice]] = [[("any", True, 5)], [("any", True, 9), ("any", True, 31)], [("any", True, 77)]]
    found = {k: Hierarchy.on(MESHES["wheel5"], "clamped", admissibility=k) for k in (m, m + 1, None)}
    marks = found[None]
    for step in steps:
        dofs = np.concatenate([chosen(marks, *choice) for choice in step])
        supports = marks.support(dofs)
        marks = marks.refined(dofs)
        for k in (m, m + 1):
            found[k] = with_regions(found[k], [s.level.keys[x] for s, x in zip(marks.stages, supports, strict=False)])
    assert found[m].is_refinement_of(found[m + 1])
    assert found[m + 1].is_refinement_of(marks)


def with_regions(hierarchy: Hierarchy, keys: list[npt.NDArray[np.int64]]) -> Hierarchy:
    """Refine what of these faces is not refined yet, by the functions that have them as supports."""
    for l, wanted in enumerate(keys):
        if not wanted.size:
            continue
        stage = hierarchy.stages[l]
        faces = np.isin(stage.level.keys, wanted)
        dofs = [
            hierarchy.dof_offsets[l] + i
            for i in range(hierarchy.dof_functions(l).size)
            if not (hierarchy.support(np.array([hierarchy.dof_offsets[l] + i]))[l] & ~faces).any()
        ]
        hierarchy = hierarchy.refined(np.array(dofs, dtype=int))
    return hierarchy


# ---- The class stays


def test_all_that_comes_of_a_hierarchy_has_its_class() -> None:
    start = Hierarchy.on(MESHES["wheel5"], "crease", admissibility=2, unit="ring")
    fine = at_a_corner_of_numbers(start)
    others = [
        fine,
        fine.coarsened(np.arange(5)),
        fine.remeshed(np.array([3]), np.arange(9)),
        fine.with_caps_at(CAP_LEVEL + 1),
        fine.truncated_to(2),
        start.common_refinement(fine),
    ]
    assert {(h.admissibility, h.unit) for h in others} == {(2, "ring")}


def at_a_corner_of_numbers(hierarchy: Hierarchy) -> Hierarchy:
    for _ in range(3):
        hierarchy = hierarchy.refined(hierarchy.dof_offsets[[-2]])
    return hierarchy


def test_a_common_refinement_has_the_weaker_rules() -> None:
    msh = generators.torus((9, 8))
    two, three, free = (
        Hierarchy.on(msh, admissibility=m, unit=unit).refined(np.array([20 * i]))
        for i, (m, unit) in enumerate([(2, "support"), (3, "ring"), (None, "support")])
    )
    found = [(h.admissibility, h.unit) for h in (two.common_refinement(three), three.common_refinement(free))]
    assert found == [(3, "ring"), (None, "ring")]


def test_spaces_and_files_have_it(tmp_path: Path) -> None:
    msh = generators.wheel(5, 3)
    V = fem.functionspace(msh, ("THCCS", 3), admissibility=2, unit="ring")
    free = fem.functionspace(msh, ("THCCS", 3))
    assert (free.hierarchy.admissibility, free.hierarchy.unit) == (None, "support")
    for _ in range(3):
        V = adapt.refine(V, V.hierarchy.dof_offsets[[-2]])
    other = V.with_hierarchy(Hierarchy.on(msh, refined_keys=V.hierarchy.refined_keys))
    assert V == other  # the same functions
    for space in (V, other, free):
        checkpoint.write(tmp_path / "u.h5", fem.Function(space, name="u"))
        found = checkpoint.read(tmp_path / "u.h5").functions["u"].function_space.hierarchy
        assert (found.admissibility, found.unit) == (space.hierarchy.admissibility, space.hierarchy.unit)
        assert found.num_dofs == space.num_dofs


def test_a_space_tells_what_differs_from_the_default() -> None:
    texts = [
        str(fem.functionspace(generators.wheel(5, 3), ("THCCS", 3), admissibility=m, unit=unit))
        for m, unit in ((None, "support"), (3, "ring"))
    ]
    assert "rings" not in texts[0]
    assert "clamped boundary, 1 levels, " in texts[0]
    assert "clamped boundary, refined by rings, 1 levels, at most 3 on a cell, " in texts[1]


def test_an_older_file_is_of_free_refinement_by_supports(tmp_path: Path) -> None:
    """Before there were classes and units a hierarchy had a rule and a cap level."""
    V = adapt.refine(fem.functionspace(generators.wheel(5, 3), ("THCCS", 3), admissibility=2, unit="ring"), [0])
    path = tmp_path / "u.h5"
    checkpoint.write(path, fem.Function(V, name="u"))
    with h5py.File(path, "r+", locking=False) as file:
        for name in ("admissibility", "unit"):
            del file["hierarchies/0"].attrs[name]
    header = checkpoint._header(path)
    with path.open("r+b") as raw:
        raw.write(header)
    found = checkpoint.read(path, mesh=V.mesh).functions["u"].function_space
    assert found == V
    assert (found.hierarchy.admissibility, found.hierarchy.unit) == (None, "support")


# ---- Where fronts move


@pytest.mark.parametrize(("unit", "m"), [("support", 2), ("support", 3), ("ring", None), ("ring", 2)])
def test_a_front_leaves_little_behind(unit: Unit, m: int | None) -> None:
    """A drop that is carried by six faces of the torus: space is given back, and the class holds at each step."""
    start = fem.functionspace(generators.torus((24, 12)), ("THCCS", 3), unit=unit, admissibility=m)
    V = fitted(drop(start, 0.0), start, most=0.2, finest=3).function_space
    first, dofs, visited = V.num_dofs, [], V.hierarchy
    for angle in np.linspace(0.0, np.pi / 2, 13)[1:]:
        V = remeshed(fem.project(drop(V, angle), V), most=0.2, finest=3)
        dofs.append(V.num_dofs)
        visited = visited.common_refinement(V.hierarchy)
        assert m is None or levels_on_cells(V.cells).max() <= m
    assert visited.num_dofs > 1.3 * max(dofs)
    assert max(dofs) < (1.35 if (unit, m) == ("ring", None) else 2.4) * first  # halves of supports can't go


# ---- Wrong options


@pytest.mark.parametrize("m", [1, 0, -3])
def test_a_class_below_two_is_refused(m: int) -> None:
    with pytest.raises(
        ValueError, match=f"admissibility is {m}; where refinement ends two levels meet: give 2 or more"
    ):
        fem.functionspace(generators.wheel(5, 2), ("THCCS", 3), admissibility=m)


@pytest.mark.parametrize("m", [2.5, 2.0, "2"], ids=repr)
def test_a_class_is_an_integer(m: float | str) -> None:
    with pytest.raises(TypeError, match=f"admissibility is {m!r}; it must be an integer of 2 or more, or None"):
        fem.functionspace(generators.wheel(5, 2), ("THCCS", 3), admissibility=m)  # type: ignore[call-overload]


def test_an_unknown_unit_is_refused() -> None:
    with pytest.raises(ValueError, match="unit is 'face'; what is refined with a function must be its"):
        Hierarchy.on(MESHES["wheel5"], unit="face")  # type: ignore[arg-type]  # that is the mistake


def test_keys_of_another_class_are_refused() -> None:
    mesh = generators.rectangle((12, 12), (0.0, 0.0), (12.0, 12.0))
    free = at_a_corner(Hierarchy.on(mesh, "crease").refined(np.array([90])), 3)
    with pytest.raises(ValueError, match="the refined_keys are not those of an admissible hierarchy of class 2"):
        Hierarchy.on(mesh, "crease", admissibility=2, refined_keys=free.refined_keys)
    closed = at_a_corner(Hierarchy.on(mesh, "crease", admissibility=2).refined(np.array([90])), 3)
    for m in (2, 3, None):
        same = Hierarchy.on(mesh, "crease", admissibility=m, refined_keys=closed.refined_keys)
        assert same.same_as(closed)
