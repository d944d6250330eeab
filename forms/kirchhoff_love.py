"""Linear Kirchhoff-Love shells: thin, curved, of any midsurface, with a displacement in space for the unknown.

Where fibres across the thickness t stay straight, as long as they are, and normal to the midsurface, a displacement u
of that surface tells everything. To first order in u the surface changes its metric and its curvature by

    eps_ab   = (a_a . u,b + a_b . u,a) / 2                   a_a the tangents, n the unit normal,
    kappa_ab = -(u,ab - Gamma^c_ab u,c) . n                  Gamma the Christoffel symbols of the midsurface,

both zero for all rigid motions. They strain what is at distance z from the midsurface by eps + z kappa; plane stress
and Hooke's law make of that membrane forces N and bending moments M. In equilibrium with a load f, per area,

    integral of N(u) : eps(v) + M(u) : kappa(v) = integral of f . v        for all displacements v.

Here eps, kappa, N and M are symmetric tensors in space that act in the tangent plane, so that no coordinates of the
surface appear: UFL's ``grad`` on a surface takes tangential derivatives, and the covariant second derivative of a
scalar is the projection of its ``grad(grad)`` onto the tangent plane. Functions must be in H^2, as smooth splines are;
clamping an edge fixes the slope as well. The unit normal of the mesh enters squared: its orientation is all one, but
for the sign of kappa and M.

Sources: Ciarlet, An introduction to differential geometry with applications to elasticity (2005), section 4 (Koiter's
model); Cirak, Ortiz and Schroeder, Subdivision surfaces: a new paradigm for thin-shell finite-element analysis, Int. J.
Numer. Meth. Engng 47 (2000), 2039-2072; Kiendl, Bletzinger, Linhard and Wuechner, Isogeometric shell analysis with
Kirchhoff-Love elements, Comput. Methods Appl. Mech. Engrg. 198 (2009), 3902-3914.
"""

import ufl
from ufl.core.expr import Expr
from ufl.domain import extract_unique_domain


def membrane_strain(u: Expr) -> Expr:
    """Return eps, half the first-order change of the metric: a tangential tensor, shape (3, 3).

    Args:
        u: Displacement in space, shape (3,), on a surface in space.

    Raises:
        ValueError: The displacement has another shape.
    """
    return ufl.sym(_tangential(u) * ufl.grad(u))


def curvature_change(u: Expr) -> Expr:
    """Return kappa, minus the first-order change of the second fundamental form: a tangential tensor, shape (3, 3).

    Args:
        u: As in :func:`membrane_strain`.

    Raises:
        ValueError: The displacement has another shape.
    """
    # The second index of the Hessian, of the last derivative, is tangential as it is.
    return -_tangential(u) * ufl.dot(_normal(u), ufl.grad(ufl.grad(u)))


def membrane_force(u: Expr, E: Expr | float, nu: Expr | float, t: Expr | float) -> Expr:
    """Return N, force per length in the tangent plane, shape (3, 3).

    Args:
        u: Displacement.
        E: Young's modulus.
        nu: Poisson's ratio.
        t: Thickness.
    """
    eps = membrane_strain(u)
    return E * t / (1 - nu**2) * ((1 - nu) * eps + nu * ufl.tr(eps) * _tangential(u))


def bending_moment(u: Expr, E: Expr | float, nu: Expr | float, t: Expr | float) -> Expr:
    """Return M, moment per length in the tangent plane, shape (3, 3); arguments as in :func:`membrane_force`."""
    kappa = curvature_change(u)
    return E * t**3 / (12 * (1 - nu**2)) * ((1 - nu) * kappa + nu * ufl.tr(kappa) * _tangential(u))


def a(u: Expr, v: Expr, E: Expr | float, nu: Expr | float, t: Expr | float) -> ufl.Form:
    """Return the bilinear form, the virtual work of membrane forces and bending moments.

    Its kernel takes seconds to compile: where the material changes from run to run, give constants, not numbers.

    Args:
        u: Trial function, shape (3,).
        v: Test function, shape (3,).
        E: Young's modulus.
        nu: Poisson's ratio.
        t: Thickness.
    """
    membrane = _plane_stress(membrane_strain(u), membrane_strain(v), nu)
    bending = _plane_stress(curvature_change(u), curvature_change(v), nu)
    return E * t / (1 - nu**2) * (membrane + t**2 / 12 * bending) * ufl.dx


def L(f: Expr, v: Expr) -> ufl.Form:
    """Return the load, the integral of f . v.

    Args:
        f: Force per area of the midsurface, shape (3,).
        v: Test function.
    """
    return ufl.inner(f, v) * ufl.dx


def _plane_stress(A: Expr, B: Expr, nu: Expr | float) -> Expr:
    """Return (1 - nu) A : B + nu tr A tr B, the law of plane stress but for its modulus."""
    return (1 - nu) * ufl.inner(A, B) + nu * ufl.tr(A) * ufl.tr(B)


def _normal(u: Expr) -> Expr:
    """Return the unit normal of the surface that a displacement is on."""
    domain = extract_unique_domain(u)
    gdim = None if domain is None else domain.geometric_dimension
    if u.ufl_shape != (3,) or gdim != 3:
        raise ValueError(
            f"the displacement has shape {u.ufl_shape}, on a mesh in {gdim} dimensions: a shell needs shape (3,) on a "
            f"surface in space; give vertices of a planar mesh a third coordinate, 0"
        )
    return ufl.CellNormal(domain)


def _tangential(u: Expr) -> Expr:
    """Return the projection onto the tangent plane."""
    n = _normal(u)
    return ufl.Identity(3) - ufl.outer(n, n)
