"""Eigenmodes of membranes, in the plane or of a curved surface: the frequencies at which they ring.

Strong form, for eigenvalues lambda and modes u that are not zero, with n the outward (co)normal:

    -div(kappa grad(u)) = lambda rho u     in the domain or on the surface
                     u = 0                where it is held (a Dirichlet condition)
      kappa grad(u) . n = 0                elsewhere on the boundary

The frequency is sqrt(lambda) / (2 pi). UFL's ``grad`` on a surface in space is the tangential one, so that the modes
there are those of the Laplace-Beltrami operator; with nothing held the first mode is constant, lambda = 0. In weak
form a(u, v) = lambda m(u, v) for all v: a generalised eigenvalue problem of two matrices. For a plate take `plate.a`
and `m` from here.

Source: Strang and Fix, An analysis of the finite element method (1973), chapter 6.
"""

import ufl
from ufl.core.expr import Expr


def a(u: Expr, v: Expr, kappa: Expr | float = 1) -> ufl.Form:
    """Return the stiffness, the integral of kappa grad(u) . grad(v).

    Args:
        u: Trial function.
        v: Test function.
        kappa: Tension: a scalar, or a tensor that acts on gradients.
    """
    return ufl.inner(kappa * ufl.grad(u), ufl.grad(v)) * ufl.dx


def m(u: Expr, v: Expr, rho: Expr | float = 1) -> ufl.Form:
    """Return the mass, the integral of rho u v.

    Args:
        u: Trial function.
        v: Test function.
        rho: Mass per area.
    """
    return rho * ufl.inner(u, v) * ufl.dx


def strong_residual(u: Expr, eigenvalue: Expr | float, kappa: Expr | float = 1, rho: Expr | float = 1) -> Expr:
    """Return eigenvalue rho u + div(kappa grad(u)), which vanishes for an exact mode.

    Args:
        u: Approximate mode.
        eigenvalue: Its eigenvalue.
        kappa: Tension, as in :func:`a`.
        rho: Mass per area.
    """
    return eigenvalue * rho * u + ufl.div(kappa * ufl.grad(u))
