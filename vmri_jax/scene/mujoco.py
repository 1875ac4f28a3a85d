"""Scenes from models of MuJoCo: MJCF and URDF files, read by MuJoCo's own parser as a compiled `mujoco.MjModel`.

Bodies that are welded together are one rigid body; those welded to the world are the ground. Joints become `Spherical`,
`Revolute` and `Prismatic`, with a `Frame` between two joints of one body; their springs, dampers and armature `JointSpring`,
`JointDamper` and `RotorInertia`; the equalities connect and weld `Spherical` and `Fixed`, and those of joints and of fixed tendons
`JointCoupling`. MuJoCo keeps equalities softly; here they are constraints, kept to round-off. What becomes of every
field of a model is in `mujoco_fields`.
"""

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.names import unknown
from vmri_jax.scene.body import Frame
from vmri_jax.scene.effect import Effect
from vmri_jax.scene.effects.custom import Potential
from vmri_jax.scene.effects.fields import Gravity
from vmri_jax.scene.effects.joint_base import Joint
from vmri_jax.scene.effects.joint_effects import JointDamper, JointLimit, JointSpring, RotorInertia
from vmri_jax.scene.effects.joints import Fixed, Prismatic, Revolute, Spherical
from vmri_jax.scene.mujoco_couplings import couplings
from vmri_jax.scene.mujoco_fields import CONSTRAINTS
from vmri_jax.scene.mujoco_loops import close, loops
from vmri_jax.scene.mujoco_model import Compiled
from vmri_jax.scene.rigid import RigidBody

SMOOTHING = 1e-3
"""Way within which a limit as a spring sets in, in parts of the range. A larger one lets the stop be felt before it is reached, a smaller
one needs smaller steps there."""
OLDEST = 4
"""The first version of MuJoCo whose fields are those of `mujoco_fields`; older ones have other flags."""


def bodies_and_effects(
    model: Any,
    qpos: Any,
    qvel: Any,
    key: str | int | None,
    ignore: Collection[str],
    limits: Literal["refuse", "spring"],
    coordinates: Literal["joint", "directors"],
) -> tuple[list[RigidBody | Frame], list[Effect]]:
    """What a scene is made of, see `Scene.from_mujoco`, whose arguments these are."""
    try:
        import mujoco  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ImportError("Scene.from_mujoco needs the package mujoco: pip install 'vmri_jax[mujoco]'.") from error
    if int(mujoco.__version__.split(".")[0]) < OLDEST:
        raise ImportError(
            f"Scene.from_mujoco needs mujoco {OLDEST}.0 or newer, and finds {mujoco.__version__}: pip install 'vmri_jax[mujoco]'."
        )
    if isinstance(model, str | PathLike):
        if not Path(model).is_file():
            raise ValueError(f"Scene.from_mujoco: the file {model} does not exist.")
        try:
            model = mujoco.MjModel.from_xml_path(str(model))  # pyright: ignore
        except ValueError as error:
            raise ValueError(f"Scene.from_mujoco: MuJoCo cannot read {model}: {error}") from error
    if not isinstance(model, mujoco.MjModel):  # pyright: ignore
        raise TypeError(f"Scene.from_mujoco: model is {type(model).__name__}; give a path, or a mujoco.MjModel.")
    if limits not in ("refuse", "spring"):
        raise ValueError(f"Scene.from_mujoco: limits is {limits!r}; it must be 'refuse' or 'spring'.")
    compiled = Compiled(mujoco, model, coordinates)
    compiled.refuse([*ignore, "limits"] if limits == "spring" and not isinstance(ignore, str) else ignore)
    reader = _Reader(compiled, _start(compiled, qpos, qvel, key))
    bodies = reader.bodies()
    springs = list(reader.limits("limits" in ignore)) if limits == "spring" else []
    tied = couplings(compiled, reader.data)
    return bodies, [*reader.joints(), *springs, *reader.equalities(), *tied, *reader.gravity(bodies)]


def _start(compiled: Compiled, qpos: Any, qvel: Any, key: str | int | None) -> Any:
    """`mujoco.MjData` at the start, its loops closed."""
    data = compiled.mujoco.MjData(compiled.model)
    if key is not None:
        if qpos is not None or qvel is not None:
            raise ValueError("Scene.from_mujoco: key and qpos or qvel are given; both say where the motion starts.")
        number = _keyframe(compiled.model, key)
        qpos, qvel = compiled.model.key_qpos[number], compiled.model.key_qvel[number]
    for name, value in (("qpos", qpos), ("qvel", qvel)):
        if value is None:
            continue
        value, target = np.asarray(value, dtype=float), getattr(data, name)
        if value.shape != target.shape:
            raise ValueError(f"Scene.from_mujoco: {name} has shape {value.shape}; the model needs {target.shape}.")
        if not np.isfinite(value).all():
            raise ValueError(f"Scene.from_mujoco: {name} is {value}, which is not finite.")
        target[:] = value
    compiled.mujoco.mj_forward(compiled.model, data)
    close(compiled, data)
    return data


def _keyframe(model: Any, key: str | int) -> int:
    """The number of a keyframe."""
    names = [model.key(i).name for i in range(model.nkey)]
    if isinstance(key, str):
        if key not in names:
            raise ValueError(f"Scene.from_mujoco: {unknown('keyframe', key, names)}")
        return names.index(key)
    if not 0 <= key < model.nkey:
        raise ValueError(f"Scene.from_mujoco: key is {key}; the model has {model.nkey} keyframes, counted from 0.")
    return key


def lift(q, params):
    """The potential ``-f . x`` of a constant force on a point."""
    return -jnp.sum(params["force"] * q[0])


@dataclass(frozen=True)
class _Reader:
    """A compiled model at one configuration, where its joints are as MuJoCo's kinematics have them."""

    compiled: Compiled
    data: Any

    def bodies(self) -> list[RigidBody | Frame]:
        """One of all bodies that are welded together, at their common centre of mass, after frames between its joints."""
        made: list[RigidBody | Frame] = []
        for root in self.compiled.roots:
            made += [Frame(self._frame(j), self.data.xanchor[j]) for j in self.compiled.joints_of(root)[:-1]]
            made.append(self._body(root))
        return made

    def _body(self, root: int) -> RigidBody:
        """All that is welded to a body, as one."""
        model, name = self.compiled.model, self.compiled.name("body", root)
        members = np.flatnonzero(model.body_weldid == root)
        masses, centres = model.body_mass[members], self.data.xipos[members]
        mass = float(masses.sum())
        centre = masses @ centres / mass
        inertia = np.zeros((3, 3))
        for b, m, position in zip(members, masses, centres, strict=True):
            axes, arm = self.data.ximat[b].reshape(3, 3), position - centre
            inertia += axes @ np.diag(model.body_inertia[b]) @ axes.T
            inertia += m * (arm @ arm * np.eye(3) - np.outer(arm, arm))
        spin, velocity = self._motion(root)
        velocity = velocity + np.cross(spin, centre - self.data.xipos[root])
        return RigidBody(name, mass, inertia, centre, velocity=velocity, spin=spin)

    def joints(self) -> Iterator[Effect]:
        """Joints, and the linear springs, dampers and rotors in them."""
        compiled, model = self.compiled, self.compiled.model
        kinds = compiled.mujoco.mjtJoint
        for j in range(model.njnt):
            between = self._between(j)
            name, anchor, axis = compiled.name("joint", j), self.data.xanchor[j].copy(), self.data.xaxis[j].copy()
            kind = model.jnt_type[j]
            if kind == kinds.mjJNT_FREE:
                continue
            if kind == kinds.mjJNT_BALL:
                yield Spherical(between, anchor, name=name)
                continue
            yield (Revolute if kind == kinds.mjJNT_HINGE else Prismatic)(between, anchor, axis, name=name)
            dof, place = model.jnt_dofadr[j], model.jnt_qposadr[j]
            stiffness, damping, rotor = (
                float(x) for x in (model.jnt_stiffness[j], model.dof_damping[dof], model.dof_armature[dof])
            )
            curved = np.any(model.jnt_stiffnesspoly[j]) or model.jnt_springyield[j]
            if stiffness and not curved and not compiled.off("SPRING"):
                relaxed = float(model.qpos_spring[place] - self.data.qpos[place])
                yield JointSpring(name, stiffness, relaxed, name=f"{name} spring")
            if damping and not np.any(model.dof_dampingpoly[dof]) and not compiled.off("DAMPER"):
                yield JointDamper(name, damping, name=f"{name} damper")
            if rotor:
                yield RotorInertia(name, rotor, name=f"{name} rotor")

    def _between(self, j: int) -> tuple[str, str]:
        """The bodies or frames that a joint is between."""
        compiled, child = self.compiled, int(self.compiled.model.jnt_bodyid[j])
        joints = compiled.joints_of(child)
        parent = compiled.group(compiled.model.body_parentid[child])
        return (
            parent if j == joints[0] else self._frame(j - 1),
            compiled.group(child) if j == joints[-1] else self._frame(j),
        )

    def _frame(self, j: int) -> str:
        """What the frame between a joint and the next one of the same body is called."""
        return f"{self.compiled.name('joint', j)} frame"

    def limits(self, ignored: bool) -> Iterator[JointLimit]:
        """Limits of joints as springs: MuJoCo's stiffness for the inertia that the joint moves at qpos0.

        By its reference of solref, a limit pulls back with the acceleration ``d / (T z)^2`` at the depth d, of the time constant T and the
        damping ratio z; negative numbers are its stiffness and damping. The inertia is ``1 / dof_invweight0``.

        Args:
            ignored: whether limits of ball joints and of tendons may be left out.

        Raises:
            ValueError: limits of ball joints or of tendons that may not.
        """
        compiled, model = self.compiled, self.compiled.model
        if compiled.off(CONSTRAINTS, "LIMIT"):
            return
        others = [
            model.joint(int(j)).name or f"joint {j}" for j in np.flatnonzero(model.jnt_limited & compiled.turning)
        ]
        others += [model.tendon(int(i)).name or f"tendon {i}" for i in np.flatnonzero(model.tendon_limited)]
        if others and not ignored:
            raise ValueError(
                f"Scene.from_mujoco: limits='spring' is for limits of hinges and slides, and {', '.join(others)} have others. Leave these "
                "out of the motion, ignore=['limits'], or change the model."
            )
        for j in np.flatnonzero(np.asarray(model.jnt_limited) & ~compiled.turning).tolist():
            time, ratio = model.jnt_solref[j]
            rate = -time if time < 0 else 1 / (time * ratio) ** 2
            stiffness = rate / float(model.dof_invweight0[model.jnt_dofadr[j]])
            lower, upper = model.jnt_range[j] - self.data.qpos[model.jnt_qposadr[j]]
            name = compiled.name("joint", j)
            smoothing = SMOOTHING * (upper - lower)
            yield JointLimit(name, lower, upper, stiffness=stiffness, smoothing=smoothing, name=f"{name} limit")

    def equalities(self) -> Iterator[Joint]:
        """Loops that are closed by connect or weld."""
        for loop in loops(self.compiled, self.data):
            first, second = loop.ends
            between = self.compiled.group(first.body), self.compiled.group(second.body)
            kind = Fixed if loop.welded else Spherical
            yield kind(between, first.point, name=self.compiled.name("equality", loop.number))

    def gravity(self, bodies: list[RigidBody | Frame]) -> Iterator[Effect]:
        """Unless it is switched off; and the forces ``-c m g`` that compensate a part c of it, in the centres of mass.

        Args:
            bodies: of the scene.
        """
        compiled, model = self.compiled, self.compiled.model
        g = compiled.gravity
        if g.any():
            yield Gravity(g.tolist())
        by_name = {body.name: body for body in bodies}
        for b in compiled.compensated:
            body, force = by_name[compiled.group(b)], -model.body_gravcomp[b] * model.body_mass[b] * g
            point = self.data.xipos[b] - body.position  # the axes of the body are those of space at the start
            name = f"{compiled.name('body', b)} gravity compensation"
            yield Potential(lift, ((body.name, point.tolist()),), {"force": force}, name=name)

    def _motion(self, body: int) -> tuple[np.ndarray, np.ndarray]:
        """Angular velocity, and velocity of the centre of mass, in space."""
        mujoco, velocity = self.compiled.mujoco, np.zeros(6)
        mujoco.mj_objectVelocity(self.compiled.model, self.data, mujoco.mjtObj.mjOBJ_BODY, body, velocity, 0)
        return velocity[:3], velocity[3:]
