"""vmri_jax itself: every scheme is compiled once as a program that only steps, for all numbers of steps."""

import dataclasses
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import vmri_jax as vm
from benchmarks.peers.cases import Case, Ladder, step_counts, tolerances
from vmri_jax.running.simulate import run, run_memory
from vmri_jax.runtime import OPTIONS, in_one_kernel
from vmri_jax.schemes.composition import stage_scheme

COMPOSED = {"kahan-li8": (1, 2, 4), "kahan-li6": (1, 2, 4), "suzuki4": (1, 2, 4, 8)}
"""Compositions of `vm.fully_explicit` that are tried, with numbers of micro steps; the finest first."""
EXPLICIT = (4, 8, 16)
"""Numbers of micro steps of `vm.fully_explicit` on its own."""
CORRECTED = (1, 2, 4, 8)
"""Numbers of micro steps of `vm.takahashi_imada`."""
LOBATTO = (4, 5, 6, 8, 11, 12, 16)
"""Degrees of `vm.galerkin` with one interval to a step, where there are constraints."""
LOOSE = (1e-2, 1e-4, 1e-6)
"""Newton tolerances for moderate errors, where there are constraints; equations are also solved to round-off."""
LOOSE_HIGH = tuple(tolerances(1e-3, 1e-10))
"""The same for high degrees, whose steps are long: tolerances are relative to the motion."""
MARCH = vm.Newton("march")
"""As `vm.simulate` starts a run. What it does not solve fails here, and is not solved again in another way."""


def schemes(case: Case) -> dict[str, vm.Scheme | vm.Composition]:
    """Those that are the fastest somewhere on these problems, or close to it."""
    explicit = vm.fully_explicit
    found: dict[str, vm.Scheme | vm.Composition] = {
        f"explicit {n}, {name}": vm.compose(explicit(n), name) for name, micro in COMPOSED.items() for n in micro
    }
    if not case.is_chain:
        found |= {f"Lobatto {degree}": vm.galerkin(1, degree, "lobatto") for degree in LOBATTO}
    return found | {f"explicit {n}": explicit(n) for n in EXPLICIT} | corrected()


def corrected() -> dict[str, vm.Scheme]:
    """Explicit schemes whose frequencies of harmonic vibrations are of order 4."""
    return {f"Takahashi-Imada {n}": vm.takahashi_imada(n) for n in CORRECTED}


def batch_schemes() -> dict[str, vm.Scheme | vm.Composition]:
    """The same for batches and moderate errors."""
    composed = {f"explicit {n}, suzuki4": vm.compose(vm.fully_explicit(n), "suzuki4") for n in (1, 2, 4)}
    return corrected() | composed | {f"explicit {n}": vm.fully_explicit(n) for n in (4, 8)}


def loose(case: Case, scheme: vm.Scheme | vm.Composition) -> tuple[float, ...]:
    """Newton tolerances that are tried besides round-off."""
    if case.is_chain:
        return ()
    return LOOSE_HIGH if stage_scheme(scheme).degree > 1 else LOOSE


def program(case: Case, scheme: vm.Scheme | vm.Composition):
    """``run(start, t_end, num_steps, tolerance)``: positions at the end, NaN where a step failed; compiled once for all.

    It is what `vm.simulate` compiles, without the checks around it, which take a millisecond per call.
    """
    system, newton, n_s, n_f = case.problem.system, MARCH, case.problem.q_s.size, case.problem.q_f.size

    @partial(jax.jit, compiler_options=OPTIONS)
    @in_one_kernel
    def steps(start, t_end, num_steps, tolerance):
        q_s, q_f, p_s, p_f = jnp.split(start, np.cumsum([n_s, n_f, n_s]))
        state, macro_dt = vm.State(jnp.zeros(()), q_s, q_f, p_s, p_f), t_end / num_steps
        to_tolerance = eqx.tree_at(lambda newton: newton.tolerance, newton, tolerance)
        memory = run_memory(system, scheme, state, macro_dt, to_tolerance)
        last, _ = run(system, scheme, to_tolerance, macro_dt, state.t, state, memory, 0, 1, num_steps, False)
        return jnp.concatenate([last.q_s[-1], last.q_f[-1]])

    return steps


def ladders(case: Case) -> list[Ladder]:
    """One per scheme and tolerance of Newton's iteration: numbers of macro steps."""
    start, t_end = jnp.concatenate([jnp.asarray(case.q), jnp.asarray(case.masses * case.v)]), jnp.asarray(case.t_end)

    def of_scheme(name: str, scheme) -> list[Ladder]:
        steps = program(case, scheme)
        settings = step_counts(max(2, 2 * case.t_end), 1e6 * case.t_end)

        def ladder(name: str, tolerance: float) -> Ladder:
            def build(num_steps: int):
                return partial(steps, start, t_end, jnp.asarray(num_steps), jnp.asarray(tolerance))

            return Ladder(name, "steps", settings, build)

        looser = [ladder(f"{name}, tolerance {tol:.1e}", tol) for tol in loose(case, scheme)]
        return [ladder(name, MARCH.tolerance), *looser]

    return [found for name, scheme in schemes(case).items() for found in of_scheme(name, scheme)]


def energy(case: Case) -> float:
    """Of the start."""
    return case.energy


def batch_ladders(case: Case, states: vm.State, q, v, schemes=None) -> list[Ladder]:
    """`vm.simulate_batch` with these schemes, a dictionary like `batch_schemes`."""
    del q, v  # known from the states

    def ladder(name: str, scheme, tolerance: float) -> Ladder:
        newton = dataclasses.replace(MARCH, tolerance=tolerance)

        def build(num_steps: int):
            steps = {"macro_dt": case.t_end / num_steps, "num_steps": num_steps, "save_every": num_steps}

            def run():
                end = vm.simulate_batch(case.problem.system, scheme, states, **steps, newton=newton)
                return np.concatenate([np.asarray(end.q_s)[:, -1], np.asarray(end.q_f)[:, -1]], axis=1)

            return run

        return Ladder(name, "steps", step_counts(2 * case.t_end, 4000 * case.t_end), build)

    def by_name(scheme):
        return {"": MARCH.tolerance} | {f", tolerance {tol:.1e}": tol for tol in loose(case, scheme)}

    schemes = batch_schemes() if schemes is None else schemes
    return [ladder(a + b, scheme, tol) for a, scheme in schemes.items() for b, tol in by_name(scheme).items()]
