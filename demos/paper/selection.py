# ---
# jupyter:
#   jupytext:
#     text_representation:
#       format_name: percent
# ---

# %% [markdown]
# # Which functions take over: children, or supports?
#
# The paper (Wei, Zhang, Hughes, Scott, CMAME 291, 2015) says twice which functions of level $l + 1$ count. The
# *children* of the functions refined become active (sec. 4.1, eq. 17). Functions of level $l$ are truncated by
# discarding children *whose support lies in* $\Omega^{l+1}$ (eq. 18). With one function refined, far from the rim,
# these are the same. As soon as two refined supports are side by side, or one is near the rim, they are not: then
# children are discarded in whose place nothing is active, and the sum of all functions is no longer one.
#
# This demo shows it on small examples, without the library's hierarchy: it takes the matrix $S$ of one subdivision and
# does the rest itself. `thccs_fem/hierarchy.py` goes by support both times, as Kraft (1997) did for B-splines.

# %%
import argparse
from pathlib import Path

import numpy as np
import scipy.sparse as sp
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from thccs_fem import adapt, fem, generators, mesh, plot

parser = argparse.ArgumentParser(description="Activating children, discarding by support, and what comes of it")
parser.add_argument("--out", type=Path, default=Path("out"), help="directory of the pictures")
arguments = parser.parse_args()
arguments.out.mkdir(parents=True, exist_ok=True)

# %% [markdown]
# ## Three rules, in a few lines
#
# $\Omega^1$ is the union of the supports of the functions `R` that are refined. *By the letter*, the children of `R`
# become active and what has its support in $\Omega^1$ is discarded. *By children*, the children of `R` are discarded
# as well. *By support*, what has its support in $\Omega^1$ becomes active as well, and a function of level 0 becomes
# passive by the same test. In each case the functions, in terms of those of level 1, are the columns of
#
# $$ C = \begin{pmatrix} Z S_{\text{kept}} & E_{\text{new}} \end{pmatrix} , $$
#
# where $Z$ zeroes the rows of what is discarded and $E$ has a unit column for each new function.

# %%
RULES = ("by the letter", "by children", "by support")


def incidence(quads: np.ndarray, num_vertices: int) -> sp.csr_array:
    """Return the faces' corners, shape (num_faces, num_vertices)."""
    entries = (np.ones(quads.size), (np.repeat(np.arange(len(quads)), 4), quads.ravel()))
    return sp.csr_array(entries, shape=(len(quads), num_vertices))


def supported_in(quads: np.ndarray, num_vertices: int, faces: np.ndarray) -> np.ndarray:
    """Return which functions live on the marked faces only; a support is the faces that touch a face of the vertex."""
    A = incidence(quads, num_vertices)
    return A.T @ (A @ (A.T @ ~faces)) == 0


class Example:
    """One mesh, the same subdivided, and the functions R of level 0 that are refined."""

    def __init__(self, msh: mesh.ControlMesh, R: list[int]):
        self.V = fem.functionspace(msh, ("THCCS", 3), boundary="crease")
        self.fine = adapt.refine(self.V, range(self.V.num_dofs))  # everything: its dofs are the functions of level 1
        coarse, fine = self.fine.hierarchy.stages[:2]
        self.S, self.quads, self.R = coarse.matrix.toarray(), fine.level.quads, R
        A = incidence(msh.quads, msh.num_vertices)
        omega = (A @ (A.T @ A))[:, R].sum(axis=1) > 0
        self.omega = np.repeat(omega, 4)  # faces of level 1
        self.inside = supported_in(self.quads, len(self.S), self.omega)
        self.children = (self.S[:, R] > 0).any(axis=1)
        refined = np.isin(np.arange(msh.num_vertices), R)
        passive = supported_in(msh.quads, msh.num_vertices, omega)
        self.rules = {
            "by the letter": (refined, self.inside, self.children),
            "by children": (refined, self.children, self.children),
            "by support": (passive, self.inside, self.inside),
        }

    def C(self, rule: str) -> np.ndarray:
        """Return the functions that there are by a rule in terms of those of level 1, one a column."""
        passive, discarded, new = self.rules[rule]
        return np.hstack([np.where(discarded[:, None], 0.0, self.S)[:, ~passive], np.eye(len(self.S))[:, new]])

    def moved_by(self, rule: str) -> float:
        """Return how far control points of level 1 get from where subdivision puts them."""
        passive, _, new = self.rules[rule]
        P = self.V.mesh.vertices
        return float(np.abs(self.C(rule) @ np.vstack([P[~passive], (self.S @ P)[new]]) - self.S @ P).max())


NX, NY = 13, 9  # vertices of a grid; its vertex (i, j) has number i + NX j
grid = generators.rectangle((NX - 1, NY - 1), upper=(NX - 1, NY - 1))  # edges of length one
ring = [4 + i + NX * (4 + j) for j in (-1, 0, 1) for i in (-1, 0, 1) if i or j]
examples = {
    "one inside": Example(grid, [4 + NX * 4]),
    "side by side": Example(grid, [4 + NX * 4, 8 + NX * 4]),
    "near the rim": Example(grid, [2 + NX * 4]),
    "all around one": Example(grid, ring),
    "a single face": Example(generators.rectangle((1, 1)), [0]),
}

# %% [markdown]
# ## What comes of it
#
# Refined are: one function inside of the grid; that and one four edges further, so that their supports share a side;
# one two edges from the rim; the eight around one, but not that one itself; and one of the four functions on a single
# face, the smallest mesh of all. The table tells how many functions there are and how many of them depend on others, by
# how much their sum differs from one, and how far the surface moves (its control points of level 1, in edges).

# %%
found = {}
print("refined          rule            functions   dependent   sum - 1   surface")
for name, example in examples.items():
    for rule in RULES:
        C = example.C(rule)
        dependent = C.shape[1] - int(np.linalg.matrix_rank(C))
        found[name, rule] = dependent, np.abs(C.sum(axis=1) - 1).max(), example.moved_by(rule)
        print("{:15}  {:13} {:11} {:11}   {:7.1e}   {:7.1e}".format(name, rule, C.shape[1], *found[name, rule]))

# %% [markdown]
# By the letter, functions on the line between two refined supports are nobody's children, but they are discarded: the
# sum falls to zero, and the surface collapses there. By children, the sum is one; but a function all of whose
# neighbours are refined loses all of its children, and systems of equations become singular. By support there is
# neither.

# %%
figure = Figure(figsize=(14, 3.4), layout="constrained")
panels = figure.subplots(1, 3)
drawn = {"side by side": "by the letter", "near the rim": "by the letter", "all around one": "by children"}
for axes, (name, rule) in zip(panels, drawn.items(), strict=True):
    example = examples[name]
    points = example.fine.hierarchy.points[1]
    _, discarded, new = example.rules[rule]
    colours = list(np.where(example.omega, "#cfe3f5", "white"))
    axes.add_collection(PolyCollection(points[example.quads], facecolors=colours, edgecolors="0.6", linewidths=0.6))
    axes.plot(*points[new].T, "o", color="tab:blue", markersize=3)
    axes.plot(*points[discarded & ~new].T, "x", color="tab:red")
    axes.plot(*grid.vertices[example.R].T, "s", color="black", fillstyle="none")
    if name == "all around one":
        axes.plot(*grid.vertices[4 + NX * 4], "D", color="tab:red")
    axes.set(title=f"{name} (squares), {rule}", aspect="equal")
    axes.axis("off")
figure.savefig(arguments.out / "selection.png", dpi=130)

# The sum of all functions by the letter, as a function of level 1.
total = fem.Function(examples["side by side"].fine, "sum")
total.x.array = examples["side by side"].C("by the letter").sum(axis=1)
plot.plot(total, arguments.out / "selection_sum.png", warp=2.0)
print(f"Wrote {arguments.out / 'selection.png'} and {arguments.out / 'selection_sum.png'}")

# %% [markdown]
# Blue is $\Omega^1$, dots are active functions of level 1, crosses are discarded while none takes over. The red diamond
# is the function of which nothing is left. The price of the rule by support: one function refined may take neighbours
# with it. Near the rim two more become passive here.
#
# What to try next: more functions in `R`, other meshes in `Example`. `tests/test_paper.py` holds these examples, and
# `tests/test_extraction.py` sets random refinements of all kinds of meshes on the rule by support.
#
# ## Check

# %%
for (name, rule), (dependent, error, moved) in found.items():
    sums_to_one = rule != "by the letter" or name in ("one inside", "all around one")
    assert error < 1e-14 if sums_to_one else error == 1.0, (name, rule)
    assert (moved < 1e-13) == sums_to_one, (name, rule)
    if rule == "by support":
        assert dependent == 0, name
assert found["all around one", "by children"][0] == 1
# The library goes by support.
for example in examples.values():
    hierarchy = adapt.refine(example.V, example.R).hierarchy
    assert hierarchy.num_dofs == example.C("by support").shape[1]
