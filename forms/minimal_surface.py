"""Minimal surfaces as graphs: the surface z = u(x, y) over a plane domain, of the least area for its rim.

Strong form, with W = sqrt(1 + |grad(u)|^2):

    -div(grad(u) / W) = f       in the domain
                   u = g       on its boundary

f = 0 is the minimal surface equation; else the graph has the mean curvature -f / 2, as a soap film has under pressure.
The problem is nonlinear: `F` is the derivative of `area` (less the work of f), and its own derivative is a symmetric
positive form, so Newton's method converges from a good start. A graph exists for any g on a convex domain only.

Source: Gilbarg and Trudinger, Elliptic partial differential equations of second order (2nd ed., 1983), chapter 16.
"""

import ufl
from ufl.core.expr import Expr


def area(u: Expr) -> ufl.Form:
    """Return the area of the graph, the integral of W.

    Args:
        u: Height.
    """
    return _stretch(u) * ufl.dx


def F(u: Expr, v: Expr, f: Expr | float = 0) -> ufl.Form:
    """Return the residual, the integral of grad(u) . grad(v) / W - f v, which is zero for the solution and all v.

    Args:
        u: Height, the unknown.
        v: Test function.
        f: Source.
    """
    return (ufl.inner(ufl.grad(u), ufl.grad(v)) / _stretch(u) - f * v) * ufl.dx


def strong_residual(u: Expr, f: Expr | float = 0) -> Expr:
    """Return f + div(grad(u) / W), which vanishes for the exact solution.

    Args:
        u: Approximate height.
        f: Source.
    """
    return f + ufl.div(ufl.grad(u) / _stretch(u))


def _stretch(u: Expr) -> Expr:
    """Return W, the area of the graph per area of the plane."""
    return ufl.sqrt(1 + ufl.inner(ufl.grad(u), ufl.grad(u)))
