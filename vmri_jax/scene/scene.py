"""Scenes: bodies and the effects between them, turned into an ordinary `System`."""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, Literal

import jax
import numpy as np

from vmri_jax.mechanics.arrays import is_concrete, require_x64
from vmri_jax.mechanics.names import Names, unknown
from vmri_jax.mechanics.rows import Place
from vmri_jax.mechanics.state import Problem, State, initial_state, tell_of_velocities
from vmri_jax.mechanics.summary import listed, summary
from vmri_jax.mechanics.system import System
from vmri_jax.refusals import Refused
from vmri_jax.running.trajectory import Trajectory, in_coordinates
from vmri_jax.scene import joint_coordinates
from vmri_jax.scene.binding import Key, bound
from vmri_jax.scene.body import AnyBody
from vmri_jax.scene.declare import arrays, items_of
from vmri_jax.scene.drawing import drawing
from vmri_jax.scene.effect import Effect
from vmri_jax.scene.effects.joint_base import Freedom, joint_named
from vmri_jax.scene.functions import Actuation, actuation, build, check_names
from vmri_jax.scene.ledger import Ledger, ledger
from vmri_jax.scene.redundancy import check_constraints, sort_with_loops
from vmri_jax.scene.rigid import Rigidity
from vmri_jax.scene.rows import names_of
from vmri_jax.scene.sorting import Sorting, rows_of
from vmri_jax.scene.trees import Branch, check_frames, grow
from vmri_jax.schemes.composition import Composition
from vmri_jax.schemes.scheme import Scheme


@dataclass(frozen=True, eq=False)
class Scene:
    """Bodies and the effects between them.

        scene = Scene(
            [Body("bob", 100.0, [10, 0, 0]), Body("hook", 1.0, [10, 2, 0]), Body("load", 1.0, [10, 2, 3])],
            [Gravity(), Anchor("bob", [0, 0, 0]), RigidLink(("bob", "hook")), Spring(("hook", "load"), 5000.0)],
        )
        run = simulate(scene, fully_implicit(10), macro_dt=0.01, num_steps=1000)

    Absent terms cost nothing: a scene without constraints gives a system without multipliers, a scene without forces a
    system without a force function. Scenes of the same structure (the same names, bodies of each effect, slow and fast
    bodies) share compiled programs. The numbers of each effect are in the params of the system by its name,
    ``params["springs"]["stiffness"]``.

    Args:
        bodies: list of `Body`, `RigidBody` and `Frame`. The coordinates of slow bodies become q_s and those of fast
            bodies q_f, in the order of the list.
        effects: list of effects of `vmri_jax.scene`, also custom ones: `Potential`, `Constraint`, `Kinetic`, `Force`.
            The scene adds their energies and stacks their constraints in the order of the list.
        project: at the start, move positions onto the constraints and remove the part of the velocities that violates
            them, instead of refusing such a start.
        redundant: for constraints that depend on others, as in a planar loop of hinges: "refuse" raises an error with
            their names, "drop" leaves out as many rows as there are dependences, see `dropped`. The dropped rows must
            follow from the others along the motion, not only at the start: the scene tries random motions, and runs
            watch the rows, see `System.implied`.
        coordinates: of rigid bodies. "joint": bodies in trees are functions of the freedoms of their joints; each
            freedom is a coordinate, zero at the positions in `bodies`, and the joint has no constraint rows. Roots of
            trees other than the ground keep directors; joints that close loops and `Spherical` joints keep their rows.
            "directors": a centre and directors for each body, joints are constraints. "auto": joint coordinates, but
            directors for mechanisms with chains or loops so many that these are faster, see
            `vmri_jax.scene.trees.LONGEST` and `JOINTS_OF_A_LOOP`; the angle of a joint with a spring, a limit or a gear
            is a coordinate there, too.
        joint_starts: values and rates of joint coordinates at the start; `with_joints` sets them. They go before the
            velocities of bodies.

    Raises:
        TypeError: an object of another class in `bodies` or `effects`.
        ValueError: 64-bit mode is off, no bodies, a name that occurs twice, arguments that an effect refuses
            (see its class), redundant constraints, a limit or a neutral angle that an angle of directors cannot reach.
    """

    bodies: Any
    effects: Any = ()
    project: bool = False
    redundant: Literal["refuse", "drop"] = "refuse"
    coordinates: Literal["joint", "directors", "auto"] = "auto"
    joint_starts: Mapping[Key, tuple[Any, Any]] = field(default_factory=dict, repr=False)
    # the problem after the first call of `problem`: building a scene of a hundred joints takes a second
    _problems: list[Problem] = field(default_factory=list, init=False, repr=False)

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
            raise Refused(f"Scene: redundant is {self.redundant!r}; it must be 'refuse' or 'drop'.")
        if self.coordinates not in ("joint", "directors", "auto"):
            raise Refused(f"Scene: coordinates is {self.coordinates!r}; it must be 'joint', 'directors' or 'auto'.")
        for name, kind, expected in (("bodies", AnyBody, "Body, RigidBody or Frame"), ("effects", Effect, "Effect")):
            object.__setattr__(self, name, items_of(f"Scene: {name}", getattr(self, name), kind, expected))
        if not self.bodies:
            raise Refused("Scene: there are no bodies; give at least one.")
        freedoms = [label for branch in self.branches for label in branch.labels if label != branch.joint.name]
        bodies, effects = ([item.name for item in items] for items in (self.bodies, self.everything))
        check_names([*bodies, *effects, *freedoms], effects)
        for effect in self.everything:
            effect.check(self.project)
        check_frames(self.by_name, self.branches)
        check_constraints(self.sorting, self.project)
        joint_coordinates.check_reach(self.sorting)

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
        """The scene of a model of MuJoCo: bodies, inertias, joints with springs, dampers and armature, equalities,
        gravity and gravcomp.

        The reader leaves out features that the flags of the model switch off, and does not refuse them. Every body gets
        the pace "auto"; ``scene.replace("arm", pace="fast")`` changes that.

        Args:
            model: path of an MJCF or URDF file, or a compiled `mujoco.MjModel`.
            qpos, qvel: MuJoCo's coordinates and velocities at the start; by default qpos0 of the model, at rest. The
                reader moves the joints to close loops that qpos leaves open by less than a thousandth of the model's
                extent.
            key: a keyframe of the model, name or number, in place of qpos and qvel.
            ignore: features of the model that the scene leaves out, by the names in the message that refuses them.
            limits: "refuse" a model with joint limits, or read each as a smooth "spring", see `JointLimit`, as stiff as
                MuJoCo's limit for the inertia at the joint.
            coordinates: of the scene; with "directors" each body can have only one joint.

        Raises:
            ImportError: without the package mujoco, or with one before 4.0.
            TypeError: a model of another class, `ignore` that is no list.
            ValueError: a file that MuJoCo cannot read; features that a scene cannot express, all in one list;
                equalities that do not hold at the start; an unknown name in `ignore`, an unknown keyframe; qpos or qvel
                of another shape or not finite.
        """
        from vmri_jax.scene.mujoco import bodies_and_effects  # the package mujoco is an optional dependency

        bodies, effects = bodies_and_effects(model, qpos, qvel, key, ignore, limits, coordinates)
        return cls(bodies, effects, redundant="drop", project=True, coordinates=coordinates)

    @cached_property
    def by_name(self) -> dict[str, AnyBody]:
        """Bodies by name."""
        return {body.name: body for body in self.bodies}

    @cached_property
    def bound(self) -> tuple[Effect, ...]:
        """The effects of the user on the bodies of this scene: their elements, parameters and values at the start, each
        computed once."""
        return bound(self.effects, self.by_name)

    @cached_property
    def branches(self) -> tuple[Branch, ...]:
        """The bodies that are functions of the freedoms of joints, each with its joint and the body that it hangs
        on."""
        if self.coordinates == "directors":
            return ()
        return grow(self.by_name, self.bound, everywhere=self.coordinates == "joint")

    @cached_property
    def everything(self) -> tuple[Effect, ...]:
        """All effects: `Rigidity` of the bodies that have directors, then the effects of the user, all bound to the
        bodies."""
        carried = {branch.child for branch in self.branches}
        rigid = [body.name for body in self.bodies if body.rigid and body.name not in carried]
        return (Rigidity(rigid).bound(self.by_name), *self.bound) if rigid else self.bound

    @cached_property
    def sorting(self) -> Sorting:
        """Which bodies are slow and which are fast, which function of the system each effect is part of, and why."""
        return sort_with_loops(self.by_name, self.everything, self.branches, self.joint_starts, self.redundant)

    @property
    def dropped(self) -> list[str]:
        """Names of the rows of constraints that the scene leaves out because they depend on others."""
        return [row.name for row in rows_of(self.sorting.placed, self.sorting.layout) if not row.kept]

    @property
    def places(self) -> dict[str, Place]:
        """Where each body's coordinates are in q_s and q_f; with joint coordinates, in the (Q_s, Q_f) that
        `Names.kinematics` computes."""
        return self.sorting.layout.bodies

    @cached_property
    def names(self) -> Names:
        """Bodies and constraints by name, in the order of coordinates and rows."""
        return names_of(self.sorting)

    @property
    def params(self) -> dict[str, Any]:
        """Parameters by the name of the effect."""
        return {effect.name: arrays(effect.parameters) for effect in self.everything}

    @property
    def start(self) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        """(q_s, q_f, v_s, v_f) at the start.

        Raises:
            ValueError: velocities of bodies that their joints do not allow, unless `project` is set, which takes the
                nearest allowed ones.
        """
        start, violation = self.sorting.start_and_violation
        if is_concrete(violation):
            tell_of_velocities("Scene", float(violation), self.project, "the joints")
        return start

    @cached_property
    def actuation(self) -> Actuation | None:
        """Forces of the controls, see `Controlled`; None if the scene has none."""
        return actuation(self.sorting)

    def system(self) -> System:
        """The system of the Lagrangian ``T - V - W`` with constraints and forces; each function without effects is
        None."""
        return build(self.sorting, self.sorting.placed)

    def problem(self) -> Problem:
        """The `Problem`: the system with positions and velocities at the start, and with the drawing unless jax.jit,
        grad or vmap traces numbers of the scene."""
        if self._problems:
            return self._problems[0]
        drawn = self.drawing() if is_concrete((self.params, [body.radius for body in self.bodies])) else None
        problem = Problem(self.system(), *self.start, drawing=drawn, project=self.project, names=self.names)
        if is_concrete((problem.system, self.start)):  # traced arrays must not outlive their trace
            self._problems.append(problem)
        return problem

    def state(self) -> State:
        """The consistent initial state, see `initial_state`."""
        return initial_state(self.system(), *self.start, project=self.project)

    def joint_motion(self, run, joint: str, of: Freedom | Literal["auto"] = "auto", pair: int = 0) -> np.ndarray:
        """How far a joint has turned (rad, whole turns included) or moved along its axis (m) from the given position,
        (k,).

        The coordinate of the joint where it has one. Where it has none, turns are counted from node to node by the
        angle and its rate.

        Args:
            run: of this scene.
            joint: name of a joint with an angle or a distance, such as `Revolute`, `Prismatic` or `Cylindrical`.
            of: the freedom, if the joint has several.
            pair: number of the pair of bodies, if the joint has several.

        Raises:
            ValueError: no such joint or freedom; a joint without a coordinate that may turn by half a turn or more
                between two nodes.
            IndexError: no such pair.
        """
        known = joint_named("Scene.joint_motion", joint, self.bound)
        return joint_coordinates.along_run(self.sorting, known, run, of, pair)

    def by_directors(self, run: Trajectory) -> Trajectory:
        """The same run with bodies described by their centres and directors, where joints have rows, multipliers and
        reaction forces.

            scene.by_directors(run).reaction_forces("hinge")["panel"]  # on the centre and the directors of the panel

        Args:
            run: of this scene.

        Raises:
            ValueError: frames without mass, which cannot move by directors; angles too far for effects that take them
                from directors.
        """
        # all bodies slow: on the micro grid, rows that the fast bodies alone cannot satisfy would be refused
        bodies = [replace(body, pace="slow") for body in self.bodies]
        effects = [replace(effect, rate="auto") for effect in self.effects]
        twin = replace(self, bodies=bodies, effects=effects, coordinates="directors", joint_starts={})
        joint_coordinates.check_run(self.sorting, run, twin.sorting)
        q, v = (np.concatenate([of(name) for name in twin.places], axis=-1) for of in (run.position, run.velocity))
        return in_coordinates(run, twin, (q, q[..., :0]), (v, v[..., :0]))

    def without(self, *names: str) -> "Scene":
        """The scene without these effects.

        Args:
            names: of the effects.

        Raises:
            ValueError: a name that no effect has.
        """
        excluded = self._named("without", names)
        return replace(self, effects=[effect for effect in self.effects if effect not in excluded])

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
            changes: new values of its arguments.

        Raises:
            ValueError: no body or effect of this name, an argument that its class does not have, a velocity that a
                joint sets.
        """
        items = {item.name: item for item in (*self.bodies, *self.effects)}
        if name not in items:
            raise Refused(f"Scene.replace: {unknown('body or effect', name, items)}")
        arguments = [argument.name for argument in fields(items[name]) if argument.init]
        for key in changes:
            if key not in arguments:
                raise Refused(f"Scene.replace: {name}: {unknown('argument', key, arguments)}")
        joint_coordinates.check_replaced(name, changes, self.branches, self.joint_starts)
        changed = list((items | {name: replace(items[name], **changes)}).values())
        return replace(self, bodies=changed[: len(self.bodies)], effects=changed[len(self.bodies) :])

    def with_rates(self, rates: Mapping[str, Any]) -> "Scene":
        """The scene with velocities at the start that give joints these rates and satisfy all constraints.

            scene.with_rates({"bearing": 100.0})  # rad/s; all bodies on the crank move with it

        Of all such velocities the scene takes those nearest to the present velocities, in the norm of the kinetic
        energy.

        Args:
            rates: by the name of a joint such as `Revolute` or `Prismatic`: rad/s or m/s, of the second body against
                the first; one number, or a number for each pair of the joint. Of a joint with several freedoms,
                ``{"turn": 1.0, "slide": 0.1}``.

        Raises:
            TypeError: no mapping, or numbers of the scene that jax.jit, grad or vmap traces.
            ValueError: no joint of this name, a joint without this freedom, rates that contradict each other or the
                constraints.
        """
        bodies, starts = joint_coordinates.with_rates(self.sorting, self.bound, self.system(), rates)
        return replace(self, bodies=bodies, joint_starts=starts)

    def with_joints(self, joints: Mapping[str, Any]) -> "Scene":
        """The scene with joints that start at other values or rates; the bodies that they carry move along.

            scene.with_joints({"shoulder": 0.3, "elbow": (-0.5, 2.0), "axle": {"turn": (0.0, 10.0), "slide": 0.1}})

        The positions of the bodies in `bodies` remain the zero of all joint coordinates, and springs still measure
        their rest lengths there. In loops and through gears, joints that are not named follow the named ones.

        Args:
            joints: by the name of the joint: its value, an angle (rad) or a distance (m), or a pair (value, rate); the
                rate is zero by default. Of a joint with several freedoms, a dictionary by their names. For a joint of
                several pairs of bodies, a value or rate is one number for all pairs, or a number for each.

        Raises:
            TypeError: no mapping.
            ValueError: no joint of this name; a joint without this freedom, or without joint coordinates; numbers that
                are not finite; a loop that does not close with these values, or whose last joint, without a coordinate,
                would turn too far for its effects.
        """
        return replace(self, joint_starts=joint_coordinates.joint_starts(self.sorting, self.bound, joints))

    def explain(self, scheme: Scheme | Composition, *, macro_dt: float | None = None, measure: bool = True) -> Ledger:
        """The grid, unknowns, evaluations and computing time that every body and effect adds to a macro step of a
        scheme.

        Args:
            scheme: of the macro steps.
            macro_dt: s, the macro step that is timed; by default micro steps have the length 0.1 / w, with the largest
                frequency w.
            measure: compile and time a macro step, and the first derivatives of every effect; without it the ledger has
                no times.
        """
        return ledger(self.sorting, scheme, macro_dt, measure)

    def drawing(self) -> dict[str, list]:
        """The drawing of the scene as plain lists, strings and numbers, see `vmri_jax.animation.Drawing.from_dict`."""
        return drawing(self.sorting, self.everything)

    def _named(self, method: str, names: Iterable[str]) -> list[Effect]:
        """The effects of these names, in the order of the scene."""
        known = [effect.name for effect in self.effects]
        for name in names:
            if name not in known:
                raise Refused(f"Scene.{method}: {unknown('effect', name, known)}")
        return [effect for effect in self.effects if effect.name in names]
