"""Checkpoints do not know how many ranks wrote them, and any number reads them back to the bit."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mpi4py import MPI

import h5py
import numpy as np
import pytest

from thccs_fem import adapt, checkpoint, fem, generators
from thccs_fem.fem.space import CellwiseSpace, FunctionSpace
from thccs_fem.mesh import ControlMesh

MESHES = {
    "plane": lambda comm: _on(generators.rectangle((4, 3)), comm),
    "closed": lambda comm: _on(generators.cube_sphere(2), comm),
    "one cell": lambda comm: _on(generators.rectangle((1, 1)), comm),  # most ranks own nothing
}


def _on(msh: ControlMesh, comm: MPI.Comm) -> ControlMesh:
    """Return the mesh on some ranks, with a tag."""
    edge = tuple(msh.edges[0].tolist())
    return ControlMesh(msh.vertices, msh.quads, edge_tags={edge: 3}, corners=msh.corners, comm=comm)


@pytest.fixture
def folder(comm: MPI.Comm, tmp_path: Path) -> Path:
    """That of rank 0, on all ranks."""
    return comm.bcast(tmp_path)


@pytest.fixture(params=[1, 2, 3])
def group(request: pytest.FixtureRequest, comm: MPI.Comm) -> Iterator[MPI.Comm]:
    """The first few ranks, and those that are left, for themselves."""
    if request.param > comm.size:
        pytest.skip(f"there are {comm.size} ranks")
    part = comm.Split(comm.rank >= request.param)
    yield part
    part.Free()


def by_number(V: FunctionSpace | CellwiseSpace, name: str) -> fem.Function:
    """Return a function with other values everywhere, the same whatever the ranks."""
    u = fem.Function(V, name)
    rows = np.random.default_rng(len(name)).uniform(-1.0, 1.0, (u.x.index_map.size_global, V.block_size))
    u.x.array = rows[u.x.index_map.numbers].ravel()
    return u


def some_functions(msh: ControlMesh) -> list[fem.Function]:
    V = fem.functionspace(msh, ("THCCS", 3))
    finer = adapt.refine(V, [2])
    finer = adapt.refine(finer, [finer.num_functions - 1])
    spaces = [V, finer, FunctionSpace(V.hierarchy, (2,)), fem.cellwise(finer, (3,)), fem.functionspace(msh, ("DG", 0))]
    return [by_number(space, "ü" * (k + 1)) for k, space in enumerate(spaces)]


def write_alone(path: Path, make_mesh: Any, comm: MPI.Comm) -> None:
    """Let rank 0 write by itself what all would."""
    if comm.rank == 0:
        checkpoint.write(path, some_functions(make_mesh(None)), {"step": 3, "x": np.arange(3)})
    comm.Barrier()


@pytest.mark.parametrize("name", MESHES)
def test_the_file_is_that_of_one_rank(name: str, comm: MPI.Comm, folder: Path) -> None:
    functions = some_functions(MESHES[name](comm))
    write_alone(folder / "alone.h5", MESHES[name], comm)
    checkpoint.write(folder / "together.h5", functions, {"step": 3, "x": np.arange(3)})
    if h5py.get_config().mpi:  # these write where they please
        alone = checkpoint.read(folder / "alone.h5").functions
        for key, u in checkpoint.read(folder / "together.h5").functions.items():
            np.testing.assert_array_equal(u.x.array, alone[key].x.array)
    else:
        assert (folder / "together.h5").read_bytes() == (folder / "alone.h5").read_bytes()
    assert sorted(file.name for file in folder.iterdir()) == ["alone.h5", "together.h5"]


@pytest.mark.parametrize("name", MESHES)
def test_any_ranks_read_it_to_the_bit(
    name: str, comm: MPI.Comm, folder: Path, group: MPI.Comm, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(checkpoint, "SLAB", 5)  # some of which have nothing for a rank
    checkpoint.write(folder / "run.h5", some_functions(MESHES[name](comm)), {"step": 3})
    saved = checkpoint.read(folder / "run.h5", group)
    assert saved.mesh.comm is group
    assert saved.attributes == {"step": 3}
    expected = some_functions(MESHES[name](group))
    assert dict(saved.mesh.edge_tags) == dict(expected[0].function_space.mesh.edge_tags)
    assert list(saved.functions) == [u.name for u in expected]
    for u in expected:
        found = saved.functions[u.name]
        np.testing.assert_array_equal(found.x.index_map.numbers, u.x.index_map.numbers)
        np.testing.assert_array_equal(found.x.array, u.x.array)  # ghosts, too
    again = checkpoint.read(folder / "run.h5", mesh=expected[0].function_space.mesh)
    assert [again.functions[u.name].function_space == u.function_space for u in expected] == [True] * len(expected)


def test_what_is_owned_is_written_whatever_ghosts_say(comm: MPI.Comm, folder: Path) -> None:
    u = by_number(fem.functionspace(_on(generators.torus((6, 6)), comm), ("THCCS", 3)), "u")
    expected = u.x.array.copy()
    u.x.array[u.x.index_map.size_local :] = np.nan
    checkpoint.write(folder / "run.h5", u)
    np.testing.assert_array_equal(checkpoint.read(folder / "run.h5", comm).functions["u"].x.array, expected)


def test_all_ranks_know_what_rank_0_could_not_read(comm: MPI.Comm, folder: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"none\.h5"):
        checkpoint.read(folder / "none.h5", comm)
    if comm.rank == 0:
        (folder / "none.h5").write_bytes(b"nothing")
    with pytest.raises(ValueError, match=r"none\.h5 is no checkpoint: it is no HDF5 file"):
        checkpoint.read(folder / "none.h5", comm)


def test_all_ranks_know_what_one_could_not_read(comm: MPI.Comm, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object) -> None:
        raise OSError("no such node")

    checkpoint.write(folder / "run.h5", some_functions(MESHES["plane"](comm)))
    if comm.rank == comm.size - 1:
        monkeypatch.setattr(checkpoint, "_values_of", fails)
    expected = f"rank {comm.size - 1} of {comm.size}: no such node" if comm.size > 1 else "no such node"
    with pytest.raises(OSError, match=expected):
        checkpoint.read(folder / "run.h5", comm)


@pytest.mark.parametrize("step", ["_begin", "_put_rows", "_finish"])
def test_all_ranks_know_what_rank_0_could_not_write(
    step: str, comm: MPI.Comm, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    put_rows = checkpoint._put_rows

    def fails(*given: Any) -> None:
        if step == "_put_rows":  # all ranks open what they write to
            put_rows(*given)
        raise OSError(28, "No space left on device")

    functions = some_functions(MESHES["plane"](comm))
    checkpoint.write(folder / "run.h5", functions, {"step": 1})
    with monkeypatch.context() as patch:
        if comm.rank == 0:
            patch.setattr(checkpoint, step, fails)
        with pytest.raises(OSError, match="No space left on device"):
            checkpoint.write(folder / "run.h5", functions, {"step": 2})
    assert checkpoint.read(folder / "run.h5", comm).attributes == {"step": 1}
    assert [file.name for file in folder.iterdir()] == ["run.h5"]


def test_all_ranks_know_of_attributes_that_would_not_come_back(comm: MPI.Comm, folder: Path) -> None:
    with pytest.raises(TypeError, match=r"attributes\['a'\] is of type object"):
        checkpoint.write(folder / "run.h5", some_functions(MESHES["plane"](comm)), {"a": object()})
    assert list(folder.iterdir()) == []
