"""Dofs of one unknown or several: their numbers, their ghosts, and the prescribed ones.

Dofs are numbered space after space. On several ranks the vectors of equations have those that this rank owns. Where
columns of matrices and prescribed dofs are numbered, the ghosts of all spaces follow, ascending by PETSc's numbers;
these go rank after rank, and within a rank space after space.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from thccs_fem.fem.bcs import DirichletBC
from thccs_fem.fem.entries import Numbering
from thccs_fem.fem.function import Function
from thccs_fem.fem.space import FunctionSpace
from thccs_fem.hierarchy import Hierarchy
from thccs_fem.index_map import IndexMap
from thccs_fem.parallel import rank_of, together
from thccs_fem.partition import needed_functions, partition
from thccs_fem.subdivision import Bools, Ints

__all__ = ["Conditions", "Layout", "constraints"]

Floats = npt.NDArray[np.float64]
Conditions = Sequence[DirichletBC] | Sequence[Sequence[DirichletBC]]


@dataclass(frozen=True, eq=False)
class Layout:
    """Dofs of several spaces, one space after the other.

    Attributes:
        spaces: The spaces.
    """

    spaces: tuple[FunctionSpace, ...]

    @property
    def comm(self) -> Any:
        """The communicator, None in serial."""
        return self.spaces[0].mesh.comm

    @cached_property
    def index_maps(self) -> list[IndexMap]:
        """Which scalar functions of each space this rank owns, and which are columns of its matrices.

        Those of the space, and where others are on another hierarchy, which is spread in another way, also all that do
        not vanish on the cells that this rank holds of that.
        """
        hierarchies = [V.hierarchy for V in self.spaces]
        return [_with_ghosts_of(V, hierarchies) for V in self.spaces]

    @cached_property
    def offsets(self) -> Ints:
        """Number of the first owned dof of each space, and their number in all, shape (len(spaces) + 1,)."""
        return np.cumsum([0, *(V.num_owned_dofs for V in self.spaces)]).astype(np.int32)

    @cached_property
    def starts(self) -> npt.NDArray[np.int64]:
        """First of PETSc's numbers of each rank, and how many there are, shape (ranks + 1,)."""
        return np.sum([V.block_size * V.index_map.starts for V in self.spaces], axis=0)

    @property
    def num_dofs(self) -> int:
        """Number of dofs in all, global."""
        return int(self.starts[-1])

    @property
    def num_owned(self) -> int:
        """Number of dofs that this rank owns."""
        return int(self.offsets[-1])

    @cached_property
    def num_local(self) -> int:
        """Number of dofs that this rank owns or has as ghosts."""
        return sum(V.block_size * M.numbers.size for V, M in zip(self.spaces, self.index_maps, strict=True))

    @property
    def is_whole(self) -> bool:
        """Whether this rank owns all dofs, by their numbers."""
        return all(V.index_map.is_whole for V in self.spaces)

    @cached_property
    def numbering(self) -> Numbering | None:
        """PETSc's numbers of the local dofs; None where they are the same."""
        if self.is_whole:
            return None
        own = self.starts[rank_of(self.comm)] + np.arange(self.num_owned)
        return Numbering(self.comm, self.starts, np.concatenate([own, self._ghosts[self._order]]).astype(np.int32))

    @cached_property
    def places(self) -> list[Ints]:
        """Local number of each dof of the functions in each of `index_maps`."""
        ghosts = np.zeros(self._order.size, dtype=np.int32)
        ghosts[self._order] = np.arange(self.num_owned, self.num_local, dtype=np.int32)
        counts = [V.block_size * M.num_ghosts for V, M in zip(self.spaces, self.index_maps, strict=True)]
        owned = np.split(np.arange(self.num_owned, dtype=np.int32), self.offsets[1:-1])
        return [np.concatenate(parts) for parts in zip(owned, np.split(ghosts, np.cumsum(counts)[:-1]), strict=True)]

    @cached_property
    def component(self) -> Ints:
        """Which of all components of all spaces each local dof belongs to, shape (num_local,)."""
        component, first = np.zeros(self.num_local, dtype=np.int32), 0
        for V, places in zip(self.spaces, self.places, strict=True):
            component[places] = first + np.arange(places.size) % V.block_size
            first += V.block_size
        return component

    @cached_property
    def _ghosts(self) -> npt.NDArray[np.int64]:
        """PETSc's numbers of the ghosts of all spaces, space after space."""
        found, before = [np.zeros(0, dtype=np.int64)], np.zeros(self.starts.size - 1, dtype=np.int64)
        for V, index_map in zip(self.spaces, self.index_maps, strict=True):
            starts = V.block_size * index_map.starts
            shift = self.starts[:-1] + before - starts[:-1]
            functions = V.block_size * index_map.ghosts.astype(np.int64) + shift[index_map.owners]
            found.append((functions[:, None] + np.arange(V.block_size)).ravel())
            before += np.diff(starts)
        return np.concatenate(found)

    @cached_property
    def _order(self) -> npt.NDArray[np.intp]:
        return np.argsort(self._ghosts)

    def split(self, x: Floats) -> list[Floats]:
        """Return the part of a vector of owned dofs that belongs to each space, views."""
        return np.split(x, self.offsets[1:-1])

    def join(self, functions: Sequence[Function]) -> Floats:
        """Return the coefficients of functions in one vector, a new one, shape (num_owned,)."""
        owned = zip(functions, self.spaces, strict=True)
        return np.concatenate([function.x.array[: V.num_owned_dofs] for function, V in owned])

    def spread(self, x: Floats, functions: Sequence[Function]) -> None:
        """Give functions their coefficients, shape (num_owned,), and their ghosts too; collective."""
        for function, values in zip(functions, self.split(x), strict=True):
            function.x.array[: values.size] = values
            function.x.scatter_forward()

    def with_ghosts(self, x: Floats) -> Floats:
        """Return a vector of all local dofs; collective.

        Args:
            x: Values of the owned ones, shape (num_owned,) or with k columns.
        """
        if self.is_whole:
            return x
        result = np.zeros((self.num_local, *x.shape[1:]))
        for index_map, places, owned in zip(self.index_maps, self.places, self.split(x), strict=True):
            values = np.zeros((places.size, *x.shape[1:]))
            values[: owned.shape[0]] = owned
            index_map.scatter_forward(_by_functions(values, index_map))
            result[places] = values
        return result

    def without_ghosts(self, x: Floats) -> Floats:
        """Return a vector of owned dofs, with what stands at their ghosts on other ranks added to them; collective.

        Args:
            x: Contributions to all local dofs, shape (num_local,) or with k columns.
        """
        if self.is_whole:
            return x
        parts = []
        for V, index_map, places in zip(self.spaces, self.index_maps, self.places, strict=True):
            values = x[places]
            index_map.reverse_add(_by_functions(values, index_map))
            parts.append(values[: V.num_owned_dofs])
        return np.concatenate(parts)

    def constraints(self, bcs: Conditions) -> tuple[Ints, Floats]:
        """Return the prescribed dofs by their local numbers, ascending, ghosts included, and their values; collective.

        Args:
            bcs: Conditions, each for the unknown in whose space it is; or a list of them for each unknown.

        Raises:
            TypeError: A condition is none.
            ValueError: A condition is on a space of no unknown, or of two.
        """
        given = together(self.comm, lambda: self._sorted(bcs or ()))
        found = [constraints(*each) for each in zip(given, self.spaces, self.index_maps, strict=True)]
        dofs = np.concatenate([places[dofs] for places, (dofs, _) in zip(self.places, found, strict=True)])
        values = np.concatenate([values for _, values in found])
        order = np.argsort(dofs)
        return dofs[order], values[order]

    def _sorted(self, bcs: Conditions) -> list[list[Any]]:
        """Return the conditions on each space."""
        if len(self.spaces) == 1 or isinstance(bcs, DirichletBC):
            return [bcs for _ in self.spaces]  # type: ignore[misc]  # constraints says what is wrong with a single one
        if len(bcs) == len(self.spaces) and all(isinstance(some, list | tuple) for some in bcs):
            return [list(some) for some in bcs]  # type: ignore[arg-type]  # as was just asked
        of_space: list[list[Any]] = [[] for _ in self.spaces]
        for bc in bcs:
            of_space[self._place(bc)].append(bc)
        return of_space

    def _place(self, bc: Any) -> int:
        """Return the number of the space that a condition is on."""
        given = bc.function_space if isinstance(bc, DirichletBC) else None
        places = [i for i, V in enumerate(self.spaces) if V is given]
        places = places or [i for i, V in enumerate(self.spaces) if V == given]
        if len(places) > 1:
            raise ValueError(
                f"a condition is on {given}, which is the space of the unknowns {places}: give a list of conditions "
                f"for each unknown, bcs=[[...], [...]]"
            )
        if not places and given is not None:
            listed = " and ".join(str(V) for V in self.spaces)
            raise ValueError(f"a condition is on {given}, but the unknowns are in {listed}")
        return places[0] if places else 0  # where constraints refuses it


def _by_functions(values: Floats, index_map: IndexMap) -> Floats:
    """Return a view with a row for each function."""
    n = index_map.numbers.size
    return values.reshape(n, values.size // n if n else 0)


# ---- Prescribed dofs -------------------------------------------------------------------------------------------------


def constraints(bcs: Sequence[DirichletBC], V: FunctionSpace, index_map: IndexMap | None = None) -> tuple[Ints, Floats]:
    """Return the prescribed dofs, ascending, local, and their values; collective.

    Where two conditions prescribe a dof, the later one holds. For ghosts their owners' conditions do: a rank need not
    see from its own cells that a ghost is on the boundary.

    Args:
        bcs: The conditions.
        V: Their space.
        index_map: Functions whose dofs are numbered, with more ghosts than the space has; None: those of the space.

    Raises:
        TypeError: If a condition is none of ours.
        ValueError: If a condition is on another space.
    """
    dofs, values = together(V.mesh.comm, lambda: _local_constraints(bcs, V))
    if V.index_map.is_whole:
        return dofs, values
    index_map = V.index_map if index_map is None else index_map
    owned = np.searchsorted(dofs, V.num_owned_dofs)
    marked = np.zeros((V.block_size * index_map.numbers.size, 2))
    marked[dofs[:owned], 0], marked[dofs[:owned], 1] = 1.0, values[:owned]
    index_map.scatter_forward(_by_functions(marked, index_map))
    dofs = np.flatnonzero(marked[:, 0]).astype(np.int32)
    return dofs, marked[dofs, 1]


def _local_constraints(bcs: Sequence[DirichletBC], V: FunctionSpace) -> tuple[Ints, Floats]:
    if isinstance(bcs, DirichletBC):
        raise TypeError("bcs is a single condition: give a list, bcs=[bc]")
    for bc in bcs:
        if not isinstance(bc, DirichletBC):
            raise TypeError(f"bcs holds a {type(bc).__name__}: make conditions with fem.dirichletbc(value, dofs, V)")
        if bc.function_space != V:
            where = "" if bc.function_space.mesh is V.mesh else " of another mesh"
            raise ValueError(
                f"a condition is on {bc.function_space}{where}, but the unknown is in {V}: make it with "
                f"fem.dirichletbc(value, dofs, V) for that space, with dofs found for it"
            )
    dofs = np.concatenate([np.zeros(0, dtype=np.int32), *(bc.dofs for bc in reversed(bcs))])
    values = np.concatenate([np.zeros(0), *(bc.values for bc in reversed(bcs))])
    dofs, first = np.unique(dofs, return_index=True)
    return dofs, values[first]


# ---- Several hierarchies ---------------------------------------------------------------------------------------------


def _with_ghosts_of(V: FunctionSpace, hierarchies: Sequence[Hierarchy]) -> IndexMap:
    """Return the functions of a space that this rank owns, with all those that meet its cells of any hierarchy."""
    index_map = V.index_map
    others = [other for other in dict.fromkeys(hierarchies) if not other.same_as(V.hierarchy)]
    if index_map.is_whole or not others:
        return index_map
    assert index_map.global_numbers is not None  # it is not whole
    held = np.zeros(index_map.size_global, dtype=bool)
    held[index_map.numbers] = True
    for other in others:
        functions = needed_functions(V.hierarchy, _cells_meeting(V.hierarchy, other))
        stages = V.hierarchy.stages[: V.num_levels]
        held |= np.concatenate([marks[stage.active] for marks, stage in zip(functions, stages, strict=False)])
    owners = np.searchsorted(index_map.starts, index_map.global_numbers, side="right") - 1
    return IndexMap.spread(index_map.comm, owners, held)


def _cells_meeting(hierarchy: Hierarchy, other: Hierarchy) -> Bools:
    """Return marks of the cells of a hierarchy that overlap those which this rank holds of another one."""
    held = np.zeros(partition(other).cells.size_global, dtype=bool)
    held[partition(other).cells.numbers] = True
    theirs, first = [], 0
    for stage in other.stages[: other.num_levels]:
        theirs.append(stage.level.keys[stage.active_faces][held[first : first + stage.active_faces.size]])
        first += stage.active_faces.size
    marks = []
    for l, stage in enumerate(hierarchy.stages[: hierarchy.num_levels]):
        keys = stage.level.keys[stage.active_faces]
        marks.append(np.zeros(keys.size, dtype=bool))
        for k, others in enumerate(theirs):
            marks[-1] |= np.isin(keys >> 2 * max(l - k, 0), others >> 2 * max(k - l, 0))
    return np.concatenate(marks)
