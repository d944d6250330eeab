"""Dofs of several unknowns on several ranks: which are owned, what PETSc calls them, and how values get to ghosts."""

from mpi4py import MPI

import numpy as np
import pytest
from spread import WITH_RIM, refined, space

from thccs_fem import fem
from thccs_fem.fem.layout import Layout
from thccs_fem.fem.space import FunctionSpace
from thccs_fem.parallel import gathered, total


@pytest.fixture(params=["one", "same hierarchy", "two hierarchies", "one cell"])
def layout(request: pytest.FixtureRequest, comm: MPI.Comm) -> Layout:
    V = space(WITH_RIM["one cell" if request.param == "one cell" else "l domain"], comm)
    if request.param == "one":
        return Layout((V,))
    finer = V.hierarchy if request.param == "same hierarchy" else refined(V).hierarchy
    return Layout((V, FunctionSpace(finer, (2,))))


def marks(layout: Layout) -> np.ndarray:
    """Return a number for each local dof that tells space, function and component, whoever owns it."""
    result = np.zeros(layout.num_local)
    for i, (V, places) in enumerate(zip(layout.spaces, layout.places, strict=True)):
        numbers = layout.index_maps[i].numbers
        result[places] = (i * 1e6 + V.block_size * numbers[:, None] + np.arange(V.block_size)).ravel()
    return result


def test_ghosts_get_what_their_owners_have(layout: Layout) -> None:
    expected = marks(layout)
    np.testing.assert_array_equal(layout.with_ghosts(expected[: layout.num_owned]), expected)
    both = np.stack([expected, -expected], axis=1)
    np.testing.assert_array_equal(layout.with_ghosts(both[: layout.num_owned]), both)


def test_contributions_go_the_other_way(layout: Layout, comm: MPI.Comm) -> None:
    """One map is the transpose of the other."""
    rng = np.random.default_rng(comm.rank)
    x, y = rng.standard_normal(layout.num_owned), rng.standard_normal(layout.num_local)
    one, other = layout.with_ghosts(x) @ y, x @ layout.without_ghosts(y)
    size = total(comm, float(np.abs(y).sum()))
    assert total(comm, float(one)) == pytest.approx(total(comm, float(other)), abs=1e-13 * size)


def test_numbers_are_those_of_petsc(layout: Layout, comm: MPI.Comm) -> None:
    """Rank after rank, each dof has but one; ghosts have their owners'."""
    numbering = layout.numbering
    assert numbering is not None
    begin, end = numbering.starts[comm.rank : comm.rank + 2]
    np.testing.assert_array_equal(numbering.numbers[: layout.num_owned], np.arange(begin, end))
    ghosts = numbering.numbers[layout.num_owned :]
    assert (np.diff(ghosts) > 0).all()
    assert not ((begin <= ghosts) & (ghosts < end)).any()
    assert layout.num_dofs == sum(V.num_dofs for V in layout.spaces) == total(comm, layout.num_owned)
    of_all = gathered(comm, marks(layout)[: layout.num_owned])
    np.testing.assert_array_equal(of_all[numbering.numbers], marks(layout))


def test_ghosts_are_prescribed_where_their_owners_are(layout: Layout, comm: MPI.Comm) -> None:
    """Whatever a rank knows of its ghosts."""
    V = layout.spaces[-1]
    functions = fem.boundary_dofs(V)
    functions = functions[functions < V.index_map.size_local]
    bc = fem.dirichletbc(1.0 + V.index_map.numbers[functions], functions, V.sub(1) if V.value_shape else V)
    dofs, values = layout.constraints([bc])
    found = np.zeros(layout.num_local)
    found[dofs] = values
    assert (np.diff(dofs) > 0).all()
    assert np.count_nonzero(found[: layout.num_owned]) == functions.size
    np.testing.assert_array_equal(layout.with_ghosts(found[: layout.num_owned]), found)
    assert total(comm, functions.size) > 0
