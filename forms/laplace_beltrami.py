"""The Laplace-Beltrami equation on a surface: diffusion along it, nothing across.

Strong form, with the tangential gradient and divergence of the surface:

    -div(kappa grad(u)) = f

and, on a rim, kappa grad(u) . n = g with the conormal n, where no Dirichlet condition is set. On a closed surface f
must have mean zero, and u is known up to a constant: it is that with mean zero, or fixed by a Dirichlet condition.

UFL's ``grad`` and ``div`` on a surface in space are the tangential ones, so nothing here speaks of
the surface. Source: Dziuk and Elliott, Finite element methods for surface PDEs, Acta Numerica 22
(2013), 289-396, section 2.
"""

import ufl
from ufl.core.expr import Expr
from ufl.domain import extract_unique_domain

# The form is positive if gamma is larger than the integral of h |dw/dn|^2 over the boundary edges of a cell by that of
# |grad(w)|^2 over the cell. For bicubic w on a square this is at most 9 an edge, 18 in a corner; flat cells have more.
GAMMA = 20.0


def a(u: Expr, v: Expr, kappa: Expr | float = 1) -> ufl.Form:
    """Return the bilinear form, the integral of kappa grad(u) . grad(v).

    Args:
        u: Trial function, or the unknown of a nonlinear problem.
        v: Test function.
        kappa: Diffusivity: a scalar, or a tensor that acts on gradients.
    """
    return ufl.inner(kappa * ufl.grad(u), ufl.grad(v)) * ufl.dx


def L(f: Expr, v: Expr, g: Expr | None = None, ds: ufl.Measure = ufl.ds) -> ufl.Form:
    """Return the load, the integral of f v, plus that of g v over the rim.

    Args:
        f: Source.
        v: Test function.
        g: Inward flux through the rim; None for none.
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
    """Return what puts u = g on the rim in the weak form: Nitsche's method, symmetric.

    The integral of -(kappa grad(u) . n) v - (kappa grad(v) . n) (u - g) + gamma (n . kappa n) (u - g) v / h: for
    consistency, for symmetry, and a penalty. Added to a(u, v) - L(f, v) it takes the place of a Dirichlet condition;
    ``ufl.system`` of the sum has the two sides of the equation.

    Source: Nitsche, Abh. Math. Sem. Univ. Hamburg 36 (1971), 9-15.

    Args:
        u: Trial function, or the unknown of a nonlinear problem.
        v: Test function.
        g: Value on the rim.
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


def strong_residual(u: Expr, f: Expr, kappa: Expr | float = 1) -> Expr:
    """Return f + div(kappa grad(u)), which vanishes for the exact solution.

    Args:
        u: Approximate solution.
        f: Source.
        kappa: Diffusivity, as in :func:`a`.
    """
    return f + ufl.div(kappa * ufl.grad(u))
