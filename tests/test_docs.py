"""What the documentation says is so: its Python runs, and what it names is there."""

import re
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
PAGES = sorted(ROOT.glob("docs/*.md"))


def test_code_for_users_of_dolfinx_runs() -> None:
    for package in ("mpi4py.MPI", "petsc4py", "dolfinx"):
        pytest.importorskip(package)
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "docs/dolfinx_users.md").read_text(), re.DOTALL)
    assert len(blocks) == 3
    names: dict[str, object] = {}
    for block in blocks:
        exec(block, names)
    uh, flux = names["uh"], names["flux"]
    assert uh.function_space == names["V"]  # type: ignore[attr-defined]  # what the code has made
    assert abs(flux.x.array).max() > 0.1  # type: ignore[attr-defined]  # as above


def test_code_of_adaptive_loops_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    section = (ROOT / "docs/adaptivity.md").read_text().split("\n## ")[1]
    names: dict[str, Any] = {}
    for block in re.findall(r"```python\n(.*?)```", section, re.DOTALL):
        exec(block, names)
    assert "within the tolerance" in names["history"].reason
    adaptive, uniform = names["films"].values()
    assert adaptive["H1 error"][-1] < uniform["H1 error"][-1]
    assert adaptive.rate("H1 error") > 1.3  # 1.5 is that of cubic splines
    assert (tmp_path / "film.png").stat().st_size > 10_000


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_files_that_a_page_names_are_there(page: Path) -> None:
    names = re.findall(r"`((?:demos|docs|forms|tests)/[\w/.]+\.(?:py|md|png))`", page.read_text())
    assert [name for name in names if not (ROOT / name).exists()] == []


def test_readme_lists_every_demo() -> None:
    readme = (ROOT / "README.md").read_text()
    assert [path.name for path in (ROOT / "demos").glob("*.py") if f"`{path.name}`" not in readme] == []


def test_every_form_is_listed_with_its_demo_and_test() -> None:
    page = (ROOT / "docs/forms.md").read_text()
    forms = [path.name for path in (ROOT / "forms").glob("*.py") if path.name != "__init__.py"]
    assert [name for name in forms if f"`forms/{name}`" not in page] == []
