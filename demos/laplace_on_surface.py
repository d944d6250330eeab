# ---
# jupyter:
#   jupytext:
#     text_representation:
#       format_name: percent
# ---

# %% [markdown]
# # Laplace's equation on a smooth surface
#
# A quad control mesh stands for a smooth surface: the limit of Catmull-Clark subdivision. On that surface, here of
# genus 3, we solve
#
# $$ -\Delta_\Gamma u = 0 \text{ on } \Gamma \setminus (\Gamma_0 \cup \Gamma_1), \qquad
#    u = 0 \text{ on } \Gamma_0, \qquad u = 1 \text{ on } \Gamma_1 , $$
#
# with $\Delta_\Gamma$ the Laplace-Beltrami operator and $\Gamma_0$, $\Gamma_1$ two small patches at its ends. Think of
# a metal shell that is cooled at one end and heated at the other. The solution has kinks around the two patches, so a
# uniform mesh would waste most of its unknowns: we refine where the residual says so, twenty times.
#
# Run it on a mesh of your own with `--mesh FILE` (OBJ, OFF, PLY, gmsh and what else meshio reads), or on all
# processors: `mpirun -n 4 python laplace_on_surface.py`.

# %%
import argparse
import itertools
import os
import sys
from pathlib import Path

import numpy as np

import ufl
from thccs_fem import adapt, estimate, fem, generators, io, mesh, parallel, plot, subdivision
from thccs_fem.forms import laplace_beltrami

try:
    from mpi4py import MPI

    from thccs_fem.fem.petsc import LinearProblem

    comm = MPI.COMM_WORLD
except ImportError:  # no PETSc here: the same problem, solved by SciPy
    from thccs_fem.fem.scipy import LinearProblem

    comm = None

parser = argparse.ArgumentParser(description="Laplace's equation on the limit surface of a control mesh")
parser.add_argument("--mesh", type=Path, help="control mesh; the genus-3 model without one")
parser.add_argument("--steps", type=int, default=int(os.environ.get("STEPS", "20")), help="refinement steps")
parser.add_argument("--out", type=Path, default=Path("out"), help="directory of the results")
arguments = parser.parse_args()

if parallel.rank_of(comm) > 0:
    sys.stdout = None  # rank 0 prints for all

# %% [markdown]
# ## The control mesh and the two patches
#
# The patches are sets of *control-mesh faces*: refinement does not change the problem. The built-in model carries them
# as face tags 1 and 2. On any other mesh `mesh.end_faces` takes, in each connected part, the faces nearest to the two
# ends of its longest axis.

# %%
if arguments.mesh is None:
    msh = generators.genus3(comm=comm)
    cold, hot = (np.flatnonzero(msh.face_tags == tag) for tag in (1, 2))
else:
    msh = io.read_mesh(arguments.mesh, comm)
    while msh.num_faces < 200 * msh.num_components:  # a coarse cage: subdivided, its limit surface is the same
        msh = subdivision.subdivided(msh)
    cold, hot = mesh.end_faces(msh)
V = fem.functionspace(msh, ("THCCS", 3))
print(f"{msh}\n{V}")

# %% [markdown]
# ## Solve, estimate, refine
#
# The weak form is what one would write for DOLFINx. `fem.region_dofs` names the functions that do not vanish on a set
# of faces; prescribing all of them fixes the solution there, whatever the level of refinement.


# %%
def heated(V: fem.FunctionSpace) -> LinearProblem:
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    bcs = [
        fem.dirichletbc(0.0, fem.region_dofs(V, cold), V),
        fem.dirichletbc(1.0, fem.region_dofs(V, hot), V),
    ]
    return LinearProblem(
        laplace_beltrami.a(u, v),
        laplace_beltrami.L(fem.Constant(msh, 0.0), v),
        bcs=bcs,
        u=fem.Function(V, "u"),
        petsc_options_prefix="laplace_",
    )


# %% [markdown]
# The functions are $C^1$, so the residual $h_K \lVert \Delta_\Gamma u_h \rVert_K$ of the strong form, without any jump
# terms, tells where the error is. The functions whose supports carry half of it (Dörfler marking) are refined, again
# and again. After each step the energy of the solution goes into the table.


# %%
def energy(step: adapt.Step, uh: fem.Function) -> dict[str, float]:
    of_this_rank = fem.assemble_scalar(fem.form(laplace_beltrami.a(uh, uh)))
    return {"energy": parallel.total(comm, of_this_rank)}


history = adapt.solve(
    V,
    heated,
    lambda uh: estimate.residual(uh, laplace_beltrami.strong_residual(uh, 0.0)),
    stop=adapt.Stop(steps=arguments.steps),
    callback=energy,
)
print(history)

# %% [markdown]
# ## Output
#
# The VTU file holds the exact bicubic pieces (open it in ParaView and raise the "Nonlinear Subdivision Level"). The
# picture has the mesh lines of the active elements on the smooth surface.

# %%
uh = history.solution
arguments.out.mkdir(parents=True, exist_ok=True)
io.write_vtu(arguments.out / "laplace.vtu", uh)
plot.plot(uh, filename=arguments.out / "laplace.png")
print(f"Wrote {arguments.out / 'laplace.vtu'} and {arguments.out / 'laplace.png'}")

# %% [markdown]
# ## Check
#
# The spaces are nested and the conditions are the same on each of them, so the energy $\int |\nabla u_h|^2$ can only
# fall towards that of the solution. The maximum principle holds for the solution, and for $u_h$ up to its error. The
# estimate gets smaller, too, if not in each step: where faces are far longer than wide it may rise for a while.

# %%
assert all(after <= before * (1 + 1e-6) for before, after in itertools.pairwise(history["energy"]))
values = uh.x.array
assert values.min() > -0.1, values.min()
assert values.max() < 1.1, values.max()
estimates = history["estimate"]
assert estimates.min() < estimates[0] or len(estimates) == 1
