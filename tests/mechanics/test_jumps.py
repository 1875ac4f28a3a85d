"""Forces that jump are found ahead of a state, and named where a run fails; steep and smooth ones are not."""

import jax.numpy as jnp
import pytest

import vmri_jax as vm
from vmri_jax.mechanics.jumps import in_words, jump_ahead

LOAD = 3.0  # N, of the friction


def dry(t, q_s, q_f, v_s, v_f, params):
    return -LOAD * jnp.sign(v_s), 0 * v_f


def dry_in_the_plane(t, q_s, q_f, v_s, v_f, params):
    """With a pull across, so that the way ahead passes beside zero."""
    return -LOAD * v_s / jnp.linalg.norm(v_s) + jnp.array([1.0, 0.0]), 0 * v_f


def switched(t, q_s, q_f, v_s, v_f, params):
    return jnp.where(t > 0.007, 1.0, 2.0) * jnp.ones_like(v_s), 0 * v_f


def far_away(q_s, q_f, params):
    """A smooth force whose positions differ by single digits of round-off on the way ahead."""
    return jnp.sum((q_s + 1e14) ** 2)


@pytest.mark.parametrize(
    ("terms", "velocity", "expected"),
    [
        ({"force": dry}, [0.01], (3.0, True)),
        ({"force": dry}, [0.01, 5.0], (3.0, True)),
        ({"force": dry_in_the_plane}, [0.0, -0.02], (3.0, True)),
        ({"force": switched}, [0.3], (0.5, False)),
        ({"slow_potential": lambda q_s, q_f, params: jnp.abs(q_s[0] - 0.001)}, [0.3], (1.0, False)),
        ({"force": dry}, [5.0], None),  # it does not stop within the time
        ({"force": lambda t, q_s, q_f, v_s, v_f, params: (-LOAD * jnp.tanh(v_s / 0.02), 0 * v_f)}, [0.01], None),
        ({"slow_potential": far_away}, [0.3], None),
    ],
)
def test_jumps_ahead(terms, velocity, expected):
    n = len(velocity)
    system = vm.System(vm.ConstantMass([1.0] * n, []), **terms)
    start = vm.initial_state(system, [0.0] * n, [], velocity, [])
    jump = jump_ahead(system, start, 0.02)
    if expected is None:
        assert jump is None
        assert in_words(jump, vm.Names()) == ""
    else:
        assert jump is not None
        assert abs(jump.behind - jump.before) / 2 == pytest.approx(expected[0], rel=1e-3)
        assert jump.reverses == expected[1]


def test_a_run_with_dry_friction_names_it():
    system = vm.System(vm.ConstantMass([1.0], []), force=dry)
    block = vm.Problem(system, [0.0], [], [0.1], [], names=vm.Names(slow={"block": 1}))
    with pytest.raises(vm.SimulationError, match="STAGNATED") as caught:
        vm.simulate(block, vm.fully_implicit(1), macro_dt=0.01, num_steps=10, solver=vm.Solver("masses"))
    first = caught.value.__notes__[0]
    assert (
        "The likely cause: the force on block jumps from -3 to 3 just ahead, where the velocity of block passes"
        in first
    )
    assert "f tanh(v / eps)" in first
    assert "sticking is out of scope" in first
