"""Planar surfaces that fold are refused by name, all others pass."""

import math
import re

import numpy as np
import pytest
from zoo import ZOO

from thccs_fem import folds, generators
from thccs_fem.extraction import Cells, evaluate_pieces, extract
from thccs_fem.folds import FOLD_LEVEL, check_no_folds
from thccs_fem.hierarchy import Hierarchy
from thccs_fem.mesh import ControlMesh
from thccs_fem.subdivision import subdivide


def cells_of(mesh: ControlMesh) -> Cells:
    return extract(Hierarchy.on(mesh, "crease"))


def message(mesh: ControlMesh) -> str:
    with pytest.raises(ValueError, match="the planar surface folds") as caught:
        check_no_folds(cells_of(mesh))
    return str(caught.value)


def fan(num_faces: int, angle: float, *, tagged: bool) -> ControlMesh:
    """Faces with two edges of length 1 each around vertex 0, which fill an angle (in degrees) evenly."""
    turns = np.radians(np.linspace(0.0, angle, 2 * num_faces + 1))
    radius = np.where(np.arange(turns.size) % 2, 1.2, 1.0)
    points = np.vstack([np.zeros(2), np.column_stack([radius * np.cos(turns), radius * np.sin(turns)])])
    faces = [(0, 2 * k + 1, 2 * k + 2, 2 * k + 3) for k in range(num_faces)]
    return ControlMesh(points, faces, corners={0: math.inf} if tagged else None)


@pytest.mark.parametrize(
    "mesh",
    [
        generators.rectangle((3, 2)),
        generators.disc(3),
        generators.wheel(3, 2),
        generators.wheel(8, 2),
        generators.l_domain(2),
        generators.l_domain1(),
        generators.l_domain2(),
    ],
    ids=["rectangle", "disc", "wheel3", "wheel8", "l_domain", "l_domain1", "l_domain2"],
)
def test_planar_models_pass(mesh):
    check_no_folds(cells_of(mesh))


@pytest.mark.parametrize("name", ["grid", "strip", "split_face", "l_domain_tagged", "l_domain_smooth", "polygons"])
def test_planar_meshes_of_the_zoo_pass(name):
    mesh = ZOO[name]()
    assert mesh.gdim == 2
    check_no_folds(cells_of(mesh))


def with_a_dart() -> ControlMesh:
    """A strip of three faces; a corner of the last one is drawn inwards beyond the diagonal: simple, but not convex."""
    strip = generators.rectangle((3, 1), (0.0, 0.0), (3.0, 1.0))
    points = strip.vertices.copy()
    points[-1] = [2.2, 0.2]
    return ControlMesh(points, strip.quads)


def folded_cells(cells: Cells, n: int = 20) -> np.ndarray:
    """Cells on which det J, by central differences of the surface, is negative somewhere on an n x n grid."""
    t, h = (np.arange(n) + 0.5) / n, 1e-4
    uv = np.stack(np.meshgrid(t, t), axis=-1).reshape(-1, 2)
    piece = np.repeat(np.arange(cells.num_pieces), len(uv))
    at = np.tile(uv, (cells.num_pieces, 1))
    x = {step: evaluate_pieces(cells.piece_points, piece, at + np.multiply(step, h)) for step in STENCIL}
    du, dv = x[1, 0] - x[-1, 0], x[0, 1] - x[0, -1]
    return np.unique(cells.piece_cell[piece[du[:, 0] * dv[:, 1] < du[:, 1] * dv[:, 0]]])


STENCIL = [(1, 0), (-1, 0), (0, 1), (0, -1)]


def test_faces_that_fold_are_named():
    mesh = with_a_dart()
    folded = folded_cells(cells_of(mesh))
    assert folded.tolist() == [2]
    assert re.search(
        r"folds \(det J <= 0\) on 1 of 3 faces, first \[2\]: move the vertices of these faces", message(mesh)
    )


def test_a_few_faces_are_named_and_all_counted():
    strip = with_a_dart()
    places = np.array([[0.0, 10.0 * k] for k in range(10)])
    points = (strip.vertices + places[:, None]).reshape(-1, 2)
    mesh = ControlMesh(points, np.vstack([strip.quads + strip.num_vertices * k for k in range(10)]))
    assert re.search(r"on 10 of 30 faces, first \[2, 5, 8, 11, 14, 17, 20, 23\]: ", message(mesh))


def test_faces_that_fold_are_named_after_refinement_too():
    hierarchy = Hierarchy.on(with_a_dart(), "clamped")
    cells = extract(hierarchy.refined(np.arange(hierarchy.num_dofs)))
    assert cells.num_cells == 12
    with pytest.raises(ValueError, match=r"on 1 of 3 faces, first \[2\]"):
        check_no_folds(cells)


def test_surfaces_in_space_pass():
    mesh = with_a_dart()
    check_no_folds(cells_of(ControlMesh(np.column_stack([mesh.vertices, np.zeros(8)]), mesh.quads)))


# Tagged corners: faces fold where a face spans more than 90 degrees, some levels below the control mesh.


@pytest.mark.parametrize(("num_faces", "angle"), [(1, 90), (1, 150), (2, 90), (2, 180), (3, 180), (3, 270), (4, 300)])
def test_corners_of_up_to_90_degrees_a_face_pass(num_faces, angle):
    check_no_folds(cells_of(fan(num_faces, angle, tagged=True)))


@pytest.mark.parametrize(("num_faces", "angle"), [(2, 225), (2, 240), (3, 285), (3, 300), (3, 315)])
def test_a_tagged_corner_that_folds_far_down_is_named(num_faces, angle):
    text = message(fan(num_faces, angle, tagged=True))
    found = re.search(
        rf"at level (\d+) at the tagged corner, vertex 0 with {num_faces} faces, on faces \[[\d, ]+\]", text
    )
    # Not to be seen on the pieces, which end at level 4; where it starts depends on the shape.
    assert 4 < int(found[1]) <= FOLD_LEVEL
    check_no_folds(cells_of(fan(num_faces, angle, tagged=False)))  # as a smooth boundary vertex it is fine


def test_uneven_spacing_at_a_reentrant_corner_folds():
    # The L-domain of 12 x 12 faces without 4 x 4, of side 1/8 on one side of the corner and 1/4 on the other.
    line = np.concatenate([np.linspace(-1.0, 0.0, 9), np.linspace(0.0, 1.0, 5)[1:]])
    grid = generators.rectangle((12, 12))
    points = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    kept = grid.quads[~(points[grid.quads].mean(axis=1) > 0.0).all(axis=1)]
    used, faces = np.unique(kept, return_inverse=True)
    reentrant = int(np.argmin(np.linalg.norm(points[used], axis=1)))
    text = message(ControlMesh(points[used], faces.reshape(-1, 4), corners={reentrant: math.inf}))
    assert f"at level 5 at the tagged corner, vertex {reentrant} with 3 faces" in text
    assert "even out the spacing" in text


@pytest.mark.parametrize("make", [lambda: generators.l_domain(4), generators.l_domain2, lambda: generators.l_domain(1)])
def test_levels_that_are_alike_have_the_patches_of_those_made_anew(make, monkeypatch):
    cells = cells_of(make())
    found, made = [], []

    def recorded(patches):
        found.append(patches)
        return np.zeros(len(patches), dtype=bool)

    def counted(*arguments):
        made.append(arguments)
        return subdivide(*arguments)

    monkeypatch.setattr(folds, "_folds", recorded)
    monkeypatch.setattr(folds, "subdivide", counted)
    check_no_folds(cells)
    assert 0 < len(made) < FOLD_LEVEL
    monkeypatch.setattr(folds, "_is_alike", lambda level, fine: False)
    check_no_folds(cells)
    for ours, anew in zip(found[:2], found[2:], strict=True):
        np.testing.assert_array_equal(ours, anew)
