"""Strong Dirichlet conditions: which degrees of freedom, and which values.

Functions are named by their numbers 0 .. V.num_functions, on several ranks by local ones, and each rank names those of
its ghosts as well: what is found here is complete. Of a vector-valued space a condition takes all components of a
function, or one through `V.sub(c)`. Equations of fourth order prescribe the slope as well, the derivative along the
conormal of the boundary: `slope=True`. What expressions become is in `fitting`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

import ufl
from thccs_fem.extraction import evaluate_pieces
from thccs_fem.fem.expression import ValueOrExpression
from thccs_fem.fem.fitting import boundary_rows, fitted
from thccs_fem.fem.function import Constant, Function
from thccs_fem.fem.space import Component, FunctionSpace, check_space
from thccs_fem.parallel import together
from thccs_fem.positions import side_points
from thccs_fem.subdivision import Bools, Ints

__all__ = ["DirichletBC", "boundary_dofs", "dirichletbc", "locate_dofs_geometrical", "region_dofs"]

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.integer]
Marker = Callable[[Floats], npt.NDArray[np.bool_]]


@dataclass(frozen=True, eq=False)
class DirichletBC:
    """Values of degrees of freedom.

    Attributes:
        function_space: The space.
        dofs: Degrees of freedom, ascending, shape (n,), local, ghosts included.
        values: Their values, shape (n,).
    """

    function_space: FunctionSpace
    dofs: Ints
    values: Floats


def locate_dofs_geometrical(V: FunctionSpace, marker: Marker) -> Ints:
    """Return the functions whose reference point is marked; collective.

    Args:
        V: The space.
        marker: Takes points x of shape (3, n) (the last row is zero in the plane), returns booleans of shape (n,).

    Returns:
        Function numbers, ascending, shape (m,), local, ghosts included.

    Raises:
        TypeError: If V is no space of splines.
        ValueError: If the marker returns another shape.
    """
    check_space(V, "locate_dofs_geometrical")
    return np.flatnonzero(together(V.mesh.comm, lambda: _marked(marker, V.reference_points))).astype(np.int32)


def boundary_dofs(
    V: FunctionSpace | Component, marker: Marker | None = None, *, tag: int | None = None, slope: bool = False
) -> Ints:
    """Return the functions that do not vanish on the boundary or on a part of it; collective.

    Args:
        V: The space, or one component of it, which makes no difference.
        marker: Takes points x of shape (3, n), returns booleans; an edge counts where its two ends and its middle are
            marked.
        tag: Edge tag of the control mesh; only its boundary edges.
        slope: Also those whose derivative across the boundary does not vanish there: what a clamped plate prescribes.

    Returns:
        Function numbers, ascending, shape (m,), local, ghosts included.

    Raises:
        TypeError: If V is no space of splines.
        ValueError: If both a marker and a tag are given, or no edge has the tag, or the marker returns another shape.
    """
    V = V.space if isinstance(V, Component) else V
    check_space(V, "boundary_dofs")
    if marker is not None and tag is not None:
        raise ValueError("give a marker or a tag, not both")
    return _on_all_ranks(V, together(V.mesh.comm, lambda: _on_boundary(V, marker, tag, slope)))


def _on_boundary(V: FunctionSpace, marker: Marker | None, tag: int | None, slope: bool) -> Ints:
    """Return what `boundary_dofs` does, but on several ranks of ghosts only those that local cells show."""
    cells = V.cells
    piece, side, edge = cells.boundary_pieces
    chosen = np.ones(piece.size, dtype=bool)
    if tag is not None:
        chosen = _tagged_half_edges(V, tag)[edge]
    if marker is not None:
        points = cells.piece_points[piece]
        for position in side_points([0.0, 0.5, 1.0])[side].swapaxes(0, 1):
            chosen &= _marked(marker, evaluate_pieces(points, np.arange(piece.size, dtype=np.int32), position))
    rows = boundary_rows(cells, depth=2 if slope else 1)
    of_side = np.repeat(chosen, rows.shape[0] // max(piece.size, 1))
    marks = np.zeros(cells.num_dofs, dtype=bool)
    marks[rows.indices[np.repeat(of_side, np.diff(rows.indptr))]] = True
    return np.flatnonzero(marks).astype(np.int32)


def region_dofs(V: FunctionSpace, faces: npt.ArrayLike | None = None, *, tag: int | None = None) -> Ints:
    """Return the functions that do not vanish on a set of control-mesh faces, however far refined; collective.

    Args:
        V: The space.
        faces: Faces of the control mesh, shape (k,).
        tag: Or their face tag.

    Returns:
        Function numbers, ascending, shape (m,), local, ghosts included.

    Raises:
        TypeError: If the faces are no integers, or V is no space of splines.
        ValueError: If not just one of `faces` and `tag` is given, a face is out of range, or no face has the tag.
    """
    check_space(V, "region_dofs")
    return _on_all_ranks(V, together(V.mesh.comm, lambda: _in_region(V, faces, tag)))


def _in_region(V: FunctionSpace, faces: npt.ArrayLike | None, tag: int | None) -> Ints:
    """Return what `region_dofs` does, but on several ranks of ghosts only those that local cells show."""
    if (faces is None) == (tag is None):
        raise ValueError("give the faces of the region, or their tag")
    marked = np.zeros(V.mesh.num_faces, dtype=bool)
    if faces is None:
        marked |= V.mesh.face_tags == tag
        if not marked.any():
            raise ValueError(
                f"no face of the mesh has the tag {tag}; tags of faces are {sorted({int(t) for t in V.mesh.face_tags})}"
            )
    else:
        marked[_indices(faces, "faces", V.mesh.num_faces)] = True
    cells = V.cells
    dofs = [batch.dofs[marked[cells.face[batch.cells]]].ravel() for batch in cells.batches]
    found = np.unique(np.concatenate(dofs))
    return found[found >= 0]


def _on_all_ranks(V: FunctionSpace, found: Ints) -> Ints:
    """Return those of the local functions that their owners have found, which hold all cells of these."""
    marks = np.zeros(V.index_map.numbers.size)
    marks[found] = 1.0
    V.index_map.scatter_forward(marks)
    return np.flatnonzero(marks).astype(np.int32)


def dirichletbc(
    value: ValueOrExpression,
    dofs: npt.ArrayLike,
    V: FunctionSpace | Component | None = None,
    *,
    slope: bool = False,
) -> DirichletBC:
    """Prescribe a value on functions; collective.

    Args:
        value: A number, an array of values per component (of all functions the same) or per function, a `Constant`, a
            UFL expression, or a callable g(x) with x of shape (3, n). Expressions and callables are projected in L2.
            All are read here and now.
        dofs: Function numbers, shape (n,), local, ghosts included: as the functions of this module return them.
        V: The space, or one component `V.sub(c)`; None: that of the value, a `Function`.
        slope: Fit value and slope of a UFL expression on the boundary, for dofs of ``boundary_dofs(V, slope=True)``.
            It must be differentiable there. Numbers need no such thing: 0 on these dofs is value and slope 0.

    Raises:
        TypeError: If the dofs are no integers, V is no space, or the slope of something without gradient is wanted.
        ValueError: If the dofs are out of range, the value's shape does not fit, a value is not finite, or the slope is
            wanted for dofs that have neither value nor slope on the boundary.
    """
    if V is None and isinstance(value, Function):
        V = value.function_space
    space, component = (V.space, V.component) if isinstance(V, Component) else (V, None)
    if not isinstance(space, FunctionSpace):
        raise TypeError(f"dirichletbc needs a space from fem.functionspace, or V.sub(c), got {type(V).__name__}")
    comm = space.mesh.comm
    numbers = together(comm, lambda: _indices(dofs, "dofs", space.index_map.numbers.size))
    functions = np.unique(numbers)
    components = np.arange(space.block_size) if component is None else np.array([component])
    if isinstance(value, Constant):
        value = value.value
    if isinstance(value, ufl.core.expr.Expr) or callable(value):
        values = fitted(space, functions, value, components.size, slope)
    else:
        values = together(comm, lambda: _broadcast(value, numbers, functions, components.size))
    rows = space.block_size * functions[:, None] + components
    return DirichletBC(space, rows.ravel().astype(np.int32), values.ravel())


def _broadcast(given: npt.ArrayLike, dofs: Indices, functions: Indices, k: int) -> Floats:
    """Return values of shape (functions, k) from one value, one a component, or one a function."""
    value = np.array(given, dtype=np.float64)
    if not np.isfinite(value).all():
        raise ValueError(f"the value {given!r} is not finite: prescribe finite values")
    if value.ndim == 0 or (value.shape == (k,) and k > 1):
        return np.broadcast_to(value, (functions.size, k))
    if value.shape in ((dofs.size,), (dofs.size, k)):
        _, first = np.unique(dofs, return_index=True)
        return np.broadcast_to(value if value.ndim == 2 else value[:, None], (dofs.size, k))[first]
    raise ValueError(
        f"a value of shape {value.shape} does not fit {dofs.size} dofs with {k} components: give a number, one value a "
        f"component, one a dof, or shape ({dofs.size}, {k})"
    )


def _indices(given: npt.ArrayLike, name: str, size: int) -> Indices:
    """Return numbers from 0 to size - 1 as an array."""
    indices = np.asarray(given)
    if not indices.size:
        return np.zeros(0, dtype=np.int64)
    if indices.ndim != 1 or not np.issubdtype(indices.dtype, np.integer):
        raise TypeError(f"{name} must be integers of shape (n,), got {indices.dtype} of shape {indices.shape}")
    if indices.min() < 0 or indices.max() >= size:
        raise ValueError(f"{name} run from 0 to {size - 1}; got {indices.min()} to {indices.max()}")
    return indices


def _marked(marker: Marker, points: Floats) -> Bools:
    """Return what the marker says of points of shape (n, gdim)."""
    x = np.zeros((3, len(points)))
    x[: points.shape[1]] = points.T
    marks = np.asarray(marker(x))
    if marks.shape != (len(points),):
        raise ValueError(
            f"the marker returned shape {marks.shape} for {len(points)} points; it must return ({len(points)},)"
        )
    return marks.astype(bool)


def _tagged_half_edges(V: FunctionSpace, tag: int) -> Bools:
    """Return the half-edges of the control mesh whose edge carries the tag."""
    mesh = V.mesh
    pairs = [edge for edge, t in mesh.edge_tags.items() if t == tag]
    if not pairs:
        raise ValueError(
            f"no edge of the mesh has the tag {tag}; tags of edges are {sorted(set(mesh.edge_tags.values()))}, from "
            f"ControlMesh(..., edge_tags={{(i, j): tag}})"
        )
    tagged = np.zeros(mesh.num_edges, dtype=bool)
    tagged[mesh.edge_indices(np.array(pairs, dtype=np.int32).reshape(-1, 2))] = True
    return tagged[mesh.face_edges]
