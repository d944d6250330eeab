"""Values at points as a matrix, which makes forces at points of its transpose."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from thccs_fem import element
from thccs_fem.fem.space import FunctionSpace, check_space

__all__ = ["point_values"]


def point_values(
    V: FunctionSpace, faces: npt.ArrayLike, uv: npt.ArrayLike, corner: npt.ArrayLike | None = None
) -> sp.csr_array:
    """Return the values of all functions of a space at points.

    With B this matrix and k components, ``B @ u.x.array.reshape(-1, k)`` are the values of a function u. A force F_i at
    point i does the work F_i . v(x_i) on a test function v, so that forces F of shape (n, k) are the load
    ``(B.T @ F).ravel()``.

    On several ranks all give the same points, and columns are local functions. Rows of points on cells that a rank does
    not hold are zero (`Function.eval` has all values); but it holds all cells of the functions that it owns, so that
    this part of the load is complete.

    Args:
        V: The space; of one with vector values the scalar functions are meant.
        faces: Faces of the control mesh, shape (n,).
        uv: Coordinates in [0, 1]^2, shape (n, 2), as for `limit.evaluate`.
        corner: Sub-quad of a polygon, shape (n,).

    Returns:
        Shape (n, V.num_functions), on several ranks with a column for each local function; 16 entries a row in regular
        cells of level 0.

    Raises:
        TypeError: If faces or corners are no integers, or V is no space of splines.
        ValueError: If a face, coordinate or corner is out of range.
    """
    check_space(V, "point_values")
    piece, position = V.cells.locate(faces, uv, corner)
    held = piece >= 0
    local = element.bicubic_values(position[held]).ravel()
    ends = np.append(0, 16 * np.cumsum(held)).astype(np.int32)
    at_points = sp.csr_array((local, np.arange(local.size, dtype=np.int32), ends), shape=(piece.size, local.size))
    return sp.csr_array(at_points @ V.cells.rows(piece[held]))
