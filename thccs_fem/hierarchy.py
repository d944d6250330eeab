"""Truncated hierarchy of Catmull-Clark levels (Wei, Zhang, Hughes, Scott 2015, sec. 4 and 5).

Omega^{l+1}, a set of faces of level l inside Omega^l, is all that is stored; everything else follows from it:

    selected^{l+1} = functions of level l + 1 whose support lies in Omega^{l+1}
    passive^l      = functions of selected^l whose support lies in Omega^{l+1};   active^l = selected^l minus passive^l
    C_0 = I,   C_{l+1} = Z_{l+1} S_l C_l + E_{l+1}

C_l holds the coefficients of every active function in terms of the functions of level l.  Z zeroes the rows of
selected^{l+1}: *this is the truncation*; E has a unit column for each newly active function.  One array, `selected`, is
both what is activated and what is discarded, so the functions form a partition of unity whatever is refined.

Dofs are numbered level by level, within a level vertices first, then traces, each in the order of the level.

Faces with an irregular vertex that are not refined are cut by the same subdivision, down to one absolute level for each
extraordinary vertex (`cap_levels`), where a bicubic cap ends the cut.  Cut faces ride along in the levels: functions
outside of Omega^{l+1} keep their untruncated rows in C_{l+1}, so the same matrices give the pieces of cut faces.

What is refined is made of units, supports or rings, and may close so that few levels meet on a cell (`regions`).

What is refined or coarsened shares all stages in which nothing changes with the hierarchy that it comes from.  Others
are made together (`joined`), so that work grows with what changes and not with the number of levels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import zip_longest
from typing import Self, get_args

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from thccs_fem.boundary import (
    Boundary,
    BoundaryRule,
    subdivision_matrix,
    to_dofs,
)
from thccs_fem.joined import Parts, groups, joined_levels
from thccs_fem.mesh import ControlMesh
from thccs_fem.positions import in_quads, in_sub_quads
from thccs_fem.regions import Unit, cover, faces_meeting, functions_meeting, refined_by, required
from thccs_fem.sparse import COMPUTED, EMPTY, csr, product, rows_of, stacked
from thccs_fem.subdivision import (
    Bools,
    Children,
    Ints,
    Level,
    Step,
    children,
    control_level,
    neighbourhood,
    subdivide,
    with_matrix,
)

__all__ = ["CAP_LEVEL", "Hierarchy", "Stage", "TooDeepError"]

UNITS = get_args(Unit)
NO_MATRIX = sp.csr_array((0, 0))
CAP_LEVEL = 4  # level at which the bicubic cap ends the cut at an irregular vertex, unless refinement goes deeper

Keys = npt.NDArray[np.int64]


class TooDeepError(ValueError):
    """There are no numbers for the faces of a level that is so fine."""


@dataclass(frozen=True, eq=False)
class Stage:
    """One level of a hierarchy.

    Attributes:
        level: Faces held: those of Omega^l, of cut faces, and the ones around them.
        boundary: Trace functions.
        inside: Faces of Omega^l, shape (num_faces,).
        refined: Faces of Omega^{l+1}, shape (num_faces,).
        cut: Faces subdivided only because they are irregular, shape (num_faces,).
        step: The subdivision of the faces with children; None at the end.
        matrix: S_l in terms of the dof functions q, shape (functions of level l + 1, functions of level l); None at the
            end.
        selected: Functions of level l selected, shape (num_functions,).
        active: Those not passive, shape (num_functions,).
    """

    level: Level
    boundary: Boundary
    inside: Bools
    refined: Bools
    cut: Bools
    step: Step | None
    matrix: sp.csr_array | None
    selected: Bools
    active: Bools

    @property
    def is_whole(self) -> bool:
        """Whether it has all that it needs: stages of an outline have no matrix."""
        return self.step is None or self.matrix is not None

    @property
    def active_faces(self) -> Ints:
        """Active elements of this level: faces inside Omega^l and outside Omega^{l+1}."""
        return np.flatnonzero(self.inside & ~self.refined).astype(np.int32)


@dataclass(frozen=True, eq=False)
class Hierarchy:
    """Truncated hierarchy on a control mesh; build it with `Hierarchy.on`, refine it with `refined`.

    Attributes:
        mesh: The control mesh.
        rule: "clamped" or "crease".
        cap_level: Least cap level.
        admissibility: How many successive levels may meet on a cell, 2 or more; None: any number.
        unit: What refining a function refines: its "support", or the "ring" of faces at its vertex.
        refined_keys: Keys of the faces of Omega^{l+1} for each level l, ascending.
        root: Level 0: the control mesh, or its first subdivision where `user_face_of_root` says so.
        stages: One for each level, the coarsest first.
        is_outline: Whether refinements have no subdivision matrices.
    """

    mesh: ControlMesh
    rule: BoundaryRule
    cap_level: int
    admissibility: int | None
    unit: Unit
    refined_keys: tuple[Keys, ...]
    root: Level
    stages: tuple[Stage, ...]
    is_outline: bool = False

    @classmethod
    def on(
        cls,
        mesh: ControlMesh,
        rule: BoundaryRule = "clamped",
        *,
        cap_level: int = CAP_LEVEL,
        admissibility: int | None = None,
        unit: Unit = "support",
        refined_keys: Sequence[Keys] = (),
    ) -> Self:
        """Return the hierarchy of a mesh with nothing refined, or with the `refined_keys` of one that was there before.

        A mesh with polygons other than quads, or one whose level-0 functions are dependent, is subdivided once.

        Raises:
            TypeError: If cap_level or admissibility is no integer.
            ValueError: If an option is out of range, or the keys are not those of an admissible hierarchy of the class.
        """
        _check_cap_level(cap_level)
        _check_admissibility(admissibility)
        if unit not in UNITS:
            raise ValueError(f'unit is {unit!r}; what is refined with a function must be its "support" or its "ring"')
        root = control_level(mesh)
        if not root.is_quad or _is_dependent(root):
            root = _as_level_zero(subdivide(root, np.ones(root.num_faces, dtype=bool)).fine)
        made = cls(mesh, rule, cap_level, admissibility, unit, (), root, ())._with(refined_keys)
        if not made._is_closed():
            raise ValueError(
                f"the refined_keys are not those of an admissible hierarchy of class {admissibility}: give those of "
                f"one that was refined with this class or a smaller one, or admissibility=None"
            )
        return made

    def _with(self, refined_keys: Sequence[Keys], cap_level: int | None = None) -> Self:
        """Return the hierarchy with other faces refined; it shares the stages in which nothing changes."""
        keys = tuple(k for k in refined_keys if k.size)
        least = self.cap_level if cap_level is None else cap_level
        caps = _cap_levels(self.root, keys, least)
        _check_depth(self.root, max(int(caps.max()), len(keys)))
        stages = tuple(_stages(self.root, self.rule, keys, caps, self.stages, self.is_outline))
        return replace(self, cap_level=least, refined_keys=keys, stages=stages)

    @property
    def num_levels(self) -> int:
        """Levels with active elements or functions: one more than the finest level that something was refined to."""
        return len(self.refined_keys) + 1

    @cached_property
    def cap_levels(self) -> Ints:
        """Cap level at each vertex of level 0 (only irregular ones have caps), shape (root.num_vertices,)."""
        return _cap_levels(self.root, self.refined_keys, self.cap_level)

    @cached_property
    def face_of_root(self) -> Ints:
        """Face of the control mesh that each face of level 0 is, or is a part of, shape (root.num_faces,)."""
        faces = np.arange(self.mesh.num_faces, dtype=np.int32)
        return np.repeat(faces, self.mesh.face_sizes) if self.root_is_subdivided else faces

    @property
    def root_is_subdivided(self) -> bool:
        """Whether level 0 is the first subdivision of the control mesh; its face h is then the child at half-edge h."""
        return self.root.num_faces != self.mesh.num_faces

    def root_position(
        self, faces: npt.ArrayLike, uv: npt.ArrayLike, corner: npt.ArrayLike | None = None
    ) -> tuple[Ints, npt.NDArray[np.float64]]:
        """Return face of level 0 and coordinates there; arguments as for `positions.in_sub_quads`."""
        return (in_sub_quads if self.root_is_subdivided else in_quads)(self.mesh, faces, uv, corner)

    @cached_property
    def points(self) -> tuple[npt.NDArray[np.float64], ...]:
        """Control points of every stage, shape (vertices of the level, gdim)."""
        points = [self.mesh.vertices]
        if self.root_is_subdivided:
            control = control_level(self.mesh)
            points = [subdivide(control, np.ones(control.num_faces, dtype=bool)).matrix @ self.mesh.vertices]
        for stage in self.stages:
            if stage.step is not None:
                points.append(stage.step.matrix @ points[-1])
        return tuple(points)

    @cached_property
    def dof_offsets(self) -> Ints:
        """First dof of each level and their number, shape (num_levels + 1,)."""
        counts = [np.count_nonzero(stage.active) for stage in self.stages[: self.num_levels]]
        return np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)

    @property
    def num_dofs(self) -> int:
        """Number of active functions."""
        return int(self.dof_offsets[-1])

    @cached_property
    def cells(self) -> tuple[Keys, Keys]:
        """Level and key of each cell (active element), in the order of their numbers, each of shape (num_cells,)."""
        keys = [stage.level.keys[stage.active_faces] for stage in self.stages[: self.num_levels]]
        return np.repeat(np.arange(len(keys)), [k.size for k in keys]), np.concatenate(keys)

    def cells_around(self, levels: Keys, keys: Keys) -> tuple[Keys, Keys]:
        """Return the cell that each of some faces is or lies in, and its level, each of shape (n,).

        Where cells are finer than the face it is the first of those in it. Cells are ranges of the keys of their parts
        on the finest level.

        Args:
            levels: Level of each face, shape (n,).
            keys: Its key there, shape (n,).
        """
        own_levels, own_keys = self.cells
        depth = max(self.num_levels - 1, int(levels.max(initial=0)))
        begins = own_keys << 2 * (depth - own_levels)
        order = np.argsort(begins)
        cell = order[np.searchsorted(begins[order], keys << 2 * (depth - levels), side="right") - 1]
        return cell, own_levels[cell]

    def dof_functions(self, level: int) -> Ints:
        """Return the functions of a level that are dofs, in dof order."""
        return np.flatnonzero(self.stages[level].active).astype(np.int32)

    @cached_property
    def coefficients(self) -> tuple[sp.csr_array, ...]:
        """C_l for every stage, shape (functions of the level, num_dofs)."""
        return tuple(_coefficients(self.stages, self.stages))

    def coefficient_rows(self, needed: Sequence[Bools]) -> list[sp.csr_array]:
        """Return `coefficients` with those rows alone that are marked, stage by stage; others are empty.

        Args:
            needed: Marks of functions for each stage; rows that marked ones are made of must be marked as well.
        """
        return _coefficients(self.stages, self.stages, needed)

    def support(self, dofs: npt.NDArray[np.integer]) -> tuple[Bools, ...]:
        """Return, for each level, the faces in the support of those given dofs that belong to the level."""
        functions = self._functions_of(dofs)
        return tuple(faces_meeting(stage.boundary, marks) for stage, marks in zip(self.stages, functions, strict=False))

    def refined(self, dofs: npt.NDArray[np.integer]) -> Self:
        """Return the hierarchy in which the units of the given dofs are refined once more (sec. 4.1).

        With them what the hierarchy's class asks for (`regions.required`), and the faces of level 0 on which functions
        are dependent, lest these be all that is left of level 0.

        Args:
            dofs: Active functions, numbers in 0 .. num_dofs, shape (n,).
        """
        return self.remeshed(dofs, np.zeros(0, dtype=np.int64))

    def outlined(self) -> Self:
        """Return this hierarchy as one whose refinements are outlines: cells and active functions, but no matrices.

        They take half the time, and tell what can be refined next.
        """
        return replace(self, is_outline=True)

    def completed(self) -> Self:
        """Return the whole hierarchy of an outline."""
        return replace(self, is_outline=False)._with(self.refined_keys)

    def coarsened(self, cells: npt.NDArray[np.integer]) -> Self:
        """Return the hierarchy in which the given cells are coarsened by one level, where whole functions allow it.

        A face of Omega^{l+1} is free if its four children are cells, and given. What is left of Omega^{l+1} is the
        union of the units without free faces, and for each other face that is not free one unit more, that with the
        fewest free faces; faces that the class needs, for finer ones that stay, are not free. So cells that are not
        given stay (but the faces of level 0 that are refined along with others go with the last of them), and
        ``refined(dofs)`` is undone when the cells that it made are given.

        Args:
            cells: Active elements, numbers in 0 .. number of cells, shape (n,).

        Returns:
            A coarsening of this hierarchy; this hierarchy itself if no face can go.
        """
        return self.remeshed(np.zeros(0, dtype=np.int64), cells)

    def remeshed(self, dofs: npt.NDArray[np.integer], cells: npt.NDArray[np.integer]) -> Self:
        """Return the hierarchy with units of dofs `refined`, and cells `coarsened` where that undoes none of it.

        Args:
            dofs: Active functions, numbers in 0 .. num_dofs, shape (n,).
            cells: Active elements, numbers in 0 .. number of cells, shape (m,).
        """
        stages = self.stages[: self.num_levels]
        wanted = self._units(dofs)
        marked = self._marks_of(cells)
        keys: list[Keys] = []
        for l in range(len(stages) - 1, -1, -1):  # finer levels ask for coarser ones
            stage = stages[l]
            refined = stage.refined | wanted[l]
            free = ~refined
            if l + 1 < len(stages):
                free = _with_all_children(stage, marked[l + 1] & ~wanted[l + 1]) & ~wanted[l]
            along = stage.level.dependent_faces if l == 0 else np.zeros_like(refined)
            kept = refined & (~free | along)
            region = refined  # if nothing is to go
            if (refined & free).any():
                region = cover(stage.boundary, stage.selected, kept & ~along, kept, refined, self.unit)
            if region.any() or _are_needed(along, [*keys[:1], *self.refined_keys[1:2]]):
                region |= along
            keys.insert(0, stage.level.keys[region])
            coarser = l + 1 - self.admissibility if self.admissibility is not None else -1
            if coarser >= 0:  # what was refined before has what it needs, unless that is to be coarsened
                faces = region if cells.size else region & ~stage.refined
                if faces.any():
                    wanted[coarser] |= required(stage.level, faces, stages[coarser].boundary)
        if _same_keys(keys, self.refined_keys):
            return self
        return self._with(keys)

    def _units(self, dofs: npt.NDArray[np.integer]) -> list[Bools]:
        """Return, for each level, the faces that refining those given dofs that belong to the level refines."""
        return [
            refined_by(stage.boundary, marks, stage.refined, self.unit)
            for stage, marks in zip(self.stages, self._functions_of(dofs), strict=False)
        ]

    def _is_closed(self) -> bool:
        """Return whether all is refined that the class asks for."""
        if self.admissibility is None:
            return True
        stages = self.stages[: self.num_levels]
        pairs = zip(stages[self.admissibility - 1 :], stages, strict=False)
        return not any((required(s.level, s.refined, coarse.boundary) & ~coarse.refined).any() for s, coarse in pairs)

    def _marks_of(self, cells: npt.NDArray[np.integer]) -> list[Bools]:
        """Return marks of the given cells on the faces of each level."""
        active = [stage.active_faces for stage in self.stages[: self.num_levels]]
        marked = np.zeros(sum(faces.size for faces in active), dtype=bool)
        marked[cells] = True
        result, first = [], 0
        for stage, faces in zip(self.stages, active, strict=False):
            marks = np.zeros(stage.level.num_faces, dtype=bool)
            marks[faces] = marked[first : first + faces.size]
            result.append(marks)
            first += faces.size
        return result

    def common_refinement(self, other: Hierarchy) -> Self:
        """Return the coarsest hierarchy that refines this one and another one.

        It is this hierarchy itself, if that is one; else it has the weaker one of their classes, and rings if one has.

        Raises:
            ValueError: If the other has another control mesh, boundary rule or least cap level.
        """
        if self.mesh is not other.mesh or (self.rule, self.cap_level) != (other.rule, other.cap_level):
            raise ValueError(
                "the hierarchies have no common refinement: both must be on the same control mesh, with the same "
                f"boundary rule and the same cap level; they have {self.rule!r}, {self.cap_level} and "
                f"{other.rule!r}, {other.cap_level}" + (" on two control meshes" if self.mesh is not other.mesh else "")
            )
        nothing = np.zeros(0, dtype=np.int64)
        pairs = zip_longest(self.refined_keys, other.refined_keys, fillvalue=nothing)
        keys = [np.union1d(ours, theirs) for ours, theirs in pairs]
        if _same_keys(keys, self.refined_keys):
            return self
        ours, theirs = self.admissibility, other.admissibility
        weaker = None if ours is None or theirs is None else max(ours, theirs)
        unit: Unit = "ring" if "ring" in (self.unit, other.unit) else "support"
        return replace(self, admissibility=weaker, unit=unit)._with(keys)

    def with_caps_at(self, cap_level: int) -> Self:
        """Return the hierarchy with another least cap level; the dofs stay as they are.

        Raises:
            ValueError: If the level is less than 1.
        """
        _check_cap_level(cap_level)
        return self._with(self.refined_keys, cap_level)

    def truncated_to(self, num_levels: int) -> Self:
        """Return the hierarchy with Omega^num_levels and everything finer emptied; num_levels is 1 or more."""
        if num_levels < 1:
            raise ValueError(f"num_levels is {num_levels}; level 0 is always there: give 1 or more")
        return self._with(self.refined_keys[: num_levels - 1])

    def is_refinement_of(self, other: Hierarchy) -> bool:
        """Return whether every function of `other` is a function of this hierarchy."""
        return (
            self.mesh is other.mesh
            and (self.rule, self.cap_level) == (other.rule, other.cap_level)
            and len(other.refined_keys) <= len(self.refined_keys)
            and all(np.isin(o, k).all() for k, o in zip(self.refined_keys, other.refined_keys, strict=False))
        )

    def prolongation(self, coarse: Hierarchy, dofs: Ints | None = None) -> sp.csr_array:
        """Return the exact transfer from a coarser hierarchy, shape (num_dofs, coarse.num_dofs).

        Truncation preserves coefficients: the row of dof (l, i) is row i of the coarse hierarchy's C_l.

        Args:
            coarse: The other one.
            dofs: Those whose rows are wanted, in any order; None: all.

        Raises:
            ValueError: If this hierarchy is no refinement of `coarse`.
        """
        if not self.is_refinement_of(coarse):
            raise ValueError(
                "the spaces are not nested: the target must be a refinement (by adapt.refine) of the source on "
                "the same control mesh with the same boundary rule; use fem.project to carry a function between "
                "unrelated spaces"
            )
        stages = self.stages[: self.num_levels]
        needed = None if dofs is None else _with_sources(stages, self._functions_of(dofs))
        carried = _coefficients(stages, coarse.stages, needed)
        rows = stacked([rows_of(c, self.dof_functions(l)) for l, c in enumerate(carried)])
        return rows if dofs is None else rows_of(rows, dofs)

    def _functions_of(self, dofs: npt.NDArray[np.integer]) -> list[Bools]:
        """Return marks of the functions of each level that the given dofs are."""
        marked = np.zeros(self.num_dofs, dtype=bool)
        marked[dofs] = True
        functions = []
        for stage, of_level in zip(self.stages, np.split(marked, self.dof_offsets[1:-1]), strict=False):
            functions.append(np.zeros_like(stage.active))
            functions[-1][stage.active] = of_level
        return functions

    def same_as(self, other: Hierarchy) -> bool:
        """Return whether both describe the same functions."""
        return self.num_levels == other.num_levels and self.is_refinement_of(other) and other.is_refinement_of(self)


def _is_dependent(root: Level) -> bool:
    """Return whether a component has only vertices of valence 3, the cube: its functions are dependent as a whole."""
    return not bool(neighbourhood(root, ~root.dependent_faces).all())


def _as_level_zero(level: Level) -> Level:
    """Return a first subdivision as level 0 of a hierarchy."""
    return replace(level, number=0, control_vertex=np.arange(level.num_vertices, dtype=np.int32))


def _same_keys(keys: Sequence[Keys], others: Sequence[Keys]) -> bool:
    """Return whether two sequences hold the same keys, empty ones at the end aside."""
    nothing = np.zeros(0, dtype=np.int64)
    return all(np.array_equal(k, o) for k, o in zip_longest(keys, others, fillvalue=nothing))


def _check_cap_level(cap_level: int) -> None:
    if not isinstance(cap_level, int | np.integer):
        raise TypeError(f"cap_level is {cap_level!r}; it must be an integer")
    if cap_level < 1:
        raise ValueError(f"cap_level is {cap_level}; a cap needs at least one cut: give 1 or more")


def _check_admissibility(admissibility: int | None) -> None:
    if admissibility is not None and not isinstance(admissibility, int | np.integer):
        raise TypeError(f"admissibility is {admissibility!r}; it must be an integer of 2 or more, or None")
    if admissibility is not None and admissibility < 2:
        raise ValueError(
            f"admissibility is {admissibility}; where refinement ends two levels meet: give 2 or more, or None for any "
            f"number of levels on a cell"
        )


def _check_depth(root: Level, deepest: int) -> None:
    if root.num_faces * 4**deepest >= 2**62:
        raise TooDeepError(
            f"{deepest} levels below the {root.num_faces} faces of level 0 are more than 64-bit face keys can number: "
            f"refine less or choose a smaller cap_level"
        )


def _cap_levels(root: Level, refined_keys: Sequence[Keys], least: int) -> Ints:
    """Return one absolute cap level for each vertex of level 0, finer than any element at it.

    A face of level l >= 1 touches a vertex of level 0 if it is child 0 of child 0 ... of the child at that vertex.
    """
    caps = np.full(root.num_vertices, least, dtype=np.int32)
    for l, keys in enumerate(refined_keys):
        if l == 0:
            at = root.vertices[root.half_edges(np.searchsorted(root.keys, keys))]
        else:
            at = root.vertices[keys[keys % 4 ** (l - 1) == 0] // 4 ** (l - 1)]
        caps[at] = np.maximum(caps[at], l + 2)  # its children are elements of level l + 1
    return caps


@dataclass(frozen=True, eq=False)
class _Outline:
    """The faces of one level of a hierarchy and their children: a `Stage` before its functions are known."""

    level: Level
    inside: Bools
    refined: Bools
    cut: Bools
    divided: Bools  # faces with children
    children: Children | None

    def is_of(self, stage: Stage) -> bool:
        """Return whether a stage is that of these faces."""
        ours, theirs = (self.inside, self.refined, self.cut), (stage.inside, stage.refined, stage.cut)
        return self.level is stage.level and all(np.array_equal(a, b) for a, b in zip(ours, theirs, strict=True))


def _stages(
    root: Level,
    rule: BoundaryRule,
    refined_keys: Sequence[Keys],
    caps: Ints,
    known: Sequence[Stage],
    is_outline: bool = False,
) -> list[Stage]:
    """Return the stages from level 0 to that of the deepest piece; those of an outline have no matrices.

    Which faces a level has determines all of it, whatever coarser levels hold beside them: its vertices stand in the
    order of coarser vertices, edges and faces, and all faces at an edge that matters are there, being neighbours of one
    that was opened. And a stage is determined by its level and the marks on it. Both are taken over where they are
    `known`, from a hierarchy of this root and rule.
    """
    outlines: list[_Outline | Stage] = []
    level, inside = root, np.ones(root.num_faces, dtype=bool)
    held = inside  # faces of Omega^l and children of cut faces
    while True:
        before = known[level.number] if level.number < len(known) else None
        keys = refined_keys[level.number] if level.number < len(refined_keys) else np.zeros(0, dtype=np.int64)
        refined = _with_keys(level, keys) & inside
        cut = held & ~refined & _needs_cut(level, caps)
        outline = _outline(level, inside, refined, cut, before)
        is_known = before is not None and outline.is_of(before) and (is_outline or before.is_whole)
        outlines.append(before if before is not None and is_known else outline)
        if outline.children is None:
            return _with_functions(outlines, rule, is_outline)
        inside, held = (outline.children.marks_of(faces) for faces in (refined, refined | cut))
        level = outline.children.fine


def _outline(level: Level, inside: Bools, refined: Bools, cut: Bools, before: Stage | None) -> _Outline:
    """Return the faces of a level with their children: those of the stage `before` where they are the same."""
    opened = refined | cut
    if not opened.any():
        return _Outline(level, inside, refined, cut, opened, None)
    divided = neighbourhood(level, opened)
    fine = None
    if before is not None and before.step is not None:
        if before.level is level and np.array_equal(divided, before.step.first_child >= 0):
            return _Outline(level, inside, refined, cut, divided, before.step)
        if np.array_equal(level.keys[divided], before.level.keys[before.step.first_child >= 0]):
            fine = before.step.fine
    return _Outline(level, inside, refined, cut, divided, children(level, divided, fine))


def _with_functions(outlines: Sequence[_Outline | Stage], rule: BoundaryRule, is_outline: bool) -> list[Stage]:
    """Return the stages of outlines, among stages that stay as they are."""
    unknown = [outline for outline in outlines if isinstance(outline, _Outline)]
    sizes = [outline.level.num_faces for outline in unknown]
    made = iter([stage for group in groups(sizes) for stage in _made(unknown[group], rule, is_outline)])
    return [next(made) if isinstance(outline, _Outline) else outline for outline in outlines]


def _made(outlines: Sequence[_Outline], rule: BoundaryRule, is_outline: bool) -> list[Stage]:
    """Return the stages of outlines, all at once."""
    inside, refined, divided = (
        np.concatenate([getattr(outline, name) for outline in outlines]) for name in ("inside", "refined", "divided")
    )
    levels = [outline.level for outline in outlines]
    vertices = Parts.of([level.num_vertices for level in levels])
    boundary = Boundary.of(joined_levels(levels), rule)
    functions = vertices.functions(boundary)
    selected = ~functions_meeting(boundary, ~inside)
    active = selected & functions_meeting(boundary, ~refined)
    found = zip(
        outlines,
        vertices.split_boundary(boundary, levels),
        _bare_steps(outlines) if is_outline else _steps(outlines, rule, boundary, divided, vertices),
        functions.split(selected),
        functions.split(active),
        strict=True,
    )
    return [Stage(o.level, traces, o.inside, o.refined, o.cut, *step, *marks) for o, traces, step, *marks in found]


def _bare_steps(outlines: Sequence[_Outline]) -> list[tuple[Step | None, None]]:
    """Return the step of each level without S; for `_made`."""
    made = [outline.children for outline in outlines]
    return [(Step(m.fine, m.first_child, m.old, m.edges, NO_MATRIX) if m else None, None) for m in made]


def _steps(
    outlines: Sequence[_Outline], rule: BoundaryRule, boundary: Boundary, divided: Bools, vertices: Parts
) -> list[tuple[Step, sp.csr_array] | tuple[None, None]]:
    """Return the step of each level, and S_l in terms of the dof functions; for `_made`."""
    if not divided.any():
        return [(None, None)] * len(outlines)
    made = [outline.children for outline in outlines]
    level = boundary.level
    step = with_matrix(level, divided, made[0] if len(made) == 1 and made[0] else children(level, divided))
    fine = Boundary.of(step.fine, rule)
    kinds = [(m.old.size, m.edges.size, np.count_nonzero(m.first_child >= 0)) if m else (0, 0, 0) for m in made]
    fine_vertices = Parts.of(*zip(*kinds, strict=True))
    plain = fine_vertices.split_rows(step.matrix, vertices)
    matrices = plain
    if boundary.vertex.size or fine.vertex.size:
        matrix = product(product(to_dofs(fine), subdivision_matrix(boundary, fine, step)), boundary.to_points)
        matrices = fine_vertices.functions(fine).split_rows(matrix, vertices.functions(boundary))
    result: list[tuple[Step, sp.csr_array] | tuple[None, None]] = []
    for m, s, matrix in zip(made, plain, matrices, strict=True):
        if m is None:
            result.append((None, None))
        else:  # without traces both matrices are the same
            step = Step(m.fine, m.first_child, m.old, m.edges, s)
            result.append((step, s if s.shape == matrix.shape else matrix))
    return result


def _with_keys(level: Level, keys: Keys) -> Bools:
    """Return marks of the faces that have one of the given keys."""
    place = np.minimum(np.searchsorted(level.keys, keys), level.num_faces - 1)
    marks = np.zeros(level.num_faces, dtype=bool)
    marks[place[level.keys[place] == keys]] = True
    return marks


def _needs_cut(level: Level, caps: Ints) -> Bools:
    """Return the faces with an irregular corner whose cap level is not reached yet."""
    ends_later = ~level.regular
    ends_later &= np.where(level.control_vertex >= 0, caps[level.control_vertex], 0) > level.number
    return level.touching(ends_later)


def _are_needed(along: Bools, keys: Sequence[Keys]) -> bool:
    """Return whether marked faces of level 0 have children among those of the given keys."""
    return bool(along.any()) and any(along[k >> 2].any() for k in keys)


def _with_all_children(stage: Stage, children: Bools) -> Bools:
    """Return the refined faces all of whose children, faces of the next level, are marked, shape (num_faces,)."""
    marks = np.zeros(stage.level.num_faces, dtype=bool)
    assert stage.step is not None  # there is a next level
    first = stage.step.first_child[stage.refined]
    marks[stage.refined] = children[first[:, None] + np.arange(4)].all(axis=1)
    return marks


def _with_sources(stages: Sequence[Stage], functions: Sequence[Bools]) -> list[Bools]:
    """Return marks of functions and of all on coarser levels whose coefficients theirs are made of, before truncation.

    Args:
        stages: The first ones of a hierarchy.
        functions: Marks for each of them.
    """
    result = [marks.copy() for marks in functions]
    for l in range(len(result) - 1, 0, -1):
        matrix = stages[l - 1].matrix
        assert matrix is not None  # every stage but the last has a step
        result[l - 1][rows_of(matrix, np.flatnonzero(result[l])).indices] = True
    return result


def _coefficients(
    stages: Sequence[Stage], of: Sequence[Stage], needed: Sequence[Bools] | None = None
) -> list[sp.csr_array]:
    """Return, on each of the given stages, the coefficients of the dofs of the hierarchy `of`.

    `of` is the stages' own hierarchy, or a coarser one: then its functions are found on the larger levels by face keys.
    Rows that are not needed are left empty.
    """
    num_dofs = sum(int(np.count_nonzero(stage.active)) for stage in of)
    result: list[sp.csr_array] = []
    first = 0
    for l, stage in enumerate(stages):
        unit = np.full(stage.boundary.num_functions, COMPUTED, dtype=np.int32)
        if l < len(of):
            selected, active = _functions_on(stage, of[l])
            unit[selected] = EMPTY  # the truncation
            unit[active] = np.arange(first, first + active.size, dtype=np.int32)
            first += active.size
        if needed is not None:
            unit[~needed[l]] = EMPTY
        if l == 0:  # all functions are selected
            result.append(_units(unit, num_dofs))
            continue
        matrix = stages[l - 1].matrix
        assert matrix is not None  # every stage but the last has a step
        result.append(product(matrix, result[-1], unit))
    return result


def _units(column: Ints, num_columns: int) -> sp.csr_array:
    """Return the matrix that has a 1 in the given column of each row; EMPTY: a row without."""
    used = column >= 0
    indptr = np.concatenate([[0], np.cumsum(used)]).astype(np.int32)
    return csr(np.ones(indptr[-1]), column[used], indptr, (column.size, num_columns))


def _functions_on(stage: Stage, other: Stage) -> tuple[Ints, Ints]:
    """Return the selected and the active functions of `other` as functions of `stage`, the same level held further."""
    if stage is other:
        return np.flatnonzero(stage.selected).astype(np.int32), np.flatnonzero(stage.active).astype(np.int32)
    level, part = stage.level, other.level
    found = np.minimum(np.searchsorted(level.keys, part.keys), level.num_faces - 1)
    same = level.keys[found] == part.keys
    number = np.full(other.boundary.num_functions, -1, dtype=np.int32)
    vertices = number[: part.num_vertices]
    vertices[part.quads[same]] = level.quads[found[same]]
    trace = other.boundary.vertex
    shift = part.num_vertices + np.arange(trace.size) - other.boundary.first[trace]
    number[part.num_vertices :] = stage.boundary.first[vertices[trace]] + shift
    return number[other.selected], number[other.active]
