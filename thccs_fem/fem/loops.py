"""The loops that together integrate a form: each one integral over cells, or facets, of equal width, for kernels.c."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from thccs_fem.extraction import Batch, Cells
from thccs_fem.facets import Facets, boundary_facets, interior_facets
from thccs_fem.fem.forms import Form, Integral
from thccs_fem.fem.space import CellwiseSpace
from thccs_fem.fem.sparsity import pointer
from thccs_fem.jit import library
from thccs_fem.subdivision import Bools, Ints

__all__ = ["Loop", "cell_loops", "loops"]

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Loop:
    """One integral over the cells, or facets, of one batch.

    Attributes:
        batch: The batch.
        first_piece: Number of pieces in the batches before, of cells.
        sets: The set of dofs of each cell or facet of the batch, as `sparsity.pattern` numbers them, shape (n,).
        c_batch: Pointer to a `thccs_batch`.
        c_integral: Pointer to a `thccs_integral`.
        memory: What these structs point to.
    """

    batch: Batch
    first_piece: int
    sets: Ints
    c_batch: Any
    c_integral: Any
    memory: list[Any]

    def run(self, function: Callable[..., int], *arguments: Any) -> None:
        """Call one of the C loops."""
        if function(self.c_batch, self.c_integral, *arguments):
            raise MemoryError("there is no memory for the tensors of a single cell")


def loops(form: Form) -> Iterator[Loop]:
    """Yield the loops of all integrals of a form: over cells, and facets of cells, that count for what this rank owns.

    These are its own cells where the form has no arguments, else those with a function that it owns.
    """
    cells, data = form.cells, _Data.of(form)
    needed = cells.with_own_dofs if form.rank else _owned(cells)
    yield from _cell_loops(form, data, needed)
    yield from _facet_loops(form, data, needed, "exterior_facet", boundary_facets)
    yield from _facet_loops(form, data, needed, "interior_facet", interior_facets)


def cell_loops(form: Form) -> Iterator[Loop]:
    """Yield the loops of the integrals over cells alone, those that this rank owns."""
    yield from _cell_loops(form, _Data.of(form), _owned(form.cells))


def _owned(cells: Cells) -> Bools:
    return np.arange(cells.num_cells) < cells.num_owned


def _cell_loops(form: Form, data: _Data, needed: Bools) -> Iterator[Loop]:
    integrals = [integral for integral in form.integrals if integral.kind == "cell"]
    first_piece = 0
    for batch in form.cells.batches if integrals else ():
        memory: list[Any] = []
        c_batch = _c_batch(batch, form.cells.points, memory)
        for integral, chosen in _chosen(integrals, form.cells.tag[batch.cells], needed[batch.cells]):
            c_integral = data.c_integral(integral, batch.cells.size, chosen, memory)
            yield Loop(batch, first_piece, batch.cells, c_batch, c_integral, memory)
        first_piece += batch.num_pieces


def _facet_loops(form: Form, data: _Data, needed: Bools, kind: str, facets_of: Callable[..., Facets]) -> Iterator[Loop]:
    integrals = [integral for integral in form.integrals if integral.kind == kind]
    if not integrals:
        return
    facets = facets_of(form.cells)
    wanted = np.zeros(facets.num_facets, dtype=bool)
    for integral in integrals:
        wanted |= True if integral.tag is None else facets.tag == integral.tag
    wanted &= needed[facets.facet_cells].any(axis=1)
    if kind == "exterior_facet":
        sets = facets.facet_cells[:, 0]
    else:
        sets = np.arange(form.cells.num_cells, form.cells.num_cells + facets.num_facets, dtype=np.int32)
    for part in facets.batches(np.flatnonzero(wanted).astype(np.int32)):
        memory: list[Any] = []
        c_batch = _c_batch(part.batch, part.points, memory)
        every = np.ones(part.facets.size, dtype=bool)
        for integral, chosen in _chosen(integrals, facets.tag[part.facets], every):
            c_integral = data.c_integral(integral, part.facets.size, chosen, memory)
            yield Loop(part.batch, 0, sets[part.facets], c_batch, c_integral, memory)


def _chosen(integrals: list[Integral], tags: Ints, needed: Bools) -> Iterator[tuple[Integral, Ints | None]]:
    """Yield the integrals over a batch, and those needed of its cells or facets that each is over; None for all."""
    for integral in integrals:
        marks = needed if integral.tag is None else needed & (tags == integral.tag)
        if marks.any():
            yield integral, None if marks.all() else np.flatnonzero(marks).astype(np.int32)


def _c_batch(batch: Batch, points: Floats, memory: list[Any]) -> Any:
    ffi = library().ffi
    return ffi.new(
        "thccs_batch *",
        {
            "sides": batch.nodes.shape[1] // 16,
            "width": batch.dofs.shape[1],
            "gdim": points.shape[1],
            "cells": pointer(batch.cells, memory),
            "dofs": pointer(batch.dofs, memory),
            "offsets": pointer(batch.offsets, memory),
            "nodes": pointer(batch.nodes, memory),
            "operators": ffi.NULL if batch.operators is None else pointer(batch.operators, memory),
            "points": pointer(points, memory),
        },
    )


@dataclass(frozen=True)
class _Data:
    """Values of the functions and constants of a form.

    Attributes:
        coefficients: Of each function its values, at the dofs or on the cells that are integrated on, shape
            (n, block_size), and whether they are those on cells.
        constants: All constants, one after the other.
    """

    coefficients: list[tuple[Floats, bool]]
    constants: Floats

    @classmethod
    def of(cls, form: Form) -> _Data:
        constants = [np.ravel(c.value) for c in form.constants] or [np.zeros(0)]
        return cls([_values(form, i) for i in range(len(form.coefficients))], np.concatenate(constants).astype(float))

    def c_integral(self, integral: Integral, num_cells: int, chosen: Ints | None, memory: list[Any]) -> Any:
        """Return a `thccs_integral *` over the chosen cells of a batch, or all."""
        ffi = library().ffi
        coefficients = ffi.new(
            "thccs_coefficient[]",
            [
                (pointer(values, memory) if reads else ffi.NULL, values.shape[1], is_cellwise)
                for (values, is_cellwise), reads in zip(self.coefficients, integral.reads, strict=True)
            ],
        )
        memory.append(coefficients)
        return ffi.new(
            "thccs_integral *",
            {
                "kernel": integral.kernel,
                "constants": pointer(self.constants, memory),
                "num_coefficients": len(self.coefficients),
                "coefficients": coefficients,
                "num_cells": num_cells if chosen is None else chosen.size,
                "cells": ffi.NULL if chosen is None else pointer(chosen, memory),
            },
        )


def _values(form: Form, i: int) -> tuple[Floats, bool]:
    """Return the values of a coefficient on the cells that are integrated on; see `_Data`."""
    function = form.coefficients[i]
    space = function.ufl_function_space()
    if isinstance(space, CellwiseSpace):
        return function.cell_values(form.cells), True
    values = function.x.array.reshape(-1, space.block_size)
    transfer = form.transfers.get(space.hierarchy)
    return values if transfer is None else transfer(values), False
