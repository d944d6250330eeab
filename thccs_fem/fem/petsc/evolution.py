"""The equations F(t, u, du/dt; v) = 0 at any time and state, as PETSc's TS asks for them.

Prescribed dofs have the equation u - g(t) = 0 instead. In the matrix their rows are the identity's, but not their
columns, since the values change.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from petsc4py import PETSc

import numpy as np
import numpy.typing as npt

import ufl
from thccs_fem.fem import assembly
from thccs_fem.fem.bcs import DirichletBC
from thccs_fem.fem.forms import form
from thccs_fem.fem.function import Constant, Function
from thccs_fem.fem.layout import Layout
from thccs_fem.fem.linear import constrain, constraints
from thccs_fem.fem.petsc.matrices import changed, new_mat
from thccs_fem.fem.space import FunctionSpace
from thccs_fem.parallel import total
from thccs_fem.subdivision import Ints
from ufl.algorithms import expand_derivatives

__all__ = ["Conditions", "EvolutionEquations", "values_of"]

Floats = npt.NDArray[np.float64]
Conditions = Sequence[DirichletBC] | Callable[[FunctionSpace, float], Sequence[DirichletBC]]


class EvolutionEquations:
    """F and its derivative at any time and state, with conditions, as callbacks of a TS.

    Args:
        F: As for `TimeProblem`.
        u: The unknown, which takes the states that F is evaluated at.
        udot: What takes their derivatives.
        t: What takes the time.
        bcs: As for `TimeProblem`.

    Attributes:
        layout: The dofs.
        derivative: The compiled derivative of F, with udot changing faster than u by a constant.
        A: Its matrix, as last assembled.
    """

    def __init__(self, F: ufl.Form, u: Function, udot: Function, t: Constant, bcs: Conditions):
        V = u.function_space
        self._F, self._test = F, _test_function(F, u, udot)
        self.u, self.udot, self.t, self.bcs = u, udot, t, bcs
        self.layout = Layout((V,))
        self._form = form(F)
        self._shift = Constant(V.mesh, 1.0)
        with_degrees, trial = self._form.ufl_form, ufl.TrialFunction(V)  # the same quadrature for the derivative
        self._mass = expand_derivatives(ufl.derivative(with_degrees, udot, trial))
        if self._mass.empty():
            raise ValueError(
                "F does not contain udot: write the derivative of u with the function that is given as udot"
            )
        stiffness = expand_derivatives(ufl.derivative(with_degrees, u, trial))
        self.derivative = form(stiffness + self._shift * self._mass)
        self._values = assembly.assemble_matrix(self.derivative)
        self._at: list[Floats] = []  # what the matrix was assembled with
        self.A = new_mat(self._values, self.derivative.spaces)
        self._prescribed: tuple[float, Ints, Floats] | None = None

    def replaced(self, u: Function) -> tuple[ufl.Form, Function, Function]:
        """Return the form for an unknown in another space, with the unknown and its derivative."""
        V = u.function_space
        udot = Function(V, self.udot.name)
        return ufl.replace(self._F, {self.u: u, self.udot: udot, self._test: ufl.TestFunction(V)}), u, udot

    def check_constant_mass(self) -> None:
        """Raise if the terms with udot are others than a constant matrix times udot."""
        changing = {self.u, self.udot, self.t} & {*self._mass.coefficients(), *self._mass.constants()}
        if changing:
            raise ValueError(
                f"the terms with udot depend on {', '.join(sorted(map(str, changing)))}, where the trapezoidal rule is "
                f'not of order 2: use scheme="bdf2", or divide by what stands before udot'
            )

    def with_prescribed(self, values: Floats, time: float) -> Floats:
        """Return values of u, of the dofs that this rank owns, with those in place that are prescribed at a time."""
        dofs, prescribed = self._conditions(time)
        owned = np.searchsorted(dofs, values.size)
        values = values.copy()
        values[dofs[:owned]] = prescribed[:owned]
        return values

    def accept(self, time: float, values: Floats) -> None:
        """Give u its values at a time; collective."""
        self.t.value = time
        self.layout.spread(values, [self.u])

    def residual(self, ts: PETSc.TS, t: float, u: PETSc.Vec, udot: PETSc.Vec, F: PETSc.Vec) -> None:
        """Evaluate F; for prescribed dofs u minus what is prescribed."""
        self._set(t, u, udot)
        values = assembly.assemble_vector(self._form)
        dofs, prescribed = self._conditions(t)
        values[dofs] = self.u.x.array[dofs] - prescribed
        F.array = values[: self.layout.num_owned]

    def jacobian(
        self, ts: PETSc.TS, t: float, u: PETSc.Vec, udot: PETSc.Vec, shift: float, J: PETSc.Mat, P: PETSc.Mat
    ) -> None:
        """Assemble the derivative where it is not what it was; udot changes `shift` times as fast as u."""
        self._set(t, u, udot)
        self._shift.value = shift
        dofs, _ = self._conditions(t)
        at = [f.x.array for f in self.derivative.coefficients] + [c.value for c in self.derivative.constants] + [dofs]
        is_same = len(at) == len(self._at) and all(map(np.array_equal, at, self._at))
        if total(self.layout.comm, int(not is_same)):
            self._at = [values.copy() for values in at]
            assembly.assemble_matrix(self._values, self.derivative)
            constrain(self._values, dofs, columns=False)
            changed(self.A)

    def forget(self) -> None:
        """Have conditions found anew, also at a time for which they were found before."""
        self._prescribed = None

    def _set(self, t: float, u: PETSc.Vec, udot: PETSc.Vec) -> None:
        self.accept(t, values_of(u))
        self.layout.spread(values_of(udot), [self.udot])

    def _conditions(self, time: float) -> tuple[Ints, Floats]:
        """Return the prescribed dofs and values at a time, which need not be found twice."""
        if self._prescribed is None or (self._prescribed[0] != time and callable(self.bcs)):
            self.t.value = time
            V = self.u.function_space
            self._prescribed = time, *constraints(self.bcs(V, time) if callable(self.bcs) else self.bcs, V)
        return self._prescribed[1:]


def values_of(x: PETSc.Vec) -> Floats:
    """Return the values of a vector, those that this rank owns, not to be changed."""
    values: Any = x.array_r  # float64, which new_mat has checked
    return values


def _test_function(F: ufl.Form, u: Function, udot: Function) -> ufl.Argument:
    """Return the test function of F, where all is in one space."""
    if not isinstance(F, ufl.Form):
        raise TypeError(f"F is a {type(F).__name__}: give a UFL form, a sum of integrals with a test function")
    V = u.function_space
    if udot.function_space != V:
        raise ValueError(f"u is in {V}, but udot in {udot.function_space}: make it with fem.Function(u.function_space)")
    arguments = F.arguments()
    if len(arguments) != 1 or arguments[0].ufl_function_space() != V:
        raise ValueError(
            f"F has the arguments {arguments}: it needs a test function in {V}, the space of u, and no other"
        )
    return arguments[0]
