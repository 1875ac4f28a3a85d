"""Checks of the arguments of runs; a message names the argument, its value, the value expected, and what to change."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from vmri_jax.mechanics.arrays import Known, is_concrete, is_known, real_array, require_x64, whole_number
from vmri_jax.mechanics.checks import check_arrays, check_flags, check_number, check_params, check_system
from vmri_jax.mechanics.constraints import check_constraints, check_mass
from vmri_jax.refusals import Refused
from vmri_jax.running.progress import ShowsProgress, check_progress
from vmri_jax.schemes.composition import SchemeLike, stage_scheme
from vmri_jax.steppers.solver import Solver

WHOLE_NUMBER_TOLERANCE = 1e-9
"""Relative distance from a whole number up to which ``(t_end - t) / macro_dt`` counts as one. The end of a run misses
t_end by at most this part of its length; a larger value lets runs end visibly beside t_end."""


@dataclass(frozen=True)
class Save:
    """The nodes and states of a run that are kept while it is computed; ``save=10`` of `vmri_jax.simulate` is short for
    ``save=vm.Save(10)``.

        vm.simulate(problem, scheme, macro_dt=0.01, t_end=10.0, save=vm.Save(every=10, micro=True))

    Args:
        every: macro steps from one saved node to the next; 1 where neither `every` nor `number` is given.
        number: in place of `every`, the number of saved intervals, equally spaced, of which there is one node more.
        micro: also keep the fast positions at the micro nodes of the macro step that ends at each saved node.
        progress: True for a bar of the nodes saved so far, or a function of (what, done, total); Ctrl-C then raises
            `Interrupted` with these nodes. With False a run that takes more than two seconds prints lines on the error
            stream.

    Raises:
        ValueError: both `every` and `number`, a number below 1.
        TypeError: a flag that is neither True nor False.
    """

    every: int | None = None
    number: int | None = None
    micro: bool = False
    progress: ShowsProgress = False

    def __post_init__(self):
        for name in ("every", "number"):
            if getattr(self, name) is not None:
                whole_number(f"Save: {name}", getattr(self, name), otherwise=", or None")
        if self.every is not None and self.number is not None:
            raise Refused(f"Save: got every = {self.every} and number = {self.number}; give one of them.")
        check_flags(micro=self.micro)
        check_progress("Save", self.progress)

    @classmethod
    def of(cls, save: "int | Save") -> "Save":
        """The argument `save` of a run."""
        return save if isinstance(save, Save) else cls(whole_number("simulate: save", save, otherwise=", or a Save"))

    def without_bar(self, name: str) -> None:
        """Refuse a bar of a run of the function of this name, which is one program without parts."""
        if self.progress is not False:
            raise Refused(f"{name}: one program has no progress; leave it out, or call simulate or stream.")

    def macro_steps(self, num_steps: int) -> int:
        """Macro steps from one saved node to the next in a run of `num_steps`; refuses a run whose end is not saved."""
        every = self.every or 1
        if num_steps % (self.number or every):
            counts = f"the {self.number} saved intervals" if self.number else f"save = {every}"
            raise Refused(
                f"simulate: num_steps = {num_steps} is not a multiple of {counts}; the end would not be saved."
            )
        return num_steps // self.number if self.number else every


def check_run(system, scheme, state, solver, macro_dt, num_steps, t_end, save) -> tuple[int, int]:
    """Refuse bad arguments of `simulate`; returns the number of macro steps, and how many of them lie between two saved
    nodes."""
    require_x64()
    if not isinstance(scheme, SchemeLike):
        raise Refused(f"simulate: scheme is {type(scheme).__name__}; give a Scheme, e.g. fully_implicit(num_micro=10).")
    check_params(system.params)
    if not isinstance(solver, Solver | None):
        raise Refused(f"simulate: solver is {solver!r}; give a Solver, e.g. vm.Solver(tolerance=1e-10).")
    check_step_size(macro_dt)
    check_number("simulate: the t of state", state.t)
    if (num_steps is None) == (t_end is None):
        got = "neither" if num_steps is None else "both"
        raise Refused(f"simulate: got {got} of num_steps and t_end; give exactly one of them.")
    num_steps = (
        steps_until(t_end, state.t, macro_dt) if num_steps is None else whole_number("simulate: num_steps", num_steps)
    )
    every = Save.of(save).macro_steps(num_steps)
    check_arrays(q_s=state.q_s, q_f=state.q_f, p_s=state.p_s, p_f=state.p_f)
    return num_steps, every


def nothing_fast(scheme: SchemeLike, num_fast: int) -> str:
    """Advice where a scene without fast coordinates or bodies takes several micro steps; empty for any other scene."""
    if num_fast or stage_scheme(scheme).num_micro == 1:
        return ""
    return (
        "no body of the scene is fast, so that all micro steps but one resolve nothing. Take num_micro=1; or say which"
        ' potential is fast, rate="fast", or which bodies are fast, pace="fast".'
    )


def steps_until(t_end, t, macro_dt) -> int:
    """The number of macro steps from t to t_end; refuses one that is not whole."""
    if not is_concrete((t_end, t, macro_dt)):
        raise Refused("simulate: t_end needs times that are known; under transformations of JAX give num_steps.")
    check_number("simulate: t_end", t_end)
    steps = (float(t_end) - float(t)) / float(macro_dt)
    whole = round(steps)
    if whole < 1:
        raise Refused(f"simulate: t_end is {t_end:g}, less than a macro step of {macro_dt:g} after the start at {t:g}.")
    if abs(steps - whole) > WHOLE_NUMBER_TOLERANCE * whole:
        between = f"from {t:g} to t_end = {t_end:g} there are {steps:.6g} macro steps of {macro_dt:g}, no whole number"
        near = float(t_end - t) / np.ceil(steps)
        raise Refused(f"simulate: {between}. Take macro_dt = {near:.10g}, or give num_steps.")
    return whole


def check_step_size(macro_dt, caller: str = "simulate", ndim: int | None = 0) -> None:
    """Refuse a missing step size, or one that is not positive; one for each lane if `ndim` is None."""
    if macro_dt is None:
        raise Refused(f"{caller}: macro_dt is missing; give the macro step H, num_micro times the micro step.")
    size = real_array(f"{caller}: macro_dt", macro_dt, ndim)
    # Of NumPy: in a program JAX would trace the comparison.
    if is_concrete(size) and not all(0 < h < np.inf for h in np.ravel(size)):
        raise Refused(f"{caller}: macro_dt is {macro_dt}; it must be a positive number.")


def refuse_tracers(caller: str, arguments, instead: str = "") -> None:
    """Refuse a pytree of arguments within a transformation of JAX, or a call within a program; `instead` ends the
    advice."""
    if not is_known(arguments):
        traced = "it is called in a program that JAX traces" if is_concrete(arguments) else "arguments are tracers"
        raise Refused(f"{caller}: {traced}; call it outside of jax.jit, vmap and grad{instead}.")


@lru_cache(maxsize=256)
def check_once(known: Known, state_name: str, constraints: bool) -> None:
    """Check a system, the tree of `known` with a state, at its time and positions.

    The check takes longer than a short run: equal ones are checked once.
    """
    system, state = known.tree
    check_system(system, state.q_s, state.q_f)
    check_mass(system, state.q_s, state.q_f)
    if constraints:
        check_constraints(system, state, state_name)
