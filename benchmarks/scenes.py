"""Scenes: what an effect costs that is not there, a scene against a system by hand, orders under forces."""

import copy
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import jax
import numpy as np

import vmri_jax as vm
from benchmarks import programs
from benchmarks.measure import Tell, interleaved, quartiles, ratio, silent
from benchmarks.report import Claim, Part, Report
from tests.scene.effect_scenes import BASE, EFFECTS, base_by_hand, scene_with
from tests.scene.forced_bodies import EFFECT_OF, convergence
from tests.scene.gallery_scenes import gallery_scene
from vmri_jax.diagnostics import fit_order
from vmri_jax.scene import Effect, Scene
from vmri_jax.scene.ledger import operations, prepare_steps, temporary_bytes

MACRO_DT = 0.01
SCENES = {
    "FPU l=3": partial(gallery_scene, "fermi_pasta_ulam"),
    "TSP": partial(gallery_scene, "triple_spherical_pendulum"),
    "SAM": partial(gallery_scene, "simple_atomic_model"),
}
MOST = 1.03
"""A scene over the system written by hand: time per micro step."""
TOLERANCES = {"of q, p": 0.2, "of balance": 0.3}
"""Of observed orders."""


@dataclass(frozen=True)
class Size:
    """How much is run.

    anew: every so many scenes without an effect are compiled once more.
    schemes, num_micro, micro_dt, num_steps, repeats: of the systems that are timed.
    orders: schemes and numbers of steps under forces.
    """

    anew: int
    schemes: tuple[str, ...]
    num_micro: int
    micro_dt: float
    num_steps: int
    repeats: int
    orders: tuple[tuple[str, vm.Scheme, tuple[int, ...]], ...]


def sizes(name: str) -> Size:
    """ "quick" or "full"."""
    orders = (
        ("fully implicit", vm.fully_implicit(2), (160, 320, 640)),
        ("galerkin, degree 2", vm.galerkin(2, 2), (160, 320)),
    )
    if name == "quick":
        return Size(9, ("fully explicit",), 10, 2e-4, 2000, 15, orders)
    return Size(1, tuple(programs.SCHEMES), 10, 2e-4, 2000, 25, orders)


# --- absence ---------------------------------------------------------------------------------------------------------
def absence(size: Size, name: str, tell: Tell = silent) -> Iterator[Report]:
    """Every effect in a small scene, taken out of it, and never mentioned: programs, unknowns and calls."""
    scheme = vm.fully_explicit(5)
    tell("never mentioned")
    never = _program(BASE.system(), scheme, BASE)
    rows = []
    for i, effect in enumerate(EFFECTS):
        tell(effect.name)
        watched, calls = counted(effect)
        scene = scene_with(watched)
        found, calls_with = _program(scene.system(), scheme, scene), len(calls)
        anew = (i + 1) % size.anew == 0
        if anew:
            jax.clear_caches()
        calls.clear()
        left = scene.without(effect.name)
        without, calls_without = _program(left.system(), scheme, left), len(calls)
        rows.append(
            {
                "effect": effect.name,
                **_columns("with", found),
                **_columns("without", without),
                **_columns("never", never),
                "compiled": "anew" if anew else "",
                "same": "yes" if without == never else "no",
                "unknowns": scene.explain(scheme, measure=False).unknowns,
                "formula": programs.unknowns(scene.problem(), scheme.num_micro),
                "calls with": calls_with,
                "calls without": calls_without,
            }
        )
    by_hand = _by_hand(scheme, tell)
    same = sum(row["same"] == "yes" for row in rows)
    by_formula = sum(row["unknowns"] == row["formula"] for row in rows)
    called = sum(row["calls without"] == 0 < row["calls with"] for row in rows)
    notes = [
        f"{same} of {len(rows)} effects: without it the program is the one that never had it.",
        f"{by_formula} of {len(rows)}: unknowns by r n_s + r n_gs + num_micro r (n_f + n_g).",
        f"{called} of {len(rows)}: called with it, never without.",
        *(f"{what}: operations {a[0]}, bytes {a[1]}; by hand {b[0]}, {b[1]}." for what, (a, b) in by_hand.items()),
    ]
    yield Report("scene_absence", name, rows, [], notes)


def _by_hand(scheme: vm.Scheme, tell: Tell) -> dict[str, tuple]:
    """Programs of scenes without an effect, and of the systems written by hand without that function."""
    tell("by hand")
    pairs = {"never, as above": (BASE, base_by_hand())}
    pendulum, hand = SCENES["TSP"](), programs.problem("TSP").system
    paces = {name: pace.value for name, pace in pendulum.sorting.paces.items()}
    for body, pace in paces.items():  # as in the whole scene, also without what they were found from
        pendulum = pendulum.replace(body, pace=pace)
    for effect, function in (("gravity", "slow_potential"), ("springs", "fast_potential"), ("links", "constraint")):
        pairs[f"TSP without {effect}"] = (pendulum.without(effect), hand.replace(**{function: None}))
    return {
        what: (_program(scene.system(), scheme, scene), _program(system, scheme, scene))
        for what, (scene, system) in pairs.items()
    }


def _program(system: vm.System, scheme: vm.Scheme, scene: Scene) -> tuple:
    """(operations in all, temporary bytes, operations by name) of a compiled run from the scene's start."""
    start = scene.problem()
    state = vm.initial_state(system, start.q_s, start.q_f, start.v_s, start.v_f, project=True)
    compiled = prepare_steps(system, scheme, state, MACRO_DT).compiled()
    counts = operations(compiled)
    return sum(counts.values()), temporary_bytes(compiled), counts


def _columns(label: str, program: tuple) -> dict:
    return {f"ops {label}": program[0], f"bytes {label}": program[1]}


def counted(effect: Effect) -> tuple[Effect, list]:
    """The effect with a function that notes each of its calls, and the list in which it does."""
    calls, function = [], effect.function

    def noting(*arguments):
        calls.append(None)
        return function(*arguments)

    kind = type(effect)
    watched = copy.copy(effect)
    object.__setattr__(watched, "__class__", type(kind.__name__, (kind,), {"function": property(lambda _: noting)}))
    return watched, calls


# --- presence --------------------------------------------------------------------------------------------------------
def presence(size: Size, name: str, tell: Tell = silent) -> Iterator[Report]:
    """The reference systems as scenes and written by hand, in turns; seconds of processor time."""
    rows, claims = [], []
    for system, scene in SCENES.items():
        for scheme in size.schemes:
            tell(f"{system}, {scheme}")
            problems = {"scene": scene().problem(), "by hand": programs.problem(system)}
            made, macro_dt = programs.SCHEMES[scheme](size.num_micro), size.num_micro * size.micro_dt
            prepared = {
                key: prepare_steps(problem.system, made, problem.state(), macro_dt, num_steps=size.num_steps)
                for key, problem in problems.items()
            }
            timed = {key: run.timed() for key, run in prepared.items()}
            seconds = interleaved(timed, size.repeats, clock=time.process_time)
            for key, run in prepared.items():
                program, us = run.compiled(), quartiles(seconds[key], 1e6 / size.num_steps / size.num_micro)
                row = {"system": system, "scheme": scheme, "program": key, "µs/micro step": us.value}
                row |= {"quartiles": f"{us.low:.3g} to {us.high:.3g}", "operations": sum(operations(program).values())}
                rows.append(row | {"bytes": temporary_bytes(program)})
            label = f"{system}, {scheme}: scene over by hand"
            claims.append(Claim(label, ratio(seconds["scene"], seconds["by hand"]), MOST))
            yield Report("scene_presence", name, rows, claims, [])


# --- orders ----------------------------------------------------------------------------------------------------------
def orders(size: Size, name: str, tell: Tell = silent) -> Iterator[Report]:
    """Errors and energy balance (change of energy less work of the forces) of bodies under forces."""
    rows = []
    for label, scheme, steps in size.orders:
        tell(label)
        errors, balances = convergence(scheme, steps)
        for body, effect in EFFECT_OF.items():
            found = zip(TOLERANCES, (errors, balances), strict=True)
            orders = {what: fit_order(1 / np.array(steps), some[body]).order for what, some in found}
            holds = all(abs(orders[what] - scheme.order) <= most for what, most in TOLERANCES.items())
            row = {"effect": effect, "scheme": label, "order": scheme.order, **orders}
            row |= {"finest error": errors[body][-1], "finest balance": balances[body][-1]}
            rows.append(row | {"holds": "yes" if holds else "no"})
        good = sum(row["holds"] == "yes" for row in rows)
        error, balance = TOLERANCES.values()
        notes = [
            f"{good} of {len(rows)}: error within {error} and energy balance within {balance} of the order expected."
        ]
        yield Report("scene_orders", name, rows, [], notes)


PARTS = {
    "absence": Part(
        (
            *("effect", "ops with", "bytes with", "ops without", "bytes without", "ops never", "bytes never"),
            *("same", "compiled", "unknowns", "formula", "calls with", "calls without"),
        ),
        absence,
        sizes,
    ),
    "presence": Part(
        ("system", "scheme", "program", "µs/micro step", "quartiles", "operations", "bytes"),
        presence,
        sizes,
    ),
    "orders": Part(
        ("effect", "scheme", "order", "of q, p", "of balance", "finest error", "finest balance", "holds"),
        orders,
        sizes,
    ),
}
