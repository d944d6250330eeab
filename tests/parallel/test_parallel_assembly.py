"""Numbers, cells, vectors and matrices: rows that ranks own are those of a serial run, without a word between them."""

from collections.abc import Callable
from functools import partial
from typing import Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
import pytest
import scipy.sparse as sp
from compared import same_as_in_serial
from problems import refined_anywhere
from zoo import ZOO, beside, torus, wheel

import ufl
from thccs_fem import adapt, fem, generators
from thccs_fem.fem.assembly import assemble_cells, integrals
from thccs_fem.mesh import ControlMesh
from thccs_fem.parallel import gathered, total
from ufl import avg, dot, dS, ds, dx, grad, inner, jump

Floats = npt.NDArray[np.float64]


def tagged(msh: ControlMesh, comm: MPI.Comm) -> ControlMesh:
    """Return the mesh with tags 0 .. 2 on faces, and 0 .. 3 on edges."""
    edges = {(int(a), int(b)): i % 4 for i, (a, b) in enumerate(msh.edges)}
    faces = np.split(msh.face_vertices, msh.face_offsets[1:-1])
    tags = np.arange(msh.num_faces) % 3
    return ControlMesh(msh.vertices, faces, face_tags=tags, edge_tags=edges, corners=msh.corners, comm=comm)


def space(make: Callable[[], ControlMesh], boundary: Any, levels: int, comm: MPI.Comm) -> fem.FunctionSpace:
    return refined_anywhere(fem.functionspace(tagged(make(), comm), ("THCCS", 3), boundary), levels)


def deep(comm: MPI.Comm) -> fem.FunctionSpace:
    """Return a space of 12 levels around a reentrant corner."""
    V = fem.functionspace(tagged(generators.l_domain(2), comm), ("THCCS", 3))
    while V.num_levels < 12:
        V = adapt.refine(V, V.hierarchy.dof_offsets[-2] + np.arange(6))
    return V


SPACES: dict[str, Callable[[MPI.Comm], fem.FunctionSpace]] = {
    "L-domain": partial(space, lambda: generators.l_domain(3), "clamped", 4),
    "disc": partial(space, lambda: generators.disc(3), "crease", 3),
    "closed": partial(space, lambda: generators.genus3(1), "clamped", 3),
    "polygons": partial(space, ZOO["polygons"], "clamped", 3),
    "components": partial(space, lambda: beside(wheel(5), torus(4, 3)), "clamped", 3),
    "few cells": partial(space, ZOO["grid"], "clamped", 1),
    "12 levels": deep,
}
each_space = pytest.mark.parametrize("make", SPACES.values(), ids=SPACES)


def by_number(V: Any, seed: int = 0) -> fem.Function:
    """Return a function with other coefficients everywhere, the same whatever the ranks."""
    u = fem.Function(V)
    rows = np.random.default_rng(seed).uniform(-1.0, 1.0, (u.x.index_map.size_global, V.block_size))
    u.x.array = rows[u.x.index_map.numbers].ravel()
    return u


def whole_vector(V: fem.FunctionSpace, b: Floats) -> Floats:
    assert b.shape == (V.num_local_dofs,)
    return V.index_map.gather(b.reshape(-1, V.block_size)).ravel()


def whole_matrix(V: fem.FunctionSpace, W: fem.FunctionSpace, A: sp.csr_array) -> sp.csr_array:
    """Return the matrix of all ranks, in the order of a serial run."""
    assert A.shape == (V.num_owned_dofs, W.num_local_dofs)
    entries = sp.coo_array(A)
    comm = V.mesh.comm
    row, column = (
        size * V_.index_map.numbers[index // size] + index % size
        for V_, size, index in zip((V, W), (V.block_size, W.block_size), entries.coords, strict=True)
    )
    data = gathered(comm, entries.data), (gathered(comm, row), gathered(comm, column))
    assert data[0].size == np.unique(data[1][0].astype(np.int64) * W.num_dofs + data[1][1]).size  # no entry twice
    return sp.csr_array(data, shape=(V.num_dofs, W.num_dofs))


def same_matrix(found: sp.csr_array) -> dict[str, Any]:
    """Return what makes the matrix: with zeros, since the pattern is the same, too."""
    found.sort_indices()
    return {"indptr": found.indptr, "indices": found.indices, "data": found.data}


def coefficients(V: fem.FunctionSpace) -> list[fem.Function]:
    """Return functions on V, cellwise on V, on the faces, and on the coarsest space and its cells."""
    hierarchy = V.hierarchy.truncated_to(1)
    coarse = fem.FunctionSpace(hierarchy) if V.num_levels > 1 else V
    spaces = [V, fem.cellwise(V), fem.functionspace(V.mesh, ("DG", 0)), coarse, fem.cellwise(coarse)]
    return [by_number(each, seed) for seed, each in enumerate(spaces)]


@each_space
def test_integrals_over_cells_and_edges(make: Callable[[MPI.Comm], fem.FunctionSpace]) -> None:
    def sums(comm: MPI.Comm) -> dict[str, Any]:
        V = make(comm)
        f, on_cells, on_faces, coarse, on_coarse = coefficients(V)
        x, n = ufl.SpatialCoordinate(V.mesh), ufl.FacetNormal(V.mesh.ufl_domain())
        forms = {
            "cells": f * on_cells * dx + on_faces * coarse * x[0] * dx(1) + on_coarse * dx((0, 2)),
            "edges": on_cells("+") * inner(jump(grad(f), n), jump(grad(coarse), n)) * dS + on_faces("-") * avg(f) * dS,
            "tagged edges": on_cells("-") * f("+") * on_coarse("+") * dS(2) + jump(on_cells) * x[1] * dS((0, 1)),
        }
        if V.mesh.boundary_edges.size:
            forms["rim"] = (dot(grad(f), n) ** 2 * on_cells + coarse * on_faces) * ds + on_coarse * f * ds((1, 3))
        found: dict[str, Any] = {}
        for name, integrand in forms.items():
            compiled = fem.form(integrand, on=V)
            found[name] = total(comm, fem.assemble_scalar(compiled))
            found[f"{name} of cells"] = V.cells.partition.cells.gather(assemble_cells(compiled))
        return found

    same_as_in_serial(sums)


@each_space
def test_vectors_and_matrices(make: Callable[[MPI.Comm], fem.FunctionSpace]) -> None:
    def assembled(comm: MPI.Comm) -> dict[str, Any]:
        V = make(comm)
        W = fem.FunctionSpace(V.hierarchy, (2,))
        f, on_cells, on_faces, coarse, on_coarse = coefficients(V)
        u, v, q = ufl.TrialFunction(V), ufl.TestFunction(V), ufl.TestFunction(W)
        n = ufl.FacetNormal(V.mesh.ufl_domain())
        linear = f * v * dx + jump(grad(v), n) * avg(coarse) * dS + on_cells("+") * v("-") * dS(1)
        bilinear = on_coarse * inner(grad(u), grad(v)) * dx + on_faces * u * v * dx(2)
        if V.mesh.boundary_edges.size:
            linear += on_faces * v * ds
            bilinear += f * u * v * ds(3)
        across = avg(on_cells) * inner(jump(grad(u), n), jump(grad(v), n)) * dS + u("+") * v("-") * dS(0)
        found: dict[str, Any] = {
            "vector": whole_vector(V, fem.assemble_vector(fem.form(linear))),
            "of two components": whole_vector(W, fem.assemble_vector(fem.form((f * q[0] + on_cells * q[1]) * dx))),
            "integrals": V.index_map.gather(integrals(V)),
        }
        for name, form in (("cells", bilinear), ("edges", bilinear + across)):
            A = fem.assemble_matrix(fem.form(form))
            found[name] = same_matrix(whole_matrix(V, V, A))
            values = A.data.copy()
            fem.assemble_matrix(A, fem.form(form))
            np.testing.assert_array_equal(A.data, values)
        B = fem.assemble_matrix(fem.form(coarse * u * q[1] * dx))
        return found | {"two rows a column": same_matrix(whole_matrix(W, V, B))}

    same_as_in_serial(assembled)
