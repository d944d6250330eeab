"""Section 5 of the paper: twenty random refinements of every kind of mesh do not move the surface."""

import numpy as np
import pytest
from refinements import CASES, MESHES, PLACES, bernstein_rows, chosen, geometry_dofs, random_positions, regular_pieces

from thccs_fem import generators, limit
from thccs_fem.extraction import Cells, evaluate_pieces, extract
from thccs_fem.hierarchy import Hierarchy
from thccs_fem.mesh import ControlMesh

REFINEMENTS = 20
EXACT = 1e-12  # of the diameter: some dozen products, a few levels deep

GENERATED = {
    "rectangle": generators.rectangle((4, 3)),
    "disc": generators.disc(2),
    "wheel": generators.wheel(5, 3),
    "l_domain": generators.l_domain(2),
    "l_domain1": generators.l_domain1(),
    "l_domain2": generators.l_domain2(),
    "generated_torus": generators.torus((8, 6)),
    "cube_sphere": generators.cube_sphere(2),
    "genus3": generators.genus3(0),
}
EVERY = MESHES | GENERATED
EVERY_CASE = CASES + [
    (name, rule)
    for name, mesh in GENERATED.items()
    for rule in (("crease", "clamped") if mesh.boundary_edges.size else ("crease",))
]


def refined_at_random(hierarchy: Hierarchy, most_levels: int, seed: int = 5) -> Hierarchy:
    """Twenty functions refined one after the other: anywhere, on the rim or at irregular vertices, fine or coarse."""
    rng = np.random.default_rng(seed)
    for place, finest, number in zip(
        rng.choice(PLACES, REFINEMENTS), rng.random(REFINEMENTS) < 0.5, rng.integers(0, 9999, REFINEMENTS), strict=True
    ):
        hierarchy = hierarchy.refined(chosen(hierarchy, place, finest, number, most_levels))
    return hierarchy


def diameter(mesh: ControlMesh) -> float:
    return float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))


def surface_at(cells: Cells, dofs: np.ndarray, positions: tuple[np.ndarray, np.ndarray, np.ndarray]) -> np.ndarray:
    return evaluate_pieces(cells.local(dofs), *cells.locate(*positions))


@pytest.mark.parametrize(("name", "rule"), EVERY_CASE)
def test_surface_stays_where_it_is(name: str, rule: str) -> None:
    mesh = EVERY[name]
    # A cap level that no refinement comes near, so that all hierarchies have the same caps.
    most_levels = 5
    coarse = Hierarchy.on(mesh, rule, cap_level=most_levels)
    fine = refined_at_random(coarse, most_levels)
    assert fine.num_levels >= 3 or name == "single_quad"
    dofs = geometry_dofs(coarse)
    carried = fine.prolongation(coarse) @ dofs
    np.testing.assert_allclose(carried, geometry_dofs(fine), rtol=0, atol=EXACT * diameter(mesh))  # as subdivided
    positions = random_positions(coarse, 400)
    cells = extract(fine)
    before, after = surface_at(extract(coarse), dofs, positions), surface_at(cells, carried, positions)
    np.testing.assert_allclose(after, before, rtol=0, atol=EXACT * diameter(mesh))
    rows = bernstein_rows(cells)
    np.testing.assert_allclose(rows @ np.ones(fine.num_dofs), 1.0, rtol=0, atol=EXACT)
    assert rows.data.min() >= -1e-13


@pytest.mark.parametrize(("name", "rule"), EVERY_CASE)
def test_outside_the_caps_it_is_the_limit_surface_wherever_these_have_sunk(name: str, rule: str) -> None:
    mesh = EVERY[name]
    coarse = Hierarchy.on(mesh, rule, cap_level=1)
    fine = refined_at_random(coarse, 6)
    irregular = ~fine.root.regular
    assert not irregular.any() or fine.cap_levels[irregular].max() > 2
    cells = extract(fine)
    positions = random_positions(coarse, 800)
    exact = limit.evaluate(mesh, *positions[:2], corner=positions[2], derivatives=0).reshape(800, -1)
    found = surface_at(cells, fine.prolongation(coarse) @ geometry_dofs(coarse), positions)
    outside = regular_pieces(cells)[cells.locate(*positions)[0]]
    assert np.count_nonzero(outside) > 100
    np.testing.assert_allclose(found[outside], exact[outside], rtol=0, atol=EXACT * diameter(mesh))
