# ---
# jupyter:
#   jupytext:
#     text_representation:
#       format_name: percent
# ---

# %% [markdown]
# # The smoothest function through scattered values
#
# Something has been measured at points $x_1, \dots, x_n$ of a surface, anywhere and in no order. What is it in between?
# A draughtsman would take a thin strip of wood, hold it fast at the points, and let it bend as little as it can. On a
# surface $\Gamma$ that is: of all functions with $u(x_i) = d_i$ take the one with the least *bending energy*
#
# $$ \frac{1}{2} \int_\Gamma (\Delta_\Gamma u)^2 . $$
#
# It satisfies $\Delta_\Gamma^2 u = -\sum_i \lambda_i \delta_{x_i}$, the biharmonic equation with the forces at the
# points that hold it. Its weak form, as it stands, is for functions in $H^2$; ours are.

# %%
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyvista
import scipy.sparse as sp
import scipy.sparse.linalg as spla

import ufl
from thccs_fem import adapt, estimate, fem, generators, limit, plot
from thccs_fem.forms import biharmonic, laplace_beltrami

steps = int(os.environ.get("STEPS", "5"))
out = Path("out")
out.mkdir(exist_ok=True)

# %% [markdown]
# ## One matrix of energies, one of values
#
# The row $i$ of `fem.point_values` has the values of all functions at $x_i$. Call this matrix $B$ and that of the
# bilinear form $A$. The least of $\frac{1}{2} u^T A u$ under $B u = d$ is where
#
# $$ \begin{pmatrix} A & B^T \\ B & 0 \end{pmatrix} \begin{pmatrix} u \\ \lambda \end{pmatrix}
#    = \begin{pmatrix} 0 \\ d \end{pmatrix} . $$
#
# $A$ alone is singular, since constants do not bend; one point is enough to fix them. But no more points can be met
# than there are functions around them: have several cells to a point. `energy` is `biharmonic.a`, or another form to
# compare with.


# %%
def smoothest(V: fem.FunctionSpace, faces, uv, data, energy: Callable = biharmonic.a) -> tuple[fem.Function, float]:
    """Return the function through the data at points of the surface with the least energy, and twice this energy."""
    A = fem.assemble_matrix(fem.form(energy(ufl.TrialFunction(V), ufl.TestFunction(V))))
    B = fem.point_values(V, faces, uv)
    saddle = sp.block_array([[A, B.T], [B, None]], format="csc")
    solution = spla.spsolve(saddle, np.concatenate([np.zeros(V.num_dofs), data]))
    uh = fem.Function(V, name="u")
    uh.x.array, forces = np.split(solution, [V.num_dofs])
    return uh, float(-forces @ data)


# %% [markdown]
# ## How good is it?
#
# We take the values of a smooth function at points of a sphere and see what comes back. The points are spread out:
# among many by chance each is the one farthest from those before, so that more points are always some points more.
# The distance between neighbours is of the order $n^{-1/2}$.


# %%
def spread(msh, n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return faces, coordinates in them and positions of n points, each far from those before."""
    faces, uv = rng.integers(msh.num_faces, size=20 * n), rng.random((20 * n, 2))
    x = limit.evaluate(msh, faces, uv)[0]
    chosen, distance = [0], np.full(20 * n, np.inf)
    while len(chosen) < n:
        distance = np.minimum(distance, np.linalg.norm(x - x[chosen[-1]], axis=1))
        chosen.append(int(distance.argmax()))
    return faces[chosen], uv[chosen], x[chosen]


def smooth(x, m=ufl):
    return m.sin(2 * x[0] + 1) * m.cos(1.5 * x[1]) * m.exp(x[2] / 2)


# %% [markdown]
# Equations of fourth order want deep caps at extraordinary vertices, as docs/fourth_order.md says: `cap_level=8`. Each
# time there are twice as many points the error falls to a quarter, so it is of the fourth order in their distance. The
# energy rises, since more points are more conditions, but never above that of the function we look for.

# %%
msh = generators.interpolated(generators.cube_sphere(24 if steps > 3 else 16))
V = fem.functionspace(msh, ("THCCS", 3), cap_level=8)
original = fem.project(smooth(ufl.SpatialCoordinate(msh)), V)
own_energy = fem.assemble_scalar(fem.form(biharmonic.a(original, original)))

numbers = 30 * 2 ** np.arange(max(steps, 2))
faces, uv, x = spread(msh, numbers[-1], np.random.default_rng(1))
errors, energies, misses = [], [], []
for n in numbers:
    uh, twice_energy = smoothest(V, faces[:n], uv[:n], smooth(x[:n].T, np))
    misses.append(np.abs(uh.eval(faces[:n], uv[:n]) - smooth(x[:n].T, np)).max())
    errors.append(estimate.norm(V, estimate.error(uh, smooth)))
    energies.append(twice_energy / 2)
    print(f"{n:3d} points: error {errors[-1]:.1e}, energy {energies[-1]:6.2f}, data missed by {misses[-1]:.0e} at most")
print(f"energy of the function itself: {own_energy / 2:.2f}")

# %% [markdown]
# ## Why not the gradient?
#
# The energy of a stretched membrane, $\frac{1}{2} \int |\nabla_\Gamma u|^2$, is simpler. But a point does not hold a
# membrane: it gives way without limit, $u \sim \log r$ at the distance $r$. A needle costs next to nothing if it is
# thin enough, so what is least in the end is a constant with needles at the points. The finer the mesh, the worse,
# if slowly. By bending, the function hardly depends on the mesh.

# %%
W = fem.functionspace(generators.interpolated(generators.cube_sphere(8)), ("THCCS", 3), cap_level=8)
faces, uv, x = spread(W.mesh, 60, np.random.default_rng(1))
bent, stretched = [], []
for level in range(3 if steps > 3 else 2):
    W = adapt.refine(W, np.arange(W.num_functions)) if level else W
    for found, energy in ((bent, biharmonic.a), (stretched, laplace_beltrami.a)):
        uh, twice_energy = smoothest(W, faces, uv, smooth(x.T, np), energy)
        found.append((estimate.norm(W, estimate.error(uh, smooth)), twice_energy / 2))
    print(
        f"60 points, {W.num_dofs:4d} dofs: error {bent[-1][0]:.3f} by bending (energy {bent[-1][1]:.2f}), "
        f"{stretched[-1][0]:.3f} by stretching (energy {stretched[-1][1]:.2f})"
    )

# %% [markdown]
# ## On a surface with three holes
#
# Now 120 points that are really scattered, some of them close together. The balls have the colours of the data: above
# with the least bending, where they hardly stand out from what is around them, and below the membrane, whose hills are
# needles at the points.

# %%
msh = generators.genus3(levels=3 if steps > 3 else 2)
V = fem.functionspace(msh, ("THCCS", 3), cap_level=8)
rng = np.random.default_rng(5)
faces, uv = rng.integers(msh.num_faces, size=120), rng.random((120, 2))
x = limit.evaluate(msh, faces, uv)[0]
data = smooth(x.T, np)
bent_surface = smoothest(V, faces, uv, data)[0]
membrane = smoothest(V, faces, uv, data, laplace_beltrami.a)[0]
missed = np.abs(bent_surface.eval(faces, uv) - data).max()

TOWARDS = np.array([0.3, -0.8, 1.0])  # the viewer
colours = {"clim": (-1.2, 1.2), "cmap": "RdYlBu_r", "n_colors": 24, "show_scalar_bar": False}
with pyvista.vtk_verbosity("off"):  # it would complain where there is no display
    plotter = pyvista.Plotter(off_screen=True, shape=(2, 1), border=False, window_size=(1400, 1300))
    plotter.set_background("white")
    plotter.enable_anti_aliasing("ssaa")
    for row, function in enumerate((bent_surface, membrane)):
        plotter.subplot(row, 0)
        plotter.add_mesh(plot.surface(function), scalars="u", ambient=0.4, diffuse=0.65, smooth_shading=True, **colours)
        for radius, lift, style in ((0.075, 0.0, {"color": "black"}), (0.06, 0.03, {"scalars": "data", **colours})):
            points = pyvista.PolyData(x + lift * TOWARDS)
            points["data"] = data
            balls = points.glyph(orient=False, scale=False, geom=pyvista.Sphere(radius=radius))
            plotter.add_mesh(balls, lighting=False, **style)
        plotter.enable_parallel_projection()
        plotter.view_vector(TOWARDS, viewup=(0, 0, 1))
        plotter.camera.zoom(2.0)
    plotter.screenshot(out / "scattered_data.png")
    plotter.close()
print(f"Wrote {out / 'scattered_data.png'}")

# %% [markdown]
# **Try next**: values that are not exact, for which one should not go through the points but minimise
# $\frac{1}{2} u^T A u + \frac{1}{2 \alpha} |B u - d|^2$, a system with $A + B^T B / \alpha$; a part of both energies, a
# *spline in tension*; points close together in a space that is refined there by `adapt.refine`.
#
# ## Check
#
# The data are met to rounding. The error falls with the second power of the number of points. Each set of points
# contains the one before, so energies rise, and stay below that of the function. Of the membrane the error grows as
# its energy falls.

# %%
assert max(*misses, missed) < 1e-10
rate = np.log2(errors[0] / errors[-1]) / np.log2(numbers[-1] / numbers[0])
print(f"the error falls like n^-{rate:.2f}")
assert 1.5 < rate < 2.5, rate
assert (np.diff(energies) > 0).all()
assert energies[-1] < own_energy / 2
assert abs(bent[-1][0] / bent[-2][0] - 1) < 0.1
assert stretched[-1][0] > 1.2 * stretched[-2][0] > 5 * bent[-1][0]
assert stretched[-1][1] < stretched[-2][1]
