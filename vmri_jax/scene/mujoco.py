"""Scenes from models of MuJoCo: MJCF and URDF files, read by MuJoCo's own parser as a compiled `mujoco.MjModel`.

Bodies that are welded together are one rigid body; those welded to the world are the ground. Joints become `Spherical`,
`Revolute` and `Prismatic`, their springs and dampers `JointSpring` and `JointDamper`, the equalities connect and weld
`Spherical` and `Fixed`. MuJoCo keeps equalities softly; here they are constraints, kept to round-off.
"""

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from vmri_jax.scene.body import GROUND
from vmri_jax.scene.effect import Effect
from vmri_jax.scene.effects.fields import Gravity
from vmri_jax.scene.effects.joint_effects import JointDamper, JointSpring
from vmri_jax.scene.effects.joints import Fixed, Joint, Prismatic, Revolute, Spherical
from vmri_jax.scene.rigid import RigidBody


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
    if isinstance(model, str | PathLike):
        if not Path(model).is_file():
            raise ValueError(f"Scene.from_mujoco: the file {model} does not exist.")
        try:
            model = mujoco.MjModel.from_xml_path(str(model))  # pyright: ignore
        except ValueError as error:
            raise ValueError(f"Scene.from_mujoco: MuJoCo cannot read {model}: {error}") from error
    if not isinstance(model, mujoco.MjModel):  # pyright: ignore
        raise TypeError(f"Scene.from_mujoco: model is {type(model).__name__}; give a path, or a mujoco.MjModel.")
    reader = _Reader(mujoco, model, qpos, qvel)
    beyond = [f"{name} ({what})" for name, what in reader.beyond() if name not in ignore]
    if beyond:
        raise ValueError(
            f"Scene.from_mujoco: the model has what a scene of rigid bodies does not express: {'; '.join(beyond)}. Leave it out of "
            "the model, or name it in ignore=, as in ignore=['contact']."
        )
    return reader.bodies(), [*reader.joints(), *reader.equalities(), *reader.gravity()]


@dataclass(frozen=True)
class _Reader:
    """A compiled model at one configuration, where its joints are as MuJoCo's kinematics have them."""

    mujoco: Any
    model: Any
    data: Any
    neutral: Any

    def __init__(self, mujoco, model, qpos, qvel):
        start, neutral = mujoco.MjData(model), mujoco.MjData(model)
        for name, given in (("qpos", qpos), ("qvel", qvel)):
            if given is not None:
                value, own = np.asarray(given, dtype=float), getattr(start, name)
                if value.shape != own.shape:
                    raise ValueError(f"Scene.from_mujoco: {name} has shape {value.shape}; the model needs {own.shape}.")
                own[:] = value
        mujoco.mj_forward(model, start)
        mujoco.mj_forward(model, neutral)
        for name, value in (("mujoco", mujoco), ("model", model), ("data", start), ("neutral", neutral)):
            object.__setattr__(self, name, value)

    def beyond(self) -> Iterator[tuple[str, str]]:
        """What a scene does not express: its name in `ignore`, and what there is of it."""
        model, kinds = self.model, self.mujoco.mjtJoint
        counts = {
            "actuators": model.nu,
            "tendons": model.ntendon,
            "flexible bodies": model.nflex,
            "plugins": model.nplugin,
        }
        counts["mocap bodies"] = model.nmocap
        for name, count in counts.items():
            if count:
                yield name, str(count)
        off = int(model.opt.disableflags)
        pairs = self._pairs_in_contact()
        if pairs and not off & int(self.mujoco.mjtDisableBit.mjDSBL_CONTACT):
            yield "contact", f"{pairs} pairs of geoms"
        limited = [self._name("joint", j) for j in range(model.njnt) if model.jnt_limited[j]]
        if limited:
            yield "limits", f"of the joints {', '.join(limited)}"
        for name, values in (("armature", model.dof_armature), ("frictionloss", model.dof_frictionloss)):
            found = [self._name("joint", model.dof_jntid[i]) for i in np.flatnonzero(values)]
            if found:
                yield name, f"of the joints {', '.join(dict.fromkeys(found))}"
        curved = [
            self._name("joint", j)
            for j in range(model.njnt)
            if np.any(getattr(model, "jnt_stiffnesspoly", np.zeros((model.njnt, 1)))[j])
        ]
        if curved:
            yield "springs that are not linear", f"of the joints {', '.join(curved)}"
        sprung = [
            self._name("joint", j)
            for j in range(model.njnt)
            if model.jnt_type[j] in (int(kinds.mjJNT_FREE), int(kinds.mjJNT_BALL))
            and (model.jnt_stiffness[j] or model.dof_damping[model.jnt_dofadr[j]])
        ]
        if sprung:
            yield "springs and dampers of ball and free joints", ", ".join(sprung)
        several = [self._name("body", b) for b in range(1, model.nbody) if model.body_jntnum[b] > 1]
        if several:
            yield "several joints of one body", f"{', '.join(several)}; put a body between them"
        others = [i for i in range(model.neq) if self._equality(i) is None]
        if others:
            yield "equalities", f"{len(others)} that are neither connect nor weld between bodies"
        if model.opt.density or model.opt.viscosity or np.any(model.opt.wind):
            yield "fluid", "density, viscosity or wind"

    def bodies(self) -> list[RigidBody]:
        """One of all bodies that are welded together, at their common centre of mass."""
        found = []
        for root in self._roots():
            members = [b for b in range(self.model.nbody) if self.model.body_weldid[b] == root]
            masses = self.model.body_mass[members]
            mass = float(masses.sum())
            centres = self.data.xipos[members]
            centre = masses @ centres / mass
            inertia = np.zeros((3, 3))
            for b, m, at in zip(members, masses, centres, strict=True):
                axes, arm = self.data.ximat[b].reshape(3, 3), at - centre
                inertia += axes @ np.diag(self.model.body_inertia[b]) @ axes.T
                inertia += m * (arm @ arm * np.eye(3) - np.outer(arm, arm))
            spin, velocity = self._motion(root)
            velocity = velocity + np.cross(spin, centre - self.data.xipos[root])
            found.append(RigidBody(self._name("body", root), mass, inertia, centre, velocity=velocity, spin=spin))
        return found

    def joints(self) -> Iterator[Effect]:
        """Joints, and springs and dampers in them."""
        model, kinds = self.model, self.mujoco.mjtJoint
        for j in range(model.njnt):
            child = model.jnt_bodyid[j]
            between = self._group(model.body_parentid[child]), self._group(child)
            name, at, axis = self._name("joint", j), self.data.xanchor[j].copy(), self.data.xaxis[j].copy()
            kind = model.jnt_type[j]
            if kind == kinds.mjJNT_FREE:
                continue
            if kind == kinds.mjJNT_BALL:
                yield Spherical(between, at, name=name)
                continue
            yield (Revolute if kind == kinds.mjJNT_HINGE else Prismatic)(between, at, axis, name=name)
            start = self.data.qpos[model.jnt_qposadr[j]]
            relaxed = float(model.qpos_spring[model.jnt_qposadr[j]] - start)
            if model.jnt_stiffness[j]:
                yield JointSpring(name, float(np.ravel(model.jnt_stiffness[j])[0]), relaxed, name=f"{name} spring")
            damping = float(np.ravel(model.dof_damping[model.jnt_dofadr[j]])[0])
            if damping:
                yield JointDamper(name, damping, name=f"{name} damper")

    def equalities(self) -> Iterator[Joint]:
        """Loops that are closed by connect or weld."""
        for i in range(self.model.neq):
            if self.model.eq_active0[i]:
                joint = self._equality(i)
                if joint is not None:
                    yield joint

    def gravity(self) -> list[Effect]:
        """Unless it is switched off."""
        off = int(self.model.opt.disableflags) & int(self.mujoco.mjtDisableBit.mjDSBL_GRAVITY)
        vector = self.model.opt.gravity
        return [Gravity(vector.tolist())] if np.any(vector) and not off else []

    def _equality(self, i: int) -> Joint | None:
        model, kinds = self.model, self.mujoco.mjtEq
        kind, (first, second) = model.eq_type[i], (model.eq_obj1id[i], model.eq_obj2id[i])
        of_bodies = model.eq_objtype[i] == self.mujoco.mjtObj.mjOBJ_BODY
        if not of_bodies or kind not in (int(kinds.mjEQ_CONNECT), int(kinds.mjEQ_WELD)):
            return None
        between, name = (self._group(first), self._group(second)), self._name("equality", i)
        if kind == kinds.mjEQ_WELD:
            return Fixed(between, self._world(first, np.zeros(3)), name=name)
        return Spherical(between, self._world(first, model.eq_data[i, :3]), name=name)

    def _world(self, body: int, point) -> np.ndarray:
        """A point in the frame of a body, in space at the start."""
        return self.data.xpos[body] + self.data.xmat[body].reshape(3, 3) @ point

    def _roots(self) -> list[int]:
        """The first of every group of bodies that are welded together, without the world."""
        return [b for b in range(1, self.model.nbody) if self.model.body_weldid[b] == b]

    def _group(self, body: int) -> str:
        root = self.model.body_weldid[body]
        return self._name("body", root) if root else GROUND

    def _motion(self, body: int) -> tuple[np.ndarray, np.ndarray]:
        """Angular velocity, and velocity of the centre of mass, in space."""
        found = np.zeros(6)
        self.mujoco.mj_objectVelocity(self.model, self.data, self.mujoco.mjtObj.mjOBJ_BODY, body, found, 0)
        return found[:3], found[3:]

    def _name(self, kind: str, i: int) -> str:
        """What it is called in the model, or its number."""
        return getattr(self.model, kind)(int(i)).name or f"{kind} {i}"

    def _pairs_in_contact(self) -> int:
        """Pairs of geoms of different bodies, not parent and child, that may collide."""
        model, found = self.model, 0
        group = [model.body_weldid[b] for b in model.geom_bodyid]
        parent = [model.body_weldid[model.body_parentid[root]] for root in group]
        for a in range(model.ngeom):
            for b in range(a):
                meet = (
                    model.geom_contype[a] & model.geom_conaffinity[b]
                    or model.geom_contype[b] & model.geom_conaffinity[a]
                )
                neighbours = group[a] == group[b] or parent[a] == group[b] or parent[b] == group[a]
                found += bool(meet and not neighbours)
        return found
