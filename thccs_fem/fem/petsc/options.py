"""Options of a solver of PETSc: those in code, beside those on the command line, under one prefix."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from petsc4py import PETSc

from thccs_fem.parallel import rank_of

__all__ = ["Options"]


class Options:
    """Options given in code; they hold before those on the command line.

    Args:
        prefix: What distinguishes the options of a problem.
        given: Options without the prefix.

    Raises:
        ValueError: The prefix is empty.
    """

    def __init__(self, prefix: str, given: Mapping[str, Any] | None):
        if not prefix:
            raise ValueError('petsc_options_prefix is empty: give a name that is the problem\'s own, as "poisson_"')
        self.prefix = prefix
        self._given = {name.removeprefix("-"): value for name, value in (given or {}).items()}
        self._unused = set(self._given)

    def have(self, *names: str) -> bool:
        """Return whether one of these is given, here or on the command line."""
        with self.in_place() as options:
            return any(options.hasName(name) for name in names)

    @contextmanager
    def in_place(self) -> Iterator[PETSc.Options]:
        """Put the options into PETSc's database, which keeps them for as long only as they may be read.

        Not to be nested, nor `have` inside: what is asked for counts as used.
        """
        options = PETSc.Options(self.prefix)
        before = {name: options.getString(name) for name in self._given if options.hasName(name)}
        for name, value in self._given.items():
            options.setValue(name, value)
        try:
            yield options
        finally:
            for name in self._given:
                if PETSc.Options().used(f"{self.prefix}{name}"):
                    self._unused.discard(name)
                options.delValue(name)
            for name, text in before.items():
                options.setValue(name, text)

    def warn_unused(self, comm: Any) -> None:
        """Warn, once and on rank 0, of options that nothing has read; to be called by what the user calls."""
        if self._unused and rank_of(comm) == 0:
            warnings.warn(f"PETSc made no use of the options {sorted(self._unused)}: are they misspelt?", stacklevel=3)
        self._unused.clear()
