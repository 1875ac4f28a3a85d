"""What users keep in a file of their own: a quantity, a system, and quantities that go wrong."""

import os
import signal
import time
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

import vmri_jax as vm
from vmri_jax import systems

POISON = 41.0
"""A frequency at which the bad quantities go wrong."""

slow_chain = systems.fermi_pasta_ulam(num_springs=2)


hung = vm.Problem(
    vm.System(
        vm.ConstantMass(slow={"trolley": 5.0}, fast={"hook": 1.0, "load": 2.0}),
        fast_potential=lambda q_f, params: params["k"] / 2 * jnp.sum((q_f["load"] - q_f["hook"] - 1.0) ** 2),
        slow_potential=lambda q_s, q_f, params: jnp.sum((q_f["hook"] - q_s["trolley"]) ** 2),
        params={"k": jnp.asarray(30.0)},
    ),
    q_s={"trolley": [0.0, 0.0]},
    q_f={"hook": [0.5, 0.0], "load": [1.0, -1.2]},
)
"""Positions as dictionaries."""


def put(problem, row):
    """Parameters by name, whole vectors of the start, and numbers in them, "v_s[0]"."""
    params, start = dict(problem.system.params), {}
    for name, value in row.items():
        part, _, index = name.rstrip("]").partition("[")
        if name in params:
            params[name] = value
        elif index:
            start[part] = jnp.asarray(start.get(part, getattr(problem, part))).at[int(index)].set(value)
        else:
            start[part] = value
    return replace(problem, system=problem.system.with_params(params), **start)


def faster(problem, row):
    """All velocities of a chain times a number, and springs of another frequency."""
    system = problem.system.replace(params={"omega": row["frequency"]})
    return replace(problem, system=system, v_s=row["speed"] * problem.v_s)


def lengths(run):
    """Distance of load and hook at every node, and the end of the load."""
    ends = run.q_f["load"] - run.q_f["hook"]
    return {"distance": jnp.linalg.norm(ends, axis=-1), "load": run.position("load")[-1]}


def reach(run):
    """Largest elongation of the first stiff spring."""
    return jnp.max(jnp.abs(run.q_f[:, 0]))


def raises(run):
    """Raises where the energy at the start tells that a run is the poisoned one."""
    return jax.pure_callback(_raise, jax.ShapeDtypeStruct((), float), run.q_s[0, 0], vmap_method="broadcast_all")


def _raise(q):
    if np.any(np.asarray(q) == POISON):
        raise ValueError("poison")
    return np.asarray(q)


def dies(run):
    """Kills its process at the poisoned run."""
    return jax.pure_callback(_die, jax.ShapeDtypeStruct((), float), run.q_s[0, 0], vmap_method="broadcast_all")


def _die(q):
    if np.any(np.asarray(q) == POISON):
        os._exit(1)
    return np.asarray(q)


def interrupts(run):
    """Ctrl-C at the poisoned run."""
    return jax.pure_callback(_interrupt, jax.ShapeDtypeStruct((), float), run.q_s[0, 0], vmap_method="broadcast_all")


def _interrupt(q):
    if np.any(np.asarray(q) == POISON):
        os.kill(os.getpid(), signal.SIGINT)
    return np.asarray(q)


def sleeps(run):
    """Takes a while."""
    return jax.pure_callback(_sleep, jax.ShapeDtypeStruct((), float), run.q_s[0, 0], vmap_method="broadcast_all")


def _sleep(q):
    time.sleep(0.3)
    return np.asarray(q)
