"""A slow oscillator coupled to three fast ones of 50, 70 and 5000 rad/s, the last far below any micro step.

Teaches: the implicit scheme steps over what is too fast to resolve, here by a factor of 100, and keeps the actions
(energy over frequency) of what it resolves.

    vmri simulate notebooks/scenes/three_scales.py:scene --num-micro 5 --macro-dt 0.1 --steps 1000 --save-micro --out three_scales.npz
    vmri animate three_scales.npz --out three_scales.png --frames 2 --to 9
"""

import numpy as np

from vmri_jax.scene import Body, Potential, Scene, SpringAnchor

FREQUENCIES = {"50 rad/s": 50.0, "70 rad/s": 70.0, "5000 rad/s": 5000.0}
PLACES = np.array([2.0, 4.0, 6.0, 8.0])  # of the four masses at rest, each at the end of a spring of length 1


def coupling(q, params):
    """A soft quartic spring between all elongations."""
    elongation = sum(position[0] - rest for position, rest in zip(q, PLACES, strict=True))
    return params["stiffness"] / 4 * elongation**4


def oscillator(name, place, frequency, elongation, pace):
    """A mass on a spring: kg, N/m."""
    body = Body(name, 1.0, place + elongation, pace=pace, radius=0.15)
    return body, SpringAnchor(name, place - 1.0, frequency**2, 1.0, name=f"{name} spring")


slow = oscillator("slow", PLACES[0], 1.0, 0.5, "slow")
fast = [
    oscillator(name, place, frequency, 1.0 / frequency, "fast")
    for place, (name, frequency) in zip(PLACES[1:], FREQUENCIES.items(), strict=True)
]
bodies, springs = zip(slow, *fast, strict=True)
scene = Scene(bodies, [*springs, Potential(coupling, [body.name for body in bodies], {"stiffness": 1.0})])
