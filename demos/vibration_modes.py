# ---
# jupyter:
#   jupytext:
#     text_representation:
#       format_name: percent
# ---

# %% [markdown]
# # The tones of a closed surface
#
# Stretch a membrane over a closed surface so that it can only move across it, and strike it: it vibrates in *modes*,
# each with a frequency of its own. They are the eigenfunctions of the Laplace-Beltrami operator,
#
# $$ -\Delta_\Gamma u = \lambda u, $$
#
# and the frequencies are $\sqrt \lambda / 2 \pi$. In weak form this is a generalised eigenvalue problem of two
# matrices, stiffness and mass, which `EigenProblem` hands to SLEPc, or to SciPy's ARPACK.

# %%
import os
import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.image import imread

import ufl
from thccs_fem import fem, generators, parallel, plot
from thccs_fem.forms import eigenmodes

try:
    from mpi4py import MPI

    from thccs_fem.fem.petsc import EigenProblem

    comm = MPI.COMM_WORLD
except ImportError:  # no SLEPc here: the same problem, solved by SciPy
    from thccs_fem.fem.scipy import EigenProblem

    comm = None

if parallel.rank_of(comm) > 0:
    sys.stdout = None  # rank 0 prints for all
steps = int(os.environ.get("STEPS", "4"))
out = Path("out")
out.mkdir(exist_ok=True)


def modes(V: fem.FunctionSpace, number: int) -> tuple[np.ndarray, list[fem.Function]]:
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    problem = EigenProblem(
        eigenmodes.a(u, v), eigenmodes.m(u, v), num_eigenvalues=number, petsc_options_prefix="modes_"
    )
    return problem.solve()


# %% [markdown]
# ## The sphere
#
# There the modes are the spherical harmonics: $\lambda = l (l + 1)$, each $2 l + 1$ times, that is one tone of silence,
# then 3, 5 and 7 of the same pitch. `generators.interpolated` moves the vertices of `cube_sphere` so that the limit
# surface passes through points of the sphere; between them it is off by a little, and so are the eigenvalues: by third
# order here, since eight vertices are extraordinary. The mesh has the symmetries of a cube, so the five tones for
# $l = 2$ come as 3 + 2, and the seven as 1 + 3 + 3.
#
# Such multiple eigenvalues are hard on Krylov methods, which may miss a copy among the last that they are asked for.
# `EigenProblem` therefore counts the eigenvalues up to the last one, by the signs in a factorisation
# $A - s M = L D L^T$, and searches again for what is missing.

# %%
exact = np.array([l * (l + 1.0) for l in range(4) for _ in range(2 * l + 1)])
errors = []
for n in (4, 8, 16, 32)[:steps]:
    V = fem.functionspace(generators.interpolated(generators.cube_sphere(n, comm=comm)), ("THCCS", 3))
    eigenvalues, _ = modes(V, exact.size)
    errors.append(np.abs(eigenvalues - exact).max())
    shown = [f"{eigenvalues[l * l]:.5f} .. {eigenvalues[(l + 1) ** 2 - 1]:.5f}" for l in (1, 2, 3)]
    print(f"{V.num_dofs:5d} dofs: {', '.join(shown)}: error {errors[-1]:.1e}")

# %% [markdown]
# ## A surface with three holes
#
# Nobody has a formula here. The lowest modes are those of a long body, half a wave along it, then a whole one; with
# rising pitch the three rings have waves around them.

# %%
V = fem.functionspace(generators.genus3(levels=2 if steps > 3 else 1, comm=comm), ("THCCS", 3))
eigenvalues, functions = modes(V, 20)
print("eigenvalues:", np.array2string(eigenvalues, precision=3, suppress_small=True, max_line_width=100))

SHOWN = (1, 2, 3, 4, 7, 8)
figure = Figure(figsize=(12, 5.2), layout="constrained")
for axes, k in zip(figure.subplots(2, 3).flat, SHOWN, strict=True):
    file = out / f"mode_{k}.png"
    largest = parallel.largest(comm, np.abs(functions[k].x.array).max())
    plot.plot(functions[k], file, clim=(-largest, largest), cmap="RdBu_r", lines=False, window_size=(800, 512))
    picture = imread(file)[:, :680]  # without the colour bar
    rows, columns = (np.flatnonzero((picture[..., :3] < 1.0).any(axis=(axis, 2))) for axis in (1, 0))
    axes.imshow(picture[rows[0] : rows[-1], columns[0] : columns[-1]])
    axes.set_title(rf"mode {k}: $\lambda$ = {eigenvalues[k]:.3f}", fontsize="medium")
    axes.set_axis_off()
if parallel.rank_of(comm) == 0:
    figure.savefig(out / "vibration_modes.png", dpi=130)
print(f"Wrote {out / 'vibration_modes.png'}")

# %% [markdown]
# Modes of different pitch are orthogonal, and each has the norm 1; the energy of a mode is its eigenvalue.


# %%
def integral(form: ufl.Form) -> float:
    return parallel.total(comm, fem.assemble_scalar(fem.form(form)))


mass = [[integral(eigenmodes.m(functions[i], functions[j])) for i in (1, 2)] for j in (1, 2)]
energy = integral(eigenmodes.a(functions[8], functions[8]))
print(f"masses {np.round(mass, 12).tolist()}, energy of mode 8 {energy:.6f}")

# %% [markdown]
# **Try next**: a drum, with `bcs=[fem.dirichletbc(0.0, fem.boundary_dofs(V), V)]` on a planar mesh; a heavy spot,
# `eigenmodes.m(u, v, rho=...)`; `target=100.0` for tones high up.
#
# ## Check

# %%
order = np.log2(np.array(errors[:-1]) / errors[1:])
print("orders:", *(f"{r:.2f}" for r in order))
assert (np.array(errors) < 0.06 * 7.0 ** -np.arange(len(errors))).all(), errors
assert 2.7 < order[-1] < 4.3, order
assert abs(eigenvalues[0]) < 1e-9
assert np.abs(np.array(mass) - np.eye(2)).max() < 1e-9
assert abs(energy / eigenvalues[8] - 1) < 1e-9
