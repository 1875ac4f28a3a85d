"""Scenes from models of MuJoCo: MJCF and URDF files, read by MuJoCo's own parser as a compiled `mujoco.MjModel`.

Bodies that are welded together are one rigid body; those welded to the world are the ground. Joints become `Spherical`,
`Revolute` and `Prismatic`, their springs and dampers `JointSpring` and `JointDamper`, the equalities connect and weld
`Spherical` and `Fixed`. MuJoCo keeps equalities softly; here they are constraints, kept to round-off. What becomes of every
field of a model is in `mujoco_fields`.
"""

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from vmri_jax.scene.effect import Effect
from vmri_jax.scene.effects.custom import Potential
from vmri_jax.scene.effects.fields import Gravity
from vmri_jax.scene.effects.joint_effects import JointDamper, JointSpring
from vmri_jax.scene.effects.joints import Fixed, Joint, Prismatic, Revolute, Spherical
from vmri_jax.scene.mujoco_loops import close, loops
from vmri_jax.scene.mujoco_model import Compiled
from vmri_jax.scene.rigid import RigidBody

OLDEST = 4
"""The first version of MuJoCo whose fields are those of `mujoco_fields`; older ones have other flags."""


def bodies_and_effects(
    model: Any, qpos: Any, qvel: Any, ignore: Collection[str]
) -> tuple[list[RigidBody], list[Effect]]:
    """What a scene is made of, see `Scene.from_mujoco`.

    Args:
        model: a path or a compiled model.
        qpos, qvel: MuJoCo's coordinates and velocities at the start; None for those of the model, at rest.
        ignore: what is left out.
    """
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
    compiled = Compiled(mujoco, model)
    compiled.refuse(ignore)
    reader = _Reader(compiled, _start(compiled, qpos, qvel))
    bodies = reader.bodies()
    return bodies, [*reader.joints(), *reader.equalities(), *reader.gravity(bodies)]


def _start(compiled: Compiled, qpos: Any, qvel: Any) -> Any:
    """`mujoco.MjData` at the start, its loops closed."""
    data = compiled.mujoco.MjData(compiled.model)
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


def lift(q, params):
    """The potential ``-f . x`` of a constant force on a point."""
    return -jnp.sum(params["force"] * q[0])


@dataclass(frozen=True)
class _Reader:
    """A compiled model at one configuration, where its joints are as MuJoCo's kinematics have them."""

    compiled: Compiled
    data: Any

    def bodies(self) -> list[RigidBody]:
        """One of all bodies that are welded together, at their common centre of mass."""
        made, model = [], self.compiled.model
        for root in self.compiled.roots:
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
            name = self.compiled.name("body", root)
            made.append(RigidBody(name, mass, inertia, centre, velocity=velocity, spin=spin))
        return made

    def joints(self) -> Iterator[Effect]:
        """Joints, and the linear springs and dampers in them."""
        compiled, model = self.compiled, self.compiled.model
        kinds = compiled.mujoco.mjtJoint
        for j in range(model.njnt):
            child = model.jnt_bodyid[j]
            between = compiled.group(model.body_parentid[child]), compiled.group(child)
            name, anchor, axis = compiled.name("joint", j), self.data.xanchor[j].copy(), self.data.xaxis[j].copy()
            kind = model.jnt_type[j]
            if kind == kinds.mjJNT_FREE:
                continue
            if kind == kinds.mjJNT_BALL:
                yield Spherical(between, anchor, name=name)
                continue
            yield (Revolute if kind == kinds.mjJNT_HINGE else Prismatic)(between, anchor, axis, name=name)
            dof, place = model.jnt_dofadr[j], model.jnt_qposadr[j]
            stiffness, damping = float(model.jnt_stiffness[j]), float(model.dof_damping[dof])
            curved = np.any(model.jnt_stiffnesspoly[j]) or model.jnt_springyield[j]
            if stiffness and not curved and not compiled.off("SPRING"):
                relaxed = float(model.qpos_spring[place] - self.data.qpos[place])
                yield JointSpring(name, stiffness, relaxed, name=f"{name} spring")
            if damping and not np.any(model.dof_dampingpoly[dof]) and not compiled.off("DAMPER"):
                yield JointDamper(name, damping, name=f"{name} damper")

    def equalities(self) -> Iterator[Joint]:
        """Loops that are closed by connect or weld."""
        for loop in loops(self.compiled, self.data):
            first, second = loop.ends
            between = self.compiled.group(first.body), self.compiled.group(second.body)
            kind = Fixed if loop.welded else Spherical
            yield kind(between, first.point, name=self.compiled.name("equality", loop.number))

    def gravity(self, bodies: list[RigidBody]) -> Iterator[Effect]:
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
