"""Does a planar surface fold?  The sign of det J on its pieces, and far down at tagged corners.

On a folded map |det J| hides the sign and the patch test fails by 1e-2 whatever the depth; a mesh that folds is refused
by name.  With plain masks a corner with two or more faces folds where its angle exceeds 90 degrees a face, but only
some levels below the control mesh, so the faces there are followed down to FOLD_LEVEL.  After two or three levels the
faces around a corner are connected as those a level above: from then on one matrix takes points to those of the next.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from thccs_fem import element
from thccs_fem.bezier import bezier_masks
from thccs_fem.boundary import Boundary
from thccs_fem.extraction import Cells
from thccs_fem.parallel import gathered
from thccs_fem.subdivision import Ints, Level, neighbourhood, subdivide

__all__ = ["check_no_folds"]

FOLD_LEVEL = 12
SHOWN = 8  # faces named in a message

Floats = npt.NDArray[np.float64]


def check_no_folds(cells: Cells) -> None:
    """Raise ValueError where a planar surface folds, naming faces of the control mesh; others always pass. Collective.

    Each rank looks at the cells that it owns and, since they are few, at all tagged corners.
    """
    mesh = cells.hierarchy.mesh
    if mesh.gdim != 2:
        return
    cell = cells.piece_cell[_folds(element.TO_BERNSTEIN @ cells.piece_points)]
    folded = np.unique(gathered(mesh.comm, cells.face[cell[cell < cells.num_owned]]))
    if folded.size:
        raise ValueError(
            f"the planar surface folds (det J <= 0) on {folded.size} of {mesh.num_faces} faces, first "
            f"{folded[:SHOWN].tolist()}: move the vertices of these faces until neighbouring edges no longer cross, or "
            f"subdivide them more evenly"
        )
    _check_tagged_corners(cells)


def _folds(bernstein: Floats) -> npt.NDArray[np.bool_]:
    """Return the patches with det J <= 0 at one of 5 x 5 points, shape (n,), for coefficients of shape (n, 16, 2).

    The corners are left out: J vanishes at a degenerate corner and at a vertex of valence 3.
    """
    t = np.linspace(0.0, 1.0, 7)[1:-1]
    values, slopes = element.bernstein_values(t), element.bernstein_slopes(t)
    grid = bernstein.reshape(-1, 4, 4, 2)  # [patch, j, i, coordinate]
    du = np.einsum("pjic,ai,bj->pabc", grid, slopes, values)
    dv = np.einsum("pjic,ai,bj->pabc", grid, values, slopes)
    det = du[..., 0] * dv[..., 1] - du[..., 1] * dv[..., 0]
    return (det <= 0.0).any(axis=(1, 2))


def _check_tagged_corners(cells: Cells) -> None:
    """Follow the faces at corners of two or more faces down to FOLD_LEVEL."""
    hierarchy = cells.hierarchy
    level, points = hierarchy.root, hierarchy.points[0]
    watched = level.corner & (level.vertex_num_faces > 1)
    number, repeats = level.number, False
    found: list[tuple[Level, Ints, Floats]] = []
    while watched.any() and number < FOLD_LEVEL:
        if not repeats:
            step = subdivide(level, neighbourhood(level, level.touching(watched)))
            inherited = _inherited(step.old, watched, step.fine)
            repeats = _is_alike(level, step.fine) and np.array_equal(watched, inherited)
            level, watched = step.fine, inherited
            faces: Ints = np.flatnonzero(level.touching(watched)).astype(np.int32)
            masks = bezier_masks(Boundary.of(level, "crease"), faces)
        number += 1
        points = step.matrix @ points
        found.append((level, faces, (masks @ points).reshape(-1, 16, 2)))
    if not found:
        return
    levels, of_levels, patches = zip(*found, strict=True)
    folds = np.split(_folds(np.concatenate(patches)), np.cumsum([faces.size for faces in of_levels])[:-1])
    for number, (level, faces, marks) in enumerate(zip(levels, of_levels, folds, strict=True), 1):
        if marks.any():
            _refuse(cells, level, faces[marks], number)


def _inherited(old: Ints, watched: npt.NDArray[np.bool_], fine: Level) -> npt.NDArray[np.bool_]:
    marks = np.zeros(fine.num_vertices, dtype=bool)
    marks[: old.size] = watched[old]
    return marks


def _is_alike(level: Level, fine: Level) -> bool:
    """Return whether two levels are connected in the same way, vertex by vertex, so that S is the same for both."""
    names = ("vertices", "twins", "vertex_num_faces", "boundary", "corner")
    return all(np.array_equal(getattr(level, name), getattr(fine, name)) for name in names)


def _refuse(cells: Cells, level: Level, folded: Ints, number: int) -> None:
    """Raise, for faces of a level or, where corners are alike, of a finer one of the given number."""
    hierarchy = cells.hierarchy
    faces = np.unique(hierarchy.face_of_root[level.keys[folded] >> (2 * level.number)])
    control = level.control_vertex[level.quads[folded]]
    corner = int(control[control >= 0][0])
    raise ValueError(
        f"the planar surface folds (det J <= 0) at level {number} at the tagged corner, vertex {corner} with "
        f"{level.vertex_num_faces[level.control_vertex == corner][0]} faces, on faces {faces[:SHOWN].tolist()}: plain "
        f"masks span at most 90 degrees a face and want even spacing there. Add faces at the corner, even out the "
        f"spacing of the edges next to it, or remove its tag"
    )
