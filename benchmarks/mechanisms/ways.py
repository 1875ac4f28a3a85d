"""Every way to compute a mechanism, from coarse to fine settings; what is not installed or cannot state it says so."""

import importlib
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from types import SimpleNamespace
from typing import Any

import numpy as np

import vmri_jax as vm
from benchmarks.chains import Coordinates
from benchmarks.mechanisms.plane import Mechanism
from benchmarks.mechanisms.scenes import functions, scene
from benchmarks.peers.cases import Ladder, doubled_steps

COUNTS = 14
"""Numbers of steps, each twice the one before, that are tried at most."""
BY_HAND = SimpleNamespace(acceleration=lambda mechanism: mechanism.acceleration)
"""Equations as integrators of `benchmarks.peers` take them."""
DEGREE = 2
"""Of the Gauss scheme, of order 4, with one interval to a step."""

Way = tuple[Ladder, Callable[[Any], np.ndarray]]
"""A ladder, and what makes centres (bars, 2) of what its runs return."""


def ways(mechanism: Mechanism, num_micro: tuple[int, ...], by_directors: tuple[int, ...]) -> dict[str, Callable]:
    """By name, functions that make a ladder and what makes centres of its results.

    Args:
        mechanism: what is computed.
        num_micro: numbers of micro steps in joint coordinates, and of those `by_directors`, where a part is fast.
    """
    found: dict[str, Callable[[], Way]] = {}
    kinds: dict[Coordinates, tuple[int, ...]] = {"joint": num_micro, "directors": by_directors}
    for coordinates, numbers in kinds.items():
        if mechanism.has_fast:
            for n in numbers:
                found[f"{coordinates}, num_micro {n}"] = partial(of_scene, mechanism, coordinates, vm.explicit_slow(n))
        if coordinates == "joint" or not mechanism.has_fast:
            found[f"{coordinates}, Gauss"] = partial(of_scene, mechanism, coordinates, vm.galerkin(1, DEGREE))
    if mechanism.loops is not None:
        found["functions of angles, Gauss"] = partial(of_functions, mechanism, vm.galerkin(1, DEGREE))
    for name in ("Euler", "implicitfast", "RK4"):
        found[f"MuJoCo {name}"] = partial(of_module, mechanism, "mujoco", name)
    for name in ("trapezoidal index 2", "generalized-alpha"):
        found[f"Exudyn {name}"] = partial(of_module, mechanism, "exudyn", name)
    found["scipy DOP853"] = partial(of_peer, mechanism, "scipy", 0)
    found["diffrax Dopri8"] = partial(of_peer, mechanism, "diffrax", 0)
    found["diffrax Tsit5"] = partial(of_peer, mechanism, "diffrax", 1)
    return found


def of_scene(mechanism: Mechanism, coordinates: Coordinates, scheme: vm.Scheme) -> Way:
    """The scene, macro steps; fewer at the coarsest with micro steps, since the macro step may be longer."""

    def centres(run: vm.Trajectory) -> np.ndarray:
        return np.array([run.position(name)[-1, :2] for name in mechanism.bars])

    first = max(4, mechanism.steps // scheme.num_micro)
    return _ours(mechanism, lambda: (scene(mechanism, coordinates), None), scheme, first), centres


def of_functions(mechanism: Mechanism, scheme: vm.Scheme) -> Way:
    """The plain functions of coordinates chosen by hand."""

    def made():
        problem = functions(mechanism)
        return problem.system, problem.state()

    return _ours(mechanism, made, scheme, mechanism.steps), lambda run: mechanism.centres(run.q_s[-1])


def _ours(mechanism: Mechanism, made: Callable, scheme: vm.Scheme, first: int) -> Ladder:
    @cache
    def prepared():  # the scene and its program: once for all numbers of steps
        system, state = made()
        run = vm.prepare(system, scheme, state, macro_dt=mechanism.t_end, num_steps=1)
        return replace(run, may_fall_back=False)  # steps too large fail, and are not solved again in another way

    def build(num_steps: int):
        return partial(prepared(), num_steps=num_steps, macro_dt=mechanism.t_end / num_steps, throw=False)

    return doubled_steps("ours", first, COUNTS, build)


def of_module(mechanism: Mechanism, module: str, name: str) -> Way:
    """MuJoCo and Exudyn: numbers of steps."""
    build = importlib.import_module(f"benchmarks.mechanisms.{module}").build
    build(mechanism, name, 1)  # says at once what it cannot state
    return doubled_steps(name, 2 * mechanism.steps, COUNTS, partial(build, mechanism, name)), np.asarray


def of_peer(mechanism: Mechanism, module: str, number: int) -> Way:
    """scipy and diffrax on accelerations: tolerances."""
    ladders = importlib.import_module(f"benchmarks.peers.{module}").ladders(mechanism, BY_HAND)
    return ladders[number], mechanism.centres
