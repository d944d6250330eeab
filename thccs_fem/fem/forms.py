"""Compiled forms: a UFL form with the functions, constants and cells that its integrals need.

A form is integrated on the cells of the finest hierarchy among its arguments and coefficients, of which all others must
be coarsenings; on level 0 of the mesh if there is none. What lives on a coarser hierarchy is carried over exactly.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from types import ModuleType
from typing import Any, overload

import ufl
from thccs_fem import element, jit
from thccs_fem.extraction import Cells, extract
from thccs_fem.fem.checks import (
    MEASURES,
    argument_orders,
    check_caps,
    check_metadata,
    check_no_facets,
    checked_mesh,
    lowered,
)
from thccs_fem.fem.function import Constant, Function
from thccs_fem.fem.space import CellwiseSpace, FunctionSpace, functionspace
from thccs_fem.hierarchy import Hierarchy
from thccs_fem.mesh import ControlMesh
from thccs_fem.prolongation import Prolongation
from ufl.algorithms.estimate_degrees import SumDegreeEstimator
from ufl.corealg.map_dag import map_expr_dags

__all__ = ["Form", "Integral", "form"]

LEAST_DEGREE, LARGEST_DEGREE = 7, 11  # of the quadrature: 4 x 4 and 6 x 6 Gauss points, 4 and 6 on facets

Space = FunctionSpace | CellwiseSpace


@dataclass(frozen=True, eq=False)
class Integral:
    """A compiled integral.

    Attributes:
        kind: What it is over: "cell", "exterior_facet" or "interior_facet".
        kernel: Pointer to the compiled function, a `thccs_kernel *` of `jit.library()`.
        tag: Face tag of its cells, or edge tag of its facets; None for all.
        reads: Which of the form's coefficients it reads.
    """

    kind: str
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
        transfers: For each coarser hierarchy what carries its scalar functions to `hierarchy`.
        module: The compiled module, kept while its kernels are.
    """

    ufl_form: ufl.Form
    spaces: tuple[FunctionSpace, ...]
    coefficients: tuple[Function, ...]
    constants: tuple[Constant, ...]
    integrals: tuple[Integral, ...]
    hierarchy: Hierarchy
    cells: Cells
    transfers: Mapping[Hierarchy, Prolongation]
    module: ModuleType

    @property
    def rank(self) -> int:
        """Number of arguments: 0, 1 or 2."""
        return len(self.spaces)

    @property
    def mesh(self) -> ControlMesh:
        """The control mesh."""
        return self.hierarchy.mesh

    @cached_property
    def orders(self) -> tuple[int, ...]:
        """How often each argument is differentiated at the most: none of a scalar, (test,), or (test, trial)."""
        return argument_orders(self.ufl_form)


@overload
def form(
    ufl_form: ufl.Form | Form, /, *, quadrature_degree: int | None = None, on: FunctionSpace | None = None
) -> Form: ...


@overload
def form(
    ufl_form: Sequence[Any], /, *, quadrature_degree: int | None = None, on: FunctionSpace | None = None
) -> list[Any]: ...


def form(
    ufl_form: ufl.Form | Form | Sequence[Any],
    /,
    *,
    quadrature_degree: int | None = None,
    on: FunctionSpace | None = None,
) -> Form | list[Any]:
    """Compile a UFL form, or load it from the cache; or a list of them, or of lists, where None stays None.

    The quadrature of an integral is Gauss' rule for the degree in its metadata, as in
    ``dx(metadata={"quadrature_degree": 5})``; else for `quadrature_degree`; else for the degree of the integrand on a
    parallelogram, where arguments and functions count 3 and the geometry 0, but at least 7 (4 points along each side)
    and at most 11 (6). Where the space brings its own rule (`FunctionSpace.with_integration`), that one holds.

    Args:
        ufl_form: A sum of integrals over ``dx``, the surface, ``ds``, its boundary, and ``dS``, the edges between
            cells; or over parts, ``dx(tag)`` or ``dx((tag, tag))`` with face tags of the mesh, ``ds(tag)`` and
            ``dS(tag)`` with its edge tags. Edges are divided where finer cells meet a coarser one. A compiled form is
            returned as it is.
        quadrature_degree: Degree where the metadata has none.
        on: A space that counts as one of the form's: its cells are integrated on where no other is finer.

    Raises:
        TypeError: It is no UFL form, or a coefficient or constant has no values.
        ValueError: It is zero, has no or several meshes, an unknown tag, other elements, spaces that are not
            refinements of one another, a cell size, functions of several blocks, something in dS that is not
            restricted to one side, or, on cells with a quadrature of their own, another one or integrals over facets.
        NotImplementedError: It has integrals other than dx, ds and dS.
        OSError: There is no C compiler, or the cache can't be written.

    Warns:
        UserWarning: Arguments have second derivatives, and caps at extraordinary vertices are too shallow for that.
    """
    if isinstance(ufl_form, Form):
        return ufl_form
    if isinstance(ufl_form, Sequence):
        return [None if f is None else form(f, quadrature_degree=quadrature_degree, on=on) for f in ufl_form]
    mesh = checked_mesh(ufl_form)
    spaces = tuple(argument.ufl_function_space() for argument in ufl_form.arguments())
    all_spaces: list[Space] = [*spaces, *(function.function_space for function in ufl_form.coefficients())]
    all_spaces += [] if on is None else [on]
    finest = _finest(all_spaces) if all_spaces else functionspace(mesh, ("THCCS", element.DEGREE))
    cells = finest.integration_cells
    hierarchy = cells.hierarchy if finest.hierarchy is None else finest.hierarchy
    if finest.integration is extract:
        check_caps(ufl_form, hierarchy)
    else:
        check_no_facets(ufl_form)
    if cells.quadrature_degree is not None:
        quadrature_degree = cells.quadrature_degree
        check_metadata(ufl_form, quadrature_degree)
    degrees, compiled, module = _compiled(ufl_form, quadrature_degree)
    given = ufl_form.coefficients()
    positions = [compiled.original_coefficient_positions[i] for i in range(compiled.num_coefficients)]
    return Form(
        ufl_form=_with_degrees(ufl_form, degrees),
        spaces=spaces,
        coefficients=tuple(given[i] for i in positions),
        constants=tuple(ufl_form.constants()),
        integrals=_integrals(compiled, module),
        hierarchy=hierarchy,
        cells=cells,
        transfers=_transfers(hierarchy, all_spaces),
        module=module,
    )


def _finest(spaces: Sequence[Space]) -> Space:
    """Return a space of which all the others are coarsenings."""
    for finest in sorted(spaces, key=lambda space: isinstance(space, CellwiseSpace)):
        if all(finest.is_refinement_of(other) for other in spaces):
            return finest
    listed = "\n".join(f"  {space!r}" for space in dict.fromkeys(spaces))
    raise ValueError(
        f"the form has functions in spaces of which none is a refinement of all the others:\n{listed}\n"
        f"Carry them to a common refinement (adapt.refine, adapt.transfer), or use fem.project. Spaces that differ by "
        f"with_integration share their coefficients: copy x.array."
    )


def _transfers(finest: Hierarchy, spaces: Sequence[Space]) -> dict[Hierarchy, Prolongation]:
    """Return the prolongations of scalar functions from all hierarchies that differ from the finest."""
    hierarchies = dict.fromkeys(space.hierarchy for space in spaces if isinstance(space, FunctionSpace))
    return {
        coarse: Prolongation(finest, coarse)
        for coarse in hierarchies
        if not (coarse is finest or coarse.same_as(finest))
    }


_known: dict[tuple[str, int | None], tuple[list[int | None], Any, ModuleType]] = {}


def _compiled(ufl_form: ufl.Form, degree: int | None) -> tuple[list[int | None], Any, ModuleType]:
    """Return the degrees to be added to a form's integrals, the `ufcx_form`, and its module.

    They are kept by the form's signature, which a process sees again and again: each step of an adaptive run has its
    own spaces, but the same forms.
    """
    key = ufl_form.signature(), degree
    if key not in _known:
        degrees = _degrees(ufl_form, degree)
        _known[key] = degrees, *_newly_compiled(_with_degrees(ufl_form, degrees))
    return _known[key]


def _newly_compiled(ufl_form: ufl.Form) -> tuple[Any, ModuleType]:
    """Return the `ufcx_form` and its module; say what UFL misses on facets."""
    try:
        (compiled,), module = jit.compile_forms([ufl_form])
    except Exception as error:
        if "restrict" not in str(error).lower() or isinstance(error, OSError):
            raise
        raise ValueError(
            f"{error} In integrals over dS each side has its own value of gradients, normals and functions that are "
            f"constant on cells: write w('+'), w('-'), jump(w), avg(w) or jump(w, n)"
        ) from error
    return compiled, module


def _degrees(ufl_form: ufl.Form, degree: int | None) -> list[int | None]:
    """Return the quadrature degree of each integral that has none in its metadata, None for the others."""
    chosen: list[int | None] = []
    for integral in ufl_form.integrals():
        metadata = integral.metadata()
        if "quadrature_degree" in metadata or metadata.get("quadrature_rule") == "custom":
            chosen.append(None)
        else:
            chosen.append(_quadrature_degree(integral) if degree is None else degree)
    return chosen


def _with_degrees(ufl_form: ufl.Form, degrees: list[int | None]) -> ufl.Form:
    """Return the form with quadrature degrees in the metadata of its integrals, where there are any to be added."""
    if all(degree is None for degree in degrees):
        return ufl_form
    integrals = []
    for integral, degree in zip(ufl_form.integrals(), degrees, strict=True):
        if degree is not None:
            integral = integral.reconstruct(metadata={**integral.metadata(), "quadrature_degree": degree})
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
    integrands = [part.integrand() for part in lowered(ufl.Form([integral])).integrals()]
    estimator = _ParametricDegree(element.DEGREE, {})  # type: ignore[no-untyped-call]  # the base class's __init__
    degrees = map_expr_dags(estimator, integrands)
    return min(max(LEAST_DEGREE, *degrees), LARGEST_DEGREE) if degrees else LEAST_DEGREE


def _integrals(compiled: Any, module: ModuleType) -> tuple[Integral, ...]:
    """Return the integrals of a `ufcx_form`, which stand there kind by kind."""
    ffi = jit.library().ffi
    integrals = []
    for block, kind in enumerate(MEASURES):
        for i in range(compiled.form_integral_offsets[block], compiled.form_integral_offsets[block + 1]):
            integral, tag = compiled.form_integrals[i], compiled.form_integral_ids[i]
            address = int(module.ffi.cast("uintptr_t", integral.tabulate_tensor_float64))
            integrals.append(
                Integral(
                    kind=kind,
                    kernel=ffi.cast("thccs_kernel *", address),
                    tag=None if tag == -1 else tag,  # FFCx's sign for "everywhere"
                    reads=tuple(integral.enabled_coefficients[j] for j in range(compiled.num_coefficients)),
                )
            )
    return tuple(integrals)
