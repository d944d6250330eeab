"""Multigrid from subdivision: the levels of a hierarchy as the levels of PETSc's PCMG.

V_l is the space without anything finer than level l. Its functions are the active ones of the levels before l, and all
selected ones of level l. So the prolongation from V_{l-1} to V_l has a unit row for each function that V_l keeps, and
for the new ones the rows of S_{l-1} C_{l-1}, where C_{l-1} are the coefficients of V_{l-1} on its last level. Below V_0
are the functions of coarser control meshes, as long as the control mesh is the subdivision of one (`coarsening`).

Level l smooths the functions that do not vanish on Omega^l: the new ones, and older ones around them. Without the older
ones, whose truncation changes, the number of iterations would grow with the refinement; with all functions of V_l the
work would, with the number of levels. Of a level's Galerkin matrix P^T A P only rows and columns of smoothed functions
are used, so that only these are made: together they have little more entries than A, for any number of levels.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from petsc4py import PETSc

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from thccs_fem.boundary import traces_meeting
from thccs_fem.coarsening import coarsened
from thccs_fem.fem.petsc.matrices import sharing
from thccs_fem.fem.space import FunctionSpace
from thccs_fem.hierarchy import Hierarchy
from thccs_fem.subdivision import Bools, Ints, neighbourhood

__all__ = ["LARGEST_COARSE", "Levels", "has_coarse_level", "multigrid"]

SMALL = 500  # functions; a direct solver is as fast as any smoother then, and there is no need for coarser meshes
LARGEST_COARSE = 50_000  # dofs of the coarsest level; the factors of more take longer than all the rest
ROUNDING = 1e-14  # entries of prolongations up to this are zero but for rounding; true ones are 1e-4 and more
# Part of the spectrum that smoothers reduce. Symmetric Gauss-Seidel has no eigenvalue above 1; from 0.1 it takes 2
# iterations more on uniform levels, from 0.3 up to 2 more where refinement is local.
SMOOTHED = "0.2,1.0"
# Added to the diagonal of the coarsest matrix, relative to it, where there is a kernel: more than rounding, so that it
# can be factorised, and less than matters (the solver removes the kernel from what comes out).
KERNEL_SHIFT = 1e-12

Levelwise = npt.NDArray[np.int8]


def multigrid(ksp: PETSc.KSP, V: FunctionSpace) -> None:
    """Make multigrid on the levels of a space the preconditioner of a solver.

    For symmetric positive definite forms of second and fourth order, with or without Dirichlet conditions (rows and
    columns of the identity), and with a null space set in the matrix. Conjugate gradients take 6 to 14 iterations to
    1e-10, for any number of dofs and levels; more for forms of fourth order on stretched faces and for thin shells.

    The cycle is PETSc's ``mg``: two steps of Chebyshev's method with symmetric Gauss-Seidel before and after, and MUMPS
    on the coarsest level. Options are those of PETSc, as ``mg_levels_ksp_max_it``; as levels smooth but a part of their
    functions, the method inside is ``mg_levels_sub_pc_type``. With another than ``sor`` PETSc estimates the spectrum.
    Matrices of levels are made when the solver is used, and again when its matrix has changed.

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
    if levels.sizes[0] > LARGEST_COARSE:
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
        sizes += [P.shape[1] for P in _below(V.hierarchy)]
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
    indptr, indices, data = P.getValuesCSR()
    matrices = levels.matrices(sp.csr_array((data, indices, indptr), shape=P.getSize()))
    if P.getNullSpace().handle:
        matrices[0] = sp.csr_array(matrices[0] + KERNEL_SHIFT * sp.diags_array(matrices[0].diagonal()))
    _make(ksp.getPC(), levels, matrices)


def _make(pc: PETSc.PC, levels: Levels, matrices: Sequence[sp.csr_array]) -> None:
    """Make a cycle of matrices, from scratch: PETSc would go on to compute residuals with those of last time."""
    pc.setType("none")
    pc.setType("mg")
    pc.setMGLevels(len(matrices))
    coarse = pc.getMGCoarseSolve()
    coarse.setOperators(_mat(matrices[0], pc.comm))
    _set_coarse_solver(coarse)
    for l, (P, matrix) in enumerate(zip(levels.prolongations, matrices[1:], strict=True), 1):
        pc.setMGInterpolation(l, _mat(P, pc.comm))
        smoother = pc.getMGSmoother(l)
        smoother.setOperators(_mat(matrix, pc.comm))
        _set_smoother(smoother, levels.smoothed[l])
    options = PETSc.Options(pc.getOptionsPrefix())
    options.setValue("pc_mg_galerkin", "external")  # matrices are there: none are asked of the DM of a SNES or TS
    pc.setFromOptions()
    options.delValue("pc_mg_galerkin")


def _set_coarse_solver(ksp: PETSc.KSP) -> None:
    ksp.setType("preonly")
    ksp.getPC().setType("lu")
    if PETSc.Sys.hasExternalPackage("mumps"):
        ksp.getPC().setFactorSolverType("mumps")


def _set_smoother(ksp: PETSc.KSP, functions: Ints) -> None:
    """Smooth the given functions alone, the one subdomain of an additive Schwarz method."""
    pc = ksp.getPC()
    pc.setType("asm")
    pc.setASMOverlap(0)
    numbers: Any = functions.astype(PETSc.IntType, copy=False)  # an array, other than the stubs say
    subdomain = PETSc.IS().createGeneral(numbers, comm=PETSc.COMM_SELF)
    pc.setASMLocalSubdomains(1, [subdomain], [subdomain])
    options = PETSc.Options(ksp.getOptionsPrefix())
    others = ("ksp_type", "pc_type", "sub_pc_type", "ksp_chebyshev_eigenvalues", "ksp_chebyshev_esteig")
    ours = not any(options.hasName(name) for name in others)
    if ours:
        options.setValue("ksp_chebyshev_eigenvalues", SMOOTHED)  # petsc4py has no function for it
    ksp.setFromOptions()
    if ours:
        options.delValue("ksp_chebyshev_eigenvalues")
    if pc.getType() == "asm":
        pc.setUp()
        for sub in pc.getASMSubKSP():
            sub.getPC().setType("sor")
            sub.setFromOptions()


def _mat(A: sp.csr_array, comm: Any) -> PETSc.Mat:
    A.sort_indices()  # which PETSc takes for granted
    return sharing(A, comm)


# ---- The levels ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Levels:
    """Nested spaces, the coarsest first, and what is smoothed on each.

    A function that one level has from the one before keeps its number through all of them, from the finest level on.

    Attributes:
        prolongations: From each level to the next.
        smoothed: Dofs of each level that it smooths, ascending; all of the coarsest.
        numbers: Number of each dof of each level; those of the last are 0, 1, ...
        finest: The last level that smooths each function, shape (functions of all levels,).
        coarser: For each dof in `smoothed` the last level before that smooths it as well; 0 if there is none.
    """

    prolongations: Sequence[sp.csr_array]
    smoothed: Sequence[Ints]
    numbers: Sequence[Ints]
    finest: Levelwise
    coarser: Sequence[Levelwise]

    @classmethod
    def of(cls, V: FunctionSpace) -> Levels:
        """Return the levels of a space, down to the coarsest mesh that its control mesh is a subdivision of."""
        prolongations = _below(V.hierarchy)
        marks = [np.ones(P.shape[0], dtype=bool) for P in prolongations]
        for l in range(1, V.num_levels):
            prolongations.append(_prolongation(V.hierarchy, l))
            marks.append(_meeting(V.hierarchy, l) | ~_copies(prolongations[-1]))
        k = V.block_size
        if k > 1:
            prolongations = [sp.csr_array(sp.kron(P, sp.eye_array(k), format="csr")) for P in prolongations]
            marks = [np.repeat(mark, k) for mark in marks]
        numbers, total = _numbers(prolongations, V.num_dofs)
        marks.insert(0, np.ones(numbers[0].size, dtype=bool))
        smoothed = [np.flatnonzero(mark).astype(np.int32) for mark in marks]
        finest, coarser = np.zeros(total, dtype=np.int8), []
        for l, (dofs, number) in enumerate(zip(smoothed, numbers, strict=True)):
            coarser.append(finest[number[dofs]])
            finest[number[dofs]] = l
        return cls(tuple(prolongations), tuple(smoothed), tuple(numbers), finest, tuple(coarser))

    @property
    def sizes(self) -> tuple[int, ...]:
        """Dofs of each level."""
        return tuple(number.size for number in self.numbers)

    def matrices(self, A: sp.csr_array) -> list[sp.csr_array]:
        """Return the Galerkin matrix of each level without the entries of two functions that it does not smooth.

        An entry of a level's matrix is used on the first level, from the finest on, that smooths one of the two
        functions, or makes others of them. So each is kept for that level, by the numbers of its functions.
        """
        kept: list[list[tuple[Ints, Ints, npt.NDArray[np.float64]]]] = [[] for _ in self.numbers]
        level_of = self.finest.copy()
        place = np.zeros(level_of.size, dtype=np.int32)
        matrices = []
        for l in reversed(range(len(self.numbers))):
            number, smoothed = self.numbers[l], self.smoothed[l]
            if smoothed.size < number.size or kept[l]:
                _keep(A, number, level_of, kept)
                place[number] = np.arange(number.size)
                rows, columns, values = (np.concatenate(parts) for parts in zip(*kept[l], strict=True))
                A = sp.csr_array((values, (place[rows], place[columns])), shape=A.shape)
                kept[l].clear()
            matrices.append(A)
            level_of[number[smoothed]] = self.coarser[l]
            if l:
                P = self.prolongations[l - 1]
                A = sp.csr_array(P.T.tocsr() @ (A @ P))
        return matrices[::-1]


def _keep(A: sp.csr_array, number: Ints, level_of: Levelwise, kept: Sequence[list[Any]]) -> None:
    """Keep the entries of a matrix for the levels that use them first."""
    rows, columns = np.repeat(number, np.diff(A.indptr)), number[A.indices]
    level = np.maximum(level_of[rows], level_of[columns])
    order = np.argsort(level, kind="stable")  # by radix, as these are bytes
    ends = np.cumsum(np.bincount(level, minlength=len(kept)))
    for l, entries in enumerate(np.split(order, ends[:-1])):
        if entries.size:
            kept[l].append((rows[entries], columns[entries], A.data[entries]))


def _numbers(prolongations: Sequence[sp.csr_array], size: int) -> tuple[list[Ints], int]:
    """Return the numbers of the dofs on each level, and how many there are."""
    numbers = [np.arange(size, dtype=np.int32)]
    for P in reversed(prolongations):
        copies = _copies(P)
        coarse = np.full(P.shape[1], -1, dtype=np.int32)
        coarse[P.indices[P.indptr[:-1][copies]]] = numbers[0][copies]
        others = np.flatnonzero(coarse < 0)
        coarse[others] = np.arange(size, size + others.size)
        size += others.size
        numbers.insert(0, coarse)
    return numbers, size


def _copies(P: sp.csr_array) -> Bools:
    """Return the rows of a prolongation whose function is one of the coarser level's: nothing else is made of that."""
    uses = np.bincount(P.indices, minlength=P.shape[1])
    rows = np.flatnonzero(np.diff(P.indptr) == 1)
    entries = P.indptr[rows]
    copies = np.zeros(P.shape[0], dtype=bool)
    copies[rows] = (P.data[entries] == 1.0) & (uses[P.indices[entries]] == 1)
    return copies


def _below(hierarchy: Hierarchy) -> list[sp.csr_array]:
    """Return the prolongations from coarser meshes up to level 0, until one has few functions."""
    prolongations: list[sp.csr_array] = []
    level, size = hierarchy.root, hierarchy.stages[0].boundary.num_functions
    while size > SMALL and (found := coarsened(level, hierarchy.rule)) is not None:
        level, matrix = found
        prolongations.insert(0, _without_rounding(matrix))
        size = matrix.shape[1]
    return prolongations


def _prolongation(hierarchy: Hierarchy, l: int) -> sp.csr_array:
    """Return the prolongation from V_{l-1} to V_l."""
    before, stage = hierarchy.stages[l - 1], hierarchy.stages[l]
    first, selected = int(hierarchy.dof_offsets[l - 1]), np.flatnonzero(before.selected)
    assert before.matrix is not None  # every stage but the last has a step
    last = np.arange(selected.size)
    units = sp.csr_array((np.ones(last.size), (selected, last)), shape=(before.selected.size, last.size))
    coefficients = sp.hstack([hierarchy.coefficients[l - 1][:, :first], units], format="csr")
    new = _without_rounding(before.matrix[np.flatnonzero(stage.selected)] @ coefficients)
    kept = np.concatenate([np.arange(first), first + last[before.active[selected]]])
    units = sp.csr_array((np.ones(kept.size), (np.arange(kept.size), kept)), shape=(kept.size, new.shape[1]))
    return sp.csr_array(sp.vstack([units, new], format="csr"))


def _without_rounding(P: sp.csr_array) -> sp.csr_array:
    P.data[np.abs(P.data) <= ROUNDING] = 0.0
    P.eliminate_zeros()
    return P


def _meeting(hierarchy: Hierarchy, l: int) -> Bools:
    """Return the functions of V_l that do not vanish on Omega^l."""
    stage, first = hierarchy.stages[l], int(hierarchy.dof_offsets[l])
    vertices = stage.level.corners_of(neighbourhood(stage.level, stage.inside))
    functions = np.concatenate([vertices, traces_meeting(stage.boundary, stage.inside)])
    used = hierarchy.coefficients[l][np.flatnonzero(functions)].indices
    older = np.bincount(used, minlength=first)[:first] > 0
    return np.concatenate([older, np.ones(np.count_nonzero(stage.selected), dtype=bool)])
