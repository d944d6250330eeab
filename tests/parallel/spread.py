"""Spaces for tests of solvers, on any communicator, and functions of them whatever the ranks."""

from collections.abc import Callable

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
from compared import shared
from zoo import ZOO

from thccs_fem import adapt, fem, generators
from thccs_fem.fem.space import FunctionSpace
from thccs_fem.mesh import ControlMesh

__all__ = ["CLOSED", "WITH_RIM", "by_number", "refined", "space", "whole"]

Maker = Callable[[MPI.Comm], ControlMesh]

CLOSED: dict[str, Maker] = {
    "torus": lambda comm: generators.torus((6, 4), comm=comm),
    "sphere": lambda comm: generators.cube_sphere(2, comm=comm),
    "few cells": lambda comm: generators.cube_sphere(1, comm=comm),
    "two parts": lambda comm: shared(ZOO["cube_and_torus"](), comm),
}
WITH_RIM: dict[str, Maker] = {
    "l domain": lambda comm: generators.l_domain(2, comm=comm),
    "wheel": lambda comm: generators.wheel(5, 2, comm=comm),
    "one cell": lambda comm: generators.rectangle((1, 1), comm=comm),
}


def space(make: Maker, comm: MPI.Comm, shape: tuple[int, ...] = ()) -> FunctionSpace:
    """Return a space with two refinements, if the mesh is not too small for that."""
    V = fem.functionspace(make(comm), ("THCCS", 3, shape))
    return V if V.num_functions < 30 else refined(refined(V))


def refined(V: FunctionSpace) -> FunctionSpace:
    return adapt.refine(V, [V.num_functions // 3, V.num_functions - 1])


def by_number(V: FunctionSpace, seed: int = 0) -> fem.Function:
    """Return a function with random coefficients, the same whatever the ranks."""
    f = fem.Function(V)
    values = np.random.default_rng(seed).uniform(-1.0, 1.0, (V.num_functions, V.block_size))
    f.x.array = values[V.index_map.numbers].ravel()
    return f


def whole(u: fem.Function) -> npt.NDArray[np.float64]:
    """Return the coefficients of a function in the order of a serial run; ghosts must be those of their owners."""
    values = u.x.array.copy()
    u.x.scatter_forward()
    np.testing.assert_array_equal(u.x.array, values)
    return u.x.index_map.gather(values.reshape(-1, u.x.block_size))
