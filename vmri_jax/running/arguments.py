"""Checks of the arguments of runs; a message names the argument, its value, the value expected, and what to change."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from vmri_jax.mechanics.arrays import Known, is_concrete, real_array, require_x64, whole_number
from vmri_jax.mechanics.checks import check_arrays, check_flags, check_number, check_params, check_system
from vmri_jax.mechanics.constraints import check_constraints, check_mass
from vmri_jax.mechanics.state import State
from vmri_jax.schemes.composition import Composition, stage_scheme
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.steppers.solver import Solver

WHOLE_NUMBER_TOLERANCE = 1e-9
"""Relative distance from a whole number up to which ``(t_end - t) / macro_dt`` counts as one. The end of a run misses t_end by at most this
part of its length; a larger value lets runs end visibly beside t_end."""


@dataclass(frozen=True)
class Steps:
    """The arguments of `vmri_jax.simulate` for step size and length: one of macro_dt and micro_dt, one of num_steps and t_end, as the user gave them."""

    macro_dt: Any = None
    micro_dt: Any = None
    num_steps: int | None = None
    t_end: float | None = None
    save_every: int = 1
    save_micro: bool = False


def check_run(system, scheme, state, solver, steps: Steps):
    """Refuse bad arguments of `simulate`; returns macro_dt, num_steps and save_every."""
    require_x64()
    if not isinstance(scheme, Scheme | Composition):
        raise TypeError(
            f"simulate: scheme is {type(scheme).__name__}; give a Scheme, e.g. fully_implicit(num_micro=10)."
        )
    check_params(system.params)
    if not isinstance(solver, Solver | None):
        raise TypeError(f"simulate: solver is {solver!r}; give a Solver, e.g. vm.Solver(tolerance=1e-10).")
    check_flags(save_micro=steps.save_micro)
    dt, num_steps, t_end = check_step_size(scheme, steps.macro_dt, steps.micro_dt), steps.num_steps, steps.t_end
    check_number("simulate: the t of state", state.t)
    if (num_steps is None) == (t_end is None):
        got = "neither" if num_steps is None else "both"
        raise ValueError(f"simulate: got {got} of num_steps and t_end; give exactly one of them.")
    if num_steps is None:
        num_steps = steps_until(t_end, state.t, dt)
    counts = check_counts(num_steps, steps.save_every)
    if is_concrete(vars(state)):
        check_vectors(state)
    return dt, *counts


def nothing_fast(scheme: Scheme | Composition, num_fast: int) -> str:
    """Advice where a scene without fast bodies takes several micro steps; empty for any other scene.

    Args:
        scheme: its micro steps count; of a composition the micro steps of a stage.
        num_fast: number of fast coordinates, or of fast bodies.
    """
    if num_fast or stage_scheme(scheme).num_micro == 1:
        return ""
    return (
        "no body of the scene is fast, so that all micro steps but one resolve nothing. Take num_micro=1; or say which potential is fast, "
        'rate="fast", or which bodies are fast, pace="fast".'
    )


def steps_until(t_end, t, macro_dt) -> int:
    """The number of macro steps from t to t_end."""
    if not is_concrete((t_end, t, macro_dt)):
        raise ValueError("simulate: t_end needs times that are known; under transformations of JAX give num_steps.")
    check_number("simulate: t_end", t_end)
    steps = float((t_end - t) / macro_dt)
    whole = round(steps)
    if whole < 1:
        raise ValueError(
            f"simulate: t_end is {t_end:g}, less than a macro step of {macro_dt:g} after the start at {t:g}."
        )
    if abs(steps - whole) > WHOLE_NUMBER_TOLERANCE * whole:
        raise ValueError(
            f"simulate: from {t:g} to t_end = {t_end:g} there are {steps:.6g} macro steps of {macro_dt:g}, no whole number. "
            f"Take macro_dt = {float(t_end - t) / np.ceil(steps):.10g}, or give num_steps."
        )
    return whole


def check_step_size(scheme: Scheme | Composition, macro_dt, micro_dt):
    """Refuse two step sizes, none, or one that is not positive; returns macro_dt."""
    if (macro_dt is None) == (micro_dt is None):
        got = "neither" if macro_dt is None else "both"
        raise ValueError(f"simulate: got {got} of macro_dt and micro_dt; give exactly one of them.")
    name, dt = ("macro_dt", macro_dt) if micro_dt is None else ("micro_dt", micro_dt)
    if is_concrete(real_array(f"simulate: {name}", dt, 0)) and not (np.isfinite(dt) and dt > 0):
        raise ValueError(f"simulate: {name} is {dt}; it must be a positive number.")
    return dt if micro_dt is None else scheme.num_micro * micro_dt


def check_counts(num_steps, save_every) -> tuple[int, int]:
    """Refuse counts that are no whole numbers, or a last step that is not saved; returns (num_steps, save_every) as Python integers."""
    num_steps = whole_number("simulate: num_steps", num_steps)
    save_every = whole_number("simulate: save_every", save_every)
    if num_steps % save_every:
        raise ValueError(
            f"simulate: num_steps = {num_steps} is not a multiple of save_every = {save_every}; the last saved node would "
            "not be the end."
        )
    return num_steps, save_every


def check_vectors(state: State) -> None:
    """Refuse positions and momenta that are not finite vectors of float64 of matching lengths."""
    vectors = {name: getattr(state, name) for name in ("q_s", "q_f", "p_s", "p_f")}
    q_s, q_f, p_s, p_f = arrays = [np.asarray(a) for a in vectors.values()]
    fits = q_s.shape == p_s.shape and q_f.shape == p_f.shape
    good = all(a.dtype == float and a.ndim == 1 and np.isfinite(a).all() for a in arrays)
    if not (fits and good):
        check_arrays(**vectors)


@lru_cache(maxsize=256)
def check_once(known: Known, state_name: str, constraints: bool) -> None:
    """Check a system, the tree of `known` with a state, at its time and positions. The check takes longer than a short run: equal ones are checked once."""
    system, state = known.tree
    check_system(system, state.q_s, state.q_f)
    check_mass(system, state.q_s, state.q_f)
    if constraints:
        check_constraints(system, state, state_name)
