"""Shooting: predictions of a model for all measurements, from the start of the motion or of parts of it.

With one part the start follows from the parameters. With several (*multiple shooting*) the start of each part is an
unknown, and a condition of the search is that each part ends where the next one starts. Errors grow little within a
part, so that the search is well behaved where a single run is chaotic, or many periods off.

Source: H. G. Bock, Recent advances in parameter identification techniques for O.D.E., Birkhaeuser (1983).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import gcd

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.accuracy.simulate import simulate
from vmri_jax.fitting.given import Measured, Unknowns
from vmri_jax.mechanics.arrays import library, split_at
from vmri_jax.mechanics.invariants import velocity
from vmri_jax.mechanics.projection import mass_and_momentum
from vmri_jax.mechanics.state import Problem, State, initial_state
from vmri_jax.running.arguments import Save
from vmri_jax.schemes.composition import SchemeLike
from vmri_jax.steppers.solver import Solver

SMALLEST_SIZE = 1e-3
"""Smallest size of a coordinate in a search, relative to the velocity that the kinetic energy of the motion allows it.
Where a coordinate hardly moves, a smaller value makes the search ill-conditioned, so that it ends while the parts have
gaps; a larger one weighs the gaps of light bodies less."""


@dataclass(frozen=True, eq=False)
class Shooting:
    """The runs of a fit, cut into parts of equal length.

    Attributes:
        model: ``{name: value} -> Problem``.
        unknowns: the parameters that are searched for.
        data: sets of measurements.
        steps: for each set, the numbers of the macro nodes of its times.
        segments: number of parts.
    """

    model: Callable[[Mapping], Problem]
    unknowns: Unknowns
    data: Sequence[Measured]
    steps: Sequence[np.ndarray]
    scheme: SchemeLike
    solver: Solver
    macro_dt: float
    segments: int

    @cached_property
    def every(self) -> int:
        """Macro steps between saved nodes."""
        return gcd(*(int(n) for steps in self.steps for n in steps))

    @property
    def last(self) -> int:
        """Macro steps up to the last measurement."""
        return max(int(steps.max()) for steps in self.steps)

    @cached_property
    def length(self) -> int:
        """Macro steps of a part."""
        nodes = -(-self.last // self.every)
        return self.every * max(-(-nodes // self.segments), 1)

    @cached_property
    def values(self) -> np.ndarray:
        """(m,) all measured values, missing ones left out."""
        return np.concatenate([m.values[np.isfinite(m.values)] for m in self.data])

    @cached_property
    def sigma(self) -> np.ndarray:
        """(m,) standard deviations of the values; 1 where they are not known."""
        sigmas = [np.ones_like(m.values) if m.sigma is None else m.sigma for m in self.data]
        return np.concatenate([s[np.isfinite(m.values)] for s, m in zip(sigmas, self.data, strict=True)])

    @property
    def knows_sigma(self) -> bool:
        """Whether the standard deviations are known."""
        return self.data[0].sigma is not None

    def start(self, u):
        """(2 n,) positions and velocities at the start of the motion, for the search variables u of the parameters."""
        problem = self.model(self.unknowns.at(u))
        return _phase(problem, problem.state())

    def starts(self, u) -> np.ndarray:
        """(segments - 1, 2 n) starts of the parts after the first one, along a single run with u."""
        if self.segments == 1:
            return np.zeros((0, self.start(u).size))
        problem = self.model(self.unknowns.at(u))
        steps = {"macro_dt": self.macro_dt, "num_steps": self.length * self.segments, "save": self.length}
        run = simulate(problem, self.scheme, **steps, solver=self.solver)
        return np.concatenate([run.states.q_s, run.states.q_f, *run.velocities], axis=1)[1:-1]

    def sizes(self, u, starts) -> np.ndarray:
        """(2 n,) units of the starts of the parts in a search: the largest value of each coordinate at all starts, or
        SMALLEST_SIZE of its bound for a coordinate that hardly moves. The units of coordinates and masses cancel."""
        problem, phases = self.model(self.unknowns.at(u)), np.concatenate([np.asarray(self.start(u))[None], starts])
        mass, _ = mass_and_momentum(problem.system, problem.q_s, problem.q_f, 0 * problem.v_s, 0 * problem.v_f)
        v = phases[:, len(mass) :]
        # |v_i| <= sqrt((M^-1)_ii v^T M v), and in the time of a part q_i changes by this velocity times the time
        fastest = np.sqrt(np.diag(np.linalg.inv(mass)) * np.max(np.sum(v @ mass * v, axis=1)))
        bounds = np.concatenate([self.length * self.macro_dt * fastest, fastest])
        size = np.maximum(np.abs(phases).max(axis=0), SMALLEST_SIZE * bounds)
        return np.where(size > 0, size, size.max() or 1.0)

    def predict(self, u, starts):
        """Predicted values (m,), and gaps (segments - 1, 2 n): the end of each part minus the start of the next one."""
        if self.segments == 1:  # the start follows from u: JAX's own derivative needs tangents for u alone
            problem = self.model(self.unknowns.at(u))
            start = problem.state(problem.project or problem.system.is_constrained)  # any parameters keep constraints
            observed, ends = jax.tree.map(lambda a: a[None], self._run(problem, start))
        else:
            observed, ends = self._parts(u, jnp.concatenate([self.start(u)[None], starts]))
        predicted = [
            jnp.reshape(o[part, node], m.values.shape)[np.isfinite(m.values)]
            for m, o, (part, node) in zip(self.data, observed, self._places, strict=True)
        ]
        return jnp.concatenate(predicted), ends[:-1] - starts

    @cached_property
    def _places(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """For each set of measurements, the part that each time lies in, and the number of the saved node there."""
        parts = [np.minimum(steps // self.length, self.segments - 1) for steps in self.steps]
        return [(k, (steps - k * self.length) // self.every) for k, steps in zip(parts, self.steps, strict=True)]

    @cached_property
    def _parts(self) -> Callable:
        """``(u, starts of all parts) -> observed quantities at the nodes of all parts, their ends``; a derivative takes
        2 n + len(u) tangents through each part, where JAX would take those of all starts through every part."""

        @jax.custom_jvp
        def parts(u, starts):
            return jax.vmap(self._part, (None, 0, 0))(u, starts, jnp.arange(self.segments))

        @parts.defjvp
        def derivative(primals, tangents):
            u, _ = primals

            def part(joined, number):
                run = self._part(joined[: u.size], joined[u.size :], number)
                return run, run  # the second one is the value beside the derivative

            joined, d_joined = (
                jnp.concatenate([jnp.broadcast_to(u, (self.segments, u.size)), starts], axis=1)
                for u, starts in (primals, tangents)
            )
            slopes, primal_out = jax.vmap(jax.jacfwd(part, has_aux=True))(joined, jnp.arange(self.segments))
            return primal_out, jax.tree.map(lambda a: jnp.einsum("k...i,ki->k...", a, d_joined), slopes)

        return parts

    def _part(self, u, start, number):
        """Observed quantities at the saved nodes of a part, and its end (2 n,), from its start (2 n,)."""
        problem = self.model(self.unknowns.at(u))
        system, n_s, n = problem.system, problem.q_s.size, problem.q_s.size + problem.q_f.size
        t = problem.t + number * (self.length * self.macro_dt)
        phase = split_at(start, n_s, n, n + n_s)
        return self._run(problem, initial_state(system, *phase, t=t, project=system.is_constrained))

    def _run(self, problem: Problem, state: State):
        """Observed quantities at the saved nodes of a run of one part from a state, and its end (2 n,)."""
        steps = {"macro_dt": self.macro_dt, "num_steps": self.length, "save": Save(self.every)}
        nodes = simulate(problem.system, self.scheme, state, **steps, solver=self.solver).states
        observed = [jax.vmap(m.observe)(nodes) for m in self.data]
        return observed, _phase(problem, jax.tree.map(lambda a: a[-1], nodes))


def _phase(problem: Problem, state: State):
    """(2 n,) positions and velocities of a state."""
    phase = state.q_s, state.q_f, *jax.jit(velocity)(problem.system, state.q_s, state.q_f, state.p_s, state.p_f)
    return library(phase).concatenate(phase)
