"""Prepared runs: the same as `simulate`, compiled once for other starts, steps, parameters and numbers of steps."""

from collections import Counter
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from tests.support import largest_difference

CALLS = Counter()
STEPS = {"macro_dt": 0.03, "num_steps": 8, "save": 2}


def watched(q_f, params):
    CALLS.update(["W"])
    return params["omega"] ** 2 / 2 * jnp.sum(q_f**2)


def moved(state: vm.State) -> vm.State:
    return vm.State(state.t, state.q_s, state.q_f, 1.5 * state.p_s, state.p_f)


def test_it_runs_what_simulate_runs(fpu):
    steps: Any = STEPS | {"save": vm.Save(2, micro=True)}
    run = vm.prepare(fpu.system, vm.fully_explicit(3), fpu.state(), **steps)
    expected = vm.simulate(fpu.system, vm.fully_explicit(3), fpu.state(), **steps)
    for name in ("t", "q_s", "q_f", "p_s", "p_f", "energy", "t_micro", "q_f_micro"):
        # two programs, one with a cursor: on some processors LLVM rounds a sum of one in another order
        np.testing.assert_allclose(getattr(run(), name), getattr(expected, name), rtol=0, atol=1e-16, err_msg=name)


def test_numbers_change_without_compiling_again(fpu):
    system = fpu.system.replace(fast_potential=watched)
    run = vm.prepare(system, vm.fully_explicit(3), fpu.state(), **STEPS)
    params = {"omega": jnp.asarray(30.0)}
    CALLS.clear()
    changed = run(moved(fpu.state()), macro_dt=0.01, params=params, num_steps=20)
    assert Counter() == CALLS
    expected = vm.prepare(
        system.replace(params=params), vm.fully_explicit(3), moved(fpu.state()), macro_dt=0.01, num_steps=20, save=5
    )()
    assert Counter() == CALLS  # the same program
    assert largest_difference(changed.q_f, expected.q_f) == 0
    assert largest_difference(changed.t, expected.t) == 0
    assert largest_difference(changed.q_f, run().q_f) > 1e-3


STEPS_TAKEN = Counter()


def counted(q_f, params):
    jax.debug.callback(lambda: STEPS_TAKEN.update(["W"]))
    return jnp.sum(q_f**2) / 2


def test_after_a_failure_no_step_is_taken(fpu):
    """The first of 40 steps fails: the potential is evaluated for the energies of the nodes and in that step, no
    more."""
    system, state = fpu.system.replace(fast_potential=counted), fpu.state()
    run = vm.prepare(system, vm.fully_explicit(1), state, macro_dt=0.01, num_steps=40)
    jax.effects_barrier()
    STEPS_TAKEN.clear()
    bad = vm.State(state.t, 1e200 * state.q_s, state.q_f, state.p_s, state.p_f)
    trajectory = run(bad, throw=False)
    jax.effects_barrier()
    assert trajectory.failed_at == 0
    assert trajectory.result == vm.Result.NON_FINITE
    assert 0 < STEPS_TAKEN["W"] <= 45  # 42, with the energies of 41 nodes; 82 if all steps were taken
    assert np.allclose(trajectory.t, 0.01 * np.arange(41), rtol=1e-15, atol=0)
    with pytest.raises(vm.SimulationError, match="macro step 0"):
        run(bad)


def test_a_start_off_the_constraints_has_failed(tsp):
    steps, state = {"macro_dt": 0.01, "num_steps": 2, "solver": vm.Solver("masses")}, tsp.state()
    off = vm.State(state.t, state.q_s, 1.01 * state.q_f, state.p_s, state.p_f)
    trajectory = vm.prepare(tsp.system, vm.fully_explicit(2), state, **steps)(off, throw=False)
    assert trajectory.result == vm.Result.CONSTRAINT_VIOLATED
    assert np.isnan(trajectory.q_f).all()
    with pytest.raises(ValueError, match="simulate: the positions of the state violate constraint, row 0"):
        vm.simulate(tsp.system, vm.fully_explicit(2), off, **steps)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"num_steps": 7}, "num_steps is 7; it must be a positive multiple of 4"),
        ({"num_steps": 8.0}, "run: num_steps is 8.0; it must be an integer"),
        ({"macro_dt": -0.01}, "run: macro_dt is -0.01; it must be a positive number"),
        ({"macro_dt": [0.01, 0.02]}, r"run: macro_dt has shape \(2,\)"),
        ({"state": 0.02}, "run: state is float; give a State"),
        ({"state": vm.State(np.nan, *4 * [np.zeros(3)])}, "run: the t of state is nan; it must be finite"),
        ({"params": {"omega": np.ones(2)}}, "give the pytree of system.params"),
        ({"state": vm.State(0.0, *4 * [np.zeros(2)])}, "the run was prepared for"),
    ],
)
def test_bad_changes_are_refused(fpu, changes, message):
    run = vm.prepare(fpu.system, vm.fully_explicit(3), fpu.state(), **STEPS)
    with pytest.raises(ValueError, match=message):
        run(**changes)


def test_tracers_and_short_floats_are_refused(fpu):
    with pytest.raises(ValueError, match="prepare: arguments are tracers"):
        jax.jit(lambda state: vm.prepare(fpu.system, vm.fully_explicit(3), state, **STEPS)().q_f)(fpu.state())
    run = vm.prepare(fpu.system.replace(params={"omega": 30.0}), vm.fully_explicit(3), fpu.state(), **STEPS)
    with pytest.raises(ValueError, match=r"params\['omega'\] has dtype float32; give float64"):
        run(params={"omega": np.float32(30.0)})
    start = fpu.state()
    for called in (
        lambda x: run(params={"omega": x}),
        lambda x: run(macro_dt=x),
        lambda x: run(replace(start, q_f=x * start.q_f)),
    ):
        with pytest.raises(ValueError, match=r"run: arguments are tracers; .*take simulate"):
            jax.grad(called)(jnp.array(0.02))
    short = jax.tree.map(lambda a: np.asarray(a, dtype=np.float32), fpu.state())
    for state, name in ((short, "the t of state"), (replace(short, t=0.0), "q_s")):
        with pytest.raises(ValueError, match=f"{name} has dtype float32; give float64"):
            run(state)
