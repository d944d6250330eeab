"""The Laplace-Beltrami equation on a surface: diffusion along it, nothing across.

Strong form, with the tangential gradient and divergence of the surface:

    -div(kappa grad(u)) = f

and no flux through the rim, if there is one and nothing else is said there. On a closed surface f
must have mean zero, and u is known up to a constant: fix it by a Dirichlet condition.

UFL's ``grad`` and ``div`` on a surface in space are the tangential ones, so nothing here speaks of
the surface. Source: Dziuk and Elliott, Finite element methods for surface PDEs, Acta Numerica 22
(2013), 289-396, section 2.
"""

import ufl
from ufl.core.expr import Expr


def a(u: Expr, v: Expr, kappa: Expr | float = 1) -> ufl.Form:
    """Return the bilinear form, the integral of kappa grad(u) . grad(v).

    Args:
        u: Trial function, or the unknown of a nonlinear problem.
        v: Test function.
        kappa: Diffusivity: a scalar, or a tensor that acts on gradients.
    """
    return ufl.inner(kappa * ufl.grad(u), ufl.grad(v)) * ufl.dx


def L(f: Expr, v: Expr) -> ufl.Form:
    """Return the load, the integral of f v.

    Args:
        f: Source.
        v: Test function.
    """
    return ufl.inner(f, v) * ufl.dx


def strong_residual(u: Expr, f: Expr, kappa: Expr | float = 1) -> Expr:
    """Return f + div(kappa grad(u)), which vanishes for the exact solution.

    Args:
        u: Approximate solution.
        f: Source.
        kappa: Diffusivity, as in :func:`a`.
    """
    return f + ufl.div(kappa * ufl.grad(u))
