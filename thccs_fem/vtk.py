"""Results as VTK files: one Bezier quadrilateral (cell type 77) for each bicubic piece, which is the exact surface.

A Bezier quadrilateral of 16 points is bicubic: its points are the Bernstein coefficients of the piece, and VTK
interpolates data given at them in the same Bernstein basis.  So surface and functions are the computed ones everywhere,
and whoever draws them chooses how finely.

Pieces share no points.  Neighbours agree along their common side, but in different polynomials where one is finer.

Files are written here, some thousand pieces at a time and uncompressed: zlib would take ten times as long to make them
smaller by a third, and VTK's writer wants all that is in a file in memory, twice.  On several ranks each writes its own
cells.
"""

from __future__ import annotations

import math
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO
from xml.sax.saxutils import quoteattr

import numpy as np
import numpy.typing as npt

from thccs_fem import element
from thccs_fem.extraction import Cells
from thccs_fem.fem.function import Function
from thccs_fem.fem.space import CellwiseSpace, FunctionSpace
from thccs_fem.parallel import by_first_rank, gathered, largest, rank_of, size_of, together
from thccs_fem.subdivision import Ints

if TYPE_CHECKING:  # imported where it is needed: it takes its time
    import pyvista

__all__ = ["bezier_grid", "cell_numbers", "in_space", "of_all_ranks", "one_for_each_cell", "owned_pieces", "write_vtu"]

# Our coefficient i + 4 j at each place of VTK: corners, then sides (each towards larger i or j), then inside.
VTK_ORDER = np.array([0, 3, 15, 12, 1, 2, 7, 11, 13, 14, 4, 8, 5, 6, 9, 10])
BEZIER_QUADRILATERAL = 77
CHUNK = 4096  # pieces that are written at a time: 1.5 MB of points
LENGTH = np.dtype(np.uint64)  # of an array, before its numbers

Floats = npt.NDArray[np.float64]
Values = npt.NDArray[Any]
type Rows = Callable[[Ints], Values]  # what is known of some pieces: shape (n,), (n, 16) or (n, 16, k)


def write_vtu(
    filename: str | os.PathLike[str],
    uh: Function | FunctionSpace | Sequence[Function],
    *,
    cell_data: Mapping[str, npt.ArrayLike] | None = None,
) -> None:
    """Write functions, or only the elements of a space, for ParaView and the like; collective.

    See `bezier_grid` for what is there. The name says what is made, on any number of ranks:

    - "u.vtu": one file. Ranks write their cells into it one after the other.
    - "u.pvtu": an index, which is what one opens, and a folder beside it with a file of each rank, written at once.

    The file or index appears when all is complete; an older one stays until then, and whole.

    Args:
        filename: The file, ending in .vtu or .pvtu; its directory must exist.
        uh: A function, several on the same elements, or a space. Functions that are constant on the faces of the
            control mesh, or on coarser cells, may be among several.
        cell_data: Values for each cell that this rank owns by name, such as estimates, each of shape
            (cells.num_owned,), which is (num_cells,) in serial.

    Raises:
        TypeError: If `uh` is none of these.
        ValueError: If the file is not called .vtu or .pvtu, functions have different elements or the same name, or cell
            data have the wrong shape, a name that is taken, or not the same names and types on all ranks.
        OSError: If the file cannot be written.
    """
    path = Path(filename)
    if path.suffix not in (".vtu", ".pvtu"):
        raise ValueError(f"the file is to be called {str(path)!r}, but the name must end in .vtu or .pvtu")
    V, functions = _space_and_functions(uh)
    by_first_rank(V.mesh.comm, lambda: _check_directory(path))
    contents = _contents(V, functions, cell_data, owned_pieces(V.cells))
    write = _write_file if path.suffix == ".vtu" else _write_index_and_pieces
    write(path, contents, V.mesh.comm)


def bezier_grid(
    uh: Function | FunctionSpace | Sequence[Function], cell_data: Mapping[str, npt.ArrayLike] | None = None
) -> pyvista.UnstructuredGrid:
    """Return functions, or only the elements of a space, as Bezier quadrilaterals, one for each bicubic piece.

    Point data are the Bernstein coefficients of the functions, vectors with two components filled up to three. Cell
    data are those given and the numbers of `cell_numbers`. Collective: every rank gets the whole surface.

    Args:
        uh: A function, several on the same elements, or a space.
        cell_data: Values for each cell that this rank owns by name, each of shape (cells.num_owned,).

    Raises:
        TypeError, ValueError: As for `write_vtu`.
    """
    import pyvista

    V, functions = _space_and_functions(uh)
    contents = _contents(V, functions, cell_data, np.arange(V.cells.num_pieces, dtype=np.int32))

    def everywhere(rows: Rows) -> Values:
        values = of_all_ranks(V.cells, rows(contents.places))
        return values.reshape(-1, *values.shape[2:])  # those of pieces one after the other

    points = everywhere(contents.points)
    quads = np.arange(len(points)).reshape(-1, element.NUM_FUNCTIONS)
    connectivity = np.insert(quads, 0, element.NUM_FUNCTIONS, axis=1)
    types = np.full(len(quads), BEZIER_QUADRILATERAL, dtype=np.uint8)
    grid = pyvista.UnstructuredGrid(connectivity.ravel(), types, points)
    for name, rows in contents.point_data.items():
        grid.point_data[name] = everywhere(rows)
    for name, rows in contents.cell_data.items():
        grid.cell_data[name] = everywhere(rows)
    return grid


def cell_numbers(cells: Cells) -> dict[str, Ints]:
    """Return cell, level, face of the control mesh and tag of each piece by name, each of shape (num_pieces,).

    The number of a cell is that in the whole hierarchy, the same on any number of ranks.
    """
    cell = cells.piece_cell
    numbers = cells.partition.cells.numbers
    return {"cell": numbers[cell], "level": cells.level[cell], "face": cells.face[cell], "tag": cells.tag[cell]}


def of_all_ranks(cells: Cells, values: Values) -> Values:
    """Return what each rank knows of its pieces for the pieces of all cells, on every rank; collective.

    Args:
        cells: The cells.
        values: Something for each piece that this rank holds, shape (num_pieces, ...).

    Returns:
        Shape (pieces of all cells, ...), in the order that pieces have in serial.
    """
    comm = cells.hierarchy.mesh.comm
    if size_of(comm) == 1:
        return values
    pieces = owned_pieces(cells)
    numbers = cells.partition.cells.numbers[cells.piece_cell[pieces]]
    of_batches = [0 if batch.operators is None else batch.dofs.shape[1] for batch in cells.batches]
    widths = np.repeat(of_batches, [batch.num_pieces for batch in cells.batches])[pieces]
    order = np.lexsort((gathered(comm, numbers), gathered(comm, widths)))
    return gathered(comm, values[pieces])[order]


def owned_pieces(cells: Cells) -> Ints:
    """Return the pieces of the cells that this rank owns, shape (n,)."""
    return np.flatnonzero(cells.piece_cell < cells.num_owned).astype(np.int32)


def in_space(points: Floats) -> Floats:
    """Return points or vectors of shape (..., 2) or (..., 3) with three components; the third of plane ones is zero."""
    return np.pad(points, (*((0, 0) for _ in points.shape[:-1]), (0, 3 - points.shape[-1])))


def one_for_each_cell(cells: Cells, name: str, values: npt.ArrayLike) -> Values:
    """Return a user's cell data as an array, shape (cells.num_owned,).

    Raises:
        ValueError: If they are not one number for each cell.
    """
    array = np.asarray(values)
    if array.shape != (cells.num_owned,) or array.dtype.kind not in "biuf":
        there = "" if size_of(cells.hierarchy.mesh.comm) == 1 else " that this rank owns"
        raise ValueError(
            f"cell data {name!r} must be one number for each of the {cells.num_owned} cells{there}, but they have "
            f"shape {array.shape} and type {array.dtype}: give those of the same space"
        )
    return array


# ---- What is written -------------------------------------------------------------------------------------------------


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


@dataclass(frozen=True, eq=False)
class _Contents:
    """Numbers on some pieces of a rank, which are named by their places: 0, 1, ...

    Attributes:
        places: All of them, shape (num_pieces,).
        points: Where the 16 points of pieces are, (n, 16, 3).
        point_data: Values at the points by name.
        cell_data: One number for a piece by name.
    """

    places: Ints
    points: Rows
    point_data: Mapping[str, Rows]
    cell_data: Mapping[str, Rows]

    @property
    def sections(self) -> dict[str, dict[str, _Array]]:
        """All of it, as a file has it."""
        topology: dict[str, Rows] = {
            "connectivity": lambda at: element.NUM_FUNCTIONS * at[:, None] + np.arange(16, dtype=at.dtype),
            "offsets": lambda at: element.NUM_FUNCTIONS * (at + 1),
            "types": lambda at: np.full(at.size, BEZIER_QUADRILATERAL, dtype=np.uint8),
        }
        sections = {
            "PointData": self.point_data,
            "CellData": self.cell_data,
            "Points": {"Points": self.points},
            "Cells": topology,
        }
        none = self.places[:0]
        return {
            section: {name: _Array(rows, rows(none)) for name, rows in fields.items()}
            for section, fields in sections.items()
        }


@dataclass(frozen=True, eq=False)
class _Array:
    """Numbers of all pieces.

    Attributes:
        rows: What they are.
        none: What they are for no piece, which has their type and shape.
    """

    rows: Rows
    none: Values

    @property
    def tag(self) -> str:
        """Type, and how many numbers a point or cell has."""
        kind = {"f": "Float", "i": "Int", "u": "UInt"}[self.none.dtype.kind]
        components = self.none.shape[2] if self.none.ndim == 3 else 1
        return f'type="{kind}{8 * self.none.dtype.itemsize}" NumberOfComponents="{components}"'

    def num_bytes(self, num_pieces: int) -> int:
        """Number of bytes for so many pieces."""
        return num_pieces * self.none.dtype.itemsize * math.prod(self.none.shape[1:])


def _contents(
    V: FunctionSpace | CellwiseSpace,
    functions: Sequence[Function],
    cell_data: Mapping[str, npt.ArrayLike] | None,
    pieces: Ints,
) -> _Contents:
    """Return what there is on some of the pieces that this rank holds; collective."""
    cells = V.cells
    nodes = np.concatenate([batch.nodes for batch in cells.batches])
    is_small = element.NUM_FUNCTIONS * largest(V.mesh.comm, pieces.size) <= np.iinfo(np.int32).max
    return _Contents(
        places=np.arange(pieces.size, dtype=np.int32 if is_small else np.int64),
        points=lambda at: in_space(_bernstein(cells.points[nodes[pieces[at]]])),
        point_data={f.name: _at_points(f.local_coefficients(V), pieces) for f in functions},
        cell_data={name: _at(array, pieces) for name, array in _numbers_and_given(cells, cell_data or {}).items()},
    )


def _at_points(local: Floats, pieces: Ints) -> Rows:
    def rows(at: Ints) -> Values:
        values = _bernstein(local[pieces[at]])
        return values[..., 0] if values.shape[2] == 1 else in_space(values) if values.shape[2] == 2 else values

    return rows


def _at(array: Values, pieces: Ints) -> Rows:
    return lambda at: array[pieces[at]]


def _bernstein(local: Floats) -> Floats:
    """Return Bernstein coefficients in VTK's order from local ones, both of shape (n, 16, k)."""
    return element.TO_BERNSTEIN[VTK_ORDER] @ local


def _numbers_and_given(cells: Cells, cell_data: Mapping[str, npt.ArrayLike]) -> dict[str, Values]:
    """Return the cell data of each piece by name, ours and the user's; collective."""
    comm, numbers = cells.hierarchy.mesh.comm, cell_numbers(cells)
    taken = next((name for name in cell_data if name in numbers), None)
    if taken is not None:
        raise ValueError(f"cell data called {taken!r} are in the file already: choose another name")
    given = together(comm, lambda: {name: _stored(cells, name, array) for name, array in cell_data.items()})
    types = [(name, array.dtype.str) for name, array in given.items()]
    for rank, others in enumerate([types] if size_of(comm) == 1 else comm.allgather(types)):
        if others != types:
            raise ValueError(
                f"cell data are {types} on rank {comm.rank}, but {others} on rank {rank}: give all ranks the same "
                f"names in the same order, and values of the same type"
            )
    return {**numbers, **{name: array[cells.piece_cell] for name, array in given.items()}}


def _stored(cells: Cells, name: str, values: npt.ArrayLike) -> Values:
    """Return a user's cell data for all cells that this rank holds, in a type that VTK has; ghosts have zero."""
    array = one_for_each_cell(cells, name, values)
    has_type = array.dtype.kind in "iu" or array.dtype.itemsize in (4, 8)
    kept = array.dtype.newbyteorder("=") if has_type else np.dtype(np.uint8 if array.dtype.kind == "b" else np.float64)
    held = np.zeros(cells.num_cells, dtype=kept)
    held[: cells.num_owned] = array
    return held


# ---- Files -----------------------------------------------------------------------------------------------------------


def _write_file(path: Path, contents: _Contents, comm: Any) -> None:
    """Write one file with the pieces of all ranks, which append theirs one after the other; collective."""
    sizes = [int(size) for size in gathered(comm, np.array([contents.places.size]))]
    with _drafts(path, comm) as folder:
        draft = folder / path.name

        def append(rank: int) -> None:
            if rank == rank_of(comm):
                with _telling(path), draft.open("ab") as file:
                    if rank == 0:
                        file.write(_head(contents, sizes).encode())
                    _write_data(file, contents)
                    if rank == len(sizes) - 1:
                        file.write(b"\n</AppendedData>\n</VTKFile>\n")

        for rank in range(len(sizes)):
            together(comm, partial(append, rank))
        by_first_rank(comm, lambda: draft.replace(path))


def _write_index_and_pieces(path: Path, contents: _Contents, comm: Any) -> None:
    """Write a file of each rank, then the index of them; collective."""
    # One of two folders, in turn: the files that an older index names stay until the new one is in its place.
    new, old = (path.with_name(f"{path.stem}_pieces{k}") for k in (0, 1))
    if by_first_rank(comm, lambda: _names(path, new)):
        new, old = old, new
    pieces = [new / f"{path.stem}_{rank}.vtu" for rank in range(size_of(comm))]
    outdated = new
    try:
        by_first_rank(comm, lambda: _make_empty(new))
        together(comm, lambda: _write_file(pieces[rank_of(comm)], contents, None))
        by_first_rank(comm, lambda: _write_index(path, contents, pieces))
        outdated = old
    finally:
        if rank_of(comm) == 0:
            _remove(outdated)


def _names(index: Path, folder: Path) -> bool:
    """Return whether there is an index that names a file in a folder."""
    begin = quoteattr(f"{folder.name}/").strip("\"'")
    return index.is_file() and begin in index.read_text(encoding="utf-8", errors="replace")


def _make_empty(folder: Path) -> None:
    _remove(folder)
    folder.mkdir(exist_ok=True)


def _remove(folder: Path) -> None:
    """Remove a folder of pieces, unless someone keeps other files there."""
    with suppress(OSError):
        for piece in folder.glob("*.vtu"):
            piece.unlink()
        folder.rmdir()


def _write_index(path: Path, contents: _Contents, pieces: Sequence[Path]) -> None:
    lines = ['<PUnstructuredGrid GhostLevel="0">']
    for section, fields in contents.sections.items():
        if section != "Cells":
            arrays = (f"<PDataArray Name={quoteattr(name)} {array.tag}/>" for name, array in fields.items())
            lines += [f"<P{_opening(section, fields)}>", *arrays, f"</P{section}>"]
    lines += [f"<Piece Source={quoteattr(piece.relative_to(path.parent).as_posix())}/>" for piece in pieces]
    lines.append("</PUnstructuredGrid>")
    with _drafts(path, None) as folder, _telling(path):
        draft = folder / path.name
        draft.write_text("\n".join([_first_line("PUnstructuredGrid"), *lines, "</VTKFile>\n"]), encoding="utf-8")
        draft.replace(path)


@contextmanager
def _drafts(path: Path, comm: Any) -> Iterator[Path]:
    """Make a directory beside a file, where the draft gets the usual permissions; it goes away whatever happens."""
    folder = Path(by_first_rank(comm, lambda: tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent)))
    try:
        yield folder
    finally:
        if rank_of(comm) == 0:
            shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def _telling(path: Path) -> Iterator[None]:
    """Tell which file could not be written, and not the draft of it."""
    try:
        yield
    except OSError as error:
        raise type(error)(
            f"{str(path)!r} could not be written ({error.strerror or error}): see that there is space and that you may "
            f"write there"
        ) from error


def _check_directory(path: Path) -> None:
    if not path.parent.is_dir():
        raise FileNotFoundError(f"there is no directory {str(path.parent)!r} for {path.name!r}; make it first")


# ---- The format: VTK's XML, with the numbers as they are after it ----------------------------------------------------


def _head(contents: _Contents, sizes: Sequence[int]) -> str:
    """Return what stands before the numbers: where those of each array begin, for pieces of ranks with such sizes."""
    lines, offset = [_first_line("UnstructuredGrid"), "<UnstructuredGrid>"], 0
    for size in sizes:
        lines.append(f'<Piece NumberOfPoints="{element.NUM_FUNCTIONS * size}" NumberOfCells="{size}">')
        for section, fields in contents.sections.items():
            lines.append(f"<{_opening(section, fields)}>")
            for name, array in fields.items():
                lines.append(f'<DataArray Name={quoteattr(name)} {array.tag} format="appended" offset="{offset}"/>')
                offset += LENGTH.itemsize + array.num_bytes(size)
            lines.append(f"</{section}>")
        lines.append("</Piece>")
    return "\n".join([*lines, "</UnstructuredGrid>", '<AppendedData encoding="raw">', "_"])


def _write_data(file: BinaryIO, contents: _Contents) -> None:
    """Write the numbers of this rank, before each array its length in bytes."""
    places = contents.places
    for fields in contents.sections.values():
        for array in fields.values():
            file.write(np.array(array.num_bytes(places.size), dtype=LENGTH).tobytes())
            for begin in range(0, places.size, CHUNK):
                file.write(np.ascontiguousarray(array.rows(places[begin : begin + CHUNK])).data)


def _first_line(kind: str) -> str:
    order = "LittleEndian" if sys.byteorder == "little" else "BigEndian"
    return f'<VTKFile type="{kind}" version="1.0" byte_order="{order}" header_type="UInt64">'


def _opening(section: str, arrays: Mapping[str, _Array]) -> str:
    """Return how a section begins; the first function is what viewers show first."""
    first = next(iter(arrays), None)
    return section if section != "PointData" or first is None else f"{section} Scalars={quoteattr(first)}"
