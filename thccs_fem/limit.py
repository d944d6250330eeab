"""Exact evaluation of the Catmull-Clark limit surface (crease boundary) and of its derivatives.

A face whose vertices are all regular is a bicubic patch.  Points in other faces go down, level by level, into the
children of these faces until they are in a regular one; only faces that hold such points are subdivided.

Three things keep this exact to rounding however near to an extraordinary vertex a point is:

* Coordinates are exact: those in a child are twice a difference that does not round, and points given in a sub-quad
  go to the first subdivision as they are.
* Derivatives are 2^depth times differences of control points that agree in more and more digits.  Therefore, once
  the surroundings of different irregular vertices have nothing in common, the points around each are taken relative
  to its limit position, which is added to positions alone.
* At an irregular vertex itself there are closed-form masks.

The axes of a face and those of its descendants differ by quarter turns and powers of two, which are carried along.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Self

import numpy as np
import numpy.typing as npt

from thccs_fem import jit
from thccs_fem.bezier import VERTEX_PLACE, bezier_masks, spline_grid
from thccs_fem.boundary import Boundary
from thccs_fem.element import TO_BERNSTEIN
from thccs_fem.mesh import ControlMesh
from thccs_fem.positions import child_at, in_quads, in_sub_quads
from thccs_fem.subdivision import Bools, Ints, Level, control_level, neighbourhood, subdivide

__all__ = ["evaluate", "evaluate_patches"]

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.integer]

ROWS = {0: 1, 1: 3, 2: 6}  # of the result for each highest order of derivatives
APART = 4  # from this level on, faces that touch those of one irregular vertex touch none of another
# As near as this, a point counts as at the vertex: the surface between shrinks by 0.66 or more a level, to 1e-36.
AT_VERTEX = 2.0**-200


def evaluate(
    mesh: ControlMesh,
    faces: npt.ArrayLike,
    uv: npt.ArrayLike,
    derivatives: int = 1,
    corner: npt.ArrayLike | None = None,
) -> Floats:
    """Evaluate the limit surface and its derivatives.

    At an irregular vertex (interior with other than four faces, on a smooth boundary with three or more, a corner with
    two or more) derivatives vanish or diverge.  Instead of the first ones there are two tangent vectors along the edges
    of the face, whose cross product points along the normal, from closed-form masks on the first subdivision; where
    four faces meet these would be the derivatives.  Where there is no tangent plane (two faces inside, four or more on
    a smooth boundary, corners), tangents other than those of the boundary curve are NaN.  So are second derivatives.

    Args:
        mesh: The control mesh.
        faces: Face of each point, integers of shape (m,).
        uv: Coordinates in [0, 1]^2, shape (m, 2): of the face, u along its edge from corner 0 to 1 and v from corner 0
            to 3; or, where `corner` names one, of the sub-quad there: (0, 0) is the corner, u runs towards the next
            one, (1, 1) is the face point.
        derivatives: Highest order: 0, 1 or 2.
        corner: Corner of the face, -1 for none, integers of shape (m,); faces that are no quads need one.

    Returns:
        Position, d/du, d/dv, d2/du2, d2/dudv, d2/dv2, or the first of these, in the coordinates given; shape
        (1, m, gdim), (3, m, gdim) or (6, m, gdim) for derivatives = 0, 1, 2.

    Raises:
        ValueError: If an argument is out of range, or a corner is missing.
        TypeError: If faces or corners are no integers.
        NotImplementedError: If the mesh has creases, or corners that are semi-sharp or inside the surface.

    >>> square = ControlMesh([(0, 0), (2, 0), (2, 1), (0, 1)], [(0, 1, 2, 3)])
    >>> evaluate(square, [0], [(0.25, 0.5)]).tolist()
    [[[0.5, 0.5]], [[2.0, 0.0]], [[0.0, 1.0]]]
    """
    if derivatives not in ROWS:
        raise ValueError(f"derivatives is {derivatives!r}; expected the highest order wanted: 0, 1 or 2")
    ends = _descend(mesh, faces, uv, corner)
    coefficients = np.concatenate([np.zeros((0, 16, mesh.gdim)), *ends.coefficients])
    at_vertex = np.flatnonzero(ends.patch < 0)
    if at_vertex.size:
        out = np.full((ROWS[derivatives], ends.patch.size, mesh.gdim), np.nan)
        inside = np.flatnonzero(ends.patch >= 0)
        out[:, inside] = evaluate_patches(ends.patch[inside], ends.uv[inside], coefficients, derivatives)
        out[0, at_vertex] = 0.0
        out[1:3, at_vertex] = ends.tangents[: len(out) - 1, at_vertex]
    else:
        out = evaluate_patches(ends.patch, ends.uv, coefficients, derivatives)
    out[0] += ends.origin
    _turn(out, ends.turns, ends.scale)
    return out


def evaluate_patches(patches: Ints, uv: Floats, coefficients: Floats, derivatives: int = 0) -> Floats:
    """Evaluate functions with values in R^k that are given by bicubic patches.

    Args:
        patches: Patch of each point, shape (m,).
        uv: Coordinates in the patch, shape (m, 2).
        coefficients: Bernstein coefficients, that of B_i(u) B_j(v) at i + 4 j, shape (num_patches, 16, k).
        derivatives: Highest order: 0, 1 or 2.

    Returns:
        Value, d/du, d/dv, d2/du2, d2/dudv, d2/dv2, or the first of these, shape (1 or 3 or 6, m, k).
    """
    library = jit.library()
    buffer = library.ffi.from_buffer
    size = coefficients.shape[2]
    out = np.zeros((ROWS[derivatives], patches.size, size))
    library.lib.thccs_evaluate_patches(
        patches.size,
        buffer("int32_t[]", np.ascontiguousarray(patches, dtype=np.int32)),
        buffer("double[]", np.ascontiguousarray(uv, dtype=np.float64)),
        size,
        buffer("double[]", np.ascontiguousarray(coefficients, dtype=np.float64)),
        len(out),
        buffer("double[]", out),
    )
    return out


@dataclass(frozen=True, eq=False)
class _Places:
    """Where points are on a level.

    Attributes:
        points: Numbers of the points, shape (n,).
        face: Faces of the level, shape (n,).
        uv: Coordinates in these, shape (n, 2).
    """

    points: Indices
    face: Ints
    uv: Floats

    def where(self, mask: Bools) -> _Places:
        """Return the marked ones."""
        return self if mask.all() else _Places(self.points[mask], self.face[mask], self.uv[mask])

    def marked(self, level: Level) -> Bools:
        """Return the faces with points, shape (level.num_faces,)."""
        marked = np.zeros(level.num_faces, dtype=bool)
        marked[self.face] = True
        return marked


@dataclass(eq=False)
class _Ends:
    """Where m points end, on a patch or at an irregular vertex; filled as they get there.

    Attributes:
        patch: Patch, -1 at irregular vertices, shape (m,).
        uv: Coordinates in the patch, shape (m, 2).
        turns: Quarter turns from the user's axes to those of the patch, shape (m,).
        scale: Length of the user's unit in those of the patch, shape (m,).
        origin: To be added to positions, shape (m, gdim).
        tangents: Those at irregular vertices, shape (2, m, gdim).
        coefficients: Bernstein coefficients of the patches, arrays of shape (n, 16, gdim).
    """

    patch: Ints
    uv: Floats
    turns: Ints
    scale: Floats
    origin: Floats
    tangents: Floats
    coefficients: list[Floats] = field(default_factory=list)

    @classmethod
    def none(cls, corner: Indices, gdim: int) -> Self:
        """Return those of points that are still on the control mesh, in sub-quads where a corner is named."""
        m = corner.size
        return cls(
            patch=np.full(m, -1, dtype=np.int32),
            uv=np.zeros((m, 2)),
            turns=-np.maximum(corner, 0).astype(np.int32),
            scale=np.where(corner >= 0, 0.5, 1.0),
            origin=np.zeros((m, gdim)),
            tangents=np.zeros((2, m, gdim)),
        )

    def on_regular_faces(self, level: Level, x: Floats, on: _Places) -> _Places:
        """End the points in regular faces there; return the others."""
        regular = ~level.touching(~level.regular)[on.face]
        done = on.where(regular)
        marked = done.marked(level)
        number = sum(map(len, self.coefficients)) + np.cumsum(marked) - 1
        self.patch[done.points] = number[done.face]
        self.uv[done.points] = done.uv
        self.coefficients.append(_patches(level, x, np.flatnonzero(marked).astype(np.int32)))
        return on.where(~regular)

    def at_vertices(self, level: Level, x: Floats, on: _Places) -> _Places:
        """End the points at irregular vertices of the first subdivision there; return the others.

        Such vertices are corner 0 of their faces and, if they are the face points of polygons, corner 2.
        """
        k = np.where(on.uv[:, 0] < 0.5, 0, 2)
        offset = np.where(k[:, None] == 0, on.uv, 1.0 - on.uv)
        at = (offset < AT_VERTEX).all(axis=1) & ~level.regular[level.quads[on.face, k]]
        if at.any():
            half_edges, number = np.unique((4 * on.face + k)[at], return_inverse=True)
            points = on.points[at]
            self.origin[points] = _limit_positions(level, x, half_edges)[number]
            self.tangents[:, points] = _limit_tangents(level, x, half_edges)[:, number]
            self.turns[points] += k[at]
        return on.where(~at)


def _descend(mesh: ControlMesh, faces: npt.ArrayLike, uv: npt.ArrayLike, corner: npt.ArrayLike | None) -> _Ends:
    """Return where the points end; arguments as for `evaluate`."""
    control = control_level(mesh)
    left: Indices = np.arange(np.size(faces))
    corners = np.broadcast_to(-1 if corner is None else np.asarray(corner), left.shape)
    ends = _Ends.none(corners, mesh.gdim)
    if mesh.is_quad:
        on = _Places(left, *in_quads(mesh, faces, uv, corners))
        on = ends.on_regular_faces(control, mesh.vertices, on)
        left = on.points
        # From what was given: coordinates in the whole face are rounded where a corner is named.
        half_edge, local = in_sub_quads(mesh, on.face, np.asarray(uv, dtype=np.float64)[left], corners[left])
    else:
        half_edge, local = in_sub_quads(mesh, faces, uv, corners)
    if not left.size:
        return ends
    face = control.face[half_edge]
    child = half_edge - control.offsets[face]
    level, x, on = _next_level(control, mesh.vertices, ends, _Places(left, face, local), child)
    on = ends.at_vertices(level, x, on)
    while (on := ends.on_regular_faces(level, x, on)).points.size:
        if level.number >= APART:
            x = _relative_to_vertices(level, x, ends, on)
        child, local = child_at(on.uv)
        level, x, on = _next_level(level, x, ends, _Places(on.points, on.face, local), child)
    return ends


def _next_level(level: Level, x: Floats, ends: _Ends, on: _Places, child: Ints) -> tuple[Level, Floats, _Places]:
    """Subdivide the faces with points and send these to the given children; their coordinates are those there."""
    step = subdivide(level, neighbourhood(level, on.marked(level)))
    ends.turns[on.points] += child
    ends.scale[on.points] *= 2.0
    return step.fine, step.matrix @ x, _Places(on.points, step.first_child[on.face] + child, on.uv)


def _patches(level: Level, x: Floats, faces: Ints) -> Floats:
    """Return the Bernstein coefficients of regular faces, shape (n, 16, gdim)."""
    gdim = x.shape[1]
    patches = np.zeros((faces.size, 16, gdim))
    inside = ~level.touching(level.boundary)[faces]
    grid = spline_grid(level, faces[inside])
    patches[inside] = (TO_BERNSTEIN @ x[grid.T].reshape(16, -1)).reshape(16, -1, gdim).swapaxes(0, 1)
    if not inside.all():
        masks = bezier_masks(Boundary.of(level, "crease"), faces[~inside])
        patches[~inside] = (masks @ x).reshape(-1, 16, gdim)
    return patches


def _relative_to_vertices(level: Level, x: Floats, ends: _Ends, on: _Places) -> Floats:
    """Return the control points relative to the limit position of the irregular vertex (corner 0) that they are around.

    The others are of no use any more.
    """
    faces = np.flatnonzero(on.marked(level)).astype(np.int32)
    vertex = level.quads[faces, 0]
    limit = np.zeros_like(x)
    limit[vertex] = _limit_positions(level, x, 4 * faces)
    ends.origin[on.points] += limit[level.quads[on.face, 0]]
    around = np.full(level.num_vertices, -1, dtype=np.int32)
    around[vertex] = vertex
    for _ in range(2):  # the faces at the vertex, and those that touch them
        of_face = around[level.quads].max(axis=1)
        around[level.quads[of_face >= 0]] = of_face[of_face >= 0, None]
    return x - np.where((around >= 0)[:, None], limit[around], 0.0)


def _limit_positions(level: Level, x: Floats, half_edges: Ints) -> Floats:
    """Return the limit positions of the vertices where half-edges of a quadrilateral level start, shape (n, gdim)."""
    faces, k = np.divmod(half_edges, 4)
    masks = bezier_masks(Boundary.of(level, "crease"), faces)
    return np.asarray(masks[16 * np.arange(k.size) + VERTEX_PLACE[k]] @ x)


def _limit_tangents(level: Level, x: Floats, half_edges: Ints) -> Floats:
    """Return the limit tangents along half-edges and along the edges before them, at the vertices where they start.

    The masks are left eigenvectors of the subdivision around a vertex (Halstead, Kass, DeRose 1993), as long as makes
    the tangent 1 on the right eigenvector with edges cos(i theta): theta is 2 pi / n, or pi / n on the boundary.

    Returns:
        Shape (2, n, gdim).
    """
    edges, opposite, place = _ring(level, half_edges)
    vertex = level.vertices[half_edges]
    n = level.vertex_num_faces[vertex]
    kinds = (
        (~level.boundary[vertex], _interior_mask),
        (level.boundary[vertex] & ~level.corner[vertex], _smooth_mask),
        (level.corner[vertex], _corner_mask),
    )
    tangents = np.zeros((2, vertex.size, x.shape[1]))
    # The masks sum to zero: relative to the vertex it needs no weight.
    to_edges, to_opposite = x[edges] - x[vertex][:, None], x[opposite] - x[vertex][:, None]
    for side in (0, 1):
        for of_kind, mask in kinds:
            weights = mask(n[of_kind, None], place[of_kind, None] + side, np.arange(edges.shape[1]))
            for weight, points in zip(weights, (to_edges, to_opposite), strict=True):
                tangents[side, of_kind] += np.einsum("ni,nic->nc", weight, points[of_kind])
    return tangents


def _ring(level: Level, half_edges: Ints) -> tuple[Ints, Ints, Ints]:
    """Return the vertices around those where the half-edges start, counter-clockwise.

    A ring begins with the half-edge, on the boundary with the rim.  Rows are as long as the longest; what is beyond the
    edges 0 .. n and the faces 0 .. n - 1 of a vertex with n faces has no meaning.

    Returns:
        Ends of the edges, shape (m, n_max + 1), opposite corners of the faces, shape (m, n_max), and number of the
        half-edge in its ring, shape (m,).
    """
    twins, following, previous = level.twins, level.following, level.previous
    vertex = level.vertices[half_edges]
    here, place = half_edges, np.zeros_like(half_edges)
    while (back := level.boundary[vertex] & (twins[here] >= 0)).any():
        here = np.where(back, following[twins[here]], here)
        place += back
    n_max = int(level.vertex_num_faces[vertex].max())
    edges = np.zeros((vertex.size, n_max + 1), dtype=np.int32)
    opposite = np.zeros((vertex.size, n_max), dtype=np.int32)
    edges[:, 0] = level.vertices[following[here]]
    for i in range(n_max):
        opposite[:, i] = level.vertices[following[following[here]]]
        edges[:, i + 1] = level.vertices[previous[here]]
        here = np.where(twins[previous[here]] >= 0, twins[previous[here]], here)
    return edges, opposite, place


def _interior_mask(n: Ints, direction: Ints, i: Indices) -> tuple[Floats, Floats]:
    """Return the weights of edges i and faces i for the tangent along an edge, at interior vertices of n faces."""
    theta = 2.0 * np.pi / n
    a = _edge_weight(theta)
    along = np.where(i < n, np.cos(theta * (i - direction)), 0.0)
    along_next = np.where(i < n, np.cos(theta * (i + 1 - direction)), 0.0)
    length = np.where(n == 2, np.nan, _squared_length(n, theta, a))  # a symmetric eigenvector is as large: no plane
    return a * along / length, ((along + along_next) / length)[:, :-1]


def _smooth_mask(n: Ints, direction: Ints, i: Indices) -> tuple[Floats, Floats]:
    """Return the same on smooth boundaries: cos times the tangent along the rim plus sin times that across.

    Across, the weights inside are those of 2 n faces; the rim vertices get what makes it an eigenvector.
    """
    theta = np.pi / n
    a = _edge_weight(theta)
    inside = np.sin(theta * i)
    rim = (np.sin(theta) * (a + 4.0) - 2.0 * (a + 2.0) / np.tan(theta / 2.0)) / a
    length = _squared_length(n, theta, a)
    across = np.where((i == 0) | (i == n), rim, np.where(i < n, a * inside, 0.0)) / length
    across_faces = np.where(i < n, inside + np.sin(theta * (i + 1)), 0.0) / length
    along = 0.5 * (i == 0) - 0.5 * (i == n)
    on_rim = (direction == 0) | (direction == n)
    sin = np.where(on_rim, 0.0, np.where(n <= 3, np.sin(theta * direction), np.nan))
    return np.cos(theta * direction) * along + sin * across, (sin * across_faces)[:, :-1]


def _corner_mask(n: Ints, direction: Ints, i: Indices) -> tuple[Floats, Floats]:
    """Return the same at corners, where the boundary curves begin along their first edges."""
    on_rim = (direction == 0) | (direction == n)
    return np.where(on_rim, 1.0 * (i == direction), np.nan), np.zeros((len(n), i.size - 1))


def _edge_weight(theta: Floats) -> Floats:
    """Return a = 16 lambda - 4, the weight of edges relative to faces."""
    cos = np.cos(theta)
    return np.asarray(1.0 + cos + np.cos(theta / 2.0) * np.sqrt(2.0 * (9.0 + cos)))


def _squared_length(n: Ints, theta: Floats, a: Floats) -> Floats:
    """Return the left eigenvector (a cos, cos + cos) times the right one (cos, (cos + cos) 4 / a), around n faces."""
    return n / 2.0 * (a + 8.0 * (1.0 + np.cos(theta)) / a)


def _turn(out: Floats, turns: Ints, scale: Floats) -> None:
    """Take derivatives from the axes of the patches to those of the user, in place."""
    moved = np.flatnonzero((turns != 0) | (scale != 1.0))
    if len(out) == 1 or not moved.size:
        return
    quarter, length = turns[moved] % 4, scale[moved, None]
    odd = (quarter % 2 == 1)[:, None]
    u, v = out[1:3, moved]
    sign_u, sign_v = np.array([1.0, -1.0, -1.0, 1.0])[quarter, None], np.array([1.0, 1.0, -1.0, -1.0])[quarter, None]
    out[1, moved] = sign_u * length * np.where(odd, v, u)
    out[2, moved] = sign_v * length * np.where(odd, u, v)
    if len(out) == 6:
        uu, uv, vv = out[3:6, moved]
        out[3, moved] = length**2 * np.where(odd, vv, uu)
        out[4, moved] = sign_u * sign_v * length**2 * uv
        out[5, moved] = length**2 * np.where(odd, uu, vv)
