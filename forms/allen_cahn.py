"""The Allen-Cahn equation: two phases, u near 1 and near -1, whose interfaces shrink by their curvature.

Strong form:

    du/dt = div(grad(u)) - W'(u) / epsilon^2    in the domain,    W(u) = (u^2 - 1)^2 / 4
    grad(u) . n = 0                             on its boundary

It is the steepest descent, in L2, of the `energy`, which falls by the integral of (du/dt)^2 in a unit of time. An
interface is tanh(x / (sqrt(2) epsilon)) across, has the energy 2 sqrt(2) / (3 epsilon) per length, and moves, for small
epsilon, with the speed of its curvature: a circle of radius R in the plane with dR/dt = -1/R.

Source: Allen and Cahn, A microscopic theory for antiphase boundary motion, Acta Metallurgica 27 (1979), 1085-1095, as
scaled by Bartels, Numerical methods for nonlinear partial differential equations (2015), chapter 6.
"""

import ufl
from ufl.core.expr import Expr


def energy(u: Expr, epsilon: Expr | float) -> ufl.Form:
    """Return the integral of |grad(u)|^2 / 2 + W(u) / epsilon^2.

    Args:
        u: Phase.
        epsilon: Width of the interfaces.
    """
    return (ufl.inner(ufl.grad(u), ufl.grad(u)) / 2 + (u**2 - 1) ** 2 / (4 * epsilon**2)) * ufl.dx


def F(u: Expr, udot: Expr, v: Expr, epsilon: Expr | float) -> ufl.Form:
    """Return the form that is zero for all v: the integral of udot v + grad(u) . grad(v) + W'(u) v / epsilon^2.

    Args:
        u: Phase.
        udot: Its derivative in time.
        v: Test function.
        epsilon: Width of the interfaces.
    """
    return udot * v * ufl.dx + (ufl.inner(ufl.grad(u), ufl.grad(v)) + (u**3 - u) * v / epsilon**2) * ufl.dx


def strong_residual(u: Expr, udot: Expr, epsilon: Expr | float) -> Expr:
    """Return div(grad(u)) - W'(u) / epsilon^2 - udot, which vanishes for the exact solution.

    Args:
        u: Approximate phase.
        udot: Its derivative in time.
        epsilon: Width of the interfaces.
    """
    return ufl.div(ufl.grad(u)) - (u**3 - u) / epsilon**2 - udot
