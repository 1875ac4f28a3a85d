"""What `print` shows of runs, states, systems and problems: a few lines in words, never whole arrays."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from tests.animation.support import swinging
from vmri_jax.mechanics.names import Names
from vmri_jax.running.origin import Origin
from vmri_jax.running.quantities import Work
from vmri_jax.running.trajectory import RunInfo
from vmri_jax.steppers.results import Result, Status

NAMES = Names(slow={"bob": 2}, fast={"tip": 2}, constraint={"rod": 1})
LONGEST = 150
"""Characters in a line of a summary."""


def lines_of(thing) -> list[str]:
    """The lines of ``print(thing)``, which are few and of a length to be read."""
    lines = str(thing).splitlines()
    assert repr(thing) == str(thing)
    assert len(lines) <= 16
    assert max(map(len, lines)) <= LONGEST
    return [" ".join(line.split()) for line in lines]


@pytest.fixture(scope="module")
def run():
    """A run of 41 nodes whose energy changes by a thousandth, and whose constraints are kept to 1e-14."""
    residual = np.zeros((41, 2))
    residual[7] = 1e-14, 2e-13
    info = RunInfo(np.full(40, 3), np.full(40, 4), np.full(40, 1e-15))
    swing = swinging(constraint_residual=residual, result=np.asarray(0), failed_at=np.asarray(-1))
    return dataclasses.replace(swing, info=info, origin=Origin(NAMES))


def test_a_run_says_what_it_is_and_what_it_has_kept(run):
    assert lines_of(run) == [
        "Trajectory: 41 saved nodes from t = 0 to 4",
        "status CONVERGED",
        "slow 2 coordinates: bob x, bob y",
        "fast 2 coordinates: tip x, tip y",
        "energy 2 at the start, changed by at most 9.99e-04, 5.0e-04 of it",
        "constraints kept to 1.0e-14 in positions, 2.0e-13 in velocities",
        "solver MASSES, at most 4 iterations per step, residual at most 1.0e-15",
    ]


def test_a_run_that_failed_says_where(run):
    cut = {name: np.where(np.arange(41)[:, None] > 5, np.nan, getattr(run, name)) for name in ("q_s", "q_f")}
    energy = np.where(np.arange(41) > 5, np.nan, run.energy)
    failed = run.with_arrays(**cut, energy=energy, result=np.asarray(3), failed_at=np.asarray(5))
    assert "status DIVERGED at macro step 5; all saved nodes after it are NaN" in lines_of(failed)


def test_a_batch_counts_its_runs(run):
    other = eqx.tree_at(lambda run: (run.result, run.failed_at), run, (np.asarray(4), np.asarray(0)))
    batch = jax.tree.map(lambda *a: np.stack(a), *[run, run, other])
    lines = lines_of(batch)
    assert lines[0] == "Trajectory of a batch of 3 runs: 41 saved nodes from t = 0 to 4"
    assert "status 2 CONVERGED, 1 NON_FINITE; failed: run.lane(i) for i = 2" in lines
    assert "energy changed by at most 9.99e-04 in a run" in lines


@pytest.mark.compiles
def test_the_status_of_a_run_prints_as_a_sentence_and_is_a_number(run):
    assert (str(run.result), f"{run.result}", repr(run.result)) == ("CONVERGED", "CONVERGED", repr(Result.CONVERGED))
    assert str(Status(3)).startswith("DIVERGED: Newton's iteration moved away")
    assert run.result == 0
    assert f"{Status(3):d}" == "3"
    again = jax.jit(lambda run: run)(run)
    assert again.result.dtype == np.int64
    assert jax.tree.map(lambda a: a[None], run).result.tolist() == [0]
    assert jnp.stack([run.result, run.result]).tolist() == [0, 0]


@pytest.mark.compiles
def test_nothing_fails_to_print_without_numbers(run, fpu):
    def seen(*things):
        said.extend(map(repr, things))
        return 0

    said: list[str] = []
    jax.jit(lambda run, state, system: seen(run, run.info, run[-1], state, system))(run, fpu.state(), fpu.system)
    jax.vmap(lambda run: seen(run, run[-1]))(jax.tree.map(lambda a: jnp.asarray(a)[None], run))
    for placeholder in (None, object(), True, jax.ShapeDtypeStruct((3,), float)):
        seen(*(jax.tree.map(lambda _, it=placeholder: it, tree) for tree in (run, run.info, fpu.state(), fpu.system)))
    assert "f64[41,2]" in said[0]
    assert len(said) == 7 + 4 * 4
    assert all(text.startswith(("Trajectory", "RunInfo", "State", "System")) for text in said)


def test_states_say_their_numbers_and_many_of_them_their_shape(run):
    assert lines_of(run[0]) == ["State at t = 0", "q_s 0, -1", "q_f 0, -2.2", "p_s 0, -1", "p_f 0, -2.2"]
    assert repr(run.states) == "\n".join(repr(run.states).splitlines())
    assert "q_s=f64[41,2]" in repr(run.states)


def test_work_is_a_ledger():
    work = Work(np.array([0.0, -1.5]), np.array([0.0, 0.25]), np.array([0.0, 1e-6]), 2e-4)
    assert lines_of(work) == [
        "Work from the start to the end, and the change of the energy",
        "change of the energy -1.25",
        "work of forces -1.5",
        "work of moving constraints 0.25",
        "remainder of the balance 1e-06, the error of the run and of the two works",
        "resolved by the nodes to 0.0002",
    ]
    cut = np.array([0.0, 1.0, np.nan])
    failed = Work(cut, cut, cut, 0.0)
    assert lines_of(failed)[0].startswith("Work from the start to node 1, after which the run failed")
    assert repr(jax.tree.map(lambda _: None, work)).startswith("Work(")


def test_a_problem_says_its_coordinates_terms_and_start(tsp):
    lines = lines_of(tsp)
    assert lines[:3] == [
        "Problem",
        "slow 3 coordinates: bob 1 x, bob 1 y, bob 1 z",
        "fast 6 coordinates: bob 2 x, bob 2 y, bob 2 z, bob 3 x, bob 3 y, bob 3 z",
    ]
    assert "constraint g function second_rod" in lines
    assert "rows of constraints rod 2 (1), rod 1 (1)" in lines
    rods = dataclasses.replace(tsp.names, constraint={"rods": 1}, slow_constraint={"rods": 1})
    assert "rows of constraints rods (2)" in lines_of(dataclasses.replace(tsp, names=rods))
    assert "q_f 10, 2, 0, 10, 2, 3" in lines
    assert lines_of(tsp.system) == ["System", *lines[3:9]]


def test_many_coordinates_are_not_all_listed():
    chain = vm.systems.fermi_pasta_ulam(50)
    assert any("50 coordinates" in line and " and 44 more" in line for line in lines_of(chain))
