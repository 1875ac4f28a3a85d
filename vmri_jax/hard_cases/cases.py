"""The hard cases that apply to any system, with steps chosen from its frequencies."""

from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import cache, cached_property, partial

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax import textbook
from vmri_jax.accuracy.companions import positions
from vmri_jax.accuracy.simulate import simulate, simulate_batch
from vmri_jax.diagnostics import step_condition
from vmri_jax.diagnostics.linear import phase_vector
from vmri_jax.hard_cases.case import Case, Outcome, Report, draw_energy, run_cases
from vmri_jax.hard_cases.measures import (
    Energy,
    constraints,
    derivatives,
    difference,
    drift_meter,
    energy,
    energy_scale,
    long_run,
    refusal,
    run,
    status,
)
from vmri_jax.mechanics.constraints import configuration
from vmri_jax.mechanics.linearisation import linearise
from vmri_jax.mechanics.motion import motion
from vmri_jax.mechanics.projection import mass_and_momentum
from vmri_jax.mechanics.state import HasProblem, Problem, State, initial_state, problem_of
from vmri_jax.mechanics.system import System
from vmri_jax.running.progress import ShowsProgress, Working
from vmri_jax.running.trajectory import Trajectory
from vmri_jax.schemes.scheme import Scheme, fully_explicit, fully_implicit
from vmri_jax.stability import advise
from vmri_jax.stability.drive import drive_period
from vmri_jax.steppers.results import Result
from vmri_jax.steppers.solver import Solver

NUM_MICRO = 5
"""Micro steps per macro step of the cases."""
PHASE = 0.2
"""omega h of the fastest vibration; omega H = 1 is below the first resonance, which a larger value may meet."""
LONGER_RUN = 8
"""Factor by which a run is lengthened if its energy has a trend. In the longer run the trend of a slow motion turns
back or settles, and a drift goes on; a larger factor tells the two apart more safely and takes longer."""
DRIFT_RATIO = 0.75
"""Rate of the trend in the longer run, as a part of the rate in the first run, above which the trend is a drift; a
larger value overlooks drifts that slow down."""
ROUND_OFF_BAND = 1e-9
"""Relative band of the energy up to which it is round-off; a larger value overlooks small drifts."""
SHADOW_STEPS = 2_000
"""Steps of the run for the shadow energy; more of them find slower drifts and take longer."""
ROUND_OFF = 4 * np.finfo(float).eps
"""Round-off of a position in a step, as a part of the largest position; a larger value hides differences of momenta."""
OVERFLOWING_MOMENTUM = 1e160
"""A momentum whose square, and so its kinetic energy, overflows float64."""
ENERGY_CRITERION = (
    "the linear trend is at most half of the largest energy error, or flattens in a longer run, or the error is below "
    "1e-9"
)
EXPLICIT_CRITERION = "runs at omega h = 1; at 2.5 every NaN is reported as a failure"
DERIVATIVE_CRITERION = "gradients and Hessians are those of the functions, to 1e-4"
LANE_CRITERION = "the bad lane reports its failure, the others equal their single runs to 1e-12"


@dataclass(frozen=True)
class Resolved:
    """A problem with a scheme and a step that resolve its fastest vibration, omega; every public method is a case."""

    problem: Problem
    scheme: Scheme
    macro_dt: float
    omega: float

    def rank(self, full: bool) -> Outcome:
        state, system = self.problem.state(), self.problem.system
        trajectory = run(self.problem, self.scheme, self.macro_dt, 10_000 if full else 1_000, save=10)
        jacobian = jax.jit(jax.vmap(jax.jacrev(system.constraints, argnums=(1, 2))))
        jacobians = jacobian(trajectory.t, trajectory.states.q_s, trajectory.states.q_f)
        rows = np.concatenate([np.asarray(a) for a in jacobians], axis=2)
        rows = rows[np.isfinite(rows).all(axis=(1, 2))]
        rows = rows / np.linalg.norm(rows, axis=2, keepdims=True)
        smallest = np.linalg.svd(rows, compute_uv=False)[:, -1]
        return Outcome(
            f"{sum(system.num_constraints(state.q_s, state.q_f))} rows; smallest singular value of the scaled rows "
            f"{smallest[0]:.1e} at the start, {smallest.min():.1e} on the way; {status(trajectory)}",
            trajectory.success and smallest.min() > 1e-8,
            {"at_start": smallest[0], "least": smallest.min()},
        )

    @cached_property
    def _long_run(self) -> Callable[[int], Trajectory]:
        """A long run by its number of macro steps, which two cases judge."""
        return cache(partial(long_run, self.problem, self.scheme, self.macro_dt))

    def constraints(self, full: bool) -> Outcome:
        steps = 1_000_000 if full else 10_000
        trajectory = self._long_run(steps)
        position, velocity = constraints(trajectory)
        nodes, system = trajectory.states, self.problem.system
        solved = sum(system.num_constraints(self.problem.q_s, self.problem.q_f))

        @jax.jit
        @jax.vmap
        def kept(t, q_s, q_f):
            rows = configuration(system, t, q_s, q_f).rows
            return jnp.abs(rows.values) <= rows.allowed(1e-10, solved)

        return Outcome(
            f"{steps:.0e} steps: {status(trajectory)}, |g| {position:.1e}, |G v| {velocity:.1e}",
            trajectory.success and bool(kept(nodes.t, nodes.q_s, nodes.q_f).all()),
            {"constraint": position, "velocity_constraint": velocity},
        )

    def energy(self, full: bool) -> Outcome:
        steps = 1_000_000 if full else 10_000
        trajectory, change = self._energy(steps)
        trend = change.drifts and change.band > ROUND_OFF_BAND
        if trend and trajectory.success:
            steps *= LONGER_RUN
            before, (trajectory, change) = change, self._energy(steps)
            trend = change.drifts and abs(change.drift) > DRIFT_RATIO * abs(before.drift)
        shadow = drift_meter(self.problem, self.scheme, self.macro_dt, SHADOW_STEPS)
        return Outcome(
            f"{steps:.0e} steps: {status(trajectory)}, relative band {change.band:.1e}, drift {change.drift:.0e} per "
            f"1e5 steps ({change.share:.0%} of the band over the run)"
            + ("" if shadow is None else f"; first {SHADOW_STEPS} steps: {shadow}"),
            trajectory.success and not trend,
            {"band": change.band, "drift_per_1e5": change.drift},
            partial(draw_energy, {"": trajectory}),
        )

    def _energy(self, steps: int) -> tuple[Trajectory, Energy]:
        trajectory = self._long_run(steps)
        return trajectory, energy(trajectory, steps, energy_scale(self.problem, trajectory))

    def tolerance(self, full: bool) -> Outcome:
        steps, ends = 1_000 if full else 100, {}
        for tolerance in (1e-4, 1e-8, 1e-12):
            solver = Solver(tolerance=tolerance)
            trajectory = run(self.problem, self.scheme, self.macro_dt, steps, save=steps, solver=solver)
            ends[tolerance] = positions(trajectory)[-1]
        loose, middle = (difference(ends[t], ends[1e-12]) for t in (1e-4, 1e-8))
        return Outcome(
            f"after {steps} steps from the run at 1e-12: {loose:.0e} at 1e-4, {middle:.0e} at 1e-8",
            np.isfinite(loose) and middle <= max(loose, 1e-10) and middle < 1e-3,
            {"apart_1e-4": loose, "apart_1e-8": middle},
        )

    def tiny_steps(self, full: bool) -> Outcome:
        state, steps = self.problem.state(), self.macro_dt * 10.0 ** -np.arange(0, 6 if full else 5, 2)
        conditions = [step_condition(self.problem.system, self.scheme, state, macro_dt=h) for h in steps]
        words = ", ".join(f"{c:.3g} at H = {h:.0e}" for c, h in zip(conditions, steps, strict=True))
        return Outcome(
            f"scaled condition {words}",
            np.isfinite(conditions).all() and conditions[-1] < 1.5 * conditions[1],
            {f"condition_{h:.0e}": c for h, c in zip(steps, conditions, strict=True)},
        )

    def reversal(self, full: bool) -> Outcome:
        """Forward and, from the end with reversed momenta, as far back."""
        steps, apart = 1_000 if full else 100, np.inf
        there = run(self.problem, self.scheme, self.macro_dt, steps, save=steps)
        if there.success:
            end = there.final_state
            turned = State(0.0, end.q_s, end.q_f, -end.p_s, -end.p_f)
            back = run(self.problem, self.scheme, self.macro_dt, steps, turned, save=steps)
            apart = difference(positions(back)[-1], positions(there)[0])
        return Outcome(f"{steps} steps there and back: {apart:.0e} from the start", apart < 1e-6, {"apart": apart})

    def explicit_limit(self, full: bool) -> Outcome:
        steps = 10_000 if full else 1_000
        below, beyond = (run(self.problem, fully_explicit(1), wh / self.omega, steps, save=10) for wh in (1.0, 2.5))
        bounded = energy(below, steps, energy_scale(self.problem, below)).band
        finite = all(bool(jnp.isfinite(r.energy).all()) == bool(r.success) for r in (below, beyond))
        return Outcome(
            f"omega h = 1: {status(below)}, relative energy error {bounded:.1e}; 2.5: {status(beyond)}",
            below.success and finite,
            {"band_below": bounded, "failed_at_beyond": beyond.failed_at},
        )

    def textbook(self, full: bool) -> Outcome:
        steps = 100 if full else 20
        single = fully_explicit(1), 0.1 / self.omega
        implicit, explicit = (self._from_textbook(*of, steps) for of in ((self.scheme, self.macro_dt), single))
        return Outcome(
            f"largest difference in {steps} steps: fully_implicit {implicit:.0e}, fully_explicit {explicit:.0e}",
            max(implicit, explicit) < 1e-10,
            {"fully_implicit": implicit, "fully_explicit": explicit},
        )

    def _from_textbook(self, scheme: Scheme, macro_dt: float, steps: int) -> float:
        """Largest difference of a run from the textbook, relative to the largest positions and momenta, less the
        round-off ``eps |M| |q| / h`` of momenta, ``M (q_+ - q) / h``."""
        system, state = self.problem.system, self.problem.state()
        simulated = jax.jit(textbook.simulate, static_argnames="num_steps")
        oracle = simulated(system, scheme, state, macro_dt, num_steps=steps)
        runs = run(self.problem, scheme, macro_dt, steps).states, oracle
        (q, p), (q_oracle, p_oracle) = (np.split(np.asarray(phase_vector(states)), 2, axis=1) for states in runs)
        mass, _ = mass_and_momentum(system, state.q_s, state.q_f, 0 * state.p_s, 0 * state.p_f)
        largest_q, largest_p = (max(np.abs(a).max(), 1e-300) for a in (q_oracle, p_oracle))
        round_off = steps * ROUND_OFF * float(np.abs(mass).max()) * largest_q * scheme.num_micro / macro_dt
        return max(difference(q, q_oracle), difference(p, p_oracle) - round_off / largest_p)

    def bad_lane(self, full: bool) -> Outcome:
        """A batch that starts at the nodes of a run, one of them with overflowing momenta, beside single runs."""
        lanes, options = 64 if full else 16, {"macro_dt": self.macro_dt, "num_steps": 20, "save": 20}
        bad = lanes // 3
        along = run(self.problem, self.scheme, self.macro_dt, lanes - 1)  # nodes are consistent with all constraints
        p_s, p_f = (jnp.asarray(p).at[bad].set(OVERFLOWING_MOMENTUM) for p in (along.p_s, along.p_f))
        states = State(along.t, along.q_s, along.q_f, p_s, p_f)
        batch = simulate_batch(self.problem.system, self.scheme, states, **options, warn=False)
        failed = np.flatnonzero(np.asarray(batch.failed_at) >= 0)
        apart = 0.0
        for lane in sorted({*np.linspace(0, lanes - 1, 4, dtype=int), bad - 1, bad + 1} - {bad}):
            single = run(self.problem, self.scheme, state=jax.tree.map(lambda a, lane=lane: a[lane], states), **options)
            apart = max(apart, *(difference(getattr(batch, q)[lane], getattr(single, q)) for q in ("q_s", "q_f")))
        result = Result(int(batch.result[bad])).name
        return Outcome(
            f"{lanes} lanes: lane {bad} {result}, {len(failed)} failed in all; others within {apart:.0e} of their "
            "single runs",
            list(failed) == [bad] and apart < 1e-12,
            {"failed": len(failed), "apart": apart},
        )

    def single_precision(self, full: bool) -> Outcome:
        """Whether the messages have the line that mends a run with the 64-bit mode off, and a start in float32."""
        problem, steps = self.problem, {"macro_dt": self.macro_dt, "num_steps": 1}
        state = problem.state()
        q_s, q_f = (np.asarray(q, np.float32) for q in (problem.q_s, problem.q_f))
        with jax.enable_x64(False):
            off = refusal(lambda: simulate(problem.system, self.scheme, state, **steps))
        data = refusal(lambda: initial_state(problem.system, q_s, q_f, problem.v_s, problem.v_f))
        fix = 'jax.config.update("jax_enable_x64", True)' in off
        cast = "float32" in data and "astype(float)" in data
        return Outcome(
            f"64-bit mode off: {'refused with the line to add' if fix else off or 'accepted'}; float32 positions: "
            f"{'refused with the cast' if cast else data or 'accepted'}",
            fix and cast,
            {"mode_refused": fix, "data_refused": cast},
        )

    def advice(self, full: bool) -> Outcome:
        advice = advise(self.problem, self.scheme, macro_dt=self.macro_dt)
        return Outcome(str(advice).replace("\n", "; "), advice.ok, {"safe_macro_dt": advice.safe_macro_dt})


def resolved(problem: Problem) -> Resolved:
    """A problem with five micro steps of ``omega h = 0.2`` for its largest frequency at the start, or for the frequency
    of its drive if larger.

    If nothing vibrates, ``omega = max(|q'_i| / |q_i|, sqrt(|q''_i| / |q_i|))``, the rate at which positions change by
    their size; 1 for a body at rest without forces.
    """
    state = problem.state()
    linear = linearise(problem.system, state)
    turning = np.abs(np.imag(linear.rates)).max(initial=0.0)  # also by magnetic fields
    omega = float(max(linear.frequencies.max(initial=0.0), turning))
    if not omega > 0:
        now = motion(problem.system, state)
        pairs = (state.q_s, state.q_f), (now.v_s, now.v_f), (now.a_s, now.a_f)
        q, v, a = (np.abs(np.append(*pair)) for pair in pairs)
        sizes = np.where(q > 0, q, q.max() or 1.0)
        omega = float(max((v / sizes).max(), np.sqrt(a / sizes).max())) or 1.0
    omega = max(omega, 2 * np.pi / (drive_period(problem.system, state, 1 / omega) or np.inf))
    return Resolved(problem, fully_implicit(NUM_MICRO), NUM_MICRO * PHASE / omega, omega)


def cases_for(problem: Problem | HasProblem) -> tuple[Case, ...]:
    """The hard cases for a system, each with a criterion; cases that do not apply to the system give the reason.

    Args:
        problem: system and start; a `Problem` or a scene.

    Raises:
        ValueError: the problem is refused by `initial_state`.
    """
    problem = problem_of("cases_for", problem)
    with Working("cases_for: small motions about the start"):
        cases = resolved(problem)
    system = problem.system
    unconstrained = "" if system.is_constrained else "the system has no constraints"
    outside, limitless = _outside(system), _has_no_limit(system)
    one_way = f"{outside}: the way back is another motion" if outside else _turns_one_way(problem)

    step = f"fully_implicit, num_micro {NUM_MICRO}, H = {cases.macro_dt:.3g}"
    single = f"num_micro 1, omega = {cases.omega:.3g}"
    rows = [
        ("advice", step, "no error, no warning", cases.advice),
        ("rank of the constraints", step, "rows independent at the start and on the way", cases.rank, unconstrained),
        ("constraints for long", step, "position constraint below 1e-10 of its size", cases.constraints, unconstrained),
        ("energy for long", step, ENERGY_CRITERION, cases.energy, outside and f"{outside}: no energy is kept"),
        ("loose Newton tolerance", f"{step}, 1e-4 to 1e-12", "error shrinks with the tolerance", cases.tolerance),
        ("tiny steps", f"{step} and smaller", "scaled condition flat", cases.tiny_steps),
        ("reversibility", step, "back at the start to 1e-6", cases.reversal, one_way),
        ("explicit limit", f"fully_explicit, {single}", EXPLICIT_CRITERION, cases.explicit_limit, limitless),
        ("textbook", f"{step}; fully_explicit, {single}", "steps of vmri_jax.textbook to 1e-10", cases.textbook),
        ("float32", "64-bit mode off, and float32 data", "refused with the one-line fix", cases.single_precision),
        ("one bad lane in a batch", step, LANE_CRITERION, cases.bad_lane),
        ("derivatives", step, DERIVATIVE_CRITERION, lambda _: derivatives(problem, cases.scheme, cases.macro_dt)),
    ]
    return tuple(
        Case(number, title, setup, criterion, run, "".join(reason))
        for number, (title, setup, criterion, run, *reason) in enumerate(rows, start=1)
    )


def check(
    problem: Problem | HasProblem, numbers: Collection[int] = (), full: bool = False, progress: ShowsProgress = False
) -> Report:
    """Put a system to the hard cases: constraints, energy, tolerance, tiny steps, reversal, batches, bad input.

    Args:
        problem: a `Problem` or a scene; steps are chosen from its frequencies.
        numbers, full, progress: as of `run_cases`.

    Returns:
        The `Report`, an outcome for each case.

    Raises:
        ValueError, Interrupted: as of `run_cases`.
    """
    return run_cases(cases_for(problem), numbers, full, progress)


def _outside(system: System) -> str:
    """The reason why work may be done on the system from outside; empty for a closed system."""
    if system.is_rheonomic:
        return "its constraints move with time"
    return "" if system.force is None else "it has forces besides its potentials, as friction and drives"


def _has_no_limit(system: System) -> str:
    """The reason why the stability limit of an explicit scheme is not ``omega h = 2``; empty if it is."""
    if system.is_constrained:
        return "every step solves for the multipliers of its constraints, explicit schemes too"
    if not system.has_constant_mass:
        return "its kinetic energy is a function, not that of constant masses: every step solves equations"
    if system.force is not None:
        return "it has forces besides its potentials: every step solves equations, and damping changes the limit"
    return ""


def _turns_one_way(problem: Problem) -> str:
    """The reason why reversed momenta do not lead back to the start; empty if the kinetic energy is even in them."""
    random, system = np.random.default_rng(0), problem.system
    v_s, v_f = (random.uniform(-1, 1, q.shape) for q in (problem.q_s, problem.q_f))
    there, back = (float(system.kinetic_energy(problem.q_s, problem.q_f, v_s * x, v_f * x)) for x in (1, -1))
    if abs(there - back) <= 1e-12 * (abs(there) + abs(back)):
        return ""
    return "its kinetic energy depends on the sign of velocities (magnetic fields): the way back is another motion"
