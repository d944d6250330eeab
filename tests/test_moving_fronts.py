"""Problems in time on meshes that refine and coarsen: all the pieces together, at small size.

For the pieces see test_timestepping.py and test_coarsening.py; for orders in time, convergence/test_time.py.
"""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest
from problems import uniformly_refined

import ufl
from thccs_fem import adapt, fem, generators
from thccs_fem.fem.space import FunctionSpace
from thccs_fem.forms import allen_cahn, cahn_hilliard
from thccs_fem.mesh import ControlMesh
from ufl import dx, grad, inner

pytest.importorskip("petsc4py")

from thccs_fem.fem.petsc import TimeProblem

Floats = npt.NDArray[np.float64]
Expr = ufl.core.expr.Expr

MESHES: dict[str, Callable[[], ControlMesh]] = {
    "torus": lambda: generators.torus((8, 4)),  # no extraordinary vertex
    "cube_sphere": lambda: generators.cube_sphere(2),  # eight of valence 3
    "genus3": lambda: generators.genus3(0),  # four of valence 8
}


def integral(u: fem.Function) -> float:
    return fem.assemble_scalar(fem.form(u * dx))


def distance(u: fem.Function, v: Expr) -> float:
    return float(np.sqrt(fem.assemble_scalar(fem.form((u - v) ** 2 * dx))))


def norm(u: fem.Function) -> float:
    return float(np.sqrt(fem.assemble_scalar(fem.form(u**2 * dx))))


def carried(u: fem.Function, V: FunctionSpace) -> fem.Function:
    """Return u in V, with the same integral."""
    return adapt.transfer(u, V, conserve=True)


def remeshed(u: fem.Function, most: float, finest: int) -> FunctionSpace:
    """Return a space in which u changes by at most so much across a cell, if the finest level allows it."""
    V = u.function_space
    change = np.sqrt(fem.assemble_cells(fem.form(inner(grad(u), grad(u)) * dx)))
    large = (change > most) & (V.cells.level < finest)
    return adapt.remesh(V, adapt.mark(V, large.astype(float), theta=1.0), change < most / 3)


def fitted(value: Expr, V: FunctionSpace, most: float, finest: int) -> fem.Function:
    """Return a projected value, on a mesh that is fine where it changes."""
    for _ in range(finest):
        V = remeshed(fem.project(value, V), most, finest)
    return fem.project(value, V)


# ---- Phases that unmix

EPSILON, MOST, FINEST = 0.2, 0.5, 3


def mixture(msh: ControlMesh) -> fem.Function:
    """Return 1 or -1 at each vertex by chance, on a mesh that is fine where this changes."""
    u = fem.Function(fem.functionspace(msh, ("THCCS", 3), cap_level=8))
    u.x.array = np.random.default_rng(1).choice([1.0, -1.0], u.x.array.size, p=[0.75, 0.25])
    for _ in range(FINEST):
        u = adapt.transfer(u, remeshed(u, MOST, FINEST))
    return u


def unmixing(u: fem.Function, dt: float) -> TimeProblem:
    V = u.function_space
    udot, v = fem.Function(V), ufl.TestFunction(V)
    F = cahn_hilliard.F(u, udot, v, EPSILON)
    return TimeProblem(F, u, udot, dt=dt, petsc_options_prefix="unmixing_")


@pytest.mark.parametrize("mesh", MESHES)
def test_the_integral_is_kept_where_fronts_move(mesh: str) -> None:
    problem = unmixing(mixture(MESHES[mesh]()), dt=0.05)
    before, both = integral(problem.u), 0
    for _ in range(7):
        old = problem.step().function_space
        assert integral(problem.u) == pytest.approx(before, rel=1e-12)
        new = remeshed(problem.u, MOST, FINEST)
        both += not (old.is_refinement_of(new) or new.is_refinement_of(old))
        problem = problem.with_space(new, carried)
        assert integral(problem.u) == pytest.approx(before, rel=1e-12)
    assert both >= 2  # refined here and coarsened there at once


def test_the_solver_is_the_same_in_another_space() -> None:
    problem = unmixing(mixture(generators.torus((8, 4))), dt=0.05)
    problem.step()
    other = problem.with_space(remeshed(problem.u, MOST, FINEST), carried)
    kinds = [
        (p.solver.getSNES().getKSP().getType(), p.solver.getSNES().getKSP().getPC().getType()) for p in (problem, other)
    ]
    assert kinds == [("preonly", "lu")] * 2


def test_unmixing_is_that_on_a_uniform_mesh() -> None:
    u = mixture(generators.genus3(0))
    fine = uniformly_refined(fem.functionspace(u.function_space.mesh, ("THCCS", 3), cap_level=8), FINEST)
    uniform, moving = unmixing(adapt.transfer(u, fine), dt=0.05), unmixing(u, dt=0.05)
    for _ in range(8):
        energies = [fem.assemble_scalar(fem.form(cahn_hilliard.energy(p.step(), EPSILON))) for p in (uniform, moving)]
        assert energies[1] == pytest.approx(energies[0], rel=2e-3)  # 2e-4 at the end, 1.3e-3 where it falls fastest
        assert distance(moving.u, uniform.u) < 0.025 * norm(uniform.u)  # 0.018
        moving = moving.with_space(remeshed(moving.u, MOST, FINEST), carried)
    assert moving.u.function_space.num_dofs < 0.4 * fine.num_dofs  # 1145 of 3068


# ---- A front that travels


def drop(V: FunctionSpace, angle: float, width: float = 0.3) -> Expr:
    """Return 1 around a place on the torus, and 0 further away."""
    x = ufl.SpatialCoordinate(V.mesh)
    centre = ufl.as_vector([2 * np.cos(angle), 2 * np.sin(angle), 1.0])
    return (1 - ufl.tanh((ufl.sqrt(ufl.inner(x - centre, x - centre)) - 0.6) / width)) / 2


def turning(u: fem.Function, dt: float) -> TimeProblem:
    """Return the problem that carries u around the torus, by an angle of 1 in a unit of time."""
    V = u.function_space
    x, udot, v = ufl.SpatialCoordinate(V.mesh), fem.Function(V), ufl.TestFunction(V)
    F = (udot * v - u * (x[0] * grad(v)[1] - x[1] * grad(v)[0])) * dx
    return TimeProblem(F, u, udot, dt=dt, petsc_options_prefix="turning_")


def test_a_front_leaves_no_trail() -> None:
    V = fem.functionspace(generators.torus((24, 12)), ("THCCS", 3))
    around, steps = 2 * np.pi / 24 * 6, 24  # by six faces: the mesh is what it was
    fine = uniformly_refined(V, 2)
    uniform = turning(fem.project(drop(V, 0.0), fine), around / steps)
    uniform.solve(around)
    moving, dofs = turning(fitted(drop(V, 0.0), V, most=0.2, finest=2), around / steps), []
    for _ in range(steps):
        moving = moving.with_space(remeshed(moving.step(), most=0.2, finest=2), carried)
        dofs.append(moving.u.function_space.num_dofs)
    assert max(dofs) < 1.3 * dofs[0]  # 528 and 420; without coarsening it ends with 966
    assert dofs[-1] < 1.3 * fitted(uniform.u, V, most=0.2, finest=2).function_space.num_dofs
    assert fine.num_dofs > 8 * max(dofs)
    exact, size = drop(V, around), norm(uniform.u)
    assert distance(moving.u, uniform.u) < 0.015 * size  # 0.010
    errors = [distance(u, exact) for u in (uniform.u, moving.u)]
    assert errors[1] == pytest.approx(errors[0], rel=0.01)  # of the steps in time, 0.19 of the size


def test_a_circle_shrinks_by_its_curvature() -> None:
    epsilon, radius = 0.05, 0.35
    V = fem.functionspace(generators.rectangle((8, 8)), ("THCCS", 3))
    x = ufl.SpatialCoordinate(V.mesh)
    r = ufl.sqrt((x[0] - 0.5) ** 2 + (x[1] - 0.5) ** 2)
    u = fitted(ufl.tanh((r - radius) / (np.sqrt(2) * epsilon)), V, most=0.5, finest=2)
    udot, v = fem.Function(u.function_space), ufl.TestFunction(u.function_space)
    F = allen_cahn.F(u, udot, v, epsilon)
    problem = TimeProblem(F, u, udot, dt=0.002, petsc_options_prefix="shrinking_")
    times, squares, dofs = [], [], []
    for _ in range(20):
        problem = problem.with_space(remeshed(problem.step(), most=0.5, finest=2), adapt.transfer)
        times.append(problem.time)
        squares.append((1 - integral(problem.u)) / 2 / np.pi)  # -1 inside the circle, in a square of area 1
        dofs.append(problem.u.function_space.num_dofs)
    slopes = np.diff(squares) / np.diff(times)
    np.testing.assert_allclose(slopes, -2.0, rtol=epsilon**2 / squares[-1])  # dR/dt = -1/R for thin fronts
    assert squares[-1] < 0.4 * radius**2
    assert dofs[-1] < 0.7 * dofs[0]
