"""`Simulation`: a run with checked arguments, and the three ways to compute it.

| call | program | used by |
|---|---|---|
| ``run()`` | `Engine.whole`, compiled for its number of saved nodes | `prepare` |
| ``run.in_pieces()``, ``run.advance(...)`` | `Engine.piece`, one program for runs of all lengths | `simulate`, `stream` |
| `vmri_jax.running.adjoints` | `Engine.stored`, `Engine.checkpointed`, with derivatives | `simulate` under transformations |

All of them return a `Run`, states and statuses; `Simulation.observed` makes its `Trajectory`, with energy, constraints and failures of the nodes.

With the matrix "auto" a piece that is not solved is computed again with exact matrices (`vmri_jax.running.fallback`), with the same tolerance and
limit of iterations; so are all pieces after it.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
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
from vmri_jax.running.arguments import Steps, check_once, check_run, check_vectors, nothing_fast
from vmri_jax.running.engine import Arrays, Engine, Model, PieceStart, engine
from vmri_jax.running.failures import simulation_error
from vmri_jax.running.fallback import FALLING_BACK, unsolved
from vmri_jax.running.interrupts import Interrupted, interrupts_noted
from vmri_jax.running.observables import concerns, failures, observables, with_tolerance
from vmri_jax.running.origin import Origin, evaluated, names_of
from vmri_jax.running.progress import ShowsProgress, Working, progress_to
from vmri_jax.running.saved import room_of_a_piece
from vmri_jax.running.trajectory import Run, Trajectory, join, trajectory_of, with_origin
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

    step: macro steps done.
    state: state at the node reached.
    memory: memory of the stepper, such as the start of Newton's next iteration.
    fell_back: whether the fallback has replaced the first matrix.
    is_first: whether the stepper has no memory of earlier steps, so that `memory` is blank.
    """

    step: int
    state: State
    memory: Any
    fell_back: bool = False
    is_first: bool = False


@dataclass(frozen=True, eq=False)
class Simulation:
    """A run with checked arguments, ready to be computed.

    The matrix of its plan computes the run. If it fails in a run or a piece, the fallback computes the run or piece again; the program
    of the fallback is compiled only then.

    Attributes:
        system, scheme, solver, state, num_steps, save_every, save_micro: as of `simulate`.
        macro_dt: macro step H, an array of shape ().
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
    save_micro: bool
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
        arguments = self._arguments(state, macro_dt, params, num_steps)
        origin = self.origin if params is None else replace(self.origin, params=params)
        arrays, save_every, _ = arguments
        with Working("the run", running=STEPPING):
            run, table = self.whole(*arguments)
        if self.unsolved(run):
            with Working(FALLING_BACK):
                run, table = self.exact.whole(*arguments)
        trajectory = with_origin(trajectory_of(run, table), origin)
        if throw and int(trajectory.failed_at) >= 0:
            raise simulation_error(trajectory, arrays.macro_dt, save_every, self.scheme.num_micro)
        self.warn("run", table, run.states.t, arrays.macro_dt, save_every)
        return trajectory

    def compiled(self) -> jax.stages.Compiled:
        """The compiled program of the run without its fallback, for inspection."""
        return self.engine.whole.lower(*self._arguments(None, None, None, None)).compile()

    def timed(self, state=None, *, macro_dt=None, params=None, num_steps=None) -> Callable[[], None]:
        """A function without arguments that computes the run and waits for its result, to be timed.

        It runs the program that succeeds, with the first matrix or of the fallback. Arguments as of a call.
        """
        arrays, *counts = self._arguments(state, macro_dt, params, num_steps)
        arguments = jax.device_put(arrays), *counts
        solves = self.exact if self.unsolved(self.whole(*arguments)[0]) else self
        program = solves.engine.whole
        program(*arguments)
        return lambda: program(*arguments)[1].block_until_ready()  # the arrays of one program are ready together

    def _arguments(self, state, macro_dt, params, num_steps) -> tuple[Arrays, int, int]:
        """The arguments of the programs of the engine."""
        leaves, start, save_every = self.arrays.model, self.arrays.state, self.save_every
        if state is not None:
            check_vectors(state)
            start = _arrays(state)
            if [a.shape for a in start] != [a.shape for a in self.arrays.state]:
                raise ValueError(
                    f"the arrays of state have shapes {[a.shape for a in start]}; the run was prepared for "
                    f"{[a.shape for a in self.arrays.state]}."
                )
        if params is not None:
            leaves = self._leaves_with(params)
        if num_steps is not None:
            if num_steps < 1 or num_steps % self.num_saves:
                raise ValueError(f"num_steps is {num_steps}; it must be a positive multiple of {self.num_saves}.")
            save_every = num_steps // self.num_saves
        macro_dt = self.macro_dt if macro_dt is None else np.asarray(macro_dt, dtype=float)
        return Arrays(leaves, start, macro_dt), save_every, self.num_saves

    def observed(self, run: Run, model: list, step: int = 0) -> tuple[Run, Any]:
        """A run and its `Observables` (..., k, 9), both NaN from a failure on; failures that the nodes show are in its status.

        Args:
            run: of the engine.
            model: the leaves of its model, of which the last ones are the leaves of the system; in a batch with an axis of lanes.
            step: macro steps before its first node.
        """
        table = self._observables(run.states, model)
        return failures(run, table, self.save_every, step)

    def at_start(self) -> np.ndarray:
        """(1, 9) the `Observables` of the start."""
        return self._observables(jax.tree.map(lambda a: np.asarray(a)[None], self.state), self.arrays.model)

    def _observables(self, states: State, model: list) -> Any:
        """(..., k, 9) the `Observables` at states of the system whose leaves are the last ones of a model."""
        structure, count = self._system
        leaves = model[len(model) - count :]
        return evaluated(observables, structure, leaves, with_tolerance(states, self.solver.tolerance))

    def traced(self, run: Run) -> Trajectory:
        """The trajectory of a run some of whose arrays are tracers: its observables are a part of the trace."""
        return with_origin(trajectory_of(*self.observed(run, self.arrays.model)), self.origin)

    def warn(self, caller: str, table, t, macro_dt=None, save_every: int | None = None, stacklevel: int = 3) -> bool:
        """Give the warnings about the motion of a run, or of a batch, see `concerns`, with its arguments; returns whether there are any."""
        macro_dt, save_every = self.macro_dt if macro_dt is None else macro_dt, save_every or self.save_every
        all_concerns = concerns(table, t, self.system, macro_dt, save_every)
        for concern in all_concerns:
            warnings.warn(type(concern)(f"{caller}: {concern}"), stacklevel=stacklevel)
        return bool(all_concerns)

    def _leaves_with(self, params) -> list:
        """The leaves of the model with other parameters."""
        expected, expected_structure = jax.tree.flatten(self.system.params)
        new, structure = jax.tree.flatten(params)
        # The full check takes longer than a short run; plain float64 leaves need none.
        if not all(isinstance(leaf, float) or getattr(leaf, "dtype", None) == np.float64 for leaf in new):
            check_params(params)
        if structure != expected_structure or list(map(np.shape, new)) != list(map(np.shape, expected)):
            raise ValueError(f"params is {params!r}; give the pytree of system.params with other numbers in it.")
        leaves = self.arrays.model  # the parameters come last, see `Arrays`
        return leaves[: len(leaves) - len(expected)] + [np.asarray(leaf) for leaf in new]

    def whole(self, arrays: Arrays, save_every: int, saves: int) -> tuple[Run, Any]:
        """The run by one program, without the fallback, as of `observed`; arguments of `Engine.whole`."""
        leaves, table = self.engine.whole(arrays, save_every, saves)
        return failures(Run.of(leaves), np.asarray(table), save_every)

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
    def is_concrete(self) -> bool:
        """Whether all arrays are concrete numbers, not tracers of a transformation."""
        return is_concrete(self.arrays)

    @cached_property
    def plan(self) -> Plan:
        """The `Plan`, which ``print`` shows in words."""
        return plan(self.system, self.scheme, self.state, self.solver)

    @cached_property
    def origin(self) -> Origin:
        """The origin of its trajectories."""
        return replace(Origin.of(self.system), names=self.names)

    @cached_property
    def arrays(self) -> Arrays:
        """The arguments of its programs."""
        return Arrays(self._model[0], tuple(vars(self.state).values()), self.macro_dt)

    @cached_property
    def engine(self) -> Engine:
        """Its programs, without the fallback."""
        return engine(self._model[1], self.num_saves, self.save_micro)

    @cached_property
    def exact(self) -> "Simulation":
        """The fallback: the same run with exact matrices."""
        return replace(self, solver=self.solver.exact())

    @cached_property
    def _model(self) -> tuple[list, Any]:
        """Leaves and structure of the `Model`."""
        return jax.tree.flatten(Model(self.solver, self.scheme, self.system))

    @cached_property
    def _system(self) -> tuple[Any, int]:
        """Structure of the system, and the number of its leaves."""
        leaves, structure = jax.tree.flatten(self.system)
        return structure, len(leaves)

    def check(self, state_name: str = "simulate: the positions of the state", constraints: bool = True) -> None:
        """Refuse a system whose functions return wrong types or shapes, and a state that violates the constraints; equal ones are checked once.

        Args:
            state_name: the state in messages.
            constraints: whether to check the constraints at the state.
        """
        with Working("checks of the system"):
            check_once(Known((self.system, replace(self.state, p_s=None, p_f=None))), state_name, constraints)

    def start(self, state: State | None = None, step: int = 0, fell_back: bool = False) -> Checkpoint:
        """The checkpoint before the first step; or before step number `step` at another state, with blank memory."""
        start = self.arrays.state if state is None else _arrays(state)
        memory = self._piece_engine(fell_back).blank_memory(self.arrays._replace(state=start))
        return Checkpoint(step, State(*start), memory, fell_back, is_first=True)

    def _piece_engine(self, fell_back: bool) -> Engine:
        room = room_of_a_piece(self.state, self.scheme.num_micro, self.save_micro)
        return engine((self.exact if fell_back else self)._model[1], room, self.save_micro)

    def advance(self, checkpoint: Checkpoint, saves: int) -> tuple[list[tuple[Run, np.ndarray]], Checkpoint]:
        """The next `saves` saved intervals, in pieces as of `observed`; from the first one that is not solved, with the fallback."""
        pieces, room = [], self._piece_engine(checkpoint.fell_back).num_saves
        for done in range(0, saves, room):
            size = min(room, saves - done)
            piece, after = self._advance(checkpoint, size)
            if not checkpoint.fell_back and self.unsolved(piece[0]):
                with Working(FALLING_BACK):
                    again = self.start(checkpoint.state, checkpoint.step, fell_back=True)
                    piece, after = self._advance(again, size)
            pieces.append(piece)
            checkpoint = after
        return pieces, checkpoint

    def _advance(self, checkpoint: Checkpoint, saves: int) -> tuple[tuple[Run, np.ndarray], Checkpoint]:
        step, state, memory, fell_back, is_first = checkpoint
        is_alive = not np.isnan(state.t)  # after a failure nothing is computed, and the trajectory keeps its length
        arrays = self.arrays._replace(state=tuple(vars(state).values()))
        begin = PieceStart(memory, is_first, self.arrays.state[0], step)
        run, state, memory = self._piece_engine(fell_back).next_piece(arrays, begin, self.save_every, saves, is_alive)
        piece = self.observed(run, arrays.model, step)
        if not is_alive or int(piece[0].failed_at) >= 0:
            state = replace(state, t=np.asarray(np.nan))
        return piece, Checkpoint(step + saves * self.save_every, state, memory, fell_back)

    def unsolved(self, run: Run) -> np.ndarray:
        """Whether the fallback may solve a run or a piece, or (lanes,) the runs of a batch."""
        is_alive = np.asarray(run.failed_at) < 0
        if is_alive.all() or not (self.may_fall_back and self.plan.has_fallback):
            return np.zeros(is_alive.shape, dtype=bool)
        return unsolved(np.asarray(run.result), np.max(run.info.method, axis=-1))

    def in_pieces(self, progress: ShowsProgress = False, caller: str = "") -> Trajectory:
        """The whole run; with a progress bar Ctrl-C raises `Interrupted` with the trajectory computed so far.

        With the name of a `caller` it warns about the motion, see `warn`.
        """
        if progress is False:
            with Working("the run", running=STEPPING):
                return self._joined(self.advance(self.start(), self.num_saves)[0], caller)
        size, checkpoint, pieces = -(-self.num_saves // PARTS_OF_A_BAR), self.start(), []
        with interrupts_noted() as interrupted, progress_to("simulate", progress) as tell:
            for done in range(0, self.num_saves, size):
                tell("simulating", done, self.num_saves)
                new_pieces, checkpoint = self.advance(checkpoint, min(size, self.num_saves - done))
                pieces += new_pieces
                if interrupted():
                    raise Interrupted(self._joined(pieces), checkpoint.step, self.num_steps, "macro steps")
        return self._joined(pieces, caller)

    def _joined(self, pieces: list[tuple[Run, np.ndarray]], caller: str = "") -> Trajectory:
        """One trajectory with arrays of JAX; `device_put`, since `jax.numpy.asarray` would compile a program for every length."""
        whole = join([trajectory_of(*piece) for piece in pieces])
        if caller:
            tables = [table[1 if i else 0 :] for i, (_, table) in enumerate(pieces)]
            self.warn(caller, np.concatenate(tables) if len(tables) > 1 else tables[0], whole.t, stacklevel=5)
        return with_origin(jax.device_put(whole), self.origin)


def simulation(moving: Movable, scheme, state: State | None, solver: Solver | None, steps: Steps) -> Simulation:
    """The `Simulation` with these arguments of `simulate`; bad arguments raise."""
    warn_if_slow()
    problem = opened(moving)
    with Working("the start of the run"):
        system, state = start_of("simulate", problem, state)
    macro_dt, num_steps, save_every = check_run(system, scheme, state, solver, steps)
    # Scenes only: `opened` returns problems as they are.
    advice = nothing_fast(scheme, state.q_f.size) if moving is not problem else ""
    if advice:
        warnings.warn(f"simulate: {advice}", stacklevel=3)
    chosen_solver, scheme, system = of_one_type((solver or Solver(), scheme, system))
    state, macro_dt, names = State(*_arrays(state)), _float(macro_dt), names_of(problem)
    return Simulation(system, scheme, chosen_solver, state, macro_dt, num_steps, save_every, steps.save_micro, names)


def _arrays(state: State) -> tuple:
    return tuple(_float(a) for a in (state.t, state.q_s, state.q_f, state.p_s, state.p_f))


def _float(value):
    """Numbers as an array of float64: of JAX if they are traced, else of NumPy, which is made faster."""
    return np.asarray(value, dtype=float) if is_concrete(value) else jnp.asarray(value, dtype=float)
