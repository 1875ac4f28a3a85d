"""The reference study end to end on its smallest figures, and its report."""

import base64
import csv
import dataclasses
import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

import vmri_jax as vm
from benchmarks.__main__ import app
from benchmarks.gail2014 import reference
from benchmarks.gail2014 import report as report_module
from benchmarks.gail2014.cost import CostRow, CostStudy
from benchmarks.gail2014.figures import Check, ConvergenceFigure, CostFigure, CostPanel, _cost_checks
from benchmarks.gail2014.reference import reference_figures
from benchmarks.gail2014.report import FigureResult, Report, choose_figures, reproduce

ALL = ["fig4", "fig5", "fig6", "fig7", "fig8", "fpu-half", "fpu-degree", "fig9", "fig10", "tsp-half", "tsp-degree"]


def tiny_convergence(name="tiny", orders=2, factory=vm.systems.fermi_pasta_ulam):
    schemes = {"5 micro steps": vm.fully_explicit(5)}
    words, steps = ("A tiny sweep", "order 2 & nothing else."), (0.01, 0.005, 0.002)
    return ConvergenceFigure(name, *words, factory, schemes, dict.fromkeys(schemes, orders), "paper", steps)


def tiny_cost():
    chain = vm.systems.fermi_pasta_ulam
    panel = CostPanel("FPU", chain, chain, vm.fully_explicit, 60, (1, 2), (1, 2), 0.01, 0.1, 0.1, repeats=1)
    return CostFigure("cost", "A tiny cost", "a minimum at 60.", (panel,))


def broken():
    raise RuntimeError("no such <chain>")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A report of one good, one wrong, one failing and one cost figure."""
    out = tmp_path_factory.mktemp("study")
    figures = (tiny_convergence(), tiny_convergence("wrong", 3), tiny_convergence("broken", 2, broken), tiny_cost())
    heard = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(report_module, "reference_figures", lambda size: figures)
        report = reproduce(out, progress=lambda *news: heard.append(news))
    return report, (out / "report.html").read_text(), heard


@pytest.mark.parametrize("size", ["quick", "full"])
def test_the_study_has_all_figures(size):
    figures = reference_figures(size)
    assert [figure.name for figure in figures] == ALL
    for figure in figures:
        if isinstance(figure, ConvergenceFigure):
            assert set(figure.orders) == set(figure.schemes)
            assert all(abs(1 / dt - round(1 / dt)) < 1e-9 and round(1 / dt) % 10 == 0 for dt in figure.macro_dt)
    expected = {figure.name: set(figure.orders.values()) for figure in figures if isinstance(figure, ConvergenceFigure)}
    assert expected["fig6"] == expected["fig7"] == expected["fig10"] == {1}
    assert expected["fig8"] == expected["fig9"] == {2}
    assert expected["fpu-degree"] == expected["tsp-degree"] == {4, 6}


def test_the_full_study_marks_the_minima_of_the_paper():
    (chains,) = [figure for figure in reference_figures("full") if figure.name == "fig5"]
    minima = {panel.title: panel.paper_minimum for panel in chains.panels}  # pyright: ignore[reportAttributeAccessIssue]
    assert minima["fully implicit, l = 70"] == 12
    assert minima["explicit slow, l = 150"] == 8
    assert minima["fully explicit, l = 200"] == 4
    assert minima["fully explicit, l = 10"] is None


def test_choosing_figures():
    figures = reference_figures()
    assert [figure.name for figure in choose_figures(figures, ["fig9", "fig6"])] == ["fig6", "fig9"]
    assert [figure.name for figure in choose_figures(figures, [])] == ALL
    with pytest.raises(ValueError, match=r"no figure 'fig11'; there are fig4, .*tsp-degree"):
        choose_figures(figures, ["fig11"])
    with pytest.raises(ValueError, match=r"'medium'.*quick, full"):
        reference_figures("medium")


def test_checks_compare_what_was_measured(made):
    report, _, _ = made
    right, wrong, _, cost = report.figures
    assert all(check.agrees for check in right.checks)
    assert not any(check.agrees for check in wrong.checks)
    assert right.checks[0] == Check("order of positions, 5 micro steps", "2", "paper", right.checks[0].seen, True)
    assert float(right.checks[0].seen) == pytest.approx(2.0, abs=0.1)
    assert [check.quantity for check in cost.checks] == [
        "FPU, dense: cost turns up again",
        "FPU, dense: cheapest number of micro steps",
        "FPU, exact: cost at 2 micro steps over that at 2, in macro steps of one length",
        "FPU, exact: cost at 2 micro steps over that at 2",
    ]


@pytest.mark.parametrize(
    ("times", "agree", "surprise"),
    [
        ((5.0, 1.0, 1.0, 1.4, 1.4), [False, True, True, True], [True, False, False, False]),
        ((1.0, 5.0, 1.0, 2.0, 1.1), [True, False, True, False], [False, False, False, False]),
        ((1.0, 5.0, 1.0, 2.0, 1.6), [True, False, False, False], [False, False, True, True]),
    ],
)
def test_a_difference_is_known_where_its_reason_holds(times, agree, surprise):
    """Times of the dense solve with 1 and 60 micro steps, of the structured one with 10 and 100, and with 100 in short
    macro steps."""
    rows = [
        CostRow("FPU", method, n, 3, 10, 1.0, us, 1.0, 5, "EXACT", "CONVERGED", times[4])
        for method, n, us in zip(("dense", "dense", "exact", "exact"), (1, 60, 10, 100), times, strict=False)
    ]
    checks = _cost_checks(tiny_cost().panels[0], CostStudy(tuple(rows)))
    assert [check.kind for check in checks] == ["turn", "minimum", "structured", "longer"]
    assert [check.agrees for check in checks] == agree
    assert [check.surprises for check in checks] == surprise
    figure = FigureResult("cost", "", "", "", tuple(checks), 0.0)
    lines = Report(Path("report.html"), (figure,)).in_five_lines()
    assert len(lines) == 5
    expected = "; ".join(check.quantity for check in checks if check.surprises) or "nothing"
    assert lines[3].startswith(f"Different from what was expected: {expected}.")
    assert f"FPU: {60 if times[0] > times[1] else 1} (paper 60)" in lines[1]


def test_what_was_seen_is_made_from_the_numbers(made):
    report, _, _ = made
    assert re.fullmatch(
        r"orders of positions / momenta, 5 micro steps: \d\.\d\d / \d\.\d\d; reference good to .*\.",
        report.figures[0].seen,
    )
    assert re.search(r"dense cheapest at \d \(.* µs\) and .* × that at 2", report.figures[3].seen)


def test_every_figure_has_its_files(made):
    report, _, _ = made
    for name in ("tiny", "wrong", "cost"):
        for ending in ("png", "svg", "csv"):
            assert (report.path.parent / f"{name}.{ending}").stat().st_size > 100
    with open(report.path.parent / "tiny.csv", newline="") as file:
        lines = list(csv.DictReader(file))
    assert [float(line["macro_dt"]) for line in lines] == [0.01, 0.005, 0.002]


def test_a_figure_that_fails_leaves_the_others(made):
    report, html, _ = made
    assert [figure.name for figure in report.failed] == ["broken"]
    assert "This figure failed. RuntimeError: no such &lt;chain&gt;" in html
    assert "in broken" in report.failed[0].traceback
    assert "1\n    of 4 figures failed" in html


def test_the_report_stands_alone(made):
    report, html, _ = made
    pictures = re.findall(r'"data:image/svg\+xml;base64,([^"]+)"', html)
    assert len(pictures) == 2 * 3
    assert all(b"<svg" in base64.b64decode(picture) for picture in pictures)
    assert not re.findall(r'(?:src|srcset|href)="(?!data:|#|[\w-]+\.(?:csv|png|svg)")', html)
    assert "prefers-color-scheme: dark" in html
    for figure in report.figures:
        if not figure.error:
            assert figure.seen in html
    assert "order 2 &amp; nothing else." in html
    assert html.count("✓ agrees") + html.count("≠ differs") == sum(len(figure.checks) for figure in report.figures)
    assert f"vmri_jax {vm_version()}" in html


def vm_version() -> str:
    from importlib.metadata import version

    return version("vmri_jax")


def test_progress_runs_over_all_figures(made):
    _, _, heard = made
    done, total = [news[1] for news in heard], {news[2] for news in heard}
    assert total == {4000}
    assert done == sorted(done)
    assert done[-1] == 4000


@pytest.fixture
def gail2014(tmp_path, monkeypatch):
    """Runs ``python -m benchmarks gail2014`` in an empty folder: (exit code, everything printed)."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("benchmarks.gail2014.report.prepare", lambda: None)
    (tmp_path / "a_file").write_text("")

    def run(*arguments):
        result = CliRunner().invoke(app, ["gail2014", *arguments])
        assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
        return result.exit_code, re.sub(r"[\s│╭╮╰╯─]+", " ", result.output)

    return run


def test_the_command_one_figure(gail2014, tmp_path, monkeypatch):
    few = dataclasses.replace(reference.SIZES["quick"], fpu_steps=(0.01, 0.005, 0.002, 0.001))
    monkeypatch.setitem(reference.SIZES, "quick", few)
    code, text = gail2014("--only", "fig6", "--out", "study")
    assert code == 0
    assert "fig6 4 of 4" in text
    assert "Page: study/report.html" in text
    files = {f"fig6.{ending}" for ending in ("csv", "png", "svg")}
    assert {path.name for path in (tmp_path / "study").iterdir()} == {"report.html", *files}


def test_what_the_command_refuses(gail2014, tmp_path):
    code, text = gail2014("--only", "fig11")
    assert code == 2
    assert "no figure 'fig11'; there are fig4, fig5" in text
    assert not (tmp_path / "out").exists()
    code, text = gail2014("--only", "fig6", "--out", "a_file")
    assert code == 2
    assert "--out a_file cannot be written: File exists" in text


def test_the_command_keeps_the_other_figures(gail2014, tmp_path, monkeypatch):
    def fail(*_, **__):
        raise RuntimeError("out of luck")

    monkeypatch.setattr("benchmarks.gail2014.figures.convergence_study", fail)
    code, text = gail2014("--only", "fig6", "--out", "study")
    assert code == 1
    assert "fig6: RuntimeError: out of luck" in text
    assert "out of luck" in (tmp_path / "study" / "report.html").read_text()
