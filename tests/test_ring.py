"""Refinement by rings: the least that adds a function, marks that carry what they promise, and fewer dofs for it."""

from functools import cache

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from problems import errors, poisson, randomly_refined, singular
from refinements import CASES, MESHES, most_functions

import ufl
from thccs_fem import adapt, estimate, fem, generators
from thccs_fem.fem.space import FunctionSpace
from thccs_fem.hierarchy import Hierarchy
from thccs_fem.regions import faces_meeting

Floats = npt.NDArray[np.float64]

BUILT = {
    "grid": lambda: fem.functionspace(generators.rectangle((5, 4)), ("THCCS", 3), unit="ring"),
    "grid, crease": lambda: fem.functionspace(generators.rectangle((5, 4)), ("THCCS", 3), "crease", unit="ring"),
    "wheel": lambda: fem.functionspace(generators.wheel(5, 3), ("THCCS", 3), unit="ring", admissibility=2),
    "closed": lambda: fem.functionspace(generators.cube_sphere(2), ("THCCS", 3), unit="ring"),
}
each_space = pytest.mark.parametrize("name", BUILT)


@cache
def space(name: str) -> FunctionSpace:
    return randomly_refined(BUILT[name](), times=5)


@cache
def rings(name: str) -> list[set[int]]:
    """Return the cells in the ring of each function, by loops: those whose face, or one above it, is at its vertex."""
    hierarchy, cells = space(name).hierarchy, space(name).cells
    found: list[set[int]] = []
    for l in range(hierarchy.num_levels):
        stage = hierarchy.stages[l]
        at: dict[int, set[int]] = {v: set() for v in range(stage.level.num_vertices)}
        number = {int(key): f for f, key in enumerate(stage.level.keys)}
        for cell, (level, face) in enumerate(zip(cells.level.tolist(), cells.level_face.tolist(), strict=True)):
            if level >= l:
                key = int(hierarchy.stages[level].level.keys[face])
                for v in stage.level.quads[number[key // 4 ** (level - l)]].tolist():
                    at[v].add(cell)
        vertex = np.concatenate([np.arange(stage.level.num_vertices), stage.boundary.vertex])
        found += [at[v] for v in vertex[stage.active].tolist()]
    return found


# ---- What is refined


@pytest.mark.parametrize(("name", "rule"), CASES)
def test_the_faces_at_a_vertex_are_the_support_of_its_function_a_level_up(name: str, rule: str) -> None:
    """No smaller region has a function of the next level; at an inner vertex of any valence it has this one alone."""
    hierarchy = Hierarchy.on(MESHES[name], rule, unit="ring")
    if hierarchy.root.dependent_faces.any():
        pytest.skip("faces of level 0 are refined along, and bring functions of their own")
    before = hierarchy.stages[0]
    for vertex in range(0, before.level.num_vertices, 3):
        faces = (before.level.quads == vertex).any(axis=1)
        after = hierarchy.refined(np.array([vertex]))
        assert np.array_equal(after.refined_keys[0], np.flatnonzero(faces))
        stage = after.stages[1]
        (here,) = np.flatnonzero(stage.level.control_vertex == vertex)
        functions = np.zeros_like(stage.selected)
        functions[here] = True
        assert stage.active[here]
        assert np.array_equal(faces_meeting(stage.boundary, functions), stage.inside)
        around = before.level.quads[faces].ravel()
        if not before.level.boundary[around].any() and np.unique(around).size == 2 * np.count_nonzero(faces) + 1:
            assert np.flatnonzero(stage.selected).tolist() == [here]
            assert after.num_dofs == hierarchy.num_dofs + 1


def test_dofs_of_rings_and_supports() -> None:
    """Inside a grid: 1 more; a row of three functions, 5 more; the support, 16 faces: 25 more and 1 less."""
    msh = generators.rectangle((12, 12))
    ring, support = (fem.functionspace(msh, ("THCCS", 3), "crease", unit=unit) for unit in ("ring", "support"))
    middle = 6 * 13 + 6
    assert adapt.refine(ring, [middle]).num_dofs == ring.num_dofs + 1
    assert adapt.refine(ring, [middle - 1, middle, middle + 1]).num_dofs == ring.num_dofs + 5
    assert adapt.refine(support, [middle]).num_dofs == support.num_dofs + 24


@each_space
def test_whatever_is_marked_something_is_refined(name: str) -> None:
    V = space(name)
    for i in range(V.num_functions):
        assert adapt.refine(V, [i]).num_cells > V.num_cells


@each_space
def test_all_functions_refine_all(name: str) -> None:
    V = BUILT[name]()
    assert adapt.refine(V, np.arange(V.num_functions)).num_cells == 4 * V.num_cells


# ---- Marks


@each_space
def test_every_cell_is_in_a_ring(name: str) -> None:
    assert set().union(*rings(name)) == set(range(space(name).num_cells))


@given(st.sampled_from(list(BUILT)), st.integers(0, 999), st.sampled_from([0.25, 0.5, 1.0]))
def test_marks_are_those_of_brute_force(name: str, seed: int, theta: float) -> None:
    """Whole numbers, so that what ties does so exactly."""
    V, cells = space(name), rings(name)
    eta = np.random.default_rng(seed).integers(-2, 4, V.num_cells).clip(0).astype(float)
    eta[0] = 1.0
    squares = [sum(eta[cell] ** 2 for cell in ring) for ring in cells]
    assert adapt.mark(V, eta, "worst").tolist() == [squares.index(max(squares))]
    large = [i for i, square in enumerate(squares) if square >= theta**2 * max(squares)]
    assert adapt.mark(V, eta, "maximum", theta).tolist() == large
    chosen: list[int] = []
    carried: set[int] = set()
    for i in sorted(range(len(squares)), key=lambda i: (-squares[i], i)):
        if sum(eta[cell] ** 2 for cell in carried) >= theta * (eta**2).sum():
            break
        if not cells[i] <= carried:
            chosen.append(i)
            carried |= cells[i]
    assert adapt.mark(V, eta, "dorfler", theta).tolist() == sorted(chosen)


@each_space
def test_nothing_is_marked_where_nothing_is_wrong(name: str) -> None:
    assert adapt.mark(space(name), np.zeros(space(name).num_cells)).size == 0


# ---- Coarsening


@each_space
def test_coarsening_leaves_a_ring(name: str) -> None:
    """Where one cell stays of a space that is refined all over, the least ring with it in it does."""
    V = BUILT[name]()
    fine = adapt.refine(V, np.arange(V.num_functions))
    left = adapt.coarsen(fine, np.arange(fine.num_cells) != 0)
    level = V.hierarchy.root
    sizes = [np.count_nonzero((level.quads == v).any(axis=1)) for v in level.quads[0]]
    assert left.num_cells == V.num_cells + 3 * min(sizes)
    assert adapt.coarsen(left, np.ones(left.num_cells, dtype=bool)) == V


# ---- What it is worth


def dofs_for(unit: str, admissibility: int | None, tolerance: float) -> tuple[float, int]:
    """Return the dofs, interpolated, that the L-domain takes for an L2 error, and the steps."""
    V = fem.functionspace(
        generators.l_domain(4),
        ("THCCS", 3),
        cap_level=16,
        unit=unit,
        admissibility=admissibility,  # type: ignore[arg-type]
    )
    exact = singular(ufl.SpatialCoordinate(V.mesh))
    rows: list[tuple[float, float]] = []
    while not rows or rows[-1][1] > tolerance:
        uh = poisson(V, exact, fem.Constant(V.mesh, 0.0))
        rows.append((V.num_dofs, errors(uh, exact)[0]))
        V = adapt.refine(V, adapt.mark(V, estimate.error(uh, exact, "L2")))
    dofs, found = np.log(rows[-2:]).T
    return float(np.exp(np.interp(-np.log(tolerance), -found, dofs))), len(rows)


def test_rings_take_fewer_dofs_and_more_steps() -> None:
    """995 in 20 steps, 775 in 30 were measured: see docs/adaptivity.md."""
    (supports, few), (rings, many) = dofs_for("support", None, 1e-6), dofs_for("ring", None, 1e-6)
    assert 0.7 < rings / supports < 0.87
    assert 1.2 < many / few < 2.0
    admissible, _ = dofs_for("ring", 2, 1e-6)
    assert 1.0 < admissible / rings < 1.15


def test_rings_put_fewer_functions_on_a_cell() -> None:
    supports, rings = (
        randomly_refined(fem.functionspace(generators.torus((12, 12)), ("THCCS", 3), unit=unit), times=20)  # type: ignore[arg-type]
        for unit in ("support", "ring")
    )
    assert most_functions(rings.cells) < most_functions(supports.cells)
