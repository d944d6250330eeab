"""Kirchhoff's plate: the deflection u of a thin plate under a load across it.

Strong form, with H(u) the Hessian, n the outward normal and s along the boundary:

    div(div(m)) = f,    m = D ((1 - nu) H(u) + nu tr(H(u)) I),    that is D div(grad(div(grad(u)))) = f for constant D,

    clamped:           u = g,       du/dn = dg/dn
    simply supported:  u = g,       m_nn = 0
    free:              m_nn = 0,    div(m) . n + dm_ns/ds = 0,    and m_ns does not jump at corners

What is said of m is natural: where a form says nothing, the plate is free. Value and slope are prescribed strongly on
``fem.boundary_dofs(V, slope=True)``, the value alone on ``fem.boundary_dofs(V)``; `clamped` and `supported` do the same
weakly, by Nitsche's method. Functions must be in H2, and the caps at extraordinary vertices deep:
docs/fourth_order.md.

On a curved surface H is the tangential Hessian. The form is then no shell's, which bends otherwise
(`thccs_fem.forms.kirchhoff_love`), but the part of second order of an energy; `strong_residual` is for the plane.

Sources: Timoshenko and Woinowsky-Krieger, Theory of plates and shells (1959), sections 21-22; Embar, Dolbow and Harari,
Imposing Dirichlet boundary conditions with Nitsche's method and spline-based finite elements, Int. J. Numer. Meth.
Engng 83 (2010), 877-898.
"""

import ufl
from ufl.core.expr import Expr
from ufl.domain import extract_unique_domain

NU = 0.3  # Poisson's ratio of steel

# On a square with h = 1 the forms with Nitsche's terms are positive for all bicubics if gamma is larger than 420 (one
# edge) or 1000 (two edges, in a corner), whatever nu from 0 to 1/2; flat cells need more.
GAMMA = 1000.0
SLOPE = 0.02  # penalty of the slope, of that of the value


def hessian(u: Expr) -> Expr:
    """Return the Hessian of a scalar; on a curved surface the tangential one, which is symmetric as well.

    There UFL's grad(grad(u)) has a normal part in its first index, by which the gradient turns with the tangent plane.

    Raises:
        ValueError: u is constant.
    """
    domain = extract_unique_domain(u)
    if domain is None:
        raise ValueError(f"{u} is no function on a mesh, so it has no Hessian")
    second = ufl.grad(ufl.grad(u))
    if domain.geometric_dimension == domain.topological_dimension:
        return second
    return ufl.dot(ufl.dot(ufl.Jacobian(domain), ufl.JacobianInverse(domain)), second)  # J times its pseudo-inverse


def moments(u: Expr, D: Expr | float = 1, nu: Expr | float = NU) -> Expr:
    """Return the moments D ((1 - nu) H(u) + nu tr(H(u)) I), without the sign that some give them.

    Args:
        u: Deflection.
        D: Bending stiffness E t^3 / (12 (1 - nu^2)).
        nu: Poisson's ratio.
    """
    H = hessian(u)
    return D * ((1 - nu) * H + nu * ufl.tr(H) * ufl.Identity(H.ufl_shape[0]))


def a(u: Expr, v: Expr, D: Expr | float = 1, nu: Expr | float = NU) -> ufl.Form:
    """Return the bilinear form, the integral of m(u) : H(v).

    Args:
        u: Trial function, or the unknown of a nonlinear problem.
        v: Test function.
        D: Bending stiffness.
        nu: Poisson's ratio. It matters where the plate is not clamped.
    """
    return ufl.inner(moments(u, D, nu), hessian(v)) * ufl.dx


def L(f: Expr, v: Expr) -> ufl.Form:
    """Return the load, the integral of f v.

    Args:
        f: Load per area.
        v: Test function.
    """
    return ufl.inner(f, v) * ufl.dx


def supported(
    u: Expr,
    v: Expr,
    g: Expr | float,
    h: Expr | float,
    D: Expr | float = 1,
    nu: Expr | float = NU,
    gamma: float = GAMMA,
    ds: ufl.Measure = ufl.ds,
) -> ufl.Form:
    """Return what puts u = g on the boundary in the weak form: Nitsche's method, symmetric.

    With q(u, v) = (div(m(u)) . n) v - m_ns(u) dv/ds, the work of the forces at the edge, this is the integral of
    q(u, v) + q(v, u - g) + gamma D (u - g) v / h^3. Added to a(u, v) - L(f, v) it takes the place of a Dirichlet
    condition; ``ufl.system`` of the sum has the two sides of the equation.

    Args:
        u: Trial function, or the unknown of a nonlinear problem.
        v: Test function.
        g: Deflection at the edge.
        h: Size of the cells.
        D: Bending stiffness.
        nu: Poisson's ratio.
        gamma: Penalty.
        ds: Where the condition holds, as ``ufl.ds(tag)``.
    """
    n = ufl.FacetNormal(extract_unique_domain(v))

    def work(w: Expr, z: Expr) -> Expr:
        m = moments(w, D, nu)
        along = ufl.grad(z) - ufl.dot(ufl.grad(z), n) * n
        return ufl.dot(ufl.div(m), n) * z - ufl.dot(ufl.dot(m, n), along)

    miss = u - g
    return (work(u, v) + work(v, miss) + gamma * D / h**3 * miss * v) * ds


def clamped(
    u: Expr,
    v: Expr,
    g: Expr | float,
    h: Expr | float,
    D: Expr | float = 1,
    nu: Expr | float = NU,
    gamma: float = GAMMA,
    ds: ufl.Measure = ufl.ds,
) -> ufl.Form:
    """Return what puts u = g and du/dn = dg/dn on the boundary in the weak form: Nitsche's method, symmetric.

    Besides the terms of :func:`supported` those of the slope: the integral of -m_nn(u) dv/dn - m_nn(v) d(u - g)/dn
    + 0.02 gamma D d(u - g)/dn dv/dn / h.

    Args:
        u: Trial function, or the unknown of a nonlinear problem.
        v: Test function.
        g: What has deflection and slope of the edge.
        h: Size of the cells.
        D: Bending stiffness.
        nu: Poisson's ratio.
        gamma: Penalty.
        ds: Where the condition holds, as ``ufl.ds(tag)``.
    """
    n = ufl.FacetNormal(extract_unique_domain(v))

    def slope(w: Expr) -> Expr:
        return ufl.dot(ufl.grad(w), n)

    def moment(w: Expr) -> Expr:
        return ufl.dot(ufl.dot(moments(w, D, nu), n), n)

    miss = slope(u - g)
    terms = -moment(u) * slope(v) - moment(v) * miss + SLOPE * gamma * D / h * miss * slope(v)
    return supported(u, v, g, h, D, nu, gamma, ds) + terms * ds


def strong_residual(u: Expr, f: Expr, D: Expr | float = 1, nu: Expr | float = NU) -> Expr:
    """Return f - div(div(m(u))), which vanishes for the exact solution, in the plane.

    Args:
        u: Approximate solution.
        f: Load per area.
        D: Bending stiffness.
        nu: Poisson's ratio.
    """
    return f - ufl.div(ufl.div(moments(u, D, nu)))
