"""Checkpoints: control mesh, hierarchies and functions in one file, to go on from after an end or a crash.

What `write` has written `read` gives back to the bit, on any number of ranks.  So a run in time goes on where it was::

    if Path("run.h5").exists():
        saved = checkpoint.read("run.h5", mesh=msh)
        u, t = saved.functions["u"], fem.Constant(msh, saved.attributes["time"])
    else:
        u, t = fem.project(initial, fem.functionspace(msh, ("THCCS", 3))), fem.Constant(msh, 0.0)
        u.name = "u"
    udot, v = fem.Function(u.function_space), ufl.TestFunction(u.function_space)
    F = heat.F(u, udot, v)
    problem = TimeProblem(F, u, udot, t=t, dt=0.1, scheme="crank_nicolson", petsc_options_prefix="heat_")
    for u in problem.steps(1.0):
        checkpoint.write("run.h5", u, {"time": problem.time})

("bdf2" looks one step further back: keep the time and the function of ``problem.before``, too, for the next problem.)

A file is either whole or not there: it is written under another name, and gets its own when it is on the disk.  So a
run that is killed at any moment goes on from the last `write` that was complete, and the next one takes away what was
left of the one that was not.

The file is an HDF5 file, with arrays as they are in memory.  HDF5 leaves the first 512 bytes to its user: there stand
the version of the format and a digest of all that follows, so that damage is found and not computed with.  Functions
are stored in the numbering of their hierarchy, which does not depend on ranks.  The groups are

    mesh          what `ControlMesh` is made of
    hierarchies   0, 1, ..: boundary rule, cap level and the refined keys of each level
    spaces        0, 1, ..: the hierarchy (none for the faces of the mesh), the element, and the shape of values
    functions     0, 1, ..: the values, shape (num_functions or num_cells, block_size), with name and space
    attributes    JSON; arrays in it are the datasets in `arrays`
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from thccs_fem.fem.function import Function
from thccs_fem.fem.space import CellwiseSpace, FunctionSpace
from thccs_fem.hierarchy import Hierarchy
from thccs_fem.index_map import Fetch
from thccs_fem.mesh import ControlMesh
from thccs_fem.parallel import by_first_rank, rank_of, size_of, together

__all__ = ["Checkpoint", "read", "write"]

VERSION = 1
HEADER_SIZE = 512  # the least that HDF5 leaves to its user
SLAB = 1 << 17  # rows that are read at a time
ARRAY = "numpy array"  # in JSON: {ARRAY: number} stands for a dataset

type Arrays = dict[str, npt.NDArray[Any]]
type Space = FunctionSpace | CellwiseSpace


@dataclass(frozen=True)
class Checkpoint:
    """What `read` found.

    Attributes:
        mesh: The control mesh that all functions are on.
        functions: The functions by name. Those that were in one space are in one again.
        attributes: What was given to `write`.
    """

    mesh: ControlMesh
    functions: dict[str, Function]
    attributes: dict[str, Any]


class _ByName(dict[str, Function]):
    """Functions by name; one that is not there is an error that names those that are."""

    def __init__(self, path: Path):
        super().__init__()
        self._path = path

    def __missing__(self, name: str) -> Function:
        raise KeyError(f"there is no function {name!r} in {self._path}; it has {', '.join(map(repr, self))}")


def write(
    path: str | os.PathLike[str],
    functions: Function | Iterable[Function],
    attributes: Mapping[str, Any] | None = None,
) -> None:
    """Write functions, with their spaces and the control mesh, to a checkpoint. Collective.

    A file that is there already stays until the new one is complete. Ranks write together if h5py was built with MPI;
    else rank 0 writes, and gets one function after the other from the rest.

    Args:
        path: The file; its directory must exist. The same name with ".part" added is used on the way.
        functions: A function or several on one control mesh, THCCS or constant on cells, in any spaces, each with a
            name of its own, as ``fem.Function(V, name="u")`` or ``u.name = "u"`` give it.
        attributes: Time, number of the step and the like by name: None, bools, numbers, strings, NumPy arrays and
            scalars, and lists and dicts (with strings as keys) of these; tuples become lists. Those of rank 0 count.

    Raises:
        TypeError: Something is no function, or an attribute is of no type above.
        ValueError: There is no function, or two have the same name, or are on two control meshes.
        OSError: The file can't be written. An older one is still there, then.
    """
    path = Path(path)
    draft = path.with_name(f"{path.name}.part")
    listed = _listed(functions)
    mesh = listed[0].ufl_function_space().mesh
    try:
        by_first_rank(mesh.comm, lambda: _begin(draft, mesh, listed, attributes or {}))
        _write_values(draft, mesh.comm, listed)
        by_first_rank(mesh.comm, lambda: _finish(draft, path))
    except BaseException:
        if rank_of(mesh.comm) == 0:
            draft.unlink(missing_ok=True)
        raise


def read(path: str | os.PathLike[str], comm: Any = None, *, mesh: ControlMesh | None = None) -> Checkpoint:
    """Read a checkpoint, on any number of ranks. Collective.

    Each rank reads what it holds. Forms are integrated as usual on the spaces that come back: `with_integration` is to
    be called again.

    Args:
        path: The file.
        comm: MPI communicator of the mesh; None in serial, or where `mesh` is given.
        mesh: A control mesh equal to the one in the file: the functions shall be on it, so that forms, constants and
            functions that are there already go along with them. None: on a new one.

    Returns:
        Mesh, functions and attributes, as they were written.

    Raises:
        OSError: The file can't be opened.
        ValueError: It is no checkpoint, or one of another version, or cut off, or damaged; or the mesh in it is another
            one than the one given.
    """
    path = Path(path)
    comm = comm if mesh is None else mesh.comm
    by_first_rank(comm, lambda: _check(path))
    with together(comm, lambda: h5py.File(path, "r", locking=False)) as file:  # no one changes it: see `write`
        arrays, attributes = together(comm, lambda: (_arrays_of(file["mesh"]), _attributes_of(file)))
        if mesh is None:
            mesh = _mesh_of(arrays, comm)
        elif not _are_equal(_mesh_arrays(mesh), arrays):
            raise ValueError(
                f"{path} has another control mesh, with {len(arrays['vertices'])} vertices and "
                f"{len(arrays['face_tags'])} faces, than the one given, with {mesh.num_vertices} and {mesh.num_faces}: "
                f"all coordinates, faces, tags and sharpnesses must be equal. Leave `mesh` out to get that of the file"
            )
        spaces = _spaces_of(file, mesh)
        functions = _ByName(path)
        for values in _members(file["functions"]):
            u = Function(spaces[values.attrs["space"]], values.attrs["name"])
            u.x.array = together(comm, partial(_values_of, u, values))
            functions[u.name] = u
    return Checkpoint(mesh, functions, attributes)


# The file as a whole ------------------------------------------------------------------------------


def _header(draft: Path) -> bytes:
    """Return what the first bytes of a file must be, for all that comes after them."""
    with draft.open("rb") as file:
        file.seek(HEADER_SIZE)
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        size = file.tell() - HEADER_SIZE
    text = f"thccs-fem checkpoint, version {VERSION}\nsha256 of the {size} bytes from {HEADER_SIZE} on: {digest}\n"
    return text.encode().ljust(HEADER_SIZE, b"\n")


def _check(path: Path) -> None:
    """Raise unless a file is a whole checkpoint of this version."""
    with path.open("rb") as file:
        header = file.read(HEADER_SIZE)
        found = file.seek(0, os.SEEK_END)
    version = re.match(rb"thccs-fem checkpoint, version (\d+)\n(?:sha256 of the (\d+) bytes)?", header)
    if version is None:
        kind = "an HDF5 file, but not one that checkpoint.write has made" if h5py.is_hdf5(path) else "no HDF5 file"
        raise ValueError(f"{path} is no checkpoint: it is {kind}")
    if int(version[1]) != VERSION:
        raise ValueError(
            f"{path} is a checkpoint of version {int(version[1])}; expected {VERSION}: read it with the release of "
            f"thccs-fem that wrote it"
        )
    whole = HEADER_SIZE + int(version[2] or 0)
    if found < whole:
        raise ValueError(
            f"{path} is cut off: {found} of {whole} bytes are there. Copy it again, or go on from an older checkpoint"
        )
    if _header(path) != header:
        raise ValueError(
            f"{path} is damaged: what it holds was not written so. Copy it again, or go on from an older checkpoint"
        )


def _begin(draft: Path, mesh: ControlMesh, functions: list[Function], attributes: Mapping[str, Any]) -> None:
    """Write all but the values of the functions, for which there is room."""
    arrays: Arrays = {}
    text = json.dumps(_encoded(dict(attributes), "attributes", arrays))
    draft.unlink(missing_ok=True)  # what a run that was killed has left
    with h5py.File(draft, "w", userblock_size=HEADER_SIZE, locking=False) as file:
        file["attributes"] = text
        for group, members in (("arrays", arrays), ("mesh", _mesh_arrays(mesh))):
            for name, array in members.items():
                file[f"{group}/{name}"] = array
        spaces = _put_spaces(file, functions)
        for number, u in enumerate(functions):
            V = u.ufl_function_space()
            shape = (u.x.index_map.size_global, V.block_size)
            values = file.create_dataset(f"functions/{number}", shape, dtype=np.float64)
            values.attrs.update({"name": u.name, "space": spaces.index(V)})


def _write_values(draft: Path, comm: Any, functions: list[Function]) -> None:
    """Write the values of the functions; collective."""
    file = together(comm, lambda: _opened(draft, comm))
    try:
        for number, u in enumerate(functions):
            V = u.ufl_function_space()
            begin, end = _share(comm, u.x.index_map.size_global)
            values = Fetch(u.x.index_map, np.arange(begin, end))(u.x.array.reshape(-1, V.block_size))
            together(comm, partial(_put_rows, file, f"functions/{number}", begin, values))
    finally:
        together(comm, lambda: None if file is None else file.close())


def _all_write(comm: Any) -> bool:
    return size_of(comm) > 1 and bool(h5py.get_config().mpi)


def _opened(draft: Path, comm: Any) -> h5py.File | None:
    """Return the file, open on the ranks that write; None on the others."""
    if _all_write(comm):
        return h5py.File(draft, "r+", driver="mpio", comm=comm)
    return h5py.File(draft, "r+", locking=False) if rank_of(comm) == 0 else None


def _share(comm: Any, size: int) -> tuple[int, int]:
    """Return the first of the rows that this rank writes, and the one after the last."""
    if _all_write(comm):
        return size * rank_of(comm) // size_of(comm), size * (rank_of(comm) + 1) // size_of(comm)
    return 0, size if rank_of(comm) == 0 else 0


def _put_rows(file: h5py.File | None, name: str, begin: int, values: npt.NDArray[np.float64]) -> None:
    if file is not None:
        file[name][begin : begin + len(values)] = values


def _finish(draft: Path, path: Path) -> None:
    """Give a file that is complete its header and its name, once it is on the disk."""
    header = _header(draft)
    with draft.open("r+b") as file:
        file.write(header)
        file.flush()
        os.fsync(file.fileno())
    draft.replace(path)
    directory = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(directory)
    finally:
        os.close(directory)


# What is in it ------------------------------------------------------------------------------------


def _listed(functions: Any) -> list[Function]:
    """Return the functions as a list, checked."""
    several = isinstance(functions, Iterable) and not isinstance(functions, Function)  # vectors have components
    listed = list(functions) if several else [functions]
    others = [type(u).__name__ for u in listed if not isinstance(u, Function)]
    if others:
        raise TypeError(f"checkpoint.write needs functions, fem.Function, got {others[0]}")
    if not listed:
        raise ValueError("there are no functions to write; expected one or more")
    names = [u.name for u in listed]
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise ValueError(
            f"{names.count(twice[0])} functions have the name {twice[0]!r}, by which they are found again: give each "
            f'its own, fem.Function(V, name="u") or u.name = "u"'
        )
    if len({u.ufl_function_space().mesh for u in listed}) > 1:
        raise ValueError("the functions are on several control meshes: write a checkpoint for each mesh")
    return listed


def _members(group: h5py.Group) -> list[Any]:
    """Return the members 0, 1, .. of a group in order."""
    return [group[str(number)] for number in range(len(group))]


def _mesh_arrays(mesh: ControlMesh) -> Arrays:
    """Return what a control mesh is made of; mappings as keys and values, in the order of the keys."""
    arrays: Arrays = {name: getattr(mesh, name) for name in ("vertices", "face_offsets", "face_vertices", "face_tags")}
    for name, width, dtype in (("edge_tags", 2, np.int64), ("creases", 2, np.float64), ("corners", 1, np.float64)):
        items = sorted(getattr(mesh, name).items())
        arrays[f"{name}/keys"] = np.array([key for key, _ in items], dtype=np.int32).reshape(-1, width)
        arrays[f"{name}/values"] = np.array([value for _, value in items], dtype=dtype)
    return arrays


def _arrays_of(group: h5py.Group) -> Arrays:
    """Return the arrays in a group and the groups in it, by name."""
    arrays: Arrays = {}
    group.visititems(lambda name, item: arrays.update({name: item[()]}) if isinstance(item, h5py.Dataset) else None)
    return arrays


def _are_equal(one: Arrays, other: Arrays) -> bool:
    return one.keys() == other.keys() and all(np.array_equal(array, other[name]) for name, array in one.items())


def _mesh_of(arrays: Arrays, comm: Any) -> ControlMesh:
    """Return the control mesh made of its arrays."""
    offsets, corners = arrays["face_offsets"], arrays["face_vertices"]
    alike = (np.diff(offsets) == offsets[1]).all()
    faces = corners.reshape(-1, offsets[1]) if alike else np.split(corners, offsets[1:-1])
    by_edge = {
        name: dict(zip(map(tuple, arrays[f"{name}/keys"].tolist()), arrays[f"{name}/values"].tolist(), strict=True))
        for name in ("edge_tags", "creases")
    }
    by_vertex = dict(zip(arrays["corners/keys"].ravel().tolist(), arrays["corners/values"].tolist(), strict=True))
    return ControlMesh(arrays["vertices"], faces, arrays["face_tags"], **by_edge, corners=by_vertex, comm=comm)


def _put_spaces(file: h5py.File, functions: list[Function]) -> list[Space]:
    """Write the spaces of the functions, each once, and their hierarchies; return the spaces."""
    spaces = list(dict.fromkeys(u.ufl_function_space() for u in functions))
    hierarchies: list[Hierarchy] = []
    for number, V in enumerate(spaces):
        if V.hierarchy is not None and not any(map(V.hierarchy.same_as, hierarchies)):
            hierarchies.append(V.hierarchy)
        group = file.create_group(f"spaces/{number}")
        group.attrs["element"] = "THCCS" if isinstance(V, FunctionSpace) else "DG"
        group.attrs["value_shape"] = np.array(V.value_shape, dtype=np.int64)
        if V.hierarchy is not None:
            group.attrs["hierarchy"] = list(map(V.hierarchy.same_as, hierarchies)).index(True)
    for number, hierarchy in enumerate(hierarchies):
        group = file.create_group(f"hierarchies/{number}")
        group.attrs.update({"rule": hierarchy.rule, "cap_level": hierarchy.cap_level, "unit": hierarchy.unit})
        if hierarchy.admissibility is not None:
            group.attrs["admissibility"] = hierarchy.admissibility
        for level, keys in enumerate(hierarchy.refined_keys):
            group[str(level)] = keys
    return spaces


def _spaces_of(file: h5py.File, mesh: ControlMesh) -> list[Space]:
    """Return the spaces of a file, on a control mesh equal to that in it."""
    hierarchies = []
    for group in _members(file["hierarchies"]) if "hierarchies" in file else []:
        keys = [level[()] for level in _members(group)]
        admissibility = group.attrs.get("admissibility")  # older files have neither this nor a unit
        hierarchies.append(
            Hierarchy.on(
                mesh,
                group.attrs["rule"],
                cap_level=int(group.attrs["cap_level"]),
                admissibility=None if admissibility is None else int(admissibility),
                unit=group.attrs.get("unit", "support"),
                refined_keys=keys,
            )
        )
    spaces: list[Space] = []
    for group in _members(file["spaces"]):
        shape = tuple(group.attrs["value_shape"].tolist())
        hierarchy = hierarchies[group.attrs["hierarchy"]] if "hierarchy" in group.attrs else None
        if hierarchy is None or group.attrs["element"] == "DG":
            spaces.append(CellwiseSpace(mesh, hierarchy, shape))
        else:
            spaces.append(FunctionSpace(hierarchy, shape))
    return spaces


def _values_of(u: Function, values: h5py.Dataset) -> npt.NDArray[np.float64]:
    """Return the coefficients of a function that this rank holds, shape (num_local_dofs,)."""
    V = u.ufl_function_space()
    if values.shape != (u.x.index_map.size_global, V.block_size):
        raise ValueError(
            f"{values.file.filename}: the function {u.name!r} has values of shape {values.shape}, its space asks for "
            f"{(u.x.index_map.size_global, V.block_size)}: read it with the release of thccs-fem that wrote it"
        )
    numbers = u.x.index_map.numbers
    rows = np.zeros((numbers.size, V.block_size))
    for begin in range(0, values.shape[0], SLAB):
        mine = np.flatnonzero((numbers >= begin) & (numbers < begin + SLAB))
        if mine.size:
            rows[mine] = values[begin : begin + SLAB][numbers[mine] - begin]
    return rows.ravel()


def _encoded(value: Any, where: str, arrays: Arrays) -> Any:
    """Return an attribute as JSON knows it; arrays, and scalars of NumPy, are added to `arrays`."""
    if isinstance(value, np.ndarray | np.generic) and value.dtype.kind in "biufc":
        arrays[str(len(arrays))] = np.asarray(value)
        return {ARRAY: len(arrays) - 1}
    if isinstance(value, Mapping):
        wrong = [key for key in value if not isinstance(key, str) or key == ARRAY]
        if wrong:
            raise TypeError(f"{where} has the key {wrong[0]!r}; expected strings (other than {ARRAY!r}) as keys")
        return {key: _encoded(member, f"{where}[{key!r}]", arrays) for key, member in value.items()}
    if isinstance(value, list | tuple):
        return [_encoded(member, f"{where}[{k}]", arrays) for k, member in enumerate(value)]
    if value is None or isinstance(value, bool | int | float | str):
        return value
    kind = f"an array of type {value.dtype}" if isinstance(value, np.ndarray) else f"of type {type(value).__name__}"
    raise TypeError(
        f"{where} is {kind}; a checkpoint keeps None, bools, numbers, strings, arrays of numbers, and lists and dicts "
        f"of these"
    )


def _attributes_of(file: h5py.File) -> dict[str, Any]:
    """Return the attributes, with their arrays."""

    def decoded(found: dict[str, Any]) -> Any:
        return file[f"arrays/{found[ARRAY]}"][()] if ARRAY in found else found

    attributes: dict[str, Any] = json.loads(file["attributes"][()], object_hook=decoded)
    return attributes
