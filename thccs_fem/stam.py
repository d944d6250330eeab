"""The functions on an irregular element, explicitly: Stam's evaluation (Stam 1998; Wei et al. 2015, sec. 3, eq. 9).

An irregular element has one extraordinary vertex, inside the surface and of valence N, at corner 0.  K = 2 N + 8
functions do not vanish on it.  They are numbered by their vertices: the extraordinary one, the 2 N around it counter-
clockwise (ends of edges and opposite corners in turn, beginning with corner 1 of the element, so that functions 0 to 3
are those of its corners), then the two arms and the corner of what is left::

        2N+4  2N+5  2N+6  2N+7
          4     3     2   2N+3        v
          5     0     1   2N+2        |
         ..  2N-1    2N   2N+1        0-- u

One subdivision takes the K control points of the element to those of its child at corner 0 by a matrix A, and to the
16 of each of its three other, regular, children.  So a point in (0, 2^-m]^2 asks for A^m: with A = V L V^-1 that costs
no more than powers of numbers, however near to the vertex the point is.

The eigenstructure comes from symmetric problems alone.  A is block lower triangular: the vertex and its ring (2 N + 1),
the arms (3 and 3), the corner (1).  Each block is symmetric in the inner product of its limit mask (weights N^2, 4, 1
around the vertex, 1, 4, 1 on an arm), so `eigh` gives all eigenvalues, real, with orthogonal vectors, for multiple ones
too.  What remains is to continue the vectors of one block into the next, by division by the difference of eigenvalues.
These differ, but for 1/8, which the ring shares with the arms where N is a multiple of 4; there the numerator vanishes
as well: A has no Jordan block for any N >= 3.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from thccs_fem import element, generators
from thccs_fem.bezier import spline_grid
from thccs_fem.limit import AT_VERTEX, ROWS, evaluate_patches
from thccs_fem.subdivision import Bools, Ints, Level, control_level, subdivide

__all__ = ["Eigenstructure", "eigenstructure", "evaluate", "stencil", "subdivision_matrices"]

Floats = npt.NDArray[np.float64]

EQUAL = 1e-9  # eigenvalues of two blocks that are nearer are equal; the others differ by 1e-3 or more up to N = 64
ORDERS = (0, 1, 1, 2, 2, 2)  # of differentiation, of the rows of `evaluate`


def evaluate(valence: int, uv: npt.ArrayLike, derivatives: int = 0) -> Floats:
    """Evaluate the functions on an irregular element (eq. 9).

    Values are exact to rounding; so are derivatives, relative to the largest one there, however near to the vertex.

    Args:
        valence: N, 3 or more; 4 gives the 16 bicubic B-splines in another order (then second derivatives, bounded for
            4 alone, have rounding errors that grow like 1 / max(u, v)).
        uv: Coordinates in [0, 1]^2, (0, 0) the extraordinary vertex, u towards corner 1, v towards corner 3, (m, 2).
        derivatives: Highest order: 0, 1 or 2.

    Returns:
        Values, d/du, d/dv, d2/du2, d2/dudv, d2/dv2, or the first of these, shape (1 or 3 or 6, m, 2 N + 8). At the
        extraordinary vertex values are those of the limit mask, 2 N + 1 of them nonzero, and derivatives NaN: there,
        they vanish or diverge.

    Raises:
        ValueError: If an argument is out of range.

    >>> evaluate(5, [(0.0, 0.0)])[0, 0, :3].tolist()  # N / (N + 5), 4 / (N (N + 5)), 1 / (N (N + 5))
    [0.5, 0.08, 0.02]
    """
    if derivatives not in ROWS:
        raise ValueError(f"derivatives is {derivatives!r}; expected the highest order wanted: 0, 1 or 2")
    eigen = eigenstructure(valence)
    uv = _checked(uv)
    out = np.full((ROWS[derivatives], len(uv), eigen.eigenvalues.size), np.nan)
    farther = uv.max(axis=1)
    at_vertex = farther < AT_VERTEX
    out[0, at_vertex] = eigen.left[0]
    inside = np.flatnonzero(~at_vertex)
    # The point is in a child other than that at corner 0 after `depth` steps: 2^-depth <= max(u, v) <= 2^(1 - depth).
    depth = np.maximum(1 - np.frexp(farther[inside])[1], 1)
    scaled = np.ldexp(uv[inside], depth[:, None] - 1)
    child, local = _regular_child(scaled)
    functions = evaluate_patches(child, local, eigen.patches, derivatives)
    functions[1:, :, 0] = 0.0  # derivatives of the constant eigenfunction, lest their rounding errors be scaled up
    powers = eigen.eigenvalues ** (depth[:, None] - 1)
    for row, order in enumerate(ORDERS[: len(out)]):
        out[row, inside] = (np.ldexp(functions[row], order * depth[:, None]) * powers) @ eigen.left
    return out


def _checked(uv: npt.ArrayLike) -> Floats:
    uv = np.asarray(uv, dtype=np.float64)
    if uv.ndim != 2 or uv.shape[1] != 2:
        raise ValueError(f"uv must have shape (m, 2), two coordinates a point; got {uv.shape}")
    bad = np.flatnonzero(~((uv >= 0.0) & (uv <= 1.0)).all(axis=1))
    if bad.size:
        raise ValueError(f"point {bad[0]} has coordinates {uv[bad[0]]}; both must lie in [0, 1]")
    return uv


def _regular_child(uv: Floats) -> tuple[Ints, Floats]:
    """Return which of the three regular children holds each point, and the point there, along the parent's axes."""
    beyond = uv >= 0.5
    child = np.where(beyond[:, 0], np.where(beyond[:, 1], 1, 0), 2).astype(np.int32)
    return child, 2.0 * uv - beyond


@dataclass(frozen=True, eq=False)
class Eigenstructure:
    """A = right @ diag(eigenvalues) @ left of an irregular element, left the inverse of right.

    Eigenvalue 0 is 1: right[:, 0] is constant and left[0] the limit mask of the extraordinary vertex.

    Attributes:
        eigenvalues: Those of the vertex and its ring, falling, then of the arms and of the corner, shape (2 N + 8,).
        right: Right eigenvectors in columns, shape (2 N + 8, 2 N + 8).
        left: Left eigenvectors in rows, shape (2 N + 8, 2 N + 8).
        patches: Bernstein coefficients of the eigenfunctions on children 1, 2 and 3 of the element, along the axes of
            the element, shape (3, 16, 2 N + 8).
    """

    eigenvalues: Floats
    right: Floats
    left: Floats
    patches: Floats

    def __post_init__(self) -> None:
        for value in self.__dict__.values():
            value.setflags(write=False)


@functools.cache
def eigenstructure(valence: int) -> Eigenstructure:
    """Return the eigenstructure of the subdivision of an irregular element.

    Args:
        valence: N, 3 or more.

    Raises:
        ValueError: If the valence is less than 3.

    >>> eigenstructure(5).eigenvalues[:3].round(6).tolist()  # 1, and twice (5 + c + sqrt((c + 1) (c + 9))) / 16, c =
    [1.0, 0.549988, 0.549988]
    """  # cos(2 pi / 5)
    A, patches = subdivision_matrices(valence)
    ring, arms = 2 * valence + 1, 2 * valence + 7
    on_ring = np.concatenate([[valence**2], np.tile([4, 1], valence)])
    eigenvalues, right, left = _symmetric(A[:ring, :ring], on_ring)
    blocks = ((ring, arms, np.array([1, 4, 1, 1, 4, 1])), (arms, arms + 1, np.array([1])))
    for begin, end, weights in blocks:
        block = _symmetric(A[begin:end, begin:end], weights)
        eigenvalues, right, left = _continued((eigenvalues, right, left), A[begin:end, :begin], block)
    # What is known exactly of the largest: its powers are one, and constants are what they are.
    eigenvalues[0], right[:, 0], left[0, :ring] = 1.0, 1.0, on_ring / on_ring.sum()
    return Eigenstructure(eigenvalues, right, left, element.TO_BERNSTEIN @ patches @ right)


def _symmetric(block: Floats, weights: npt.NDArray[np.integer]) -> tuple[Floats, Floats, Floats]:
    """Return eigenvalues, falling, right and left eigenvectors of a matrix that is symmetric in a weighted product."""
    root = np.sqrt(weights)
    values, vectors = np.linalg.eigh(root[:, None] * block / root)
    values, vectors = values[::-1].copy(), vectors[:, ::-1]
    return values, vectors / root[:, None], vectors.T * root


def _continued(
    first: tuple[Floats, Floats, Floats], lower: Floats, second: tuple[Floats, Floats, Floats]
) -> tuple[Floats, Floats, Floats]:
    """Return the eigenstructure of [[A1, 0], [lower, A2]] from those of A1 and A2.

    The second part w of a vector r of A1 solves (value - A2) w = lower r.
    """
    (values, right, left), (other_values, other_right, other_left) = first, second
    difference = values - other_values[:, None]
    equal = np.abs(difference) < EQUAL
    coupling = np.where(equal, 0.0, other_left @ lower @ right)  # they are zero where the eigenvalues are equal
    continuation = other_right @ (coupling / np.where(equal, 1.0, difference))
    zeros = np.zeros((len(values), len(other_values)))
    return (
        np.concatenate([values, other_values]),
        np.block([[right, zeros], [continuation, other_right]]),
        np.block([[left, zeros], [-other_left @ continuation @ left, other_left]]),
    )


@functools.cache
def subdivision_matrices(valence: int) -> tuple[Floats, Floats]:
    """Return A, and what gives the regular children, of an irregular element.

    On child 0 the functions are A^T times those of the child, which is the refinability of eq. 13.

    Args:
        valence: N, 3 or more.

    Returns:
        A: control points of child 0 from those of the element, shape (2 N + 8, 2 N + 8); and the local B-spline
        coefficients of children 1, 2 and 3 along the axes of the element, shape (3, 16, 2 N + 8).

    Raises:
        ValueError: If the valence is less than 3.
    """
    if valence < 3:
        raise ValueError(f"the valence is {valence}; an irregular element has 3 or more faces at its vertex")
    level = control_level(generators.wheel(valence, 2))
    step = subdivide(level, np.ones(level.num_faces, dtype=bool))
    columns = stencil(level, np.zeros(1, dtype=np.int32))[0]  # face 0 of a wheel begins at its hub
    child = step.first_child[0] + np.arange(4, dtype=np.int32)
    rows = stencil(step.fine, 4 * child[:1])[0]
    # A child's axes are those of the element in quarter turns.
    grids = [np.rot90(spline_grid(step.fine, child[k : k + 1]).reshape(4, 4), -k).ravel() for k in (1, 2, 3)]
    matrix = step.matrix.toarray()[:, columns]
    A, patches = matrix[rows], matrix[np.stack(grids)]
    A.setflags(write=False)
    patches.setflags(write=False)
    return A, patches


def stencil(level: Level, half_edges: Ints) -> Ints:
    """Return the vertices whose functions do not vanish on irregular elements.

    Args:
        level: A quadrilateral level.
        half_edges: For each element the half-edge from its extraordinary vertex to its corner 1, shape (n,).

    Returns:
        Shape (n, 2 N + 8), in the order of `evaluate`.

    Raises:
        ValueError: If the valences differ, or an element has a corner on the boundary, a second irregular one, or one
            with faces that are not held.
    """
    _check_elements(level, half_edges)
    following, previous, twins = level.following, level.previous, level.twins
    start = level.vertices
    beyond = following[following]
    found = [start[half_edges]]
    here = half_edges
    for _ in range(level.vertex_num_faces[start[half_edges]].max(initial=0)):
        found += [start[following[here]], start[beyond[here]]]
        here = twins[previous[here]]
    # Across the sides that do not meet the vertex: first that after corner 1, then that after corner 2.
    right, upper = twins[following[half_edges]], twins[beyond[half_edges]]
    found += [start[previous[twins[following[right]]]], start[beyond[right]], start[previous[right]]]
    found += [start[beyond[twins[previous[upper]]]], start[previous[upper]], start[beyond[upper]]]
    found += [start[beyond[twins[previous[right]]]]]
    return np.stack(found, axis=1)


def _check_elements(level: Level, half_edges: Ints) -> None:
    corners = level.quads[half_edges // 4]
    valences = level.vertex_num_faces[level.vertices[half_edges]]
    if valences.size and (valences != valences[0]).any():
        raise ValueError(f"the elements have vertices of valences {np.unique(valences).tolist()}; give those of one")
    plain: Bools = level.regular & ~level.boundary
    num_plain = np.count_nonzero(plain[corners], axis=1) - plain[level.vertices[half_edges]]
    fit = (num_plain == 3) & level.complete[corners].all(axis=1) & ~level.boundary[corners].any(axis=1)
    if not fit.all():
        face = int(half_edges[~fit][0]) // 4
        raise ValueError(
            f"face {face} has a corner on the boundary, or irregular besides the one named, or with faces that are not "
            f"held: Stam's evaluation is for one extraordinary vertex an element. Subdivide the mesh once or twice."
        )
