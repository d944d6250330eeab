"""Problems with known errors, one of each kind, and the estimators of them: for tests and the table of effectivities.

The effectivity is the estimate over the norm of the error that it estimates, here always the energy norm. Of a problem
that is not symmetric that is the norm of its symmetric part, of a nonlinear one that of its derivative at the solution.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import pi
from typing import Literal

import numpy as np
import numpy.typing as npt
from problems import lifted, singular, tangential, uniformly_refined, wavy

import ufl
from thccs_fem import adapt, estimate, fem, generators
from thccs_fem.fem.assembly import assemble_cells
from thccs_fem.fem.scipy import LinearProblem, NonlinearProblem
from thccs_fem.forms import biharmonic, kirchhoff_love, linear_elasticity, plate
from thccs_fem.mesh import ControlMesh
from ufl import div, dot, dx, grad, inner

__all__ = ["FOURTH", "NONLINEAR", "PROBLEMS", "SECOND", "Problem", "adaptive", "uniform"]

Expr = ufl.core.expr.Expr
Floats = npt.NDArray[np.float64]
Indicators = Callable[[fem.Function], Floats]


@dataclass(frozen=True)
class Problem:
    """A problem, its error, and its estimators.

    Attributes:
        make: Makes the first space.
        solve: Solves the problem.
        error: The energy norm of the error.
        estimators: By name.
        levels: How often to refine uniformly.
        max_dofs: Where to end an adaptive run.
    """

    make: Callable[[], fem.FunctionSpace]
    solve: Callable[[fem.FunctionSpace], fem.Function]
    error: Callable[[fem.Function], float]
    estimators: dict[str, Indicators]
    levels: int = 3
    max_dofs: int = 1000

    def effectivity(self, uh: fem.Function, estimator: str) -> float:
        """Return what is estimated over the error."""
        return estimate.norm(uh.function_space, self.estimators[estimator](uh)) / self.error(uh)


def uniform(problem: Problem, estimator: str) -> Floats:
    """Return the effectivities on all levels of uniform refinement, after the first."""
    V, found = problem.make(), []
    for _ in range(problem.levels):
        V = uniformly_refined(V)
        found.append(problem.effectivity(problem.solve(V), estimator))
    return np.array(found)


def adaptive(problem: Problem, estimator: str) -> Floats:
    """Return dofs, errors and effectivities in a run that the estimator drives, shape (3, steps)."""
    V, rows = problem.make(), []
    while V.num_dofs < problem.max_dofs:
        uh = problem.solve(V)
        eta, error = problem.estimators[estimator](uh), problem.error(uh)
        rows.append((V.num_dofs, error, estimate.norm(V, eta) / error))
        V = adapt.refine(V, adapt.mark(V, eta))
    return np.array(rows).T


def space(
    mesh: Callable[[], ControlMesh], shape: tuple[int, ...] = (), **options: object
) -> Callable[[], fem.FunctionSpace]:
    return lambda: fem.functionspace(mesh(), ("THCCS", 3, shape) if shape else ("THCCS", 3), **options)


def arguments(V: fem.FunctionSpace) -> tuple[ufl.Argument, ufl.Argument]:
    return ufl.TrialFunction(V), ufl.TestFunction(V)


def root(density: Expr) -> float:
    return float(np.sqrt(assemble_cells(fem.form(density * dx, quadrature_degree=11)).sum()))


# ---- Second order


def elliptic(
    make: Callable[[], fem.FunctionSpace],
    solution: Callable[[Expr], Expr],
    *,
    kappa: Callable[[ControlMesh], Expr | float] = lambda _: 1.0,
    c: float = 0.0,
    beta: tuple[float, ...] | None = None,
    is_natural: bool = False,
) -> Problem:
    """Return -div(kappa grad(u)) + beta . grad(u) + c u = f for u = solution / kappa.

    With its values prescribed on the boundary, or its flux.
    """

    def exact(msh: ControlMesh) -> Expr:
        return solution(ufl.SpatialCoordinate(msh)) / kappa(msh)

    def lower(msh: ControlMesh, u: Expr, slope: Expr) -> Expr:
        return c * u + (0.0 if beta is None else dot(ufl.as_vector(beta), slope))

    def a(msh: ControlMesh, u: Expr, v: Expr) -> ufl.Form:
        return (inner(kappa(msh) * grad(u), grad(v)) + lower(msh, u, grad(u)) * v) * dx

    def solve(V: fem.FunctionSpace) -> fem.Function:
        u, v = arguments(V)
        dofs = fem.boundary_dofs(V)
        bcs = [] if is_natural or not dofs.size else [fem.dirichletbc(exact(V.mesh), dofs, V)]
        return LinearProblem(a(V.mesh, u, v), a(V.mesh, exact(V.mesh), v), bcs=bcs).solve()

    def error(uh: fem.Function) -> float:
        msh = uh.function_space.mesh
        e = uh - exact(msh)
        gradient = tangential(msh, grad(e))
        return root(kappa(msh) * inner(gradient, gradient) + c * e * e)

    def residual(uh: fem.Function) -> Floats:
        msh = uh.function_space.mesh
        k, u, n = kappa(msh), exact(msh), ufl.FacetNormal(msh)
        slope = tangential(msh, grad(u))
        strong = lower(msh, u, slope) - div(k * slope) + div(k * grad(uh)) - lower(msh, uh, grad(uh))
        missing = dot(k * (slope - grad(uh)), n) if is_natural else None
        flux = k * grad(uh) if isinstance(k, fem.Function) else None  # else it jumps at caps alone, and little
        return estimate.residual(uh, strong, missing, flux, stiffness=k, reaction=c)

    def bubble(uh: fem.Function) -> Floats:
        msh, (u, v) = uh.function_space.mesh, arguments(uh.function_space)
        return estimate.bubble(uh, a(msh, u, v), a(msh, exact(msh), v))

    return Problem(make, solve, error, {"residual": residual, "bubble": bubble})


def two_materials() -> ControlMesh:
    """Return the square (-1, 1)^2 with face tag 1 on the right half."""
    msh = generators.rectangle((4, 4), (-1.0, -1.0), (1.0, 1.0))
    right = msh.vertices[msh.quads].mean(axis=1)[:, 0] > 0
    return ControlMesh(msh.vertices, msh.quads, face_tags=right.astype(int), corners=msh.corners)


def jumping(msh: ControlMesh) -> Expr:
    kappa = fem.Function(fem.functionspace(msh, ("DG", 0)))
    kappa.x.array = np.where(msh.face_tags == 1, 10.0, 1.0)
    return kappa


def bump(centre: tuple[float, float, float], width: float) -> Callable[[Expr], Expr]:
    def solution(x: Expr) -> Expr:
        d = x - ufl.as_vector(centre)
        return ufl.exp(-dot(d, d) / width**2)

    return solution


def elastic() -> Problem:
    """Return a sheet in plane stress."""
    lmbda, mu = linear_elasticity.plane_stress(E=1.0, nu=0.3)

    def exact(V: fem.FunctionSpace) -> Expr:
        x = ufl.SpatialCoordinate(V.mesh)
        return ufl.as_vector([wavy(x), ufl.sin(x[0] + 2 * x[1])])

    def load(V: fem.FunctionSpace) -> Expr:
        return -div(linear_elasticity.sigma(exact(V), lmbda, mu))

    def solve(V: fem.FunctionSpace) -> fem.Function:
        u, v = arguments(V)
        bc = fem.dirichletbc(exact(V), fem.boundary_dofs(V), V)
        return LinearProblem(linear_elasticity.a(u, v, lmbda, mu), linear_elasticity.L(load(V), v), bcs=[bc]).solve()

    def error(uh: fem.Function) -> float:
        e = uh - exact(uh.function_space)
        return root(inner(linear_elasticity.sigma(e, lmbda, mu), linear_elasticity.epsilon(e)))

    def residual(uh: fem.Function) -> Floats:
        strong = linear_elasticity.strong_residual(uh, load(uh.function_space), lmbda, mu)
        return estimate.residual(uh, strong, stiffness=lmbda + 2 * mu)

    def bubble(uh: fem.Function) -> Floats:
        V = uh.function_space
        u, v = arguments(V)
        return estimate.bubble(uh, linear_elasticity.a(u, v, lmbda, mu), linear_elasticity.L(load(V), v))

    make = space(lambda: generators.wheel(5, 2), (2,))
    return Problem(make, solve, error, {"residual": residual, "bubble": bubble}, max_dofs=2000)


# ---- Nonlinear


def nonlinear(
    make: Callable[[], fem.FunctionSpace], solution: Callable[[Expr], Expr], flux: Callable[[Expr], Expr]
) -> Problem:
    """Return -div(flux(u)) = f with the values of u on the boundary."""

    def exact(V: fem.FunctionSpace) -> Expr:
        return solution(ufl.SpatialCoordinate(V.mesh))

    def F(u: Expr, v: Expr, V: fem.FunctionSpace) -> ufl.Form:
        return (inner(flux(u), grad(v)) + div(flux(exact(V))) * v) * dx

    def solve(V: fem.FunctionSpace) -> fem.Function:
        u = fem.project(exact(V), V)
        bc = fem.dirichletbc(exact(V), fem.boundary_dofs(V), V)
        NonlinearProblem(F(u, ufl.TestFunction(V), V), u, bcs=[bc]).solve()
        return u

    def stiffness(uh: fem.Function) -> Expr:
        """Return half the trace of the derivative of the flux by the gradient."""
        p = ufl.variable(grad(uh))
        return ufl.tr(ufl.diff(flux_of(uh, p), p)) / 2

    def flux_of(u: Expr, p: Expr) -> Expr:
        return ufl.replace(flux(u), {grad(u): p})

    def error(uh: fem.Function) -> float:
        e = uh - exact(uh.function_space)
        p = ufl.variable(grad(uh))
        return root(inner(dot(ufl.diff(flux_of(uh, p), p), grad(e)), grad(e)))

    def residual(uh: fem.Function) -> Floats:
        V = uh.function_space
        return estimate.residual(uh, div(flux(uh)) - div(flux(exact(V))), stiffness=stiffness(uh))

    def bubble(uh: fem.Function) -> Floats:
        V = uh.function_space
        return estimate.bubble(uh, F(uh, ufl.TestFunction(V), V))

    return Problem(make, solve, error, {"residual": residual, "bubble": bubble})


def scherk(x: Expr) -> Expr:
    """Return the height of Scherk's minimal surface."""
    return ufl.ln(ufl.cos(x[1]) / ufl.cos(x[0]))


# ---- Fourth order


def bent(
    make: Callable[[], fem.FunctionSpace],
    solution: Callable[[Expr], Expr],
    edge: Literal["clamped", "supported", "free"] = "clamped",
) -> Problem:
    """Return a plate; a free one is on a foundation, which pushes back by u."""
    D, nu, c = 1.0, 0.3, 1.0 if edge == "free" else 0.0

    def exact(V: fem.FunctionSpace) -> Expr:
        return solution(ufl.SpatialCoordinate(V.mesh))

    def a(u: Expr, v: Expr) -> ufl.Form:
        return plate.a(u, v, D, nu) + (c * u * v * dx if c else ufl.Form([]))

    def load(V: fem.FunctionSpace, v: Expr) -> ufl.Form:
        """Return the load, which is not a(exact, v) where kinks of caps would not show for that; edges are straight."""
        return plate.L(div(div(plate.moments(exact(V), D, nu))), v) if edge == "clamped" else a(exact(V), v)

    def solve(V: fem.FunctionSpace) -> fem.Function:
        u, v = arguments(V)
        dofs = fem.boundary_dofs(V, slope=edge == "clamped")
        bcs = [] if edge == "free" else [fem.dirichletbc(exact(V), dofs, V, slope=edge == "clamped")]
        return LinearProblem(a(u, v), load(V, v), bcs=bcs).solve()

    def error(uh: fem.Function) -> float:
        e = uh - exact(uh.function_space)
        return root(inner(plate.moments(e, D, nu), plate.hessian(e)) + c * e * e)

    def residual(uh: fem.Function) -> Floats:
        V, m = uh.function_space, plate.moments(uh, D, nu)
        n = ufl.FacetNormal(V.mesh)
        missing, along = plate.moments(exact(V), D, nu) - m, ufl.as_vector([-n[1], n[0]])
        shear = dot(div(missing), n) + inner(dot(grad(missing), along), ufl.outer(n, along))
        strong = div(div(missing)) + c * (exact(V) - uh)
        conditions = {"moment": dot(dot(missing, n), n)} if edge != "clamped" else {}
        conditions |= {"neumann": shear} if edge == "free" else {}
        return estimate.residual(uh, strong, flux=div(m), order=4, stiffness=D, reaction=c, **conditions)

    def bubble(uh: fem.Function) -> Floats:
        u, v = arguments(uh.function_space)
        return estimate.bubble(uh, a(u, v), load(uh.function_space, v))

    return Problem(make, solve, error, {"residual": residual, "bubble": bubble})


def against_a_finer_solution(
    make: Callable[[], fem.FunctionSpace],
    a: Callable[[Expr, Expr], ufl.Form],
    load: Callable[[fem.FunctionSpace], Expr],
    estimators: dict[str, Indicators],
) -> Problem:
    """Return a(u, v) = (load, v), clamped where there is a boundary; it is solved in a space refined twice."""

    def L(V: fem.FunctionSpace, v: Expr) -> ufl.Form:
        return inner(load(V), v) * dx

    def solve(V: fem.FunctionSpace) -> fem.Function:
        u, v = arguments(V)
        dofs = fem.boundary_dofs(V, slope=True)
        bcs = [fem.dirichletbc(0.0, dofs, V)] if dofs.size else []
        return LinearProblem(a(u, v), L(V, v), bcs=bcs).solve()

    def error(uh: fem.Function) -> float:
        fine = solve(uniformly_refined(uh.function_space, 2))
        e = fem.Function(fine.function_space)
        e.x.array = fine.x.array - adapt.transfer(uh, fine.function_space).x.array
        return float(np.sqrt(assemble_cells(fem.form(a(e, e))).sum()))

    def bubble(uh: fem.Function) -> Floats:
        u, v = arguments(uh.function_space)
        return estimate.bubble(uh, a(u, v), L(uh.function_space, v))

    return Problem(make, solve, error, {**estimators, "bubble": bubble}, levels=2, max_dofs=700)


def on_a_surface(mesh: Callable[[], ControlMesh], cap_level: int) -> Problem:
    """Return div(grad(div(grad(u)))) + u = f on a closed surface."""

    def load(V: fem.FunctionSpace) -> Expr:
        x = ufl.SpatialCoordinate(V.mesh)
        return ufl.sin(2 * x[0]) * ufl.cos(x[1] + 1) + x[2]

    def residual(uh: fem.Function) -> Floats:
        strong = biharmonic.strong_residual(uh, load(uh.function_space)) - uh
        return estimate.residual(uh, strong, flux=grad(div(grad(uh))), order=4, reaction=1.0)

    def a(u: Expr, v: Expr) -> ufl.Form:
        return biharmonic.a(u, v) + u * v * dx

    return against_a_finer_solution(space(mesh, cap_level=cap_level), a, load, {"residual": residual})


def shell(thickness: float) -> Problem:
    """Return a shallow shell, clamped at its rim, under a load of its own weight."""

    def load(V: fem.FunctionSpace) -> Expr:
        x = ufl.SpatialCoordinate(V.mesh)
        return ufl.as_vector([0 * x[0], 0 * x[0], -1.0 + 0.5 * ufl.sin(3 * x[0])])

    def a(u: Expr, v: Expr) -> ufl.Form:
        return kirchhoff_love.a(u, v, 1.0, 0.3, fem.Constant(mesh_of(v), thickness))

    def mesh_of(v: Expr) -> ControlMesh:
        return v.ufl_function_space().mesh

    make = space(lambda: lifted(generators.rectangle((3, 3))), (3,))
    return against_a_finer_solution(make, a, load, {})


def difference(x: Expr) -> Expr:
    """Return x^4 - y^4, biharmonic."""
    return x[0] ** 4 - x[1] ** 4


def sines(x: Expr) -> Expr:
    return ufl.sin(pi * x[0] / 2) * ufl.sin(pi * x[1] / 2)


# ---- All of them


def square() -> ControlMesh:
    return generators.rectangle((4, 4))


def wheel(valence: int) -> Callable[[], ControlMesh]:
    return lambda: generators.wheel(valence, 2)


def l_domain(cap_level: int) -> Problem:
    return elliptic(space(lambda: generators.l_domain(4), cap_level=cap_level), singular)


SECOND = {
    "Poisson, square": lambda: elliptic(space(square), wavy),
    "Poisson, wheel of 3": lambda: elliptic(space(wheel(3)), wavy),
    "Poisson, wheel of 5": lambda: elliptic(space(wheel(5)), wavy),
    "Poisson, wheel of 8": lambda: elliptic(space(wheel(8)), wavy),
    "Poisson, wheel of 8, caps at 8": lambda: elliptic(space(wheel(8), cap_level=8), wavy),
    "Poisson, wheel of 5, crease": lambda: elliptic(space(wheel(5), boundary="crease"), wavy),
    "L-domain": lambda: l_domain(4),
    "L-domain, caps at 16": lambda: l_domain(16),
    "Neumann, wheel of 5": lambda: elliptic(space(wheel(5)), wavy, c=1.0, is_natural=True),
    "kappa 1 and 10": lambda: elliptic(space(two_materials), lambda x: ufl.sin(2 * x[0]) * wavy(x), kappa=jumping),
    "Laplace-Beltrami, torus": lambda: elliptic(
        space(lambda: generators.torus((12, 8))), bump((3.0, 0.0, 0.0), 1.5), c=1.0
    ),
    "Laplace-Beltrami, sphere": lambda: elliptic(
        space(lambda: generators.cube_sphere(3)), bump((3**-0.5, 3**-0.5, 3**-0.5), 0.7), c=1.0
    ),
    "reaction-diffusion, 0.1": lambda: elliptic(space(wheel(5)), wavy, kappa=lambda _: 0.1, c=1.0),
    "reaction-diffusion, 1e-3": lambda: elliptic(space(wheel(5)), wavy, kappa=lambda _: 1e-3, c=1.0),
    "reaction-diffusion, 1e-6": lambda: elliptic(space(wheel(5)), wavy, kappa=lambda _: 1e-6, c=1.0),
    "advection-diffusion, 0.1": lambda: elliptic(space(wheel(5)), wavy, kappa=lambda _: 0.1, beta=(1.0, 0.5)),
    "advection-diffusion, 1e-3": lambda: elliptic(space(wheel(5)), wavy, kappa=lambda _: 1e-3, beta=(1.0, 0.5)),
    "elasticity": elastic,
}
NONLINEAR = {
    "-div((1 + u^2) grad u) = f": lambda: nonlinear(space(wheel(5)), wavy, lambda u: (1 + u**2) * grad(u)),
    "minimal surface": lambda: nonlinear(
        space(square), scherk, lambda u: grad(u) / ufl.sqrt(1 + inner(grad(u), grad(u)))
    ),
}
FOURTH = {
    "plate, square": lambda: bent(space(square), wavy),
    "plate, square, x^4 - y^4": lambda: bent(space(square), difference),
    "plate, square, supported": lambda: bent(space(square), sines, "supported"),
    "plate, square, free": lambda: bent(space(square), wavy, "free"),
    "plate, disc": lambda: bent(space(lambda: generators.disc(2), cap_level=8), wavy),
    "plate, wheel of 3": lambda: bent(space(wheel(3), cap_level=6), wavy),
    "plate, wheel of 5": lambda: bent(space(wheel(5), cap_level=10), wavy),
    "plate, wheel of 8": lambda: bent(space(wheel(8), cap_level=12), wavy),
    "biharmonic, torus": lambda: on_a_surface(lambda: generators.torus((12, 8)), 4),
    "biharmonic, sphere": lambda: on_a_surface(lambda: generators.cube_sphere(3), 6),
    "shell, 0.1 thick": lambda: shell(0.1),
    "shell, 0.01 thick": lambda: shell(0.01),
}
PROBLEMS = {**SECOND, **NONLINEAR, **FOURTH}
