"""Estimators of fourth-order and nonlinear problems on several ranks: what a serial run comes to, cell by cell."""

from collections.abc import Callable
from typing import Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
import pytest
from compared import same_as_in_serial
from spread import CLOSED, WITH_RIM, by_number, space

import ufl
from thccs_fem import estimate, fem
from thccs_fem.mesh import ControlMesh
from thccs_fem.partition import partition
from ufl import div, dot, dx, grad, inner

Floats = npt.NDArray[np.float64]
Maker = Callable[[MPI.Comm], ControlMesh]
MESHES = WITH_RIM | CLOSED
each_mesh = pytest.mark.parametrize("make", MESHES.values(), ids=MESHES)


def of_all(V: fem.FunctionSpace, eta: Floats) -> Floats:
    """Return the indicators of all cells."""
    assert eta.shape == (V.cells.num_owned,)
    return partition(V.hierarchy).cells.gather(eta)


@each_mesh
def test_residuals(make: Maker) -> None:
    """With jumps everywhere: kappa differs from face to face, and the function is no solution."""

    def indicators(comm: MPI.Comm) -> dict[str, Any]:
        V = space(make, comm)
        u, n, x = by_number(V), ufl.FacetNormal(V.mesh), ufl.SpatialCoordinate(V.mesh)
        kappa = fem.Function(fem.functionspace(V.mesh, ("DG", 0)))
        kappa.x.array = 1.0 + np.arange(V.mesh.num_faces) % 3
        flux, moments = kappa * grad(div(grad(u))), kappa * ufl.outer(grad(u), grad(u))
        rim = {"neumann": dot(flux, n), "moment": dot(dot(moments, n), n)} if V.mesh.boundary_edges.size else {}
        found = {
            "second": estimate.residual(
                u, x[0] + div(grad(u)), flux=kappa * grad(u), stiffness=kappa, reaction=1 / kappa
            ),
            "fourth": estimate.residual(
                u, x[0] - div(flux), flux=flux, order=4, moments=moments, stiffness=kappa, **rim
            ),
        }
        return {name: of_all(V, eta) for name, eta in found.items()}

    same_as_in_serial(indicators)


@each_mesh
@pytest.mark.filterwarnings("ignore:the form has second derivatives")
def test_bubbles(make: Maker) -> None:
    def indicators(comm: MPI.Comm) -> dict[str, Any]:
        V, W = space(make, comm), space(make, comm, (2,))
        found = {}
        for name, U in {"scalar": V, "vector": W}.items():
            u, v, uh = ufl.TrialFunction(U), ufl.TestFunction(U), by_number(U)
            load = ufl.SpatialCoordinate(U.mesh)[0] * (v[0] if U.value_shape else v) * dx
            bending = (inner(grad(grad(u)), grad(grad(v))) + inner(u, v)) * dx
            F = (1 + inner(uh, uh)) * inner(grad(uh), grad(v)) * dx + inner(uh, v) * dx - load
            found[f"fourth order, {name}"] = of_all(U, estimate.bubble(uh, bending, load))
            found[f"nonlinear, {name}"] = of_all(U, estimate.bubble(uh, F))
        return found

    same_as_in_serial(indicators, tol=1e-9)  # kinks and deep pieces amplify rounding
