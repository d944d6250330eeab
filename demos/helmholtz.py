# ---
# jupyter:
#   jupytext:
#     text_representation:
#       format_name: percent
# ---

# %% [markdown]
# # Waves: how many unknowns a wavelength?
#
# Sound of one frequency in a room, or a water wave in a basin, satisfies the Helmholtz equation
#
# $$ -\Delta u - k^2 u = f, $$
#
# with $k$ the wave number and $2 \pi / k$ the wavelength. Two things make it hard: the form is *indefinite*, so
# that conjugate gradients break down, and the discrete wave travels a little too slowly, an error that piles up over
# many wavelengths (pollution). Elements of low degree pay for that with dozens of unknowns a wavelength. Smooth cubics
# need few.

# %%
import os
from pathlib import Path

import numpy as np

import ufl
from thccs_fem import adapt, estimate, fem, generators, plot
from thccs_fem.forms import helmholtz

try:
    from mpi4py import MPI  # noqa: F401  # petsc4py wants it loaded

    from thccs_fem.fem.petsc import LinearProblem
except ImportError:  # no PETSc here: the same problem, solved by SciPy
    from thccs_fem.fem.scipy import LinearProblem

steps = int(os.environ.get("STEPS", "4"))
out = Path("out")
out.mkdir(exist_ok=True)

# %% [markdown]
# ## A plane wave
#
# On $[0, 1]^2$ take $u = \cos(\mathbf k \cdot \mathbf x)$, prescribed on the boundary, with $|\mathbf k| = 40$: that
# is 6.4 wavelengths along a side, and 9 along the diagonal. The wave that fits best, the $L^2$ projection, shows
# what the space could do; the difference between both is pollution. Small problems are factorised, so an indefinite
# matrix needs no care.

# %%
k = 40.0
direction = np.array([np.cos(0.5), np.sin(0.5)])


def plane_wave(V: fem.FunctionSpace) -> tuple[float, float]:
    """Return the relative L2 errors of the Galerkin solution and of the projection."""
    msh = V.mesh
    x = ufl.SpatialCoordinate(msh)
    exact = ufl.cos(k * (direction[0] * x[0] + direction[1] * x[1]))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    problem = LinearProblem(
        helmholtz.a(u, v, k),
        helmholtz.L(fem.Constant(msh, 0.0), v),
        bcs=[fem.dirichletbc(exact, fem.boundary_dofs(V), V)],
        petsc_options_prefix="wave_",
    )
    size = np.sqrt(fem.assemble_scalar(fem.form(exact**2 * ufl.dx, quadrature_degree=11, on=V)))
    found = (problem.solve(), fem.project(exact, V))
    return tuple(estimate.norm(V, estimate.error(uh, exact)) / size for uh in found)


rows = []
for n in (8, 16, 32, 64)[:steps]:
    V = fem.functionspace(generators.rectangle((n, n)), ("THCCS", 3))
    rows.append((2 * np.pi / k * n, *plane_wave(V)))
    print("{:4.1f} cells a wavelength: error {:.1e}, of the projection {:.1e}".format(*rows[-1]))

# %% [markdown]
# With three cells a wavelength the coarse wave is out of step; with five, which are five unknowns in each direction,
# the error is that of the projection, to a third, and falls with fourth order from there. Pollution is a matter of
# coarse meshes.
#
# ## A room
#
# A room in the shape of an L with rigid walls: $\nabla u \cdot n = 0$, which is the natural condition and needs no
# line of code. In one arm is a small source of sound, 13 wavelengths from the end of the other one. There is sound in
# both: waves go around the reentrant corner, where the solution is singular, like $r^{2/3}$. So the mesh, with five
# cells a wavelength to begin with, is refined there, and at the source.

# %%
k_room = 30.0 if steps > 3 else 15.0
msh = generators.l_domain(int(0.8 * k_room))
x = ufl.SpatialCoordinate(msh)
place, width = (0.6, -0.7), 0.05
f = 1e3 * ufl.exp(-((x[0] - place[0]) ** 2 + (x[1] - place[1]) ** 2) / width**2)


def room(V: fem.FunctionSpace) -> LinearProblem:
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    a, L = helmholtz.a(u, v, k_room), helmholtz.L(f, v)
    return LinearProblem(a, L, u=fem.Function(V, "pressure"), petsc_options_prefix="room_")


solutions: list[fem.Function] = []
history = adapt.solve(
    fem.functionspace(msh, ("THCCS", 3)),
    room,
    lambda uh: estimate.residual(uh, helmholtz.strong_residual(uh, f, k_room)),
    stop=adapt.Stop(steps=steps + 3),
    callback=lambda step, uh: solutions.append(uh),
)
print(history)
before, uh = solutions[-2:]
before = adapt.transfer(before, uh.function_space)
size, changed = (fem.assemble_scalar(fem.form(w**2 * ufl.dx)) ** 0.5 for w in (uh, uh - before))
print(f"The last refinement changed the pressure by {100 * changed / size:.2f} %")
plot.plot(uh, out / "helmholtz.png", clim=(-4, 4), cmap="RdBu_r", lines=False)
print(f"Wrote {out / 'helmholtz.png'}")

# %% [markdown]
# **Try next**: a wall that gives way, `helmholtz.a(u, v, k, z=...)`; a frequency at which the room resonates by itself,
# where the matrix becomes singular; waves along a curved surface, with the same form.
#
# ## Check

# %%
cells, galerkin, projection = np.transpose(rows)
resolved = cells > 4
assert (galerkin[resolved] < 1.4 * projection[resolved]).all()
assert (galerkin[resolved] < 2.0 * cells[resolved] ** -4.0).all(), galerkin * cells**4
assert changed < 0.01 * size, changed / size
