"""A bridge to DOLFINx: the pieces as one of its meshes, our functions as functions on that mesh, exactly.

Each bicubic piece becomes a quadrilateral cell of degree 3. A function of ours is bicubic on a piece as well, so it is
one of the discontinuous Lagrange space of degree 3, DOLFINx's ("DQ", 3), and whatever DOLFINx can do with a function it
can do with ours: interpolate gradients, evaluate at points, write files, assemble forms that we refuse. With A the
matrix of a form there and C the extraction matrix, C^T A C is ours.

**The cells of that mesh hang together nowhere**, since pieces meet in sides of different length where one is finer: no
point belongs to two cells, every side is a boundary of the mesh, and ``ds`` integrates over all of them.

DOLFINx sorts cells anew: `pieces` says which piece of ``V.cells`` each cell of its mesh is; ``V.cells.piece_cell`` and
``V.cells.tag`` lead on to our cell and to its tag. On several ranks each has the pieces of the cells that it owns.

    >>> import dolfinx, ufl
    >>> import thccs_fem.dolfinx as bridge
    >>> from thccs_fem import fem, generators
    >>> V = fem.functionspace(generators.rectangle((3, 2)), ("THCCS", 3))
    >>> u = bridge.function(fem.project(lambda x: x[0] * x[1], V))

Its gradient as a function that ``dolfinx.io.VTXWriter`` can write:

    >>> W = dolfinx.fem.functionspace(bridge.mesh(V), ("DQ", 3, (2,)))
    >>> gradient = dolfinx.fem.Function(W, name="gradient")
    >>> gradient.interpolate(dolfinx.fem.Expression(ufl.grad(u), W.element.interpolation_points))
    >>> float(gradient.x.array.max().round(9))
    1.0
"""

from __future__ import annotations

from typing import Any
from weakref import WeakKeyDictionary

from mpi4py import MPI  # before petsc4py, which must find it initialised
from petsc4py import PETSc

import dolfinx
import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

import basix.ufl
from thccs_fem import element
from thccs_fem.extraction import Cells
from thccs_fem.fem.function import Function
from thccs_fem.fem.layout import Layout
from thccs_fem.fem.petsc.matrices import comm_of, sharing
from thccs_fem.fem.space import CellwiseSpace, FunctionSpace
from thccs_fem.subdivision import Ints

__all__ = ["extraction_matrix", "function", "functionspace", "mesh", "pieces"]

Floats = npt.NDArray[np.float64]

# Forms and functions of DOLFINx go together only on one and the same mesh.
_meshes: WeakKeyDictionary[Cells, dolfinx.mesh.Mesh[np.float64]] = WeakKeyDictionary()


def mesh(V: FunctionSpace | CellwiseSpace) -> dolfinx.mesh.Mesh[np.float64]:
    """Return the pieces of a space as a mesh of DOLFINx, of degree 3; the same one for the same pieces.

    Args:
        V: The space; those of other value shapes on its hierarchy, and what is cellwise on it, have the same pieces.

    Raises:
        TypeError: V is no space of ours.
    """
    if not isinstance(V, FunctionSpace | CellwiseSpace):
        raise TypeError(f"a space from thccs_fem.fem.functionspace is needed, got {type(V).__name__}")
    if V.cells not in _meshes:
        _meshes[V.cells] = _mesh(V.cells, MPI.COMM_SELF if V.mesh.comm is None else V.mesh.comm)
    return _meshes[V.cells]


def _mesh(cells: Cells, comm: MPI.Comm) -> dolfinx.mesh.Mesh[np.float64]:
    lagrange = basix.ufl.element("Lagrange", "quadrilateral", element.DEGREE)
    points = element.bicubic_values(lagrange.basix_element.points) @ cells.piece_points[_owned_pieces(cells)]
    num_pieces, num_nodes, gdim = points.shape
    first = num_nodes * sum(comm.allgather(num_pieces)[: comm.rank])
    coordinates: Any = basix.ufl.blocked_element(lagrange, shape=(gdim,))  # what DOLFINx takes, by another type's name
    return dolfinx.mesh.create_mesh(
        comm,
        first + np.arange(num_pieces * num_nodes).reshape(num_pieces, num_nodes),
        coordinates,
        points.reshape(-1, gdim),
        partitioner=_where_they_are,
    )


def _where_they_are(comm: MPI.Comm, parts: int, cell_types: Any, cells: Any) -> Any:
    """Return the rank of each cell that this rank has, its own: DOLFINx need not move any. Cells are four corners."""
    return dolfinx.graph.adjacencylist(np.full((cells[0].size // 4, 1), comm.rank, dtype=np.int32))._cpp_object


def pieces(V: FunctionSpace | CellwiseSpace) -> Ints:
    """Return the piece of ``V.cells`` that each cell of `mesh(V)` on this rank is, shape (cells of mesh(V),)."""
    owned = _owned_pieces(V.cells)
    first = sum(mesh(V).comm.allgather(owned.size)[: mesh(V).comm.rank])
    return owned[mesh(V).topology.original_cell_index - first]


def _owned_pieces(cells: Cells) -> Ints:
    return np.flatnonzero(cells.piece_cell < cells.num_owned).astype(np.int32)


def functionspace(V: FunctionSpace | CellwiseSpace) -> dolfinx.fem.FunctionSpace[np.float64]:
    """Return the discontinuous space of degree 3 on `mesh(V)`, with values of the shape of V's: V is part of it.

    Raises:
        TypeError: As for `mesh`.
    """
    return dolfinx.fem.functionspace(mesh(V), ("DQ", element.DEGREE, V.value_shape))


def function(uh: Function) -> dolfinx.fem.Function[np.float64]:
    """Return a function of ours as one of DOLFINx, in `functionspace`: the same at all points.

    Args:
        uh: The function, which may be a cellwise one, as `fem.cell_sizes`; its values are copied.

    Raises:
        TypeError: As for `mesh`.
    """
    V = uh.ufl_function_space()
    Q = functionspace(V)
    result: dolfinx.fem.Function[np.float64] = dolfinx.fem.Function(Q, name=uh.name, dtype=np.float64)
    values = _at_nodes(Q) @ uh.local_coefficients()[pieces(V)]
    result.x.array.reshape(-1, V.block_size)[Q.dofmap.list] = values
    return result


def extraction_matrix(V: FunctionSpace) -> PETSc.Mat:
    """Return C: of the dofs of a function of V it makes those of the same function in `functionspace(V)`.

    With A a matrix assembled by DOLFINx there, ``A.PtAP(C)`` is the matrix in V; with b a vector, C^T b is that in V.

    Returns:
        Shape (dofs of functionspace(V), V.num_dofs), with the blocks of V.

    Raises:
        TypeError: As for `mesh`.
    """
    Q = functionspace(V)
    local = sp.kron(sp.eye_array(len(Q.dofmap.list)), _at_nodes(Q), format="csr")
    node_of_dof = np.argsort(Q.dofmap.list, axis=None)
    C = sp.csr_array((local @ V.cells.rows(pieces(V)))[node_of_dof])
    C = sp.csr_array(sp.kron(C, sp.eye_array(V.block_size), format="csr"))
    C.sort_indices()
    mat = sharing(C, comm_of(V), Layout((V,)).numbering)
    mat.setBlockSizes(V.block_size, V.block_size)
    return mat


def _at_nodes(Q: dolfinx.fem.FunctionSpace[np.float64]) -> Floats:
    """Return the values of the 16 local functions at the nodes of a cell, shape (16 nodes, 16)."""
    return element.bicubic_values(Q.element.interpolation_points[:, :2])
