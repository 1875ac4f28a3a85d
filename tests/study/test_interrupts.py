"""Ctrl-C in a study keeps what is done; a cost report of a system at rest says so."""

from dataclasses import replace
from importlib import import_module

import pytest

import vmri_jax as vm
from tests.small_systems import one_coordinate
from vmri_jax.accuracy.families import of_order_2
from vmri_jax.study import (
    ConvergenceStudy,
    ReferenceSolution,
    convergence_study,
    cost_report,
)
from vmri_jax.study.row import joined

SCHEME, T_END = vm.fully_explicit(1), 0.08


def ctrl_c(words: str):
    """A `progress` during which the user presses Ctrl-C before the work of these words."""

    def progress(what: str, done: int, total: int) -> None:
        if words in what:
            raise KeyboardInterrupt

    return progress


@pytest.fixture(scope="module")
def reference() -> ReferenceSolution:
    return ReferenceSolution(
        *joined(vm.simulate(one_coordinate(), SCHEME, macro_dt=T_END / 256, num_steps=256, save=256))
    )


@pytest.mark.parametrize(("words", "rows"), [("H = 0.01", 2), ("measuring times", 3)])
def test_convergence_studies_keep_their_rows(reference, words, rows):
    steps = [0.04, 0.02, 0.01]
    with pytest.raises(vm.Interrupted, match=f"interrupted after {rows} runs") as caught:
        convergence_study(
            *(one_coordinate(), {"explicit": SCHEME}, steps, T_END),
            num_saves=1,
            reference=reference,
            repeats=1,
            progress=ctrl_c(words),
        )
    study = caught.value.done
    assert isinstance(study, ConvergenceStudy)
    assert [row.macro_dt for row in study.rows] == steps[:rows]
    assert study.order("explicit") == pytest.approx(2.0, abs=0.05)


def test_cost_reports_keep_their_runs_while_the_page_is_drawn(monkeypatch, tmp_path):
    """Ctrl-C in the figures of the page ended `vmri cost` without a word of what it had found."""

    def drawing(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(import_module("vmri_jax.study.tuning"), "_write", drawing)
    menu = [replace(of_order_2(vm.fully_explicit), first=1)]
    with pytest.raises(vm.Interrupted) as caught:
        cost_report(one_coordinate(), "mass", tmp_path, t_end=T_END, errors=[1e-3], menu=menu)
    assert caught.value.done.rows


def test_a_cost_report_of_a_system_at_rest_says_so(tmp_path):
    """Its errors are parts of how far it moves; it came as "errors are []"."""
    at_rest = vm.Problem(vm.System(vm.ConstantMass([1.0], [])), [1.0], [])
    with pytest.raises(ValueError, match=r"positions move by 0\.0e\+00.*at rest"):
        cost_report(at_rest, "mass", tmp_path, t_end=1.0, menu=[of_order_2(vm.fully_explicit)])
