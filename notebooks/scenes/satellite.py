"""A satellite with two flexible booms in orbit: gravity gradient and orbit are slow, the booms vibrate fast.

Teaches: one scene from the orbit to the vibration; the momenta of the whole scene are kept to round-off.

    vmri simulate notebooks/scenes/satellite.py:scene --scheme explicit-slow --num-micro 10 --macro-dt 0.02 --steps 1000 --save-micro --out satellite.npz
    vmri animate satellite.npz --out satellite.png --frames 3 --to 4.2 --view=-90,50
"""

import numpy as np

from vmri_jax.scene import Bending, Body, NBodyGravity, RigidLink, Scene, Spring

PLANET, ORBIT = 1000.0, 10.0  # with G = 1 an orbit takes 2 pi seconds; the satellite is far larger than real ones
RATE = np.sqrt(PLANET / ORBIT**3)
TILT = 0.3  # rad, of the booms from the radial direction: they librate about it

radial = np.array([np.cos(TILT), np.sin(TILT), 0.0])
along = np.array([-np.sin(TILT), np.cos(TILT), 0.0])


def boom(name, side):
    """Root, middle and tip of a boom, turning with the orbit; the tip is bent out of the line and out of the plane."""
    bodies = []
    for part, distance, bent in (("root", 0.6, 0.0), ("middle", 1.3, 0.0), ("tip", 2.0, 0.1)):
        offset = side * distance * radial + bent * along + np.array([0.0, 0.0, bent])
        position = np.array([ORBIT, 0.0, 0.0]) + offset
        bodies.append(
            Body(f"{name} {part}", 0.05, position, np.cross([0.0, 0.0, RATE], position), pace="fast", radius=0.12)
        )
    return bodies


inner, outer = boom("inner", -1.0), boom("outer", 1.0)
satellite = ["hub", *(body.name for body in (*inner, *outer))]

scene = Scene(
    [
        Body("planet", PLANET, [0.0, 0.0, 0.0], pace="slow", radius=3.0),
        Body("hub", 3.0, [ORBIT, 0.0, 0.0], [0.0, ORBIT * RATE, 0.0], pace="slow", radius=0.3),
        *inner,
        *outer,
    ],
    [
        NBodyGravity(constant=1.0, between=[("planet", name) for name in satellite]),
        RigidLink([("hub", "inner root"), ("hub", "outer root")], name="mounts"),
        Bending(("inner root", "hub", "outer root"), 2.0, name="hinge"),
        Spring([(f"{a} root", f"{a} middle") for a in ("inner", "outer")], 500.0, 0.7, name="inner halves"),
        Spring([(f"{a} middle", f"{a} tip") for a in ("inner", "outer")], 500.0, 0.7, name="outer halves"),
        Bending([(f"{a} root", f"{a} middle", f"{a} tip") for a in ("inner", "outer")], 5.0, name="booms"),
    ],
)
