# ---
# jupyter:
#   jupytext:
#     text_representation:
#       format_name: percent
# ---

# %% [markdown]
# # Truncation, in one dimension
#
# Everything that this library does on surfaces happens on a line too, where it fits into a few lines of NumPy. This is
# section 2 of the paper (Wei, Zhang, Hughes, Scott, CMAME 291, 2015) with its figures 1 and 2: cubic B-splines can be
# *refined*, a *hierarchy* refines them only where we want, and *truncation* makes their sum one again.
#
# The library itself is not used here. `truncation.py` is the same story around an extraordinary vertex.

# %%
import argparse
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy.interpolate import BSpline
from scipy.special import comb

parser = argparse.ArgumentParser(description="Hierarchical and truncated cubic B-splines on a line")
parser.add_argument("--out", type=Path, default=Path("out"), help="directory of the pictures")
arguments = parser.parse_args()
arguments.out.mkdir(parents=True, exist_ok=True)

# %% [markdown]
# ## A B-spline is a combination of finer ones
#
# Let $B$ be the cubic B-spline with knots $-2, -1, 0, 1, 2$. Those of level $l$ are its copies $B(2^l x - i)$, half as
# wide with each level. Each is a combination of five of the next level, its *children*, with binomial coefficients:
#
# $$ B(x) = \sum_{k=-2}^{2} \frac{1}{8} \binom{4}{k + 2} \, B(2 x - k) \qquad \text{(eq. 1)} . $$
#
# On quad meshes this becomes Catmull-Clark subdivision.

# %%
bspline = BSpline.basis_element([-2, -1, 0, 1, 2], extrapolate=False)


def B(x: np.ndarray) -> np.ndarray:
    return np.nan_to_num(bspline(x))  # zero outside


offsets = np.arange(-2, 3)
coefficients = comb(4, offsets + 2) / 8
t = np.linspace(-2.5, 2.5, 1001)
children = coefficients[:, None] * B(2 * t - offsets[:, None])
refinability = np.abs(children.sum(axis=0) - B(t)).max()
print(f"coefficients of the children: {coefficients}, error of eq. 1: {refinability:.1e}")

figure = Figure(figsize=(7, 3), layout="constrained")
axes = figure.subplots()
axes.plot(t, children.T, color="tab:blue")
axes.plot(t, B(t), color="black", linewidth=2)
for k, c in zip(offsets, coefficients, strict=True):
    axes.text(k / 2, c * 2 / 3 - 0.06, f"{8 * c:.0f}/8", ha="center", color="tab:blue")
axes.set(title="A B-spline (black), its children times their coefficients (blue)")
figure.savefig(arguments.out / "univariate_refinability.png", dpi=150)

# %% [markdown]
# ## A hierarchy
#
# On $[0, 8]$ with knots at the integers, $\Omega^1 = [2, 7]$ is to be refined. A function of level 0 with its support
# in there is *passive*: here those around 4 and 5. In their place the functions of level 1 with their supports in there
# are *active*. Supports decide on either level.

# %%
LENGTH, OMEGA = 8, (2, 7)
x = np.linspace(0, LENGTH, 64 * LENGTH + 1)


def centres(level: int) -> np.ndarray:
    """Return the centres of all functions of a level that do not vanish on the interval."""
    return np.arange(-1, 2**level * LENGTH + 2) / 2**level


def splines(level: int) -> np.ndarray:
    """Return the values of these functions, shape (functions, points)."""
    return B(2**level * (x - centres(level)[:, None]))


def inside(level: int) -> np.ndarray:
    """Return which of them have their support in Omega."""
    radius = 2 / 2**level
    return (centres(level) - radius >= OMEGA[0]) & (centres(level) + radius <= OMEGA[1])


passive, selected = inside(0), inside(1)
kept, added = splines(0)[~passive], splines(1)[selected]
hierarchical = np.concatenate([kept, added])
print(f"passive: around {centres(0)[passive]}; active on level 1: around {centres(1)[selected]}")

# %% [markdown]
# ## Truncation
#
# These functions are independent, but they are no partition of unity: the functions of level 0 beside the passive ones
# reach into $\Omega^1$, where the ones of level 1 sum to one already. Now write these in terms of their children, by
# eq. 1, and leave out the children that are active themselves,
#
# $$ \operatorname{trunc} B_i = \sum_{j \text{ not active}} S_{ji} \, B^1_j , $$
#
# and nothing is counted twice. In the language of the library (`thccs_fem/hierarchy.py`): $C_1 = Z S C_0 + E$, where
# $Z$ leaves out, $E$ adds the new functions, and *one* array, `selected`, decides on both.

# %%
offset = np.rint(2 * (centres(1)[:, None] - centres(0))).astype(int)
S = np.where(np.abs(offset) <= 2, comb(4, offset + 2) / 8, 0.0)  # S[j, i]: coefficient of child j in function i
ZS = np.where(selected[:, None], 0.0, S)[:, ~passive]
truncated = np.concatenate([ZS.T @ splines(1), added])

figure = Figure(figsize=(8, 6), layout="constrained")
panels = figure.subplots(3, sharex=True)
drawn = [
    ("Level 0, the passive functions grey", splines(0), np.where(passive, "0.6", "black")),
    ("Hierarchical: the sum (dotted) is not one", hierarchical, ["black"] * len(kept) + ["tab:blue"] * len(added)),
    ("Truncated: the sum is one", truncated, ["black"] * len(kept) + ["tab:blue"] * len(added)),
]
for axes, (title, functions, colours) in zip(panels, drawn, strict=True):
    for values, colour in zip(functions, colours, strict=True):
        axes.plot(x, np.where(values > 0, values, np.nan), color=colour)
    axes.plot(x, functions.sum(axis=0), color="black", linestyle=":")
    axes.axvspan(*OMEGA, color="tab:blue", alpha=0.08)
    axes.set(title=title, ylim=(0, 1.8), xlim=(0, LENGTH))
figure.savefig(arguments.out / "univariate_truncation.png", dpi=150)
print(f"Wrote {arguments.out / 'univariate_refinability.png'} and {arguments.out / 'univariate_truncation.png'}")

# %% [markdown]
# A function that lost children is not only smaller, it also ends earlier: matrices become sparser. And nothing is lost:
# both sets span the same space, in which all splines of level 0 lie. Truncation chooses a basis that sums to one.


# %%
def rank(*functions: np.ndarray) -> int:
    return int(np.linalg.matrix_rank(np.concatenate(functions), tol=1e-10))


def end_of(centre: int, functions: np.ndarray) -> float:
    """Return where a function of level 0 becomes zero."""
    values = functions[np.flatnonzero(centres(0)[~passive] == centre)[0]]
    return float(x[np.flatnonzero(values > 0)[-1] + 1])


print(f"{'':12}  functions  rank  least sum  largest sum  end of the one around 3")
for name, functions in (("hierarchical", hierarchical), ("truncated", truncated)):
    sums = functions.sum(axis=0)
    row = f"{len(functions):9} {rank(functions):5} {sums.min():10.4f} {sums.max():12.4f} {end_of(3, functions):24}"
    print(f"{name:12}  {row}")
both, with_level_0 = rank(hierarchical, truncated), rank(hierarchical, truncated, splines(0))
print(f"rank of both together: {both}, and with level 0: {with_level_0}")

# %% [markdown]
# What to try next: `OMEGA = (2, 5)` is shorter than a support of level 0. No function is passive then, but three are
# added: refined elements alone do not replace anything, which is why the library refines supports of functions.
#
# ## Check
#
# The sum of the truncated functions is one, to rounding, the sum of the hierarchical ones is not. No function is
# negative. Both sets are independent and span the same space, and level 0 is in it.

# %%
assert refinability < 1e-15
assert hierarchical.sum(axis=0).max() > 1.5
assert np.abs(truncated.sum(axis=0) - 1).max() < 1e-14
assert truncated.min() >= 0
assert len(hierarchical) == len(truncated) == rank(hierarchical) == rank(truncated)
assert both == with_level_0 == rank(truncated)
assert (end_of(3, hierarchical), end_of(3, truncated)) == (5.0, 3.5)
