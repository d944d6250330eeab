"""Are these faces a control mesh?  Each check raises ValueError and names the faces and vertices at fault."""

from collections.abc import Sequence

import numpy as np
from scipy.sparse import csgraph

from thccs_fem.polygons import Bools, Floats, Indices, Ints, Polygons, as_tuples, face_areas, graph_of, some_of

COINCIDENT_CORNERS = 1e-12  # two corners of a face this close are an error; of the mesh's diameter
CROSSING_GAP = 0.01  # edges that pass this close cross; of the distance of their ends (0.03 occurs in good meshes)
ZERO_AREA = 1e-12  # of the sum of the squared edge lengths of the face
PARALLEL = 1e-14  # squared sine of the angle of parallel edges: it is a difference of terms near 1


def check_faces(polygons: Polygons) -> None:
    """Raise ValueError if a face repeats a vertex or another face, or if a vertex is isolated."""
    v = polygons.vertices
    twice = [one[v[one] == v[other]] for _, one, other in polygons.corner_pairs()]
    _refuse(polygons, twice, "have a vertex twice: leave one out")
    for size in np.unique(polygons.sizes):
        faces = np.flatnonzero(polygons.sizes == size)
        rows = v[polygons.offsets[faces][:, None] + np.arange(size)]
        rows.sort(axis=1)
        order = np.lexsort(rows.T)
        equal = (rows[order[1:]] == rows[order[:-1]]).all(axis=1)
        if equal.any():
            pairs = np.sort(faces[np.column_stack([order[:-1], order[1:]])[equal]], axis=1)
            raise ValueError(f"faces {some_of(as_tuples(pairs))} have the same vertices: leave one out")
    number = np.bincount(v, minlength=polygons.num_vertices)
    isolated = np.flatnonzero(number == 0)
    if isolated.size:
        raise ValueError(f"vertices {some_of(isolated)} are isolated: no face has them. Leave them out")


def check_edges(polygons: Polygons) -> None:
    """Raise ValueError if an edge has more than two faces."""
    edges = np.flatnonzero(polygons.edge_sizes > 2)
    if edges.size:
        pairs = as_tuples(polygons.edges[edges])
        faces = polygons.corner_faces[polygons.corner_edges == edges[0]]
        raise ValueError(
            f"edges {some_of(pairs)} have more than two faces (edge {pairs[0]}: faces "
            f"{some_of(faces)}): the mesh is not a manifold. Leave faces out, or give each sheet "
            f"vertices of its own"
        )


def check_orientation(polygons: Polygons) -> None:
    """Raise ValueError if two faces run along an edge in the same direction."""
    one, other = polygons.twins
    same = np.flatnonzero(polygons.vertices[one] == polygons.vertices[other])
    if same.size:
        corner = one[same[0]]
        begin, end = polygons.vertices[[corner, polygons.following[corner]]]
        faces = polygons.corner_faces[[corner, other[same[0]]]]
        more = f" (and so on at {same.size - 1} more edges)" if same.size > 1 else ""
        raise ValueError(
            f"faces {faces[0]} and {faces[1]} run along edge ({begin}, {end}) in the same "
            f"direction{more}: the mesh is not consistently oriented. "
            f"mesh.orient(vertices, faces) repairs it"
        )


def check_fans(polygons: Polygons) -> None:
    """Raise ValueError if the faces at a vertex make more than one fan."""
    # In an oriented mesh the corner after a corner's twin is at the same vertex, one face further.
    one, other = polygons.twins
    beyond = polygons.following[np.append(other, one)]
    graph = graph_of(np.append(one, other), beyond, polygons.vertices.size)
    number, fan = csgraph.connected_components(graph, directed=False)
    if number == polygons.num_vertices:
        return
    _, corners = np.unique(fan, return_index=True)
    fans = np.bincount(polygons.vertices[corners])
    vertices = np.flatnonzero(fans > 1)
    faces = np.unique(polygons.corner_faces[polygons.vertices == vertices[0]])
    raise ValueError(
        f"vertices {some_of(vertices)} join fans of faces that have no edge in common (vertex "
        f"{vertices[0]}: {fans[vertices[0]]} fans of faces {some_of(faces)}): the mesh is not a "
        f"manifold. Give each fan a vertex of its own"
    )


# Where the faces lie ------------------------------------------------------------------------------


def check_shapes(points: Floats, polygons: Polygons) -> None:
    """Raise ValueError if a face has two corners in one place, crosses itself or has no area."""
    diameter = np.linalg.norm(np.ptp(points, axis=0))
    if diameter == 0:
        raise ValueError(f"the mesh has no area: all its vertices are at {points[0].tolist()}")
    unit = (points - points.mean(axis=0)) / diameter  # squares of these neither overflow nor vanish
    corners = unit[polygons.vertices]
    together, crossing = [], []
    for steps, one, other in polygons.corner_pairs():
        together.append(one[_squared(corners[one] - corners[other]) <= COINCIDENT_CORNERS**2])
        if steps > 1:  # edges that have no corner in common
            crossing.append(one[_crossing(corners, polygons.following, one, other)])
    _refuse(polygons, together, "have two corners in one place: merge the vertices, or move one")
    _refuse(
        polygons,
        crossing,
        "cross themselves like a bow-tie: give the corners in the order around the face",
    )
    _check_areas(corners, polygons)


def _refuse(polygons: Polygons, corners: Sequence[Indices], what: str) -> None:
    """Raise ValueError for the faces of the corners, if there are any."""
    faces = np.unique(polygons.corner_faces[np.concatenate([*corners, np.zeros(0, np.int64)])])
    if faces.size:
        raise ValueError(f"faces {polygons.named(faces)} {what}")


def _check_areas(corners: Floats, polygons: Polygons) -> None:
    """Raise ValueError if a face has no area."""
    lengths = _squared(corners[polygons.following] - corners)
    scale = np.add.reduceat(lengths, polygons.offsets[:-1])
    areas = np.linalg.norm(face_areas(corners, polygons), axis=1)
    flat = np.flatnonzero(areas <= ZERO_AREA * scale)
    if flat.size == polygons.num_faces:
        raise ValueError("the mesh has no area: the corners of each face lie on a line")
    if flat.size:
        raise ValueError(
            f"faces {polygons.named(flat)} have no area, all corners on a line: move one, or leave the faces out"
        )


def _crossing(corners: Floats, following: Ints, one: Indices, other: Indices) -> Bools:
    """Tell whether the edges from two corners cross, for many twos.

    They do where the nearest points of their lines are inside both, at a distance that is small
    against that of their ends; in the plane it is 0. To project on the mean plane of a face would
    not do in space: that of a bow-tie is arbitrary, and a face far from plane may be good and yet
    cross itself there.
    """
    p, q, r, s = corners[one], corners[following[one]], corners[other], corners[following[other]]
    u, v, w = q - p, s - r, r - p
    uu, vv, uv, uw, vw = _squared(u), _squared(v), _dot(u, v), _dot(u, w), _dot(v, w)
    determinant = uu * vv - uv**2
    parallel = determinant <= PARALLEL * uu * vv
    determinant[parallel] = 1.0
    a, b = (vv * uw - uv * vw) / determinant, (uv * uw - uu * vw) / determinant
    inside = ~parallel & (a > 0) & (a < 1) & (b > 0) & (b < 1)
    gap = _squared(w - a[:, None] * u + b[:, None] * v)
    ends = np.minimum(_squared(q - r), _squared(s - p))
    return np.asarray(inside & (gap < CROSSING_GAP**2 * ends))


def _dot(x: Floats, y: Floats) -> Floats:
    return np.asarray(np.einsum("ij,ij->i", x, y))


def _squared(x: Floats) -> Floats:
    return _dot(x, x)
