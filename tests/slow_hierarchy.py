"""An oracle for the hierarchy: whole levels, dense coefficients, loops, and the definitions word for word.

Shares no code with the package. Faces of level l are numbered by key (child k of face f is 4 f + k), vertices
[old | edge points | face points]; only the crease boundary rule.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp


@dataclass(frozen=True, eq=False)
class SlowLevel:
    """A whole level: faces, shape (num_faces, 4), and the vertices that are corners."""

    faces: np.ndarray
    num_vertices: int
    corners: frozenset[int]

    @cached_property
    def supports(self) -> sp.csr_array:
        """Pattern of (face, function): the faces that touch a face of the vertex, A A^T A."""
        incidence = sp.csr_array(
            (np.ones(self.faces.size), (np.repeat(np.arange(len(self.faces)), 4), self.faces.ravel())),
            shape=(len(self.faces), self.num_vertices),
        )
        return sp.csr_array(incidence @ incidence.T @ incidence) > 0

    def meeting(self, faces: np.ndarray) -> np.ndarray:
        """Marks of the functions whose support holds one of the marked faces."""
        return (self.supports.T.astype(int) @ faces.astype(int)) > 0

    @cached_property
    def subdivided(self) -> tuple[np.ndarray, SlowLevel]:
        """S, dense, and the next level."""
        n = self.num_vertices
        edges: dict[tuple[int, int], list[int]] = {}
        for f, face in enumerate(self.faces.tolist()):
            for a, b in zip(face, [*face[1:], face[0]], strict=True):
                edges.setdefault((min(a, b), max(a, b)), []).append(f)
        number = {edge: n + i for i, edge in enumerate(edges)}
        identity = np.eye(n)
        points = np.array([identity[face].mean(axis=0) for face in self.faces])
        middles = {edge: identity[list(edge)].mean(axis=0) for edge in edges}
        edge_points = [
            (middles[edge] + points[sides].mean(axis=0)) / 2 if len(sides) == 2 else middles[edge]
            for edge, sides in edges.items()
        ]
        old = [self._old_vertex(v, identity, points, middles, edges) for v in range(n)]
        children = []
        for f, face in enumerate(self.faces.tolist()):
            around = [number[min(a, b), max(a, b)] for a, b in zip(face, [*face[1:], face[0]], strict=True)]
            children += [(face[k], around[k], n + len(edges) + f, around[k - 1]) for k in range(4)]
        matrix = np.array([*old, *edge_points, *points])
        return matrix, SlowLevel(np.array(children), len(matrix), self.corners)

    @cached_property
    def _faces_of_vertex(self) -> list[list[int]]:
        lists: list[list[int]] = [[] for _ in range(self.num_vertices)]
        for f, face in enumerate(self.faces.tolist()):
            for v in face:
                lists[v].append(f)
        return lists

    @cached_property
    def _neighbours(self) -> list[set[int]]:
        sets: list[set[int]] = [set() for _ in range(self.num_vertices)]
        for face in self.faces.tolist():
            for k in range(4):
                sets[face[k]].add(face[k - 1])
                sets[face[k - 1]].add(face[k])
        return sets

    def _old_vertex(self, v, identity, points, middles, edges):
        spokes = [(min(v, w), max(v, w)) for w in self._neighbours[v]]
        rim = [edge for edge in spokes if len(edges[edge]) == 1]
        if v in self.corners or (rim and len(self._faces_of_vertex[v]) == 1):
            return identity[v]
        if rim:
            return (2 * identity[v] + middles[rim[0]] + middles[rim[1]]) / 4
        n = len(spokes)
        face_mean = points[self._faces_of_vertex[v]].mean(axis=0)
        middle_mean = np.mean([middles[edge] for edge in spokes], axis=0)
        return ((n - 3) * identity[v] + 2 * middle_mean + face_mean) / n


def whole_levels(faces, num_vertices: int, corners, count: int) -> list[SlowLevel]:
    """Levels 0 .. count - 1 of a mesh of quads."""
    levels = [SlowLevel(np.asarray(faces), num_vertices, frozenset(int(v) for v in corners))]
    while len(levels) < count:
        levels.append(levels[-1].subdivided[1])
    return levels


@dataclass(frozen=True, eq=False)
class SlowStage:
    """What the hierarchy is on one level; coefficients of all active functions, shape (num_vertices, num_dofs)."""

    inside: np.ndarray
    selected: np.ndarray
    active: np.ndarray
    coefficients: np.ndarray


def slow_stages(levels: list[SlowLevel], omegas: list[np.ndarray]) -> list[SlowStage]:
    """Stages for omegas[l], the faces of level l that are refined (their children make up Omega^{l+1})."""
    pairs, inside = [], np.ones(len(levels[0].faces), dtype=bool)
    for l, level in enumerate(levels[: len(omegas) + 1]):
        refined = np.zeros(len(level.faces), dtype=bool)
        if l < len(omegas):
            refined[omegas[l]] = True
        assert not (refined & ~inside).any()
        selected = ~level.meeting(~inside)
        pairs.append((inside, selected, selected & level.meeting(~refined)))
        inside = np.repeat(refined, 4)
    num_dofs = sum(int(active.sum()) for _, _, active in pairs)
    stages: list[SlowStage] = []
    first = 0
    for l, (inside, selected, active) in enumerate(pairs):
        own = np.zeros((levels[l].num_vertices, num_dofs))
        if l > 0:
            own = levels[l - 1].subdivided[0] @ stages[-1].coefficients
            own[selected] = 0.0
        new = np.flatnonzero(active)
        own[new, first + np.arange(new.size)] = 1.0
        first += new.size
        stages.append(SlowStage(inside, selected, active, own))
    return stages
