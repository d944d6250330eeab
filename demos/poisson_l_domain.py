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
from matplotlib.figure import Figure

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
# ## Solve
#
# `l_domain` tags its six corners, so that the smooth surface has them too.

# %%
msh = generators.l_domain(4, comm=comm)
f = fem.Constant(msh, 1.0)


def solve(V: fem.FunctionSpace) -> fem.Function:
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    frame = fem.dirichletbc(0.0, fem.boundary_dofs(V), V)
    problem = LinearProblem(poisson.a(u, v), poisson.L(f, v), bcs=[frame], petsc_options_prefix="membrane_")
    uh = problem.solve()
    uh.name = "u"
    return uh


# %% [markdown]
# ## Estimate
#
# With Lagrange elements a residual estimator has two parts, the residual in the cells and the jumps of the flux between
# them, and the jumps are the larger part. Here the functions are $C^1$: there are no jumps, and with $h_K$ the root
# of the cell's area one line is all,
#
# $$ \eta_K = h_K \, \lVert 1 + \Delta u_h \rVert_{L^2(K)} . $$


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
# graded towards the six corners. `adapt.solve` never hears of it.

# %%
ENERGY = 0.2140758026865


def energy(uh: fem.Function) -> float:
    return parallel.total(comm, fem.assemble_scalar(fem.form(poisson.a(uh, uh))))


def with_energy(uh: fem.Function) -> np.ndarray:
    energies.append(energy(uh))
    return residual(uh)


energies: list[float] = []
V = fem.functionspace(msh, ("THCCS", 3))
history = adapt.solve(V, solve, with_energy, steps=steps, strategy="dorfler", theta=0.5)
print(history)
dofs = np.array([step.dofs for step in history.steps])
error = np.sqrt(ENERGY - np.array(energies))
estimated = np.array([step.estimate for step in history.steps])

# %% [markdown]
# The same with uniform refinement: each step makes four times as many dofs, and the error falls by a third in the end.

# %%
uniform = []
for _ in range(min(steps, 4)):
    uh = solve(V)
    uniform.append((V.num_dofs, np.sqrt(ENERGY - energy(uh))))
    V = adapt.refine(V, np.arange(V.num_functions))
print("dofs", *(f"{n:.0f}" for n, _ in uniform), "error", *(f"{e:.1e}" for _, e in uniform))

# %% [markdown]
# ## Pictures
#
# The membrane with the cells of the last mesh: refined towards the reentrant corner down to cells that no picture
# shows, a little at the other corners, and hardly inside.

# %%
uh = history.solution
assert uh is not None
plot.plot(uh, out / "l_domain_mesh.png", warp=2.0, camera=(1.0, 1.4, 2.4))

figure = Figure(figsize=(7, 5), layout="constrained")
axes = figure.subplots()
axes.loglog(dofs, estimated, ".:", color="tab:orange", label="estimate, adaptive")
axes.loglog(dofs, error, ".-", color="tab:blue", label="error, adaptive")
axes.loglog(*np.transpose(uniform), ".--", color="tab:red", label="error, uniform")
axes.loglog(dofs, error[-1] * (dofs / dofs[-1]) ** -1.5, color="grey", lw=0.8, label="dofs$^{-3/2}$")
axes.set(xlabel="dofs", ylabel="energy norm", title="A membrane over an L: cubic splines at their full rate")
axes.legend()
if parallel.rank_of(comm) == 0:
    figure.savefig(out / "l_domain_convergence.png", dpi=150)
print(f"Wrote {out / 'l_domain_mesh.png'} and {out / 'l_domain_convergence.png'}")

# %% [markdown]
# The estimate is 4 to 6 times the error, all along. The adaptive run keeps up with dofs$^{-3/2}$, the rate of cubic
# splines for smooth functions, and is ahead of it as long as a few dofs at the corner take away most of the error;
# uniform refinement is left with the dofs$^{-1/3}$ of the singularity.
#
# **Try next**: `strategy="maximum"`; `estimate.bubble(uh, a, L)`, which comes nearer to the error; a frame without
# the tag at the reentrant corner, whose limit is rounded off there.
#
# ## Check

# %%
assert all(np.diff(energies) > 0)  # nested spaces: the energy rises to that of the solution
effectivity = estimated / error
assert 3 < effectivity.min(), effectivity
assert effectivity.max() < 7, effectivity
if steps >= 20:
    rate = -np.polyfit(np.log(dofs[10:]), np.log(error[10:]), 1)[0]
    print(f"rate of the energy error in dofs: {rate:.2f}")
    assert 1.5 < rate < 3.5, rate
    assert error[-1] < 1e-4
