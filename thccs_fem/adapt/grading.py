"""Spaces graded a priori towards extraordinary vertices, where Catmull-Clark functions approximate less well.

Around a vertex whose rings of faces shrink by lambda a level, quadratic functions are not in the space. On ring j, of
size lambda^j, they leave an error lambda^{2j} 8^{-n} in H1 (lambda^{3j} 16^{-n} in L2) if its faces are cut n times.
The sum of the squares is least for a given number of cells, 4^n a ring, if n falls by log4(1/lambda) a ring: the size
of cells is then that of all others times the root of the distance, whatever lambda is. In L2 less would do.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from thccs_fem.adapt.remeshing import refine
from thccs_fem.fem.space import FunctionSpace, check_space
from thccs_fem.hierarchy import Hierarchy
from thccs_fem.regions import units_inside
from thccs_fem.subdivision import Bools, Level, neighbourhood

__all__ = ["grade_extraordinary"]

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

FULL_ORDER = 3  # of H1 errors: halvings of a face against those of the error
MARGIN = 2  # levels beyond the last ring: a few cells each, so that what is left inside of it counts for little


def grade_extraordinary(V: FunctionSpace, levels: int, *, subdivided: int = 0) -> FunctionSpace:
    """Return the space with all cells on some level or a finer one, and finer towards extraordinary vertices.

    Errors of smooth functions then fall like dofs^(-3/2) in H1 and dofs^-2 in L2, as they do without such vertices.
    With lambda the factor by which rings of faces around the vertex shrink (0.41 for valence 3, 0.5 for the regular 4,
    0.55 for 5, below 0.66 for all), cells on ring j are at least of level

        levels + j - j log4(1 / lambda),     j <= J = 3/2 levels / log2(1 / lambda),

    rounded, ring j being what the support of the vertex's function of level j has beyond that of level j + 1; inside
    of ring J they get two levels finer than there. At ring J the error lambda^(2 J) in H1 is that of cells of level
    `levels` elsewhere. Towards irregular vertices on the boundary, with k faces, it is the same with lambda that of
    valence 2 k. (At a reentrant corner the solution is singular, which asks for more: estimate it.) A vertex of valence
    2 needs no finer cells.

    Collective. The result depends on V and the numbers alone, and refines that of fewer levels. Levels are those of the
    hierarchy: level 0 is the control mesh, or its first subdivision if that has polygons.

    Args:
        V: The space; what is refined in it stays.
        levels: Level of the cells far away from the vertices, 0 or more.
        subdivided: Steps of subdivision that level 0 has behind it, or about as many times as it is finer than a mesh
            in which such vertices are neighbours, 0 or more: levels and rings are then counted from there, so that the
            result is the same as on the mesh before these steps with as many levels more.

    Returns:
        The space, a refinement of V; V itself if it is that fine.

    Raises:
        ValueError: If a number is negative.
        TypeError: If V is no space of splines, or a number no integer.
    """
    check_space(V, "grading")
    for name, number in (("levels", levels), ("subdivided", subdivided)):
        if not isinstance(number, int | np.integer):
            raise TypeError(f"{name} is {number!r}: expected an integer")
        if number < 0:
            raise ValueError(f"{name} is {number}: expected 0 or more")
    for l in range(levels):
        V = refine(V, np.arange(*V.hierarchy.dof_offsets[l : l + 2]))
    vertices, halvings = _slow_vertices(V.hierarchy.root)
    deepening = 1.0 - halvings / 2.0  # levels a ring
    last_rings = FULL_ORDER / 2 * (levels + subdivided) / halvings
    finest = levels + last_rings * deepening + MARGIN
    for l in range(levels, int(finest.max(initial=0.0))):
        wanted = finest >= l + 1
        rings = np.ceil((l + 0.5 - levels) / deepening[wanted])  # the first whose level, rounded, is more than l
        rings = np.minimum(rings.astype(np.int64) - subdivided, l)
        V = refine(V, _functions_inside(V.hierarchy, l, _discs(V.hierarchy, l, vertices[wanted], rings)))
    return V


def _slow_vertices(root: Level) -> tuple[Ints, Floats]:
    """Return the vertices of level 0 that lower the rate of convergence, and log2(1 / lambda) at each, ascending.

    The factor lambda is the subdominant eigenvalue of the masks (Ball and Storry, ACM Trans. Graph. 7, 1988).
    """
    vertices = np.flatnonzero(~root.regular)
    valence = np.where(root.boundary, 2, 1)[vertices] * root.vertex_num_faces[vertices]
    c = np.cos(2.0 * np.pi / valence)
    shrinking = (5.0 + c + np.cos(np.pi / valence) * np.sqrt(18.0 + 2.0 * c)) / 16.0
    halvings = -np.log2(shrinking)
    slow = 2.0 * halvings < FULL_ORDER
    return vertices[slow], halvings[slow]


def _discs(hierarchy: Hierarchy, l: int, vertices: Ints, rings: Ints) -> Bools:
    """Return the faces of level l inside the supports of the vertices' functions of levels `rings`, l or coarser.

    A negative level is one before level 0: the support is two faces of that level wide, all around.
    """
    keys = hierarchy.stages[l].level.keys
    marks = np.zeros(keys.size, dtype=bool)
    for ring in np.unique(rings):
        level = hierarchy.stages[max(ring, 0)].level
        disc = level.touching(np.isin(level.control_vertex, vertices[rings == ring]))
        for _ in range(2 ** max(1 - ring, 1) - 1):
            disc = neighbourhood(level, disc)
        marks |= np.isin(keys >> 2 * (l - level.number), level.keys[disc])
    return marks


def _functions_inside(hierarchy: Hierarchy, l: int, faces: Bools) -> Ints:
    """Return the functions of level l, numbers in the space, whose units are inside the faces and not refined."""
    stage = hierarchy.stages[l]
    wanted, refined = (units_inside(stage.boundary, marks, hierarchy.unit) for marks in (faces, stage.refined))
    inside = stage.active & wanted & ~refined
    return hierarchy.dof_offsets[l] + np.flatnonzero(inside[stage.active])
