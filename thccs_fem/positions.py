"""Where a point lies: coordinates in faces, in their sub-quads, and in the children of quads.

Child k of a quad has corner k of the quad as its corner 0; its axes are those of the quad turned by k right angles.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from thccs_fem.mesh import ControlMesh

__all__ = ["CHILD_AXES", "CHILD_ORIGIN", "child_at", "in_quads", "in_sub_quads", "side_points"]

Ints = npt.NDArray[np.int32]

# Child k of a quad: parent (u, v) = CHILD_ORIGIN[k] + CHILD_AXES[k] @ child (u, v) / 2; axes in columns.
CHILD_ORIGIN = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
CHILD_AXES = np.array([[[1, 0], [0, 1]], [[0, -1], [1, 0]], [[-1, 0], [0, -1]], [[0, 1], [-1, 0]]], dtype=float)


def side_points(t: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return points on the sides of a quad, side k from corner k to corner k + 1, shape (4, n, 2), t shape (n,)."""
    return CHILD_ORIGIN[:, None] + CHILD_AXES[:, None, :, 0] * np.asarray(t)[:, None]


def child_at(uv: npt.NDArray[np.float64]) -> tuple[Ints, npt.NDArray[np.float64]]:
    """Return the child of a quad that holds each point and the point's coordinates there.

    Args:
        uv: Points in [0, 1]^2, shape (n, 2).

    Returns:
        Child numbers 0 .. 3, shape (n,), and coordinates in [0, 1]^2 of the child, shape (n, 2).
    """
    right, upper = uv[:, 0] >= 0.5, uv[:, 1] >= 0.5
    child = np.where(upper, np.where(right, 2, 3), np.where(right, 1, 0)).astype(np.int32)
    # The axes are rotations: the inverse is the transpose.
    return child, 2.0 * np.einsum("nji,nj->ni", CHILD_AXES[child], uv - CHILD_ORIGIN[child])


def in_sub_quads(
    mesh: ControlMesh, faces: npt.ArrayLike, uv: npt.ArrayLike, corner: npt.ArrayLike | None = None
) -> tuple[Ints, npt.NDArray[np.float64]]:
    """Return the child of the first subdivision that holds each point and the point's coordinates there.

    Args:
        mesh: The control mesh.
        faces: Faces of the mesh, shape (n,).
        uv: Coordinates in [0, 1]^2, shape (n, 2): of the face, u along its edge from corner 0 to 1 and v from corner 0
            to 3; or, where `corner` names one, of the sub-quad there: (0, 0) the corner, u towards the next one, (1, 1)
            the face point.
        corner: Corner of the face, -1 for none, shape (n,); faces that are no quads need one.

    Returns:
        Half-edges of the mesh (the child at half-edge h has number h), shape (n,), and coordinates, shape (n, 2).

    Raises:
        ValueError: If an argument is out of range, or a corner is missing.
    """
    faces, uv, corner = _checked_positions(mesh, faces, uv, corner)
    child, inner = child_at(uv)
    whole = corner < 0
    half_edge = mesh.face_offsets[faces] + np.where(whole, child, corner)
    return half_edge.astype(np.int32), np.where(whole[:, None], inner, uv)


def in_quads(
    mesh: ControlMesh, faces: npt.ArrayLike, uv: npt.ArrayLike, corner: npt.ArrayLike | None = None
) -> tuple[Ints, npt.NDArray[np.float64]]:
    """Return the face and the coordinates of points in faces that are quads; arguments as for `in_sub_quads`."""
    faces, uv, corner = _checked_positions(mesh, faces, uv, corner)
    if (corner < 0).all():
        return faces, uv
    outer = CHILD_ORIGIN[corner] + np.einsum("nij,nj->ni", CHILD_AXES[corner], uv) / 2.0
    return faces, np.where((corner < 0)[:, None], uv, outer)


def _checked_positions(
    mesh: ControlMesh, faces: npt.ArrayLike, uv: npt.ArrayLike, corner: npt.ArrayLike | None
) -> tuple[Ints, npt.NDArray[np.float64], Ints]:
    faces = np.atleast_1d(np.asarray(faces))
    uv = np.asarray(uv, dtype=np.float64)
    corner = np.full(faces.shape, -1) if corner is None else np.asarray(corner)
    if not (faces.size or uv.size or corner.size):  # no points: lists without any are of no shape and no type
        faces, uv, corner = np.zeros(0, dtype=np.int32), np.zeros((0, 2)), np.zeros(0, dtype=np.int32)
    if not np.issubdtype(faces.dtype, np.integer) or not np.issubdtype(corner.dtype, np.integer):
        raise TypeError(f"faces and corner must be integers, got {faces.dtype} and {corner.dtype}")
    if corner.shape != faces.shape:
        raise ValueError(f"corner must have shape {faces.shape}, one for each of the faces; got {corner.shape}")
    if uv.shape != (*faces.shape, 2) or faces.ndim != 1:
        raise ValueError(f"uv must have shape ({faces.size}, 2), two coordinates for each of the faces; got {uv.shape}")
    bad = np.flatnonzero((faces < 0) | (faces >= mesh.num_faces))
    if bad.size:
        raise ValueError(f"point {bad[0]} is on face {faces[bad[0]]}; the mesh has faces 0 to {mesh.num_faces - 1}")
    sizes = mesh.face_sizes[faces]
    bad = np.flatnonzero((corner >= sizes) | ((corner < 0) & (sizes != 4)))
    if bad.size:
        raise ValueError(
            f"point {bad[0]} is on face {faces[bad[0]]} with {sizes[bad[0]]} corners and names corner "
            f"{corner[bad[0]]}; "
            f"a face that is no quad needs a corner from 0 to {sizes[bad[0]] - 1} for each of its points"
        )
    bad = np.flatnonzero(~((uv >= 0.0) & (uv <= 1.0)).all(axis=1))
    if bad.size:
        raise ValueError(f"point {bad[0]} has coordinates {uv[bad[0]]}; both must lie in [0, 1]")
    return faces.astype(np.int32), uv, corner.astype(np.int32)
