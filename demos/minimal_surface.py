# ---
# jupyter:
#   jupytext:
#     text_representation:
#       format_name: percent
# ---

# %% [markdown]
# # Soap films
#
# A soap film in a wire frame takes the form of least area. As a graph $z = u(x, y)$ over the domain inside the frame
# its area is
#
# $$ A(u) = \int_\Omega W, \qquad W = \sqrt{1 + |\nabla u|^2}, $$
#
# and where it is least, its derivative vanishes in all directions: a nonlinear equation,
#
# $$ \int_\Omega \frac{\nabla u \cdot \nabla v}{W} = 0 \text{ for all } v, \qquad u = g \text{ on the frame} . $$
#
# `NonlinearProblem` solves it by Newton's method. The Jacobian is found by UFL, the derivative of the form.

# %%
import os
import sys
from pathlib import Path

import numpy as np

import ufl
from thccs_fem import adapt, estimate, fem, generators, parallel, plot
from thccs_fem.forms import minimal_surface, poisson

try:
    from mpi4py import MPI

    from thccs_fem.fem.petsc import LinearProblem, NonlinearProblem

    comm = MPI.COMM_WORLD
except ImportError:  # no PETSc here: the same problems, solved by SciPy
    from thccs_fem.fem.scipy import LinearProblem, NonlinearProblem

    comm = None

if parallel.rank_of(comm) > 0:
    sys.stdout = None  # rank 0 prints for all
steps = int(os.environ.get("STEPS", "4"))
out = Path("out")
out.mkdir(exist_ok=True)

# %% [markdown]
# ## To begin with
#
# Newton's method wants a good first guess. For low frames $W$ is near 1, and the film is nearly the harmonic function
# with the same values on the frame: that is the guess.


# %%
def film(V: fem.FunctionSpace, g) -> tuple[fem.Function, float, list[float]]:
    """Return the film in the frame g, the area of the first guess, and the residuals of all iterates."""
    msh = V.mesh
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    frame = fem.dirichletbc(g(ufl.SpatialCoordinate(msh)), fem.boundary_dofs(V), V)
    uh = LinearProblem(
        poisson.a(u, v), poisson.L(fem.Constant(msh, 0.0), v), bcs=[frame], petsc_options_prefix="guess_"
    ).solve()
    first = area(uh)
    problem = NonlinearProblem(minimal_surface.F(uh, v), uh, bcs=[frame], petsc_options_prefix="film_")
    problem.solve()
    uh.name = "height"
    return uh, first, problem.norms


def area(uh: fem.Function) -> float:
    return parallel.total(comm, fem.assemble_scalar(fem.form(minimal_surface.area(uh))))


# %% [markdown]
# ## Scherk's surface
#
# Heinrich Scherk found a minimal surface in 1834 that is a graph over a square, $u = \log(\cos x / \cos y)$. At
# $x, y = \pm \pi / 2$ it goes up and down to infinity; we stay inside, $|x|, |y| \le 1.2$. Cubics have fourth order in
# $L^2$, whether the problem is linear or not.


# %%
def scherk(x):
    return ufl.ln(ufl.cos(x[0]) / ufl.cos(x[1]))


errors = []
V = fem.functionspace(generators.rectangle((4, 4), (-1.2, -1.2), (1.2, 1.2), comm=comm), ("THCCS", 3))
for step in range(min(steps, 4)):
    V = adapt.refine(V, np.arange(V.num_functions)) if step else V
    uh, _, norms = film(V, scherk)
    errors.append(estimate.norm(V, estimate.error(uh, scherk)))
    residuals = ", ".join(f"{norm:.0e}" for norm in norms)
    print(f"{V.num_dofs:4d} dofs: error {errors[-1]:.1e}, residuals {residuals}")

# %% [markdown]
# The residuals show Newton's method: each iterate has about twice as many digits as the one before.
#
# ## A film in a bent ring
#
# The frame is a ring that goes up and down three times, $g = \frac{1}{2} \cos 3 \theta$. The graph of the harmonic
# function, $\frac{1}{2} r^3 \cos 3 \theta$, has 30 % more area than the flat disc, and that of the film has a little
# less.

# %%
V = fem.functionspace(generators.disc(4 if steps > 3 else 2, comm=comm), ("THCCS", 3))
V = adapt.refine(V, np.arange(V.num_functions))


def ring(x):
    return 0.5 * (4 * x[0] ** 3 - 3 * x[0] * (x[0] ** 2 + x[1] ** 2))  # r^3 cos(3 theta) / 2


uh, harmonic_area, norms = film(V, ring)
film_area = area(uh)
disc_area = area(fem.Function(V))
print(f"area of the disc {disc_area:.4f}, of the harmonic graph {harmonic_area:.4f}, of the film {film_area:.4f}")
print(f"{len(norms) - 1} iterations")
plot.plot(uh, out / "minimal_surface.png", warp=1.0, camera=(0.5, -1.6, 1.6), cmap="coolwarm")
print(f"Wrote {out / 'minimal_surface.png'}")

# %% [markdown]
# **Try next**: a higher ring, until the film would hang over and is no graph any more; a film that is blown up by
# pressure, `minimal_surface.F(uh, v, f)`, which gives spheres; the residual estimator with
# `minimal_surface.strong_residual`.
#
# ## Check

# %%
order = np.log2(np.array(errors[:-1]) / errors[1:])
print("orders:", *(f"{r:.2f}" for r in order))
assert 3.3 < order[-1] < 4.3, order
assert errors[2] < 7e-5
assert disc_area < film_area < harmonic_area
assert len(norms) - 1 <= 6
