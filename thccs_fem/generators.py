"""Control meshes made by code: closed surfaces, shells, planar domains and the models of Wei et al. (2015).

Most meshes are drawn as *blocks*: arrays of points of shape (rows, columns, gdim) whose cells are
quads. `_joined` glues blocks where their points coincide. Vertices are numbered block by block and
row by row, faces likewise, so that neighbours are near in memory. Faces of planar meshes run
counter-clockwise, those of closed surfaces have their normals outward.

Vertices are control points: where a surface or a rim is curved, the limit lies off them, nearer by
a factor of four with each doubling of the counts. `interpolated` moves them so that it passes
through where they were, `fitted` so that it comes near to any surface.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from numbers import Integral
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from scipy.sparse import csgraph
from scipy.sparse.linalg import spsolve
from scipy.spatial import KDTree

from thccs_fem.bezier import VERTEX_PLACE, bezier_masks
from thccs_fem.boundary import Boundary
from thccs_fem.mesh import ControlMesh
from thccs_fem.parallel import end_together, together
from thccs_fem.subdivision import control_level, subdivided

__all__ = [
    "cube_sphere",
    "cylinder",
    "disc",
    "fitted",
    "genus3",
    "hemisphere",
    "implicit_surface",
    "interpolated",
    "l_domain",
    "l_domain1",
    "l_domain2",
    "rectangle",
    "spherical_zone",
    "torus",
    "trapezohedron",
    "wheel",
]

Bools = npt.NDArray[np.bool_]
Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]

# Taubin's smoothing: a step towards the mean of the neighbours and a longer one back, so that detail
# goes and volume stays.
SMOOTHING_STEPS = (0.5, -0.505)

SAME_POINT = 1e-9  # of the span of all coordinates: points of blocks that are nearer are one vertex


# Closed surfaces


def torus(shape: Sequence[int], R: float = 2.0, r: float = 1.0, *, comm: Any = None) -> ControlMesh:
    """Make a torus around the z axis, a closed grid of quads with no extraordinary vertex.

    The vertices lie on the torus of radii R and r. Vertex i * m + j is the j-th around the tube at
    the i-th place around the axis; u of a face runs around the axis, v around the tube.

    Args:
        shape: Faces around the axis and around the tube (n, m), three or more each.
        R: Radius of the circle in the middle of the tube.
        r: Radius of the tube, less than R.
        comm: MPI communicator of the mesh.

    Raises:
        TypeError: The shape is not two integers.
        ValueError: A count or a radius is too small or too large.

    >>> torus((16, 8)).genus
    1
    """
    n, m = _counts("shape", shape, size=2, minimum=3)
    if not (math.isfinite(R) and 0 < r < R):
        raise ValueError(f"the radii are R = {R} and r = {r}: expected 0 < r < R, both finite")
    around, tube = np.meshgrid(_angles(n), _angles(m), indexing="ij")
    distance = R + r * np.cos(tube)
    points = [distance * np.cos(around), distance * np.sin(around), r * np.sin(tube)]
    i, j = np.meshgrid(np.arange(n), np.arange(m), indexing="ij")
    i_next, j_next = (i + 1) % n, (j + 1) % m
    corners = [i * m + j, i_next * m + j, i_next * m + j_next, i * m + j_next]
    vertices = np.stack(points, axis=-1).reshape(-1, 3)
    faces = np.stack(corners, axis=-1).reshape(-1, 4)
    return ControlMesh(vertices, faces, comm=comm)


def cube_sphere(n: int, *, comm: Any = None) -> ControlMesh:
    """Make a sphere from a cube: eight extraordinary vertices of valence 3.

    The vertices lie on the unit sphere; along the middle lines of each side of the cube they are at
    equal angles. With n = 1 all vertices have valence 3: that is the mesh whose Catmull-Clark
    functions are linearly dependent.

    Args:
        n: Faces along an edge of the cube, one or more.
        comm: MPI communicator of the mesh.

    Raises:
        TypeError: n is not an integer.
        ValueError: n is less than 1.

    >>> cube_sphere(4)
    ControlMesh(gdim=3, num_vertices=98, num_edges=192, num_faces=96)
    """
    _check_count("n", n, minimum=1)
    t = np.tan(np.linspace(-math.pi / 4, math.pi / 4, n + 1))
    v, u = np.meshgrid(t, t, indexing="ij")
    front = np.stack([np.ones_like(u), u, v], axis=-1)
    back = np.stack([-np.ones_like(u), v, u], axis=-1)
    sides = [np.roll(side, axis, axis=-1) for side in (front, back) for axis in range(3)]
    vertices, faces = _joined(sides)
    return ControlMesh(vertices / np.linalg.norm(vertices, axis=1, keepdims=True), faces, comm=comm)


def trapezohedron(valence: int, n: int, *, comm: Any = None) -> ControlMesh:
    """Make a sphere with two poles of any valence: 2 valence kites between them, of n x n faces each.

    The poles are vertices 0 and (n + 1)^2; where kites meet around the equator there are 2 valence extraordinary
    vertices more, of valence 3. The vertices lie on the unit sphere. With valence 3 it is a cube on one of its corners.

    Args:
        valence: Faces at either pole, three or more.
        n: Faces along an edge of a kite, one or more.
        comm: MPI communicator of the mesh.

    Raises:
        TypeError: An argument is not an integer.
        ValueError: valence is less than 3 or n is less than 1.

    >>> sorted(trapezohedron(5, 2).extraordinary_vertices.values())
    [3, 3, 3, 3, 3, 3, 3, 3, 3, 3, 5, 5]
    """
    _check_count("valence", valence, minimum=3)
    _check_count("n", n, minimum=1)
    # Up and down in turn around the equator, as high as those of the cube if there are six.
    z = np.resize([1.0, -1.0], 2 * valence) / valence
    angles, radius = _angles(2 * valence), math.sqrt(1.0 - 1.0 / valence**2)
    belt = np.column_stack([radius * np.cos(angles), radius * np.sin(angles), z])
    top, bottom = np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0])
    blocks = []
    for k in range(0, 2 * valence, 2):
        a, b, c, d = belt[np.arange(k, k + 4) % (2 * valence)]
        blocks += [_bilinear([top, a, b, c], n, n), _bilinear([bottom, d, c, b], n, n)]
    vertices, faces = _joined(blocks)
    return ControlMesh(vertices / np.linalg.norm(vertices, axis=1, keepdims=True), faces, comm=comm)


# A quarter (x, y >= 0) of the genus-3 surface, which is symmetric about the coordinate planes: the
# points of the upper side, z > 0, and in the plane z = 0 those of the rim, of the right hole and of
# the middle hole, each from large to small x. To find them, the integral of (H - 0.9)^2 over the
# limit surface (H the mean curvature; tubes of radius 0.56 have 0.9) plus the variances of log face
# area and log aspect were lowered, the area held; then they were rounded.
GENUS3_UPPER = np.array([[5.0, 0.0, 0.9], [2.9, 1.85, 0.9], [1.5, 0.0, 0.65], [0.0, 1.75, 0.9]])
GENUS3_RIM = np.array([[6.2, 0.0, 0.0], [2.95, 2.85, 0.0], [1.65, 0.6, 0.0], [0.0, 2.6, 0.0]])
GENUS3_RIGHT_HOLE = np.array([[3.5, 0.0, 0.0], [3.15, 0.5, 0.0], [2.0, 0.0, 0.0]])
GENUS3_MIDDLE_HOLE = np.array([[0.9, 0.0, 0.0], [0.0, 0.45, 0.0]])


def genus3(levels: int = 3, *, comm: Any = None) -> ControlMesh:
    """Make a surface with three holes in a row: 3068 vertices and 3072 faces, as in Table 1.

    A mesh of 44 vertices and 48 faces is subdivided. Its vertices remain vertices 0 to 43, and the
    4**levels descendants of its face k are in one run, from k * 4**levels. Four vertices are
    extraordinary, all of valence 8: above and below the two bridges between the holes. The limit
    surface is the same for all levels, symmetric about the three coordinate planes, 9.7 long, 3.5
    wide and 1.2 high.

    Face tag 1 marks a square at the left end of the surface (x < 0), tag 2 its mirror image at the
    right end, for values to be prescribed: 4**levels faces each, 64 of the 3072. The mesh that is
    not subdivided has no faces that small, and no tags.

    Args:
        levels: Catmull-Clark steps applied to the 48 faces; Table 1 has three.
        comm: MPI communicator of the mesh.

    Raises:
        TypeError: levels is not an integer.
        ValueError: levels is negative.

    >>> mesh = genus3()
    >>> mesh.num_vertices, mesh.num_faces, mesh.genus, sorted(mesh.extraordinary_vertices.values())
    (3068, 3072, 3, [8, 8, 8, 8])
    """
    _check_count("levels", levels, minimum=0)
    base = ControlMesh(*_joined(_genus3_tubes()))
    if levels == 0:
        return ControlMesh(base.vertices, base.quads, comm=comm)
    left, right = np.argmin(base.vertices[:, 0]), np.argmax(base.vertices[:, 0])
    # After one step the child at corner k of face f is face 4 f + k.
    children = base.face_vertices
    tags = np.where(children == left, 1, np.where(children == right, 2, 0))
    once = subdivided(base)
    return subdivided(ControlMesh(once.vertices, once.quads, tags, comm=comm), levels - 1)


def _genus3_tubes() -> list[Floats]:
    """Return the outside and the walls of the three holes: closed strips from below to above.

    They meet along the middle lines of the upper and of the lower side, which run around the holes
    and touch at the extraordinary vertices.
    """
    outside = _strip(*map(_four_quarters, (GENUS3_UPPER, GENUS3_RIM)))
    middle = _strip(*map(_four_quarters, (GENUS3_UPPER[2:], GENUS3_MIDDLE_HOLE)))[:, ::-1]
    right = _strip(*map(_two_halves, (GENUS3_UPPER[:3], GENUS3_RIGHT_HOLE)))[:, ::-1]
    left = right[:, ::-1] * [-1.0, 1.0, 1.0]
    return [outside, middle, right, left]


def _two_halves(half: Floats) -> Floats:
    """Return the closed polygon of the half y >= 0, whose ends lie in the plane y = 0."""
    return np.concatenate([half, half[-2::-1] * [1.0, -1.0, 1.0]])


def _four_quarters(quarter: Floats) -> Floats:
    """Return the closed polygon of the quarter x, y >= 0, from the plane y = 0 to x = 0."""
    return _two_halves(np.concatenate([quarter, quarter[-2::-1] * [-1.0, 1.0, 1.0]]))


def _strip(upper: Floats, middle: Floats) -> Floats:
    """Return the block from the mirror image of the upper polygon in z = 0 to the polygon."""
    return np.stack([upper * [1.0, 1.0, -1.0], middle, upper])


def implicit_surface(
    f: Callable[[Floats], npt.ArrayLike],
    shape: Sequence[int],
    lower: Sequence[float] = (-1.0, -1.0, -1.0),
    upper: Sequence[float] = (1.0, 1.0, 1.0),
    *,
    smoothing: int = 0,
    comm: Any = None,
) -> ControlMesh:
    """Make a closed surface of quads around the region where a function is positive.

    The function is read at the points of a lattice. A cell of the lattice with both signs has a
    vertex, at the mean of the places where its edges change sign; an edge of the lattice that
    changes sign has a quad, of the vertices of the four cells around it. So the mesh is that of the
    surface of a set of cubes, one a positive point: a region whose sides lie along the axes has few
    extraordinary vertices, one with slanting sides has hundreds, and as many faces with several.

    Where two cubes would meet in a mere edge or corner the surface would touch itself there: the
    points around are counted in.

    Args:
        f: Takes points x of shape (3, m), returns values of shape (m,), finite, positive inside.
        shape: Points of the lattice along x, y and z, three or more each.
        lower: Its lower corner, three coordinates.
        upper: Its upper corner; f is not positive on the sides of the box between both.
        smoothing: Times that the vertices are smoothed, which rounds the steps of the lattice off.
        comm: MPI communicator of the mesh.

    Raises:
        TypeError: The shape is not three integers, or smoothing is none.
        ValueError: A count is too small, the corners are wrong, or f is positive nowhere, on the
            sides of the box, not finite, or of the wrong shape.

    >>> ball = implicit_surface(lambda x: 0.8 - (x**2).sum(axis=0), (20, 20, 20))
    >>> ball.euler_characteristic, ball.num_faces, len(ball.extraordinary_vertices)
    (2, 1296, 560)
    """
    counts, low, high = _lattice_box(shape, lower, upper)
    _check_count("smoothing", smoothing, minimum=0)
    axes = [np.linspace(*ends) for ends in zip(low, high, counts, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"))
    end_together(comm)
    values = together(comm, lambda: _lattice_values(f, points))
    vertices, quads = _surface_net(_filled(values))
    scaled = low + vertices * (high - low) / (np.array(counts) - 1)
    return ControlMesh(_smoothed(scaled, quads, smoothing), quads, comm=comm)


def _lattice_values(f: Callable[[Floats], npt.ArrayLike], points: Floats) -> Floats:
    """Return the values at the points of a lattice, shape (n, m, k), of points of shape (3, n, m, k)."""
    values = np.asarray(f(points.reshape(3, -1)), dtype=np.float64)
    if values.size != points[0].size:
        raise ValueError(f"f returned {values.size} values for {points[0].size} points: expected one for each")
    return values.reshape(points.shape[1:])


def _lattice_box(
    shape: Sequence[int], lower: Sequence[float], upper: Sequence[float]
) -> tuple[tuple[int, ...], Floats, Floats]:
    """Return the counts and both corners of a lattice in space."""
    counts = _counts("shape", shape, size=3, minimum=3)
    return counts, *_box(lower, upper, gdim=3)


def _filled(values: Floats) -> Floats:
    """Return values on a lattice, not zero, whose positive points have a manifold for their surface.

    That is so if no face and no cell of the lattice has the two ends of a diagonal, and nothing but
    them, on one side. Points are only ever added, between others: it ends, and off the sides.
    """
    if not np.isfinite(values).all():
        raise ValueError(f"f has {np.count_nonzero(~np.isfinite(values))} values that are not finite on the lattice")
    inside = values > 0
    if not inside.any():
        raise ValueError("f is positive at no point of the lattice: there is no surface. Give more points, or -f")
    if inside.sum() > inside[1:-1, 1:-1, 1:-1].sum():
        raise ValueError("f is positive on the sides of the box: the surface would be cut off. Give a larger box")
    while any([_fill_diagonals(inside, block) for block in ((1, 2, 2), (2, 1, 2), (2, 2, 1), (2, 2, 2))]):
        pass
    return np.where(inside, 1.0, -1.0) * np.maximum(np.abs(values), np.finfo(np.float64).tiny)


def _fill_diagonals(inside: Bools, block: tuple[int, int, int]) -> bool:
    """Fill, in place, the blocks of a lattice where a diagonal has one sign and the rest the other; say if any."""
    size = [n - k + 1 for n, k in zip(inside.shape, block, strict=True)]
    corners = list(itertools.product(*map(range, block)))
    parts = [inside[tuple(slice(o, o + n) for o, n in zip(c, size, strict=True))] for c in corners]
    total = np.sum(parts, axis=0)
    critical = np.zeros(size, dtype=bool)
    for one, other in zip(parts[: len(parts) // 2], reversed(parts), strict=False):
        critical |= (one & other & (total == 2)) | (~one & ~other & (total == len(parts) - 2))
    for part in parts:
        part |= critical
    return bool(critical.any())


def _surface_net(values: Floats) -> tuple[Floats, Ints]:
    """Return vertices, in steps of the lattice, and quads between the signs of its values.

    Vertices are in the order of the cells of the lattice, quads in that of their first vertices.
    """
    inside = values > 0
    quads, places = [], []
    for axis in range(3):
        here, there = (np.moveaxis(values, axis, 0)[part] for part in (slice(-1), slice(1, None)))
        edges = np.argwhere(np.moveaxis((here > 0) != (there > 0), 0, axis))
        a, b = values[tuple(edges.T)], values[tuple((edges + np.eye(3, dtype=int)[axis]).T)]
        places.append(edges + (a / (a - b))[:, None] * np.eye(3)[axis])
        # Counter-clockwise around the axis, which is outward where the lower end is inside.
        second, third = np.eye(3, dtype=int)[[(axis + 1) % 3, (axis + 2) % 3]]
        around = np.stack([edges - second - third, edges - third, edges, edges - second], axis=1)
        cells = np.ravel_multi_index(tuple(np.moveaxis(around, 2, 0)), inside.shape)
        quads.append(np.where((a > 0)[:, None], cells, cells[:, ::-1]))
    cells, corner = np.unique(np.concatenate(quads), return_inverse=True)
    corner = corner.reshape(-1, 4).astype(np.int32)
    place = np.repeat(np.concatenate(places), 4, axis=0)
    number = np.bincount(corner.ravel())
    sums = [np.bincount(corner.ravel(), weights=x) for x in place.T]
    order = np.argsort(corner.min(axis=1), kind="stable")
    return np.column_stack(sums) / number[:, None], corner[order].astype(np.int32)


def _smoothed(vertices: Floats, quads: Ints, times: int) -> Floats:
    """Return the vertices of a closed surface, smoothed."""
    n = len(vertices)
    one, other = quads.ravel(), np.roll(quads, -1, axis=1).ravel()  # each edge once in both directions
    neighbours = sp.csr_array((np.ones(one.size), (one, other)), shape=(n, n))
    mean = sp.diags_array(1.0 / neighbours.sum(axis=1)) @ neighbours
    for _ in range(times):
        for step in SMOOTHING_STEPS:
            vertices = vertices + step * (mean @ vertices - vertices)
    return vertices


# Shells: surfaces with rims


def cylinder(
    shape: Sequence[int],
    R: float = 1.0,
    length: float = 1.0,
    angle: float = 2.0 * math.pi,
    *,
    rim: float = 1.0,
    comm: Any = None,
) -> ControlMesh:
    """Make a circular cylinder around the z axis without lids, or a strip of it along the axis.

    The vertices lie on the cylinder, from z = -length / 2 to length / 2 and from polar angle -angle / 2
    to angle / 2: the middle of a strip is in the direction of x. Faces are numbered row by row along z;
    u of a face runs around the axis, v along it, normals are outward.

    A crease boundary does not bend across its edges: at the straight edges of a strip the limit surface
    is flat, and the width of the faces there says how far.

    Args:
        shape: Faces around the axis and along it (n, m), one or more each, three or more around a
            closed cylinder.
        R: Radius.
        length: Length along the axis.
        angle: Angle of the strip, at most 2 pi: a closed cylinder.
        rim: Width of the faces at the straight edges of a strip compared to faces that are all equal,
            from above 0 to 1: those in between are wider towards the middle.
        comm: MPI communicator of the mesh.

    Raises:
        TypeError: The shape is not two integers.
        ValueError: A count, a length or a share is too small or too large.

    >>> cylinder((8, 2)).boundary_loops[0].size, cylinder((8, 2), angle=1.0).num_vertices
    (8, 27)
    """
    n, m = _counts("shape", shape, size=2, minimum=1)
    if not (0 < R < math.inf and 0 < length < math.inf and 0 < angle <= 2.0 * math.pi):
        raise ValueError(
            f"R = {R}, length = {length} and angle = {angle}: expected positive numbers, an angle of at most 2 pi"
        )
    if angle == 2.0 * math.pi:
        _check_count("shape[0] of a closed cylinder", n, minimum=3)
        if rim != 1.0:
            raise ValueError(f"rim is {rim}, but a closed cylinder has no straight edges: leave it out")
    around = angle * (_graded(n, rim) - 0.5)
    z = length * (np.linspace(0.0, 1.0, m + 1) - 0.5)
    points = _lattice(around, z)
    block = np.stack([R * np.cos(points[..., 0]), R * np.sin(points[..., 0]), points[..., 1]], axis=-1)
    return ControlMesh(*_joined([block]), comm=comm)


def spherical_zone(
    shape: Sequence[int],
    R: float = 1.0,
    polar: Sequence[float] = (math.pi / 10, math.pi / 2),
    *,
    rim: float = 1.0,
    comm: Any = None,
) -> ControlMesh:
    """Make the part of a sphere between two circles of latitude: by default half of it, with a hole of 18 degrees.

    The vertices lie on the sphere around the origin, the first of each row in the half plane of the x and
    z axes. Faces are numbered row by row from the lower circle up; u of a face runs around the z axis, v
    up, normals are outward.

    Args:
        shape: Faces around the axis and along a meridian (n, m), three and one or more.
        R: Radius.
        polar: Angles of the upper and of the lower circle from the z axis, between 0 and pi.
        rim: Height of the faces at both rims compared to faces that are all equal, as for `cylinder`.
        comm: MPI communicator of the mesh.

    Raises:
        TypeError: The shape is not two integers.
        ValueError: A count, an angle, the radius or the share is too small or too large.

    >>> [loop.size for loop in spherical_zone((8, 2)).boundary_loops]
    [8, 8]
    """
    n, m = _counts("shape", shape, size=2, minimum=1)
    _check_count("shape[0]", n, minimum=3)
    if len(polar) != 2 or not (0 < R < math.inf and 0 < polar[0] < polar[1] < math.pi):
        raise ValueError(f"R = {R} and polar = {polar}: expected 0 < R and two angles, 0 < upper < lower < pi")
    upper, lower = polar
    points = _lattice(2.0 * math.pi * np.linspace(0.0, 1.0, n + 1), lower + (upper - lower) * _graded(m, rim))
    around, down = np.moveaxis(points, -1, 0)
    block = R * np.stack([np.sin(down) * np.cos(around), np.sin(down) * np.sin(around), np.cos(down)], axis=-1)
    return ControlMesh(*_joined([block]), comm=comm)


# Where the sides of a cube meet, its lines have kinks, and the limit of points on the sphere has wiggles
# there: the curvature of a thin shell feels these more than its extraordinary vertices. So many steps
# towards the mean of the neighbours take the kinks off; more would gather faces at the top.
HEMISPHERE_STEPS = 5


def hemisphere(n: int, R: float = 1.0, *, comm: Any = None) -> ControlMesh:
    """Make the upper half of a sphere from half a cube: four extraordinary vertices of valence 3, no pole.

    The vertices lie on the sphere, 8 n of them at equal angles on the rim, the circle z = 0. Normals are
    outward.

    Args:
        n: Faces along half an edge of the cube, one or more.
        R: Radius.
        comm: MPI communicator of the mesh.

    Raises:
        TypeError: n is not an integer.
        ValueError: n is less than 1, or the radius is not positive.

    >>> hemisphere(2).num_faces, hemisphere(2).boundary_loops[0].size
    (48, 16)
    """
    _check_count("n", n, minimum=1)
    if not 0 < R < math.inf:
        raise ValueError(f"the radius is {R}: expected a positive number")
    whole = cube_sphere(2 * n)
    upper = whole.quads[whole.vertices[whole.quads, 2].min(axis=1) > -SAME_POINT]
    used, corner = np.unique(upper, return_inverse=True)
    mesh = ControlMesh(whole.vertices[used], corner.reshape(-1, 4))
    a, b = mesh.edges.T
    one_way = sp.csr_array((np.ones(a.size), (a, b)), shape=(used.size, used.size))
    points = np.array(mesh.vertices)
    inside = np.setdiff1d(np.arange(used.size), mesh.boundary_vertices)
    for _ in range(HEMISPHERE_STEPS):
        sums = (one_way @ points + one_way.T @ points)[inside]
        points[inside] = sums / np.linalg.norm(sums, axis=1, keepdims=True)
    return ControlMesh(R * points, mesh.quads, comm=comm)


def _graded(n: int, end: float) -> Floats:
    """Return n + 1 numbers from 0 to 1, symmetric, with the slope `end` at both ends and no curvature there.

    A cubic B-spline curve whose ends have no second derivative follows that smoothly.
    """
    if not 0 < end <= 1:
        raise ValueError(f"rim is {end}: expected a share above 0, at most 1")
    t = np.linspace(0.0, 1.0, n + 1)
    return end * t + (1.0 - end) * t**3 * (10.0 - 15.0 * t + 6.0 * t**2)


# Limits through given points


def interpolated(mesh: ControlMesh) -> ControlMesh:
    """Return the mesh whose limit surface passes through the vertices of a given one, each vertex going to its own.

    The limit points of the vertices are sparse linear combinations of the vertices: one system is solved.
    Between them the limit is near a smooth surface that the vertices lie on by the fourth order of the
    size of the faces; by the second at rims across which the surface is curved, and where the lines of the
    mesh have kinks.

    Args:
        mesh: A mesh of quads. Tags, creases and corners are kept.

    Raises:
        ValueError: A face is no quad.
        NotImplementedError: The mesh has creases inside, or corners that are semi-sharp or inside.

    >>> ring = interpolated(cylinder((12, 1)))
    >>> round(float(np.hypot(*ring.vertices[0, :2])), 4)  # outside of the circle: 3 / (2 + cos(2 pi / 12))
    1.0467
    """
    return _with_limits(mesh, mesh.vertices)


def fitted(mesh: ControlMesh, closest: Callable[[Floats], npt.ArrayLike]) -> ControlMesh:
    """Return the mesh whose limit surface meets a given surface: the limits of its vertices are moved onto that.

    Between them it is as near as `interpolated`; at extraordinary vertices it is off by the second order of the size of
    the faces there. A mesh that was subdivided has no kinks in its lines: its vertices make a better fit than points
    that are placed block by block.

    Args:
        mesh: A mesh of quads. Tags, creases and corners are kept.
        closest: Takes points x of shape (gdim, m), returns points on the surface near them, of the same shape.

    Raises:
        ValueError: A face is no quad, or what is returned has another shape or is not finite.
        NotImplementedError: The mesh has creases inside, or corners that are semi-sharp or inside.

    >>> sphere = fitted(subdivided(cube_sphere(1), 3), lambda x: x / np.linalg.norm(x, axis=0))
    >>> sphere
    ControlMesh(gdim=3, num_vertices=386, num_edges=768, num_faces=384)
    """
    limits = (_limits_of_vertices(mesh) @ mesh.vertices).T
    return _with_limits(mesh, together(mesh.comm, lambda: _moved(limits, closest)).T)


def _moved(points: Floats, closest: Callable[[Floats], npt.ArrayLike]) -> Floats:
    """Return what `closest` makes of points, shape (gdim, m)."""
    found = np.asarray(closest(points), dtype=np.float64)
    if found.shape != points.shape or not np.isfinite(found).all():
        raise ValueError(
            f"closest returned an array of shape {found.shape} for points of shape {points.shape}, of finite numbers "
            f"{np.count_nonzero(np.isfinite(found))}: expected as many points, all of them finite"
        )
    return found


def _with_limits(mesh: ControlMesh, points: Floats) -> ControlMesh:
    """Return the mesh with the limits of its vertices at the given points, shape (num_vertices, gdim)."""
    vertices = spsolve(_limits_of_vertices(mesh).tocsc(), points)
    return ControlMesh(vertices, mesh.quads, mesh.face_tags, mesh.edge_tags, mesh.creases, mesh.corners, comm=mesh.comm)


def _limits_of_vertices(mesh: ControlMesh) -> sp.csr_array:
    """Return the weights of the limit point of each vertex, shape (num_vertices, num_vertices)."""
    _, first = np.unique(mesh.quads, return_index=True)
    faces, k = np.divmod(first.astype(np.int32), 4)
    masks = bezier_masks(Boundary.of(control_level(mesh), "crease"), faces)
    return sp.csr_array(masks[16 * np.arange(k.size) + VERTEX_PLACE[k]])


# Planar domains


def rectangle(
    shape: Sequence[int],
    lower: Sequence[float] = (0.0, 0.0),
    upper: Sequence[float] = (1.0, 1.0),
    *,
    comm: Any = None,
) -> ControlMesh:
    """Make a rectangle of equal faces with sides along the axes.

    Args:
        shape: Faces along x and along y (n, m), one or more each.
        lower: Lower left corner (x, y).
        upper: Upper right corner (x, y).
        comm: MPI communicator of the mesh.

    Raises:
        TypeError: The shape is not two integers.
        ValueError: A count is less than 1, or the corners are not two finite numbers each, those of
            lower the smaller ones.

    >>> rectangle((3, 2)).quads[0].tolist()
    [0, 1, 5, 4]
    """
    n, m = _counts("shape", shape, size=2, minimum=1)
    low, high = _box(lower, upper, gdim=2)
    x, y = np.linspace(low[0], high[0], n + 1), np.linspace(low[1], high[1], m + 1)
    points = _lattice(x, y)
    return ControlMesh(points.reshape(-1, 2), _quads(points), comm=comm)


# A disc is drawn as a square whose middle block has this share of its width. Towards the centre the
# concentric squares stay square, but shrink; towards the rim they become circles. Both numbers were
# chosen for faces of good shape and similar size.
DISC_MIDDLE = 0.4
DISC_SHRINK = 0.8


def disc(n: int, *, comm: Any = None) -> ControlMesh:
    """Make a disc of five blocks of n x n faces: four extraordinary vertices, of valence 3.

    The rim is smooth, with two faces at each vertex, and the limits of its 4 n vertices lie on the
    unit circle. The middle block is a square with its sides bent outwards a little.

    Args:
        n: Faces along a side of a block, one or more.
        comm: MPI communicator of the mesh.

    Raises:
        TypeError: n is not an integer.
        ValueError: n is less than 1.

    >>> len(disc(3).boundary_vertices), disc(3).num_faces
    (12, 45)
    """
    _check_count("n", n, minimum=1)
    outer = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    inner = DISC_MIDDLE * outer
    blocks = [_bilinear(inner, n, n)]
    blocks += [_bilinear([outer[k - 1], outer[k], inner[k], inner[k - 1]], n, n) for k in range(4)]
    square, faces = _joined(blocks)
    # The limit of a vertex on a smooth rim is (P_- + 4 P + P_+) / 6.
    radius = 3.0 / (2.0 + math.cos(2.0 * math.pi / (4 * n)))
    size = np.abs(square).max(axis=1, keepdims=True)
    vertices = (1 - size) * DISC_SHRINK * square + size * radius * _rounded(square)
    return ControlMesh(vertices, faces, comm=comm)


def _rounded(points: Floats) -> Floats:
    """Return points moved from concentric squares to circles, equal steps to equal angles."""
    swap = np.abs(points[:, 1]) > np.abs(points[:, 0])
    major, minor = np.where(swap, points.T[::-1], points.T)
    angle = math.pi / 4 * np.divide(minor, major, out=np.zeros_like(minor), where=major != 0)
    x, y = major * np.cos(angle), major * np.sin(angle)
    return np.column_stack([np.where(swap, y, x), np.where(swap, x, y)])


def wheel(valence: int, n: int, *, comm: Any = None) -> ControlMesh:
    """Make a regular polygon of sectors around one extraordinary vertex at the origin.

    The domain is the polygon itself, with its corners on the unit circle. Each sector has n x n
    faces and reaches from the origin to a corner and to the middles of the two sides there.

    Args:
        valence: Number of sectors, and of sides of the polygon, three or more.
        n: Faces along a side of a sector, one or more.
        comm: MPI communicator of the mesh.

    Raises:
        TypeError: An argument is not an integer.
        ValueError: valence is less than 3 or n is less than 1.

    >>> wheel(5, 3).extraordinary_vertices
    {0: 5}
    """
    _check_count("valence", valence, minimum=3)
    _check_count("n", n, minimum=1)
    # The rim in steps of half a sector: middles of sides (even) and corners (odd).
    angles = _angles(2 * valence)
    points = np.column_stack([np.cos(angles), np.sin(angles)])
    points[::2] *= math.cos(math.pi / valence)
    ends = np.roll(points[::2], -1, axis=0)
    sectors = zip(points[::2], points[1::2], ends, strict=True)
    blocks = [_bilinear([np.zeros(2), *points], n, n) for points in sectors]
    return ControlMesh(*_joined(blocks), comm=comm)


# The L-domains are [-1, 1]^2 without the quadrant x, y > 0: the paper's solution
# r^(2/3) sin(2 theta / 3 - pi / 3), theta from pi / 2 to 2 pi, vanishes on the two edges that meet
# at the reentrant corner. Corners counter-clockwise from there.
L_CORNERS = np.array([[0.0, 0.0], [0.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0], [1.0, 0.0]])


def l_domain(n: int = 4, *, comm: Any = None) -> ControlMesh:
    """Make the L-domain [-1, 1]^2 without x, y > 0 of three squares of n x n equal faces.

    All six corners are tagged, the reentrant one at the origin among them: three faces meet there.

    Args:
        n: Faces along a side of a square, one or more.
        comm: MPI communicator of the mesh.

    Raises:
        TypeError: n is not an integer.
        ValueError: n is less than 1.

    >>> l_domain()
    ControlMesh(gdim=2, num_vertices=65, num_edges=112, num_faces=48)
    """
    _check_count("n", n, minimum=1)
    return _l_mesh(np.linspace(-1.0, 0.0, n + 1), np.linspace(0.0, 1.0, n + 1), comm)


def l_domain1(*, comm: Any = None) -> ControlMesh:
    """Make the L-domain with the counts of the paper's L-domain1: 153 vertices and 128 faces.

    A grid of 12 x 12 faces without 4 x 4, with no extraordinary vertex: eight columns left of the
    reentrant corner, four right of it, and likewise for the rows. The faces at that corner are
    squares of side 1/8, and the columns on the right widen from there, to 3/8: were they all 1/4
    wide, the limit would fold at the corner. All six corners are tagged.

    Args:
        comm: MPI communicator of the mesh.

    >>> l_domain1()
    ControlMesh(gdim=2, num_vertices=153, num_edges=280, num_faces=128)
    """
    k = np.arange(5)
    return _l_mesh(np.linspace(-1.0, 0.0, 9), k * (k + 2) / 24.0, comm)


def l_domain2(*, comm: Any = None) -> ControlMesh:
    """Make the L-domain with the counts of the paper's L-domain2: 221 vertices and 192 faces.

    The mesh has the paper's four extraordinary vertices and 56 rim edges too, but where they lie is
    our choice: in either arm one vertex of valence 3 and one of valence 5, three edges apart, all
    symmetric about the line y = x. Rim edges are 1/7 long on the outer sides and grow from 1/14 to
    3/14 on those at the reentrant corner. The faces at that corner are squares of side 1/14, so
    that the limit does not fold there; each of the other vertices inside is at the mean of its
    neighbours. All six corners are tagged.

    Args:
        comm: MPI communicator of the mesh.

    >>> sorted(l_domain2().extraordinary_vertices.values())
    [3, 3, 5, 5]
    """
    drawing = ControlMesh(*_joined(_l_domain2_blocks()))
    vertices = np.array(drawing.vertices)
    rim = _rim(drawing, start=np.zeros(2))
    k = np.arange(8)
    graded, even = k * (k + 5) / 84.0, k / 7.0
    sides = [graded, even, np.arange(15) / 14.0, np.arange(15) / 14.0, even, 1.0 - graded[::-1]]
    ends = zip(sides, L_CORNERS, np.roll(L_CORNERS, -1, axis=0), strict=True)
    vertices[rim] = np.concatenate([a + t[:-1, None] * (b - a) for t, a, b in ends])
    # The drawing has squares of side 1 at the reentrant corner.
    ring = np.flatnonzero(np.abs(drawing.vertices).max(axis=1) < 1.5)
    vertices[ring] = drawing.vertices[ring] / 14.0
    return _l_tagged(_relaxed(drawing, vertices, np.union1d(rim, ring)), drawing.quads, comm)


def _l_domain2_blocks() -> list[Floats]:
    """Return the blocks of a drawing with the origin at the reentrant corner and unit faces there.

    A square of 10 x 10 faces at the lower left, and six blocks in either arm: what a plain grid
    would have, and between its columns and rows the two blocks along the line from the vertex of
    valence 3 to the one of valence 5, which are three faces wide.
    """
    three, five = (1, -5), (5, -7)
    corner, top1, top2, top3 = (0, 0), (1, 0), (4, 0), (7, 0)
    left1, left2, left3 = (0, -5), (0, -8), (0, -10)
    bottom, end, right = (1, -10), (7, -10), (7, -5)
    arm = [
        _bilinear([left1, three, top1, corner], 1, 5),
        _bilinear([three, five, top2, top1], 3, 5),
        _bilinear([five, right, top3, top2], 3, 5),
        _bilinear([left2, five, three, left1], 1, 3),
        _bilinear([left3, bottom, five, left2], 1, 2),
        _bilinear([bottom, end, right, five], 3, 2),
    ]
    # Swapping x and y turns faces over; swapping rows and columns turns them back.
    other_arm = [block[:, :, ::-1].swapaxes(0, 1) for block in arm]
    square = _bilinear([(-10, -10), left3, corner, (-10, 0)], 10, 10)
    return [square, *arm, *other_arm]


def _l_mesh(left: Floats, right: Floats, comm: Any) -> ControlMesh:
    """Return the L-domain of three lattices, with the same lines along x as along y."""
    blocks = [_lattice(left, left), _lattice(right, left), _lattice(left, right)]
    return _l_tagged(*_joined(blocks), comm)


def _l_tagged(vertices: Floats, faces: Ints, comm: Any) -> ControlMesh:
    """Return the mesh with the six corners of the L-domain tagged."""
    _, nearest = KDTree(vertices).query(L_CORNERS)
    corners = dict.fromkeys(nearest.tolist(), math.inf)
    return ControlMesh(vertices, faces, corners=corners, comm=comm)


# Blocks


def _lattice(x: Floats, y: Floats) -> Floats:
    """Return the block of all points (x, y), one row for each y."""
    return np.stack(np.meshgrid(x, y), axis=-1)


def _bilinear(corners: npt.ArrayLike, n: int, m: int) -> Floats:
    """Return the block of n x m faces in a quadrilateral, rows from corners 0, 1 to 3, 2."""
    a, b, c, d = np.asarray(corners, dtype=np.float64)
    u, v = np.linspace(0.0, 1.0, n + 1)[:, None], np.linspace(0.0, 1.0, m + 1)[:, None, None]
    block: Floats = (1 - v) * ((1 - u) * a + u * b) + v * ((1 - u) * d + u * c)
    return block


def _joined(blocks: Sequence[Floats]) -> tuple[Floats, Ints]:
    """Return vertices and quads of blocks; points that coincide are one vertex.

    Vertices are numbered as they first appear.

    Args:
        blocks: Points, shapes (rows, columns, gdim).
    """
    points = np.concatenate([block.reshape(-1, block.shape[-1]) for block in blocks])
    begins = itertools.accumulate((block[..., 0].size for block in blocks), initial=0)
    pairs = zip(begins, blocks, strict=False)  # the last begin is the end
    quads = np.concatenate([begin + _quads(block) for begin, block in pairs])
    i, j = KDTree(points).query_pairs(SAME_POINT * np.ptp(points), output_type="ndarray").T
    same = sp.coo_array((np.ones(i.size, dtype=bool), (i, j)), shape=(len(points), len(points)))
    _, number = csgraph.connected_components(same, directed=False)
    _, first, vertex = np.unique(number, return_index=True, return_inverse=True)
    appearance = np.argsort(np.argsort(first))
    return points[np.sort(first)], appearance[vertex][quads].astype(np.int32)


def _quads(block: Floats) -> Ints:
    """Return the quads of a block whose points are numbered row by row, shape (num_faces, 4)."""
    number = np.arange(block[..., 0].size, dtype=np.int32).reshape(block.shape[:2])
    corners = [number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]]
    return np.stack(corners, axis=-1).reshape(-1, 4)


def _rim(mesh: ControlMesh, start: Floats) -> Ints:
    """Return the vertices of the only rim, counter-clockwise from the one nearest to a point."""
    (loop,) = mesh.boundary_loops
    begin = np.argmin(np.linalg.norm(mesh.vertices[loop] - start, axis=1))
    return np.roll(loop, -begin)


def _relaxed(mesh: ControlMesh, vertices: Floats, fixed: Ints) -> Floats:
    """Return the vertices moved to the mean of their neighbours, all except the fixed ones."""
    a, b = mesh.edges.T
    n = mesh.num_vertices
    one_way = sp.coo_array((np.ones(a.size), (a, b)), shape=(n, n)).tocsr()
    laplacian = (sp.diags_array(mesh.valences.astype(np.float64)) - one_way - one_way.T).tocsr()
    free = np.setdiff1d(np.arange(n), fixed)
    rows = laplacian[free]
    moved = vertices.copy()
    moved[free] = spsolve(rows[:, free].tocsc(), -rows[:, fixed] @ vertices[fixed])
    return moved


def _angles(n: int) -> Floats:
    """Return n equal steps around the circle, from 0."""
    return 2.0 * math.pi * np.arange(n) / n


# Arguments


def _check_count(name: str, value: Any, *, minimum: int) -> None:
    """Raise unless the value is an integer that is large enough."""
    if isinstance(value, bool) or not isinstance(value, Integral):
        raise TypeError(f"{name} is {value!r}: expected an integer")
    if value < minimum:
        raise ValueError(f"{name} is {value}: expected {minimum} or more")


def _counts(name: str, value: Any, *, size: int, minimum: int) -> tuple[int, ...]:
    """Return the counts of a shape (n, m) or (n, m, k)."""
    if not isinstance(value, Sequence | np.ndarray) or len(value) != size:
        words = ("two integers (n, m)", "three integers (n, m, k)")[size - 2]
        raise TypeError(f"{name} is {value!r}: expected {words}")
    for k in range(size):
        _check_count(f"{name}[{k}]", value[k], minimum=minimum)
    return tuple(int(count) for count in value)


def _box(lower: Sequence[float], upper: Sequence[float], *, gdim: int) -> tuple[Floats, Floats]:
    """Return both corners of a box."""
    low, high = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
    extent = high - low if low.shape == high.shape == (gdim,) else np.zeros(gdim)
    if not (np.isfinite(extent) & (extent > 0)).all():
        raise ValueError(
            f"the corners are lower = {lower} and upper = {upper}: expected {('two', 'three')[gdim - 2]} finite "
            f"coordinates each, those of lower less than those of upper"
        )
    return low, high
