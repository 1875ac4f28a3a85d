"""The page of cost: its answers, figures and files."""

from itertools import pairwise

import numpy as np
import pytest

from tests.study.test_convergence import PROBLEM
from tests.study.test_tuning import SHORT_MENU
from vmri_jax.study import cost_report
from vmri_jax.study.cost_report import default_t_end


def test_cost_report(tmp_path):
    report = cost_report(PROBLEM, "spring", tmp_path, t_end=1.0, errors=(1e-5, 1e-3), menu=SHORT_MENU)
    text = report.path.read_text()
    assert [answer.error for answer in report.rows] == [1e-3, 1e-5]
    assert "What accuracy costs" in text
    printed = " ".join(str(report).split())  # whatever the width of the terminal
    assert "Runs to t = 1, with the largest errors of the positions on the way." in printed
    large, small = report.reached
    assert small.settings.command("spring") in text.replace("&#34;", '"')
    assert small.error_q <= 1e-5
    assert large.error_q <= 1e-3
    assert large.seconds <= small.seconds
    assert set(report.curves.schemes) == {family.name for family in SHORT_MENU}
    for scheme in report.curves.schemes:  # a curve falls
        assert all(a.error_q > b.error_q for a, b in pairwise(report.curves.curve(scheme)))
    front = [row.seconds for row in report.curves.pareto()]
    assert all(0 < seconds <= row for (seconds, _), row in zip(report.bound, front, strict=True))
    assert {"cost.html", "cost.png", "cost_dark.png", "cost.csv"} <= {path.name for path in tmp_path.iterdir()}
    assert default_t_end(PROBLEM) == pytest.approx(30 * 2 * np.pi / 20, rel=0.1)
    with pytest.raises(ValueError, match="each of errors is -1"):
        cost_report(PROBLEM, "spring", tmp_path, t_end=1.0, errors=(-1.0,))
