# ---
# jupyter:
#   jupytext:
#     text_representation:
#       format_name: percent
# ---

# %% [markdown]
# # Truncation around an extraordinary vertex
#
# `univariate_splines.py` truncates splines on a line. On a quad mesh the same is done with Catmull-Clark functions, one
# a vertex. Where all vertices have four edges these are products of such splines. This demo is about the others, of
# section 4 of the paper (Wei, Zhang, Hughes, Scott, CMAME 291, 2015): figures 4 to 7 for extraordinary vertices (EVs)
# with $N = 3$ and $N = 5$ edges.

# %%
import argparse
from fractions import Fraction
from pathlib import Path

import numpy as np
import pyvista
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from thccs_fem import adapt, fem, generators, plot

parser = argparse.ArgumentParser(description="Children, supports and truncation of functions near extraordinary vertices")
parser.add_argument("--out", type=Path, default=Path("out"), help="directory of the pictures")
arguments = parser.parse_args()
arguments.out.mkdir(parents=True, exist_ok=True)

VALENCES = (3, 5)
RINGS = 5  # of faces around the EV: what is refined below stays away from the rim
spaces = {N: fem.functionspace(generators.wheel(N, RINGS), ("THCCS", 3), boundary="crease") for N in VALENCES}

# %% [markdown]
# ## Three types of functions (fig. 4)
#
# Near an EV there are: the function $B_{EV}$ of the EV itself; those of the vertices around it, whose supports have the
# EV inside; and those one ring further, whose supports have the EV on their boundary and contain some of the irregular
# faces only. Functions further off are bicubic splines. The support of a function is made of all faces that touch a face
# of its vertex. The library answers by `V.hierarchy.support`: marks of faces, level by level.


# %%
def vertices_near(N: int) -> dict[str, int]:
    """Return the EV, one vertex for each type of neighbour, and the next one straight on (dofs have these numbers)."""
    mesh = spaces[N].mesh
    _, edge, diagonal, _ = mesh.quads[0]
    straight = np.linalg.norm(mesh.vertices - 2 * mesh.vertices[edge], axis=1).argmin()
    return {"EV": 0, "edge neighbour": int(edge), "second ring": int(straight), "diagonal neighbour": int(diagonal)}


def draw_mesh(axes: Axes, points: np.ndarray, quads: np.ndarray, marked: np.ndarray) -> None:
    """Draw the faces of a planar mesh, the marked ones blue."""
    colours = np.where(marked, "#cfe3f5", "white")
    axes.add_collection(PolyCollection(points[quads], facecolors=list(colours), edgecolors="0.5", linewidths=0.7))
    axes.set(xlim=(-1, 1), ylim=(-1, 1), aspect="equal")
    axes.axis("off")


figure = Figure(figsize=(12, 6.4), layout="constrained")
print("N   function of            faces in its support   irregular ones")
for N, row in zip(VALENCES, figure.subplots(2, 4), strict=True):
    mesh, hierarchy = spaces[N].mesh, spaces[N].hierarchy
    irregular = (mesh.quads == 0).any(axis=1)
    for axes, (name, vertex) in zip(row, vertices_near(N).items(), strict=True):
        (support,) = hierarchy.support(np.array([vertex]))
        print(f"{N}   {name:20} {np.count_nonzero(support):22} {np.count_nonzero(support & irregular):16}")
        draw_mesh(axes, mesh.vertices, mesh.quads, support)
        axes.plot(*mesh.vertices[vertex], "o", color="tab:red")
        axes.set_title(f"{name}, N = {N}")
figure.savefig(arguments.out / "truncation_supports.png", dpi=130)

# %% [markdown]
# ## Children (fig. 6)
#
# $B_{EV}$ has $6 N + 1$ children in the next level, a vertex of four edges has 25:
#
# $$ B_i = \sum_j S_{ji} \, B^1_j \qquad \text{(eq. 13)}, $$
#
# with $S$ the matrix of Catmull-Clark subdivision. In terms of the univariate coefficients $6/8, 4/8, 1/8$ the child
# $(a, b)$ of a sector, counted in half edges from the EV, has the product $c_a c_b$ for its coefficient, whatever $N$.
# Only the EV's own is another: $1 - 7 / (4 N)$, which is $c_0 c_0 = 9/16$ for $N = 4$.
#
# The library's $S$ is `V.hierarchy.stages[0].matrix`, once something is refined.

# %%
UNIVARIATE = [Fraction(6, 8), Fraction(4, 8), Fraction(1, 8)]
PLACES = {"EV": (0, 0), "edge point": (1, 0), "face point": (1, 1)}
PLACES |= {"edge neighbour": (2, 0), "edge point beside": (2, 1), "diagonal neighbour": (2, 2)}


def expected_coefficients(N: int) -> dict[str, tuple[int, Fraction]]:
    """Return number and coefficient of each kind of child of B_EV, by the formula."""
    expected = {}
    for name, (a, b) in PLACES.items():
        if (a, b) == (0, 0):
            expected[name] = 1, 1 - Fraction(7, 4 * N)
        else:
            both_orders = 2 * N if (a, b) == (2, 1) else N
            expected[name] = both_orders, UNIVARIATE[a] * UNIVARIATE[b]
    return expected


found, expected = {}, {}
figure = Figure(figsize=(12, 6.2), layout="constrained")
for N, axes in zip(VALENCES, figure.subplots(1, 2), strict=True):
    hierarchy = adapt.refine(spaces[N], [0]).hierarchy
    S = hierarchy.stages[0].matrix[:, [0]].toarray()[:, 0]
    values, counts = np.unique(S[S > 0], return_counts=True)
    found[N] = {Fraction(v).limit_denominator(1000): int(n) for v, n in zip(values, counts, strict=True)}
    expected[N] = expected_coefficients(N)
    print(f"\nN = {N}: {np.count_nonzero(S)} children")
    for name, (count, value) in expected[N].items():
        print(f"  {name:20} {count:3} with {value!s:>6} = {float(value):.6f}; in S {found[N].get(value, 0):3}")
    fine = hierarchy.stages[1].level
    draw_mesh(axes, hierarchy.points[1], fine.quads, np.zeros(fine.num_faces, dtype=bool))
    for j in np.flatnonzero(S):
        axes.text(*hierarchy.points[1][j], f"{Fraction(S[j]).limit_denominator(1000)}", ha="center", va="center", size=7,
                  bbox={"boxstyle": "round,pad=0.2", "fc": "white", "ec": "tab:blue"})
    axes.set(title=f"Coefficients of the {np.count_nonzero(S)} children, N = {N}", xlim=(-0.6, 0.6), ylim=(-0.6, 0.6))
figure.savefig(arguments.out / "truncation_coefficients.png", dpi=130)
