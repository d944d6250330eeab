"""Indicators, marks and refinement on several ranks: what a serial run comes to, cell by cell."""

from collections.abc import Callable
from typing import Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
import pytest
from compared import same_as_in_serial, shared
from problems import smooth, wavy
from zoo import ZOO

import ufl
from thccs_fem import adapt, estimate, fem, generators
from thccs_fem.fem.petsc import LinearProblem
from thccs_fem.hierarchy import Hierarchy
from thccs_fem.partition import partition
from ufl import div, dot, dx, grad, inner

Floats = npt.NDArray[np.float64]

MUMPS = {"ksp_type": "preonly", "pc_type": "lu", "pc_factor_mat_solver_type": "mumps"}

SPACES: dict[str, Callable[[MPI.Comm], fem.FunctionSpace]] = {
    "L-domain": lambda comm: refined(fem.functionspace(generators.l_domain(3, comm=comm), ("THCCS", 3))),
    "wheel, crease": lambda comm: refined(fem.functionspace(generators.wheel(5, 3, comm=comm), ("THCCS", 3), "crease")),
    "closed": lambda comm: refined(fem.functionspace(generators.cube_sphere(3, comm=comm), ("THCCS", 3))),
    "polygons": lambda comm: refined(fem.functionspace(shared(ZOO["polygons"](), comm), ("THCCS", 3))),
    "one cell": lambda comm: fem.functionspace(generators.rectangle((1, 1), comm=comm), ("THCCS", 3)),
}
each_space = pytest.mark.parametrize("make", SPACES.values(), ids=SPACES)


def refined(V: fem.FunctionSpace) -> fem.FunctionSpace:
    """Return the space refined three times, on each rank elsewhere: what any of them marks is refined."""
    comm = V.mesh.comm
    for step in range(3):
        marked = np.random.default_rng(step).integers(0, V.num_functions, 4)
        V = adapt.refine(V, marked[comm.rank :: comm.size])
    return V


def of_all(V: fem.FunctionSpace, eta: Floats) -> Floats:
    """Return the indicators of all cells."""
    assert eta.shape == (V.cells.num_owned,)
    return partition(V.hierarchy).cells.gather(eta)


def shares(V: fem.FunctionSpace, whole: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the values of the cells that this rank owns."""
    return whole[V.cells.partition.cells.numbers[: V.cells.num_owned]]


def keys(hierarchy: Hierarchy) -> dict[str, npt.NDArray[np.int64]]:
    return {f"level {level}": keys for level, keys in enumerate(hierarchy.refined_keys)}


# ---- Indicators


def smoothed(V: fem.FunctionSpace, exact: Callable[..., Any]) -> tuple[fem.Function, ufl.Form, ufl.Form]:
    """Return the solution of a problem without conditions, and the problem."""
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    f = exact(ufl.SpatialCoordinate(V.mesh))
    a, L = (inner(grad(u), grad(v)) + u * v) * dx, f * v * dx
    return LinearProblem(a, L, petsc_options=MUMPS, petsc_options_prefix="smoothed_").solve(), a, L


@each_space
def test_indicators(make: Callable[[MPI.Comm], fem.FunctionSpace]) -> None:
    def indicators(comm: MPI.Comm) -> dict[str, Any]:
        V = make(comm)
        exact = wavy if V.mesh.gdim == 2 else smooth
        uh, a, L = smoothed(V, exact)
        f = exact(ufl.SpatialCoordinate(V.mesh))
        kappa = fem.Function(fem.functionspace(V.mesh, ("DG", 0)))
        kappa.x.array = 1.0 + np.arange(V.mesh.num_faces) % 3
        flux = kappa * grad(uh)
        rim = V.mesh.boundary_edges.size > 0
        neumann = dot(flux, ufl.FacetNormal(V.mesh)) if rim else None
        found = {
            "L2": estimate.error(uh, exact),
            "H1": estimate.error(uh, exact, "H1"),
            "residual": estimate.residual(uh, f - uh + div(grad(uh))),
            "with edges": estimate.residual(uh, f - uh + div(flux), neumann, flux=flux),
            "bubble": estimate.bubble(uh, a, L),
        }
        norms = {f"norm of {name}": estimate.norm(V, eta) for name, eta in found.items()}
        return {name: of_all(V, eta) for name, eta in found.items()} | norms

    same_as_in_serial(indicators)


def test_cells_whose_bubbles_have_no_solution_are_counted_on_all_ranks() -> None:
    def refusal(comm: MPI.Comm) -> str:
        V = fem.functionspace(generators.rectangle((4, 4), comm=comm), ("THCCS", 3))
        u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
        with pytest.raises(
            ValueError, match=r"the local problems of 16 cells .* the first that of cell 0 on face 0 "
        ) as e:
            estimate.bubble(fem.Function(V), fem.Constant(V.mesh, 0.0) * u * v * dx, v * dx)
        return str(e.value)

    same_as_in_serial(refusal)


# ---- Marks


@pytest.mark.parametrize("strategy", ["worst", "maximum", "dorfler"])
@each_space
def test_marks(make: Callable[[MPI.Comm], fem.FunctionSpace], strategy: adapt.Strategy) -> None:
    def marked(comm: MPI.Comm) -> list[dict[str, Any]]:
        V = make(comm)
        return [marks_of(V, np.random.default_rng(seed).random(V.num_cells) ** (1 + 3 * seed)) for seed in range(4)]

    def marks_of(V: fem.FunctionSpace, eta: Floats) -> dict[str, Any]:
        functions = adapt.mark(V, shares(V, eta), strategy)
        cells = adapt.mark_coarsening(V, shares(V, eta))
        assert (cells < V.cells.num_owned).all()
        marks = np.zeros(V.cells.num_owned, dtype=bool)
        marks[cells] = True
        spaces = {
            "refined": adapt.refine(V, functions),
            "coarsened": adapt.coarsen(V, cells),
            "coarsened by marks": adapt.coarsen(V, marks),
            "remeshed": adapt.remesh(V, functions, marks),
        }
        assert spaces["coarsened"] == spaces["coarsened by marks"]
        found = {"functions": functions, "cells": of_all(V, marks)}
        return found | {name: keys(space.hierarchy) for name, space in spaces.items()}

    same_as_in_serial(marked)


@pytest.mark.parametrize("strategy", ["worst", "maximum", "dorfler"])
@pytest.mark.parametrize("kind", ["equal", "of four sizes"])
def test_rounding_does_not_break_ties(kind: str, strategy: adapt.Strategy) -> None:
    """All symmetric: indicators of many functions are equal, but for what each rank's rounding makes of them."""

    def marked(comm: MPI.Comm) -> dict[str, Any]:
        V = adapt.refine(fem.functionspace(generators.torus((8, 8), comm=comm), ("THCCS", 3)), np.arange(0, 64, 4))
        eta = np.ones(V.num_cells) if kind == "equal" else 2.0 ** (np.arange(V.num_cells) % 4)
        noise = np.random.default_rng([comm.rank, comm.size]).uniform(-1e-9, 1e-9, V.cells.num_owned)
        functions = adapt.mark(V, shares(V, eta) * (1.0 + noise), strategy, theta=0.5)
        cells = np.zeros(V.cells.num_owned, dtype=bool)
        cells[adapt.mark_coarsening(V, shares(V, eta) * (1.0 + noise), theta=0.25)] = True
        return {"functions": functions, "cells": of_all(V, cells)}

    found = same_as_in_serial(marked)
    assert found["functions"].size
    assert found["cells"].any()


def test_what_one_rank_gets_wrong_is_refused_by_all(comm: MPI.Comm) -> None:
    V = SPACES["L-domain"](comm)
    last = comm.rank == comm.size - 1
    eta = np.ones(V.cells.num_owned)
    eta[0] = -1.0 if last else 1.0
    cases: list[tuple[Callable[[], Any], type[Exception], str]] = [
        (lambda: adapt.mark(V, eta), ValueError, "eta of cell 0 is -1.0"),
        (lambda: adapt.mark_coarsening(V, eta), ValueError, "eta of cell 0 is -1.0"),
        (lambda: adapt.mark(V, np.ones(V.cells.num_owned + last)), ValueError, "it needs one value for each of the"),
        (lambda: adapt.refine(V, [V.num_functions if last else 0]), ValueError, "functions run from 0 to"),
        (lambda: adapt.refine(V, [0.5] if last else [0]), TypeError, "marked functions must be integers"),
        (lambda: adapt.coarsen(V, [V.cells.num_owned if last else 0]), ValueError, "cells run from 0 to"),
        (lambda: adapt.coarsen(V, np.ones(V.cells.num_owned + last, dtype=bool)), ValueError, "there must be one for"),
        (lambda: adapt.remesh(V, [], [0.5] if last else []), TypeError, "marked cells must be integers or bools"),
    ]
    for call, error, message in cases:
        with pytest.raises(error, match=f"rank {comm.size - 1} of {comm.size}: .*{message}"):
            call()
