"""The programs in the README run as printed, and its numbers hold."""

import re
import subprocess
import sys
from pathlib import Path

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


def test_a_fit(tmp_path):
    program = next(program for program in PROGRAMS if "vm.fit(" in program)
    run = [sys.executable, "-c", program]
    done = subprocess.run(run, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip().splitlines()[0] in TEXT, done.stdout
    assert (tmp_path / "fit.png").stat().st_size > 10_000


def test_optimal_control():
    scope = {}
    exec(next(program for program in PROGRAMS if "vm.control.minimize(" in program), scope)
    assert scope["found"].converged
    assert abs(scope["found"].cost - 6) < 1e-3
