"""A run that loses its energy is told about; round-off about a state of rest is not."""

import warnings

import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm


def bonds(q_f, params):
    return 50.0 * (q_f[0] - 0.3) ** 2 + 20.0 * (q_f[1] - q_f[0] - (0.1 + 0.2)) ** 2


def bonds_of_terms_that_cancel(q_f, params):
    return bonds(q_f, params) + 1e4 * jnp.sin(q_f[1]) ** 2 - 1e4


@pytest.mark.parametrize(
    ("fast_potential", "slow_potential"),
    [(bonds, None), (bonds_of_terms_that_cancel, lambda q_s, q_f, params: 1e4 * jnp.cos(q_f[1]) ** 2)],
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


@pytest.mark.parametrize("scheme", [vm.fully_implicit(2), vm.galerkin(1, 3)])
def test_a_weight_that_rests_at_the_origin(scheme):
    """All positions are zero: the displacement that the rail takes from a step is the size of round-off, of 1e-51 m for
    `galerkin`, and the energy of the velocity that it takes the size of lost energy, of 2e-33 J for `fully_implicit`.
    """
    mass = vm.ConstantMass([], [2.0, 2.0])
    system = vm.System(mass, lambda q_s, q_f, params: 19.62 * q_f[1], constraint=lambda q_s, q_f, params: q_f[1:])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run = vm.simulate(vm.Problem(system, [], [0.0, 0.0]), scheme, macro_dt=0.01, num_steps=2)
    np.testing.assert_allclose(run.multipliers()["constraint"], -19.62)


def test_a_pushed_system_that_explodes_is_told_and_one_in_resonance_is_not():
    def push(t, q_s, q_f, v_s, v_f, params):
        return q_s, 10.0 * jnp.sin(100.0 * t)[None]

    system = vm.System(vm.ConstantMass([], [1.0]), None, lambda q_f, params: 5e3 * q_f[0] ** 2, force=push)
    pushed = vm.prepare(vm.Problem(system, [], [0.01]), vm.fully_explicit(1), macro_dt=0.01, num_steps=40)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pushed()
    with pytest.warns(vm.LostEnergyWarning, match=r"the energy, .* or less at the start, has changed by"):
        pushed(macro_dt=0.03)


def rotating_frame(q_s, q_f, v_s, v_f, turn):
    velocity = v_f + turn * jnp.stack([-q_f[1], q_f[0]])
    return velocity @ velocity / 2


def ring(q_f, turn):
    return 5.0 * (jnp.linalg.norm(q_f) - 1.0) ** 2


def test_a_frame_that_turns():
    """T has terms of degree 0 and 1 in v: momenta are ``M v + dT/dv(0)``, and ``p . v - T`` is negative here."""
    for constraint in (None, lambda q_s, q_f, turn: jnp.stack([q_f[0] ** 2 + 4 * q_f[1] ** 2 - 1.0])):
        system = vm.System(rotating_frame, None, ring, constraint=constraint, params=2.0)
        seen = vm.Problem(system, [], [1.0, 0.0], [], [0.0, 0.5])
        np.testing.assert_allclose(seen.state().p_f, [0.0, 2.5])
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            run = vm.simulate(seen, vm.fully_implicit(1), macro_dt=0.01, num_steps=20)
        assert abs(run.energy - run.energy[0]).max() < 1e-4
