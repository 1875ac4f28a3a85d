"""Gradients of runs: time of a gradient over the time of the run, memory of short and of long ones, seconds to
compile."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

import vmri_jax as vm
from benchmarks.measure import Ratio, Tell, exactly, interleaved, quartiles, silent, temporary_bytes
from benchmarks.report import Claim, Report

FACTOR, GROWTH = 4.0, 4.0
"""Targets: time of a gradient over the time of a run, memory of a gradient of a million steps over that of a
thousand."""
SHORT, LONG = 1_000, 1_000_000
"""Steps of the gradients that are timed, and of those whose memory is read off the compiled program."""


@dataclass(frozen=True)
class Case:
    """A system whose squared positions at the end are differentiated with respect to its parameters and the momenta of
    the start."""

    name: str
    problem: Callable[[], vm.Problem]
    macro_dt: float


@dataclass(frozen=True)
class Size:
    """Cases, and samples of a time."""

    cases: tuple[Case, ...]
    repeats: int


def sizes(name: str) -> Size:
    """ "quick" or "full"."""
    fpu = Case("FPU", vm.systems.fermi_pasta_ulam, 0.01)
    if name == "quick":
        return Size((fpu,), 5)
    others = (
        Case("TSP", vm.systems.triple_spherical_pendulum, 0.002),
        Case("SAM", vm.systems.simple_atomic_model, 0.001),
    )
    return Size((fpu, *others), 15)


def run(size: Size, name: str, tell: Tell = silent) -> Iterator[Report]:
    """A report after each system."""
    report = Report("adjoints", name)
    for case in size.cases:
        rows, ratio = measured(case, size.repeats, tell)
        report.rows.extend(rows)
        report.claims.append(Claim(f"{case.name}: a gradient over a run", ratio, at_most=FACTOR))
        growth = exactly(rows[1]["MB"] / rows[0]["MB"])
        report.claims.append(Claim(f"{case.name}: memory, {LONG} over {SHORT} steps", growth, at_most=GROWTH))
        report.note(f"{case.name}: a run takes {rows[0]['run us']:.1f} microseconds a step.")
        yield report


def measured(case: Case, repeats: int, tell: Tell) -> tuple[list[dict], Ratio]:
    """A row for each number of steps, and the time of the short gradient over the time of a run."""
    problem, scheme, solver = case.problem(), vm.fully_implicit(10), vm.Solver("masses")
    start, params = problem.state(), jax.tree.map(jnp.asarray, problem.system.params)

    def gradient(steps: int):
        """The compiled gradient, and its row."""

        def cost(params, p_f):
            state = vm.State(start.t, start.q_s, start.q_f, start.p_s, p_f)
            system, every = problem.system.replace(params=params), steps // 10
            options = {"macro_dt": case.macro_dt, "num_steps": steps, "save": every, "solver": solver}
            end = vm.simulate(system, scheme, state, **options)
            return jnp.sum(end.q_s[-1] ** 2) + jnp.sum(end.q_f[-1] ** 2)

        tell(f"{case.name}, {steps} steps")
        began = time.perf_counter()
        program = jax.jit(jax.grad(cost, (0, 1))).lower(params, start.p_f).compile()
        seconds, memory = time.perf_counter() - began, temporary_bytes(program) / 1e6
        return program, {"system": case.name, "steps": steps, "compile s": seconds, "MB": memory}

    options = {"macro_dt": case.macro_dt, "num_steps": SHORT, "save": SHORT // 10, "solver": solver}
    (program, short), (_, long) = map(gradient, (SHORT, LONG))
    calls = {
        "run": vm.prepare(problem, scheme, **options).timed(),
        "gradient": lambda: jax.block_until_ready(program(params, start.p_f)),
    }
    samples = {name: np.array(times) for name, times in interleaved(calls, repeats).items()}
    ratio = quartiles(list(samples["gradient"] / samples["run"]))
    short |= {"over a run": ratio.value, "run us": 1e6 * float(np.median(samples["run"])) / SHORT}
    return [short, long], ratio
