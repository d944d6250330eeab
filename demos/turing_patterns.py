# ---
# jupyter:
#   jupytext:
#     text_representation:
#       format_name: percent
# ---

# %% [markdown]
# # Turing patterns on a surface
#
# Spots of a fish, stripes of a zebra: Turing proposed in 1952 that they come about by two substances that react with
# each other and diffuse at different speeds. Here are Schnakenberg's activator $u_0$ and substrate $u_1$ on a surface
# of genus 3,
#
# $$ \partial_t u_0 = D_0 \Delta_\Gamma u_0 + a - u_0 + u_0^2 u_1, \qquad
#    \partial_t u_1 = D_1 \Delta_\Gamma u_1 + b - u_0^2 u_1 . $$
#
# They are at rest for $u_0 = a + b$, $u_1 = b / (a + b)^2$, and stirred together they would stay so. But the substrate
# diffuses twenty times as fast, and this makes the uniform state unstable: a mode $w$ of the surface,
# $-\Delta_\Gamma w = k^2 w$, grows like $e^{s t}$ with the larger eigenvalue $s(k^2)$ of
#
# $$ \begin{pmatrix} -1 + 2 u_0 u_1 & u_0^2 \\ -2 u_0 u_1 & -u_0^2 \end{pmatrix}
#    - k^2 \begin{pmatrix} D_0 & 0 \\ 0 & D_1 \end{pmatrix} . $$
#
# This *dispersion relation* is positive in a band of wave numbers only. Its maximum tells how wide the spots will be.

# %%
import math
import os
from pathlib import Path

import numpy as np

import ufl
from thccs_fem import fem, generators, plot
from thccs_fem.fem.petsc import EigenProblem, TimeProblem
from thccs_fem.forms import eigenmodes, reaction_diffusion

steps = int(os.environ.get("STEPS", "90"))

a, b = 0.1, 0.9
D = (0.12**2, 20 * 0.12**2)
rest = np.array([a + b, b / (a + b) ** 2])


def linearised(k2: float) -> np.ndarray:
    reaction = np.array([[2 * rest.prod() - 1, rest[0] ** 2], [-2 * rest.prod(), -(rest[0] ** 2)]])
    return reaction - k2 * np.diag(D)


def growth(k2: float) -> float:
    return float(np.linalg.eigvals(linearised(k2)).real.max())


band = np.linspace(0.0, 1.0 / D[0], 2001)
fastest = float(max(band, key=growth))
print(f"fastest: k^2 = {fastest:.2f}, s = {growth(fastest):.4f}, wavelength {2 * math.pi / math.sqrt(fastest):.2f}")

# %% [markdown]
# ## Modes of the surface
#
# The first twenty modes around the fastest wave number come from an eigenvalue problem for one component.

# %%
msh = generators.genus3(levels=2)
W = fem.functionspace(msh, ("THCCS", 3))
w, z = ufl.TrialFunction(W), ufl.TestFunction(W)
problem = EigenProblem(
    eigenmodes.a(w, z), eigenmodes.m(w, z), num_eigenvalues=20, target=fastest, petsc_options_prefix="modes_"
)
eigenvalues, modes = problem.solve()
print(f"{W}\nk^2 of the modes: {eigenvalues.min():.2f} to {eigenvalues.max():.2f}")

# %% [markdown]
# ## The problem in time
#
# Both substances are components of one function. We start from rest and a little of each mode, with signs by chance,
# in the direction of the eigenvector that grows.

# %%
V = fem.functionspace(msh, ("THCCS", 3, (2,)))
u, udot, v = fem.Function(V, name="u"), fem.Function(V), ufl.TestFunction(V)

signs = np.random.default_rng(3).choice([-1e-4, 1e-4], size=len(modes))
start = np.tile(rest, (V.num_functions, 1))
for sign, k2, mode in zip(signs, eigenvalues, modes, strict=True):
    values, vectors = np.linalg.eig(linearised(k2))
    start += sign * np.outer(mode.x.array, vectors[:, values.real.argmax()].real)
u.x.array = start.ravel()

# %% [markdown]
# The weak form has $u$ and its derivative $\dot u$, each a function of its own. `TimeProblem` puts the formula of a
# scheme in the place of $\dot u$, here BDF2, and solves the nonlinear equations of each step by Newton's method. Steps
# are short while we measure how fast the modes grow, and longer after that.

# %%
F = reaction_diffusion.F(u, udot, v, reaction_diffusion.schnakenberg(u, a, b), D)
problem = TimeProblem(F, u, udot, dt=0.5, scheme="bdf2", petsc_options_prefix="turing_")
mass = fem.assemble_matrix(fem.form(w * z * ufl.dx))


def amplitudes() -> np.ndarray:
    """Return how much of each mode is in the activator."""
    return np.array([mode.x.array @ (mass @ (u.x.array[::2] - rest[0])) for mode in modes])


times, history = [0.0], [amplitudes()]
for step in range(steps):
    problem.dt = 0.5 if step < 20 else 1.0
    problem.step()
    times.append(problem.time)
    history.append(amplitudes())
    if step % 10 == 9:
        print(f"t = {problem.time:4.1f}: there is up to {np.abs(history[-1]).max():.5f} of a mode in u_0")

# %% [markdown]
# ## The dispersion relation
#
# As long as they are small, the modes do not know of each other: each grows at its own rate, which is that of the
# matrix of two by two above.

# %%
measured = slice(1, 21)  # step 0 starts BDF2 with a formula of order one
periods = np.array(times[measured])
rates = np.polyfit(periods, np.log(np.abs(history[measured])), 1)[0]
expected = np.array([growth(k2) for k2 in eigenvalues])
print("     k^2  measured  expected")
for k2, *both in zip(eigenvalues, rates, expected, strict=True):
    print(f"{k2:8.3f} {both[0]:9.4f} {both[1]:9.4f}")

# %% [markdown]
# ## The pattern
#
# Later they compete for the substrate, and spots remain, about as far apart as the fastest mode has its maxima.

# %%
activator = fem.Function(W, name="activator")
activator.x.array = u.x.array[::2]
out = Path("out")
out.mkdir(parents=True, exist_ok=True)
plot.plot(activator, filename=out / "turing_patterns.png", lines=False)
print(f"Wrote {out / 'turing_patterns.png'}")

# %% [markdown]
# Try `reaction_diffusion.gray_scott`, other diffusivities, or a mesh of your own. Where spots are narrow,
# `problem.with_space` goes on in a space that is refined there.
#
# ## Check
#
# Rates are those of the dispersion relation, within what steps of 0.5 err: BDF2 has $e^{s t}$ with $s$ larger by
# $(s \, dt)^2 / 3$ of itself, 0.6 %. In each unit of time the reaction adds $a + b - u_0$ to the sum of both, so once
# the pattern stands, $u_0$ is $a + b$ on average.

# %%
assert np.abs(rates / expected - 1.0).max() < 0.01
mean = fem.assemble_scalar(fem.form(u[0] * ufl.dx)) / fem.assemble_scalar(fem.form(fem.Constant(msh, 1.0) * ufl.dx))
print(f"u_0 is {mean:.5f} on average")
assert abs(mean - rest[0]) < 0.01
values = activator.eval(np.arange(msh.num_faces), np.full((msh.num_faces, 2), 0.5))
print(f"u_0 is {values.min():.3f} to {values.max():.3f} in the middles of faces")
assert steps < 60 or (values.min() < 0.5 and values.max() > 2.0)
