"""`Simulation`: a run with checked arguments, and the three ways to compute it.

| call | program | used by |
|---|---|---|
| ``run()`` | `Engine.program` from the start, compiled for its number of saved nodes | `prepare` |
| ``run.in_pieces()``, ``run.advance(...)`` | the same from a cursor, for runs of all lengths | `simulate`, `stream` |
| ``run.traced()`` | `Engine.differentiable`, with derivatives | `simulate` under transformations |

All of them return `Saved`. With the matrix "auto" a piece that is not solved is computed again with exact matrices
(`vmri_jax.running.engine`), with the same tolerance and limit of iterations; so are all pieces after it.
"""

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.configure import warn_if_slow
from vmri_jax.mechanics.arrays import Known, is_concrete, of_one_type, own_array, whole_number
from vmri_jax.mechanics.checks import check_arrays, check_number, check_params, check_type
from vmri_jax.mechanics.names import Names
from vmri_jax.mechanics.projection import at_same_velocities
from vmri_jax.mechanics.state import REPORTED_VIOLATION, Movable, State, opened, start_of
from vmri_jax.mechanics.summary import numbers, summary
from vmri_jax.mechanics.system import System
from vmri_jax.refusals import Refused, warn_user
from vmri_jax.running.arguments import Save, check_once, check_run, check_step_size, nothing_fast, refuse_tracers
from vmri_jax.running.engine import FALLING_BACK, Cursor, Engine, blank_memory, engine, solved_again, unsolved
from vmri_jax.running.failures import simulation_error
from vmri_jax.running.interrupts import Interrupted, interrupts_noted
from vmri_jax.running.observables import concerns
from vmri_jax.running.origin import Origin
from vmri_jax.running.progress import Working, progress_to
from vmri_jax.running.saved import Columns, Saved, joined
from vmri_jax.running.trajectory import Trajectory
from vmri_jax.schemes.composition import SchemeLike
from vmri_jax.steppers.plan import Plan, plan, with_rules_for
from vmri_jax.steppers.solver import Solver

NUMBERS_PER_PIECE = 2**15
"""Numbers in the nodes of a piece of a run, 256 kB. With a larger value short runs wait for memory that they do not
use; a smaller one divides long runs into more calls of some 50 microseconds each."""
PARTS_OF_A_BAR = 50
"""Parts of a run with a progress bar.

More parts move the bar more smoothly, and each costs a call of some 30 microseconds.
"""
STEPPING = "stepping"
"""The work of a run that is compiled, for lines about runs that take more than two seconds."""


MOTION = ("macro_dt", "state", "solver", "scheme", "system")
"""The fields of a `Simulation` that its motion follows from."""
LENGTH = ("num_steps", "save_every", "save", "names", "of_problem", "may_fall_back")
"""All other fields."""


@partial(jax.tree_util.register_dataclass, data_fields=MOTION, meta_fields=LENGTH)
@dataclass(frozen=True, eq=False)
class Simulation:
    """A run with checked arguments, ready to be computed; a pytree of the numbers that its motion follows from.

    The matrix of its plan computes the run. If it fails in a run or a piece, the fallback computes the run or piece
    again; the program of the fallback is compiled only then.

    Attributes:
        macro_dt: macro step H, an array of shape ().
        state, solver, scheme, system, num_steps, save: as of `simulate`.
        save_every: macro steps from one saved node to the next.
        names: names of bodies and constraints; None if there are none.
        of_problem: whether the start is the positions and velocities of a problem: with other parameters, the momenta
            are others.
        may_fall_back: whether the fallback is tried where the first matrix fails; else the run fails.
    """

    macro_dt: Any
    state: State
    solver: Solver
    scheme: SchemeLike
    system: System
    num_steps: int = 0
    save_every: int = 0
    save: Save = field(default_factory=Save)
    names: Names | None = None
    of_problem: bool = False
    may_fall_back: bool = True

    def __call__(self, state=None, *, macro_dt=None, params=None, num_steps=None, throw: bool = True) -> Trajectory:
        """The trajectory of the run; arguments replace its start, macro step, parameters or number of steps.

        Args:
            state, macro_dt, params: in the shapes of the run; None for the values of the run. With other params, a run
                of a problem keeps the velocities of its start, a run of a system and a state the momenta.
            num_steps: macro steps, a multiple of `num_saves`, which stays while `save_every` changes; None for the
                number of the run.
            throw: raise `SimulationError` if a step fails, as `simulate` does; else return the trajectory, NaN from the
                failure on.

        Raises:
            ValueError: arrays whose shapes differ from the shapes of the run, a call inside of a transformation.
            SimulationError: a step failed.
        """
        run = self.with_arguments(state, macro_dt, params, num_steps)
        with Working("the run", running=STEPPING):
            saved = run._whole()
        if saved.failed_at >= 0 and run.unsolved(saved):
            with Working(FALLING_BACK):
                saved = run.exact._whole()
        is_told = run.state is self.state and run.system is self.system and "is_told" in vars(self)
        vars(self)["is_told"] = True  # of a start: a further call with the same one is a short run
        return run.finished("run", saved, throw, is_told)

    def compiled(self) -> jax.stages.Compiled:
        """The compiled program of the run without its fallback, for inspection."""
        return self.engine.program.lower(self.leaves, self.save_every, self.num_saves).compile()

    def timed(self, state=None, *, macro_dt=None, params=None, num_steps=None) -> Callable[[], None]:
        """A function without arguments that computes the run and waits for its result, to be timed.

        It runs the program that succeeds, with the first matrix or of the fallback. Arguments as of a call.
        """
        run = self.with_arguments(state, macro_dt, params, num_steps)
        run = run.exact if run.unsolved(run._whole()) else run
        program, arguments = run.engine.program, (jax.device_put(run.leaves), run.save_every, run.num_saves)
        program(*arguments)
        return lambda: program(*arguments)[1].block_until_ready()  # the arrays of one program are ready together

    def with_arguments(self, state=None, macro_dt=None, params=None, num_steps: int | None = None) -> "Simulation":
        """The run with other arguments, see `__call__`, by the same program."""
        refuse_tracers("run", (state, macro_dt, params), ", or take simulate")
        changes: dict[str, Any] = {}
        if macro_dt is not None:
            check_step_size(macro_dt, "run")
            changes["macro_dt"] = _float(macro_dt)
        if state is not None:
            check_type("run: state", state, State, "a State, e.g. from initial_state(...) or an earlier run[-1]")
            check_number("run: the t of state", state.t)
            check_arrays(q_s=state.q_s, q_f=state.q_f, p_s=state.p_s, p_f=state.p_f)
            changes["state"] = _with_arrays(state)
            new, shapes = ([a.shape for a in vars(start).values()] for start in (changes["state"], self.state))
            if new != shapes:
                raise Refused(f"the arrays of state have shapes {new}; the run was prepared for {shapes}.")
        if params is not None:
            check_params(params)
            (old, expected), (new, structure) = map(jax.tree.flatten, (self.system.params, params))
            if structure != expected or list(map(np.shape, new)) != list(map(np.shape, old)):
                raise Refused(f"params is {params!r}; give the pytree of system.params with other numbers in it.")
            changes["system"] = self.system.with_params(jax.tree.map(own_array, params))
            if state is None and self.of_problem and not self.system.has_constant_mass:
                changes["state"] = _with_arrays(at_same_velocities(self.system, changes["system"], self.state))
        if num_steps is not None:
            if whole_number("run: num_steps", num_steps) % self.num_saves:
                raise Refused(f"num_steps is {num_steps}; it must be a positive multiple of {self.num_saves}.")
            changes |= {"num_steps": num_steps, "save_every": num_steps // self.num_saves}
        if not changes:
            return self
        run = replace(self, **changes)
        # what stays: to compare structures, or to flatten a system, takes as long as a short run
        vars(run).update(engine=self.engine, columns=self.columns)
        if params is None:
            first = jax.tree.leaves((run.macro_dt, run.state))  # in the order of `MOTION`
            vars(run)["leaves"] = first + self.leaves[len(first) :]
        return run

    def _whole(self) -> Saved:
        """The run by one program, without the fallback."""
        rows, status = map(np.asarray, self.engine.program(self.leaves, self.save_every, self.num_saves))
        return Saved(self.columns.split(rows[: self.num_saves + 1]), *status).marked(self)

    def traced(self) -> Trajectory:
        """All steps of a run, some of whose arrays are tracers."""

        def steps(run: Simulation) -> Callable[[list], Saved]:
            return lambda leaves: run.engine.differentiable(leaves, run.save_every)

        run = steps(self)
        if self.plan.has_fallback:
            run = partial(solved_again, run, steps(self.exact), lambda saved: (saved.result, saved.method))
        saved = run(self.leaves)
        return self.engine.nodes_as_saved(self.leaves, saved, self.save_every).trajectory(self)

    def finished(self, caller: str, saved: Saved, throw: bool = True, is_told: bool = False) -> Trajectory:
        """The trajectory of a whole run, or of runs with an axis of lanes, after the warnings about its start, unless
        the user `is_told`, and about its motion; raises the `SimulationError` of a run with a failed step if `throw` is
        true."""
        trajectory = saved.trajectory(self)
        if not is_told:
            self.tell_of_start(caller, trajectory)
        self.warn(caller, saved.nodes.table, trajectory.states.t)
        if throw and trajectory.failed_at >= 0:
            raise simulation_error(self, trajectory)
        return trajectory

    def tell_of_start(self, caller: str, trajectory: Trajectory) -> None:
        """Warn about momenta of the start that are off the hidden constraints: the run takes their projection, which
        its first node has."""
        if not self.system.is_constrained:
            return
        given, taken = (np.concatenate([a.p_s, a.p_f], axis=-1) for a in (self.state, trajectory.states))
        change, size = (np.max(np.abs(p), initial=0.0) for p in (taken[..., 0, :] - given, given))
        if change > REPORTED_VIOLATION * size:
            warn_user(
                f"{caller}: the momenta of the start are off the hidden constraints, by {change:.3g} where the largest "
                f"of them is {size:.3g}; the run starts with their projection. Make the start by initial_state(...).",
            )

    def warn(self, caller: str, table, t) -> bool:
        """Give the warnings about the motion of a run, or of runs with an axis of lanes, see `concerns`; returns
        whether there are any."""
        all_concerns = concerns(table, t, self.system, self.macro_dt, self.save_every)
        for concern in all_concerns:
            warn_user(type(concern)(f"{caller}: {concern}"))
        return bool(all_concerns)

    def __repr__(self) -> str:
        micro = f", of {self.scheme.num_micro} micro steps each" if self.scheme.num_micro > 1 else ""
        lines = {
            "macro steps": f"{self.num_steps} of {numbers(self.macro_dt)}{micro}",
            "saved nodes": f"{self.num_saves + 1}, one every {self.save_every} macro steps",
        }
        return summary("Simulation, prepared: run() makes a Trajectory", lines | self.system.in_words())

    @property
    def order(self) -> int:
        """Order of convergence of its scheme, with the rules of all potentials of the system."""
        return with_rules_for(self.system, self.scheme).order

    @property
    def num_saves(self) -> int:
        """Saved intervals."""
        return self.num_steps // self.save_every

    @cached_property
    def columns(self) -> Columns:
        """The columns of a row of its saved nodes."""
        return Columns.of(self.state, self.scheme.num_micro if self.save.micro else 0)

    @property
    def width(self) -> int:
        """Numbers of a saved node."""
        return self.columns.table.stop

    @cached_property
    def plan(self) -> Plan:
        """The `Plan` that takes its steps; ``print`` shows it in words."""
        return plan(self.system, self.scheme, self.state, self.solver)

    @cached_property
    def origin(self) -> Origin:
        """The origin of its trajectories."""
        return Origin(self.names, self.system)

    @cached_property
    def leaves(self) -> list:
        """The arguments of its programs."""
        return jax.tree.leaves(self)

    @cached_property
    def engine(self) -> Engine:
        """Its programs, without the fallback."""
        return self._engine(self.num_saves)

    @cached_property
    def _engine_of_pieces(self) -> Engine:
        """Its programs for pieces, of a size for runs of all lengths, which then share them, without the fallback."""
        return self._engine(max(NUMBERS_PER_PIECE // self.width, 1))

    @cached_property
    def blank_memory(self) -> Any:
        """Zeros in the shapes of the memory of its stepper."""
        return blank_memory(self._engine_of_pieces, tuple((a.shape, a.dtype) for a in self.leaves))

    def _engine(self, num_saves: int) -> Engine:
        motion = Simulation(*(getattr(self, name) for name in MOTION), save=Save(micro=self.save.micro))
        return engine(jax.tree.structure(motion), num_saves)

    @cached_property
    def exact(self) -> "Simulation":
        """The fallback: the same run with exact matrices."""
        return replace(self, solver=self.solver.exact())

    def check(self, state_name: str = "simulate: the positions of the state", constraints: bool = True) -> None:
        """Refuse a system whose functions return wrong types or shapes, and a state that violates the constraints.

        `state_name` is the state in messages. Equal ones are checked once.
        """
        with Working("checks of the system"):
            check_once(Known((self.system, replace(self.state, p_s=None, p_f=None))), state_name, constraints)

    def advance(self, cursor: Cursor, saves: int) -> "tuple[Saved, Cursor, Simulation]":
        """The next `saves` saved intervals, the cursor after them, and the run that goes on from there: the fallback
        from the first piece on that is not solved.

        After a failure nothing is computed, and all further nodes are NaN.
        """
        run, pieces, room = self, [], self._engine_of_pieces.num_saves
        for done in range(0, saves, room):
            size = min(room, saves - done)
            piece, after = run._advance(cursor, size)
            if cursor.failed_at < 0 and run.unsolved(piece):
                with Working(FALLING_BACK):
                    run = run.exact
                    piece, after = run._advance(cursor._replace(memory=None), size)
            pieces.append(piece)
            cursor = after
        return joined(pieces), cursor, run

    def _advance(self, cursor: Cursor, saves: int) -> tuple[Saved, Cursor]:
        step, is_first = int(cursor.step), cursor.memory is None
        if is_first:
            cursor = cursor._replace(memory=self.blank_memory)
        rows, cursor = self._engine_of_pieces.program(self.leaves, self.save_every, saves, cursor, is_first)
        nodes = np.array(np.asarray(rows)[: saves + 1])  # a copy, which holds no memory of a whole piece
        saved = Saved(self.columns.split(nodes), np.asarray(cursor.result), np.asarray(cursor.failed_at)).marked(
            self, step
        )
        reached = np.asarray(step + saves * self.save_every)
        return saved, cursor._replace(step=reached, result=saved.result, failed_at=saved.failed_at)

    def unsolved(self, saved: Saved) -> np.ndarray:
        """Whether the fallback may solve a run or a piece, or (lanes,) the runs of a batch."""
        is_alive = np.asarray(saved.failed_at < 0)
        if is_alive.all() or not (self.may_fall_back and self.plan.has_fallback):
            return np.zeros(is_alive.shape, dtype=bool)
        return unsolved(saved.result, saved.method)

    def in_pieces(self) -> Saved:
        """The nodes of the whole run; with a progress bar Ctrl-C raises `Interrupted` with the trajectory computed so
        far."""
        bar, cursor, run, pieces = self.save.progress is not False, Cursor.at_start(self.state), self, []
        size = -(-self.num_saves // (PARTS_OF_A_BAR if bar else 1))
        noted = interrupts_noted() if bar else nullcontext(lambda: False)
        shown = progress_to("simulate", self.save.progress) if bar else Working("the run", running=STEPPING)
        with noted as interrupted, shown as tell:
            for done in range(0, self.num_saves, size):
                if bar:
                    tell("simulating", done, self.num_saves)
                piece, cursor, run = run.advance(cursor, min(size, self.num_saves - done))
                pieces.append(piece)
                if interrupted():
                    so_far = joined(pieces).trajectory(self)
                    raise Interrupted(so_far, int(cursor.step), self.num_steps, "macro steps")
        return joined(pieces)


def simulation(
    moving: Movable,
    scheme,
    state: State | None,
    solver: Solver | None,
    macro_dt,
    num_steps=None,
    t_end=None,
    save: int | Save = 1,
) -> Simulation:
    """The `Simulation` with these arguments of `simulate`; bad arguments raise."""
    warn_if_slow()
    problem = opened(moving)
    of_problem = state is None
    with Working("the start of the run"):
        system, state = start_of("simulate", problem, state)
    num_steps, save_every = check_run(system, scheme, state, solver, macro_dt, num_steps, t_end, save)
    # Scenes only: `opened` returns problems as they are.
    advice = nothing_fast(scheme, state.q_f.size) if moving is not problem else ""
    if advice:
        warn_user(f"simulate: {advice}")
    chosen_solver, scheme, system = of_one_type((solver or Solver(), scheme, system))
    motion = (_float(macro_dt), _with_arrays(state), chosen_solver, scheme, system)
    return Simulation(*motion, num_steps, save_every, Save.of(save), getattr(problem, "names", None), of_problem)


def _with_arrays(state: State) -> State:
    return State(*map(_float, vars(state).values()))


def _float(value):
    """Numbers as an array of float64: of JAX if they are traced, else of NumPy, which is made faster."""
    return own_array(value, float) if is_concrete(value) else jnp.asarray(value, dtype=float)
