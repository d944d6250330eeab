"""Grading towards irregular vertices: which cells get how fine, and that it depends on nothing else."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from problems import halvings, randomly_refined
from zoo import ZOO

import ufl
from thccs_fem import adapt, fem, generators
from thccs_fem.fem.assembly import assemble_cells
from thccs_fem.hierarchy import Hierarchy
from thccs_fem.mesh import ControlMesh
from thccs_fem.subdivision import subdivided


def space(msh: ControlMesh) -> fem.FunctionSpace:
    return fem.functionspace(msh, ("THCCS", 3))


def levels_at(hierarchy: Hierarchy, vertex: int) -> list[int]:
    """Return the levels of the cells at a vertex of level 0."""
    found = []
    for stage in hierarchy.stages[: hierarchy.num_levels]:
        at = stage.level.touching(stage.level.control_vertex == vertex)
        found += [stage.level.number] * np.count_nonzero(at[stage.active_faces])
    return found


def finest_level(valence: int, levels: int) -> int:
    """Return the level of the cells at a vertex: that of ring J, and two more; none more where that is not needed."""
    last = 1.5 * levels / halvings(valence)
    return int(levels + last - last * halvings(valence) / 2 + 2) if halvings(valence) < 1.5 else levels


@pytest.mark.parametrize("levels", [0, 1, 2])
@pytest.mark.parametrize("valence", [3, 5, 6, 8, 12, 40])
def test_cells_at_a_vertex_have_the_level_of_the_formula(valence: int, levels: int) -> None:
    V = adapt.grade_extraordinary(space(generators.wheel(valence, 4)), levels)
    assert levels_at(V.hierarchy, 0) == [finest_level(valence, levels)] * valence
    assert [stage.active_faces.size > 0 for stage in V.hierarchy.stages[: levels + 1]] == [False] * levels + [True]


@pytest.mark.parametrize("name", ZOO)
def test_every_irregular_vertex_is_graded(name: str) -> None:
    """Also at rims, with two in a face, and on polygons, where level 0 is the first subdivision."""
    V = adapt.grade_extraordinary(space(ZOO[name]()), 1)
    root = V.hierarchy.root
    irregular = np.flatnonzero(~root.regular)
    valences = np.where(root.boundary, 2, 1)[irregular] * root.vertex_num_faces[irregular]
    for vertex, valence in zip(irregular, valences, strict=True):
        assert min(levels_at(V.hierarchy, vertex)) >= finest_level(valence, 1)
    if (valences == 2).all():  # or there is none
        assert V.num_cells == 4 * space(V.mesh).num_cells


@pytest.mark.parametrize("valence", [3, 6, 12])
def test_size_of_cells_is_the_root_of_the_distance(valence: int) -> None:
    """Whatever the valence: that is where the errors of all rings have the same weight a cell."""
    V = adapt.grade_extraordinary(space(generators.wheel(valence, 2)), 5)
    x, one = ufl.SpatialCoordinate(V.mesh), fem.Constant(V.mesh, 1.0)
    area = assemble_cells(fem.form(one * ufl.dx, on=V))
    distance = assemble_cells(fem.form(ufl.sqrt(x[0] ** 2 + x[1] ** 2) * ufl.dx, on=V)) / area
    size = np.sqrt(area)
    graded = (distance > 4 * size) & (distance < 0.25)  # not the last cells, nor those that all have one level
    order = np.polyfit(np.log(distance[graded]), np.log(size[graded]), 1)[0]
    assert order == pytest.approx(0.5, abs=0.12)  # levels are whole numbers


@pytest.mark.parametrize("make", [lambda: generators.wheel(5, 2), lambda: generators.trapezohedron(6, 2)])
def test_more_levels_refine_what_fewer_made(make: Callable[[], ControlMesh]) -> None:
    V = space(make())
    coarse = adapt.grade_extraordinary(V, 0)
    for levels in (1, 2, 3):
        fine = adapt.grade_extraordinary(V, levels)
        assert fine.is_refinement_of(coarse)
        assert adapt.grade_extraordinary(coarse, levels).num_dofs == fine.num_dofs
        assert adapt.grade_extraordinary(fine, levels) is fine
        coarse = fine


def test_what_is_refined_stays() -> None:
    coarsest = space(generators.trapezohedron(5, 2))
    V = randomly_refined(coarsest, times=4)
    W = adapt.grade_extraordinary(V, 1)
    assert W.is_refinement_of(V)
    assert W.is_refinement_of(adapt.grade_extraordinary(coarsest, 1))


@pytest.mark.parametrize("times", [1, 2])
@pytest.mark.parametrize(
    "make", [lambda: generators.trapezohedron(5, 1), lambda: generators.wheel(7, 2), ZOO["rim_of_four"]]
)
def test_steps_behind_the_mesh_count_like_levels(make: Callable[[], ControlMesh], times: int) -> None:
    """Faces of a subdivided mesh have the keys of the faces of that level."""
    msh = make()
    fine = adapt.grade_extraordinary(space(subdivided(msh, times)), 1, subdivided=times)
    whole = adapt.grade_extraordinary(space(msh), 1 + times)
    assert fine.num_dofs == whole.num_dofs
    for found, expected in zip(fine.hierarchy.refined_keys, whole.hierarchy.refined_keys[times:], strict=True):
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("options", [{"admissibility": 2}, {"admissibility": 3}, {"unit": "ring"}], ids=str)
def test_other_ways_to_refine_have_at_least_the_same_cells(options: dict[str, Any]) -> None:
    msh = generators.wheel(8, 2)
    plain = adapt.grade_extraordinary(space(msh), 2)
    other = adapt.grade_extraordinary(fem.functionspace(msh, ("THCCS", 3), **options), 2)
    assert other.num_levels == plain.num_levels
    for keys, least in zip(other.hierarchy.refined_keys, plain.hierarchy.refined_keys, strict=True):
        assert np.isin(least, keys).all()
    assert other.num_dofs < 1.2 * plain.num_dofs  # class 2 has a seam of two rings around the finest cells


def test_wrong_arguments_are_named() -> None:
    V = space(generators.wheel(5, 1))
    with pytest.raises(ValueError, match="levels is -1: expected 0 or more"):
        adapt.grade_extraordinary(V, -1)
    with pytest.raises(ValueError, match="subdivided is -2: expected 0 or more"):
        adapt.grade_extraordinary(V, 1, subdivided=-2)
    with pytest.raises(TypeError, match=r"levels is 1.5: expected an integer"):
        adapt.grade_extraordinary(V, 1.5)  # type: ignore[arg-type]  # the wrong argument
    with pytest.raises(TypeError, match=r"subdivided is 0.5: expected an integer"):
        adapt.grade_extraordinary(V, 0, subdivided=0.5)  # type: ignore[arg-type]  # the wrong argument
    with pytest.raises(TypeError, match="grading needs a space"):
        adapt.grade_extraordinary(V.mesh, 1)  # type: ignore[arg-type]  # the wrong argument
