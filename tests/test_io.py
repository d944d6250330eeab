"""Mesh files: every form of each format, and what is said of malformed ones."""

import contextlib
import os
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
from ranks import on_ranks

from thccs_fem import io
from thccs_fem.io import read_mesh
from thccs_fem.mesh import ControlMesh

CUBE = [(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)]
CUBE_FACES = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
PLANE = [(0, 0), (1, 0), (2, 0), (0, 1), (1, 1), (2, 1), (0.5, 2)]
PLANE_FACES = [(0, 1, 4, 3), (1, 2, 5, 4), (3, 4, 6)]

V = "".join(f"v {x} {y} {z}\n" for x, y, z in CUBE)
F = "".join(f"f {' '.join(str(v + 1) for v in face)}\n" for face in CUBE_FACES)
OFF_V = "".join(f"{x} {y} {z}\n" for x, y, z in CUBE)
OFF_F = "".join(f"4 {a} {b} {c} {d}\n" for a, b, c, d in CUBE_FACES)
PLY = """ply
format {}
comment made by hand
element vertex 8
property float x
property double y
property int z
element face 6
property list uchar int vertex_indices
end_header
"""


@pytest.fixture
def write(tmp_path: Path) -> Callable[[str, str | bytes], Path]:
    """Return a function that writes a file."""

    def write(name: str, content: str | bytes) -> Path:
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write


type Write = Callable[[str, str | bytes], Path]


def faces(msh: ControlMesh) -> list[tuple[int, ...]]:
    return [tuple(face.tolist()) for face in np.split(msh.face_vertices, msh.face_offsets[1:-1])]


def assert_cube(msh: ControlMesh) -> None:
    assert msh.vertices.tolist() == [list(vertex) for vertex in CUBE]
    assert faces(msh) == CUBE_FACES


def error(path: Path, **options: Any) -> str:
    """Return what is said of the file after its name."""
    with pytest.raises(ValueError, match=f"^{re.escape(str(path))}") as caught:
        read_mesh(path, **options)
    return str(caught.value).removeprefix(str(path))


# OBJ


def obj_faces(form: str) -> str:
    return "".join("f " + " ".join(form.format(v=v + 1, back=v - 8) for v in face) + "\n" for face in CUBE_FACES)


@pytest.mark.parametrize("form", ["{v}", "{v}/3", "{v}//2", "{v}/5/7", "{back}", "{back}/-1/-2"])
def test_obj_corners(write: Write, form: str) -> None:
    assert_cube(read_mesh(write("cube.obj", V + obj_faces(form))))


@pytest.mark.parametrize(
    "text",
    [
        "\ufeff# made by hand\n" + V + F,
        (V + F).replace("\n", "\r\n"),
        (V + F).replace("\n", "\r"),
        V + F.rstrip(),
        V.replace("\n", " # a vertex\n\n\t\n") + F.replace("f ", "  f\t"),
        V + F.replace(" 3 4 ", " \\\n3 4\\\n "),
        V.replace("\n", " 0.5 0.25 1\n") + F,  # colours
        V.replace("\n", " 1.0\n") + F,  # weights
        "mtllib a.mtl\nvt 0 0\nvn 0 0 1\n" + V + "s off\n" + F + "l 1 2\np 1\nt crease 1/1/0 0 1 2.0\n",
        F + V,  # faces may come first
        V + F + "# no end \\",
    ],
    ids="bom crlf cr no-end comments continued colours weights rest faces-first backslash".split(),
)
def test_obj_text(write: Write, text: str) -> None:
    msh = read_mesh(write("CUBE.OBJ", text))
    assert_cube(msh)
    assert msh.face_tags.tolist() == [0] * 6


def test_obj_negative_indices_count_from_the_vertices_read_so_far(write: Write) -> None:
    text = "v 0 0 0\nv 1 0 0\nv 1 1 0\nf -3 -2 -1\nv 0 1 0\nf -4 -2 -1\n"
    assert faces(read_mesh(write("two.obj", text))) == [(0, 1, 2), (0, 2, 3)]


def test_obj_groups_become_face_tags(write: Write) -> None:
    a, b, c, d, e, f = F.splitlines()
    lines = ["g unused", "o A", a, "usemtl red", b, "g x y", c, "usemtl", "usemtl  red", d]
    lines += ["usemtl blue", e, "g unused", "usemtl red", f]
    msh = read_mesh(write("cube.obj", V + "\n".join(lines)))
    assert msh.face_tags.tolist() == [0, 1, 2, 2, 3, 1]


def test_obj_in_another_encoding(write: Write) -> None:
    assert_cube(read_mesh(write("cube.obj", "o Würfel\n".encode("latin-1") + (V + F).encode())))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", ": the file is empty"),
        ("\n \n", ": the file is empty"),
        ("# nothing\n", ": 0 vertices and 0 faces were found; a control mesh is a surface"),
        (V, ": 8 vertices and 0 faces were found"),
        (V + "l 1 2 3\n", ": 8 vertices and 0 faces were found"),
        ("v 0 0 0\nv 1 0\n", ", line 2: a vertex has 2 coordinates; expected three"),
        ("v 0 0 0\nv 1,0 0 0\n", ", line 2: a vertex is '1,0 0 0'; expected three numbers"),
        (V + "f 1 2 x\n", ", line 9: in the face '1 2 x' the vertex is '1 2 x'; expected integers"),
        (V + "f 1 2 3.5\n", ", line 9: in the face '1 2 3.5' the vertex"),
        (V + "f 1 2 /3\n", ", line 9: in the face '1 2 /3' the vertex is '1 2 '; expected"),
        (V + "f 1 2\n", ", line 9: a face has 2 corners; expected three or more"),
        (V + "\nf 1 2 9\n", ", line 10: a face has the vertex 9; vertices are 1 to 8"),
        (V + "f 0 1 2\n", ", line 9: a face has the vertex 0; OBJ counts from 1, or backwards from"),
        (V + "f 1 2 -9\n", ", line 9: a face has the vertex -9; OBJ counts from 1"),
        ("f 1 2 3\n", ", line 1: a face has the vertex 1; vertices are none"),
        ("v 0 0 nan\n" + V + F, ": vertices 0 have a coordinate that is NaN"),
        ("v 5 5 5\n" + V + obj_faces("{back}"), ": vertices 0 are isolated"),
        (V + "f 1 \\\n 2 \\\n x", ", line 9: in the face '1 2 x'"),
    ],
)
def test_malformed_obj(write: Write, text: str, message: str) -> None:
    assert error(write("bad.obj", text)).startswith(message)


def test_obj_cut_off_between_two_lines_is_an_open_mesh(write: Write) -> None:
    msh = read_mesh(write("cut.obj", V + F[: -len("f 2 4 8 6\n")]))
    assert [loop.tolist() for loop in msh.boundary_loops] == [[1, 5, 7, 3]]


# OFF


@pytest.mark.parametrize(
    "text",
    [
        "OFF\n8 6 12\n" + OFF_V + OFF_F,
        "OFF 8 6 12\n" + OFF_V + OFF_F,
        "OFF # a cube\n\n# counts\n8 6\n" + OFF_V.replace("\n", " # v\n\n") + OFF_F,
        ("\ufeffOFF\n8 6 0\n" + OFF_V + OFF_F).replace("\n", "\r\n"),
        "COFF\n8 6 12\n" + OFF_V.replace("\n", " 255 0 0 255\n") + OFF_F,
        "NOFF\n8 6 12\n" + OFF_V.replace("\n", " 0 0 1\n") + OFF_F,
        "STCNOFF\n8 6 12\n" + OFF_V.replace("\n", " 0 0 1 1 1 1 0.5 0.5\n") + OFF_F,
        "OFF\n8 6 12\n" + OFF_V + OFF_F.replace("\n", " 0.5 0.5 0.5\n"),  # colours of faces
    ],
    ids="plain one-line comments crlf colours normals all face-colours".split(),
)
def test_off(write: Write, text: str) -> None:
    assert_cube(read_mesh(write("cube.off", text)))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", ": the file is empty"),
        ("# OFF\n", ": there are only comments in the file"),
        ("8 6 12\n" + OFF_V, ", line 1: the file begins with '8 6 12'; expected OFF"),
        ("OFF BINARY\n8 6 12\n", ", line 1: the file begins with 'OFF BINARY'; expected OFF"),
        ("4OFF\n8 6 12\n", ", line 1: the file begins with '4OFF'; expected OFF"),
        ("nOFF\n3 8 6 12\n", ", line 1: the file begins with 'nOFF'"),
        ("OFF\n", ", line 1: the numbers of vertices and faces are missing"),
        ("OFF\n8\n", ", line 2: the numbers of vertices and faces are missing"),
        ("OFF\n\n8 six\n", ", line 3: the count of vertices and faces is '8 six'; expected integers"),
        ("OFF\n-1 6 0\n", ", line 2: the counts of vertices and faces are [-1, 6]: one is"),
        (
            "OFF\n8 6 12\n" + OFF_V + OFF_F[:-10],
            ", line 2: the header counts 8 vertices and 6 faces, but 13 lines follow; expected one",
        ),
        ("OFF\n8 5 12\n" + OFF_V + OFF_F, ", line 2: the header counts 8 vertices and 5 faces, but"),
        ("OFF\n7 7 12\n" + OFF_V + OFF_F, ", line 10: a face has 1 corners; expected three or more"),
        ("OFF\n9 5 12\n" + OFF_V + OFF_F, ": vertices 8 are isolated"),
        ("OFF\n8 6 12\n" + OFF_V + OFF_F[:-3] + "\n", ", line 16: a face of 4 corners has 3 numbers"),
        ("OFF\n8 6 12\n" + OFF_V.replace("1", "one") + OFF_F, ", line 4: a vertex is 'one 0 0'"),
        ("OFF\n8 6 12\n" + OFF_V + OFF_F.replace("4 ", "four ", 1), ", line 11: the number of"),
        ("OFF\n8 6 12\n" + OFF_V + OFF_F.replace("2 3 1", "2 3 a"), ", line 11: a face is '0 2 3 a'"),
        ("OFF\n8 6 12\n" + OFF_V + OFF_F.replace("2 3 1", "2 3 8"), ", line 11: a face has the vert"),
        ("OFF\n8 1 0\n" + OFF_V + "2 0 1\n", ", line 11: a face has 2 corners"),
        ("OFF\n8 0 0\n" + OFF_V, ": 8 vertices and 0 faces were found"),
    ],
)
def test_malformed_off(write: Write, text: str, message: str) -> None:
    assert error(write("bad.off", text)).startswith(message)


# PLY


def ply_body(order: str, extra: bool = False) -> bytes:
    """Return the rows of the cube as float, double, int and uchar, 4 int."""
    vertices = [struct.pack(f"{order}fdi", *vertex) for vertex in CUBE]
    if extra:  # a colour, then a list
        vertices = [row + struct.pack(f"{order}B", 7) for row in vertices]
    quads = [struct.pack(f"{order}B4i", 4, *face) for face in CUBE_FACES]
    if extra:
        quads = [struct.pack(f"{order}Hd", 1, 0.5) + row + b"\3" for row in quads]
    return b"".join(vertices + quads)


EXTRA = (
    PLY.replace("int z\n", "int z\nproperty uchar red\n")
    .replace("6\n", "6\nproperty list ushort double weights\n")
    .replace("indices\n", "index\nproperty char flag\n")
)
ORDERS = {"binary_little_endian 1.0": "<", "binary_big_endian 1.0": ">"}


@pytest.mark.parametrize("line_end", ["\n", "\r\n"])
def test_ply_text(write: Write, line_end: str) -> None:
    text = PLY.format("ascii 1.0") + OFF_V + OFF_F
    assert_cube(read_mesh(write("cube.ply", text.replace("\n", line_end))))


def test_ply_text_with_other_properties_and_elements(write: Write) -> None:
    header = EXTRA.format("ascii 1.0").replace("end_", "element edge 1\nproperty int a\nend_")
    rows = "".join(f"2 0.5 1.5 {row} -1\n" for row in OFF_F.splitlines())
    text = header + OFF_V.replace("\n", " 255\n") + "\n" + rows + "3\n"
    assert_cube(read_mesh(write("cube.ply", text)))


@pytest.mark.parametrize("kind", ORDERS)
def test_ply_binary(write: Write, kind: str) -> None:
    data = PLY.format(kind).encode() + ply_body(ORDERS[kind])
    assert_cube(read_mesh(write("cube.ply", data)))
    assert_cube(read_mesh(write("end.ply", data + b"\n")))


@pytest.mark.parametrize("kind", ORDERS)
def test_ply_binary_with_other_properties(write: Write, kind: str) -> None:
    data = EXTRA.format(kind).encode() + ply_body(ORDERS[kind], extra=True)
    assert_cube(read_mesh(write("cube.ply", data)))


@pytest.mark.parametrize("first", [0, 2])
@pytest.mark.parametrize("kind", [*ORDERS, "ascii 1.0"])
def test_ply_faces_of_several_sizes(write: Write, kind: str, first: int) -> None:
    # The largest face at the front or at the end: both ends of reading all rows as the first.
    rows = PLANE_FACES[first:] + PLANE_FACES[:first]
    header = PLY.format(kind).replace("vertex 8", "vertex 7").replace("face 6", "face 3")
    header = header.replace("property int z", "property float32 z")
    if kind == "ascii 1.0":
        body = "".join(f"{x} {y} 0.5\n" for x, y in PLANE).encode()
        body += "".join(f"{len(r)} {' '.join(map(str, r))}\n" for r in rows).encode()
    else:
        body = b"".join(struct.pack(f"{ORDERS[kind]}fdf", x, y, 0.5) for x, y in PLANE)
        body += b"".join(struct.pack(f"{ORDERS[kind]}B{len(r)}i", len(r), *r) for r in rows)
    msh = read_mesh(write("plane.ply", header.encode() + body))
    assert msh.vertices.tolist() == [[x, y, 0.5] for x, y in PLANE]
    assert faces(msh) == rows


@pytest.mark.parametrize("name", ["char", "uchar", "short", "ushort", "int", "uint", "int8", "uint32"])
def test_ply_types_of_indices(write: Write, name: str) -> None:
    code = {"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I"}
    code |= {"int8": "b", "uint32": "I"}
    header = PLY.format("binary_big_endian 1.0").replace("uchar int vertex", f"int {name} vertex")
    body = ply_body(">")[: 8 * 16]
    body += b"".join(struct.pack(f">i4{code[name]}", 4, *face) for face in CUBE_FACES)
    assert_cube(read_mesh(write("cube.ply", header.encode() + body)))


TEXT_PLY = PLY.format("ascii 1.0")
BINARY_PLY = PLY.format("binary_little_endian 1.0")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", ": the file is empty"),
        (TEXT_PLY[4:], ", line 1: 'format ascii 1.0' is not what a PLY header has there"),
        (TEXT_PLY[:60], ": the PLY header has no end (end_header)"),
        (TEXT_PLY.replace("ascii 1.0", "ascii 2.0"), ", line 2: 'format ascii 2.0' is not what"),
        (TEXT_PLY.replace("ascii", "binary"), ", line 2: 'format binary 1.0'"),
        (TEXT_PLY.replace("format ascii 1.0\n", ""), ", line 3: 'element vertex 8'"),
        (TEXT_PLY.replace("vertex 8", "vertex eight"), ", line 4: 'element vertex eight'"),
        (TEXT_PLY.replace("float x", "quadruple x"), ", line 5: 'property quadruple x'"),
        (TEXT_PLY.replace("list uchar", "list float"), ", line 9: 'property list float int vert"),
        (TEXT_PLY.replace(" z\n", " y\n"), ", line 10: a name is there twice, or an element without"),
        (TEXT_PLY.replace("element face 6", "element a 1\nelement face 6"), ", line 11: a name is"),
        (TEXT_PLY.replace("element face", "element vertex"), ", line 10: a name is there twice"),
        (TEXT_PLY.replace(" z\n", " w\n"), ": the header has no x, y and z of vertices, or no list"),
        (TEXT_PLY.replace("vertex_indices", "corners"), ": the header has no x, y and z of"),
        (TEXT_PLY.replace("uchar int v", "uchar float v"), ": the header has no x, y and z of"),
        (TEXT_PLY.replace("element vertex", "element node"), ": the header has no x, y and z of"),
        (TEXT_PLY.replace("element face", "element tristrips"), ": the header has no x, y and z"),
        (TEXT_PLY + OFF_V + OFF_F[:-10], ": the header counts 8 vertex, 6 face, but 13 lines follow"),
        (TEXT_PLY + OFF_V + OFF_F + "3 0 1 2\n", ": the header counts 8 vertex, 6 face, but 15"),
        (TEXT_PLY + OFF_V + OFF_F[:-3] + "\n", ", line 24: too few values for the properties of a f"),
        (TEXT_PLY + "0 0\n" + OFF_V[6:] + OFF_F, ", line 11: too few values for the properties of a v"),
        (TEXT_PLY + OFF_V.replace("\n", " 9\n") + OFF_F, ", line 11: '9' is left after the properties"),
        (TEXT_PLY + "a 0 0\n" + OFF_V[6:] + OFF_F, ", line 11: could not convert string to float: 'a'"),
        (TEXT_PLY + OFF_V + "4 0 2 3 1.5\n" + OFF_F[10:], ", line 19: invalid literal for int()"),
        (TEXT_PLY + OFF_V + "4 0 2 3 8\n" + OFF_F[10:], ", line 19: a face has the vertex 8; vertices"),
        (TEXT_PLY + OFF_V + "2 0 2\n" + OFF_F[10:], ", line 19: a face has 2 corners; expected"),
        (BINARY_PLY.encode() + ply_body("<")[:-1], ": the file ends within the 6 rows of face that"),
        (BINARY_PLY.encode() + ply_body("<")[:60], ": the file ends within the 8 rows of vertex"),
        (BINARY_PLY.encode() + ply_body("<") + b"123", ": 3 bytes are left after all that the header"),
        (
            BINARY_PLY.encode() + ply_body("<")[:-4] + struct.pack("<i", 8),
            ": faces 5 have corners out of range (face 5: 8): vertices are 0 to 7",
        ),
        (
            TEXT_PLY.replace("vertex 8", "vertex 0").replace("face 6", "face 0"),
            ": 0 vertices and 0 faces were found",
        ),
        (
            BINARY_PLY.replace("vertex 8", "vertex 0").replace("face 6", "face 0"),
            ": 0 vertices and 0 faces were found",
        ),
    ],
)
def test_malformed_ply(write: Write, text: str | bytes, message: str) -> None:
    assert error(write("bad.ply", text)).startswith(message)


# meshio's formats


def write_meshio(path: Path, cells: list[Any], points: Any = PLANE, **options: Any) -> Path:
    coordinates = np.array(points, dtype=float)
    coordinates = np.pad(coordinates, ((0, 0), (0, 3 - coordinates.shape[1])))
    data = options.pop("cell_data", {})
    with contextlib.redirect_stderr(None), contextlib.redirect_stdout(None):
        meshio.Mesh(coordinates, cells, cell_data=data).write(path, **options)
    return path


QUADS = ("quad", PLANE_FACES[:2])
TRIANGLES = ("triangle", PLANE_FACES[2:])


@pytest.mark.parametrize("extension", ["vtk", "vtu", "inp", "mesh"])
def test_formats_of_meshio(tmp_path: Path, extension: str) -> None:
    binary = {"binary": True} if extension in ("vtk", "vtu") else {}
    path = write_meshio(tmp_path / f"plane.{extension}", [QUADS, TRIANGLES], **binary)
    msh = read_mesh(path)
    assert msh.vertices.tolist() == [list(map(float, vertex)) for vertex in PLANE]
    assert faces(msh) == PLANE_FACES
    assert msh.face_tags.tolist() == [0, 0, 0]


@pytest.mark.parametrize("extension", ["vtk", "vtu"])
def test_polygons(tmp_path: Path, extension: str) -> None:
    points = [(0, 0), (1, 0), (1.5, 1), (0.5, 2), (-0.5, 1), (2, 0)]
    path = write_meshio(
        tmp_path / f"a.{extension}", [("polygon", [[0, 1, 2, 3, 4]]), ("triangle", [[1, 5, 2]])], points
    )
    assert faces(read_mesh(path)) == [(0, 1, 2, 3, 4), (1, 5, 2)]


GROUPS = [np.array([3, 3]), np.array([4]), np.array([7, 8, 7, 0])]
LINES = ("line", [[1, 0], [1, 2], [0, 1], [6, 3]])


@pytest.mark.parametrize("binary", [True, False])
def test_gmsh_groups_are_tags_and_points_of_no_face_are_dropped(tmp_path: Path, binary: bool) -> None:
    points = [(9, 9), *PLANE[:3], (8, 8), *PLANE[3:]]
    new = np.array([1, 2, 3, 5, 6, 7, 8])
    blocks = [(kind, new[np.array(cells)]) for kind, cells in (QUADS, TRIANGLES, LINES)]
    data = {"gmsh:physical": GROUPS, "gmsh:geometrical": GROUPS}
    options: dict[str, Any] = {"file_format": "gmsh22", "binary": binary, "cell_data": data}
    msh = read_mesh(write_meshio(tmp_path / "a.msh", blocks, points, **options))
    assert msh.vertices.tolist() == [list(map(float, vertex)) for vertex in PLANE]
    assert faces(msh) == PLANE_FACES
    assert msh.face_tags.tolist() == [3, 3, 4]
    assert msh.edge_tags == {(0, 1): 7, (1, 2): 8}  # the first of two, and none where it is 0


def test_gmsh_lines_off_the_surface_are_warned_of(tmp_path: Path) -> None:
    lines = ("line", [[0, 1], [0, 7], [0, 4]])
    data = {"gmsh:physical": [np.array([1, 1]), np.array([5, 6, 6])]}
    data |= {"gmsh:geometrical": data["gmsh:physical"]}
    path = write_meshio(
        tmp_path / "a.msh", [QUADS, lines], [*PLANE[:6], (4, 4), (5, 5)], file_format="gmsh22", cell_data=data
    )
    with pytest.warns(UserWarning, match=r"a\.msh: 2 tagged lines are edges of no face") as caught:
        msh = read_mesh(path)
    assert msh.edge_tags == {(0, 1): 5}
    assert caught[0].filename == __file__  # not a line of the library


@pytest.mark.parametrize(
    ("cells", "message"),
    [
        ([("hexahedron", [range(8)])], ": a volume mesh (hexahedron); a control mesh is a surface"),
        ([("quad9", [range(9)])], ": faces of type quad9; expected polygon, quad, triangle. Save a"),
        ([("line", [[0, 1]])], ": 0 vertices and 0 faces were found"),
        ([("quad", [[0, 1, 3, 2], [0, 2, 6, 9]])], ": a face has a point that is not in the file"),
    ],
)
def test_cells_that_are_no_surface(tmp_path: Path, cells: list[Any], message: str) -> None:
    points = [*CUBE, (2, 2, 2)]
    path = write_meshio(tmp_path / "a.vtk", [(kind, np.array(c)) for kind, c in cells], points)
    assert error(path).startswith(message)


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("a.msh", "", "the file is empty"),
        ("a.msh", "hello\n", "meshio can't read it: Error: Couldn't read file"),
        ("a.msh", "$MeshFormat\n4.1 0 8\n$EndMeshFormat\n$Nodes\n1 4 1 4\n", "meshio can't read it"),
        ("a.vtu", "<VTKFile", "meshio can't read it: Error: Couldn't read file"),
        ("a.vtk", "# vtk DataFile Version 3.0\nx\nASCII\nDATASET POLYDATA\n", "meshio can't read it: "),
    ],
)
def test_meshio_neither_exits_nor_prints(
    write: Write, capfd: pytest.CaptureFixture[str], name: str, content: str, reason: str
) -> None:
    assert error(write(name, content)).startswith(f": {reason}")
    assert capfd.readouterr() == ("", "")


def test_gmsh_file_with_groups_on_a_part_only(write: Write) -> None:
    # Two square surfaces, one of them in a group: meshio can't hold that.
    text = (
        "$MeshFormat\n4.1 0 8\n$EndMeshFormat\n$Entities\n0 0 2 0\n"
        "1 0 0 0 1 1 0 1 5 0\n2 1 0 0 2 1 0 0 0\n$EndEntities\n"
        "$Nodes\n1 6 1 6\n2 1 0 6\n1\n2\n3\n4\n5\n6\n"
        "0 0 0\n1 0 0\n2 0 0\n0 1 0\n1 1 0\n2 1 0\n$EndNodes\n"
        "$Elements\n2 2 1 2\n2 1 3 1\n1 1 2 5 4\n2 2 3 1\n2 2 3 6 5\n$EndElements\n"
    )
    message = error(write("part.msh", text))
    assert message.endswith("Put all that is saved in physical groups, or nothing")
    whole = text.replace("2 1 0 0 2 1 0 0 0\n", "2 1 0 0 2 1 0 1 6 0\n")
    assert read_mesh(write("whole.msh", whole)).face_tags.tolist() == [5, 6]


def test_what_meshio_warns_of_is_a_warning(write: Write) -> None:
    arrays = {
        "connectivity": "0 1 4 3 1 2 5 4 3 4 6",
        "offsets": "4 8 11",
        "types": "9 9 200",  # no cell that meshio knows
    }
    points = " ".join(f"{x} {y} 0" for x, y in PLANE)
    data = '<DataArray type="{}" format="ascii" {}>{}</DataArray>'
    cells = "".join(data.format("Int64", f'Name="{k}"', v) for k, v in arrays.items())
    text = (
        f'<VTKFile type="UnstructuredGrid" version="0.1" byte_order="LittleEndian">'
        f'<UnstructuredGrid><Piece NumberOfPoints="7" NumberOfCells="3">'
        f"<Points>{data.format('Float64', 'NumberOfComponents="3"', points)}</Points>"
        f"<Cells>{cells}</Cells></Piece></UnstructuredGrid></VTKFile>"
    )
    with pytest.warns(UserWarning, match=r"a\.vtu: meshio: Warning: File contains cells that"):
        assert faces(read_mesh(write("a.vtu", text))) == PLANE_FACES[:2]


# All formats


def test_plane_meshes(write: Write) -> None:
    flat = "v 0 0 {z}\nv 1 0 {z}\nv 1 1 {z}\nv 0 1 {z}\nf 1 2 3 4\n"
    zero, half = (write(f"{z}.obj", flat.format(z=z)) for z in ("-0.0", "0.5"))
    assert read_mesh(zero).vertices.tolist() == [[0, 0], [1, 0], [1, 1], [0, 1]]
    assert [read_mesh(path, gdim=3).gdim for path in (zero, half)] == [3, 3]
    assert [read_mesh(path, gdim=2).gdim for path in (zero, half)] == [2, 2]
    assert read_mesh(half).gdim == 3
    cube = write("cube.obj", V + F)
    assert error(cube, gdim=2).startswith(": z goes from 0.0 to 1.0; with gdim=2 it must be")
    with pytest.raises(ValueError, match="gdim is 4; expected 2, 3 or None"):
        read_mesh(cube, gdim=4)


def test_orient(write: Write) -> None:
    path = write("cube.obj", V + F.replace("f 1 3 4 2", "f 1 2 4 3"))
    message = error(path)
    assert "run along edge" in message
    assert message.endswith("mesh.orient(vertices, faces) repairs it (or read_mesh with orient=True)")
    assert_cube(read_mesh(path, orient=True))


def test_missing_file(tmp_path: Path) -> None:
    for extension in ("obj", "off", "ply", "msh", "vtu"):
        path = tmp_path / f"missing.{extension}"
        with pytest.raises(OSError, match=f"missing.{extension}"):
            read_mesh(path)
    (tmp_path / "folder.obj").mkdir()
    with pytest.raises(OSError, match=r"folder\.obj"):
        read_mesh(tmp_path / "folder.obj")


@pytest.mark.parametrize("name", ["cube.blend", "cube", "obj"])
def test_unknown_extension(write: Write, name: str) -> None:
    message = error(write(name, V + F))
    assert f"the extension {Path(name).suffix!r} is unknown; expected one of .obj, .off" in message
    assert {".msh", ".ply", ".vtk", ".vtu"} <= set(message.replace(",", "").split())


def test_path_may_be_a_string(write: Write) -> None:
    assert_cube(read_mesh(str(write("cube.obj", V + F))))


def test_rank_0_reads_for_all(write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write("cube.obj", V + F)
    read: list[Path] = []
    monkeypatch.setattr(io, "_read", lambda path, read_file=io._read: read.append(path) or read_file(path))
    first, second = on_ranks(2, lambda comm: read_mesh(path, comm))
    assert read == [path]
    for rank, msh in enumerate([first, second]):
        assert isinstance(msh, ControlMesh)
        assert (msh.comm.rank, msh.comm.size) == (rank, 2)
        assert_cube(msh)
    path.unlink()
    for error in on_ranks(2, lambda comm: read_mesh(path, comm)):
        assert str(error) == f"[Errno 2] No such file or directory: '{path}'"
        assert isinstance(error, FileNotFoundError)


FOLDER = Path(os.environ.get("THCCS_MESHES", "missing"))
needs_meshes = pytest.mark.skipif(not FOLDER.is_dir(), reason="THCCS_MESHES names no folder with meshes")


@needs_meshes
def test_gmsh_file_and_its_obj_are_one_mesh() -> None:
    msh = read_mesh(FOLDER / "flange_plate_5_holes.msh")
    other = read_mesh(FOLDER / "flange_plate_5_holes.obj")
    assert (msh.gdim, other.gdim) == (2, 2)
    for name in ("num_vertices", "num_edges", "num_faces", "num_invalid_faces", "num_components"):
        assert getattr(msh, name) == getattr(other, name)
    assert len(msh.boundary_loops) == 6
    # Physical groups of the file: plate 1, outer 2, holes 3.
    assert set(msh.face_tags.tolist()) == {1}
    rim = {tuple(edge) for edge in msh.edges[msh.boundary_edges].tolist()}
    assert msh.edge_tags.keys() == rim
    outer = max(msh.boundary_loops, key=lambda loop: float(np.ptp(msh.vertices[loop, 0])))
    on_outer = {edge for edge in rim if set(edge) <= set(outer.tolist())}
    assert {edge for edge, tag in msh.edge_tags.items() if tag == 2} == on_outer
    assert {edge for edge, tag in msh.edge_tags.items() if tag == 3} == rim - on_outer


@needs_meshes
@pytest.mark.parametrize("extension", ["off", "ply", "vtu"])
def test_a_real_mesh_in_other_formats(tmp_path: Path, extension: str) -> None:
    # As meshio writes them; its PLY is binary.
    msh = read_mesh(FOLDER / "blender_suzanne.obj")
    blocks = [
        (kind, [face for face in faces(msh) if len(face) == size]) for kind, size in (("quad", 4), ("triangle", 3))
    ]
    if extension == "off":
        rows = [*map(str, msh.vertices.tolist()), *(f"{len(f)} {f}" for f in faces(msh))]
        text = "\n".join([f"OFF {msh.num_vertices} {msh.num_faces}", *rows])
        for mark in "[](),":
            text = text.replace(mark, " ")
        path = tmp_path / "suzanne.off"
        path.write_text(text)
        expected = faces(msh)
    else:
        path = write_meshio(tmp_path / f"suzanne.{extension}", blocks, msh.vertices)
        expected = blocks[0][1] + blocks[1][1]
    other = read_mesh(path)
    assert np.array_equal(other.vertices, msh.vertices)
    assert faces(other) == expected
