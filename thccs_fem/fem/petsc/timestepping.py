"""Problems in time, F(t, u, du/dt; v) = 0 for all v, stepped by a TS of PETSc.

A change of space between two steps needs a new TS, and TSBDF takes no history from outside: it would start again, with
half a step of order one, which costs an order where spaces change often. So a new TS is led through the last step
again, with equations that always hold, and is then given the states before and after that step.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any, Literal, get_args
from weakref import proxy

from petsc4py import PETSc

import numpy as np
import numpy.typing as npt

import ufl
from thccs_fem.fem.function import Constant, Function
from thccs_fem.fem.linear import is_finite, is_fourth_order
from thccs_fem.fem.nonlinear import RELATIVE
from thccs_fem.fem.petsc import linear, nonlinear
from thccs_fem.fem.petsc.evolution import Conditions, EvolutionEquations, values_of
from thccs_fem.fem.petsc.matrices import new_vec, solver_comm
from thccs_fem.fem.petsc.options import Options
from thccs_fem.fem.space import FunctionSpace
from thccs_fem.parallel import all_arrive, total

__all__ = ["TimeProblem"]

Floats = npt.NDArray[np.float64]
Scheme = Literal["implicit_euler", "bdf2", "crank_nicolson"]
Transfer = Callable[[Function, FunctionSpace], Function]

TYPES = {"implicit_euler": "beuler", "bdf2": "bdf", "crank_nicolson": "cn"}
ADAPT = "ts_adapt_type"  # TSBDF would adapt its steps if nothing is said
SAME_TIME = 1e-9  # of a step: what is left at the end is no step of its own, and no reason for a shorter one
UNLIMITED = 2**31 - 2  # steps: one less than what PETSc takes for "not said"


class TimeProblem:
    """Find u(t) with F(t, u, du/dt; v) = 0 for all v, and Dirichlet conditions, one time step after the other.

    The schemes are "implicit_euler" (order 1; TSBEULER), "bdf2" (order 2, damps what is stiff; TSBDF) and
    "crank_nicolson" (order 2, the trapezoidal rule, hardly damps what is stiff; TSCN). All of them keep the integral of
    u, to the accuracy of the solvers, where F is the integral of du/dt for v = 1.

    Steps have the size `dt`, which may be set anew between two of them; with the option ``ts_adapt_type`` "basic" PETSc
    chooses it, to ``ts_rtol`` and ``ts_atol``. Options are those in `petsc_options`, and those on the command line with
    the prefix: of the TS, its SNES and its KSP. If nothing is said, ``snes_rtol`` is 1e-10, and linear systems are
    solved as by `NonlinearProblem`. The matrix is assembled and factorised anew only where a coefficient, a constant or
    the step size has changed: once for all steps of the heat equation. Its rows of prescribed dofs are the identity's,
    but not its columns, since the values change.

    Args:
        F: Form with a test function, in u and its derivative.
        u: The unknown, with its values at the start.
        udot: A function of the same space that stands for the derivative of u in F.
        dt: Size of a step.
        scheme: One of the three.
        t: The time in F, with its value at the start; None: it is not in F, and starts at 0.
        bcs: Conditions; where they change, a function ``bcs(V, time)`` that returns them, called with `t` set to that
            time. Prescribed values replace those of u at the start, and where the space changes.
        before: `before` of another problem that this one shall go on from, after a checkpoint, say; None: a new start.
        petsc_options_prefix: What distinguishes the options of this problem, usually with "_" at the end.
        petsc_options: Options without the prefix, as ``{"snes_rtol": 1e-12}``. They hold for this problem, and before
            those on the command line.

    Raises:
        TypeError: F is no form, or a condition none.
        ValueError: F has not one test function, in the space of u and udot, or no udot; a condition is in another
            space, or `before` is; dt is not positive; the scheme is unknown, or "crank_nicolson" where the terms with
            udot have u, udot or t in other factors; or the prefix is empty.
    """

    def __init__(
        self,
        F: ufl.Form,
        u: Function,
        udot: Function,
        *,
        dt: float,
        scheme: Scheme = "bdf2",
        t: Constant | None = None,
        bcs: Conditions = (),
        before: tuple[float, Function] | None = None,
        petsc_options_prefix: str,
        petsc_options: Mapping[str, Any] | None = None,
    ):
        self._given_options = petsc_options or {}
        self._options = Options(petsc_options_prefix, petsc_options)
        if not self._options.have(ADAPT):
            self._options = Options(petsc_options_prefix, {ADAPT: "none", **self._given_options})
        if scheme not in get_args(Scheme):
            raise ValueError(f"the scheme is {scheme!r}; it must be one of {', '.join(get_args(Scheme))}")
        t = Constant(u.function_space.mesh, 0.0) if t is None else t
        self._equations = EvolutionEquations(F, u, udot, t, bcs)
        if scheme == "crank_nicolson":
            self._equations.check_constant_mass()
        self._scheme: Scheme = scheme
        self._before: tuple[float, Floats] | None = None  # time and values before the last step
        if before is not None:
            if before[1].function_space != u.function_space:
                raise ValueError(
                    f"the values before are in {before[1].function_space}; they must be in the space of the unknown, "
                    f"{u.function_space}"
                )
            self._before = before[0], self._equations.layout.join([before[1]])
        self._ts = self._stepper(float(t), int(before is not None), _checked(dt))

    @property
    def u(self) -> Function:
        """The solution at `time`. The next step starts from its values, also where they were changed from outside."""
        return self._equations.u

    @property
    def udot(self) -> Function:
        """What stands for the derivative of u, with the values at which F was last evaluated."""
        return self._equations.udot

    @property
    def before(self) -> tuple[float, Function] | None:
        """Time and solution before the last step; None at the start.

        With it and `u` "bdf2" goes on in another run as in this one; the other schemes need u alone.
        """
        if self._before is None:
            return None
        u = Function(self.u.function_space, name=f"{self.u.name} before")
        self._equations.layout.spread(self._before[1], [u])
        return self._before[0], u

    @property
    def time(self) -> float:
        """The time of u."""
        return self._ts.getTime()

    @property
    def step_number(self) -> int:
        """Number of steps since the start, in whatever spaces."""
        return self._ts.getStepNumber()

    @property
    def dt(self) -> float:
        """Size of the next step."""
        return self._ts.getTimeStep()

    @dt.setter
    def dt(self, dt: float) -> None:
        self._ts.setTimeStep(_checked(dt))

    @property
    def solver(self) -> PETSc.TS:
        """The TS; another one after a step that failed."""
        return self._ts

    def step(self) -> Function:
        """Go one step forward and return u.

        Raises:
            RuntimeError: A solver fails; the message has the reasons of TS, SNES and KSP. Time and u are those before
                the step, which may be tried again with a smaller `dt`.
        """
        ts, x, present = self._ts, self._ts.getSolution(), self._present
        is_changed = not np.array_equal(present, values_of(x))
        if total(self._comm, int(is_changed)):  # from outside: what was before is no history
            self._before = None
            ts.restartStep()
        if self._before is None:
            x.array = self._equations.with_prescribed(present, self.time)
        number, dt, before = self.step_number, self.dt, (self.time, values_of(x).copy())
        try:
            with self._options.in_place():
                ts.step()
            reason: Any = ts.getConvergedReason()  # an int, other than the stubs say
            if reason < 0 or not is_finite(self._comm, values_of(x)):
                where = f"in the step from t = {before[0]:g} with dt = {dt:g}"
                raise RuntimeError(f"PETSc's {ts.getType()} failed {where}: {_why(ts)}")
        except Exception as error:
            if all_arrive(self._comm):  # else bcs failed on some ranks alone, which ends all
                self._equations.accept(*before)
                self._equations.forget()
                self._ts = self._stepper(before[0], number, dt)
            if isinstance(error, PETSc.Error) and error.__cause__ is not None:  # what bcs raised
                raise error.__cause__ from None
            raise
        self._before = before
        self._equations.accept(self.time, values_of(x))
        ts.monitor(self.step_number, self.time, x)
        self._options.warn_unused(self._comm)
        return self.u

    def steps(self, until: float) -> Iterator[Function]:
        """Step to a time and yield u after each step; the last one is shortened to end there.

        Raises:
            RuntimeError: See `step`.
        """
        while (left := until - self.time) > SAME_TIME * self.dt:
            dt = self.dt
            is_shorter = left < (1.0 - SAME_TIME) * dt  # else the matrix would be another one for a rounding error
            if is_shorter:
                self.dt = left
            try:
                self.step()
            finally:
                if is_shorter:
                    self.dt = dt
            yield self.u

    def solve(self, until: float) -> Function:
        """Step to a time and return u there.

        Raises:
            RuntimeError: See `step`.
        """
        for _ in self.steps(until):
            pass
        return self.u

    def with_space(self, V: FunctionSpace, transfer: Transfer, *, bcs: Conditions | None = None) -> TimeProblem:
        """Return the problem that goes on from here in another space; this one stays as it is.

        In F, u, udot and the test function are replaced by those of V. The state before the last step is carried over
        like u, so that BDF2 goes on as if nothing had happened, and keeps its order. All other functions in F, such as
        data, stay where they are.

        Args:
            V: The space, with values of the same shape.
            transfer: Carries a function to V, as `adapt.transfer`.
            bcs: Conditions in V; None: the function ``bcs(V, time)`` that this problem has, or none.

        Raises:
            ValueError: This problem has conditions in a list, and none are given for V; or as for the constructor.
        """
        equations = self._equations
        if bcs is None and not callable(equations.bcs) and len(equations.bcs):
            raise ValueError(
                "the conditions are a list for the dofs of the old space: give bcs=[...] with those of the new one, or "
                "make the problem with a function bcs(V, time)"
            )
        problem = TimeProblem(
            *equations.replaced(transfer(self.u, V)),
            dt=self.dt,
            scheme=self._scheme,
            t=equations.t,
            bcs=equations.bcs if bcs is None else bcs,
            petsc_options_prefix=self._options.prefix,
            petsc_options=self._given_options,
        )
        problem._options = self._options
        if self._before is not None:
            time, before = self._before[0], self.u.copy()
            equations.layout.spread(self._before[1], [before])
            carried = problem._equations.layout.join([transfer(before, V)])
            problem._before = time, problem._equations.with_prescribed(carried, time)
        problem._equations.accept(self.time, problem._equations.with_prescribed(problem._present, self.time))
        problem._ts = problem._stepper(self.time, self.step_number, self.dt)
        return problem

    @property
    def _comm(self) -> Any:
        return self._equations.layout.comm

    @property
    def _present(self) -> Floats:
        """The values of u that this rank owns, a new array."""
        return self._equations.layout.join([self.u])

    # ---- The TS

    def _stepper(self, time: float, number: int, dt: float) -> PETSc.TS:
        """Return a TS that goes on from u as if it had made the step before itself."""
        ts = PETSc.TS().create(solver_comm(self.u.function_space))
        ts.setOptionsPrefix(self._options.prefix)
        ts.setType(TYPES[self._scheme])
        ts.setErrorIfStepFails(False)
        ts.setMaxSteps(UNLIMITED)
        ts.setSolution(new_vec(self._present, ts.comm))
        equations = proxy(self._equations)  # which a TS must not own: when Python ends, it cannot take them back
        ts.setIJacobian(partial(EvolutionEquations.jacobian, equations), self._equations.A)
        snes = ts.getSNES()
        snes.setTolerances(rtol=RELATIVE)
        snes.getKSP().setTolerances(rtol=linear.TOLERANCE)
        if not self._options.have("ksp_type", "pc_type"):  # before options are read, which leaves nothing to choose
            linear.choose(snes.getKSP(), self._equations.A, False, is_fourth_order([[self._equations.derivative]]))
        if self._before is not None and self._scheme == "bdf2":
            self._replay(ts, time, number)
        ts.setIFunction(partial(EvolutionEquations.residual, equations), new_vec(np.zeros_like(self._present), ts.comm))
        with self._options.in_place():
            ts.setFromOptions()
        linear.set_levels(snes.getKSP(), [self.u.function_space])
        ts.setTime(time)
        ts.setStepNumber(number)
        ts.setTimeStep(dt)
        return ts

    def _replay(self, ts: PETSc.TS, time: float, number: int) -> None:
        """Lead a TS through the last step: it keeps the state before the step, and u takes the place of the result."""
        assert self._before is not None  # who calls has looked
        x = ts.getSolution()
        ts.setIFunction(lambda ts, t, u, udot, F: F.set(0.0), x.duplicate())
        with Options(self._options.prefix, {ADAPT: "none"}).in_place():
            ts.setFromOptions()
        ts.setTime(self._before[0])
        ts.setStepNumber(number - 1)
        ts.setTimeStep(time - self._before[0])
        x.array = self._before[1]
        ts.step()
        x.array = self._present


def _checked(dt: float) -> float:
    if not (dt > 0.0 and math.isfinite(dt)):
        raise ValueError(f"dt is {dt}: steps go forward, give a positive size")
    return dt


def _why(ts: PETSc.TS) -> str:
    """Return why a step failed, and what may help."""
    snes = ts.getSNES()
    reason: Any = snes.getConvergedReason()  # an int, other than the stubs say
    name = nonlinear.REASONS.get(reason)
    if name == "DIVERGED_LINEAR_SOLVE":
        ksp_reason: Any = snes.getKSP().getConvergedReason()
        return f"{name}, {linear.failure(snes.getKSP())}. {linear.help_for(ksp_reason)}"
    if name is not None:
        state = f"after {snes.getIterationNumber()} iterations, with a residual of norm {snes.getFunctionNorm():.3e}"
        return f"{name}, {nonlinear.MEANING.get(name, name)}, {state}. What may help: a smaller dt"
    ts_reason: Any = ts.getConvergedReason()
    if ts_reason == PETSc.TS.ConvergedReason.DIVERGED_STEP_REJECTED:
        return "DIVERGED_STEP_REJECTED, its error was too large again and again: loosen ts_rtol and ts_atol"
    return "values are not finite: see that coefficients and data are, or take a smaller dt"
