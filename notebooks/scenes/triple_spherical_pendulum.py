"""A heavy bob on a rod (slow), from it a hook on a rod and a load on a stiff spring (fast).

Teaches: the scene finds from masses and stiffness which bodies are slow and which are fast; rods of both are kept to round-off.

    vmri simulate notebooks/scenes/triple_spherical_pendulum.py:scene --num-micro 5 --macro-dt 0.02 --steps 1000 --save-micro --out triple_spherical_pendulum.npz
    vmri animate triple_spherical_pendulum.npz --out triple_spherical_pendulum.png --frames 3
"""

from vmri_jax.scene import Anchor, Body, Gravity, RigidLink, Scene, Spring

scene = Scene(
    [
        Body("bob", 100.0, [10.0, 0.0, 0.0], [0.0, 1.0, 0.0], radius=0.9),
        Body("hook", 1.0, [10.0, 2.0, 0.0], [0.0, 1.0, 0.0], radius=0.4),
        Body("load", 1.0, [10.0, 2.0, 3.0], [0.0, 1.0, 0.5], radius=0.4),
    ],
    [
        Gravity(9.81),
        Anchor("bob", [0.0, 0.0, 0.0], 10.0),
        RigidLink(("bob", "hook"), 2.0),
        Spring(("hook", "load"), 5000.0, 3.0),
    ],
)
