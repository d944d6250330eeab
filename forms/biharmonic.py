"""The biharmonic equation, in the plane or on a surface.

Strong form, with the Laplace-Beltrami operator of the surface for the Laplacian:

    div(grad(div(grad(u)))) = f

with value and slope prescribed on the whole boundary (a clamped plate, stream functions of Stokes flow), or on a
surface without one. There u is known up to a constant, and f must have mean zero.

On any other boundary take `thccs_fem.forms.plate`: what this form leaves free is not supported or free but ill-posed,
for its energy is zero for every harmonic function. Functions must be in H2, and the caps at extraordinary vertices
deep: docs/fourth_order.md. Source: Ciarlet, The finite element method for elliptic problems (1978), section 1.2.
"""

import ufl
from ufl.core.expr import Expr


def a(u: Expr, v: Expr, kappa: Expr | float = 1) -> ufl.Form:
    """Return the bilinear form, the integral of kappa div(grad(u)) div(grad(v)).

    Args:
        u: Trial function, or the unknown of a nonlinear problem.
        v: Test function.
        kappa: Stiffness, a scalar.
    """
    return kappa * ufl.inner(ufl.div(ufl.grad(u)), ufl.div(ufl.grad(v))) * ufl.dx


def L(f: Expr, v: Expr) -> ufl.Form:
    """Return the load, the integral of f v.

    Args:
        f: Source.
        v: Test function.
    """
    return ufl.inner(f, v) * ufl.dx


def strong_residual(u: Expr, f: Expr, kappa: Expr | float = 1) -> Expr:
    """Return f - div(grad(kappa div(grad(u)))), which vanishes for the exact solution.

    Args:
        u: Approximate solution.
        f: Source.
        kappa: Stiffness, as in :func:`a`.
    """
    return f - ufl.div(ufl.grad(kappa * ufl.div(ufl.grad(u))))
