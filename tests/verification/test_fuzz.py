"""Random systems end in a valid trajectory, a named status or a refusal; and the verdict on them can fail.

`python -m tests.fuzz` runs thousands of them over many structures; here are a few structures whose draws Hypothesis
chooses, and shrinks where one ends wrong.
"""

from random import Random

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

import vmri_jax as vm
from tests import fuzz
from tests.verification import random_systems as rs
from vmri_jax.running.trajectory import RunInfo, from_named_arrays

# Many draws of each run one program; the structures are chosen to be different ways through a step.
STRUCTURES = {
    "kicks and drifts": rs.Structure(
        dimension=2, slow_potential="pole", fast_potential="spring", scheme="fully explicit", num_micro=5, num_saves=1
    ),
    "rods": rs.Structure(
        dimension=2,
        fast=2,
        slow_potential="pole",
        fast_potential="harmonic",
        constraint="chain",
        scheme="fully explicit",
        num_micro=3,
        method="masses",
    ),
    "a constraint that crosses itself": rs.Structure(
        dimension=2, fast_potential="finitely extensible", constraint="product", num_micro=2, method="exact"
    ),
    "a force that is NaN for half of all velocities": rs.Structure(
        slow_potential="logarithm", fast_potential="double well", force="root", method="exact"
    ),
}


LONG = ("a constraint that crosses itself", "a force that is NaN for half of all velocities")


@pytest.mark.parametrize("name", [pytest.param(s, marks=pytest.mark.full if s in LONG else ()) for s in STRUCTURES])
def test_runs_end_as_they_should(name):
    structure, seen = STRUCTURES[name], set()

    @given(st.randoms(note_method_calls=False, use_true_random=False))
    @settings(max_examples=30)
    def check(random):
        (outcome,) = fuzz.verdicts(structure, [rs.draw(random, structure)])
        seen.add(outcome)
        assert outcome in fuzz.HONEST

    check()
    assert len(seen) > 1  # not all refused, or all at rest


def test_lanes_of_a_batch_end_as_they_should():
    structure = rs.Structure(slow_potential="pole", fast_potential="harmonic", scheme="fully explicit", lanes=4)
    found = []
    for seed in range(8):
        random = Random(seed)
        found += fuzz.verdicts(structure, [rs.draw(random, structure) for _ in range(4)])
    assert set(found) <= set(fuzz.HONEST)
    assert {"CONVERGED", "NON_FINITE"} <= set(found)


def verdict(**changes) -> str:
    """On a run of three intervals with these fields changed."""
    nodes = dict.fromkeys(("q_s", "q_f", "p_s", "p_f"), np.ones((4, 1)))
    fields = {
        "t": np.arange(4.0),
        **nodes,
        "energy": np.ones(4),
        "constraint_residual": np.zeros((4, 2)),
        **dict.fromkeys(RunInfo._fields, np.zeros(3)),
        "result": 0,
        "failed_at": -1,
    }
    return fuzz.judge(from_named_arrays(fields | changes), 1e-12, num_steps=6)


NAN, LAST = np.array([1.0, 1.0, 1.0, np.nan]), {"result": 2, "failed_at": 5}
FAILED = LAST | dict.fromkeys(("q_s", "q_f", "p_s", "p_f"), NAN[:, None]) | {"energy": NAN}


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({}, "CONVERGED"),
        (FAILED, "STAGNATED"),
        (FAILED | {"result": 99}, "unknown status"),
        ({"result": 2}, "status at odds"),
        ({"failed_at": 1}, "status at odds"),
        ({"energy": NAN}, "not finite: energy"),
        ({"p_s": NAN[:, None]}, "not finite: p_s"),
        (FAILED | {"energy": np.ones(4)}, "stale numbers: energy"),
        ({"constraint_residual": np.full((4, 2), 2e-6)}, "constraint violated"),
        ({"constraint_residual": np.full((4, 2), np.nan)}, "constraint violated"),
        ({"t_micro": np.ones((3, 2)), "q_f_micro": np.full((3, 2, 1), np.nan)}, "not finite: q_f_micro"),
        ({"residual": np.full(3, np.nan)}, "not finite: residual"),
    ],
)
def test_verdicts(changes, found):
    assert verdict(**changes).startswith(found)


def test_errors_of_others_are_no_refusals():
    for wrong in (
        lambda: jnp.ones(2) + jnp.ones(3),
        lambda: vm.ConstantMass.velocity(None, 0, 0),  # pyright: ignore[reportArgumentType]
        lambda: {}["x"],
    ):
        with pytest.raises(Exception) as caught:  # noqa: PT011
            wrong()
        assert fuzz.refusal(caught.value).startswith("foreign error: " + type(caught.value).__name__)
    with pytest.raises(ValueError, match="positive") as caught:
        vm.ConstantMass([-1.0], [1.0])
    assert fuzz.refusal(caught.value) == "REFUSED"


def test_draws_are_named_by_their_run():
    assert fuzz.draws_of(0, 7) == fuzz.draws_of(0, 7)
    assert fuzz.draws_of(0, 7) != fuzz.draws_of(1, 7)
    assert fuzz.draws_of(0, 7)[0] == fuzz.draws_of(0, 8)[0]
    runs = [run for together in fuzz.calls(list(range(1000)), 0) for run in together]
    assert runs == list(range(1000))


def test_outcomes_are_kept(tmp_path):
    path = tmp_path / "fuzz.jsonl"
    path.write_text('{"run": 0, "outcome": "CONVERGED"}\n{"run": 1, "outcome": "stale numbers: energy"}\n')
    found = fuzz.fuzz(2, 0, path, limit=1.0)
    assert found == {0: "CONVERGED", 1: "stale numbers: energy"}
    console = Console(record=True, width=100)
    fuzz.table(found, console)
    text = console.export_text()
    assert "1 ended wrong" in text
    assert "run 1: stale numbers: energy" in text
