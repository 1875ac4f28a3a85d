"""Programs of prepared runs, with the observables of their nodes, and of gradients: their instructions after XLA's
optimisation, and the processor time until they are compiled."""

import re
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp

import vmri_jax as vm
from benchmarks.chains import Coordinates
from benchmarks.measure import Tell, exactly, silent
from benchmarks.programs import gallery_scene, problem
from benchmarks.report import Claim, Report

STEPS = 100
"""Macro steps of a program. The size of a program does not depend on this number."""
MICRO_DT = 2e-4


def double_pendulum() -> vm.Problem:
    """Two rods on one another, in angles: a kinetic energy that depends on positions."""

    def kinetic(q_s, q_f, v_s, v_f, params):
        return v_f[0] ** 2 + v_f[1] ** 2 / 8 + v_f[0] * v_f[1] * jnp.cos(q_f[0] - q_f[1]) / 2

    def potential(q_f, params):
        return -9.81 * (2 * jnp.cos(q_f[0]) + jnp.cos(q_f[1]) / 2) + 50 * (1 - jnp.cos(q_f[1]))

    return vm.Problem(
        vm.System(kinetic=kinetic, fast_potential=potential), q_s=[], q_f=[0.6, 0.3], v_s=[], v_f=[0.0, 1.0]
    )


@dataclass(frozen=True)
class Program:
    """A run, or the value and the gradient of a function of its end.

    most: instructions that it had when it was written down; a test allows a tenth more.
    """

    problem: Callable[[], vm.Problem]
    scheme: vm.Scheme
    most: int
    matrix: str = "auto"
    is_gradient: bool = False

    def compiled(self) -> jax.stages.Compiled:
        """The program."""
        problem, steps = self.problem(), {"macro_dt": MICRO_DT * self.scheme.num_micro, "num_steps": STEPS}
        options = {**steps, "save": STEPS, "solver": vm.Solver(self.matrix)}
        if not self.is_gradient:
            return vm.prepare(problem, self.scheme, **options).compiled()

        def last(state: vm.State):
            """Positions at the end."""
            run = vm.simulate(problem.system, self.scheme, state, **options)
            return jnp.sum(run.q_s[-1] ** 2) + jnp.sum(run.q_f[-1] ** 2)

        return jax.jit(jax.value_and_grad(last)).lower(problem.state()).compile()


def gallery(name: str, coordinates: Coordinates) -> vm.Problem:
    """The problem of a scene of the gallery."""
    return replace(gallery_scene(name), coordinates=coordinates).problem()


FPU, TSP, SAM = (partial(problem, name) for name in ("FPU l=3", "TSP", "SAM"))
SATELLITE = partial(gallery, "rigid_satellite", "joint")
SQUEEZER, ENGINE = (partial(gallery, name, "directors") for name in ("squeezer", "engine"))
PROGRAMS: dict[str, Program] = {
    "double pendulum in angles, fully_implicit(1)": Program(double_pendulum, vm.fully_implicit(1), 2050),
    "double pendulum in angles, galerkin(1, 3)": Program(double_pendulum, vm.galerkin(1, 3), 2410),
    "FPU, fully_explicit(5)": Program(FPU, vm.fully_explicit(5), 810),
    "FPU, fully_implicit(5)": Program(FPU, vm.fully_implicit(5), 2260),
    "FPU, fully_implicit(5), exact matrices": Program(FPU, vm.fully_implicit(5), 3460, "exact"),
    "TSP, fully_explicit(5)": Program(TSP, vm.fully_explicit(5), 3030),
    "TSP, fully_implicit(1)": Program(TSP, vm.fully_implicit(1), 2530),
    "TSP, fully_implicit(5)": Program(TSP, vm.fully_implicit(5), 3320),
    "TSP, fully_implicit(5), exact matrices": Program(TSP, vm.fully_implicit(5), 5360, "exact"),
    "SAM, fully_implicit(5)": Program(SAM, vm.fully_implicit(5), 4610),
    "SAM, fully_implicit(5), exact matrices": Program(SAM, vm.fully_implicit(5), 7410, "exact"),
    "satellite in joint coordinates, fully_explicit(5)": Program(SATELLITE, vm.fully_explicit(5), 6440),
    "squeezer by directors, fully_implicit(1)": Program(SQUEEZER, vm.fully_implicit(1), 3150),
    "engine by directors, explicit_slow(5)": Program(ENGINE, vm.explicit_slow(5), 6710),
    "gradient: double pendulum, fully_implicit(1)": Program(
        double_pendulum, vm.fully_implicit(1), 4130, is_gradient=True
    ),
    "gradient: TSP, fully_implicit(5)": Program(TSP, vm.fully_implicit(5), 8300, is_gradient=True),
}


def instructions(compiled: jax.stages.Compiled) -> int:
    """Instructions of a compiled program, parameters and constants included."""
    return len(re.findall(r"= \S+ ([a-z\-]+)\(", compiled.as_text() or ""))


def sizes(name: str) -> list[str]:
    """ "quick", without those that take longest to compile, or "full": names of programs."""
    longest = SAM, SATELLITE, SQUEEZER, ENGINE
    return [key for key, program in PROGRAMS.items() if name == "full" or program.problem not in longest]


def run(size: list[str], name: str, tell: Tell = silent) -> Iterator[Report]:
    """Compile them one after the other, a report after each."""
    report = Report("programs", name)
    for program in size:
        tell(program)
        row, claim = measured(program)
        report.rows.append(row)
        report.claims.append(claim)
        yield report


def measured(name: str) -> tuple[dict, Claim]:
    """The row of a program, and its instructions over those that were written down."""
    program = PROGRAMS[name]
    start = time.process_time()
    count = instructions(program.compiled())
    row = {"program": name, "instructions": count, "to compile, s": time.process_time() - start}
    return row, Claim(f"{name}: instructions over those written down", exactly(count / program.most), 1.1)
