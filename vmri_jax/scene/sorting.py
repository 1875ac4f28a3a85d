"""Sorting of bodies into slow and fast, and of effects into the functions of a `System`.

An effect touches the bodies whose coordinates it depends on. Each of its elements has a home, the argument of `System`
that it is part of. Of several lines that fit, the first one counts:

| element of a | home | function |
|---|---|---|
| potential with the rate k | k | V_k, at every k-th micro node |
| potential with the rate "fast" that touches a slow body | "fast" | on the micro grid like W, but of q_s too |
| potential that touches a slow body | "slow_potential" | V, on the grid of the rule of V |
| potential between fast bodies with the rate "slow", or not stiff | "slow_potential" | V |
| potential between fast bodies with the rate "fast", or stiff | "fast_potential" | W(q_f), on the micro grid |
| constraint that touches a fast body | "constraint" | g, on the micro grid |
| constraint between slow bodies | "slow_constraint" | g_s, on the macro grid |
| kinetic effect | "kinetic" | T, on the micro grid: the momenta of fast bodies follow from it |
| force | "force" | F |
| control | "control" | none: a run has no controls |

The kinetic energy T_s of bodies that depend on slow coordinates alone is on the macro grid. On the micro grid g_s would
have more rows than unknowns.

A body with the pace "auto" is fast if one of these effects moves it against another body: a potential or kinetic effect
that has the rate "fast", a potential with the rate k, or a stiff potential or kinetic effect that has the rate "auto".
A stiff potential that touches a body with the pace "slow" does not count, since it is part of V. An effect is stiff if
its frequency is above the border between slow and fast, see `vmri_jax.scene.rates`. Without a border no effect makes
bodies fast by its frequency, and every potential between fast bodies with a frequency above zero is stiff. A body with
the pace "auto" is fast, too, if constraints tie it to fast bodies that cannot move without it, as in a closed loop, see
`vmri_jax.scene.redundancy.tied_to_fast`.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain
from typing import Any, Literal, NamedTuple

import jax
import numpy as np
from scipy.sparse import eye_array

from vmri_jax.mechanics.arrays import is_concrete, library, split_at
from vmri_jax.mechanics.summary import listed
from vmri_jax.refusals import Refused
from vmri_jax.scene.binding import DecidedPace, Layout
from vmri_jax.scene.body import GROUND, Bodies, joined, label_of
from vmri_jax.scene.effect import Effect
from vmri_jax.scene.rates import SEPARATION, Rates, border, measure
from vmri_jax.scene.trees import Branch, joint_constants, make_layout, with_weight

NAMED = 3
"""Most bodies that a reason names; with more the table of reasons is too wide."""

Home = (
    Literal["kinetic", "slow_potential", "fast_potential", "constraint", "slow_constraint", "force", "control", "fast"]
    | int
)
"""The argument of `System` that an element is part of; "fast" or a whole number is the key of a potential in
`System.potentials`."""

HOMES: tuple[Home, ...] = ("slow_constraint", "constraint")
"""The arguments of `System` that hold constraints, in the order of the grids macro, micro."""

ELSEWHERE: dict[str, tuple[Home, str]] = {
    "kinetic": ("kinetic", "depends on velocities"),
    "force": ("force", "not derived from a potential"),
    "control": ("control", "set by an optimisation, zero in a run"),
}
"""Home of all elements of other kinds than potentials and constraints, and why."""


class Placed(NamedTuple):
    """Some elements of an effect, by their indices, with a common home, and the reason for it.

    dropped: indices of the rows of a constraint that the scene leaves out, in the order of its terms.
    sizes: of the dropped rows, see `ConstraintRows.sizes`.
    """

    effect: Effect
    elements: tuple[int, ...]
    home: Home
    reason: str
    dropped: tuple[int, ...] = ()
    sizes: tuple[float, ...] = ()


@dataclass(frozen=True)
class Sorting:
    """Bodies with their paces and places, and the effects, each with its home.

    branches: the bodies on joints, in the order of the kinematics.
    joint_starts: values and rates of freedoms of joints at the start, by the keys of `Layout.freedoms`. Other freedoms
        start at zero, with the rates that follow from the velocities of bodies.
    """

    bodies: Bodies
    paces: dict[str, DecidedPace]
    layout: Layout
    placed: tuple[Placed, ...]
    branches: tuple[Branch, ...] = ()
    joint_starts: Mapping[tuple[str, int, str], tuple[Any, Any]] = field(default_factory=dict)

    @property
    def start(self) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        """(q_s, q_f, v_s, v_f) at the start."""
        return self.start_and_violation[0]

    @cached_property
    def positions(self) -> Any:
        """(n,) q = (q_s, q_f) at the start."""
        return self._with_joint_starts(self.assembled, 0)

    @property
    def assembled(self) -> Any:
        """(n,) q = (q_s, q_f) at the positions of the bodies as the user gave them, where freedoms of joints are
        zero."""
        q, (n_s, n_f), first_fast = self.of_bodies("coordinates"), self.layout.sizes, self.layout.ends[0]
        return q if self.layout.kinematics is None else joined([q[:n_s], q[first_fast : first_fast + n_f]])

    def _with_joint_starts(self, q: Any, order: Literal[0, 1]) -> Any:
        """Coordinates (order 0) or velocities (order 1) with the values or rates in `joint_starts` put in."""
        numbers = self.layout.numbers
        for key, value_and_rate in self.joint_starts.items():
            if key not in numbers:
                raise Refused(
                    f"Scene: with_joints has set a start of {key[0]}, which has no coordinate in this scene. Change "
                    "effects, bodies and coordinates first, and call with_joints then."
                )
            (i,), number = numbers[key], value_and_rate[order]
            q = joined([q[:i], library(number).reshape(number, (1,)), q[i + 1 :]])
        return q

    @cached_property
    def start_and_violation(self) -> tuple[tuple, Any]:
        """`start`, and the part of the velocities of bodies that their joints do not allow, relative to all, by
        masses."""
        q, v, violation, n_s = self.positions, self.of_bodies("rates"), 0.0, self.layout.sizes[0]
        if self.layout.kinematics is not None:
            v, violation = _nearest_rates(self.to_bodies(self.assembled)[1], v, self.of_bodies("masses"))
            v = self._with_joint_starts(v, 1)
        return (*split_at(q, n_s), *split_at(v, n_s)), violation

    def of_bodies(self, quantity: Literal["coordinates", "rates", "masses"]) -> Any:
        """A quantity of all bodies in the order of (Q_s, Q_f), with zeros for the freedoms of joints."""
        layout = self.layout
        pieces = {place: getattr(self.bodies[name], quantity) for name, place in layout.bodies.items()}
        pieces |= {place: np.zeros(1) for place in layout.freedoms.values()}
        return joined([pieces[place] for place in sorted(pieces, key=lambda place: place.order)])

    def to_bodies(self, q: Any) -> tuple[Any, Any]:
        """Q = (Q_s, Q_f) of q = (q_s, q_f), each one vector, and the Jacobian dQ/dq."""
        if self.layout.kinematics is None:
            return q, eye_array(q.size)
        n_s = self.layout.sizes[0]
        return self.layout.kinematics.with_jacobian(*split_at(q, n_s), self.joints)

    @cached_property
    def joints(self) -> dict[str, Any]:
        """Constants of the joints that carry bodies, see `joint_constants`; empty if no joint does."""
        return joint_constants(self.bodies, self.branches) if self.branches else {}


def _nearest_rates(jacobian, rates, masses) -> tuple[Any, Any]:
    """v with ``J^T M J v = J^T M V``: ``J v`` is nearest to the rates V of bodies; and ``|V - J v| / |V|``, by M."""
    xp = library(jacobian, rates, masses)
    v = xp.linalg.solve(jacobian.T @ (masses[:, None] * jacobian), jacobian.T @ (masses * rates))
    violation, square = rates - jacobian @ v, xp.sum(masses * rates**2)
    return v, xp.sqrt(xp.sum(masses * violation**2) / xp.where(square > 0, square, 1.0))


Owners = tuple[tuple[str, ...], tuple[str, ...]]
"""The bodies whose coordinates an element of an effect depends on: all, and the ones among these that move the bodies
of the element against each other, not together."""


def _owners(effect: Effect, branches: Sequence[Branch]) -> list[Owners]:
    """The bodies whose coordinates each element of an effect depends on.

    Every body of an element depends on a chain of bodies, from itself to the root of its tree. All bodies are the union
    of these chains; the bodies that move the bodies of the element against each other are this union without the bodies
    that are in every chain.
    """
    on_joints = {branch.child: branch for branch in branches}
    carried = {(branch.joint.name, branch.element): branch.child for branch in branches}
    owners = []
    for i, names in enumerate(effect.elements):
        pairs = [key[:2] for key in effect.freedoms_of(i)]
        if pairs and all(pair in carried for pair in pairs):
            chains = [[carried[pair]] for pair in pairs]
        else:
            chains = [_chain(name, on_joints) for name in dict.fromkeys(map(str, names))]
        names_of_all = tuple(dict.fromkeys(name for chain in chains for name in chain))
        # a body that carries all bodies of the element moves them together
        shared = set.intersection(*map(set, chains)) if len(chains) > 1 else set()
        owners.append((names_of_all, tuple(name for name in names_of_all if name not in shared) or names_of_all))
    return owners


def _chain(name: str, branches: Mapping[str, Branch]) -> list[str]:
    """The bodies whose coordinates the position of a body depends on, from this body to the root of its tree."""
    chain = []
    while name != GROUND:
        if name not in branches or branches[name].joint.freedoms:  # a body on a `Fixed` joint has no coordinates
            chain.append(name)
        if name not in branches:
            break
        name = branches[name].parent
    return chain


def sort(
    bodies: Bodies, effects: Sequence[Effect], branches: Sequence[Branch] = (), tied: Mapping[str, str] | None = None
) -> Sorting:
    """Paces of all bodies and homes of all effects; refused if traced numbers decide, or nothing can move.

    `tied` has the reasons of bodies that are fast because constraints tie them to fast bodies.
    """
    energies = [effect for effect in effects if effect.kind in ("potential", "kinetic")]
    owned = {effect.name: _owners(effect, branches) for effect in effects}
    measured = _measure(with_weight(bodies, branches), energies, owned)
    limit = border(measured, energies)
    carrying = {(branch.joint.name, branch.element) for branch in branches}
    paces = _paces(bodies, energies, measured, limit, owned)
    paces |= {name: DecidedPace("fast", reason) for name, reason in (tied or {}).items()}
    placed = []
    for effect in effects:
        homes: dict[Home, dict[int, tuple[str, tuple[str, ...]]]] = {}
        for i, (names, _) in enumerate(owned[effect.name]):
            if (effect.name, i) in carrying:
                continue  # a joint that carries a body has coordinates instead of constraint rows
            slow = tuple(name for name in names if paces[name].value == "slow")
            home, reason = _home(effect, i, slow, len(names), measured, limit)
            homes.setdefault(home, {})[i] = reason, slow
        placed += [Placed(effect, tuple(reasons), home, _summary(reasons.values())) for home, reasons in homes.items()]
    layout, ordered = make_layout(bodies, paces, branches)
    if not any(layout.sizes):
        joints = dict.fromkeys(branch.joint.name for branch in branches)
        raise Refused(
            f"Scene: nothing can move: {', '.join(joints)} leave no freedom to any body. Leave one of these joints out."
        )
    return Sorting(bodies, paces, layout, tuple(placed), ordered)


def _measure(bodies, energies, owned: Mapping[str, Sequence[Owners]]) -> dict[str, Rates]:
    """Rates of potentials and kinetic effects; {} if no decision depends on them, since they need concrete numbers."""
    undecided = []
    for effect in energies:
        free = [all(bodies[name].pace != "slow" for name in names) for names, _ in owned[effect.name]]
        if effect.kind == "potential" and effect.rate == "auto" and any(free):
            undecided.append(effect.name)
    if not undecided and all(body.pace != "auto" for body in bodies.values()):
        return {}
    kinetic = any(effect.kind == "kinetic" for effect in energies)
    numbers = [(body.masses, body.coordinates, body.rates if kinetic else None) for body in bodies.values()]
    if not is_concrete((numbers, [effect.parameters for effect in energies])):
        raise Refused(
            f"Scene: whether {', '.join(undecided or bodies)} is slow or fast depends on numbers that jax.jit, grad or "
            "vmap traces, so that their values are unknown. Give every body a pace and every potential between fast "
            "bodies a rate, or build the system outside of jit and vary its params."
        )
    return measure(bodies, energies)


def _paces(bodies, energies, measured, limit, owned: Mapping[str, Sequence[Owners]]) -> dict[str, DecidedPace]:
    """The pace of every body: as the user gave it, or fast if a stiff effect moves it, else slow."""
    paces = {}
    for name, body in bodies.items():
        if body.pace != "auto":
            paces[name] = DecidedPace(body.pace, "as given")
        elif limit is None:
            paces[name] = DecidedPace("slow", f"no gap of a factor {SEPARATION:g} between the rates of the effects")
        else:
            paces[name] = DecidedPace("slow", f"no effect above {limit:.3g} rad/s touches it")
    for effect in energies:
        for i, (names, between) in enumerate(owned[effect.name]):
            declared = effect.rate == "fast" or isinstance(effect.rate, int)
            slow = [name for name in names if bodies[name].pace == "slow"]
            in_v = effect.kind == "potential" and not declared and slow  # part of V, however stiff
            reason = _stiff(effect, i, measured, limit)
            for name in names if reason else ():
                if paces[name].value == "fast" or bodies[name].pace != "auto":
                    continue
                if in_v:
                    text = f"{effect.name}, {reason}, is part of V: it also touches {slow[0]}, whose pace is slow"
                    paces[name] = DecidedPace("slow", text)
                elif name in between:
                    paces[name] = DecidedPace("fast", f"touched by {effect.name}, {reason}")
                else:
                    paces[name] = DecidedPace("slow", f"{effect.name}, {reason}, acts between bodies that it carries")
    return paces


def _stiff(effect: Effect, i: int, measured, limit) -> str:
    """The reason why element i makes bodies fast; "" if it does not."""
    if isinstance(effect.rate, int):
        return f"declared for every {effect.rate} micro nodes"
    if effect.rate != "auto":
        return "declared fast" if effect.rate == "fast" else ""
    if limit is None or effect.name not in measured or measured[effect.name].frequency[i] <= limit:
        return ""
    return f"{measured[effect.name].frequency[i]:.3g} rad/s, above {limit:.3g}"


def _home(effect: Effect, i: int, slow: tuple[str, ...], size: int, measured, limit) -> tuple[Home, str]:
    """The home of element i, see the table of this module, and why; it touches `size` bodies, the slow ones `slow`.

    In a reason two braces ``{}`` stand for the names of the slow bodies, and for "is" or "are".
    """
    if effect.kind in ELSEWHERE:
        return ELSEWHERE[effect.kind]
    if effect.kind == "constraint":
        return (
            ("slow_constraint", "between slow bodies") if len(slow) == size else ("constraint", "touches a fast body")
        )
    if isinstance(effect.rate, int):
        return effect.rate, "as given"
    if slow and effect.rate == "fast":
        return "fast", "as given, and touches {}, which {} slow"
    if slow:
        return "slow_potential", "touches {}, which {} slow"
    if effect.rate != "auto":
        return ("fast_potential" if effect.rate == "fast" else "slow_potential"), "as given"
    level = f"{limit:.3g} rad/s" if limit else "zero: no border between slow and fast"
    if measured[effect.name].frequency[i] > (limit or 0.0):
        return "fast_potential", f"between fast bodies and stiff, above {level}"
    return "slow_potential", f"between fast bodies but soft, {'below' if limit else 'at'} {level}"


def _summary(reasons: Iterable[tuple[str, tuple[str, ...]]]) -> str:
    """The distinct reasons of the elements of an effect, each with all its slow bodies; of several reasons each with
    its number of elements."""
    bodies_by_text: dict[str, list[tuple[str, ...]]] = {}
    for text, slow in reasons:
        bodies_by_text.setdefault(text, []).append(slow)
    parts = []
    for text, bodies in bodies_by_text.items():
        names = tuple(dict.fromkeys(chain(*bodies)))
        count = f" ({len(bodies)})" if len(bodies_by_text) > 1 else ""
        parts.append(text.format(listed(names, NAMED), "is" if len(names) == 1 else "are") + count)
    return "; ".join(parts)


class Row(NamedTuple):
    """A row of a constraint.

    label: of its element: the name of the effect and, if it has several elements, names of the bodies.
    name: of the effect and the bodies, with a number if an element has several rows.
    part: number of its entry in `Sorting.placed`, which has this effect and home.
    number: of the row in this entry, in the order of its terms.
    kept: False for a row that the scene leaves out.
    """

    label: str
    name: str
    part: int
    number: int
    effect: Effect
    home: Home
    kept: bool


def rows_of(placed: Sequence[Placed], layout: Layout) -> list[Row]:
    """The rows of constraints, in the order of `Sorting.placed` and of the terms of each effect."""
    rows = []
    for i, part in enumerate(placed):
        effect, number = part.effect, 0
        for group in effect.groups(part.elements, layout) if part.home in HOMES else ():
            # all elements of a group have as many rows
            size = jax.eval_shape(effect.called, *effect.arguments_at_start(group[:1])).size
            for element in group:
                named = f"{effect.name} {'-'.join(map(label_of, effect.elements[element]))}"
                label = effect.name if len(effect.elements) == 1 else named
                for name in [named] if size == 1 else [f"{named} [{j}]" for j in range(size)]:
                    rows.append(Row(label, name, i, number, effect, part.home, number not in part.dropped))
                    number += 1
    return rows
