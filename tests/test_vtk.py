"""VTU files: VTK's own evaluation of what is in them is that of the functions, everywhere and to rounding."""

from pathlib import Path

import numpy as np
import pytest
import pyvista
from refinements import geometry_dofs, random_positions
from vtkmodules.vtkCommonCore import reference
from vtkmodules.vtkCommonDataModel import vtkHigherOrderQuadrilateral
from zoo import ZOO

from thccs_fem import adapt, generators, io, limit, vtk
from thccs_fem.fem.function import Function
from thccs_fem.fem.space import CellwiseSpace, FunctionSpace, cellwise, functionspace
from thccs_fem.mesh import ControlMesh

EXACT = 1e-12  # 16 terms of sizes up to 10
# Planar and in space, with and without a rim, caps of several valences, polygons.
NAMES = ["grid", "torus", "wheel5", "l_domain_tagged", "tripod", "pyramid"]

each_mesh = pytest.mark.parametrize("name", NAMES)


def space(mesh: ControlMesh, shape: tuple[int, ...] = ()) -> FunctionSpace:
    """Return a space with three levels of elements."""
    V = functionspace(mesh, ("THCCS", 3, shape))
    for _ in range(2):
        V = V.with_hierarchy(V.hierarchy.refined(np.array([V.num_functions // 3, V.num_functions - 1])))
    return V


def position(V: FunctionSpace) -> Function:
    """Return the function whose value is where it is taken, in a space of vectors."""
    x = Function(V, "x")
    x.x.array = geometry_dofs(V.hierarchy).ravel()
    return x


def some_function(V: FunctionSpace | CellwiseSpace, name: str = "u") -> Function:
    u = Function(V, name)
    u.x.array = np.random.default_rng(3).uniform(-1.0, 1.0, V.num_dofs)
    return u


def evaluated(grid: pyvista.UnstructuredGrid, cells: np.ndarray, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return what VTK finds at coordinates of cells: points, and weights of the cells' own points."""
    points, weights = np.zeros((cells.size, 3)), np.zeros((cells.size, 16))
    for k, number in enumerate(cells):
        x, w = [0.0] * 3, [0.0] * 16
        grid.GetCell(number).EvaluateLocation(reference(0), (*uv[k], 0.0), x, w)
        points[k], weights[k] = x, w
    return points, weights


def test_places_are_those_of_vtk() -> None:
    places = [vtkHigherOrderQuadrilateral.PointIndexFromIJK(i, j, [3, 3]) for j in range(4) for i in range(4)]
    np.testing.assert_array_equal(vtk.VTK_ORDER[places], np.arange(16))


@each_mesh
def test_file_holds_surface_and_function(name: str, tmp_path: Path) -> None:
    mesh = ZOO[name]()
    V = space(mesh)
    u, x = some_function(V), position(space(mesh, (mesh.gdim,)))
    vtk.write_vtu(tmp_path / "u.vtu", u)
    grid = pyvista.read(tmp_path / "u.vtu")
    assert set(grid.celltypes) == {pyvista.CellType.BEZIER_QUADRILATERAL}
    assert (grid.n_cells, grid.n_points) == (V.cells.num_pieces, 16 * V.cells.num_pieces)
    faces, uv, corner = random_positions(V.hierarchy, 50)
    piece, local = V.cells.locate(faces, uv, corner)
    points, weights = evaluated(grid, piece, local)
    np.testing.assert_allclose(points[:, : mesh.gdim], x.eval(faces, uv, corner), rtol=0, atol=EXACT)
    assert not points[:, mesh.gdim :].any()
    values = (weights * grid.point_data["u"][grid.cell_connectivity.reshape(-1, 16)[piece]]).sum(axis=1)
    np.testing.assert_allclose(values, u.eval(faces, uv, corner), rtol=0, atol=EXACT)


@each_mesh
def test_tessellated_surface_is_where_it_should_be(name: str) -> None:
    mesh = ZOO[name]()
    grid = vtk.bezier_grid(position(space(mesh, (mesh.gdim,))))
    facets = grid.extract_surface(algorithm="dataset_surface", nonlinear_subdivision=2)
    assert facets.n_points > grid.n_points  # it was subdivided
    np.testing.assert_allclose(facets.point_data["x"], facets.points, rtol=1e-6, atol=1e-6)  # VTK makes float32 points


def test_surface_is_the_limit_surface() -> None:
    mesh = generators.torus((6, 5))  # no extraordinary vertices, so no caps
    V = space(mesh)
    faces, uv, _ = random_positions(V.hierarchy, 50)
    piece, local = V.cells.locate(faces, uv)
    points, _ = evaluated(vtk.bezier_grid(V), piece, local)
    np.testing.assert_allclose(points, limit.evaluate(mesh, faces, uv, derivatives=0)[0], rtol=0, atol=EXACT)


@each_mesh
def test_cell_data(name: str, tmp_path: Path) -> None:
    V = space(ZOO[name]())
    cells = V.cells
    eta = np.random.default_rng(4).random(V.num_cells)
    io.write_vtu(tmp_path / "mesh.vtu", V, cell_data={"eta": eta, "large": eta > 0.5})
    grid = pyvista.read(tmp_path / "mesh.vtu")
    assert grid.point_data.keys() == []
    assert sorted(grid.cell_data.keys()) == ["cell", "eta", "face", "large", "level", "tag"]
    cell = grid.cell_data["cell"]
    np.testing.assert_array_equal(cell, cells.piece_cell)
    for key, values in (("level", cells.level), ("face", cells.face), ("tag", cells.tag), ("eta", eta)):
        np.testing.assert_array_equal(grid.cell_data[key], values[cell])


def test_tags_are_those_of_the_faces() -> None:
    grid = vtk.bezier_grid(functionspace(generators.genus3(1), ("THCCS", 3)))
    assert sorted(set(grid.cell_data["tag"])) == [0, 1, 2]


def test_several_functions_from_spaces_of_their_own() -> None:
    mesh = ZOO["grid"]()
    u, d = some_function(space(mesh)), some_function(space(mesh, (2,)), "d")
    assert u.function_space.hierarchy is not d.function_space.hierarchy
    grid = vtk.bezier_grid([u, d])
    np.testing.assert_array_equal(grid.point_data["u"], vtk.bezier_grid(u).point_data["u"])
    assert grid.point_data["d"].shape == (grid.n_points, 3)
    assert not grid.point_data["d"][:, 2].any()
    # Each component alone is the scalar function with its coefficients.
    for c in range(2):
        u.x.array = d.x.array[c::2]
        component = vtk.bezier_grid(u).point_data["u"]
        np.testing.assert_allclose(grid.point_data["d"][:, c], component, rtol=0, atol=EXACT)


@pytest.mark.parametrize("name", ["wheel5", "pyramid"])
def test_constants_on_faces_and_cells_go_along(name: str) -> None:
    coarse = functionspace(ZOO[name](), ("THCCS", 3), boundary="crease")
    V = adapt.refine(adapt.refine(coarse, [0]), [1])
    u, k = some_function(V), Function(functionspace(V.mesh, ("DG", 0)), "k")
    k.x.array = np.arange(V.mesh.num_faces)
    q, r = some_function(cellwise(V, (2,)), "q"), some_function(cellwise(coarse), "r")
    for functions in ([u, k, q, r], [k, r, u, q], [r, k, q]):
        grid = vtk.bezier_grid(functions)
        assert grid.n_cells == V.cells.num_pieces
        at = {f: grid.point_data[f].reshape(grid.n_cells, 16, -1) for f in grid.point_data.keys()}
        on_faces = np.repeat(grid.cell_data["face"][:, None], 16, axis=1)
        np.testing.assert_allclose(at["k"][:, :, 0], on_faces, atol=EXACT)
        on_cells = q.x.array.reshape(-1, 2)[grid.cell_data["cell"]]
        np.testing.assert_allclose(at["q"][:, :, :2], np.repeat(on_cells[:, None], 16, axis=1), atol=EXACT)
        assert np.unique(at["r"].round(12)).size == coarse.num_cells
    np.testing.assert_array_equal(vtk.bezier_grid([k, u]).point_data["u"], vtk.bezier_grid(u).point_data["u"])
    with pytest.raises(ValueError, match=r"elements of the functions differ"):
        vtk.bezier_grid([some_function(coarse), q])


def test_vectors_of_other_lengths_keep_them() -> None:
    for k in (1, 3, 4):
        values = vtk.bezier_grid(some_function(space(ZOO["torus"](), (k,)))).point_data["u"]
        assert values.reshape(len(values), -1).shape[1] == k


def test_what_can_not_be_written(tmp_path: Path) -> None:
    mesh = ZOO["torus"]()
    V = space(mesh)
    u = some_function(V)
    file = tmp_path / "u.vtu"
    with pytest.raises(ValueError, match=r"u\.vtk.*must end in \.vtu or \.pvtu"):
        vtk.write_vtu(tmp_path / "u.vtk", u)
    with pytest.raises(FileNotFoundError, match=r"no directory .*none.* make it first"):
        vtk.write_vtu(tmp_path / "none" / "u.vtu", u)
    with pytest.raises(TypeError, match="got int"):
        vtk.write_vtu(file, 3)  # type: ignore[arg-type]  # wrong on purpose
    with pytest.raises(TypeError, match="got list"):
        vtk.write_vtu(file, [])
    with pytest.raises(TypeError, match="got FunctionSpace"):
        vtk.write_vtu(file, [u, V])  # type: ignore[list-item]  # wrong on purpose
    with pytest.raises(ValueError, match=r"(?s)elements of the functions differ.*'u': .*'v': .*adapt\.transfer"):
        vtk.write_vtu(file, [u, some_function(functionspace(mesh, ("THCCS", 3)), "v")])
    wheel = ZOO["wheel5"]()
    one, other = (functionspace(wheel, ("THCCS", 3), cap_level=k) for k in (3, 4))  # the same cells, other pieces
    with pytest.raises(ValueError, match="elements of the functions differ"):
        vtk.write_vtu(file, [some_function(one), some_function(other, "v")])
    with pytest.raises(ValueError, match=r"called \['u', 'u'\].*Function\.name"):
        vtk.write_vtu(file, [u, u.copy()])
    with pytest.raises(ValueError, match="'level' are in the file already"):
        vtk.write_vtu(file, u, cell_data={"level": np.zeros(V.num_cells)})
    with pytest.raises(ValueError, match=rf"'eta' must be one number for each of the {V.num_cells} cells.*\(3,\)"):
        vtk.write_vtu(file, u, cell_data={"eta": np.zeros(3)})
    with pytest.raises(ValueError, match=r"'eta' must be one number.*type <U1"):
        vtk.write_vtu(file, u, cell_data={"eta": np.full(V.num_cells, "a")})
    assert list(tmp_path.iterdir()) == []


def test_other_types_and_names(tmp_path: Path) -> None:
    V = space(ZOO["grid"]())
    u = some_function(V, '<u> & "v"')  # what XML must hide
    data = {"half": np.float16, "flag": bool, "small": np.int8, "big": ">f8", "long": np.int64}
    given = {name: np.arange(V.num_cells).astype(dtype) for name, dtype in data.items()}
    vtk.write_vtu(tmp_path / "u.vtu", u, cell_data=given)
    grid = pyvista.read(tmp_path / "u.vtu")
    assert grid.point_data.keys() == [u.name]
    stored = {"half": np.float64, "flag": np.uint8, "small": np.int8, "big": np.float64, "long": np.int64}
    for name, dtype in stored.items():
        assert grid.cell_data[name].dtype == dtype
        np.testing.assert_array_equal(grid.cell_data[name], given[name][grid.cell_data["cell"]])


@pytest.mark.parametrize("name", ["u.vtu", "u.pvtu"])
def test_what_is_written_in_parts_is_whole(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(vtk, "CHUNK", 7)
    V = space(ZOO["pyramid"]())
    functions = [some_function(V), position(space(V.mesh, (3,)))]
    eta = np.random.default_rng(5).random(V.num_cells)
    vtk.write_vtu(tmp_path / name, functions, cell_data={"eta": eta})
    read, made = pyvista.read(tmp_path / name), vtk.bezier_grid(functions, {"eta": eta})
    np.testing.assert_array_equal(read.points, made.points)
    np.testing.assert_array_equal(read.cell_connectivity, made.cell_connectivity)
    for there, here in ((read.point_data, made.point_data), (read.cell_data, made.cell_data)):
        assert there.keys() == here.keys()
        for key in here.keys():
            np.testing.assert_array_equal(there[key], here[key])
    assert read.active_scalars_name == "u"


def names_in(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


def half(*_: object) -> None:
    raise OSError("disk full")


def test_older_file_stays_until_the_new_one_is_complete(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "u.vtu"
    file.write_text("old")
    u = some_function(space(ZOO["torus"]()))
    with monkeypatch.context() as patch:
        patch.setattr(vtk, "_write_data", half)
        with pytest.raises(OSError, match=r"u\.vtu' could not be written \(disk full\): see that there is space"):
            vtk.write_vtu(file, u)
    assert [path.read_text() for path in tmp_path.iterdir()] == ["old"]
    vtk.write_vtu(file, u)
    assert list(tmp_path.iterdir()) == [file]
    assert pyvista.read(file).n_cells == u.function_space.cells.num_pieces
    other = tmp_path / "other"
    other.touch()
    assert file.stat().st_mode == other.stat().st_mode


@pytest.mark.parametrize("stem", ["u", "ü & 'v'"])
@pytest.mark.parametrize("fails", ["_write_data", "_write_index"])
def test_older_index_keeps_its_pieces_until_the_new_one_is_complete(
    fails: str, stem: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, u = tmp_path / f"{stem}.pvtu", some_function(space(ZOO["torus"]()))
    vtk.write_vtu(file, u)
    assert names_in(tmp_path) == [f"{stem}.pvtu", f"{stem}_pieces0/{stem}_0.vtu"]
    before = u.x.array.copy()
    for k in (1, 0):
        first = pyvista.read(file).point_data["u"]
        u.x.array = before + k
        with monkeypatch.context() as patch:
            patch.setattr(vtk, fails, half)
            with pytest.raises(OSError, match="disk full"):
                vtk.write_vtu(file, u)
        assert names_in(tmp_path) == [f"{stem}.pvtu", f"{stem}_pieces{1 - k}/{stem}_0.vtu"]
        np.testing.assert_array_equal(pyvista.read(file).point_data["u"], first)
        vtk.write_vtu(file, u)
        assert names_in(tmp_path) == [f"{stem}.pvtu", f"{stem}_pieces{k}/{stem}_0.vtu"]
        np.testing.assert_array_equal(pyvista.read(file).point_data["u"], vtk.bezier_grid(u).point_data["u"])


def test_files_of_others_stay_where_pieces_were(tmp_path: Path) -> None:
    (tmp_path / "u_pieces0").mkdir()
    (tmp_path / "u_pieces0" / "notes.txt").touch()
    u = some_function(space(ZOO["torus"]()))
    for _ in range(3):
        vtk.write_vtu(tmp_path / "u.pvtu", u)
    assert names_in(tmp_path) == ["u.pvtu", "u_pieces0/notes.txt", "u_pieces0/u_0.vtu"]


@pytest.mark.parametrize("name", ["u.vtu", "u.pvtu"])
def test_full_disk_is_reported(name: str, tmp_path: Path) -> None:
    resource = pytest.importorskip("resource", reason="only Unix has limits of file sizes")
    u = some_function(space(ZOO["torus"]()))
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, hard))
    try:
        with pytest.raises(
            OSError, match=r"u.*\.vtu' could not be written \(File too large\): see that there is space"
        ):
            vtk.write_vtu(tmp_path / name, u)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert names_in(tmp_path) == []
