"""`Simulation`: a run with checked arguments, and the three ways to compute it.

| call | program | used by |
|---|---|---|
| ``run()`` | `Engine.whole`, compiled for its number of saved nodes | `prepare` |
| ``run.in_pieces()``, ``run.advance(...)`` | `Engine.piece`, one program for runs of all lengths | `simulate`, `stream` |
| `vmri_jax.running.adjoints` | `Engine.stored`, `Engine.checkpointed`, with derivatives | `simulate` under transformations |

All of them return states and statuses; `Simulation.observed` adds energy, constraints and failures of the nodes.

With the matrix "auto" a piece that is not solved is computed again with exact matrices (`vmri_jax.running.fallback`), with the same tolerance and
limit of iterations; so are all pieces after it.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.configure import warn_if_slow
from vmri_jax.mechanics.arrays import Known, is_concrete, of_one_type
from vmri_jax.mechanics.checks import check_params
from vmri_jax.mechanics.names import Names
from vmri_jax.mechanics.state import Movable, State, opened, start_of
from vmri_jax.mechanics.summary import numbers, summary
from vmri_jax.mechanics.system import System
from vmri_jax.refusals import Refused
from vmri_jax.running.arguments import Save, Steps, check_once, check_run, check_vectors, nothing_fast
from vmri_jax.running.engine import NUM_STATE, Cursor, Engine, Motion, engine
from vmri_jax.running.failures import simulation_error
from vmri_jax.running.fallback import FALLING_BACK, unsolved
from vmri_jax.running.interrupts import Interrupted, interrupts_noted
from vmri_jax.running.observables import Observables, concerns, failures, observables, with_tolerance
from vmri_jax.running.origin import Origin, evaluated, names_of
from vmri_jax.running.progress import Working, progress_to
from vmri_jax.running.saved import Saved, room_of_a_piece
from vmri_jax.running.trajectory import Piece, Trajectory, join, with_observables
from vmri_jax.schemes.composition import Composition
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.steppers.plan import Plan, plan, with_rules_for
from vmri_jax.steppers.solver import Solver

PARTS_OF_A_BAR = 50
"""Parts of a run with a progress bar. More parts move the bar more smoothly, and each costs a call of some 30 microseconds."""
STEPPING = "stepping"
"""The work of a run that is compiled, for lines about runs that take more than two seconds."""


class Checkpoint(NamedTuple):
    """A run between two steps: everything that its next steps depend on, to the last bit.

    cursor: state, memory of the stepper such as the start of Newton's next iteration, steps done, and status so far.
    is_first: whether the stepper has no memory of earlier steps, so that the memory of the cursor is blank.
    fell_back: whether the fallback has replaced the first matrix.
    """

    cursor: Cursor
    is_first: bool = False
    fell_back: bool = False


@dataclass(frozen=True, eq=False)
class Simulation:
    """A run with checked arguments, ready to be computed.

    The matrix of its plan computes the run. If it fails in a run or a piece, the fallback computes the run or piece again; the program
    of the fallback is compiled only then.

    Attributes:
        system, scheme, solver, state, num_steps, save: as of `simulate`.
        macro_dt: macro step H, an array of shape ().
        save_every: macro steps from one saved node to the next.
        names: names of bodies and constraints; None if there are none.
        may_fall_back: whether the fallback is tried where the first matrix fails; else the run fails.
    """

    system: System
    scheme: Scheme | Composition
    solver: Solver
    state: State
    macro_dt: Any
    num_steps: int
    save_every: int
    save: Save
    names: Names | None
    may_fall_back: bool = True

    def __call__(self, state=None, *, macro_dt=None, params=None, num_steps=None, throw: bool = True) -> Trajectory:
        """The trajectory of the run; arguments replace its start, macro step, parameters or number of steps.

        Args:
            state, macro_dt, params: in the shapes of the run; None for the values of the run.
            num_steps: macro steps, a multiple of `num_saves`, which stays while `save_every` changes; None for the number of the run.
            throw: raise `SimulationError` if a step fails, as `simulate` does; else return the trajectory, NaN from the failure on.

        Raises:
            ValueError: arrays whose shapes differ from the shapes of the run.
            SimulationError: a step failed.
        """
        leaves, save_every = self._arguments(state, macro_dt, params, num_steps)
        origin = self.origin if params is None else self.origin.with_params(params)
        with Working("the run", running=STEPPING):
            run, table = self.whole(leaves, save_every)
        if self.unsolved(run):
            with Working(FALLING_BACK):
                run, table = self.exact.whole(leaves, save_every)
        trajectory = with_observables(run, table, origin)
        if throw and int(trajectory.failed_at) >= 0:
            raise simulation_error(trajectory, leaves[0], save_every, self.scheme.num_micro)
        self.warn("run", table, run.states.t, leaves[0], save_every)
        return trajectory

    def compiled(self) -> jax.stages.Compiled:
        """The compiled program of the run without its fallback, for inspection."""
        return self.engine.whole.lower(*self._arguments(None, None, None, None), self.num_saves).compile()

    def timed(self, state=None, *, macro_dt=None, params=None, num_steps=None) -> Callable[[], None]:
        """A function without arguments that computes the run and waits for its result, to be timed.

        It runs the program that succeeds, with the first matrix or of the fallback. Arguments as of a call.
        """
        leaves, save_every = self._arguments(state, macro_dt, params, num_steps)
        solves = self.exact if self.unsolved(self.whole(leaves, save_every)[0]) else self
        program, arguments = solves.engine.whole, (jax.device_put(leaves), save_every, self.num_saves)
        program(*arguments)
        return lambda: program(*arguments)[1].block_until_ready()  # the arrays of one program are ready together

    def _arguments(self, state, macro_dt, params, num_steps) -> tuple[list, int]:
        """The leaves of the motion, and the macro steps from one saved node to the next."""
        dt, *start = self.leaves[:NUM_STATE]
        model, save_every = self.leaves[NUM_STATE:], self.save_every
        if state is not None:
            check_vectors(state)
            shapes, start = [a.shape for a in start], _arrays(state)
            if [a.shape for a in start] != shapes:
                raise Refused(
                    f"the arrays of state have shapes {[a.shape for a in start]}; the run was prepared for {shapes}."
                )
        if params is not None:
            model = self._with_params(model, params)
        if num_steps is not None:
            if num_steps < 1 or num_steps % self.num_saves:
                raise Refused(f"num_steps is {num_steps}; it must be a positive multiple of {self.num_saves}.")
            save_every = num_steps // self.num_saves
        return [dt if macro_dt is None else np.asarray(macro_dt, dtype=float), *start, *model], save_every

    def _with_params(self, model: list, params) -> list:
        """The leaves of the model with other parameters."""
        check_params(params)
        expected, expected_structure = jax.tree.flatten(self.system.params)
        new, structure = jax.tree.flatten(params)
        if structure != expected_structure or list(map(np.shape, new)) != list(map(np.shape, expected)):
            raise Refused(f"params is {params!r}; give the pytree of system.params with other numbers in it.")
        return model[: len(model) - len(expected)] + [np.asarray(leaf) for leaf in new]

    def whole(self, leaves: list, save_every: int) -> Piece:
        """The run by one program, without the fallback; arguments of `Engine.whole`."""
        saved, status = self.engine.whole(leaves, save_every, self.num_saves)
        saved, status = Saved(*(None if a is None else np.asarray(a) for a in saved)), np.asarray(status)
        run = self.unpacked(saved, leaves, status[..., 0], status[..., 1], save_every)
        return failures(run, saved.rows[:, -len(Observables._fields) :], save_every)

    def unpacked(self, saved: Saved, leaves: list, result, failed_at, save_every: int, step: int = 0) -> Trajectory:
        """Nodes in arrays of NumPy as a trajectory without observables, or a batch of them.

        Args:
            saved, result, failed_at: of an engine.
            leaves: of the motion; in a batch with an axis of lanes.
            step: macro steps before the first node.
        """
        macro_dt, t_start = map(np.asarray, leaves[:2])
        steps = step + np.arange(saved.rows.shape[-2]) * save_every
        t = t_start[..., None] + steps * macro_dt[..., None]
        return saved.run(self.state, t, result, failed_at, self.scheme, macro_dt)

    def observed(self, run: Trajectory, leaves: list, step: int = 0) -> Piece:
        """A run, or a batch, and its `Observables` (..., k, 9), both NaN from a failure on; failures that the nodes show are in its status.

        Args:
            run: of the engine.
            leaves: of the motion, of which the last ones are the leaves of the system; in a batch with an axis of lanes.
            step: macro steps before its first node.
        """
        return failures(run, self._observables(run.states, leaves), self.save_every, step)

    def at_start(self) -> np.ndarray:
        """(1, 9) the `Observables` of the start."""
        return self._observables(jax.tree.map(lambda a: a[None], self.state), self.leaves)

    def _observables(self, states: State, leaves: list) -> Any:
        structure, count = self._system
        nodes = with_tolerance(states, self.solver.tolerance)
        return evaluated(observables, structure, leaves[len(leaves) - count :], nodes)

    def traced(self, run: Trajectory) -> Trajectory:
        """The trajectory of a run some of whose arrays are tracers: its observables are a part of the trace."""
        return with_observables(*self.observed(run, self.leaves), self.origin)

    def warn(self, caller: str, table, t, macro_dt=None, save_every: int | None = None, stacklevel: int = 3) -> bool:
        """Give the warnings about the motion of a run, or of a batch, see `concerns`, with its arguments; returns whether there are any."""
        macro_dt, save_every = self.macro_dt if macro_dt is None else macro_dt, save_every or self.save_every
        all_concerns = concerns(table, t, self.system, macro_dt, save_every)
        for concern in all_concerns:
            warnings.warn(type(concern)(f"{caller}: {concern}"), stacklevel=stacklevel)
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

    @property
    def save_micro(self) -> bool:
        """Whether micro nodes are saved."""
        return self.save.micro

    @property
    def is_concrete(self) -> bool:
        """Whether all arrays are concrete numbers, not tracers of a transformation."""
        return is_concrete(self.leaves)

    @cached_property
    def plan(self) -> Plan:
        """The `Plan`, which ``print`` shows in words."""
        return plan(self.system, self.scheme, self.state, self.solver)

    @cached_property
    def origin(self) -> Origin:
        """The origin of its trajectories."""
        return Origin(self.names, self.system)

    @property
    def leaves(self) -> list:
        """The leaves of its `Motion`, the arguments of its programs."""
        return self._motion[0]

    @cached_property
    def engine(self) -> Engine:
        """Its programs, without the fallback."""
        return engine(self._motion[1], self.num_saves, self.save_micro)

    @cached_property
    def exact(self) -> "Simulation":
        """The fallback: the same run with exact matrices."""
        return replace(self, solver=self.solver.exact())

    @cached_property
    def _motion(self) -> tuple[list, Any]:
        """Leaves and structure of the `Motion`."""
        return jax.tree.flatten(Motion(self.macro_dt, self.state, self.solver, self.scheme, self.system))

    @cached_property
    def _system(self) -> tuple[Any, int]:
        """Structure of the system, and the number of its leaves."""
        structure = self._motion[1].children()[Motion._fields.index("system")]
        return structure, structure.num_leaves

    def check(self, state_name: str = "simulate: the positions of the state", constraints: bool = True) -> None:
        """Refuse a system whose functions return wrong types or shapes, and a state that violates the constraints; equal ones are checked once.

        Args:
            state_name: the state in messages.
            constraints: whether to check the constraints at the state.
        """
        with Working("checks of the system"):
            check_once(Known((self.system, replace(self.state, p_s=None, p_f=None))), state_name, constraints)

    def start(self, fell_back: bool = False) -> Checkpoint:
        """The checkpoint before the first step."""
        return self._blank(Cursor.at_start(self.state, None), fell_back)

    def _blank(self, cursor: Cursor, fell_back: bool) -> Checkpoint:
        """A checkpoint whose stepper has no memory of earlier steps."""
        memory = self._piece_engine(fell_back).blank_memory(self.leaves)
        return Checkpoint(cursor._replace(memory=memory), is_first=True, fell_back=fell_back)

    def _piece_engine(self, fell_back: bool) -> Engine:
        return (self.exact if fell_back else self)._pieces

    @cached_property
    def _pieces(self) -> Engine:
        """Its programs for pieces, without the fallback."""
        room = room_of_a_piece(self.state, self.scheme.num_micro, self.save_micro)
        return engine(self._motion[1], room, self.save_micro)

    def advance(self, checkpoint: Checkpoint, saves: int) -> tuple[Piece, Checkpoint]:
        """The next `saves` saved intervals, as of `observed`; from the first piece that is not solved, with the fallback.

        After a failure nothing is computed, and all further nodes are NaN.
        """
        pieces, room = [], self._piece_engine(checkpoint.fell_back).num_saves
        for done in range(0, saves, room):
            size = min(room, saves - done)
            piece, after = self._advance(checkpoint, size)
            if not checkpoint.fell_back and int(checkpoint.cursor.failed_at) < 0 and self.unsolved(piece[0]):
                with Working(FALLING_BACK):
                    piece, after = self._advance(self._blank(checkpoint.cursor, fell_back=True), size)
            pieces.append(piece)
            checkpoint = after
        return join(pieces), checkpoint

    def _advance(self, checkpoint: Checkpoint, saves: int) -> tuple[Piece, Checkpoint]:
        cursor, is_first, fell_back = checkpoint
        step, leaves = int(cursor.step), self.leaves
        saved, cursor = self._piece_engine(fell_back).next_piece(leaves, cursor, is_first, self.save_every, saves)
        result, failed_at = np.asarray(cursor.result), np.asarray(cursor.failed_at)
        run, table = self.observed(self.unpacked(saved, leaves, result, failed_at, self.save_every, step), leaves, step)
        after = cursor._replace(step=step + saves * self.save_every, result=run.result, failed_at=run.failed_at)
        return (run, table), Checkpoint(after, fell_back=fell_back)

    def unsolved(self, run: Trajectory) -> np.ndarray:
        """Whether the fallback may solve a run or a piece, or (lanes,) the runs of a batch."""
        is_alive = np.asarray(run.failed_at) < 0
        if is_alive.all() or not (self.may_fall_back and self.plan.has_fallback):
            return np.zeros(is_alive.shape, dtype=bool)
        return unsolved(np.asarray(run.result), np.max(run.info.method, axis=-1))

    def in_pieces(self, caller: str = "") -> Trajectory:
        """The whole run; with a progress bar Ctrl-C raises `Interrupted` with the trajectory computed so far.

        With the name of a `caller` it warns about the motion, see `warn`.
        """
        if self.save.progress is False:
            with Working("the run", running=STEPPING):
                return self._finished(self.advance(self.start(), self.num_saves)[0], caller)
        size, checkpoint, pieces = -(-self.num_saves // PARTS_OF_A_BAR), self.start(), []
        with interrupts_noted() as interrupted, progress_to("simulate", self.save.progress) as tell:
            for done in range(0, self.num_saves, size):
                tell("simulating", done, self.num_saves)
                piece, checkpoint = self.advance(checkpoint, min(size, self.num_saves - done))
                pieces.append(piece)
                if interrupted():
                    steps = int(checkpoint.cursor.step)
                    raise Interrupted(self._finished(join(pieces)), steps, self.num_steps, "macro steps")
        return self._finished(join(pieces), caller)

    def _finished(self, piece: Piece, caller: str = "") -> Trajectory:
        run, table = piece
        if caller:
            self.warn(caller, table, run.states.t, stacklevel=5)
        return with_observables(run, table, self.origin)


def simulation(moving: Movable, scheme, state: State | None, solver: Solver | None, steps: Steps) -> Simulation:
    """The `Simulation` with these arguments of `simulate`; bad arguments raise."""
    warn_if_slow()
    problem = opened(moving)
    with Working("the start of the run"):
        system, state = start_of("simulate", problem, state)
    num_steps, save_every = check_run(system, scheme, state, solver, steps)
    # Scenes only: `opened` returns problems as they are.
    advice = nothing_fast(scheme, state.q_f.size) if moving is not problem else ""
    if advice:
        warnings.warn(f"simulate: {advice}", stacklevel=3)
    chosen_solver, scheme, system = of_one_type((solver or _usual_solver(), scheme, system))
    state, macro_dt, names = State(*_arrays(state)), _float(steps.macro_dt), names_of(problem)
    save = Save.of(steps.save)
    return Simulation(system, scheme, chosen_solver, state, macro_dt, num_steps, save_every, save, names)


@cache
def _usual_solver() -> Solver:
    return Solver()


def _arrays(state: State) -> tuple:
    return tuple(_float(a) for a in (state.t, state.q_s, state.q_f, state.p_s, state.p_f))


def _float(value):
    """Numbers as an array of float64: of JAX if they are traced, else of NumPy, which is made faster."""
    return np.asarray(value, dtype=float) if is_concrete(value) else jnp.asarray(value, dtype=float)
