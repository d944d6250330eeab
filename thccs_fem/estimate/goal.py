"""The error of a number that is computed from the solution, and where it comes from: dual weighted residuals.

With u in W, a refinement of V, the solution of F(u; v) = 0 for all v in W, and J a functional, the dual solution is the
z in W for which

    F'(uh; phi, z) = J'(uh; phi)    for all phi in W;        then J(u) - J(uh) = -F(uh; z) + R.

It says how much what is left of the equations at each place matters to the goal (Becker and Rannacher, Acta Numerica
10, 2001). R is zero if F and J are linear in u, else quadratic in u - uh, which is no less than F(uh; z) itself where
gradients enter nonlinearly: for a minimal surface -F(uh; z) was from 3 to 130 % of the error. Between uh and u,
derivatives change by their mean, up to a cubic error, if they are taken halfway. So in nonlinear problems z is the dual
solution at uh + d / 2, with d from one step of Newton's method in W; then R is cubic.

F(uh; z_h) = 0 for all z_h in V, so that where errors are told apart it is z - z_h that counts, with z_h the dual
solution in V. A weak form needs no strong residuals and no jumps for that, if the weight is cut into pieces by a
partition of unity psi_i (Richter and Wick, J. Comput. Appl. Math. 279, 2015): F(uh; (z - z_h) psi_i). The functions of
V are one. In terms of those of W, psi_i = sum_j P_ji phi_j, where rows of P sum to one, and weights are cut coefficient
by coefficient: with z - z_h = sum_j e_j phi_j,

    the share of function i is    -sum_j P_ji e_j F(uh; phi_j).

Measured, that is as good as products of functions; and it needs no form but F.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

import ufl
from thccs_fem.fem.assembly import assemble_cells, assemble_scalar, assemble_vector, integrals
from thccs_fem.fem.bcs import DirichletBC, dirichletbc
from thccs_fem.fem.forms import form
from thccs_fem.fem.function import Function
from thccs_fem.fem.linear import constraints, drops_constants
from thccs_fem.fem.scipy.linear import LinearProblem
from thccs_fem.fem.space import FunctionSpace, check_space
from thccs_fem.parallel import total
from thccs_fem.prolongation import Prolongation
from thccs_fem.subdivision import Bools, Ints
from ufl.algorithms import expand_derivatives

__all__ = ["goal"]

Floats = npt.NDArray[np.float64]
Fixed = Callable[[FunctionSpace], npt.ArrayLike | DirichletBC | Sequence[DirichletBC]]

MEAN = 1e-3  # of a function, relative to that of absolute values of coefficients; quadrature leaves 1e-6
APART = 1e-6  # distance of two points that are not the same, relative to the size of the mesh
HINTS = {
    "F": "it is the residual that uh solves, of linear problems a(uh, v) - L(v)",
    "J": "it is a number computed from uh, such as uh * dx(1)",
}


def goal(
    uh: Function,
    F: ufl.Form,
    J: ufl.Form,
    *,
    fixed: Fixed | None = None,
    problem: Callable[..., Any] = LinearProblem,
) -> tuple[Floats, float]:
    """Estimate the error of a functional of the solution, and what each cell has to do with it; collective.

    For Poisson's equation and the mean over the faces tagged 1, say ::

        F = inner(grad(uh), grad(v)) * dx - f * v * dx
        eta, value = estimate.goal(uh, F, uh * dx(1), fixed=fem.boundary_dofs)

    The value is the difference that uniform refinement would make: J(u) - J(uh), with u the solution in the space that
    is refined once everywhere, and each J integrated on its own cells; up to an error that is cubic in u - uh, if F or
    J is not linear in uh. It has a sign, and may be added to J(uh). What the refined space misses as well is not in it:
    where u is singular and V not graded, that is a part which does not get smaller.

    Each function has a share in the value. They add up to it but for what refinement need not mend: prescribed values,
    quadrature, and what the solver has left. The absolute value of a share is spread over the support as the function
    is; what a cell gets is the square of its indicator. So `adapt.mark` with "dorfler" finds where the largest shares
    are. As they have signs the sum of the squares is more than the value, by a factor that has no bound.

    It costs about as much as solving a linear problem in the refined space, of four times as many dofs; twice that, if
    F or J is not linear. Where elements at extraordinary vertices come to the level of their caps, those of the
    refined space are deeper.

    Args:
        uh: The approximation; the indicators belong to its cells.
        F: The residual that uh solves, in uh and a test function of its space: for linear problems a(uh, v) - L(v).
        J: The functional, a form in uh without arguments. A weight in it that is narrower than the cells needs a
            quadrature of higher degree: ``dx(metadata={"quadrature_degree": 20})``.
        fixed: Takes a space, that of uh or its refinement, and returns what is prescribed there: functions, as
            `fem.boundary_dofs` does, or conditions of `fem.dirichletbc`, one or a list of them. Of conditions the
            values count as well: how much better these are in the refined space is part of the value. None: nothing
            is prescribed; if uh has mean zero then, as on a closed surface, so has u.
        problem: `LinearProblem` of fem.scipy or of fem.petsc, or what takes the same arguments: who solves. On several
            ranks it must be the latter.

    Returns:
        Indicators, shape (cells.num_owned,), those of the cells that this rank owns, and the estimate of J(u) - J(uh).

    Raises:
        TypeError: If uh is no function, F or J no UFL form, or `fixed` no function of a space, or it returns None.
        ValueError: If F has not just one argument, of the space of uh, or J has any; or one of them does not depend on
            uh; or constants are free, and uh has not mean zero; or `fixed` does not look at the space.
    """
    V = _checked_space(uh, F, J, fixed)
    W = _refined_everywhere(V)
    P = Prolongation(W.hierarchy, V.hierarchy)
    given = coarse = _Equations(F, J, uh, V)
    fine = middle = given.at(_carried(P, uh, W), W)
    in_W, in_V = _Prescribed.of(fixed, W), _Prescribed.of(fixed, V)
    (dofs, jump), (coarse_dofs, _) = in_W.at(fine.u), in_V.at(uh)
    _check_found_anew(V, W, in_V, in_W)
    fine.check_means(dofs)
    residual, change_of_goal = fine.residual(), fine.goal() - given.goal()
    if not fine.is_linear:
        halfway = _plus(fine.u, fine.newton_step(dofs, jump, problem) / 2.0)
        middle, coarse = fine.at(halfway, W), fine.at(halfway, V)
    z, z_h = middle.dual(dofs, problem), coarse.dual(coarse_dofs, problem)
    shares = P.transposed(_by_functions(-(z.x.array - _carried(P, z_h, W).x.array) * residual, W))
    V.index_map.scatter_forward(shares)
    change = middle.balance(dofs) * fine.u.x.array - z.x.array * residual
    if total(V.mesh.comm, int(jump.any())):
        change[dofs] += jump * middle.sensitivity(z)[dofs]
    value = change_of_goal + total(V.mesh.comm, float(np.sum(change[: W.num_owned_dofs])))
    return np.sqrt(_over_supports(V, np.abs(shares))), value


@dataclass(frozen=True, eq=False)
class _Equations:
    """The residual F, which has a test function of any space, and the goal J as forms in u, and their derivatives.

    Attributes:
        F: The residual.
        J: The goal.
        u: The function.
        space: Space of the arguments of derivatives.
    """

    F: ufl.Form
    J: ufl.Form
    u: Function
    space: FunctionSpace

    def at(self, u: Function, space: FunctionSpace) -> _Equations:
        """Return them as forms in another function."""
        return _Equations(ufl.replace(self.F, {self.u: u}), ufl.replace(self.J, {self.u: u}), u, space)

    @cached_property
    def slope(self) -> ufl.Form:
        """J'(u; test)."""
        return _derivative("J", self.J, self.u, ufl.TestFunction(self.space))

    @cached_property
    def adjoint(self) -> ufl.Form:
        """F'(u; test, trial): the direction is the test function."""
        return _derivative("F", self._tested(ufl.TrialFunction(self.space)), self.u, ufl.TestFunction(self.space))

    @property
    def is_linear(self) -> bool:
        """Whether u is in none of the derivatives."""
        return self.u not in (*self.slope.coefficients(), *self.adjoint.coefficients())

    def goal(self) -> float:
        """Return J(u)."""
        return total(self.space.mesh.comm, assemble_scalar(form(self.J)))

    def residual(self) -> Floats:
        """Return F(u; phi) for all phi, local, the owned part complete."""
        return assemble_vector(form(self._tested(ufl.TestFunction(self.space))))

    def sensitivity(self, z: Function) -> Floats:
        """Return J'(u; phi) - F'(u; phi, z) for all phi, zero but where something is prescribed; as `residual`."""
        return assemble_vector(form(self.slope - ufl.action(self.adjoint, z)))

    def dual(self, dofs: Ints, problem: Callable[..., Any]) -> Function:
        """Return z with F'(u; phi, z) = J'(u; phi) for all phi, all of them zero at the prescribed dofs."""
        try:
            bc = DirichletBC(self.space, dofs, np.zeros(dofs.size))
            return _solved(problem, self.adjoint, self.slope, bc)
        except (ValueError, RuntimeError) as error:
            if not isinstance(error, NotImplementedError):  # that is SciPy on several ranks
                error.add_note("This is the dual problem. See that `fixed` returns all that is prescribed for uh.")
            raise

    def balance(self, dofs: Ints) -> Floats:
        """Return what the load of the dual problem has been balanced with, see `_balance`."""
        return _balance(self.adjoint, self.slope, self.space, dofs)

    def check_means(self, dofs: Ints) -> None:
        """Raise if u, which is in the space, has not mean zero where constants are free.

        Raises:
            ValueError: It has another mean.
        """
        V = self.space
        sizes = integrals(V)[: V.index_map.size_local]
        values = self.u.x.array[: V.num_owned_dofs].reshape(sizes.size, V.block_size)
        mean, absolute = (total(V.mesh.comm, sizes @ each) for each in (values, np.abs(values)))
        wrong = _free_components(self.adjoint, V, dofs) & (np.abs(mean) > MEAN * absolute)
        if wrong.any():
            raise ValueError(
                f"nothing is prescribed, and F and its derivative have gradients alone of component "
                f"{int(np.argmax(wrong))}, so that uh must have mean zero there, but it has not: see that `fixed` "
                f"returns all that is prescribed for uh, or subtract the mean from uh"
            )

    def newton_step(self, dofs: Ints, values: Floats, problem: Callable[..., Any]) -> Floats:
        """Return what a step of Newton's method adds to u, which is in the space, shape (num_local_dofs,)."""
        test, trial = ufl.TestFunction(self.space), ufl.TrialFunction(self.space)
        jacobian = _derivative("F", self._tested(test), self.u, trial)
        return _solved(problem, jacobian, -self._tested(test), DirichletBC(self.space, dofs, values)).x.array

    def _tested(self, v: ufl.Argument) -> ufl.Form:
        (test,) = self.F.arguments()
        return ufl.replace(self.F, {test: v})


def _solved(problem: Callable[..., Any], a: ufl.Form, L: ufl.Form, bc: DirichletBC) -> Function:
    load = _balance(a, L, bc.function_space, bc.dofs)
    solution: Function = problem(a, L, bcs=[bc], load=load, petsc_options_prefix="goal_").solve()
    return solution


def _balance(a: ufl.Form, L: ufl.Form, V: FunctionSpace, dofs: Ints) -> Floats:
    """Return what makes the mean of a load zero in components whose constants are free.

    There solutions have mean zero, and L needs to be known for such functions only. That of a problem which is balanced
    in V need not be so on finer cells, for quadrature.

    Returns:
        Shape (num_local_dofs,), zero in other components. Times u, it is what L makes of the mean of -u.
    """
    free, owned = _free_components(a, V, dofs), V.index_map.size_local
    result = np.zeros((V.num_local_dofs // V.block_size, V.block_size))
    if free.any():
        load, sizes = assemble_vector(form(L)).reshape(result.shape), integrals(V)
        mean = total(V.mesh.comm, load[:owned].sum(axis=0)) / total(V.mesh.comm, sizes[:owned].sum())
        result[:, free] = -np.outer(sizes, mean[free])
    return result.ravel()


def _free_components(a: ufl.Form, V: FunctionSpace, dofs: Ints) -> Bools:
    """Return the components of which a has gradients alone, and nothing is prescribed, shape (block_size,)."""
    prescribed = np.bincount(dofs % V.block_size, minlength=V.block_size)
    return drops_constants([[form(a)]], [V]) & (total(V.mesh.comm, prescribed) == 0)


def _carried(P: Prolongation, u: Function, W: FunctionSpace) -> Function:
    """Return u in the refined space."""
    result = Function(W, u.name)
    result.x.array = P(u.x.array.reshape(-1, W.block_size)).ravel()
    return result


def _plus(u: Function, step: Floats) -> Function:
    """Return the function with other coefficients, by the difference to those of u."""
    result = u.copy()
    result.x.array += step
    return result


def _refined_everywhere(V: FunctionSpace) -> FunctionSpace:
    """Return the space with each cell divided, also where refining the rings of all functions would leave some."""
    return V.with_hierarchy(replace(V.hierarchy, unit="support").refined(np.arange(V.num_functions)))


def _by_functions(values: Floats, V: FunctionSpace) -> Floats:
    """Return the sum over the components of each function, shape (num_functions,), local."""
    return np.asarray(values.reshape(-1, V.block_size).sum(axis=1))


def _over_supports(V: FunctionSpace, amounts: Floats) -> Floats:
    """Return the part of each cell, shape (cells.num_owned,), of amounts that are spread as the functions of V are.

    Args:
        V: The space.
        amounts: One for each scalar function, local, ghosts included.
    """
    density = Function(FunctionSpace(V.hierarchy, (), V.integration))
    density.x.array = amounts / integrals(V)
    return np.maximum(assemble_cells(form(density * ufl.dx)), 0.0)  # functions are not negative; rounding may be


@dataclass(frozen=True, eq=False)
class _Prescribed:
    """What `fixed` returned for a space: conditions, or functions alone, as conditions of zero."""

    bcs: Sequence[DirichletBC]
    has_values: bool

    @classmethod
    def of(cls, fixed: Fixed | None, V: FunctionSpace) -> _Prescribed:
        given: Any = [] if fixed is None else fixed(V)
        if given is None:
            raise TypeError("fixed returned None: let it return what is prescribed in the space that it is called with")
        listed: Any = [given] if isinstance(given, DirichletBC) else given
        if isinstance(listed, Sequence) and all(isinstance(bc, DirichletBC) for bc in listed):
            return cls(listed, True)
        return cls([dirichletbc(0.0, listed, V)], False)

    def at(self, u: Function) -> tuple[Ints, Floats]:
        """Return the prescribed dofs, ascending, local, ghosts included, and by how much u misses the values if any."""
        dofs, values = constraints(self.bcs, u.function_space)
        return dofs, values - u.x.array[dofs] if self.has_values else np.zeros(dofs.size)

    def has_dofs_of(self, other: _Prescribed) -> bool:
        """Return whether this rank has been given the same numbers."""
        mine, others = ([bc.dofs for bc in each.bcs] for each in (self, other))
        return len(mine) == len(others) and all(map(np.array_equal, mine, others))

    def points(self, V: FunctionSpace) -> Floats:
        """Return where functions of V with the numbers are that this rank has been given, shape (n, gdim)."""
        numbers = [bc.dofs // V.block_size for bc in self.bcs]
        return V.reference_points[np.concatenate([np.zeros(0, dtype=np.int32), *numbers])]


def _check_found_anew(V: FunctionSpace, W: FunctionSpace, in_V: _Prescribed, in_W: _Prescribed) -> None:
    """Raise if dofs that were found for V are taken for those of its refinement.

    Raises:
        ValueError: Both have the same numbers on all ranks, but not where they are: that only functions of vertices of
            V can have, at the vertex.
    """
    if total(V.mesh.comm, int(not in_W.has_dofs_of(in_V))):
        return
    distance = np.abs(in_W.points(W) - in_W.points(V)).max(initial=0.0)
    if total(V.mesh.comm, int(distance > APART * np.ptp(V.mesh.vertices, axis=0).max())):
        raise ValueError(
            "fixed returned the same dofs for the space of uh and for its refinement, but they are others there: let "
            "it find them in the space that it is called with, as fem.boundary_dofs or lambda W: fem.boundary_dofs(W)"
        )


def _derivative(name: str, what: ufl.Form, u: Function, direction: ufl.Argument) -> ufl.Form:
    derivative = expand_derivatives(ufl.derivative(what, u, direction))
    if derivative.empty():
        raise ValueError(f"the derivative of {name} by uh is zero: {HINTS[name]}")
    return derivative


def _checked_space(uh: object, F: object, J: object, fixed: object) -> FunctionSpace:
    if not isinstance(uh, Function):
        raise TypeError(f"uh is a {type(uh).__name__}; it must be a fem.Function, as goals are of one unknown")
    check_space(uh.ufl_function_space(), "goal")
    V = uh.function_space
    for name, given, rank in (("F", F, 1), ("J", J, 0)):
        if not isinstance(given, ufl.Form):
            raise TypeError(f"{name} is a {type(given).__name__}, but derivatives of it are needed: give a UFL form")
        if len(given.arguments()) != rank:
            raise ValueError(f"{name} has {len(given.arguments())} arguments; it must have {rank}: {HINTS[name]}")
        if uh not in given.coefficients():
            raise ValueError(f"{name} does not depend on uh: {HINTS[name]}")
    assert isinstance(F, ufl.Form)  # as was just asked
    (test,) = F.arguments()
    if test.ufl_function_space() != V:
        raise ValueError(f"uh is in {V}, but the test function of F in {test.ufl_function_space()}: give it the same")
    if fixed is not None and not callable(fixed):
        raise TypeError(
            f"fixed is a {type(fixed).__name__}, but it is needed in the refined space as well: give a function of the "
            f"space, as fem.boundary_dofs, or lambda V: fem.boundary_dofs(V, tag=1)"
        )
    return V
