"""Batches of runs: many starts, step sizes or parameters of one system, lane by lane independent."""

import dataclasses
from functools import lru_cache, partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core
from jax.sharding import PartitionSpec

from vmri_jax.mechanics.arrays import real_array
from vmri_jax.mechanics.checks import check_params, check_type
from vmri_jax.mechanics.state import State, check_constraints
from vmri_jax.mechanics.system import System
from vmri_jax.running.simulate import check_run, run, run_memory
from vmri_jax.running.trajectory import Trajectory
from vmri_jax.runtime import OPTIONS
from vmri_jax.schemes.composition import Composition, stage_scheme
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.steppers.lanes import over_lanes
from vmri_jax.steppers.newton import Newton, is_collocation
from vmri_jax.steppers.split import split

WORKING_SET = 4096
"""Numbers that the lanes of a chunk may hold together, 32 kB: the first-level cache."""
FEWEST, MOST = 64, 1024
"""Lanes of a chunk. Loops over fewer are written out instead of run, which takes twice the time per lane even where 64 do not fit
into the cache."""
IN_A_CALL = 16
"""Chunks that a call computes at most. A call takes as long as a hundred steps of a small system."""
RESULTS = 4_000_000
"""Numbers that their results may hold together, 32 MB: with more, loops are no single kernels (`vmri_jax.configure`)."""
MATRICES = 10_000_000
"""Numbers that the matrices of a chunk may hold together (80 MB), before the lanes become fewer than that."""
CACHE = 130_000
"""The same where all of them are read in every pass (`is_collocation`): the second-level cache, 1 MB."""


def simulate_batch(
    system: System,
    scheme: Scheme | Composition,
    states: State,
    *,
    macro_dt=None,
    micro_dt=None,
    num_steps: int,
    save_every: int = 1,
    save_micro: bool = False,
    params=None,
    newton: Newton | None = None,
    chunk: int | None = None,
    devices: int = 1,
) -> Trajectory:
    """Simulate a batch of states, each lane as `simulate` would; the arrays returned have a leading batch axis.

    Lanes are computed side by side, with the batch axis contiguous in memory, in chunks that fit into the cache. A lane
    that fails is NaN from there on and has its status in ``.result`` and ``.failed_at``; others do not notice, and
    nothing is raised. Lanes that the nested march does not solve are run again with the exact arrowhead.

    Args:
        system, scheme: what moves, and how.
        states: a `State` whose arrays have a leading batch axis, e.g. ``jax.vmap(make)(q_s, ...)`` or
            ``jax.tree.map(lambda *a: jnp.stack(a), *list_of_states)``.
        macro_dt, micro_dt: step size, a number or one per lane; exactly one of them.
        num_steps, save_every, save_micro, newton: as in `simulate`.
        params: a pytree like ``system.params`` with a leading batch axis, if parameters differ between lanes.
        chunk: lanes that are computed side by side; chosen from the size of the problem if None.
        devices: CPU devices over which chunks are spread, see `vmri_jax.configure`.

    Raises:
        ValueError, TypeError: bad arguments, before anything is computed.
    """
    newton = newton or Newton()
    lanes = _check_states(states)
    check_type("simulate_batch: system", system, System, "a vmri_jax.System")
    if params is not None:
        _check_params(system, params, lanes)
    states, params = jax.tree.map(np.asarray, (states, params))  # cut into pieces without a compiled program for each
    first = jax.tree.map(lambda a: a[0], states)
    check_run(
        system,
        scheme,
        first,
        newton,
        *(_first(dt) for dt in (macro_dt, micro_dt)),
        num_steps=num_steps,
        save_every=save_every,
        save_micro=save_micro,
    )
    name, dt = ("macro_dt", macro_dt) if micro_dt is None else ("micro_dt", micro_dt)
    dt = np.asarray(real_array(f"simulate_batch: {name}", dt))
    if dt.shape not in ((), (lanes,)):
        raise ValueError(
            f"simulate_batch: {name} has shape {dt.shape}; give a number, or one for each of the {lanes} lanes."
        )
    if not (np.all(np.isfinite(dt)) and np.all(dt > 0)):
        raise ValueError(f"simulate_batch: every {name} must be a positive number, got {dt}.")
    if not 1 <= devices <= jax.device_count():
        raise ValueError(
            f"simulate_batch: devices is {devices}, but JAX has {jax.device_count()}; call vm.configure(devices={devices}) "
            "before JAX starts."
        )
    if chunk is not None and (not isinstance(chunk, int) or chunk < 1):
        raise ValueError(f"simulate_batch: chunk is {chunk!r}; it must be an integer of at least 1, or None.")
    if params is None:
        check_constraints(system, first, "simulate_batch: the first state")
    macro_dt = dt * (scheme.num_micro if micro_dt is not None else 1)
    size = _chunk(system, stage_scheme(scheme), first) if chunk is None else chunk
    static = {"num_saves": num_steps // save_every, "save_every": save_every, "save_micro": save_micro}
    go = partial(_in_chunks, system, scheme, chunk=size, devices=devices, **static)
    alone = newton.alone(system, scheme)
    batch = {"state": states}  # what differs between the lanes
    batch |= {} if params is None else {"params": params}
    batch |= {} if dt.ndim == 0 else {"macro_dt": macro_dt}
    go = partial(go, macro_dt)
    trajectory = go(alone, batch)
    failed = np.flatnonzero(np.asarray(trajectory.failed_at) >= 0)
    if failed.size and alone is not newton:
        exact = dataclasses.replace(newton, method="arrowhead")
        again = go(exact, jax.tree.map(lambda a: a[failed], batch))
        trajectory = jax.tree.map(lambda a, b: a.at[failed].set(b), trajectory, again)
    return trajectory


def _first(dt):
    """The step size of the first lane."""
    if dt is None or not np.size(real_array("simulate_batch: the step size", dt)):
        return dt
    return np.ravel(dt)[0]


def _check_params(system: System, params, lanes: int) -> None:
    """Refuse parameters that are not those of the system with a batch axis."""
    check_params(params)
    own, given = jax.tree.structure(system.params), jax.tree.structure(params)
    if own != given:
        raise ValueError(
            f"simulate_batch: params is {given}; give the pytree of system.params, {own}, with a batch axis."
        )
    wanted = [(lanes, *np.shape(leaf)) for leaf in jax.tree.leaves(system.params)]
    shapes = [np.shape(leaf) for leaf in jax.tree.leaves(params)]
    if shapes != wanted:
        raise ValueError(
            f"simulate_batch: the arrays of params have shapes {shapes}; give one per lane of each parameter, {wanted}."
        )


def _check_states(states) -> int:
    """The number of lanes."""
    if not isinstance(states, State):
        raise TypeError(
            f"simulate_batch: states is {type(states).__name__}; give a State whose arrays have a batch axis."
        )
    shapes = {name: np.shape(value) for name, value in vars(states).items()}
    lanes = shapes["q_s"][:1]
    if any(len(s) != (1 if name == "t" else 2) or s[:1] != lanes for name, s in shapes.items()) or lanes == (0,):
        raise ValueError(
            f"simulate_batch: the arrays of states have shapes {shapes}; give t (batch,) and all others (batch, n)."
        )
    return lanes[0]


def _chunk(system: System, scheme: Scheme, state: State) -> int:
    """A power of two of lanes: those whose unknowns fit into the working set, but not too few."""
    leaves, structure = jax.tree.flatten((system, scheme, state))
    unknowns, most = _unknowns(structure, tuple((np.shape(a), jnp.result_type(a)) for a in leaves))
    variables = state.q_s.shape[0] + state.q_f.shape[0]
    fitting = WORKING_SET / (8 * variables + unknowns)
    enough = min(FEWEST, max(8.0, most / (unknowns * variables + 1)))
    return 2 ** int(np.log2(np.clip(fitting, enough, MOST)))


@lru_cache
def _unknowns(structure, leaves) -> tuple[int, int]:
    """Fast unknowns of a macro step that are solved for together, and numbers that their matrices may hold in all lanes.

    The functions of a system are traced for it.
    """
    found = [(0, MATRICES)]

    def count(system, scheme, state):
        if split(system, scheme, state.q_s, state.q_f) is None:
            n_g = system.num_constraints(state.q_s, state.q_f)[0]
            at_once = is_collocation(system, scheme, state.q_s, state.q_f)
            unknowns = scheme.num_micro * scheme.degree * (state.q_f.shape[0] + n_g)
            found.append((unknowns, CACHE if at_once else MATRICES))

    jax.eval_shape(count, *jax.tree.unflatten(structure, [jax.ShapeDtypeStruct(*a) for a in leaves]))
    return found[-1]


def _in_chunks(system, scheme, macro_dt, newton, batch, *, chunk: int, devices: int, **static) -> Trajectory:
    """All lanes, `chunk` per device at a time; the last ones are filled up with copies, so that one program does all."""
    state = batch["state"]
    lanes, (n_s, n_f) = state.q_s.shape[0], (state.q_s.shape[1], state.q_f.shape[1])
    width = min(chunk * devices, -(-lanes // devices) * devices)
    numbers = static["num_saves"] * (2 * (n_s + n_f) + static["save_micro"] * scheme.num_micro * n_f)
    together = IN_A_CALL if width < lanes and IN_A_CALL * width * numbers < RESULTS else 1
    pieces = []
    for start in range(0, lanes, together * width):
        index = np.minimum(np.arange(start, start + together * width), lanes - 1).reshape(together, width)
        count = min(together, -(-(lanes - start) // width))
        piece = jax.tree.map(lambda a, index=index: a[index], batch)
        pieces.append(_chunks(system, scheme, macro_dt, newton, piece, count, devices, **static))
    return pieces[0] if lanes == together * width else _join(pieces, lanes)


@partial(jax.jit, static_argnames="lanes")
def _join(pieces, lanes: int) -> Trajectory:
    return jax.tree.map(lambda *parts: jnp.concatenate(parts)[:lanes], *pieces)


@partial(jax.jit, static_argnames=("devices", "num_saves", "save_micro"), compiler_options=OPTIONS)
def _chunks(
    system, scheme, macro_dt, newton, batch, count, devices, *, num_saves, save_every, save_micro
) -> Trajectory:
    """The first `count` chunks of a batch with arrays (chunks, lanes, ...), one after the other; zeros for the others."""

    def side_by_side(system, scheme, macro_dt, newton, save_every, batch):
        def lane(batch):
            state, dt = batch["state"], batch.get("macro_dt", macro_dt)
            own = system.replace(params=batch.get("params", system.params))
            memory = run_memory(own, scheme, state, dt, newton)
            return run(own, scheme, newton, dt, state.t, state, memory, 0, num_saves, save_every, save_micro)[0]

        lanes = batch["state"].t.shape[0]
        result = over_lanes(lane, lanes)(jax.tree.map(lambda a: jnp.moveaxis(a, 0, -1), batch))
        return jax.tree.map(lambda a: jnp.moveaxis(a, -1, 0), result)

    if devices > 1:
        mesh = jax.sharding.Mesh(np.array(jax.devices()[:devices]), ("lanes",))
        shared, spread = PartitionSpec(), PartitionSpec("lanes")
        specs = {"in_specs": (shared,) * 5 + (spread,), "out_specs": spread}
        side_by_side = jax.shard_map(side_by_side, mesh=mesh, **specs, check_vma=False)
    go = partial(side_by_side, system, scheme, macro_dt, newton, save_every)
    chunks = batch["state"].t.shape[0]
    if chunks == 1:
        return go(jax.tree.map(lambda a: a[0], batch))
    traced, shape = jax.make_jaxpr(go, return_shape=True)(jax.tree.map(lambda a: a[0], batch))
    shapes, structure = jax.tree.flatten(shape)

    def chunk(i, results):
        found = core.jaxpr_as_fun(traced)(*(a[i] for a in jax.tree.leaves(batch)))
        return [result.at[i].set(one) for result, one in zip(results, found, strict=True)]

    results = jax.lax.fori_loop(0, count, chunk, [jnp.zeros((chunks, *a.shape), a.dtype) for a in shapes])
    return jax.tree.unflatten(structure, [a.reshape(-1, *a.shape[2:]) for a in results])
