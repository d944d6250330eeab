"""Demos run on several ranks as they are, and find the same numbers."""

import runpy
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mpi4py import MPI

import pytest
from compared import assert_same

from thccs_fem import adapt

DEMOS = Path(__file__).parents[2] / "demos"


def columns_of(history: adapt.History, *names: str) -> list[Any]:
    return [history[name] for name in names]


# Steps, and what is to be the same.
FIGURES: dict[str, tuple[int, Callable[[dict[str, Any]], list[Any]]]] = {
    "laplace_on_surface": (1, lambda of: columns_of(of["history"], "dofs", "estimate", "energy")),
    "poisson_l_domain": (
        3,
        lambda of: [columns_of(of[run], "dofs", "estimate", "energy") for run in ("history", "uniform")],
    ),
    "minimal_surface": (3, lambda of: [of["errors"], of["film_area"], of["harmonic_area"], of["disc_area"]]),
    "scordelis_lo_roof": (2, lambda of: of["deflections"]),
    "cahn_hilliard": (3, lambda of: [of["times"], of["dofs"], of["masses"], of["lost"]]),
}


@pytest.mark.skipif(MPI.COMM_WORLD.size > 2, reason="half a minute, and other tests have all that demos do on 3 ranks")
@pytest.mark.parametrize("demo", FIGURES)
def test_demo_finds_what_it_finds_in_serial(
    demo: str, comm: MPI.Comm, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps, figures = FIGURES[demo]

    def run(where: Path) -> list[Any]:
        with monkeypatch.context() as patch:
            patch.chdir(where)
            patch.setenv("STEPS", str(steps))
            patch.setattr(sys, "argv", [demo])
            patch.setattr(sys, "stdout", sys.stdout)  # demos close it on ranks other than the first
            return figures(runpy.run_path(str(DEMOS / f"{demo}.py"), run_name="__main__"))

    found = run(folder)
    comm.barrier()  # rank 0 draws last
    pictures = sorted((folder / "out").glob("*.png"))
    assert pictures
    expected = None
    if comm.rank == 0:
        monkeypatch.setattr(MPI, "COMM_WORLD", MPI.COMM_SELF)
        expected = run(tmp_path)
        assert sorted((tmp_path / "out").glob("*.png")) == pictures
    assert_same(found, comm.bcast(expected), tol=1e-10)
