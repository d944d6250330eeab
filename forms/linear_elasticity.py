"""Linear elasticity of a sheet in the plane: small displacements of an isotropic material.

Strong form, for the displacement u with two components and n the outward normal:

    -div(sigma(u)) = f        in the domain
       sigma(u) . n = t       where no Dirichlet condition is set

with the strain epsilon(u) = (grad(u) + grad(u)^T) / 2 and the stress

    sigma(u) = lmbda tr(epsilon(u)) I + 2 mu epsilon(u).

The constants lmbda and mu are Lamé's, by `plane_strain` for a body that is long across the plane and cannot widen
there, by `plane_stress` for a thin sheet that can.

Source: Braess, Finite elements (3rd ed., 2007), chapter VI, sections 3 and 4.
"""

import ufl
from ufl.core.expr import Expr


def plane_strain(E: float, nu: float) -> tuple[float, float]:
    """Return Lamé's constants lmbda and mu for zero strain across the plane.

    Args:
        E: Young's modulus.
        nu: Poisson's ratio, less than 1/2.
    """
    return E * nu / ((1 + nu) * (1 - 2 * nu)), E / (2 * (1 + nu))


def plane_stress(E: float, nu: float) -> tuple[float, float]:
    """Return Lamé's constants lmbda and mu for zero stress across the plane.

    Args:
        E: Young's modulus.
        nu: Poisson's ratio.
    """
    return E * nu / (1 - nu**2), E / (2 * (1 + nu))


def epsilon(u: Expr) -> Expr:
    """Return the strain of a displacement, a symmetric tensor.

    Args:
        u: Displacement.
    """
    return ufl.sym(ufl.grad(u))


def sigma(u: Expr, lmbda: Expr | float = 1, mu: Expr | float = 1) -> Expr:
    """Return the stress of a displacement, a symmetric tensor.

    Args:
        u: Displacement.
        lmbda: Lamé's first constant.
        mu: The second, the shear modulus.
    """
    return lmbda * ufl.tr(epsilon(u)) * ufl.Identity(2) + 2 * mu * epsilon(u)


def a(u: Expr, v: Expr, lmbda: Expr | float = 1, mu: Expr | float = 1) -> ufl.Form:
    """Return the bilinear form, the integral of sigma(u) : epsilon(v).

    Args:
        u: Trial function.
        v: Test function.
        lmbda: Lamé's first constant.
        mu: The second, the shear modulus.
    """
    return ufl.inner(sigma(u, lmbda, mu), epsilon(v)) * ufl.dx


def L(f: Expr, v: Expr, t: Expr | None = None, ds: ufl.Measure = ufl.ds) -> ufl.Form:
    """Return the load, the integral of f . v, plus that of t . v over the boundary.

    Args:
        f: Force per area.
        v: Test function.
        t: Traction on the boundary, force per length; None for none.
        ds: Where it pulls, as ``ufl.ds(tag)``.
    """
    load = ufl.inner(f, v) * ufl.dx
    return load if t is None else load + ufl.inner(t, v) * ds


def strong_residual(u: Expr, f: Expr, lmbda: Expr | float = 1, mu: Expr | float = 1) -> Expr:
    """Return f + div(sigma(u)), a vector, which vanishes for the exact solution.

    Args:
        u: Approximate displacement.
        f: Force per area.
        lmbda: Lamé's first constant.
        mu: The second, the shear modulus.
    """
    return f + ufl.div(sigma(u, lmbda, mu))
