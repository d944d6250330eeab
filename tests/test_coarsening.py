"""Subdivision taken back, against subdivision itself, whatever the order of vertices and faces."""

from collections.abc import Callable

import numpy as np
import pytest
from zoo import ZOO, beside, grid, polycube, torus, wheel

from thccs_fem import generators
from thccs_fem.boundary import BoundaryRule
from thccs_fem.coarsening import coarsened
from thccs_fem.hierarchy import Hierarchy
from thccs_fem.mesh import ControlMesh
from thccs_fem.subdivision import Level, control_level, subdivided

Builder = Callable[[], ControlMesh]


def has_four_of_three(mesh: ControlMesh) -> bool:
    """Whether a face has four corners inside, of valence 3."""
    level = control_level(mesh)
    return bool((~level.boundary & (level.vertex_num_faces == 3))[level.quads].all(axis=1).any())


BUILT = {name: build() for name, build in ZOO.items()}
MESHES = [name for name, mesh in BUILT.items() if mesh.is_quad and not has_four_of_three(mesh)]


def shuffled(mesh: ControlMesh, seed: int = 0) -> tuple[ControlMesh, np.ndarray]:
    """Return the mesh with vertices, faces and first corners in any order, and the new number of each vertex."""
    rng = np.random.default_rng(seed)
    number = rng.permutation(mesh.num_vertices)
    points = np.zeros_like(mesh.vertices)
    points[number] = mesh.vertices
    faces = [np.roll(face, rng.integers(4)) for face in number[mesh.quads]]
    corners = {int(number[v]): sharpness for v, sharpness in mesh.corners.items()}
    return ControlMesh(points, np.array(faces)[rng.permutation(mesh.num_faces)], corners=corners), number


@pytest.mark.parametrize("rule", ["crease", "clamped"])
@pytest.mark.parametrize("name", MESHES)
def test_matrix_is_that_of_subdivision(name: str, rule: BoundaryRule) -> None:
    hierarchy = Hierarchy.on(BUILT[name], rule)
    expected = hierarchy.refined(np.arange(hierarchy.num_dofs)).stages[0].matrix
    found = coarsened(control_level(subdivided(BUILT[name])), rule)
    assert expected is not None
    assert found is not None
    # Old vertices are the first of the finer mesh, and keep their order.
    assert found[1].shape == expected.shape
    assert abs(found[1] - expected).max() == 0.0  # made by the same operations


@pytest.mark.parametrize("name", [name for name in MESHES if name not in ("torus", "torus_of_nine")])
def test_any_order_of_vertices_and_faces(name: str) -> None:
    mesh = BUILT[name]
    fine, number = shuffled(subdivided(mesh))
    found = coarsened(control_level(fine), "crease")
    assert found is not None
    level, matrix = found
    old = np.sort(number[: mesh.num_vertices])
    points = np.zeros_like(mesh.vertices)
    points[np.searchsorted(old, number[: mesh.num_vertices])] = mesh.vertices
    assert level.num_faces == mesh.num_faces
    np.testing.assert_allclose(matrix @ points, fine.vertices, rtol=0, atol=1e-13)  # means of points below 10
    before = np.sort(np.searchsorted(old, number[mesh.quads]), axis=1)
    after = np.sort(level.quads, axis=1)
    np.testing.assert_array_equal(after[np.lexsort(after.T)], before[np.lexsort(before.T)])


@pytest.mark.parametrize("mesh", [torus(8, 6), generators.torus((12, 8))], ids=["irregular", "round"])
def test_a_torus_keeps_its_first_vertex(mesh: ControlMesh) -> None:
    found = coarsened(control_level(mesh), "clamped")
    assert found is not None
    level, matrix = found
    assert (level.num_vertices, level.num_faces) == (mesh.num_vertices // 4, mesh.num_faces // 4)
    np.testing.assert_allclose(sorted(matrix[[0]].data), [1 / 64] * 4 + [6 / 64] * 4 + [36 / 64], rtol=0, atol=1e-15)
    np.testing.assert_allclose(matrix.sum(axis=1), 1.0, rtol=0, atol=1e-15)


@pytest.mark.parametrize("seed", range(4))
def test_an_annulus_keeps_vertices_of_its_rims(seed: int) -> None:
    mesh = subdivided(generators.cylinder((6, 2)))  # nothing but its rims says which rows are old
    found = coarsened(control_level(shuffled(mesh, seed)[0]), "clamped")
    assert found is not None
    assert np.count_nonzero(found[0].boundary) == 12
    assert found[0].num_faces == 12


def test_down_to_the_coarsest() -> None:
    level: Level = control_level(generators.cube_sphere(12))
    sizes = []
    while (found := coarsened(level, "clamped")) is not None:
        level = found[0]
        sizes.append(level.num_vertices)
    assert sizes == [218, 56]  # 6 and 3 faces along an edge


REFUSED: dict[str, Builder] = {
    "odd grid": lambda: grid(4, 3),
    "odd torus": lambda: torus(6, 5),
    "odd wheel": lambda: wheel(5, 3),
    "irregular vertices at odd distance": lambda: polycube([(0, 0, 0), (1, 0, 0), (2, 0, 0)]),
    "corner at an edge point": lambda: with_corner(grid(4, 4), 1),
    "cube": lambda: generators.cube_sphere(2),
    "odd and even": lambda: beside(torus(6, 6), torus(5, 6)),
}


def with_corner(mesh: ControlMesh, vertex: int) -> ControlMesh:
    return ControlMesh(mesh.vertices, mesh.quads, corners={vertex: 10.0})


@pytest.mark.parametrize("build", REFUSED.values(), ids=REFUSED)
def test_what_is_no_subdivision(build: Builder) -> None:
    assert coarsened(control_level(build()), "clamped") is None


def test_two_parts() -> None:
    found = coarsened(control_level(beside(subdivided(wheel(5)), torus(8, 6))), "clamped")
    assert found is not None
    assert found[0].num_faces == 20 + 12
