"""A run that loses its energy is told about; round-off about a state of rest is not."""

import warnings

import jax.numpy as jnp
import pytest

import vmri_jax as vm


def bonds(q_f, params):
    return 50.0 * (q_f[0] - 0.3) ** 2 + 20.0 * (q_f[1] - q_f[0] - (0.1 + 0.2)) ** 2


def bonds_of_terms_that_cancel(q_f, params):
    return bonds(q_f, params) + 1e4 * jnp.sin(q_f[1]) ** 2 - 1e4


def rest_of_these_terms(q_s, q_f, params):
    return 1e4 * jnp.cos(q_f[1]) ** 2


@pytest.mark.parametrize(
    ("fast_potential", "slow_potential"), [(bonds, None), (bonds_of_terms_that_cancel, rest_of_these_terms)]
)
def test_rest_up_to_roundoff_is_no_loss(fast_potential, slow_potential):
    system = vm.System(vm.ConstantMass([], [1.0, 1.0]), slow_potential, fast_potential)
    rest = vm.Problem(system, [], [0.3, 0.6])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run = vm.simulate(rest, vm.fully_explicit(1), macro_dt=0.01, num_steps=400)
    assert 0 < abs(run.energy - run.energy[0]).max() < 1e-9
    moved = vm.initial_state(system, [], [0.31, 0.6], [], [0.0, 0.0])
    with pytest.warns(vm.LostEnergyWarning, match=r"the computed motion is wrong: the energy.* has changed by"):
        vm.simulate(system, vm.fully_explicit(1), moved, macro_dt=0.25, num_steps=3)
