"""The programs that are timed: the built-in systems under the schemes of the reference study."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import vmri_jax as vm
from vmri_jax.runtime import OPTIONS

SCHEMES: dict[str, Callable[[int], vm.Scheme]] = {
    "fully implicit": vm.fully_implicit,
    "explicit slow": vm.explicit_slow,
    "fully explicit": vm.fully_explicit,
}
SYSTEMS = {
    "FPU": vm.systems.fermi_pasta_ulam,
    "TSP": vm.systems.triple_spherical_pendulum,
    "SAM": vm.systems.simple_atomic_model,
}


def problem(name: str, amplitude: float = 1.0) -> vm.Problem:
    """``"TSP"``, ``"SAM"``, or the chain with so many springs, ``"FPU l=50"``; its start may be made smaller."""
    system, _, springs = name.partition(" l=")
    problem = SYSTEMS[system](int(springs)) if springs else SYSTEMS[system]()
    if amplitude == 1.0:
        return problem
    return replace(problem, **{key: amplitude * getattr(problem, key) for key in ("q_s", "q_f", "v_s", "v_f")})


def unknowns(problem: vm.Problem, num_micro: int) -> int:
    """Unknowns of one macro step of degree 1, all of them solved for at once."""
    n_g, n_gs = problem.system.num_constraints(problem.q_s, problem.q_f)
    return problem.q_s.size + n_gs + num_micro * (problem.q_f.size + n_g)


def program(problem: vm.Problem, scheme: vm.Scheme, micro_dt: float, newton: vm.Newton | None = None):
    """``run(num_steps)``: simulate, and save the last node only; a run that fails is seen in its ``result``."""

    def run(num_steps: int, state: vm.State) -> vm.Trajectory:
        step = {"micro_dt": micro_dt, "num_steps": num_steps, "save_every": num_steps}
        return vm.simulate(problem.system, scheme, state, **step, newton=newton, throw=False)

    return partial(run, state=problem.state())


def short_program(problem: vm.Problem, scheme: vm.Scheme, micro_dt: float):
    """The same compiled once more as a whole, for every number of steps: a call costs nothing besides its steps."""
    whole = jax.jit(
        lambda num_steps, state: program(problem, scheme, micro_dt)(num_steps, state=state),
        static_argnums=0,
        compiler_options=OPTIONS,
    )
    return partial(whole, state=problem.state())


def failed(trajectory: vm.Trajectory) -> bool:
    """Whether any step, or any trajectory of a batch, failed."""
    return bool(np.any(np.asarray(trajectory.failed_at) >= 0))


def starts(problem: vm.Problem, batch: int, spread: float = 0.01) -> vm.State:
    """So many starts that differ in their velocities, consistent with the constraints, batch axis first."""

    def start(v_s, v_f):
        return vm.initial_state(problem.system, problem.q_s, problem.q_f, v_s, v_f)

    random = np.random.default_rng(0)
    v_s, v_f = (jnp.asarray(v + spread * random.normal(size=(batch, v.size))) for v in (problem.v_s, problem.v_f))
    return jax.jit(jax.vmap(start))(v_s, v_f)
