"""The Cahn-Hilliard equation: a mixture of two substances, u near 1 and near -1, that unmixes.

Strong form, with the chemical potential mu:

    du/dt = div(M grad(mu)),    mu = W'(u) - epsilon^2 div(grad(u)),    W(u) = (u^2 - 1)^2 / 4

It has fourth derivatives of u. The weak form is the primal one, for u alone: integrated by parts twice it asks for
functions with a continuous gradient, and no second unknown is needed. The integral of u stays what it is, and the
`energy` falls by the integral of M |grad(mu)|^2 in a unit of time. Of waves with -div(grad(w)) = k^2 w on a mixture c
the small ones grow like exp(s t) with s = -M k^2 (W''(c) + epsilon^2 k^2).

On a boundary the condition that nothing flows through, M grad(mu) . n = 0, is natural. The other one, grad(u) . n = 0
where u meets a wall at a right angle, must be imposed: add :func:`contact` to F. Without it waves at the boundary grow
faster the shorter they are.

Source: Gomez, Calo, Bazilevs and Hughes, Isogeometric analysis of the Cahn-Hilliard phase-field model, Computer Methods
in Applied Mechanics and Engineering 197 (2008), 4333-4352; here with the quartic W.
"""

import ufl
from ufl.core.expr import Expr
from ufl.domain import extract_unique_domain

GAMMA = 20.0  # penalty of the slope on the boundary, that of a clamped plate: plate.SLOPE * plate.GAMMA


def energy(u: Expr, epsilon: Expr | float) -> ufl.Form:
    """Return the integral of epsilon^2 |grad(u)|^2 / 2 + W(u).

    Args:
        u: Concentration, from -1 to 1.
        epsilon: Width of the interfaces.
    """
    return (epsilon**2 * ufl.inner(ufl.grad(u), ufl.grad(u)) / 2 + (u**2 - 1) ** 2 / 4) * ufl.dx


def chemical_potential(u: Expr, epsilon: Expr | float) -> Expr:
    """Return mu = W'(u) - epsilon^2 div(grad(u)).

    Args:
        u: Concentration.
        epsilon: Width of the interfaces.
    """
    return u**3 - u - epsilon**2 * ufl.div(ufl.grad(u))


def F(u: Expr, udot: Expr, v: Expr, epsilon: Expr | float, M: Expr | float = 1) -> ufl.Form:
    """Return the form that is zero for all v.

    The integral of udot v + M W''(u) grad(u) . grad(v) + epsilon^2 div(grad(u)) div(M grad(v)).

    Args:
        u: Concentration.
        udot: Its derivative in time.
        v: Test function.
        epsilon: Width of the interfaces.
        M: Mobility, which may depend on u, as ``1 - u**2``.
    """
    local = (3 * u**2 - 1) * M * ufl.inner(ufl.grad(u), ufl.grad(v))
    across = epsilon**2 * ufl.div(ufl.grad(u)) * ufl.div(M * ufl.grad(v))
    return udot * v * ufl.dx + (local + across) * ufl.dx


def contact(
    u: Expr,
    v: Expr,
    epsilon: Expr | float,
    h: Expr | float,
    M: Expr | float = 1,
    gamma: float = GAMMA,
    ds: ufl.Measure = ufl.ds,
) -> ufl.Form:
    """Return what is added to F for grad(u) . n = 0 on the boundary: Nitsche's method.

    The integral of -epsilon^2 M (div(grad(u)) dv/dn + div(grad(v)) du/dn) + epsilon^2 M gamma (du/dn) (dv/dn) / h.

    Args:
        u: Concentration.
        v: Test function.
        epsilon: Width of the interfaces.
        h: Size of the cells.
        M: Mobility.
        gamma: Penalty.
        ds: Where the condition holds, as ``ufl.ds(tag)``.
    """
    n = ufl.FacetNormal(extract_unique_domain(v))

    def slope(w: Expr) -> Expr:
        return ufl.inner(ufl.grad(w), n)

    consistent = -ufl.div(ufl.grad(u)) * slope(v) - ufl.div(ufl.grad(v)) * slope(u)
    return epsilon**2 * M * (consistent + gamma * slope(u) * slope(v) / h) * ds
