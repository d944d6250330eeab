# ---
# jupyter:
#   jupytext:
#     text_representation:
#       format_name: percent
# ---

# %% [markdown]
# # Two phases and a mesh that follows their fronts
#
# A mixture of two substances that would rather be by themselves unmixes: first everywhere, then ever more slowly, as
# small drops dissolve and large ones grow. With $u$ from -1 (all the one) to 1 (all the other), Cahn and Hilliard wrote
#
# $$ \partial_t u = \Delta_\Gamma \mu, \qquad \mu = W'(u) - \epsilon^2 \Delta_\Gamma u, \qquad
#    W(u) = \tfrac14 (u^2 - 1)^2 , $$
#
# here on a surface $\Gamma$ of genus 3. Nothing is lost, so $\int_\Gamma u$ stays what it is, and the free energy
#
# $$ E(u) = \int_\Gamma \tfrac{\epsilon^2}{2} |\nabla_\Gamma u|^2 + W(u) $$
#
# falls. The equation is of fourth order. Continuous elements need $\mu$ as a second unknown; our functions are $C^1$,
# and the weak form for $u$ alone will do (Gomez, Calo, Bazilevs and Hughes, 2008):
#
# $$ \int_\Gamma \partial_t u\, v + W''(u) \nabla_\Gamma u \cdot \nabla_\Gamma v
#    + \epsilon^2 \Delta_\Gamma u\, \Delta_\Gamma v = 0 \quad \text{for all } v . $$
#
# Between the phases $u$ goes like $\tanh(x / \sqrt 2 \epsilon)$. A front must be resolved, some cells of size
# $\epsilon$ across; inside the phases nothing happens. And fronts move. So the mesh has to refine where they go, *and
# to coarsen where they have been*: else all of the surface would be fine in the end.

# %%
import os
import sys
from pathlib import Path

from mpi4py import MPI

import numpy as np
from matplotlib.figure import Figure
from matplotlib.image import imread

import ufl
from thccs_fem import adapt, fem, generators, plot
from thccs_fem.fem.petsc import TimeProblem
from thccs_fem.forms import cahn_hilliard

steps = int(os.environ.get("STEPS", "45"))
out = Path("out")
out.mkdir(exist_ok=True)

comm = MPI.COMM_WORLD
if comm.rank > 0:
    sys.stdout = None  # rank 0 prints for all

epsilon = 0.1
msh = generators.genus3(levels=0, comm=comm)
V = fem.functionspace(msh, ("THCCS", 3), cap_level=8)
print(f"{msh}\n{V}")

# %% [markdown]
# The control mesh has 48 faces, so coarse that a front would be lost in one of them. Second derivatives want small caps
# at the four extraordinary vertices, hence `cap_level` (see `docs/fourth_order.md`); and caps that stay where they are
# when the mesh changes, so that all spaces are on the same surface.
#
# ## How much does $u$ change across a cell?
#
# A cell of size $h$ has the area $h^2$, so that $\lVert \nabla u \rVert_{L^2(K)}$ is $h$ times the mean slope: the
# change of $u$ from one side of $K$ to the other. That is all the indicator we need (gradients have led meshes to
# fronts since Provatas, Goldenfeld and Dantzig, 1998). In the middle of a front the slope is $1 / (\sqrt 2 \epsilon)$,
# so that a change of at most 0.7 means $h \le \epsilon$.
#
# Functions are refined whose supports cover the cells where $u$ changes by more. Cells go where it changes by less than
# a third of that: their parents, twice as wide, will still be below the limit, and are not refined again in the next
# step.

# %%
most = 0.7


def changes(u: fem.Function) -> np.ndarray:
    """Return by how much u changes across each cell."""
    return np.sqrt(fem.assemble_cells(fem.form(ufl.inner(ufl.grad(u), ufl.grad(u)) * ufl.dx)))


def remeshed(u: fem.Function) -> fem.FunctionSpace:
    """Return the space with a mesh as u needs it."""
    V, change = u.function_space, changes(u)
    large = (change > most).astype(float)
    return adapt.remesh(V, adapt.mark(V, large, theta=1.0), change < most / 3)


# %% [markdown]
# ## From one space to the next
#
# `adapt.transfer` carries $u$ over: exactly where the mesh was refined, by an $L^2$ projection where it was coarsened
# (as Hennig, Ambati, De Lorenzis and Kästner did for such problems, 2018). Constants are in the space, so that the
# projection keeps the integral of $u$.
#
# On a curved surface there is a catch. Areas of bicubic patches are integrals of square roots. Quadrature errs there by
# a little, on other cells by something else, and so the same function has another integral after each change of mesh.
# Here that is up to a millionth, but it would add up. A constant, added to the function, gives it back: that is
# `conserve=True`.


# %%
def integral(u: fem.Function) -> float:
    return comm.allreduce(fem.assemble_scalar(fem.form(u * ufl.dx)))


def carried(u: fem.Function, V: fem.FunctionSpace) -> fem.Function:
    """Return u in V with the same integral."""
    return adapt.transfer(u, V, conserve=True)


# %% [markdown]
# ## The start
#
# Each vertex of the control mesh is given one of the substances by chance, with odds of three to one. The mesh is
# refined for this $u$ before anything moves.

# %%
u = fem.Function(V, name="u")
values = np.random.default_rng(1).choice([1.0, -1.0], V.num_dofs, p=[0.75, 0.25])
u.x.array = values[V.index_map.numbers]  # of the dofs that this rank holds
while (V := remeshed(u)) is not u.function_space:
    u = carried(u, V)
print(V)

# %% [markdown]
# ## Time
#
# Unmixing is quick at first and slows down as drops grow: each step is longer than the one before, up to a limit. When
# a drop vanishes, things are quick again: where Newton's method finds no solution, a quarter of the step will do. After
# every second one comes a new mesh, which costs about as much as a step. `with_space` makes the problem that goes on
# there. It carries over the last state and the one before, so that BDF2 does not have to start anew.

# %%
udot, v = fem.Function(V), ufl.TestFunction(V)
problem = TimeProblem(
    cahn_hilliard.F(u, udot, v, epsilon),
    u,
    udot,
    dt=0.02,
    scheme="bdf2",
    petsc_options_prefix="cahn_hilliard_",
    petsc_options={"snes_rtol": 1e-6},
)


def energy(u: fem.Function) -> float:
    return comm.allreduce(fem.assemble_scalar(fem.form(cahn_hilliard.energy(u, epsilon))))


times, dofs, masses = [0.0], [V.num_dofs], [integral(u)]
lost, gained = [], []  # energy, by each step and by each change of space
before = energy(u)
seen = {0: (0.0, u.copy())}
for number in range(1, steps + 1):
    try:
        u = problem.step()
    except RuntimeError:
        problem.dt /= 4
        u = problem.step()
    after = energy(u)
    lost.append(before - after)
    before = after
    if number % 2 == 0 and (V := remeshed(u)) is not u.function_space:
        problem = problem.with_space(V, carried)
        u = problem.u
        before = energy(u)
        gained.append(before - after)
    times.append(problem.time)
    dofs.append(V.num_dofs)
    masses.append(integral(u))
    if number in (steps // 3, steps):
        seen[number] = (problem.time, u.copy())
    if number % 5 == 0:
        print(f"t = {problem.time:6.3f}: energy {before:.4f}, {V.num_dofs} dofs on {V.num_levels} levels")
    problem.dt = min(1.1 * problem.dt, 0.6)

# %% [markdown]
# ## How many unknowns that takes
#
# A uniform mesh with cells as small as the smallest ones here is the control mesh subdivided as often as these are:
# 12284 dofs, against some 3200. How many there are follows the length of the fronts, and falls with it.

# %%
finest = max(state.function_space.num_levels for _, state in seen.values()) - 1
uniform = fem.functionspace(generators.genus3(finest, comm=comm), ("THCCS", 3)).num_dofs
print(f"uniform: {uniform} dofs; here {min(dofs)} to {max(dofs)}, on average {np.mean(dofs):.0f}")

width = 1800 if steps > 10 else 600
figure = Figure(figsize=(13, 8.2), layout="constrained")
places = figure.subplots(2, 2).flat
for axes, (number, (time, state)) in zip(places, seen.items(), strict=False):
    file = out / f"cahn_hilliard_{number}.png"
    plot.plot(state, file, clim=(-1.5, 1.5), cmap="RdBu_r", window_size=(width, 16 * width // 25))
    picture = imread(file)[:, : 17 * width // 20]  # without the colour bar
    rows, columns = (np.flatnonzero((picture[..., :3] < 1.0).any(axis=(axis, 2))) for axis in (1, 0))
    axes.imshow(picture[rows[0] : rows[-1], columns[0] : columns[-1]])
    axes.set_title(f"t = {time:.2f}: {state.function_space.num_dofs} dofs")
    axes.set_axis_off()
axes = figure.axes[3]
axes.loglog(times[1:], dofs[1:], label="mesh that follows the fronts")
axes.axhline(uniform, color="grey", linestyle="--", label="uniform mesh of the same resolution")
axes.set(xlabel="t", ylabel="dofs", ylim=(100, 2 * uniform))
axes.legend(loc="lower right")
if comm.rank == 0:
    figure.savefig(out / "cahn_hilliard.png", dpi=130)
print(f"Wrote {out / 'cahn_hilliard.png'}")

# %% [markdown]
# **Try next**: equal shares of both substances, `p=[0.5, 0.5]`, which make stripes instead of drops; half the
# `epsilon`, for which fronts of the same length take twice as many cells here, and a uniform mesh four times;
# `STEPS=80`, for the end of the drop on the left.
#
# ## Check
#
# The integral of $u$ is that of the start, to rounding. Each step loses energy. The projection is the nearest function
# in L2, not the one with the least energy, and adds some: in all less than a hundredth of what the steps lose.

# %%
drift = np.abs(np.array(masses) / masses[0] - 1.0).max()
print(f"integral kept to {drift:.1e}")
print(f"energy lost in steps {sum(lost):.4f}, gained by changes of space {sum(gained):.1e}")
assert drift < 1e-12
assert min(lost) > 0.0
assert sum(map(abs, gained)) < 0.01 * sum(lost)
assert np.mean(dofs) < 0.6 * uniform
