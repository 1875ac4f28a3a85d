"""One side of a comparison: a process that runs what it is told, when it is its turn.

``python .../benchmarks/worker.py`` imports the `vmri_jax` of the checkout that it is started in, and nothing of this folder.
Questions and answers are lines of JSON on standard input and output; `benchmarks.seats` asks.
"""

import argparse
import importlib
import json
import os
import runpy
import sys
import time
from dataclasses import dataclass

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


class Timed:
    """A run that takes turns with others; `end` is what a short call computes, `result` the status of a call."""

    num_steps: int
    end: np.ndarray
    result: str = ""

    def sample(self) -> float:
        """Seconds."""
        raise NotImplementedError

    def keep(self, short, whole) -> None:
        """The end of the first run, and the worst status of the second."""
        nodes = short.states  # vectors, also where a run has dictionaries
        q = np.concatenate([np.asarray(nodes.q_s), np.asarray(nodes.q_f)], axis=-1)
        self.end = q[..., -1, :]
        self.result = vm.Result(int(np.max(np.asarray(whole.result)))).name


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


class Single(Timed):
    """`vm.simulate`: seconds of the steps, what a call of one step takes at least being subtracted."""

    simulator = staticmethod(simulator)

    def __init__(self, case: Case):
        self.simulate = self.simulator(case)
        self.num_steps = case.num_steps or _steps_for(self.simulate, case.seconds)
        self.keep(self.simulate(COMPARED), self.simulate(self.num_steps))
        self.call = min(_seconds(self.simulate, 1) for _ in range(CALLS))

    def sample(self) -> float:
        """Of `num_steps - 1` steps."""
        return _seconds(self.simulate, self.num_steps) - self.call


class Call(Single):
    """What a call of `vm.simulate` takes besides its steps."""

    def sample(self) -> float:
        """A call of one step, less a step."""
        one = np.mean([_seconds(self.simulate, 1) for _ in range(CALLS)])
        return float(one - (_seconds(self.simulate, self.num_steps) - one) / (self.num_steps - 1))


class Prepared(Call):
    """What a call of a prepared run takes besides its steps."""

    @staticmethod
    def simulator(case: Case):
        """The same by `vm.prepare`."""
        problem = case.problem()
        run = vm.prepare(problem.system, case.made_scheme(), problem.state(), macro_dt=case.macro_dt, num_steps=1)
        return lambda num_steps: run(num_steps=num_steps, throw=False)


class Batch(Timed):
    """`vm.simulate_batch`: seconds of a call."""

    def __init__(self, case: Case):
        problem, scheme = case.problem(), case.made_scheme()
        states = starts(problem, case.lanes)

        def simulate(num_steps: int):
            return vm.simulate_batch(problem.system, scheme, states, **last_node(case.macro_dt, num_steps))

        self.simulate = simulate
        self.num_steps = case.num_steps or _steps_for(simulate, case.seconds, first=COMPARED, factor=16)
        self.keep(simulate(COMPARED), simulate(self.num_steps))

    def sample(self) -> float:
        """Of one call."""
        return _seconds(self.simulate, self.num_steps)


class First(Timed):
    """The first result of a process."""

    def __init__(self, case: Case):
        self.num_steps = case.num_steps
        run = simulator(case)(case.num_steps)
        self.keep(run, run)


class Gradient(Timed):
    """Reverse-mode derivative of the squared fast positions at the end with respect to the momenta of the start."""

    def __init__(self, case: Case):
        problem, scheme = case.problem(), case.made_scheme()
        state, steps = problem.state(), last_node(case.macro_dt, case.num_steps)

        @jax.jit
        @jax.grad
        def gradient(p_f):
            start = vm.State(state.t, state.q_s, state.q_f, state.p_s, p_f)
            return jnp.sum(vm.simulate(problem.system, scheme, start, **steps).q_f[-1] ** 2)

        self.gradient, self.at, self.num_steps = gradient, state.p_f, case.num_steps
        self.end = np.asarray(gradient(state.p_f))

    def sample(self) -> float:
        """Of one call."""
        return _seconds(self.gradient, self.at)


KINDS = {
    "single": Single,
    "call": Call,
    "prepared": Prepared,
    "batch": Batch,
    "first": First,
    "gradient": Gradient,
}


def _seconds(function, *arguments) -> float:
    clocks = time.perf_counter, time.process_time  # as `vmri_jax.running.timing.stopwatch`, which older sides lack
    before = [clock() for clock in clocks]
    run = function(*arguments)
    jax.block_until_ready(getattr(run, "failed_at", run))  # the arrays of a run are ready together
    return min(clock() - start for clock, start in zip(clocks, before, strict=True))


def _steps_for(simulate, seconds: float, first: int = 1, factor: int = 4) -> int:
    """The number of steps that take `seconds`, besides the time of a call; few numbers are tried, since a batch is compiled for each."""
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
    start = jax.vmap(lambda v_s, v_f: vm.initial_state(problem.system, problem.q_s, problem.q_f, v_s, v_f))
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
    timed = Timed()
    for line in sys.stdin:
        question = json.loads(line)
        try:
            if question["do"] == "make":
                timed = Timed()  # nothing of the last one stays
                jax.clear_caches()
                timed = KINDS[question["case"]["kind"]](Case(**question["case"]))
                end = np.ravel(timed.end).tolist()
                answer: dict = {"num_steps": timed.num_steps, "end": end, "result": timed.result}
                answer["processor"] = time.process_time()
            else:
                answer = {"seconds": timed.sample()}
        except Exception as error:  # the other side goes on
            answer = {"error": f"{type(error).__name__}: {error}"}
        print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    main()
