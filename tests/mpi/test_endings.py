"""Scripts that fail, on one rank or on all: one traceback, an exit code, and nobody who waits for ever."""

from pathlib import Path

import pytest
from launch import run_on_ranks

SECONDS = 30.0  # far more than a rank waits for others to fail, even if the processors are busy
START = """
import sys
import time
from mpi4py import MPI
from thccs_fem import generators, io, mesh

comm = MPI.COMM_WORLD
msh = generators.rectangle((1, 1), comm=comm)
"""


def ending(tmp_path: Path, size: int, script: str) -> str:
    """Run a script that fails; return what it says."""
    file = tmp_path / "script.py"
    file.write_text(START + script)
    code, output = run_on_ranks(size, str(file), time_limit=SECONDS, cwd=tmp_path)
    assert code == 1
    assert output.count("Traceback (most recent call last)") == 1
    assert output.count('script.py", line') == 1
    return output


@pytest.mark.parametrize(
    ("size", "line", "error"),
    [
        (2, "print(mash)", "NameError: name 'mash' is not defined. Did you mean: 'mesh'?"),
        (3, "io.read_mesh('no.obj', comm)", "FileNotFoundError: [Errno 2] No such file or directory: 'no.obj'"),
    ],
    ids=["name", "file"],
)
def test_error_of_all_ranks_is_told_once(tmp_path: Path, size: int, line: str, error: str) -> None:
    output = ending(tmp_path, size, line)
    assert output.startswith("Traceback")
    assert output.endswith(f"\n{error}\n")


@pytest.mark.parametrize("size", [2, 3])
def test_mesh_that_one_rank_finds_bad(tmp_path: Path, size: int) -> None:
    output = ending(tmp_path, size, "mesh.ControlMesh(msh.vertices, [(0, 1, 3, 2 + 6 * (comm.rank == 1))], comm=comm)")
    assert output.startswith("Traceback")
    expected = f"rank 1 of {size}: faces 0 have corners out of range (face 0: 8): vertices are 0 to 3"
    assert output.endswith(f"\nValueError: {expected}\n")
    assert "in read_polygons" in output  # it is the failed rank's traceback that is shown


@pytest.mark.parametrize(("size", "others"), [(2, "wait"), (3, "end")])
def test_error_of_one_rank_ends_all(tmp_path: Path, size: int, others: str) -> None:
    script = """
if comm.rank == 1:
    time.sleep(0.5)
    raise ArithmeticError("one rank alone")
"""
    output = ending(tmp_path, size, script + ("comm.barrier()" if others == "wait" else ""))
    assert output.startswith(f"rank 1 of {size}:\nTraceback")
    assert "\nArithmeticError: one rank alone\n" in output


def test_errors_of_some_ranks_end_all(tmp_path: Path) -> None:
    script = """
if comm.rank > 0:
    raise ArithmeticError(f"on rank {comm.rank}")
comm.barrier()
"""
    output = ending(tmp_path, 3, script)
    assert output.startswith("rank 1 of 3:\nTraceback")
    assert "\nArithmeticError: on rank 1\nrank 2 of 3 failed, too: ArithmeticError: on rank 2\n" in output


def test_different_errors_of_all_ranks(tmp_path: Path) -> None:
    output = ending(tmp_path, 2, "msh.face_tags[3 + comm.rank]")
    assert output.startswith("rank 0 of 2:\nTraceback")
    first, second = (f"IndexError: index {i} is out of bounds for axis 0 with size 1\n" for i in (3, 4))
    assert output.endswith(f"\n{first}rank 1 of 2 failed, too: {second}")


@pytest.mark.parametrize("lines", ["", "comm.barrier()"], ids=["others end", "others wait"])
def test_error_of_a_part_of_the_ranks_ends_all(tmp_path: Path, lines: str) -> None:
    script = f"""
sys.excepthook = sys.__excepthook__
part = comm.Split(comm.rank > 0)
generators.rectangle((1, 1), comm=part)
if comm.rank > 0:
    raise ArithmeticError("in one part")
{lines}
"""
    output = ending(tmp_path, 3, script)
    assert output.startswith("Traceback")
    assert "\nArithmeticError: in one part\n" in output


def test_conditions_that_fail_on_one_rank_in_a_step(tmp_path: Path) -> None:
    script = """
import ufl
from thccs_fem import fem
from thccs_fem.fem.petsc import TimeProblem

V = fem.functionspace(generators.rectangle((4, 2), comm=comm), ("THCCS", 3))
u, udot, v = fem.Function(V), fem.Function(V), ufl.TestFunction(V)

def bcs(V, time):
    if time > 0.05 and comm.rank == 1:
        raise ArithmeticError("no value")
    return [fem.dirichletbc(time, fem.boundary_dofs(V), V)]

TimeProblem(udot * v * ufl.dx, u, udot, dt=0.1, bcs=bcs, petsc_options_prefix="t_").solve(0.2)
"""
    file = tmp_path / "script.py"
    file.write_text(START + script)
    code, output = run_on_ranks(2, str(file), time_limit=SECONDS, cwd=tmp_path)
    assert code == 1
    assert "\nArithmeticError: no value\n" in output


def test_communicator_that_is_gone(tmp_path: Path) -> None:
    script = """
part = comm.Dup()
sys.excepthook = sys.__excepthook__
generators.rectangle((1, 1), comm=part)
part.Free()
comm.barrier()
if comm.rank == 1:
    raise ArithmeticError("one rank alone")
comm.barrier()
"""
    output = ending(tmp_path, 2, script)
    assert output.startswith("Traceback")
    assert "\nArithmeticError: one rank alone\n" in output


def test_what_all_ranks_catch_ends_nothing(tmp_path: Path) -> None:
    file = tmp_path / "script.py"
    file.write_text(
        START
        + """
try:
    mesh.ControlMesh(msh.vertices, [(0, 1, 3, 2 + 6 * (comm.rank == 1))], comm=comm)
except ValueError as error:
    found = comm.allgather(str(error))
assert len(found) == 2 and len(set(found)) == 1
sys.exit(7)
"""
    )
    code, output = run_on_ranks(2, str(file), time_limit=SECONDS, cwd=tmp_path)
    assert (code, output) == (7, "")


PROBLEM = """
import ufl
from thccs_fem import fem
from thccs_fem.fem.petsc import LinearProblem

V = fem.functionspace(generators.torus((5, 4), comm=comm), ("THCCS", 3))
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
f = fem.Function(V)
f.x.array[:] = 1.0
a, L = ufl.inner(ufl.grad(u), ufl.grad(v)) * ufl.dx + u * v * ufl.dx, f * v * ufl.dx
options = {"ksp_type": "cg", "pc_type": "none", "ksp_max_it": 1, "ksp_rtol": 1e-14}
"""


@pytest.mark.parametrize(
    ("size", "line", "error"),
    [
        (3, "LinearProblem(a, L, petsc_options_prefix='a_', petsc_options=options).solve()", "DIVERGED_MAX_IT"),
        (
            2,
            "f.x.array[0] = [1, 'nan'][comm.rank]; LinearProblem(a, L, petsc_options_prefix='a_').solve()",
            "not finite",
        ),
    ],
    ids=["iterations", "nan"],
)
def test_solver_that_fails(tmp_path: Path, size: int, line: str, error: str) -> None:
    output = ending(tmp_path, size, PROBLEM + line)
    assert output.startswith("Traceback")
    assert "\nRuntimeError: PETSc's" in output
    assert error in output
