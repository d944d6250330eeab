"""Values of UFL expressions, or of plain functions g(x), at points of the pieces."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

import ufl
import ufl.algorithms
from thccs_fem import jit
from thccs_fem.extraction import evaluate_pieces
from thccs_fem.fem.function import Constant, Function
from thccs_fem.fem.space import CellwiseSpace, FunctionSpace
from thccs_fem.parallel import together
from thccs_fem.subdivision import Ints

__all__ = ["Expression", "ValueOrExpression", "values_at"]

Floats = npt.NDArray[np.float64]
ValueOrExpression = ufl.core.expr.Expr | Callable[[Floats], npt.ArrayLike] | Floats | float


class Expression:
    """A UFL expression compiled for points of the reference square.

    Args:
        expression: In Functions, Constants and the spatial coordinate; no arguments.
        points: Points in [0, 1]^2, the same on every piece, shape (m, 2).

    Raises:
        ValueError: If the expression has arguments.
    """

    def __init__(self, expression: ufl.core.expr.Expr, points: npt.ArrayLike):
        if ufl.algorithms.extract_arguments(expression):
            raise ValueError(f"an expression with test or trial functions has no values: {expression}")
        self.points = np.ascontiguousarray(points, dtype=np.float64)
        self.value_shape = expression.ufl_shape
        self._compiled, self._module = jit.compile_expression(expression, self.points)
        coefficients = ufl.algorithms.extract_coefficients(expression)
        positions = self._compiled.original_coefficient_positions
        self._coefficients: list[Function] = [
            coefficients[positions[i]] for i in range(self._compiled.num_coefficients)
        ]
        self._constants: list[Constant] = ufl.algorithms.analysis.extract_constants(expression)

    def eval(self, V: FunctionSpace, pieces: Ints) -> Floats:
        """Evaluate on pieces of V, whose hierarchy must be that of Functions in the expression or finer; collective.

        Args:
            V: The space.
            pieces: Numbers of its pieces, local: each rank may ask for others, also for none.

        Returns:
            Shape (pieces, m, components).

        Raises:
            ValueError: If a Function lives in a space that V does not refine.
        """
        all_local = [_local(u, V) for u in self._coefficients]
        local = [of_pieces[pieces].reshape(pieces.size, int(np.prod(of_pieces.shape[1:]))) for of_pieces in all_local]
        w = np.concatenate([np.zeros((pieces.size, 0)), *local], axis=1)
        c = np.concatenate([np.zeros(0), *(constant.value.ravel() for constant in self._constants)])
        x = np.zeros((pieces.size, 16, 3))
        x[:, :, : V.mesh.gdim] = V.cells.piece_points[pieces]
        values = np.zeros((pieces.size, len(self.points), int(np.prod(self.value_shape, dtype=int))))
        module = jit.library()
        pointers = [module.ffi.from_buffer("double[]", np.ascontiguousarray(a)) for a in (w, c, x)]
        kernel = module.ffi.cast(
            "thccs_kernel *", int(self._module.ffi.cast("uintptr_t", self._compiled.tabulate_tensor_float64))
        )
        module.lib.thccs_tabulate(
            kernel,
            pieces.size,
            values[:1].size if pieces.size else 0,
            w.shape[1],
            *pointers,
            module.ffi.from_buffer("double[]", values, require_writable=True),
        )
        return values


def _local(u: Function, V: FunctionSpace) -> Floats:
    """Return the coefficients of u on the pieces of V, shape (num_pieces, 16, block_size).

    Or (num_pieces, 1, block_size) if u is constant on each cell.
    """
    local = u.local_coefficients(V)
    return local[:, :1] if isinstance(u.ufl_function_space(), CellwiseSpace) else local


def values_at(value: ValueOrExpression, V: FunctionSpace, pieces: Ints, points: Floats, k: int) -> Floats:
    """Return values with k components at reference points of pieces; collective.

    Args:
        value: UFL expression, or callable g(x) with x of shape (3, n) that returns (n,) or (k, n).
        V: The space whose pieces are meant.
        pieces: Pieces, shape (n,), local.
        points: Points in [0, 1]^2, shape (m, 2).
        k: Components.

    Returns:
        Shape (n, m, k).

    Raises:
        ValueError: If the value has another number of components.
    """
    if isinstance(value, ufl.core.expr.Expr):
        expression = Expression(value, points)
        if int(np.prod(expression.value_shape, dtype=int)) != k:
            raise ValueError(f"the expression has shape {expression.value_shape}; {k} components are needed")
        return expression.eval(V, pieces)
    if not callable(value):
        raise TypeError(f"a UFL expression or a function g(x) is needed, got {type(value).__name__}")
    piece = np.repeat(pieces, len(points))
    x = np.zeros((3, piece.size))
    x[: V.mesh.gdim] = evaluate_pieces(V.cells.piece_points, piece, np.tile(points, (pieces.size, 1))).T
    values = together(V.mesh.comm, lambda: _called(value, x, k))
    return np.ascontiguousarray(np.broadcast_to(values, (k, piece.size)).T).reshape(pieces.size, len(points), k)


def _called(value: Callable[[Floats], npt.ArrayLike], x: Floats, k: int) -> Floats:
    """Return g(x), shape (n,) or (k, n)."""
    values = np.asarray(value(x), dtype=np.float64)
    n = x.shape[1]
    if values.shape not in ((n,), (k, n)):
        raise ValueError(
            f"g(x) returned shape {values.shape} for x of shape {x.shape}; it must return ({n},) or ({k}, {n})"
        )
    return values
