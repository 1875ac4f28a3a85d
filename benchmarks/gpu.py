"""Batches on a GPU: lanes per second, beside `simulate_batch` on this machine's CPU and diffrax on the card, and how
far both devices are apart."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import vmri_jax as vm
from benchmarks.instructions import double_pendulum
from benchmarks.measure import Tell, exactly, silent
from benchmarks.programs import problem
from benchmarks.report import Claim, Report
from benchmarks.worker import starts
from vmri_jax.running.timing import least_seconds

T_END = 1.0
COMPARED = 256
"""Lanes whose ends are compared between devices and with a reference."""
GRADIENT_LANES = 1000
APART = 1e-9
"""Largest difference of positions between CPU and GPU, relative to the largest position.

Sums are taken in another order there.
"""
FINER = 8
"""Steps of the reference over steps of the run.

At order 2 the error of the reference is a sixty-fourth of the error of the run.
"""
TOLERANCES = 10.0 ** -np.arange(2.0, 12.0)
"""Of diffrax: the loosest one that is as accurate as our run is timed."""


@dataclass(frozen=True)
class System:
    """A problem with the step that its batches take.

    num_steps: macro steps to `T_END`.
    acceleration: ``a(q, v)`` with all constraints and masses eliminated by hand, for diffrax; None where it is not
        written.
    """

    name: str
    problem: vm.Problem
    scheme: vm.Scheme
    num_steps: int
    acceleration: Callable | None

    @property
    def run(self) -> dict[str, Any]:
        """Arguments of `simulate`; without the fallback, which every lane would compute."""
        steps = {"macro_dt": T_END / self.num_steps, "num_steps": self.num_steps, "save": self.num_steps}
        return {**steps, "solver": vm.plan(self.problem, self.scheme).first}

    def end(self, state: vm.State):
        """Positions (n,) at the end."""
        run = vm.simulate(self.problem.system, self.scheme, state, **self.run)
        return jnp.concatenate([run.q_s[-1], run.q_f[-1]])

    def gradient(self, state: vm.State):
        """Of the sum of squares of the end by the start."""
        return jax.grad(lambda state: jnp.sum(self.end(state) ** 2))(state)


def by_angles(q, v):
    """Accelerations of the double pendulum, its 2 x 2 mass matrix inverted by hand."""
    sine, cosine = jnp.sin(q[0] - q[1]), jnp.cos(q[0] - q[1])
    right = jnp.stack(
        [
            -sine * v[1] ** 2 / 2 - 9.81 * 2 * jnp.sin(q[0]),
            sine * v[0] ** 2 / 2 - 9.81 / 2 * jnp.sin(q[1]) - 50 * jnp.sin(q[1]),
        ]
    )
    determinant = 2 / 4 - cosine**2 / 4
    return jnp.stack([right[0] / 4 - cosine / 2 * right[1], 2 * right[1] - cosine / 2 * right[0]]) / determinant


def of_peers(name: str) -> Callable | None:
    """The accelerations that the peers get, see `benchmarks.peers`."""
    from benchmarks.peers import cases, equations  # their data are not needed to import this module

    return equations.acceleration(cases.case(f"{name} t=1"))


def systems_of(names: tuple[str, ...]) -> Iterator[System]:
    """The systems with these names.

    Long steps of high degree suit a card: kernels of a step start one after the other, for any number of lanes.
    """
    if "FPU" in names:
        yield System("FPU", problem("FPU l=3"), vm.fully_explicit(10), 100, of_peers("FPU l=3"))
    if "TSP" in names:
        yield System("TSP", problem("TSP"), vm.galerkin(1, 6), 32, of_peers("TSP"))
    if "double pendulum" in names:
        yield System("double pendulum", double_pendulum(), vm.galerkin(1, 3), 24, by_angles)


@dataclass(frozen=True)
class Size:
    """How much is run."""

    systems: tuple[str, ...]
    lanes: tuple[int, ...]
    repeats: int


def sizes(name: str) -> Size:
    """ "quick" or "full"."""
    names = "FPU", "TSP", "double pendulum"
    return Size(names, (1000, 10_000) if name == "quick" else (1000, 10_000, 100_000, 1_000_000), 3)


def devices() -> tuple[Any, Any]:
    """The accelerator, or the CPU where there is none, and the CPU."""
    return jax.devices()[0], jax.devices("cpu")[0]


def run(size: Size, name: str, tell: Tell = silent) -> Iterator[Report]:
    """Measure all of it, a report after each system."""
    accelerator, _ = devices()
    report = Report("gpu", name, notes=[f"accelerator: {accelerator.device_kind}"])
    if accelerator.platform == "cpu":
        report.note("JAX sees no accelerator here: the rows of the device are of the CPU")
    for system in systems_of(size.systems):
        _measure(system, size, report, tell)
        yield report


def _measure(system: System, size: Size, report: Report, tell: Tell) -> None:
    accelerator, cpu = devices()
    with jax.default_device(cpu):
        few = starts(system.problem, max(COMPARED, min(size.lanes)))
        compared = jax.tree.map(lambda a: a[:COMPARED], few)
        finer = replace(system, num_steps=FINER * system.num_steps)
        reference = jax.jit(jax.vmap(finer.end))(compared)
    ends, gradients = jax.jit(jax.vmap(system.end)), jax.jit(jax.vmap(system.gradient))
    here = ends(jax.device_put(compared, cpu))
    error = float(jnp.max(jnp.abs(here - reference)))

    def row(program: str, device: Any, lanes: int, run: Callable[[], Any], **more) -> None:
        tell(f"{system.name}, {program}, {device.device_kind}, {lanes} lanes")
        jax.block_until_ready(run())  # compiled
        rate = lanes / least_seconds([run], size.repeats)[0]
        row = {"system": system.name, "program": program, "device": device.device_kind, "lanes": lanes}
        report.rows.append(row | {"lanes/s": rate} | more)

    there = np.asarray(ends(jax.device_put(compared, accelerator)))
    apart = float(np.max(np.abs(there - np.asarray(here))) / np.max(np.abs(here)))
    for lanes in size.lanes:
        states = jax.device_put(_repeated(few, lanes), accelerator)
        row("run", accelerator, lanes, partial(ends, states), error=error, apart=apart)
    states = jax.device_put(_repeated(few, GRADIENT_LANES), accelerator)
    row("gradient", accelerator, GRADIENT_LANES, partial(gradients, states))
    with jax.default_device(cpu):
        lanes = min(size.lanes)
        many, step = _repeated(few, lanes), {k: v for k, v in system.run.items() if k != "solver"}
        batch = partial(vm.simulate_batch, system.problem.system, system.scheme, many, **step)
        row("simulate_batch", cpu, lanes, lambda: batch().q_f, error=error)
    for lanes, run, peer_error in _diffrax(system, few, size.lanes, reference, error, accelerator):
        row("diffrax Dopri8", accelerator, lanes, run, error=peer_error)
    report.claims.append(Claim(f"{system.name}: CPU and device apart", exactly(apart), APART))


def _repeated(states: vm.State, lanes: int) -> vm.State:
    """As many lanes as are asked for, the same ones again and again."""
    return jax.tree.map(lambda a: jnp.asarray(np.resize(np.asarray(a), (lanes, *a.shape[1:]))), states)


def _diffrax(system: System, few: vm.State, counts: tuple[int, ...], reference, error: float, device: Any):
    """Batches of diffrax at the loosest tolerance that is as accurate; nothing if it is not installed."""
    try:
        import diffrax  # pyright: ignore[reportMissingImports]

        from benchmarks.peers import diffrax as peer
    except ImportError:
        return
    accelerations = SimpleNamespace(acceleration=lambda _: system.acceleration)
    solve = peer.solution(SimpleNamespace(t_end=T_END), diffrax.Dopri8(), accelerations)  # pyright: ignore
    many = jax.jit(jax.vmap(solve, in_axes=(0, None)))

    def start(lanes: int):
        states = _repeated(few, lanes)
        v_s, v_f = jax.vmap(partial(vm.diagnostics.velocity, system.problem.system))(
            states.q_s, states.q_f, states.p_s, states.p_f
        )
        pair = jnp.concatenate([states.q_s, states.q_f], axis=1), jnp.concatenate([v_s, v_f], axis=1)
        return jax.device_put(pair, device)

    compared = start(COMPARED)
    errors = {tol: float(jnp.max(jnp.abs(many(compared, tol) - reference))) for tol in map(float, TOLERANCES)}
    accurate = [tol for tol, found in errors.items() if found <= error]
    if accurate:
        for lanes in counts:
            yield lanes, partial(many, start(lanes), accurate[0]), errors[accurate[0]]
