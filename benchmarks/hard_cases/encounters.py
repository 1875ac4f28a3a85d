"""Stiff contact, points that nearly coincide, a close encounter, three time scales."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import vmri_jax as vm
from benchmarks.hard_cases import hard_case
from benchmarks.hard_cases.systems import bouncing_ball, three_scales, two_body
from vmri_jax.hard_cases import Outcome
from vmri_jax.hard_cases.measures import energy, long_run, run, status
from vmri_jax.running.timing import interleaved


@hard_case("stiff penalty contact")
def penalty_contact(full: bool) -> Outcome:
    """ball on a floor of k = 1e8, 100 bounces, num_micro 20, H = 1e-4

    height within 1 %, no energy jump above 1e-3
    """
    problem, macro_dt, bounces = bouncing_ball(), 1e-4, 100 if full else 3
    period = 2 * np.sqrt(2 * 1.0 / 9.81)
    steps = int((bounces + 0.5) * period / macro_dt) // 20 * 20
    heights, jumps, lost = [], [], []
    for scheme in (vm.fully_explicit(20), vm.fully_implicit(20)):
        trajectory = run(problem, scheme, macro_dt, steps, save=2)  # a contact takes 4.5 steps
        z, e = np.asarray(trajectory.q_f)[:, 0], np.asarray(trajectory.energy) / float(trajectory.energy[0])
        flying = z > 1e-3  # contact sinks in by 4e-4
        flights = np.split(np.arange(len(z)), np.flatnonzero(np.diff(flying.astype(int))) + 1)
        flights = [f for f in flights if flying[f[0]] and len(f) > 10]
        level = np.array([e[f].mean() for f in flights])
        heights.append(max(abs(z[f].max() - 1) for f in flights[1:-1]))
        jumps.append(np.abs(np.diff(level)).max())
        lost.append(abs(level[-1] - level[0]))
    return Outcome(
        f"{bounces} bounces, omega h = 0.05: height within {max(heights):.1e}, largest jump of the relative energy at "
        f"a bounce {jumps[0]:.1e} (explicit), {jumps[1]:.1e} (implicit)",
        max(heights) < 0.01 and max(jumps) < 1e-3,
        {"height": max(heights), "jump_explicit": jumps[0], "jump_implicit": jumps[1], "lost": max(lost)},
    )


@hard_case("norm at zero")
def norm_at_zero(full: bool) -> Outcome:
    """triple pendulum with l_3 = 0.01, points 1e-2 to 1e-8 apart, and coincident

    finite gradients; coincident points fail plainly
    """
    problem = vm.systems.triple_spherical_pendulum(lengths=(10.0, 2.0, 0.01))
    steps, scheme, solver = 500 if full else 50, vm.fully_explicit(2), vm.Solver("masses")

    @jax.jit
    @partial(jax.jacfwd, has_aux=True)
    def reached(stiffness, state):
        system = problem.system.replace(params=problem.system.params | {"stiffness": stiffness})
        run = vm.simulate(system, scheme, state, macro_dt=1e-3, num_steps=steps, save=steps, solver=solver)
        return run.q_f[-1], run

    values, said = {}, []
    for distance in (1e-2, 1e-4, 1e-8, 0.0):
        q_f = jnp.array([10.0, 2.0, 0.0, 10.0, 2.0, 0.0]).at[5].add(distance)
        v_f = jnp.array([0.0, 1.0, 0.0, 0.0, 1.0, 0.5 if distance else 0.0])  # coincident points: also at rest
        state = vm.Problem(problem.system, problem.q_s, q_f, problem.v_s, v_f, project=True).state()
        gradient, trajectory = reached(problem.system.params["stiffness"], state)
        largest = float(jnp.max(jnp.abs(gradient)) * problem.system.params["stiffness"])
        values[f"gradient_{distance:g}"] = largest if trajectory.success else np.nan
        said.append(
            f"{largest:.2g} ({distance:g} apart)" if trajectory.success else f"{status(trajectory)} ({distance:g})"
        )
    zero = values.pop("gradient_0")
    return Outcome(
        f"derivative of the positions with respect to log k, largest entry: {', '.join(said)}",
        np.isfinite(list(values.values())).all() and np.isnan(zero),
        values,
    )


@hard_case("close encounter")
def close_encounter(full: bool) -> Outcome:
    """two bodies, e = 0.9, centre of mass in a trap

    relative energy error below 1e-5 at a stated cost
    """
    problem, orbits = two_body(0.9), 100 if full else 5
    settings = {
        "impulse, kahan-li8": (vm.compose(vm.fully_explicit(10), "kahan-li8"), 200),
        "impulse": (vm.fully_explicit(10), 200),
    }
    values, said = {}, []
    for name, (scheme, per_orbit) in settings.items():
        trajectory = long_run(problem, scheme, 2 * np.pi / per_orbit, orbits * per_orbit)
        values[name] = energy(trajectory, 1, abs(float(trajectory.energy[0]))).band
        seconds = min(interleaved({"": lambda s=scheme, n=per_orbit: run(problem, s, 2 * np.pi / n, 5 * n).q_f}, 3)[""])
        said.append(f"{name} {values[name]:.1e} at {per_orbit} steps, {seconds / 5 * 1e6:.0f} us an orbit")
    return Outcome(f"relative energy error: {'; '.join(said)}", values["impulse, kahan-li8"] < 1e-5, values)


@hard_case("three scales")
def three_time_scales(full: bool) -> Outcome:
    """FPU chain with omega = 50, 70, 5000, fully_implicit, h = 0.02, t = 50

    stable at omega_3 h = 100; I_1, I_2 within 0.05 of a resolved run
    """
    problem, omega = three_scales(), np.array([50.0, 70.0, 5000.0])
    coarse = run(problem, vm.fully_implicit(5), 0.1, 500)  # omega_3 h = 100
    fine = run(problem, vm.fully_explicit(100), 0.01, 5000, save=10)  # omega_3 h = 0.5
    actions = [np.asarray(vm.diagnostics.oscillatory_energies(omega, r.q_f, r.p_f)) for r in (coarse, fine)]
    at_end = np.abs(actions[0][-1] - actions[1][-1])
    third = actions[0][:, 2].max()
    return Outcome(
        f"omega_3 h = 100: {status(coarse)}; at t = 50 I_1, I_2 within {at_end[0]:.3f}, {at_end[1]:.3f} of the "
        f"resolved run, I_3 stays below {third:.0e}",
        coarse.success and at_end[:2].max() < 0.05 and third < 0.05,
        {"I_1": at_end[0], "I_2": at_end[1], "I_3": third},
    )
