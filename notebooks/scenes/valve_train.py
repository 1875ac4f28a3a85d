"""Two valves driven by a cam, the cam by a chain from the crank: the chain is slow, the valves are fast and damped.

Teaches: a custom constraint, force and potential; work of a drive against losses.

    vmri simulate notebooks/scenes/valve_train.py:scene --num-micro 10 --macro-dt 0.01 --steps 1000 --save-micro --out valve_train.npz
    vmri animate valve_train.npz --out valve_train.png --frames 3
"""

import jax.numpy as jnp

from vmri_jax.scene import Anchor, Body, Constraint, Force, LinearDamping, Potential, Scene, Spring, SpringAnchor

SPEED = 5.0  # rad/s
CRANK = jnp.array([0.0, -3.0])  # the camshaft is at the origin, pins go round both at distance 1


def tension(q, params):
    """The chain keeps the pins of crank and cam at the same angle, elastically."""
    crank, cam = q
    return params["stiffness"] / 2 * jnp.sum((crank - params["center"] - cam) ** 2)


def lobe(q, params):
    """A tappet rides on the cam: it is out by the lift where the pin points at it."""
    cam, tappet = q
    lift = params["lift"] * jnp.exp(6.0 * (params["side"] * cam[0] - 1.0))
    return tappet - params["side"] * (1.5 + lift)


def engine(t, q, v, params):
    """Torque that holds the speed of the crank."""
    (arm,), (velocity,) = q, v
    arm = arm - params["center"]
    tangent = jnp.array([-arm[1], arm[0]])
    return (params["gain"] * (params["speed"] - jnp.sum(tangent * velocity)) * tangent,)


def valve(name, side):
    """A tappet on the cam, a valve at the end of a stiff rod, a spring that pushes it back; all on one line."""
    start = 1.5 + 0.8 * float(jnp.exp(-6.0))
    bodies = [
        Body(f"{name} tappet", 0.05, side * start, pace="fast"),
        Body(f"{name} valve", 0.1, side * (start + 2), pace="fast"),
    ]
    effects = [
        Constraint(lobe, ("cam", f"{name} tappet"), {"side": side, "lift": 0.8}, name=f"{name} lobe"),
        Spring((f"{name} tappet", f"{name} valve"), 4000.0, 2.0, name=f"{name} rod"),
        SpringAnchor(f"{name} valve", side * 6.5, 40.0, 3.5, name=f"{name} spring"),
    ]
    return bodies, effects


(left, on_left), (right, on_right) = valve("left", -1.0), valve("right", 1.0)
scene = Scene(
    [
        Body("crank", 4.0, CRANK + jnp.array([0.0, 1.0]), [-SPEED, 0.0], pace="slow"),
        Body("cam", 2.0, [0.0, 1.0], [-SPEED, 0.0], pace="slow"),
        *left,
        *right,
    ],
    [
        Anchor(["crank", "cam"], [CRANK, [0.0, 0.0]], name="bearings"),
        Potential(tension, ("crank", "cam"), {"stiffness": 200.0, "center": CRANK}, name="chain", drawn_as="spring"),
        Force(engine, "crank", {"gain": 4.0, "speed": SPEED, "center": CRANK}),
        *on_left,
        *on_right,
        LinearDamping(1.0, ["left valve", "right valve"]),
    ],
    project=True,  # the tappets move with the cams from the start
)
