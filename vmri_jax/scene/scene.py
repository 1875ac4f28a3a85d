"""Scenes: bodies and the effects between them, turned into an ordinary `System`."""

from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import jax
import numpy as np

from vmri_jax.mechanics.arrays import is_concrete
from vmri_jax.mechanics.checks import require_x64
from vmri_jax.mechanics.names import Names, unknown
from vmri_jax.mechanics.rows import Place
from vmri_jax.mechanics.state import Problem, State, initial_state, tell_of_velocities
from vmri_jax.mechanics.summary import listed, summary
from vmri_jax.mechanics.system import System
from vmri_jax.running.trajectory import Trajectory
from vmri_jax.scene.assembly import actuation, build
from vmri_jax.scene.body import AnyBody, Frame
from vmri_jax.scene.effect import Effect
from vmri_jax.scene.effects.joints import Joint, along_run
from vmri_jax.scene.labels import names_of
from vmri_jax.scene.ledger import Ledger, ledger
from vmri_jax.scene.redundancy import check_constraints, dropped_rows, without_redundant
from vmri_jax.scene.rigid import RigidBody, Rigidity
from vmri_jax.scene.sorting import Sorting, sort
from vmri_jax.scene.terms import RESERVED, Actuation
from vmri_jax.scene.trees import Branch, check_frames, grow, shallow
from vmri_jax.scene.velocities import joint_starts, with_rates
from vmri_jax.schemes.composition import Composition
from vmri_jax.schemes.scheme import Scheme

EXPECTED = {"bodies": "Body, RigidBody or Frame", "effects": "Effect"}
DRAWN_LISTS = ("solids", "links", "springs", "anchors", "planes", "spheres")
"""Entries of a drawing to which effects add."""


@dataclass(frozen=True, eq=False)
class Scene:
    """Bodies and the effects between them.

        scene = Scene(
            [Body("bob", 100.0, [10, 0, 0]), Body("hook", 1.0, [10, 2, 0]), Body("load", 1.0, [10, 2, 3])],
            [Gravity(), Anchor("bob", [0, 0, 0]), RigidLink(("bob", "hook")), Spring(("hook", "load"), 5000.0)],
        )
        run = simulate(scene.system(), fully_implicit(10), scene.state(), macro_dt=0.01, num_steps=1000)

    What the scene does not call for does not exist in its system: no function, no unknown, no evaluation. Scenes of the
    same structure (names, who touches whom, who is slow and fast) give systems that share compiled programs, whatever their
    numbers; these are in the system's params by the name of the effect, ``params["springs"]["stiffness"]``.

    Args:
        bodies: of `Body`, `RigidBody` and `Frame`; slow ones become q_s and fast ones q_f, in this order.
        effects: of `vmri_jax.scene`, also custom ones: `Potential`, `Constraint`, `Kinetic`, `Force`. Energies are
            summed and constraints joined in this order.
        project: move positions onto the constraints at the start, and take away what of the velocities points against them,
            instead of refusing them.
        redundant: what is done about constraints that depend on others, as in a planar loop of hinges: "refuse" names them,
            "drop" leaves as many rows of them out as are too many, see `dropped`. These must follow from the others along the motion,
            not only at the start: the scene tries random motions, and runs watch the rows, see `System.implied`.

        coordinates: of rigid bodies, "directors" for a centre and directors each, tied by joints as constraints; "joint" for bodies that
            are functions of the freedoms of joints, along trees. Then every such joint adds a coordinate for each of its freedoms, zero at
            the start, and no row; roots of trees that are not the ground keep directors, a joint that closes a loop its rows, and
            a `Spherical` one, too. "auto" for joint coordinates of trees that are not deep, where they are faster, see
            `vmri_jax.scene.trees.LONGEST`.
        joint_starts: values and rates of their coordinates at the start, see `with_joints`, which sets them.

    Raises:
        TypeError: something else among them.
        ValueError: 64-bit mode is off, no bodies, names that occur twice, what is wrong with an effect (see there), redundant constraints.
    """

    bodies: Any
    effects: Any = ()
    project: bool = False
    redundant: Literal["refuse", "drop"] = "refuse"
    coordinates: Literal["joint", "directors", "auto"] = "directors"
    joint_starts: Mapping[tuple[str, int, str], tuple[Any, Any]] = field(default_factory=dict, repr=False)

    def __repr__(self) -> str:
        effects = [effect.name for effect in self.effects]
        return summary(
            f"Scene of {len(self.bodies)} bodies and {len(effects)} effects",
            {"bodies": listed([body.name for body in self.bodies]), "effects": listed(effects)}
            | {"to see more": "scene.explain(scheme), scene.system(), scene.problem()"},
        )

    def __post_init__(self):
        require_x64()
        if self.redundant not in ("refuse", "drop"):
            raise ValueError(f"Scene: redundant is {self.redundant!r}; it must be 'refuse' or 'drop'.")
        if self.coordinates not in ("joint", "directors", "auto"):
            raise ValueError(f"Scene: coordinates is {self.coordinates!r}; it must be 'joint', 'directors' or 'auto'.")
        for name, kind in (("bodies", AnyBody), ("effects", Effect)):
            items = getattr(self, name)
            if isinstance(items, kind) or not isinstance(items, Iterable):
                raise TypeError(f"Scene: {name} is {items!r}; give a list.")
            object.__setattr__(self, name, tuple(items))
            for item in getattr(self, name):
                if not isinstance(item, kind):
                    raise TypeError(f"Scene: {item!r} is among {name}; it must be {EXPECTED[name]}.")
        if not self.bodies:
            raise ValueError("Scene: there are no bodies; give at least one.")
        for name, count in Counter(item.name for item in (*self.bodies, *self.everything)).items():
            if count > 1:
                raise ValueError(
                    f"Scene: the name {name!r} occurs twice; give each body and effect its own, e.g. name=..."
                )
        for name, content in RESERVED.items():
            if name in [effect.name for effect in self.effects]:
                raise ValueError(
                    f"Scene: an effect is called {name!r}, where the params keep {content}; give it another name."
                )
        potentials = [effect.name for effect in self.effects if effect.kind == "potential"]
        for effect in self.everything:
            effect.check(self.by_name, self.project)
            for name in effect.refers_to:
                if name not in potentials:
                    raise ValueError(f"{effect.name}: {unknown('potential', name, potentials)}")
        check_frames(self.by_name, self.branches)
        check_constraints(self.sorting)

    @classmethod
    def from_mujoco(
        cls,
        model: Any,
        *,
        qpos: Any = None,
        qvel: Any = None,
        key: str | int | None = None,
        ignore: Collection[str] = (),
        limits: Literal["refuse", "spring"] = "refuse",
        coordinates: Literal["joint", "directors"] = "joint",
    ) -> "Scene":
        """The scene of a model of MuJoCo: bodies, inertias, joints with springs, dampers and armature, equalities, gravity and gravcomp.

        Flags of the model are heard: what they switch off neither acts nor is refused. All bodies decide their pace by
        themselves; ``scene.replace("arm", pace="fast")`` changes that.

        Args:
            model: path of an MJCF or URDF file, or a compiled `mujoco.MjModel`.
            qpos, qvel: MuJoCo's coordinates and velocities at the start; None for those of the model, at rest. Loops that
                qpos leaves open by less than a thousandth of the model's extent are closed by moving the joints.
            key: a keyframe of the model, name or number, in place of qpos and qvel.
            ignore: what is left out of the motion although the model has it, by the names in the message that refuses it.
            limits: "spring" for limits of joints as smooth springs, see `JointLimit`, as stiff as MuJoCo's for the inertia at the joint.
            coordinates: of the scene; by "directors" each body can have one joint.

        Raises:
            ImportError: without the package mujoco, or with one before 4.0.
            TypeError: a model of another kind, names to ignore that are no list.
            ValueError: a file that MuJoCo cannot read; all that a scene does not express, in one list; equalities that do not hold at
                the start; an unknown name to ignore, or keyframe; qpos or qvel of another shape or not finite.
        """
        from vmri_jax.scene.mujoco import bodies_and_effects  # its package is an extra

        made = bodies_and_effects(model, qpos, qvel, key, ignore, limits, coordinates)
        return cls(*made, redundant="drop", project=True, coordinates=coordinates)

    @cached_property
    def by_name(self) -> dict[str, AnyBody]:
        """Bodies by name."""
        return {body.name: body for body in self.bodies}

    @cached_property
    def branches(self) -> tuple[Branch, ...]:
        """The bodies that are functions of the freedoms of joints."""
        if self.coordinates == "directors":
            return ()
        branches = grow(self.by_name, self.effects)
        return branches if self.coordinates == "joint" else shallow(branches)

    @cached_property
    def everything(self) -> tuple[Effect, ...]:
        """The effects, after what keeps rigid bodies rigid; with the joints that they name."""
        carried = {branch.child for branch in self.branches}
        rigid = [body.name for body in self.bodies if body.rigid and body.name not in carried]
        effects = tuple(effect.bound(self.effects) for effect in self.effects)
        return (Rigidity(rigid), *effects) if rigid else effects

    @cached_property
    def sorting(self) -> Sorting:
        """Who is slow and who is fast, where every effect lives, and why."""
        found = replace(sort(self.by_name, self.everything, self.branches), joint_starts=self.joint_starts)
        return without_redundant(found) if self.redundant == "drop" else found

    @property
    def dropped(self) -> list[str]:
        """Names of the rows of constraints that are left out, as they depend on others."""
        return dropped_rows(self.sorting)

    @property
    def places(self) -> dict[str, Place]:
        """Where each body's coordinates are in q_s and q_f; of bodies on joints, in (Q_s, Q_f) of `Names.kinematics`."""
        return self.sorting.places

    @cached_property
    def names(self) -> Names:
        """Bodies and constraints by name, in the order of coordinates and rows."""
        return names_of(self.sorting)

    @property
    def params(self) -> dict[str, Any]:
        """Parameters by the name of the effect."""
        return {effect.name: effect.parameters(self.by_name) for effect in self.everything}

    @property
    def start(self) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        """(q_s, q_f, v_s, v_f) at the start.

        Raises:
            ValueError: velocities of bodies that their joints do not allow, unless `project` takes the nearest.
        """
        start, missed = self.sorting.start, self.sorting.missed
        if is_concrete(missed):
            tell_of_velocities("Scene", float(missed), self.project, "the joints")
        return start

    @cached_property
    def actuation(self) -> Actuation | None:
        """Forces of the controls, see `Controlled`; None where nothing is controlled."""
        return actuation(self.sorting)

    def system(self) -> System:
        """The system: ``T - V - W`` with constraints and forces, each None where no effect calls for it."""
        return build(self.sorting, self.sorting.placed)

    def problem(self) -> Problem:
        """The system with positions and velocities at the start, and with the drawing unless its numbers are traced."""
        if self._problems:
            return self._problems[0]
        seen = is_concrete((self.params, [body.radius for body in self.bodies]))
        drawing = self.drawing() if seen else None
        made = Problem(self.system(), *self.start, drawing=drawing, project=self.project, names=self.names)
        if is_concrete((made.system, self.start)):
            self._problems.append(made)
        return made

    @cached_property
    def _problems(self) -> list[Problem]:
        """What `problem` has built, kept unless its numbers are traced: a scene of a hundred joints takes a second."""
        return []

    def state(self) -> State:
        """The consistent initial state, see `initial_state`."""
        return initial_state(self.system(), *self.start, project=self.project)

    def joint_motion(self, run, joint: str, of: Literal["turn", "slide", "auto"] = "auto", pair: int = 0) -> np.ndarray:
        """How far a joint has turned (rad) or moved along its axis (m) since the start, (k,).

        Args:
            run: of this scene.
            joint: name of the joint, a `Revolute`, `Prismatic` or `Cylindrical`.
            of: which of both, where the joint leaves both free.
            pair: number of the pair of bodies, where it joins several.

        Raises:
            ValueError: no joint of this name, or one that leaves no such freedom.
            IndexError: no such pair.
        """
        joints = {effect.name: effect for effect in self.effects if isinstance(effect, Joint)}
        if joint not in joints:
            raise ValueError(f"Scene.joint_motion: {unknown('joint', joint, joints)}")
        return along_run(joints[joint], run, self.by_name, of, pair)

    def by_directors(self, run: Trajectory) -> Trajectory:
        """A run in joint coordinates as one of the same scene by directors: its joints have rows, multipliers and reaction forces.

            scene.by_directors(run).reaction_forces("hinge")["panel"]  # on the centre and the directors of the panel

        Args:
            run: of this scene.

        Raises:
            ValueError: the scene has frames without mass, which cannot move by directors.
        """
        frames = [body.name for body in self.bodies if isinstance(body, Frame)]
        if frames:
            raise ValueError(
                f"Scene.by_directors: {', '.join(frames)} have no mass, and bodies by directors need some. Reaction forces are known of scenes "
                "without frames: join bodies by Universal, Cylindrical or Planar, or put bodies of small mass in place of the frames."
            )
        bodies = [replace(body, pace="slow") for body in self.bodies]  # all rows on one grid: none is too many there
        effects = [replace(effect, rate="auto") for effect in self.effects]
        twin = replace(self, bodies=bodies, effects=effects, coordinates="directors", joint_starts={})
        arrays: dict[str, Any] = {}
        for letter, of_body in (("q", run.position), ("p", run.momentum)):
            for part in ("s", "f"):
                places = {name: place for name, place in twin.places.items() if place.part == part}
                pieces = [of_body(name) for name in sorted(places, key=lambda name: places[name].start)]
                arrays[f"{letter}_{part}"] = np.concatenate(pieces, axis=-1) if pieces else run.states.q_s[..., :0]
        return run.with_arrays(**arrays, t_micro=None, q_f_micro=None).of(twin)

    def without(self, *names: str) -> "Scene":
        """The scene without these effects.

        Args:
            names: of the effects.

        Raises:
            ValueError: a name that no effect has.
        """
        found = self._named("without", names)
        return replace(self, effects=[effect for effect in self.effects if effect not in found])

    def only(self, *names: str) -> "Scene":
        """The scene with these effects and no other.

        Args:
            names: of the effects.

        Raises:
            ValueError: a name that no effect has.
        """
        return replace(self, effects=self._named("only", names))

    def replace(self, name: str, **changes) -> "Scene":
        """The scene with a body or an effect changed, ``scene.replace("springs", stiffness=2.0)``.

        Args:
            name: of the body or effect.
            changes: its arguments that are new.

        Raises:
            ValueError: a name that no body or effect has, or an argument that it does not have.
        """
        items = {item.name: item for item in (*self.bodies, *self.effects)}
        if name not in items:
            raise ValueError(f"Scene.replace: {unknown('body or effect', name, items)}")
        fields = items[name].__dataclass_fields__
        for key in changes:
            if key not in fields:
                raise ValueError(f"Scene.replace: {name}: {unknown('argument', key, fields)}")
        items[name] = replace(items[name], **changes)
        changed = list(items.values())
        return replace(self, bodies=changed[: len(self.bodies)], effects=changed[len(self.bodies) :])

    def with_rates(self, rates: Mapping[str, Any]) -> "Scene":
        """The scene with velocities that have these rates in joints, and keep all constraints, at the start.

            scene.with_rates({"bearing": 100.0})  # rad/s; all that hangs on the crank moves with it

        What the rates leave open stays as near to the velocities that the bodies have, in the norm of the kinetic energy.

        Args:
            rates: by the name of a `Revolute`, `Prismatic` or `Cylindrical`: rad/s or m/s, of the second body against the first; one
                number, or one for each pair of the joint. Of a joint that does both, ``{"turn": 1.0, "slide": 0.1}``.

        Raises:
            TypeError: no mapping, or numbers of the scene that are traced.
            ValueError: no joint of this name, one that leaves no such freedom, rates that cannot be together.
        """
        bodies, starts = with_rates(self.sorting, self.effects, self.system(), rates)
        return replace(self, bodies=bodies, joint_starts=starts)

    def with_joints(self, joints: Mapping[str, Any]) -> "Scene":
        """The scene with joints that start with other angles or ways, and rates; what they carry moves along.

            scene.with_joints({"shoulder": 0.3, "elbow": (-0.5, 2.0), "axle": {"turn": (0.0, 10.0), "slide": 0.1}})

        Angles and ways stay zero where the bodies are as they are given, and so do rest positions that springs measure there. In loops, and by gears,
        the joints that are not named follow.

        Args:
            joints: by the name of the joint: an angle (rad) or a way (m), or a pair of it and its rate, which is zero by default; of a joint
                with several freedoms by their names. For a joint of several pairs of bodies each may be one number for all, or one for each.

        Raises:
            TypeError: no mapping.
            ValueError: no joint of this name, one that leaves no such freedom or has no coordinate of its own, numbers that are not finite, a
                loop that does not close with them, and by how much.
        """
        return replace(self, joint_starts={**self.joint_starts, **joint_starts(self.sorting, self.effects, joints)})

    def explain(self, scheme: Scheme | Composition, *, macro_dt: float | None = None, measure: bool = True) -> Ledger:
        """What every body and effect adds to a macro step of a scheme: where it lives, unknowns, evaluations, and its cost.

        Args:
            scheme: how the steps are taken.
            macro_dt: step that is measured; by default micro steps of a tenth of the fastest vibration's radian.
            measure: compile and time a macro step, and the first derivatives of every effect; without, the ledger costs nothing.
        """
        return ledger(self.sorting, scheme, macro_dt, measure)

    def drawing(self) -> dict[str, list]:
        """What the scene looks like as plain lists, strings and numbers, see `vmri_jax.animation.Drawing.from_dict`."""
        seen: dict[str, Any] = {kind: [] for kind in ("bodies", "blocks", *DRAWN_LISTS)}
        radii = {body.name: float(body.radius) for body in self.bodies if body.radius is not None}
        for body in self.bodies:
            part, start, size = self.places[body.name]
            axes = [[part, start + i] for i in range(size)]
            if isinstance(body, RigidBody):
                for kind, entries in body.drawing(part, start).items():
                    seen[kind] += entries
            elif not isinstance(body, Frame):
                seen["blocks" if body.block else "bodies"].append({"name": body.name, "coordinates": axes})
        seen["bodies"] += self._drawn_points()
        for effect in self.everything:
            parts = effect.drawing(self.by_name)
            for kind in DRAWN_LISTS:
                seen[kind] += parts.get(kind, [])
            radii |= dict(parts.get("radii", []))
            if "up" in parts:
                seen["up"] = parts["up"]
        for entry in seen["bodies"]:
            if entry["name"] in radii:
                entry["radius"] = radii[entry["name"]]
        if (kinematics := self.sorting.layout.kinematics) is not None:
            joints = {name: np.asarray(values).tolist() for name, values in self.sorting.joints.items()}
            seen["kinematics"] = {"map": kinematics.to_dict(), "joints": joints}
        return seen

    def _drawn_points(self) -> list[dict[str, Any]]:
        """Points in rigid bodies where something drawn ends, as bodies that are not shown."""
        found = {}
        for effect in self.everything:
            for label, (name, weights) in effect.drawn_points(self.by_name).items():
                part, start, size = self.places[name]
                along = [1.0, *np.asarray(weights).tolist()][: size // 3]
                forms = [[[w, part, start + 3 * k + i] for k, w in enumerate(along) if w] for i in range(3)]
                found[label] = {"name": label, "coordinates": forms, "shown": ""}
        return list(found.values())

    def _named(self, what: str, names: Iterable[str]) -> list[Effect]:
        """The effects of these names, in the order of the scene."""
        known = [effect.name for effect in self.effects]
        for name in names:
            if name not in known:
                raise ValueError(f"Scene.{what}: {unknown('effect', name, known)}")
        return [effect for effect in self.effects if effect.name in names]
