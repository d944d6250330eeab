"""Smooth problems whose rates nothing but extraordinary vertices lowers, for tests and the benchmark."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from problems import errors, laplacian, poisson, projected_in_h1, smooth, wavy

import ufl
from thccs_fem import estimate, fem, generators
from thccs_fem.fem.scipy import LinearProblem
from thccs_fem.mesh import ControlMesh
from thccs_fem.subdivision import subdivided
from ufl import div, dx, grad, inner

__all__ = [
    "OPTIMAL",
    "Closed",
    "Fitted",
    "Plane",
    "Problem",
    "closed",
    "on_sphere",
    "on_torus",
    "plane",
    "rates",
    "row",
]

Floats = npt.NDArray[np.float64]
Expr = ufl.core.expr.Expr

OPTIMAL = np.array([2.0, 1.5])  # rates in dofs, in L2 and H1


@dataclass(frozen=True)
class Plane:
    """-div(grad(u)) = 6.25 u with the values of u on the boundary."""

    V: fem.FunctionSpace

    @property
    def exact(self) -> ufl.core.expr.Expr:
        return wavy(ufl.SpatialCoordinate(self.V.mesh))

    def solve(self, V: fem.FunctionSpace) -> fem.Function:
        return poisson(V, self.exact, 6.25 * self.exact)

    def residual(self, uh: fem.Function) -> Floats:
        return estimate.residual(uh, 6.25 * self.exact + div(grad(uh)))

    def bubble(self, uh: fem.Function) -> Floats:
        u, v = (make(uh.function_space) for make in (ufl.TrialFunction, ufl.TestFunction))
        return estimate.bubble(uh, inner(grad(u), grad(v)) * dx, 6.25 * self.exact * v * dx)


@dataclass(frozen=True)
class Closed:
    """u - div(grad(u)) = f on a surface; f is left in its weak form where possible, which needs no curvature."""

    V: fem.FunctionSpace

    @property
    def exact(self) -> ufl.core.expr.Expr:
        return smooth(ufl.SpatialCoordinate(self.V.mesh))

    def solve(self, V: fem.FunctionSpace) -> fem.Function:
        return projected_in_h1(V, self.exact)

    def residual(self, uh: fem.Function) -> Floats:
        f = self.exact - laplacian(uh.function_space.mesh, self.exact)
        return estimate.residual(uh, f - uh + div(grad(uh)))

    def bubble(self, uh: fem.Function) -> Floats:
        u, v = (make(uh.function_space) for make in (ufl.TrialFunction, ufl.TestFunction))
        a, load = (inner(grad(w), grad(v)) + w * v for w in (u, self.exact))
        return estimate.bubble(uh, a * dx, load * dx)


@dataclass(frozen=True)
class Fitted:
    """u - div(grad(u)) = f on a surface that is nearly the given one, with f and u at the nearest points of that."""

    V: fem.FunctionSpace
    exact: Expr
    f: Expr

    def solve(self, V: fem.FunctionSpace) -> fem.Function:
        u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
        return LinearProblem((inner(grad(u), grad(v)) + u * v) * dx, self.f * v * dx).solve()

    def residual(self, uh: fem.Function) -> Floats:
        return estimate.residual(uh, self.f - uh + div(grad(uh)))

    def bubble(self, uh: fem.Function) -> Floats:
        u, v = ufl.TrialFunction(uh.function_space), ufl.TestFunction(uh.function_space)
        return estimate.bubble(uh, (inner(grad(u), grad(v)) + u * v) * dx, self.f * v * dx)


Problem = Plane | Closed | Fitted


def plane(valence: int) -> Plane:
    """Return the problem on a wheel."""
    return Plane(fem.functionspace(generators.wheel(valence, 2), ("THCCS", 3)))


def closed(valence: int) -> Closed:
    """Return the problem on a surface with two poles of the valence, and others of valence 3."""
    return Closed(fem.functionspace(generators.trapezohedron(valence, 1), ("THCCS", 3)))


def on_sphere(cage: ControlMesh, times: int) -> Fitted:
    """Return the problem on a cage that is subdivided some times and fitted to the unit sphere: spherical harmonics."""
    mesh = generators.fitted(subdivided(cage, times), lambda x: x / np.linalg.norm(x, axis=0))
    x = ufl.SpatialCoordinate(mesh)
    n = x / ufl.sqrt(ufl.dot(x, x))
    harmonics = {1: n[2] + 0.5 * n[0], 2: n[0] ** 2 - n[1] ** 2, 3: 3 * n[0] * n[1] * n[2]}  # by degree
    f = sum((1 + k * (k + 1)) * u for k, u in harmonics.items())
    return Fitted(fem.functionspace(mesh, ("THCCS", 3)), sum(harmonics.values()), f)


def on_torus(n: int) -> Fitted:
    """Return the problem on the torus of radii 2 and 1, of 2 n x n faces: u = cos(phi) sin(theta), around and along."""
    mesh = generators.interpolated(generators.torus((2 * n, n), R=2.0, r=1.0))
    x = ufl.SpatialCoordinate(mesh)
    rho = ufl.sqrt(x[0] ** 2 + x[1] ** 2)
    tube = ufl.sqrt((rho - 2) ** 2 + x[2] ** 2)
    cos_phi, cos_theta, sin_theta = x[0] / rho, (rho - 2) / tube, x[2] / tube
    width = 2 + cos_theta  # the distance from the axis; the operator is d(w du)/w + d^2 u/w^2 in theta and phi
    u = cos_phi * sin_theta
    return Fitted(fem.functionspace(mesh, ("THCCS", 3)), u, u + u * cos_theta / width + u + u / width**2)


def row(problem: Problem, V: fem.FunctionSpace) -> tuple[float, float, float]:
    """Return dofs and errors in L2 and H1."""
    return V.num_dofs, *errors(problem.solve(V), problem.exact)


def rates(rows: Sequence[tuple[float, ...]] | Floats) -> Floats:
    """Return the rates in dofs of both errors, by least squares."""
    dofs, *found = np.log(np.array(rows).T)
    return -np.polyfit(dofs, np.transpose(found), 1)[0]
