"""Two pendulums that stand upside down, because their pivots vibrate fast: Kapitza's pendulum, single and double.

Teaches: a body whose motion is given, `Guide`, is a constraint that depends on time, and does work on the pendulum.

    vmri simulate notebooks/scenes/upright_pendulum.py:scene --scheme fully-explicit --num-micro 10 --macro-dt 0.01 --steps 1000 --save-micro --out upright_pendulum.npz
    vmri animate upright_pendulum.npz --out upright_pendulum.png --frames 3 --to 1.25
"""

import jax.numpy as jnp

from vmri_jax.scene import Body, Gravity, Guide, LinearDamping, RigidLink, Scene

SHAKER = {"amplitude": 0.05, "frequency": 200.0}  # m, rad/s


def shaken(t, params):
    """A pivot that vibrates up and down."""
    return jnp.stack([params["x"], params["amplitude"] * jnp.cos(params["frequency"] * t)])


def pivot(name, x):
    """A pivot at x and what moves it."""
    body = Body(name, 1.0, [x, SHAKER["amplitude"]], pace="fast", radius=0.04)
    return body, Guide(name, shaken, params={**SHAKER, "x": x}, name=f"{name} shaker")


(left, moves_left), (right, moves_right) = pivot("left", -0.5), pivot("right", 0.5)
scene = Scene(
    [
        left,
        Body("bob", 1.0, [-0.3, 0.55], pace="fast"),
        right,
        Body("lower", 1.0, [0.55, 0.35], pace="fast"),
        Body("upper", 0.5, [0.5, 0.6], pace="fast"),
    ],
    [
        Gravity(9.81, ["bob", "lower", "upper"]),
        moves_left,
        moves_right,
        RigidLink([("left", "bob"), ("right", "lower"), ("lower", "upper")]),
        LinearDamping(0.2, ["bob", "lower", "upper"]),
    ],
)
