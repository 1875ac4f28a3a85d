"""Loops that a user of JAX would write by hand: r-RESPA for the chain, RATTLE for particles on rods."""

from functools import partial

import jax
import jax.numpy as jnp

from benchmarks.peers import equations
from benchmarks.peers.cases import Case, Ladder, steps_ladder
from benchmarks.peers.mechanics import dot, solve

NUM_MICRO = (1, 4, 16)
"""Micro steps per macro step of r-RESPA that are tried."""
TOLERANCE = 1e-13
"""RATTLE iterates until the largest relative error of a squared length of a rod is below it."""


def ladders(case: Case) -> list[Ladder]:
    """r-RESPA with some numbers of micro steps, or RATTLE; numbers of macro steps."""
    start = (jnp.asarray(case.q), jnp.asarray(case.v))

    def ladder(name: str, steps) -> Ladder:
        def build(num_steps: int):
            return partial(steps, start, jnp.asarray(case.t_end / num_steps), jnp.asarray(num_steps))

        return steps_ladder(case, name, build)

    if case.is_chain:
        return [ladder(f"r-RESPA {n}", jax.jit(_respa(case, n))) for n in NUM_MICRO]
    return [ladder("RATTLE", jax.jit(_rattle(case)))]


def _respa(case: Case, num_micro: int):
    """Kicks of the soft springs at the macro nodes, merged; velocity Verlet of the stiff ones in between."""
    n, stiff = case.q.size // 2, case.omega**2
    full = equations.acceleration(case)

    def soft(q):
        return full(q, None).at[n:].add(stiff * q[n:])

    def steps(start, macro_dt, num_steps):
        h = macro_dt / num_micro

        def micro(_, carry):
            s, f, v_s, v_f = carry
            v_f = v_f - h / 2 * stiff * f
            f = f + h * v_f
            return s + h * v_s, f, v_s, v_f - h / 2 * stiff * f

        def macro(_, carry):
            q, v, a = carry
            v = v + macro_dt / 2 * a
            s, f, v_s, v_f = jax.lax.fori_loop(0, num_micro, micro, (q[:n], q[n:], v[:n], v[n:]), unroll=True)
            q, v = jnp.concatenate([s, f]), jnp.concatenate([v_s, v_f])
            a = soft(q)
            return q, v + macro_dt / 2 * a, a

        q, v = start
        return jax.lax.fori_loop(0, num_steps, macro, (q, v, soft(q)))[0]

    return steps


def _rattle(case: Case):
    """Newton's iteration for the multipliers of the positions, one linear solve for those of the velocities."""
    p = case.particles
    lengths = [length**2 for _, _, length in p.rods]

    def free(q):
        return [f / p.masses[i // 3] for i, f in enumerate(p.forces(q, jnp.sqrt))]

    def squares(q):
        return [(dot(d, d) - l2) / 2 for d, l2 in zip(p.rods_of(q), lengths, strict=True)]

    def project(q, v):
        rods = p.rods_of(q)
        rates = [-dot(d, w) for d, w in zip(rods, p.rods_of(v), strict=True)]
        return p.pulled(v, rods, solve(p.rod_matrix(rods, rods), rates))

    def steps(start, dt, num_steps):
        def step(_, carry):
            q, v, a, mu = carry
            v = [x + dt / 2 * y for x, y in zip(v, a, strict=True)]
            rods = p.rods_of(q)

            def place(mu):
                moved = p.pulled(v, rods, mu)
                return [x + dt * y for x, y in zip(q, moved, strict=True)], moved

            def newton(carry):
                mu, _, count = carry
                at, _ = place(mu)
                off = squares(at)
                correction = solve(p.rod_matrix(p.rods_of(at), rods), [-x / dt for x in off])
                worst = jnp.max(jnp.stack([jnp.abs(x) / l2 for x, l2 in zip(off, lengths, strict=True)]))
                return [x + y for x, y in zip(mu, correction, strict=True)], worst, count + 1

            go = (mu, jnp.asarray(jnp.inf), 0)
            mu, _, _ = jax.lax.while_loop(lambda c: (c[1] > TOLERANCE) & (c[2] < 20), newton, go)
            q, v = place(mu)
            a = free(q)
            v = project(q, [x + dt / 2 * y for x, y in zip(v, a, strict=True)])
            return q, v, a, mu

        q, v = (list(x) for x in start)
        zero = [jnp.zeros(()) for _ in p.rods]
        a = [jnp.asarray(x, dtype=float) for x in free(q)]
        return jnp.stack(jax.lax.fori_loop(0, num_steps, step, (q, v, a, zero))[0])

    return steps


energy = equations.energy
