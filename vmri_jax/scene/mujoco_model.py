"""A compiled model of MuJoCo: names of its elements, its flags, and the features that no scene expresses, by the fields
that bring them about.

A field has its name in Python, ``jnt_stiffness``, ``opt.density``, and a flag the name of its bit,
``opt.disableflags.SPRING``.

Source: the comments in MuJoCo's mjmodel.h, and its documentation, "XML reference".
"""

from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from vmri_jax.mechanics.names import unknown
from vmri_jax.mechanics.summary import listed
from vmri_jax.refusals import Refused
from vmri_jax.scene.body import GROUND

CONSTRAINTS = "CONSTRAINT"
"""The flag that switches off contact, limits, dry friction and equalities at once."""
PASSIVE = "SPRING DAMPER"
"""The flags that together switch off all passive forces, with the forces of the fluid and the compensation of
gravity."""


@dataclass(frozen=True)
class Refusal:
    """A part of a model that no scene expresses; `ignore` may name it unless it is not `ignorable`.

    without: the motion of the model if `ignore` names this part; for a part that it may not name, advice.
    fields: the fields whose entries define the part, each with the flags that switch it off, see `Compiled.off`.
    """

    without: str
    fields: dict[str, tuple[str, ...]] = field(default_factory=dict)
    ignorable: bool = True


REFUSED = {
    "actuators": Refusal(
        "actuators exert no force, and their armature and damping are left out",
        {
            "nactuator": ("ACTUATION",),
            "actuator_armature": (),
            "actuator_damping": ("DAMPER",),
            "actuator_dampingpoly": ("DAMPER",),
        },
    ),
    "tendons": Refusal(
        "their springs, dampers, dry friction and armature do not act",
        {
            "tendon_stiffness": ("SPRING",),
            "tendon_stiffnesspoly": ("SPRING",),
            "tendon_damping": ("DAMPER",),
            "tendon_dampingpoly": ("DAMPER",),
            "tendon_frictionloss": (CONSTRAINTS, "FRICTIONLOSS"),
            "tendon_armature": (),
        },
    ),
    "contact": Refusal(
        "bodies pass through each other",
        {
            "geom_contype": (CONSTRAINTS, "CONTACT"),
            "geom_conaffinity": (CONSTRAINTS, "CONTACT"),
            "npair": (CONSTRAINTS, "CONTACT"),
        },
    ),
    "limits": Refusal(
        'joints turn and slide, and tendons stretch, without end; limits="spring" makes those of joints springs',
        {"jnt_limited": (CONSTRAINTS, "LIMIT"), "tendon_limited": (CONSTRAINTS, "LIMIT")},
    ),
    "armature of ball and free joints": Refusal("it is left out"),
    "frictionloss": Refusal("joints have no dry friction", {"dof_frictionloss": (CONSTRAINTS, "FRICTIONLOSS")}),
    "springs that are not linear": Refusal(
        "the springs that are named are left out, with their linear part",
        {"jnt_stiffnesspoly": ("SPRING",), "jnt_springyield": ("SPRING",)},
    ),
    "dampers that are not linear": Refusal(
        "the dampers that are named are left out, with their linear part", {"dof_dampingpoly": ("DAMPER",)}
    ),
    "springs and dampers of ball and free joints": Refusal("they are left out"),
    "couplings": Refusal("joints and tendons in these equalities move independently"),
    "soft equalities": Refusal(
        "they are kept to round-off, as all equalities are",
        {"eq_solref": (CONSTRAINTS, "EQUALITY"), "eq_solimp": (CONSTRAINTS, "EQUALITY")},
    ),
    "fluid": Refusal("bodies move in a vacuum", {"opt.density": (PASSIVE,), "opt.viscosity": (PASSIVE,)}),
    "mocap bodies": Refusal("they rest where they start", {"nmocap": ()}),
    "plugins": Refusal("their forces do not act", {"nplugin": ()}),
    "sleep": Refusal("bodies at rest are moved like others", {"opt.enableflags.SLEEP": ()}),
    "several joints of one body": Refusal(
        'take coordinates="joint", with hinges and slides in place of a ball', ignorable=False
    ),
    "compensation of gravity by actuators": Refusal(
        "take actuatorgravcomp off the joints: gravcomp of bodies then acts by itself",
        {"jnt_actgravcomp": ("GRAVITY", PASSIVE)},
        ignorable=False,
    ),
    "flexible bodies": Refusal("make them of rigid bodies and joints", {"nflex": ()}, ignorable=False),
}
"""The parts that the reader refuses, by their names in messages and in `ignore`."""
SOFTEST_TIME = 0.02
"""s, default time constant in MuJoCo's solref. The author of a model sets a larger one to get a spring, which a
constraint does not replace; a larger value here accepts such equalities."""
SOFTEST_IMPEDANCE = 0.9
"""Default of the smallest impedance in MuJoCo's solimp. The author of a model sets a smaller one to get a soft
equality, which a constraint does not replace; a larger value here refuses equalities with default numbers."""
ELEMENTS = {"jnt": "joint", "dof": "joint", "body": "body", "tendon": "tendon", "actuator": "actuator"}
"""For each prefix of fields with a row for each element, the word for these elements."""
STATES_ASKED = (0.1, 1.0)
"""Standard deviations, in m, rad, m/s and rad/s, of random changes of the start at which MuJoCo is asked for the forces
of actuators: a force that is zero at the start, as of a servo at its target, is not zero there. More states take
longer."""


@dataclass(frozen=True)
class Compiled:
    """A compiled model: the package mujoco, and `mujoco.MjModel`.

    coordinates: of the scene: by "directors" a body can have one joint.
    data: `mujoco.MjData` at the start, with the controls and activations there; None for the model's own start.
    """

    mujoco: Any
    model: Any
    coordinates: str = "joint"
    data: Any = None

    def off(self, *flags: str) -> bool:
        """Whether opt.disableflags has one of these flags, or all flags in one of these strings ("SPRING DAMPER")."""
        bits, kinds = int(self.model.opt.disableflags), self.mujoco.mjtDisableBit
        return any(all(bits & int(getattr(kinds, f"mjDSBL_{flag}")) for flag in group.split()) for group in flags)

    @property
    def gravity(self) -> np.ndarray:
        """(3,) acceleration, m/s^2; zero if the model switches gravity off."""
        return np.zeros(3) if self.off("GRAVITY") else np.array(self.model.opt.gravity)

    @cached_property
    def extent(self) -> float:
        """Size of the moving bodies, m: of the box around their centres and joints, and their radius of gyration.
        (MuJoCo's own extent may be set by the author for the camera.)"""
        model, moving = self.model, [b for b in range(1, self.model.nbody) if self.root(b)]
        points = np.concatenate([self.data.xipos[moving], self.data.xanchor])
        radii = np.sqrt(model.body_inertia[moving].sum(axis=1) / 2 / np.maximum(model.body_mass[moving], 1e-300))
        return float(np.ptp(points, axis=0).max() + radii.max())

    @property
    def compensated(self) -> list[int]:
        """Numbers of the moving bodies with gravcomp; none where MuJoCo has not counted them, as after a change without
        mj_setConst."""
        if self.off(PASSIVE) or not self.gravity.any() or not self.model.ngravcomp:
            return []
        return [b for b in np.flatnonzero(self.model.body_gravcomp).tolist() if self.root(b)]

    @property
    def equalities(self) -> list[int]:
        """Numbers of the active equalities."""
        return [] if self.off(CONSTRAINTS, "EQUALITY") else np.flatnonzero(self.model.eq_active0).tolist()

    def closes(self, i: int) -> bool:
        """Whether an equality closes a loop: a connect or a weld of bodies or of sites."""
        kinds, objects = self.mujoco.mjtEq, self.mujoco.mjtObj
        is_loop = self.model.eq_type[i] in (int(kinds.mjEQ_CONNECT), int(kinds.mjEQ_WELD))
        return is_loop and self.model.eq_objtype[i] in (int(objects.mjOBJ_BODY), int(objects.mjOBJ_SITE))

    def ties(self, i: int) -> bool:
        """Whether an equality couples hinges and slides, or fixed tendons of hinges and slides."""
        model, kinds = self.model, self.mujoco.mjtEq
        numbers = [int(n) for n in (model.eq_obj1id[i], model.eq_obj2id[i]) if n >= 0]
        if model.eq_type[i] == int(kinds.mjEQ_TENDON):
            wraps = np.concatenate([model.tendon_adr[n] + np.arange(model.tendon_num[n]) for n in numbers])
            if np.any(model.wrap_type[wraps] != int(self.mujoco.mjtWrap.mjWRAP_JOINT)):
                return False
            numbers = model.wrap_objid[wraps]
        elif model.eq_type[i] != int(kinds.mjEQ_JOINT):
            return False
        return not np.any(self.turning[numbers])

    @property
    def turning(self) -> np.ndarray:
        """(njnt,) whether a joint is a ball joint or free: it has several coordinates, with a quaternion."""
        kinds = self.mujoco.mjtJoint
        return np.isin(self.model.jnt_type, [int(kinds.mjJNT_FREE), int(kinds.mjJNT_BALL)])

    def joints_of(self, body: int) -> list[int]:
        """Numbers of the joints of a body, in the order from its parent to the body."""
        model = self.model
        return list(range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]))

    @cached_property
    def roots(self) -> list[int]:
        """The first body of every group of bodies that are welded together, without the groups of the world and of
        mocap bodies."""
        return [b for b in range(1, self.model.nbody) if self.root(b) == b]

    def root(self, body: int) -> int:
        """The first body of the group that a body is welded to; 0 for the groups of the world and of mocap bodies,
        which do not move."""
        root = int(self.model.body_weldid[body])
        return 0 if self.model.body_mocapid[root] >= 0 else root

    def group(self, body: int) -> str:
        """The name in the scene of the rigid body that a body is part of."""
        root = self.root(body)
        return self.name("body", root) if root else GROUND

    def name(self, kind: str, i: int) -> str:
        """Name of an element in the scene: its name in the model, or else its number; "arm joint" if a body has the
        name "arm", too."""
        name = getattr(self.model, kind)(int(i)).name or f"{kind} {int(i)}"
        is_body = self.mujoco.mj_name2id(self.model, self.mujoco.mjtObj.mjOBJ_BODY, name) >= 0
        return f"{name} {kind}" if name == GROUND or (kind != "body" and is_body) else name

    def refuse(self, ignore: Collection[str]) -> None:
        """Raise ValueError with all features of the model that a scene does not express, except those in `ignore`, see
        `REFUSED`."""
        if isinstance(ignore, str):
            raise Refused(f"Scene.from_mujoco: ignore is {ignore!r}; give a list, ignore=[{ignore!r}].")
        ignorable = [kind for kind, refusal in REFUSED.items() if refusal.ignorable]
        for kind in ignore:
            if kind not in REFUSED:
                raise Refused(f"Scene.from_mujoco: ignore: {unknown('name', kind, ignorable)}")
        refused = {kind: part for kind, part in self.beyond() if kind not in ignore or not REFUSED[kind].ignorable}
        if not refused:
            return
        leave_out = [kind for kind in refused if REFUSED[kind].ignorable]
        advice = [f"leave them out of the motion, ignore={leave_out}"] if leave_out else []
        advice += [f"for {kind}, {REFUSED[kind].without}" for kind in refused if not REFUSED[kind].ignorable]
        raise Refused(
            "Scene.from_mujoco: the model has features that a scene of rigid bodies does not express: "
            f"{'; '.join(f'{kind} ({part})' for kind, part in refused.items())}. Change the model, or "
            f"{'; '.join(advice)}."
        )

    def beyond(self) -> Iterator[tuple[str, str]]:
        """The features of the model that a scene does not express: the name in `REFUSED`, and the elements that have
        the feature."""
        model = self.model
        kept = [i for i in self.equalities if self.closes(i) or self.ties(i)]
        # bodies with several joints, if one of these is a ball joint or the scene has directors alone
        several = np.flatnonzero(np.asarray(model.body_jntnum) > 1)
        if self.coordinates != "directors":
            several = [b for b in several if np.any(self.turning[self.joints_of(int(b))])]
        is_sleeping = int(model.opt.enableflags) & int(self.mujoco.mjtEnableBit.mjENBL_SLEEP)
        compensation = "compensation of gravity by actuators"
        parts = {
            "actuators": self._actuators(),
            "contact": self._contact(),
            "armature of ball and free joints": self._listed("joint", self._turning_joints("dof_armature")),
            "springs and dampers of ball and free joints": self._listed("joint", self._sprung()),
            "couplings": self._listed("equality", [i for i in self.equalities if i not in kept]),
            "soft equalities": self._listed("equality", [i for i in kept if self._is_soft(i)]),
            "sleep": "the flag sleep" if is_sleeping else "",
            "several joints of one body": self._listed("body", several),
            compensation: self._acting(REFUSED[compensation]) if self.compensated else "",
        }
        for kind, refusal in REFUSED.items():
            part = parts[kind] if kind in parts else self._acting(refusal)
            if part:
                yield kind, part

    def _acting(self, refusal: Refusal) -> str:
        """The elements with a field of this refusal that is not zero and that no flag switches off."""
        parts = []
        for name, flags in refusal.fields.items():
            values = np.asarray(getattr(self.model.opt if name.startswith("opt.") else self.model, name.split(".")[-1]))
            if self.off(*flags) or not values.any():
                continue
            if values.ndim == 0:
                parts.append(f"{name.removeprefix('opt.')} = {values:g}")
                continue
            kind = ELEMENTS[name.split("_")[0]]
            rows = np.flatnonzero(_rows(values))
            rows = self.model.dof_jntid[rows] if name.startswith("dof_") else rows
            parts.append(self._listed(kind, rows))
        return ", ".join(dict.fromkeys(parts))

    def _listed(self, kind: str, rows) -> str:
        """ "joint a, joint b, ..." without repetitions."""
        return listed(list(dict.fromkeys(f"{kind} {getattr(self.model, kind)(int(i)).name or int(i)}" for i in rows)))

    def _actuators(self) -> str:
        """Actuators with a force, joints with a force of actuators (a range without zero), and all actuators with
        armature or damping."""
        model = self.model
        forces, rates, loads = self._actuation()
        acting = np.zeros(model.nactuator, dtype=bool)
        for values, part in ((forces, "out"), (rates, "act")):
            spans = zip(getattr(model, f"actuator_{part}adr"), getattr(model, f"actuator_{part}num"), strict=True)
            acting |= np.array([values[a : a + n].any() for a, n in spans], dtype=bool)
        for name, flags in REFUSED["actuators"].fields.items():
            if name != "nactuator" and not self.off(*flags):
                acting |= _rows(getattr(model, name))
        limited = model.dof_jntid[loads & (model.jnt_actfrclimited[model.dof_jntid] != 0)]
        if len(limited) and not acting.any():
            return self._listed("joint", limited)
        return self._listed("actuator", np.flatnonzero(acting))

    def _actuation(self) -> list[np.ndarray]:
        """Whether forces of actuators (nout,), rates of activations (na,), forces on velocities (nv,) are not all zero.

        The states are the start and some that differ in all coordinates; controls and activations do not differ.
        """
        model, mujoco, random = self.model, self.mujoco, np.random.default_rng(0)
        data, acting = mujoco.MjData(model), []
        start = data if self.data is None else self.data
        qpos, qvel, act, ctrl = (np.array(a) for a in (start.qpos, start.qvel, start.act, start.ctrl))
        for size in (0.0, *STATES_ASKED):
            data.qpos[:], data.act[:], data.ctrl[:] = qpos, act, ctrl
            mujoco.mj_integratePos(model, data.qpos, size * random.normal(size=model.nv), 1.0)
            data.qvel[:] = qvel + size * random.normal(size=model.nv)
            mujoco.mj_forward(model, data)
            acting.append([np.array(values) != 0 for values in (data.actuator_force, data.act_dot, data.qfrc_actuator)])
        return [np.any(kind, axis=0) for kind in zip(*acting, strict=True)]

    def _contact(self) -> str:
        pairs = self.touching()
        if not len(pairs):
            return ""
        model, several = self.model, "s" if len(pairs) > 1 else ""
        bodies = [model.body(int(model.geom_bodyid[g])).name or f"body {model.geom_bodyid[g]}" for g in pairs[0]]
        return f"{len(pairs)} pair{several} of geoms, as of {bodies[0]} and {bodies[1]}"

    def touching(self) -> np.ndarray:
        """(n, 2) pairs of geoms that may collide by MuJoCo's rules for types, parents and exclusions, and pairs that
        the model names."""
        model = self.model
        if self.off(CONSTRAINTS, "CONTACT"):
            return np.zeros((0, 2), dtype=int)
        body = np.asarray(model.geom_bodyid)
        weld = model.body_weldid[body]
        group, parent = np.array([self.root(b) for b in body], dtype=int), model.body_weldid[model.body_parentid[weld]]
        kind, affinity = np.asarray(model.geom_contype), np.asarray(model.geom_conaffinity)
        meet = (kind[:, None] & affinity) | (affinity[:, None] & kind) != 0
        if not self.off("FILTERPARENT"):  # parents and children do not collide, unless the parent is the world
            child = (weld[:, None] == parent) & (weld[:, None] != 0) & (weld != 0)
            meet &= ~(child | child.T)
        for first, second in zip(*np.divmod(model.exclude_signature, 1 << 16), strict=True):
            excluded = (body[:, None] == first) & (body == second)
            meet &= ~(excluded | excluded.T)
        for first, second in zip(model.pair_geom1, model.pair_geom2, strict=True):  # named pairs override exclusions
            meet[first, second] = meet[second, first] = True
        meet &= group[:, None] != group  # bodies that are welded together do not move against each other
        return np.argwhere(np.triu(meet))

    def _turning_joints(self, field: str) -> list:
        """Ball and free joints with an entry of a field of velocities that is not zero."""
        return [j for j in self.model.dof_jntid[np.flatnonzero(getattr(self.model, field))] if self.turning[j]]

    def _sprung(self) -> list:
        """Ball and free joints with a spring or a damper, in their order."""
        sprung = (
            [] if self.off("SPRING") else np.flatnonzero(self.turning & (np.asarray(self.model.jnt_stiffness) != 0))
        )
        return sorted({*sprung, *([] if self.off("DAMPER") else self._turning_joints("dof_damping"))})

    def _is_soft(self, i: int) -> bool:
        """Whether an equality is softer than by default, or has a solref with negative numbers, which define a
        spring."""
        time, impedance = self.model.eq_solref[i, 0], self.model.eq_solimp[i, :2].min()
        return not (0 < time <= SOFTEST_TIME and impedance >= SOFTEST_IMPEDANCE)


def _rows(values: Any) -> np.ndarray:
    """(n,) whether a row of a field has an entry that is not zero."""
    return np.any(values, axis=tuple(range(1, np.ndim(values))))
