# ---
# jupyter:
#   jupytext:
#     text_representation:
#       format_name: percent
# ---

# %% [markdown]
# # Boundary conditions that know when to give in
#
# A substance seeps out of a disc through its rim, where it is held at zero, and is made up for inside:
#
# $$ -\varepsilon \Delta u + u = 1 \text{ in the disc}, \qquad u = 0 \text{ on its rim} . $$
#
# For small $\varepsilon$ the solution is 1 almost everywhere and falls to 0 in a layer of the width
# $\sqrt \varepsilon$. On a mesh with cells wider than that no function can do it: told to be 0 on the rim, it is wrong
# inside, where it need not be. *Nitsche's method* puts the condition into the weak form,
#
# $$ a(u, v) - L(v) + \int_{\partial\Omega} \Big( -\varepsilon \frac{\partial u}{\partial n} v
#    - \varepsilon \frac{\partial v}{\partial n} (u - g) + \frac{\gamma \varepsilon}{h} (u - g) v \Big) = 0, $$
#
# which holds for the exact solution, is symmetric, and loses no order. Its penalty is $\gamma \varepsilon / h$ against
# the 1 of the equation: where cells are too large for the layer, the equation has its way, and where they are small
# enough the condition.

# %%
import os
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy.special import i0e

import ufl
from thccs_fem import adapt, fem, generators, limit
from thccs_fem.forms import poisson

try:
    from mpi4py import MPI  # noqa: F401  # petsc4py wants it loaded

    from thccs_fem.fem.petsc import LinearProblem
except ImportError:  # no PETSc here: the same problem, solved by SciPy
    from thccs_fem.fem.scipy import LinearProblem

steps = int(os.environ.get("STEPS", "5"))
out = Path("out")
out.mkdir(exist_ok=True)

# %% [markdown]
# ## Both ways
#
# `poisson.nitsche` is added to the residual form; `ufl.system` sorts what has the unknown from what has not. The size
# of the cells is `fem.cell_sizes(V)`.

# %%
EPSILON = 1e-4
msh = generators.disc(3)
f, epsilon = fem.Constant(msh, 1.0), fem.Constant(msh, EPSILON)


def strong(V: fem.FunctionSpace) -> fem.Function:
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    rim = fem.dirichletbc(0.0, fem.boundary_dofs(V), V)
    a, L = poisson.a(u, v, kappa=epsilon, c=1), poisson.L(f, v)
    return LinearProblem(a, L, bcs=[rim], petsc_options_prefix="strong_").solve()


def weak(V: fem.FunctionSpace) -> fem.Function:
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    F = poisson.a(u, v, kappa=epsilon, c=1) - poisson.L(f, v)
    F += poisson.nitsche(u, v, 0, fem.cell_sizes(V), kappa=epsilon)
    a, L = ufl.system(F)
    return LinearProblem(a, L, petsc_options_prefix="weak_").solve()


# %% [markdown]
# ## A coarse mesh
#
# The layer is 0.01 wide, the cells at the rim ten times as much. The exact solution is
# $1 - I_0(r / \sqrt \varepsilon) / I_0(1 / \sqrt \varepsilon)$, with a Bessel function.


# %%
def exact(r):
    s = np.sqrt(EPSILON)
    return 1 - i0e(r / s) / i0e(1 / s) * np.exp((r - 1) / s)  # i0e(x) is I_0(x) e^-x, which does not overflow


rng = np.random.default_rng(0)
faces, uv = rng.integers(0, msh.num_faces, 4000), rng.random((4000, 2))
radius = np.linalg.norm(limit.evaluate(msh, faces, uv)[0], axis=1)
inside = radius < 0.9  # where the exact solution is 1 up to 5e-5

V = fem.functionspace(msh, ("THCCS", 3))
rows, shown = [], []
for step in range(min(steps, 5)):
    solutions = [solver(V) for solver in (strong, weak)]
    values = [u.eval(faces, uv) for u in solutions]
    wrong = [np.abs(value - exact(radius))[inside].max() for value in values]
    rows.append((V.num_dofs, *wrong))
    print(f"{V.num_dofs:6d} dofs, largest error inside: strong condition {wrong[0]:.1e}, weak condition {wrong[1]:.1e}")
    if step < 2:
        shown.append((V, *values))
    V = adapt.refine(V, np.arange(V.num_functions))

# %% [markdown]
# The strong condition is right on the rim and wrong all over the disc, by 16 % on the coarsest mesh. The weak one does
# not see the layer there, and hardly errs inside of it. As cells become as small as the layer, both find it.

# %%
figure = Figure(figsize=(10, 4.2), layout="constrained")
for axes, (space, *values) in zip(figure.subplots(1, 2, sharey=True), shown, strict=True):
    for value, color, label in zip(values, ("tab:red", "tab:blue"), ("strong", "weak"), strict=True):
        axes.plot(radius, value, ".", ms=2, color=color, label=f"{label} condition")
    r = np.linspace(0.3, 1.0, 1000)
    axes.plot(r, exact(r), color="black", lw=1, label="exact")
    axes.set(title=f"{space.num_dofs} dofs", xlabel="r", xlim=(0.3, 1.005), ylim=(-0.02, 1.25))
    axes.legend(loc="lower left", markerscale=5)
figure.savefig(out / "weak_conditions.png", dpi=130)
print(f"Wrote {out / 'weak_conditions.png'}")

# %% [markdown]
# **Try next**: another penalty, `poisson.nitsche(..., gamma=200)`, which makes the weak condition strong; conditions on
# a part of the boundary, `ds=ufl.ds(tag)`; refinement where the residual is, which goes to the rim at once.
#
# ## Check

# %%
dofs, with_strong, with_weak = np.transpose(rows)
assert with_strong[0] > 0.1, with_strong
assert with_weak.max() < 0.02, with_weak
assert (with_weak < with_strong / 3)[:4].all()
if steps > 4:
    assert max(with_strong[4], with_weak[4]) < 1e-5
