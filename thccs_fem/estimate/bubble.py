"""Local problems on the bubbles of each cell."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

import ufl
from thccs_fem.estimate.indicators import check_function
from thccs_fem.fem.assembly import bubble_energies
from thccs_fem.fem.forms import Form, form
from thccs_fem.fem.function import Function
from thccs_fem.fem.space import FunctionSpace
from thccs_fem.parallel import gathered

__all__ = ["bubble"]

Floats = npt.NDArray[np.float64]


def bubble(uh: Function, a: ufl.Form | Form, L: ufl.Form | Form | None = None) -> Floats:
    """Return the bubble indicators: the energy norms of the error's projections onto four bubble functions a cell.

    In each cell, for all components together, the local problem for a combination z of bubbles is

        a(z, b) = L(b) - a(uh, b)    for all bubbles b of the cell,        eta^2 = |a(z, z)|,

    the problem that uh solves, as it was written, with its quadrature. Of a nonlinear one give the form F that vanishes
    for the solution, ``bubble(uh, F)`` with F in uh itself and a test function: then a is the derivative of F at uh,
    and -F(uh; b) the right-hand side.

    Bubbles are polynomials, bicubic in the cell, that vanish on its edges: they are continuous, but not in the space,
    which is smoother. An irregular cell has four as well, over all its pieces. For a fourth-order equation, whose forms
    have second derivatives of the test function, they are bicubic in each quarter of the cell, and C1: value and
    normal derivative vanish on the edges.

    If a is symmetric and positive definite, eta is at most the energy norm of the error in the cell, up to quadrature;
    what it misses is the part of the error that lives on the edges. At fourth order that can be all of it, where forces
    on the edges are in balance with themselves (docs/fourth_order.md). It is an indicator for equations in a coercive
    form: of a pure advection a(z, z) is zero.

    Args:
        uh: The approximation; the indicators belong to its cells.
        a: Bilinear form in trial and test functions of the space of uh; or F, if L is left out.
        L: Linear form in a test function of that space. Bubbles do not see integrals over edges.

    Returns:
        Shape (cells.num_owned,), those of the cells that this rank owns.

    Raises:
        TypeError: If uh is no function.
        ValueError: If forms and uh have different spaces or functions on finer cells; F does not depend on uh; or the
            local problem of a cell has no solution.
    """
    check_function(uh)
    V = uh.function_space
    bilinear, linear = _linearised(uh, a) if L is None else (form(a), form(L))
    _check_problem(V, bilinear, linear)
    squares = np.abs(bubble_energies(bilinear, linear, None if L is None else uh))
    _check_solved(V, np.flatnonzero(np.isinf(squares)))
    return np.sqrt(squares)


def _linearised(uh: Function, F: ufl.Form | Form) -> tuple[Form, Form]:
    """Return the derivative of F at uh, and F."""
    residual = form(F)
    if residual.rank != 1:
        raise ValueError(
            f"the form has {residual.rank} arguments and L is left out: give a and L of a linear problem, or the "
            f"residual F(uh; v) of a nonlinear one, with one test function"
        )
    if uh not in residual.ufl_form.coefficients():
        raise ValueError(
            f"F does not depend on {uh}, whose error is wanted: it must have the solution itself in the place of the "
            f"unknown; of a linear problem give a and L"
        )
    return form(ufl.derivative(residual.ufl_form, uh)), residual


def _check_solved(V: FunctionSpace, singular: npt.NDArray[np.integer]) -> None:
    numbers = V.cells.partition.cells.numbers[singular]
    found = gathered(V.mesh.comm, np.stack([numbers, V.cells.face[singular]], axis=1))
    if found.size:
        cell, face = found[np.argmin(found[:, 0])]
        raise ValueError(
            f"the local problems of {len(found)} cells have no solution, the first that of cell {cell} on "
            f"face {face} of the control mesh: L has an integral there, or one of a component, "
            f"that a has none of, or the coefficients of a are zero"
        )


def _check_problem(V: FunctionSpace, a: Form, L: Form) -> None:
    if (a.rank, L.rank) != (2, 1):
        raise ValueError(f"a and L have {a.rank} and {L.rank} arguments; the bilinear form has 2, the linear form 1")
    if any(space != V for space in (*a.spaces, *L.spaces)):
        raise ValueError(
            f"uh is in {V}, but the arguments of a are in {a.spaces[1]} and {a.spaces[0]} and that of L in "
            f"{L.spaces[0]}: give the forms that uh solves, with TrialFunction(V) and TestFunction(V) of its space"
        )
    for given in (a, L):
        if not given.hierarchy.same_as(V.hierarchy):
            raise ValueError("a or L has functions on a refinement of the cells that indicators are wanted for")
