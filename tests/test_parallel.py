"""Sums and errors of several ranks, which are threads here; `tests/parallel` has them in processes."""

import sys
import traceback
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from ranks import Comm, on_ranks, ranks

from thccs_fem import parallel
from thccs_fem.mesh import ControlMesh

SIZES = pytest.mark.parametrize("size", [1, 2, 3])


class MeshError(ValueError):
    """Is not made from its message: that would be another one."""

    def __init__(self, face: int) -> None:
        super().__init__(f"face {face} is bad")


def no_bytes() -> UnicodeDecodeError:
    return UnicodeDecodeError("utf-8", b"\xff", 0, 1, "invalid start byte")


def local_class() -> Exception:
    class Local(KeyError):
        pass

    return Local("key")


def raising(error: BaseException) -> Callable[[], Any]:
    def work() -> Any:
        raise error

    return work


def texts(outcomes: list[Any]) -> list[str]:
    return [f"{type(outcome).__name__}: {outcome}" for outcome in outcomes]


def test_serial_is_one_rank() -> None:
    array = np.arange(3.0)
    assert (parallel.size_of(None), parallel.rank_of(None)) == (1, 0)
    assert (parallel.total(None, 2.5), parallel.largest(None, 2.5), parallel.smallest(None, 2.5)) == (2.5, 2.5, 2.5)
    assert parallel.total(None, array) is parallel.gathered(None, array) is array
    assert parallel.together(None, lambda: 7) == parallel.by_first_rank(None, lambda: 7) == 7
    error = OSError(2, "no", "file")
    for call in (parallel.together, parallel.by_first_rank):
        with pytest.raises(OSError, match="no") as caught:
            call(None, raising(error))
        assert caught.value is error


@SIZES
def test_sums_are_those_of_the_values_in_the_order_of_ranks(size: int) -> None:
    values = [1.0, 1e16, -1e16]
    expected = [1.0, 1e16, 0.0][size - 1]  # rounded after each sum, 1 is lost
    assert on_ranks(size, lambda comm: parallel.total(comm, values[comm.rank])) == [expected] * size
    found: list[Any] = on_ranks(size, lambda comm: parallel.total(comm, np.full((2, 3), values[comm.rank])))
    np.testing.assert_array_equal(found, np.full((size, 2, 3), expected))
    assert on_ranks(size, lambda comm: parallel.total(comm, comm.rank + 1)) == [size * (size + 1) // 2] * size


@SIZES
def test_extremes(size: int) -> None:
    assert on_ranks(size, lambda comm: parallel.largest(comm, -comm.rank)) == [0] * size
    assert on_ranks(size, lambda comm: parallel.smallest(comm, -comm.rank / 2)) == [(1 - size) / 2] * size
    for extreme in (parallel.largest, parallel.smallest):
        found: list[Any] = on_ranks(size, lambda comm, call=extreme: call(comm, [0.0, np.nan, 1.0][-1 - comm.rank]))
        np.testing.assert_array_equal(found, [1.0] if size == 1 else [np.nan] * size)


@SIZES
def test_arrays_are_gathered_in_the_order_of_ranks(size: int) -> None:
    found: list[Any] = on_ranks(size, lambda comm: parallel.gathered(comm, np.full((comm.rank, 2), comm.rank, np.int8)))
    for array in found:
        assert array.dtype == np.int8
        np.testing.assert_array_equal(array, [[1, 1], [2, 2], [2, 2]][: size * (size - 1) // 2] or np.zeros((0, 2)))


@SIZES
def test_each_rank_does_its_own_work(size: int) -> None:
    assert on_ranks(size, lambda comm: parallel.together(comm, lambda: comm.rank)) == list(range(size))
    assert on_ranks(size, lambda comm: parallel.by_first_rank(comm, lambda: comm.rank)) == [0] * size


@pytest.mark.parametrize(
    ("error", "seen"),
    [
        (ValueError("no mesh"), "ValueError: rank 1 of 3: no mesh"),
        (ValueError(), "ValueError: rank 1 of 3: "),
        (KeyError("name"), "KeyError: \"rank 1 of 3: 'name'\""),
        (FileNotFoundError(2, "no", "a.obj"), "FileNotFoundError: rank 1 of 3: [Errno 2] no: 'a.obj'"),
        (MeshError(3), "ValueError: rank 1 of 3: face 3 is bad"),
        (no_bytes(), f"UnicodeError: rank 1 of 3: {no_bytes()}"),
        (local_class(), "KeyError: \"rank 1 of 3: 'key'\""),
        (ExceptionGroup("some", [ValueError("one")]), "Exception: rank 1 of 3: some (1 sub-exception)"),
        (SystemExit(3), "SystemExit: rank 1 of 3: 3"),
    ],
    ids=lambda value: value.partition(":")[0] if isinstance(value, str) else type(value).__name__,
)
def test_error_of_one_rank_is_raised_on_all(error: BaseException, seen: str) -> None:
    work = [lambda: 0, raising(error), lambda: 2]
    found = on_ranks(3, lambda comm: parallel.together(comm, work[comm.rank]))
    assert texts(found) == [seen] * 3
    places = [traceback.extract_tb(o.__traceback__)[-1].name for o in found if isinstance(o, BaseException)]
    assert places == ["together", "work", "together"]  # the failed rank knows where
    assert not any(o.__cause__ for o in found if isinstance(o, BaseException))  # or there were two tracebacks


def test_same_error_of_all_ranks_stays_as_it_is() -> None:
    errors = [FileNotFoundError(2, "no such file", "a.obj") for _ in range(3)]
    assert on_ranks(3, lambda comm: parallel.together(comm, raising(errors[comm.rank]))) == errors


def test_first_of_different_errors_is_raised() -> None:
    work = [lambda: 0, raising(TypeError("one")), raising(ValueError("two"))]
    found = on_ranks(3, lambda comm: parallel.together(comm, work[comm.rank]))
    assert texts(found) == ["TypeError: rank 1 of 3: one"] * 3


def test_interrupt_does_not_wait_for_other_ranks() -> None:
    comm = ranks(2)[1]
    with pytest.raises(KeyboardInterrupt):
        parallel.together(comm, raising(KeyboardInterrupt()))
    assert comm.meeting.n_waiting == 0


@pytest.mark.parametrize(
    ("error", "seen"),
    [
        (FileNotFoundError(2, "no such file", "a.obj"), "FileNotFoundError: [Errno 2] no such file: 'a.obj'"),
        (no_bytes(), f"UnicodeDecodeError: {no_bytes()}"),
        (MeshError(3), "ValueError: face 3 is bad"),
        (local_class(), "KeyError: \"'key'\""),
        (SystemExit(3), "SystemExit: 3"),
    ],
    ids=lambda value: "" if isinstance(value, str) else type(value).__name__,
)
def test_error_of_the_first_rank_is_raised_on_all_as_it_is(error: BaseException, seen: str) -> None:
    found = on_ranks(3, lambda comm: parallel.by_first_rank(comm, raising(error)))
    assert found[0] is error
    assert texts(found[1:]) == [seen] * 2
    assert getattr(found[2], "errno", None) == getattr(error, "errno", None)


# Meshes

POINTS = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]
SQUARE: dict[str, Any] = {"vertices": POINTS, "faces": [(0, 1, 2, 3)]}


def test_mesh_is_the_same_on_all_ranks() -> None:
    found = on_ranks(2, lambda comm: ControlMesh(**SQUARE, comm=comm))
    assert [repr(mesh) for mesh in found] == ["ControlMesh(gdim=2, num_vertices=4, num_edges=4, num_faces=1)"] * 2
    assert [mesh.comm.rank for mesh in found if isinstance(mesh, ControlMesh)] == [0, 1]


def test_mesh_that_one_rank_finds_bad_is_bad_for_all() -> None:
    def made(comm: Comm) -> ControlMesh:
        return ControlMesh(POINTS, [(0, 1, 2, 3 + (comm.rank == 1))], comm=comm)

    first, *others = texts(on_ranks(3, made))
    assert first.startswith("ValueError: rank 1 of 3: faces 0 have corners out of range (face 0: 4)")
    assert others == [first, first]


@pytest.mark.parametrize(
    "other",
    [
        {"vertices": [*POINTS[:3], (0.0, 1.0 + 1e-15)]},
        {"vertices": [(*point, 0.0) for point in POINTS]},
        {"faces": [(1, 2, 3, 0)]},
        {"face_tags": [1]},
        {"edge_tags": {(0, 1): 1}},
        {"creases": {(0, 1): 1.0}},
        {"corners": {0: 1.0}},
    ],
    ids=lambda other: next(iter(other)),
)
def test_ranks_that_give_different_meshes_are_told(other: dict[str, Any]) -> None:
    given = [SQUARE, SQUARE, SQUARE | other]
    (name,) = other
    found = texts(on_ranks(3, lambda comm: ControlMesh(**given[comm.rank], comm=comm)))
    assert found[0].startswith(f"ValueError: rank 2 of 3 gives a mesh with other {name} than rank 0; expected the")
    assert found[1:] == found[:-1]


def test_order_of_tags_makes_no_other_mesh() -> None:
    tags: list[dict[tuple[int, int], int]] = [{(0, 1): 1, (1, 2): 2}, {(2, 1): 2, (0, 1): 1}]
    found = on_ranks(2, lambda comm: ControlMesh(**SQUARE, edge_tags=tags[comm.rank], comm=comm))
    assert [type(mesh) for mesh in found] == [ControlMesh] * 2


def test_communicator_of_another_kind() -> None:
    with pytest.raises(TypeError, match=r"comm is 3; expected a communicator of mpi4py, such as MPI\.COMM_WORLD"):
        ControlMesh(**SQUARE, comm=3)


# The hook


@pytest.fixture(autouse=True)
def _hook(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "excepthook", sys.excepthook)


def test_hook_is_set_once_and_for_the_largest_communicator() -> None:
    before = sys.excepthook
    parallel.end_together(None)
    parallel.end_together(SimpleNamespace(size=1))
    assert sys.excepthook is before
    sizes = []
    for size in (3, 2, 4):
        parallel.end_together(SimpleNamespace(size=size))
        sizes.append(sys.excepthook.comm.size)  # type: ignore[attr-defined]  # the hook of ours has it
        assert sys.excepthook.shows is before  # type: ignore[attr-defined]
    assert sizes == [3, 3, 4]


def test_hook_is_not_set_where_someone_types(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "ps1", ">>> ", raising=False)
    before = sys.excepthook
    parallel.end_together(SimpleNamespace(size=2))
    assert sys.excepthook is before
