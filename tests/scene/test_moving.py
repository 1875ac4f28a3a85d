"""Bodies on points whose motion is given: a pendulum below a cart that is moved, in three ways, against the same by hand."""

import jax.numpy as jnp
import numpy as np
import pytest

from tests.steppers import test_rheonomic as by_hand
from vmri_jax import fully_implicit, simulate
from vmri_jax.scene import Body, Constraint, Gravity, Guide, MovingPivot, RigidLink, Scene

PARAMS = by_hand.PARAMS
STEP = {"macro_dt": 0.05, "num_steps": 20}


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
    "guided cart": [Guide("cart", cart, params=PARAMS), RigidLink(("cart", "bob"))],
    "custom constraint": [Constraint(level, "cart", PARAMS, timed=True), RigidLink(("cart", "bob"))],
    "moving pivot": [MovingPivot("bob", cart, params=PARAMS)],
}


@pytest.mark.parametrize("way", WAYS)
def test_same_as_by_hand(way):
    scene = below_a_cart(WAYS[way])
    run = simulate(scene.system(), fully_implicit(3), scene.state(), **STEP)
    name = "pivot that is moved" if way == "moving pivot" else "cart that is moved"
    expected = by_hand.run(by_hand.SYSTEMS[name], fully_implicit(3), STEP["num_steps"])
    assert np.abs(run.q_f - expected.q_f).max() < 1e-12
    assert run.constraint_residual.max() < 1e-13
    if way != "moving pivot":
        assert np.abs(run.q_s[:, 0] - by_hand.pivot(run.t, PARAMS)).max() < 1e-15


def test_other_numbers_compile_nothing_again():
    scene, other = (below_a_cart([MovingPivot("bob", cart, params=PARAMS | {"frequency": w})]) for w in (4.0, 5.0))
    assert scene.system().constraint == other.system().constraint
