"""The main demo on meshes as people have them: a folder of them, named by THCCS_MESHES, and some as nasty made here."""

import os
import runpy
from collections.abc import Callable, Sequence
from math import cos, pi, sin
from pathlib import Path

import numpy as np
import pytest

from thccs_fem import generators
from thccs_fem.mesh import ControlMesh
from thccs_fem.subdivision import subdivided

DEMO = Path(__file__).parents[1] / "demos" / "laplace_on_surface.py"
STEPS = 3

FOLDER = os.environ.get("THCCS_MESHES")
FILES = sorted(path for path in Path(FOLDER or "").glob("*") if FOLDER and path.suffix in {".obj", ".msh"})

Points = Sequence[Sequence[float]]
Polygons = Sequence[Sequence[int]]


def run_demo(path: Path, out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run the demo, which checks its own figures, and see that each step refines and that there are results."""
    monkeypatch.setattr("sys.argv", [DEMO.name, "--mesh", str(path), "--steps", str(STEPS), "--out", str(out)])
    found = runpy.run_path(str(DEMO), run_name="__main__")
    dofs = [step.dofs for step in found["history"].steps]
    assert len(dofs) == STEPS + 1
    assert (np.diff(dofs) > 0).all()
    for name in ("laplace.vtu", "laplace.png"):
        assert (out / name).stat().st_size > 1000


@pytest.mark.skipif(FOLDER is None, reason="the environment variable THCCS_MESHES names no folder of meshes")
def test_the_folder_holds_meshes() -> None:
    assert FILES, f"no .obj or .msh file in {FOLDER}"


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_demo_on_the_meshes_of_a_folder(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run_demo(path, tmp_path, monkeypatch)


# ---- Meshes made here


def as_obj(points: Points, faces: Polygons) -> str:
    """Return an OBJ file; points in the plane get z = 0."""
    lines = ["v " + " ".join(f"{x:.17g}" for x in (*point, 0.0)[:3]) for point in points]
    lines += ["f " + " ".join(str(vertex + 1) for vertex in face) for face in faces]
    return "\n".join(lines) + "\n"


def of_mesh(msh: ControlMesh) -> tuple[Points, Polygons]:
    faces = np.split(msh.face_vertices, msh.face_offsets[1:-1])
    return msh.vertices.tolist(), [face.tolist() for face in faces]


def cube() -> tuple[Points, Polygons]:
    """All vertices of valence 3, so that the functions of level 0 are dependent."""
    return of_mesh(generators.cube_sphere(1))


def cut_in_two() -> tuple[Points, Polygons]:
    """A torus with an interior vertex of valence 2 in each face of a row: two quads that share two sides."""
    points, faces = of_mesh(generators.torus((12, 6)))
    kept = []
    for f, (a, b, c, d) in enumerate(faces):
        if f % 6 == 1:
            kept += [[a, b, c, len(points)], [a, len(points), c, d]]
            points.append(np.mean([points[v] for v in (a, b, c, d)], axis=0).tolist())
        else:
            kept.append([a, b, c, d])
    return points, kept


def tetrahedra() -> tuple[Points, Polygons]:
    """Two tetrahedra, subdivided once: every face has two extraordinary vertices."""
    corners = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]])
    sides = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
    apart = corners + np.array([4.0, 0.0, 0.0])
    return of_mesh(subdivided(ControlMesh(np.vstack([corners, apart]), [*sides, *(sides + 4)])))


def prism() -> tuple[Points, Polygons]:
    """Two pentagons and ten triangles: no quad at all, all vertices of valence 5 or 4."""
    ring = [2 * pi * k / 5 for k in range(5)]
    points = [(cos(t), sin(t), -0.6) for t in ring] + [(cos(t + pi / 5), sin(t + pi / 5), 0.6) for t in ring]
    below = [(k, (k + 1) % 5, 5 + k) for k in range(5)]
    above = [((k + 1) % 5, 5 + (k + 1) % 5, 5 + k) for k in range(5)]
    return points, [(4, 3, 2, 1, 0), (5, 6, 7, 8, 9), *below, *above]


def house() -> tuple[Points, Polygons]:
    """In the plane: a pentagon, a quad and two triangles."""
    points = [(0, 0), (2, 0), (2, 1), (1, 1), (0, 1), (1, 2), (2.5, 2.0), (-0.5, 2.0)]
    return points, [(0, 1, 2, 3, 4), (3, 2, 6, 5), (3, 5, 4), (4, 5, 7)]


def sphere_with_poles() -> tuple[Points, Polygons]:
    """Sixty-four triangles meet at either pole."""
    n, heights = 64, np.linspace(-1.0, 1.0, 10)[1:-1] * pi / 2
    rings = [(cos(h) * cos(2 * pi * k / n), cos(h) * sin(2 * pi * k / n), sin(h)) for h in heights for k in range(n)]
    south, north = len(rings), len(rings) + 1
    sides = [
        (n * r + k, n * r + (k + 1) % n, n * (r + 1) + (k + 1) % n, n * (r + 1) + k)
        for r in range(len(heights) - 1)
        for k in range(n)
    ]
    last = n * (len(heights) - 1)
    caps = [((k + 1) % n, k, south) for k in range(n)] + [(last + k, last + (k + 1) % n, north) for k in range(n)]
    return [*rings, (0, 0, -1), (0, 0, 1)], [*sides, *caps]


def components() -> tuple[Points, Polygons]:
    """A torus, a cube, a bent plate, and a single triangle, apart from one another."""
    plate = generators.rectangle((3, 2))
    bent = ControlMesh(np.column_stack([plate.vertices, plate.vertices[:, 0] ** 2]), plate.quads)
    triangle = ControlMesh([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 2)])
    points: list[list[float]] = []
    faces: list[list[int]] = []
    for k, part in enumerate([generators.torus((6, 4)), generators.cube_sphere(1), bent, triangle]):
        vertices, polygons = of_mesh(part)
        faces += [[vertex + len(points) for vertex in face] for face in polygons]
        points += [[x + 5.0 * k, y, z] for x, y, z in vertices]
    return points, faces


def plus() -> tuple[Points, Polygons]:
    """Five squares in the plane with a hole in the middle: eight reentrant corners, none of them tagged."""
    inside = [(i, j) for i in range(9) for j in range(9) if (3 <= i < 6 or 3 <= j < 6) and (i, j) != (4, 4)]
    number: dict[tuple[int, int], int] = {}
    faces = [
        [number.setdefault(p, len(number)) for p in ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1))] for i, j in inside
    ]
    return list(number), faces


def folded_plate() -> tuple[Points, Polygons]:
    """An L in space, bent along a line, with a reentrant corner and another on the bend."""
    points, faces = of_mesh(generators.l_domain(3))
    return [(x, y, abs(x) / 2 + y**2 / 4) for x, y in points], faces


def band() -> tuple[Points, Polygons]:
    """One face wide, so that every vertex lies on the rim, and closed."""
    ring = [2 * pi * k / 7 for k in range(7)]
    points = [(cos(t), sin(t), z) for z in (0.0, 0.5) for t in ring]
    return points, [(k, (k + 1) % 7, 7 + (k + 1) % 7, 7 + k) for k in range(7)]


def needles() -> tuple[Points, Polygons]:
    """A tube whose faces are 300 times as long as they are wide."""
    points, faces = of_mesh(generators.torus((6, 12)))
    return [(100.0 * x, 100.0 * y, z / 3) for x, y, z in points], faces


NASTY = [
    cube,
    cut_in_two,
    tetrahedra,
    prism,
    house,
    sphere_with_poles,
    components,
    plus,
    folded_plate,
    band,
    needles,
]


@pytest.mark.parametrize("make", NASTY, ids=lambda make: make.__name__)
def test_demo_on_a_nasty_mesh(
    make: Callable[[], tuple[Points, Polygons]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / f"{make.__name__}.obj"
    path.write_text(as_obj(*make()))
    run_demo(path, tmp_path / "out", monkeypatch)
