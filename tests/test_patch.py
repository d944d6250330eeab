"""The patch test: Poisson's equation with linear boundary values has the linear function as its solution, exactly."""

import numpy as np
import pytest
from problems import moved_inside, poisson, randomly_refined

import ufl
from thccs_fem import adapt, element, fem, generators, limit
from thccs_fem.boundary import BoundaryRule
from thccs_fem.hierarchy import CAP_LEVEL
from thccs_fem.mesh import ControlMesh

VALENCES = [3, 5, 6, 8]
SEEDS = [0, 1, 2]
ROUNDING = 1e-12  # condition numbers of some hundreds times values up to 4; 3e-14 was measured
SECTOR = 3  # faces along a side of a sector: a function's support fits in one

each_valence = pytest.mark.parametrize("valence", VALENCES)
each_rule = pytest.mark.parametrize("rule", ["clamped", "crease"])


def moved_wheel(valence: int, seed: int = 0) -> ControlMesh:
    return moved_inside(generators.wheel(valence, SECTOR), 0.2, seed)


def space(msh: ControlMesh, rule: BoundaryRule, cap_level: int = CAP_LEVEL) -> fem.FunctionSpace:
    return fem.functionspace(msh, ("THCCS", 3), boundary=rule, cap_level=cap_level)


def linear(x: ufl.core.expr.Expr) -> ufl.core.expr.Expr:
    return 1 + 2 * x[0] - 3 * x[1]


def patch_error(V: fem.FunctionSpace) -> float:
    """Return the largest error of the Bernstein coefficients, which bounds that of the function."""
    x = ufl.SpatialCoordinate(V.mesh)
    uh = poisson(V, linear(x), fem.Constant(V.mesh, 0.0))
    expected = linear(np.moveaxis(V.cells.piece_points, 2, 0))
    return float(np.abs((uh.local_coefficients()[..., 0] - expected) @ element.TO_BERNSTEIN.T).max())


@each_rule
@each_valence
def test_patch(valence: int, rule: BoundaryRule) -> None:
    assert patch_error(space(moved_wheel(valence), rule)) < ROUNDING


@each_rule
@each_valence
@pytest.mark.parametrize("cap_level", [1, CAP_LEVEL])
def test_patch_with_one_sector_refined(valence: int, rule: BoundaryRule, cap_level: int) -> None:
    """Sectors of different levels are cut down to one cap level; it sinks for all of them if one is refined too far."""
    msh = moved_wheel(valence)
    V = space(msh, rule, cap_level)
    centre = 0
    sectors = np.flatnonzero((msh.quads == centre).any(axis=1))
    for level, (face, uv) in enumerate([(8, 0.0), (4, 0.0), (0, 0.5)]):  # vertex (2, 2) / 2^level of the first sector
        point = limit.evaluate(msh, [face], [(uv, uv)])[0]
        distance = np.linalg.norm(V.reference_points - point, axis=1)
        distance[: V.hierarchy.dof_offsets[-2]] = np.inf  # coarser functions
        assert distance.min() < 1e-12
        V = adapt.refine(V, [distance.argmin()])
        levels = V.cells.level[np.isin(V.cells.face, sectors)]
        assert levels.max() == level + 1
        assert np.count_nonzero(levels == 0) == valence - 1
        assert patch_error(V) < ROUNDING


@each_rule
@each_valence
@pytest.mark.parametrize("seed", SEEDS)
def test_patch_after_random_refinements(valence: int, rule: BoundaryRule, seed: int) -> None:
    V = randomly_refined(space(moved_wheel(valence, seed), rule), times=4, seed=seed)
    assert V.num_levels >= 3
    assert patch_error(V) < ROUNDING
