"""Admissible hierarchies and rings on several ranks: the faces, marks and classes of a serial run."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
from compared import same_as_in_serial, shared
from zoo import ZOO

from thccs_fem import adapt, checkpoint, fem, generators
from thccs_fem.mesh import ControlMesh
from thccs_fem.partition import partition
from thccs_fem.regions import Unit

MESHES: dict[str, Callable[[MPI.Comm], ControlMesh]] = {
    "L-domain": lambda comm: generators.l_domain(3, comm=comm),
    "closed": lambda comm: generators.cube_sphere(3, comm=comm),
    "tripod": lambda comm: shared(ZOO["tripod"](), comm),
    "polygons": lambda comm: shared(ZOO["polygons"](), comm),
}
each_mesh = pytest.mark.parametrize("make", MESHES.values(), ids=MESHES)
each_rule = pytest.mark.parametrize(("unit", "m"), [("support", 2), ("ring", None), ("ring", 2), ("ring", 3)])


def keys(V: fem.FunctionSpace) -> dict[str, Any]:
    return {f"level {level}": keys for level, keys in enumerate(V.hierarchy.refined_keys)}


def estimated(V: fem.FunctionSpace, seed: int) -> np.ndarray:
    """Return indicators of the cells that this rank owns, by the cells' numbers."""
    cells = partition(V.hierarchy).cells
    eta = np.random.default_rng(seed).random(cells.size_global) ** 4
    return eta[cells.numbers[: cells.size_local]]


@each_rule
@each_mesh
def test_marks_and_faces_are_those_of_a_serial_run(
    make: Callable[[MPI.Comm], ControlMesh], unit: Unit, m: int | None
) -> None:
    def run(comm: MPI.Comm) -> list[dict[str, Any]]:
        V = fem.functionspace(make(comm), ("THCCS", 3), unit=unit, admissibility=m)
        found = []
        for step in range(4):
            eta = estimated(V, step)
            marked = [adapt.mark(V, eta, strategy) for strategy in ("worst", "maximum", "dorfler")]
            few = adapt.mark_coarsening(V, eta, theta=0.3)
            V = adapt.remesh(V, marked[2], few) if step == 3 else adapt.refine(V, marked[2][comm.rank :: comm.size])
            assert (V.hierarchy.unit, V.hierarchy.admissibility) == (unit, m)
            found.append({**{f"marked {i}": marks for i, marks in enumerate(marked)}, **keys(V)})
        return found

    same_as_in_serial(run)


def test_files_of_all_ranks_have_class_and_unit(comm: MPI.Comm, tmp_path: Path) -> None:
    folder = comm.bcast(tmp_path)
    V = adapt.refine(
        fem.functionspace(generators.l_domain(3, comm=comm), ("THCCS", 3), unit="ring", admissibility=2), [3]
    )
    checkpoint.write(folder / "u.h5", fem.Function(V, name="u"))
    found = checkpoint.read(folder / "u.h5", comm).functions["u"].function_space.hierarchy
    assert (found.unit, found.admissibility) == ("ring", 2)
    comm.Barrier()
