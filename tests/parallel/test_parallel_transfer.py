"""Functions carried from one hierarchy to another, whose parts on the ranks differ."""

from collections.abc import Callable
from typing import Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
import pytest
import scipy.sparse as sp
from compared import same_as_in_serial, shared
from spread import whole
from zoo import ZOO

import ufl
from thccs_fem import adapt, fem, generators
from thccs_fem.fem import mass
from thccs_fem.fem.space import FunctionSpace
from thccs_fem.parallel import total
from thccs_fem.partition import partition
from thccs_fem.prolongation import Prolongation

Floats = npt.NDArray[np.float64]

MESHES: dict[str, Callable[[], Any]] = {
    "wheel5": ZOO["wheel5"],
    "polygons": ZOO["polygons"],
    "tube": lambda: generators.torus((24, 4)),  # long enough that no rank holds all of it
}
SEVERAL = pytest.mark.parametrize("name", MESHES)
TOLERANCE = 1e-11  # if iterated, residuals of 1e-14, condition numbers of some hundred; else matrices are factorised


def coarsest(comm: MPI.Comm, name: str, shape: tuple[int, ...] = ()) -> FunctionSpace:
    return fem.functionspace(shared(MESHES[name](), comm), ("THCCS", 3, shape), cap_level=6)


def refined(V: FunctionSpace, seed: int, times: int = 3) -> FunctionSpace:
    rng = np.random.default_rng(seed)
    for _ in range(times):
        V = adapt.refine(V, rng.choice(V.num_functions, 2, replace=False))
    return V


def some_function(V: FunctionSpace) -> fem.Function:
    u, k = fem.Function(V, "u"), V.block_size
    u.x.array = np.sin(k * V.index_map.numbers[:, None] + np.arange(k)).ravel()
    return u


def integral(u: fem.Function) -> float:
    return total(u.function_space.mesh.comm, fem.assemble_scalar(fem.form(u * ufl.dx)))


@SEVERAL
def test_into_refinements_it_is_exact(name: str) -> None:
    def carried(comm: MPI.Comm) -> list[Floats]:
        V = coarsest(comm, name, shape=(2,))
        W = refined(V, seed=1)
        u = some_function(V)
        rng = np.random.default_rng(0)
        faces = rng.integers(0, V.mesh.num_faces, 20)
        corner = None if V.mesh.is_quad else rng.integers(0, V.mesh.face_sizes[faces])
        at = faces, rng.random((20, 2)), corner
        fine = adapt.transfer(u, W)
        np.testing.assert_allclose(fine.eval(*at), u.eval(*at), atol=1e-13)
        assert fine.name == "u"
        return [whole(fine), whole(adapt.transfer(u, W, conserve=True)), whole(adapt.transfer(u, V))]

    same_as_in_serial(carried, tol=1e-13)


@pytest.mark.parametrize(
    ("name", "small"), [*((name, mass.SMALL) for name in MESHES), ("wheel5", 0)], ids=[*MESHES, "wheel5, iterated"]
)
@pytest.mark.parametrize("norm", ["L2", "H1"])
def test_to_coarser_and_to_other_hierarchies(norm: Any, name: str, small: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mass, "SMALL", small)

    def carried(comm: MPI.Comm) -> list[Floats]:
        V = coarsest(comm, name)
        U, W = refined(V, seed=1), refined(V, seed=2)
        u = some_function(U)
        return [
            whole(adapt.transfer(u, V, norm)),
            whole(adapt.transfer(u, W, norm)),
            whole(adapt.transfer(u, W, norm, conserve=True)),
        ]

    same_as_in_serial(carried, tol=TOLERANCE)


def test_of_vectors() -> None:
    def carried(comm: MPI.Comm) -> Floats:
        V = coarsest(comm, "wheel5", shape=(2,))
        return whole(adapt.transfer(some_function(refined(V, seed=1)), refined(V, seed=2), conserve=True))

    same_as_in_serial(carried, tol=TOLERANCE)


def test_what_lies_in_the_other_space_stays(comm: MPI.Comm) -> None:
    V = coarsest(comm, "tube")
    u = some_function(V)
    fine = adapt.transfer(u, refined(V, seed=1))
    np.testing.assert_allclose(adapt.transfer(fine, V).x.array, u.x.array, atol=1e-11)


@pytest.mark.parametrize("norm", ["L2", "H1"])
def test_integrals_stay(norm: Any, comm: MPI.Comm) -> None:
    V = coarsest(comm, "tube")
    u = some_function(refined(V, seed=1))
    area = total(comm, fem.assemble_scalar(fem.form(fem.Constant(V.mesh, 1.0) * ufl.dx)))
    for W in (V, refined(V, seed=2), refined(u.function_space, seed=3)):
        kept = adapt.transfer(u, W, norm, conserve=True)
        assert abs(integral(kept) - integral(u)) < 1e-14 * area  # values are at most 1


def test_after_coarsening_and_refining_time_and_again() -> None:
    def carried(comm: MPI.Comm) -> list[Floats]:
        V = refined(coarsest(comm, "tube"), seed=0)
        u = some_function(V)
        found = []
        for step in range(4):
            numbers = V.cells.partition.cells.numbers[: V.cells.num_owned]
            W = adapt.remesh(V, [step, V.num_functions - 1], np.flatnonzero(numbers % 3 != 0))
            u, V = adapt.transfer(u, W, conserve=True), W
            found.append(whole(u))
        return found

    same_as_in_serial(carried)


# ---- Prolongations


@pytest.mark.parametrize("name", MESHES)
def test_prolongations_have_the_rows_of_the_whole_matrix(name: str, comm: MPI.Comm) -> None:
    V = coarsest(comm, name)
    for coarse in (V, refined(V, seed=1, times=1)):
        fine = refined(coarse, seed=2)
        P = fine.hierarchy.prolongation(coarse.hierarchy)
        here = Prolongation(fine.hierarchy, coarse.hierarchy)
        rows = sp.csr_array(P[fine.index_map.numbers])
        np.testing.assert_array_equal(here.wanted, np.unique(rows.indices))
        assert abs(here.matrix - rows[:, here.wanted]).max() == 0.0
        load = np.sin(np.arange(2 * fine.num_functions)).reshape(-1, 2)
        back = coarse.index_map.gather(here.transposed(load[fine.index_map.numbers]))
        np.testing.assert_allclose(back, P.T @ load, atol=1e-13)


def test_prolongations_of_spaces_are_those_of_a_serial_run() -> None:
    def matrix(comm: MPI.Comm) -> Floats:
        V = coarsest(comm, "wheel5", shape=(2,))
        return refined(V, seed=1).prolongation(V).toarray()

    same_as_in_serial(matrix, tol=0.0)


def test_parts_of_both_hierarchies_differ(comm: MPI.Comm) -> None:
    # Else nothing here would travel.
    V = coarsest(comm, "tube")
    assert partition(V.hierarchy).cells.numbers.size < V.num_cells
    near_one_end = np.argsort(V.hierarchy.points[0][:, 0], kind="stable")[:4]
    W = adapt.refine(V, near_one_end)
    local = V.index_map.local_of(Prolongation(W.hierarchy, V.hierarchy).wanted)
    assert total(comm, int(np.count_nonzero(local < 0))) > 0


def test_errors(comm: MPI.Comm) -> None:
    V, W = coarsest(comm, "tube"), coarsest(comm, "wheel5")
    with pytest.raises(ValueError, match="the hierarchies have no common refinement"):
        adapt.transfer(some_function(V), W)
    with pytest.raises(ValueError, match="the spaces are not nested"):
        Prolongation(V.hierarchy, refined(V, seed=1).hierarchy)
