"""The physics: what a user writes, as plain JAX functions of slow and fast variables."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.arrays import is_concrete, real_array


class ConstantMass(eqx.Module):
    """Kinetic energy ``T = v_s^T M_s v_s / 2 + v_f^T M_f v_f / 2`` with constant masses.

    Args:
        slow, fast: (n,) masses per coordinate, or an (n, n) symmetric positive definite mass matrix.

    Raises:
        ValueError: a mass that is not positive, or a matrix that is not symmetric positive definite.
    """

    slow: Any
    fast: Any

    def __init__(self, slow, fast):
        self.slow, self.fast = _mass("slow", slow), _mass("fast", fast)

    def __call__(self, q_s, q_f, v_s, v_f, params):
        return (jnp.sum(v_s * _times(self.slow, v_s)) + jnp.sum(v_f * _times(self.fast, v_f))) / 2

    def momentum(self, v_s, v_f):
        """``(M_s v_s, M_f v_f)``, over any leading axes."""
        return _times(self.slow, v_s), _times(self.fast, v_f)

    def velocity(self, p_s, p_f):
        """``(M_s^-1 p_s, M_f^-1 p_f)``, over any leading axes."""
        return _solve(self.slow, p_s), _solve(self.fast, p_f)


def _times(mass, v):
    return mass * v if mass.ndim == 1 else v @ mass


def _solve(mass, p):
    return p * (1 / mass) if mass.ndim == 1 else jnp.linalg.solve(mass, p[..., None])[..., 0]


def _mass(name: str, mass):
    mass = jnp.asarray(real_array(f"ConstantMass: {name}", mass))
    if mass.ndim not in (1, 2) or (mass.ndim == 2 and mass.shape[0] != mass.shape[1]):
        raise ValueError(f"ConstantMass: {name} has shape {mass.shape}; give (n,) masses or an (n, n) mass matrix.")
    if not is_concrete(mass):
        return mass
    values = np.asarray(mass)
    if not np.all(np.isfinite(values)):
        raise ValueError(f"ConstantMass: {name} = {values} is not finite.")
    if mass.ndim == 1 and np.any(values <= 0):
        raise ValueError(f"ConstantMass: {name} = {values}; every mass must be positive.")
    if mass.ndim == 2 and (not np.allclose(values, values.T) or np.any(np.linalg.eigvalsh(values) <= 0)):
        raise ValueError(f"ConstantMass: {name} must be a symmetric positive definite matrix.")
    return mass


class KineticFunction(eqx.Module):
    """Kinetic energy given by a function ``kinetic(q_s, q_f, v_s, v_f, params) -> ()``."""

    function: Callable = eqx.field(static=True)

    def __call__(self, q_s, q_f, v_s, v_f, params):
        return self.function(q_s, q_f, v_s, v_f, params)


@dataclasses.dataclass(frozen=True)
class Rheonomic:
    """A holonomic constraint that depends on time: a function with the time as its first argument.

        System(..., constraint=Rheonomic(guided))  # guided(t, q_s, q_f, params) -> (n_g,)

    Its hidden constraint is ``G v + dg/dt = 0``. It does work: energy is not kept.

    Raises:
        TypeError: function is no function.
    """

    function: Callable

    def __post_init__(self):
        if not callable(self.function):
            raise TypeError(f"Rheonomic: function is {self.function!r}; give a function of (t, q_s, q_f, params).")


class System(eqx.Module):
    """Mechanical system with Lagrangian ``L = T - V - W``, constraints ``g = 0`` and forces ``F``.

    Args:
        kinetic: `ConstantMass`, or ``kinetic(q_s, q_f, v_s, v_f, params) -> ()``, regular in the velocities.
        slow_potential: ``V(q_s, q_f, params) -> ()``.
        fast_potential: ``W(q_f, params) -> ()``.
        constraint: ``g(q_s, q_f, params) -> (n_g,)``, holonomic, involving fast variables.
        slow_constraint: ``g_s(q_s, params) -> (n_gs,)``, holonomic, of slow variables alone. Constraints that depend on
            time are given as `Rheonomic` functions.
        force: ``F(t, q_s, q_f, v_s, v_f, params) -> (F_s, F_f)``, not derived from a potential.
        params: any pytree of arrays, handed to every function; traced, so that sweeps and gradients over it
            never recompile.

    Functions are compared by identity: define them at module level (not inside a loop) and pass what varies
    through `params`, and everything is compiled once.
    """

    kinetic: ConstantMass | KineticFunction
    slow_potential: Callable | None = eqx.field(static=True, default=None)
    fast_potential: Callable | None = eqx.field(static=True, default=None)
    constraint: Callable | Rheonomic | None = eqx.field(static=True, default=None)
    slow_constraint: Callable | Rheonomic | None = eqx.field(static=True, default=None)
    force: Callable | None = eqx.field(static=True, default=None)
    params: Any = None

    def __init__(
        self,
        kinetic,
        slow_potential=None,
        fast_potential=None,
        constraint=None,
        slow_constraint=None,
        force=None,
        params=None,
    ):
        functions = {
            "slow_potential": slow_potential,
            "fast_potential": fast_potential,
            "constraint": constraint,
            "slow_constraint": slow_constraint,
            "force": force,
        }
        for name, function in functions.items():
            timed = isinstance(function, Rheonomic) and name in ("constraint", "slow_constraint")
            if function is not None and not callable(function) and not timed:
                raise TypeError(f"System: {name} is {function!r}; it must be a function or None.")
            _check_hash(name, function)
            setattr(self, name, function)
        if not isinstance(kinetic, ConstantMass | KineticFunction):
            if not callable(kinetic):
                raise TypeError(
                    f"System: kinetic is {kinetic!r}; give ConstantMass(slow, fast) or a function "
                    "kinetic(q_s, q_f, v_s, v_f, params)."
                )
            _check_hash("kinetic", kinetic)
            kinetic = KineticFunction(kinetic)
        self.kinetic = kinetic
        self.params = params

    def replace(self, **changes) -> "System":
        """The same system with some fields changed, e.g. ``system.replace(params=new)``."""
        return dataclasses.replace(self, **changes)

    def g(self, t, q_s, q_f):
        """Values of `constraint`, shape (n_g,); n_g = 0 where there is none."""
        return _constrain(self.constraint, t, q_s, q_f, self.params)

    def g_slow(self, t, q_s):
        """Values of `slow_constraint`, shape (n_gs,); n_gs = 0 where there is none."""
        return _constrain(self.slow_constraint, t, q_s, self.params)

    @property
    def is_constrained(self) -> bool:
        """Whether there are constraints."""
        return not (self.constraint is self.slow_constraint is None)

    @property
    def is_rheonomic(self) -> bool:
        """Whether constraints depend on time."""
        return any(isinstance(function, Rheonomic) for function in (self.constraint, self.slow_constraint))

    def forces(self, t, q_s, q_f, v_s, v_f):
        """Values of `force`, ``(F_s, F_f)``; zero where there is none."""
        if self.force is None:
            return jnp.zeros_like(q_s), jnp.zeros_like(q_f)
        return self.force(t, q_s, q_f, v_s, v_f, self.params)

    def constraints(self, t, q_s, q_f):
        """All constraint values at one configuration, ``(g, g_slow)`` joined, shape (n_g + n_gs,)."""
        return jnp.concatenate([self.g(t, q_s, q_f), self.g_slow(t, q_s)])

    def constraint_rates(self, t, q_s, q_f, v_s, v_f):
        """Rates of all constraint values, ``G v + dg/dt``, shape (n_g + n_gs,)."""
        if self.is_rheonomic:
            return jax.jvp(self.constraints, (t, q_s, q_f), (jnp.ones_like(t), v_s, v_f))[1]
        return jax.jvp(partial(self.constraints, t), (q_s, q_f), (v_s, v_f))[1]

    def num_constraints(self, q_s, q_f) -> tuple[int, int]:
        """``(n_g, n_gs)`` for configurations of these shapes."""
        t = jnp.zeros(())
        return jax.eval_shape(self.g, t, q_s, q_f).shape[0], jax.eval_shape(self.g_slow, t, q_s).shape[0]


def with_time(function, t, *arguments):
    """A constraint as a plain function and its arguments, the time the first of them if it is `Rheonomic`."""
    return (function.function, (t, *arguments)) if isinstance(function, Rheonomic) else (function, arguments)


def _constrain(function, t, *arguments):
    if function is None:
        return jnp.zeros(0)
    function, arguments = with_time(function, t, *arguments)
    return function(*arguments)


def _check_hash(name: str, function) -> None:
    try:
        hash(function)
    except TypeError:
        raise TypeError(
            f"System: {name} is {function!r}, which has no hash: programs are compiled once per function. Give a plain "
            "function, with what varies in params."
        ) from None
