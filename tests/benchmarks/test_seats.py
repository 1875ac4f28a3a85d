"""Workers take turns, and what is compared is what both sides compute."""

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

import vmri_jax as vm
from benchmarks import against, seats, tricks, worker
from benchmarks.measure import Ratio
from benchmarks.seats import Seat, Worker, take_turns
from benchmarks.worker import Case
from vmri_jax import diagnostics
from vmri_jax.kernels import cpu

ROOT = Path(__file__).parents[2]
SHORT = Case("single", "FPU l=3", "fully_explicit 2", 0.01, seconds=1e-3)


def test_schemes_in_words():
    assert Case("", scheme="galerkin 1 8 lobatto").made_scheme().degree == 8
    composed = Case("", scheme="kahan-li8 of fully_explicit 2").made_scheme()
    assert composed.order == 8
    assert composed.num_micro == vm.compose(vm.fully_explicit(2), "kahan-li8").num_micro


@pytest.fixture(scope="module")
def workers():
    with Worker(Seat()) as one, Worker(Seat()) as other:
        yield {"one": one, "other": other}


def test_two_sides(workers):
    """The same number of steps on both, the same end."""
    found = take_turns(workers, SHORT, 3)
    assert [len(samples) for samples in found.samples.values()] == [3, 3]
    assert found.made["one"]["num_steps"] == found.made["other"]["num_steps"] > 1
    assert found.made["one"]["result"] == "CONVERGED"
    assert found.difference("one", "other") == 0


def test_what_a_side_cannot_do_is_said(workers):
    found = take_turns(workers, replace(SHORT, scheme="no_such_scheme 2"), 3)
    assert not found.samples
    assert "no_such_scheme" in found.refused["one"]
    assert found.difference("one", "other") is None
    assert take_turns(workers, SHORT, 1).samples  # it goes on


def test_a_worker_that_ends_is_an_error(tmp_path):
    with (
        Worker(Seat(checkout=tmp_path, options=("--no-such-option",))) as lost,
        pytest.raises(RuntimeError, match="ended"),
    ):
        lost.make(SHORT)


def test_turns():
    assert seats._rotated(["a", "b", "c"], 4) == ["b", "c", "a"]


def test_every_group_of_a_comparison():
    """With itself, one case of each kind."""
    size = against.sizes("quick", ROOT, only=["single", "gradient"])
    gradient = replace(against.GROUPS["gradient"][0], system="FPU l=3", scheme="fully_explicit 2", num_steps=2)
    groups = {"single": [SHORT], "gradient": [gradient]}
    *_, report = against.run(replace(size, groups=groups, repeats=2, fresh=1, seconds=1e-3), "quick")
    assert [row["group"] for row in report.rows] == ["single", "gradient, cold", "gradient"]
    assert all(row["differs"] == 0 for row in report.rows)
    assert [claim.what.split(":")[1] for claim in report.claims] == [" after over before", " after, seconds"]
    assert report.about["before"]["commit"] == report.about["after"]["commit"]


def test_sizes_of_a_comparison(tmp_path):
    assert set(against.sizes("full", ROOT).groups) == set(against.GROUPS)
    with pytest.raises(ValueError, match="has no folder vmri_jax"):
        against.sizes("quick", tmp_path)
    with pytest.raises(ValueError, match="there is no group one; there are single"):
        against.sizes("quick", ROOT, only=["one"])


def test_every_case_names_a_scheme_and_a_system():
    for case in [*(case for cases in against.GROUPS.values() for case in cases), *tricks.CASES]:
        assert case.made_scheme().num_micro >= 1
        assert case.problem().q_s.size


def test_plain_form_of_a_kernel(monkeypatch):
    """It replaces the tuned one in every module that has imported it, and nothing else of that name."""

    def tuned():
        """Of the kernels."""

    def plain():
        """The same."""

    other = object()
    monkeypatch.setattr(cpu, "probe", tuned, raising=False)
    monkeypatch.setattr(diagnostics, "probe", tuned, raising=False)
    monkeypatch.setattr(vm, "probe", other, raising=False)
    monkeypatch.setitem(sys.modules, "vmri_jax.kernels.plain", SimpleNamespace(probe=plain))
    worker.use_plain("probe")
    assert cpu.probe is plain  # pyright: ignore[reportAttributeAccessIssue]
    assert diagnostics.probe is plain  # pyright: ignore[reportAttributeAccessIssue]
    assert vm.probe is other  # pyright: ignore[reportAttributeAccessIssue]


def test_a_trick_stays_if_it_buys_enough_somewhere():
    chain, batch = (next(c for c in tricks.CASES if c.kind == kind) for kind in ("single", "batch"))
    row = tricks._row("solve", {chain: Ratio(1.5, 1.4, 1.6), batch: Ratio(1.1, 1.0, 1.2)})
    assert (row["FPU l=3"], row["FPU l=3, batch"], row["TSP"]) == (1.5, 1.1, None)
    assert (row["most"], row["keep"]) == (1.5, "yes")
    assert tricks._row("solve", {chain: Ratio(1.5, 1.2, 1.6)})["keep"] == "no"
