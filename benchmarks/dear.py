"""Where micro steps pay: slow forces that are dear. Time to an error against the price of the slow force, with its bound.

Two kinds of system. Molecules: n diatomic ones with stiff bonds W and Lennard-Jones forces V between all pairs of atoms of different molecules; W costs
n terms, V 2 n (n - 1). A teacher and its student: a chain of stiff springs in a potential by a network of many weights (the teacher), of which a small one
(the student) knows the most; the student stands on the micro nodes, the difference on the macro nodes (multiple time steps with learned potentials,
arXiv 2510.06562).

The bound: if single steps are as long as micro steps of the same error, N of them cost ``N (v + w)`` for prices v of V and w of W, a macro step costs
``v + N w``.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import combinations, pairwise
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import vmri_jax as vm
from benchmarks.measure import Ratio, Tell, silent
from benchmarks.report import Claim, Report
from benchmarks.savings import ratio_at
from vmri_jax import plots
from vmri_jax.mechanics.invariants import potential_energy
from vmri_jax.plots.theme import curve_look, legend_below
from vmri_jax.running.timing import seconds_each
from vmri_jax.study.program import Program, joined
from vmri_jax.study.timing import interleaved

COLUMNS = ("system", "scheme", "H", "error", "ms", "gain", "bound")
TARGET = 1e-5
"""Error of the positions at the end at which times are compared."""
RATIO = 2.0
"""From one number of macro steps to the next."""
LARGEST, SMALLEST = 1e-2, 1e-7
"""Errors that a ladder of steps spans."""
SLOWEST = 10.0
"""Seconds of a run after which a ladder ends."""
T_END = 1.0
BOND, STIFFNESS = 0.8, 5e4
"""Length of a bond and its stiffness with unit masses: frequency 316, about 30 times the frequency of neighbours in the lattice, as of nitrogen."""
SPACING, SPEED = 1.9, 0.5
"""Distance of the molecules of the lattice, in diameters of an atom, and the size of their random velocities."""
WIDTHS = {"student": (16,), "teacher": (300, 300)}
"""Hidden layers of the networks: 1e5 weights of the teacher."""


@dataclass(frozen=True)
class Case:
    """A system whose slow force has a price, and the numbers of micro steps that are tried on it.

    title: of its curves.
    problem: the system with its start.
    num_micro: numbers of micro steps.
    """

    title: str
    problem: Callable[[], vm.Problem]
    num_micro: tuple[int, ...] = (1, 5, 20)


def sizes(name: str) -> list[Case]:
    """ "quick": 8 molecules; "full": 16 and 64 of them, and the teacher."""
    if name == "quick":
        return [Case("8 molecules", partial(molecules, 8), (1, 10))]
    return [
        Case("16 molecules", partial(molecules, 16), (1, 10, 20, 40)),
        Case("64 molecules", partial(molecules, 64), (1, 20, 40)),
        Case("teacher", teacher, (1, 10, 20)),
    ]


# --- molecules -------------------------------------------------------------------------------------------------------
def lennard_jones(pairs, q_s, q_f, params):
    """``sum 4 (r^-12 - r^-6)`` over all pairs of atoms of different molecules."""
    q = q_f.reshape(-1, 3)
    d = q[pairs[:, 0]] - q[pairs[:, 1]]
    inverse = 1 / jnp.sum(d * d, axis=1) ** 3
    return 4 * jnp.sum(inverse * (inverse - 1))


def bonds(q_f, params):
    """``k / 2 sum (|q_2i - q_2i+1| - l)^2``."""
    q = q_f.reshape(-1, 2, 3)
    return STIFFNESS / 2 * jnp.sum((jnp.linalg.norm(q[:, 0] - q[:, 1], axis=1) - BOND) ** 2)


def molecules(n: int) -> vm.Problem:
    """Diatomic molecules on a lattice, turned and kicked at random."""
    random = np.random.default_rng(0)
    side = int(np.ceil(n ** (1 / 3)))
    places = SPACING * np.stack(np.meshgrid(*[np.arange(side)] * 3), axis=-1).reshape(-1, 3)[:n]
    axes = random.normal(size=(n, 3))
    axes *= BOND / 2 / np.linalg.norm(axes, axis=1)[:, None]
    q = np.stack([places - axes, places + axes], axis=1).reshape(-1)
    pairs = np.array([(i, j) for i, j in combinations(range(2 * n), 2) if i // 2 != j // 2])
    system = vm.System(vm.ConstantMass([], np.ones(6 * n)), partial(lennard_jones, pairs), bonds)
    return vm.Problem(system, [], q, [], SPEED * random.normal(size=6 * n))


# --- a teacher and its student ---------------------------------------------------------------------------------------
def network(weights, q):
    """A potential: tanh layers, and a sum with the last weights."""
    for matrix, bias in weights:
        q = jnp.tanh(matrix @ q + bias)
    return jnp.sum(q) / jnp.sqrt(q.size)


def difference(q_s, q_f, params):
    """What the teacher knows beyond the student, a tenth of the student's potential."""
    return 0.1 * network(params["teacher"], q_f)


def springs_and_student(q_f, params):
    """Stiff springs along the chain, and the student."""
    stretch = jnp.diff(q_f.reshape(-1, 3), axis=0)
    springs = STIFFNESS / 2 * jnp.sum((jnp.linalg.norm(stretch, axis=1) - 1.0) ** 2)
    return springs + network(params["student"], q_f)


def teacher(count: int = 6) -> vm.Problem:
    """A chain of `count` points in the potential of the teacher."""
    random = np.random.default_rng(1)

    def weights(widths):
        sizes = [3 * count, *widths]
        return [
            (jnp.asarray(random.normal(size=(b, a)) / np.sqrt(a)), jnp.asarray(random.normal(size=b)))
            for a, b in pairwise(sizes)
        ]

    params = {name: weights(widths) for name, widths in WIDTHS.items()}
    q = np.stack([np.arange(count), np.zeros(count), np.zeros(count)], axis=1).reshape(-1)
    system = vm.System(vm.ConstantMass([], np.ones(3 * count)), difference, springs_and_student, params=params)
    return vm.Problem(system, [], q, [], SPEED * random.normal(size=3 * count))


# --- measuring -------------------------------------------------------------------------------------------------------
def run(cases: list[Case], name: str, tell: Tell = silent) -> Iterator[Report]:
    """A report after each system."""
    rows, claims, notes, curves = [], [], [], {}
    for case in cases:
        problem = case.problem()
        slow, fast = _prices(problem)
        curves[case.title] = of_case = measured(case.title, problem, case.num_micro, tell)
        to_target = {scheme: _time_to(TARGET, *curve) for scheme, curve in of_case.items()}
        best = min(to_target, key=to_target.__getitem__)
        for scheme, (steps, errors, ms) in of_case.items():
            family, _, num_micro = scheme.partition(", N = ")
            n = int(num_micro or 1)
            single = of_case[f"{family}, N = 1" if num_micro else scheme][1:]
            rows += [
                {
                    "system": case.title,
                    "scheme": scheme,
                    "H": T_END / count if num_micro else None,
                    "error": error,
                    "ms": duration,
                }
                | {"gain": ratio_at(single, error, duration), "bound": n * (slow + fast) / (slow + n * fast)}
                for count, error, duration in zip(steps, errors, ms, strict=True)
            ]
        for family in ("kicks", "suzuki4"):
            of_family = {scheme: ms for scheme, ms in to_target.items() if scheme.startswith(f"{family}, ")}
            fastest = min(of_family, key=of_family.__getitem__)
            claims.append(
                _claim(
                    f"{case.title}: {family}, N = 1 over {fastest}", of_family[f"{family}, N = 1"], of_family[fastest]
                )
            )
        if "diffrax Dopri8" in to_target:
            claims.append(
                _claim(f"{case.title}: diffrax Dopri8 over {best}", to_target["diffrax Dopri8"], to_target[best])
            )
        notes.append(f"{case.title}: a gradient of V takes {slow / fast:.3g} times as long as one of W.")
        yield Report("dear", name, list(rows), list(claims), list(notes), {"dear": partial(_draw, dict(curves))})


def _claim(name: str, ms: float, best: float) -> Claim:
    """Times to the target, one over the other."""
    ratio = ms / best
    return Claim(f"{name} at {TARGET:g}", Ratio(ratio, ratio, ratio))


Curve = tuple[np.ndarray, np.ndarray, np.ndarray]


def measured(title: str, problem: vm.Problem, num_micro: tuple[int, ...], tell: Tell) -> dict[str, Curve]:
    """Numbers of macro steps, errors of the positions at the end and milliseconds, by scheme."""
    tell(f"{title}, fine steps")
    exact, _ = joined(Program(problem, vm.compose(vm.fully_explicit(10), "kahan-li8"), T_END)(400))
    schemes: dict[str, Any] = {f"kicks, N = {n}": vm.fully_explicit(n) for n in num_micro}
    schemes |= {f"suzuki4, N = {n}": vm.compose(vm.fully_explicit(n), "suzuki4") for n in num_micro}
    calls: dict[str, dict[int, tuple[float, Callable]]] = {}
    for scheme, chosen in schemes.items():
        program = Program(problem, chosen, T_END)

        def error_and_run(n: int, program=program):
            q, _ = joined(program(n))
            return float(np.abs(q[-1] - exact[-1]).max()), program.timed(n)

        calls[scheme] = _ladder(error_and_run, 8, lambda n, scheme=scheme: tell(f"{title}, {scheme}, {n} steps"))
    calls |= _diffrax(problem, exact[-1], lambda words: tell(f"{title}, {words}"))
    runs = {f"{scheme} {n}": run for scheme, ladder in calls.items() for n, (_, run) in ladder.items()}
    seconds = interleaved(runs, 3)
    return {
        scheme: (
            np.array(list(ladder)),
            np.array([error for error, _ in ladder.values()]),
            np.array([1e3 * np.median(seconds[f"{scheme} {n}"]) for n in ladder]),
        )
        for scheme, ladder in calls.items()
    }


def _ladder(
    error_and_run: Callable[[int], tuple[float, Callable]], first: int, tell: Callable[[int], None]
) -> dict[int, tuple[float, Callable]]:
    """Errors and runs for more and more steps, within the errors that are looked at."""
    rungs, n = {}, first
    while True:
        tell(n)
        error, run = error_and_run(n)
        start = time.perf_counter()
        run()
        seconds = time.perf_counter() - start
        if error <= LARGEST:
            rungs[n] = error, run
        if error < SMALLEST or seconds > SLOWEST:
            return rungs
        n = round(n * RATIO)


def _diffrax(
    problem: vm.Problem, exact: np.ndarray, tell: Callable[[str], None]
) -> dict[str, dict[int, tuple[float, Callable]]]:
    """The same by adaptive steps of Dopri8 on ``q'' = -V'(q) - W'(q)``, keyed by ``-log2`` of the tolerance; nothing where diffrax is not installed."""
    try:
        import diffrax  # pyright: ignore[reportMissingImports]
    except ImportError:
        return {}
    start = (jnp.asarray(problem.q_f), jnp.asarray(problem.v_f))

    force = jax.grad(lambda q: -potential_energy(problem.system, jnp.zeros(0), q))
    term: Any = diffrax.ODETerm(lambda t, y, args: (y[1], force(y[0])))

    @jax.jit
    def solve(tolerance):
        controller = diffrax.PIDController(rtol=tolerance, atol=tolerance)
        solution = diffrax.diffeqsolve(
            term, diffrax.Dopri8(), 0.0, T_END, None, start, stepsize_controller=controller, max_steps=100_000
        )
        return solution.ys[0][-1]  # pyright: ignore[reportOptionalSubscript]

    rungs = {}
    for power in range(7, 40, 3):
        tell(f"diffrax, tolerance 2^-{power}")
        error = float(np.abs(np.asarray(solve(2.0**-power)) - exact).max())
        if error <= LARGEST:
            rungs[power] = error, partial(lambda tolerance: solve(tolerance).block_until_ready(), 2.0**-power)
        if error < SMALLEST:
            break
    return {"diffrax Dopri8": rungs}


def _prices(problem: vm.Problem) -> tuple[float, float]:
    """Seconds of a gradient of V and of W."""
    q = jnp.asarray(problem.q_f)
    slow, fast = (
        jax.grad(lambda q, name=name: problem.system.all_potentials(jnp.zeros(0), q)[name]) for name in ("slow", "fast")
    )
    return seconds_each(slow, q, 500), seconds_each(fast, q, 500)


def _time_to(error: float, steps: np.ndarray, errors: np.ndarray, ms: np.ndarray) -> float:
    """Milliseconds at an error, between those measured; infinite outside of them."""
    between = ratio_at((errors, ms), error, 1.0)
    return np.inf if between is None else between


def _draw(curves: dict[str, dict[str, Curve]]):
    """Error against time, a panel for each system; a scheme looks alike in all of them."""
    columns = min(3, len(curves))
    schemes = list(dict.fromkeys(scheme for measured_curves in curves.values() for scheme in measured_curves))
    title = "Slow forces that are dear: kicks and their composition of order 4 with N micro steps"
    with plots.new_figure(0.8 + 3.4 * columns, 1.2 + 3.2 * -(-len(curves) // columns), title, plots.LIGHT) as figure:
        panels = plots.panel_grid(figure, len(curves), columns)
        for axes, (name, measured_curves) in zip(panels, curves.items(), strict=True):
            for scheme, (_, error, ms) in measured_curves.items():
                axes.loglog(ms, error, label=scheme, **curve_look(schemes.index(scheme), plots.LIGHT))
            axes.set(title=name, xlabel="ms", ylabel="error of positions at the end")
        legend_below(figure)
    return figure
