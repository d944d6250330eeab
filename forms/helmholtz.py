"""The Helmholtz equation: waves of one frequency, in the plane or along a surface, in real numbers.

Strong form, with n the outward (co)normal:

    -div(grad(u)) - k^2 u = f      in the domain
       grad(u) . n + z u = g       where no Dirichlet condition is set

k is the wave number, 2 pi / k the wavelength. The form is symmetric but indefinite, and singular where k^2 is an
eigenvalue of the domain. z is an impedance that stores energy but absorbs none: an absorbing boundary has z = -i k, for
which u would have to be complex.

Source: Ihlenburg, Finite element analysis of acoustic scattering (1998), sections 1.1 and 2.2.
"""

import ufl
from ufl.core.expr import Expr


def a(u: Expr, v: Expr, k: Expr | float, z: Expr | float | None = None, ds: ufl.Measure = ufl.ds) -> ufl.Form:
    """Return the bilinear form, the integral of grad(u) . grad(v) - k^2 u v, plus that of z u v over the boundary.

    Args:
        u: Trial function.
        v: Test function.
        k: Wave number.
        z: Impedance of the boundary; None for none.
        ds: Where it has one, as ``ufl.ds(tag)``.
    """
    form = (ufl.inner(ufl.grad(u), ufl.grad(v)) - k**2 * ufl.inner(u, v)) * ufl.dx
    return form if z is None else form + z * ufl.inner(u, v) * ds


def L(f: Expr, v: Expr, g: Expr | None = None, ds: ufl.Measure = ufl.ds) -> ufl.Form:
    """Return the load, the integral of f v, plus that of g v over the boundary.

    Args:
        f: Source.
        v: Test function.
        g: What grad(u) . n + z u is on the boundary; None for zero.
        ds: Where it is not zero, as ``ufl.ds(tag)``.
    """
    load = ufl.inner(f, v) * ufl.dx
    return load if g is None else load + ufl.inner(g, v) * ds


def strong_residual(u: Expr, f: Expr, k: Expr | float) -> Expr:
    """Return f + div(grad(u)) + k^2 u, which vanishes for the exact solution.

    Args:
        u: Approximate solution.
        f: Source.
        k: Wave number.
    """
    return f + ufl.div(ufl.grad(u)) + k**2 * u
