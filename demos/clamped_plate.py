# ---
# jupyter:
#   jupytext:
#     text_representation:
#       format_name: percent
# ---

# %% [markdown]
# # A clamped plate: value and slope on the boundary
#
# A thin round plate of radius 1, built into a wall all around, under an even load $f$. Kirchhoff's theory says that its
# deflection $u$ has the least energy
#
# $$ \tfrac{1}{2} \int_\Omega D \left( (1 - \nu) \, |H(u)|^2 + \nu \, (\operatorname{tr} H(u))^2 \right) - \int_\Omega f
#    u , \qquad u = 0 , \quad \frac{\partial u}{\partial n} = 0 \text{ on } \partial\Omega , $$
#
# with the Hessian $H(u)$, the bending stiffness $D$ and Poisson's ratio $\nu$. This is an equation of *fourth order*,
# $D \Delta^2 u = f$. Finite elements of the usual kind have kinks at the edges of cells, where the Hessian makes no
# sense. Subdivision functions are smooth: the form is written down and solved as it is. New here are the two conditions
# on the boundary, for both the value and the slope belong to the plate.

# %%
import itertools
import os
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import ufl
from thccs_fem import adapt, fem, generators, limit, plot
from thccs_fem.forms import plate

try:
    from mpi4py import MPI  # noqa: F401  # petsc4py wants it loaded

    from thccs_fem.fem.petsc import LinearProblem
except ImportError:  # no PETSc here: the same problem, solved by SciPy
    from thccs_fem.fem.scipy import LinearProblem

levels = min(int(os.environ.get("STEPS", "4")), 4)
out = Path("out")
out.mkdir(exist_ok=True)

# %% [markdown]
# ## Clamped or supported
#
# `fem.boundary_dofs` names the functions that do not vanish on the boundary. With `slope=True` it adds those that have
# a slope there: all others leave the boundary flat where it is, so that zero for the dofs named is all there is to
# clamping, and it holds exactly. Without the argument the plate may turn at its edge: it is simply supported.
#
# The mesh of the disc has four vertices with three faces, where the functions are put together from small bicubic
# patches. Forms of fourth order want these to be small: `cap_level=8` (see `docs/fourth_order.md`).

# %%
D, nu = 1.0, 0.3
msh = generators.disc(8)
V = fem.functionspace(msh, ("THCCS", 3), cap_level=8)


def deflection(V: fem.FunctionSpace, clamped: bool) -> fem.Function:
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    wall = fem.dirichletbc(0.0, fem.boundary_dofs(V, slope=clamped), V)
    load = plate.L(fem.Constant(msh, 1.0), v)
    problem = LinearProblem(plate.a(u, v, D, nu), load, bcs=[wall], petsc_options_prefix="plate_")
    uh = problem.solve()
    uh.name = "clamped" if clamped else "supported"
    return uh


# %% [markdown]
# ## Against the closed forms
#
# Both deflections are known (Timoshenko and Woinowsky-Krieger, *Theory of plates and shells*, 1959, sections 16 and
# 17):
#
# $$ u = \frac{f}{64 D} (1 - r^2)^2 \quad \text{clamped}, \qquad
#    u = \frac{f}{64 D} (1 - r^2) \left( \frac{5 + \nu}{1 + \nu} - r^2 \right) \quad \text{supported}. $$
#
# The plate is refined uniformly. Its rim is a smooth spline through 32 points of the circle, and refinement leaves it
# where it is: inside the circle by 2 millionths of the radius on average. Deflections go with the fourth power of the
# radius, so what cannot be told apart from a circle's are 8 millionths.


# %%
def exact(r2: ufl.core.expr.Expr | np.ndarray, clamped: bool) -> ufl.core.expr.Expr | np.ndarray:
    return (1 - r2) * ((1 if clamped else (5 + nu) / (1 + nu)) - r2) / (64 * D)


def relative_error(uh: fem.Function, clamped: bool) -> float:
    x = ufl.SpatialCoordinate(msh)
    w = exact(x[0] ** 2 + x[1] ** 2, clamped)
    squares = [fem.assemble_scalar(fem.form(e**2 * ufl.dx, quadrature_degree=11)) for e in (uh - w, w)]
    return float(np.sqrt(squares[0] / squares[1]))


errors: list[list[float]] = []
shown: list[fem.Function] = []
print("  dofs   clamped  supported")
for level in range(levels):
    V = V if level == 0 else adapt.refine(V, np.arange(V.num_functions))
    plates = [deflection(V, clamped) for clamped in (True, False)]
    errors.append([relative_error(uh, clamped) for uh, clamped in zip(plates, (True, False), strict=True)])
    print(f"{V.num_dofs:6d}   {errors[-1][0]:.1e}    {errors[-1][1]:.1e}")
    shown = shown or plates

# %% [markdown]
# ## Pictures
#
# The plates on the first mesh, to the same scale, and cross-sections: the clamped one leaves the wall horizontally.

# %%
for uh in shown:
    plot.plot(uh, filename=out / f"plate_{uh.name}.png", warp=-8.0, camera=(0.0, -1.0, 0.6), cmap="viridis_r")

rng = np.random.default_rng(0)
faces, uv = rng.integers(0, msh.num_faces, 400), rng.random((400, 2))
r = np.linalg.norm(limit.evaluate(msh, faces, uv)[0], axis=1)
radii = np.linspace(0.0, 1.0, 200)
figure = Figure(figsize=(7, 4), layout="constrained")
axes = figure.subplots()
for uh, clamped, colour in zip(plates, (True, False), ("tab:blue", "tab:orange"), strict=True):
    axes.plot(r, -uh.eval(faces, uv), ".", color=colour, markersize=3, label=f"{uh.name}, at random points")
    axes.plot(radii, -exact(radii**2, clamped), color=colour, linewidth=1, label="closed form")
axes.set(xlabel="distance from the centre", ylabel="deflection", xlim=(0, 1))
axes.legend()
figure.savefig(out / "plate_section.png", dpi=150)
print(f"Wrote {out / 'plate_clamped.png'}, {out / 'plate_supported.png'} and {out / 'plate_section.png'}")

# %% [markdown]
# ## What to try next
#
# - Another shape: `generators.wheel(5, 4)` is a pentagon, and any planar quad mesh will do.
# - Clamp only a part: `fem.boundary_dofs(V, lambda x: x[0] < 0, slope=True)`; the rest of the rim is free.
# - An edge that is bent: `fem.dirichletbc(g, dofs, V, slope=True)` prescribes value and slope of an expression `g`.

# %% [markdown]
# ## Check
#
# Rim functions that are left free have neither value nor slope, each refinement divides the errors until the shape of
# the rim is what remains, and the supported plate is 5.3/1.3 times as deep in the middle as the clamped one.

# %%
assert errors[0][0] < 0.03, errors
assert errors[0][1] < 0.002, errors
assert all(
    fine < coarse for before, after in itertools.pairwise(errors) for coarse, fine in zip(before, after, strict=True)
)
if len(errors) >= 3:
    assert max(errors[2]) < 5e-5, errors
middle = [float(np.abs(uh.eval(faces, uv)).max()) for uh in plates]
assert abs(middle[1] / middle[0] / (5.3 / 1.3) - 1) < 0.01, middle
