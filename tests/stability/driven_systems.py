"""Twelve driven or moving systems: what is said about them, and what a run of a thousand periods does,
``python -m tests.stability.driven_systems``."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

import vmri_jax as vm
from tests.support import until_failure

NONE = np.zeros(0)
PERIODS = 1000
"""Periods of the drive, of the orbit, of the spin or of the vibration in a run."""


@dataclass(frozen=True)
class Driven:
    """A system, its period, macro steps in a period, and whether its motion and a run with these steps stay bounded."""

    problem: vm.Problem
    period: float
    steps: float
    stable: bool
    stable_run: bool
    scheme: vm.Scheme

    @property
    def macro_dt(self) -> float:
        return self.period / self.steps

    def largest(self) -> float:
        """Largest position in a run of `PERIODS` periods over that in its first ten periods; infinite if the run
        fails."""
        steps = round(PERIODS * self.steps)
        run = until_failure(self.problem, self.scheme, macro_dt=self.macro_dt, num_steps=steps)
        away = np.abs(np.concatenate([run.states.q_s - run.states.q_s[0], run.states.q_f - run.states.q_f[0]], axis=1))
        away = away[:, :2]  # the third coordinate of the top turns
        return float(away.max() / away[: round(10 * self.steps)].max()) if run.success else np.inf


def parametric(t, q_s, q_f, v_s, v_f, params):
    """``x'' = -(a - 2 q cos 2 t) x + f cos 2 t``: Mathieu, with a force."""
    return q_s, -(params["a"] - 2 * params["q"] * jnp.cos(2 * t)) * q_f + params["f"] * jnp.cos(2 * t)


def mathieu(a, q, f=0.0, *, steps=32.0, stable=True) -> Driven:
    params = {name: np.asarray(x) for name, x in {"a": a, "q": q, "f": f}.items()}
    system = vm.System(vm.ConstantMass(NONE, [1.0]), force=parametric, params=params)
    return Driven(vm.Problem(system, NONE, [1e-3]), np.pi, steps, stable, stable, vm.fully_explicit(1))


MASS, TURNS, STRENGTH, WZ = 40.0, 2 * np.pi * 20.0, 138935.0, np.pi
HALF = (2 * STRENGTH / (MASS * WZ**2)) ** (1 / 3) / 2


def coulomb_and_trap(q_s, q_f, params):
    x = q_f.reshape(2, 3)
    soft = jnp.sum(x[:, 2] ** 2 - 0.5 * x[:, 0] ** 2 - 0.5 * x[:, 1] ** 2)
    return STRENGTH / jnp.linalg.norm(x[1] - x[0]) + MASS / 2 * WZ**2 * soft


def radio_frequency(t, q_s, q_f, v_s, v_f, params):
    return q_s, -MASS * TURNS**2 / 2 * params["q"] * jnp.cos(TURNS * t) * q_f * jnp.tile(jnp.array([1.0, -1, 0]), 2)


def paul_trap(q, steps, stable, stable_run) -> Driven:
    """Two ions of mass 40 in a trap of 20 MHz, in micrometres and microseconds."""
    masses = vm.ConstantMass(NONE, jnp.full(6, MASS))
    system = vm.System(masses, coulomb_and_trap, force=radio_frequency, params={"q": np.asarray(q)})
    start = [1.0, 0.5, -HALF, -0.7, 0.3, 1.05 * HALF]
    return Driven(vm.Problem(system, NONE, start), 0.05, steps, stable, stable_run, vm.fully_explicit(1))


def pivot_in_motion(t, q_s, q_f, v_s, v_f, params):
    """A pendulum of unit length at the angle q_f from straight up, on a pivot that moves by ``a cos(40 t)``."""
    return q_s, (9.81 - params["a"] * 1600 * jnp.cos(40 * t)) * jnp.sin(q_f)


def kapitza(a, stable) -> Driven:
    """Up it stands where ``a^2 1600 > 2 g``: a above 0.111."""
    masses = vm.ConstantMass(NONE, [1.0])
    system = vm.System(masses, force=pivot_in_motion, params={"a": np.asarray(a)})
    return Driven(vm.Problem(system, NONE, [0.05]), 2 * np.pi / 40, 40, stable, stable, vm.fully_explicit(1))


def weight(q_s, q_f, params):
    return 9.81 * q_f[1]


def rod_in_the_lift(t, q_s, q_f, params):
    """A rod of unit length that hangs on a lift, which swings by ``0.1 cos(omega t)``."""
    return jnp.array([q_f[0] ** 2 + (q_f[1] - 0.1 * jnp.cos(params["omega"] * t)) ** 2 - 1.0]) / 2


def lift(omega, stable) -> Driven:
    """The pendulum has frequency 3.13; a lift of twice this frequency makes it swing."""
    params = {"omega": np.asarray(omega)}
    system = vm.System(
        vm.ConstantMass(NONE, [1.0, 1.0]), weight, constraint=vm.Rheonomic(rod_in_the_lift), params=params
    )
    start = [0.001, 0.1 - np.sqrt(1 - 1e-6)]
    return Driven(vm.Problem(system, NONE, start), 2 * np.pi / omega, 32, stable, stable, vm.fully_implicit(1))


def gravity(q_s, q_f, params):
    return -1.0 / jnp.linalg.norm(q_f)


def moon() -> Driven:
    problem = vm.Problem(vm.System(vm.ConstantMass(NONE, [1.0, 1.0]), gravity), NONE, [1.0, 0.0], None, [0.0, 1.1])
    return Driven(problem, 2 * np.pi * (2 - 1.21) ** -1.5, 200, True, True, vm.fully_explicit(1))


def turning(q_s, q_f, v_s, v_f, params):
    """A heavy top with moments A = 1 and C = 0.5, tilted by the angles q_f[0] and q_f[1] and turned by q_f[2]."""
    across = v_f[0] ** 2 * jnp.cos(q_f[1]) ** 2 + v_f[1] ** 2
    return (across + 0.5 * (v_f[2] + v_f[0] * jnp.sin(q_f[1])) ** 2) / 2


def height(q_s, q_f, params):
    return jnp.cos(q_f[0]) * jnp.cos(q_f[1])


def top(spin=5.0) -> Driven:
    """It sleeps where ``C^2 spin^2 > 4 A``: above a spin of 4."""
    problem = vm.Problem(vm.System(turning, height), NONE, [1e-3, 0.0, 0.0], None, [0.0, 0.0, spin])
    return Driven(problem, 2 * np.pi / spin, 32, True, True, vm.fully_implicit(1))


def links(q_s, q_f, params):
    return jnp.sum((q_f[:2] - q_s) ** 2) + jnp.sum((q_f[2:] - q_s) ** 2) + jnp.sum(q_s**2) / 2


def bonds(q_f, params):
    return 200 * jnp.sum(q_f**2)


def pumped(t, q_s, q_f, v_s, v_f, params):
    """The stiffness of the slow springs to the ground changes in time."""
    return -params["depth"] * jnp.cos(params["omega"] * t) * q_s, jnp.zeros_like(q_f)


def chain(omega, stable) -> Driven:
    """Two slow and four fast coordinates; the slow ones have frequency 2.23 and are pumped at twice that, or beside
    it."""
    params = {"depth": np.asarray(1.0), "omega": jnp.asarray(omega)}
    masses = vm.ConstantMass([1.0, 1.0], [1.0, 1.0, 1.0, 1.0])
    system = vm.System(masses, links, bonds, force=pumped, params=params)
    problem = vm.Problem(system, [1e-3, 1e-3], [1e-4, -1e-4, 0.0, 0.0])
    return Driven(problem, 2 * np.pi / omega, 24, stable, stable, vm.explicit_slow(5))


def hanging(q_s, q_f, params):
    return -jnp.sin(q_f[0])


def control() -> Driven:
    """An undriven pendulum that hangs."""
    problem = vm.Problem(vm.System(vm.ConstantMass(NONE, [1.0]), hanging), NONE, [np.pi / 2 + 1e-9])
    return Driven(problem, 2 * np.pi, 32, True, True, vm.fully_explicit(1))


SYSTEMS = {
    "Paul trap, q = 0.25, 2 steps": lambda: paul_trap(0.25, 2.0, True, False),
    "Paul trap, q = 0.25, 10 steps": lambda: paul_trap(0.25, 10.0, True, True),
    "Paul trap, q = 1, 40 steps": lambda: paul_trap(1.0, 40.0, False, False),
    "Kapitza's pendulum up, a = 0.15": lambda: kapitza(0.15, True),
    "Kapitza's pendulum up, a = 0.1": lambda: kapitza(0.1, False),
    "Mathieu, first tongue": lambda: mathieu(1.0, 0.2, stable=False),
    "Mathieu, second tongue": lambda: mathieu(4.1, 1.0, stable=False),
    "Mathieu, between, 32.5 steps": lambda: mathieu(2.5, 0.3, steps=32.5),
    "moon on its orbit": moon,
    "spinning top": top,
    "pendulum in a lift, omega = 10": lambda: lift(10.0, True),
    "pendulum in a lift, twice its frequency": lambda: lift(2 * 9.81**0.5, False),
    "parametric chain, beside": lambda: chain(3.0, True),
    "parametric chain, twice its frequency": lambda: chain(2 * 4.95**0.5, False),
    "driven oscillator": lambda: mathieu(2.5, 0.0, 1.0),
    "pendulum, not driven": control,
}


def main() -> None:
    for name, make in SYSTEMS.items():
        driven = make()
        print(f"\n{name}: macro_dt = {driven.macro_dt:.4g}, motion {'stable' if driven.stable else 'unstable'}")
        print(vm.advise(driven.problem, driven.scheme, macro_dt=driven.macro_dt))
        print(
            f"run of {PERIODS} periods: largest position {driven.largest():.3g} times that of the first 10", flush=True
        )


if __name__ == "__main__":
    vm.configure()
    main()
