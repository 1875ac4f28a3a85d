"""Gradients of runs: time of a gradient over the time of the run, memory, compile time and agreement of all adjoints."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

import vmri_jax as vm
from benchmarks.measure import Ratio, Tell, exactly, interleaved, quartiles, silent
from benchmarks.report import Claim, Report

ADJOINTS = ("stored", "checkpoint")
FACTOR, AGREEMENT, GROWTH = 4.0, 1e-10, 4.0
"""Targets: time over that of a run, differences of gradients, memory of checkpoints over a thousand times as many steps."""
SHORT, LONG = 1_000, 1_000_000
"""Steps of the gradients that are timed, and of those whose memory is read off the compiled program."""


@dataclass(frozen=True)
class Case:
    """A system whose squared positions at the end are differentiated with respect to its parameters and the momenta of the start."""

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
        rows, ratios = measured(case, size.repeats, tell)
        report.rows.extend(rows)
        for adjoint in ADJOINTS:
            report.claims.append(Claim(f"{case.name}: {adjoint} over a run", ratios[adjoint], at_most=FACTOR))
            apart = exactly(max(row.get("apart", 0.0) for row in rows if row["gradient"] == adjoint))
            report.claims.append(Claim(f"{case.name}: {adjoint} apart from stored", apart, at_most=AGREEMENT))
        memory = {(row["gradient"], row["steps"]): row["MB"] for row in rows}
        growth = exactly(memory["checkpoint", LONG] / memory["checkpoint", SHORT])
        words = f"{case.name}: memory of checkpoint, {LONG} over {SHORT} steps"
        report.claims.append(Claim(words, growth, at_most=GROWTH))
        report.note(f"{case.name}: a run takes {rows[0]['run us']:.1f} microseconds a step.")
        yield report


def measured(case: Case, repeats: int, tell: Tell) -> tuple[list[dict], dict[str, Ratio]]:
    """A row for each adjoint and number of steps, and times over that of a run."""
    problem, scheme, solver = case.problem(), vm.fully_implicit(10), vm.Solver("masses")
    start, params = problem.state(), jax.tree.map(jnp.asarray, problem.system.params)

    def gradient(adjoint: str, steps: int):
        def cost(params, p_f):
            state = vm.State(start.t, start.q_s, start.q_f, start.p_s, p_f)
            end = vm.simulate(
                problem.system.replace(params=params),
                scheme,
                state,
                macro_dt=case.macro_dt,
                num_steps=steps,
                save=vm.Save(steps // 10, adjoint=adjoint),
                solver=solver,
            )
            return jnp.sum(end.q_s[-1] ** 2) + jnp.sum(end.q_f[-1] ** 2)

        began = time.perf_counter()
        program = jax.jit(jax.grad(cost, (0, 1))).lower(params, start.p_f).compile()
        return program, time.perf_counter() - began

    forward = vm.prepare(
        problem, scheme, macro_dt=case.macro_dt, num_steps=SHORT, save=SHORT // 10, solver=solver
    ).timed()
    calls, rows, expected = {"run": forward}, [], None
    for adjoint in ADJOINTS:
        tell(f"{case.name}, {adjoint}")
        program, seconds = gradient(adjoint, SHORT)
        found = jnp.concatenate([jnp.ravel(a) for a in jax.tree.leaves(program(params, start.p_f))])
        expected = found if expected is None else expected
        apart = float(jnp.max(jnp.abs(found - expected)) / jnp.max(jnp.abs(expected)))
        calls[adjoint] = lambda program=program: jax.block_until_ready(program(params, start.p_f))
        rows.append(_row(case, adjoint, SHORT, seconds, program) | {"apart": apart})
        if adjoint == "checkpoint":
            program, seconds = gradient(adjoint, LONG)
            rows.append(_row(case, adjoint, LONG, seconds, program))
    samples = interleaved(calls, repeats)
    run, ratios = np.array(samples["run"]), {}
    for row in rows:
        if row["steps"] == SHORT:
            ratios[row["gradient"]] = quartiles(list(np.array(samples[row["gradient"]]) / run))
            row |= {"over a run": ratios[row["gradient"]].value, "run us": 1e6 * float(np.median(run)) / SHORT}
    return rows, ratios


def _row(case: Case, gradient: str, steps: int, seconds: float, program) -> dict:
    memory = program.memory_analysis().temp_size_in_bytes / 1e6
    return {"system": case.name, "gradient": gradient, "steps": steps, "compile s": seconds, "MB": memory}
