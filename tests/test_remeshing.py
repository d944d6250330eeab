"""Coarsening of hierarchies: what stays, what is undone, and what a function keeps on the way."""

import functools
import gc
import weakref
from collections.abc import Callable
from typing import Literal

import numpy as np
import numpy.typing as npt
import pytest
import scipy.sparse as sp
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule
from problems import randomly_refined
from refinements import CHOICES, MESHES, bernstein_mass, bernstein_rows, chosen, levels_on_cells, scaled_eigenvalue

import ufl
from thccs_fem import adapt, fem, generators
from thccs_fem.extraction import Cells, extract
from thccs_fem.fem.scipy import linear
from thccs_fem.fem.scipy.linear import factorised
from thccs_fem.fem.space import FunctionSpace
from thccs_fem.hierarchy import CAP_LEVEL, Hierarchy, Stage
from thccs_fem.mesh import ControlMesh
from ufl import dx, grad, inner

Floats = npt.NDArray[np.float64]
Cell = tuple[int, int]  # level and key: a name that a cell has in all hierarchies of a mesh

EXACT = 1e-12  # sums of a few dozen products of numbers up to 1, several levels deep
INDEPENDENT = 1e-7  # eigenvalues of what is dependent are rounding, below 1e-12
NOTHING = np.zeros(0, dtype=np.int64)

PLACES: dict[str, ControlMesh] = {
    **{name: MESHES[name] for name in ("torus", "wheel5", "l_domain_smooth", "l_tricube", "tripod")},
    "cube_sphere": generators.cube_sphere(2),
    "genus3": generators.genus3(0),
}
CASES = [(name, "crease") for name in PLACES] + [("wheel5", "clamped"), ("l_domain_smooth", "clamped")]


@functools.cache
def beginning(name: str, boundary: str, admissibility: int | None = None, unit: str = "support") -> Hierarchy:
    return Hierarchy.on(PLACES[name], boundary, admissibility=admissibility, unit=unit)


def cells_of(hierarchy: Hierarchy) -> list[Cell]:
    """The cells in the order of their numbers."""
    stages = hierarchy.stages[: hierarchy.num_levels]
    return [(l, int(key)) for l, stage in enumerate(stages) for key in stage.level.keys[stage.active_faces]]


def along(hierarchy: Hierarchy) -> set[int]:
    """Faces of level 0 with four inner corners of valence 3, which are refined along with others."""
    root = hierarchy.root
    three = (root.vertex_num_faces == 3) & ~root.boundary
    return set(np.flatnonzero(three[root.quads].all(axis=1)).tolist())


def support_of(stage: Stage, vertex: int) -> npt.NDArray[np.bool_]:
    """The support of a vertex's function, word for word: the faces that touch a face of the vertex."""
    at = (stage.level.quads == vertex).any(axis=1)
    return np.isin(stage.level.quads, stage.level.quads[at]).any(axis=1)


def ring_of(stage: Stage, vertex: int) -> npt.NDArray[np.bool_]:
    """The faces at a vertex."""
    return (stage.level.quads == vertex).any(axis=1)


def taken_by(hierarchy: Hierarchy, dof: int) -> tuple[int, npt.NDArray[np.int64]]:
    """The level of a dof and the keys of the faces that refining it takes, by the letter (crease boundary)."""
    l = int(np.searchsorted(hierarchy.dof_offsets, dof, side="right")) - 1
    stage = hierarchy.stages[l]
    vertex = int(hierarchy.dof_functions(l)[dof - hierarchy.dof_offsets[l]])
    faces = ring_of(stage, vertex)
    if hierarchy.unit == "support" or not (faces & ~stage.refined).any():
        faces = support_of(stage, vertex)
    return l, stage.level.keys[faces]


# ---- Any sequence of refining and coarsening


class Remeshing(RuleBasedStateMachine):
    """Refine and coarsen in any order; what must hold after each step, and where it all ends."""

    hierarchy: Hierarchy

    @initialize(
        case=st.sampled_from(CASES),
        admissibility=st.sampled_from([None, 2, 3]),
        unit=st.sampled_from(["support", "ring"]),
    )
    def start(self, case: tuple[str, str], admissibility: int | None, unit: str) -> None:
        self.hierarchy = beginning(*case, admissibility, unit)

    def marked(self, seed: int, share: float) -> npt.NDArray[np.int64]:
        """Some cells, those that are near in number together, as faces near each other often are."""
        count = len(cells_of(self.hierarchy))
        return (seed + np.arange(int(share * count))) % count

    def functions(self, choices: list[tuple[str, bool, int]]) -> npt.NDArray[np.int64]:
        return np.unique(np.concatenate([chosen(self.hierarchy, *choice) for choice in choices])).astype(np.int64)

    @rule(choices=st.lists(CHOICES, min_size=1, max_size=3))
    def refine(self, choices: list[tuple[str, bool, int]]) -> None:
        """Refine, and coarsen what that made: nothing has happened."""
        before = self.hierarchy
        after = before.refined(self.functions(choices))
        old = set(cells_of(before))
        new = [number for number, cell in enumerate(cells_of(after)) if cell not in old]
        assert after.coarsened(np.array(new, dtype=int)).same_as(before)
        self.hierarchy = after

    @rule(seed=st.integers(0, 9999), share=st.sampled_from([0.3, 0.8, 0.95]))
    def coarsen(self, seed: int, share: float) -> None:
        """Cells that are not marked stay, but for those that are refined along with others."""
        before, cells = self.hierarchy, self.marked(seed, share)
        after = before.coarsened(cells)
        assert before.is_refinement_of(after)
        kept = set(cells_of(before)) - {cells_of(before)[i] for i in cells}
        lost = kept - set(cells_of(after))
        assert all(level == 1 and key // 4 in along(before) for level, key in lost)
        self.hierarchy = after

    @rule(
        choices=st.lists(CHOICES, min_size=1, max_size=2),
        seed=st.integers(0, 9999),
        share=st.sampled_from([0.5, 1.0]),
    )
    def remesh(self, choices: list[tuple[str, bool, int]], seed: int, share: float) -> None:
        """What is to be refined is refined as if nothing were coarsened."""
        before, dofs = self.hierarchy, self.functions(choices)
        after = before.remeshed(dofs, self.marked(seed, share))
        assert before.refined(dofs).is_refinement_of(after)
        taken = [taken_by(before, dof) for dof in dofs if before.rule == "crease"]
        if before.unit == "support":  # those of traces as well
            supports = zip(before.stages, before.support(dofs), strict=False)
            taken += [(l, stage.level.keys[support]) for l, (stage, support) in enumerate(supports) if support.any()]
        for l, keys in taken:
            assert np.isin(keys, after.refined_keys[l]).all()
        self.hierarchy = after

    @invariant()
    def the_rules_of_refinement_stay(self) -> None:
        assert self.hierarchy.root is self.hierarchy.stages[0].level
        admissibility = self.hierarchy.admissibility
        if admissibility is not None:
            assert levels_on_cells(extract(self.hierarchy)).max() <= admissibility

    @invariant()
    def regions_are_nested_unions_of_units(self) -> None:
        for l, keys in enumerate(self.hierarchy.refined_keys):
            stage = self.hierarchy.stages[l]
            assert not (stage.refined & ~stage.inside).any()
            assert np.array_equal(stage.level.keys[stage.refined], keys)
            covered = np.zeros(stage.refined.size, dtype=bool)
            for vertex in np.flatnonzero((stage.selected & ~stage.active)[: stage.level.num_vertices]):
                covered |= support_of(stage, vertex)
            assert not (covered & ~stage.refined).any()
            if self.hierarchy.unit == "ring":
                for vertex in range(stage.level.num_vertices):
                    ring = ring_of(stage, vertex)
                    if stage.refined[ring].all():
                        covered |= ring
            if self.hierarchy.rule == "crease" or self.hierarchy.unit == "ring":  # traces bring faces too
                missing = set(stage.level.keys[stage.refined & ~covered].tolist())
                assert missing <= (along(self.hierarchy) if l == 0 else set())

    @invariant()
    def functions_are_a_partition_of_unity(self) -> None:
        rows = bernstein_rows(extract(self.hierarchy))
        assert abs(rows.sum(axis=1) - 1.0).max() < EXACT
        assert rows.data.min() > -EXACT

    def teardown(self) -> None:
        assert independence(extract(self.hierarchy)) > INDEPENDENT
        while (levels := self.hierarchy.num_levels) > 1:  # all cells coarsened: one level less
            self.hierarchy = self.hierarchy.coarsened(np.arange(len(cells_of(self.hierarchy))))
            assert self.hierarchy.num_levels == levels - 1
        assert self.hierarchy.coarsened(np.arange(len(cells_of(self.hierarchy)))) is self.hierarchy


def independence(cells: Cells) -> float:
    """The least scaled eigenvalue of the mass matrix in the parameters of the control mesh."""
    rows = bernstein_rows(cells)
    area = np.abs(np.linalg.det(cells.piece_axes)) * 4.0 ** -cells.level[cells.piece_cell]
    mass = sp.kron(sp.diags_array(area), sp.csr_array(np.kron(bernstein_mass(), bernstein_mass())), format="csr")
    return scaled_eigenvalue((rows.T @ mass @ rows).toarray())


def test_what_is_refined_on_a_face_that_is_refined_along_goes_level_by_level() -> None:
    """The ring of a face point is one face of level 0, which may be one that no ring has brought by itself."""
    coarse = beginning("tripod", "crease", None, "ring")
    face = min(along(coarse))
    hierarchy = coarse.refined(coarse.root.quads[face])
    (dof,) = (
        dof
        for dof in range(hierarchy.dof_offsets[1], hierarchy.num_dofs)
        if set(taken_by(hierarchy, dof)[1] // 4) == {face}
    )
    hierarchy = hierarchy.refined(np.array([dof]))
    assert hierarchy.num_levels == 3
    for levels in (2, 1):
        hierarchy = hierarchy.coarsened(np.arange(len(cells_of(hierarchy))))
        assert hierarchy.num_levels == levels
        assert abs(bernstein_rows(extract(hierarchy)).sum(axis=1) - 1.0).max() < EXACT


Remeshing.TestCase.settings = settings(max_examples=30, stateful_step_count=6, deadline=None)
TestRemeshing = Remeshing.TestCase


# ---- What stays


def children_of(hierarchy: Hierarchy, level: int, keys: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """The cells that are children of faces of a level."""
    wanted = set(keys.tolist())
    return np.array([i for i, (l, key) in enumerate(cells_of(hierarchy)) if l == level + 1 and key // 4 in wanted])


def refined_everywhere() -> tuple[Hierarchy, Hierarchy]:
    coarse = Hierarchy.on(generators.torus((16, 16)))
    return coarse, coarse.refined(np.arange(coarse.num_dofs))


def test_half_a_function_cannot_go() -> None:
    hierarchy = Hierarchy.on(generators.torus((8, 8))).refined(np.array([7]))
    half = hierarchy.refined_keys[0][:5]
    assert hierarchy.coarsened(children_of(hierarchy, 0, half)) is hierarchy
    assert hierarchy.coarsened(NOTHING) is hierarchy


def test_one_of_two_functions_goes_and_leaves_the_other() -> None:
    coarse = Hierarchy.on(generators.torus((12, 5)))
    one, other = (coarse.refined(np.array([i])) for i in (0, 30))
    both = coarse.refined(np.array([0, 30]))
    assert np.intersect1d(one.refined_keys[0], other.refined_keys[0]).size == 0
    assert both.coarsened(children_of(both, 0, other.refined_keys[0])).same_as(one)


@pytest.mark.parametrize("face", [100, 137])
def test_the_halo_is_one_support_wide(face: int) -> None:
    """One face that stays keeps one support, 16 faces, of a region that was refined all over."""
    _, fine = refined_everywhere()
    left = fine.coarsened(np.array([i for i, (_, key) in enumerate(cells_of(fine)) if key // 4 != face]))
    assert left.refined_keys[0].size == 16
    assert face in left.refined_keys[0]
    # One that goes, of many that stay: 16 functions with it in their supports are back, 25 of the next level are gone.
    hole = fine.coarsened(children_of(fine, 0, np.array([face])))
    assert np.setdiff1d(fine.refined_keys[0], hole.refined_keys[0]).tolist() == [face]
    assert hole.num_dofs == fine.num_dofs + 16 - 25


def test_the_cheapest_support_is_kept() -> None:
    """Where 15 faces of a support are to stay, it is that support which stays, for the price of one face."""
    coarse, fine = refined_everywhere()
    (support,) = coarse.support(np.array([100]))
    wanted = set(np.flatnonzero(support)[1:].tolist())
    left = fine.coarsened(np.array([i for i, (_, key) in enumerate(cells_of(fine)) if key // 4 not in wanted]))
    assert np.array_equal(left.refined_keys[0], np.flatnonzero(support))


def test_a_sunk_cap_rises_again_and_a_deep_one_stays() -> None:
    for cap_level in (CAP_LEVEL, CAP_LEVEL + 2):
        hierarchies = [Hierarchy.on(PLACES["l_tricube"], "crease", cap_level=cap_level)]
        for _ in range(4):
            l, last = hierarchies[-1].num_levels - 1, hierarchies[-1]
            here = np.flatnonzero(last.stages[l].level.control_vertex[last.dof_functions(l)] == 0)
            hierarchies.append(last.refined(last.dof_offsets[l] + here))
        fine = hierarchies[-1]
        assert fine.cap_levels[0] == max(cap_level, fine.num_levels)
        for expected in reversed(hierarchies[:-1]):
            fine = fine.coarsened(np.arange(len(cells_of(fine))))
            assert fine.same_as(expected)
            assert np.array_equal(fine.cap_levels, expected.cap_levels)


# ---- Common refinements


def test_the_common_refinement_is_the_least() -> None:
    for name in ("wheel5", "l_tricube"):
        coarse = beginning(name, "crease")
        one = coarse.refined(np.array([0])).refined(np.array([5]))
        other = coarse.refined(np.array([coarse.num_dofs - 1]))
        common = one.common_refinement(other)
        assert common.is_refinement_of(one)
        assert common.is_refinement_of(other)
        assert set(cells_of(common)) <= set(cells_of(one)) | set(cells_of(other))
        assert common.same_as(other.common_refinement(one))
        assert one.common_refinement(coarse) is one
        assert coarse.common_refinement(one).same_as(one)


def test_unrelated_hierarchies_have_no_common_refinement() -> None:
    wheel = beginning("wheel5", "crease")
    others = [beginning("wheel5", "clamped"), beginning("torus", "crease"), wheel.with_caps_at(CAP_LEVEL + 1)]
    for other in others:
        with pytest.raises(ValueError, match="the hierarchies have no common refinement"):
            wheel.common_refinement(other)


# ---- Functions are carried over


def spaces(name: str, boundary: str, shape: tuple[int, ...] = ()) -> tuple[FunctionSpace, FunctionSpace]:
    """A space, and what refining and coarsening in one go makes of it."""
    V = randomly_refined(fem.functionspace(PLACES[name], ("THCCS", 3, shape), boundary), times=3, seed=1)
    V2 = adapt.remesh(V, np.random.default_rng(0).integers(0, V.num_functions, 3), np.arange(V.num_cells))
    assert not V2.is_refinement_of(V)
    return V, V2


def over(common: Hierarchy, u: fem.Function) -> fem.Function:
    """The same function in the space of a refinement."""
    result = fem.Function(u.function_space.with_hierarchy(common))
    result.x.array = result.function_space.prolongation(u.function_space) @ u.x.array
    return result


def random_function(V: FunctionSpace) -> fem.Function:
    u = fem.Function(V)
    u.x.array = np.random.default_rng(3).uniform(0.0, 1.0, V.num_dofs)
    return u


@pytest.mark.parametrize("projection", ["L2", "H1"])
@pytest.mark.parametrize("shape", [(), (2,)])
@pytest.mark.parametrize(("name", "boundary"), CASES)
def test_the_integral_is_kept_and_the_error_orthogonal(
    name: str, boundary: str, shape: tuple[int, ...], projection: Literal["L2", "H1"]
) -> None:
    V, V2 = spaces(name, boundary, shape)
    u = random_function(V)
    w = adapt.transfer(u, V2, projection=projection)
    common = V.hierarchy.common_refinement(V2.hierarchy)
    fine, coarse = over(common, u), over(common, w)
    for i in range(V.block_size):
        before, after = (
            fem.assemble_scalar(fem.form((f[i] if shape else f) * dx, quadrature_degree=11)) for f in (fine, coarse)
        )
        assert abs(after - before) <= 1e-13 * before  # u > 0: rounding of sums of 10^4 positive numbers
    v = ufl.TestFunction(V2)
    product = inner(coarse - fine, v)
    if projection == "H1":
        product += inner(grad(coarse - fine), grad(v))
    defect = fem.assemble_vector(fem.form(product * dx, quadrature_degree=11))
    assert np.abs(defect).max() < 1e-11


def test_all_functions_and_components_share_one_factorisation(monkeypatch: pytest.MonkeyPatch) -> None:
    V, V2 = spaces("torus", "clamped", (2,))
    made = []

    def counted(A: sp.csr_array) -> Callable[[Floats], Floats]:
        made.append(weakref.ref(A))
        return factorised(A)

    monkeypatch.setattr(linear, "factorised", counted)
    u = random_function(V)
    first = adapt.transfer(u, V2)
    components = [random_function(fem.FunctionSpace(V.hierarchy)) for _ in range(2)]
    for i, component in enumerate(components):
        component.x.array = u.x.array[i::2]
        there = adapt.transfer(component, fem.FunctionSpace(V2.hierarchy))
        np.testing.assert_allclose(there.x.array, first.x.array[i::2], rtol=1e-13, atol=1e-14)
    assert len(made) == 1
    different = adapt.transfer(u, V2, projection="H1")
    assert len(made) == 2
    assert np.abs(different.x.array - first.x.array).max() > 1e-6
    adapt.transfer(u, V2)
    assert len(made) == 3  # only the last one is kept
    del V, u, component, components
    gc.collect()
    assert made[-1]() is None  # and no longer than functions to be carried over


@pytest.mark.parametrize("shape", [(), (2,)])
def test_the_integral_as_it_is_measured_is_kept_if_wanted(shape: tuple[int, ...]) -> None:
    # This coarse, quadrature errs by 2e-6 of the area, and by another number on finer cells.
    def measured(u: fem.Function) -> Floats:
        parts = [u[i] for i in range(2)] if shape else [u]
        return np.array([fem.assemble_scalar(fem.form(part * dx)) for part in parts])

    V = fem.functionspace(generators.torus((8, 6)), ("THCCS", 3, shape))
    kept = loose = random_function(V)
    start, moved = measured(kept), 0.0
    random = np.random.default_rng(5)
    for number in range(6):
        V = kept.function_space
        marked = random.integers(0, V.num_functions, 3)
        V = adapt.refine(V, marked) if number % 3 == 0 else adapt.remesh(V, marked, np.arange(V.num_cells))
        kept, loose = adapt.transfer(kept, V, conserve=True), adapt.transfer(loose, V)
        np.testing.assert_allclose(measured(kept), start, rtol=1e-13)  # rounding of sums
        moved = max(moved, np.abs(measured(loose) / start - 1.0).max())
    assert 1e-8 < moved < 1e-4
    np.testing.assert_allclose(kept.x.array, loose.x.array, atol=1e-4)  # constants


def test_what_is_lost_is_of_fourth_order() -> None:
    lost = []
    for n in (6, 12):
        msh = generators.torus((2 * n, n))
        V = fem.functionspace(msh, ("THCCS", 3))
        fine = adapt.refine(V, np.arange(V.num_functions))
        x = ufl.SpatialCoordinate(msh)
        u = fem.project(ufl.sin(x[0] + x[2]), fine)
        coarse = adapt.transfer(u, adapt.coarsen(fine, np.ones(fine.num_cells, dtype=bool)))
        assert coarse.function_space == V
        difference = over(fine.hierarchy, coarse) - u
        lost.append(np.sqrt(fem.assemble_scalar(fem.form(difference**2 * dx))))
    assert 3.5 < np.log2(lost[0] / lost[1]) < 5.0


# ---- A moving front


def distance(V: FunctionSpace, t: float) -> Floats:
    """Distance of each cell's midpoint from a sphere on its way around the torus."""
    points, hierarchy = [], V.hierarchy
    for l, stage in enumerate(hierarchy.stages[: V.num_levels]):
        points.append(hierarchy.points[l][stage.level.quads[stage.active_faces]].mean(axis=1))
    centre = np.array([2 * np.cos(t), 2 * np.sin(t), 1.0])
    return np.abs(np.linalg.norm(np.concatenate(points) - centre, axis=1) - 0.6)


def at_front(V: FunctionSpace, t: float, finest: int, widths: float) -> npt.NDArray[np.int64]:
    """Functions that cover the coarse cells nearer to the front than so many of their own widths."""
    near = distance(V, t) < widths * np.pi / 6 * 0.5**V.cells.level
    return adapt.mark(V, (near & (V.cells.level < finest)).astype(float), theta=1.0)


def test_dofs_do_not_pile_up_behind_a_moving_front() -> None:
    """Refined nearer than one width, coarsened further than two: no more than refining all that is nearer than two."""
    finest, rounds = 3, 5
    V = fem.functionspace(generators.torus((24, 12)), ("THCCS", 3))
    moving = piled_up = V
    u = fem.project(1.0, V)
    dofs, most = [], []
    for t in np.linspace(0.0, 1.0, 11):
        still = V
        for _ in range(rounds):  # a function with a coarse cell in its support may be one of a coarser level
            still = adapt.refine(still, at_front(still, t, finest, widths=2.0))
            piled_up = adapt.refine(piled_up, at_front(piled_up, t, finest, widths=1.0))
            far = distance(moving, t) > 2.0 * np.pi / 6 * 0.5**moving.cells.level
            moving = adapt.remesh(moving, at_front(moving, t, finest, widths=1.0), far)
        on_front = distance(moving, t) < 0.25 * np.pi / 6 * 0.5**finest
        assert (moving.cells.level[on_front] == finest).all()
        dofs.append(moving.num_dofs)
        most.append(still.num_dofs)
        u = adapt.transfer(u, moving)
    assert (np.array(dofs) < most).all()
    assert piled_up.num_dofs > 2 * max(dofs)
    np.testing.assert_allclose(u.x.array, 1.0, rtol=1e-10)  # ten projections, each to some 1e-12
