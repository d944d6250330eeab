"""Named control meshes for tests, small and nasty: whatever holds on all of them holds.

`ZOO` maps a name to a function that builds the mesh. Vertices of the planar ones are moved a little, so that nothing
holds by symmetry alone.
"""

import itertools
import math
from collections.abc import Callable

import numpy as np
from thccs_fem import generators
from thccs_fem.mesh import ControlMesh

__all__ = ["ZOO"]

SHIFT = 0.05  # of the shortest edge: no face folds


def _moved(mesh: ControlMesh, *, corners: dict[int, float] | None = None) -> ControlMesh:
    """Return the mesh with its vertices moved by fixed, unrelated steps, and with other corner tags if given."""
    ends = mesh.vertices[mesh.edges]
    shortest = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).min()
    phase = np.arange(mesh.vertices.size).reshape(mesh.vertices.shape)
    faces = np.split(mesh.face_vertices, mesh.face_offsets[1:-1])
    vertices = mesh.vertices + SHIFT * shortest * np.sin(1.0 + 7.0 * phase)
    return ControlMesh(vertices, faces, mesh.face_tags, corners=mesh.corners if corners is None else corners)


def _grid(n: int, m: int) -> ControlMesh:
    return _moved(generators.rectangle((n, m)))


def _l(n: int, *, tagged: bool) -> ControlMesh:
    """Three squares of n x n faces; the reentrant vertex, where three faces meet, is a corner or smooth."""
    mesh = generators.l_domain(n)
    reentrant = int(np.argmin(np.linalg.norm(mesh.vertices, axis=1)))
    return _moved(mesh, corners={v: s for v, s in mesh.corners.items() if tagged or v != reentrant})


def _fan() -> ControlMesh:
    """Five faces at one smooth rim vertex, four at the next: irregular rim vertices joined by an edge."""
    angles = np.linspace(0.0, math.pi, 6)
    ring = [(math.cos(a), math.sin(a)) for a in angles]
    middle = [(1.5 * math.cos(a), 1.5 * math.sin(a)) for a in (angles[:-1] + angles[1:]) / 2]
    spokes = [(0, 1 + k, 7 + k, 2 + k) for k in range(5)]
    below = [(1.0, -1.0), (2.0, -1.0), (2.0, 0.3)]
    # Faces at vertex 1 = (1, 0): the first of the spokes and two more outside.
    outside = [(1, 12, 13, 14), (1, 14, 15, 7)]
    points = [(0.0, 0.0), *ring, *middle, *below, (1.9, 1.0)]
    return ControlMesh(points, spokes + outside)


def _annulus() -> ControlMesh:
    """Two loops of rim; the strip between is two faces wide."""
    n = 6
    angles = 2.0 * math.pi * np.arange(n) / n
    points = [(r * math.cos(a), r * math.sin(a)) for r in (1.0, 1.6, 2.4) for a in angles]
    rings = itertools.product(range(2), range(n))
    faces = [(n * r + k, n * (r + 1) + k, n * (r + 1) + (k + 1) % n, n * r + (k + 1) % n) for r, k in rings]
    return _moved(ControlMesh(points, faces))


def _polygons() -> ControlMesh:
    """An open house: a square, two triangles and a pentagon, with one vertex inside."""
    points = [(0, 0), (2, 0), (2, 1), (1, 1), (0, 1), (1, 2), (2.5, 2.0), (-0.5, 2.0)]
    return ControlMesh(points, [(0, 1, 2, 3, 4), (3, 2, 6, 5), (3, 5, 4), (4, 5, 7)])


def _tetrahedron() -> ControlMesh:
    """Four triangles: after one step two extraordinary vertices on every face."""
    points = [(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)]
    return ControlMesh(points, [(0, 1, 2), (0, 2, 3), (0, 3, 1), (1, 3, 2)])


def _two_ends() -> ControlMesh:
    """Two hexagonal caps on a prism, each cut into three quads: faces with two and three extraordinary vertices."""
    angles = 2.0 * math.pi * np.arange(6) / 6
    rings = [(math.cos(a), math.sin(a), z) for z in (-0.5, 0.5) for a in angles]
    points = [*rings, (0.0, 0.0, -1.0), (0.0, 0.0, 1.0)]
    sides = [(k, (k + 1) % 6, 6 + (k + 1) % 6, 6 + k) for k in range(6)]
    lower = [(12, k, (k - 1) % 6, (k - 2) % 6) for k in (0, 2, 4)]
    upper = [(13, 6 + k, 6 + (k + 1) % 6, 6 + (k + 2) % 6) for k in (0, 2, 4)]
    return ControlMesh(points, sides + lower + upper)


def _valence2() -> ControlMesh:
    """A 3 x 3 grid with a vertex of two faces in the middle face, which is cut in two."""
    grid = generators.rectangle((3, 3))
    a, b, c, d = grid.quads[4]
    faces = [*np.delete(grid.quads, 4, axis=0).tolist(), [a, b, c, 16], [a, 16, c, d]]
    return ControlMesh(np.vstack([grid.vertices, [0.5, 0.5]]), faces)


def _two_components() -> ControlMesh:
    """A torus and a cube apart from it, whose own eight functions are dependent on level 0."""
    torus, cube = generators.torus((4, 3)), generators.cube_sphere(1)
    vertices = np.vstack([torus.vertices, cube.vertices + [5.0, 0.0, 0.0]])
    return ControlMesh(vertices, np.vstack([torus.quads, cube.quads + torus.num_vertices]))


ZOO: dict[str, Callable[[], ControlMesh]] = {
    "quad": lambda: _grid(1, 1),
    "strip": lambda: _grid(5, 1),
    "grid2": lambda: _grid(2, 2),
    "grid": lambda: _grid(5, 4),
    "annulus": _annulus,
    "wheel3": lambda: _moved(generators.wheel(3, 1)),
    "wheel5": lambda: _moved(generators.wheel(5, 2)),
    "wheel8": lambda: _moved(generators.wheel(8, 1)),
    "disc": lambda: _moved(generators.disc(2)),
    "l_corner1": lambda: _l(1, tagged=True),
    "l_corner": lambda: _l(2, tagged=True),
    "l_smooth": lambda: _l(2, tagged=False),
    "fan": _fan,
    "valence2": _valence2,
    "polygons": _polygons,
    "torus": lambda: generators.torus((5, 4)),
    "torus3": lambda: generators.torus((3, 3)),
    "cube": lambda: generators.cube_sphere(1),
    "cube2": lambda: generators.cube_sphere(2),
    "tetrahedron": _tetrahedron,
    "two_ends": _two_ends,
    "two_components": _two_components,
}
