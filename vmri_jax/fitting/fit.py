"""Identification: parameters of a system from measurements of its motion, with what is known about them afterwards."""

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import replace
from functools import partial
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.fitting.given import Measured, Unknown, Unknowns
from vmri_jax.fitting.result import SINGULAR_VALUE_TOLERANCE, Fit, without_starts
from vmri_jax.fitting.shooting import Shooting
from vmri_jax.mechanics.arrays import split_at, whole_number
from vmri_jax.mechanics.checks import check_number, check_type, traced
from vmri_jax.mechanics.places import Placed, places_of
from vmri_jax.mechanics.slots import free
from vmri_jax.mechanics.state import HasProblem, Problem, problem_of
from vmri_jax.refusals import Refused
from vmri_jax.running.arguments import check_step_size
from vmri_jax.running.export import extra
from vmri_jax.running.prepare import prepare
from vmri_jax.running.progress import Progress, Working
from vmri_jax.schemes.composition import SchemeLike
from vmri_jax.steppers.solver import Solver

GAP_WEIGHTS = (1e-2, 1.0, 1e2, 1e4, 1e6)
"""Weights of the gaps between the parts of multiple shooting, for searches one after the other, each from the end of
the one before. A gap as large as the motion counts like a miss of every value by this many standard deviations. A
larger first weight makes the search as hard as one with a single run; a smaller last one leaves gaps."""
TOLERANCE = 1e-6
"""Absolute and relative change of the search variables at which a search ends. A larger one leaves errors of this size
beside the standard errors of the parameters."""
FAILED_MISS = 1e6
"""Miss of a value, in standard deviations, that a failed run counts as: far above the misses of runs that work, so that
the search turns back. Squares of much larger values would drown the others in round-off."""
REFITS_AT_ONCE = 50
"""Fits of a bootstrap side by side. With more of them all wait longer for the slowest; with fewer, vector instructions
are left unused."""
NUM_PHASES = 4
"""Number of phases that the display of a long fit tells apart."""


def fit(
    problem: Problem | HasProblem | Callable[[Mapping], Problem],
    data: Measured | Sequence[Measured],
    parameters: Mapping[str, Unknown | float],
    *,
    scheme: SchemeLike,
    macro_dt: float,
    segments: int = 1,
    starts: int = 1,
    spread: float = 0.3,
    max_steps: int = 100,
    solver: Solver | None = None,
    seed: int = 0,
) -> Fit:
    """Find the parameters for which the motion comes closest to what was measured.

        data = vm.fitting.Measured(t, values, sigma=0.01, observe=lambda state: state.q_f)
        result = vm.fit(problem, data, {"stiffness": vm.fitting.Unknown(3000.0, lower=0)}, scheme=scheme, macro_dt=0.01)
        print(result)

    The method of Levenberg and Marquardt (`optimistix`) minimises ``sum ((predicted - measured) / sigma)^2``, with the
    Jacobian in forward mode. A fit that takes more than two seconds shows its phases on the error stream.

    Args:
        problem: a problem; `parameters` name its params, "bonds.stiffness", the parts of its start, "q_s", "q_f",
            "v_s", "v_f", or numbers in them, "masses[1]", "hub x". Or a function ``{name: value} -> Problem``, for
            everything else.
        data: one or several sets of measurements.
        parameters: an `Unknown` for each name, or the number where its search starts.
        scheme, macro_dt, solver: as in `simulate`. The times of measurement must be macro nodes. Where the solver is
            not chosen, runs have no fallback.
        segments: parts of multiple shooting; more than one for long or chaotic motion.
        starts: number of searches side by side, the first from `parameters`, the others from random starts about them.
        spread: standard deviation of the random starts, about the relative change of a parameter.
        max_steps: largest number of iterations of a search.
        seed: of the random starts.

    Returns:
        The `Fit`: parameters, their covariance, what the data does not determine, the run.

    Raises:
        ValueError, TypeError: bad arguments; times off the grid; a parameter that nothing depends on.
        SimulationError: the run with the first parameters fails.
        ImportError: optimistix is not installed.
    """
    extra("optimistix", "fit", "fit")
    model = _model(problem, parameters)
    unknowns = Unknowns({name: u if isinstance(u, Unknown) else Unknown(u) for name, u in parameters.items()})
    data = [data] if isinstance(data, Measured) else list(data)
    _check(data, segments, starts, max_steps)
    if not check_number("fit: spread", spread) > 0:
        raise Refused(f"fit: spread is {spread}; it must be positive.")
    whole_number("fit: seed", seed, least=0)
    first = model(unknowns.at(np.zeros(unknowns.size)))
    check_type("fit: the model", first, Problem, "a vmri_jax.Problem from its parameters")
    with traced("fit: problem"):
        jax.eval_shape(lambda u: model(unknowns.at(u)).state(), np.zeros(unknowns.size))
    check_step_size(macro_dt, "fit")
    # steps[i] are the numbers of the macro nodes at which the set i of data was measured
    steps = [m.steps(float(first.t), macro_dt) for m in data]
    if max(s.max() for s in steps) < 1:
        raise Refused("fit: all measurements are at the start of the problem; measure at later times, too.")
    with Working("fit") as tell:
        tell("a run with the first parameters", 0, NUM_PHASES)
        run = prepare(first, scheme, macro_dt=macro_dt, num_steps=max(int(s.max()) for s in steps), solver=solver)
        nodes = run().states
        for m, places in zip(data, steps, strict=True):
            m.check(jax.tree.map(lambda a, places=places: a[places], nodes))
        # A fallback is a branch of the compiled step: `jax.vmap` over searches would compute both of its sides.
        shooting = Shooting(model, unknowns, data, steps, scheme, solver or run.plan.first, float(macro_dt), segments)
        search = _Search(shooting, max_steps)
        u = np.zeros((starts, unknowns.size))
        u[1:] = spread * np.random.default_rng(seed).standard_normal((starts - 1, unknowns.size))
        search.check_dependence(tell)
        return search.result(u, tell)


def _model(problem, parameters: Mapping) -> Callable[[Mapping], Problem]:
    if not parameters:
        raise Refused("fit: parameters is empty; name the unknown ones, e.g. {'stiffness': Unknown(3000.0, lower=0)}.")
    if not isinstance(problem, Problem) and callable(problem) and not hasattr(problem, "problem"):
        return cast(Callable[[Mapping], Problem], problem)
    base = problem_of("fit", cast(Problem, problem))
    known = {name: place for name, place in places_of(base).items() if name != "t"}
    for name, unknown in parameters.items():
        if name not in known:
            arrays = ", ".join(free(other for other in known if "[" not in other))
            names = f"system.params and of the start ({arrays}), and numbers of arrays, q_f[0] for example"
            raise Refused(f"fit: parameters has {name!r}, which is none of {names}. A function may make the Problem.")
        expected = known[name][1]
        start = unknown.start if isinstance(unknown, Unknown) else unknown
        if np.shape(start) != expected:
            raise Refused(f"fit: the start of {name!r} has shape {np.shape(start)}; in the problem it has {expected}.")
    return partial(Placed({name: known[name][0] for name in parameters}), base)


def _check(data: list, segments: int, starts: int, max_steps: int) -> None:
    if not data:
        raise Refused("fit: data is empty; give measurements, vm.fitting.Measured(t, values, sigma).")
    for m in data:
        check_type("fit: data", m, Measured, "vm.fitting.Measured(t, values, sigma), or several of them")
    if len({m.sigma is None for m in data}) > 1:
        raise Refused("fit: some of data have a sigma and some have none; give it for all or for none.")
    for name, value in (("segments", segments), ("starts", starts), ("max_steps", max_steps)):
        whole_number(f"fit: {name}", value)


def _changed(item, attributes: Mapping):
    """A copy of an object with other attributes, which JAX may trace: nothing is checked."""
    item = copy(item)
    vars(item).update(attributes)
    return item


class _Search:
    """The search of a fit; its programs are compiled once and run for several starts and several sets of values.

    Numbers of the unknowns, standard deviations and units are arguments of the programs: with others a program in the
    cache on disk serves.
    """

    def __init__(self, shooting: Shooting, max_steps: int):
        self.shooting, self.max_steps = shooting, max_steps
        self.size = shooting.unknowns.size
        self.count = len(shooting.values)
        if self.count < self.size + (not shooting.knows_sigma):
            numbers = f"{self.size} unknown numbers{'' if shooting.knows_sigma else ' and sigma'}"
            raise Refused(f"fit: {self.count} values for {numbers}; measure more, or fix some.")
        u_start = np.zeros(self.size)
        self.part_starts = shooting.starts(u_start)
        self.scale = shooting.sizes(u_start, self.part_starts)
        self.compiled_jacobian = self.compiled(_Search.jacobian)

    def compiled(self, function: Callable) -> Callable:
        """``function(search, ...)`` as a compiled function of all but the search."""

        @jax.jit
        def program(numbers, *arguments):
            of_unknowns, of_runs, scale = numbers
            pairs = zip(known.items(), of_unknowns, strict=True)
            unknowns = Unknowns({name: _changed(unknown, values) for (name, unknown), values in pairs})
            runs = _changed(self.shooting, of_runs | {"unknowns": unknowns})
            return function(_changed(self, {"shooting": runs, "scale": scale}), *arguments)

        # the names are no arguments: JAX would sort them, and the search variables are in the order of the user
        known = self.shooting.unknowns.unknowns
        of_unknowns = [vars(unknown) for unknown in known.values()]
        of_runs = {"sigma": self.shooting.sigma, "macro_dt": self.shooting.macro_dt}
        return partial(program, (of_unknowns, of_runs, self.scale))

    def residual(self, x, args):
        """Misses of all values in standard deviations, and weighted gaps between the parts, at x = (u, z): search
        variables, and starts of the parts in units of `scale`; `args` are the values and the weight of gaps."""
        (u, z), (values, weight), shooting = x, args, self.shooting
        predicted, gaps = shooting.predict(u, z * self.scale)
        misses = (predicted - values) / shooting.sigma
        finite = jnp.isfinite(misses)
        misses = jnp.where(finite, misses, FAILED_MISS)
        gaps = jnp.where(jnp.isfinite(gaps), gaps, FAILED_MISS)
        return misses, weight * np.sqrt(self.count) * gaps / self.scale

    def solve(self, u, z, values):
        """The search from u, z: its end (u, z), misses, gaps in units of `scale`, iterations, whether it converged."""
        optimistix = extra("optimistix", "fit", "fit")
        solver = optimistix.LevenbergMarquardt(rtol=TOLERANCE, atol=TOLERANCE)
        weights = jnp.asarray(GAP_WEIGHTS if self.shooting.segments > 1 else (1.0,))

        def stage(x, weight):
            options = {"max_steps": self.max_steps, "throw": False}
            solution = optimistix.least_squares(self.residual, solver, x, (values, weight), **options)
            good = solution.result == optimistix.RESULTS.successful
            return solution.value, (solution.stats["num_steps"], good)

        (u, z), (iterations, good) = jax.lax.scan(stage, (u, z), weights)
        misses, gaps = self.residual((u, z), (values, 1 / np.sqrt(self.count)))
        return u, z, misses, gaps, jnp.sum(iterations), good[-1]

    def jacobian(self, u, z, values):
        """Jacobians of misses and gaps with their last weight, by the parameters and by the starts of the parts."""

        def joined(x):
            u, z = split_at(x, self.size)
            parts = self.residual((u, z.reshape(shape)), (values, GAP_WEIGHTS[-1]))
            return jnp.concatenate([jnp.ravel(a) for a in parts])

        shape = jnp.shape(z)
        # dr/dx = (dr/du) / (dx/du), since the number i of the parameters depends on u_i alone
        whole = jax.jacfwd(joined)(jnp.concatenate([u, jnp.ravel(z)]))
        by_parameters = jax.jacfwd(lambda u: self.shooting.unknowns.vector(self.shooting.unknowns.at(u)))(u)
        return whole[:, : self.size] / jnp.diagonal(by_parameters), whole[:, self.size :]

    def check_dependence(self, tell: Progress) -> None:
        """Refuse parameters that no measured value depends on."""
        tell("compiling and running the derivatives with respect to the parameters", 1, NUM_PHASES)
        point = np.zeros(self.size), self.part_starts / self.scale, self.shooting.values
        by_parameters = np.asarray(self.compiled_jacobian(*point)[0])
        dead = np.flatnonzero(~by_parameters.any(axis=0))
        if dead.size:
            names = ", ".join(self.shooting.unknowns.labels[i] for i in dead)
            raise Refused(f"fit: no measured value depends on {names}; leave this parameter out, or start elsewhere.")

    def result(self, u, tell: Progress) -> Fit:
        """The `Fit` of the best search; each row of u starts one."""
        tell(f"compiling the search, then at most {self.max_steps} iterations", 2, NUM_PHASES)
        z = np.broadcast_to(self.part_starts / self.scale, (len(u), *self.part_starts.shape))
        solve = self.compiled(jax.vmap(_Search.solve, (None, 0, 0, None)))
        ends = [np.asarray(a) for a in solve(u, z, self.shooting.values)]
        squares = np.sum(ends[2] ** 2, axis=1)  # of the misses
        u, z, misses, gaps, iterations, good = (a[np.argmin(squares)] for a in ends)
        tell("the derivatives at the end of the search", 3, NUM_PHASES)
        jacobians = [np.asarray(a) for a in self.compiled_jacobian(u, z, self.shooting.values)]
        gap = float(np.abs(gaps).max(initial=0.0))
        end = {"iterations": int(iterations), "success": bool(good), "gap": gap, "squares": squares}
        change = self.change_by_half_steps(u, z, (misses, GAP_WEIGHTS[-1] * np.sqrt(self.count) * gaps), jacobians)
        return Fit.of(self.shooting, u, misses, jacobians, change, **end, again=partial(self.again, u, z))

    def change_by_half_steps(self, u, z, residual, jacobians) -> np.ndarray:
        """Change (p,) of the parameters with steps of half the length, to first order ``-J^+ (r(H/2) - r(H))``.

        A fit hides the error of its scheme in the parameters: too large a step lowers a frequency, and a larger
        stiffness makes up for it. Neither the misses nor the covariance show this error.
        """
        runs, halved = self.shooting, copy(self)
        halved.shooting = replace(runs, macro_dt=runs.macro_dt / 2, steps=[2 * steps for steps in runs.steps])
        fine = halved.compiled(_Search.residual)((u, z), (self.shooting.values, GAP_WEIGHTS[-1]))
        difference = np.concatenate([np.ravel(np.asarray(b) - a) for a, b in zip(residual, fine, strict=True)])
        jacobian = np.asarray(without_starts(*jacobians))
        size = np.linalg.norm(jacobian, axis=0)
        size = np.where(size > 0, size, 1.0)
        return -np.linalg.lstsq(jacobian / size, difference, rcond=SINGULAR_VALUE_TOLERANCE)[0] / size

    def again(self, u, z, values):
        """Parameters (k, p) and covariances (k, p, p) of fits to other values (k, m), which start at the end u, z."""

        def refit(search, u, z, values):
            u_end, z_end, *_ = search.solve(u, z, values)
            jacobian = without_starts(*search.jacobian(u_end, z_end, values))
            covariance = jnp.linalg.pinv(jacobian.T @ jacobian, hermitian=True)
            unknowns = search.shooting.unknowns
            return unknowns.vector(unknowns.at(u_end)), covariance

        refits, parts = self.compiled(jax.vmap(refit, (None, None, None, 0))), -(-len(values) // REFITS_AT_ONCE)
        size = -(-len(values) // parts)
        padded, fits = np.resize(values, (parts * size, values.shape[1])), []  # one program for all parts
        with Working("bootstrap") as tell:
            for i, part in enumerate(np.split(padded, parts)):
                tell(f"fits {i * size + 1} to {min((i + 1) * size, len(values))} of {len(values)}", i, parts)
                fits.append([np.asarray(a) for a in refits(u, z, part)])
        return tuple(np.concatenate(arrays)[: len(values)] for arrays in zip(*fits, strict=True))
