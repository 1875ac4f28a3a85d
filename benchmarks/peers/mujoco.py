# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
"""MuJoCo: rods are ball joints of a tree, springs are tendons; RK4 and its semi-implicit Euler."""

from collections.abc import Sequence

import mujoco
import numpy as np

from benchmarks.peers.cases import Case, Ladder, steps_ladder
from benchmarks.peers.mechanics import Particles, from_masses, to_masses

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
                mujoco.mj_resetData(model, data)
                data.qvel[:] = velocity
                mujoco.mj_step(model, data, nstep=num_steps)
                mujoco.mj_kinematics(model, data)
                mujoco.mj_comPos(model, data)
                return positions(case, data)

            return run

        return steps_ladder(case, name, build, first=8.0)

    return [ladder(name) for name in INTEGRATORS]


def prepare(case: Case):
    """Model, data and joint velocities at the start, where all joint positions are zero."""
    bodies, tendons = _chain(case) if case.is_chain else _particles(case.particles, case.q)
    gravity = 0.0 if case.is_chain else case.particles.gravity
    model = mujoco.MjModel.from_xml_string(f"""
        <mujoco>
          <option gravity="0 0 {-gravity!r}"><flag contact="disable" constraint="disable" autoreset="disable"/></option>
          <worldbody>{bodies}</worldbody>
          <tendon>{tendons}</tendon>
        </mujoco>""")
    data = mujoco.MjData(model)
    data.qvel[:] = to_masses(case.v) if case.is_chain else _velocities(model, case)
    return model, data, data.qvel.copy()


def positions(case: Case, data) -> np.ndarray:
    """Of the case, slow ones first."""
    if case.is_chain:
        return from_masses(data.xipos[1:, 0])
    order = np.argsort(_order(case.particles))
    return data.xipos[1:][order].reshape(-1)


def energy(case: Case) -> float:
    """Of the start: ``mjData.energy``."""
    model, data, _ = prepare(case)
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    mujoco.mj_forward(model, data)
    return float(data.energy.sum())


def _chain(case: Case) -> tuple[str, str]:
    """Its masses on sliders, joined by tendons of linear and cubic force, ``(omega^2 / 2) d`` and ``4 d^3``."""
    x = to_masses(case.q)
    bodies = "".join(_body(f"{i}", AXES[0] * a, _slider(f"{i}", AXES[0], a)) for i, a in enumerate(x))
    stiff = [_tendon({i + 1: 1, i: -1}, f"{case.omega**2 / 2!r}") for i in range(0, len(x), 2)]
    soft = [_tendon({i + 1: 1, i: -1}, "0 0 4") for i in range(1, len(x) - 1, 2)]
    walls = [_tendon({i: 1}, "0 0 4") for i in (0, len(x) - 1)]
    return bodies, "".join(stiff + soft + walls)


def _body(name: str, place, inside: str, mass: float = 1.0, offset: Sequence[float] = (0.0, 0.0, 0.0)) -> str:
    inertia = f'<inertial pos="{_numbers(offset)}" mass="{mass!r}" diaginertia="{_numbers([INERTIA] * 3)}"/>'
    return f'<body name="b{name}" pos="{_numbers(place)}">{inertia}{inside}</body>'


def _slider(name: str, axis, place: float = 0.0) -> str:
    return f'<joint name="j{name}" type="slide" axis="{_numbers(axis)}" ref="{float(place)!r}"/>'


def _tendon(joints: dict[int, int], stiffness: str) -> str:
    inside = "".join(f'<joint joint="j{i}" coef="{c}"/>' for i, c in joints.items())
    return f'<fixed stiffness="{stiffness}" springlength="0">{inside}</fixed>'


def _particles(p: Particles, q) -> tuple[str, str]:
    """A body per particle, hinged at the other end of its rod if it has one, else free to move."""
    q = np.reshape(q, (-1, 3))

    def tree(i: int, parent: int, origin) -> str:
        """Particle i and those that hang on it; `origin` is where its parent's frame is."""
        hinged = parent is not None
        frame = (np.zeros(3) if parent == -1 else q[parent]) if hinged else q[i]
        joints = '<joint type="ball"/>' if hinged else "".join(_slider(f"{i}{a}", AXES[a]) for a in range(3))
        site = f'<site name="s{i}" pos="{_numbers(q[i] - frame)}"/>'
        below = "".join(tree(j, i, frame) for k, j, _ in p.rods if k == i)
        return _body(f"{i}", frame - origin, joints + site + below, p.masses[i], q[i] - frame)

    parents = {j: i for i, j, _ in p.rods}
    roots = [i for i in range(len(p.masses)) if parents.get(i, -1) == -1]
    bodies = "".join(tree(i, parents.get(i), np.zeros(3)) for i in roots)  # pyright: ignore[reportArgumentType]
    tendons = "".join(
        f'<spatial stiffness="{k!r}" springlength="{length!r}"><site site="s{i}"/><site site="s{j}"/></spatial>'
        for i, j, k, length in p.springs
    )
    return bodies, tendons


def _order(p: Particles) -> list[int]:
    """Particles in the order of the bodies, depth first."""
    parents = {j: i for i, j, _ in p.rods}

    def below(i: int) -> list[int]:
        return [i] + [x for k, j, _ in p.rods if k == i for x in below(j)]

    return [x for i in range(len(p.masses)) if parents.get(i, -1) == -1 for x in below(i)]


def _velocities(model, case: Case) -> np.ndarray:
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


def _numbers(values) -> str:
    return " ".join(repr(float(x)) for x in values)
