"""Grading on several ranks: the faces of a serial run."""

from collections.abc import Callable

from mpi4py import MPI

import pytest
from compared import same_as_in_serial, shared
from zoo import ZOO

from thccs_fem import adapt, fem, generators
from thccs_fem.mesh import ControlMesh

MESHES: dict[str, Callable[[MPI.Comm], ControlMesh]] = {
    "wheel": lambda comm: generators.wheel(8, 2, comm=comm),
    "closed": lambda comm: generators.trapezohedron(5, 2, comm=comm),
    "rim": lambda comm: shared(ZOO["rim_of_four"](), comm),
    "polygons": lambda comm: shared(ZOO["polygons"](), comm),
}


@pytest.mark.parametrize("subdivided", [0, 1])
@pytest.mark.parametrize("make", MESHES.values(), ids=MESHES)
def test_the_same_cells_are_refined(make: Callable[[MPI.Comm], ControlMesh], subdivided: int) -> None:
    def work(comm: MPI.Comm) -> dict[str, object]:
        V = adapt.grade_extraordinary(fem.functionspace(make(comm), ("THCCS", 3)), 1, subdivided=subdivided)
        keys = {f"level {level}": keys for level, keys in enumerate(V.hierarchy.refined_keys)}
        return {**keys, "dofs": V.num_dofs, "cells": V.num_cells}

    same_as_in_serial(work)


def test_fitted_meshes_are_the_same() -> None:
    same_as_in_serial(
        lambda comm: generators.fitted(generators.trapezohedron(5, 2, comm=comm), lambda x: x / (x**2).sum(0)).vertices
    )
