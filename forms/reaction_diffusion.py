"""Reaction and diffusion of several substances, in the plane or on a surface.

Strong form, for the concentrations u = (u_0, u_1, ...), each with its diffusivity D_i:

    du_i/dt - D_i div(grad(u_i)) = R_i(u)    in the domain
                  grad(u_i) . n = 0         on its boundary

R is the reaction: `schnakenberg`, `gray_scott`, or an expression of one's own. Where two substances diffuse at
different speeds, a uniform state that the reaction alone would hold may break up into spots and stripes (Turing, Phil.
Trans. R. Soc. B 237 (1952), 37-72): a mode with -div(grad(w)) = k^2 w grows like exp(s t), s being an eigenvalue of
dR/du - k^2 diag(D).

Source: Murray, Mathematical biology II (3rd ed., 2003), chapter 2; on surfaces Dziuk and Elliott, Finite element
methods for surface PDEs, Acta Numerica 22 (2013).
"""

import ufl
from ufl.core.expr import Expr

Diffusivities = list[Expr | float] | tuple[Expr | float, ...]


def F(u: Expr, udot: Expr, v: Expr, reaction: Expr, diffusivities: Diffusivities) -> ufl.Form:
    """Return the form that is zero for all v: the integral of udot . v - R . v, and of D_i grad(u_i) . grad(v_i).

    Args:
        u: Concentrations, a vector.
        udot: Their derivatives in time.
        v: Test function.
        reaction: What the reaction adds to each of them in a unit of time, as :func:`schnakenberg` of u.
        diffusivities: One for each component.
    """
    diffusion = sum(D * ufl.inner(ufl.grad(u[i]), ufl.grad(v[i])) for i, D in enumerate(diffusivities))
    return ufl.inner(udot, v) * ufl.dx + (diffusion - ufl.inner(reaction, v)) * ufl.dx


def strong_residual(u: Expr, udot: Expr, reaction: Expr, diffusivities: Diffusivities) -> Expr:
    """Return the vector of R_i + D_i div(grad(u_i)) - udot_i, which vanishes for the exact solution.

    Args:
        u: Approximate concentrations.
        udot: Their derivatives in time.
        reaction: As in :func:`F`.
        diffusivities: As in :func:`F`.
    """
    diffusion = [D * ufl.div(ufl.grad(u[i])) for i, D in enumerate(diffusivities)]
    return reaction + ufl.as_vector(diffusion) - udot


def schnakenberg(u: Expr, a: Expr | float = 0.1, b: Expr | float = 0.9, gamma: Expr | float = 1) -> Expr:
    """Return gamma (a - u_0 + u_0^2 u_1, b - u_0^2 u_1), at rest for u = (a + b, b / (a + b)^2).

    Source: Schnakenberg, Simple chemical reaction systems with limit cycle behaviour, J. Theor. Biol. 81 (1979),
    389-400, as scaled by Murray, section 2.2.

    Args:
        u: Concentrations of activator and substrate.
        a: Supply of the activator.
        b: Supply of the substrate.
        gamma: Speed of the reaction.
    """
    autocatalysis = u[0] ** 2 * u[1]
    return gamma * ufl.as_vector([a - u[0] + autocatalysis, b - autocatalysis])


def gray_scott(u: Expr, feed: Expr | float = 0.04, kill: Expr | float = 0.06) -> Expr:
    """Return (-u_0 u_1^2 + feed (1 - u_0), u_0 u_1^2 - (feed + kill) u_1), at rest for u = (1, 0).

    Source: Pearson, Complex patterns in a simple system, Science 261 (1993), 189-192.

    Args:
        u: Concentrations of the substrate and of what feeds on it.
        feed: Rate of the supply.
        kill: Rate of decay.
    """
    autocatalysis = u[0] * u[1] ** 2
    return ufl.as_vector([feed * (1 - u[0]) - autocatalysis, autocatalysis - (feed + kill) * u[1]])
