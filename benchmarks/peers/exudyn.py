# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
"""Exudyn: trapezoidal rule with constraints at velocity level, generalized-alpha, and RK67 for the chain."""

from typing import Any

import exudyn as exu
import numpy as np
from exudyn import itemInterface as items
from exudyn.advancedUtilities import CreateSymbolicUserFunction

from benchmarks.peers.cases import Case, Ladder, steps_ladder
from benchmarks.peers.mechanics import from_masses, to_masses

SOLVERS = {
    "RK67": exu.DynamicSolverType.RK67,
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
                return positions(case, mbs, nodes) if solved(mbs, settings, name) else np.full(case.q.size, np.nan)

            return run

        return steps_ladder(case, name, build, first=8.0)

    return [ladder(name) for name in SOLVERS if case.is_chain or name != "RK67"]


def prepare(case: Case):
    """The assembled system, its nodes, and the potentials of its springs."""
    exu.SetWriteToConsole(False)
    mbs: Any = exu.SystemContainer().AddSystem()
    nodes, springs = (_chain if case.is_chain else _particles)(case, mbs)
    mbs.Assemble()
    return mbs, nodes, springs


def positions(case: Case, mbs, nodes) -> np.ndarray:
    """Of the case, slow ones first, at the end of the last solution."""
    x = [np.atleast_1d(mbs.GetNodeOutput(node, exu.OutputVariableType.CoordinatesTotal)) for node in nodes]
    return (from_masses if case.is_chain else np.asarray)(np.concatenate(x))


def energy(case: Case) -> float:
    """Of the start, from Exudyn's nodes and lengths of the springs."""
    mbs, nodes, springs = prepare(case)
    values = [mbs.GetNodeOutput(node, exu.OutputVariableType.Coordinates_t) for node in nodes]
    masses = np.ones(len(nodes)) if case.is_chain else np.array(case.particles.masses)
    kinetic = sum(m / 2 * np.dot(v, v) for m, v in zip(masses, values, strict=True))
    if not case.is_chain:
        heights = positions(case, mbs, nodes)[2::3]
        kinetic += case.particles.gravity * float(masses @ heights)
    return float(kinetic + sum(potential(mbs) for potential in springs))


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


def _chain(case: Case, mbs):
    """Its masses on a line; symbolic functions for the quartic springs are evaluated without Python."""
    markers, nodes = [], []
    for x, v in zip(to_masses(case.q), to_masses(case.v), strict=True):
        node = mbs.AddNode(items.Node1D(referenceCoordinates=[0.0], initialCoordinates=[x], initialVelocities=[v]))
        mbs.AddObject(items.Mass1D(physicsMass=1.0, nodeNumber=node))
        markers.append(mbs.AddMarker(items.MarkerNodeCoordinate(nodeNumber=node, coordinate=0)))
        nodes.append(node)
    ground = mbs.AddNode(items.NodePointGround())
    wall = mbs.AddMarker(items.MarkerNodeCoordinate(nodeNumber=ground, coordinate=0))
    pairs = [(wall, markers[0]), *zip(markers[1:-1:2], markers[2:-1:2], strict=True), (markers[-1], wall)]
    stiffness = case.omega**2 / 2
    springs, mbs.variables["forces"] = [], []
    for pair in zip(markers[::2], markers[1::2], strict=True):
        item = mbs.AddObject(items.ObjectConnectorCoordinateSpringDamper(markerNumbers=list(pair), stiffness=stiffness))
        springs.append(_potential(item, lambda d: stiffness / 2 * d**2))
    for pair in pairs:
        item = mbs.AddObject(items.ObjectConnectorCoordinateSpringDamper(markerNumbers=list(pair)))
        function = CreateSymbolicUserFunction(mbs, _cubic, "springForceUserFunction", item)
        mbs.SetObjectParameter(item, "springForceUserFunction", function)
        mbs.variables["forces"].append(function)  # Exudyn does not keep it alive
        springs.append(_potential(item, lambda d: d**4))
    return nodes, springs


def _cubic(mbs, t, itemNumber, displacement, velocity, stiffness, damping, offset):
    return 4.0 * displacement * displacement * displacement


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
        springs.append(_potential(mbs.AddObject(spring), lambda d, k=k, r=length: k / 2 * (d - r) ** 2, "Distance"))
    for i, j, length in p.rods:
        mbs.AddObject(items.ObjectConnectorDistance(markerNumbers=[markers[i], markers[j]], distance=length))
    return nodes, springs


def _potential(item, function, output: str = "Displacement"):
    """Potential of a spring from its length or elongation, as Exudyn gives it."""
    variable = getattr(exu.OutputVariableType, output)
    return lambda mbs: function(mbs.GetObjectOutput(item, variable))
