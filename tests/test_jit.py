"""Compiled code and its cache. Caches of their own are in temporary directories."""

import os
import re
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

import ufl
from thccs_fem import element, fem, generators, jit

ROOT = Path(__file__).parents[1]

COMPILE = """
    import ufl
    from thccs_fem import element, jit

    V = ufl.FunctionSpace(ufl.Mesh(element.coordinate_element(2)), element.bspline())
    forms, module = jit.compile_forms([ufl.TestFunction(V) * ufl.dx(metadata={"quadrature_degree": 7})])
    assert forms[0].rank == 1
    assert jit.library().lib.thccs_assemble_cells
"""


def start(code: str, **environment: str | Path) -> subprocess.Popen[str]:
    """Run code in another Python process, which finds the package where this one does."""
    changes = {"PYTHONPATH": str(ROOT), **{name: str(value) for name, value in environment.items()}}
    return subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(code)],
        env=os.environ | changes,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def output(code: str, **environment: str | Path) -> tuple[int, str]:
    """Return exit code and all output."""
    process = start(code, **environment)
    text, _ = process.communicate(timeout=120)
    return process.returncode, text


def modules(cache: Path) -> list[str]:
    """Return the names of the modules in a cache."""
    return sorted(path.name for path in cache.glob("*/*") if path.is_dir())


@pytest.fixture(scope="module")
def filled_cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache filled by three processes that started at once."""
    cache = tmp_path_factory.mktemp("cache")
    processes = [start(COMPILE, THCCS_CACHE=cache) for _ in range(3)]
    for process in processes:
        text, _ = process.communicate(timeout=120)
        assert (process.returncode, text) == (0, "")  # silent, too
    return cache


def test_processes_that_start_at_once_share_one_copy(filled_cache: Path) -> None:
    assert [re.sub("_.*", "", name) for name in modules(filled_cache)] == ["forms", "kernels"]
    assert not list(filled_cache.glob("*/build-*"))


def test_a_second_start_compiles_nothing(filled_cache: Path) -> None:
    assert output(COMPILE, THCCS_CACHE=filled_cache, CC="false") == (0, "")


def test_what_a_killed_process_left_is_no_obstacle(filled_cache: Path, tmp_path: Path) -> None:
    (fingerprint,) = filled_cache.iterdir()
    for name in modules(filled_cache):
        (tmp_path / fingerprint.name / "build-killed" / name).mkdir(parents=True)
        (tmp_path / fingerprint.name / name).with_suffix(".lock").touch()
    assert output(COMPILE, THCCS_CACHE=tmp_path) == (0, "")


def test_forms_with_constants_are_compiled_once_whatever_their_numbers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # UFL sorts factors by their text, where 10 comes before 9.
    monkeypatch.setenv("THCCS_CACHE", str(tmp_path))
    msh = generators.rectangle((1, 1), (0.0, 0.0), (2.0, 3.0))

    def integrate() -> None:
        a, b, c = (fem.Constant(msh, value) for value in (2.0, 3.0, 5.0))
        assert fem.assemble_scalar(fem.form((a * b + c**2) * ufl.dx)) == pytest.approx(6.0 * (6.0 + 25.0))

    integrate()
    while str(fem.Constant(msh, 0.0).count() + 1).strip("9"):
        pass  # until the next ones are 9 and 10, or 99 and 100
    integrate()
    assert [name.split("_")[0] for name in modules(tmp_path)].count("forms") == 1


def test_without_locks_the_first_one_wins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("THCCS_CACHE", str(tmp_path))
    monkeypatch.setattr(jit, "fcntl", None)

    def build_twice(path: Path) -> None:
        """Build while another process puts its copy into place."""
        (path / "mine").touch()
        others = jit.cache_directory() / "module"
        others.mkdir()
        (others / "theirs").touch()

    assert [path.name for path in jit._built("module", build_twice).iterdir()] == ["theirs"]
    assert not list(tmp_path.glob("*/build-*"))


def test_missing_compiler_is_named(tmp_path: Path) -> None:
    code, text = output(COMPILE, THCCS_CACHE=tmp_path, CC="no-such-compiler")
    assert code != 0
    assert "OSError: there is no C compiler: 'no-such-compiler' was not found" in text
    assert modules(tmp_path) == []


def test_failing_compiler_is_named(tmp_path: Path) -> None:
    code, text = output(COMPILE, THCCS_CACHE=tmp_path, CC="false")
    assert code != 0
    assert "RuntimeError: the C compiler 'false' failed" in text
    assert modules(tmp_path) == []


def test_cache_that_cannot_be_written_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("THCCS_CACHE", str(tmp_path / "file"))
    with pytest.raises(OSError, match=r"compiled code can't be kept in .*file.*variable THCCS_CACHE"):
        jit.library.__wrapped__()


def test_options_of_ffcx_in_the_working_directory_do_not_matter(tmp_path: Path) -> None:
    (tmp_path / "ffcx_options.json").write_text('{"scalar_type": "float32", "verbosity": 10}')
    there = f"import os; os.chdir({str(tmp_path)!r})\n"
    assert output(there + textwrap.dedent(COMPILE), THCCS_CACHE=tmp_path) == (0, "")


@pytest.mark.skipif(sys.platform in {"win32", "darwin"}, reason="other platforms have other places")
def test_cache_is_where_the_environment_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("THCCS_CACHE", str(tmp_path / "own"))
    assert jit.cache_directory().parent == tmp_path / "own"
    monkeypatch.delenv("THCCS_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert jit.cache_directory().parent == tmp_path / "xdg" / "thccs-fem"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert jit.cache_directory().parent == tmp_path / ".cache" / "thccs-fem"


def test_cache_depends_on_processor_and_flags(monkeypatch: pytest.MonkeyPatch) -> None:
    here = jit.cache_directory()
    jit._fingerprint.cache_clear()
    assert jit.cache_directory() == here
    monkeypatch.setattr(jit, "_processor", lambda: "another one")
    jit._fingerprint.cache_clear()
    other = jit.cache_directory()
    monkeypatch.setattr(jit, "FLAGS", ("-O0",))
    jit._fingerprint.cache_clear()
    assert len({here, other, jit.cache_directory()}) == 3
    monkeypatch.undo()
    jit._fingerprint.cache_clear()
    assert jit.cache_directory() == here


def test_floating_point_of_the_process_is_left_alone() -> None:
    jit.library()
    assert "-ffast-math" not in jit.FLAGS
    tiny = np.array([np.finfo(np.float64).smallest_subnormal])
    assert (tiny * 1.0 != 0.0).all()  # flush-to-zero would make it 0
    assert np.isnan(np.array([np.nan]) + 1.0).all()


def test_tables_keep_small_products() -> None:
    """With FFCx's own tolerances the last product of end values, 2e-12, counts as 0."""
    V = ufl.FunctionSpace(ufl.Mesh(element.coordinate_element(2)), element.bspline())
    mass = ufl.TrialFunction(V) * ufl.TestFunction(V) * ufl.dx(metadata={"quadrature_degree": 15})
    (form,), module = jit.compile_forms([mass])
    nodes = np.array([(x, y, 0.0) for y in (-1.0, 0.0, 1.0, 2.0) for x in (-1.0, 0.0, 1.0, 2.0)])
    tensor = np.zeros((16, 16))
    pointers = [module.ffi.cast("double *", array.ctypes.data) for array in (tensor, nodes)]
    null = module.ffi.NULL
    form.form_integrals[0].tabulate_tensor_float64(pointers[0], null, null, pointers[1], null, null, null)
    # int B_0 B_3 = 1 / 5040 and int B_0 B_0 = 20 / 5040 on [0, 1]; functions 0, 3, 12, 15 are at the corners.
    expected = np.array([[400, 20, 20, 1], [20, 400, 1, 20], [20, 1, 400, 20], [1, 20, 20, 400]]) / 5040**2
    np.testing.assert_allclose(tensor[np.ix_([0, 3, 12, 15], [0, 3, 12, 15])], expected, rtol=1e-11)  # tables: 1e-15


def test_points_that_differ_by_little_are_not_confused() -> None:
    x = ufl.SpatialCoordinate(generators.rectangle((1, 1)).ufl_domain())
    points = np.array([[0.25, 0.5]])
    names = {jit.compile_expression(x[0], points + shift)[1].__file__ for shift in (0.0, 1e-12, 0.0)}
    assert len(names) == 2
