"""How functions go over to a refinement, coefficient by coefficient, and how loads come back."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from thccs_fem.hierarchy import Hierarchy
from thccs_fem.index_map import Fetch
from thccs_fem.partition import partition

__all__ = ["Prolongation"]

Floats = npt.NDArray[np.float64]


class Prolongation:
    """The exact transfer from a hierarchy to a refinement of it, on the dofs that this rank holds of both.

    Making one is collective, and so is its use: the coarse dofs that fine ones are made of may be anywhere.

    Args:
        fine: The refinement.
        coarse: The other one.

    Attributes:
        matrix: Coefficients of fine dofs (rows, local) in terms of `wanted` ones (columns).
        wanted: Coarse dofs, by their number in the hierarchy, shape (n,).

    Raises:
        ValueError: If `fine` is no refinement of `coarse`.
    """

    def __init__(self, fine: Hierarchy, coarse: Hierarchy):
        self._fine, self._coarse = partition(fine).functions, partition(coarse).functions
        rows = fine.prolongation(coarse, None if self._fine.is_whole else self._fine.numbers)
        self.wanted = np.unique(rows.indices).astype(np.int32)
        if self.wanted.size < rows.shape[1]:
            columns = np.searchsorted(self.wanted, rows.indices).astype(np.int32)
            rows = sp.csr_array((rows.data, columns, rows.indptr), shape=(rows.shape[0], self.wanted.size))
        self.matrix = sp.csr_array(rows)
        self._fetch = Fetch(self._coarse, self.wanted)

    def __call__(self, values: Floats) -> Floats:
        """Return the coefficients of functions on the refinement.

        Args:
            values: Their coefficients, one function in each column, shape (coarse local, k) or the owned part of it.

        Returns:
            Shape (fine local, k).
        """
        return self.matrix @ self._fetch(values)

    def transposed(self, load: Floats) -> Floats:
        """Return the load of the coarse functions.

        Args:
            load: That of the fine ones, of which the owned part is used, shape (fine local, k).

        Returns:
            Shape (coarse local, k), the owned part complete.
        """
        owned = self._fine.size_local
        return self.gathered(self.matrix[:owned].T @ load[:owned])

    def gathered(self, contributions: Floats) -> Floats:
        """Return the sums over ranks of what each has for the coarse dofs that it wants.

        Args:
            contributions: Shape (wanted,) or (wanted, k).

        Returns:
            Shape (coarse local,) or (coarse local, k), the owned part complete.
        """
        result = np.zeros((self._coarse.numbers.size, *contributions.shape[1:]))
        self._fetch.add_back(contributions, result)
        return result
