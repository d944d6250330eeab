"""Every demo runs, small, and ends in the check of its own figures."""

import ast
import re
import runpy
from pathlib import Path

import pytest

DEMOS = sorted((Path(__file__).parents[1] / "demos").rglob("*.py"))
each_demo = pytest.mark.parametrize("demo", DEMOS, ids=lambda demo: demo.stem)


def test_there_are_demos() -> None:
    assert DEMOS


@each_demo
def test_demo_ends_in_a_check_that_can_fail(demo: Path) -> None:
    source = demo.read_text()
    headings = list(re.finditer(r"^# #+ (.*)$", source, re.MULTILINE))
    assert headings[-1][0] == "# ## Check"
    check = ast.parse(source[headings[-1].start() :])
    assert any(isinstance(node, ast.Assert) for node in ast.walk(check))


@each_demo
def test_demo_runs(demo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # demos write to out/ where they are started
    monkeypatch.setenv("STEPS", "3")
    monkeypatch.setattr("sys.argv", [str(demo)])
    runpy.run_path(str(demo), run_name="__main__")
