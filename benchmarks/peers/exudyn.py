# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
"""Exudyn: trapezoidal rule with constraints at velocity level, and generalized-alpha."""

from typing import Any

import exudyn as exu
import numpy as np
from exudyn import itemInterface as items

from benchmarks.peers.cases import Case, Ladder, steps_ladder

SOLVERS = {
    "trapezoidal index 2": exu.DynamicSolverType.TrapezoidalIndex2,
    "generalized-alpha": exu.DynamicSolverType.GeneralizedAlpha,
}
DENSE = 60
"""Up to so many coordinates a dense solver is faster than a sparse one."""
NEWTON = {"relativeTolerance": 1e-10, "absoluteTolerance": 1e-12}
"""Tight enough not to be seen in the errors."""
SPECTRAL_RADIUS = 0.9
"""Of generalized-alpha, its default: 1 would not damp, but constraints at position level need less."""


def ladders(case: Case) -> list[Ladder]:
    """Solvers; numbers of steps."""

    def ladder(name: str) -> Ladder:
        def build(num_steps: int):
            mbs, nodes, _ = prepare(case)
            settings = settings_of(case.t_end, num_steps, case.q.size)

            def run():
                return positions(mbs, nodes) if solved(mbs, settings, name) else np.full(case.q.size, np.nan)

            return run

        return steps_ladder(case, name, build, first=8.0)

    return [ladder(name) for name in SOLVERS]


def prepare(case: Case):
    """The assembled system, its nodes, and the potentials of its springs."""
    exu.SetWriteToConsole(False)
    mbs: Any = exu.SystemContainer().AddSystem()
    nodes, springs = _particles(case, mbs)
    mbs.Assemble()
    return mbs, nodes, springs


def positions(mbs, nodes) -> np.ndarray:
    """Of all nodes, at the end of the last solution."""
    return np.concatenate([mbs.GetNodeOutput(node, exu.OutputVariableType.CoordinatesTotal) for node in nodes])


def energy(case: Case) -> float:
    """Of the start, from Exudyn's nodes and lengths of the springs."""
    mbs, nodes, springs = prepare(case)
    values = [mbs.GetNodeOutput(node, exu.OutputVariableType.Coordinates_t) for node in nodes]
    masses = np.array(case.particles.masses)
    kinetic = sum(m / 2 * np.dot(v, v) for m, v in zip(masses, values, strict=True))
    weight = case.particles.gravity * float(masses @ positions(mbs, nodes)[2::3])
    return float(kinetic + weight + sum(potential(mbs) for potential in springs))


def solved(mbs, settings, name: str) -> bool:
    """Whether the solver with this name got to the end."""
    try:
        mbs.SolveDynamic(settings, solverType=SOLVERS[name], storeSolver=False, showCausingItems=False)
    except (ValueError, RuntimeError):  # the solver gave up
        return False
    return True


def settings_of(t_end: float, num_steps: int, coordinates: int):
    """Settings of a run of this length of a system with this number of coordinates."""
    settings = exu.SimulationSettings()
    time = settings.timeIntegration
    time.endTime, time.numberOfSteps, time.verboseMode, time.adaptiveStep = t_end, num_steps, 0, False
    for name, value in NEWTON.items():
        setattr(time.newton, name, value)
    time.newton.useModifiedNewton = True
    time.generalizedAlpha.spectralRadius = SPECTRAL_RADIUS
    settings.solutionSettings.writeSolutionToFile = False
    settings.solutionSettings.sensorsWritePeriod = t_end
    kinds = exu.LinearSolverType
    settings.linearSolverType = kinds.EXUdense if coordinates <= DENSE else kinds.EigenSparse
    settings.displayStatistics = settings.displayComputationTime = False
    settings.displayGlobalTimers = False
    return settings


def _particles(case: Case, mbs):
    """Mass points, springs and rods."""
    p = case.particles
    markers, nodes = [], []
    for q, v, m in zip(case.q.reshape(-1, 3), case.v.reshape(-1, 3), p.masses, strict=True):
        node = mbs.AddNode(items.NodePoint(referenceCoordinates=q, initialVelocities=v))
        body = mbs.AddObject(items.MassPoint(physicsMass=m, nodeNumber=node))
        markers.append(mbs.AddMarker(items.MarkerBodyPosition(bodyNumber=body)))
        mass = mbs.AddMarker(items.MarkerBodyMass(bodyNumber=body))
        mbs.AddLoad(items.LoadMassProportional(markerNumber=mass, loadVector=[0, 0, -p.gravity]))
        nodes.append(node)
    markers.append(mbs.AddMarker(items.MarkerBodyPosition(bodyNumber=mbs.AddObject(items.ObjectGround()))))  # number -1
    springs = []
    for i, j, k, length in p.springs:
        spring = items.ObjectConnectorSpringDamper(
            markerNumbers=[markers[i], markers[j]], referenceLength=length, stiffness=k
        )
        springs.append(_potential(mbs.AddObject(spring), k, length))
    for i, j, length in p.rods:
        mbs.AddObject(items.ObjectConnectorDistance(markerNumbers=[markers[i], markers[j]], distance=length))
    return nodes, springs


def _potential(item, stiffness: float, length: float):
    """Potential of a spring from its length as Exudyn gives it."""
    distance = exu.OutputVariableType.Distance
    return lambda mbs: stiffness / 2 * (mbs.GetObjectOutput(item, distance) - length) ** 2
