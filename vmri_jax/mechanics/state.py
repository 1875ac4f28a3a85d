"""States (time, positions and momenta on the constraint manifold), and the start of a run: `initial_state` and
`Problem`."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from vmri_jax.mechanics.arrays import Known, Number, Numbers, is_concrete, is_known, of_one_type, require_x64
from vmri_jax.mechanics.by_name import constraint_sizes, flat_system
from vmri_jax.mechanics.checks import check_arrays, check_flags, check_number, check_params, check_system, check_type
from vmri_jax.mechanics.consistent import consistent_momenta, project_positions
from vmri_jax.mechanics.constraints import START_TOLERANCE, check_constraints, check_mass
from vmri_jax.mechanics.names import Names
from vmri_jax.mechanics.rows import Part
from vmri_jax.mechanics.slots import Slots
from vmri_jax.mechanics.summary import coordinates, has_values, listed, numbers, summary
from vmri_jax.mechanics.system import System
from vmri_jax.refusals import Refused, warn_user

REPORTED_VIOLATION = 1e-6
"""Violation of the constraints by the velocities, relative to their norm (of the kinetic energy), above which a warning
is given. A smaller value warns about rounded starts, a larger one passes over mistakes."""
REFUSED_VIOLATION = 1e-2
"""Violation, as in REPORTED_VIOLATION, above which a start is refused.

A smaller value refuses rounded starts, a larger one passes over mistakes.
"""
REPORTED_PROJECTION = 0.85
"""Violation, as in REPORTED_VIOLATION, above which a warning is given even with ``project=True``: a projection that
removes most of the velocities is hardly intended. A larger value passes over mistakes."""
A_SYSTEM = "a vmri_jax.System; of a scene its .system(), of a problem its .system"
"""A right argument in messages about objects that are no system."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class State:
    """Time, positions of the slow and of the fast variables, and their conjugate momenta."""

    t: Number
    q_s: Float[Numbers, "n_s"]
    q_f: Float[Numbers, "n_f"]
    p_s: Float[Numbers, "n_s"]
    p_f: Float[Numbers, "n_f"]

    def __eq__(self, other) -> Any:
        return eqx.tree_equal(self, other)

    def __repr__(self) -> str:
        if not has_values(self) or np.ndim(self.t) or np.ndim(self.q_s) != 1:
            return eqx.tree_pformat(self)
        vectors = {"q_s": self.q_s, "q_f": self.q_f, "p_s": self.p_s, "p_f": self.p_f}
        return summary(f"State at t = {float(self.t):.6g}", {name: numbers(a) for name, a in vectors.items()})


def initial_state(
    system: Any,
    q_s=None,
    q_f=None,
    v_s=None,
    v_f=None,
    t: Number | None = None,
    *,
    project: bool | None = None,
    tolerance=START_TOLERANCE,
) -> State:
    """Consistent state from positions and velocities: ``p = dT/dv``, projected onto the hidden constraints.

        vm.initial_state(problem)
        vm.initial_state(problem, v_f={"load": [0.0, 0.1]}, t=2.0)
        vm.initial_state(system, q_s, q_f, v_s, v_f)

    Args:
        system: a `Problem` or a scene, or a `System`.
        q_s, q_f, v_s, v_f: (n_s,), (n_f,) arrays of float64, or for a problem as of `Problem`; None for the arrays of
            the problem, of a system for no velocity.
        t: start time; None for the time of the problem, or 0.
        project: move positions onto the constraints, and velocities onto the hidden constraints, instead of refusing
            them. A warning tells of velocities of which the projection leaves little. None for the choice of the
            problem, of a system for no projection.
        tolerance: largest value of a satisfied constraint, relative to its size, mostly of the terms that cancel in it:
            ``|d| + L`` of ``|d| - L``.

    Raises:
        TypeError: a system without positions.
        ValueError: float32 data or 64-bit mode off, wrong shapes, not finite, positions that violate a constraint
            (with the size of the violation), velocities against a constraint, constraints that the fast variables
            cannot satisfy, a kinetic energy without mass along some coordinate. Within transformations of JAX,
            positions that violate a constraint and velocities against a constraint are starts of runs that fail at
            once, see `vmri_jax.Result`.
    """
    require_x64()
    start = {"q_s": q_s, "q_f": q_f, "v_s": v_s, "v_f": v_f, "t": t}
    problem = opened(system)
    if isinstance(problem, Problem):
        changes = {name: value for name, value in start.items() if value is not None}
        problem = replace(problem, **changes) if changes else problem
        system, start = problem.system, {name: getattr(problem, name) for name in start}
        project = problem.project if project is None else project
    check_type("initial_state: system", system, System, f"a vmri_jax.Problem, a scene, or {A_SYSTEM}")
    q_s, q_f, v_s, v_f, t = start.values()
    if q_s is None or q_f is None:
        raise Refused(
            "initial_state: a System has no start; give q_s and q_f, or a Problem(system, q_s, q_f, v_s, v_f) alone."
        )
    check_params(system.params)
    system = of_one_type(system)
    for name, value in start.items():
        if isinstance(value, Mapping):
            raise Refused(
                f"initial_state: {name} is a dictionary; give real numbers, or Problem(system, q_s, q_f, v_s, "
                "v_f).state(): a problem knows the order of the bodies."
            )
    project = False if project is None else project
    check_flags(project=project)
    t = check_number("t", 0.0 if t is None else t)
    check_number("tolerance", tolerance)
    v_s, v_f = (np.zeros(np.shape(q)) if v is None else v for q, v in ((q_s, v_s), (q_f, v_f)))
    q_s, q_f, v_s, v_f = check_arrays(q_s=q_s, q_f=q_f, v_s=v_s, v_f=v_f)
    arguments = system, t, q_s, q_f, v_s, v_f
    if not is_known(arguments):
        if is_concrete((system, q_s, q_f)) and not system.has_constant_mass:
            check_system(system, q_s, q_f)
            check_mass(system, q_s, q_f)
        return _traced_start(arguments, project)
    state, violation = _checked_start(Known(arguments), project, tolerance)
    at_rest = not any(np.asarray(v).any() for v in (v_s, v_f))
    tell_of_velocities("initial_state", violation, project, at_rest=at_rest)
    return state


def _start(arguments, project: bool):
    """The state with projected momenta, with projected positions if `project`, and the violation of
    `consistent_momenta`."""
    system, t, q_s, q_f, *velocities = arguments
    if project and system.is_constrained:
        q_s, q_f = project_positions(system, t, q_s, q_f)
    check_system(system, q_s, q_f)
    p_s, p_f, violation = consistent_momenta(system, t, q_s, q_f, *velocities)
    return State(t, q_s, q_f, p_s, p_f), violation


def _traced_start(arguments, project: bool) -> State:
    """The state in a program, which cannot refuse: of velocities against the constraints it has momenta that are NaN,
    so that its run fails."""
    state, violation = _start(arguments, project)
    if project or not arguments[0].is_constrained:
        return state
    _, _, _, _, *velocities = arguments
    is_moving = jnp.any(jnp.concatenate(velocities) != 0.0)  # at rest, moving constraints give the velocities
    fits = (jax.lax.stop_gradient(violation) <= REFUSED_VIOLATION) | ~is_moving
    return replace(state, **{name: jnp.where(fits, getattr(state, name), jnp.nan) for name in ("p_s", "p_f")})


@lru_cache(maxsize=256)
def _checked_start(known: Known, project: bool, tolerance: float) -> tuple[State, float]:
    """`_start` after all checks, which take longer than a short run: equal starts are made once."""
    system, _, q_s, q_f, *_ = known.tree
    if not system.has_constant_mass:  # before the projection, which divides by the masses
        check_system(system, q_s, q_f)
        check_mass(system, q_s, q_f)
    # copies: JAX takes the memory of arrays of NumPy as it is, and users go on writing to theirs
    state, violation = jax.device_put(jax.tree.map(np.array, _start(known.tree, project)))
    advice = (
        "projection did not reach the constraints; start closer to them."
        if project
        else "correct the positions, or pass project=True to move them onto the constraints."
    )
    check_constraints(system, state, "initial_state: the initial positions", tolerance, advice)
    if not all(np.isfinite(p).all() for p in (state.p_s, state.p_f)):
        raise Refused(
            "initial_state: the momenta are not finite. The mass matrix d2T/dv2 or the constraint Jacobian is "
            "singular at the initial positions, or a function returned NaN there."
        )
    return state, float(violation)


def tell_of_velocities(
    caller: str, violation: float, project: bool, constraints: str = "the constraints", at_rest: bool = False
) -> None:
    """Warn about velocities that violate the hidden constraints, and refuse a large violation.

    Args:
        caller: name of the caller in the message.
        violation: as of `consistent_momenta`.
        project: whether the user wants the projected velocities.
        constraints: name of the constraints in the message.
        at_rest: whether all velocities of the user are zero; moving constraints may demand others, which are then
            taken.
    """
    message = (
        f"{caller}: the velocities differ by {violation:.2%} (in the norm of the kinetic energy) from the nearest "
        f"velocities that fit {constraints}"
    )
    scenes = "for a scene, with_rates({joint: rate}) gives all velocities that belong to the rate of a joint"
    if project and violation > REPORTED_PROJECTION and not at_rest:
        warn_user(f"{message}, and project=True has replaced them; {scenes}.")
    if project:
        return
    if at_rest and violation > REPORTED_VIOLATION:
        warn_user(
            f"{caller}: all velocities are zero, but {constraints} move; the nearest velocities that fit are taken. "
            "Pass project=True if that is meant.",
        )
    elif violation > REFUSED_VIOLATION:
        raise Refused(
            f"{message}. Correct the velocities, or pass project=True for the nearest consistent velocities; {scenes}."
        )
    elif violation > REPORTED_VIOLATION:
        warn_user(f"{message}; the nearest consistent velocities are taken. Pass project=True if that is meant.")


@dataclass(frozen=True)
class Problem:
    """A system with initial positions and velocities.

    Positions may be dictionaries, an array of any shape for each body,
    ``q_f={"hook": [3.0, -4.0], "load": [3.0, -5.0]}``. The functions of the system then get such dictionaries,
    ``q_f["load"] - q_f["hook"]``; a force may return a dictionary (a body without an entry has no force), and a
    constraint may return its rows by name, ``{"rope": ...}``. The problem stores vectors, in the order of the
    dictionaries; a run returns dictionaries again, ``run.q_f["load"]``.

    Args:
        system: the `System` that moves.
        q_s, q_f: (n_s,), (n_f,) positions, or dictionaries of arrays.
        v_s, v_f: velocities, in the form of the positions; None for zero. A dictionary may leave out bodies at rest.
        t: start time.
        drawing: appearance of the system, plain data for `vmri_jax.animation.Drawing`, or None.
        project: whether `state` projects positions and velocities onto the constraints, see `initial_state`.
        names: `Names` of bodies and constraints, or None; runs, figures and files have them as labels. Dictionaries
            give the names of bodies.

    Raises:
        TypeError, ValueError: arrays as `initial_state` refuses them; names that do not add up to coordinates and
            constraints.
    """

    system: System
    q_s: Any
    q_f: Any
    v_s: Any = None
    v_f: Any = None
    t: Number = 0.0
    drawing: Any = None
    project: bool = False
    names: Names | None = None

    def __post_init__(self):
        require_x64()
        check_type("Problem: system", self.system, System, A_SYSTEM)
        if self.names is not None:
            check_type("Problem: names", self.names, Names, "vmri_jax.Names(slow={...}, fast={...})")
        slots = [self._make_flat(part) for part in ("s", "f")]
        names = "q_s", "q_f", "v_s", "v_f"
        vars(self).update(zip(names, check_arrays(**{name: getattr(self, name) for name in names}), strict=True))
        if slots != [None, None]:
            vars(self)["system"] = flat_system(self.system, *slots)
        if self.names is None:
            return
        check_system(self.system, self.q_s, self.q_f)
        if slots != [None, None]:
            vars(self)["names"] = self._with_rows(self.names)
        self.names.of(self.system, self.q_s.size, self.q_f.size)

    def _make_flat(self, part: Part) -> Slots | None:
        """Replace dictionaries by vectors, and missing velocities by zeros; the arrays of the dictionary, None if the
        user gave vectors."""
        position, velocity = (getattr(self, f"{kind}_{part}") for kind in "qv")
        names, is_named = self.names or Names(), isinstance(position, Mapping)
        slots = names.arrays(part, len(position) if is_named else np.size(position))
        if is_named:
            slots = slots or Slots.of(f"Problem: q_{part}", position)
            position = slots.flat(f"Problem: q_{part}", position)
        if velocity is None:
            velocity = np.zeros(np.shape(position))
        elif isinstance(velocity, Mapping):
            if slots is None:
                raise Refused(
                    f"Problem: v_{part} is a dictionary and q_{part} is none; give both as dictionaries, or both as "
                    "arrays."
                )
            velocity = slots.flat(f"Problem: v_{part}", velocity, zeros=True)
        vars(self).update({f"q_{part}": position, f"v_{part}": velocity})
        if slots is not None:
            vars(self)["names"] = replace(names, **{"slow" if part == "s" else "fast": dict(slots.shapes)})
        return slots

    def _with_rows(self, names: Names) -> Names:
        """Names with the rows that constraints return by name."""
        values, sizes = {"t": np.zeros(()), "q_s": self.q_s, "q_f": self.q_f}, {}
        for term in self.system.of_kind("constraint"):
            rows = constraint_sizes(term.function, *term.of_arguments(values), self.system.params)
            sizes |= {term.field: rows} if rows else {}
        return replace(names, **sizes)

    def __repr__(self) -> str:
        names = (self.names or Names()).of_coordinates(np.shape(self.q_s)[-1], np.shape(self.q_f)[-1])
        return summary(
            "Problem",
            {
                "slow": coordinates(names.slow_coordinates),
                "fast": coordinates(names.fast_coordinates),
                **self.system.in_words(),
                "rows of constraints": listed([f"{name} ({len(rows)})" for name, rows in names.rows.items()]),
                "start": f"t = {numbers(self.t)}",
                **{name: numbers(getattr(self, name)) for name in ("q_s", "q_f", "v_s", "v_f")},
            },
        )

    def state(self, project: bool | None = None) -> State:
        """The consistent initial `State`, see `initial_state`; with None, `project` is the one of the problem."""
        return initial_state(self, project=project)


class HasProblem(Protocol):
    """An object with a method ``problem()``, such as a scene."""

    def problem(self) -> Problem: ...


Movable = System | Problem | HasProblem
"""Objects that can be simulated; a system needs a state as well."""


def opened(movable):
    """The problem of a scene; any other object unchanged."""
    return movable.problem() if callable(getattr(movable, "problem", None)) else movable


def problem_of(caller: str, movable: Problem | HasProblem) -> Problem:
    """The problem of a scene, or the problem itself; `caller` begins the message.

    Raises:
        TypeError: an argument that is neither.
    """
    require_x64()
    example = "a vmri_jax.Problem or a Scene. A System needs a start: Problem(system, q_s, q_f, v_s, v_f)"
    return check_type(f"{caller}: problem", opened(movable), Problem, example)


def start_of(caller: str, system, state=None) -> tuple[System, State]:
    """The system and the start of a run; `caller` begins the message.

    Args:
        system: a `System`, a `Problem`, or an object with a method ``problem()``, such as a scene.
        state: start; None for the start of the problem.

    Raises:
        TypeError: another object; a system without a state.
    """
    require_x64()
    system = opened(system)
    if isinstance(system, Problem):
        system, state = system.system, system.state() if state is None else state
    check_type(f"{caller}: system", system, System, "a vmri_jax.Problem or a Scene, or a System and a State")
    example = "a State, e.g. from initial_state(...), or a Problem(system, q_s, q_f, v_s, v_f) alone"
    if state is None:
        raise Refused(f"{caller}: a System has no start; give {example}.")
    return system, check_type(f"{caller}: state", state, State, example)
