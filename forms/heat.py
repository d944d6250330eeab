"""The heat equation, in the plane or on a surface.

Strong form, with n the outward (co)normal:

    du/dt - div(kappa grad(u)) = f    in the domain
           kappa grad(u) . n = g      where no Dirichlet condition is set

On a closed surface, and wherever no heat comes in, the integral of u stays what it is.

Source: Thomée, Galerkin finite element methods for parabolic problems (2nd ed., 2006), chapter 1; on surfaces Dziuk and
Elliott, Finite element methods for surface PDEs, Acta Numerica 22 (2013), section 5.
"""

import ufl
from ufl.core.expr import Expr


def F(
    u: Expr,
    udot: Expr,
    v: Expr,
    f: Expr | float = 0,
    g: Expr | None = None,
    kappa: Expr | float = 1,
    ds: ufl.Measure = ufl.ds,
) -> ufl.Form:
    """Return the form that is zero for all v: the integral of udot v + kappa grad(u) . grad(v) - f v, and of -g v.

    Args:
        u: Temperature.
        udot: Its derivative in time.
        v: Test function.
        f: Source.
        g: Inward flux on the boundary; None for none.
        kappa: Diffusivity: a scalar, or a tensor that acts on gradients.
        ds: Where the flux is, as ``ufl.ds(tag)``.
    """
    inside = udot * v * ufl.dx + (ufl.inner(kappa * ufl.grad(u), ufl.grad(v)) - f * v) * ufl.dx
    return inside if g is None else inside - g * v * ds


def strong_residual(u: Expr, udot: Expr, f: Expr | float = 0, kappa: Expr | float = 1) -> Expr:
    """Return f + div(kappa grad(u)) - udot, which vanishes for the exact solution.

    Args:
        u: Approximate temperature.
        udot: Its derivative in time.
        f: Source.
        kappa: Diffusivity, as in :func:`F`.
    """
    return f + ufl.div(kappa * ufl.grad(u)) - udot
