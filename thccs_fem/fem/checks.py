"""What a form must be before it is compiled: one mesh, functions with values, measures and tags that are there.

And what it should be: of fourth order on deep caps alone.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

import ufl
from thccs_fem.fem.function import Constant, Function
from thccs_fem.fem.space import CellwiseSpace, FunctionSpace
from thccs_fem.hierarchy import Hierarchy
from thccs_fem.mesh import ControlMesh, Domain
from thccs_fem.parallel import rank_of
from ufl.algorithms import apply_algebra_lowering, apply_derivatives
from ufl.corealg.traversal import unique_pre_traversal
from ufl.domain import extract_domains

__all__ = ["MEASURES", "argument_orders", "check_caps", "check_metadata", "check_no_facets", "checked_mesh", "lowered"]

# Cap levels at which the kinks of caps are no larger than other errors, by docs/fourth_order.md.
DEEP, DEEP_AT_VALENCE_3 = 8, 6

#: What is integrated over, in FFCx's order, and its measure.
MEASURES = {"cell": "dx", "exterior_facet": "ds", "interior_facet": "dS"}

EDGE_TAGS = "edge_tags={(i, j): tag}"
_ARGUMENTS = {"cell": "face_tags=tags", "exterior_facet": EDGE_TAGS, "interior_facet": EDGE_TAGS}

# FFCx knows them on affine cells only.
SIZES = (
    ufl.classes.CellVolume,
    ufl.classes.Circumradius,
    ufl.classes.CellDiameter,
    ufl.classes.MinCellEdgeLength,
    ufl.classes.MaxCellEdgeLength,
    ufl.classes.FacetArea,
    ufl.classes.MinFacetEdgeLength,
    ufl.classes.MaxFacetEdgeLength,
)


def checked_mesh(ufl_form: object) -> ControlMesh:
    """Return the mesh of a form that has all that is needed to compile it; `forms.form` lists what is raised."""
    form = _checked_form(ufl_form)
    mesh = _mesh(form)
    for integral in form.integrals():
        _check_integral(integral, mesh)
    _check_arguments(form)
    _check_values(form)
    return mesh


def check_no_facets(ufl_form: ufl.Form) -> None:
    """Refuse integrals over facets where pieces are not those of the surface.

    Raises:
        ValueError: If there are some.
    """
    measures = {MEASURES[integral.integral_type()] for integral in ufl_form.integrals()} - {"dx"}
    if measures:
        raise ValueError(
            f"the form has integrals over {' and '.join(sorted(measures))}, but its spaces come from with_integration, "
            f"which makes cells for dx alone: integrate over edges on the space it was called on"
        )


def check_metadata(ufl_form: ufl.Form, degree: int) -> None:
    """Refuse rules other than that of the given degree.

    Raises:
        ValueError: If an integral asks for one.
    """
    for integral in ufl_form.integrals():
        metadata = integral.metadata()
        if metadata.get("quadrature_degree", degree) != degree or "quadrature_rule" in metadata:
            raise ValueError(
                f"the metadata {metadata} ask for a rule of their own, but the cells of the space are made for degree "
                f"{degree} alone: leave them out, or integrate on a space without with_integration"
            )


def lowered(ufl_form: ufl.Form) -> ufl.Form:
    """Return a form with all derivatives taken: those that are left are of coefficients and arguments."""
    return apply_derivatives.apply_derivatives(apply_algebra_lowering.apply_algebra_lowering(ufl_form))


def argument_orders(ufl_form: ufl.Form) -> tuple[int, ...]:
    """Return how often each argument of a form is differentiated at the most, in the order of their numbers."""
    orders = dict.fromkeys(ufl_form.arguments(), 0)
    for integral in lowered(ufl_form).integrals():
        for node in unique_pre_traversal(integral.integrand()):
            times = 0
            while isinstance(node, ufl.classes.Grad):
                (node,), times = node.ufl_operands, times + 1
            if node in orders:
                orders[node] = max(orders[node], times)
    return tuple(orders.values())


def check_caps(ufl_form: ufl.Form, hierarchy: Hierarchy) -> None:
    """Warn of shallow caps where second derivatives of arguments see their kinks.

    Warns:
        UserWarning: There are some. On rank 0 alone.
    """
    root = hierarchy.root
    valences = root.vertex_num_faces[~root.regular & ~root.boundary]
    needed = 0 if not valences.size else DEEP_AT_VALENCE_3 if (valences == 3).all() else DEEP
    is_first = rank_of(hierarchy.mesh.comm) == 0
    if is_first and hierarchy.cap_level < needed and max(argument_orders(ufl_form), default=0) > 1:
        warnings.warn(
            f"the form has second derivatives of its test or trial function, and the mesh extraordinary vertices (of "
            f"valence {', '.join(map(str, np.unique(valences)))}), near which functions are C1 up to kinks in bicubic "
            f"caps. Of caps at cap_level={hierarchy.cap_level} these can be most of the error: give functionspace "
            f"cap_level={needed} (see docs/fourth_order.md)",
            skip_file_prefixes=(str(Path(__file__).parents[1]),),
        )


def _checked_form(ufl_form: object) -> ufl.Form:
    if not isinstance(ufl_form, ufl.Form | ufl.ZeroBaseForm):
        given = type(ufl_form).__name__
        raise TypeError(f"form needs a sum of UFL integrals, got {given}: is there a * ufl.dx missing?")
    integrals = () if isinstance(ufl_form, ufl.ZeroBaseForm) else ufl_form.integrals()
    if all(isinstance(integral.integrand(), ufl.classes.Zero) for integral in integrals):
        raise ValueError(
            "the form is zero, so that nothing is known of its functions: for a zero right-hand side write "
            "fem.Constant(msh, 0.0) * v * ufl.dx"
        )
    assert isinstance(ufl_form, ufl.Form)  # another one is empty
    return ufl_form


def _mesh(ufl_form: ufl.Form) -> ControlMesh:
    """Return the mesh of all measures, functions, constants and coordinates."""
    domains = {*ufl_form.ufl_domains(), *(d for integral in ufl_form.integrals() for d in extract_domains(integral))}
    if len(domains) != 1:
        raise ValueError(f"the form has measures or functions on {len(domains)} meshes: all must be on one")
    (domain,) = domains
    if not isinstance(domain, Domain):
        raise ValueError(
            f"the form is on {domain!r}, which is not the domain of a control mesh: use functions of a space from "
            f"fem.functionspace(msh, ...), or dx(domain=msh)"
        )
    return domain.control_mesh


def _check_integral(integral: ufl.Integral, mesh: ControlMesh) -> None:
    """Refuse what is not integrated here, or would be integrated wrongly."""
    kind, ids = integral.integral_type(), integral.subdomain_id()
    if kind not in MEASURES:
        measure = ufl.measure.integral_type_to_measure_name[kind]
        raise NotImplementedError(
            f"the form has an integral over {measure} ({kind}); there are dx, ds and dS only. Values at points come "
            f"from Function.eval and fem.point_values."
        )
    if integral.subdomain_data() is not None:
        raise ValueError(
            f"the measure has subdomain_data; tags belong to the mesh here: ControlMesh(..., {_ARGUMENTS[kind]}) and "
            f"{MEASURES[kind]}(tag)"
        )
    known = _known_tags(mesh, kind)
    for tag in ids if isinstance(ids, tuple) else (ids,):
        if tag != "everywhere" and not (tag >= 0 and tag in known):
            of_what = {"cell": "the mesh", "exterior_facet": "edges on its boundary"}.get(kind, "edges inside it")
            raise ValueError(
                f"the form has {MEASURES[kind]}({tag!r}), but tags are from 0, and those of {of_what} are "
                f"{sorted(known)}; they are given to the mesh: ControlMesh(..., {_ARGUMENTS[kind]})"
            )
    for node in unique_pre_traversal(integral.integrand()):
        if isinstance(node, SIZES):
            raise ValueError(
                f"the form has {type(node).__name__}, which can't be computed on curved cells: use "
                f"h = fem.cell_sizes(V), the root of the area of each cell, in dS avg(h)"
            )
        if isinstance(node, ufl.classes.FacetNormal) and kind == "cell":
            raise ValueError("the form has FacetNormal in dx: the normal of the boundary is known in ds and dS only")
        if isinstance(node, ufl.classes.Restricted) and kind != "interior_facet":
            raise ValueError(
                f"the form has {node} in {MEASURES[kind]}: jump, avg, '+' and '-' have a meaning in dS alone"
            )


def _known_tags(mesh: ControlMesh, kind: str) -> set[int]:
    """Return the tags that an integral can have."""
    if kind == "cell":
        return {int(t) for t in mesh.face_tags}
    tags = list(mesh.edge_tags.values())
    pairs = [list(pair) for pair in mesh.edge_tags]
    on_boundary = mesh.edge_faces[mesh.edge_indices(pairs), 1] < 0 if pairs else []
    return {tag for tag, outer in zip(tags, on_boundary, strict=True) if outer == (kind == "exterior_facet")}


def _check_arguments(ufl_form: ufl.Form) -> None:
    arguments = ufl_form.arguments()
    if len({argument.number() for argument in arguments}) < len(arguments):
        raise ValueError(
            f"the form has the test or trial functions {', '.join(map(str, arguments))} of several blocks at once: "
            f"take it apart by ufl.extract_blocks(F), and compile each block"
        )
    for argument in arguments:
        space = argument.ufl_function_space()
        if isinstance(space, CellwiseSpace):
            raise ValueError(
                f"{argument} is constant on each cell, but test and trial functions must be in spaces from "
                f'fem.functionspace(msh, ("THCCS", 3)): integrals over each cell come from fem.assemble_cells'
            )
        _check_space(argument, space)
    for coefficient in ufl_form.coefficients():
        if not isinstance(coefficient.ufl_function_space(), CellwiseSpace):
            _check_space(coefficient, coefficient.ufl_function_space())


def _check_space(function: ufl.core.expr.Expr, space: ufl.FunctionSpace) -> None:
    if not isinstance(space, FunctionSpace):
        raise ValueError(
            f"{function} has the element {space.ufl_element()!r}, but all arguments and functions of a form must be in "
            f'spaces from fem.functionspace(msh, ("THCCS", 3)): use fem.project to carry others over'
        )


def _check_values(ufl_form: ufl.Form) -> None:
    """Refuse UFL's own coefficients and constants."""
    for coefficient in ufl_form.coefficients():
        if not isinstance(coefficient, Function):
            raise TypeError(f"{coefficient} is a {type(coefficient).__name__} without values: use fem.Function(V)")
    for constant in ufl_form.constants():
        if not isinstance(constant, Constant):
            raise TypeError(f"{constant} is a {type(constant).__name__} without a value: use fem.Constant(msh, value)")
