# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
"""OpenMM: its r-RESPA integrator with constraints (MTSIntegrator), in doubles on the Reference platform."""

import numpy as np
import openmm as mm

from benchmarks.peers.cases import Case, Ladder, steps_ladder
from benchmarks.peers.mechanics import from_masses, to_masses

NUM_MICRO = (1, 4)
"""Micro steps per macro step that are tried; each is interpreted, more make a step slower."""
SLOW, FAST = 0, 1  # force groups
FIXED = 1e20
"""Mass of the particle at the origin, which cannot be infinite: it moves less than round-off."""
TOLERANCE = 1e-13
"""Relative error of a rod; the iteration ends below it."""


def ladders(case: Case) -> list[Ladder]:
    """Some numbers of micro steps; numbers of macro steps."""

    def ladder(num_micro: int) -> Ladder:
        def build(num_steps: int):
            context, x, v = prepare(case, num_micro)
            return lambda: positions(case, end_of(context, x, v, case.t_end, num_steps))

        return steps_ladder(case, f"MTS {num_micro}", build)

    return [ladder(n) for n in NUM_MICRO]


def prepare(case: Case, num_micro: int):
    """Context, positions and velocities at the start, in nm, ps and kJ/mol."""
    system, x, v = _chain(case) if case.is_chain else _particles(case)
    context = context_of(system, num_micro)
    context.setPositions(x)
    context.setVelocities(v)
    return context, x, v


def context_of(system, num_micro: int):
    """A context that integrates a system with forces of two groups, `SLOW` and `FAST`."""
    integrator = mm.MTSIntegrator(1e-3, [(SLOW, 1), (FAST, num_micro)])
    integrator.setConstraintTolerance(TOLERANCE)
    return mm.Context(system, integrator, mm.Platform.getPlatformByName("Reference"))


def end_of(context, x, v, t_end: float, num_steps: int) -> np.ndarray:
    """Places (particles, 3) of the particles after a run from x and v, NaN where a step is too large."""
    context.setPositions(x)
    context.setVelocities(v)
    integrator = context.getIntegrator()
    integrator.setStepSize(t_end / num_steps)
    try:
        integrator.step(num_steps)
    except mm.OpenMMException:
        return np.full(np.shape(x), np.nan)
    return np.asarray(context.getState(positions=True).getPositions(asNumpy=True)._value)


def positions(case: Case, x: np.ndarray) -> np.ndarray:
    """Of the case, slow ones first."""
    return from_masses(x[:, 0]) if case.is_chain else x[: len(case.particles.masses)].reshape(-1)


def energy(case: Case) -> float:
    """Of the start: potential and kinetic energy of the context."""
    context, _, _ = prepare(case, 1)
    state = context.getState(energy=True)
    return state.getPotentialEnergy()._value + state.getKineticEnergy()._value


def _chain(case: Case):
    """Its masses on a line: quartic springs ``d^4`` between the stiff ones and to the walls at 0."""
    x, v = (np.stack([a, 0 * a, 0 * a], axis=1) for a in (to_masses(case.q), to_masses(case.v)))
    n = len(x)
    system, stiff = mm.System(), mm.HarmonicBondForce()
    soft, walls = mm.CustomBondForce("r^4"), mm.CustomExternalForce("x^4")
    for _ in range(n):
        system.addParticle(1.0)
    for i in range(0, n, 2):
        stiff.addBond(i, i + 1, 0.0, case.omega**2 / 2)
    for i in range(1, n - 1, 2):
        soft.addBond(i, i + 1)
    walls.addParticle(0)
    walls.addParticle(n - 1)
    add_forces(system, {stiff: FAST, soft: SLOW, walls: SLOW})
    return system, x, v


def _particles(case: Case):
    """The particles, and one more that stays at the origin."""
    p, n = case.particles, len(case.particles.masses)
    system, stiff, soft = mm.System(), mm.HarmonicBondForce(), mm.HarmonicBondForce()
    weight = mm.CustomExternalForce("w*z")
    weight.addPerParticleParameter("w")
    for i, m in enumerate(p.masses):
        system.addParticle(m)
        weight.addParticle(i, [m * p.gravity])
    system.addParticle(FIXED)
    fast = case.problem.q_s.size // 3
    for i, j, k, length in p.springs:
        (stiff if min(i, j) >= fast else soft).addBond(i, j, length, k)
    for i, j, length in p.rods:
        system.addConstraint(n if i < 0 else i, j, length)
    add_forces(system, {stiff: FAST, soft: SLOW, weight: SLOW})
    x, v = (np.vstack([a.reshape(-1, 3), np.zeros(3)]) for a in (case.q, case.v))
    return system, x, v


def add_forces(system, groups) -> None:
    """Forces with their groups."""
    for force, group in groups.items():
        force.setForceGroup(group)
        system.addForce(force)
