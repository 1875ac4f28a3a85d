"""The reference systems as scenes."""

import jax.numpy as jnp
import numpy as np

from vmri_jax.scene import Anchor, Body, Gravity, Potential, RigidLink, Scene, Spring


def soft_springs(q, params):
    """Quartic springs between the stiff ones, in scaled centres s and elongations f."""
    s, f = q
    wall = jnp.zeros(1)
    left, right = jnp.concatenate([wall, s + f]), jnp.concatenate([s - f, wall])
    return jnp.sum((right - left) ** 4) / 4


def stiff_springs(q, params):
    """Linear springs in their elongations."""
    (f,) = q
    return params["omega"] ** 2 / 2 * jnp.sum(f**2)


def fermi_pasta_ulam(num_springs=3, omega=50.0) -> Scene:
    """Two blocks of general coordinates and two functions."""
    first = np.eye(num_springs)[0]
    return Scene(
        [Body("centres", 1.0, first, first, pace="slow"), Body("elongations", 1.0, first / omega, first, pace="fast")],
        [
            Potential(soft_springs, ("centres", "elongations")),
            Potential(stiff_springs, "elongations", {"omega": omega}),
        ],
    )


def triple_spherical_pendulum() -> Scene:
    """Three points; who is slow and who is fast is left to the scene."""
    return Scene(
        [
            Body("bob", 100.0, [10.0, 0.0, 0.0], [0.0, 1.0, 0.0]),
            Body("hook", 1.0, [10.0, 2.0, 0.0], [0.0, 1.0, 0.0]),
            Body("load", 1.0, [10.0, 2.0, 3.0], [0.0, 1.0, 0.5]),
        ],
        [
            Gravity(9.81),
            Anchor("bob", [0.0, 0.0, 0.0], 10.0),
            RigidLink(("bob", "hook"), 2.0),
            Spring(("hook", "load"), 5000.0, 3.0),
        ],
    )


def simple_atomic_model(length=10.0) -> Scene:
    """Six atoms, heavy ones slow and light ones fast."""
    radius, inradius, height = length * np.sqrt(np.array([1 / 3, 1 / 12, 2 / 3]))
    top = -2 * length - height
    positions = {
        "1": [0.0, 0.0, -length],
        "2": [0.0, 0.0, -2 * length],
        "3": [radius, 0.0, top],
        "4": [-inradius, length / 2, top],
        "5": [-inradius, -length / 2, top],
        "6": [radius, 0.0, top - length],
    }
    velocities = [[0, 0.5, 0], [0.3, 0.2, 0.1], [0, 0.4, 0.2], [-0.5, 0.2, 0.3], [0.2, -0.6, 0.4], [0.7, 0.1, 0.2]]
    masses = [100.0, 40.0, 1.0, 1.0, 1.0, 1.0]
    return Scene(
        [
            Body(name, mass, positions[name], velocity, pace="slow" if name in "12" else "fast")
            for name, mass, velocity in zip(positions, masses, velocities, strict=True)
        ],
        [
            Spring(("1", "2"), 10.0, length, name="soft 1-2"),
            Spring(("2", "3"), 1.0, length, name="soft 2-3"),
            Gravity(9.81),
            Spring([("3", "4"), ("4", "5"), ("5", "3")], 4000.0, length, name="stiff"),
            RigidLink([("2", "4"), ("2", "5"), ("3", "6")], length),
            Anchor("1", [0.0, 0.0, 0.0], length),
        ],
    )
