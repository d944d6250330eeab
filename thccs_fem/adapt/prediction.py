"""Refinement by several levels at once, where indicators say what those of the parts will be.

Where a function is refined the indicators of its cells fall by a power of the size: by that of the theory where the
solution is smooth, by less at a singularity, where the power can be seen once something was refined there.  With these
*rates* the indicators of a refinement can be predicted (Melenk and Wohlmuth, Adv. Comput. Math. 15, 2001, who choose
between h and p by them), and what would be marked next can be refined before anything is solved.

Indicators must be local for that: small where the mesh is fine, whatever it is elsewhere.  Residuals are.  The error
itself is not: in L2 most of it can come from a corner far away, and falls where nothing was refined.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from thccs_fem.adapt.marking import TIE, in_turn, on_all_cells, until_carried
from thccs_fem.fem.space import FunctionSpace, check_space
from thccs_fem.hierarchy import Hierarchy
from thccs_fem.sparse import csr, entries, product, rows_of, transposed
from thccs_fem.subdivision import Ints

__all__ = ["MarkingAhead", "Prediction", "predict"]

LEAST_RATE = 0.25  # something is gained by each refinement, or there would be no end to it
MOST_ROUNDS = 8  # levels by which one step refines at the most

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Prediction:
    """Indicators in a space, and the rates at which they fall where cells are refined; make one with `predict`.

    Attributes:
        V: The space.
        eta: Indicator of each cell of the hierarchy, the same on all ranks, shape (num_cells,).
        rates: r, where those of all parts of the cell, k levels finer, have the norm 2^(-r k) eta; shape (num_cells,).
    """

    V: FunctionSpace
    eta: Floats
    rates: Floats

    def refined(self, reduction: float = 0.3, theta: float = 0.8) -> FunctionSpace:
        """Return the space refined until the predicted estimate is small enough; collective.

        In rounds, each of which marks functions by Doerfler's rule with the predicted indicators, and refines.

        Args:
            reduction: What the predicted estimate may be, relative to the present one, in (0, 1).
            theta: What the marked functions carry of the sum of squares in each round, in (0, 1].

        Raises:
            ValueError: If an argument is out of range.
        """
        _check_shares(reduction, theta)
        hierarchy, squares = self.V.hierarchy.outlined(), self.eta**2
        least = reduction**2 * squares.sum() * (1.0 + TIE)
        for _ in range(MOST_ROUNDS):
            if squares.sum() <= least:
                break
            finer = hierarchy.refined(_marked(hierarchy, squares, theta))
            if finer is hierarchy:
                break
            hierarchy, squares = finer, self._squares_on(finer)
        is_same = hierarchy.refined_keys is self.V.hierarchy.refined_keys
        return self.V if is_same else self.V.with_hierarchy(hierarchy.completed())

    def _squares_on(self, hierarchy: Hierarchy) -> Floats:
        """Return the squares of the predicted indicators of a refinement, where children of a cell share evenly."""
        cell, levels = _cells_around(self.V.hierarchy, hierarchy)
        return (self.eta[cell] * 2.0 ** (-(self.rates[cell] + 1.0) * levels)) ** 2


def predict(
    V: FunctionSpace, eta: npt.ArrayLike, before: Prediction | None = None, *, order: float = 3.0
) -> Prediction:
    """Return what is to be expected of the indicators when V is refined; collective.

    Args:
        V: The space.
        eta: Indicator of each cell that this rank owns, not squared, shape (cells.num_owned,).
        before: The prediction in the space that V was refined from, which shows how fast indicators fall; None: they
            are taken for those of a smooth solution.
        order: Order of convergence in the norm that is estimated, for smooth solutions: 3 in H1, 4 in L2. Rates are
            never larger.

    Raises:
        TypeError: If V is no space of splines, or `before` no prediction.
        ValueError: If eta does not fit the cells or is negative or not finite, or the order is no more than 0.25,
            or V is no refinement of the space before.
    """
    check_space(V, "prediction")
    if not isinstance(before, Prediction | None):
        raise TypeError(f"before is of type {type(before).__name__}: give what predict has returned, or None")
    _check_order(order)
    of_cells = on_all_cells(V, eta)
    rates = np.full(of_cells.size, float(order))
    if before is not None:
        if not V.hierarchy.is_refinement_of(before.V.hierarchy):
            raise ValueError(f"the prediction before was in {before.V}, which {V} does not refine: give None")
        cell, levels = _cells_around(before.V.hierarchy, V.hierarchy)
        finer = (levels > 0) & (before.eta[cell] > 0.0)
        fall = np.maximum(of_cells[finer] / before.eta[cell][finer], np.finfo(float).tiny)
        rates = before.rates[cell]
        rates[finer] = np.clip(-np.log2(fall) / levels[finer], LEAST_RATE, order)
    return Prediction(V, of_cells, rates)


class MarkingAhead:
    """The marking of a loop that refines by several levels a solution: `predict`, then `Prediction.refined`.

    It remembers the last prediction, for the rates. A run that goes on from a checkpoint does without, as at first.

    Args:
        order: See `predict`.
        reduction: See `Prediction.refined`.
        theta: See `Prediction.refined`.

    Raises:
        ValueError: If an argument is out of range.
    """

    def __init__(self, order: float = 3.0, reduction: float = 0.3, theta: float = 0.8):
        _check_order(order)
        _check_shares(reduction, theta)
        self._order, self._reduction, self._theta = order, reduction, theta
        self._last: Prediction | None = None

    def __call__(self, V: FunctionSpace, eta: Floats) -> FunctionSpace:
        """Return the refined space; collective."""
        last = self._last
        if last is not None and not V.hierarchy.is_refinement_of(last.V.hierarchy):  # of another run
            last = None
        self._last = predict(V, eta, last, order=self._order)
        return self._last.refined(self._reduction, self._theta)


def _check_order(order: float) -> None:
    if not order > LEAST_RATE:
        raise ValueError(f"order is {order}; give the order of convergence for smooth solutions, 3 in H1, 4 in L2")


def _check_shares(reduction: float, theta: float) -> None:
    for name, value in (("reduction", reduction), ("theta", theta)):
        if not (0.0 < value < 1.0 or (name == "theta" and value == 1.0)):
            raise ValueError(f"{name} is {value}; it must lie between 0 and 1")


def _cells_around(coarse: Hierarchy, fine: Hierarchy) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Return for each cell of a refinement the cell that it is or lies in, and how many levels coarser that is."""
    cell, levels = coarse.cells_around(*fine.cells)
    return cell, fine.cells[0] - levels


def _marked(hierarchy: Hierarchy, squares: Floats, theta: float) -> npt.NDArray[np.int64]:
    """Return the fewest functions, largest indicators first, whose units carry theta of the sum of squares."""
    cell, dof = _incidence(hierarchy)
    order, turn = in_turn(np.sqrt(np.bincount(dof, weights=squares[cell], minlength=hierarchy.num_dofs)))
    first = np.full(squares.size, order.size)
    begins = np.flatnonzero(np.diff(cell, prepend=-1))
    if begins.size:
        first[cell[begins]] = np.minimum.reduceat(turn[dof], begins)
    return until_carried(order, first, squares, theta)


def _incidence(hierarchy: Hierarchy) -> tuple[Ints, npt.NDArray[np.int64]]:
    """Return pairs of a cell and a function of its own level that would be refined together, sorted by cells.

    Functions of vertices alone: those of traces refine no more than that of their vertex.
    """
    stages = hierarchy.stages[: hierarchy.num_levels]
    first_vertex = np.cumsum([0, *(s.level.num_vertices for s in stages)], dtype=np.int32)
    first_face = np.cumsum([0, *(s.level.num_faces for s in stages)], dtype=np.int32)
    quads = np.concatenate([s.level.quads + v for s, v in zip(stages, first_vertex, strict=False)])
    indptr = np.arange(0, quads.size + 1, 4, dtype=np.int32)
    corners = csr(np.ones(quads.size), quads.ravel(), indptr, (len(quads), int(first_vertex[-1])))
    cells = np.concatenate([s.active_faces + f for s, f in zip(stages, first_face, strict=False)])
    of_cells = rows_of(corners, cells)
    if hierarchy.unit == "support":
        of_cells = product(product(of_cells, transposed(corners)), corners)
    numbers = []
    for stage, first in zip(stages, hierarchy.dof_offsets, strict=False):
        active = stage.active[: stage.level.num_vertices]
        numbers.append(np.where(active, first + np.cumsum(active) - 1, -1))
    cell, vertex, _ = entries(of_cells)
    dof = np.concatenate(numbers)[vertex]
    return cell[dof >= 0], dof[dof >= 0]
