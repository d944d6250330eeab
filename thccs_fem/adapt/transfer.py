"""Functions carried from one space of a mesh to another."""

from __future__ import annotations

from typing import Literal

import numpy as np
import numpy.typing as npt

from thccs_fem.fem.assembly import integrals
from thccs_fem.fem.function import Function
from thccs_fem.fem.project import projector
from thccs_fem.fem.space import FunctionSpace, check_space
from thccs_fem.parallel import total
from thccs_fem.prolongation import Prolongation

__all__ = ["transfer"]

Floats = npt.NDArray[np.float64]


def transfer(
    u: Function, V: FunctionSpace, projection: Literal["L2", "H1"] = "L2", *, conserve: bool = False
) -> Function:
    """Return u in another space of the same mesh: the same function if V refines the space of u, else the nearest.

    Collective. The projection is over the cells of the coarsest refinement of both spaces. It keeps functions that lie
    in V, and the integral of u over these cells to rounding (with "H1" too: constants are test functions, and have no
    gradient). Integrals over the cells of either space differ from it by what quadrature leaves, also those of a
    function that is carried over exactly: by 1e-6 of them where cells are coarse and curved. With `conserve` a constant
    makes up for it, so that ``assemble_scalar(form(u * dx))`` stays what it was, as it does in time steps that
    conserve; use it for all transfers of a run, or the constants add up.

    Where a cap at an extraordinary vertex sinks or rises (elements at or below `cap_level`), the spaces are on surfaces
    that differ inside the cap: coefficients are carried over as they are. A space made with a larger `cap_level` avoids
    it.

    Args:
        u: The function.
        V: The space, from that of u by `refine`, `coarsen` and `remesh`.
        projection: The norm in which the result is nearest to u: "L2", or "H1", that of (u, v) + (grad u, grad v).
        conserve: Add a constant to each component that keeps its integral as it is measured, to rounding.

    Raises:
        TypeError: If u is no function, or one of the spaces none of splines.
        ValueError: If the spaces are not on the same mesh with the same boundary rule, or their values have different
            shapes, or the projection is none of ours.
    """
    if not isinstance(u, Function):
        raise TypeError(f"u is of type {type(u).__name__}; it must be a fem.Function: of several give one at a time")
    W = u.function_space
    for space in (W, V):
        check_space(space, "transfer")
    if projection not in ("L2", "H1"):
        raise ValueError(f'projection is {projection!r}; it must be "L2" or "H1"')
    if W.value_shape != V.value_shape:
        raise ValueError(f"values of shape {W.value_shape} cannot be carried to shape {V.value_shape}")
    values = u.x.array.reshape(-1, W.block_size)
    if V.hierarchy.common_refinement(W.hierarchy) is V.hierarchy:
        carried = Prolongation(V.hierarchy, W.hierarchy)(values)
    else:
        carried = projector(W.hierarchy, V, projection)(values)
    if conserve:
        found = _integral(V, np.column_stack([carried, np.ones(len(carried))]))
        carried += (_integral(W, values) - found[:-1]) / found[-1]
    result = Function(V, u.name)
    result.x.array = carried.ravel()
    return result


def _integral(V: FunctionSpace, values: Floats) -> Floats:
    """Return the integrals of functions, one in each column, over the cells of all ranks, shape (k,)."""
    owned = V.index_map.size_local
    return total(V.mesh.comm, integrals(V)[:owned] @ values[:owned])
