"""Regions of faces: what refining a function takes, what that asks of coarser levels, and what coarsening leaves.

Omega^{l+1} is a union of *units*, one for each function that was refined: its support, two rings of faces around its
vertex (Wei, Zhang, Hughes, Scott 2015), or the faces at the vertex, one ring, the least region that a function of level
l + 1 fits into (in the spirit of their extended THCCS, CMAME 299, 2016). A trace has the ring of its vertex.

A hierarchy is *admissible of class m* if the functions that do not vanish on a cell belong to at most m successive
levels (Buffa and Giannelli, Math. Models Methods Appl. Sci. 26, 2016, and with Morgenstern and Peterseim, CAGD 47,
2016). That holds if on faces of Omega^{j+1} all functions of level k = j - m + 2 are selected, since truncation then
leaves nothing there of coarser ones. With Q the face of level k that a refined face of level j is or lies in, these
functions reach three rings of faces around Q; all of them lie in the two rings of level k - 1 around the one vertex of
that level that Q has, its corner 0. So refinement closes by supports, one for each such Q (`required`).
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from thccs_fem.boundary import Boundary, support_of_traces, traces_meeting
from thccs_fem.subdivision import Bools, Ints, Level, neighbourhood

__all__ = [
    "Unit",
    "cover",
    "faces_meeting",
    "functions_meeting",
    "refined_by",
    "required",
    "units_inside",
]

Unit = Literal["support", "ring"]


def functions_meeting(boundary: Boundary, faces: Bools) -> Bools:
    """Return the functions whose support meets the marked faces, shape (num_functions,).

    The support of a vertex's function are the faces that touch a face of the vertex; that of a trace is smaller.
    """
    level = boundary.level
    vertices = level.corners_of(neighbourhood(level, faces))
    return np.concatenate([vertices, traces_meeting(boundary, faces)])


def faces_meeting(boundary: Boundary, functions: Bools) -> Bools:
    """Return the faces in the union of the supports of the marked functions, shape (num_faces,)."""
    level = boundary.level
    if not functions.any():
        return np.zeros(level.num_faces, dtype=bool)
    vertices, traces = np.split(functions, [level.num_vertices])
    return neighbourhood(level, level.touching(vertices)) | support_of_traces(boundary, traces)


def units_inside(boundary: Boundary, faces: Bools, unit: Unit) -> Bools:
    """Return the functions whose unit lies in the marked faces, as far as faces are held, shape (num_functions,)."""
    if unit == "support":
        return ~functions_meeting(boundary, ~faces)
    return ~_at_vertices(boundary, boundary.level.corners_of(~faces))


def refined_by(boundary: Boundary, functions: Bools, refined: Bools, unit: Unit) -> Bools:
    """Return the faces that refining the marked functions takes, shape (num_faces,).

    With rings, where all of a function's ring is refined already it is the rest of its support, so that something is
    refined as long as the function is active.
    """
    if unit == "support" or not functions.any():
        return faces_meeting(boundary, functions)
    open_ = _at_vertices(boundary, boundary.level.corners_of(~refined))
    return _rings(boundary, functions & open_) | faces_meeting(boundary, functions & ~open_)


def required(finer: Level, faces: Bools, boundary: Boundary) -> Bools:
    """Return what must be refined for the marked faces of a finer level to be, if hierarchies are admissible.

    Args:
        finer: Level j.
        faces: Faces to be refined, shape (finer.num_faces,).
        boundary: Level j - m + 1 with its traces, m being the class.

    Returns:
        A union of supports of functions, marks of faces of the coarser level.
    """
    level = boundary.level
    children = np.unique(finer.keys[faces] >> 2 * (finer.number - level.number - 1))  # Q of the module's text
    parents = np.searchsorted(level.keys, children >> 2)
    functions = np.zeros(boundary.num_functions, dtype=bool)
    functions[level.quads[parents, children & 3]] = True
    return faces_meeting(boundary, functions)


def cover(boundary: Boundary, selected: Bools, wanted: Bools, kept: Bools, most: Bools, unit: Unit) -> Bools:
    """Return a small union of units that holds the wanted faces and lies in the faces `most`, shape (num_faces,).

    All units that lie in the faces to be kept, wanted or not; then, for each face that is left, the one that adds the
    fewest faces; then supports of traces, for faces at the rim that only they can have brought.  (The smallest union of
    all would be a set cover, which is NP-hard to find.)

    Args:
        boundary: The level and its traces.
        selected: Functions of the level that are selected, shape (num_functions,).
        wanted: Marks of faces, as are the others; those that must stay refined.
        kept: Those that may stay at no cost.
        most: Those that may stay.
        unit: What regions are made of.
    """
    allowed = selected if unit == "support" else np.ones_like(selected)
    covered = _units(boundary, allowed & units_inside(boundary, kept, unit), unit)
    left = wanted & ~covered
    if not left.any():
        return covered
    vertices, traces = np.split(allowed & units_inside(boundary, most, unit), [boundary.level.num_vertices])
    chosen = np.zeros(boundary.num_functions, dtype=bool)
    chosen[_cheapest(boundary.level, np.flatnonzero(vertices), left, ~kept & ~covered, unit)] = True
    covered = covered | _units(boundary, chosen, unit)
    left = left & ~covered
    chosen[boundary.level.num_vertices :] = traces & traces_meeting(boundary, left)
    return covered | _units(boundary, chosen, unit)


def _cheapest(level: Level, vertices: npt.NDArray[np.integer], left: Bools, unwanted: Bools, unit: Unit) -> Ints:
    """Return, for each face that is left, the best of the vertices whose function has it in its unit.

    The best has the fewest unwanted faces in its unit; of these, the most that are left; of these, the first vertex.

    Returns:
        Vertices, ascending, each once; none for a face in no unit.
    """
    corners = sp.csr_array(
        (np.ones(level.vertices.size, dtype=np.int32), level.vertices, level.offsets),
        shape=(level.num_faces, level.num_vertices),
    )
    own = sp.csc_array(corners)[:, vertices]
    pairs = sp.coo_array(own if unit == "ring" else sp.csr_array(corners @ corners.T) @ own)
    face, function = pairs.coords  # the face is in the unit
    cost = np.bincount(function[unwanted[face]], minlength=vertices.size)
    gain = np.bincount(function[left[face]], minlength=vertices.size)
    order = np.lexsort((-gain, cost))
    rank = np.argsort(order)
    best = np.full(level.num_faces, order.size)
    np.minimum.at(best, face[left[face]], rank[function[left[face]]])
    return np.unique(vertices[order[best[left & (best < order.size)]]]).astype(np.int32)


def _units(boundary: Boundary, functions: Bools, unit: Unit) -> Bools:
    """Return the faces in the units of the marked functions, shape (num_faces,)."""
    return faces_meeting(boundary, functions) if unit == "support" else _rings(boundary, functions)


def _rings(boundary: Boundary, functions: Bools) -> Bools:
    """Return the faces at the vertices of the marked functions, shape (num_faces,)."""
    vertices, traces = np.split(functions, [boundary.level.num_vertices])
    vertices = vertices.copy()
    vertices[boundary.vertex[traces]] = True
    return boundary.level.touching(vertices)


def _at_vertices(boundary: Boundary, vertices: Bools) -> Bools:
    """Return the functions that belong to marked vertices, shape (num_functions,)."""
    return np.concatenate([vertices, vertices[boundary.vertex]])
