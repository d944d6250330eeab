"""Which functions there are, and what they are in terms of each level: definitions, a slow oracle, THB-splines."""

import functools
import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from refinements import CASES, MAX_LEVELS, MESHES, STEPS, coarsest, refinements
from scipy.interpolate import BSpline
from slow_hierarchy import SlowStage, slow_stages, whole_levels
from zoo import ZOO

from thccs_fem import boundary, generators
from thccs_fem.extraction import evaluate_pieces, extract
from thccs_fem.hierarchy import CAP_LEVEL, Hierarchy

EXACT = 1e-12  # sums of a few dozen products of numbers up to 1, several levels deep


# Against the slow oracle


@functools.cache
def levels_of(name: str):
    root = coarsest(name, "crease").root
    return whole_levels(root.quads, root.num_vertices, np.flatnonzero(root.corner), MAX_LEVELS)


def slow_vertices(hierarchy: Hierarchy, levels, l: int) -> np.ndarray:
    """The number that the oracle gives each vertex of stage l."""
    level = hierarchy.stages[l].level
    numbers = np.full(level.num_vertices, -1)
    numbers[level.quads] = levels[l].faces[level.keys]
    assert np.array_equal(numbers[level.quads], levels[l].faces[level.keys])  # the same at all faces of a vertex
    assert np.unique(numbers).size == numbers.size
    return numbers


def oracle(name: str, hierarchy: Hierarchy) -> tuple[list[SlowStage], list[np.ndarray]]:
    levels = levels_of(name)
    numbers = [slow_vertices(hierarchy, levels, l) for l in range(hierarchy.num_levels)]
    return slow_stages(levels, list(hierarchy.refined_keys)), numbers


def in_order_of(hierarchy: Hierarchy, slow: list[SlowStage], numbers: list[np.ndarray]) -> np.ndarray:
    """The column that each dof has in the oracle."""
    first, columns = 0, []
    for l, stage in enumerate(slow):
        column = np.full(stage.active.size, -1)
        column[stage.active] = first + np.arange(np.count_nonzero(stage.active))
        columns.append(column[numbers[l][hierarchy.dof_functions(l)]])
        first += np.count_nonzero(stage.active)
    return np.concatenate(columns)


@pytest.mark.parametrize("name", [name for name in ZOO if name != "pole"])  # the oracle is slow
@settings(max_examples=2)
@given(steps=STEPS)
def test_functions_and_coefficients_are_those_of_the_definition(name, steps):
    hierarchy = refinements(name, "crease", steps)[-1]
    slow, numbers = oracle(name, hierarchy)
    columns = in_order_of(hierarchy, slow, numbers)
    assert np.array_equal(np.sort(columns), np.arange(hierarchy.num_dofs))
    for l, (stage, expected) in enumerate(zip(hierarchy.stages, slow, strict=False)):
        assert np.array_equal(np.sort(numbers[l][stage.selected]), np.flatnonzero(expected.selected))
        assert np.array_equal(np.sort(numbers[l][stage.active]), np.flatnonzero(expected.active))
        assert np.array_equal(np.sort(stage.level.keys[stage.inside]), np.flatnonzero(expected.inside))
        used = levels_of(name)[l].meeting(expected.inside)[numbers[l]]
        ours = hierarchy.coefficients[l].toarray()[used]
        np.testing.assert_allclose(ours, expected.coefficients[numbers[l][used]][:, columns], rtol=0, atol=EXACT)


@pytest.mark.parametrize("name", ["grid", "l_tricube", "wheel5"])
@settings(max_examples=3)
@given(steps=STEPS)
def test_prolongation_reads_the_coefficients_of_the_coarse_functions(name, steps):
    coarse, fine = (refinements(name, "crease", steps)[k] for k in (1, -1))
    numbers = oracle(name, fine)[1]
    nothing = np.zeros(0, dtype=np.int64)
    padded = [*coarse.refined_keys, *[nothing] * MAX_LEVELS][: len(fine.refined_keys)]
    slow_coarse = slow_stages(levels_of(name), padded)
    expected = [slow_coarse[l].coefficients[numbers[l][fine.dof_functions(l)]] for l in range(fine.num_levels)]
    coarse_columns = in_order_of(coarse, slow_coarse[: coarse.num_levels], oracle(name, coarse)[1])
    ours = fine.prolongation(coarse).toarray()
    np.testing.assert_allclose(ours, np.concatenate(expected)[:, coarse_columns], rtol=0, atol=EXACT)


def walked_support(level, vertex: int, kind: int) -> set[int]:
    """Faces of the rim edges that a trace function lives on: two either way, one at a corner, ending at corners."""
    leaving, entering = {}, {}
    for h in np.flatnonzero(level.rim).tolist():
        leaving[int(level.vertices[h])] = h
        entering[int(level.vertices[level.following[h]])] = h

    def walk(forward: bool, edges: int) -> set[int]:
        faces, v = set(), vertex
        for _ in range(edges):
            h = (leaving if forward else entering).get(v)
            if h is None:
                break
            faces.add(int(level.face[h]))
            v = int(level.vertices[level.following[h] if forward else h])
            if level.corner[v]:
                break
        return faces

    if kind == boundary.CORNER_MIXED:
        return walk(True, 1)
    forward = walk(True, 2) if kind in (boundary.SMOOTH, boundary.CORNER_OUT) else set()
    backward = walk(False, 2) if kind in (boundary.SMOOTH, boundary.CORNER_IN) else set()
    return forward | backward


@pytest.mark.parametrize("name", [name for name, rule in CASES if rule == "clamped"])
@settings(max_examples=2)
@given(steps=STEPS)
def test_traces_are_selected_by_the_walk_along_the_rim(name, steps):
    hierarchy = refinements(name, "clamped", steps)[-1]
    for stage in hierarchy.stages[: hierarchy.num_levels]:
        traces = zip(stage.boundary.vertex.tolist(), stage.boundary.kind.tolist(), strict=True)
        for function, (vertex, kind) in enumerate(traces, start=stage.level.num_vertices):
            support = np.array(sorted(walked_support(stage.level, vertex, kind)))
            selected = bool(stage.inside[support].all())
            assert stage.selected[function] == selected
            assert stage.active[function] == (selected and not stage.refined[support].all())


@pytest.mark.parametrize(("name", "rule"), CASES)
def test_supports_are_the_faces_where_functions_do_not_vanish(name, rule):
    hierarchy = coarsest(name, rule)
    cells = extract(hierarchy)
    rows = cells.rows(np.arange(cells.num_pieces, dtype=np.int32)).tocoo()
    nonzero = np.zeros((hierarchy.num_dofs, hierarchy.root.num_faces), dtype=bool)
    big = np.abs(rows.data) > 1e-10  # true entries are above 1e-5; rounding leaves 1e-16
    nonzero[rows.col[big], cells.level_face[cells.piece_cell[rows.row[big] // 16]]] = True
    for dof in range(hierarchy.num_dofs):
        (support,) = hierarchy.support(np.array([dof]))
        assert np.array_equal(support, nonzero[dof]), f"dof {dof}"


# Against THB-splines


GRID = 14  # faces along a side; the functions refined below are far from the rim


def spline(l: int, i: int):
    """The uniform cubic B-spline of level l centred at i / 2**l."""
    knots = (i + np.arange(-2.0, 3.0)) / 2.0**l
    return BSpline.basis_element(knots, extrapolate=False)


@functools.cache
def two_scale(l: int) -> dict[int, float]:
    """Coefficients of the B-spline 0 of level l in those of level l + 1, by collocation."""
    shifts = np.arange(-4, 5)
    points = np.linspace(-2.0, 2.0, 41)[1:-1] / 2.0**l
    table = np.stack([np.nan_to_num(spline(l + 1, int(k))(points)) for k in shifts], axis=1)
    values = np.nan_to_num(spline(l, 0)(points))
    found = np.linalg.lstsq(table, values, rcond=None)[0]
    return {int(k): c for k, c in zip(shifts, found, strict=True) if abs(c) > 1e-12}


class ThbFunction:
    """A truncated hierarchical B-spline: the coefficients {(i, j): c} of one level, truncated level by level."""

    def __init__(self, l: int, index: tuple[int, int], selected: list[set[tuple[int, int]]]):
        self.level, self.coefficients = l, {index: 1.0}
        for finer in range(l + 1, len(selected)):
            line = two_scale(self.level)
            finer_coefficients: dict[tuple[int, int], float] = {}
            for (i, j), c in self.coefficients.items():
                for (di, a), (dj, b) in itertools.product(line.items(), line.items()):
                    key = (2 * i + di, 2 * j + dj)
                    finer_coefficients[key] = finer_coefficients.get(key, 0.0) + c * a * b
            self.level = finer
            self.coefficients = {key: c for key, c in finer_coefficients.items() if key not in selected[finer]}

    def __call__(self, points: np.ndarray) -> np.ndarray:
        total = np.zeros(len(points))
        for (i, j), c in self.coefficients.items():
            along_x, along_y = spline(self.level, i)(points[:, 0]), spline(self.level, j)(points[:, 1])
            total += c * np.nan_to_num(along_x * along_y)
        return total


def faces_of(index: tuple[int, int]) -> set[tuple[int, int]]:
    i, j = index
    return set(itertools.product(range(i - 2, i + 2), range(j - 2, j + 2)))


def inner_indices(hierarchy: Hierarchy, l: int) -> np.ndarray:
    """Where the functions of a level stand, shape (num_functions, 2): control points stay on the lattice."""
    return np.rint(hierarchy.points[l] * 2**l).astype(int)


def refined_in_the_middle(seed: int) -> tuple[Hierarchy, list[set[tuple[int, int]]]]:
    """A hierarchy of three levels on the grid, and Omega^{l+1} as faces (column, row) of level l, by its own count."""
    rng = np.random.default_rng(seed)
    mesh = generators.rectangle((GRID, GRID), (0.0, 0.0), (GRID, GRID))
    hierarchy = Hierarchy.on(mesh, "crease")
    omegas: list[set[tuple[int, int]]] = []
    for step in range(3):
        l = min(step, 1)
        functions = hierarchy.dof_functions(l)
        index = inner_indices(hierarchy, l)[functions]
        inside = (np.abs(index / 2**l - GRID / 2) <= 2.0).all(axis=1)
        picked = rng.choice(np.flatnonzero(inside), 2, replace=False)
        hierarchy = hierarchy.refined(hierarchy.dof_offsets[l] + picked)
        omegas += [set()] * (l + 1 - len(omegas))
        omegas[l] = omegas[l].union(*(faces_of(tuple(index[p].tolist())) for p in picked))
    return hierarchy, omegas


@pytest.mark.parametrize("seed", range(2))
def test_a_grid_gives_truncated_hierarchical_b_splines(seed):
    hierarchy, omegas = refined_in_the_middle(seed)
    domains = [set(itertools.product(range(GRID), range(GRID)))]
    domains += [{(2 * i + a, 2 * j + b) for i, j in o for a in (0, 1) for b in (0, 1)} for o in omegas]
    every = [set(itertools.product(range(2, 2**l * GRID - 1), repeat=2)) for l in range(len(domains))]
    selected = [{f for f in e if faces_of(f) <= domain} for e, domain in zip(every, domains, strict=True)]
    cells = extract(hierarchy)
    points = np.random.default_rng(seed).uniform(GRID / 2 - 4.0, GRID / 2 + 4.0, (200, 2))
    low = np.floor(points).astype(int)
    piece, uv = cells.locate(low[:, 1] * GRID + low[:, 0], points - low)
    values = evaluate_pieces(cells.local(np.eye(hierarchy.num_dofs)), piece, uv)
    compared = 0
    for l in range(hierarchy.num_levels):
        refined = omegas[l] if l < len(omegas) else set()
        active = {f for f in selected[l] if not faces_of(f) <= refined}
        index = [tuple(pair) for pair in inner_indices(hierarchy, l)[hierarchy.dof_functions(l)].tolist()]
        assert {f for f in index if f in every[l]} == active
        for dof, f in enumerate(index, start=int(hierarchy.dof_offsets[l])):
            if f in active and np.abs(np.array(f) / 2**l - GRID / 2).max() <= 4.0:
                np.testing.assert_allclose(values[:, dof], ThbFunction(l, f, selected)(points), rtol=0, atol=EXACT)
                compared += 1
    assert compared > 50


# Levels, caps, relations


@pytest.mark.parametrize(("name", "rule"), CASES)
@settings(max_examples=2)
@given(steps=STEPS)
def test_steps_have_rows_of_sum_one_and_no_negative_entry(name, rule, steps):
    hierarchy = refinements(name, rule, steps)[-1]
    for stage, finer in itertools.pairwise(hierarchy.stages):
        # Others are functions at an artificial rim, which no piece sees.
        held = stage.refined | stage.cut
        children = np.zeros(finer.level.num_faces, dtype=bool)
        children[(stage.step.first_child[held][:, None] + np.arange(4)).ravel()] = True
        around = finer.level.touching(finer.level.corners_of(children))
        seen = finer.level.corners_of(around)
        traces = [
            bool(children[sorted(walked_support(finer.level, v, k))].any())
            for v, k in zip(finer.boundary.vertex.tolist(), finer.boundary.kind.tolist(), strict=True)
        ]
        rows = stage.matrix[np.flatnonzero(np.concatenate([seen, np.array(traces, dtype=bool)]))]
        assert abs(rows.sum(axis=1) - 1.0).max() < EXACT
        assert rows.data.min() > -1e-15  # sums of three or four terms that cancel


def test_caps_sink_below_the_finest_element_at_their_vertex_and_nowhere_else():
    hierarchy = coarsest("l_tricube", "crease")
    for _ in range(5):  # always the function of one vertex of level 0, to level 5
        l = hierarchy.num_levels - 1
        here = np.flatnonzero(hierarchy.stages[l].level.control_vertex[hierarchy.dof_functions(l)] == 0)
        hierarchy = hierarchy.refined(hierarchy.dof_offsets[l] + here)
    assert hierarchy.num_levels == 6
    expected = np.full(hierarchy.root.num_vertices, CAP_LEVEL)
    expected[0] = 6  # one below the elements of level 5; other vertices see elements of level 2 at most
    assert np.array_equal(hierarchy.cap_levels, expected)


@pytest.mark.parametrize("name", ["wheel5", "l_domain_smooth", "tripod", "polygons"])
@pytest.mark.parametrize("cap_level", [1, 3, 6])
@settings(max_examples=2)
@given(steps=STEPS)
def test_all_sectors_of_an_irregular_vertex_end_at_its_cap_level(name, cap_level, steps):
    mesh = MESHES[name]
    hierarchy = Hierarchy.on(mesh, "crease", cap_level=cap_level)
    for step in steps:
        hierarchy = hierarchy.refined(np.array([number % hierarchy.num_dofs for *_, number in step]))
    cells = extract(hierarchy)
    ends: dict[int, set[int]] = {}
    finest: dict[int, int] = {}
    for m, (stage, piece_of_face) in enumerate(zip(hierarchy.stages, cells.piece_of_face, strict=True)):
        level = stage.level
        at = level.control_vertex[level.quads]
        irregular = (at >= 0) & ~level.regular[level.quads]
        for face, k in np.argwhere(irregular & (piece_of_face >= 0)[:, None]):
            ends.setdefault(int(at[face, k]), set()).add(m)
        for face, k in np.argwhere(irregular & (stage.inside & ~stage.refined)[:, None]):
            finest[int(at[face, k])] = max(finest.get(int(at[face, k]), 0), m)
    assert set(ends) == set(np.flatnonzero(~hierarchy.root.regular))
    for vertex, levels in ends.items():
        assert levels == {int(hierarchy.cap_levels[vertex])}
        assert hierarchy.cap_levels[vertex] == max(cap_level, finest[vertex] + 1)


@settings(max_examples=5)
@given(steps=STEPS)
def test_relations_between_hierarchies(steps):
    hierarchies = refinements("wheel3", "clamped", steps)
    coarse, fine = hierarchies[0], hierarchies[-1]
    assert fine.num_levels > 1
    assert fine.is_refinement_of(coarse)
    assert fine.is_refinement_of(fine)
    assert not coarse.is_refinement_of(fine)
    again = refinements("wheel3", "clamped", steps)[-1]
    assert again.same_as(fine)
    assert not fine.same_as(coarse)
    assert not coarse.same_as(fine)
    for count in range(1, fine.num_levels + 1):
        truncated = fine.truncated_to(count)
        assert truncated.num_levels == count
        assert fine.is_refinement_of(truncated)
        for l in range(count - 1):
            assert np.array_equal(truncated.stages[l].level.keys[truncated.stages[l].refined], fine.refined_keys[l])
    assert fine.truncated_to(1).same_as(coarse)
    assert fine.truncated_to(fine.num_levels).same_as(fine)


def test_refinement_is_a_union_and_its_order_does_not_matter():
    hierarchy = coarsest("grid", "clamped")
    both = hierarchy.refined(np.array([3, 20]))
    functions_left = both.prolongation(hierarchy)
    assert functions_left.shape == (both.num_dofs, hierarchy.num_dofs)
    one = hierarchy.refined(np.array([3]))
    same = np.flatnonzero(one.dof_functions(0) == 20)  # still active: its support is not within that of 3
    assert one.refined(same).same_as(both)


def test_every_function_is_refined_with_its_own_support():
    hierarchy = coarsest("l_tricube", "crease")
    dofs = np.arange(hierarchy.num_dofs)
    assert np.array_equal(hierarchy.refined(dofs).refined_keys[0], np.arange(hierarchy.root.num_faces))


def test_refining_nothing_changes_nothing():
    hierarchy = coarsest("grid", "clamped")
    assert hierarchy.refined(np.zeros(0, dtype=int)).same_as(hierarchy)


def test_dofs_are_numbered_level_by_level_vertices_first():
    hierarchy = coarsest("grid", "clamped").refined(np.array([0, 30]))
    assert hierarchy.num_levels == 2
    assert hierarchy.dof_offsets[-1] == hierarchy.num_dofs == sum(hierarchy.dof_functions(l).size for l in range(2))
    for l in range(2):
        functions = hierarchy.dof_functions(l)
        assert (np.diff(functions) > 0).all()
        columns = hierarchy.coefficients[l].toarray()[functions]
        np.testing.assert_array_equal(
            columns[:, hierarchy.dof_offsets[l] : hierarchy.dof_offsets[l + 1]], np.eye(functions.size)
        )


# Meshes whose functions would be dependent, and wrong input


@pytest.mark.parametrize(
    ("name", "subdivided"), [("cube", True), ("cube_and_torus", True), ("l_tricube", False), ("wheel3", False)]
)
def test_a_component_with_valence_3_alone_is_subdivided_first(name, subdivided):
    hierarchy = coarsest(name, "crease")
    assert hierarchy.root_is_subdivided == subdivided
    mesh = MESHES[name]
    assert hierarchy.root.num_faces == (4 if subdivided else 1) * mesh.num_faces
    assert np.array_equal(np.bincount(hierarchy.face_of_root), np.full(mesh.num_faces, 4 if subdivided else 1))


def test_polygons_are_subdivided_first():
    hierarchy = coarsest("polygons", "crease")
    assert hierarchy.root_is_subdivided
    assert np.array_equal(np.bincount(hierarchy.face_of_root), MESHES["polygons"].face_sizes)


@pytest.mark.parametrize("cap_level", [0, -1])
def test_a_cap_needs_a_cut(cap_level):
    with pytest.raises(ValueError, match=f"cap_level is {cap_level}; a cap needs at least one cut: give 1 or more"):
        Hierarchy.on(MESHES["wheel3"], cap_level=cap_level)


def test_levels_that_no_key_can_number_are_refused():
    Hierarchy.on(MESHES["single_quad"], cap_level=30)
    with pytest.raises(ValueError, match="31 levels below the 1 faces of level 0 are more than 64-bit face keys"):
        Hierarchy.on(MESHES["single_quad"], cap_level=31)


def test_prolongation_between_unrelated_hierarchies_is_refused():
    coarse = coarsest("grid", "clamped")
    fine = coarse.refined(np.array([5]))
    others = [
        (coarse, fine),
        (fine, coarse.refined(np.array([14]))),
        (fine, coarsest("grid", "crease")),
        (fine, Hierarchy.on(ZOO["grid"](), "clamped")),
    ]
    for target, source in others:
        with pytest.raises(ValueError, match="the spaces are not nested"):
            target.prolongation(source)
