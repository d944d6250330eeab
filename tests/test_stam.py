"""Stam's evaluation against exact evaluation by subdivision, the pieces of the library, and the masks themselves."""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest
from exact import ExactMesh
from zoo import ZOO, grid, half_disc, l_domain, wheel

from thccs_fem import element, limit, stam
from thccs_fem.bezier import spline_grid
from thccs_fem.extraction import Cells, extract
from thccs_fem.hierarchy import Hierarchy
from thccs_fem.mesh import ControlMesh
from thccs_fem.subdivision import Level, control_level, subdivide

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]

VALENCES = [3, 5, 6, 7, 8, 12, 16, 31, 64]  # from 8 on also those with an eigenvalue that two blocks share
each_valence = pytest.mark.parametrize("valence", VALENCES)
ROUNDING = 1e-13  # 2 N + 8 terms of size 1, eigenvectors of condition 600
ORDERS = np.array([0, 1, 1, 2, 2, 2])


def dyadic_and_random_points(number: int = 40) -> Floats:
    """Points all over the element, corners and edges of its sub-elements among them, not the extraordinary vertex."""
    lines = np.array([0.0, 0.25, 0.5, 0.75, 1.0])
    dyadic = np.stack(np.meshgrid(lines, lines), axis=-1).reshape(-1, 2)[1:]
    return np.concatenate([dyadic, np.random.default_rng(0).random((number, 2))])


def at_vertex(level: Level, vertex: int = 0) -> Ints:
    """The half-edges that start at a vertex."""
    return np.flatnonzero(level.vertices == vertex).astype(np.int32)


def turned(mesh: ControlMesh) -> ControlMesh:
    """The mesh with its faces beginning at other corners."""
    shift = np.arange(mesh.num_faces) // 4 % 4  # of `wheel`, whose sectors have four faces: others in each sector
    return ControlMesh(mesh.vertices, [np.roll(f, s) for f, s in zip(mesh.quads, shift, strict=True)])


# ---- The matrices and their eigenstructure


def rounding(valence: int) -> float:
    """Return what rounding may leave in sums over the faces, half a unit in the last place for each."""
    return max(1e-15, valence * np.finfo(float).eps / 2.0)


@each_valence
def test_the_first_rows_are_the_masks_of_catmull_and_clark(valence: int) -> None:
    A, _ = stam.subdivision_matrices(valence)
    n = valence
    edge = np.zeros(2 * n + 8)
    edge[[0, 1, 2, 3, 2 * n - 1, 2 * n]] = [3 / 8, 3 / 8, 1 / 16, 1 / 16, 1 / 16, 1 / 16]
    vertex = np.zeros(2 * n + 8)
    vertex[0], vertex[1 : 2 * n + 1 : 2], vertex[2 : 2 * n + 2 : 2] = 1 - 7 / (4 * n), 3 / (2 * n**2), 1 / (4 * n**2)
    face = np.zeros(2 * n + 8)
    face[:4] = 1 / 4
    corner = np.zeros(2 * n + 8)  # 2 N + 7: the vertex of the coarse corner 2
    around = [3, 2 * n + 5, 2 * n + 6, 2 * n + 7, 2 * n + 3, 2 * n + 2, 1, 0]
    corner[2], corner[around] = 9 / 16, [3 / 32, 1 / 64, 3 / 32, 1 / 64, 3 / 32, 1 / 64, 3 / 32, 1 / 64]
    for row, expected in ((0, vertex), (1, edge), (2, face), (2 * n + 7, corner)):
        np.testing.assert_allclose(A[row], expected, rtol=0, atol=rounding(n))


@each_valence
def test_subdivision_makes_means(valence: int) -> None:
    for matrix in stam.subdivision_matrices(valence):
        assert matrix.shape[-1] == 2 * valence + 8
        assert matrix.min() >= 0.0
        # Nothing is outside of the stencil.
        np.testing.assert_allclose(matrix.sum(axis=-1), 1.0, rtol=0, atol=rounding(valence))


@pytest.mark.parametrize("valence", [*range(3, 34), 48, 63, 64])
def test_eigenstructure_is_that_of_the_matrix(valence: int) -> None:
    A, patches = stam.subdivision_matrices(valence)
    eigen = stam.eigenstructure(valence)
    product = eigen.right * eigen.eigenvalues @ eigen.left
    np.testing.assert_allclose(product, A, rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(eigen.right @ eigen.left, np.eye(len(A)), rtol=0, atol=ROUNDING)
    assert np.linalg.cond(eigen.right) < 1000  # no Jordan block, and none near
    np.testing.assert_allclose(eigen.patches, element.TO_BERNSTEIN @ patches @ eigen.right, rtol=0, atol=ROUNDING)


@each_valence
def test_eigenvalues_are_the_known_ones(valence: int) -> None:
    eigen = stam.eigenstructure(valence)
    c = np.cos(2 * np.pi / valence)
    subdominant = (5 + c + np.sqrt((c + 1) * (c + 9))) / 16
    np.testing.assert_allclose(eigen.eigenvalues[:3], [1.0, subdominant, subdominant], rtol=1e-14)
    assert eigen.eigenvalues[3] < subdominant - 0.001
    outer = np.sort(eigen.eigenvalues[2 * valence + 1 :])
    np.testing.assert_allclose(outer, [1 / 64, 1 / 32, 1 / 32, 1 / 16, 1 / 16, 1 / 8, 1 / 8], rtol=0, atol=1e-15)


def test_a_shared_eigenvalue_without_jordan_block() -> None:
    """1/8 belongs to the ring as well as to the arms; divided by their difference, rounding would be all there is."""
    for valence in (4, 8, 12, 64):
        eigenvalues = stam.eigenstructure(valence).eigenvalues
        assert np.count_nonzero(np.abs(eigenvalues - 1 / 8) < 1e-14) >= 4


def test_what_is_kept_is_read_only() -> None:
    eigen = stam.eigenstructure(5)
    assert stam.eigenstructure(5) is eigen
    for array in (*stam.subdivision_matrices(5), eigen.eigenvalues, eigen.right, eigen.left, eigen.patches):
        with pytest.raises(ValueError, match="read-only"):
            array.flat[0] = 0.0


# ---- Values


@each_valence
@pytest.mark.parametrize("distance", [1.0, 1e-3, 1e-9, 1e-15])
def test_values_and_derivatives_are_those_of_the_limit_surface(valence: int, distance: float) -> None:
    """In faces that begin at any of their corners."""
    mesh = turned(wheel(valence))
    level = control_level(mesh)
    half_edges = at_vertex(level)[:4]
    face, corner = half_edges // 4, half_edges % 4
    assert np.unique(corner).size == half_edges.size
    points = dyadic_and_random_points()
    vertices = stam.stencil(level, half_edges)
    found = stam.evaluate(valence, distance * points, 2)[:, None] @ mesh.vertices[vertices]
    shape = (6, half_edges.size, len(points), 3)
    faces = np.repeat(face, len(points))
    if distance < 0.5:  # coordinates in the sub-quad at the corner keep their digits
        uv = np.tile(2 * distance * points, (half_edges.size, 1))
        expected = limit.evaluate(mesh, faces, uv, 2, np.repeat(corner, len(points))).reshape(shape)
        expected *= 2.0 ** ORDERS[:, None, None, None]
    else:
        uv = np.concatenate([turned_coordinates(points, k) for k in corner])
        expected = limit.evaluate(mesh, faces, uv, 2).reshape(shape)
        expected = np.stack([turned_derivatives(expected[:, n], k) for n, k in enumerate(corner)], axis=1)
    size = np.abs(expected).max(axis=(1, 2, 3))
    for row in range(6):
        atol = ROUNDING if row == 0 else 1e-12 * size[row]  # relative to the largest derivative
        np.testing.assert_allclose(found[row], expected[row], rtol=0, atol=atol)


def turned_coordinates(uv: Floats, corner: int) -> Floats:
    """Coordinates in the face of points given along its axes from another corner."""
    u, v = uv.T
    return np.stack([(u, v), (1 - v, u), (1 - u, 1 - v), (v, 1 - u)][corner], axis=-1)


def turned_derivatives(x: Floats, corner: int) -> Floats:
    """Derivatives along the axes from another corner."""
    value, du, dv, duu, duv, dvv = x
    for _ in range(corner):
        du, dv, duu, duv, dvv = dv, -du, dvv, -duv, duu
    return np.stack([value, du, dv, duu, duv, dvv])


def test_values_near_the_vertex_are_those_of_rational_arithmetic() -> None:
    mesh = wheel(5)
    face, (part, kept) = 0, ExactMesh.of(mesh).near(0)
    control = mesh.vertices[stam.stencil(control_level(mesh), np.zeros(1, dtype=np.int32))[0]]
    for depth in range(41):
        fine = part.subdivided()
        if depth in (0, 10, 40):
            here = kept.index(face)
            x = stam.evaluate(5, [(2.0**-depth, 2.0**-depth)], 1)[:, 0] @ control
            np.testing.assert_allclose(x[0], fine.limit(part.faces[here][2]).astype(float), rtol=0, atol=1e-14)
            first = fine.derivatives(4 * here + 2)[:2] * (-(2 ** (depth + 1)))  # child 2 runs backwards
            np.testing.assert_allclose(x[1:], first.astype(float), rtol=1e-13)
        face = 4 * kept.index(face)
        part, kept = fine.near(0)


@each_valence
def test_at_the_vertex_is_the_limit_mask(valence: int) -> None:
    n = valence
    functions = stam.evaluate(n, [(0.0, 0.0), (1e-70, 0.0), (1e-50, 1e-55)], 1)
    expected = np.zeros(2 * n + 8)
    expected[0], expected[1 : 2 * n + 1 : 2], expected[2 : 2 * n + 2 : 2] = n, 4 / n, 1 / n
    np.testing.assert_allclose(functions[0], np.tile(expected / (n + 5), (3, 1)), rtol=0, atol=1e-15)
    assert np.count_nonzero(functions[0, 0]) == 2 * n + 1
    assert np.isnan(functions[1:, :2]).all()
    assert np.isfinite(functions[1:, 2]).all()


@each_valence
def test_partition_of_unity(valence: int) -> None:
    points = dyadic_and_random_points()
    for distance in (1.0, 1e-12):
        functions = stam.evaluate(valence, distance * points, 2)
        assert functions[0].min() > -1e-15
        np.testing.assert_allclose(functions[0].sum(axis=1), 1.0, rtol=0, atol=ROUNDING)
        size = np.abs(functions).max(axis=(1, 2))
        assert (np.abs(functions.sum(axis=2)).max(axis=1)[1:] < ROUNDING * size[1:]).all()


def test_valence_four_is_the_bicubic_spline() -> None:
    mesh = grid(3, 3)
    level = control_level(mesh)
    half_edge = np.array([4 * 4], dtype=np.int32)  # of the face in the middle
    order = spline_grid(level, half_edge // 4)[0]
    points = dyadic_and_random_points()
    expected = np.zeros((len(points), mesh.num_vertices))
    u, v = element.bspline_values(points.T)
    expected[:, order] = (v[:, :, None] * u[:, None, :]).reshape(-1, 16)
    functions = stam.evaluate(4, points)[0]
    np.testing.assert_allclose(functions, expected[:, stam.stencil(level, half_edge)[0]], rtol=0, atol=1e-14)


# ---- Refinability, and the pieces of the library


@pytest.mark.parametrize("valence", [3, 5, 8])
def test_refinability(valence: int) -> None:
    """Eq. 13 with the matrix of the whole mesh: B_i = sum_j S_ji B_j of the next level, on all four children."""
    level = control_level(wheel(valence))
    step = subdivide(level, np.ones(level.num_faces, dtype=bool))
    fine, S = step.fine, step.matrix.toarray()
    inner = np.random.default_rng(1).random((30, 2))
    for half_edge in at_vertex(level):
        child = step.first_child[half_edge // 4] + (half_edge + np.arange(4)) % 4
        coarse = stam.stencil(level, np.array([half_edge]))[0]
        functions = np.zeros((4, 30, fine.num_vertices))
        functions[0][:, stam.stencil(fine, 4 * child[:1])[0]] = stam.evaluate(valence, inner)[0]
        u, v = element.bspline_values(inner.T)
        for k in (1, 2, 3):
            functions[k][:, spline_grid(fine, child[k : k + 1])[0]] = (v[:, :, None] * u[:, None, :]).reshape(-1, 16)
        refined = functions @ S
        for k in range(4):
            outer = turned_coordinates(inner / 2, k)  # child k has its corner 0 at corner k, and axes from there
            expected = np.zeros_like(refined[k])
            expected[:, coarse] = stam.evaluate(valence, outer)[0]
            np.testing.assert_allclose(refined[k], expected, rtol=0, atol=ROUNDING)


def refined_wheel(valence: int, rule: str) -> Hierarchy:
    """Three levels: one vertex next to the extraordinary one, then one of its children's neighbours."""
    hierarchy = Hierarchy.on(wheel(valence, 4), rule, cap_level=9)  # type: ignore[arg-type]  # a literal
    for _ in range(2):
        hierarchy = hierarchy.refined(np.array([hierarchy.dof_offsets[hierarchy.num_levels - 1] + 1]))
    return hierarchy


@pytest.mark.parametrize("rule", ["crease", "clamped"])
@pytest.mark.parametrize("valence", [3, 5, 8])
def test_pieces_are_those_of_the_library(valence: int, rule: str) -> None:
    """Cut elements of all levels of a hierarchy, all functions at once, values and derivatives."""
    hierarchy = refined_wheel(valence, rule)
    cells = extract(hierarchy)
    seen = 0
    for l in range(hierarchy.num_levels):
        stage = hierarchy.stages[l]
        half_edges = at_vertex(stage.level, int(np.flatnonzero(stage.level.control_vertex == 0)[0]))
        active = np.isin(half_edges // 4, stage.active_faces)
        if active.any():
            irregular = half_edges[active]
            coefficients = (stage.boundary.to_points @ hierarchy.coefficients[l])[: stage.level.num_vertices].toarray()
            vertices = stam.stencil(stage.level, irregular)
            for half_edge, mine in zip(irregular, vertices, strict=True):
                cell = int(np.flatnonzero((cells.level == l) & (cells.level_face == half_edge // 4))[0])
                seen += _compare(cells, cell, half_edge % 4, valence, coefficients[mine])
    assert seen == valence  # each sector once or more
    assert hierarchy.num_levels == 3


def _compare(cells: Cells, cell: int, corner: int, valence: int, coefficients: Floats) -> bool:
    pieces = np.flatnonzero(cells.piece_cell == cell).astype(np.int32)
    scale = np.linalg.norm(cells.piece_axes[pieces], axis=1)[:, 0]
    regular = pieces[scale > scale.min()]  # the cap is one of four of the last size
    local = cells.rows(regular).toarray().reshape(regular.size, 16, -1)
    inner = np.random.default_rng(cell).random((regular.size, 2))
    axes = cells.piece_axes[regular]
    outer = cells.piece_origin[regular] + np.einsum("nij,nj->ni", axes, inner)
    found = limit.evaluate_patches(np.arange(regular.size, dtype=np.int32), inner, element.TO_BERNSTEIN @ local, 2)
    uv = turned_coordinates(outer, (4 - corner) % 4)
    expected = turned_derivatives(stam.evaluate(valence, uv, 2) @ coefficients, (4 - corner) % 4)
    with_axes = np.stack(
        [
            expected[0],
            *np.einsum("nij,inc->jnc", axes, expected[1:3]),
            *np.einsum("nia,njb,ijnc->abnc", axes, axes, expected[[3, 4, 4, 5]].reshape(2, 2, *expected.shape[1:]))[
                [0, 0, 1], [0, 1, 1]
            ],
        ]
    )
    np.testing.assert_allclose(found, with_axes, rtol=0, atol=1e-12)  # derivatives on the piece are of size 1
    return True


# ---- What is refused


@pytest.mark.parametrize("valence", [2, 1, 0, -3])
def test_small_valences_are_refused(valence: int) -> None:
    with pytest.raises(ValueError, match=f"the valence is {valence}; an irregular element has 3 or more"):
        stam.evaluate(valence, [(0.5, 0.5)])


@pytest.mark.parametrize(
    ("uv", "message"),
    [
        ([0.5, 0.5], r"uv must have shape \(m, 2\), two coordinates a point; got \(2,\)"),
        ([(0.5, 0.5, 0.5)], r"got \(1, 3\)"),
        ([(0.5, 0.5), (1.5, 0.0)], r"point 1 has coordinates \[1.5 0. \]; both must lie in \[0, 1\]"),
        ([(0.5, -1e-9)], "point 0 has coordinates"),
        ([(0.5, np.nan)], "point 0 has coordinates"),
    ],
)
def test_points_are_checked(uv: npt.ArrayLike, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        stam.evaluate(5, uv)


def test_orders_of_derivatives() -> None:
    uv = [(0.25, 0.5), (1.0, 0.75)]
    every = stam.evaluate(5, uv, 2)
    for derivatives, rows in ((0, 1), (1, 3)):
        np.testing.assert_array_equal(stam.evaluate(5, uv, derivatives), every[:rows])
    with pytest.raises(ValueError, match="derivatives is 3; expected the highest order wanted: 0, 1 or 2"):
        stam.evaluate(5, uv, 3)


def _unfit() -> dict[str, Callable[[], tuple[Level, Ints]]]:
    pair = control_level(ZOO["tripod"]())
    both = np.flatnonzero((~pair.regular[pair.quads]).sum(axis=1) > 1)
    rim = control_level(half_disc(3))
    corner = control_level(l_domain(tagged=False, n=3))
    inside = corner.regular[corner.quads] & ~corner.boundary[corner.quads]
    at_corner = np.flatnonzero(inside.sum(axis=1) == 3)  # the middle one of the three faces at the reentrant vertex
    k = np.flatnonzero(~inside[at_corner[0]])
    near_rim = control_level(wheel(5, 1))
    whole = control_level(wheel(5, 3))
    part = subdivide(whole, np.arange(whole.num_faces) == 0).fine
    return {
        "two irregular corners": lambda: (pair, (4 * both[:1]).astype(np.int32)),
        "on the boundary": lambda: (rim, at_vertex(rim)[:1]),
        "at a reentrant vertex": lambda: (corner, (4 * at_corner[:1] + k).astype(np.int32)),
        "corners on the boundary": lambda: (near_rim, at_vertex(near_rim)[:1]),
        "faces not held": lambda: (part, np.zeros(1, dtype=np.int32)),
    }


@pytest.mark.parametrize(
    "case",
    ["two irregular corners", "on the boundary", "at a reentrant vertex", "corners on the boundary", "faces not held"],
)
def test_elements_of_another_kind_are_refused(case: str) -> None:
    level, half_edges = _unfit()[case]()
    with pytest.raises(ValueError, match=rf"face {half_edges[0] // 4} has a corner on the boundary, or irregular"):
        stam.stencil(level, half_edges)


def test_valences_are_not_mixed() -> None:
    level = control_level(ZOO["wheel5"]())
    regular = np.flatnonzero(level.regular & ~level.boundary)
    mixed = np.array([at_vertex(level)[0], at_vertex(level, int(regular[0]))[0]])
    with pytest.raises(ValueError, match=r"vertices of valences \[4, 5\]; give those of one"):
        stam.stencil(level, mixed)


def test_no_elements_are_no_mistake() -> None:
    assert len(stam.stencil(control_level(wheel(5)), np.zeros(0, dtype=np.int32))) == 0
