"""Scenes from models of MuJoCo: MJCF and URDF files, read by MuJoCo's own parser as a compiled `mujoco.MjModel`.

| MuJoCo | scene |
|---|---|
| bodies that are welded together | one `RigidBody`, or the ground if they are welded to the world |
| joints ball, hinge, slide | `Spherical`, `Revolute`, `Prismatic`, with a `Frame` between two joints of the same body |
| stiffness, damping, armature of joints | `JointSpring`, `JointDamper`, `RotorInertia` |
| limits of joints, with limits="spring" | `JointLimit` |
| equalities connect, weld | `Spherical`, `Fixed` |
| equalities joint, tendon (fixed) | `JointCoupling` |
| gravity, gravcomp | `Gravity`, `Potential` |

MuJoCo's equalities are soft; here they are constraints, satisfied to round-off. The parts of a model that the reader
refuses are in `mujoco_model`.
"""

from collections.abc import Collection, Iterator
from os import PathLike
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.arrays import real_array
from vmri_jax.mechanics.names import unknown
from vmri_jax.refusals import NotInstalled, Refused
from vmri_jax.scene.body import Frame
from vmri_jax.scene.effect import Effect
from vmri_jax.scene.effects.custom import Potential
from vmri_jax.scene.effects.forces import Gravity
from vmri_jax.scene.effects.joint_base import Joint
from vmri_jax.scene.effects.joint_effects import JointDamper, JointLimit, JointSpring, RotorInertia
from vmri_jax.scene.effects.joints import Fixed, Prismatic, Revolute, Spherical
from vmri_jax.scene.mujoco_equalities import close, couplings, loops
from vmri_jax.scene.mujoco_model import CONSTRAINTS, Compiled
from vmri_jax.scene.rigid import RigidBody

SMOOTHING = 1e-3
"""Smoothing of a limit as a spring, relative to the range of the joint. With a larger value the force sets in visibly
before the limit; a smaller value needs smaller steps there."""
OLDEST_VERSION = 4
"""First major version of MuJoCo with the fields of `mujoco_model`; older versions have other flags."""


def bodies_and_effects(
    model: Any, qpos: Any, qvel: Any, key: str | int | None, ignore: Collection[str], limits: str, coordinates: str
) -> tuple[list[RigidBody | Frame], list[Effect]]:
    """Bodies and effects of the scene of a model, see `Scene.from_mujoco`."""
    try:
        import mujoco  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise NotInstalled("Scene.from_mujoco needs the package mujoco: pip install 'vmri_jax[mujoco]'.") from error
    if int(mujoco.__version__.split(".")[0]) < OLDEST_VERSION:
        raise NotInstalled(
            f"Scene.from_mujoco needs mujoco {OLDEST_VERSION}.0 or newer, and finds {mujoco.__version__}: pip install "
            "'vmri_jax[mujoco]'."
        )
    if isinstance(model, str | PathLike):
        if not Path(model).is_file():
            raise Refused(f"Scene.from_mujoco: the file {model} does not exist.")
        try:
            model = mujoco.MjModel.from_xml_path(str(model))  # pyright: ignore
        except ValueError as error:
            raise Refused(f"Scene.from_mujoco: MuJoCo cannot read {model}: {error}") from error
    if not isinstance(model, mujoco.MjModel):  # pyright: ignore
        raise Refused(f"Scene.from_mujoco: model is {type(model).__name__}; give a path, or a mujoco.MjModel.")
    if limits not in ("refuse", "spring"):
        raise Refused(f"Scene.from_mujoco: limits is {limits!r}; it must be 'refuse' or 'spring'.")
    reader = _Reader(mujoco, model, coordinates, _start(mujoco, model, qpos, qvel, key))
    reader.refuse([*ignore, "limits"] if limits == "spring" and not isinstance(ignore, str) else ignore)
    close(reader)
    bodies = reader.bodies()
    springs = list(reader.limits("limits" in ignore)) if limits == "spring" else []
    return bodies, [*reader.joints(), *springs, *reader.closing(), *couplings(reader), *reader.weights(bodies)]


def _start(mujoco: Any, model: Any, qpos: Any, qvel: Any, key: str | int | None) -> Any:
    """`mujoco.MjData` at the start, of a keyframe with its controls, activations and poses of mocap bodies."""
    data = mujoco.MjData(model)
    if key is not None:
        if qpos is not None or qvel is not None:
            raise Refused("Scene.from_mujoco: key and qpos or qvel are given; both define the start. Give one of them.")
        names = [model.key(i).name for i in range(model.nkey)]
        if isinstance(key, str) and key not in names:
            raise Refused(f"Scene.from_mujoco: {unknown('keyframe', key, names)}")
        number = names.index(key) if isinstance(key, str) else key
        if not 0 <= number < model.nkey:
            raise Refused(f"Scene.from_mujoco: key is {key}; the model has {model.nkey} keyframes, counted from 0.")
        mujoco.mj_resetDataKeyframe(model, data, number)
        qpos, qvel = model.key_qpos[number], model.key_qvel[number]
    for name, value in (("qpos", qpos), ("qvel", qvel)):
        if value is None:
            continue
        value, target = np.asarray(real_array(f"Scene.from_mujoco: {name}", value)), getattr(data, name)
        if value.shape != target.shape:
            raise Refused(f"Scene.from_mujoco: {name} has shape {value.shape}; the model needs {target.shape}.")
        if not np.isfinite(value).all():
            raise Refused(f"Scene.from_mujoco: {name} is {value}, which is not finite.")
        target[:] = value
    mujoco.mj_forward(model, data)
    return data


def lift(q, params):
    """The potential ``-f . x`` of a constant force on a point."""
    return -jnp.sum(params["force"] * q[0])


class _Reader(Compiled):
    """The bodies and effects of a compiled model."""

    def bodies(self) -> list[RigidBody | Frame]:
        """A rigid body for each group of bodies that are welded together, after the frames between its joints."""
        bodies: list[RigidBody | Frame] = []
        for root in self.roots:
            bodies += [Frame(self._frame(j), self.data.xanchor[j]) for j in self.joints_of(root)[:-1]]
            bodies.append(self._body(root))
        return bodies

    def _body(self, root: int) -> RigidBody:
        """The rigid body of all bodies that are welded to `root`, at their common centre of mass."""
        model, mujoco = self.model, self.mujoco
        members = np.flatnonzero(model.body_weldid == root)
        masses, centres = model.body_mass[members], self.data.xipos[members]
        mass = float(masses.sum())
        centre = masses @ centres / mass
        inertia = np.zeros((3, 3))
        # parallel axes: J = sum R J_b R^T + m (r^2 1 - r r^T) with the arm r from the common centre
        for b, m, position in zip(members, masses, centres, strict=True):
            axes, arm = self.data.ximat[b].reshape(3, 3), position - centre
            inertia += axes @ np.diag(model.body_inertia[b]) @ axes.T
            inertia += m * (arm @ arm * np.eye(3) - np.outer(arm, arm))
        motion = np.zeros(6)  # angular velocity, and velocity of the centre of mass, in space
        mujoco.mj_objectVelocity(model, self.data, mujoco.mjtObj.mjOBJ_BODY, root, motion, 0)
        spin, velocity = motion[:3], motion[3:]
        velocity = velocity + np.cross(spin, centre - self.data.xipos[root])
        return RigidBody(self.name("body", root), mass, inertia, centre, velocity=velocity, spin=spin)

    def joints(self) -> Iterator[Effect]:
        """All joints, each followed by its linear spring, damper and rotor."""
        model, kinds = self.model, self.mujoco.mjtJoint
        for j in range(model.njnt):
            between = self._between(j)
            name, anchor, axis = self.name("joint", j), self.data.xanchor[j].copy(), self.data.xaxis[j].copy()
            kind = model.jnt_type[j]
            if kind == kinds.mjJNT_FREE:
                continue  # a body without a joint is free in a scene
            if kind == kinds.mjJNT_BALL:
                yield Spherical(between, anchor, name=name)
                continue
            yield (Revolute if kind == kinds.mjJNT_HINGE else Prismatic)(between, anchor, axis, name=name)
            dof, place = model.jnt_dofadr[j], model.jnt_qposadr[j]
            stiffness, damping, rotor = model.jnt_stiffness[j], model.dof_damping[dof], model.dof_armature[dof]
            is_nonlinear = np.any(model.jnt_stiffnesspoly[j]) or model.jnt_springyield[j]
            if stiffness and not is_nonlinear and not self.off("SPRING"):
                relaxed = float(model.qpos_spring[place] - self.data.qpos[place])
                yield JointSpring(name, stiffness, relaxed, name=f"{name} spring")
            if damping and not np.any(model.dof_dampingpoly[dof]) and not self.off("DAMPER"):
                yield JointDamper(name, damping, name=f"{name} damper")
            if rotor:
                yield RotorInertia(name, rotor, name=f"{name} rotor")

    def _between(self, j: int) -> tuple[str, str]:
        """Names of both bodies or frames of a joint."""
        child = int(self.model.jnt_bodyid[j])
        joints, parent = self.joints_of(child), self.group(self.model.body_parentid[child])
        return (
            parent if j == joints[0] else self._frame(j - 1),
            self.group(child) if j == joints[-1] else self._frame(j),
        )

    def _frame(self, j: int) -> str:
        """Name of the frame between a joint and the next joint of the same body."""
        return f"{self.name('joint', j)} frame"

    def limits(self, ignored: bool) -> Iterator[JointLimit]:
        """Limits of joints as springs, with MuJoCo's stiffness for the inertia that the joint moves at qpos0.

        MuJoCo's solref of a limit is (T, z), its time constant and damping ratio: at the depth d it pulls back with the
        acceleration ``d / (T z)^2``. Negative numbers are (-k, -c), with the acceleration ``k d``. The inertia is
        ``1 / dof_invweight0``. The depth is counted from the margin of the joint, which lies inside its range. This is
        the stiffness of an impact; MuJoCo scales a steady load, too, by one minus the impedance of solimp, so that its
        limits give way to a load by a twentieth of the depth here. Limits of ball joints and of tendons are refused
        unless they are `ignored`.
        """
        model = self.model
        if self.off(CONSTRAINTS, "LIMIT"):
            return
        unfit = [model.joint(int(j)).name or f"joint {j}" for j in np.flatnonzero(model.jnt_limited & self.turning)]
        unfit += [model.tendon(int(i)).name or f"tendon {i}" for i in np.flatnonzero(model.tendon_limited)]
        if unfit and not ignored:
            raise Refused(
                f"Scene.from_mujoco: limits='spring' is for limits of hinges and slides, and {', '.join(unfit)} have "
                "limits of another kind. Leave these out of the motion, ignore=['limits'], or change the model."
            )
        for j in np.flatnonzero(np.asarray(model.jnt_limited) & ~self.turning).tolist():
            time, ratio = model.jnt_solref[j]
            rate = -time if time < 0 else 1 / (time * ratio) ** 2
            stiffness = rate / float(model.dof_invweight0[model.jnt_dofadr[j]])
            margins = np.array([1.0, -1.0]) * model.jnt_margin[j]
            lower, upper = model.jnt_range[j] + margins - self.data.qpos[model.jnt_qposadr[j]]
            name, smoothing = self.name("joint", j), SMOOTHING * (upper - lower)
            yield JointLimit(name, lower, upper, stiffness=stiffness, smoothing=smoothing, name=f"{name} limit")

    def closing(self) -> Iterator[Joint]:
        """Joints that close loops, from the equalities connect and weld."""
        for loop in loops(self):
            kind = Spherical if len(loop.gap) == 1 else Fixed
            yield kind(tuple(map(self.group, loop.bodies)), loop.points[0], name=self.name("equality", loop.number))

    def weights(self, bodies: list[RigidBody | Frame]) -> Iterator[Effect]:
        """Gravity, unless the model switches it off, and the forces ``-c m g`` in centres of mass that compensate a
        fraction c of it."""
        model, g = self.model, self.gravity
        if g.any():
            yield Gravity(g.tolist())
        by_name = {body.name: body for body in bodies}
        for b in self.compensated:
            body, force = by_name[self.group(b)], -model.body_gravcomp[b] * model.body_mass[b] * g
            point = self.data.xipos[b] - body.position  # at the start the axes of the body are the axes of space
            name = f"{self.name('body', b)} gravity compensation"
            yield Potential(lift, ((body.name, point.tolist()),), {"force": force}, name=name)
