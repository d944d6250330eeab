# ---
# jupyter:
#   jupytext:
#     text_representation:
#       format_name: percent
# ---

# %% [markdown]
# # How good is the bubble estimator?
#
# The paper (Wei, Zhang, Hughes, Scott, CMAME 291, 2015, sec. 6) refines where an estimator of bubble functions, its
# ref. [6], sees the error. This demo measures that estimator on three problems with known solutions: the *effectivity*
# is what it estimates, divided by the energy norm of the error. Beside it stands `estimate.residual`.
#
# A bubble is a function that vanishes on the edges of an element. In each element $K$ we take four of them, the
# bicubic Bernstein polynomials inside, and ask the weak form itself what $u_h$ has missed there:
#
# $$ a(z_K, b) = L(b) - a(u_h, b) \quad \text{for all bubbles } b \text{ of } K, \qquad \eta_K^2 = a(z_K, z_K) . $$
#
# So $z_K$ is the projection of the error $e = u - u_h$ onto the bubbles. The spline space has no such functions, being
# smooth across edges, so that $z_K$ does not vanish by Galerkin's orthogonality. That needs no constant, no second
# derivative, and nothing but the forms that the solver had: `estimate.bubble(uh, a, L)`.
#
# Two facts come with projections. The estimate is never too large, $\sum \eta_K^2 \le a(e, e)$. And it can't see the
# part of the error that lives on the edges: of a smooth error, measured in the energy norm, bubbles of any degree see
# about three quarters.

# %%
import argparse
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import ufl
from thccs_fem import adapt, estimate, fem, generators, plot
from ufl import div, dot, dx, grad, inner

try:
    from thccs_fem.fem.petsc import LinearProblem
except ImportError:  # no PETSc here: the same problem, solved by SciPy
    from thccs_fem.fem.scipy import LinearProblem

parser = argparse.ArgumentParser(description="Effectivity of the bubble estimator along adaptive runs")
parser.add_argument("--steps", type=int, default=int(os.environ.get("STEPS", "20")), help="refinement steps")
parser.add_argument("--out", type=Path, default=Path("out"), help="directory of the pictures")
arguments = parser.parse_args()
arguments.out.mkdir(parents=True, exist_ok=True)

Expr = ufl.core.expr.Expr

# %% [markdown]
# ## Three problems
#
# On closed surfaces $-\Delta_\Gamma u + u = f$, where $u$ is a bump: on a *torus*, without extraordinary vertices
# (EVs), and on a *sphere* made of a cube, where the bump sits at one of the eight EVs. On the *L-domain*
# $-\Delta u = 0$ with $u = r^{2/3} \sin(\frac23 \theta - \frac{\pi}3)$ on the boundary, singular at the corner.
#
# For surfaces we hand in the load as $L(v) = a(u, v)$. The strong residual needs $f$ itself. UFL's `grad` of an
# expression in $x$ is the one in space; $P = J J^+$ takes its tangential part, and `div` of that is $\Delta_\Gamma u$.


# %%
@dataclass
class Problem:
    """The equation -div(grad(u)) + c u = f with the solution `exact`, on the surface of V."""

    V: fem.FunctionSpace
    exact: Expr
    c: float

    def tangential(self, gradient: Expr) -> Expr:
        """Return the part of a gradient that is tangential to the surface."""
        domain = self.V.mesh.ufl_domain()
        return dot(gradient, ufl.Jacobian(domain) * ufl.JacobianInverse(domain)) if self.V.mesh.gdim == 3 else gradient

    @property
    def f(self) -> Expr:
        """The right-hand side."""
        if self.c == 0.0:
            return fem.Constant(self.V.mesh, 0.0)
        return self.c * self.exact - div(self.tangential(grad(self.exact)))

    def a(self, u: Expr, v: Expr) -> ufl.Form:
        """Return the bilinear form."""
        return (inner(grad(u), grad(v)) + self.c * u * v) * dx

    def L(self, v: Expr) -> ufl.Form:
        """Return the load."""
        return self.f * v * dx if self.c == 0.0 else self.a(self.exact, v)

    def solve(self, V: fem.FunctionSpace) -> fem.Function:
        """Solve in a space."""
        u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
        rim = fem.boundary_dofs(V)
        bcs = [fem.dirichletbc(self.exact, rim, V)] if rim.size else []
        return LinearProblem(self.a(u, v), self.L(v), bcs=bcs, petsc_options_prefix="bubble_").solve()

    def energy_error(self, uh: fem.Function) -> float:
        """Return the energy norm of the error."""
        e = uh - self.exact
        gradient = self.tangential(grad(e))
        squares = (inner(gradient, gradient) + self.c * e * e) * dx
        return fem.assemble_scalar(fem.form(squares, quadrature_degree=11)) ** 0.5


def bump(V: fem.FunctionSpace, centre: np.ndarray, width: float) -> Expr:
    d = ufl.SpatialCoordinate(V.mesh) - ufl.as_vector(centre.tolist())
    return ufl.exp(-dot(d, d) / width**2)


def singular(V: fem.FunctionSpace) -> Expr:
    x, y = ufl.SpatialCoordinate(V.mesh)
    turned = 5 * np.pi / 4  # atan2 jumps in the middle of the missing quadrant
    c, s = np.cos(turned), np.sin(turned)
    theta = turned + ufl.atan2(c * y - s * x, c * x + s * y)
    return (x**2 + y**2) ** (1 / 3) * ufl.sin(2 * theta / 3 - np.pi / 3)


torus = fem.functionspace(generators.torus((16, 8)), ("THCCS", 3))
sphere = fem.functionspace(generators.cube_sphere(4), ("THCCS", 3))
l_domain = fem.functionspace(generators.l_domain(4), ("THCCS", 3), cap_level=16)  # graded quadrature at the corner
problems = {
    "torus": Problem(torus, bump(torus, np.array([3.0, 0.0, 0.0]), 0.5**0.5), 1.0),
    "sphere": Problem(sphere, bump(sphere, np.full(3, 3**-0.5), 0.1**0.5), 1.0),
    "L-domain": Problem(l_domain, singular(l_domain), 0.0),
}

# %% [markdown]
# ## Adaptive runs
#
# The bubble indicators drive the refinement: those functions are refined whose supports carry half of the estimate.


# %%
def bubbles_of(uh: fem.Function, problem: Problem) -> np.ndarray:
    """Return the bubble indicators."""
    V = uh.function_space
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    return estimate.bubble(uh, problem.a(u, v), problem.L(v))


def run(problem: Problem) -> tuple[np.ndarray, fem.Function]:
    """Return a row for each step: dofs, energy error, bubble estimate, residual estimate; and the last solution."""
    rows: list[tuple[float, ...]] = []

    def indicators(uh: fem.Function) -> np.ndarray:
        V = uh.function_space
        eta = bubbles_of(uh, problem)
        residuals = estimate.residual(uh, problem.f + div(grad(uh)) - problem.c * uh)
        rows.append((V.num_dofs, problem.energy_error(uh), estimate.norm(V, eta), estimate.norm(V, residuals)))
        return eta

    history = adapt.solve(problem.V, problem.solve, indicators, stop=adapt.Stop(steps=arguments.steps))
    return np.array(rows), history.solution


tables, solutions = {}, {}
for name, problem in problems.items():
    tables[name], solutions[name] = run(problem)
    print(f"\n{name}\n{'dofs':>6} {'error':>9} {'bubble':>9} {'effectivity':>11} {'residual':>9} {'effectivity':>11}")
    for dofs, error, bubbles, residual in tables[name]:
        print(
            f"{dofs:6.0f} {error:9.2e} {bubbles:9.2e} {bubbles / error:11.2f} {residual:9.2e} {residual / error:11.1f}"
        )

# %% [markdown]
# ## What comes out
#
# Once a bump is resolved, the effectivity of the bubbles stays within a fifth of one constant while the error falls by
# a factor of a hundred or more. It is not near one: it lies between 0.38 and 0.60, lowest while all of the error is in
# the elements at the re-entrant corner. So the estimate is a lower bound of the error, and twice the estimate a fair
# guess.
#
# The residual estimator is 0.4 to 0.9 of the error on all three. That is owed to its weights. At the re-entrant corner
# the second derivatives of the functions are not square-integrable: weighted by the size of the element as a whole, as
# one would do elsewhere, the residual depends on where the cap ends that replaces them, and is 1.2, 2.4, 8.1 and 15
# times the error in the first step with `cap_level` 4, 8, 16 and 20. `estimate.residual` takes the geometric mean of
# the sizes of the element and of the piece of it, which is 0.4 for all of these, as are the bubbles.
#
# Other problems have other constants: 0.33 to 0.40 on a torus whose elements are twice as long as wide, 0.4 to 0.7
# under uniform refinement around EVs with 3 to 8 edges. We also tried other bubbles. With four in each bicubic
# *piece*, of which the elements at the corner have 49, instead of four in the whole element, the effectivity on the
# L-domain rises from 0.22 to 0.52 in a longer run: not constant at all. Bubbles of degree 4 add 10 to 25 %, and degree
# 5 hardly more.

# %%
figure = Figure(figsize=(12, 6.5), layout="constrained")
for column, (name, table) in enumerate(tables.items()):
    dofs, error, bubbles, residual = table.T
    above, below = (figure.add_subplot(2, 3, 3 * row + column + 1) for row in (0, 1))
    above.loglog(dofs, residual, "s-", color="tab:orange", markersize=3, label="residual estimate")
    above.loglog(dofs, error, "o-", color="black", markersize=3, label="energy error")
    above.loglog(dofs, bubbles, "^-", color="tab:blue", markersize=3, label="bubble estimate")
    above.set(title=name)
    below.semilogx(dofs, residual / error, "s-", color="tab:orange", markersize=3)
    below.semilogx(dofs, bubbles / error, "^-", color="tab:blue", markersize=3)
    below.axhline(1.0, color="black", linewidth=0.8)
    below.set(ylim=(0.0, 1.2), xlabel="dofs", ylabel="effectivity")
    for axes in (above, below):
        axes.set_xlim(90, 4000)
        axes.xaxis.set_minor_formatter("")
    if column == 0:
        above.legend()
figure.savefig(arguments.out / "bubble_estimator.png", dpi=130)

# %% [markdown]
# The indicators of the last step on the sphere, seen from the bump: near it they differ by two powers of ten or so, and
# fall off where there is nothing to resolve. That is what marking aims at.

# %%
eta = bubbles_of(solutions["sphere"], problems["sphere"])
plot.plot(
    solutions["sphere"],
    filename=arguments.out / "bubble_estimator_sphere.png",
    cell_data={"log10 of the estimate": np.log10(eta)},
    camera=(1.0, 0.8, 1.2),
)

# %% [markdown]
# What to try next: `--steps 30`; bumps of other widths, which move the constants a little; the residual as the driver.
#
# ## Check
#
# The estimate is a lower bound, and its effectivity within 20 % of one value; that of the residual changes by more, but
# not much. The first two steps of the surfaces do not count, where the bump is as wide as an element.

# %%
for name, table in tables.items():
    _, error, bubbles, residual = table[0 if name == "L-domain" else 2 :].T
    effectivity = bubbles / error
    assert 0.35 < effectivity.min() < effectivity.max() < 0.65, name
    assert effectivity.max() / effectivity.min() < 1.2 / 0.8, name
    assert 0.35 < (residual / error).min() < (residual / error).max() < 1.0, name
    assert error[-1] < error[0], name
