"""Results as VTK files: one Bezier quadrilateral (cell type 77) for each bicubic piece, which is the exact surface.

A Bezier quadrilateral of 16 points is bicubic: its points are the Bernstein coefficients of the piece, and VTK
interpolates data given at them in the same Bernstein basis.  So surface and functions are the computed ones everywhere,
and whoever draws them chooses how finely.

Pieces share no points.  Neighbours agree along their common side, but in different polynomials where one is finer.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from thccs_fem import element
from thccs_fem.extraction import Cells
from thccs_fem.fem.function import Function
from thccs_fem.fem.space import CellwiseSpace, FunctionSpace
from thccs_fem.subdivision import Ints

if TYPE_CHECKING:  # imported where it is needed: it takes its time
    import pyvista

__all__ = ["bezier_grid", "cell_numbers", "in_space", "one_for_each_cell", "write_vtu"]

# Our coefficient i + 4 j at each place of VTK: corners, then sides (each towards larger i or j), then inside.
VTK_ORDER = np.array([0, 3, 15, 12, 1, 2, 7, 11, 13, 14, 4, 8, 5, 6, 9, 10])

Floats = npt.NDArray[np.float64]


def write_vtu(
    filename: str | os.PathLike[str],
    uh: Function | FunctionSpace | Sequence[Function],
    *,
    cell_data: Mapping[str, npt.ArrayLike] | None = None,
) -> None:
    """Write functions, or only the elements of a space, to a VTU file, for ParaView and the like.

    See `bezier_grid` for what is in it. The file appears when it is complete; an older one stays until then.

    Args:
        filename: The file, ending in .vtu; its directory must exist.
        uh: A function, several on the same elements, or a space. Functions that are constant on the faces of the
            control mesh, or on coarser cells, may be among several.
        cell_data: Values for each cell by name, such as estimates, each of shape (num_cells,).

    Raises:
        TypeError: If `uh` is none of these.
        ValueError: If the file is not called .vtu, functions have different elements or the same name, or cell data
            have the wrong shape or a name that is taken.
        OSError: If the file cannot be written.
    """
    path = Path(filename)
    if path.suffix != ".vtu":
        raise ValueError(f"the file is to be called {str(path)!r}, but the name must end in .vtu")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"there is no directory {str(path.parent)!r} for {path.name!r}; make it first")
    grid = bezier_grid(uh, cell_data)
    # A directory of its own: the draft gets the usual permissions, and goes away whatever happens.
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
        draft = Path(folder, path.name)
        _save(grid, draft, path)
        draft.replace(path)


def _save(grid: pyvista.UnstructuredGrid, draft: Path, path: Path) -> None:
    """Write the draft of a file; not by grid.save, which does not tell when the disk is full."""
    from vtkmodules.vtkCommonMisc import vtkErrorCode
    from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridWriter

    writer = vtkXMLUnstructuredGridWriter()
    writer.SetFileName(str(draft))
    writer.SetInputData(grid)
    writer.SetCompressionLevel(1)  # half the time of VTK's 5, for files larger by a fiftieth
    if not writer.Write():
        reason = vtkErrorCode.GetStringFromErrorCode(writer.GetErrorCode())
        raise OSError(
            f"VTK could not write {str(path)!r} ({reason}): see that there is space and that you may write there"
        )


def bezier_grid(
    uh: Function | FunctionSpace | Sequence[Function], cell_data: Mapping[str, npt.ArrayLike] | None = None
) -> pyvista.UnstructuredGrid:
    """Return functions, or only the elements of a space, as Bezier quadrilaterals, one for each bicubic piece.

    Point data are the Bernstein coefficients of the functions, vectors with two components filled up to three. Cell
    data are those given and the numbers of `cell_numbers`.

    Args:
        uh: A function, several on the same elements, or a space.
        cell_data: Values for each cell by name, each of shape (num_cells,).

    Raises:
        TypeError, ValueError: As for `write_vtu`.
    """
    import pyvista

    V, functions = _space_and_functions(uh)
    cells = V.cells
    num_points = element.NUM_FUNCTIONS * cells.num_pieces
    quads = np.arange(num_points).reshape(-1, element.NUM_FUNCTIONS)
    connectivity = np.insert(quads, 0, element.NUM_FUNCTIONS, axis=1)
    types = np.full(cells.num_pieces, pyvista.CellType.BEZIER_QUADRILATERAL, dtype=np.uint8)
    grid = pyvista.UnstructuredGrid(connectivity.ravel(), types, in_space(_bernstein(cells.piece_points)))
    for f in functions:
        values = _bernstein(f.local_coefficients(V))
        grid.point_data[f.name] = in_space(values) if values.shape[1] == 2 else values
    for name, numbers in cell_numbers(cells).items():
        grid.cell_data[name] = numbers
    for name, given in (cell_data or {}).items():
        if name in grid.cell_data:
            raise ValueError(f"cell data called {name!r} are in the file already: choose another name")
        grid.cell_data[name] = one_for_each_cell(cells, name, given)[cells.piece_cell]
    return grid


def cell_numbers(cells: Cells) -> dict[str, Ints]:
    """Return cell, level, face of the control mesh and tag of each piece by name, each of shape (num_pieces,)."""
    cell = cells.piece_cell
    return {"cell": cell, "level": cells.level[cell], "face": cells.face[cell], "tag": cells.tag[cell]}


def in_space(points: Floats) -> Floats:
    """Return points or vectors of shape (n, 2) or (n, 3) with three components; the third of plane ones is zero."""
    return np.pad(points, ((0, 0), (0, 3 - points.shape[1])))


def _bernstein(local: Floats) -> Floats:
    """Return Bernstein coefficients in VTK's order, shape (16 num_pieces, k), from local ones (num_pieces, 16, k)."""
    return (element.TO_BERNSTEIN[VTK_ORDER] @ local).reshape(-1, local.shape[2])


def _space_and_functions(uh: object) -> tuple[FunctionSpace | CellwiseSpace, list[Function]]:
    """Return the functions that a user gave, and the space whose elements they are written on."""
    if isinstance(uh, FunctionSpace):
        return uh, []
    functions = [uh] if isinstance(uh, Function) else list(uh) if isinstance(uh, Iterable) else []
    strange = next((f for f in functions if not isinstance(f, Function)), None if functions else uh)
    if strange is not None:
        raise TypeError(
            f"expected a Function, a sequence of Functions or a FunctionSpace, got {type(strange).__name__}"
        )
    names = [f.name for f in functions]
    if len(set(names)) < len(names):
        raise ValueError(f"the functions are called {names}, but two names in one file must differ: set Function.name")
    spaces = [f.ufl_function_space() for f in functions]
    for V in spaces:
        if all(_is_on_elements_of(V, W) for W in spaces):
            return V, functions
    listed = "\n".join(f"  {f.name!r}: {f.ufl_function_space()}" for f in functions)
    raise ValueError(
        f"the elements of the functions differ:\n{listed}\nCarry the coarser ones over with adapt.transfer, or write "
        f"several files"
    )


def _is_on_elements_of(V: FunctionSpace | CellwiseSpace, W: FunctionSpace | CellwiseSpace) -> bool:
    """Return whether functions of W are known on the elements of V; those that are constant on cells may be coarser."""
    if isinstance(W, CellwiseSpace) or V.hierarchy is None:
        return V.is_refinement_of(W)
    return V.hierarchy.same_as(W.hierarchy) and np.array_equal(V.hierarchy.cap_levels, W.hierarchy.cap_levels)


def one_for_each_cell(cells: Cells, name: str, values: npt.ArrayLike) -> npt.NDArray[np.generic]:
    """Return a user's cell data as an array, shape (num_cells,).

    Raises:
        ValueError: If they are not one number for each cell.
    """
    array = np.asarray(values)
    if array.shape != (cells.num_cells,) or array.dtype.kind not in "biuf":
        raise ValueError(
            f"cell data {name!r} must be one number for each of the {cells.num_cells} cells, but they have shape "
            f"{array.shape} and type {array.dtype}: give those of the same space"
        )
    return array
