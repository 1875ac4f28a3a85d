# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
"""Mechanisms in Exudyn: bodies in the plane, joints as constraints, springs and a torque."""

from functools import partial
from typing import Any

import exudyn as exu
import numpy as np
from exudyn import itemInterface as items

from benchmarks.mechanisms.plane import GROUND, Mechanism
from benchmarks.peers.cases import NotRepresentable
from benchmarks.peers.exudyn import settings_of, solved


def build(mechanism: Mechanism, solver: str, num_steps: int):
    """A run that returns the centres (bars, 2) at the end.

    Raises:
        NotRepresentable: a contact.
    """
    if mechanism.contact is not None:
        raise NotRepresentable("the cam is a potential of its own")
    mbs, nodes = _assemble(mechanism)
    return partial(_run, mbs, nodes, settings_of(mechanism.t_end, num_steps, 3 * len(mechanism.bars)), solver)


def _run(mbs, nodes, settings, solver: str) -> np.ndarray:
    if not solved(mbs, settings, solver):
        return np.full((len(nodes), 2), np.nan)
    return np.array([mbs.GetNodeOutput(node, exu.OutputVariableType.CoordinatesTotal)[:2] for node in nodes])


def _assemble(mechanism: Mechanism):
    """The system and its nodes."""
    exu.SetWriteToConsole(False)
    mbs: Any = exu.SystemContainer().AddSystem()
    bodies, nodes = {GROUND: mbs.AddObject(items.ObjectGround(referencePosition=[0, 0, 0]))}, {}
    for name, one in mechanism.bars.items():
        pose, velocity = mechanism.start[name]
        node = items.NodeRigidBody2D(referenceCoordinates=pose.tolist(), initialVelocities=velocity.tolist())
        nodes[name] = mbs.AddNode(node)
        body = items.ObjectRigidBody2D(physicsMass=one.mass, physicsInertia=one.moment, nodeNumber=nodes[name])
        bodies[name] = mbs.AddObject(body)
        if mechanism.gravity:
            mass = mbs.AddMarker(items.MarkerBodyMass(bodyNumber=bodies[name]))
            mbs.AddLoad(items.LoadMassProportional(markerNumber=mass, loadVector=[0, -mechanism.gravity, 0]))

    def marker(body: str, at, kind=items.MarkerBodyPosition):
        local = [*mechanism.local(body, at).tolist(), 0.0]
        return mbs.AddMarker(kind(bodyNumber=bodies[body], localPosition=local))

    def turning(body: str):
        return mbs.AddMarker(items.MarkerNodeCoordinate(nodeNumber=nodes[body], coordinate=2))

    for hinge in mechanism.hinges:
        pair = [marker(body, hinge.at) for body in (hinge.a, hinge.b)]
        mbs.AddObject(items.ObjectJointRevolute2D(markerNumbers=pair))
        if hinge.stiffness:  # at rest where both angles are as at the start, from which nodes count
            pair = [turning(hinge.a), turning(hinge.b)]
            mbs.AddObject(items.ObjectConnectorCoordinateSpringDamper(markerNumbers=pair, stiffness=hinge.stiffness))
    for coil in mechanism.coils:
        ends = [marker(coil.a, coil.at_a), marker(coil.b, coil.at_b)]
        mbs.AddObject(
            items.ObjectConnectorSpringDamper(
                markerNumbers=ends, stiffness=coil.stiffness, damping=0.0, referenceLength=coil.length
            )
        )
    if mechanism.torque:
        first = mechanism.hinges[0]
        shaft = marker(first.b, first.at, items.MarkerBodyRigid)
        mbs.AddLoad(items.LoadTorqueVector(markerNumber=shaft, loadVector=[0, 0, mechanism.torque]))
    mbs.Assemble()
    return mbs, list(nodes.values())
