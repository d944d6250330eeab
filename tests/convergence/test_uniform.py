"""Rates of uniform refinement: full order where the mesh is regular, less at rims without traces.

Expected rates in L2 and H1 are theory where it exists (order 4 and 3; 2.5 and 1.5 with the Catmull-Clark boundary rule;
at an extraordinary vertex those of its masks, see test_extraordinary.py). The last errors are those that were measured.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import pi

import numpy as np
import pytest
from problems import errors, lifted, poisson, projected_in_h1, rates_at_extraordinary, smooth, uniformly_refined, wavy

import ufl
from thccs_fem import fem, generators
from thccs_fem.boundary import BoundaryRule
from thccs_fem.mesh import ControlMesh

FULL = (4.0, 3.0)
CREASE = (2.5, 1.5)
FITTED = 3  # levels
TOLERANCE = 0.2  # of rates: what terms of higher order still change on these levels
MARGIN = 1.1  # of errors


def half_torus(n: int, m: int) -> ControlMesh:
    """Return half of a torus, n faces along and m around the tube: no extraordinary vertex, two circles for a rim."""
    along, around = np.meshgrid(np.linspace(0.0, pi, n + 1), 2 * pi * np.arange(m) / m, indexing="ij")
    distance = 2.0 + np.cos(around)
    points = np.stack([distance * np.cos(along), distance * np.sin(along), np.sin(around)], axis=-1)
    i, j = np.meshgrid(np.arange(n), np.arange(m), indexing="ij")
    corners = [i * m + j, (i + 1) * m + j, (i + 1) * m + (j + 1) % m, i * m + (j + 1) % m]
    return ControlMesh(points.reshape(-1, 3), np.stack(corners, axis=-1).reshape(-1, 4))


@dataclass(frozen=True)
class Case:
    mesh: Callable[[], ControlMesh]
    rates: tuple[float, float]  # in L2 and H1
    levels: int
    last: tuple[float, float]  # errors on the last level
    rule: BoundaryRule = "clamped"


CASES = {
    # In the plane: Poisson's equation with Dirichlet data.
    "square": Case(lambda: generators.rectangle((4, 4)), FULL, 5, (5.3e-10, 2.2e-7)),
    "square, crease": Case(lambda: generators.rectangle((4, 4)), CREASE, 5, (3.0e-6, 7.1e-4), "crease"),
    # Closed surfaces: u - div(grad(u)) = f.
    "torus": Case(lambda: generators.torus((16, 10)), FULL, 4, (1.5e-7, 8.9e-6)),
    "genus 3": Case(lambda: generators.genus3(levels=2), rates_at_extraordinary(8), 3, (3.7e-5, 1.1e-3)),
    # Surfaces with a curved rim: the same with Dirichlet data.
    "half torus": Case(lambda: half_torus(6, 6), FULL, 5, (3.0e-8, 2.8e-6)),
    "half torus, crease": Case(lambda: half_torus(6, 6), CREASE, 5, (2.0e-6, 9.4e-5), "crease"),
    "lifted square": Case(lambda: lifted(generators.rectangle((4, 4))), FULL, 6, (1.6e-12, 1.0e-9)),
    "lifted disc": Case(lambda: lifted(generators.disc(2)), FULL, 5, (2.4e-9, 5.0e-7)),  # valence 3 shows later
    "valence 5 next to the rim": Case(
        lambda: lifted(generators.wheel(5, 1)), rates_at_extraordinary(5), 6, (4.2e-8, 5.5e-6)
    ),
    "the same, crease": Case(lambda: lifted(generators.wheel(5, 1)), CREASE, 5, (1.7e-6, 1.4e-4), "crease"),
}


def run(case: Case) -> np.ndarray:
    """Return the errors on each level, shape (levels, 2)."""
    msh = case.mesh()
    V = fem.functionspace(msh, ("THCCS", 3), boundary=case.rule)
    x = ufl.SpatialCoordinate(msh)
    found = []
    for level in range(case.levels):
        V = uniformly_refined(V) if level else V
        exact = wavy(x) if msh.gdim == 2 else smooth(x)
        uh = poisson(V, exact, 6.25 * exact) if msh.gdim == 2 else projected_in_h1(V, exact)
        found.append(errors(uh, exact))
    return np.array(found)


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_rates(case: Case) -> None:
    found = run(case)
    rates = -np.polyfit(np.arange(FITTED), np.log2(found[-FITTED:]), 1)[0]
    np.testing.assert_allclose(rates, case.rates, atol=TOLERANCE)
    assert (found[-1] < MARGIN * np.array(case.last)).all()
