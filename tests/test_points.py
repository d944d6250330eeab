"""Values at points: what Function.eval says, the exact limit surface, and forces as loads."""

import numpy as np
import pytest
from problems import randomly_refined
from refinements import geometry_dofs, random_positions
from zoo import ZOO

import ufl
from thccs_fem import fem, generators, limit
from thccs_fem.mesh import ControlMesh

SCALAR = ("THCCS", 3)


@pytest.mark.parametrize("boundary", ["clamped", "crease"])
@pytest.mark.parametrize("name", ZOO)
def test_values_are_those_of_functions(name: str, boundary: str) -> None:
    V = randomly_refined(fem.functionspace(ZOO[name](), ("THCCS", 3, (2,)), boundary=boundary), times=2)
    u = fem.Function(V)
    u.x.array = np.random.default_rng(0).standard_normal(V.num_dofs)
    points = random_positions(V.hierarchy, 40)
    matrix = fem.point_values(V, *points)
    assert matrix.shape == (40, V.num_functions)
    values = matrix @ u.x.array.reshape(-1, 2)
    np.testing.assert_allclose(values, u.eval(*points), atol=1e-12)  # sums of up to 100 products of size 1
    np.testing.assert_allclose(matrix.sum(axis=1), 1.0, rtol=1e-13)


@pytest.mark.parametrize("msh", [generators.torus((6, 5)), generators.l_domain(3)], ids=["torus", "l_domain"])
def test_points_are_on_the_limit_surface(msh: ControlMesh) -> None:
    V = randomly_refined(fem.functionspace(msh, SCALAR))
    rng = np.random.default_rng(1)
    faces, uv = rng.integers(0, msh.num_faces, 30), rng.random((30, 2))
    # The reentrant corner of the L-domain ends in a cap: points farther from it than that are exact.
    far = np.linalg.norm(limit.evaluate(msh, faces, uv, derivatives=0)[0], axis=1) > 0.1
    points = fem.point_values(V, faces[far], uv[far]) @ geometry_dofs(V.hierarchy)
    np.testing.assert_allclose(points, limit.evaluate(msh, faces[far], uv[far], derivatives=0)[0], atol=1e-13)


def test_forces_are_loads() -> None:
    # Forces with the weights of Gauss' rule on one face are its pressure, integrated by that rule.
    plain = generators.rectangle((3, 2), upper=(3.0, 2.0))
    msh = ControlMesh(plain.vertices, plain.quads, face_tags=[0, 0, 0, 0, 1, 0])
    V = fem.functionspace(msh, ("THCCS", 3, (2,)))
    t, w = np.polynomial.legendre.leggauss(4)
    u, v = np.meshgrid((t + 1.0) / 2.0, (t + 1.0) / 2.0)
    forces = np.outer(w, w).ravel()[:, None] / 4.0 * [2.0, -1.0]
    load = (fem.point_values(V, np.full(16, 4), np.stack([u.ravel(), v.ravel()], axis=1)).T @ forces).ravel()
    pressure = ufl.dot(fem.Constant(msh, [2.0, -1.0]), ufl.TestFunction(V)) * ufl.dx(1)
    np.testing.assert_allclose(load, fem.assemble_vector(fem.form(pressure)), atol=1e-15)


def test_positions_are_checked() -> None:
    V = fem.functionspace(ZOO["polygons"](), SCALAR)
    with pytest.raises(ValueError, match="the mesh has faces 0 to"):
        fem.point_values(V, [V.mesh.num_faces], [[0.5, 0.5]])
    with pytest.raises(ValueError, match=r"both must lie in \[0, 1\]"):
        fem.point_values(V, [0], [[0.5, 1.5]], [0])
    assert fem.point_values(V, np.zeros(0, dtype=int), np.zeros((0, 2))).shape == (0, V.num_functions)
