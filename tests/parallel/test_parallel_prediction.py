"""Predicted indicators on several ranks: the same refinement as in serial."""

from typing import Any

from mpi4py import MPI

import pytest
from compared import same_as_in_serial

from thccs_fem import adapt, fem, generators
from thccs_fem.partition import partition


def steps(comm: MPI.Comm) -> list[Any]:
    """Return the keys and rates of some steps, driven by indicators that are large at one cell of each level."""
    V = fem.functionspace(generators.wheel(5, 3, comm=comm), ("THCCS", 3))
    before, found = None, []
    for _ in range(3):
        cells = partition(V.hierarchy).cells
        number = cells.numbers[: cells.size_local]
        eta = 10.0 ** -(1.0 + number % 7) * 2.0 ** -V.cells.level[: cells.size_local]
        before = adapt.predict(V, eta, before)
        V = before.refined(reduction=0.4, theta=0.6)
        found += [before.eta, before.rates, *V.hierarchy.refined_keys]
    return found


def test_refinement_by_predictions_is_that_of_a_serial_run() -> None:
    found = same_as_in_serial(steps)
    assert len(found) > 9


def ahead(comm: MPI.Comm) -> list[Any]:
    """Return dofs and keys of a loop that marks ahead."""
    V = fem.functionspace(generators.wheel(5, 2, comm=comm), ("THCCS", 3))

    def estimator(u: fem.Function) -> Any:
        cells = partition(u.function_space.hierarchy).cells
        return 10.0 ** -(1.0 + cells.numbers[: cells.size_local] % 5)

    rule = adapt.MarkingAhead(reduction=0.5)
    history = adapt.solve(V, fem.Function, estimator, marking=rule, stop=adapt.Stop(steps=2), progress=False)
    return [history["dofs"], *history.solution.function_space.hierarchy.refined_keys]


def test_a_loop_that_marks_ahead_is_that_of_a_serial_run() -> None:
    same_as_in_serial(ahead)


def test_a_space_on_some_ranks_alone_is_refused(comm: MPI.Comm) -> None:
    V = fem.functionspace(generators.wheel(5, 2, comm=comm), ("THCCS", 3))

    def marking(V: fem.FunctionSpace, eta: Any) -> Any:
        W = adapt.refine(V, [0])
        return W if comm.rank else [0]

    def ones(u: fem.Function) -> Any:
        return [1.0] * partition(u.function_space.hierarchy).cells.size_local

    with pytest.raises(ValueError, match="a space on some ranks, functions on others"):
        adapt.solve(V, fem.Function, ones, marking=marking, stop=adapt.Stop(steps=1), progress=False)
