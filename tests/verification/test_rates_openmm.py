"""Three rates of forces against OpenMM's `MTSIntegrator([(0, 1), (1, 4), (2, 32)])`, where OpenMM is installed."""

import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from vmri_jax.schemes.quadrature import trapezoidal

MASS = np.array([2.0, 1.0, 1.5, 1.0])
POINTS = np.array([[0.0, 0.0, 0.0], [1.0, 0.1, 0.0], [1.9, -0.2, 0.1], [2.9, 0.1, 0.0]])
VELOCITY = np.array([[0.1, 0.3, 0.0], [-0.2, -0.1, 0.1], [0.05, -0.2, 0.0], [-0.1, 0.2, -0.1]])
LENGTHS = np.linalg.norm(np.diff(POINTS, axis=0), axis=1)
PAIRS = ((0, 2), (0, 3), (1, 3))
ANGLE, BEND, STIFFNESS = 2.9, 20.0, 1000.0
H, NUM_STEPS = 0.05, 100


def pairs(q_s, q_f, params):
    x = q_f.reshape(-1, 3)
    return sum(1 / jnp.sum((x[i] - x[j]) ** 2) for i, j in PAIRS)


def bends(q_s, q_f, params):
    d = jnp.diff(q_f.reshape(-1, 3), axis=0)
    d /= jnp.linalg.norm(d, axis=1)[:, None]
    return BEND * jnp.sum((jnp.arccos(-jnp.sum(d[:-1] * d[1:], axis=1)) - ANGLE) ** 2)


def bonds(q_s, q_f, params):
    return STIFFNESS * jnp.sum((jnp.linalg.norm(jnp.diff(q_f.reshape(-1, 3), axis=0), axis=1) - LENGTHS) ** 2)


def ends(q_s, q_f, params):
    """A stiff spring from the first to the last atom."""
    x = q_f.reshape(-1, 3)
    return STIFFNESS * (jnp.linalg.norm(x[0] - x[3]) - 2.9) ** 2


def rigid(q_s, q_f, params):
    d = jnp.diff(q_f.reshape(-1, 3), axis=0)
    return (jnp.sum(d * d, axis=1) - LENGTHS**2) / 2


@pytest.mark.parametrize(("constrained", "bound"), [(False, 1e-12), (True, 5e-9)])
def test_equals_openmm(constrained, bound):
    """Measured 1e-13; with constraints 1.4e-9, which OpenMM's own constraints are good for at their smallest
    tolerance."""
    openmm = pytest.importorskip("openmm")
    mts = pytest.importorskip("openmm.mtsintegrator")
    system = openmm.System()
    for mass in MASS:
        system.addParticle(mass)
    forces = openmm.CustomBondForce("1/r^2"), openmm.CustomAngleForce(f"{BEND}*(theta-{ANGLE})^2")
    stiff = openmm.CustomBondForce(f"{STIFFNESS}*(r-l)^2")
    stiff.addPerBondParameter("l")
    for group, force in enumerate((*forces, stiff)):
        force.setForceGroup(group)
        system.addForce(force)
    for i, j in PAIRS:
        forces[0].addBond(i, j, [])
    for i in range(2):
        forces[1].addAngle(i, i + 1, i + 2, [])
    for i, length in enumerate(LENGTHS):
        if constrained:
            system.addConstraint(i, i + 1, length)
        else:
            stiff.addBond(i, i + 1, [length])
    if constrained:
        stiff.addBond(0, 3, [2.9])

    levels = {"pairs": pairs, "bends": bends, "bonds": ends if constrained else bonds}
    rules = {"pairs": vm.macro(trapezoidal), "bends": vm.micro(trapezoidal, every=8), "bonds": vm.micro(trapezoidal)}
    masses = np.repeat(MASS, 3)
    ours = vm.System(vm.ConstantMass([], masses), potentials=levels, constraint=rigid if constrained else None)
    start = vm.initial_state(ours, [], POINTS.ravel(), [], VELOCITY.ravel(), project=constrained)
    scheme = vm.fully_explicit(32).with_potentials(**rules)
    run = vm.simulate(ours, scheme, start, macro_dt=H, num_steps=NUM_STEPS, save=NUM_STEPS)

    integrator = mts.MTSIntegrator(H, [(0, 1), (1, 4), (2, 32)])
    integrator.setConstraintTolerance(1e-14)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))
    context.setPositions(POINTS)
    context.setVelocities((np.asarray(start.p_f) / masses).reshape(-1, 3))
    integrator.step(NUM_STEPS)
    theirs = context.getState(getPositions=True).getPositions(asNumpy=True)
    assert np.abs(np.asarray(theirs._value).ravel() - np.asarray(run.q_f[-1])).max() < bound
