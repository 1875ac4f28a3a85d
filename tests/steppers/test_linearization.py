"""The Newton matrix, factored interval by interval, against the derivative of the whole residual, on a system with
everything in it."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from benchmarks.gail2014.dense import newton_direction
from tests.support import relative_difference
from tests.user_systems import bent_system
from vmri_jax import Scheme, explicit_slow, fully_explicit, fully_implicit, galerkin, macro, micro, quadrature
from vmri_jax.schemes.equations import StepEquations
from vmri_jax.schemes.intervals import Intervals
from vmri_jax.steppers.implicit import solve
from vmri_jax.steppers.march import MarchEquations, linearised_pass
from vmri_jax.steppers.null_space import inverse_with_multipliers, inverse_without_multipliers

SCHEMES = {
    "fully implicit": fully_implicit(3),
    "explicit slow": explicit_slow(3, 0.3),
    "fully explicit": fully_explicit(3, 0.3),
    "one micro step": fully_implicit(1),
    "macro gauss": Scheme(
        3, kinetic=micro(quadrature.midpoint), slow=macro(quadrature.gauss(2)), fast=micro(quadrature.simpson)
    ),
    "gauss 2": galerkin(3, 2),
    "lobatto 2": galerkin(3, 2, "lobatto"),
    "gauss 3, macro": Scheme(
        2,
        3,
        kinetic=micro(quadrature.gauss(3)),
        slow=macro(quadrature.gauss(2)),
        fast=micro(quadrature.affine(0.2)),
        force=micro(quadrature.lobatto(4)),
    ),
}


def equations_and_unknowns(scheme):
    rng = np.random.default_rng(3)
    q_s, q_f, p_s, p_f = rng.normal(size=(4, 3))
    equations = StepEquations(bent_system(), scheme, 0.4, q_s, q_f, p_s, p_f, 0.3)
    guess = jax.device_get(jax.jit(StepEquations.guess)(equations, 0.5 * p_s, 0.5 * p_f, np.ones(2), np.ones(1)))
    return equations, jax.tree.map(lambda x: x + 0.1 * rng.normal(size=x.shape), guess)


SIMILAR = ("fully implicit", "explicit slow", "one micro step", "macro gauss", "gauss 2", "lobatto 2")
"""Their blocks are those of others: V on the macro and W on the micro grid, Gauss and Lobatto rules of a higher
degree."""


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.full if n in SIMILAR else ()) for n in SCHEMES])
def test_all_take_the_direction_of_the_derivative_of_the_residual(name):
    """That is the dense one: a wrong block would turn it."""
    equations, x = equations_and_unknowns(SCHEMES[name])

    @jax.jit
    def directions(x):
        residual, _ = Intervals(equations).residual(x)
        found = {"dense": ravel_pytree(newton_direction(equations, x, residual))[0]}
        for inverted in (inverse_with_multipliers, inverse_without_multipliers):
            march = MarchEquations(equations, inverted)
            z, of_intervals = march.flat(x)
            at_x = z, of_intervals, of_intervals[-1]
            matrices, _, by_positions = linearised_pass(march, *at_x, from_last=False, corrects=False)
            direction = solve(march, (matrices, by_positions), *march.flat(residual))
            found[inverted.__name__] = ravel_pytree(march.by_name(*direction))[0]
        return found

    found = directions(x)
    for direction in found.values():
        assert relative_difference(direction, found["dense"]) < 5e-14  # measured 4.9e-15


def test_the_masses_at_the_start_stand_in_for_a_kinetic_energy():
    """Matrices of the masses are the exact ones of the system with ``v^T M v / 2`` in place of T, M at the start of the
    step."""
    equations, x = equations_and_unknowns(SCHEMES["gauss 2"])
    q_s, q_f, n_s = equations.q_s, equations.q_f, equations.q_s.size
    v = np.concatenate([x.slow[-1] / equations.macro_dt, x.fast[0, -1] / equations.micro_dt])
    mass = jax.jit(jax.hessian(lambda v: equations.system.kinetic_energy(q_s, q_f, v[:n_s], v[n_s:])))(v)

    def energy(q_s, q_f, v_s, v_f, params):
        v = jnp.concatenate([v_s, v_f])
        return v @ mass @ v / 2

    equations = replace(equations, masses=mass)
    constant = replace(equations, system=equations.system.replace(kinetic=energy, slow_kinetic=None))

    def matrices(march):
        z, of_intervals = march.flat(x)
        return linearised_pass(march, z, of_intervals, of_intervals[-1], from_last=False, corrects=False)[0]

    masses, exact = jax.jit(
        lambda: (matrices(MarchEquations(equations).by_masses()), matrices(MarchEquations(constant)))
    )()
    for of_masses, of_constant in zip(masses, exact, strict=True):
        np.testing.assert_allclose(of_masses, of_constant, atol=1e-13 * np.abs(of_constant).max())
