# ---
# jupyter:
#   jupytext:
#     text_representation:
#       format_name: percent
# ---

# %% [markdown]
# # How far is it along the surface?
#
# The length of the shortest path on a surface from a given point, its *geodesic distance* $\varphi$, satisfies the
# eikonal equation $|\nabla_\Gamma \varphi| = 1$, which is nonlinear and has kinks. Crane, Weischedel and Wardetzky
# (Geodesics in heat, ACM Transactions on Graphics 32, 2013) found a way around it with *two linear problems*:
#
# 1. Keep the point hot for a short time $t$, and see how far the heat comes. One implicit step will do:
#    $\; w / t - \Delta_\Gamma w = 0$, $w = 1$ at the point.
# 2. Heat has hardly arrived anywhere far away. But what has come came by the shortest way: $-\nabla_\Gamma w$ points
#    away from the source. Only its length is of no use, so take $X = -\nabla_\Gamma w / |\nabla_\Gamma w|$.
# 3. Find the function whose gradient is nearest to $X$: $\; \Delta_\Gamma \varphi = \operatorname{div}_\Gamma X$.
#
# $X$ turns about at the source and where several shortest paths meet, so that it has no divergence there. In weak form
# none is needed,
#
# $$ \int_\Gamma \nabla_\Gamma \varphi \cdot \nabla_\Gamma v = \int_\Gamma X \cdot \nabla_\Gamma v . $$

# %%
import os
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import ListedColormap

import ufl
from thccs_fem import adapt, fem, generators, limit, plot
from thccs_fem.forms import heat, laplace_beltrami

try:
    from mpi4py import MPI  # noqa: F401  # petsc4py wants it loaded

    from thccs_fem.fem.petsc import LinearProblem
except ImportError:  # no PETSc here: the same problem, solved by SciPy
    from thccs_fem.fem.scipy import LinearProblem

steps = int(os.environ.get("STEPS", "4"))
out = Path("out")
out.mkdir(exist_ok=True)

# %% [markdown]
# ## The space
#
# Around the source all directions meet in one cell, and a function that is $C^1$ would round the tip of the cone off:
# all distances would be wrong by a part of a cell. Local refinement puts this right. A point is given by a face of the
# control mesh and coordinates in it; `fem.point_values` has the values of all functions there, so those that do not
# vanish at the source are the columns it has entries in. They are refined, seven times over.


# %%
def space_around(msh, face: int, uv: tuple[float, float], levels: int = 7) -> fem.FunctionSpace:
    V = fem.functionspace(msh, ("THCCS", 3))
    for _ in range(levels):
        V = adapt.refine(V, at_source(V, face, uv))
    return V


def at_source(V: fem.FunctionSpace, face: int, uv: tuple[float, float]) -> np.ndarray:
    return np.unique(fem.point_values(V, [face], [uv]).indices)


# %% [markdown]
# ## The two problems
#
# `heat.F` is the residual of the heat equation, in $u$ and its derivative $\dot u$. For this we put the difference
# quotient of one step, and `ufl.system` takes it apart into a bilinear form and a load.
#
# The time is $t = 16 h^2$ with $h^2$ the mean area of the faces. Heat falls off like $e^{-r / \sqrt t}$: at a distance
# of $36 \sqrt t$ it is less than a rounding error at the source, and $X$ is noise. So the time must not be too short;
# the longer it is, the more of the heat comes by other ways than the shortest. The second problem is pure Neumann:
# `LinearProblem` sees that constants are in the kernel, and we shift the solution so that it is zero at the source.


# %%
def geodesic_distance(V: fem.FunctionSpace, face: int, uv: tuple[float, float]) -> fem.Function:
    msh = V.mesh
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    area = fem.assemble_scalar(fem.form(fem.Constant(msh, 1.0) * ufl.dx))
    t = fem.Constant(msh, 16 * area / msh.num_faces)
    hot = fem.dirichletbc(1.0, at_source(V, face, uv), V)
    cold = fem.Constant(msh, 0.0)
    step = ufl.system(heat.F(u, (u - cold) / t, v))
    w = LinearProblem(*step, bcs=[hot], petsc_options_prefix="heat_").solve()
    length = ufl.sqrt(ufl.inner(ufl.grad(w), ufl.grad(w)))
    X = ufl.conditional(ufl.gt(length, 0), -ufl.grad(w) / length, 0 * ufl.grad(w))
    load = ufl.inner(X, ufl.grad(v)) * ufl.dx
    phi = LinearProblem(laplace_beltrami.a(u, v), load, petsc_options_prefix="distance_").solve()
    phi.x.array -= phi.eval([face], [uv])[0]
    phi.name = "distance"
    return phi


# %% [markdown]
# ## On a sphere
#
# There the distance is known, the radius times the angle. (The limit surface of `cube_sphere` is not quite a sphere:
# its radius varies by 0.2 % on the second mesh and by 0.02 % on the last.) Near the antipode, where paths from all
# sides meet in a kink, the error is a part of a cell; on average it falls like $h^2$.

# %%
MIDDLE = (0.5, 0.5)
errors = []
for n in (4, 8, 16, 32)[: max(steps, 2)]:
    msh = generators.cube_sphere(n)
    phi = geodesic_distance(space_around(msh, 3, MIDDLE), 3, MIDDLE)
    faces = np.arange(msh.num_faces)
    centres = np.full((faces.size, 2), 0.5)
    x = limit.evaluate(msh, faces, centres)[0]
    radius = np.linalg.norm(x, axis=1)
    exact = radius.mean() * np.arccos(np.clip(x @ x[3] / (radius * radius[3]), -1.0, 1.0))
    error = phi.eval(faces, centres) - exact
    errors.append((np.sqrt(np.mean(error**2)), np.abs(error).max()))
    dofs = phi.function_space.num_dofs
    rms, largest = errors[-1]
    print(f"sphere of {msh.num_faces:5d} faces, {dofs:5d} dofs: error {rms:.1e} on average, {largest:.1e} at most")

# %% [markdown]
# ## On a surface with three holes
#
# From a point at the left end, behind. Stripes are as wide everywhere as they must be, and bend where two fronts meet
# beyond a hole.

# %%
msh = generators.genus3(levels=3 if steps > 3 else 2)
source = int(np.flatnonzero(msh.face_tags == 1)[0])
V = space_around(msh, source, MIDDLE)
phi = geodesic_distance(V, source, MIDDLE)
farthest = phi.x.array.max()
print(f"genus 3: {V.num_dofs} dofs, the farthest point is {farthest:.2f} away")

colours = colormaps["plasma"](np.repeat(np.linspace(0.1, 0.95, 12), 2))
colours[1::2, :3] *= 0.8  # every other stripe darker
stripes = ListedColormap(np.repeat(colours, 10, axis=0))
plot.plot(phi, out / "geodesic_distance.png", cmap=stripes, lines=False)
print(f"Wrote {out / 'geodesic_distance.png'}")

# %% [markdown]
# No formula is known here, but the eikonal equation is: how far is $|\nabla_\Gamma \varphi|$ from 1, on average? By
# 6 %: where two fronts meet the kink is rounded over a width of about $\sqrt t$.

# %%
length = ufl.sqrt(ufl.inner(ufl.grad(phi), ufl.grad(phi)))
area = fem.assemble_scalar(fem.form(fem.Constant(msh, 1.0) * ufl.dx))
deviation = fem.assemble_scalar(fem.form(abs(length - 1) * ufl.dx)) / area
print(f"mean of | |grad(phi)| - 1 |: {deviation:.3f}")

# %% [markdown]
# **Try next**: several sources at once (all of them hot); a curve as the source (`fem.boundary_dofs` on a surface with
# a rim); refining where paths meet, at large $|\Delta_\Gamma \varphi|$, as well.
#
# ## Check

# %%
rms = np.array([e[0] for e in errors])
assert (rms < 1.2 * 0.013 * 0.3 ** np.arange(rms.size)).all(), rms  # at least 0.3 a halving, 0.25 being second order
assert errors[-1][1] < 0.6 * errors[-2][1]  # first order where paths meet
assert deviation < 0.08, deviation
