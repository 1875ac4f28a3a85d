"""Settings of JAX: made before it starts, and one warning where they were forgotten."""

import os
import subprocess
import sys

import pytest

from vmri_jax.configure import FAST_LOOPS

FORKING = """
import os, sys
import jax, vmri_jax
for line in sys.stdin:
    if not (child := os.fork()):
        exec(eval(line), {})
        sys.stdout.flush()
        os._exit(0)
    print("ended", os.waitpid(child, 0)[1], flush=True)
"""
"""Forks a process for each program that it reads: JAX, which is imported once, has no settings and has not started in
any of them."""


@pytest.fixture(scope="module")
def printed():
    """What a program prints, also as errors and warnings, in a process whose JAX has no settings."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "XLA_"))}
    command = [sys.executable, "-W", "ignore::DeprecationWarning", "-c", FORKING]
    pipe, joined = subprocess.PIPE, subprocess.STDOUT
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=joined, text=True, env=environment) as mother:
        programs, answers = mother.stdin, mother.stdout
        assert programs
        assert answers

        def output(program: str) -> str:
            print(repr(program), file=programs, flush=True)
            text = ""
            while not (line := answers.readline()).startswith("ended"):
                assert line, text
                text += line
            assert line == "ended 0\n", text
            return text

        yield output
        programs.close()


def test_configure_before_jax_starts(printed):
    program = """
import os, jax, vmri_jax as vm
from vmri_jax.configure import warn_if_slow
os.environ["XLA_FLAGS"] = "--xla_cpu_enable_fast_math=false"
vm.configure(devices=2, cache="/tmp/vmri_jax_nothing")
vm.configure()
print(os.environ["XLA_FLAGS"], jax.device_count(), jax.numpy.ones(1).dtype)
warn_if_slow()
vm.configure(devices=2)
try:
    vm.configure(devices=3)
except RuntimeError as error:
    print(error)
"""
    assert printed(program).splitlines() == [
        " ".join(["--xla_cpu_enable_fast_math=false", *FAST_LOOPS, "2 float64"]),
        (
            "configure: JAX has already started, its settings can no longer change; call vm.configure() before any "
            "array is made."
        ),
    ]


@pytest.mark.parametrize(
    ("before", "arguments", "folder"),
    [
        ("", "", "/tmp/somewhere/vmri_jax"),
        ("", "cache=False", "None"),
        ("", "cache='/tmp/mine'", "/tmp/mine"),
        ("jax.config.update('jax_compilation_cache_dir', '/tmp/mine')", "", "/tmp/mine"),  # it is kept
    ],
)
def test_programs_are_kept_on_disk(printed, before, arguments, folder):
    program = f"""
import os, jax
os.environ["XDG_CACHE_HOME"] = "/tmp/somewhere"
import vmri_jax as vm
{before}
vm.configure({arguments})
print(jax.config.jax_compilation_cache_dir)
"""
    assert printed(program).split() == [folder]


def test_import_and_questions_change_nothing(printed):
    program = """
import os, jax, vmri_jax as vm
assert "XLA_FLAGS" not in os.environ and not jax.config.jax_enable_x64
assert jax.config.jax_num_cpu_devices == -1
print(jax.device_count())
try:
    vm.configure()
except RuntimeError as error:
    print("already started" in str(error), jax.config.jax_num_cpu_devices, jax.config.jax_enable_x64)
"""
    assert printed(program).splitlines() == ["1", "True -1 False"]


def test_one_warning_with_the_line_to_add(printed):
    program = """
import warnings
import jax
from vmri_jax import NotConfiguredWarning
from vmri_jax.configure import warn_if_slow
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    warn_if_slow()
    warn_if_slow()
print(len(caught), caught[0].category is NotConfiguredWarning, "vm.configure()" in str(caught[0].message))
"""
    assert printed(program).split() == ["1", "True", "True"]
