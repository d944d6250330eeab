"""Pictures: facets and lines lie on the surface, pictures have no holes and what is asked for."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import pyvista
from hypothesis import given
from hypothesis import strategies as st
from test_vtk import EXACT, NAMES, position, some_function, space
from zoo import ZOO

from thccs_fem import generators, plot
from thccs_fem.fem.function import Function
from thccs_fem.fem.space import functionspace
from thccs_fem.plot import pictures, surfaces

SIZE = (320, 240)
WHITE = np.full(3, 255)

each_mesh = pytest.mark.parametrize("name", NAMES)


@pytest.fixture
def picture(tmp_path: Path) -> Any:
    """Draw small pictures; skip where nothing can be drawn on."""

    def draw(*args: Any, **kwargs: Any) -> np.ndarray:
        file = tmp_path / "u.png"
        try:
            assert plot.plot(*args, file, window_size=SIZE, **kwargs) is None
        except OSError as error:
            if "no OpenGL" in str(error):
                pytest.skip(str(error))
            raise
        return np.asarray(pyvista.read_texture(file).to_array())[..., :3].astype(int)

    return draw


@each_mesh
def test_facets_and_lines_are_on_the_surface(name: str) -> None:
    mesh = ZOO[name]()
    x = position(space(mesh, (mesh.gdim,)))
    for drawn in (plot.surface(x), plot.mesh_lines(x)):
        np.testing.assert_allclose(drawn.point_data["x"], drawn.points[:, : mesh.gdim], rtol=0, atol=EXACT)
        assert not drawn.points[:, mesh.gdim :].any()


def cosines_of_normals(facets: pyvista.PolyData) -> np.ndarray:
    """Cosines between the normals given at the corners of the facets and those of the facets."""
    corners = facets.points[facets.regular_faces]
    flat = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    return np.einsum("fcx,fx->fc", facets.point_data["Normals"][facets.regular_faces], flat)


@each_mesh
def test_facets_are_turned_as_their_normals(name: str) -> None:
    facets = plot.surface(space(ZOO[name]()))
    normals = facets.point_data["Normals"]
    assert facets.point_data.active_normals_name == "Normals"
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, rtol=0, atol=EXACT)
    cosines = cosines_of_normals(facets)
    assert cosines.min() > 0.8  # facets turn by much where the surface is sharply bent
    assert np.median(cosines) > 0.999


def test_facets_are_as_near_as_promised(monkeypatch: pytest.MonkeyPatch) -> None:
    V = functionspace(generators.cube_sphere(1), ("THCCS", 3))
    facets = plot.surface(V)
    monkeypatch.setattr(surfaces, "GAP", surfaces.GAP / 10.0)
    finer = plot.surface(V)
    assert finer.n_cells > 2 * facets.n_cells
    finer = finer.compute_implicit_distance(facets.triangulate())
    promised = surfaces.GAP * 10.0 * np.linalg.norm(np.ptp(V.cells.points, axis=0))
    assert np.abs(finer.point_data["implicit_distance"]).max() < 2.0 * promised  # facets are bent in two directions


def test_values_are_as_near_as_promised(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(surfaces, "FACET", 1.0)
    V = functionspace(generators.rectangle((3, 3)), ("THCCS", 3))
    u = some_function(V)
    facets = plot.surface(u)
    monkeypatch.setattr(surfaces, "SHADE", surfaces.SHADE / 10.0)
    finer = plot.surface(u)
    assert finer.n_cells > 2 * facets.n_cells
    drawn = finer.sample(facets)
    found = drawn.point_data["vtkValidPointMask"] == 1  # all but some on the rim
    assert found.mean() > 0.9
    promised = surfaces.SHADE * 10.0 * np.ptp(u.local_coefficients())
    errors = (drawn.point_data["u"] - finer.point_data["u"])[found]
    assert np.abs(errors).max() < 2.0 * promised  # facets are bent in two directions


def test_only_the_range_of_values_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(surfaces, "FACET", 1.0)
    V = functionspace(generators.rectangle((3, 3)), ("THCCS", 3))
    u = some_function(V)
    num_facets = plot.surface(u).n_cells
    u.x.array = 1e6 * u.x.array + 7.0
    assert plot.surface(u).n_cells == num_facets > V.num_cells
    for constant in (0.0, 1e-300, 7.0):
        u.x.array = constant * (1.0 + 1e-14 * np.random.default_rng(5).random(V.num_dofs))
        assert plot.surface(u).n_cells == V.num_cells


def test_no_more_facets_than_can_be_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    V = functionspace(generators.torus((6, 5)), ("THCCS", 3))
    assert plot.surface(V).n_cells > 2000
    monkeypatch.setattr(surfaces, "MOST_FACETS", 2000)
    assert 500 <= plot.surface(V).n_cells <= 2000
    monkeypatch.setattr(surfaces, "MOST_FACETS", 1)
    assert plot.surface(V).n_cells == V.num_cells


def test_facets_know_their_cells() -> None:
    V = space(ZOO["tripod"]())
    facets = plot.surface(V)
    assert set(facets.cell_data.keys()) == {"cell", "level", "face", "tag"}
    np.testing.assert_array_equal(np.unique(facets.cell_data["cell"]), np.arange(V.num_cells))
    np.testing.assert_array_equal(facets.cell_data["level"], V.cells.level[facets.cell_data["cell"]])


@each_mesh
def test_lines_go_once_around_each_cell(name: str) -> None:
    cells = space(ZOO[name]()).cells
    lengths = np.abs(cells.piece_axes).sum(axis=1)  # of the sides along u and v, in the cell
    around = (cells.on_cell_edges * np.tile(lengths, 2)).sum(axis=1)
    np.testing.assert_array_equal(np.bincount(cells.piece_cell, around), np.full(cells.num_cells, 4.0))


def test_lines_of_a_planar_grid_have_the_perimeters_of_the_cells() -> None:
    V = space(generators.rectangle((4, 2)))
    lines = plot.mesh_lines(V)
    length = lines.compute_cell_sizes(area=False, volume=False).cell_data["Length"].sum()
    # Sides of cells of level l are 1/4 and 1/2 long, times 2^-l.
    assert length == pytest.approx((1.5 * 0.5**V.cells.level).sum(), rel=1e-12)


@pytest.mark.parametrize("name", ["wheel5", "l_domain_tagged"])
def test_picture_shows_a_function(name: str, picture: Any) -> None:
    u = some_function(space(ZOO[name]()))
    image = picture(u)
    assert image.shape == (SIZE[1], SIZE[0], 3)
    for corner in (image[0, 0], image[0, -1], image[-1, 0], image[-1, -1]):
        np.testing.assert_array_equal(corner, WHITE)
    surface = (image[:, :260] != WHITE).any(axis=2)  # the rest is for the bar
    rows, columns = np.flatnonzero(surface.any(axis=1)), np.flatnonzero(surface.any(axis=0))
    assert np.ptp(rows) > 0.9 * SIZE[1] or np.ptp(columns) > 0.75 * SIZE[0]
    assert rows.min() > 0
    assert rows.max() < SIZE[1] - 1
    assert (image[:, 275:] != WHITE).any()
    assert len(np.unique(image[surface.nonzero()], axis=0)) > 500  # many colours


def test_picture_of_a_space_is_grey(picture: Any) -> None:
    image = picture(space(ZOO["tripod"]()))
    assert np.ptp(image, axis=2).max() < 40
    assert (image != WHITE).any(axis=2).mean() > 0.3


def test_picture_has_no_holes(picture: Any) -> None:
    """Pieces at extraordinary vertices differ in their numbers of facets."""
    u = Function(functionspace(generators.disc(4), ("THCCS", 3)))
    image = picture(u, lines=False, clim=(-1.0, 2.0))
    y, x = np.mgrid[: SIZE[1], : SIZE[0]]
    centre = SIZE[0] * (1.0 - pictures.BAR) / 2.0
    inside = np.hypot(x - centre, y - SIZE[1] / 2.0) < 0.4 * SIZE[1]
    assert len(np.unique(image[inside], axis=0)) == 1


def test_lines_are_drawn_or_not(picture: Any) -> None:
    V = space(ZOO["grid"]())
    with_lines, without = picture(V), picture(V, lines=False)
    assert (with_lines != without).any(axis=2).mean() > 0.02
    assert with_lines.min() < 80
    assert without.min() > 180


def test_cells_are_drawn_by_their_values(picture: Any) -> None:
    V = space(generators.l_domain(1))
    level = V.cells.level
    colours = {"clim": (0.0, 2.0), "cmap": ["#ff0000", "#00ff00", "#0000ff"]}
    image = picture(V, cell_data={"level": level}, lines=False, **colours)
    kind = np.where(image[:, :260].min(axis=2) > 0, -1, image[:, :260].argmax(axis=2))  # the rest is for the bar
    area = np.bincount(level, weights=0.25**level, minlength=3)  # of cells that are squares
    seen = np.bincount(kind[kind >= 0], minlength=3)
    np.testing.assert_allclose(seen / seen.sum(), area / area.sum(), atol=0.02)
    assert (picture(V, cell_data={"level": level}, **colours) != image).any()
    u = some_function(V)
    np.testing.assert_array_equal(picture(u, cell_data={"level": level}), picture(V, cell_data={"level": level}))


def test_vectors_are_drawn_by_magnitude(picture: Any) -> None:
    mesh = ZOO["torus"]()
    d = some_function(space(mesh, (2,)), "d")
    flipped = d.copy()
    flipped.x.array = -d.x.array
    np.testing.assert_array_equal(picture(d), picture(flipped))


def test_colours(picture: Any) -> None:
    u = some_function(space(ZOO["grid"]()))
    drawn = picture(u)
    assert (drawn != picture(u, cmap="coolwarm")).any()
    wide = picture(u, clim=(-100.0, 100.0), lines=False)[60:180, 60:200]
    assert np.ptp(wide.reshape(-1, 3), axis=0).max() < 20
    white_map = picture(u, cmap=["#ffffff", "#ffffff"])
    assert white_map[:, :260].min() < 100  # lines can be seen on white
    assert picture(u, cmap=["#000000", "#000000"])[60:180, 60:200].max() > 60  # and on black


def test_camera(picture: Any) -> None:
    V = space(ZOO["torus"]())
    from_above = picture(V, camera="xy")
    np.testing.assert_array_equal(from_above[SIZE[1] // 2, SIZE[0] // 2], WHITE)  # the hole
    assert (from_above != picture(V)).any()
    assert (picture(V, camera=(1.0, 0.0, 0.0)) != from_above).any()
    far = picture(V, camera=[(0.0, 0.0, 100.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0)])
    assert 0.0 < (far != WHITE).any(axis=2).mean() < 0.05


def test_warped_plane_is_the_graph() -> None:
    u = some_function(space(generators.wheel(5, 2)))
    facets, lines = plot.surface(u, warp=0.5), plot.mesh_lines(u, warp=0.5)
    for drawn in (facets, lines):
        np.testing.assert_allclose(drawn.points[:, 2], 0.5 * drawn.point_data["u"], rtol=0, atol=EXACT)
    assert np.median(cosines_of_normals(facets)) > 0.99
    assert np.median(np.abs(facets.point_data["Normals"][:, 2])) < 0.95  # the normals of the plane would fail


def test_surface_is_warped_by_vectors() -> None:
    x = position(space(ZOO["tripod"](), (3,)))
    for drawn in (plot.surface(x, warp=-0.5), plot.mesh_lines(x, warp=-0.5)):
        np.testing.assert_allclose(drawn.points, 0.5 * drawn.point_data["x"], rtol=0, atol=EXACT)


def test_what_can_not_be_warped() -> None:
    u = some_function(space(ZOO["torus"]()))
    with pytest.raises(ValueError, match=r"'u', with 1 component\(s\), can not warp a surface in 3 dimensions: .*"):
        plot.surface(u, warp=1.0)
    with pytest.raises(ValueError, match=r"a space can not warp .*; leave warp out"):
        plot.mesh_lines(u.function_space, warp=1.0)
    with pytest.raises(ValueError, match=r"warp is nan; expected a finite factor"):
        plot.surface(u, warp=np.nan)


def test_without_a_file_there_is_a_window(monkeypatch: pytest.MonkeyPatch, picture: Any) -> None:
    V = space(ZOO["grid"]())
    picture(V)  # skips where nothing can be drawn on
    shown = []
    monkeypatch.setattr(pyvista.Plotter, "show", lambda plotter: shown.append(plotter))
    plot.plot(V)
    assert len(shown) == 1
    shown[0].close()


@pytest.mark.skipif("sys.platform != 'linux'", reason="other systems always have a display")
def test_window_wants_a_display(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pyvista, "OFF_SCREEN", False)
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(OSError, match=r"no display .*DISPLAY is not set.*: give a filename"):
        plot.plot(space(ZOO["grid"]()))


def test_picture_wants_opengl() -> None:
    window = SimpleNamespace(Initialize=lambda: None, IsCurrent=lambda: False)
    with pytest.raises(OSError, match=r"no OpenGL to draw with: install"):
        pictures._check_there_is_something_to_draw_on(SimpleNamespace(off_screen=True, render_window=window))


def test_what_can_not_be_drawn(tmp_path: Path, picture: Any) -> None:
    u = some_function(space(ZOO["grid"]()))
    with pytest.raises(ValueError, match=r"u\.jpg.*must end in \.png"):
        plot.plot(u, tmp_path / "u.jpg")
    with pytest.raises(FileNotFoundError, match=r"no directory .*none.* make it first"):
        plot.plot(u, tmp_path / "none" / "u.png")
    for function in (plot.plot, plot.surface, plot.mesh_lines):
        with pytest.raises(TypeError, match="expected a Function or a FunctionSpace, got list"):
            function([u])  # type: ignore[operator]  # wrong on purpose
    for clim in ((1.0, 1.0), (2.0, 1.0), (0.0, np.inf), (np.nan, 1.0)):
        with pytest.raises(ValueError, match=r"clim is .*; expected two finite numbers, the lower one first"):
            picture(u, clim=clim)
    V = u.function_space
    eta = np.ones(V.num_cells)
    with pytest.raises(ValueError, match=r"have the names \['a', 'b'\]: a picture can show one"):
        plot.plot(V, tmp_path / "u.png", cell_data={"a": eta, "b": eta})
    with pytest.raises(ValueError, match=r"'eta' must be one number for each of the \d+ cells"):
        plot.plot(V, tmp_path / "u.png", cell_data={"eta": eta[1:]})
    eta[3] = 0.0
    with pytest.warns(RuntimeWarning), pytest.raises(ValueError, match=r"'eta' of cell 3 are -inf: give finite values"):
        plot.plot(V, tmp_path / "u.png", cell_data={"eta": np.log10(eta)})
    u.x.array[:2] = np.nan, np.inf
    with pytest.raises(
        ValueError, match=rf"2 of the {u.x.array.size} coefficients of 'u' are infinite or not a number"
    ):
        plot.plot(u, tmp_path / "u.png")
    assert list(tmp_path.iterdir()) == []


def test_constant_functions_have_a_range() -> None:
    assert pictures._range(np.zeros(3)) == (-0.5, 0.5)
    assert pictures._range(np.full(3, 4.0)) == (2.0, 6.0)
    assert pictures._range(np.array([-4.0, -4.0 + 1e-12])) == pytest.approx((-6.0, -2.0))
    assert pictures._range(np.array([1.0, 3.0, 2.0])) == (1.0, 3.0)


@given(st.floats(-1e6, 1e6), st.floats(1e-3, 1e6))
def test_ticks_are_round_and_can_be_told_apart(low: float, width: float) -> None:
    high = low + width
    ticks, form = pictures._ticks(low, high)
    assert 4 <= ticks.size <= 11
    assert low - 1e-6 * width <= ticks[0] < ticks[-1] <= high + 1e-6 * width
    labels = [form % tick for tick in ticks]
    assert len(set(labels)) == ticks.size
    assert "-0" not in labels
    np.testing.assert_allclose([float(label) for label in labels], ticks, rtol=0, atol=1e-9 * max(abs(low), abs(high)))
    # One digit, 1, 2 or 5, in the step.
    mantissa = (ticks[1] - ticks[0]) / 10.0 ** np.floor(np.log10((ticks[1] - ticks[0]) * (1.0 + 1e-6)))
    assert np.abs(mantissa - [1.0, 2.0, 5.0]).min() < 1e-6
