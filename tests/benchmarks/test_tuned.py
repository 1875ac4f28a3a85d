"""The benchmark of runs of an accuracy over the search: one row, its claim, and what a search refuses."""

from dataclasses import replace
from functools import partial

from benchmarks import tuned
from benchmarks.dear.systems import molecules


def test_a_row_and_a_refusal():
    case = tuned.Case("2 molecules", partial(molecules, 2), 0.1, 1e-2, ("fully explicit",))
    *_, report = tuned.run([case, replace(case, error=1e-20)], "quick")
    (row,) = report.rows
    assert max(row["its error"], row["error there"]) <= row["error"]
    (claim,) = report.claims
    assert claim.seen.value == row["ratio"] > 0
    assert len(report.notes) == 1


def test_sizes():
    assert {case.system for case in tuned.sizes("quick")} < {case.system for case in tuned.sizes("full")}
    assert len(tuned.sizes("full")) == 16
    assert {case.system for case in tuned.sizes("full", ("TSP",))} == {"TSP"}
