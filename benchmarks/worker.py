"""One side of a comparison: a process that runs what it is told, when it is its turn.

``python .../benchmarks/worker.py`` imports the `vmri_jax` of the checkout that it is started in, and nothing of this
folder. Questions and answers are lines of JSON on standard input and output; `benchmarks.seats` asks.
"""

import argparse
import importlib
import json
import os
import runpy
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

if __name__ == "__main__":
    sys.path[0] = os.getcwd()

import jax
import jax.numpy as jnp
import numpy as np

import vmri_jax as vm

SYSTEMS = {"FPU": "fermi_pasta_ulam", "TSP": "triple_spherical_pendulum", "SAM": "simple_atomic_model"}
SCENES = {"satellite": "notebooks/scenes/rigid_satellite.py"}
"""Files of scenes, whose kinetic energy is a function of joint coordinates."""
SPREAD = 0.01
"""Of the velocities in a batch."""
COMPARED = 8
"""Macro steps after which two sides are compared: round-off has not grown by then."""
CALLS = 20
"""Calls in a row whose mean is one sample of a short call."""


@dataclass(frozen=True)
class Case:
    """What is run.

    kind: a key of `KINDS`.
    system: ``"TSP"``, ``"SAM"``, ``"FPU l=3"`` or ``"satellite"``.
    scheme: a constructor and its arguments, ``"galerkin 1 8 lobatto"``, after the name of a composition if it is one,
        ``"kahan-li8 of fully_explicit 2"``.
    num_steps: macro steps; 0 to find how many take `seconds`.
    lanes: of a batch.
    method: matrix of `vmri_jax.Solver`.
    """

    kind: str
    system: str = ""
    scheme: str = ""
    macro_dt: float = 0.0
    num_steps: int = 0
    seconds: float = 0.1
    lanes: int = 1
    method: str = "auto"

    @property
    def label(self) -> str:
        """In tables."""
        lanes = f", {self.lanes} lanes" if self.lanes > 1 else ""
        return f"{self.system}, {self.scheme}{lanes}{'' if self.method == 'auto' else f', {self.method}'}"

    def problem(self):
        """System and start."""
        if self.system in SCENES:
            return runpy.run_path(SCENES[self.system])["scene"].problem()
        name, _, springs = self.system.partition(" l=")
        return getattr(vm.systems, SYSTEMS[name])(*([int(springs)] if springs else []))

    def made_scheme(self):
        """The scheme that the words stand for."""
        composition, _, words = self.scheme.rpartition(" of ")
        name, *arguments = words.split()
        scheme = getattr(vm, name)(*(int(a) if a.isdigit() else a for a in arguments))
        return vm.compose(scheme, composition) if composition else scheme


class Timed(NamedTuple):
    """What takes turns with others: its number of steps, the end of a short run, ``sample()`` in seconds, the worst
    status of a run."""

    num_steps: int
    end: np.ndarray
    sample: Callable[[], float]
    result: str = ""


def timed(short: vm.Trajectory, whole: vm.Trajectory, num_steps: int, sample: Callable[[], float]) -> Timed:
    """The end of a short run and the status of a whole one."""
    nodes = short.states  # vectors, also where a run has dictionaries
    q = np.concatenate([np.asarray(nodes.q_s), np.asarray(nodes.q_f)], axis=-1)
    return Timed(num_steps, q[..., -1, :], sample, vm.Result(int(np.max(np.asarray(whole.result)))).name)


def last_node(macro_dt: float, num_steps: int) -> dict:
    """Arguments of a run that saves its last node only."""
    return {"macro_dt": macro_dt, "num_steps": num_steps, "save": num_steps}


def simulator(case: Case):
    """``simulate(num_steps)`` by `vm.simulate`."""
    problem, scheme = case.problem(), case.made_scheme()
    state = problem.state()
    solver = vm.Solver(case.method)

    def simulate(num_steps: int) -> vm.Trajectory:
        try:
            return vm.simulate(problem.system, scheme, state, **last_node(case.macro_dt, num_steps), solver=solver)
        except vm.SimulationError as failure:
            return failure.trajectory

    return simulate


def prepared(case: Case):
    """The same by `vm.prepare`."""
    problem = case.problem()
    run = vm.prepare(problem.system, case.made_scheme(), problem.state(), macro_dt=case.macro_dt, num_steps=1)
    return lambda num_steps: run(num_steps=num_steps, throw=False)


def single(case: Case) -> Timed:
    """`vm.simulate`: seconds of the steps, what a call of one step takes at least being subtracted."""
    simulate = simulator(case)
    n = case.num_steps or _steps_for(simulate, case.seconds)
    call = min(_seconds(simulate, 1) for _ in range(CALLS))
    return timed(simulate(COMPARED), simulate(n), n, lambda: _seconds(simulate, n) - call)


def call(simulate: Callable, case: Case) -> Timed:
    """What a call takes besides its steps: a call of one step, less a step."""
    n = case.num_steps or _steps_for(simulate, case.seconds)

    def sample() -> float:
        one = np.mean([_seconds(simulate, 1) for _ in range(CALLS)])
        return float(one - (_seconds(simulate, n) - one) / (n - 1))

    return timed(simulate(COMPARED), simulate(n), n, sample)


def batch(case: Case) -> Timed:
    """`vm.simulate_batch`: seconds of a call."""
    problem, scheme = case.problem(), case.made_scheme()
    states = starts(problem, case.lanes)

    def simulate(num_steps: int):
        return vm.simulate_batch(problem.system, scheme, states, **last_node(case.macro_dt, num_steps))

    n = case.num_steps or _steps_for(simulate, case.seconds, first=COMPARED, factor=16)
    return timed(simulate(COMPARED), simulate(n), n, lambda: _seconds(simulate, n))


def first(case: Case) -> Timed:
    """The first result of a process, whose time is the time of the process."""
    run = simulator(case)(case.num_steps)
    return timed(run, run, case.num_steps, lambda: np.nan)


def gradient(case: Case) -> Timed:
    """Reverse-mode derivative of the squared fast positions at the end with respect to the momenta of the start."""
    problem, scheme = case.problem(), case.made_scheme()
    state, steps = problem.state(), last_node(case.macro_dt, case.num_steps)

    @jax.jit
    @jax.grad
    def slope(p_f):
        start = vm.State(state.t, state.q_s, state.q_f, state.p_s, p_f)
        return jnp.sum(vm.simulate(problem.system, scheme, start, **steps).q_f[-1] ** 2)

    return Timed(case.num_steps, np.asarray(slope(state.p_f)), lambda: _seconds(slope, state.p_f))


KINDS: dict[str, Callable[[Case], Timed]] = {
    "single": single,
    "call": lambda case: call(simulator(case), case),
    "prepared": lambda case: call(prepared(case), case),
    "batch": batch,
    "first": first,
    "gradient": gradient,
}


def _seconds(function, *arguments) -> float:
    clocks = time.perf_counter, time.process_time  # as `vmri_jax.running.timing.stopwatch`, which older sides lack
    before = [clock() for clock in clocks]
    run = function(*arguments)
    jax.block_until_ready(getattr(run, "failed_at", run))  # the arrays of a run are ready together
    return min(clock() - start for clock, start in zip(clocks, before, strict=True))


def _steps_for(simulate, seconds: float, first: int = 1, factor: int = 4) -> int:
    """The number of steps that take `seconds`, besides the time of a call; few numbers are tried, since a batch is
    compiled for each."""
    jax.block_until_ready(simulate(first))
    call, steps = min(_seconds(simulate, first) for _ in range(CALLS)), first
    while True:
        steps *= factor
        jax.block_until_ready(simulate(steps))
        taken = _seconds(simulate, steps) - call
        if taken >= seconds / (2 * factor):
            return max(2, round((steps - first) * seconds / taken))


def starts(problem, lanes: int):
    """So many starts that differ in their velocities, consistent with the constraints, batch axis first."""
    random = np.random.default_rng(0)
    v_s, v_f = (jnp.asarray(v + SPREAD * random.normal(size=(lanes, v.size))) for v in (problem.v_s, problem.v_f))
    start = jax.vmap(lambda v_s, v_f: vm.initial_state(problem, v_s=v_s, v_f=v_f, project=True))
    return jax.jit(start)(v_s, v_f)


def use_plain(name: str) -> None:
    """Take this function or constant of ``vmri_jax.kernels`` from its plain form, wherever it has been imported."""
    tuned, plain = (getattr(importlib.import_module(f"vmri_jax.kernels.{form}"), name) for form in ("cpu", "plain"))
    for module in [m for key, m in sys.modules.items() if key.split(".")[0] == "vmri_jax"]:
        if getattr(module, name, None) is tuned:
            setattr(module, name, plain)


def main() -> None:
    """Answer until there are no more questions."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--plain", action="append", default=[], help="a function of the kernels in its plain form")
    options = parser.parse_args()
    answers, sys.stdout = sys.stdout, sys.stderr
    vm.configure(cache=None)
    for name in options.plain:
        use_plain(name)
    made: Timed | None = None
    for line in sys.stdin:
        question = json.loads(line)
        try:
            if question["do"] == "make":
                made = None  # nothing of the last one stays
                jax.clear_caches()
                made = KINDS[question["case"]["kind"]](Case(**question["case"]))
                end = np.ravel(made.end).tolist()
                answer: dict = {"num_steps": made.num_steps, "end": end, "result": made.result}
                answer["processor"] = time.process_time()
            else:
                assert made is not None
                answer = {"seconds": made.sample()}
        except Exception as error:  # the other side goes on
            answer = {"error": f"{type(error).__name__}: {error}"}
        print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    main()
