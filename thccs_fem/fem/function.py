"""Functions in a THCCS space, and constants, as UFL objects with values."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

import ufl
from thccs_fem.absent import Absent
from thccs_fem.element import NUM_FUNCTIONS
from thccs_fem.extraction import Cells, evaluate_pieces
from thccs_fem.fem.space import CellwiseSpace, FunctionSpace, cellwise
from thccs_fem.index_map import Fetch, IndexMap
from thccs_fem.mesh import ControlMesh
from thccs_fem.parallel import gathered, rank_of, size_of, together, total
from thccs_fem.prolongation import Prolongation
from thccs_fem.subdivision import Ints

__all__ = ["Constant", "Function", "Vector", "cell_sizes"]

NUM_GAUSS = 4  # points in each direction for areas


class Vector:
    """Coefficients of a function; `array` holds those this rank owns, then its ghosts (none in serial).

    Args:
        index_map: What this rank owns and holds.
        block_size: Coefficients of each.
    """

    def __init__(self, index_map: IndexMap, block_size: int):
        self._index_map = index_map
        self._block_size = block_size
        self._array = np.zeros(block_size * index_map.numbers.size)

    @property
    def array(self) -> npt.NDArray[np.float64]:
        """Values, shape (block_size * (size_local + num_ghosts),), float64; write into it or assign to it."""
        return self._array

    @array.setter
    def array(self, values: npt.ArrayLike) -> None:
        self._array[:] = values

    @property
    def index_map(self) -> IndexMap:
        """What this rank owns and holds, without the block size."""
        return self._index_map

    @property
    def block_size(self) -> int:
        """Coefficients of each index of the map."""
        return self._block_size

    petsc_vec = Absent(
        "PETSc.Vec().createWithArray(u.x.array[: V.num_owned_dofs], comm=...) is one that shares the values"
    )

    def scatter_forward(self) -> None:
        """Give ghosts the values that their owners have; collective."""
        self._index_map.scatter_forward(self._array.reshape(-1, self._block_size))


class Function(ufl.Coefficient):
    """A function of a THCCS space, or one that is constant on each cell.

    Args:
        V: The space.
        name: Name in output.
    """

    def __init__(self, V: FunctionSpace | CellwiseSpace, name: str = "f"):
        if not isinstance(V, FunctionSpace | CellwiseSpace):
            raise TypeError(f"a Function needs a space from fem.functionspace, got {type(V).__name__}")
        super().__init__(V)  # type: ignore[no-untyped-call]  # UFL is typed in part
        self.name = name
        self._x = Vector(V.index_map, V.block_size)

    @property
    def function_space(self) -> FunctionSpace:
        """The space.

        For type checkers a THCCS space, which nearly all functions are in; where one that is constant on each cell may
        come, `ufl_function_space` says so.
        """
        return self.ufl_function_space()  # type: ignore[return-value]  # as documented

    def ufl_function_space(self) -> FunctionSpace | CellwiseSpace:
        """Return the space, of either kind."""
        return super().ufl_function_space()  # type: ignore[no-untyped-call]  # as above

    @property
    def x(self) -> Vector:
        """Coefficients."""
        return self._x

    def copy(self, name: str | None = None) -> Function:
        """Return an independent function with the same values."""
        other = Function(self.function_space, self.name if name is None else name)
        other.x.array = self.x.array
        return other

    def local_coefficients(self, V: FunctionSpace | CellwiseSpace | None = None) -> npt.NDArray[np.float64]:
        """Return the local B-spline coefficients on each piece of a space; collective.

        Args:
            V: A refinement of the function's space; None: that space.

        Returns:
            Shape (num_pieces, 16, block_size), local.

        Raises:
            ValueError: If V is no refinement.
        """
        own = self.ufl_function_space()
        cells = own.cells if V is None else V.cells
        if isinstance(own, CellwiseSpace):  # the local functions add up to one
            return np.repeat(self.cell_values(cells)[cells.piece_cell, None], NUM_FUNCTIONS, axis=1)
        values = self.x.array.reshape(-1, own.block_size)
        if cells.hierarchy is not own.hierarchy:
            values = Prolongation(cells.hierarchy, own.hierarchy)(values)
        return cells.local(values)

    def cell_values(self, cells: Cells) -> npt.NDArray[np.float64]:
        """Return the values of a function that is constant on each cell, on finer cells or the same; collective.

        Returns:
            Shape (cells.num_cells, block_size), local.

        Raises:
            ValueError: If some are coarser.
        """
        V = self.ufl_function_space()
        assert isinstance(V, CellwiseSpace)  # callers look first
        values = self.x.array.reshape(-1, V.block_size)
        if cells.hierarchy is V.hierarchy:
            return values
        numbers = together(V.mesh.comm, lambda: V.numbers_of(cells))
        return Fetch(V.index_map, numbers)(values)

    def eval(
        self, faces: npt.ArrayLike, uv: npt.ArrayLike, corner: npt.ArrayLike | None = None
    ) -> npt.NDArray[np.float64]:
        """Evaluate at points given on faces of the control mesh; collective.

        On several ranks each gets the values at the points that it gave, wherever these lie.

        Args:
            faces: Faces, shape (n,).
            uv: Coordinates in [0, 1]^2, shape (n, 2), as for `limit.evaluate`.
            corner: Sub-quad of a polygon, shape (n,).

        Returns:
            Values, shape (n,) for scalars and (n, k) for vectors.

        Raises:
            ValueError: If a face, coordinate or corner is out of range.
        """
        V = self.ufl_function_space()
        comm = V.mesh.comm
        face, position = together(comm, lambda: V.cells.hierarchy.root_position(faces, uv, corner))
        values = self._at(gathered(comm, face), gathered(comm, position))
        if size_of(comm) > 1:
            begin = sum(comm.allgather(face.size)[: rank_of(comm)])
            values = total(comm, values)[begin : begin + face.size]
        return values if V.value_shape else values[:, 0]

    def _at(self, face: Ints, position: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Return the values at points of faces of level 0, shape (n, block_size); zero on cells of other ranks."""
        V = self.ufl_function_space()
        piece, position = V.cells.locate_in_roots(face, position)
        here = np.flatnonzero(piece >= 0)
        here = here[V.cells.piece_cell[piece[here]] < V.cells.num_owned]
        values = np.zeros((face.size, V.block_size))
        if isinstance(V, CellwiseSpace):
            values[here] = self.cell_values(V.cells)[V.cells.piece_cell[piece[here]]]
        else:
            values[here] = evaluate_pieces(self.local_coefficients(), piece[here], position[here])
        return values

    def __str__(self) -> str:
        return self.name

    interpolate = Absent("splines have no nodal values; fem.project(value, V) returns the nearest function")
    sub = Absent("u[i] is a component in forms, u.x.array[i :: V.block_size] are its coefficients")
    split = Absent(
        "there are no mixed elements; u[i] is a component in forms, and several unknowns are several Functions"
    )

    def __float__(self) -> float:
        raise ValueError(f"the function {self} is no number: u.eval(faces, uv) has its values at points")

    def ufl_evaluate(self, x: object, component: object, derivatives: object) -> float:
        """Refuse what UFL makes of u(x), for which the face of a point in space is not known."""
        raise TypeError(f"{self}({x}): functions have values at points of faces, u.eval(faces, uv)")


def cell_sizes(V: FunctionSpace) -> Function:
    """Return the sizes of the cells of V, each the root of its area, constant on each cell; collective."""
    cells = V.cells
    t, w = np.polynomial.legendre.leggauss(NUM_GAUSS)
    points = np.stack(np.meshgrid((t + 1.0) / 2.0, (t + 1.0) / 2.0), axis=-1).reshape(-1, 2)
    areas = cells.area_element(np.arange(cells.num_pieces, dtype=np.int32), points) @ np.outer(w, w).ravel() / 4.0
    h = Function(cellwise(V), name="h")
    h.x.array = np.sqrt(np.bincount(cells.piece_cell, weights=areas, minlength=cells.num_cells))
    h.x.scatter_forward()  # ghosts are right but for rounding
    return h


class Constant(ufl.Constant):
    """A constant, scalar or array, on a mesh; assign to `value` to change it between assemblies.

    Args:
        domain: The control mesh.
        c: Value, float or array.
    """

    def __init__(self, domain: ControlMesh, c: npt.ArrayLike):
        self._value = np.array(c, dtype=np.float64)
        super().__init__(domain.ufl_domain(), self._value.shape)  # type: ignore[no-untyped-call]  # as above

    def __repr__(self) -> str:
        """Return the text by which UFL sorts the factors of a product.

        The number has leading zeros: else 10 came before 9, and a form with these two would be another one, with a
        kernel of its own, than the same form with 8 and 9.
        """
        return f"Constant({self._ufl_domain!r}, {self._ufl_shape!r}, {self._count:012d})"

    @property
    def value(self) -> Any:
        """The value, float64 array of the constant's shape."""
        return self._value

    @value.setter
    def value(self, c: npt.ArrayLike) -> None:
        self._value[...] = c

    def __float__(self) -> float:
        return float(self._value)
