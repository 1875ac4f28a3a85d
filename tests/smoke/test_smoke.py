"""One short run of everything: what has to work with every version of Python and JAX."""

import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from vmri_jax import ConstantMass
from vmri_jax.scene import Anchor, Body, Gravity, RigidLink, Scene, Spring

STEPS = {
    "explicit": ("fermi_pasta_ulam", vm.fully_explicit(4), None),
    "rattle": ("triple_spherical_pendulum", vm.fully_explicit(1), None),
    "split": ("simple_atomic_model", vm.explicit_slow(3), None),
    "masses": ("triple_spherical_pendulum", vm.fully_implicit(3), vm.Solver("masses")),
    "modes": ("fermi_pasta_ulam", vm.galerkin(1, 3), None),
    "exact": ("fermi_pasta_ulam", vm.fully_implicit(2), vm.Solver("exact")),
    "composition": ("fermi_pasta_ulam", vm.compose(vm.fully_explicit(2), "suzuki4"), None),
}


def start(name: str):
    problem = getattr(vm.systems, name)()
    return problem, problem.state()


@pytest.mark.parametrize("name", STEPS)
def test_every_kind_of_step(name):
    system, scheme, solver = STEPS[name]
    problem, state = start(system)
    run = vm.simulate(problem.system, scheme, state, macro_dt=0.002, num_steps=10, solver=solver)
    assert run.result <= vm.Result.CONVERGED_AT_ROUNDOFF
    assert float(jnp.abs(run.energy / run.energy[0] - 1).max()) < 1e-3
    assert float(run.constraint_residual.max()) < 1e-9


def test_a_batch():
    problem, state = start("fermi_pasta_ulam")
    states = jax.tree.map(lambda a: jnp.stack([a, a * 1.01]), state)
    batch = vm.simulate_batch(problem.system, vm.fully_implicit(2), states, macro_dt=0.01, num_steps=5)
    single = vm.simulate(problem.system, vm.fully_implicit(2), state, macro_dt=0.01, num_steps=5)
    np.testing.assert_allclose(batch.q_f[0], single.q_f, rtol=1e-12, atol=1e-13)


def test_a_gradient():
    problem, state = start("fermi_pasta_ulam")

    def end(omega):
        system = problem.system.replace(params={"omega": omega})
        run = vm.simulate(system, vm.fully_implicit(2), state, macro_dt=0.01, num_steps=3)
        return jnp.sum(run.q_f[-1] ** 2)

    omega = problem.system.params["omega"]
    slope = (end(omega + 1e-4) - end(omega - 1e-4)) / 2e-4
    assert float(jax.grad(end)(omega)) == pytest.approx(float(slope), rel=1e-5)


def test_masses_are_matrices_or_vectors():
    diagonal = ConstantMass([1.0, 2.0], [3.0])
    dense = ConstantMass(np.diag([1.0, 2.0]), [[3.0]])
    v = jnp.array([1.0, -1.0]), jnp.array([2.0])
    for a, b in zip(diagonal.momentum(*v), dense.momentum(*v), strict=True):
        np.testing.assert_allclose(a, b)


def test_a_scene():
    scene = Scene(
        [Body("hook", 50.0, [0.0, -1.0]), Body("load", 1.0, [0.4, -1.3]), Body("bell", 1.0, [0.4, -2.3])],
        [Gravity(), Anchor("hook", [0.0, 0.0]), RigidLink(("hook", "load")), Spring(("load", "bell"), 4e4, length=1.0)],
    )
    run = vm.simulate(scene.system(), vm.fully_implicit(3), scene.state(), macro_dt=0.01, num_steps=5)
    assert float(run.constraint_residual.max()) < 1e-10


def test_a_store(tmp_path):
    problem, state = start("fermi_pasta_ulam")
    how = {"macro_dt": 0.01, "num_steps": 6}
    stored = vm.stream(problem.system, vm.fully_explicit(2), state, out=tmp_path / "run", chunk=3, **how)
    run = vm.simulate(problem.system, vm.fully_explicit(2), state, **how)
    np.testing.assert_allclose(stored.load().q_f, run.q_f, rtol=0, atol=1e-14)


def test_an_ensemble(tmp_path):
    design = {"num_steps": [10, 20], "num_micro": [1, 3]}
    runs = vm.ensemble("fpu", "explicit-slow", design, t_end=0.2, chunk=2, out=tmp_path / "runs.zarr")
    assert runs.complete
    assert (runs.failed_runs, runs.computed, runs.chunks.count) == (0, 4, 2)


def test_the_command_line(tmp_path):
    out = tmp_path / "run.npz"
    command = [sys.executable, "-c", "from vmri_jax.cli import main; main()", "simulate", "fpu"]
    command += ["--macro-dt", "0.1", "--steps", "100", "--out", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=Path(__file__).parents[2])
    assert done.returncode == 0, done.stderr
    assert len(np.load(out)["t"]) > 1
