"""The bridge to DOLFINx on several ranks: each has its own pieces, and forms are those of one rank."""

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import pytest
from compared import same_as_in_serial

import ufl
from thccs_fem import adapt, fem, generators
from thccs_fem.fem.petsc import assemble_matrix
from thccs_fem.parallel import total

pytest.importorskip("dolfinx")

import dolfinx.fem.petsc

from thccs_fem import dolfinx as bridge


def space(comm: MPI.Comm) -> fem.FunctionSpace:
    V = fem.functionspace(generators.cube_sphere(2, comm=comm), ("THCCS", 3, (2,)))
    return adapt.refine(V, [0, 3])


def test_integrals_of_functions_are_those_of_one_rank() -> None:
    def work(comm: MPI.Comm) -> tuple[float, int]:
        V = space(comm)
        u = fem.Function(V)
        u.x.array = np.sin(np.arange(V.num_dofs)).reshape(-1, 2)[V.index_map.numbers].ravel()
        theirs, x = bridge.function(u), ufl.SpatialCoordinate(bridge.mesh(V))
        density = theirs[0] ** 2 * x[0] ** 2 + ufl.inner(ufl.grad(theirs), ufl.grad(theirs))
        integral = dolfinx.fem.assemble_scalar(dolfinx.fem.form(density * ufl.dx))
        return total(comm, integral), bridge.mesh(V).topology.index_map(2).size_global

    same_as_in_serial(work, tol=1e-12)


def test_extraction_makes_their_matrix_ours(comm: MPI.Comm) -> None:
    V = space(comm)

    def weighted_mass(V: ufl.FunctionSpace, x: ufl.SpatialCoordinate) -> ufl.Form:
        u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
        return (1.0 + x[0]) * ufl.inner(u, v) * ufl.dx(metadata={"quadrature_degree": 7})

    theirs = weighted_mass(bridge.functionspace(V), ufl.SpatialCoordinate(bridge.mesh(V)))
    A = dolfinx.fem.petsc.assemble_matrix(dolfinx.fem.form(theirs))
    A.assemble()
    ours = assemble_matrix(fem.form(weighted_mass(V, ufl.SpatialCoordinate(V.mesh))))
    difference = A.PtAP(bridge.extraction_matrix(V))
    difference.axpy(-1.0, ours, structure=PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
    assert difference.norm() < 1e-13 * ours.norm()
