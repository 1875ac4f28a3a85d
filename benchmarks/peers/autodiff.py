"""Equations of motion by automatic differentiation of the Lagrangian and the constraints that ours is given:

    [M  G^T] [  a   ]   [ -grad(V + W)     ]
    [G   0 ] [lambda] = [ -(d/dt G) v      ]

with G the Jacobian of the constraints.
"""

import jax
import jax.numpy as jnp

from benchmarks.peers.cases import Case


def acceleration(case: Case):
    """``a(q, v)``, arrays (n,), slow coordinates first."""
    system, n_s = case.problem.system, case.problem.q_s.size
    mass = jax.hessian(lambda v: kinetic(case, v))(jnp.asarray(case.v))
    force = jax.grad(lambda q: -potential(case, q))

    def constraints(q):
        return system.constraints(0.0, q[:n_s], q[n_s:])

    def centripetal(q, v):
        """``(d/dt G) v``: the second derivative of the constraints in the direction of v."""
        return jax.jvp(lambda q: jax.jvp(constraints, (q,), (v,))[1], (q,), (v,))[1]

    def free(q, v):
        return force(q) / jnp.diagonal(mass)

    def held(q, v):
        g = jax.jacfwd(constraints)(q)
        matrix = jnp.block([[mass, g.T], [g, jnp.zeros((len(g), len(g)))]])
        return jnp.linalg.solve(matrix, jnp.concatenate([force(q), -centripetal(q, v)]))[: q.size]

    return held if system.is_constrained else free


def potential(case: Case, q):
    """``V + W``."""
    system, (q_s, q_f) = case.problem.system, jnp.split(q, [case.problem.q_s.size])
    slow = 0.0 if system.slow_potential is None else system.slow_potential(q_s, q_f, system.params)
    return slow + (0.0 if system.fast_potential is None else system.fast_potential(q_f, system.params))


def kinetic(case: Case, v):
    """T at the positions of the start; masses are constant."""
    system, splits = case.problem.system, [case.problem.q_s.size]
    return system.kinetic_energy(*jnp.split(case.q, splits), *jnp.split(v, splits))


def energy(case: Case) -> float:
    """Of the start, from the functions that are differentiated."""
    return float(kinetic(case, case.v) + potential(case, case.q))
