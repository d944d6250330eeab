"""The names that others call, with the parameters that they may rely on."""

import importlib
import inspect
import pkgutil
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import thccs_fem

# What is promised of a parameter: its place, unless it comes after a star; its name, unless it
# comes before a slash; its default, unless that is ANY. More parameters may follow, all with
# defaults.
ANY = inspect.Parameter.empty
SIGNATURES = {
    "parallel.all_arrive": "comm",
    "parallel.size_of": "comm",
    "parallel.rank_of": "comm",
    "parallel.total": "comm, value",
    "parallel.largest": "comm, value",
    "parallel.smallest": "comm, value",
    "parallel.gathered": "comm, array",
    "parallel.together": "comm, work",
    "parallel.by_first_rank": "comm, work",
    "parallel.end_together": "comm",
    "mesh.ControlMesh": ("vertices, faces, face_tags=None, edge_tags=None, creases=None, corners=None, comm=None"),
    "mesh.ControlMesh.ufl_domain": "self",
    "mesh.end_faces": "msh, /, share=ANY",
    "mesh.orient": "vertices, faces",
    "generators.torus": "shape, /, R=2, r=1",
    "generators.cube_sphere": "n",
    "generators.cylinder": "shape, R=1.0, length=1.0, angle=ANY, *, rim=1.0",
    "generators.spherical_zone": "shape, R=1.0, polar=ANY, *, rim=1.0",
    "generators.hemisphere": "n, R=1.0",
    "generators.trapezohedron": "valence, n",
    "generators.interpolated": "msh, /",
    "generators.fitted": "msh, closest, /",
    "generators.genus3": "",
    "generators.implicit_surface": "f, shape, lower=ANY, upper=ANY, *, smoothing=0",
    "generators.rectangle": "shape, /",
    "generators.disc": "n",
    "generators.wheel": "valence, n",
    "generators.l_domain": "n=4",
    "generators.l_domain1": "",
    "generators.l_domain2": "",
    "limit.evaluate": "msh, /, faces, uv, derivatives=ANY, corner=None",
    "stam.evaluate": "valence, uv, derivatives=0",
    "quadrature.paper_cells": "hierarchy",
    "quadrature.without_caps": "depth",
    "fem.functionspace": "msh, element, /, boundary=ANY, *, admissibility=None, unit='support'",
    "fem.FunctionSpace.sub": "self, component, /",
    "fem.FunctionSpace.ufl_domain": "self",
    "fem.FunctionSpace.with_integration": "self, rule",
    "fem.Constant": "msh, value, /",
    "fem.Function": "V, name=ANY",
    "fem.Function.eval": "self, faces, uv, corner=None",
    "fem.Expression": "expression, points",
    "fem.cellwise": "V, value_shape=()",
    "fem.cell_sizes": "V",
    "fem.point_values": "V, faces, uv, corner=None",
    "fem.project": "expression, V, /",
    "fem.locate_dofs_geometrical": "V, marker",
    "fem.boundary_dofs": "V, marker=None, *, tag=ANY, slope=ANY",
    "fem.region_dofs": "V, faces=ANY, *, tag=ANY",
    "fem.dirichletbc": "value, dofs, V, *, slope=ANY",
    "fem.form": "ufl_form, /",
    "fem.assemble_scalar": "form, /",
    "fem.assemble_vector": "form, /",
    "fem.assemble_matrix": "form, /",
    "fem.scipy.LinearProblem": "a, L, *, bcs=(), petsc_options_prefix=ANY, petsc_options=None",
    "fem.scipy.LinearProblem.solve": "self",
    "fem.scipy.LinearProblem.start_from_u": "self",
    "fem.scipy.NonlinearProblem": "F, u, *, bcs=(), J=None, petsc_options_prefix=ANY, petsc_options=None",
    "fem.scipy.NonlinearProblem.solve": "self",
    "fem.scipy.EigenProblem": (
        "a, m=None, *, bcs=(), num_eigenvalues=6, target=0.0, petsc_options_prefix=ANY, petsc_options=None"
    ),
    "fem.scipy.EigenProblem.solve": "self",
    "fem.petsc.LinearProblem": "a, L, *, bcs=(), petsc_options_prefix=ANY, petsc_options=None",
    "fem.petsc.LinearProblem.solve": "self",
    "fem.petsc.LinearProblem.start_from_u": "self",
    "fem.petsc.NonlinearProblem": "F, u, *, bcs=(), J=None, petsc_options_prefix=ANY, petsc_options=None",
    "fem.petsc.NonlinearProblem.solve": "self",
    "fem.petsc.EigenProblem": (
        "a, m=None, *, bcs=(), num_eigenvalues=6, target=0.0, petsc_options_prefix=ANY, petsc_options=None"
    ),
    "fem.petsc.EigenProblem.solve": "self",
    "fem.petsc.TimeProblem": "F, u, udot, *, dt, scheme=ANY, bcs=(), petsc_options_prefix, petsc_options=None",
    "fem.petsc.TimeProblem.step": "self",
    "fem.petsc.TimeProblem.steps": "self, until",
    "fem.petsc.TimeProblem.solve": "self, until",
    "fem.petsc.TimeProblem.with_space": "self, V, transfer, *, bcs=None",
    "fem.petsc.assemble_vector": "form, /",
    "fem.petsc.apply_lifting": "b, a, bcs, /",
    "fem.petsc.set_bc": "b, bcs, /",
    "fem.petsc.multigrid": "ksp, V",
    "estimate.error": "uh, u_exact, norm='L2'",
    "estimate.residual": "uh, strong_residual, neumann=None, flux=None, *, order=2, moment=None, moments=None, "
    "stiffness=1.0, reaction=0.0",
    "estimate.bubble": "uh, a, L=None",
    "estimate.goal": "uh, F, J, *, fixed=None, problem=ANY",
    "estimate.norm": "V, eta",
    "adapt.mark": "V, eta, strategy='dorfler', theta=0.5",
    "adapt.solve": "V, problem, estimator, *, stop, marking=ANY, callback=None, progress=None, checkpoint=None",
    "adapt.Marking": "strategy='dorfler', theta=0.5",
    "adapt.MarkingAhead": "order=3.0, reduction=0.3, theta=0.8",
    "adapt.predict": "V, eta, before=None, *, order=3.0",
    "adapt.Prediction.refined": "self, reduction=0.3, theta=0.8",
    "adapt.Stop": "tolerance=0.0, dofs=None, levels=None, seconds=None, steps=None",
    "adapt.History.rate": "self, column='estimate', last=5",
    "adapt.refine": "V, marked",
    "adapt.coarsen": "V, cells",
    "adapt.grade_extraordinary": "V, levels, *, subdivided=0",
    "adapt.mark_coarsening": "V, eta, theta=0.05",
    "adapt.remesh": "V, marked, cells",
    "adapt.transfer": "u, V, projection='L2', *, conserve=False",
    "checkpoint.write": "path, functions, attributes=None",
    "checkpoint.read": "path, comm=None, *, mesh=None",
    "io.read_mesh": "filename, /, comm=None",
    "io.write_vtu": "filename, uh, /",
    "plot.convergence": "histories, filename, *, columns='estimate', slopes=ANY, title=''",
    "plot.plot": "uh, filename=None",
    "dolfinx.mesh": "V",
    "dolfinx.functionspace": "V",
    "dolfinx.function": "uh",
    "dolfinx.extraction_matrix": "V",
    "forms.laplace_beltrami.a": "u, v, kappa=1",
    "forms.laplace_beltrami.L": "f, v, g=None, ds=ANY",
    "forms.laplace_beltrami.strong_residual": "u, f, kappa=1",
    "forms.laplace_beltrami.nitsche": "u, v, g, h, kappa=1, gamma=ANY, ds=ANY",
    "forms.heat.F": "u, udot, v, f=0, g=None, kappa=1, ds=ANY",
    "forms.heat.strong_residual": "u, udot, f=0, kappa=1",
    "forms.reaction_diffusion.F": "u, udot, v, reaction, diffusivities",
    "forms.reaction_diffusion.strong_residual": "u, udot, reaction, diffusivities",
    "forms.reaction_diffusion.schnakenberg": "u, a=0.1, b=0.9, gamma=1",
    "forms.reaction_diffusion.gray_scott": "u, feed=0.04, kill=0.06",
    "forms.allen_cahn.energy": "u, epsilon",
    "forms.allen_cahn.F": "u, udot, v, epsilon",
    "forms.allen_cahn.strong_residual": "u, udot, epsilon",
    "forms.cahn_hilliard.energy": "u, epsilon",
    "forms.cahn_hilliard.chemical_potential": "u, epsilon",
    "forms.cahn_hilliard.F": "u, udot, v, epsilon, M=1",
    "forms.cahn_hilliard.contact": "u, v, epsilon, h, M=1, gamma=ANY, ds=ANY",
    "forms.poisson.a": "u, v, kappa=1, c=0",
    "forms.poisson.L": "f, v, g=None, ds=ANY",
    "forms.poisson.strong_residual": "u, f, kappa=1, c=0",
    "forms.poisson.nitsche": "u, v, g, h, kappa=1, gamma=ANY, ds=ANY",
    "forms.helmholtz.a": "u, v, k, z=None, ds=ANY",
    "forms.helmholtz.L": "f, v, g=None, ds=ANY",
    "forms.helmholtz.strong_residual": "u, f, k",
    "forms.linear_elasticity.plane_strain": "E, nu",
    "forms.linear_elasticity.plane_stress": "E, nu",
    "forms.linear_elasticity.epsilon": "u",
    "forms.linear_elasticity.sigma": "u, lmbda=1, mu=1",
    "forms.linear_elasticity.a": "u, v, lmbda=1, mu=1",
    "forms.linear_elasticity.L": "f, v, t=None, ds=ANY",
    "forms.linear_elasticity.strong_residual": "u, f, lmbda=1, mu=1",
    "forms.minimal_surface.area": "u",
    "forms.minimal_surface.F": "u, v, f=0",
    "forms.minimal_surface.strong_residual": "u, f=0",
    "forms.biharmonic.a": "u, v, kappa=1",
    "forms.biharmonic.L": "f, v",
    "forms.biharmonic.strong_residual": "u, f, kappa=1",
    "forms.plate.hessian": "u",
    "forms.plate.moments": "u, D=1, nu=0.3",
    "forms.plate.a": "u, v, D=1, nu=0.3",
    "forms.plate.L": "f, v",
    "forms.plate.clamped": "u, v, g, h, D=1, nu=0.3, gamma=ANY, ds=ANY",
    "forms.plate.supported": "u, v, g, h, D=1, nu=0.3, gamma=ANY, ds=ANY",
    "forms.plate.strong_residual": "u, f, D=1, nu=0.3",
    "forms.eigenmodes.a": "u, v, kappa=1",
    "forms.eigenmodes.m": "u, v, rho=1",
    "forms.eigenmodes.strong_residual": "u, eigenvalue, kappa=1, rho=1",
    "forms.kirchhoff_love.membrane_strain": "u",
    "forms.kirchhoff_love.curvature_change": "u",
    "forms.kirchhoff_love.membrane_force": "u, E, nu, t",
    "forms.kirchhoff_love.bending_moment": "u, E, nu, t",
    "forms.kirchhoff_love.a": "u, v, E, nu, t",
    "forms.kirchhoff_love.L": "f, v",
}
PACKAGES = pkgutil.walk_packages(thccs_fem.__path__, "thccs_fem.")
MODULES = [found.name.removeprefix("thccs_fem.") for found in PACKAGES]
NAMED = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
VARIADIC = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)


def module(name: str) -> ModuleType:
    """Import a module of the package; skip where it needs PETSc or DOLFINx and there is none."""
    if name.startswith("fem.petsc"):
        pytest.importorskip("petsc4py")
    if name == "dolfinx":
        pytest.importorskip("dolfinx")
    return importlib.import_module(f"thccs_fem.{name}")


def public(name: str) -> Callable[..., Any]:
    """Return the function, class or method of a dotted name."""
    parts = name.split(".")
    depth = 2 if parts[0] == "forms" or parts[1] in {"petsc", "scipy"} else 1
    found: Any = module(".".join(parts[:depth]))
    for part in parts[depth:]:
        found = getattr(found, part)
    return found


@pytest.mark.parametrize(("name", "documented"), SIGNATURES.items(), ids=SIGNATURES)
def test_signature_is_the_documented_one(name: str, documented: str) -> None:
    actual = inspect.signature(public(name)).parameters
    promised = inspect.signature(eval(f"lambda {documented}: None", {"ANY": ANY})).parameters
    in_place = list(actual.values())
    kept = set()
    for place, want in enumerate(promised.values()):
        if want.kind is inspect.Parameter.KEYWORD_ONLY:
            assert want.name in actual
            have = actual[want.name]
        else:
            have = in_place[place]
            assert have.kind is not inspect.Parameter.KEYWORD_ONLY
        if want.kind is not inspect.Parameter.POSITIONAL_ONLY:
            assert have.name == want.name
            assert have.kind in NAMED
        if want.default is not ANY:
            assert have.default == want.default
        kept.add(have.name)
    more = [p for p in in_place if p.name not in kept and p.kind not in VARIADIC]
    assert [p.name for p in more if p.default is inspect.Parameter.empty] == []


@pytest.mark.parametrize("name", MODULES)
def test_what_a_module_calls_public_is_there_once(name: str) -> None:
    names = getattr(module(name), "__all__", [])
    assert isinstance(names, list)  # in the order that ruff checks
    assert len(set(names)) == len(names)
    assert [n for n in names if not hasattr(module(name), n)] == []


def test_fem_says_what_is_public() -> None:
    of_fem = {name.split(".")[1] for name in SIGNATURES if name.startswith("fem.")}
    assert of_fem - {"petsc", "scipy"} <= set(module("fem").__all__)


def test_attributes_of_a_mesh() -> None:
    msh = module("generators").rectangle((2, 2))
    assert (msh.num_vertices, msh.num_faces, msh.euler_characteristic) == (9, 4, 1)
    assert msh.extraordinary_vertices == {}
    assert msh.comm is None
    assert msh.ufl_domain() is msh.ufl_domain()


def test_attributes_of_a_space_and_a_function() -> None:
    fem = module("fem")
    msh = module("generators").rectangle((2, 2))
    V = fem.functionspace(msh, ("THCCS", 3), boundary="crease")
    assert (V.num_dofs, V.num_cells, V.num_levels) == (9, 4, 1)
    assert V.ufl_domain() is msh.ufl_domain()
    assert V.hierarchy is not None
    clamped = fem.functionspace(msh, ("THCCS", 3), boundary="clamped")
    # Spaces of one mesh share UFL's domain and element: only their own comparison tells them apart.
    assert V == V
    assert hash(V) == hash(V)
    assert V != clamped
    uh = fem.Function(V, name="u")
    assert uh.x.array.shape == (9,)
    assert uh.x.array.dtype == np.float64
    assert fem.functionspace(msh, ("THCCS", 3, (3,))).num_dofs % 3 == 0
