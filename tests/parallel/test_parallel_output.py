"""Files and pictures of several ranks are those of one, and what goes wrong on one of them all ranks tell."""

import resource
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
import pyvista
from compared import same_as_in_serial

from thccs_fem import adapt, fem, generators, io, plot, vtk
from thccs_fem.fem.space import CellwiseSpace, FunctionSpace
from thccs_fem.mesh import ControlMesh
from thccs_fem.plot import pictures

EXACT = 1e-14  # the same operators and sums; where pieces are cut from others, in another order
MESHES: dict[str, Callable[[MPI.Comm], ControlMesh]] = {
    "wheel": lambda comm: generators.wheel(5, 3, comm=comm),
    "sphere": lambda comm: generators.cube_sphere(3, comm=comm),
    "one cell": lambda comm: generators.rectangle((1, 1), comm=comm),  # most ranks own nothing
}

each_mesh = pytest.mark.parametrize("name", MESHES)
each_file = pytest.mark.parametrize("file", ["u.vtu", "u.pvtu"])


@pytest.fixture
def folder(comm: MPI.Comm, tmp_path: Path) -> Path:
    """That of rank 0, on all ranks."""
    return comm.bcast(tmp_path)


def refined(msh: ControlMesh) -> FunctionSpace:
    """Return a space with three levels of elements."""
    V = fem.functionspace(msh, ("THCCS", 3))
    for _ in range(2):
        V = adapt.refine(V, [V.num_functions // 3, V.num_functions - 1])
    return V


def by_number(V: FunctionSpace | CellwiseSpace, name: str) -> fem.Function:
    """Return a function with other values everywhere, the same whatever the ranks."""
    u = fem.Function(V, name)
    rows = np.random.default_rng(len(name)).uniform(-1.0, 1.0, (u.x.index_map.size_global, V.block_size))
    u.x.array = rows[u.x.index_map.numbers].ravel()
    return u


def on_cells(V: FunctionSpace) -> np.ndarray:
    """Return a value for each owned cell."""
    return np.cos(V.cells.partition.cells.numbers[: V.cells.num_owned])


def some_functions(msh: ControlMesh) -> list[fem.Function]:
    V = refined(msh)
    W = FunctionSpace(V.hierarchy, (2,))
    faces = fem.functionspace(msh, ("DG", 0))
    return [
        by_number(V, "u"),
        by_number(W, "vector"),
        by_number(fem.cellwise(V), "on cells"),
        by_number(faces, "faces"),
    ]


def content(grid: pyvista.DataSet, order: Any = slice(None)) -> dict[str, np.ndarray]:
    """Return all that a grid of Bezier quadrilaterals holds, piece by piece."""
    points = grid.cell_connectivity.reshape(-1, 16)
    found = {"points": grid.points[points], "types": grid.celltypes}
    found |= {name: grid.point_data[name][points] for name in grid.point_data}
    found |= {f"of {name}": grid.cell_data[name] for name in grid.cell_data}
    return {name: values[order] for name, values in found.items()}


def by_cell(grid: pyvista.DataSet) -> dict[str, np.ndarray]:
    """Return the same for pieces in the order of their cells; those of a cell are in one file, in their own order."""
    return content(grid, np.argsort(grid.cell_data["cell"], kind="stable"))


@each_mesh
@each_file
def test_file_holds_what_that_of_one_rank_holds(name: str, file: str, folder: Path) -> None:
    def work(comm: MPI.Comm) -> dict[str, np.ndarray]:
        functions = some_functions(MESHES[name](comm))
        target = folder if comm.size == MPI.COMM_WORLD.size else folder / str(MPI.COMM_WORLD.rank)
        target.mkdir(exist_ok=True)
        io.write_vtu(target / file, functions, cell_data={"eta": on_cells(functions[0].function_space)})
        return by_cell(pyvista.read(target / file))

    same_as_in_serial(work, EXACT)


def test_each_rank_writes_its_own_cells(comm: MPI.Comm, folder: Path) -> None:
    V = refined(MESHES["wheel"](comm))
    io.write_vtu(folder / "u.pvtu", V)
    pieces = [pyvista.read(folder / "u_pieces0" / f"u_{rank}.vtu") for rank in range(comm.size)]
    mine = V.cells.partition.cells.numbers[: V.cells.num_owned]
    np.testing.assert_array_equal(np.unique(pieces[comm.rank].cell_data["cell"]), mine)
    assert sum(piece.n_cells for piece in pieces) == pyvista.read(folder / "u.pvtu").n_cells


@each_mesh
def test_grid_is_that_of_one_rank(name: str) -> None:
    def work(comm: MPI.Comm) -> dict[str, np.ndarray]:
        functions = some_functions(MESHES[name](comm))
        return content(vtk.bezier_grid(functions, {"eta": on_cells(functions[0].function_space)}))

    same_as_in_serial(work, EXACT)


@each_mesh
def test_facets_and_lines_are_those_of_one_rank(name: str) -> None:
    def work(comm: MPI.Comm) -> list[np.ndarray]:
        u = by_number(refined(MESHES[name](comm)), "u")
        warp = 0.5 if u.function_space.mesh.gdim == 2 else 0.0
        facets, lines = plot.surface(u, warp=warp), plot.mesh_lines(u, warp=warp)
        of_facets = [facets.points, facets.regular_faces, facets.point_data["u"], facets.point_normals]
        return [*of_facets, facets.cell_data["cell"], lines.points, lines.lines, lines.cell_data["cell"]]

    same_as_in_serial(work, 1e-6)  # VTK's points and normals are float32


@pytest.mark.parametrize("shown", ["function", "cells", "space"])
def test_picture_is_that_of_one_rank(shown: str, comm: MPI.Comm, folder: Path) -> None:
    def draw(group: MPI.Comm, file: Path) -> None:
        V = refined(MESHES["sphere"](group))
        data = {"eta": on_cells(V)} if shown == "cells" else None
        plot.plot(by_number(V, "u") if shown == "function" else V, file, cell_data=data, window_size=(300, 200))

    draw(comm, folder / "together.png")
    if comm.rank == 0:
        draw(MPI.COMM_SELF, folder / "alone.png")
        one, other = (pyvista.read(folder / f"{name}.png").point_data.active_scalars for name in ("together", "alone"))
        assert one.shape == other.shape
        # Rounding may move an edge over the middle of a pixel.
        assert np.count_nonzero((one != other).any(axis=1)) <= len(other) // 1000
        assert len(np.unique(other, axis=0)) > 10  # something is there
    comm.Barrier()
    assert sorted(path.name for path in folder.iterdir()) == ["alone.png", "together.png"]


# ---- What goes wrong -------------------------------------------------------------------------------------------------


def last(comm: MPI.Comm) -> bool:
    return comm.rank == comm.size - 1


def of_last(comm: MPI.Comm, message: str) -> str:
    return message if comm.size == 1 else f"rank {comm.size - 1} of {comm.size}: .*{message}"


@contextmanager
def small_files_only(here: bool) -> Iterator[None]:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (5000 if here else soft, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@each_file
@pytest.mark.parametrize("exists", [False, True])
def test_full_disk_of_one_rank_is_told_by_all(exists: bool, file: str, comm: MPI.Comm, folder: Path) -> None:
    u = by_number(refined(MESHES["wheel"](comm)), "u")
    if exists:
        io.write_vtu(folder / file, u)
    before = sorted(path.read_bytes() for path in folder.rglob("*.*vtu"))
    comm.Barrier()
    message = of_last(comm, r"could not be written \(File too large\): see that there is space")
    with small_files_only(last(comm)), pytest.raises(OSError, match=message):
        io.write_vtu(folder / file, u)
    comm.Barrier()
    assert sorted(path.read_bytes() for path in folder.rglob("*.*vtu")) == before
    assert not exists or pyvista.read(folder / file).n_cells == vtk.bezier_grid(u).n_cells
    io.write_vtu(folder / file, u)
    assert pyvista.read(folder / file).n_points == vtk.bezier_grid(u).n_points


@each_file
def test_missing_directory_is_told_by_all(file: str, comm: MPI.Comm, folder: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no directory .*none.* make it first"):
        io.write_vtu(folder / "none" / file, refined(MESHES["wheel"](comm)))
    with pytest.raises(FileNotFoundError, match=r"no directory .*none.* make it first"):
        plot.plot(refined(MESHES["wheel"](comm)), folder / "none" / "u.png")


def test_wrong_cell_data_of_one_rank_are_told_by_all(comm: MPI.Comm, folder: Path) -> None:
    V = refined(MESHES["wheel"](comm))
    eta = on_cells(V)
    for work in (
        lambda data: io.write_vtu(folder / "u.vtu", V, cell_data=data),
        lambda data: vtk.bezier_grid(V, data),
        lambda data: plot.plot(V, folder / "u.png", cell_data=data),
    ):
        with pytest.raises(ValueError, match=of_last(comm, "'eta' must be one number for each of the")):
            work({"eta": eta[: -1 if last(comm) else None]})
    if comm.size > 1:
        with pytest.raises(ValueError, match=r"cell data are \[\('eta', .*\] on rank ., but \[\('eta', .*\] on rank ."):
            io.write_vtu(folder / "u.vtu", V, cell_data={"eta": eta > 0 if last(comm) else eta})
    assert list(folder.iterdir()) == []


def test_values_that_are_not_finite_on_one_rank_are_told_by_all(comm: MPI.Comm, folder: Path) -> None:
    u = by_number(refined(MESHES["wheel"](comm)), "u")
    V = u.function_space
    if last(comm):
        u.x.array[:2] = np.nan
    with pytest.raises(ValueError, match=f"^2 of the {V.num_dofs} coefficients of 'u' are infinite or not a number"):
        plot.plot(u, folder / "u.png")
    eta = on_cells(V)
    if last(comm):
        eta[0] = np.inf
    number = comm.bcast(V.cells.partition.cells.numbers[0], root=comm.size - 1)
    with pytest.raises(ValueError, match=f"^cell data 'eta' of cell {number} are inf: give finite values"):
        plot.plot(V, folder / "u.png", cell_data={"eta": eta})
    assert list(folder.iterdir()) == []


def test_picture_that_can_not_be_drawn_is_told_by_all(
    comm: MPI.Comm, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object) -> None:
        raise OSError("no display")

    monkeypatch.setattr(pictures, "_check_there_is_something_to_draw_on", fails)
    with pytest.raises(OSError, match=r"^no display$"):
        plot.plot(refined(MESHES["wheel"](comm)), folder / "u.png")
