"""Spaces refined where functions are marked and coarsened where cells are.

What is coarsened are cells, by one level: those marked, as far as whole functions of the coarser level allow.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from thccs_fem.fem.space import FunctionSpace, check_space
from thccs_fem.hierarchy import Hierarchy
from thccs_fem.parallel import gathered, together
from thccs_fem.partition import partition

__all__ = ["coarsen", "refine", "remesh"]


def refine(V: FunctionSpace, marked: npt.ArrayLike) -> FunctionSpace:
    """Return the space in which the supports of the marked functions are refined; V is unchanged. Collective.

    Args:
        V: The space.
        marked: Function numbers in the whole space, shape (m,); what any rank gives is marked.

    Raises:
        ValueError: If a number is out of range.
        TypeError: If the numbers are no integers.
    """
    functions = _functions(V, marked)
    return V.with_hierarchy(V.hierarchy.refined(functions)) if functions.size else V


def coarsen(V: FunctionSpace, cells: npt.ArrayLike) -> FunctionSpace:
    """Return the space in which the marked cells are coarsened by one level, where whole functions allow it.

    A cell that is marked may stay; one that is not never goes. V is unchanged, and refines the result. Collective.

    Args:
        V: The space.
        cells: Cells that this rank owns, local numbers, shape (m,), or marks, bool, shape (cells.num_owned,).

    Returns:
        The space; V itself if nothing changes.

    Raises:
        ValueError: If a number is out of range, or the marks are not one for each cell.
        TypeError: If the cells are neither integers nor marks.
    """
    return _on(V, V.hierarchy.coarsened(_cells(V, cells)))


def remesh(V: FunctionSpace, marked: npt.ArrayLike, cells: npt.ArrayLike) -> FunctionSpace:
    """Return the space refined where functions are marked and coarsened where cells are, where that undoes none of it.

    Cells that the refinement needs stay, marked or not: what `refine` would have done to the supports of the marked
    functions is done. Collective.

    Args:
        V: The space.
        marked: Function numbers as for `refine`, shape (m,).
        cells: Cells that this rank owns, numbers, shape (n,), or marks, as for `coarsen`.

    Returns:
        The space; V itself if nothing changes.

    Raises:
        ValueError: If a number is out of range, or the marks are not one for each cell.
        TypeError: If the functions are no integers, or the cells neither integers nor marks.
    """
    return _on(V, V.hierarchy.remeshed(_functions(V, marked), _cells(V, cells)))


def _on(V: FunctionSpace, hierarchy: Hierarchy) -> FunctionSpace:
    return V if hierarchy is V.hierarchy else V.with_hierarchy(hierarchy)


def _functions(V: FunctionSpace, marked: npt.ArrayLike) -> npt.NDArray[np.int64]:
    """Return the functions that some rank has marked, ascending."""
    check_space(V, "refinement")
    comm = V.mesh.comm
    return np.unique(gathered(comm, together(comm, lambda: _checked_functions(V, marked))))


def _checked_functions(V: FunctionSpace, marked: npt.ArrayLike) -> npt.NDArray[np.int64]:
    """Return marked functions as numbers, ascending."""
    functions = np.unique(np.asarray(marked))
    if functions.size and not np.issubdtype(functions.dtype, np.integer):
        marks = ": np.flatnonzero(marks) makes numbers of marks" * (functions.dtype == np.bool_)
        raise TypeError(f"marked functions must be integers (see adapt.mark), got {functions.dtype}{marks}")
    if functions.size and (functions[0] < 0 or functions[-1] >= V.num_functions):
        raise ValueError(f"functions run from 0 to {V.num_functions - 1}; got {functions[0]} to {functions[-1]}")
    return functions.astype(np.int64)


def _cells(V: FunctionSpace, cells: npt.ArrayLike) -> npt.NDArray[np.int64]:
    """Return the cells that the ranks have marked as numbers in the hierarchy, rank after rank."""
    check_space(V, "coarsening")
    comm, owned = V.mesh.comm, partition(V.hierarchy).cells
    local = together(comm, lambda: _checked_cells(owned.size_local, cells))
    return gathered(comm, owned.numbers[local].astype(np.int64))


def _checked_cells(num_cells: int, cells: npt.ArrayLike) -> npt.NDArray[np.int64]:
    """Return marked cells as numbers, ascending."""
    marked = np.asarray(cells)
    if marked.dtype == np.bool_:
        if marked.shape != (num_cells,):
            raise ValueError(f"marks have shape {marked.shape}; there must be one for each of the {num_cells} cells")
        return np.flatnonzero(marked)
    numbers = np.unique(marked)
    if numbers.size and not np.issubdtype(numbers.dtype, np.integer):
        raise TypeError(f"marked cells must be integers or bools (see adapt.mark_coarsening), got {numbers.dtype}")
    if numbers.size and (numbers[0] < 0 or numbers[-1] >= num_cells):
        raise ValueError(f"cells run from 0 to {num_cells - 1}; got {numbers[0]} to {numbers[-1]}")
    return numbers.astype(np.int64)
