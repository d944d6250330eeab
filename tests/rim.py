"""Spaces with a rim, and values and slopes of their functions there."""

import functools

import numpy as np
import numpy.typing as npt
from zoo import ZOO

from thccs_fem import adapt, fem, generators
from thccs_fem.extraction import evaluate_pieces
from thccs_fem.fem.space import FunctionSpace

Floats = npt.NDArray[np.float64]

WITH_RIM = [name for name, make in ZOO.items() if make().boundary_edges.size]


@functools.cache
def space(name: str, boundary: str = "clamped", times: int = 0) -> FunctionSpace:
    """Return scalar functions on a mesh of the zoo, refined a few times."""
    V = fem.functionspace(ZOO[name](), ("THCCS", 3), boundary=boundary)
    for _ in range(times):
        V = adapt.refine(V, [0, V.num_functions - 1, V.num_functions // 2])
    return V


def with_random_values(V: FunctionSpace, dofs: npt.ArrayLike) -> fem.Function:
    """Return a function whose coefficients are random at the given dofs, and else zero."""
    u = fem.Function(V)
    u.x.array[dofs] = np.random.default_rng(0).uniform(1.0, 2.0, np.size(dofs))
    return u


def unit_square(n: int = 4, times: int = 0, shape: tuple[int, ...] = ()) -> FunctionSpace:
    """Return functions on a square of n x n faces, refined a few times."""
    msh = generators.rectangle((n, n), lower=(0.0, 0.0), upper=(1.0, 1.0))
    V = fem.functionspace(msh, ("THCCS", 3, shape))
    for _ in range(times):
        V = adapt.refine(V, [0, V.num_functions - 1, V.num_functions // 2])
    return V


def slopes_on_the_rim(u: fem.Function) -> tuple[Floats, Floats]:
    """Values, and derivatives along the inner conormal, at points of all boundary edges, by differences of values."""
    V = u.function_space
    piece, side, _ = V.cells.boundary_pieces
    corner = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])[side]
    along = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])[side]
    inward = np.array([[0.0, 1.0], [-1.0, 0.0], [0.0, -1.0], [1.0, 0.0]])[side]
    at = corner + 0.3 * along

    def derivative(local: Floats, direction: Floats) -> Floats:
        values = [evaluate_pieces(local, piece, at + step * direction) for step in (0.0, 0.25, 0.5, 0.75)]
        return (-11 * values[0] + 18 * values[1] - 9 * values[2] + 2 * values[3]) / 1.5  # exact for cubics

    (xs, us), (xt, ut) = (
        [derivative(local, direction) for local in (V.cells.piece_points, u.local_coefficients())]
        for direction in (along, inward)
    )
    shear = (xt * xs).sum(axis=1) / (xs**2).sum(axis=1)
    width = np.linalg.norm(xt - shear[:, None] * xs, axis=1)
    return evaluate_pieces(u.local_coefficients(), piece, at)[:, 0], (ut[:, 0] - shear * us[:, 0]) / width
