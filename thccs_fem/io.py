"""Control meshes from files; results are written by `thccs_fem.vtk.write_vtu`, which is `io.write_vtu` as well.

OBJ, OFF and PLY files are read here, whatever meshio installs or knows: its own readers refuse
good files of these formats. It reads all other formats. A reader returns a `_Surface`; vertices
and faces keep the order of the file.
"""

import codecs
import contextlib
import io
import os
import re
import struct
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

import meshio
import numpy as np
import numpy.typing as npt

from thccs_fem import mesh
from thccs_fem.parallel import by_first_rank
from thccs_fem.polygons import Pair
from thccs_fem.vtk import write_vtu

__all__ = ["read_mesh", "write_vtu"]

type Floats = npt.NDArray[np.float64]
type Indices = npt.NDArray[np.integer]
type Faces = Indices | list[list[int]]
type Line = tuple[int, list[str]]  # number in the file, counted from 1, and words


@dataclass(frozen=True)
class _Surface:
    """What a file holds: vertices (n, 3), faces, and tags of some kinds."""

    vertices: Floats
    faces: Faces
    face_tags: Sequence[int] | Indices | None = None
    edge_tags: Mapping[Pair, int] = field(default_factory=dict)


def read_mesh(
    path: str | os.PathLike[str],
    comm: Any = None,
    *,
    gdim: int | None = None,
    orient: bool = False,
) -> mesh.ControlMesh:
    """Read a control mesh from a file. Collective.

    What is read beyond vertices and faces:

    - OBJ: face tags number the combinations of ``o``, ``g`` and ``usemtl`` from 0, in the order of
      the faces that they first come with. Anything else is left out, creases ("t" lines) too.
    - OFF (also with colours, normals or texture coordinates) and PLY (text or binary): nothing.
    - gmsh: physical groups of surfaces are face tags, those of curves edge tags; 0 is for no group,
      and the first counts where there are more. Points that are of no face are left out.
    - Other formats known to meshio, such as VTK and VTU: nothing, and points that are of no face
      are left out.

    Args:
        path: The file. Its extension tells the format.
        comm: MPI communicator of the mesh. Rank 0 reads the file for all.
        gdim: 2 for a mesh in the plane, which must have the same z everywhere; 3 for one in space;
            None: 2 where z is zero everywhere, otherwise 3.
        orient: Whether to turn faces over as `thccs_fem.mesh.orient` does.

    Returns:
        The mesh, the same on every rank.

    Raises:
        OSError: The file can't be opened.
        ValueError: The format is unknown, the file is not what its format wants (file and line are
            named), or its faces do not make a `thccs_fem.mesh.ControlMesh`.

    Warns:
        UserWarning: As `thccs_fem.mesh.ControlMesh`; or some tagged lines are no edges of the
            surface; or meshio had something to say. On rank 0 alone.
    """
    if gdim not in (None, 2, 3):
        raise ValueError(f"gdim is {gdim!r}; expected 2, 3 or None")
    file = Path(path)
    surface = by_first_rank(comm, lambda: _read(file))
    vertices = _in_its_dimension(file, surface.vertices, gdim)
    try:
        faces = mesh.orient(vertices, surface.faces) if orient else surface.faces
        return mesh.ControlMesh(vertices, faces, surface.face_tags, dict(surface.edge_tags), comm=comm)
    except ValueError as error:
        repair = " (or read_mesh with orient=True)" if "mesh.orient" in str(error) else ""
        raise ValueError(f"{file}: {error}{repair}") from error


def _read(path: Path) -> _Surface:
    surface = _reader(path)(path)
    if not (len(surface.vertices) and len(surface.faces)):
        raise ValueError(
            f"{path}: {len(surface.vertices)} vertices and {len(surface.faces)} faces were found; "
            f"a control mesh is a surface, with some of both"
        )
    return surface


def _reader(path: Path) -> Callable[[Path], _Surface]:
    """Return the reader for the extension of a file."""
    own = {".obj": _read_obj, ".off": _read_off, ".ply": _read_ply}
    others = {name for name in meshio.extension_to_filetypes if name.count(".") == 1} - own.keys()
    extension = path.suffix.lower()
    if extension in own:
        return own[extension]
    if extension in others:
        return _read_with_meshio
    known = ", ".join([*own, *sorted(others)])
    raise ValueError(f"{path}: the extension {extension!r} is unknown; expected one of {known}")


def _in_its_dimension(path: Path, vertices: Floats, gdim: int | None) -> Floats:
    """Return the vertices in 2 coordinates if they lie, or are said to lie, in the plane."""
    z = vertices[:, 2]
    if gdim is None:
        gdim = 3 if z.any() else 2
    if gdim == 2 and np.ptp(z) != 0:
        raise ValueError(
            f"{path}: z goes from {z.min()} to {z.max()}; with gdim=2 it must be the same "
            f"everywhere. Leave gdim out for a surface in space"
        )
    return vertices[:, :gdim]


# Text ---------------------------------------------------------------------------------------------


def _fail(path: Path, line: int, text: str, cause: Exception | None = None) -> NoReturn:
    raise ValueError(f"{path}, line {line}: {text}") from cause


def _bytes(path: Path) -> bytes:
    """Return what is in the file, without a byte order mark."""
    data = path.read_bytes().removeprefix(codecs.BOM_UTF8)
    if not data.strip():
        raise ValueError(f"{path}: the file is empty")
    return data


def _lines(data: bytes) -> list[str]:
    """Return the lines of a text with any line ends."""
    text = data.decode(errors="replace")  # names may be in any encoding; all else is ASCII
    return text.replace("\r\n", "\n").replace("\r", "\n").split("\n")


def _statements(lines: list[str]) -> Iterator[Line]:
    r"""Yield the words of each line that has any, without comments; ``\`` at the end joins lines."""
    joined: list[str] = []
    first = 1
    for number, line in enumerate(lines, start=1):
        text = line.partition("#")[0].rstrip()
        first = first if joined else number
        joined.append(text.removesuffix("\\"))
        if text.endswith("\\") and number < len(lines):
            continue
        words = " ".join(joined).split()
        joined = []
        if words:
            yield first, words


def _coordinates(path: Path, line: int, words: list[str]) -> list[float]:
    """Return the first three words as coordinates: colours, weights or normals may follow."""
    if len(words) < 3:
        _fail(path, line, f"a vertex has {len(words)} coordinates; expected three")
    try:
        return [float(word) for word in words[:3]]
    except ValueError as error:
        _fail(path, line, f"a vertex is {' '.join(words[:3])!r}; expected three numbers", error)


def _integers(path: Path, line: int, words: Sequence[str], what: str) -> list[int]:
    try:
        return [int(word) for word in words]
    except ValueError as error:
        _fail(path, line, f"{what} is {' '.join(words)!r}; expected integers", error)


def _check_corners(path: Path, faces: Faces, lines: list[int], num_vertices: int, base: int) -> None:
    """Raise ValueError for the first face with fewer than three corners, or with one that is none.

    Args:
        path: The file.
        faces: Vertices of each face, from 0.
        lines: Line of each face.
        num_vertices: Number of vertices.
        base: What the file calls the first vertex.
    """
    for corners, line in zip(faces, lines, strict=True):  # as many as were parsed in a loop
        if len(corners) < 3:
            _fail(path, line, f"a face has {len(corners)} corners; expected three or more")
        for corner in (min(corners), max(corners)):
            if not 0 <= corner < num_vertices:
                known = f"{base} to {num_vertices - 1 + base}" if num_vertices else "none"
                _fail(path, line, f"a face has the vertex {corner + base}; vertices are {known}")


# OBJ ----------------------------------------------------------------------------------------------


def _read_obj(path: Path) -> _Surface:
    vertices: list[list[float]] = []
    faces: list[list[int]] = []
    lines: list[int] = []
    tags: list[int] = []
    names = {"o": "", "g": "", "usemtl": ""}
    tag_of: dict[tuple[str, ...], int] = {}
    for line, (keyword, *words) in _statements(_lines(_bytes(path))):  # text comes line by line
        if keyword == "v":
            vertices.append(_coordinates(path, line, words))
        elif keyword == "f":
            faces.append(_obj_face(path, line, words, len(vertices)))
            lines.append(line)
            tags.append(tag_of.setdefault(tuple(names.values()), len(tag_of)))
        elif keyword in names:
            names[keyword] = " ".join(words)
    _check_corners(path, faces, lines, len(vertices), 1)
    return _Surface(np.array(vertices).reshape(-1, 3), faces, tags)


def _obj_face(path: Path, line: int, words: list[str], num_vertices: int) -> list[int]:
    """Return the corners, counted from 0, of a face that comes after so many vertices."""
    what = f"in the face {' '.join(words)!r} the vertex"
    numbers = _integers(path, line, [word.partition("/")[0] for word in words], what)
    wrong = [number for number in numbers if number == 0 or number < -num_vertices]
    if wrong:
        counts = f"OBJ counts from 1, or backwards from -1 to -{num_vertices} here"
        _fail(path, line, f"a face has the vertex {wrong[0]}; {counts}")
    return [number - 1 if number > 0 else number + num_vertices for number in numbers]


# OFF ----------------------------------------------------------------------------------------------


def _read_off(path: Path) -> _Surface:
    rows = list(_statements(_lines(_bytes(path))))
    if not rows:
        raise ValueError(f"{path}: there are only comments in the file")
    counts, rows = _off_counts(path, rows)
    line, (num_vertices, num_faces) = counts
    if len(rows) != num_vertices + num_faces:
        _fail(
            path,
            line,
            f"the header counts {num_vertices} vertices and {num_faces} faces, but {len(rows)} "
            f"lines follow; expected one for each",
        )
    vertices = [_coordinates(path, *row) for row in rows[:num_vertices]]
    faces = [_off_face(path, *row) for row in rows[num_vertices:]]
    _check_corners(path, faces, [number for number, _ in rows[num_vertices:]], num_vertices, 0)
    return _Surface(np.array(vertices).reshape(-1, 3), faces)


def _off_counts(path: Path, rows: list[Line]) -> tuple[tuple[int, list[int]], list[Line]]:
    """Return the line of the counts and the numbers of vertices and faces, and the rows after."""
    (line, (keyword, *counts)), *rows = rows
    # ST: texture coordinates, C: colours, N: normals, all after x y z; 4 and n: other than x y z.
    if not re.fullmatch("(ST)?C?N?OFF", keyword) or counts[:1] == ["BINARY"]:
        begin = " ".join([keyword, *counts])[:60]
        expected = "expected OFF (or COFF, NOFF, STOFF), as text and with three coordinates"
        _fail(path, line, f"the file begins with {begin!r}; {expected}")
    if not counts and rows:
        (line, counts), *rows = rows
    if len(counts) < 2:
        _fail(path, line, "the numbers of vertices and faces are missing after OFF")
    numbers = _integers(path, line, counts[:2], "the count of vertices and faces")
    if min(numbers) < 0:
        _fail(path, line, f"the counts of vertices and faces are {numbers}: one is negative")
    return (line, numbers), rows


def _off_face(path: Path, line: int, words: list[str]) -> list[int]:
    """Return the corners of a face; colours may follow."""
    (size,) = _integers(path, line, words[:1], "the number of corners")
    if not 0 <= size < len(words):
        _fail(path, line, f"a face of {size} corners has {len(words) - 1} numbers: line cut off?")
    return _integers(path, line, words[1 : size + 1], "a face")


# PLY ----------------------------------------------------------------------------------------------

# Codes of the module struct, which NumPy knows too.
_PLY_TYPES = {
    **{"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I"},
    **{"int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I"},
    **{"float": "f", "double": "d", "float32": "f", "float64": "d"},
}
_PLY_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass(frozen=True)
class _PlyProperty:
    """One value, or a list of values after their number."""

    name: str
    code: str
    length_code: str = ""  # of the number of values in a list


@dataclass(frozen=True)
class _PlyElement:
    """Rows of one kind."""

    name: str
    count: int
    properties: list[_PlyProperty] = field(default_factory=list)


@dataclass(frozen=True)
class _PlyHeader:
    order: str  # of the bytes; empty for text
    elements: list[_PlyElement]
    num_lines: int
    num_bytes: int


def _read_ply(path: Path) -> _Surface:
    data = _bytes(path)
    header = _ply_header(path, data)
    properties = {element.name: element.properties for element in header.elements}
    missing = {"x", "y", "z"} - {p.name for p in properties.get("vertex", []) if not p.length_code}
    corners = [
        p.name
        for p in properties.get("face", [])
        if p.name in ("vertex_index", "vertex_indices") and p.length_code and p.code not in "fd"
    ]
    if missing or not corners:
        raise ValueError(
            f"{path}: the header has no x, y and z of vertices, or no list of integers vertex_indices of faces"
        )
    read = _ply_binary if header.order else _ply_text
    columns = read(path, data, header)
    vertices = np.column_stack([columns["vertex"][name] for name in "xyz"]).astype(np.float64)
    return _Surface(vertices, columns["face"][corners[0]])


def _ply_header(path: Path, data: bytes) -> _PlyHeader:
    order: str | None = None
    elements: list[_PlyElement] = []
    start = 0
    for line in range(1, data.count(b"\n") + 1):
        end = data.index(b"\n", start)
        text = data[start:end].decode("ascii", errors="replace").strip()
        start = end + 1
        match text.split():
            case ["ply"] if line == 1:
                pass
            case ["format", kind, "1.0"] if line > 1 and kind in _PLY_ORDERS:
                order = _PLY_ORDERS[kind]
            case ["comment" | "obj_info", *_] if line > 1:
                pass
            case ["element", name, count] if order is not None and count.isdecimal():
                elements.append(_PlyElement(name, int(count)))
            case ["property", kind, name] if elements and kind in _PLY_TYPES:
                elements[-1].properties.append(_PlyProperty(name, _PLY_TYPES[kind]))
            case ["property", "list", length, kind, name] if (
                elements and kind in _PLY_TYPES and _PLY_TYPES.get(length, "f") not in "fd"
            ):
                types = _PLY_TYPES[kind], _PLY_TYPES[length]
                elements[-1].properties.append(_PlyProperty(name, *types))
            case ["end_header"] if order is not None:
                _check_ply_names(path, line, elements)
                return _PlyHeader(order, elements, line, start)
            case _:
                _fail(path, line, f"{text[:60]!r} is not what a PLY header has there")
    raise ValueError(f"{path}: the PLY header has no end (end_header): file cut off?")


def _check_ply_names(path: Path, line: int, elements: list[_PlyElement]) -> None:
    """Raise ValueError unless elements and the properties of each have different names."""
    properties = [[p.name for p in element.properties] for element in elements]
    for names in ([element.name for element in elements], *properties):
        if not names or len(set(names)) < len(names):
            _fail(path, line, "a name is there twice, or an element without properties, above")


def _ply_text(path: Path, data: bytes, header: _PlyHeader) -> dict[str, dict[str, Any]]:
    """Return the values of each element by property."""
    rows = [(number, line.split()) for number, line in enumerate(_lines(data), start=1)]
    rows = [row for row in rows[header.num_lines :] if row[1]]
    total = sum(element.count for element in header.elements)
    if len(rows) != total:
        counts = ", ".join(f"{element.count} {element.name}" for element in header.elements)
        raise ValueError(
            f"{path}: the header counts {counts}, but {len(rows)} lines follow; expected one for each, {total}"
        )
    columns: dict[str, dict[str, Any]] = {}
    for element in header.elements:
        mine, rows = rows[: element.count], rows[element.count :]
        columns[element.name] = _ply_text_rows(path, element, mine)
        if element.name == "face":
            lines = [number for number, _ in mine]
            (count,) = (other.count for other in header.elements if other.name == "vertex")
            for name in columns["face"].keys() & {"vertex_index", "vertex_indices"}:
                _check_corners(path, columns["face"][name], lines, count, 0)
    return columns


def _ply_text_rows(path: Path, element: _PlyElement, rows: list[Line]) -> dict[str, Any]:
    columns: dict[str, list[Any]] = {p.name: [] for p in element.properties}
    for line, words in rows:  # text comes line by line
        rest = iter(words)
        try:
            for p in element.properties:
                kind = float if p.code in "fd" else int
                if p.length_code:
                    size = int(next(rest))
                    columns[p.name].append([kind(next(rest)) for _ in range(size)])
                else:
                    columns[p.name].append(kind(next(rest)))
        except StopIteration:
            _fail(path, line, f"too few values for the properties of a {element.name}")
        except ValueError as error:
            _fail(path, line, f"{error}; expected the properties of a {element.name}", error)
        more = " ".join(rest)
        if more:
            _fail(path, line, f"{more!r} is left after the properties of a {element.name}")
    return columns


def _ply_binary(path: Path, data: bytes, header: _PlyHeader) -> dict[str, dict[str, Any]]:
    """Return the values of each element by property."""
    columns: dict[str, dict[str, Any]] = {}
    start = header.num_bytes
    for element in header.elements:
        try:
            columns[element.name], start = _ply_binary_rows(element, data, start, header.order)
        except struct.error as error:
            raise ValueError(
                f"{path}: the file ends within the {element.count} rows of {element.name} that the "
                f"header counts: cut off, or damaged"
            ) from error
    if data[start:].strip():
        raise ValueError(f"{path}: {len(data) - start} bytes are left after all that the header counts")
    return columns


def _ply_binary_rows(element: _PlyElement, data: bytes, start: int, order: str) -> tuple[dict[str, Any], int]:
    """Return the values of each property, and where the rows end.

    Raises:
        struct.error: The data end before.
    """
    first, _ = _ply_walk(element, data, start, order, min(element.count, 1))
    # Rows are nearly always alike: those of the size of the first are read at once.
    fields: list[tuple[str, str, tuple[int, ...]]] = []
    for i, p in enumerate(element.properties):
        if p.length_code:
            fields.append((f"length {i}", order + p.length_code, ()))
        size = (len(first[p.name][0]),) if p.length_code and element.count else ()
        fields.append((f"value {i}", order + p.code, size))
    row = np.dtype(fields)
    end = start + element.count * row.itemsize
    if end > len(data):
        return _ply_walk(element, data, start, order, element.count)
    table = np.frombuffer(data, row, element.count, start)
    for i, p in enumerate(element.properties):
        if p.length_code and (table[f"length {i}"] != table[f"value {i}"].shape[-1]).any():
            return _ply_walk(element, data, start, order, element.count)
    return {p.name: table[f"value {i}"] for i, p in enumerate(element.properties)}, end


def _ply_walk(element: _PlyElement, data: bytes, start: int, order: str, count: int) -> tuple[dict[str, Any], int]:
    """As `_ply_binary_rows`, row by row and for so many of them: each begins where another ends."""
    columns: dict[str, list[Any]] = {p.name: [] for p in element.properties}
    for _ in range(count):
        for p in element.properties:
            size = 1
            if p.length_code:
                (size,) = struct.unpack_from(order + p.length_code, data, start)
                start += struct.calcsize(order + p.length_code)
            values = struct.unpack_from(f"{order}{size}{p.code}", data, start)
            start += struct.calcsize(f"{order}{size}{p.code}")
            columns[p.name].append(list(values) if p.length_code else values[0])
    return columns, start


# meshio -------------------------------------------------------------------------------------------


def _read_with_meshio(path: Path) -> _Surface:
    found = _meshio_mesh(path)
    blocks = _face_blocks(path, found.cells)
    if not blocks:
        return _Surface(np.zeros((0, 3)), [])
    cells = [np.asarray(found.cells[i].data, dtype=np.int64) for i in blocks]
    corners = np.concatenate([faces.ravel() for faces in cells])
    if corners.min() < 0 or corners.max() >= len(found.points):
        raise ValueError(f"{path}: a face has a point that is not in the file")
    # Points that belong to the geometry alone would be isolated vertices.
    used, numbers = np.unique(corners, return_inverse=True)
    parts = np.split(numbers, np.cumsum([faces.size for faces in cells])[:-1])
    cells = [part.reshape(faces.shape) for part, faces in zip(parts, cells, strict=True)]
    points = np.asarray(found.points, dtype=np.float64)[used]
    groups = [np.abs(group) for group in found.cell_data.get("gmsh:physical", [])]  # < 0: turned
    return _Surface(
        np.pad(points, ((0, 0), (0, 3 - points.shape[1]))),
        np.concatenate(cells) if len({faces.shape[1] for faces in cells}) == 1 else _lists(cells),
        np.concatenate([groups[i] for i in blocks]) if groups else None,
        _tagged_edges(path, found.cells, groups, used, cells) if groups else {},
    )


def _lists(cells: list[Indices]) -> list[list[int]]:
    return [face for faces in cells for face in faces.tolist()]


def _meshio_mesh(path: Path) -> Any:
    """Return the `meshio.Mesh`, and nothing of what meshio prints."""
    _bytes(path)  # an empty or missing file is told of like any other
    printed = io.StringIO()
    try:
        with (
            contextlib.redirect_stdout(printed),
            contextlib.redirect_stderr(printed),
            warnings.catch_warnings(action="ignore"),
        ):
            found = meshio.read(path)
    # It raises whatever parsing comes across, and ends the process where it has no reader left.
    except (Exception, SystemExit) as error:
        reason = " ".join(printed.getvalue().split()) if isinstance(error, SystemExit) else error
        hint = ". Put all that is saved in physical groups, or nothing"
        raise ValueError(
            f"{path}: meshio can't read it: {reason}{hint if 'gmsh:physical' in str(error) else ''}"
        ) from error
    if "Warning" in printed.getvalue():
        _warn(f"{path}: meshio: {' '.join(printed.getvalue().split())}")
    return found


def _warn(text: str) -> None:
    warnings.warn(text, skip_file_prefixes=(str(Path(__file__).parent),))


def _face_blocks(path: Path, blocks: list[Any]) -> list[int]:
    """Return which blocks of cells are faces, polygons all.

    Raises:
        ValueError: There are volumes, or faces that are no polygons.
    """
    volumes = sorted({block.type for block in blocks if block.dim == 3})
    if volumes:
        raise ValueError(
            f"{path}: a volume mesh ({', '.join(volumes)}); a control mesh is a surface. Save the "
            f"faces of its boundary alone"
        )
    polygons = {"triangle", "quad", "polygon"}
    others = sorted({block.type for block in blocks if block.dim == 2} - polygons)
    if others:
        raise ValueError(
            f"{path}: faces of type {', '.join(others)}; expected {', '.join(sorted(polygons))}. "
            f"Save a mesh of first order"
        )
    return [i for i, block in enumerate(blocks) if block.dim == 2]


def _tagged_edges(
    path: Path, blocks: list[Any], groups: list[Indices], used: Indices, cells: list[Indices]
) -> dict[Pair, int]:
    """Return the tags of those lines of the file that are edges of its faces.

    Args:
        path: The file.
        blocks: All cells of the file.
        groups: Tags of each block, 0 for none.
        used: Points of the file that are vertices, ascending.
        cells: Blocks of faces, by vertices.
    """
    which = [i for i, block in enumerate(blocks) if block.type == "line"]
    if not which:
        return {}
    tags = np.concatenate([groups[i] for i in which])
    points = np.concatenate([blocks[i].data for i in which])[tags != 0]
    tags = tags[tags != 0]
    lines = np.sort(np.searchsorted(used, points), axis=1)
    ends = [np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2) for faces in cells]
    low, high = np.sort(np.concatenate(ends), axis=1).T
    edge = np.isin(points, used).all(axis=1)
    edge &= np.isin(lines[:, 0] * used.size + lines[:, 1], low * used.size + high)
    if not edge.all():
        _warn(f"{path}: {(~edge).sum()} tagged lines are edges of no face; they are left out")
    # Backwards, so that the first tag of an edge stays.
    pairs = map(tuple, lines[edge][::-1].tolist())
    return dict(zip(pairs, tags[edge][::-1].tolist(), strict=True))
