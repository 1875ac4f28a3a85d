"""What arguments of runs are told."""

import jax
import numpy as np
import pytest

import vmri_jax as vm
from vmri_jax.running.arguments import nothing_fast


@pytest.mark.parametrize(
    ("scheme", "num_fast", "told"),
    [
        (vm.fully_implicit(1), 0, False),
        (vm.compose(vm.fully_implicit(1), "kahan-li8"), 0, False),  # its num_micro counts the micro steps of 17 stages
        (vm.compose(vm.fully_implicit(2), "yoshida4"), 0, True),
        (vm.fully_implicit(2), 0, True),
        (vm.fully_implicit(2), 3, False),
    ],
)
def test_several_micro_steps_for_nothing_fast(scheme, num_fast, told):
    assert ("Take num_micro=1" in nothing_fast(scheme, num_fast)) == told


@pytest.mark.compiles
def test_runs_of_known_numbers_in_a_program(fpu):
    """A function without arguments in jit: JAX compiles the run as a part of it."""
    state, steps = fpu.state(), {"macro_dt": 0.01, "num_steps": 2}

    def run():
        return vm.simulate(fpu.system, vm.fully_explicit(1), state, **steps).q_f

    assert np.allclose(jax.jit(run)(), run(), rtol=1e-14, atol=1e-16)
    with pytest.raises(ValueError, match=r"prepare: .* outside of jax.jit"):
        jax.jit(lambda: vm.prepare(fpu, vm.fully_explicit(1), **steps)().q_f)()
