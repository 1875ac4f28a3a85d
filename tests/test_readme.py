"""The programs in the README run as printed, and its numbers hold."""

import re
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm

TEXT = (Path(__file__).parent.parent / "README.md").read_text()
PROGRAMS = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)


def test_example_runs(tmp_path):
    """In a process of its own, since settings are read when JAX starts; it prints what the page says."""
    example, results = PROGRAMS[:2]
    checks = 'assert run.position("load").shape == (201, 2)\nassert len(run[100:]) == 101\n'
    run = [sys.executable, "-c", example + results + checks]
    done = subprocess.run(run, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert [f"`{line}`" in TEXT for line in done.stdout.splitlines()] == [True, True], done.stdout
    assert (tmp_path / "run.png").stat().st_size > 10_000
    assert (tmp_path / "run.csv").read_text().startswith("t,trolley,hook x,hook y,load x,load y,v trolley,")


def test_scenes_run():
    """Points and springs, then rigid bodies and a hinge, one after the other as they stand there."""
    scope = {}
    for start in ("from vmri_jax.scene import Anchor", "from vmri_jax.scene import Box"):
        exec(next(program for program in PROGRAMS if program.startswith(start)), scope)
    for name, places in (("scene", {"hook": "s", "bell": "f"}), ("satellite", {"hub": "s", "panel": "f"})):
        scene = scope[name]
        assert {body: scene.places[body].part for body in places} == places
        assert vm.simulate(scene, vm.fully_implicit(num_micro=10), macro_dt=0.01, num_steps=10).success


def test_many_runs(tmp_path):
    program = next(program for program in PROGRAMS if "vm.ensemble(" in program)
    run = [sys.executable, "-c", program]
    done = subprocess.run(run, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert f"It prints `{done.stdout.strip()}`." in TEXT, done.stdout
    assert (tmp_path / "runs.png").stat().st_size > 10_000


@pytest.mark.full
def test_a_gradient_over_many_steps_in_little_memory(fpu):
    recipe = next(program for program in PROGRAMS if "jax.checkpoint" in program)
    scheme = vm.fully_implicit(10)
    scope = {"jax": jax, "vm": vm, "system": fpu.system, "scheme": scheme}
    exec(recipe, scope)

    def whole(state):
        return vm.simulate(fpu.system, scheme, state, macro_dt=0.01, num_steps=10_000, save_every=10_000).final_state

    found = []
    for end in (scope["end"], whole):
        gradient = jax.grad(lambda state, end=end: jnp.sum(end(state).q_f ** 2))
        program = jax.jit(gradient).lower(fpu.state()).compile()
        memory = program.memory_analysis()
        assert memory is not None
        found.append((memory.temp_size_in_bytes / 1e6, program(fpu.state())))
    (little, ours), (much, theirs) = found
    assert (round(little), round(much)) == (2, 195)
    assert np.allclose(ours.q_f, theirs.q_f, rtol=1e-6)
