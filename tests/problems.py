"""Model problems, and ways to refine, for the tests of rates, errors and marking."""

from collections.abc import Sequence
from math import cos, log2, pi, sqrt

import numpy as np

import ufl
from thccs_fem import adapt, estimate, fem, generators
from thccs_fem.fem.scipy import LinearProblem
from thccs_fem.mesh import ControlMesh
from ufl import dx, grad, inner

__all__ = [
    "errors",
    "graded_l_domain",
    "halvings",
    "laplacian",
    "lifted",
    "moved_inside",
    "poisson",
    "projected_in_h1",
    "randomly_refined",
    "rates_at_extraordinary",
    "refined_anywhere",
    "refined_towards",
    "singular",
    "smooth",
    "tangential",
    "uniformly_refined",
    "wavy",
]

Expr = ufl.core.expr.Expr


# ---- Meshes and spaces


def moved_inside(msh: ControlMesh, size: float, seed: int = 0) -> ControlMesh:
    """Return the mesh with the vertices inside moved by up to `size` of its shortest edge along each axis."""
    shift = np.random.default_rng(seed).uniform(-1.0, 1.0, msh.vertices.shape)
    shift[msh.boundary_vertices] = 0.0
    ends = msh.vertices[msh.edges]
    shortest = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).min()
    return ControlMesh(msh.vertices + size * shortest * shift, msh.quads, corners=msh.corners)


def lifted(msh: ControlMesh) -> ControlMesh:
    """Return a planar mesh lifted onto a paraboloid, so that its rim is a curve in space."""
    x, y = msh.vertices.T
    z = 0.8 - 0.5 * x**2 - 0.3 * y**2 + 0.2 * x * y
    return ControlMesh(np.column_stack([x, y, z]), msh.quads, corners=msh.corners)


def uniformly_refined(V: fem.FunctionSpace, times: int = 1) -> fem.FunctionSpace:
    for _ in range(times):
        V = adapt.refine(V, np.arange(V.num_functions))
    return V


def randomly_refined(V: fem.FunctionSpace, times: int = 3, seed: int = 0) -> fem.FunctionSpace:
    """Refine three functions at a time, rather new ones than old, so that levels pile up."""
    rng = np.random.default_rng(seed)
    for _ in range(times):
        weight = np.arange(1.0, V.num_functions + 1) ** 2
        V = adapt.refine(V, rng.choice(V.num_functions, size=3, replace=False, p=weight / weight.sum()))
    return V


def refined_towards(
    V: fem.FunctionSpace, point: Sequence[float], num_levels: int, count: int = 24
) -> fem.FunctionSpace:
    """Refine the functions of the finest level that are next to a point, again and again."""
    while V.num_levels < num_levels:
        first = V.hierarchy.dof_offsets[-2]
        distance = np.linalg.norm(V.reference_points[first:] - np.array(point), axis=1)
        V = adapt.refine(V, first + np.argsort(distance, kind="stable")[:count])
    return V


def refined_anywhere(V: fem.FunctionSpace, num_levels: int, seed: int = 0) -> fem.FunctionSpace:
    """Refine one in sixteen of the functions of the finest level, wherever they are."""
    rng = np.random.default_rng(seed)
    while V.num_levels < num_levels:
        new = np.arange(V.hierarchy.dof_offsets[-2], V.num_functions)
        V = adapt.refine(V, rng.choice(new, size=max(3, new.size // 16), replace=False))
    return V


def graded_l_domain(num_levels: int, theta: float = 0.5) -> fem.FunctionSpace:
    """Return a space on the L-domain with its corner at the origin, refined as the H1 error of r^(2/3) asks for."""
    V = fem.functionspace(generators.l_domain(4), ("THCCS", 3))
    while V.num_levels < num_levels:
        size = 0.25 * 0.5 ** np.repeat(np.arange(V.num_levels), np.diff(V.hierarchy.dof_offsets))
        distance = np.maximum(np.linalg.norm(V.reference_points, axis=1), size)
        error = size**4 * distance ** (2 / 3 - 4)
        order = np.argsort(-error, kind="stable")
        carried = np.cumsum(error[order] ** 2)
        V = adapt.refine(V, order[: np.searchsorted(carried, theta * carried[-1]) + 1])
    return V


# ---- Extraordinary vertices


def halvings(valence: int) -> float:
    """Return log2(1 / lambda), lambda the eigenvalue of Catmull and Clark's masks by which rings of faces shrink."""
    c = cos(2 * pi / valence)
    return -log2((5 + c + cos(pi / valence) * sqrt(18 + 2 * c)) / 16)


def rates_at_extraordinary(valence: int) -> tuple[float, float]:
    """Return the rates in L2 and H1, under uniform refinement, of a space without quadratic functions at a vertex."""
    return min(4.0, 3 * halvings(valence)), min(3.0, 2 * halvings(valence))


# ---- Exact solutions


def wavy(x: Expr) -> Expr:
    """Return a planar function with -div(grad(u)) = 6.25 u."""
    return ufl.sin(2 * x[0] + 1) * ufl.cos(1.5 * x[1])


def smooth(x: Expr) -> Expr:
    """Return a function of space."""
    return ufl.sin(0.4 * x[0] + 0.5) * ufl.exp(0.1 * x[1]) + 0.03 * x[2] ** 2


def singular(x: Expr) -> Expr:
    """Return r^(2/3) sin(2 theta/3 - pi/3), theta from pi/2 to 2 pi: harmonic, zero on the edges at the L's corner."""
    turned = 5 * np.pi / 4  # atan2 jumps at half a turn: put that in the middle of the missing quadrant
    c, s = np.cos(turned), np.sin(turned)
    theta = turned + ufl.atan2(c * x[1] - s * x[0], c * x[0] + s * x[1])
    return (x[0] ** 2 + x[1] ** 2) ** (1 / 3) * ufl.sin(2 * theta / 3 - np.pi / 3)


def tangential(msh: ControlMesh, gradient: Expr) -> Expr:
    """Return the part of a gradient that is tangential to the surface: UFL's own of a function of space is another."""
    if msh.gdim == 2:
        return gradient
    domain = msh.ufl_domain()
    return ufl.dot(gradient, ufl.Jacobian(domain) * ufl.JacobianInverse(domain))


def laplacian(msh: ControlMesh, g: Expr) -> Expr:
    """Return the Laplace-Beltrami operator of a function of space."""
    return ufl.div(tangential(msh, grad(g)))


# ---- Solvers


def poisson(V: fem.FunctionSpace, exact: Expr, f: Expr) -> fem.Function:
    """Solve -div(grad(u)) = f with the values of u on the boundary."""
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    bc = fem.dirichletbc(exact, fem.boundary_dofs(V), V)
    return LinearProblem(inner(grad(u), grad(v)) * dx, f * v * dx, bcs=[bc]).solve()


def projected_in_h1(V: fem.FunctionSpace, exact: Expr) -> fem.Function:
    """Solve u - div(grad(u)) = f on a surface, with the values of u on the boundary if there is one.

    The load is a(exact, v): f itself, the Laplace-Beltrami operator of a function of space, UFL cannot write.
    """
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    load = (inner(grad(exact), grad(v)) + exact * v) * dx  # grad(v) takes the tangential part of grad(exact)
    dofs = fem.boundary_dofs(V)
    bcs = [fem.dirichletbc(exact, dofs, V)] if dofs.size else []
    return LinearProblem((inner(grad(u), grad(v)) + u * v) * dx, load, bcs=bcs).solve()


def errors(uh: fem.Function, exact: Expr) -> tuple[float, float]:
    """Return the errors in L2 and H1."""
    V = uh.function_space
    return estimate.norm(V, estimate.error(uh, exact, "L2")), estimate.norm(V, estimate.error(uh, exact, "H1"))
