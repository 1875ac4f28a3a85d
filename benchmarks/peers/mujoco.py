# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
"""MuJoCo: rods are ball joints of a tree, springs are tendons; RK4 and its semi-implicit Euler."""

import mujoco
import numpy as np

from benchmarks.peers.cases import Case, Ladder, steps_ladder
from benchmarks.peers.mechanics import Particles

INERTIA = 1e-10
"""Of every mass about itself: MuJoCo knows no points. It moves no digit that is compared."""
INTEGRATORS = {"RK4": mujoco.mjtIntegrator.mjINT_RK4, "Euler": mujoco.mjtIntegrator.mjINT_EULER}
AXES = np.eye(3)

mujoco.set_mju_user_warning(lambda message: None)  # a step too large is seen in the error


def ladders(case: Case) -> list[Ladder]:
    """Both integrators; numbers of steps."""

    def ladder(name: str) -> Ladder:
        def build(num_steps: int):
            model, data, velocity = prepare(case)
            model.opt.integrator = INTEGRATORS[name]
            model.opt.timestep = case.t_end / num_steps

            def run():
                step(model, data, velocity, num_steps)
                return positions(case, data)

            return run

        return steps_ladder(case, name, build, first=8.0)

    return [ladder(name) for name in INTEGRATORS]


def step(model, data, velocity, num_steps: int) -> None:
    """Steps from the start, where all joint positions are zero; then the centres of the bodies."""
    mujoco.mj_resetData(model, data)
    data.qvel[:] = velocity
    mujoco.mj_step(model, data, nstep=num_steps)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)


def without_contacts():
    """An empty model without contacts and constraints; a step too large is not mended."""
    spec = mujoco.MjSpec()
    for flag in ("CONTACT", "CONSTRAINT", "AUTORESET"):
        spec.option.disableflags |= getattr(mujoco.mjtDisableBit, f"mjDSBL_{flag}")
    return spec


def prepare(case: Case):
    """Model, data and joint velocities at the start, where all joint positions are zero."""
    spec = without_contacts()
    _particles(case, spec)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qvel[:] = _velocities(case)
    return model, data, data.qvel.copy()


def positions(case: Case, data) -> np.ndarray:
    """Of the case, slow ones first."""
    order = np.argsort(_order(case.particles))
    return data.xipos[1:][order].reshape(-1)


def energy(case: Case) -> float:
    """Of the start: ``mjData.energy``."""
    model, data, _ = prepare(case)
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    mujoco.mj_forward(model, data)
    return float(data.energy.sum())


def _particles(case: Case, spec) -> None:
    """A body per particle, hinged at the other end of its rod if it has one, else free to move."""
    p, q = case.particles, case.q.reshape(-1, 3)
    spec.option.gravity = -p.gravity * AXES[2]
    frames = {-1: np.zeros(3)}
    bodies = {-1: spec.worldbody}
    parents = {j: i for i, j, _ in p.rods}
    for i in _order(p):
        parent = parents.get(i, -1)
        hinged = i in parents
        frames[i] = (q[parent] if parent >= 0 else np.zeros(3)) if hinged else q[i]
        place = {"pos": frames[i] - frames[parent], "ipos": q[i] - frames[i]}
        point = {"mass": p.masses[i], "inertia": [INERTIA] * 3, "explicitinertial": True}
        bodies[i] = bodies[parent].add_body(**place, **point)
        if hinged:
            bodies[i].add_joint(type=mujoco.mjtJoint.mjJNT_BALL)
        else:
            for axis in AXES:
                bodies[i].add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
        bodies[i].add_site(name=f"{i}", pos=q[i] - frames[i])
    for i, j, k, length in p.springs:
        tendon = spec.add_tendon(stiffness=[k, 0.0, 0.0], springlength=[length, length])
        tendon.wrap_site(f"{i}")
        tendon.wrap_site(f"{j}")


def _order(p: Particles) -> list[int]:
    """Particles in the order of the bodies, depth first."""
    parents = {j: i for i, j, _ in p.rods}

    def below(i: int) -> list[int]:
        return [i] + [x for k, j, _ in p.rods if k == i for x in below(j)]

    return [x for i in range(len(p.masses)) if parents.get(i, -1) == -1 for x in below(i)]


def _velocities(case: Case) -> np.ndarray:
    """Joint velocities: ``r x (v - v_parent) / |r|^2`` for rods, relative to that of the rod they hang on."""
    p, q, v = case.particles, case.q.reshape(-1, 3), case.v.reshape(-1, 3)
    parents, spin, found = {j: i for i, j, _ in p.rods}, {}, []
    for i in _order(p):
        if i not in parents:
            found.append(v[i])
            spin[i] = np.zeros(3)
            continue
        k = parents[i]
        r, w = (q[i], v[i]) if k < 0 else (q[i] - q[k], v[i] - v[k])
        spin[i] = np.cross(r, w) / (r @ r)
        found.append(spin[i] - (0 if k < 0 else spin[k]))
    return np.concatenate(found)
