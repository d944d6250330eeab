"""Small control meshes with everything in them that can go wrong: `ZOO`, name -> builder.

Points are moved about a little (the same at every call), so that nothing holds by symmetry alone.
"""

from collections.abc import Callable, Iterable
from itertools import product

import numpy as np
import numpy.typing as npt

from thccs_fem.mesh import ControlMesh

Floats = npt.NDArray[np.float64]


def moved(points: npt.ArrayLike, by: float = 0.08, seed: int = 1) -> Floats:
    points = np.asarray(points, dtype=float)
    return points + by * np.random.default_rng(seed).uniform(-1.0, 1.0, points.shape)


def grid(n: int, m: int) -> ControlMesh:
    """Return n x m faces in the plane, all vertices regular."""
    y, x = np.mgrid[: m + 1, : n + 1]
    vertices = np.arange((n + 1) * (m + 1)).reshape(m + 1, n + 1)
    quads = [vertices[:-1, :-1], vertices[:-1, 1:], vertices[1:, 1:], vertices[1:, :-1]]
    points = np.column_stack([x.ravel(), y.ravel()])
    return ControlMesh(moved(points), np.stack(quads, axis=-1).reshape(-1, 4))


def torus(n: int, m: int) -> ControlMesh:
    """Return a closed mesh of n x m faces, all vertices regular."""
    vertices = np.arange(n * m).reshape(n, m)
    quads = [np.roll(vertices, shift, (0, 1)) for shift in ((0, 0), (-1, 0), (-1, -1), (0, -1))]
    a, b = (angle.ravel() for angle in np.mgrid[:n, :m] * 2 * np.pi / np.reshape([n, m], (2, 1, 1)))
    points = [(2 + np.cos(b)) * np.cos(a), (2 + np.cos(b)) * np.sin(a), np.sin(b)]
    return ControlMesh(moved(np.column_stack(points)), np.stack(quads, axis=-1).reshape(-1, 4))


def wheel(valence: int, n: int = 2) -> ControlMesh:
    """Return sectors of n x n faces around one vertex, the first; it is corner 0 of all its faces."""
    numbers: dict[tuple[int, int, int], int] = {}
    points: list[tuple[float, float, float]] = []

    def vertex(sector: int, i: int, j: int) -> int:
        # The edge j of a sector is the edge i of the next one; the centre belongs to the first.
        key = (sector % valence, i, j) if i else ((sector + 1) % valence, j, 0)
        key = key if i or j else (0, 0, 0)
        if key not in numbers:
            numbers[key] = len(numbers)
            radius, angle = np.hypot(i, j), (np.arctan2(j, i) * 2 / np.pi + sector) * 2 * np.pi / valence
            points.append((radius * np.cos(angle), radius * np.sin(angle), 0.2 * radius**2))
        return numbers[key]

    faces = [
        [vertex(s, i, j), vertex(s, i + 1, j), vertex(s, i + 1, j + 1), vertex(s, i, j + 1)]
        for s, i, j in product(range(valence), range(n), range(n))
    ]
    return ControlMesh(moved(points, min(0.08, 0.8 / valence)), faces)


def polycube(cells: Iterable[tuple[int, int, int]]) -> ControlMesh:
    """Return the surface of unit cubes that are joined by faces; the cells are their lower corners."""
    solid = set(cells)
    numbers: dict[tuple[int, ...], int] = {}
    faces = []
    for cell, axis, side in product(sorted(solid), range(3), (0, 1)):
        across = tuple(c + (2 * side - 1) * (i == axis) for i, c in enumerate(cell))
        if across in solid:
            continue
        around = ((0, 0), (1, 0), (1, 1), (0, 1)) if side else ((0, 0), (0, 1), (1, 1), (1, 0))
        face = []
        for steps in around:
            corner = list(cell)
            corner[axis] += side
            corner[(axis + 1) % 3] += steps[0]
            corner[(axis + 2) % 3] += steps[1]
            face.append(numbers.setdefault(tuple(corner), len(numbers)))
        faces.append(face)
    return ControlMesh(moved(list(numbers)), faces)


def pillow() -> ControlMesh:
    """Return two sheets of 2 x 2 faces joined at the rim: closed, four vertices of valence 2."""
    sheet = np.arange(9).reshape(3, 3)
    back = sheet.copy()
    back[1, 1] = 9
    faces = [
        [v[i, j], v[i + 1, j], v[i + 1, j + 1], v[i, j + 1]][::step]
        for v, step in ((sheet, 1), (back, -1))
        for i, j in product(range(2), range(2))
    ]
    points = [(i, j, 0.5 * (i == j == 1)) for i, j in product(range(3), range(3))]
    return ControlMesh(moved([*points, (1.0, 1.0, -0.5)]), faces)


def split_face() -> ControlMesh:
    """Return 3 x 3 faces, the one in the middle in two: a vertex of valence 2 between two of valence 5."""
    mesh = grid(3, 3)
    a, b, c, d = (int(v) for v in mesh.quads[4])
    faces = [*np.delete(mesh.quads, 4, axis=0).tolist(), [a, b, c, 16], [a, 16, c, d]]
    return ControlMesh(np.vstack([mesh.vertices, mesh.vertices[[a, c]].mean(axis=0)]), faces)


def l_domain(tagged: bool, n: int = 2) -> ControlMesh:
    """Return three n x n squares around a reentrant corner with three faces."""
    numbers: dict[tuple[int, int], int] = {}
    faces = []
    for i, j in product(range(-n, n), range(-n, n)):
        if i < 0 or j < 0:
            around = ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1))
            faces.append([numbers.setdefault(corner, len(numbers)) for corner in around])
    corners = {numbers[0, 0]: 10.0} if tagged else None
    return ControlMesh(moved(list(numbers)), faces, corners=corners)


def half_disc(num_faces: int, tagged: bool = False) -> ControlMesh:
    """Return a fan of faces around vertex 0 on a smooth boundary, or a corner, and a ring around it."""
    mesh = wheel(2 * num_faces)
    faces = mesh.quads[: 4 * num_faces]
    vertices, new = np.unique(faces, return_inverse=True)
    corners = {0: 10.0} if tagged else None
    return ControlMesh(mesh.vertices[vertices], new.reshape(-1, 4), corners=corners)


def pyramid() -> ControlMesh:
    """Return a quad and four triangles."""
    points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0.5, 0.5, 1)]
    return ControlMesh(moved(points), [[3, 2, 1, 0], [0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])


def prism(n: int) -> ControlMesh:
    """Return two n-gons and n quads between them."""
    angle = 2 * np.pi * np.arange(n) / n
    rings = [np.column_stack([np.cos(angle), np.sin(angle), np.full(n, z)]) for z in (0.0, 1.0)]
    sides = [[i, (i + 1) % n, n + (i + 1) % n, n + i] for i in range(n)]
    ends = [list(range(n))[::-1], list(range(n, 2 * n))]
    return ControlMesh(moved(np.vstack(rings)), [*ends, *sides])


def polygons() -> ControlMesh:
    """Return a triangle and three quads around a vertex in the plane, and a pentagon beside them."""
    points = [(0, 0), (2, -1), (2, 1), (1, 2), (-1, 2), (-2, 0.5), (-1.5, -1.5), (0.5, -2), (3, 1.5), (4, 0), (3, -1)]
    faces = [[0, 1, 2], [0, 2, 3, 4], [0, 4, 5, 6], [0, 6, 7, 1], [1, 10, 9, 8, 2]]
    return ControlMesh(moved(points), faces)


def tetrahedron() -> ControlMesh:
    points = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]
    return ControlMesh(moved(points), [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])


def beside(*meshes: ControlMesh) -> ControlMesh:
    """Return the meshes, side by side, as components of one."""
    points = np.vstack([mesh.vertices + np.array([10.0 * i, 0.0, 0.0]) for i, mesh in enumerate(meshes)])
    first = np.cumsum([0, *(mesh.num_vertices for mesh in meshes)])
    return ControlMesh(points, np.vstack([mesh.quads + shift for mesh, shift in zip(meshes, first, strict=False)]))


TRIPOD = ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1))

ZOO: dict[str, Callable[[], ControlMesh]] = {
    "single_quad": lambda: grid(1, 1),
    "strip": lambda: grid(4, 1),
    "grid": lambda: grid(4, 3),
    "torus": lambda: torus(5, 4),
    "torus_of_nine": lambda: torus(3, 3),  # a function meets itself across every face
    **{f"wheel{n}": lambda n=n: wheel(n) for n in (2, 3, 5, 6, 8, 12)},  # type: ignore[misc]
    "wheel7_one_ring": lambda: wheel(7, 1),
    "pole": lambda: wheel(64, 1),
    "split_face": split_face,
    "pillow": pillow,
    "cube": lambda: polycube(TRIPOD[:1]),  # all of valence 3
    "cube_and_torus": lambda: beside(polycube(TRIPOD[:1]), torus(4, 3)),
    "l_tricube": lambda: polycube(TRIPOD[:3]),  # valences 3 and 5
    "tripod": lambda: polycube(TRIPOD),  # valences 3, 5 and 6, several in a face
    "l_domain_tagged": lambda: l_domain(tagged=True),
    "l_domain_smooth": lambda: l_domain(tagged=False),
    "corner_of_two": lambda: half_disc(2, tagged=True),
    "corner_of_five": lambda: half_disc(5, tagged=True),
    "rim_of_four": lambda: half_disc(4),
    "tetrahedron": tetrahedron,
    "pyramid": pyramid,
    "pentagonal_prism": lambda: prism(5),
    "polygons": polygons,
}
