"""Bodies on points whose motion is given: a pendulum below a cart that is moved, in three ways, against the same by
hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.steppers import test_rheonomic as by_hand
from vmri_jax import State
from vmri_jax.mechanics.motion import motion
from vmri_jax.mechanics.projection import legendre
from vmri_jax.scene import Body, Constraint, Gravity, Guide, MovingPivot, RigidLink, Scene

PARAMS = by_hand.PARAMS


def cart(t, params):
    return jnp.stack([by_hand.pivot(t, params), jnp.zeros_like(t)])


def level(t, q, params):
    return q[0] - cart(t, params)


def below_a_cart(hold) -> Scene:
    """A cart and a bob, each held by what is given."""
    bodies = [
        Body("cart", 3.0, [PARAMS["amplitude"], 0.0], pace="slow"),
        Body("bob", 1.0, [PARAMS["amplitude"], -by_hand.LENGTH], [0.4, 0.0], pace="fast"),
    ]
    return Scene(bodies, [Gravity(by_hand.G, "bob"), *hold])


WAYS = {
    "guided cart": [Guide("cart", cart, PARAMS), RigidLink(("cart", "bob"))],
    "custom constraint": [Constraint(level, "cart", PARAMS, timed=True), RigidLink(("cart", "bob"))],
    "moving pivot": [MovingPivot("bob", cart, params=PARAMS)],
}


TIME, ANGLE, SPIN = 0.4, 0.7, 1.3
"""Of the state at which accelerations are compared, and the angle and the angular velocity of the bob."""


def motion_of(system, q_s, v_s):
    """Constraints, their rates, and the motion by the continuous equations, where the bob swings on the moved pivot."""
    x, rate = (float(value) for value in jax.jit(jax.value_and_grad(by_hand.pivot))(TIME, PARAMS))
    out, along = (np.array([np.sin(ANGLE), -np.cos(ANGLE)]), np.array([np.cos(ANGLE), np.sin(ANGLE)]))
    bob = by_hand.LENGTH * out + [x, 0.0], by_hand.LENGTH * SPIN * along + [rate, 0.0]
    start = q_s(x), bob[0], v_s(rate), bob[1]
    return moved(system, *start)


@jax.jit
def moved(system, *start):
    """Constraints and their rates, and the motion by the continuous equations."""
    held = system.constraints(TIME, *start[:2]), system.constraint_rates(TIME, *start)
    return held, motion(system, State(jnp.asarray(TIME), *start[:2], *legendre(system, *start)))


@pytest.mark.parametrize("way", WAYS)
def test_same_as_by_hand(way):
    """Runs of the systems by hand are in `tests/steppers/test_rheonomic.py`."""
    moves = way != "moving pivot"  # the cart, which otherwise rests where it starts
    at = PARAMS["amplitude"]
    name = "cart that is moved" if moves else "pivot that is moved"
    held, ours = motion_of(
        below_a_cart(WAYS[way]).system(),
        lambda x: np.array([x if moves else at, 0.0]),
        lambda v: np.array([v if moves else 0.0, 0.0]),
    )
    _, theirs = motion_of(
        by_hand.SYSTEMS[name], lambda x: np.array([x if moves else 0.0]), lambda v: np.array([v if moves else 0.0])
    )
    for rows in held:
        np.testing.assert_allclose(rows, 0.0, atol=1e-13)
    np.testing.assert_allclose(ours.a_f, theirs.a_f, rtol=1e-12)
    if moves:
        np.testing.assert_allclose(ours.a_s, [theirs.a_s[0], 0.0], rtol=1e-12, atol=1e-12)


def test_other_numbers_compile_nothing_again():
    scene, other = (below_a_cart([MovingPivot("bob", cart, params=PARAMS | {"frequency": w})]) for w in (4.0, 5.0))
    assert scene.system().constraint == other.system().constraint
