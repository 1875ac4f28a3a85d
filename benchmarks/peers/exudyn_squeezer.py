# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
"""Andrews' squeezer in Exudyn: seven bodies in the plane, ten joints, a spring and a torque."""

from typing import Any

import exudyn as exu
import numpy as np
from exudyn import itemInterface as items

SOLVERS = {
    "trapezoidal index 2": exu.DynamicSolverType.TrapezoidalIndex2,
    "generalized-alpha": exu.DynamicSolverType.GeneralizedAlpha,
}


def angles(data: dict, t_end: float, num_steps: int, solver: str) -> np.ndarray:
    """The seven angles at the end.

    Args:
        data: of the file of the scene.
        t_end, num_steps: of the run.
        solver: one of `SOLVERS`.
    """
    mbs, nodes = _prepare(data)
    settings = exu.SimulationSettings()
    stepping = settings.timeIntegration
    stepping.endTime, stepping.numberOfSteps, stepping.verboseMode = t_end, num_steps, 0
    stepping.newton.relativeTolerance, stepping.newton.absoluteTolerance = 1e-10, 1e-12
    settings.solutionSettings.writeSolutionToFile = False
    settings.solutionSettings.sensorsWritePeriod = t_end
    mbs.SolveDynamic(settings, solverType=SOLVERS[solver], storeSolver=False, showCausingItems=False)
    turned = [mbs.GetNodeOutput(node, exu.OutputVariableType.Coordinates)[2] for node in nodes]
    at = np.array(data["angles"]) + turned
    return np.array([at[0], at[1] - at[0], at[2], at[3] - at[4], at[4], at[5] - at[6], at[6]])


def _prepare(data: dict):
    """The assembled system and its nodes."""
    exu.SetWriteToConsole(False)
    mbs: Any = exu.SystemContainer().AddSystem()
    ground = mbs.AddObject(items.ObjectGround(referencePosition=[0, 0, 0]))
    nodes, bodies = [], {"ground": ground}
    places = {"ground": (np.zeros(2), 0.0)}
    bars = zip(data["MASSES"], data["MOMENTS"], data["centres"], data["angles"], strict=True)
    for k, (mass, moment, centre, angle) in enumerate(bars):
        node = mbs.AddNode(items.NodeRigidBody2D(referenceCoordinates=[*centre, angle], initialVelocities=[0, 0, 0]))
        body = items.ObjectRigidBody2D(physicsMass=mass, physicsInertia=moment, nodeNumber=node)
        nodes.append(node)
        bodies[f"K{k + 1}"], places[f"K{k + 1}"] = mbs.AddObject(body), (np.asarray(centre), angle)

    def local(body: str, point) -> list[float]:
        centre, angle = places[body]
        x, y = np.asarray(point) - centre
        return [x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle), 0.0]

    def marker(body: str, at: list[float], kind=items.MarkerBodyPosition):
        return mbs.AddMarker(kind(bodyNumber=bodies[body], localPosition=at))

    for pair, point in data["JOINTS"].items():
        mbs.AddObject(items.ObjectJointRevolute2D(markerNumbers=[marker(body, local(body, point)) for body in pair]))
    end = [data["SD"] - data["SB"], data["SA"] - data["SC"], 0.0]
    ends = [marker("K3", end), marker("ground", [*data["C"], 0.0])]
    stiffness, length = data["STIFFNESS"], data["LENGTH"]
    mbs.AddObject(
        items.ObjectConnectorSpringDamper(markerNumbers=ends, stiffness=stiffness, damping=0.0, referenceLength=length)
    )
    shaft = marker("K1", local("K1", [0.0, 0.0]), items.MarkerBodyRigid)
    mbs.AddLoad(items.LoadTorqueVector(markerNumber=shaft, loadVector=[0, 0, data["TORQUE"]]))
    mbs.Assemble()
    return mbs, nodes
