"""What a rank may ask by itself: no other rank hears of it, and none is waited for."""

from typing import Any

from mpi4py import MPI

import pytest

import ufl
from thccs_fem import adapt, fem, generators
from ufl import TestFunction, TrialFunction, dx


@pytest.fixture
def names(comm: MPI.Comm) -> dict[str, Any]:
    msh = generators.torus((6, 4), comm=comm)
    V = fem.functionspace(msh, ("THCCS", 3))
    W = adapt.refine(V, [3, 4])
    vectors = fem.functionspace(msh, ("THCCS", 3, (3,)))
    u = fem.Function(W)
    return {"msh": msh, "V": V, "W": W, "vectors": vectors, "u": u, "D": fem.cellwise(W), "v": TestFunction(W)}


@pytest.mark.parametrize(
    "what",
    [
        "repr(msh), repr(V), repr(W), repr(u), repr(D)",
        "W == V, hash(W), W.ufl_domain(), vectors.sub(0)",
        "W.num_dofs, W.num_cells, W.num_functions, W.num_levels, W.num_local_dofs, W.num_owned_dofs, D.num_dofs",
        "W.index_map.local_range, W.index_map.ghosts, W.index_map.owners, W.index_map.numbers",
        "W.cells.num_cells, W.cells.level, W.cells.partition.imbalance",
        "u.copy(), u.x.array.max(), fem.Constant(msh, 1.0), fem.Function(W)",
        "fem.assemble_scalar(fem.form(u**2 * dx + u * ufl.dS))",
        "fem.assemble_vector(fem.form(v * dx))",
        "fem.assemble_matrix(fem.form(v * TrialFunction(W) * dx))",
        "fem.assemble_cells(fem.form(u**2 * dx))",
    ],
)
@pytest.mark.parametrize("rank", [0, 1])
def test_one_rank_looks_alone(names: dict[str, Any], comm: MPI.Comm, rank: int, what: str) -> None:
    if comm.rank == rank:
        eval(what, {**names, "fem": fem, "ufl": ufl, "dx": dx, "TrialFunction": TrialFunction})
    # All have this behind them in the same order: had the rank waited above, it would not have come here.
    assert comm.allreduce(1) == comm.size
