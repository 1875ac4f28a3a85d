# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
"""Mechanisms without loops in MuJoCo: hinges of a tree, and springs in them."""

from functools import partial

import mujoco
import numpy as np

from benchmarks.mechanisms.plane import GROUND, Mechanism
from benchmarks.peers import mujoco as peers
from benchmarks.peers.cases import NotRepresentable

INTEGRATORS = peers.INTEGRATORS | {"implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST}


def build(mechanism: Mechanism, integrator: str, num_steps: int):
    """A run that returns the centres (bars, 2) at the end.

    Raises:
        NotRepresentable: loops, which are soft in MuJoCo; springs and contacts that it does not know.
    """
    if not mechanism.is_tree or mechanism.coils or mechanism.contact:
        raise NotRepresentable("loops are soft constraints there")
    spec = peers.without_contacts()
    spec.option.gravity = [0.0, -mechanism.gravity, 0.0]
    hung = {hinge.b: hinge for hinge in mechanism.hinges}
    origin = {GROUND: np.zeros(2)} | {name: np.array(hinge.at) for name, hinge in hung.items()}
    made, rates = {GROUND: spec.worldbody}, []
    for name, one in mechanism.bars.items():
        pose, velocity = mechanism.start[name]
        hinge = hung.get(name)
        here = origin.setdefault(name, pose[:2])
        before = GROUND if hinge is None else hinge.a
        body = made[before].add_body(
            pos=[*(here - origin[before]), 0.0],
            mass=one.mass,
            ipos=[*(pose[:2] - here), 0.0],
            inertia=[one.moment] * 3,
            explicitinertial=True,
        )
        made[name] = body
        if hinge is None:
            for axis in np.eye(3)[:2]:
                body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
            rates += list(velocity[:2])
        body.add_joint(
            type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1], stiffness=[hinge.stiffness if hinge else 0.0, 0.0, 0.0]
        )
        rates.append(velocity[2] - (0.0 if before == GROUND else mechanism.start[before][1][2]))
    model = spec.compile()
    model.opt.integrator, model.opt.timestep = INTEGRATORS[integrator], mechanism.t_end / num_steps
    return partial(_run, model, mujoco.MjData(model), np.array(rates), num_steps)


def _run(model, data, rates, num_steps: int) -> np.ndarray:
    peers.step(model, data, rates, num_steps)
    return np.array(data.xipos[1:, :2])
