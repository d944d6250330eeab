"""Curves of adaptive runs: what is drawn, and what is refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista

from thccs_fem import adapt, plot


def falling(rate: float, num: int = 6, sign: float = 1.0) -> adapt.History:
    dofs = 50 * 2 ** np.arange(num)
    return adapt.History(
        tuple(
            adapt.Step(i, 1, 1, n, sign * 3.0 * n**-rate, 0.1, values={"error": 0.5 * n**-rate if i else 0.0})
            for i, n in enumerate(dofs.tolist())
        )
    )


def drawn(figure: Any) -> dict[str, np.ndarray]:
    """Return the points of all curves by their labels."""
    return {line.get_label(): line.get_xydata() for line in figure.axes[0].lines if line.get_label()[0] != "_"}


def references(figure: Any) -> list[np.ndarray]:
    return [line.get_xydata() for line in figure.axes[0].lines if line.get_label()[0] == "_"]


@pytest.fixture
def unwritten(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let no file be written, which takes longer than all else."""
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", lambda *_, **options: None)


def test_columns_of_runs_are_drawn(tmp_path: Path) -> None:
    """On logarithmic scales, with nothing where there is none, and a colour for each run."""
    runs = {
        "adaptive": falling(1.5, sign=-1.0),
        "uniform": falling(0.5, 3),
        "other": {"dofs": [10, 20], "error": [2, 1]},
    }
    figure = plot.convergence(runs, tmp_path / "a.png", columns=("estimate", "error"), title="Rates")
    curves = drawn(figure)
    assert list(curves) == [
        "adaptive, estimate",
        "adaptive, error",
        "uniform, estimate",
        "uniform, error",
        "other, error",
    ]
    dofs = runs["adaptive"]["dofs"]
    np.testing.assert_allclose(curves["adaptive, estimate"], np.stack([dofs, 3.0 * dofs**-1.5], axis=1))
    np.testing.assert_allclose(curves["adaptive, error"], np.stack([dofs, 0.5 * dofs**-1.5], axis=1)[1:])  # 0 before
    np.testing.assert_array_equal(curves["other, error"], [[10, 2], [20, 1]])
    (axes,) = figure.axes
    assert (axes.get_xscale(), axes.get_yscale(), axes.get_title()) == ("log", "log", "Rates")
    colours = [line.get_color() for line in axes.lines[:5]]
    assert colours == ["C0", "C0", "C1", "C1", "C2"]
    assert len({line.get_linestyle() for line in axes.lines[:2]}) == 2
    height, width, _ = pyvista.read_texture(tmp_path / "a.png").to_array().shape
    assert (height, width) == (750, 1050)


def test_the_name_tells_the_type(tmp_path: Path) -> None:
    plot.convergence(falling(1.5), tmp_path / "a.pdf")
    assert (tmp_path / "a.pdf").read_bytes()[:4] == b"%PDF"


@pytest.mark.usefixtures("unwritten")
def test_one_curve_needs_no_legend(tmp_path: Path) -> None:
    figure = plot.convergence(falling(1.5), tmp_path / "a.png")
    (axes,) = figure.axes
    assert axes.get_legend() is None
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("dofs", "estimate")
    labels = drawn(plot.convergence({"a": falling(1.5), "b": falling(2.0)}, tmp_path / "b.svg"))
    assert list(labels) == ["a", "b"]
    assert list(drawn(plot.convergence(falling(1.5), tmp_path / "c.png", columns=["estimate", "error"]))) == [
        "estimate",
        "error",
    ]


@pytest.mark.usefixtures("unwritten")
@pytest.mark.parametrize(
    ("slopes", "letters"), [((1.5, 2.0), ["$N^{-3/2}$", "$N^{-2}$"]), ((0.63,), ["$N^{-0.63}$"]), ((), [])]
)
def test_slopes_are_below_the_curves(slopes: tuple[float, ...], letters: list[str], tmp_path: Path) -> None:
    runs = {"adaptive": falling(1.7), "uniform": falling(0.5)}
    figure = plot.convergence(runs, tmp_path / "a.png", slopes=slopes)
    lines = references(figure)
    assert [text.get_text() for text in figure.axes[0].texts] == letters
    for line, slope in zip(lines, slopes, strict=True):
        (x0, y0), (x1, y1) = line
        assert -np.log(y1 / y0) / np.log(x1 / x0) == pytest.approx(slope)
        for curve in drawn(figure).values():
            below = y0 * (curve[:, 0] / x0) ** -slope
            assert (below < curve[:, 1])[curve[:, 0] >= x0].all()


@pytest.mark.usefixtures("unwritten")
def test_a_single_step_is_drawn(tmp_path: Path) -> None:
    figure = plot.convergence(falling(1.5, 1), tmp_path / "a.png")
    assert [len(line.get_xydata()) for line in figure.axes[0].lines] == [1]  # and no slopes


@pytest.mark.parametrize("ending", ["png", "pdf", "svg"])
def test_the_same_curves_are_the_same_file(ending: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On any day, and whatever identifiers Matplotlib makes up."""
    files = [tmp_path / f"{day}.{ending}" for day in (1, 2)]
    for day, file in enumerate(files):
        monkeypatch.setenv("SOURCE_DATE_EPOCH", str(86_400 * day))  # the date that Matplotlib takes
        plot.convergence(falling(1.5), file)
    assert files[0].read_bytes() == files[1].read_bytes()


@pytest.mark.usefixtures("unwritten")
def test_one_slope_may_be_a_number(tmp_path: Path) -> None:
    one, several, none = (plot.convergence(falling(1.5), tmp_path / "a.png", slopes=s) for s in (1.5, [1.5], ()))
    np.testing.assert_array_equal(references(one)[-1], references(several)[-1])
    assert len(references(one)) == len(references(several)) == len(references(none)) + 1


@pytest.mark.parametrize(
    ("runs", "options", "error", "message"),
    [
        ([falling(1.5)], {}, TypeError, 'the run, of type list, has no column "dofs": give a history, or several by n'),
        ({"a": [1.0]}, {}, TypeError, "the run 'a', of type list, has no column \"dofs\""),
        ({"a": {"estimate": [1.0]}}, {}, TypeError, "the run 'a', of type dict, has no column \"dofs\""),
        (
            {"dofs": [1, 2, 3], "estimate": [2, 1]},
            {},
            ValueError,
            r"the column 'estimate' has shape \(2,\), that of the dofs \(3,\)",
        ),
        (falling(1.5), {"columns": []}, ValueError, "there are no columns to draw: give a name or several"),
    ],
)
def test_what_is_no_table_is_refused(
    runs: Any, options: dict[str, Any], error: type[Exception], message: str, tmp_path: Path
) -> None:
    with pytest.raises(error, match=message):
        plot.convergence(runs, tmp_path / "a.png", **options)


def test_curves_that_can_not_be_drawn(tmp_path: Path) -> None:
    with pytest.raises(KeyError, match="no run has a column 'eror' with values to draw"):
        plot.convergence(falling(1.5), tmp_path / "a.png", columns=("error", "eror"))
    with pytest.raises(KeyError, match="no run has a column 'estimate'"):
        plot.convergence(adapt.History(), tmp_path / "a.png")
    with pytest.raises(ValueError, match="there are no runs to draw: give a history, or several by name"):
        plot.convergence({}, tmp_path / "a.png")
    with pytest.raises(ValueError, match=r"to be called '.*a.txt', but the name must end in .*\.pdf, .*\.png"):
        plot.convergence(falling(1.5), tmp_path / "a.txt")
    with pytest.raises(FileNotFoundError, match="there is no directory"):
        plot.convergence(falling(1.5), tmp_path / "none" / "a.png")
