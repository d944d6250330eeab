"""Effectivities: what is estimated over the energy norm of the error, of equations of every kind."""

from dataclasses import replace

import pytest
from estimated import PROBLEMS, adaptive, uniform

# Least and largest effectivity on two levels of uniform refinement and in a short adaptive run, by a tenth to a fifth
# beyond what is measured for these. The table in docs/adaptivity.md has longer runs.
BOUNDS = {
    ("Poisson, square", "residual"): (0.75, 1.15),
    ("Poisson, wheel of 8", "residual"): (0.53, 1.1),
    ("L-domain, caps at 16", "residual"): (0.32, 0.45),
    ("Neumann, wheel of 5", "residual"): (0.45, 1.05),
    ("Poisson, wheel of 5, crease", "residual"): (0.53, 0.75),
    ("kappa 1 and 10", "residual"): (0.75, 1.1),
    ("kappa 1 and 10", "bubble"): (0.45, 0.7),
    ("Laplace-Beltrami, sphere", "residual"): (0.45, 0.95),
    ("reaction-diffusion, 0.1", "residual"): (0.45, 1.05),
    ("reaction-diffusion, 1e-6", "residual"): (0.85, 1.1),
    ("reaction-diffusion, 1e-6", "bubble"): (0.6, 0.95),
    ("advection-diffusion, 0.1", "residual"): (0.45, 1.05),
    ("advection-diffusion, 0.1", "bubble"): (0.45, 0.85),
    ("elasticity", "residual"): (0.4, 0.9),
    ("elasticity", "bubble"): (0.5, 0.8),
    ("-div((1 + u^2) grad u) = f", "residual"): (0.45, 1.05),
    ("-div((1 + u^2) grad u) = f", "bubble"): (0.4, 0.75),
    ("minimal surface", "residual"): (0.75, 1.3),
    ("minimal surface", "bubble"): (0.25, 0.55),
    ("plate, square", "residual"): (1.1, 1.75),
    ("plate, square", "bubble"): (0.45, 0.7),
    ("plate, square, x^4 - y^4", "residual"): (0.6, 1.1),
    ("plate, square, supported", "residual"): (1.3, 1.9),
    ("plate, square, free", "residual"): (1.2, 1.8),
    ("plate, wheel of 5", "residual"): (0.31, 0.7),
    ("plate, wheel of 5", "bubble"): (0.23, 0.4),
    ("plate, wheel of 8", "residual"): (0.4, 0.65),
    ("biharmonic, sphere", "residual"): (0.4, 1.0),
    ("biharmonic, sphere", "bubble"): (0.28, 0.48),
    ("shell, 0.1 thick", "bubble"): (0.4, 0.65),
}
MAX_DOFS = {"elasticity": 600, "biharmonic, sphere": 100, "shell, 0.1 thick": 150}  # others 300


@pytest.mark.parametrize(("name", "estimator"), BOUNDS, ids=[", ".join(key) for key in BOUNDS])
def test_bounded_on_both_sides(name: str, estimator: str) -> None:
    problem = replace(PROBLEMS[name](), levels=2, max_dofs=MAX_DOFS.get(name, 300))
    found = [*uniform(problem, estimator), *adaptive(problem, estimator)[2]]
    lower, upper = BOUNDS[name, estimator]
    assert len(found) > 2
    assert lower < min(found) < max(found) < upper, found


def test_bubbles_do_not_see_forces_on_edges_in_balance_with_themselves() -> None:
    """The third derivatives of x^4 - y^4 jump in both directions, and inside of cells nothing is left."""
    problem = replace(PROBLEMS["plate, square, x^4 - y^4"](), levels=2)
    assert uniform(problem, "bubble").max() < 0.01
