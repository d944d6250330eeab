"""Multigrid from subdivision: the levels of a hierarchy as the levels of PETSc's PCMG.

The levels, and their matrices, are those of `fem.levels`. Each smooths a part of its functions, by Chebyshev's method
with symmetric Gauss-Seidel. In serial this is PETSc's; where not all functions are smoothed, in the one subdomain of an
additive Schwarz method. On several ranks it is that of `gauss_seidel`, which is as good, for any number of ranks;
PETSc's would know nothing of what other ranks do meanwhile, and takes up to twice as many iterations.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

from petsc4py import PETSc

import numpy as np
import scipy.sparse as sp

from thccs_fem.fem.entries import Numbering
from thccs_fem.fem.levels import LevelMatrix, Levels, prolongations_below
from thccs_fem.fem.petsc.gauss_seidel import GaussSeidel
from thccs_fem.fem.petsc.matrices import sharing, values_of
from thccs_fem.fem.space import FunctionSpace
from thccs_fem.index_map import IndexMap
from thccs_fem.parallel import rank_of, total
from thccs_fem.sparse import absolute_sums, csr
from thccs_fem.subdivision import Bools, Ints

__all__ = ["LARGEST_COARSE", "has_coarse_level", "multigrid"]

LARGEST_COARSE = 50_000  # dofs of the coarsest level; the factors of more take longer than all the rest
# Chebyshev polynomials of the fourth kind need no lower end of the spectrum (Lottes, Numer. Linear Algebra Appl. 30,
# 2023), and symmetric Gauss-Seidel has no eigenvalue above 1. Those of the first kind, with ends 0.2 and 1, take as
# many iterations where refinement is local and one more on uniform levels.
SMOOTHER = {"ksp_chebyshev_kind": "fourth", "ksp_chebyshev_eigenvalues": "0.1,1.0"}
# Steps before and after the coarser levels. Three instead of two take a quarter fewer iterations for forms of fourth
# order on irregular meshes (16 instead of 22), in less time; elsewhere they save one or two, which is no gain.
STEPS, STEPS_FOURTH_ORDER = 2, 3
GROWTH = 1.5  # of energies from level to level: functions keep theirs (second order), or have 2.4 to 4 times as much
# Added to the diagonal of the coarsest matrix, relative to it, where there is a kernel: more than rounding, so that it
# can be factorised, and less than matters (the solver removes the kernel from what comes out).
KERNEL_SHIFT = 1e-12


def multigrid(ksp: PETSc.KSP, V: FunctionSpace) -> None:
    """Make multigrid on the levels of a space the preconditioner of a solver.

    For symmetric positive definite forms of second and fourth order, with or without Dirichlet conditions (rows and
    columns of the identity), and with a null space set in the matrix. Conjugate gradients take 5 to 12 iterations to
    1e-10, for any number of dofs, levels and ranks, up to 16 for forms of fourth order on irregular meshes; more where
    a surface folds, and for thin shells.

    The cycle is PETSc's ``mg``: two steps of Chebyshev's method with symmetric Gauss-Seidel before and after (three for
    forms of fourth order), and MUMPS on the coarsest level. Options are those of PETSc, as ``mg_levels_ksp_max_it``; as
    levels smooth but a part of their functions, the method inside is ``mg_levels_sub_pc_type``. With another than
    ``sor`` PETSc estimates the spectrum. On several ranks Gauss-Seidel goes over all of them together; if
    ``mg_levels_sub_pc_type`` is given, each rank has that method for its own functions. Matrices of levels are made
    when the solver is used, and again when its matrix has changed.

    Args:
        ksp: The solver; its matrix may be set before or after. Options with its prefix are read when a matrix is new.
        V: The space of the unknown.

    Raises:
        TypeError: What is given is no KSP.
        PETSc.Error: When the solver is used, from a ValueError: the matrix has another size than the space.

    Warns:
        UserWarning: There is no level that is small enough to be solved directly.
    """
    if not isinstance(ksp, PETSc.KSP):
        raise TypeError(f"multigrid needs the KSP of a problem, multigrid(problem.solver, V), got {type(ksp).__name__}")
    levels = Levels.of(V)
    if levels.sizes[0] > LARGEST_COARSE and rank_of(V.mesh.comm) == 0:
        warnings.warn(
            f"the coarsest level has {levels.sizes[0]} dofs, all of which are in the matrix to be factorised: the "
            f"control mesh of {V.mesh.num_faces} faces is not the subdivision of a coarser one. Begin with a coarser "
            f"mesh and refine the space (adapt.refine), or use subdivision.subdivided of a coarser mesh",
            stacklevel=2,
        )
    ksp.getPC().setType("mg")
    ksp.setPreSolve(partial(_update, levels=levels, last=[]))


def has_coarse_level(V: FunctionSpace) -> bool:
    """Return whether a space has a level that is small enough to be solved directly."""
    sizes = [V.hierarchy.stages[0].boundary.num_functions]
    if V.block_size * sizes[0] > LARGEST_COARSE:
        sizes += [P.shape[1] for P in prolongations_below(V.hierarchy)]
    return V.block_size * min(sizes) <= LARGEST_COARSE


def _update(ksp: PETSc.KSP, b: PETSc.Vec, x: PETSc.Vec, levels: Levels, last: list[Any]) -> None:
    """Make the preconditioner, if the matrix of the solver is not the one of last time."""
    P = ksp.getOperators()[1]
    if last == [P, P.stateGet()]:
        return
    last[:] = [P, P.stateGet()]
    if P.getSize() != (levels.sizes[-1],) * 2:
        raise ValueError(
            f"the matrix is of size {P.getSize()}, but the space that multigrid was made for has {levels.sizes[-1]} "
            f"dofs: call multigrid again with the space of the unknown"
        )
    matrices = levels.matrices(_rows(P, levels.dofs[-1]))
    if P.getNullSpace().handle:
        matrices[0] = matrices[0].with_diagonal(1.0 + KERNEL_SHIFT)
    _make(ksp.getPC(), P, levels, matrices)


def _rows(A: PETSc.Mat, dofs: IndexMap) -> sp.csr_array:
    """Return the rows of a matrix that this rank owns; its values are not copied, where they are at hand."""
    values, columns = values_of(A), A.getAttr("columns")
    if values is None:
        indptr, indices, data = A.getValuesCSR()
        values, columns = sp.csr_array((data, indices, indptr), shape=(dofs.size_local, dofs.size_global)), None
    if dofs.global_numbers is None:
        return values
    numbers = np.argsort(dofs.global_numbers).astype(np.int32)  # of PETSc's columns
    if isinstance(columns, Numbering):
        numbers = numbers[columns.numbers]
    return csr(values.data, numbers[values.indices], values.indptr, (dofs.size_local, dofs.size_global))


def _make(pc: PETSc.PC, finest: PETSc.Mat, levels: Levels, matrices: Sequence[LevelMatrix]) -> None:
    """Make a cycle of matrices, from scratch: PETSc would go on to compute residuals with those of last time."""
    pc.setType("none")
    pc.setType("mg")
    pc.setMGLevels(len(matrices))
    steps = STEPS_FOURTH_ORDER if _growth(levels, matrices) > GROWTH else STEPS
    coarse = pc.getMGCoarseSolve()
    coarse.setOperators(_mat(matrices[0].values, levels.dofs[0], pc.comm))
    _set_coarse_solver(coarse)
    smoothers = []
    for l, (P, matrix) in enumerate(zip(levels.prolongations, matrices[1:], strict=True), 1):
        pc.setMGInterpolation(l, _mat(matrix.owned_rows(P), levels.dofs[l - 1], pc.comm))
        smoothers.append(pc.getMGSmoother(l))
        is_finest = matrix is matrices[-1]  # PETSc has that already
        smoothers[-1].setOperators(finest if is_finest else _mat(matrix.values, matrix.dofs, pc.comm))
        smoothers[-1].setTolerances(max_it=steps)
        _set_smoother(smoothers[-1].getPC(), matrix, levels.smoothed[l])
    # Matrices are there: none are asked of the DM of a SNES or TS.
    defaults = {f"{pc.getOptionsPrefix() or ''}pc_mg_galerkin": "external"}
    for smoother in smoothers:
        defaults |= _defaults(smoother)
    with _in_place(defaults):
        pc.setFromOptions()
        pc.setUp()
    for smoother in smoothers:
        _set_inner_smoother(smoother)


def _set_coarse_solver(ksp: PETSc.KSP) -> None:
    has_mumps = PETSc.Sys.hasExternalPackage("mumps")
    ksp.setType("preonly")
    ksp.getPC().setType("lu" if has_mumps or ksp.comm.size == 1 else "redundant")
    if has_mumps:
        ksp.getPC().setFactorSolverType("mumps")


def _growth(levels: Levels, matrices: Sequence[LevelMatrix]) -> float:
    """Return how many times more energy the new functions of the last level have than those of the one before."""
    energies = [_typical_energy(matrix, new) for matrix, new in zip(matrices[-2:], levels.new[-2:], strict=True)]
    return energies[-1] / energies[0]


def _typical_energy(A: LevelMatrix, functions: Bools) -> float:
    """Return the geometric mean of the diagonal entries of functions, those with a Dirichlet condition aside."""
    diagonal = A.diagonal
    free = functions[A.owned] & (absolute_sums(A.values)[0] > np.abs(diagonal))
    logarithms, count = total(A.dofs.comm, np.array([np.log(diagonal[free]).sum(), np.count_nonzero(free)]))
    return float(np.exp(logarithms / count)) if count else 1.0


def _set_smoother(pc: PETSc.PC, matrix: LevelMatrix, functions: Ints) -> None:
    """Smooth the given functions alone."""
    has_method = PETSc.Options(pc.getOptionsPrefix()).hasName("sub_pc_type")
    if matrix.dofs.is_whole and functions.size == matrix.owned.size and not has_method:
        pc.setType("sor")  # a subdomain of all would be a copy of the matrix
    elif matrix.dofs.is_whole or has_method:
        pc.setType("asm")
        pc.setASMOverlap(0)
        subdomain = PETSc.IS().createGeneral(_owned_of(functions, matrix.dofs), comm=PETSc.COMM_SELF)
        pc.setASMLocalSubdomains(1, [subdomain], [subdomain])
    else:
        pc.setType("python")
        pc.setPythonContext(GaussSeidel(matrix, functions))


def _owned_of(functions: Ints, dofs: IndexMap) -> Any:  # an array, other than the stubs of petsc4py say
    """Return PETSc's numbers of those functions that this rank owns."""
    local = dofs.local_of(functions)
    return dofs.local_to_global(local[local >= 0]).astype(PETSc.IntType, copy=False)


def _defaults(smoother: PETSc.KSP) -> dict[str, str]:
    """Return what options are to say of a smoother, as petsc4py has no functions for it; nothing if others do."""
    prefix = smoother.getOptionsPrefix() or ""
    others = ("ksp_type", "pc_type", "sub_pc_type", "ksp_chebyshev_esteig", *SMOOTHER)
    if any(PETSc.Options(prefix).hasName(name) for name in others):
        return {}
    return {prefix + name: value for name, value in SMOOTHER.items()}


@contextmanager
def _in_place(values: Mapping[str, str]) -> Iterator[None]:
    """Put options into PETSc's database for a while."""
    options = PETSc.Options()
    for name, value in values.items():
        options.setValue(name, value)
    try:
        yield
    finally:
        for name in values:
            options.delValue(name)


def _set_inner_smoother(ksp: PETSc.KSP) -> None:
    if ksp.getPC().getType() == "asm":
        for sub in ksp.getPC().getASMSubKSP():
            sub.getPC().setType("sor")
            sub.setFromOptions()


def _mat(A: sp.csr_array, columns: IndexMap, comm: Any) -> PETSc.Mat:
    """Return a matrix of rows that this rank owns."""
    if columns.global_numbers is None:
        A.sort_indices()  # which PETSc takes for granted
        return sharing(A, comm)
    begin, end = columns.local_range
    held = np.zeros(columns.size_global, dtype=bool)  # by PETSc's numbers
    held[columns.global_numbers[A.indices]] = True
    held[begin:end] = False
    numbers = np.concatenate([np.arange(begin, end), np.flatnonzero(held)]).astype(np.int32)
    local = np.zeros(columns.size_global, dtype=np.int32)
    local[numbers] = np.arange(numbers.size)
    indices, indptr = local[columns.global_numbers][A.indices], A.indptr.astype(np.int32, copy=False)
    A = csr(A.data.copy(), indices, indptr, (A.shape[0], numbers.size))
    A.sort_indices()
    return sharing(A, comm, Numbering(columns.comm, columns.starts, numbers))
