"""Poisson's equation in the plane, with a reaction term and boundary flux.

Strong form, with n the outward normal:

    -div(kappa grad(u)) + c u = f    in the domain
           kappa grad(u) . n = g     where no Dirichlet condition is set

Source: Ern and Guermond, Theory and practice of finite elements (2004), section 3.1.
"""

import ufl
from ufl.core.expr import Expr


def a(u: Expr, v: Expr, kappa: Expr | float = 1, c: Expr | float = 0) -> ufl.Form:
    """Return the bilinear form, the integral of kappa grad(u) . grad(v) + c u v.

    Args:
        u: Trial function, or the unknown of a nonlinear problem.
        v: Test function.
        kappa: Diffusivity: a scalar, or a tensor that acts on gradients.
        c: Reaction rate.
    """
    return (ufl.inner(kappa * ufl.grad(u), ufl.grad(v)) + c * ufl.inner(u, v)) * ufl.dx


def L(f: Expr, v: Expr, g: Expr | None = None) -> ufl.Form:
    """Return the load, the integral of f v, plus that of g v over the boundary.

    Args:
        f: Source.
        v: Test function.
        g: Inward flux on the boundary; None for none.
    """
    load = ufl.inner(f, v) * ufl.dx
    return load if g is None else load + ufl.inner(g, v) * ufl.ds


def strong_residual(u: Expr, f: Expr, kappa: Expr | float = 1, c: Expr | float = 0) -> Expr:
    """Return f + div(kappa grad(u)) - c u, which vanishes for the exact solution.

    Args:
        u: Approximate solution.
        f: Source.
        kappa: Diffusivity, as in :func:`a`.
        c: Reaction rate.
    """
    return f + ufl.div(kappa * ufl.grad(u)) - c * u
