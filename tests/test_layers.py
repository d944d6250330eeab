"""Data flows one way: modules in order, each imports earlier ones alone."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LAYERS = """
    thccs_fem thccs_fem.absent thccs_fem.parallel thccs_fem.index_map thccs_fem.jit thccs_fem.sparse thccs_fem.element
    thccs_fem.polygons thccs_fem.validation thccs_fem.mesh thccs_fem.positions
    thccs_fem.subdivision thccs_fem.boundary thccs_fem.joined thccs_fem.coarsening thccs_fem.bezier thccs_fem.limit
    thccs_fem.generators
    thccs_fem.stam thccs_fem.regions thccs_fem.hierarchy thccs_fem.partition thccs_fem.prolongation
    thccs_fem.extraction thccs_fem.facets thccs_fem.quadrature thccs_fem.folds
    thccs_fem.fem.space thccs_fem.fem.function thccs_fem.fem.expression thccs_fem.fem.checks thccs_fem.fem.forms
    thccs_fem.fem.sparsity thccs_fem.fem.loops thccs_fem.fem.mass
    thccs_fem.fem.points thccs_fem.fem.entries thccs_fem.fem.assembly thccs_fem.fem.fitting thccs_fem.fem.bcs
    thccs_fem.fem.layout thccs_fem.fem.blocks
    thccs_fem.fem.linear thccs_fem.fem.nonlinear thccs_fem.fem.eigen
    thccs_fem.fem.scipy.linear thccs_fem.fem.scipy.nonlinear thccs_fem.fem.scipy.eigen thccs_fem.fem.scipy
    thccs_fem.fem.project thccs_fem.fem
    thccs_fem.fem.levels thccs_fem.fem.petsc.matrices thccs_fem.fem.petsc.gauss_seidel thccs_fem.fem.petsc.multigrid
    thccs_fem.fem.petsc.options
    thccs_fem.fem.petsc.linear thccs_fem.fem.petsc.nonlinear thccs_fem.fem.petsc.eigen
    thccs_fem.fem.petsc.evolution thccs_fem.fem.petsc.timestepping thccs_fem.fem.petsc
    thccs_fem.estimate.indicators thccs_fem.estimate.error thccs_fem.estimate.residual thccs_fem.estimate.bubble
    thccs_fem.estimate.goal
    thccs_fem.estimate thccs_fem.checkpoint
    thccs_fem.adapt.marking thccs_fem.adapt.prediction thccs_fem.adapt.remeshing thccs_fem.adapt.grading
    thccs_fem.adapt.transfer thccs_fem.adapt.history thccs_fem.adapt.resuming thccs_fem.adapt.returned
    thccs_fem.adapt.loop thccs_fem.adapt
    thccs_fem.vtk thccs_fem.io thccs_fem.plot.paths thccs_fem.plot.surfaces thccs_fem.plot.pictures
    thccs_fem.plot.curves thccs_fem.plot
    thccs_fem.dolfinx
""".split()
PATHS = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for path in (ROOT / "thccs_fem").rglob("*.py")
    if ROOT / "thccs_fem/forms" not in path.parents
}


def imports(path: Path) -> Iterator[str]:
    """Yield every name that a file imports, under TYPE_CHECKING and inside functions too."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{'.' * node.level}{node.module}.{alias.name}" for alias in node.names)


def module_of(name: str) -> str:
    """Return the module of the package that an imported name is or is in."""
    while name not in LAYERS:
        name = name.rpartition(".")[0]
    return name


def test_every_module_has_its_layer() -> None:
    assert sorted(PATHS) == sorted(LAYERS)


@pytest.mark.parametrize("module", sorted(PATHS))
def test_only_earlier_layers_are_imported(module: str) -> None:
    earlier = LAYERS[: LAYERS.index(module)]
    names = [name for name in imports(PATHS[module]) if name.startswith(("thccs_fem", "."))]
    assert [name for name in names if name[0] == "." or module_of(name) not in earlier] == []


@pytest.mark.parametrize("module", sorted(PATHS))
def test_petsc_mpi_and_dolfinx_stay_where_they_belong(module: str) -> None:
    allowed = set()
    if module.startswith("thccs_fem.fem.petsc"):
        allowed = {"mpi4py", "petsc4py", "slepc4py"}
    elif module == "thccs_fem.dolfinx":
        allowed = {"dolfinx", "mpi4py", "petsc4py"}
    roots = {name.partition(".")[0] for name in imports(PATHS[module])}
    assert roots & {"dolfinx", "mpi4py", "petsc4py", "slepc4py"} <= allowed


def test_forms_need_ufl_alone() -> None:
    paths = sorted((ROOT / "forms").glob("*.py"))
    assert {name.partition(".")[0] for path in paths for name in imports(path)} == {"ufl"}
