# ---
# jupyter:
#   jupytext:
#     text_representation:
#       format_name: percent
# ---

# %% [markdown]
# # The functions on an irregular element
#
# Each vertex of a quad mesh has its Catmull-Clark function. On a face whose four vertices have four edges each, 16 of
# them do not vanish: the bicubic B-splines. An *irregular* face has one extraordinary vertex (EV) with $N \ne 4$ edges.
# There are $2 N + 8$ functions on it, and they are no polynomials. Section 3 of the paper (Wei, Zhang, Hughes, Scott,
# CMAME 291, 2015) evaluates them explicitly, by the method of Stam (eq. 9, and figure 3), and so does `thccs_fem.stam`.

# %%
import argparse
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from thccs_fem import element, generators, stam
from thccs_fem.bezier import spline_grid
from thccs_fem.subdivision import control_level, subdivide

parser = argparse.ArgumentParser(description="Explicit Catmull-Clark functions on an irregular element")
parser.add_argument("--valence", type=int, default=5, help="number of edges at the extraordinary vertex")
parser.add_argument("--out", type=Path, default=Path("out"), help="directory of the pictures")
arguments = parser.parse_args()
arguments.out.mkdir(parents=True, exist_ok=True)

N = arguments.valence
K = 2 * N + 8

# %% [markdown]
# ## Which functions
#
# The functions on an element are those of the vertices of all faces that touch it. `stam.stencil` names them: 0 is the
# EV, $1, \dots, 2 N$ go round it (0 to 3 are the corners of the element), the last seven are the rest.

# %%
mesh = generators.wheel(N, 2)
level = control_level(mesh)
half_edges = np.flatnonzero(level.vertices == 0).astype(np.int32)  # from the EV, one for each of its N elements
stencils = stam.stencil(level, half_edges)

figure = Figure(figsize=(6, 6), layout="constrained")
axes = figure.subplots()
for face in mesh.quads:
    axes.fill(*mesh.vertices[face].T, facecolor="white", edgecolor="gray")
axes.fill(*mesh.vertices[mesh.quads[half_edges[0] // 4]].T, facecolor="lightblue", edgecolor="black")
for number, vertex in enumerate(stencils[0]):
    axes.text(*mesh.vertices[vertex], str(number), ha="center", va="center", bbox={"boxstyle": "circle", "fc": "white"})
axes.set(aspect="equal", title=f"An irregular element and its 2 N + 8 = {K} vertices, N = {N}")
axes.set_axis_off()
figure.savefig(arguments.out / "irregular_element.png", dpi=150)

# %% [markdown]
# ## Evaluation
#
# Subdivision cuts the element into four. Three of the children are regular: B-splines. The fourth, at the EV, is like
# the element itself, and its $K$ control points are $A$ times those of the element. So at a point in a regular child
# after $m + 1$ cuts the functions are
#
# $$ B(\xi, \eta)^T = b(\xi', \eta')^T P_k \bar A A^m = b^T P_k \bar A V \Lambda^m V^{-1} \qquad \text{(eq. 9)} $$
#
# with $b$ the 16 B-splines, $(\xi', \eta')$ the coordinates in the child, $P_k \bar A$ the control points of child
# $k$, and $A = V \Lambda V^{-1}$. Powers of numbers cost the same for any $m$: one may go as near to the EV as one
# likes.

# %%
eigen = stam.eigenstructure(N)
lambda_ = float(eigen.eigenvalues[1])
print(f"N = {N}: {K} functions, eigenvalues {eigen.eigenvalues[:6].round(4).tolist()} ...")
t = np.linspace(0, 1, 41) ** 2  # denser near the EV
xi, eta = np.meshgrid(t, t)
uv = np.column_stack([xi.ravel(), eta.ravel()])
B, *slopes = stam.evaluate(N, uv, derivatives=1)
partition = np.abs(B.sum(axis=1) - 1).max()
print(f"values between {B.min():.0e} and {B.max():.4f}, their sum is 1 up to {partition:.0e}")
print(f"at the EV, {np.count_nonzero(B[0])} = 2 N + 1 of them are not zero: {B[0, :3].round(4).tolist()} ...")

# %% [markdown]
# Here are the functions of the EV, of vertices around it, and of some farther away: $z = B_i(x, y)$ on the element,
# with the EV at $(0, 0)$.

# %%
shown = [0, 1, 2, 4, 5, 2 * N + 1, 2 * N + 2, 2 * N + 7]
figure = Figure(figsize=(14, 7), layout="constrained")
for place, i in enumerate(shown):
    axes = figure.add_subplot(2, 4, place + 1, projection="3d")
    axes.plot_surface(xi, eta, B[:, i].reshape(xi.shape), cmap="viridis", rcount=41, ccount=41, antialiased=False)
    axes.view_init(elev=35, azim=-60)
    axes.set(title=f"$B_{{{i}}}$", xlabel="x", ylabel="y", xticks=[0, 1], yticks=[0, 1])
figure.savefig(arguments.out / "irregular_functions.png", dpi=150)

# %% [markdown]
# On all $N$ elements around the EV together its own function looks like a hat, here over the limit of a planar mesh
# around the EV. It is smooth ($C^1$ at the EV, $C^2$ elsewhere), though with respect to the coordinates in an element
# derivatives grow or vanish there, like $(2 \lambda)^m$.

# %%
x, y = np.concatenate([B @ mesh.vertices[stencil] for stencil in stencils]).T
z = np.tile(B[:, 0], N)
corner = np.arange(len(uv)).reshape(xi.shape)
a, b, c, d = (part.ravel() for part in (corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]))
triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
triangles = (len(uv) * np.arange(N)[:, None, None] + triangles).reshape(-1, 3)
figure = Figure(figsize=(8, 5), layout="constrained")
axes = figure.add_subplot(projection="3d")
axes.plot_trisurf(x, y, z, triangles=triangles, cmap="viridis", antialiased=False)
axes.set(title=f"$B_0$ on the {N} elements at an extraordinary vertex", zlim=(0, B[0, 0]), box_aspect=(1, 1, 0.5))
figure.savefig(arguments.out / "extraordinary_function.png", dpi=150)
print(f"Wrote irregular_element.png, irregular_functions.png and extraordinary_function.png to {arguments.out}")

# %%
near = np.ldexp(1.0, [-180, -190])  # the distance 2^-180 halved ten times
far, nearer = np.abs(stam.evaluate(N, np.column_stack([near, 0.7 * near]), 1)[1]).max(axis=1)
growth = float((nearer / far) ** (1 / 10))
print(f"the largest d/dxi grows by {growth:.6f} with each halving of the distance; 2 lambda = {2 * lambda_:.6f}")

# %% [markdown]
# ## Refinability
#
# Each function is a combination of those of the subdivided mesh, with the coefficients of subdivision:
#
# $$ B_i = \sum_j S_{ji} \, B^1_j \qquad \text{(eq. 13)} . $$
#
# This is what hierarchies are built on. It holds on all four children of the element: on that at the EV with the same
# $2 N + 8$ functions again, on the others with B-splines.

# %%
step = subdivide(level, np.ones(level.num_faces, dtype=bool))
S = step.matrix.toarray()
child = step.first_child[half_edges[0] // 4] + np.arange(4)
points = np.random.default_rng(0).random((200, 2))
u, v = points.T
outer = np.stack([(u, v), (2 - v, u), (2 - u, 2 - v), (v, 2 - u)]).swapaxes(1, 2) / 2  # children begin at other corners
refinability = []
for k in range(4):
    fine = np.zeros((len(points), S.shape[0]))
    if k == 0:
        fine[:, stam.stencil(step.fine, 4 * child[:1])[0]] = stam.evaluate(N, points)[0]
    else:
        along_u, along_v = element.bspline_values(points.T)
        grid = spline_grid(step.fine, child[k : k + 1])[0]
        fine[:, grid] = (along_v[:, :, None] * along_u[:, None, :]).reshape(-1, 16)
    refinability.append(float(np.abs((fine @ S)[:, stencils[0]] - stam.evaluate(N, outer[k])[0]).max()))
print(f"error of eq. 13 on the four children: {[f'{error:.0e}' for error in refinability]}")

# %% [markdown]
# ## Check

# %%
rounding = 1e-13  # K terms of size one
assert partition < rounding
assert B.min() > -1e-15
assert np.count_nonzero(B[0]) == 2 * N + 1
assert max(refinability) < rounding
assert max(np.abs(slope[1:].sum(axis=1)).max() for slope in slopes) < 1e-12  # slopes of a constant
assert abs(growth / (2 * lambda_) - 1) < 1e-4
