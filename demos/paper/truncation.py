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

parser = argparse.ArgumentParser(
    description="Children, supports and truncation of functions near extraordinary vertices"
)
parser.add_argument("--out", type=Path, default=Path("out"), help="directory of the pictures")
arguments = parser.parse_args()
arguments.out.mkdir(parents=True, exist_ok=True)

VALENCES = (3, 5)
RINGS = 5  # of faces around the EV: what is refined below stays away from the rim
spaces = {N: fem.functionspace(generators.wheel(N, RINGS), ("THCCS", 3), boundary="crease") for N in VALENCES}

# %% [markdown]
# ## Three types of functions (fig. 4)
#
# The support of a function is made of the faces that touch a face of its vertex. Three types of supports contain
# irregular faces: that of $B_{EV}$, the function of the EV itself; those of the vertices in faces around it (here one
# along an edge, one across a face), which have the EV inside; and those one ring further, which have the EV on their
# boundary and hold irregular faces beside it only. All other functions are bicubic splines.
#
# In the library, `V.hierarchy.support` marks these faces, level by level.


# %%
def vertices_near(N: int) -> dict[str, int]:
    """Return the EV, one vertex for each type of neighbour, and the next one straight on (dofs have these numbers)."""
    mesh = spaces[N].mesh
    _, edge, diagonal, _ = mesh.quads[0]
    straight = np.linalg.norm(mesh.vertices - 2 * mesh.vertices[edge], axis=1).argmin()
    return {"EV": 0, "edge neighbour": int(edge), "second ring": int(straight), "diagonal neighbour": int(diagonal)}


def draw_mesh(axes: Axes, points: np.ndarray, quads: np.ndarray, marked: np.ndarray, show: np.ndarray) -> None:
    """Draw the faces of a planar mesh around the points to show, the marked ones blue."""
    colours = list(np.where(marked, "#cfe3f5", "white"))
    axes.add_collection(PolyCollection(points[quads], facecolors=colours, edgecolors="0.5", linewidths=0.7))
    (left, bottom), (right, top) = show.min(axis=0) - 0.08, show.max(axis=0) + 0.08
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
    axes.axis("off")


figure = Figure(figsize=(12, 6.4), layout="constrained")
print("N   function of            faces in its support   irregular ones")
for N, row in zip(VALENCES, figure.subplots(2, 4), strict=True):
    mesh, hierarchy = spaces[N].mesh, spaces[N].hierarchy
    irregular = (mesh.quads == 0).any(axis=1)
    for axes, (name, vertex) in zip(row, vertices_near(N).items(), strict=True):
        (support,) = hierarchy.support(np.array([vertex]))
        print(f"{N}   {name:20} {np.count_nonzero(support):22} {np.count_nonzero(support & irregular):16}")
        draw_mesh(axes, mesh.vertices, mesh.quads, support, mesh.vertices)
        axes.plot(*mesh.vertices[vertex], "o", color="tab:red")
        axes.set_title(f"{name}, N = {N}")
figure.savefig(arguments.out / "truncation_supports.png", dpi=130)

# %% [markdown]
# ## Children (fig. 6)
#
# $B_{EV}$ has $6 N + 1$ children on the next level, the function of any vertex with four edges has 25:
#
# $$ B_i = \sum_j S_{ji} \, B^1_j \qquad \text{(eq. 13)}, $$
#
# with $S$ the matrix of Catmull-Clark subdivision: in the library `V.hierarchy.stages[0].matrix`, as soon as something
# is refined. Count half edges $(a, b)$ from the EV along the two sides of a sector: the coefficient of the child there
# is $c_a c_b$ with the univariate $c = (6/8, 4/8, 1/8)$, whatever $N$. Only at the EV itself it is $1 - 7 / (4 N)$,
# which is $c_0 c_0$ for $N = 4$.

# %%
UNIVARIATE = [Fraction(6, 8), Fraction(4, 8), Fraction(1, 8)]


def expected_coefficients(N: int) -> dict[str, tuple[int, Fraction]]:
    """Return how many children of each kind B_EV has, and their coefficient."""
    c = UNIVARIATE
    return {
        "EV": (1, 1 - Fraction(7, 4 * N)),
        "edge points": (N, c[1] * c[0]),
        "face points": (N, c[1] * c[1]),
        "edge neighbours": (N, c[2] * c[0]),
        "edge points between": (2 * N, c[2] * c[1]),
        "diagonal neighbours": (N, c[2] * c[2]),
    }


def as_fraction(value: float) -> Fraction:
    return Fraction(value).limit_denominator(1000)


coefficients: dict[int, dict[Fraction, int]] = {}
figure = Figure(figsize=(12, 6), layout="constrained")
for N, axes in zip(VALENCES, figure.subplots(1, 2), strict=True):
    hierarchy = adapt.refine(spaces[N], [0]).hierarchy
    S = hierarchy.stages[0].matrix[:, [0]].toarray()[:, 0]
    children = np.flatnonzero(S)
    values, counts = np.unique([as_fraction(v) for v in S[children]], return_counts=True)
    coefficients[N] = dict(zip(values, counts.tolist(), strict=True))
    print(f"\nN = {N}: {children.size} children, 6 N + 1 = {6 * N + 1}")
    for kind, (count, value) in expected_coefficients(N).items():
        print(f"  {kind:20} {count:3} with {value!s:>6}, in S: {coefficients[N][value]:3}")
    fine, points = hierarchy.stages[1].level, hierarchy.points[1]
    draw_mesh(axes, points, fine.quads, np.zeros(fine.num_faces, dtype=bool), points[children])
    for child in children:
        box = {"boxstyle": "round,pad=0.2", "facecolor": "white", "edgecolor": "tab:blue"}
        axes.text(*points[child], str(as_fraction(S[child])), ha="center", va="center", size=9, bbox=box)
    axes.set_title(f"Coefficients of the {children.size} children, N = {N}")
figure.savefig(arguments.out / "truncation_coefficients.png", dpi=130)

# %% [markdown]
# ## Three cases of truncation (sec. 4.2, fig. 5)
#
# Refine one function near the EV. Its 25 children become active, and those that are children of $B_{EV}$ too are
# discarded from it: 15 for an edge neighbour, 5 for the vertex behind it, 9 for a diagonal neighbour, whatever $N$.
# What is left of $B_{EV}$ is column 0 of $C_1$, in the library `V.hierarchy.coefficients[1]`. In the picture $\Omega^1$
# is blue, crosses are children that are discarded, dots are those that are left.

# %%
CASES = ("edge neighbour", "second ring", "diagonal neighbour")


def unit_function(V: fem.FunctionSpace) -> fem.Function:
    """Return dof 0, the function of the EV."""
    u = fem.Function(V, "B")
    u.x.array[0] = 1.0
    return u


whole: dict[int, fem.Function] = {}
discarded: dict[tuple[int, str], int] = {}
truncated: dict[tuple[int, str], fem.Function] = {}
refinability: list[float] = []
figure = Figure(figsize=(12, 8.2), layout="constrained")
print("\nN   refined               children   discarded   left   value at the EV before   after")
for N, row in zip(VALENCES, figure.subplots(2, 3), strict=True):
    whole[N] = unit_function(spaces[N])
    for axes, case in zip(row, CASES, strict=True):
        V = adapt.refine(spaces[N], [vertices_near(N)[case]])
        coarse, fine = V.hierarchy.stages[:2]
        S = coarse.matrix[:, [0]].toarray()[:, 0]
        left = V.hierarchy.coefficients[1][:, [0]].toarray()[:, 0]
        gone = (S > 0) & (left == 0)
        discarded[N, case] = np.count_nonzero(gone)

        # B_EV in the refined space is what is left of it, dof 0, plus the discarded children times their coefficients.
        B = adapt.transfer(whole[N], V)
        refinability.append(np.abs(B.x.array[V.hierarchy.dof_offsets[1] :] - S[fine.active]).max())
        truncated[N, case] = unit_function(V)
        before, after = (u.eval([0], [[0.0, 0.0]])[0] for u in (B, truncated[N, case]))
        counts = f"{np.count_nonzero(S):8} {discarded[N, case]:11} {np.count_nonzero(left):6}"
        print(f"{N}   {case:20} {counts} {before:24.4f} {after:7.4f}")

        points = V.hierarchy.points[1]
        draw_mesh(axes, points, fine.level.quads, fine.inside, points[S > 0])
        axes.plot(*points[left > 0].T, "o", color="tab:blue")
        axes.plot(*points[gone].T, "x", color="tab:red", markeredgewidth=2)
        axes.set_title(f"{case} refined, N = {N}: {discarded[N, case]} discarded")
figure.savefig(arguments.out / "truncation_cases.png", dpi=130)

# %% [markdown]
# ## The truncated functions (fig. 7)
#
# On a planar domain `plot.surface(u, warp=1.0)` (and `plot.plot`) draws the graph of a function. From left to right:
# $B_{EV}$ as it was, and truncated in each of the three cases. The lines are the sides of the elements.

# %%
with pyvista.vtk_verbosity("off"):  # it would complain where there is no display
    plotter = pyvista.Plotter(off_screen=True, shape=(2, 4), border=False, window_size=(2400, 1300))
for row, N in enumerate(VALENCES):
    for column, u in enumerate([whole[N], *(truncated[N, case] for case in CASES)]):
        plotter.subplot(row, column)
        facets, lines = plot.surface(u, warp=1.0), plot.mesh_lines(u, warp=1.0)
        plotter.add_mesh(facets, scalars="B", cmap="YlGnBu", clim=(-0.1, 0.6), ambient=0.3, show_scalar_bar=False)
        plotter.add_mesh(lines.translate((0.0, 0.0, 0.003)), color="black", line_width=1.5)
        title = f"{CASES[column - 1]} refined" if column else "not truncated"
        plotter.add_text(f"{title}, N = {N}", font_size=12, color="black")
        plotter.camera_position = [(3.0, -4.0, 3.0), (0.0, 0.0, 0.1), (0.0, 0.0, 1.0)]
        plotter.enable_parallel_projection()
        plotter.camera.parallel_scale = 0.6
plotter.set_background("white")
plotter.enable_anti_aliasing("ssaa")
plotter.screenshot(arguments.out / "truncation_functions.png")
plotter.close()
print(f"Wrote truncation_supports.png, _coefficients.png, _cases.png and _functions.png to {arguments.out}")

# %% [markdown]
# What to try next: other valences in `VALENCES` (any from 3; for 4 all is as on a grid), or two functions refined at
# once, `adapt.refine(V, [i, j])`. Why the children are discarded by their supports is the topic of `selection.py`.
#
# ## Check
#
# The numbers of the paper: $6 N + 1$ children, and 15, 5 and 9 discarded in the three cases; coefficients as in the
# formula; $B_{EV}$ is what is left of it plus what was discarded, and at the EV it is $N / (N + 5)$.

# %%
for N in VALENCES:
    assert {value: count for count, value in expected_coefficients(N).values()} == coefficients[N]
    assert sum(coefficients[N].values()) == 6 * N + 1
    assert [discarded[N, case] for case in CASES] == [15, 5, 9]
assert max(refinability) < 1e-15
for N in VALENCES:
    assert abs(whole[N].eval([0], [[0.0, 0.0]])[0] - N / (N + 5)) < 1e-15  # the limit mask
