"""Many macro steps: one compiled nested scan, with a status per step and nothing lost when one fails."""

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax import diagnostics
from vmri_jax.mechanics.arrays import is_concrete, real_array
from vmri_jax.mechanics.checks import (
    CONSTRAINT_TOLERANCE,
    check_arrays,
    check_flags,
    check_number,
    check_params,
    check_system,
    check_type,
    require_x64,
)
from vmri_jax.mechanics.state import State, check_constraints
from vmri_jax.mechanics.system import System
from vmri_jax.running.interrupts import Interrupted, interrupts_noted
from vmri_jax.running.trajectory import RunInfo, Trajectory, join
from vmri_jax.runtime import OPTIONS, in_one_kernel
from vmri_jax.schemes.composition import Composition, stage_scheme
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.steppers.newton import Newton
from vmri_jax.steppers.plan import has_fallback, plan
from vmri_jax.steppers.plan import projects_rarely as _projects_rarely
from vmri_jax.steppers.results import Method, Result, SimulationError


def simulate(
    system: System,
    scheme: Scheme | Composition,
    state: State,
    *,
    macro_dt=None,
    micro_dt=None,
    num_steps: int,
    save_every: int = 1,
    save_micro: bool = False,
    newton: Newton | None = None,
    throw: bool = True,
    progress: bool = False,
) -> Trajectory:
    """Simulate `num_steps` macro steps and save every `save_every`-th macro node.

    Compiled once per system structure, scheme structure and number of saved nodes: step sizes, parameters, rule
    weights, initial states and `save_every` may vary without compiling again. Works under ``jax.vmap`` over state,
    params and macro_dt, and under ``jax.grad`` and ``jax.jacfwd``; then the status is in the trajectory and never raised.
    Under ``jax.vmap`` the method "auto" computes its fallback for every lane: take `simulate_batch`, or "march".

    Args:
        system, scheme: what moves, and how.
        state: start, from `initial_state` or a former run.
        macro_dt, micro_dt: step size, exactly one of them (``macro_dt = num_micro * micro_dt``).
        num_steps: macro steps, a multiple of `save_every`.
        save_every: macro steps from one saved node to the next.
        save_micro: also keep the fast positions at the micro nodes of the macro step that ends at each saved node.
        newton: how implicit equations are solved.
        throw: raise `SimulationError` (which carries the partial trajectory) if a step fails; else return the trajectory,
            NaN from the failure on.
        progress: show a progress bar; the run is then compiled for a part of its saved nodes.

    Returns:
        The `Trajectory`, with ``num_steps / save_every + 1`` saved nodes. Times are ``t_0 + k macro_dt``, computed from
        the step number k, never accumulated.

    Raises:
        ValueError, TypeError: bad arguments, before anything is computed.
        SimulationError: a step failed.
        Interrupted: Ctrl-C while `progress` is shown; it carries what was computed.
    """
    check_flags(throw=throw, progress=progress)
    simulation, start = prepare(system, scheme, state, newton, macro_dt, micro_dt, num_steps, save_every, save_micro)
    num_saves = num_steps // save_every
    if not simulation.is_concrete(start):
        return simulation.all(start, num_saves)

    at, pieces = simulation.start(start), []
    check_constraints(system, start, "simulate: the state")
    with interrupts_noted(progress) as interrupted:
        for saves in _sizes(num_saves, progress):
            piece, at = simulation.advance(at, saves)
            pieces.append(piece)
            if interrupted():
                raise Interrupted(join(pieces), at.step, num_steps)
    trajectory = join(pieces)
    if throw and int(trajectory.failed_at) >= 0:
        raise simulation_error(trajectory, simulation.macro_dt, save_every)
    return trajectory


class Checkpoint(NamedTuple):
    """Where a run stands: all that its next steps depend on, to the last bit.

    step: macro steps done.
    state, memory: at the node reached, and what the last step hands on.
    fell_back: whether the nested march has given way to its fallback.
    """

    step: int
    state: State
    memory: Any
    fell_back: bool = False


@dataclasses.dataclass(frozen=True)
class Simulation:
    """What stays the same all along a run, whose pieces are computed one after the other from a `Checkpoint`."""

    system: System
    scheme: Scheme | Composition
    newton: Newton
    macro_dt: Any
    t_start: Any
    save_every: int
    save_micro: bool

    def is_concrete(self, start: State) -> bool:
        """Whether there are only numbers, no tracers of a transformation."""
        return is_concrete((self.system, self.scheme, start, self.macro_dt, self.newton))

    def newton_for(self, fell_back: bool) -> Newton:
        """How steps are solved: "auto" is first the march alone (its fallback takes long to compile)."""
        return self.newton if fell_back or not self.newton.falls_back else _alone(self.newton, self.system, self.scheme)

    def start(self, state: State, step: int = 0, fell_back: bool = False) -> Checkpoint:
        """Before the first step, or before any as if it was the first one."""
        memory = run_memory(self.system, self.scheme, state, self.macro_dt, self.newton_for(fell_back))
        return Checkpoint(step, state, memory, fell_back)

    def advance(self, at: Checkpoint, saves: int) -> tuple[Trajectory, Checkpoint]:
        """The next `saves` saved intervals, compiled once per number of them.

        Where the march fails the run goes on from the last saved node before with the fallback.
        """
        newton = self.newton_for(at.fell_back)
        piece, end = self._advance(at, saves, newton)
        failed = int(piece.failed_at)
        if failed < 0 or newton is self.newton:
            return piece, end
        if int(jnp.max(piece.info.method)) < Method.RATTLE:  # explicit or linear: no other method helps
            return piece, end
        kept = (failed - at.step) // self.save_every
        good = [piece.first(kept)] if kept else []
        state = good[0].final_state if kept else at.state
        at = self.start(state, at.step + kept * self.save_every, fell_back=True)
        rest, end = self._advance(at, saves - kept, self.newton)
        return join([*good, rest]), end

    def _advance(self, at: Checkpoint, saves: int, newton: Newton) -> tuple[Trajectory, Checkpoint]:
        piece, state, memory = _run_in_one_kernel(
            self.system, self.scheme, newton, self.macro_dt, self.t_start, at.state, at.memory, at.step, saves,
            self.save_every, self.save_micro,
        )  # fmt: skip
        return piece, Checkpoint(at.step + saves * self.save_every, state, memory, at.fell_back)

    def all(self, state: State, saves: int) -> Trajectory:
        """The whole run as one piece, under transformations of JAX."""
        check_system(self.system, state.q_s, state.q_f)
        at = self.system, self.scheme, self.newton, self.macro_dt, self.t_start, state
        rules = stage_scheme(self.scheme)
        falls_back = iterates = has_fallback(plan(self.system, rules, self.newton, state))
        whole = _march_first if falls_back and iterates else _whole
        return whole(saves, self.save_every, self.save_micro, at)


def _alone(newton, system, scheme):
    """Temporary."""
    from vmri_jax.steppers.plan import _can_be_nested

    return newton.without_fallback() if _can_be_nested(system, stage_scheme(scheme)) else newton


def run(
    system, scheme, newton, macro_dt, t_start, state, memory, first_step, num_saves, save_every, save_micro
) -> tuple[Trajectory, Any]:
    """`num_saves * save_every` macro steps from step number `first_step`; also the memory for the next one."""
    stepper = plan(system, scheme, newton, state)
    n, rarely = scheme.num_micro, _projects_rarely(stepper)

    def step(_, carry):
        state, memory, k, (result, failed_at), worst, _ = carry
        state, info, memory = stepper.step(state, memory, macro_dt)
        alive = failed_at < 0  # until the step before
        ok = alive & (info.result <= Result.CONVERGED_AT_ROUNDOFF)
        now = (info.method, info.iterations, info.residual)
        worst = tuple(jnp.where(alive, jnp.maximum(w, x), w) for w, x in zip(worst, now, strict=True))
        result = jnp.where(alive, jnp.maximum(result, info.result), result)
        status = (result, jnp.where(alive & ~ok, k, failed_at))
        p_s, p_f = jnp.where(ok, state.p_s, jnp.nan), jnp.where(ok, state.p_f, jnp.nan)  # positions follow, see below
        state = State(t_start + (k + 1) * macro_dt, state.q_s, state.q_f, p_s, p_f)
        micro = jnp.where(ok, info.q_f_micro, jnp.nan) if save_micro else None
        return state, memory, k + 1, status, worst, micro

    def save(carry, _):
        state, memory, k, status = carry
        worst = (jnp.asarray(0), jnp.asarray(0), jnp.zeros(()))
        micro = jnp.zeros((n, state.q_f.shape[0])) if save_micro else None
        carry = (state, memory, k, status, worst, micro)
        state, memory, k, status, worst, micro = jax.lax.fori_loop(0, save_every, step, carry)
        if rarely:
            state, memory = stepper.project(state, memory)
        return (state, memory, k, status), (state, worst, micro)

    status = (jnp.asarray(int(Result.CONVERGED)), jnp.asarray(-1))
    carry = (state, memory, jnp.asarray(first_step), status)
    (_, memory, _, status), (states, worst, micro) = jax.lax.scan(save, carry, length=num_saves)
    nodes = jax.tree.map(lambda first, later: jnp.concatenate([first[None], later]), state, states)
    phase = (nodes.q_s, nodes.q_f, nodes.p_s, nodes.p_f)
    energy = jax.vmap(partial(diagnostics.energy, system))(*phase)

    # The energy is NaN from a failing step on. A potential may also be NaN where its gradient is not (a logarithm beyond
    # its pole), and a lane of a batch may start off its constraints: such nodes are no result either.
    residual = jax.vmap(partial(diagnostics.constraint_residual, system))(nodes)
    kept = residual[:, 0] <= jnp.maximum(CONSTRAINT_TOLERANCE, 100 * newton.tolerance)
    broken = jnp.cumsum(~jnp.isfinite(energy) | ~kept) > 0
    first = jnp.argmax(broken)
    at_node = first_step + first * save_every - 1
    newly = broken.any() & ((status[1] < 0) | (at_node < status[1]))
    cause = jnp.where(jnp.isfinite(energy[first]), Result.CONSTRAINT_VIOLATED, Result.NON_FINITE)
    status = (jnp.where(newly, cause, status[0]), jnp.where(newly, jnp.maximum(at_node, 0), status[1]))
    energy = jnp.where(broken, jnp.nan, energy)
    phase = tuple(jnp.where(broken[:, None], jnp.nan, a) for a in phase)

    trajectory = Trajectory(
        nodes.t,
        *phase,
        energy=energy,
        constraint_residual=jnp.where(broken[:, None], jnp.nan, residual),
        info=RunInfo(*worst),
        result=status[0],
        failed_at=status[1],
        t_micro=nodes.t[1:, None] - macro_dt * (1 - scheme.micro_times) if save_micro else None,
        q_f_micro=micro,
    )
    return trajectory, memory


# A traced save_every lets a sweep over step sizes compile once; under a transformation it is static instead, so that
# the trip count of the loop is known and reverse mode works.
_run_static = jax.jit(run, static_argnames=("num_saves", "save_micro", "save_every"))


def _whole(num_saves: int, save_every: int, save_micro: bool, at) -> Trajectory:
    """All of a run at once, with one Newton for every step."""
    system, scheme, newton, macro_dt, t_start, state = at
    memory, saves = run_memory(system, scheme, state, macro_dt, newton), (num_saves, save_every, save_micro)
    trajectory, _ = _run_static(system, scheme, newton, macro_dt, t_start, state, memory, 0, *saves)
    return trajectory


@partial(jax.custom_jvp, nondiff_argnums=(0, 1, 2))
def _march_first(num_saves: int, save_every: int, save_micro: bool, at) -> Trajectory:
    """`_whole` by the nested march alone, whose loops are single kernels; by the arrowhead if that fails."""

    def by(newton: Newton) -> Trajectory:
        return _whole(num_saves, save_every, save_micro, (system, scheme, newton, *rest))

    system, scheme, newton, *rest = at
    found = by(_alone(newton, system, scheme))
    exact = dataclasses.replace(newton, method="arrowhead")
    return jax.lax.cond(found.failed_at < 0, lambda: found, lambda: by(exact))


@_march_first.defjvp
def _of_each_step(num_saves, save_every, save_micro, primals, tangents):
    """Derivatives are those of the run that falls back step by step: one program instead of two."""
    return jax.jvp(partial(_whole, num_saves, save_every, save_micro), primals, tangents)


@partial(jax.jit, static_argnames=("num_saves", "save_micro"), compiler_options=OPTIONS)
def _run_in_one_kernel(
    system, scheme, newton, macro_dt, t_start, at, memory, first_step, num_saves, save_every, save_micro
):
    """Also the state at the end."""

    @in_one_kernel
    def go(macro_dt, t_start, at, memory, first_step):
        return run(system, scheme, newton, macro_dt, t_start, at, memory, first_step, num_saves, save_every, save_micro)

    piece, memory = go(macro_dt, t_start, at, memory, first_step)
    return piece, piece.final_state, memory


@jax.jit
def run_memory(system, scheme, state, macro_dt, newton):
    """`start_memory`; what the user's functions return is checked while tracing."""
    check_system(system, state.q_s, state.q_f)
    return plan(system, scheme, newton, state).init(state, macro_dt)


def _sizes(num_saves: int, progress: bool):
    """Numbers of saved nodes per compiled call; one call, or about 50 equal ones with a progress bar around them."""
    if not progress:
        yield num_saves
        return
    from rich.progress import track

    size = -(-num_saves // 50)
    sizes = [size] * (num_saves // size) + ([num_saves % size] if num_saves % size else [])
    yield from track(sizes, description="simulating", transient=True)


def prepare(
    system, scheme, state, newton, macro_dt, micro_dt, num_steps, save_every, save_micro
) -> tuple[Simulation, State]:
    """The simulation that these arguments of `simulate` ask for, and its start; bad ones are refused."""
    macro_dt = check_run(system, scheme, state, newton, macro_dt, micro_dt, num_steps, save_every, save_micro)
    start = State(jnp.asarray(state.t, dtype=float), *check_arrays(**_vectors(state)))
    macro_dt = jnp.asarray(macro_dt, dtype=float)
    return Simulation(system, scheme, newton or Newton(), macro_dt, start.t, save_every, save_micro), start


def _vectors(state: State) -> dict:
    return {name: getattr(state, name) for name in ("q_s", "q_f", "p_s", "p_f")}


def check_run(system, scheme, state, newton, macro_dt, micro_dt, num_steps, save_every, save_micro=False):
    """Refuse bad arguments of `simulate`; returns macro_dt."""
    require_x64()
    if not isinstance(scheme, Scheme | Composition):
        raise TypeError(
            f"simulate: scheme is {type(scheme).__name__}; give a Scheme, e.g. fully_implicit(num_micro=10)."
        )
    check_type("simulate: system", system, System, "a vmri_jax.System")
    check_type("simulate: state", state, State, "a State, e.g. from initial_state(...)")
    check_params(system.params)
    if not isinstance(newton, Newton | None):
        raise TypeError(f"simulate: newton is {newton!r}; give a Newton, e.g. Newton(method='dense').")
    if (macro_dt is None) == (micro_dt is None):
        got = "neither" if macro_dt is None else "both"
        raise ValueError(f"simulate: got {got} of macro_dt and micro_dt; give exactly one of them.")
    name, dt = ("macro_dt", macro_dt) if micro_dt is None else ("micro_dt", micro_dt)
    check_flags(save_micro=save_micro)
    if is_concrete(real_array(f"simulate: {name}", dt, 0)) and not (np.isfinite(dt) and dt > 0):
        raise ValueError(f"simulate: {name} is {dt}; it must be a positive number.")
    check_number("simulate: the t of state", state.t)
    for name, value in (("num_steps", num_steps), ("save_every", save_every)):
        if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
            raise ValueError(f"simulate: {name} is {value!r}; it must be an integer of at least 1.")
    if num_steps % save_every:
        raise ValueError(
            f"simulate: num_steps = {num_steps} is not a multiple of save_every = {save_every}; the last saved node would "
            "not be the end."
        )
    vectors = _vectors(state)
    if is_concrete(vectors):
        check_arrays(**vectors)
    return dt if micro_dt is None else scheme.num_micro * micro_dt


def simulation_error(trajectory: Trajectory, macro_dt, save_every: int) -> SimulationError:
    """The error that says how a failed run failed."""
    step = int(trajectory.failed_at)
    interval = step // save_every
    return SimulationError(
        Result(int(trajectory.result)),
        step,
        float(trajectory.t[0] + step * macro_dt),
        int(trajectory.info.iterations[interval]),
        float(trajectory.info.residual[interval]),
        trajectory,
    )


def macro_step(system, scheme, state, macro_dt, newton=None):
    """One macro step."""
    stepper = plan(system, scheme, newton or Newton(), state)
    state, info, own = stepper.step(state, stepper.init(state, macro_dt), macro_dt)
    return (stepper.project(state, own)[0] if _projects_rarely(stepper) else state), info
