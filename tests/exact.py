"""Catmull-Clark in rational numbers: slow, plain, and without anything of thccs_fem's but the numbering of vertices."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from thccs_fem.mesh import ControlMesh

Numbers = npt.NDArray[np.object_]  # of Fractions


@dataclass(frozen=True, eq=False)
class ExactMesh:
    """A mesh whose points are Fractions, shape (n, gdim); boundary vertices in `tagged` stay where they are."""

    points: Numbers
    faces: list[list[int]]
    tagged: frozenset[int]

    @classmethod
    def of(cls, mesh: ControlMesh) -> Self:
        points = np.array([[Fraction(x) for x in point] for point in mesh.vertices.tolist()])
        faces = [part.tolist() for part in np.split(mesh.face_vertices, mesh.face_offsets[1:-1])]
        return cls(points, faces, frozenset(mesh.corners))

    @cached_property
    def face_of(self) -> dict[tuple[int, int], int]:
        """Face to the left of each directed edge."""
        return {edge: f for f, face in enumerate(self.faces) for edge in around(face)}

    @cached_property
    def faces_at(self) -> list[list[int]]:
        at: list[list[int]] = [[] for _ in self.points]
        for f, face in enumerate(self.faces):
            for v in face:
                at[v].append(f)
        return at

    @cached_property
    def neighbours(self) -> list[set[int]]:
        found: list[set[int]] = [set() for _ in self.points]
        for a, b in self.face_of:
            found[a].add(b)
            found[b].add(a)
        return found

    @cached_property
    def rim_neighbours(self) -> list[list[int]]:
        found: list[list[int]] = [[] for _ in self.points]
        for a, b in self.face_of:
            if (b, a) not in self.face_of:
                found[a].append(b)
                found[b].append(a)
        return found

    def is_corner(self, v: int) -> bool:
        return bool(self.rim_neighbours[v]) and (v in self.tagged or len(self.faces_at[v]) == 1)

    def subdivided(self) -> ExactMesh:
        """Return the next level: old vertices, edge points, face points; a child for each corner of a face."""
        points = self.points
        edges: dict[tuple[int, int], int] = {}
        for edge in self.face_of:
            edges.setdefault(ordered(*edge), len(points) + len(edges))
        face_points = [mean(points[v] for v in face) for face in self.faces]
        first = len(points) + len(edges)
        children = [
            [face[k], edges[ordered(face[k], face[k + 1 - len(face)])], first + f, edges[ordered(face[k - 1], face[k])]]
            for f, face in enumerate(self.faces)
            for k in range(len(face))
        ]
        old = [self._vertex_point(v, face_points) for v in range(len(points))]
        new = [self._edge_point(edge, face_points) for edge in edges]
        return ExactMesh(np.array([*old, *new, *face_points]), children, self.tagged)

    def _edge_point(self, edge: tuple[int, int], face_points: list[Numbers]) -> Numbers:
        sides = [self.face_of[e] for e in (edge, edge[::-1]) if e in self.face_of]
        ends = [self.points[v] for v in edge]
        return mean(ends) if len(sides) == 1 else mean([*ends, *(face_points[f] for f in sides)])

    def _vertex_point(self, v: int, face_points: list[Numbers]) -> Numbers:
        p = self.points[v]
        if self.is_corner(v):
            return p
        if rim := self.rim_neighbours[v]:
            return (6 * p + self.points[rim[0]] + self.points[rim[1]]) / 8
        n = len(self.faces_at[v])
        middles = mean((p + self.points[w]) / 2 for w in self.neighbours[v])
        return ((n - 3) * p + mean(face_points[f] for f in self.faces_at[v]) + 2 * middles) / n

    def limit(self, v: int) -> Numbers:
        """Return the limit position of a vertex; its faces are quads."""
        p = self.points[v]
        if self.is_corner(v):
            return p
        if rim := self.rim_neighbours[v]:
            return (4 * p + self.points[rim[0]] + self.points[rim[1]]) / 6
        n = len(self.faces_at[v])
        edges = sum(self.points[w] for w in self.neighbours[v])
        opposite = sum(self.points[self.faces[f][self.faces[f].index(v) - 2]] for f in self.faces_at[v])
        return (n * n * p + 4 * edges + opposite) / (n * (n + 5))

    def is_regular(self, v: int) -> bool:
        """Tell whether a vertex is inside and has four faces."""
        return not self.rim_neighbours[v] and len(self.faces_at[v]) == 4

    def derivatives(self, f: int) -> Numbers:
        """Return u, v, uu, uv, vv at corner 0 of a quad, a regular vertex, shape (5, gdim)."""
        grid = np.zeros((3, 3, self.points.shape[1]), dtype=object)  # [v, u]
        v = self.faces[f][0]
        grid[1, 1] = self.points[v]
        for edge, opposite in (((1, 2), (2, 2)), ((2, 1), (2, 0)), ((1, 0), (0, 0)), ((0, 1), (0, 2))):
            k = self.faces[f].index(v)
            grid[edge] = self.points[self.faces[f][k - 3]]
            grid[opposite] = self.points[self.faces[f][k - 2]]
            f = self.face_of[v, self.faces[f][k - 1]]
        value = np.array([Fraction(1, 6), Fraction(4, 6), Fraction(1, 6)])
        first = np.array([Fraction(-1, 2), Fraction(0), Fraction(1, 2)])
        second = np.array([Fraction(1), Fraction(-2), Fraction(1)])
        orders = ((value, first), (first, value), (value, second), (first, first), (second, value))
        return np.array([np.einsum("j,i,jic->c", along_v, along_u, grid) for along_v, along_u in orders])

    def near(self, v: int) -> tuple[ExactMesh, list[int]]:
        """Return the faces at a vertex and those that touch them, and their numbers; the vertex gets number 0.

        After a subdivision, all within two faces of the vertex is right again.
        """
        close = {w for f in self.faces_at[v] for w in self.faces[f]}
        kept = [f for f, face in enumerate(self.faces) if close & set(face)]
        old = [v, *sorted({w for f in kept for w in self.faces[f]} - {v})]
        new = {w: i for i, w in enumerate(old)}
        faces = [[new[w] for w in self.faces[f]] for f in kept]
        return ExactMesh(self.points[old], faces, frozenset(new[w] for w in self.tagged & new.keys())), kept


def around(face: list[int]) -> Iterable[tuple[int, int]]:
    return zip(face, face[1:] + face[:1], strict=True)


def ordered(a: int, b: int) -> tuple[int, int]:
    return min(a, b), max(a, b)


def mean(points: Iterable[Any]) -> Numbers:
    points = list(points)
    return sum(points[1:], points[0]) / len(points)
