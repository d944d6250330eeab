"""Compiled forms: a UFL form with the functions, constants and cells that its integrals need.

A form is integrated on the cells of the finest hierarchy among its arguments and coefficients, of which all others must
be coarsenings; on level 0 of the mesh if there is none. What lives on a coarser hierarchy is carried over exactly.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import scipy.sparse as sp

import ufl
from thccs_fem import element, jit
from thccs_fem.extraction import Cells
from thccs_fem.fem.function import Constant, Function
from thccs_fem.fem.space import FunctionSpace, functionspace
from thccs_fem.hierarchy import Hierarchy
from thccs_fem.mesh import ControlMesh, Domain
from ufl.algorithms import apply_algebra_lowering, apply_derivatives
from ufl.algorithms.estimate_degrees import SumDegreeEstimator
from ufl.corealg.map_dag import map_expr_dags
from ufl.corealg.traversal import traverse_unique_terminals
from ufl.domain import extract_domains

__all__ = ["Form", "Integral", "form"]

LEAST_DEGREE, LARGEST_DEGREE = 7, 11  # of the quadrature: 4 x 4 and 6 x 6 Gauss points

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


@dataclass(frozen=True, eq=False)
class Integral:
    """A compiled integral over cells.

    Attributes:
        kernel: Pointer to the compiled function, a `thccs_kernel *` of `jit.library()`.
        tag: Face tag of its cells; None for all cells.
        reads: Which of the form's coefficients it reads.
    """

    kernel: Any
    tag: int | None
    reads: tuple[bool, ...]


@dataclass(frozen=True, eq=False)
class Form:
    """A compiled form; make one with `form`.

    Attributes:
        ufl_form: The form, with the quadrature degrees that were used.
        spaces: Spaces of the arguments: none of a scalar, (test,) of a vector, (test, trial) of a matrix.
        coefficients: Functions in the order of the kernels.
        constants: Constants in the order of the kernels. Values of both are read at each assembly.
        integrals: What is summed.
        hierarchy: The finest hierarchy, whose cells are integrated on.
        cells: These cells.
        transfers: For each coarser hierarchy the matrix that carries its scalar functions to `hierarchy`.
        module: The compiled module, kept while its kernels are.
    """

    ufl_form: ufl.Form
    spaces: tuple[FunctionSpace, ...]
    coefficients: tuple[Function, ...]
    constants: tuple[Constant, ...]
    integrals: tuple[Integral, ...]
    hierarchy: Hierarchy
    cells: Cells
    transfers: Mapping[Hierarchy, sp.csr_array]
    module: ModuleType

    @property
    def rank(self) -> int:
        """Number of arguments: 0, 1 or 2."""
        return len(self.spaces)

    @property
    def mesh(self) -> ControlMesh:
        """The control mesh."""
        return self.hierarchy.mesh


def form(
    ufl_form: ufl.Form | Form, /, *, quadrature_degree: int | None = None, on: FunctionSpace | None = None
) -> Form:
    """Compile a UFL form, or load it from the cache.

    The quadrature of an integral is Gauss' rule for the degree in its metadata, as in
    ``dx(metadata={"quadrature_degree": 5})``; else for `quadrature_degree`; else for the degree of the integrand on a
    parallelogram, where arguments and functions count 3 and the geometry 0, but at least 7 (4 x 4 points) and at most
    11 (6 x 6). Where the space brings its own rule (`FunctionSpace.with_integration`), that one holds.

    Args:
        ufl_form: A sum of integrals over ``dx``, or ``dx(tag)`` with a face tag of the mesh, or ``dx((tag, tag))``. A
            compiled form is returned as it is.
        quadrature_degree: Degree where the metadata has none.
        on: A space that counts as one of the form's: its cells are integrated on where no other is finer.

    Raises:
        TypeError: It is no UFL form, or a coefficient or constant has no values.
        ValueError: It is zero, has no or several meshes, an unknown tag, an element other than THCCS, spaces that are
            not refinements of one another, a cell size, or a quadrature degree of its own on cells with another one.
        NotImplementedError: It has integrals other than dx.
        OSError: There is no C compiler, or the cache can't be written.
    """
    if isinstance(ufl_form, Form):
        return ufl_form
    _check_form(ufl_form)
    mesh = _mesh(ufl_form)
    for integral in ufl_form.integrals():
        _check_integral(integral, mesh)
    arguments = tuple(ufl_form.arguments())
    for function in (*arguments, *ufl_form.coefficients()):
        _check_space(function, function.ufl_function_space())
    _check_values(ufl_form)
    spaces = tuple(argument.ufl_function_space() for argument in arguments)
    all_spaces = [*spaces, *(function.function_space for function in ufl_form.coefficients())]
    all_spaces += [] if on is None else [on]
    finest = _finest(all_spaces) if all_spaces else functionspace(mesh, ("THCCS", element.DEGREE))
    cells = finest.integration_cells
    if cells.quadrature_degree is not None:
        quadrature_degree = cells.quadrature_degree
        _check_metadata(ufl_form, quadrature_degree)
    ufl_form = _with_quadrature(ufl_form, quadrature_degree)
    (compiled,), module = jit.compile_forms([ufl_form])
    given = ufl_form.coefficients()
    positions = [compiled.original_coefficient_positions[i] for i in range(compiled.num_coefficients)]
    return Form(
        ufl_form=ufl_form,
        spaces=spaces,
        coefficients=tuple(given[i] for i in positions),
        constants=tuple(ufl_form.constants()),
        integrals=_integrals(compiled, module),
        hierarchy=finest.hierarchy,
        cells=cells,
        transfers=_transfers(finest, all_spaces),
        module=module,
    )


def _check_form(ufl_form: object) -> None:
    if not isinstance(ufl_form, ufl.Form | ufl.ZeroBaseForm):
        given = type(ufl_form).__name__
        raise TypeError(f"form needs a sum of UFL integrals, got {given}: is there a * ufl.dx missing?")
    integrals = () if isinstance(ufl_form, ufl.ZeroBaseForm) else ufl_form.integrals()
    if all(isinstance(integral.integrand(), ufl.classes.Zero) for integral in integrals):
        raise ValueError(
            "the form is zero, so that nothing is known of its functions: for a zero right-hand side write "
            "fem.Constant(msh, 0.0) * v * ufl.dx"
        )


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
    if kind != "cell":
        measure = ufl.measure.integral_type_to_measure_name[kind]
        raise NotImplementedError(
            f"the form has an integral over {measure} ({kind}); only dx is implemented. On the boundary impose values "
            f"by fem.dirichletbc, or leave the term out for homogeneous natural conditions."
        )
    if integral.subdomain_data() is not None:
        raise ValueError(
            "the measure has subdomain_data; tags belong to the mesh here: ControlMesh(..., face_tags=tags) and dx(tag)"
        )
    for tag in ids if isinstance(ids, tuple) else (ids,):
        if tag != "everywhere" and not (tag >= 0 and (mesh.face_tags == tag).any()):
            known = sorted({int(t) for t in mesh.face_tags})
            raise ValueError(f"the form has dx({tag!r}), but tags are from 0, and those of the mesh are {known}")
    for terminal in traverse_unique_terminals(integral.integrand()):
        if isinstance(terminal, SIZES):
            raise ValueError(
                f"the form has {type(terminal).__name__}, which can't be computed on curved cells: hand the cell size "
                f"in as data, a fem.Function or fem.Constant, or weight the values of fem.assemble_cells with it"
            )


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


def _finest(spaces: Sequence[FunctionSpace]) -> FunctionSpace:
    """Return a space of which all the others are coarsenings."""
    for finest in spaces:
        if all(finest.is_refinement_of(other) for other in spaces):
            return finest
    listed = "\n".join(f"  {space!r}" for space in dict.fromkeys(spaces))
    raise ValueError(
        f"the form has functions in spaces of which none is a refinement of all the others:\n{listed}\n"
        f"Carry them to a common refinement (adapt.refine, adapt.transfer), or use fem.project. Spaces that differ by "
        f"with_integration share their coefficients: copy x.array."
    )


def _transfers(finest: FunctionSpace, spaces: Sequence[FunctionSpace]) -> dict[Hierarchy, sp.csr_array]:
    """Return the prolongations of scalar functions from all hierarchies that differ from the finest."""
    hierarchies = dict.fromkeys(space.hierarchy for space in spaces)
    return {
        coarse: finest.hierarchy.prolongation(coarse)
        for coarse in hierarchies
        if not (coarse is finest.hierarchy or coarse.same_as(finest.hierarchy))
    }


def _check_metadata(ufl_form: ufl.Form, degree: int) -> None:
    """Refuse rules other than that of the given degree."""
    for integral in ufl_form.integrals():
        metadata = integral.metadata()
        if metadata.get("quadrature_degree", degree) != degree or "quadrature_rule" in metadata:
            raise ValueError(
                f"the metadata {metadata} ask for a rule of their own, but the cells of the space are made for degree "
                f"{degree} alone: leave them out, or integrate on a space without with_integration"
            )


def _with_quadrature(ufl_form: ufl.Form, degree: int | None) -> ufl.Form:
    """Return the form with a quadrature degree in the metadata of each integral that has none."""
    integrals = []
    for integral in ufl_form.integrals():
        metadata = integral.metadata()
        if "quadrature_degree" not in metadata and metadata.get("quadrature_rule") != "custom":
            chosen = _quadrature_degree(integral) if degree is None else degree
            integral = integral.reconstruct(metadata={**metadata, "quadrature_degree": chosen})
        integrals.append(integral)
    return ufl.Form(integrals)


class _ParametricDegree(SumDegreeEstimator):
    """Degree of an integrand in each parameter on a parallelogram, of which the geometry is constant or smooth."""

    def geometric_quantity(self, v: ufl.core.expr.Expr) -> int:
        """Return 0 for normals, Jacobians and the like."""
        return 0

    def spatial_coordinate(self, v: ufl.core.expr.Expr) -> int:
        """Return 0: a given function of x is as smooth as it is, whatever the degree of the map."""
        return 0


def _quadrature_degree(integral: ufl.Integral) -> int:
    """Return the default degree: see `form`."""
    lowered = apply_derivatives.apply_derivatives(apply_algebra_lowering.apply_algebra_lowering(ufl.Form([integral])))
    integrands = [part.integrand() for part in lowered.integrals()]
    estimator = _ParametricDegree(element.DEGREE, {})  # type: ignore[no-untyped-call]  # the base class's __init__
    degrees = map_expr_dags(estimator, integrands)
    return min(max(LEAST_DEGREE, *degrees), LARGEST_DEGREE) if degrees else LEAST_DEGREE


def _integrals(compiled: Any, module: ModuleType) -> tuple[Integral, ...]:
    """Return the cell integrals, which come first, of a `ufcx_form`."""
    ffi = jit.library().ffi
    integrals = []
    for i in range(compiled.form_integral_offsets[0], compiled.form_integral_offsets[1]):
        integral, tag = compiled.form_integrals[i], compiled.form_integral_ids[i]
        address = int(module.ffi.cast("uintptr_t", integral.tabulate_tensor_float64))
        integrals.append(
            Integral(
                kernel=ffi.cast("thccs_kernel *", address),
                tag=None if tag == -1 else tag,  # FFCx's sign for "everywhere"
                reads=tuple(integral.enabled_coefficients[j] for j in range(compiled.num_coefficients)),
            )
        )
    return tuple(integrals)
