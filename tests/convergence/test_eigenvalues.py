"""Rates of eigenvalues: twice those of energies on a fixed surface, and that of the geometry where the surface moves.

On a surface that is the same on all meshes eigenvalues of cubics converge with order 6. The limit surfaces of a torus
and of a sphere come nearer to the exact ones as the mesh is made finer, and with them the eigenvalues: with order 2 if
the control points are on the surface, with order 4 if the limit points of the vertices are.
"""

import numpy as np
import numpy.typing as npt

import ufl
from thccs_fem import fem, generators
from thccs_fem.fem.scipy import EigenProblem
from thccs_fem.fem.space import FunctionSpace
from thccs_fem.mesh import ControlMesh
from ufl import dx, grad, inner

Floats = npt.NDArray[np.float64]

R, r = 2.0, 1.0


def eigenvalues(V: FunctionSpace, count: int, on_boundary: bool = False) -> Floats:
    """Return the first eigenvalues of the Laplace-Beltrami operator."""
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    bcs = [fem.dirichletbc(0.0, fem.boundary_dofs(V), V)] if on_boundary else []
    return EigenProblem(inner(grad(u), grad(v)) * dx, bcs=bcs, num_eigenvalues=count).solve()[0]


def rates(sizes: tuple[int, ...], errors: Floats) -> Floats:
    """Return the slopes of errors, shape (sizes, eigenvalues), in 1 / size."""
    return -np.polyfit(np.log(sizes), np.log(errors), 1)[0]


def test_rectangles() -> None:
    sides = np.array([1.0, 1.3])
    i, j = np.mgrid[1:9, 1:9]
    exact = np.sort((np.pi**2 * ((i / sides[0]) ** 2 + (j / sides[1]) ** 2)).ravel())[:4]
    sizes = (12, 16, 24)
    found = [
        eigenvalues(fem.functionspace(generators.rectangle((n, n), (0.0, 0.0), tuple(sides)), ("THCCS", 3)), 4, True)
        for n in sizes
    ]
    errors = np.array(found) / exact - 1.0
    assert (errors > 0.0).all()  # from above, by Rayleigh's principle
    assert (np.abs(rates(sizes, errors) - 6.0) < 0.4).all()
    assert (errors[-1] < 1.1 * np.array([1.7e-10, 7.8e-9, 9.6e-9, 1.1e-7])).all()  # as measured


# ---- Tori


def interpolating_torus(n: int, m: int) -> ControlMesh:
    """Return a control mesh whose limit surface meets the torus in the limit points of its n x m vertices.

    A uniform cubic B-spline with control points on a circle has its knots on one that is smaller by (2 + cos(2 pi / n))
    / 3; so it is along and around, where the distance from the axis is shrunk by both, and the height by one.
    """
    along, around = np.meshgrid(2 * np.pi * np.arange(n) / n, 2 * np.pi * np.arange(m) / m, indexing="ij")
    k_along, k_around = ((2.0 + np.cos(2 * np.pi / count)) / 3.0 for count in (n, m))
    distance = (R + r * np.cos(around) / k_around) / k_along
    points = np.stack([distance * np.cos(along), distance * np.sin(along), r * np.sin(around) / k_around], axis=-1)
    return ControlMesh(points.reshape(-1, 3), generators.torus((n, m)).quads)


def of_torus(count: int, size: int = 24) -> Floats:
    """Return the first eigenvalues of the torus of revolution.

    With u = f(t) exp(i k s), s along and t around the tube, and rho = R + r cos(t) the distance from the axis, they are
    those of -(rho f')' / (r^2 rho) + k^2 f / rho^2 = lambda f: once for k = 0, twice for k > 0. f is a trigonometric
    polynomial, the integrals are trapezoidal sums: both converge exponentially.
    """
    t = 2 * np.pi * np.arange(8 * size) / (8 * size)
    rho = R + r * np.cos(t)
    l = np.arange(size)
    basis = np.hstack([np.cos(np.outer(t, l)), np.sin(np.outer(t, l[1:]))])
    slope = np.hstack([-l * np.sin(np.outer(t, l)), l[1:] * np.cos(np.outer(t, l[1:]))])
    mass = basis.T @ (rho[:, None] * basis)
    L = np.linalg.cholesky(mass)
    found: list[float] = []
    for k in range(count):
        energy = slope.T @ (rho[:, None] * slope) / r**2 + k**2 * basis.T @ (basis / rho[:, None])
        own = np.linalg.eigvalsh(np.linalg.solve(L, np.linalg.solve(L, energy).T))
        found += own.tolist() * (1 if k == 0 else 2)
    return np.sort(found)[:count]


def test_the_spectrum_of_the_torus_is_known() -> None:
    spectrum = of_torus(12)
    np.testing.assert_allclose(spectrum, of_torus(12, 36), rtol=1e-11, atol=1e-11)
    assert abs(spectrum[0]) < 1e-12
    assert spectrum[1] == spectrum[2]
    # The first function is nearly one of the angle along, as on a thin tube, where lambda is 1 / R^2.
    assert abs(spectrum[1] * R**2 - 1.0) < 0.01


def test_tori_of_revolution() -> None:
    exact = of_torus(8)
    sizes = (12, 16, 24, 32)
    found = np.array([eigenvalues(fem.functionspace(interpolating_torus(n, n // 2), ("THCCS", 3)), 8) for n in sizes])
    np.testing.assert_allclose(found[:, 0], 0.0, atol=1e-10)
    np.testing.assert_allclose(found[:, [1, 3]], found[:, [2, 4]], rtol=1e-9)  # double, by the mesh's symmetry
    errors = np.abs(found[:, 1:] / exact[1:] - 1.0)
    assert (np.abs(rates(sizes[1:], errors[1:]) - 4.0) < 0.4).all()
    assert (errors[-1] < 8e-5).all()  # measured: 1.3e-5 to 7.3e-5


# ---- Spheres


def test_spheres() -> None:
    degrees = np.repeat([1, 2, 3], [3, 5, 7])
    exact = degrees * (degrees + 1.0)
    sizes = (3, 4, 6, 8, 12)
    found = np.array([eigenvalues(fem.functionspace(generators.cube_sphere(n), ("THCCS", 3)), 16) for n in sizes])
    np.testing.assert_allclose(found[:, 0], 0.0, atol=1e-10)
    errors = found[:, 1:] / exact - 1.0
    spread = np.array([[np.ptp(own[degrees == l]) for l in (2, 3)] for own in found[:, 1:]])
    assert (errors > 0.0).all()  # the surface is inside of the sphere
    assert (np.abs(rates(sizes[1:], errors[1:]) - 2.0) < 0.1).all()
    assert (errors[-1] < 0.011).all()  # measured: 0.0097 to 0.0105
    assert (np.abs(rates(sizes[1:], spread[1:]) - 2.0) < 0.3).all()  # multiplets cluster
