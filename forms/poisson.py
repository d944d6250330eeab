"""Poisson's equation in the plane, with a reaction term and boundary flux.

Strong form, with n the outward normal:

    -div(kappa grad(u)) + c u = f    in the domain
           kappa grad(u) . n = g     where no Dirichlet condition is set

Source: Ern and Guermond, Theory and practice of finite elements (2004), section 3.1.
"""

import ufl
from ufl.core.expr import Expr
from ufl.domain import extract_unique_domain

# The form is positive if gamma is larger than the integral of h |dw/dn|^2 over the boundary edges of a cell by that of
# |grad(w)|^2 over the cell. For bicubic w on a square this is at most 9 an edge, 18 in a corner; flat cells have more.
GAMMA = 20.0


def a(u: Expr, v: Expr, kappa: Expr | float = 1, c: Expr | float = 0) -> ufl.Form:
    """Return the bilinear form, the integral of kappa grad(u) . grad(v) + c u v.

    Args:
        u: Trial function, or the unknown of a nonlinear problem.
        v: Test function.
        kappa: Diffusivity: a scalar, or a tensor that acts on gradients.
        c: Reaction rate.
    """
    return (ufl.inner(kappa * ufl.grad(u), ufl.grad(v)) + c * ufl.inner(u, v)) * ufl.dx


def L(f: Expr, v: Expr, g: Expr | None = None, ds: ufl.Measure = ufl.ds) -> ufl.Form:
    """Return the load, the integral of f v, plus that of g v over the boundary.

    Args:
        f: Source.
        v: Test function.
        g: Inward flux on the boundary; None for none.
        ds: Where that is, as ``ufl.ds(tag)``.
    """
    load = ufl.inner(f, v) * ufl.dx
    return load if g is None else load + ufl.inner(g, v) * ds


def nitsche(
    u: Expr,
    v: Expr,
    g: Expr | float,
    h: Expr | float,
    kappa: Expr | float = 1,
    gamma: float = GAMMA,
    ds: ufl.Measure = ufl.ds,
) -> ufl.Form:
    """Return what puts u = g on the boundary in the weak form: Nitsche's method, symmetric.

    The integral of -(kappa grad(u) . n) v - (kappa grad(v) . n) (u - g) + gamma (n . kappa n) (u - g) v / h: for
    consistency, for symmetry, and a penalty. Added to a(u, v) - L(f, v) it takes the place of a Dirichlet condition;
    ``ufl.system`` of the sum has the two sides of the equation.

    Source: Nitsche, Abh. Math. Sem. Univ. Hamburg 36 (1971), 9-15.

    Args:
        u: Trial function, or the unknown of a nonlinear problem.
        v: Test function.
        g: Value on the boundary.
        h: Size of the cells.
        kappa: Diffusivity, as in :func:`a`.
        gamma: Penalty.
        ds: Where the condition holds, as ``ufl.ds(tag)``.
    """
    n = ufl.FacetNormal(extract_unique_domain(v))

    def flux(w: Expr) -> Expr:
        return ufl.inner(kappa * ufl.grad(w), n)

    penalty = gamma * ufl.inner(kappa * n, n) / h
    return (-flux(u) * v - flux(v) * (u - g) + penalty * (u - g) * v) * ds


def strong_residual(u: Expr, f: Expr, kappa: Expr | float = 1, c: Expr | float = 0) -> Expr:
    """Return f + div(kappa grad(u)) - c u, which vanishes for the exact solution.

    Args:
        u: Approximate solution.
        f: Source.
        kappa: Diffusivity, as in :func:`a`.
        c: Reaction rate.
    """
    return f + ufl.div(kappa * ufl.grad(u)) - c * u
