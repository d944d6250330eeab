# ---
# jupyter:
#   jupytext:
#     text_representation:
#       format_name: percent
# ---

# %% [markdown]
# # A plate with a hole
#
# Pull at a sheet of metal, and it carries the same stress everywhere. Drill a hole, however small, and beside it the
# stress is *three times* as large: that is where it tears. Gustav Kirsch found this in 1898, with a formula for the
# displacement of an infinite plate with a hole of radius 1 under the tension $T$ along $x$. We cut a disc of radius 4
# out of it, prescribe Kirsch's displacement on its rim, leave the hole free, and see whether the factor 3 comes out of
#
# $$ -\operatorname{div} \sigma(u) = 0, \qquad \sigma(u) = \lambda \operatorname{tr} \varepsilon(u) I
#    + 2 \mu \varepsilon(u), \qquad \varepsilon(u) = \tfrac{1}{2} (\nabla u + \nabla u^T) . $$

# %%
import os
from pathlib import Path

import numpy as np

import ufl
from thccs_fem import estimate, fem, plot
from thccs_fem.forms import linear_elasticity
from thccs_fem.mesh import ControlMesh

try:
    from mpi4py import MPI  # noqa: F401  # petsc4py wants it loaded

    from thccs_fem.fem.petsc import LinearProblem
except ImportError:  # no PETSc here: the same problem, solved by SciPy
    from thccs_fem.fem.scipy import LinearProblem

steps = int(os.environ.get("STEPS", "4"))
out = Path("out")
out.mkdir(exist_ok=True)

# %% [markdown]
# ## A control mesh by hand
#
# A grid of points, around the hole and outwards: the quads need no more than numbers. The limit of a smooth rim is
# at $(P_- + 4 P + P_+) / 6$, so a circle of vertices is put a little outside of the circle that is wanted. The edges of
# the outer rim get the tag 1, by which conditions know them on whatever level of refinement.

# %%
OUTSIDE = 4.0


def plate(around: int, outwards: int) -> ControlMesh:
    angle = 2 * np.pi * np.arange(around) / around
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    radius = OUTSIDE ** (np.arange(outwards + 1) / outwards) * 3 / (2 + np.cos(angle[1]))  # finer at the hole
    vertices = radius[:, None, None] * circle
    number = np.arange((outwards + 1) * around).reshape(outwards + 1, around)
    after = np.roll(number, -1, axis=1)
    quads = np.stack([number[:-1], number[1:], after[1:], after[:-1]], axis=-1).reshape(-1, 4)
    outside = dict.fromkeys(zip(number[-1].tolist(), after[-1].tolist(), strict=True), 1)
    return ControlMesh(vertices.reshape(-1, 2), quads, edge_tags=outside)


# %% [markdown]
# ## Kirsch's solution
#
# For a thin sheet, that is for plane stress, with $\kappa = (3 - \nu) / (1 + \nu)$.

# %%
E, nu, T = 1.0, 0.3, 0.01
lmbda, mu = linear_elasticity.plane_stress(E, nu)


def kirsch(x):
    r, theta = ufl.sqrt(x[0] ** 2 + x[1] ** 2), ufl.atan2(x[1], x[0])
    kappa = (3 - nu) / (1 + nu)
    c, s, c3, s3 = ufl.cos(theta), ufl.sin(theta), ufl.cos(3 * theta), ufl.sin(3 * theta)
    along = r * (kappa + 1) * c + 2 / r * ((1 + kappa) * c + c3) - 2 / r**3 * c3
    across = r * (kappa - 3) * s + 2 / r * ((1 - kappa) * s + s3) - 2 / r**3 * s3
    return T / (8 * mu) * ufl.as_vector([along, across])


def solve(V: fem.FunctionSpace) -> fem.Function:
    msh = V.mesh
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    rim = fem.dirichletbc(kirsch(ufl.SpatialCoordinate(msh)), fem.boundary_dofs(V, tag=1), V)
    problem = LinearProblem(
        linear_elasticity.a(u, v, lmbda, mu),
        linear_elasticity.L(fem.Constant(msh, (0.0, 0.0)), v),
        bcs=[rim],
        petsc_options_prefix="plate_",
    )
    uh = problem.solve()
    uh.name = "u"
    return uh


# %% [markdown]
# ## The factor 3
#
# It is the stress along $x$ at the top of the hole, over $T$. Functions are $C^1$, so strains and stresses are
# continuous and have a value at every point, also on the rim. The face whose first vertex is the top of the hole has
# it at $(0, 0)$; `fem.project` makes a function of the stress that can be evaluated there.


# %%
def stress(uh: fem.Function) -> fem.Function:
    scalar = fem.FunctionSpace(uh.function_space.hierarchy)
    sigma_h = fem.project(linear_elasticity.sigma(uh, lmbda, mu)[0, 0] / T, scalar)
    sigma_h.name = "stress / T"
    return sigma_h


rows = []
for k in range(steps):
    msh = plate(around=8 * 2**k, outwards=3 * 2**k)
    V = fem.functionspace(msh, ("THCCS", 3, (2,)))
    uh = solve(V)
    top = 2 * 2**k  # a quarter around
    factor = stress(uh).eval([top], [(0.0, 0.0)])[0]
    error = estimate.norm(V, estimate.error(uh, kirsch, "H1"))
    rows.append((error, abs(factor - 3)))
    print(f"{V.num_dofs:6d} dofs: H1 error {error:.1e}, stress at the top of the hole {factor:.5f} T")

# %%
plot.plot(stress(uh), out / "plate_with_hole.png", cmap="inferno")
print(f"Wrote {out / 'plate_with_hole.png'}")

# %% [markdown]
# With 12 elements outwards and 32 around the factor is right to three digits. At the sides of the hole, left and right,
# there is no tension at all: the force goes around it, above and below.
#
# **Try next**: pressure in the hole, `linear_elasticity.L(f, v, t=-p * n)` with `n = ufl.FacetNormal(msh)`; an elliptic
# hole, whose factor is 1 + 2 times the ratio of its axes; `linear_elasticity.plane_strain`.
#
# ## Check

# %%
errors = np.array(rows)
rate = -np.polyfit(np.arange(len(rows)), np.log2(errors[:, 0]), 1)[0]
print(f"order of the error in H1: {rate:.2f}")
assert 2.7 < rate < 4.0, rate
assert errors[2, 1] < 2e-3, errors
