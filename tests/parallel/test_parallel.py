"""Sums and errors over ranks that are processes, and meshes, which every rank holds whole."""

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
from compared import assert_same, same_as_in_serial, shared
from zoo import ZOO

from thccs_fem import generators, io, limit, parallel, subdivision
from thccs_fem.mesh import ControlMesh


def the_same_on_all(comm: MPI.Comm, value: Any) -> bool:
    """Whether a value has the same bits on all ranks."""
    return len(set(comm.allgather(np.asarray(value).tobytes()))) == 1


def test_sums_have_the_same_bits_on_all_ranks(comm: MPI.Comm) -> None:
    values = np.random.default_rng(comm.rank).standard_normal((5, 3))
    all_values = np.array(comm.allgather(values))
    for found, expected in (
        (parallel.total(comm, values), all_values.sum(axis=0)),
        (parallel.total(comm, values[0, 0]), all_values[:, 0, 0].sum()),
        (parallel.largest(comm, values[0, 0]), all_values[:, 0, 0].max()),
        (parallel.smallest(comm, values[0, 0]), all_values[:, 0, 0].min()),
        (parallel.gathered(comm, values), all_values.reshape(-1, 3)),
        (parallel.gathered(comm, values[: comm.rank]), np.concatenate([v[:r] for r, v in enumerate(all_values)])),
    ):
        np.testing.assert_allclose(found, expected, rtol=1e-14)
        assert the_same_on_all(comm, found)


def test_error_of_the_last_rank_is_seen_by_all(comm: MPI.Comm) -> None:
    last = comm.size - 1

    def work() -> int:
        if comm.rank == last:
            raise FileNotFoundError(2, "no such file", "a.obj")
        return comm.rank

    with pytest.raises(FileNotFoundError) as caught:
        parallel.together(comm, work)
    assert str(caught.value) == f"rank {last} of {comm.size}: [Errno 2] no such file: 'a.obj'"
    assert parallel.together(comm, lambda: comm.rank) == comm.rank


def test_first_rank_works_for_all(comm: MPI.Comm, tmp_path: Path) -> None:
    done = []
    assert parallel.by_first_rank(comm, lambda: done.append(comm.rank) or "done") == "done"
    assert done == [0] * (comm.rank == 0)
    with pytest.raises(FileNotFoundError) as caught:
        parallel.by_first_rank(comm, (tmp_path / "missing").read_text)
    assert caught.value.errno == 2
    assert len(set(comm.allgather(str(caught.value)))) == 1


# Meshes

MAKERS: dict[str, Callable[[MPI.Comm], ControlMesh]] = {
    "torus": lambda comm: generators.torus((4, 3), comm=comm),
    "cube_sphere": lambda comm: generators.cube_sphere(2, comm=comm),
    "genus3": lambda comm: generators.genus3(comm=comm),
    "implicit_surface": lambda comm: generators.implicit_surface(
        lambda x: 0.7 - np.linalg.norm(x, axis=0), (6, 6, 6), comm=comm
    ),
    "wheel": lambda comm: generators.wheel(5, 2, comm=comm),
    "l_domain2": lambda comm: generators.l_domain2(comm=comm),
    "cylinder": lambda comm: generators.cylinder((5, 2), comm=comm),
    "interpolated": lambda comm: generators.interpolated(generators.hemisphere(2, comm=comm)),
    "subdivided polygons": lambda comm: subdivision.subdivided(shared(ZOO["polygons"](), comm), 2),
    **{name: lambda comm, make=make: shared(make(), comm) for name, make in ZOO.items()},  # type: ignore[misc]
}


@pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)
def test_meshes_are_those_of_a_serial_run(make: Callable[[MPI.Comm], ControlMesh]) -> None:
    def work(comm: MPI.Comm) -> list[Any]:
        msh = make(comm)
        assert msh.comm is comm
        corner = np.zeros(msh.num_faces, dtype=np.int32)
        points = limit.evaluate(msh, np.arange(msh.num_faces), np.full((msh.num_faces, 2), 0.3), 2, corner)
        tags = {str(pair): tag for pair, tag in msh.edge_tags.items()}
        return [msh.vertices, msh.face_vertices, msh.edge_faces, msh.face_tags, tags, points]

    same_as_in_serial(work, tol=0.0)


def test_each_rank_may_ask_for_other_points(comm: MPI.Comm) -> None:
    msh = generators.torus((5, 4), comm=comm)
    faces = np.arange(comm.rank, 20, 1 + comm.rank)
    x = limit.evaluate(msh, faces, np.full((faces.size, 2), 0.5), 0)
    np.testing.assert_array_equal(x, limit.evaluate(generators.torus((5, 4)), faces, np.full((faces.size, 2), 0.5), 0))


def test_files_are_read_by_rank_0(comm: MPI.Comm, folder: Path) -> None:
    path = folder / "square.off"
    if comm.rank == 0:
        path.write_text("OFF 4 1 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 3\n")
    msh = io.read_mesh(path, comm)
    assert (msh.num_faces, msh.comm) == (1, comm)
    if comm.rank == 0:
        path.write_text("OFF 4 1 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 3 2 1\n")
    with pytest.raises(ValueError, match=r"square\.off: all 1 faces are clockwise; .*orient=True\)"):
        io.read_mesh(path, comm)
    comm.barrier()
    assert io.read_mesh(path, comm, orient=True).num_faces == 1
    with pytest.raises(FileNotFoundError, match="missing"):
        io.read_mesh(folder / "missing.obj", comm)


def test_bad_mesh_of_one_rank_is_bad_for_all(comm: MPI.Comm) -> None:
    points = [(0, 0), (1, 0), (1, 1), (0, 1)]
    for bad in range(comm.size):
        face = (0, 1, 2, 3) if comm.rank != bad else (0, 3, 2, 1)
        with pytest.raises(ValueError, match=f"^rank {bad} of {comm.size}: all 1 faces are clockwise"):
            ControlMesh(points, [face], comm=comm)
    with pytest.raises(ValueError, match=r"^rank 1 of \d gives a mesh with other vertices, face_tags than rank 0"):
        ControlMesh(np.multiply(points, 1 + (comm.rank == 1)), [(0, 1, 2, 3)], [int(comm.rank == 1)], comm=comm)


def test_rank_0_warns_for_all(comm: MPI.Comm) -> None:
    points = [(0, 0), (1, 0), (1, 1), (0, 1), (1, 0), (2, 0), (2, 1), (1, 1)]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        ControlMesh(points, [(0, 1, 2, 3), (4, 5, 6, 7)], comm=comm)
    assert [str(w.message)[:30] for w in caught] == ["boundary vertices (1, 4), (2, 7)"[:30]] * (comm.rank == 0)


def test_some_of_the_ranks_may_have_a_mesh(comm: MPI.Comm) -> None:
    part = comm.Split(comm.rank % 2)
    msh = generators.torus((3 + comm.rank % 2, 3), comm=part)
    assert msh.num_faces == 9 + 3 * (comm.rank % 2)
    part.Free()


# The harness


def test_differences_are_found() -> None:
    result = {"x": [np.arange(3.0), np.arange(3)], "name": "one"}
    assert_same(result, result, 0.0)
    assert_same({"x": [np.arange(3.0) + 1e-11, np.arange(3)], "name": "one"}, result, 1e-10)
    for other in (
        {"x": [np.arange(3.0) + 1e-9, np.arange(3)], "name": "one"},
        {"x": [np.arange(3.0), np.arange(3) + 1], "name": "one"},
        {"x": [np.arange(3.0)], "name": "one"},
        {"x": [np.arange(4.0), np.arange(3)], "name": "one"},
        {"x": [np.arange(3.0), np.arange(3)], "name": "two"},
        {"y": [np.arange(3.0), np.arange(3)], "name": "one"},
    ):
        with pytest.raises(AssertionError):
            assert_same(other, result, 1e-10)
