"""Mechanisms as scenes, by directors or in joint coordinates, and as plain functions of the coordinates chosen by
hand."""

import jax.numpy as jnp
import numpy as np

import vmri_jax as vm
from benchmarks.chains import Coordinates
from benchmarks.mechanisms.plane import GROUND, Mechanism
from vmri_jax.scene import (
    Body,
    Gravity,
    JointDrive,
    JointSpring,
    Potential,
    Prismatic,
    Revolute,
    RigidBody,
    Scene,
    Spring,
)


def steady(t, params):
    """A constant torque."""
    return params["torque"] * jnp.ones_like(t)


def scene(mechanism: Mechanism, coordinates: Coordinates) -> Scene:
    """In the plane z = 0; every body is a sphere in its moments, of which one counts."""
    bodies, effects = [], []
    for name, one in mechanism.bars.items():
        (x, y, angle), (v_x, v_y, rate) = mechanism.start[name]
        pace = "fast" if one.fast else "slow"
        at, velocity = [x, y, 0.0], [v_x, v_y, 0.0]
        if one.moment is None:
            bodies.append(Body(name, one.mass, at, velocity, pace=pace))
        else:
            turned: dict = {"rotation": [0.0, 0.0, angle], "spin": [0.0, 0.0, rate]}
            bodies.append(RigidBody(name, one.mass, [one.moment] * 3, at, velocity=velocity, pace=pace, **turned))
    for i, hinge in enumerate(mechanism.hinges):
        effects.append(Revolute((hinge.a, hinge.b), [*hinge.at, 0.0], [0.0, 0.0, 1.0], name=f"hinge {i}"))
        if hinge.stiffness:
            effects.append(JointSpring(f"hinge {i}", hinge.stiffness, name=f"hinge spring {i}"))
    for slide in mechanism.slides:
        place = mechanism.start[slide.body][0][:2]
        effects.append(Prismatic((GROUND, slide.body), [*place, 0.0], [*slide.axis, 0.0], name=f"{slide.body} slide"))
    for i, coil in enumerate(mechanism.coils):
        ends = (_end(mechanism, coil.a, coil.at_a), _end(mechanism, coil.b, coil.at_b))
        fast = all(body == GROUND or mechanism.bars[body].fast for body in (coil.a, coil.b))
        rate = "fast" if fast else "slow"
        effects.append(Spring(ends, coil.stiffness, coil.length, name=f"spring {i}", rate=rate))
    if mechanism.contact is not None:
        touching = mechanism.contact
        effects.append(Potential(touching.of_bodies, touching.bodies, touching.params))
    if mechanism.gravity:
        effects.append(Gravity([0.0, -mechanism.gravity, 0.0]))
    if mechanism.torque:
        effects.append(JointDrive("hinge 0", steady, {"torque": mechanism.torque}))
    return Scene(bodies, effects, project=True, redundant="drop", coordinates=coordinates)


def _end(mechanism: Mechanism, body: str, at):
    """A point of space as a scene takes it."""
    if body != GROUND and mechanism.bars[body].moment is None:
        return body
    return body, [*mechanism.local(body, at), 0.0]


def functions(mechanism: Mechanism) -> vm.Problem:
    """All coordinates by hand, all of them slow."""
    loops = mechanism.loops
    system = vm.System(
        lambda q_s, q_f, v_s, v_f, params: mechanism.kinetic(q_s, v_s),
        slow_potential=lambda q_s, q_f, params: mechanism.potential(mechanism.poses(q_s)),
        slow_constraint=None if loops is None else lambda q_s, params: loops(q_s),
        force=(lambda t, q_s, q_f, v_s, v_f, params: (mechanism.drive(q_s), jnp.zeros(0)))
        if mechanism.torque
        else None,
    )
    return vm.Problem(system, mechanism.q, np.zeros(0), mechanism.v, project=True)
