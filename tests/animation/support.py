"""Runs for the tests of pictures, without a simulation."""

import jax
import numpy as np

import vmri_jax as vm
from tests.support import DATA, PROBLEMS
from vmri_jax.running.trajectory import RunInfo, from_named_arrays

PENDULUM = {
    "bodies": [
        {"name": "bob", "coordinates": [["s", 0], ["s", 1]], "radius": 0.2},
        {"name": "tip", "coordinates": [["f", 0], ["f", 1]], "color": "#aa3311"},
    ],
    "links": [["bob", "tip"]],
    "springs": [],
    "anchors": [{"body": "bob", "point": [0.0, 0.0], "kind": "spring"}],
    "planes": [{"point": [0.0, -3.0], "normal": [0.0, 1.0]}],
    "spheres": [{"center": [2.0, 0.0], "radius": 0.4}],
}


def trajectory(t, q_s, q_f, p_s=None, p_f=None, energy=None, **fields) -> vm.Trajectory:
    """A run of these nodes that went well."""
    count = len(t)
    defaults = {"result": 0, "failed_at": -1, "constraint_residual": np.zeros((count, 2))}
    defaults |= dict.fromkeys(RunInfo._fields, np.zeros(count - 1, dtype=int))
    energy = np.ones(count) if energy is None else energy
    momenta = {"p_s": q_s if p_s is None else p_s, "p_f": q_f if p_f is None else p_f}
    return from_named_arrays({"t": t, "q_s": q_s, "q_f": q_f, **momenta, "energy": energy} | defaults | fields)


def swinging(count: int = 41, end: float = 4.0, **fields) -> vm.Trajectory:
    """A bob (slow) and a tip (fast) of two coordinates each, for `PENDULUM`."""
    t = np.linspace(0.0, end, count)
    bob = np.stack([np.sin(t), -np.cos(t)], axis=1)
    energy = 2.0 + 1e-3 * np.sin(3 * t)
    return trajectory(t, bob, 2.2 * bob, energy=energy, **fields)


def reference_run(name: str, macro_dt: float) -> vm.Trajectory:
    """A trajectory of ``tests/data/reference`` with its energies."""
    with np.load(DATA / "reference" / f"{name}.npz") as data:
        phase = [data[key] for key in ("q_s", "q_f", "p_s", "p_f")]
    system = PROBLEMS[name[:3]]().system
    energy = jax.jit(jax.vmap(lambda *phase: vm.diagnostics.energy(system, *phase)))(*phase)
    return trajectory(macro_dt * np.arange(len(phase[0])), *phase, energy=np.asarray(energy))
