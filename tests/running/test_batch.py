"""Batches: every lane is the single run, whatever the chunks; failures stay in their lane."""

from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from tests.stability.systems import swinging
from tests.support import PROBLEMS, largest_difference
from tests.user_systems import cart
from vmri_jax import (
    Result,
    State,
    compose,
    explicit_slow,
    fully_explicit,
    fully_implicit,
    galerkin,
    simulate,
    simulate_batch,
)


def spread(problem, lanes: int) -> State:
    """States that differ in their velocities."""
    state = problem.state()
    scale = 1 + 0.02 * jnp.arange(lanes)[:, None]
    q_s, q_f = jnp.tile(state.q_s, (lanes, 1)), jnp.tile(state.q_f, (lanes, 1))
    return State(jnp.zeros(lanes), q_s, q_f, scale * state.p_s, scale * state.p_f)


SYSTEMS = PROBLEMS | {"chain": partial(vm.systems.fermi_pasta_ulam, 1), "pendulum": swinging, "cart": cart}
RUN: dict[str, Any] = {"num_steps": 20, "save": 5}
WAYS = {  # system, scheme, macro_dt, largest difference of a lane from its single run
    "kicks": ("chain", fully_explicit(3), 0.05, 1e-13),  # measured 3e-15
    "linear fast equations": ("chain", explicit_slow(3), 0.05, 1e-13),
    "nested": ("pendulum", fully_implicit(3), 0.05, 1e-13),
    "drift along constraints": ("tsp", fully_explicit(1), 0.002, 1e-13),
    "collocation": ("pendulum", galerkin(1, 2), 0.05, 1e-12),
    "composition": ("chain", compose(fully_explicit(2), "yoshida4"), 0.02, 1e-13),
}


def lane_of(states: State, lane: int) -> State:
    return jax.tree.map(lambda a: a[lane], states)


@cache
def single(way: str, lane: int):
    """The run of one of five lanes."""
    name, scheme, macro_dt, _ = WAYS[way]
    problem = SYSTEMS[name]()
    return simulate(problem.system, scheme, lane_of(spread(problem, 5), lane), macro_dt=macro_dt, **RUN)


@pytest.mark.parametrize(("way", "chunk"), [(way, 2 if way == "nested" else None) for way in WAYS])
def test_lanes_equal_single_runs(way, chunk):
    name, scheme, macro_dt, bound = WAYS[way]
    problem = SYSTEMS[name]()
    batch = simulate_batch(problem.system, scheme, spread(problem, 5), macro_dt=macro_dt, chunk=chunk, **RUN)
    assert batch.q_f.shape == (5, 5, problem.q_f.size)
    assert np.all(np.asarray(batch.result) <= Result.CONVERGED_AT_ROUNDOFF)
    for lane in (0, 4):
        assert largest_difference(batch.q_f[lane], single(way, lane).q_f) < bound
        assert largest_difference(batch.t[lane], single(way, lane).t) == 0
