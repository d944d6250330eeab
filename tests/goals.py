"""Problems with a goal: equations, what is prescribed, a number that is wanted, and the solution where it is known."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from problems import lifted, singular, smooth, wavy

import ufl
from thccs_fem import fem, generators
from thccs_fem.fem.scipy import LinearProblem, NonlinearProblem
from thccs_fem.forms import linear_elasticity, minimal_surface, plate, poisson
from thccs_fem.mesh import ControlMesh
from ufl import dot, ds, dx, grad, inner

__all__ = ["KNOWN", "LINEAR", "NONLINEAR", "Problem", "bumps", "l_shaped", "square", "value_of"]

Expr = ufl.core.expr.Expr
Bcs = Callable[[fem.FunctionSpace], Sequence[fem.DirichletBC]]

LEFT, RIGHT, BOTTOM, TOP = 1, 2, 3, 4


@dataclass(frozen=True)
class Problem:
    """F(u; v) = 0 for all v, and J(u).

    Attributes:
        V: The first space.
        F: The residual.
        J: The goal.
        bcs: Conditions in a space.
        exact: The solution, if it is known.
    """

    V: fem.FunctionSpace
    F: Callable[[Any, Any], ufl.Form]
    J: Callable[[Any], ufl.Form]
    bcs: Bcs = lambda V: []
    exact: Expr | None = None

    def solve(self, V: fem.FunctionSpace, problem: Callable[..., Any] = LinearProblem) -> fem.Function:
        """Solve a linear problem."""
        a, L = ufl.system(self.F(ufl.TrialFunction(V), ufl.TestFunction(V)))
        solution: fem.Function = problem(a, L, bcs=self.bcs(V), petsc_options_prefix="goals_").solve()
        return solution

    def solve_by_newton(self, V: fem.FunctionSpace, problem: Callable[..., Any] = NonlinearProblem) -> fem.Function:
        uh = fem.Function(V)
        F = self.F(uh, ufl.TestFunction(V))
        solution: fem.Function = problem(F, uh, bcs=self.bcs(V), petsc_options_prefix="goals_").solve()
        return solution

    def forms(self, uh: fem.Function) -> tuple[ufl.Form, ufl.Form]:
        """Return F and J of an approximation."""
        return self.F(uh, ufl.TestFunction(uh.function_space)), self.J(uh)


def value_of(J: ufl.Form) -> float:
    return fem.assemble_scalar(fem.form(J))


def tagged(msh: ControlMesh, comm: Any = None) -> ControlMesh:
    """Return a planar mesh with tags on its four sides, and 1 on the faces in the lower left part."""
    x = msh.vertices
    low, high = x.min(axis=0), x.max(axis=0)
    rim = msh.edges[msh.edge_faces[:, 1] < 0]
    middles = x[rim].mean(axis=1)
    distances = np.stack([middles - low, high - middles], axis=2)  # from LEFT and RIGHT, and from BOTTOM and TOP
    nearest = LEFT + distances.reshape(-1, 4).argmin(axis=1)
    sides = dict(zip(map(tuple, rim.tolist()), nearest.tolist(), strict=True))
    faces = (x[msh.quads].mean(axis=1) < (low + high) / 2).all(axis=1).astype(int)
    return ControlMesh(x, msh.quads, face_tags=faces, edge_tags=sides, corners=msh.corners, comm=comm)


def prescribed(exact: Expr | float, **where: Any) -> Bcs:
    return lambda V: [fem.dirichletbc(exact, fem.boundary_dofs(V, **where), V)]


def square(comm: Any = None, n: int = 4) -> ControlMesh:
    return tagged(generators.rectangle((n, n), comm=comm), comm)


# ---- Linear ones


def mean_over_a_part(comm: Any = None) -> Problem:
    """Return Poisson's equation on a square, and the mean over a quarter of it."""
    msh = square(comm)
    exact = wavy(ufl.SpatialCoordinate(msh))
    V = fem.functionspace(msh, ("THCCS", 3))
    f = -ufl.div(grad(exact))
    return Problem(V, lambda u, v: poisson.a(u, v) - poisson.L(f, v), lambda u: 4 * u * dx(1), prescribed(exact), exact)


def flux_through_a_side(comm: Any = None) -> Problem:
    """Return the heat that leaves through one side, weighted, where two sides are kept warm and two are heated."""
    return _heated(comm, lambda u, F, x, flux: ufl.sin(np.pi * x[1]) * flux(u) * ds(RIGHT))


def flux_from_the_equations(comm: Any = None) -> Problem:
    """Return the same heat as what is left of the equations for a function with that weight: of twice the order."""
    return _heated(comm, lambda u, F, x, flux: F(u, x[0] * ufl.sin(np.pi * x[1])))


def _heated(comm: Any, J: Callable[..., ufl.Form]) -> Problem:
    msh = square(comm)
    x, n = ufl.SpatialCoordinate(msh), ufl.FacetNormal(msh)
    exact = wavy(x)
    kappa = 1 + 0.5 * x[0]

    def flux(u: Expr) -> Expr:
        return kappa * dot(grad(u), n)

    def F(u: Expr, v: Expr) -> ufl.Form:
        f = -ufl.div(kappa * grad(exact))
        return poisson.a(u, v, kappa) - f * v * dx - flux(exact) * v * ds(TOP) - flux(exact) * v * ds(BOTTOM)

    def bcs(V: fem.FunctionSpace) -> list[fem.DirichletBC]:
        return [fem.dirichletbc(exact, fem.boundary_dofs(V, tag=tag), V) for tag in (LEFT, RIGHT)]

    return Problem(fem.functionspace(msh, ("THCCS", 3)), F, lambda u: J(u, F, x, flux), bcs, exact)


def with_advection(comm: Any = None) -> Problem:
    """Return a problem that is not its own adjoint, on a mesh with an extraordinary vertex, with values on the rim."""
    msh = generators.wheel(5, 2, comm=comm)
    x = ufl.SpatialCoordinate(msh)
    exact = wavy(x)
    beta = ufl.as_vector([3.0, 1.0 + x[0]])

    def F(u: Expr, v: Expr) -> ufl.Form:
        f = -ufl.div(grad(exact)) + dot(beta, grad(exact))
        return (inner(grad(u), grad(v)) + dot(beta, grad(u)) * v - f * v) * dx

    V = fem.functionspace(msh, ("THCCS", 3))
    return Problem(V, F, lambda u: ufl.exp(x[0]) * u * dx, prescribed(exact), exact)


def displacement_of_a_side(comm: Any = None) -> Problem:
    """Return a block on rollers, pulled at one side, and how far that moves."""
    msh = square(comm)
    x, n = ufl.SpatialCoordinate(msh), ufl.FacetNormal(msh)
    exact = ufl.as_vector([x[0] * ufl.cos(x[1]), x[1] * ufl.exp(0.5 * x[0])])
    stress = linear_elasticity.sigma(exact)

    def F(u: Expr, v: Expr) -> ufl.Form:
        t = dot(stress, n)
        shear_1 = dot(t, ufl.as_vector([0, 1])) * v[1] * ds(LEFT)  # rollers hold one component, forces are the other
        shear_0 = dot(t, ufl.as_vector([1, 0])) * v[0] * ds(BOTTOM)
        pull = dot(t, v) * ds(RIGHT) + dot(t, v) * ds(TOP)
        return linear_elasticity.a(u, v) - inner(-ufl.div(stress), v) * dx - pull - shear_1 - shear_0

    def bcs(V: fem.FunctionSpace) -> list[fem.DirichletBC]:
        return [
            fem.dirichletbc(0.0, fem.boundary_dofs(V, tag=LEFT), V.sub(0)),
            fem.dirichletbc(0.0, fem.boundary_dofs(V, tag=BOTTOM), V.sub(1)),
        ]

    V = fem.functionspace(msh, ("THCCS", 3, (2,)))
    return Problem(V, F, lambda u: ufl.sin(np.pi * x[1]) * u[0] * ds(RIGHT), bcs, exact)


def on_a_closed_surface(comm: Any = None) -> Problem:
    """Return the Laplace-Beltrami equation on a sphere with eight extraordinary vertices, and a mean near one."""
    msh = generators.cube_sphere(3, comm=comm)
    x = ufl.SpatialCoordinate(msh)
    exact = smooth(2 * x)
    w = ufl.exp(-4 * ((x[0] - 0.6) ** 2 + (x[1] - 0.6) ** 2 + (x[2] - 0.6) ** 2))

    def F(u: Expr, v: Expr) -> ufl.Form:
        return (inner(grad(u), grad(v)) + u * v - inner(grad(exact), grad(v)) - exact * v) * dx

    return Problem(fem.functionspace(msh, ("THCCS", 3)), F, lambda u: w * u * dx, exact=exact)


def with_free_constants(comm: Any = None) -> Problem:
    """Return the Laplace-Beltrami equation on a torus, which leaves constants free, and a goal that sees them."""
    msh = generators.torus((8, 6), comm=comm)
    x = ufl.SpatialCoordinate(msh)
    w = ufl.exp(-((x[0] - 3) ** 2) - x[1] ** 2 - x[2] ** 2)

    def F(u: Expr, v: Expr) -> ufl.Form:
        return (inner(grad(u), grad(v)) - inner(grad(smooth(x)), grad(v))) * dx

    return Problem(fem.functionspace(msh, ("THCCS", 3)), F, lambda u: w * u * dx)


def in_space_with_a_rim(comm: Any = None) -> Problem:
    """Return a vector-valued problem on a curved surface with a rim."""
    msh = lifted(generators.wheel(3, 2))
    msh = ControlMesh(msh.vertices, msh.quads, corners=msh.corners, comm=comm)
    x = ufl.SpatialCoordinate(msh)

    def F(u: Expr, v: Expr) -> ufl.Form:
        return (inner(grad(u), grad(v)) + u[1] * v[0] - x[0] * v[0] - x[2] * v[1]) * dx

    V = fem.functionspace(msh, ("THCCS", 3, (2,)), "crease")
    return Problem(V, F, lambda u: x[1] * u[0] * dx + u[1] * ds, prescribed(0.0))


def clamped_plate(comm: Any = None) -> Problem:
    """Return a plate that is clamped on all sides, and its mean deflection on a quarter."""
    msh = square(comm)
    x = ufl.SpatialCoordinate(msh)
    exact = (ufl.sin(np.pi * x[0]) * ufl.sin(np.pi * x[1])) ** 2 * ufl.exp(x[0])

    def F(u: Expr, v: Expr) -> ufl.Form:
        return plate.a(u, v) - inner(plate.moments(exact), plate.hessian(v)) * dx

    def bcs(V: fem.FunctionSpace) -> list[fem.DirichletBC]:
        return [fem.dirichletbc(0.0, fem.boundary_dofs(V, slope=True), V)]

    return Problem(fem.functionspace(msh, ("THCCS", 3)), F, lambda u: 4 * u * dx(1), bcs, exact)


def l_shaped(comm: Any = None) -> Problem:
    """Return a harmonic function with a singular gradient at the corner, and its mean far from there."""
    msh = generators.l_domain(4, comm=comm)
    x = ufl.SpatialCoordinate(msh)
    far = (x[0] + 0.5) ** 2 + (x[1] + 0.5) ** 2
    V = fem.functionspace(msh, ("THCCS", 3), cap_level=16)
    exact, f = singular(x), fem.Constant(msh, 0.0)

    def F(u: Expr, v: Expr) -> ufl.Form:
        return inner(grad(u), grad(v)) * dx - f * v * dx

    return Problem(V, F, lambda u: ufl.exp(-10 * far) * u * dx, prescribed(exact), exact)


def bumps(comm: Any = None) -> Problem:
    """Return two equal sources, and what is wanted is near one of them."""
    msh = generators.wheel(5, 3, comm=comm)
    x, zero = ufl.SpatialCoordinate(msh), prescribed(0.0)
    f = sum(100 * bump(x, 200, place) for place in ((0.4, 0.3), (-0.4, 0.3)))
    w = bump(x, 100, (0.3, 0.5))

    def F(u: Expr, v: Expr) -> ufl.Form:
        return inner(grad(u), grad(v)) * dx - f * v * dx

    return Problem(fem.functionspace(msh, ("THCCS", 3)), F, lambda u: w * u * dx, zero)


def bump(x: Expr, sharpness: float, place: tuple[float, float]) -> Expr:
    return ufl.exp(-sharpness * ((x[0] - place[0]) ** 2 + (x[1] - place[1]) ** 2))


# ---- Nonlinear ones


def soap_film(comm: Any = None) -> Problem:
    """Return a surface of given curvature, and the average of its height."""
    msh = square(comm)
    x = ufl.SpatialCoordinate(msh)
    exact = wavy(x)
    f = -ufl.div(grad(exact) / ufl.sqrt(1 + inner(grad(exact), grad(exact))))
    V = fem.functionspace(msh, ("THCCS", 3))
    return Problem(V, lambda u, v: minimal_surface.F(u, v, f), lambda u: 4 * u * dx(1), prescribed(exact), exact)


def area_of_a_film(comm: Any = None) -> Problem:
    """Return the same, and its area, which is not linear either."""
    film = soap_film(comm)
    return Problem(film.V, film.F, minimal_surface.area, film.bcs, film.exact)


def hot_conductor(comm: Any = None) -> Problem:
    """Return a conductivity that rises with the temperature, on an extraordinary vertex, and the heat through a rim."""
    msh = generators.wheel(5, 2, comm=comm)
    x = ufl.SpatialCoordinate(msh)
    exact = wavy(x)

    def F(u: Expr, v: Expr) -> ufl.Form:
        return (inner((1 + u**2) * grad(u), grad(v)) + ufl.div((1 + exact**2) * grad(exact)) * v) * dx

    V = fem.functionspace(msh, ("THCCS", 3))
    return Problem(V, F, lambda u: ufl.exp(x[0]) * u**2 * dx, prescribed(exact), exact)


LINEAR = {
    "mean over a part": mean_over_a_part,
    "flux through a side": flux_through_a_side,
    "flux from the equations": flux_from_the_equations,
    "with advection": with_advection,
    "displacement of a side": displacement_of_a_side,
    "on a closed surface": on_a_closed_surface,
    "with free constants": with_free_constants,
    "in space with a rim": in_space_with_a_rim,
    "clamped plate": clamped_plate,
    "L-shaped": l_shaped,
}
NONLINEAR = {"soap film": soap_film, "area of a film": area_of_a_film, "hot conductor": hot_conductor}
KNOWN = {
    name: make
    for name, make in (LINEAR | NONLINEAR).items()
    if name not in ("with free constants", "in space with a rim", "L-shaped")
}
