"""Compiled forms: what they are integrated on, with which quadrature, and what is refused."""

import dataclasses
import re
import warnings
from collections.abc import Callable

import numpy as np
import pytest

import basix.ufl
import ufl
from thccs_fem import element, fem, generators
from thccs_fem.fem.forms import Form
from thccs_fem.fem.space import FunctionSpace
from thccs_fem.mesh import ControlMesh
from thccs_fem.quadrature import paper_cells
from ufl import div, dP, dS, ds, dx, exp, grad, inner, sin


def tagged_mesh() -> ControlMesh:
    """Return a grid of 3 x 3 unit squares with tags 1, 2, 2, 0, ... in the order of the faces."""
    msh = generators.rectangle((3, 3))
    tags = [1, 2, 2, 0, 0, 0, 0, 0, 0]
    return ControlMesh(msh.vertices, msh.quads, face_tags=tags)


MESH = tagged_mesh()
V = fem.functionspace(MESH, ("THCCS", 3))
W = fem.functionspace(MESH, ("THCCS", 3, (2,)))
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
w = fem.Function(V, name="w")
x = ufl.SpatialCoordinate(MESH)


def refined(space: FunctionSpace, dofs: list[int]) -> FunctionSpace:
    return space.with_hierarchy(space.hierarchy.refined(np.array(dofs)))


def degrees(form: Form) -> list[int]:
    return [integral.metadata()["quadrature_degree"] for integral in form.ufl_form.integrals()]


# ---- Quadrature


@pytest.mark.parametrize(
    ("integrand", "degree"),
    [
        (u * v, 7),
        (inner(grad(u), grad(v)), 7),
        (div(grad(u)) * div(grad(v)), 7),
        (v, 7),
        (sin(x[0]) * v, 7),  # a given function of x does not count: the geometry's degree would make it 8
        ((w - exp(x[0])) ** 2, 7),
        (w * u * v, 9),
        (w**2 * v, 9),
        (w**5 * v, 11),
        (ufl.derivative(w**2 * v, w, u), 9),
    ],
    ids=str,
)
def test_quadrature_degree_is_that_on_a_parallelogram_within_bounds(integrand: ufl.core.expr.Expr, degree: int) -> None:
    assert degrees(fem.form(integrand * dx)) == [degree]


def test_quadrature_degree_of_the_user_is_kept() -> None:
    form = fem.form(u * v * dx(metadata={"quadrature_degree": 3}) + w * u * v * dx, quadrature_degree=5)
    assert sorted(degrees(form)) == [3, 5]
    assert degrees(fem.form(u * v * dx(metadata={"quadrature_rule": "GLL"}))) == [7]


def test_quadrature_points_of_the_user_are_kept() -> None:
    rule = {
        "quadrature_rule": "custom",
        "quadrature_points": np.array([[0.5, 0.5]]),
        "quadrature_weights": np.array([1.0]),
    }
    form = fem.form(x[0] ** 2 * dx(domain=MESH, metadata=rule))
    midpoints = (np.arange(3) + 0.5) / 3
    # On the unit square the map of each cell is affine: the midpoint rule is what it is called.
    assert fem.assemble_scalar(form) == pytest.approx((midpoints**2).sum() / 3, rel=1e-13)


# ---- What is in a form


def test_form_knows_its_functions_in_the_order_of_the_kernels() -> None:
    f, g = fem.Function(V, name="f"), fem.Function(V, name="g")
    c, d = fem.Constant(MESH, [1.0, 2.0]), fem.Constant(MESH, 3.0)
    # Differentiation drops f, the first of three.
    form = fem.form(ufl.derivative(d * f * g * w * c[1] * dx, f, v))
    assert set(form.ufl_form.coefficients()) == {f, g, w}
    assert set(form.coefficients) == {g, w}
    assert form.constants == (c, d)
    assert form.spaces == (V,)
    assert (form.rank, form.mesh, form.cells, form.transfers) == (1, MESH, V.cells, {})


def test_integrals_know_their_tags_and_coefficients() -> None:
    f = fem.Function(V)
    form = fem.form(f * v * dx(2) + w * v * dx + v * dx((0, 1)))
    used = {
        integral.tag: [c for c, reads in zip(form.coefficients, integral.reads, strict=True) if reads]
        for integral in form.integrals
    }
    assert used == {None: [w], 0: [], 1: [], 2: [f]}


def test_integrals_over_edges_know_their_kind_and_tag() -> None:
    msh = generators.rectangle((3, 3))
    edges = [tuple(map(int, edge)) for edge in msh.edges]
    inside = np.flatnonzero(msh.edge_faces[:, 1] >= 0)
    tags = {edges[inside[0]]: 4, edges[inside[1]]: 5, edges[msh.boundary_edges[0]]: 6}
    V = fem.functionspace(ControlMesh(msh.vertices, msh.quads, edge_tags=tags), ("THCCS", 3))
    f, v = fem.Function(V), ufl.TestFunction(V)
    form = fem.form(v * dx + f * v * ds(6) + v * ds + ufl.avg(v) * dS((5, 4)))
    found = [(integral.kind, integral.tag, integral.reads) for integral in form.integrals]
    assert found == [
        ("cell", None, (False,)),
        ("exterior_facet", None, (False,)),
        ("exterior_facet", 6, (True,)),
        ("interior_facet", 4, (False,)),
        ("interior_facet", 5, (False,)),
    ]


def test_quadrature_degree_on_edges_is_that_in_cells() -> None:
    assert degrees(fem.form(w * u * v * ds + ufl.jump(u) * ufl.avg(v) * dS)) == [9, 7]


def test_blocks_of_a_mixed_form_are_forms() -> None:
    mixed = ufl.MixedFunctionSpace(V, W)
    (u, p), (v, q) = ufl.TrialFunctions(mixed), ufl.TestFunctions(mixed)
    F = (inner(grad(u), grad(v)) + inner(p, q) + div(p) * v) * dx + u * q[1] * ds
    blocks = [[fem.form(block) for block in row] for row in ufl.extract_blocks(F)]
    assert [[form.spaces for form in row] for row in blocks] == [[(V, V), (V, W)], [(W, V), (W, W)]]
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    expected = fem.assemble_matrix(fem.form(inner(grad(u), grad(v)) * dx))
    assert (fem.assemble_matrix(blocks[0][0]) != expected).nnz == 0


def test_cells_may_be_those_of_a_cellwise_function() -> None:
    fine = refined(V, [V.num_dofs // 2])
    h = fem.cell_sizes(fine)
    form = fem.form(h**2 * v * dx)
    assert form.cells is fine.cells
    assert set(form.transfers) == {V.hierarchy}
    assert fem.form(constant * dx, on=fine).cells is fine.cells
    coarse = fem.cell_sizes(V)
    assert fem.form(coarse * ufl.TestFunction(fine) * dx).cells is fine.cells
    assert fem.assemble_scalar(fem.form(coarse**-2 * dx, on=fine)) == pytest.approx(V.num_cells, rel=1e-13)
    assert fem.assemble_scalar(fem.form(h**-2 * dx)) == pytest.approx(fine.num_cells, rel=1e-13)
    assert fem.form(constant * dx).cells.num_cells == MESH.num_faces


def test_compiled_form_is_returned_as_it_is() -> None:
    form = fem.form(v * dx)
    assert fem.form(form) is form
    with pytest.raises(dataclasses.FrozenInstanceError):
        form.module = None


def test_form_without_functions_is_on_level_0_of_its_mesh() -> None:
    form = fem.form(1.0 * dx(domain=MESH))
    assert (form.rank, form.mesh, form.cells.num_cells) == (0, MESH, 9)
    assert fem.assemble_scalar(form) == pytest.approx(1.0, rel=1e-14)


def test_form_without_functions_keeps_its_mesh() -> None:
    form = fem.form(1.0 * dx(domain=generators.rectangle((2, 2)).ufl_domain()))  # no other reference to that mesh
    assert fem.assemble_scalar(form) == pytest.approx(1.0, rel=1e-14)


# ---- Cells of the finest hierarchy


@pytest.mark.parametrize("order", [0, 1])
def test_cells_are_those_of_the_finest_space(order: int) -> None:
    fine = refined(V, [V.num_dofs // 2])
    spaces = (V, fine) if order == 0 else (fine, V)
    form = fem.form(ufl.TestFunction(spaces[0]) * fem.Function(spaces[1]) * dx)
    assert form.cells is fine.cells
    assert set(form.transfers) == {V.hierarchy}
    assert form.transfers[V.hierarchy].matrix.shape == (fine.num_dofs, V.num_dofs)


def test_equal_hierarchies_need_no_transfer() -> None:
    again = fem.functionspace(MESH, ("THCCS", 3))
    assert again.hierarchy is not V.hierarchy
    assert fem.form(ufl.TestFunction(V) * fem.Function(again) * dx).transfers == {}


def test_unrelated_refinements_are_refused_by_name() -> None:
    large = fem.functionspace(generators.rectangle((8, 8)), ("THCCS", 3))
    corner = np.argsort(large.reference_points.sum(axis=1))
    one, other = refined(large, [corner[0]]), refined(large, [corner[-1]])
    with pytest.raises(ValueError, match=r"none is a refinement of all the others:\n.*\n.*\n.*common refinement"):
        fem.form(fem.Function(one) * fem.Function(other) * dx)


def test_space_to_integrate_on_may_be_given() -> None:
    fine = refined(V, [V.num_dofs // 2])
    assert fem.form(w * dx, on=fine).cells is fine.cells
    assert fem.form(1.0 * dx(domain=MESH), on=fine).cells is fine.cells


# ---- Refused

lagrange = ufl.FunctionSpace(MESH.ufl_domain(), basix.ufl.element("Lagrange", "quadrilateral", 3))
other_mesh = ufl.Mesh(element.coordinate_element(2))
constant = fem.Function(fem.functionspace(MESH, ("DG", 0)))
n = ufl.FacetNormal(MESH)

REFUSED: dict[str, tuple[Callable[[], object], type[Exception], str]] = {
    "no form": (
        lambda: u * v,
        TypeError,
        "form needs a sum of UFL integrals, got Product: is there a * ufl.dx missing?",
    ),
    "zero": (lambda: 0 * v * dx(domain=MESH), ValueError, "the form is zero.*fem.Constant(msh, 0.0) * v * ufl.dx"),
    "points": (lambda: v * dP(domain=MESH), NotImplementedError, "over dP (vertex); there are dx, ds and dS only"),
    "argument of no side": (
        lambda: inner(grad(u), grad(v)) * dS,
        ValueError,
        "Discontinuous type Argument must be restricted. In integrals over dS .* write w('+'), w('-'), jump(w)",
    ),
    "coefficient of no side": (
        lambda: constant * v("+") * dS,
        ValueError,
        "Discontinuous type Coefficient must be restricted. In integrals over dS each side has its own value",
    ),
    "normal of no side": (lambda: n[0] * v("+") * dS, ValueError, "must be restricted. In integrals over dS"),
    "a side in dx": (lambda: v("+") * dx, ValueError, "the form has (v_0)(+) in dx: jump, avg, '+' and '-' have"),
    "a mean on the boundary": (
        lambda: ufl.avg(v) * ds,
        ValueError,
        "in ds: jump, avg, '+' and '-' have a meaning",
    ),
    "normal in dx": (lambda: n[0] * v * dx, ValueError, "the form has FacetNormal in dx: the normal of the boundary"),
    "subdomain data on edges": (
        lambda: v * ds(subdomain_data=[1]),
        ValueError,
        "tags belong to the mesh here: ControlMesh(..., edge_tags={(i, j): tag}) and ds(tag)",
    ),
    "unknown tag of edges": (lambda: v * ds(3), ValueError, "ds(3), but tags are from 0, and those of edges on its"),
    "cellwise argument": (
        lambda: ufl.TestFunction(constant.function_space) * dx,
        ValueError,
        "v_0 is constant on each cell, but test and trial .* integrals over each cell come from fem.assemble_cells",
    ),
    "several blocks": (
        lambda: sum(ufl.TestFunctions(ufl.MixedFunctionSpace(V, V))) * dx,
        ValueError,
        "of several blocks at once: take it apart by ufl.extract_blocks(F)",
    ),
    "subdomain data": (lambda: v * dx(subdomain_data=[1]), ValueError, "the measure has subdomain_data; tags belong"),
    "unknown tag": (
        lambda: v * dx(7),
        ValueError,
        "the form has dx(7), but tags are from 0, and those of the mesh are [0, 1, 2]",
    ),
    "unknown tag of two": (lambda: v * dx((1, 8)), ValueError, "the form has dx(8)"),
    "negative tag": (lambda: v * dx(-1), ValueError, "the form has dx(-1), but tags are from 0"),
    "Lagrange argument": (
        lambda: ufl.TestFunction(lagrange) * dx,
        ValueError,
        "v_0 has the element .*(P, quadrilateral, 3",
    ),
    "Lagrange function": (lambda: ufl.Coefficient(lagrange) * v * dx, ValueError, "w_.* has the element .*fem.project"),
    "no values": (
        lambda: ufl.Coefficient(V) * v * dx,
        TypeError,
        "is a Coefficient without values: use fem.Function(V)",
    ),
    "no value": (lambda: ufl.Constant(MESH) * v * dx, TypeError, "is a Constant without a value: use fem.Constant(msh"),
    "cell size": (
        lambda: ufl.CellDiameter(MESH) * v * dx,
        ValueError,
        "the form has CellDiameter, .* use h = fem.cell_sizes(V)",
    ),
    "cell volume": (lambda: ufl.CellVolume(MESH) * v * dx, ValueError, "the form has CellVolume"),
    "two meshes": (
        lambda: fem.Function(fem.functionspace(generators.rectangle((2, 2)), ("THCCS", 3))) * v * dx(domain=MESH),
        ValueError,
        "the form has measures or functions on 2 meshes",
    ),
    "coordinates of another mesh": (
        lambda: ufl.SpatialCoordinate(generators.rectangle((2, 2)))[0] * v * dx(domain=MESH),
        ValueError,
        "on 2 meshes",
    ),
    "other mesh": (lambda: 1.0 * dx(domain=other_mesh), ValueError, "not the domain of a control mesh"),
}


@pytest.mark.parametrize(("make", "error", "message"), REFUSED.values(), ids=REFUSED)
def test_what_is_refused_is_named(make: Callable[[], object], error: type[Exception], message: str) -> None:
    pattern = ".*".join(re.escape(part) for part in message.split(".*"))
    with pytest.raises(error, match=pattern):
        fem.form(make())


def test_edges_of_cells_for_dx_alone_are_refused() -> None:
    W = V.with_integration(paper_cells)
    v = ufl.TestFunction(W)
    with pytest.raises(ValueError, match="integrals over dS and ds, but its spaces come from with_integration"):
        fem.form(v * dx + v * ds + ufl.avg(v) * dS)
    assert fem.form(constant * v * dx).cells is W.integration_cells


# ---- Fourth order


def test_orders_are_those_of_the_arguments() -> None:
    f, n = fem.Function(V), ufl.FacetNormal(MESH)
    third = grad(div(grad(v)))[0]
    for integral, orders in (
        (u * v * dx, (0, 0)),
        (inner(grad(u), grad(v)) * dx, (1, 1)),
        (u * div(grad(v)) * dx, (2, 0)),
        (u.dx(0) * third * dx + div(grad(u)) * v * dx, (3, 2)),
        (div(grad(f)) * v * dx, (0,)),
        (div(grad(f)) * dx, ()),
        (ufl.jump(grad(ufl.TestFunction(W)[0].dx(1)), n) * dS, (2,)),
    ):
        assert fem.form(integral).orders == orders


WHEELS = {valence: generators.wheel(valence, 2) for valence in (3, 4, 5)}


@pytest.mark.parametrize(
    ("valence", "cap_level", "deep"), [(3, 4, 6), (3, 5, 6), (3, 6, 0), (4, 1, 0), (5, 4, 8), (5, 7, 8), (5, 8, 0)]
)
def test_shallow_caps_are_warned_of_where_arguments_have_second_derivatives(
    valence: int, cap_level: int, deep: int
) -> None:
    space = refined(fem.functionspace(WHEELS[valence], ("THCCS", 3), cap_level=cap_level), [0])
    u, v, f = ufl.TrialFunction(space), ufl.TestFunction(space), fem.Function(space)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        fem.form([div(grad(u)) * v * dx, div(grad(v)) * dx])
        fem.form([inner(grad(u), grad(v)) * dx, div(grad(f)) * v * dx, div(grad(f)) * dx])
        integrated_otherwise = space.with_integration(paper_cells)
        fem.form(div(grad(ufl.TestFunction(integrated_otherwise))) * dx)
    assert [warning.filename for warning in caught] == [__file__] * (2 if deep else 0)
    for warning in caught:
        text = str(warning.message)
        assert f"of valence {valence})" in text
        assert f"at cap_level={cap_level} " in text
        assert f"give functionspace cap_level={deep} " in text
