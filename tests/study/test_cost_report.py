"""The page of cost: its answers, figures and files, and what it says of schemes that it had no time for."""

from importlib import import_module

import numpy as np
import pytest

from tests.study.test_advisor import SHORT_MENU
from tests.study.test_convergence import PROBLEM
from vmri_jax.study import cost_report
from vmri_jax.study.cost_report import _multirate, default_t_end


def test_cost_report(tmp_path):
    """Above 20 s of compiling: the schemes of the search, with twice their micro steps for the shares, and the trials of an accuracy."""
    report = cost_report(PROBLEM, "spring", tmp_path, t_end=1.0, errors=(1e-5, 1e-3), menu=SHORT_MENU)
    text = report.path.read_text()
    assert [answer.error for answer in report.rows] == [1e-3, 1e-5]
    assert "What accuracy costs" in text
    assert not report.not_tried
    printed = " ".join(str(report).split())  # whatever the width of the terminal
    assert (
        "Runs to t = 1, with the largest errors of the positions on the way. The reference solution is good to"
        in printed
    )
    setting = report.rows[1].setting
    assert setting is not None
    assert setting.command("spring") in text.replace("&#34;", '"')
    settings = {answer.error: answer.setting for answer in report.rows}
    for error, family, num_micro, gain in _multirate(report):  # the page's sentences agree with its table
        chosen = settings[error]
        assert chosen is not None
        assert (family, num_micro) == (chosen.family.name, chosen.num_micro)
        assert gain >= 1
    assert sum(report.shares.values()) == pytest.approx(1)
    assert report.accuracy is not None
    assert report.accuracy.error_q <= report.accuracy_error
    shares = [stair.fast_share for stairs in report.stairs.values() for stair in stairs]
    assert all(0 <= share <= 1 for share in shares if not np.isnan(share))
    assert not all(np.isnan(share) for share in shares)
    assert {"cost.html", "cost.png", "cost_dark.png", "cost.csv"} <= {path.name for path in tmp_path.iterdir()}
    assert default_t_end(PROBLEM) == pytest.approx(30 * 2 * np.pi / 20, rel=0.1)
    with pytest.raises(ValueError, match="positive"):
        cost_report(PROBLEM, "spring", tmp_path, t_end=1.0, errors=(-1.0,))


def test_a_cost_report_names_the_schemes_that_it_had_no_time_for(tmp_path, monkeypatch):
    """Once a scheme has kept the error, a search without time compiles no other one."""
    module = import_module("vmri_jax.study.cost_report")
    monkeypatch.setattr(module, "BUDGET", -1.0)
    monkeypatch.setattr(module, "_of_accuracy", lambda *_: None)
    report = cost_report(PROBLEM, "spring", tmp_path, t_end=1.0, errors=(1e-3,), menu=SHORT_MENU)
    assert 0 < len(report.not_tried) < len(SHORT_MENU)
    for text in (str(report), report.path.read_text()):
        assert f"not tried: {', '.join(report.not_tried)}. For one error vmri tune tries all" in " ".join(text.split())
