# ---
# jupyter:
#   jupytext:
#     text_representation:
#       format_name: percent
# ---

# %% [markdown]
# # Adaptive refinement without knowing the solution
#
# A membrane over an L-shaped frame, pressed down evenly:
#
# $$ -\Delta u = 1 \text{ on } \Omega = [-1, 1]^2 \setminus \{x, y > 0\}, \qquad u = 0 \text{ on } \partial\Omega . $$
#
# At the reentrant corner $u$ behaves like $r^{2/3}$: its gradient is infinite there. No formula is known for $u$, so
# the mesh cannot be refined where the *error* is large. It is refined where the *residual* is: what is left of the
# equation when the approximation is put into it.

# %%
import os
import sys
from pathlib import Path

import numpy as np

import ufl
from thccs_fem import adapt, estimate, fem, generators, parallel, plot
from thccs_fem.forms import poisson

try:
    from mpi4py import MPI

    from thccs_fem.fem.petsc import LinearProblem

    comm = MPI.COMM_WORLD
except ImportError:  # no PETSc here: the same problem, solved by SciPy
    from thccs_fem.fem.scipy import LinearProblem

    comm = None

if parallel.rank_of(comm) > 0:
    sys.stdout = None  # rank 0 prints for all
steps = int(os.environ.get("STEPS", "20"))
out = Path("out")
out.mkdir(exist_ok=True)

# %% [markdown]
# ## The problem
#
# `l_domain` tags its six corners, so that the smooth surface has them too. What is to be solved is a function of the
# space, as it will be solved in one after the other.

# %%
msh = generators.l_domain(4, comm=comm)
f = fem.Constant(msh, 1.0)


def membrane(V: fem.FunctionSpace) -> LinearProblem:
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    frame = fem.dirichletbc(0.0, fem.boundary_dofs(V), V)
    return LinearProblem(
        poisson.a(u, v), poisson.L(f, v), bcs=[frame], u=fem.Function(V, "u"), petsc_options_prefix="membrane_"
    )


# %% [markdown]
# ## Estimate
#
# With Lagrange elements a residual estimator has two parts, the residual in the cells and the jumps of the flux between
# them, and the jumps are the larger part. Here the functions are $C^1$: there are no jumps, and with $h_K$ the root
# of the cell's area one line is all,
#
# $$ \eta_K = \tfrac{1}{\sqrt{42}} h_K \, \lVert 1 + \Delta u_h \rVert_{L^2(K)} . $$
#
# The number is that for which cubic splines on a line have exactly this error. (In the cells at the corner, where
# $\Delta u_h$ is not square-integrable, `estimate.residual` takes for $h_K$ what gets smaller towards it.)


# %%
def residual(uh: fem.Function) -> np.ndarray:
    return estimate.residual(uh, poisson.strong_residual(uh, f))


# %% [markdown]
# ## How good is it?
#
# The error in the energy norm needs no formula for $u$: since $u_h$ is the best approximation of $u$,
#
# $$ \lVert \nabla (u - u_h) \rVert^2 = \lVert \nabla u \rVert^2 - \lVert \nabla u_h \rVert^2, $$
#
# and $\lVert \nabla u \rVert^2$ is one number. We computed it once by other means: Lagrange triangles of degree 8,
# graded towards the six corners.
#
# `adapt.solve` does all: solve, estimate, mark the functions whose supports carry half of the estimate, refine them,
# and again. It never hears of the true error. That comes from a callback, which sees each step and may add numbers to
# the table.

# %%
ENERGY = 0.2140758026865


def energy(step: adapt.Step, uh: fem.Function) -> dict[str, float]:
    energy = parallel.total(comm, fem.assemble_scalar(fem.form(poisson.a(uh, uh))))
    return {"energy": energy, "error": np.sqrt(ENERGY - energy)}


V = fem.functionspace(msh, ("THCCS", 3))
history = adapt.solve(V, membrane, residual, stop=adapt.Stop(steps=steps), callback=energy)
print(history)

# %% [markdown]
# The same with uniform refinement: each step makes four times as many dofs, and the error falls by a third in the end.

# %%
stop = adapt.Stop(steps=min(steps, 3))
uniform = adapt.solve(V, membrane, residual, marking=adapt.uniform, stop=stop, callback=energy)
print(uniform)

# %% [markdown]
# ## Pictures
#
# The membrane with the cells of the last mesh: refined towards the reentrant corner down to cells that no picture
# shows, a little at the other corners, and hardly inside.

# %%
plot.plot(history.solution, out / "l_domain_mesh.png", warp=2.0, camera=(1.0, 1.4, 2.4))
plot.convergence(
    {"adaptive": history, "uniform": uniform},
    out / "l_domain_convergence.png",
    columns=("estimate", "error"),
    slopes=(1.5,),
    title="A membrane over an L: cubic splines at their full rate",
)
print(f"Wrote {out / 'l_domain_mesh.png'} and {out / 'l_domain_convergence.png'}")

# %% [markdown]
# The estimate is 0.4 to 0.8 of the error, all along. The adaptive run keeps up with dofs$^{-3/2}$, the rate of cubic
# splines for smooth functions, and is ahead of it as long as a few dofs at the corner take away most of the error;
# uniform refinement is left with the dofs$^{-1/3}$ of the singularity.
#
# **Try next**: `marking=adapt.Marking("maximum")`; `estimate.bubble(uh, a, L)`, which is never larger than the error;
# a frame without the tag at the reentrant corner, whose limit is rounded off there.
#
# ## Check

# %%
assert all(np.diff(history["energy"]) > 0)  # nested spaces: the energy rises to that of the solution
effectivity = history["estimate"] / history["error"]
assert 0.4 < effectivity.min(), effectivity
assert effectivity.max() < 0.9, effectivity
if steps >= 20:
    rate = history.rate("error", last=len(history.steps) - 10)
    print(f"rate of the energy error in dofs: {rate:.2f}")
    assert 1.5 < rate < 3.5, rate
    assert history["error"][-1] < 1e-4
