"""Eigenvalue problems on several ranks have the eigenvalues of one, none of them missing."""

from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
from compared import same_as_in_serial
from spread import CLOSED, WITH_RIM, space, whole

import ufl
from thccs_fem import fem
from thccs_fem.fem.petsc import EigenProblem
from thccs_fem.fem.space import FunctionSpace
from ufl import dx, grad, inner


def laplace(V: FunctionSpace) -> ufl.Form:
    return inner(grad(ufl.TrialFunction(V)), grad(ufl.TestFunction(V))) * dx


def test_prescribed_dofs_are_left_out() -> None:
    """Functions of simple eigenvalues are the same to the sign."""

    def work(comm: MPI.Comm) -> list[Any]:
        V = space(WITH_RIM["l domain"], comm)
        bcs = [fem.dirichletbc(0.0, fem.boundary_dofs(V), V)]
        values, functions = EigenProblem(laplace(V), bcs=bcs, num_eigenvalues=3, petsc_options_prefix="d_").solve()
        return [values, *map(whole, functions)]

    same_as_in_serial(work)


@pytest.mark.parametrize(
    ("name", "shape", "target"), [("sphere", (), 0.0), ("torus", (2,), 1.5), ("few cells", (), 0.0)]
)
def test_copies_of_multiple_eigenvalues(name: str, shape: tuple[int, ...], target: float) -> None:
    def work(comm: MPI.Comm) -> list[Any]:
        V = space(CLOSED[name], comm, shape)
        problem = EigenProblem(laplace(V), num_eigenvalues=5, target=target, petsc_options_prefix="m_")
        values, functions = problem.solve()
        mass = [[comm.allreduce(fem.assemble_scalar(fem.form(inner(f, g) * dx))) for f in functions] for g in functions]
        np.testing.assert_allclose(mass, np.eye(5), atol=1e-9)
        return [values]

    same_as_in_serial(work)


def test_conditions_of_one_rank_that_are_not_zero(comm: MPI.Comm) -> None:
    V = space(WITH_RIM["l domain"], comm)
    dofs = fem.boundary_dofs(V)
    owned = dofs[dofs < V.num_owned_dofs][:1] if comm.rank == 0 else []
    problem = EigenProblem(laplace(V), bcs=[fem.dirichletbc(2.0, owned, V)], petsc_options_prefix="z_")
    with pytest.raises(ValueError, match="conditions prescribe values up to 2"):
        problem.solve()
