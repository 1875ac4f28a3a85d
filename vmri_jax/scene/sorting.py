"""Who is slow and who is fast: bodies by pace, effects by what they touch and how stiff they are.

A potential that touches a slow body is part of V, unless its rate is declared. One that touches only fast bodies is part of W if it is
stiff, else of V, where it is evaluated less often. One of the declared rate k is evaluated at every k-th micro node, and one that is
declared fast and touches a slow body is on the micro grid. A constraint that touches a fast body is held on the micro grid, one between slow
bodies on the macro grid: on the micro grid it would be over-determined. Kinetic effects are on the micro grid always,
because momenta need them there; the kinetic energy of bodies that depend on slow coordinates alone is on the macro grid.

A body is fast that a stiff potential (not one of V) or kinetic effect touches: one whose frequency is above the border
between slow and fast, see `vmri_jax.scene.rates`.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import chain
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.sparse import eye_array

from vmri_jax.mechanics.arrays import is_concrete, library, quickly_compiled
from vmri_jax.mechanics.kinematics import Kinematics
from vmri_jax.mechanics.rows import Place
from vmri_jax.scene.body import GROUND, Bodies
from vmri_jax.scene.effect import Effect
from vmri_jax.scene.layout import Layout, Pace, join
from vmri_jax.scene.rates import SEPARATION, Rates, border, measure
from vmri_jax.scene.trees import Branch, Link, joint_numbers, layout, nearest_rates, with_weight

NAMED = 3
"""Most bodies that a reason names."""

Home = (
    Literal["kinetic", "slow_potential", "fast_potential", "constraint", "slow_constraint", "force", "control", "fast"]
    | int
)
"""The argument of `System` that an element is part of; "fast" or a whole number: the potential of this name in `System.potentials`."""


class Reason(NamedTuple):
    """Why an element is where it is; the text has places for its bodies and "is" or "are", if it is about some."""

    text: str
    bodies: tuple[str, ...] = ()


class Placed(NamedTuple):
    """Some elements of an effect, the argument of `System` that they are part of, and why.

    dropped: rows of a constraint that are left out, numbers in the order of its terms.
    sizes: by how much the values of these change in a large motion, see `vmri_jax.scene.rows`.
    """

    effect: Effect
    elements: tuple[int, ...]
    home: Home
    reason: str
    dropped: tuple[int, ...] = ()
    sizes: tuple[float, ...] = ()


@dataclass(frozen=True)
class Sorting:
    """Bodies by name, their paces, their places, and where every effect lives.

    Attributes:
        links: the frames of bodies on joints, in the order of the kinematics; None where a way has ended.
        joint_starts: values and rates of freedoms of joints at the start, by the keys of `Layout.freedoms`; others are zero, with the
            rates that the velocities of bodies give.
    """

    bodies: Bodies
    paces: dict[str, Pace]
    layout: Layout
    placed: tuple[Placed, ...]
    links: tuple[Link | None, ...] = ()
    joint_starts: Mapping[tuple[str, int, str], tuple[Any, Any]] = field(default_factory=dict)

    @property
    def branches(self) -> tuple[Branch, ...]:
        """The bodies on joints."""
        return tuple(dict.fromkeys(link.branch for link in self.links if link is not None))

    @property
    def places(self) -> dict[str, Place]:
        """Where the coordinates of bodies are in Q_s and Q_f, see `Layout`."""
        return self.layout.bodies

    @property
    def start(self) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        """(q_s, q_f, v_s, v_f) at the start."""

        if self.layout.kinematics is None:
            return (*self._of_bodies("coordinates"), *self._of_bodies("rates"))
        return self._on_joints[0]

    @property
    def positions(self) -> tuple[jax.Array, jax.Array]:
        """(q_s, q_f) at the start."""
        return self._with_joint_starts(*self.assembled, 0)

    @property
    def assembled(self) -> tuple[Any, Any]:
        """(q_s, q_f) where the bodies are as they are given, and freedoms of joints are zero."""
        slow, fast = self._of_bodies("coordinates")
        n_s, n_f = self.layout.sizes
        return slow[:n_s], fast[:n_f]

    def _with_joint_starts(self, slow, fast, which: int) -> tuple[Any, Any]:
        """Slow and fast coordinates with the values that freedoms of joints start with, or (1) velocities with their rates."""
        for key, value in self.joint_starts.items():
            part, start, _ = self.layout.freedoms[key]
            given = (slow, fast)[part == "f"]
            pieces = given[:start], library(value[which]).reshape(value[which], (1,)), given[start + 1 :]
            changed = library(pieces).concatenate(pieces)
            slow, fast = (changed, fast) if part == "s" else (slow, changed)
        return slow, fast

    @property
    def missed(self) -> Any:
        """The part of the velocities of bodies that their joints do not allow, in the norm of the kinetic energy; see `start`."""
        return self._on_joints[1] if self.layout.kinematics is not None else 0.0

    @cached_property
    def _on_joints(self) -> tuple[tuple, Any]:
        q, n_s = library(self.assembled).concatenate(self.assembled), self.layout.sizes[0]
        rates, masses = (library(both).concatenate(both) for both in map(self._of_bodies, ("rates", "masses")))
        v, missed = nearest_rates(self.to_bodies(q)[1], rates, masses)
        return (*self.positions, *self._with_joint_starts(v[:n_s], v[n_s:], 1)), missed

    def _of_bodies(self, what: str) -> tuple[jax.Array, jax.Array]:
        return join(self.bodies, self.layout, "s", what), join(self.bodies, self.layout, "f", what)

    def to_bodies(self, q: Any) -> tuple[Any, Any]:
        """The coordinates of all bodies (Q_s, Q_f) one after the other, and their Jacobian, of q = (q_s, q_f)."""
        if self.layout.kinematics is None:
            return q, eye_array(q.size)
        bodies, jacobian = _bodies_and_jacobian(self.layout.kinematics, q, self.joints)
        return (np.asarray(bodies), np.asarray(jacobian)) if is_concrete(jacobian) else (bodies, jacobian)

    @cached_property
    def joints(self) -> dict[str, Any]:
        """Points and triads of the joints that carry bodies, see `Kinematics`; empty without such."""
        return joint_numbers(self.bodies, self.links) if self.links else {}


@partial(quickly_compiled, static_argnames="kinematics")
def _bodies_and_jacobian(kinematics: Kinematics, q, joints):
    """Q and dQ/dq."""

    def bodies(q):
        n_s = kinematics.sizes[0]
        found = jnp.concatenate(kinematics(q[:n_s], q[n_s:], joints))
        return found, found

    jacobian, found = jax.jacfwd(bodies, has_aux=True)(q)
    return found, jacobian


class Owners(NamedTuple):
    """The bodies whose coordinates an element of an effect depends on.

    all: every one of them.
    between: those that move its bodies against each other.
    """

    all: tuple[str, ...]
    between: tuple[str, ...]


def _owners(effect: Effect, bodies: Bodies, branches: Sequence[Branch]) -> list[Owners]:
    """The bodies whose coordinates each element of an effect depends on."""
    on_joints = {branch.child: branch for branch in branches}
    carried = {(branch.joint.name, branch.element): branch.child for branch in branches}
    found = []
    for i, names in enumerate(effect.elements(bodies)):
        pairs = effect.pairs_of_joints(i)
        if pairs and all(pair in carried for pair in pairs):
            chains = [[carried[pair]] for pair in pairs]
        else:
            chains = [_chain(name, on_joints) for name in dict.fromkeys(map(str, names))]
        everything = tuple(dict.fromkeys(name for chain in chains for name in chain))
        shared = set.intersection(*map(set, chains)) if len(chains) > 1 else set()
        found.append(Owners(everything, tuple(name for name in everything if name not in shared) or everything))
    return found


def _chain(name: str, branches: Mapping[str, Branch]) -> list[str]:
    """The bodies whose coordinates a body depends on, itself first."""
    found = []
    while name != GROUND:
        if name not in branches or branches[name].joint.freedoms:
            found.append(name)
        if name not in branches:
            break
        name = branches[name].parent
    return found


def sort(bodies: Bodies, effects: Sequence[Effect], branches: Sequence[Branch] = ()) -> Sorting:
    """Paces of all bodies and homes of all effects.

    Args:
        bodies: by name.
        effects: in the order in which their terms are added.
        branches: bodies that are functions of the freedoms of joints, parents before children.

    Raises:
        ValueError: something to be decided by numbers that are traced; joints that leave no freedom.
    """
    energies = [effect for effect in effects if effect.kind in ("potential", "kinetic")]
    owned = {effect.name: _owners(effect, bodies, branches) for effect in effects}
    measured = _measure(with_weight(bodies, branches), energies, owned)
    declared = {
        rate: [measured[effect.name].rate for effect in energies if effect.rate == rate and effect.name in measured]
        for rate in ("slow", "fast")
    }
    limit = border(
        [rates.rate for rates in measured.values()],
        max((rates.max() for rates in declared["slow"]), default=0.0),
        min((rates.min() for rates in declared["fast"]), default=np.inf),
    )
    carrying = {(branch.joint.name, branch.element) for branch in branches}
    paces = _paces(bodies, energies, measured, limit, owned)
    placed = []
    for effect in effects:
        homes: dict[Home, dict[int, Reason]] = {}
        for i, (names, _) in enumerate(owned[effect.name]):
            if (effect.name, i) in carrying:
                continue  # it has no equation
            slow = tuple(name for name in names if paces[name].value == "slow")
            home, reason = _home(effect, i, slow, len(names), measured, limit)
            homes.setdefault(home, {})[i] = reason
        placed += [Placed(effect, tuple(some), home, _together(some.values())) for home, some in homes.items()]
    where, ordered = layout(bodies, paces, branches)
    if not any(where.sizes):
        joints = dict.fromkeys(branch.joint.name for branch in branches)
        raise ValueError(
            f"Scene: nothing can move: {', '.join(joints)} leave no freedom to any body. Leave one of them out."
        )
    return Sorting(bodies, paces, where, tuple(placed), ordered)


def _measure(bodies, energies, owned: Mapping[str, Sequence[Owners]]) -> dict[str, Rates]:
    """Rates of potentials and kinetic effects, if a decision depends on them."""
    undecided = []
    for effect in energies:
        free = [all(bodies[name].pace != "slow" for name in names) for names, _ in owned[effect.name]]
        if effect.kind == "potential" and effect.rate == "auto" and any(free):
            undecided.append(effect.name)
    if not undecided and all(body.pace != "auto" for body in bodies.values()):
        return {}
    kinetic = any(effect.kind == "kinetic" for effect in energies)
    numbers = [(body.masses, body.coordinates, body.rates if kinetic else None) for body in bodies.values()]
    if not is_concrete((numbers, [effect.parameters(bodies) for effect in energies])):
        raise ValueError(
            f"Scene: whether {', '.join(undecided or bodies)} is slow or fast depends on numbers that are traced. Give every body a "
            "pace and every potential between fast bodies a rate, or build the system outside of jit and vary its params."
        )
    return measure(bodies, energies)


def _paces(bodies, energies, measured, limit, owned: Mapping[str, Sequence[Owners]]) -> dict[str, Pace]:
    paces = {}
    for name, body in bodies.items():
        if body.pace != "auto":
            paces[name] = Pace(body.pace, "as given")
        elif limit is None:
            paces[name] = Pace("slow", f"no gap of a factor {SEPARATION:g} between the rates of the effects")
        else:
            paces[name] = Pace("slow", f"touched by nothing stiff, above {limit:.3g} rad/s")
    for effect in energies:
        for i, (names, between) in enumerate(owned[effect.name]):
            declared = effect.rate == "fast" or isinstance(effect.rate, int)
            if effect.kind == "potential" and not declared and any(bodies[name].pace == "slow" for name in names):
                continue  # it is part of V
            why = _stiff(effect, i, measured, limit)
            for name in between if why else ():
                if paces[name].value == "slow" and bodies[name].pace == "auto":
                    paces[name] = Pace("fast", f"touched by {effect.name}, {why}")
    return paces


def _stiff(effect: Effect, i: int, measured, limit) -> str:
    """Why an element makes bodies fast; empty if it does not."""
    if isinstance(effect.rate, int):
        return f"declared for every {effect.rate} micro nodes"
    if effect.rate != "auto":
        return "declared fast" if effect.rate == "fast" else ""
    if limit is None or effect.name not in measured or measured[effect.name].frequency[i] <= limit:
        return ""
    return f"{measured[effect.name].frequency[i]:.3g} rad/s, above {limit:.3g}"


def _home(effect: Effect, i: int, slow: tuple[str, ...], size: int, measured, limit) -> tuple[Home, Reason]:
    """Where an element of an effect belongs that touches these slow bodies, and why."""
    if effect.kind == "kinetic":
        return "kinetic", Reason("depends on velocities")
    if effect.kind == "force":
        return "force", Reason("not derived from a potential")
    if effect.kind == "control":
        return "control", Reason("set by an optimisation, zero in a run")
    if effect.kind == "constraint" and len(slow) == size:
        return "slow_constraint", Reason("between slow bodies")
    if effect.kind == "constraint":
        return "constraint", Reason("touches a fast body")
    if isinstance(effect.rate, int):
        return effect.rate, Reason("as given")
    if slow and effect.rate == "fast":
        return "fast", Reason("as given, and touches {}, which {} slow", slow)
    if slow:
        return "slow_potential", Reason("touches {}, which {} slow", slow)
    if effect.rate != "auto":
        return ("fast_potential" if effect.rate == "fast" else "slow_potential"), Reason("as given")
    limit = limit or 0.0
    if measured[effect.name].frequency[i] > limit:
        return "fast_potential", Reason(f"between fast bodies and stiff, above {limit:.3g} rad/s")
    return "slow_potential", Reason(f"between fast bodies but soft, below {limit:.3g} rad/s")


def _together(reasons: Iterable[Reason]) -> str:
    """All distinct reasons, each with the number of its elements if there are others; its bodies named together."""
    found: dict[str, list[tuple[str, ...]]] = {}
    for reason in reasons:
        found.setdefault(reason.text, []).append(reason.bodies)
    parts = []
    for text, bodies in found.items():
        names = tuple(dict.fromkeys(chain(*bodies)))
        listed = ", ".join(names[:NAMED]) + (f" and {len(names) - NAMED} more" if len(names) > NAMED else "")
        count = f" ({len(bodies)})" if len(found) > 1 else ""
        parts.append(text.format(listed, "is" if len(names) == 1 else "are") + count)
    return "; ".join(parts)
