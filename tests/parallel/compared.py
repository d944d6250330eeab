"""The same work done by all ranks together and by each rank alone: the results must not differ."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from mpi4py import MPI

import numpy as np

from thccs_fem.mesh import ControlMesh

__all__ = ["assert_same", "same_as_in_serial", "shared"]


def shared(msh: ControlMesh, comm: MPI.Comm) -> ControlMesh:
    """Return the mesh on another communicator."""
    faces = msh.quads if msh.is_quad else np.split(msh.face_vertices, msh.face_offsets[1:-1])
    return ControlMesh(msh.vertices, faces, msh.face_tags, msh.edge_tags, msh.creases, msh.corners, comm)


def same_as_in_serial[T](work: Callable[[MPI.Comm], T], tol: float = 1e-10) -> T:
    """Call work on all ranks together and on this one alone; fail unless both give the same.

    Args:
        work: Gives numbers, arrays, text or truth, or sequences and mappings of these, of the whole, not of the rank.
        tol: Largest difference; of each array, its part of the largest entry.

    Returns:
        What came of the ranks together.
    """
    together, alone = work(MPI.COMM_WORLD), work(MPI.COMM_SELF)
    assert_same(together, alone, tol)
    return together


def assert_same(found: Any, expected: Any, tol: float, name: str = "result") -> None:
    if isinstance(expected, Mapping):
        assert list(found) == list(expected), f"keys of {name}"
        found, expected = list(found.items()), list(expected.items())
    if isinstance(expected, str):
        assert found == expected, name
    elif isinstance(expected, Sequence):
        assert len(found) == len(expected), f"length of {name}"
        for i, (one, other) in enumerate(zip(found, expected, strict=True)):
            assert_same(one, other, tol, f"{name}[{i}]")
    else:
        found, expected = np.asarray(found), np.asarray(expected)
        assert found.shape == expected.shape, f"shape of {name}"
        exact = expected.dtype.kind in "biu" or not expected.size
        size = 0.0 if exact else np.abs(expected).max(where=np.isfinite(expected), initial=0.0)
        np.testing.assert_allclose(found, expected, rtol=0, atol=tol * size, err_msg=name)
