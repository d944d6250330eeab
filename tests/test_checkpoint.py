"""Checkpoints: what is read is what was written, to the bit, or it is refused."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from refinements import CASES, MESHES, STEPS, refinements
from zoo import ZOO

import ufl
from thccs_fem import adapt, checkpoint, estimate, fem, generators
from thccs_fem.fem.scipy import LinearProblem
from thccs_fem.fem.space import CellwiseSpace, FunctionSpace
from thccs_fem.forms import heat, poisson
from thccs_fem.mesh import ControlMesh

TAGGED: dict[str, Any] = {
    "vertices": [(0, 0), (2, 0), (2, 2), (0, 2), (3, 1)],
    "faces": [[0, 1, 2, 3], [1, 4, 2]],
    "face_tags": [7, -(2**31)],
    "edge_tags": {(1, 0): 5, (4, 2): -1},
    "creases": {(1, 2): 0.1, (3, 0): np.inf},
    "corners": {4: 1 / 3, 0: 10.0},
}
NAMES = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=5)
TEXT = st.text(max_size=5)
NUMBERS = hnp.scalar_dtypes().filter(lambda dtype: dtype.kind in "biufc")
ARRAYS = hnp.arrays(NUMBERS, hnp.array_shapes(min_dims=0, min_side=0, max_side=3))
LEAVES = st.none() | st.booleans() | st.integers() | st.floats() | TEXT | ARRAYS | ARRAYS.map(lambda a: a.sum())
TREES = st.recursive(LEAVES, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(TEXT, inner, max_size=3))


def random(V: FunctionSpace | CellwiseSpace, name: str, seed: int = 0) -> fem.Function:
    u = fem.Function(V, name)
    u.x.array = np.random.default_rng(seed).uniform(-1.0, 1.0, u.x.array.size)
    return u


def assert_same_mesh(found: ControlMesh, expected: ControlMesh) -> None:
    for name in ("vertices", "face_offsets", "face_vertices", "face_tags"):
        there, here = getattr(found, name), getattr(expected, name)
        np.testing.assert_array_equal(there, here)
        assert there.dtype == here.dtype
    for name in ("edge_tags", "creases", "corners"):
        assert getattr(found, name) == getattr(expected, name)


def assert_same(found: Any, expected: Any) -> None:
    """Equal, of the same type, and to the bit; a list for a tuple, a scalar for an array without axes."""
    if isinstance(expected, np.ndarray | np.generic):
        expected = expected[()]
        assert (found.dtype, found.shape, found.tobytes()) == (expected.dtype, expected.shape, expected.tobytes())
    elif isinstance(expected, dict):
        assert list(found) == list(expected)
        for key, value in expected.items():
            assert_same(found[key], value)
    elif isinstance(expected, list | tuple):
        assert len(found) == len(expected)
        for one, other in zip(found, expected, strict=True):
            assert_same(one, other)
    else:
        assert type(found) is type(expected)
        assert repr(found) == repr(expected)  # nan is no equal of itself


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "état.h5"


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file, not to be changed."""
    path = tmp_path_factory.mktemp("written") / "run.h5"
    V = fem.functionspace(generators.rectangle((2, 2)), ("THCCS", 3))
    checkpoint.write(path, [random(V, "u"), random(V, "v", 1)], {"time": 0.1})
    return path


# ---- What was written comes back


@settings(max_examples=20)
@given(st.sampled_from(CASES), STEPS, NAMES, st.integers(1, 3), st.integers(1, 8))
@example(("polygons", "clamped"), [[("any", True, 1)]] * 2, "ü/∂t", 2, 6)
def test_functions_come_back_to_the_bit(
    case: tuple[str, str], steps: list[Any], name: str, width: int, cap_level: int
) -> None:
    first, *_, middle, last = (hierarchy.with_caps_at(cap_level) for hierarchy in refinements(*case, steps))
    V, W = FunctionSpace(last), FunctionSpace(middle, (width,))
    spaces = [V, W, V, CellwiseSpace(V.mesh, last, (width,)), CellwiseSpace(V.mesh), FunctionSpace(first)]
    functions = [random(space, f"{name}{k}", k) for k, space in enumerate(spaces)]
    with tempfile.TemporaryDirectory() as folder:
        checkpoint.write(Path(folder) / f"{width}.h5", functions)
        saved = checkpoint.read(Path(folder) / f"{width}.h5")
    assert_same_mesh(saved.mesh, V.mesh)
    assert saved.mesh.comm is None
    assert list(saved.functions) == [u.name for u in functions]
    for u, found in zip(functions, saved.functions.values(), strict=True):
        np.testing.assert_array_equal(found.x.array, u.x.array)
        here, there = u.ufl_function_space(), found.ufl_function_space()
        assert found.name == u.name
        assert type(there) is type(here)
        assert there.mesh is saved.mesh
        assert there.value_shape == here.value_shape
        if here.hierarchy is not None:
            assert there.hierarchy is not None
            assert (there.hierarchy.rule, there.hierarchy.cap_level) == (case[1], cap_level)
            assert len(there.hierarchy.refined_keys) == len(here.hierarchy.refined_keys)
            for keys, expected in zip(there.hierarchy.refined_keys, here.hierarchy.refined_keys, strict=True):
                np.testing.assert_array_equal(keys, expected)


@pytest.mark.parametrize("name", sorted(ZOO))
def test_meshes_come_back(name: str, path: Path) -> None:
    checkpoint.write(path, random(fem.functionspace(MESHES[name], ("DG", 0)), "u"))
    assert_same_mesh(checkpoint.read(path).mesh, MESHES[name])


def test_tags_and_sharpnesses_come_back(path: Path) -> None:
    msh = ControlMesh(**TAGGED)
    checkpoint.write(path, random(fem.functionspace(msh, ("DG", 0)), "u"))
    assert_same_mesh(checkpoint.read(path).mesh, msh)


def test_functions_share_the_space_that_they_shared(path: Path) -> None:
    V = fem.functionspace(generators.l_domain(2), ("THCCS", 3))
    W = fem.functionspace(V.mesh, ("THCCS", 3))  # equal to V
    finer = adapt.refine(V, [3])
    checkpoint.write(path, [random(space, name) for name, space in zip("abcd", (V, finer, W, V), strict=True)])
    a, b, c, d = (u.function_space for u in checkpoint.read(path).functions.values())
    assert a is c is d
    assert b.is_refinement_of(a)
    np.testing.assert_array_equal(b.prolongation(a).toarray(), finer.prolongation(V).toarray())


def test_functions_go_along_with_those_on_a_mesh_that_is_there(path: Path) -> None:
    msh = ControlMesh(**TAGGED | {"creases": None, "corners": {0: 10.0}})
    V = fem.functionspace(msh, ("THCCS", 3))
    u = random(V, "u")
    checkpoint.write(path, u)
    found = checkpoint.read(path, mesh=msh).functions["u"]
    assert found.function_space == V
    # Rounding: kernels may round the sums of one and the other in different places (by fused operations).
    assert fem.assemble_scalar(fem.form((found - u) ** 2 * ufl.dx)) < 1e-28


@settings(max_examples=30)
@given(st.dictionaries(TEXT, TREES, max_size=3))
@example({"time": 0.1, "step": np.int64(3), "\0ü\ud800": (float("nan"), -0.0, np.float64("inf"), [np.arange(2)])})
@example({"many": [np.array(k) for k in range(11)]})
def test_attributes_come_back(attributes: dict[str, Any]) -> None:
    u = random(fem.functionspace(MESHES["single_quad"], ("DG", 0)), "u")
    with tempfile.TemporaryDirectory() as folder:
        checkpoint.write(Path(folder) / "a.h5", u, attributes)
        assert_same(checkpoint.read(Path(folder) / "a.h5").attributes, attributes)


def test_long_functions_are_read_in_slabs(written: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    expected = checkpoint.read(written).functions["v"]
    monkeypatch.setattr(checkpoint, "SLAB", 7)
    np.testing.assert_array_equal(checkpoint.read(written).functions["v"].x.array, expected.x.array)


def test_equal_content_is_equal_bytes(path: Path, written: Path) -> None:
    saved = checkpoint.read(written)
    checkpoint.write(path, saved.functions.values(), saved.attributes)
    assert path.read_bytes() == written.read_bytes()


def test_other_programs_can_read_the_file(written: Path) -> None:
    saved = checkpoint.read(written)
    with h5py.File(written) as file:
        assert sorted(file) == ["attributes", "functions", "hierarchies", "mesh", "spaces"]
        assert file["functions/1"].attrs["name"] == "v"
        np.testing.assert_array_equal(file["functions/1"][:, 0], saved.functions["v"].x.array)
        np.testing.assert_array_equal(file["mesh/vertices"], saved.mesh.vertices)


# ---- What is no whole checkpoint is refused


def test_no_function_of_that_name(written: Path) -> None:
    with pytest.raises(KeyError, match=r"no function 'w' in .*run.h5; it has 'u', 'v'"):
        checkpoint.read(written).functions["w"]


def test_no_file(path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"état\.h5"):
        checkpoint.read(path)


@pytest.mark.parametrize("content", [b"", b"solid cube", bytes(5000)])
def test_no_hdf5_file(path: Path, content: bytes) -> None:
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"état.h5 is no checkpoint: it is no HDF5 file"):
        checkpoint.read(path)


@pytest.mark.parametrize("userblock_size", [0, 512])
def test_hdf5_file_of_another_program(path: Path, userblock_size: int) -> None:
    with h5py.File(path, "w", userblock_size=userblock_size) as file:
        file["mesh/vertices"] = np.zeros((3, 2))
    with pytest.raises(ValueError, match=r"is no checkpoint: it is an HDF5 file, but not one that checkpoint.write"):
        checkpoint.read(path)


def test_other_version(path: Path, written: Path) -> None:
    path.write_bytes(written.read_bytes().replace(b"version 1\n", b"version 12\n", 1))
    with pytest.raises(ValueError, match=r"version 12; expected 1: read it with the release of thccs-fem that wrote"):
        checkpoint.read(path)


def test_cut_off(path: Path, written: Path) -> None:
    whole = written.read_bytes()
    for size in range(512, len(whole), 997):
        path.write_bytes(whole[:size])
        with pytest.raises(ValueError, match=rf"is cut off: {size} of {len(whole)} bytes are there. Copy it again"):
            checkpoint.read(path)


def test_damaged_anywhere(path: Path, written: Path) -> None:
    whole = np.frombuffer(written.read_bytes(), dtype=np.uint8)
    rng = np.random.default_rng(4)
    places = [*range(0, 512, 5), *range(512, whole.size, 61)]
    for place in places:
        content = whole.copy()
        content[place] ^= 1 << rng.integers(8)
        path.write_bytes(content.tobytes())
        with pytest.raises(ValueError, match=r"is damaged|is no checkpoint|is cut off|of version"):
            checkpoint.read(path)
    content = whole.copy()
    content[-512:] = 0  # as a file system may leave a block that it has not written
    path.write_bytes(content.tobytes())
    with pytest.raises(ValueError, match=r"is damaged: what it holds was not written so. Copy it again, or go on from"):
        checkpoint.read(path)


@pytest.mark.parametrize("name", sorted(TAGGED))
def test_another_mesh_than_the_one_given(path: Path, name: str) -> None:
    changed: dict[str, Any] = {
        "vertices": [(0, 0), (2, 0), (2, 2), (0, 2), (3, 1 + 2**-52)],
        "faces": [[1, 2, 3, 0], [1, 4, 2]],
        "face_tags": [7, 8],
        "edge_tags": {(0, 1): 5},
        "creases": None,
        "corners": {4: 1 / 3, 0: 11},
    }
    checkpoint.write(path, random(fem.functionspace(ControlMesh(**TAGGED), ("DG", 0)), "u"))
    other = ControlMesh(**TAGGED | {name: changed[name]})
    with pytest.raises(ValueError, match=r"another control mesh, with 5 vertices and 2 faces, than the one given"):
        checkpoint.read(path, mesh=other)


def test_values_of_another_space(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    V = fem.functionspace(generators.rectangle((2, 2)), ("THCCS", 3))
    checkpoint.write(path, random(V, "u"))
    monkeypatch.setattr(checkpoint, "_spaces_of", lambda file, msh: [fem.functionspace(msh, ("THCCS", 3), "crease")])
    with pytest.raises(ValueError, match=r"'u' has values of shape \(25, 1\), its space asks for \(9, 1\): read it"):
        checkpoint.read(path)


# ---- What can't be written


def test_nothing_is_written(path: Path) -> None:
    with pytest.raises(ValueError, match="no functions to write; expected one or more"):
        checkpoint.write(path, [])


@pytest.mark.parametrize("wrong", [3.0, [None], np.zeros(3)])
def test_no_functions(path: Path, wrong: Any) -> None:
    with pytest.raises(TypeError, match=r"checkpoint.write needs functions, fem.Function, got (float|NoneType)"):
        checkpoint.write(path, wrong)


def test_two_functions_of_one_name(path: Path) -> None:
    V = fem.functionspace(generators.rectangle((2, 2)), ("THCCS", 3))
    with pytest.raises(ValueError, match="2 functions have the name 'f', by which they are found again: give each its"):
        checkpoint.write(path, [fem.Function(V), fem.Function(V)])


def test_two_meshes(path: Path) -> None:
    functions = [fem.Function(fem.functionspace(generators.rectangle((2, 2)), ("DG", 0)), name) for name in "uv"]
    with pytest.raises(ValueError, match="several control meshes: write a checkpoint for each mesh"):
        checkpoint.write(path, functions)


@pytest.mark.parametrize(
    ("attributes", "message"),
    [
        ({"mesh": object()}, r"attributes\['mesh'\] is of type object; a checkpoint keeps None"),
        ({"a": [0, {"b": {1}}]}, r"attributes\['a'\]\[1\]\['b'\] is of type set; a checkpoint keeps"),
        ({"a": np.array(["b"])}, r"attributes\['a'\] is an array of type <U1; a checkpoint keeps"),
        ({"a": {1: 2}}, r"attributes\['a'\] has the key 1; expected strings"),
        ({"a": {"numpy array": 2}}, r"attributes\['a'\] has the key 'numpy array'; expected strings \(other than"),
    ],
)
def test_attributes_that_would_not_come_back(path: Path, attributes: dict[str, Any], message: str) -> None:
    u = random(fem.functionspace(MESHES["grid"], ("DG", 0)), "u")
    checkpoint.write(path, u)
    before = path.read_bytes()
    with pytest.raises(TypeError, match=message):
        checkpoint.write(path, u, attributes)
    assert path.read_bytes() == before
    assert list(path.parent.iterdir()) == [path]


def test_no_folder(tmp_path: Path) -> None:
    u = random(fem.functionspace(MESHES["grid"], ("DG", 0)), "u")
    with pytest.raises(FileNotFoundError, match="nowhere"):
        checkpoint.write(tmp_path / "nowhere" / "run.h5", u)


def test_what_fails_leaves_the_old_file_alone(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_space(file: int) -> None:
        raise OSError(28, "No space left on device")

    u = random(fem.functionspace(MESHES["grid"], ("DG", 0)), "u")
    checkpoint.write(path, u, {"step": 1})
    monkeypatch.setattr(os, "fsync", no_space)
    with pytest.raises(OSError, match="No space left on device"):
        checkpoint.write(path, u, {"step": 2})
    assert checkpoint.read(path).attributes == {"step": 1}
    assert list(path.parent.iterdir()) == [path]


def test_a_write_takes_away_what_another_has_left(path: Path) -> None:
    path.with_name("état.h5.part").write_bytes(b"half of a file")
    checkpoint.write(path, random(fem.functionspace(MESHES["grid"], ("DG", 0)), "u"))
    assert list(path.parent.iterdir()) == [path]


# ---- Runs that are killed


@pytest.mark.parametrize("what", ["at_every_line", "while_writing", "adaptive"])
def test_killed(what: str, tmp_path: Path) -> None:
    script = Path(__file__).with_name("killing.py")
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(script.parents[1])}
    command = [sys.executable, "-W", "error::DeprecationWarning", str(script), what, str(tmp_path)]
    run = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert run.returncode == 0, run.stdout + run.stderr


# ---- Time


@pytest.mark.parametrize("scheme", ["implicit_euler", "crank_nicolson", "bdf2"])
def test_a_run_in_time_goes_on(path: Path, scheme: str) -> None:
    pytest.importorskip("mpi4py.MPI")
    pytest.importorskip("petsc4py")
    from thccs_fem.fem.petsc import TimeProblem

    msh = generators.torus((6, 4))
    x = ufl.SpatialCoordinate(msh)

    def problem(u: fem.Function, time: float, before: tuple[float, fem.Function] | None = None) -> TimeProblem:
        udot, v, t = fem.Function(u.function_space), ufl.TestFunction(u.function_space), fem.Constant(msh, time)
        F = heat.F(u, udot, v, f=ufl.sin(t) * x[0])
        return TimeProblem(F, u, udot, t=t, dt=0.1, scheme=scheme, before=before, petsc_options_prefix="run_")

    V = fem.functionspace(msh, ("THCCS", 3))
    whole = problem(fem.project(x[0], V), 0.0)
    first = problem(fem.project(x[0], V), 0.0)
    for _ in range(5):
        whole.step()
    for _ in range(2):
        u = first.step()
    assert first.before is not None
    u.name = "u"
    past, before = first.before
    checkpoint.write(path, [u, before], {"time": first.time, "past": past})
    saved = checkpoint.read(path, mesh=msh)
    given = (saved.attributes["past"], saved.functions[before.name]) if scheme == "bdf2" else None
    second = problem(saved.functions["u"], saved.attributes["time"], given)
    for _ in range(3):
        second.step()
    assert second.time == whole.time
    with pytest.raises(ValueError, match=r"the values before are in .*; they must be in the space of the unknown"):
        problem(u, 0.0, (past, fem.Function(adapt.refine(V, [0]))))
    rounding = 1e-14 if scheme == "bdf2" else 0.0  # it computes the sizes of steps from times
    np.testing.assert_allclose(second.u.x.array, whole.u.x.array, rtol=0.0, atol=rounding)


# ---- The adaptive loop


def loop(V: FunctionSpace, path: Path | None, stop: adapt.Stop) -> tuple[adapt.History, int]:
    """Return the history of an adaptive run, and how often it solved."""
    f, solved = fem.Constant(V.mesh, 1.0), 0

    def solver(V: FunctionSpace) -> fem.Function:
        nonlocal solved
        solved += 1
        u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
        bc = fem.dirichletbc(0.0, fem.boundary_dofs(V), V)
        return LinearProblem(poisson.a(u, v), poisson.L(f, v), bcs=[bc]).solve()

    def estimator(u: fem.Function) -> np.ndarray:
        return estimate.residual(u, poisson.strong_residual(u, f))

    return adapt.solve(V, solver, estimator, stop=stop, checkpoint=path, progress=False), solved


def test_a_run_goes_on_where_it_was(path: Path) -> None:
    V = fem.functionspace(generators.l_domain(2), ("THCCS", 3))
    whole, _ = loop(V, None, adapt.Stop(steps=4))
    assert loop(V, path, adapt.Stop(steps=1))[1] == 2
    again = fem.functionspace(V.mesh, ("THCCS", 3))  # of another process, say
    continued, solved = loop(again, path, adapt.Stop(steps=4))
    assert solved == 3
    assert [(s.number, s.dofs, s.estimate) for s in continued.steps] == [
        (s.number, s.dofs, s.estimate) for s in whole.steps
    ]
    assert continued.solution.function_space == whole.solution.function_space
    np.testing.assert_array_equal(continued.solution.x.array, whole.solution.x.array)


@pytest.mark.parametrize("stop", [adapt.Stop(steps=2), adapt.Stop(tolerance=1.0), adapt.Stop(dofs=1)], ids=str)
def test_a_run_that_is_over_is_over(path: Path, stop: adapt.Stop) -> None:
    V = fem.functionspace(generators.l_domain(2), ("THCCS", 3))
    first, _ = loop(V, path, adapt.Stop(steps=2))
    second, solved = loop(V, path, stop)
    assert solved == 0
    assert second.steps == first.steps
    np.testing.assert_array_equal(second.solution.x.array, first.solution.x.array)


@pytest.mark.parametrize(
    "other",
    [
        lambda V: fem.functionspace(V.mesh, ("THCCS", 3), "crease"),
        lambda V: fem.functionspace(V.mesh, ("THCCS", 3), cap_level=7),
        lambda V: adapt.refine(V, [0]),
    ],
    ids=["rule", "caps", "finer"],
)
def test_a_run_from_another_space_is_refused(path: Path, other: Callable[[FunctionSpace], FunctionSpace]) -> None:
    V = fem.functionspace(generators.l_domain(2), ("THCCS", 3))
    loop(V, path, adapt.Stop(steps=1))
    with pytest.raises(ValueError, match=rf"of a run that began with {V.num_dofs} dofs in another space than Functi"):
        loop(other(V), path, adapt.Stop(steps=2))


def test_a_run_on_another_mesh_is_refused(path: Path) -> None:
    loop(fem.functionspace(generators.l_domain(2), ("THCCS", 3)), path, adapt.Stop(steps=0))
    with pytest.raises(ValueError, match="another control mesh"):
        loop(fem.functionspace(generators.l_domain(4), ("THCCS", 3)), path, adapt.Stop(steps=0))


def test_a_file_of_another_kind_is_refused(written: Path) -> None:
    V = fem.functionspace(generators.rectangle((2, 2)), ("THCCS", 3))
    with pytest.raises(ValueError, match=r"run.h5 was not written by adapt.solve: give another name, or remove it"):
        loop(V, written, adapt.Stop(steps=1))
