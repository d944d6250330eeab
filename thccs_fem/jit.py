"""Compiled code: UFL forms through FFCx, and the project's own C loops (kernels.c), each built once and kept.

The cache is ``$THCCS_CACHE`` or the user's cache directory. In it there is one directory for each combination of
processor, compiler flags and package versions, because ``-march=native`` code must never meet another processor,
and in that one directory for each compiled module. A module is built in a temporary directory and moved into place
by one rename, so that any number of processes may start at once and a killed one leaves nothing half made.
"""

import contextlib
import functools
import hashlib
import importlib.machinery
import importlib.metadata
import importlib.resources
import importlib.util
import logging
import os
import platform
import shutil
import sys
import sysconfig
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import cffi
import numpy as np
import numpy.typing as npt

import ffcx.codegeneration.jit
import ffcx.naming
import ufl

try:
    import fcntl
except ImportError:  # Windows: processes may then build the same module twice, the first one wins
    fcntl = None  # type: ignore[assignment]  # there is no such module to be had there

# As fast as -ffast-math on these kernels; that one is never used, since gcc then switches the whole process to
# flush-to-zero when the library is loaded, and NaNs are no longer seen.
FLAGS = (
    "-O3",
    "-march=native",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fno-signed-zeros",
    "-fassociative-math",
    "-freciprocal-math",
    "-g0",
    "-Wno-unused-variable",  # FFCx declares tables that it may not use: that is no news to who writes a form
    "-Wno-unused-const-variable",
)

# FFCx rounds table entries to 0 and 1 within its tolerance. Its default, 1e-9, is wrong for B-splines: products of two
# end values, (h^3 / 6)^2 with h the distance of the first Gauss point from the end, are that small from 5 points on.
OPTIONS = {
    "language": "C",
    "scalar_type": "float64",
    "sum_factorization": False,
    "part": "full",
    "epsilon": 1e-14,
    "table_rtol": 1e-15,
    "table_atol": 1e-15,
    "verbosity": logging.WARNING,
}


def cache_directory() -> Path:
    """Return the directory of the compiled modules that fit this processor, these flags and versions.

    It is not made yet. ``$THCCS_CACHE`` takes precedence over the user's cache directory.
    """
    return _cache_root() / f"{platform.machine()}-{_fingerprint()}"


def compile_forms(forms: Sequence[ufl.Form]) -> tuple[list[Any], ModuleType]:
    """Compile UFL forms with FFCx, or load them where that was done before.

    Args:
        forms: Forms whose integrals all have a quadrature degree (or points) in their metadata.

    Returns:
        The ``ufcx_form`` of each form, and the module (with ``ffi``) that must be kept as long as these are in use.

    Raises:
        OSError: There is no C compiler, or the cache can't be written.
        RuntimeError: The C compiler failed.
    """
    signature = ffcx.naming.compute_signature(list(forms), str(sorted(OPTIONS.items())))
    return _compiled_by_ffcx(ffcx.codegeneration.jit.compile_forms, f"forms_{signature}", list(forms))


def compile_expression(expression: ufl.core.expr.Expr, points: npt.NDArray[np.float64]) -> tuple[Any, ModuleType]:
    """Compile a UFL expression for evaluation at reference points, or load it where that was done before.

    Args:
        expression: The expression, without arguments.
        points: Points in the reference square, shape (n, 2).

    Returns:
        The ``ufcx_expression``, and the module (with ``ffi``) that must be kept as long as it is in use.

    Raises:
        OSError: There is no C compiler, or the cache can't be written.
        RuntimeError: The C compiler failed.
    """
    compiler = ffcx.codegeneration.jit.compile_expressions
    nowhere: npt.NDArray[np.floating[Any]] = points[:0]  # FFCx would print the points, with no more than 8 digits
    signature = ffcx.naming.compute_signature([(expression, nowhere)], str(sorted(OPTIONS.items())))
    key = hashlib.sha256(signature.encode() + repr(points.shape).encode() + points.tobytes()).hexdigest()
    (compiled,), module = _compiled_by_ffcx(compiler, f"expression_{key}", [(expression, points)])
    return compiled, module


_loaded: dict[Path, tuple[list[Any], ModuleType]] = {}  # what this process has loaded, by directory


def _compiled_by_ffcx(compiler: Callable[..., Any], name: str, objects: list[Any]) -> tuple[list[Any], ModuleType]:
    """Return what one of FFCx's compilers makes of the objects, from memory or the cache if it is there.

    Loading a module takes FFCx as long as finding its name: signatures of forms are half of what a small form costs.
    """
    directory = cache_directory() / name
    if directory not in _loaded:
        options: dict[str, Any] = {"options": OPTIONS, "cffi_extra_compile_args": list(FLAGS)}
        _built(name, lambda path: compiler(objects, cache_dir=path, **options))
        compiled, module, _ = compiler(objects, cache_dir=directory, **options)
        _loaded[directory] = compiled, module
    return _loaded[directory]


@functools.cache
def library() -> ModuleType:
    """Return the module of the C loops: ``library().lib`` has the functions of kernels.h, ``library().ffi`` is cffi's.

    A function is declared once, in kernels.h, and written in kernels.c. Calls release the GIL.

    Raises:
        OSError: There is no C compiler, or the cache can't be written.
        RuntimeError: The C compiler failed.
    """
    package = importlib.resources.files(__package__)
    header, source = ((package / name).read_text("utf-8") for name in ("kernels.h", "kernels.c"))
    name = "kernels_" + hashlib.sha256((header + source).encode()).hexdigest()[:32]

    def build(path: Path) -> None:
        builder = cffi.FFI()
        builder.cdef(header)
        builder.set_source(name, source, include_dirs=[str(package)], extra_compile_args=["-std=c17", *FLAGS])
        builder.compile(tmpdir=str(path))

    return _load(name, _built(name, build))


def _cache_root() -> Path:
    """Return the directory for caches: the environment's, else that of the platform."""
    if given := os.environ.get("THCCS_CACHE"):
        return Path(given).expanduser().absolute()
    home = Path.home()
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA", home / "AppData" / "Local"))
    elif sys.platform == "darwin":
        base = home / "Library" / "Caches"
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache")
    return base / "thccs-fem"


@functools.cache
def _fingerprint() -> str:
    """Return a hash of all that decides whether a compiled module can be used, besides its source."""
    versions = [importlib.metadata.version(f"fenics-{name}") for name in ("ufl", "basix", "ffcx")]
    suffix = sysconfig.get_config_var("EXT_SUFFIX")
    key = "\n".join([_processor(), *FLAGS, *versions, cffi.__version__, suffix])
    return hashlib.sha256(key.encode()).hexdigest()[:16]


def _processor() -> str:
    """Return the processor's model and features, as far as the platform tells them."""
    with contextlib.suppress(OSError):
        first = Path("/proc/cpuinfo").read_text().split("\n\n")[0]
        # x86 says "model name" and "flags", ARM "CPU part" and "Features"; clock rates and the like are left out.
        keys = ("vendor_id", "model name", "flags", "CPU implementer", "CPU part", "Features", "isa")
        return "\n".join(line for line in first.splitlines() if line.startswith(keys))
    return f"{platform.machine()} {platform.processor()}"


def _built(name: str, build: Callable[[Path], object]) -> Path:
    """Return the cached directory of this name; the first time have it filled by build(path)."""
    target = cache_directory() / name
    if target.is_dir():
        return target
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with _locked(target.with_suffix(".lock")):
            if not target.is_dir():
                with tempfile.TemporaryDirectory(prefix="build-", dir=target.parent) as scratch:
                    _run_compiler(build, Path(scratch, name))
                    _move(Path(scratch, name), target)
    except OSError as error:
        if error.errno is None:  # not the system's: no compiler
            raise
        raise OSError(
            f"compiled code can't be kept in {target.parent}: {error}. "
            f"Set the environment variable THCCS_CACHE to a directory that can be written."
        ) from error
    return target


def _move(source: Path, target: Path) -> None:
    """Rename a directory, unless another process was first (which can be where there are no locks)."""
    try:
        source.rename(target)
    except OSError:
        if not target.is_dir():
            raise


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Let one process at a time in; the system gives the lock back when a process dies."""
    with path.open("w") as file:
        if fcntl is not None:
            with contextlib.suppress(OSError):  # some network file systems have no locks
                fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _run_compiler(build: Callable[[Path], object], path: Path) -> None:
    """Call build(path), and say what to do when the C compiler is missing or fails."""
    path.mkdir()
    logger = logging.getLogger()
    handlers = logger.handlers.copy()
    try:
        build(path)
    except cffi.VerificationError as error:
        compiler = os.environ.get("CC") or sysconfig.get_config_var("CC") or "cl"
        if shutil.which(compiler.split()[0]) is None:
            raise OSError(
                f"there is no C compiler: {compiler!r} was not found. Forms are compiled when they are first used: "
                f"install gcc or clang, or set the environment variable CC."
            ) from error
        raise RuntimeError(
            f"the C compiler {compiler!r} failed ({error}); its messages are above. "
            f"gcc or clang is needed, with the flags {' '.join(FLAGS)}."
        ) from error
    finally:
        logger.handlers = handlers  # FFCx takes them away while it compiles, and keeps them if that fails


def _load(name: str, directory: Path) -> ModuleType:
    """Import the extension module of this name from the directory."""
    details = (importlib.machinery.ExtensionFileLoader, importlib.machinery.EXTENSION_SUFFIXES)
    spec = importlib.machinery.FileFinder(str(directory), details).find_spec(name)
    if spec is None or spec.loader is None:
        raise OSError(f"{directory} has no compiled module in it: remove that directory and try again.")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
