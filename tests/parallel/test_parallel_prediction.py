"""Predicted indicators on several ranks: the same refinement as in serial."""

from typing import Any

from mpi4py import MPI

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
