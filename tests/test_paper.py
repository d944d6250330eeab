"""The numbers of Wei, Zhang, Hughes, Scott (2015), and why their rule of selection is read as it is here."""

import numpy as np
import pytest
from refinements import bernstein_rows, scaled_eigenvalue
from slow_hierarchy import SlowLevel, whole_levels

from thccs_fem import generators
from thccs_fem.extraction import extract
from thccs_fem.hierarchy import Hierarchy

VALENCES = [3, 5, 6, 8]
RINGS = 5  # of faces around the extraordinary vertex: no support below reaches the rim


def wheel(valence: int) -> Hierarchy:
    """The hierarchy around one extraordinary vertex, vertex 0 and dof 0."""
    return Hierarchy.on(generators.wheel(valence, RINGS), "crease")


def neighbours(hierarchy: Hierarchy) -> dict[str, int]:
    """A vertex on an edge from vertex 0, one across a face, and the next ones straight on from both."""
    quads = hierarchy.root.quads
    edges = np.concatenate([quads[:, [k, (k + 1) % 4]] for k in range(4)])

    def beside(v: int) -> set[int]:
        return set(edges[(edges == v).any(axis=1)].ravel().tolist()) - {v}

    def in_faces_of(v: int) -> set[int]:
        return set(quads[(quads == v).any(axis=1)].ravel().tolist()) - {v}

    edge = min(beside(0))
    diagonal = min(in_faces_of(0) - beside(0))
    (straight,) = beside(edge) - in_faces_of(0) - {0}
    (corner,) = in_faces_of(diagonal) - beside(diagonal) - set().union(*(in_faces_of(v) for v in beside(0))) - {0}
    return {"edge": edge, "diagonal": diagonal, "straight": straight, "corner": corner}


def functions_on_faces(hierarchy: Hierarchy) -> np.ndarray:
    """How many functions do not vanish on each cell."""
    cells = extract(hierarchy)
    rows = bernstein_rows(cells).tocoo()
    pairs = np.unique(np.stack([cells.piece_cell[rows.row // 16], rows.col])[:, np.abs(rows.data) > 1e-12], axis=1)
    return np.bincount(pairs[0], minlength=cells.num_cells)


@pytest.mark.parametrize("valence", VALENCES)
def test_functions_on_a_face(valence):
    hierarchy = wheel(valence)
    level = hierarchy.root
    counts = functions_on_faces(hierarchy)
    irregular = level.touching(np.arange(level.num_vertices) == 0)
    inside = ~level.touching(level.corners_of(level.touching(level.boundary)))
    assert np.count_nonzero(irregular) == valence
    assert (counts[irregular] == 2 * valence + 8).all()
    assert inside[~irregular].any()
    assert (counts[inside & ~irregular] == 16).all()


@pytest.mark.parametrize("valence", VALENCES)
def test_finer_functions_on_an_irregular_face(valence):
    hierarchy = wheel(valence)
    refined = hierarchy.refined(np.arange(hierarchy.num_dofs))
    level = refined.stages[1].level
    assert refined.stages[1].inside.all()
    children = np.zeros(level.num_faces, dtype=bool)
    parent = int(np.flatnonzero(hierarchy.root.touching(np.arange(hierarchy.root.num_vertices) == 0))[0])
    children[level.keys // 4 == parent] = True
    assert np.count_nonzero(children) == 4
    assert np.count_nonzero(level.corners_of(level.touching(level.corners_of(children)))) == 2 * valence + 17


@pytest.mark.parametrize("valence", VALENCES)
def test_children_of_a_function(valence):
    hierarchy = wheel(valence)
    refined = hierarchy.refined(np.arange(hierarchy.num_dofs))
    children = np.bincount(refined.stages[0].matrix.tocoo().col)
    assert children[0] == 6 * valence + 1
    assert all(children[v] == 25 for v in neighbours(hierarchy).values())


@pytest.mark.parametrize("valence", VALENCES)
def test_coefficients_of_the_children(valence):
    """Figure 6: products of the univariate coefficients at half edges from the vertex, but for its own."""
    hierarchy = wheel(valence)
    stage = hierarchy.refined(np.arange(hierarchy.num_dofs)).stages[0]
    quads, step = stage.level.quads, stage.step
    at_vertex = quads[(quads == 0).any(axis=1)]
    around = set(at_vertex.ravel().tolist()) - {0}
    beside = {int(face[(k + s) % 4]) for face in at_vertex for k in np.flatnonzero(face == 0) for s in (1, 3)}
    c = (6 / 8, 4 / 8, 1 / 8)

    def of_old(v: int) -> float:
        return 1 - 7 / (4 * valence) if v == 0 else c[2] * c[0 if v in beside else 2] if v in around else 0.0

    def of_edge(ends: set[int]) -> float:
        return c[1] * c[0] if 0 in ends else c[2] * c[1] if ends <= around and ends & beside else 0.0

    old = [of_old(v) for v in step.old.tolist()]
    ends = np.stack([stage.level.vertices[step.edges], stage.level.vertices[stage.level.following[step.edges]]], axis=1)
    edges = [of_edge(set(pair)) for pair in ends.tolist()]
    faces = np.where((quads == 0).any(axis=1), c[1] * c[1], 0.0)
    found = stage.matrix[:, [0]].toarray()[:, 0]
    np.testing.assert_allclose(found, [*old, *edges, *faces], rtol=0, atol=1e-15)  # one of them is rounded


@pytest.mark.parametrize("valence", VALENCES)
@pytest.mark.parametrize(
    ("which", "discarded"),
    # Cases 1, 3 and 2 of section 4.2; one more further off.
    [("edge", 15), ("diagonal", 9), ("straight", 5), ("corner", 1)],
)
def test_children_of_the_irregular_function_discarded_when_a_neighbour_is_refined(valence, which, discarded):
    hierarchy = wheel(valence)
    refined = hierarchy.refined(np.array([neighbours(hierarchy)[which]]))
    fine = refined.stages[1]
    children = refined.stages[0].matrix[:, [0]].toarray()[:, 0] > 0.0
    assert np.count_nonzero(fine.selected) == 25
    assert np.count_nonzero(children & fine.selected) == discarded
    # What is discarded is gone from the function, and only that.
    left = refined.coefficients[1][:, [0]].toarray()[:, 0] > 0.0
    assert np.array_equal(left, children & ~fine.selected)


@pytest.mark.parametrize("valence", VALENCES)
def test_refining_the_irregular_function(valence):
    hierarchy = wheel(valence)
    refined = hierarchy.refined(np.array([0]))
    assert np.count_nonzero(refined.stages[1].selected) == 6 * valence + 1
    assert refined.num_dofs == hierarchy.num_dofs - 1 + 6 * valence + 1


# Two readings of "children". Section 4.1 activates the children of the functions refined; eq. (18) discards those
# with their support in the refined domain. Near a boundary, or near one another, these are different sets.

SIDE = 9  # vertices along a side of the grid


def grid(columns: int = SIDE) -> SlowLevel:
    quads = generators.rectangle((columns - 1, SIDE - 1)).quads
    counts = np.bincount(quads.ravel())
    return whole_levels(quads, counts.size, np.flatnonzero(counts == 1), 1)[0]


def supported_inside(level: SlowLevel, fine: SlowLevel, refined: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Marks of the refined faces, and of the fine functions with their support in their children."""
    faces = np.asarray(level.supports[:, refined].sum(axis=1)).ravel() > 0
    return faces, ~fine.meeting(~np.repeat(faces, 4))


def literal_sum(refined: list[int], columns: int = SIDE) -> tuple[np.ndarray, np.ndarray]:
    """The sum of all functions by the paper's letter, in those of level 1, and the marks of those inside Omega^1."""
    level = grid(columns)
    matrix, fine = level.subdivided
    _, inside = supported_inside(level, fine, refined)
    children = (matrix[:, refined] > 0.0).any(axis=1)
    kept = np.setdiff1d(np.arange(level.num_vertices), refined)
    truncated = np.where(inside[:, None], 0.0, matrix[:, kept])  # eq. (18)
    return truncated.sum(axis=1) + children, inside  # activated: eq. (17)


def package_sum(refined: list[int], columns: int = SIDE) -> np.ndarray:
    cells = extract(Hierarchy.on(generators.rectangle((columns - 1, SIDE - 1)), "crease").refined(np.array(refined)))
    return bernstein_rows(cells) @ np.ones(cells.num_dofs)


@pytest.mark.parametrize(
    ("place", "selected", "children", "passive"),
    [((4, 4), 25, 25, 1), ((3, 4), 25, 25, 1), ((2, 4), 35, 25, 3), ((1, 4), 25, 20, 2), ((2, 2), 49, 25, 9)],
)
def test_the_paper_by_its_letter_has_a_hole_where_refinement_meets_the_boundary(place, selected, children, passive):
    function = place[0] + SIDE * place[1]
    total, inside = literal_sum([function])
    hole = inside & (total == 0.0)
    assert np.count_nonzero(inside) == selected
    assert np.count_nonzero(hole) == selected - children
    error = np.abs(total - 1.0).max()
    np.testing.assert_allclose(error, 1.0 if selected > children else 0.0, rtol=0, atol=1e-15)
    # One array for what is activated and what is discarded: nothing is missing, and more than one function is replaced.
    hierarchy = Hierarchy.on(generators.rectangle((SIDE - 1, SIDE - 1)), "crease")
    refined = hierarchy.refined(np.array([function]))
    assert np.count_nonzero(refined.stages[1].selected) == selected
    assert hierarchy.num_dofs - refined.dof_functions(0).size == passive
    np.testing.assert_allclose(package_sum([function]), 1.0, rtol=0, atol=1e-14)  # sums of 16 terms


def test_the_hole_is_in_the_surface():
    # On the rim the limit at a vertex is (P_- + 4 P + P_+) / 6 of rim vertices alone: all functions vanish there.
    total, _ = literal_sum([2 + SIDE * 4])
    _, fine = grid().subdivided
    row = [v for v in range(fine.num_vertices) if total[v] == 0.0]
    rim_edges = np.concatenate([fine.faces[:, [k, (k + 1) % 4]] for k in range(4)])
    pairs, counts = np.unique(np.sort(rim_edges, axis=1), axis=0, return_counts=True)
    rim = pairs[counts == 1]
    middles = [v for v in row if np.isin(rim, row).all(axis=1)[(rim == v).any(axis=1)].sum() == 2]
    assert len(middles) == 3  # of the five rim vertices in the hole, those with both neighbours in it


def test_the_hole_is_there_between_refined_functions_too():
    # Far from the rim; their supports have a side in common. What lives on both sides of it is nobody's child.
    refined, columns = [4 + 13 * 4, 8 + 13 * 4], 13
    total, inside = literal_sum(refined, columns)
    assert np.count_nonzero(inside & (total == 0.0)) == 15
    assert np.count_nonzero(inside) == 2 * 25 + 15
    np.testing.assert_allclose(package_sum(refined, columns), 1.0, rtol=0, atol=1e-14)  # sums of 16 terms


def test_children_alone_leave_functions_of_nothing():
    # The eight neighbours of a function refined, it itself not: all its children are discarded.
    middle = SIDE // 2 * (SIDE + 1)
    ring = [middle + i + SIDE * j for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]
    matrix, _ = grid().subdivided
    children = (matrix[:, ring] > 0.0).any(axis=1)
    assert not matrix[~children, middle].any()
    # By support, it is replaced by its children like its neighbours; what is left is independent.
    hierarchy = Hierarchy.on(generators.rectangle((SIDE - 1, SIDE - 1)), "crease").refined(np.array(ring))
    assert middle not in hierarchy.dof_functions(0)
    rows = bernstein_rows(extract(hierarchy))
    assert scaled_eigenvalue((rows.T @ rows).toarray()) > 1e-4
