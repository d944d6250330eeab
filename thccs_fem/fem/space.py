"""Function spaces on the limit surface of a control mesh.

A `FunctionSpace` is a UFL function space whose functions are the active functions of a `Hierarchy`, once for every
component of the value.  Degree of freedom `block_size * i + c` is component c of function i.
A `CellwiseSpace` holds coefficients that are constant on each cell.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import cached_property
from typing import Any, Literal, overload

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

import ufl
from thccs_fem import element
from thccs_fem.absent import Absent
from thccs_fem.bezier import bezier_masks
from thccs_fem.boundary import BoundaryRule, to_dofs
from thccs_fem.extraction import Cells, extract
from thccs_fem.folds import check_no_folds
from thccs_fem.hierarchy import CAP_LEVEL, Hierarchy
from thccs_fem.index_map import IndexMap
from thccs_fem.mesh import ControlMesh
from thccs_fem.partition import partition
from thccs_fem.regions import Unit
from thccs_fem.subdivision import Ints

__all__ = ["CellwiseSpace", "Component", "FunctionSpace", "cellwise", "check_space", "functionspace"]

FAMILY, DEGREE = "THCCS", 3

ConstantElement = (
    tuple[Literal["DG"], Literal[0]]
    | tuple[Literal["DG"], Literal[0], tuple[()]]
    | tuple[Literal["DG"], Literal[0], tuple[int]]
)


class _OnRanks(ABC):
    """Numbers of degrees of freedom, `block_size` for each index of a map."""

    block_size: int

    @property
    @abstractmethod
    def index_map(self) -> IndexMap:
        """What this rank owns, and of what it holds copies."""

    @property
    def num_dofs(self) -> int:
        """Number of degrees of freedom, global."""
        return self.block_size * self.index_map.size_global

    @property
    def num_owned_dofs(self) -> int:
        """Number of degrees of freedom that this rank owns."""
        return self.block_size * self.index_map.size_local

    @property
    def num_local_dofs(self) -> int:
        """Number of degrees of freedom that this rank owns or has as ghosts."""
        return self.block_size * self.index_map.numbers.size


class FunctionSpace(ufl.FunctionSpace, _OnRanks):
    """THCCS functions with values of a given shape; make one with `functionspace`, refine it with `adapt.refine`.

    Args:
        hierarchy: The hierarchy that holds the scalar functions.
        value_shape: () for scalars, (k,) for vectors.
        integration: Makes of the hierarchy the cells that forms are integrated on.
    """

    def __init__(
        self,
        hierarchy: Hierarchy,
        value_shape: tuple[int, ...] = (),
        integration: Callable[[Hierarchy], Cells] = extract,
    ):
        if not isinstance(hierarchy, Hierarchy):
            raise TypeError(
                f"FunctionSpace needs a Hierarchy, got {type(hierarchy).__name__}: spaces on a mesh come from "
                f'functionspace(msh, ("THCCS", 3))'
            )
        super().__init__(  # type: ignore[no-untyped-call]  # UFL is typed in part
            hierarchy.mesh.ufl_domain(), element.blocked(value_shape) if value_shape else element.bspline()
        )
        self.hierarchy = hierarchy
        self.integration = integration
        self.block_size = int(np.prod(value_shape, dtype=int))
        partition(hierarchy)  # on all ranks together, as spaces are made: then one rank may ask for sizes

    dofmap = Absent("V.cells.batches have the dofs of cells; their number is V.num_dofs, the block size V.block_size")
    tabulate_dof_coordinates = Absent("coefficients belong to no points; V.reference_points has one near each function")
    element = Absent("fem.project takes the place of interpolation; an Expression has points of the unit square")

    @property
    def mesh(self) -> ControlMesh:
        """The control mesh."""
        return self.hierarchy.mesh

    @property
    def index_map(self) -> IndexMap:
        """Which scalar functions this rank owns, and of which it holds copies."""
        return partition(self.hierarchy).functions

    @property
    def num_functions(self) -> int:
        """Number of scalar functions, global."""
        return self.hierarchy.num_dofs

    @property
    def num_cells(self) -> int:
        """Number of active elements, global."""
        return partition(self.hierarchy).cells.size_global

    @property
    def num_levels(self) -> int:
        """Number of levels; 1 when nothing is refined."""
        return self.hierarchy.num_levels

    @cached_property
    def cells(self) -> Cells:
        """Active elements with the extraction operators of their pieces."""
        return _cells(self.hierarchy, extract)

    @cached_property
    def integration_cells(self) -> Cells:
        """What forms are integrated on: `cells`, unless `with_integration` put others in their place."""
        return _cells(self.hierarchy, self.integration)

    @cached_property
    def reference_points(self) -> npt.NDArray[np.float64]:
        """A point for each function, shape (num_functions, gdim), local, ghosts included.

        The limit point of the function's vertex; on a clamped boundary a trace function sits at the rim vertex, the one
        beside it a third of an edge inside.
        """
        hierarchy = self.hierarchy
        points = []
        for l in range(hierarchy.num_levels):
            boundary = hierarchy.stages[l].boundary
            limit = np.zeros((boundary.num_functions, self.mesh.gdim))
            limit[: boundary.level.num_vertices] = _limit_points(hierarchy, l)
            points.append((to_dofs(boundary) @ limit)[hierarchy.dof_functions(l)])
        return np.concatenate(points)[self.index_map.numbers]

    def sub(self, component: int) -> Component:
        """Return one component, for boundary conditions on it alone.

        Raises:
            IndexError: If there is no such component.
        """
        if not 0 <= component < self.block_size or not self.value_shape:
            raise IndexError(f"component {component} of a space with value shape {self.value_shape}")
        return Component(self, component)

    def with_hierarchy(self, hierarchy: Hierarchy) -> FunctionSpace:
        """Return the space of the same kind on another hierarchy of the same mesh."""
        return FunctionSpace(hierarchy, self.value_shape, self.integration)

    def with_integration(self, rule: Callable[[Hierarchy], Cells]) -> FunctionSpace:
        """Return the space of the same functions whose forms are integrated in another way.

        Coefficients and cells are the same in both, and so are boundary conditions, values at points, and output. A
        form has functions of one of them only; ``g = fem.Function(W); g.x.array = f.x.array`` carries f over.

        Args:
            rule: `extraction.extract`, the default, or one of `quadrature`.
        """
        return FunctionSpace(self.hierarchy, self.value_shape, rule)

    def is_refinement_of(self, other: FunctionSpace | CellwiseSpace) -> bool:
        """Return whether every scalar function of `other` lies in this space, integrated in the same way.

        Or, if it is cellwise, whether it is constant on each of the cells here.
        """
        if isinstance(other, CellwiseSpace):
            return other.mesh is self.mesh and (
                other.hierarchy is None or self.hierarchy.is_refinement_of(other.hierarchy)
            )
        return self.integration is other.integration and (
            self.hierarchy is other.hierarchy or self.hierarchy.is_refinement_of(other.hierarchy)
        )

    def prolongation(self, coarse: FunctionSpace) -> sp.csr_array:
        """Return the exact transfer from a coarser space, shape (num_dofs, coarse.num_dofs).

        On several ranks it is the same on each, for the dofs of all of them by their numbers in the hierarchies, not
        for local ones: `adapt.transfer` carries functions over.

        Raises:
            ValueError: If the spaces are not nested or their values have different shapes.
        """
        if self.value_shape != coarse.value_shape:
            raise ValueError(f"values of shape {coarse.value_shape} cannot be carried to shape {self.value_shape}")
        scalar = self.hierarchy.prolongation(coarse.hierarchy)
        return sp.csr_array(sp.kron(scalar, sp.eye_array(self.block_size), format="csr"))

    def __eq__(self, other: object) -> bool:
        if self is other:
            return True
        return (
            isinstance(other, FunctionSpace)
            and self.value_shape == other.value_shape
            and self.integration is other.integration
            and (self.hierarchy is other.hierarchy or self.hierarchy.same_as(other.hierarchy))
        )

    def __hash__(self) -> int:
        return hash((id(self.mesh), self.hierarchy.rule, self.num_dofs, self.value_shape))

    def __str__(self) -> str:
        hierarchy = self.hierarchy
        rings = ", refined by rings" if hierarchy.unit == "ring" else ""
        bound = "" if hierarchy.admissibility is None else f", at most {hierarchy.admissibility} on a cell"
        return (
            f"FunctionSpace(THCCS degree 3, values {self.value_shape}, {hierarchy.rule} boundary{rings}, "
            f"{self.num_levels} levels{bound}, {self.num_dofs} dofs)"
        )


class CellwiseSpace(ufl.FunctionSpace, _OnRanks):
    """Functions that are constant on each face of a control mesh, or each cell of a hierarchy; for coefficients.

    Make one with ``functionspace(msh, ("DG", 0))`` or with `cellwise`. Degree of freedom `block_size * i + c` is
    component c on face or cell i. What is finer than these has the value of the face or cell it lies in.

    On several ranks cells are spread as those of the space are; faces of the control mesh are held by all, as the mesh.

    Args:
        mesh: The control mesh.
        hierarchy: The hierarchy with the cells; None: the faces of the mesh.
        value_shape: () for scalars, (k,) for vectors.
    """

    integration = staticmethod(extract)

    def __init__(self, mesh: ControlMesh, hierarchy: Hierarchy | None = None, value_shape: tuple[int, ...] = ()):
        super().__init__(mesh.ufl_domain(), element.constant(value_shape))  # type: ignore[no-untyped-call]  # as above
        self.mesh = mesh
        self.hierarchy = hierarchy
        self.block_size = int(np.prod(value_shape, dtype=int))

    @cached_property
    def index_map(self) -> IndexMap:
        """Which cells this rank owns, and of which it holds copies; every rank holds all faces of the control mesh."""
        return IndexMap.whole(self.mesh.num_faces) if self.hierarchy is None else partition(self.hierarchy).cells

    @property
    def num_cells(self) -> int:
        """Number of faces or cells, global."""
        return self.index_map.size_global

    @cached_property
    def cells(self) -> Cells:
        """The cells, those of level 0 for the faces of the mesh."""
        return _cells(Hierarchy.on(self.mesh) if self.hierarchy is None else self.hierarchy, extract)

    @property
    def integration_cells(self) -> Cells:
        """The cells: what forms are integrated on if these are the finest."""
        return self.cells

    def is_refinement_of(self, other: FunctionSpace | CellwiseSpace) -> bool:
        """Return whether each cell here lies in one of those of `other`, with integrals over the same."""
        if self.hierarchy is None:
            return isinstance(other, CellwiseSpace) and other.hierarchy is None and other.mesh is self.mesh
        return other.integration is extract and FunctionSpace(self.hierarchy).is_refinement_of(other)

    def numbers_of(self, cells: Cells) -> Ints:
        """Return the number of the face or cell that each of the given cells lies in, shape (cells.num_cells,).

        Raises:
            ValueError: If some lie in none, since they are coarser.
        """
        if self.hierarchy is None:
            return cells.face
        if cells.hierarchy is self.hierarchy:
            return cells.partition.cells.numbers
        numbers = cells.partition.cells.numbers
        levels, keys = (of_all[numbers] for of_all in cells.hierarchy.cells)
        found, around = self.hierarchy.cells_around(levels, keys)
        num_coarser = np.count_nonzero(around > levels)
        if num_coarser:
            raise ValueError(
                f"the values of {num_coarser} of {found.size} cells are not known: a function that is "
                f"constant on cells goes over to finer cells only"
            )
        return found.astype(np.int32)

    def __eq__(self, other: object) -> bool:
        if self is other:
            return True
        if not (isinstance(other, CellwiseSpace) and self.mesh is other.mesh and self.value_shape == other.value_shape):
            return False
        if self.hierarchy is None or other.hierarchy is None:
            return self.hierarchy is other.hierarchy
        return self.hierarchy is other.hierarchy or self.hierarchy.same_as(other.hierarchy)

    def __hash__(self) -> int:
        return hash((id(self.mesh), self.num_dofs, self.value_shape))

    def __str__(self) -> str:
        where = "control mesh" if self.hierarchy is None else f"hierarchy of {self.hierarchy.num_levels} levels"
        return f"CellwiseSpace(values {self.value_shape}, {self.num_cells} cells of a {where})"


def cellwise(V: FunctionSpace, value_shape: tuple[int, ...] = ()) -> CellwiseSpace:
    """Return the space of functions that are constant on each cell of V, in the order of the cells.

    They can be coefficients of forms and parts of expressions, but not test or trial functions.

    Args:
        V: The space with the cells.
        value_shape: () for scalars, (k,) for vectors.
    """
    return CellwiseSpace(V.mesh, V.hierarchy, _checked_shape(value_shape))


def check_space(V: object, what: str) -> None:
    """Raise if something is no space of splines.

    Args:
        V: What was given.
        what: What needs a space, for the message.

    Raises:
        TypeError: It is none.
    """
    if not isinstance(V, FunctionSpace):
        given = str(V) if isinstance(V, CellwiseSpace) else type(V).__name__
        raise TypeError(f'{what} needs a space from fem.functionspace(msh, ("THCCS", 3)), got {given}')


class Component:
    """One component of a vector-valued space; made by `FunctionSpace.sub`."""

    def __init__(self, space: FunctionSpace, component: int):
        self.space = space
        self.component = component

    collapse = Absent("dofs are numbers of functions, the same for all components: fem.boundary_dofs(V) finds them")


@overload
def functionspace(
    mesh: ControlMesh,
    element: ConstantElement,
    boundary: BoundaryRule = "clamped",
    *,
    cap_level: int = CAP_LEVEL,
    admissibility: int | None = None,
    unit: Unit = "support",
) -> CellwiseSpace: ...


@overload
def functionspace(
    mesh: ControlMesh,
    element: tuple[Any, ...],
    boundary: BoundaryRule = "clamped",
    *,
    cap_level: int = CAP_LEVEL,
    admissibility: int | None = None,
    unit: Unit = "support",
) -> FunctionSpace: ...


def functionspace(
    mesh: ControlMesh,
    element: tuple[Any, ...],
    boundary: BoundaryRule = "clamped",
    *,
    cap_level: int = CAP_LEVEL,
    admissibility: int | None = None,
    unit: Unit = "support",
) -> FunctionSpace | CellwiseSpace:
    """Return the THCCS space on the limit surface of a control mesh.

    Args:
        mesh: The control mesh.
        element: ("THCCS", 3) for scalars, ("THCCS", 3, (k,)) for vectors with k components; or ("DG", 0), with a
            shape or without, for coefficients that are constant on each face of the control mesh.
        boundary: "clamped" (full approximation order up to the boundary) or "crease" (the plain Catmull-Clark
        boundary).
        cap_level: Level at which a bicubic cap ends the cut at extraordinary vertices; deeper where refinement goes
            deeper.
        admissibility: The class m of refinement: the functions that do not vanish on a cell belong to at most m
            successive levels, m being 2 or more; what is refined takes more along for that. None: any levels may meet.
        unit: What refining a function refines: its "support", two rings of faces around its vertex, or the "ring" of
            faces at it, which needs fewer dofs and more steps (see docs/adaptivity.md).

    Raises:
        TypeError: If `mesh` is no control mesh, or cap_level or admissibility no integer.
        ValueError: If the element is none of ours, or an option is out of range, or the planar surface folds.
        NotImplementedError: If the mesh has creases inside.
    """
    if not isinstance(mesh, ControlMesh):
        raise TypeError(f"functionspace needs a thccs_fem.mesh.ControlMesh, got {type(mesh).__name__}")
    if boundary not in ("clamped", "crease"):
        raise ValueError(f'boundary is {boundary!r}; it must be "clamped" or "crease"')
    value_shape = _value_shape(element)
    if element[0] == "DG":
        return CellwiseSpace(mesh, value_shape=value_shape)
    hierarchy = Hierarchy.on(mesh, boundary, cap_level=cap_level, admissibility=admissibility, unit=unit)
    space = FunctionSpace(hierarchy, value_shape)
    check_no_folds(space.cells)
    return space


def _value_shape(element: object) -> tuple[int, ...]:
    """Return the value shape that ("THCCS", 3[, shape]) or ("DG", 0[, shape]) asks for."""
    known = ((FAMILY, DEGREE), ("DG", 0))
    if not isinstance(element, tuple) or not 2 <= len(element) <= 3 or element[:2] not in known:
        raise ValueError(
            f'the element is {element!r}; it must be ("THCCS", 3), or ("THCCS", 3, (k,)) for k components, or '
            f'("DG", 0) for coefficients that are constant on each face of the mesh'
        )
    return _checked_shape(element[2] if len(element) == 3 else ())


def _checked_shape(shape: object) -> tuple[int, ...]:
    if not isinstance(shape, tuple) or len(shape) > 1 or not all(isinstance(k, int) and k > 0 for k in shape):
        raise ValueError(f"the value shape is {shape!r}; it must be () or (k,) with k components")
    return shape


def _limit_points(hierarchy: Hierarchy, l: int) -> npt.NDArray[np.float64]:
    """Return the limit points of the vertices of Omega^l, shape (vertices of the level, gdim); others are zero."""
    stage = hierarchy.stages[l]
    faces: Ints = np.flatnonzero(stage.inside).astype(np.int32)
    masks = bezier_masks(stage.boundary, faces)[:, : stage.level.num_vertices]
    corners = (masks @ hierarchy.points[l]).reshape(faces.size, 16, -1)[:, [0, 3, 15, 12]]
    points = np.zeros_like(hierarchy.points[l])
    points[stage.level.quads[faces]] = corners
    return points


def _cells(hierarchy: Hierarchy, rule: Callable[[Hierarchy], Cells]) -> Cells:
    """Return the cells that the rule makes of a hierarchy, made once and kept with it."""
    kept: dict[Callable[[Hierarchy], Cells], Cells] = hierarchy.__dict__.setdefault("_cells", {})
    if rule not in kept:
        kept[rule] = rule(hierarchy)
    return kept[rule]
