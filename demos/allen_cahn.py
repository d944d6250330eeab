# ---
# jupyter:
#   jupytext:
#     text_representation:
#       format_name: percent
# ---

# %% [markdown]
# # Curves that shorten themselves
#
# A metal cools and orders itself in one of two ways, $u = 1$ here and $u = -1$ there. In between is a thin layer that
# costs energy, and the *Allen-Cahn equation* is the steepest way down,
#
# $$ \partial_t u = \Delta_\Gamma u - \frac{u^3 - u}{\varepsilon^2}
#    \qquad \text{for the energy} \qquad
#    E = \int_\Gamma \frac{|\nabla_\Gamma u|^2}{2} + \frac{(u^2 - 1)^2}{4 \varepsilon^2} . $$
#
# Across the layer $u$ is $\tanh(d / \sqrt 2 \varepsilon)$ at the distance $d$, and a unit of its length has the energy
# $2 \sqrt 2 / 3 \varepsilon$. So going down means to get shorter, and a curve gets shorter fastest by moving with the
# speed of its curvature. *Along a surface* that is the geodesic curvature $\kappa_g$: of a bend that comes from the
# surface alone the curve knows nothing. As $\varepsilon \to 0$ this becomes exact, and what can not move is a geodesic.

# %%
import math
import os
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.image import imread

import ufl
from thccs_fem import fem, generators, plot
from thccs_fem.fem.petsc import TimeProblem
from thccs_fem.forms import allen_cahn

steps = int(os.environ.get("STEPS", "4"))
out = Path("out")
out.mkdir(exist_ok=True)

# %% [markdown]
# ## A circle on a sphere
#
# The circle at the polar angle $\theta$ has $\kappa_g = \cot \theta$ and moves towards the pole, $\dot \theta = -\cot
# \theta$. Multiply by $-\sin \theta$:
#
# $$ \frac{d}{dt} \cos \theta = \cos \theta, \qquad \cos \theta = \cos \theta_0 \, e^t . $$
#
# It starts slowly and is gone when $\cos \theta = 1$; the equator, a geodesic, stays. The cap inside has the part
# $(1 - \cos \theta) / 2$ of the sphere, so the mean of $u$, 1 in the cap and $-1$ outside, is $-\cos \theta$: that is
# easy to measure. Since a layer is curved, the mean is not quite that, but $1 - \pi^2 \varepsilon^2 / 12$ times as
# much, for all $\theta$ alike. We start with the profile of a layer at 60 degrees and look at the factor by which
# $\cos \theta$ grows.
#
# The limit surface of `cube_sphere` is no exact sphere. `interpolated` makes its vertices points of the sphere, and
# what is left of the area's error is printed below. It would matter: on a sphere of radius $R$ all is $1 / R^2$ times
# as fast, and without `interpolated` $R^2$ would be too small by 1.4 % on the first of these meshes, 0.4 % on the last,
# about as much as the whole error that is left by then.

# %%
END = 0.4
start, end = 0.5, 0.5 * math.exp(END)


def circle(epsilon: float) -> tuple[int, float, list[float]]:
    """Return the number of dofs, the area of the surface, and minus the mean of u after every step."""
    msh = generators.interpolated(generators.cube_sphere(round(2 / epsilon)))
    V = fem.functionspace(msh, ("THCCS", 3))
    x = ufl.SpatialCoordinate(msh)
    polar = ufl.acos(x[2] / ufl.sqrt(ufl.inner(x, x)))
    u = fem.project(ufl.tanh((math.acos(start) - polar) / (math.sqrt(2) * epsilon)), V)
    udot, v = fem.Function(V), ufl.TestFunction(V)
    F = allen_cahn.F(u, udot, v, fem.Constant(msh, epsilon))
    problem = TimeProblem(F, u, udot, dt=epsilon / 10, petsc_options_prefix="circle_")
    area = fem.assemble_scalar(fem.form(fem.Constant(msh, 1.0) * ufl.dx))
    integral = fem.form(u * ufl.dx)
    means = [-fem.assemble_scalar(integral) / area]
    means += [-fem.assemble_scalar(integral) / area for _ in problem.steps(END)]
    return V.num_dofs, area, means


widths = 0.2 / math.sqrt(2) ** np.arange(max(steps - 1, 2))
profile, growth = [], []
for epsilon in widths:
    dofs, area, cosines = circle(epsilon)
    profile.append((1 - cosines[0] / start) / epsilon**2)
    growth.append(cosines[-1] / cosines[0] / math.exp(END) - 1)
    print(
        f"epsilon {epsilon:.3f}, {dofs:4d} dofs, area / 4 pi - 1 = {area / (4 * math.pi) - 1:.0e}: cos(theta) from "
        f"{cosines[0]:.4f} to {cosines[-1]:.4f}, grown by {cosines[-1] / cosines[0]:.4f}, exactly {math.exp(END):.4f}"
    )
order = np.log2(growth[0] / growth[-1]) / np.log2(widths[0] / widths[-1])
print(f"error in the growth: {', '.join(f'{g:.4f}' for g in growth)}, order {order:.2f} in epsilon")

# %% [markdown]
# ## From noise to geodesics
#
# Now a surface with three holes, and for a start nothing but noise: a random number for every dof. At once both phases
# form, then small patches vanish, boundaries straighten, and at last closed geodesics are left, each around a handle,
# where a curve can not shrink any more. Discs vanish: by the theorem of Gauss and Bonnet the boundary of a disc is a
# geodesic only if the Gaussian curvature inside has the integral $2 \pi$, that of half a sphere.
#
# Patches vanish within $\varepsilon^2$, geodesics are found within units of time. So PETSc shall choose the steps:
# options of a TS do that. How fast the boundaries move on average is $\int |\dot u| / \int |\nabla_\Gamma u|$, which is
# $|\kappa_g|$ on average.

# %%
msh = generators.genus3(levels=2)
V = fem.functionspace(msh, ("THCCS", 3))
width = fem.Constant(msh, 0.2)
u, udot, v = fem.Function(V, name="u"), fem.Function(V), ufl.TestFunction(V)
u.x.array = np.random.default_rng(3).uniform(-1.0, 1.0, V.num_dofs)
problem = TimeProblem(
    allen_cahn.F(u, udot, v, width),
    u,
    udot,
    dt=0.002,
    petsc_options_prefix="phases_",
    petsc_options={"ts_adapt_type": "basic", "ts_rtol": 1e-2, "ts_atol": 1e-2, "ts_adapt_dt_max": 0.2},
)


energy = fem.form(allen_cahn.energy(u, width))
velocity = fem.form(abs(udot) * ufl.dx), fem.form(ufl.sqrt(ufl.inner(ufl.grad(u), ufl.grad(u))) * ufl.dx)
unit_energy = 2 * math.sqrt(2) / (3 * float(width))

snapshots: list[tuple[float, np.ndarray]] = []
energies = [fem.assemble_scalar(energy)]
speed = math.inf
for until in (0.02, 0.1, 0.3, 1.0, 3.0, 20.0)[: 6 if steps > 3 else 2]:
    while problem.time < until and speed > 1e-3:
        problem.step()
        energies.append(fem.assemble_scalar(energy))
        moving, slope = map(fem.assemble_scalar, velocity)
        speed = moving / slope
    snapshots.append((problem.time, u.x.array.copy()))
    length = energies[-1] / unit_energy
    print(f"t = {problem.time:5.2f} after {problem.step_number:3d} steps: length {length:5.1f}, speed {speed:.4f}")

# %% [markdown]
# The first two lengths mean little, for there are no layers yet. Between $t = 1$ and $t = 3$ one phase gives up the
# junction on the left: a boundary around one arm is shorter than those that were there before.

# %%
figure = Figure(figsize=(12, 4.9), layout="constrained")
for axes, (time, values) in zip(figure.subplots(2, 3).flat, snapshots, strict=False):
    u.x.array = values
    plot.plot(u, out / "phase.png", clim=(-1, 1), cmap="RdBu_r", lines=False, window_size=(800, 512))
    picture = imread(out / "phase.png")[:, :680]  # without the colour bar
    rows, columns = (np.flatnonzero((picture[..., :3] < 1.0).any(axis=(axis, 2))) for axis in (1, 0))
    axes.imshow(picture[rows[0] : rows[-1], columns[0] : columns[-1]])
    axes.set_title(f"t = {time:.2f}", fontsize="medium")
for axes in figure.axes:
    axes.set_axis_off()
figure.savefig(out / "allen_cahn.png", dpi=130)
(out / "phase.png").unlink()
print(f"Wrote {out / 'allen_cahn.png'}")

# %% [markdown]
# **Try next**: another seed, and all may end in one phase, or other geodesics remain; half the width on
# `generators.genus3(levels=3)`; the circle on a torus, where it may be left hanging around the hole; a mixture that
# can not turn from one phase to the other, `forms/cahn_hilliard.py`.
#
# ## Check
#
# The growth is exact but for $O(\varepsilon^2)$, and so is the factor between the mean and $\cos \theta$. The energy
# falls in every step, and at the end nothing moves.

# %%
assert np.abs(np.array(profile) - math.pi**2 / 12).max() < 0.02, profile  # what is left is O(epsilon^2)
assert (np.array(growth) < 0.6 * widths**2).all(), growth
assert 1.7 < order < 2.5, order
assert max(np.diff(energies)) < 0
if steps > 3:
    assert speed < 1e-3
    assert 8 < energies[-1] / unit_energy < 20
