"""Floats of less than 64 bits are refused by name; numbers given before 64-bit mode keep all their digits."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm

EARLY = """
import jax.numpy as jnp
import numpy as np
import vmri_jax as vm

def spring(q_f, params):
    return params["k"] / 2 * jnp.sum(q_f**2)

MASSES = vm.ConstantMass([0.1], np.array([0.1]))
SYSTEM = vm.System(MASSES, None, spring, params={"k": 0.1, "n": 3, "on": True})
vm.configure()
late = vm.System(vm.ConstantMass([0.1], [0.1]), None, spring, params={"k": 0.1, "n": 3, "on": True})
runs = []
for system in (SYSTEM, late):
    state = vm.initial_state(system, [0.3], [0.3], [0.1], [0.1])
    runs.append(vm.simulate(system, vm.fully_explicit(2), state, macro_dt=0.1, num_steps=20))
print(float(jnp.abs(runs[0].q_f - runs[1].q_f).max()), MASSES.fast.dtype)
"""

SHORT = """
import jax, jax.numpy as jnp
import vmri_jax as vm

def error_of(make):
    try:
        make()
    except ValueError as error:
        print(str(error).replace(chr(10), " "))

for make in (
    lambda: vm.ConstantMass(jnp.array([0.1]), [0.1]),
    lambda: vm.systems.fermi_pasta_ulam(),
    lambda: vm.initial_state(None, [1.0], [1.0], [0.0], [0.0]),
    lambda: vm.simulate(None, vm.fully_implicit(2), None, macro_dt=0.1, num_steps=1),
):
    error_of(make)
params, masses = {"k": jnp.array(0.1)}, jnp.array([0.1])
jax.config.update("jax_enable_x64", True)
error_of(lambda: vm.ConstantMass([0.1], masses))
system = vm.System(vm.ConstantMass([0.1], [0.1]), params=params)
error_of(lambda: vm.initial_state(system, [0.1], [0.1], [0.0], [0.0]))
"""


def printed(program: str) -> list[str]:
    """What a program prints in a process whose JAX has no settings."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "XLA_"))}
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_masses_and_params_made_before_64_bit_mode_are_exact():
    assert printed(EARLY) == ["0.0 float64"]


def test_every_door_asks_for_64_bit_mode_and_arrays_made_before_are_refused_by_name():
    *off, masses, params = printed(SHORT)
    assert len(off) == 4
    for message in off:
        assert "needs 64-bit floats" in message
        assert "vm.configure()" in message
        assert 'jax.config.update("jax_enable_x64", True)' in message
    assert "ConstantMass: fast has dtype float32; give float64" in masses
    assert "System: params['k'] has dtype float32; give float64" in params
    assert "made after vm.configure()" in params


def one_spring(q_f, params):
    return jnp.sum(params["stiff"]["k"] * q_f**2) / 2


SYSTEM = vm.System(vm.ConstantMass([1.0], [1.0]), None, one_spring, params={"stiff": {"k": jnp.ones(1)}})


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.bfloat16, np.float16, np.complex64])
def test_params_are_refused_at_every_door(dtype):
    start, step = ([0.0], [1.0], [0.0], [0.0]), {"macro_dt": 0.1, "num_steps": 1}
    state, short = vm.initial_state(SYSTEM, *start), {"stiff": {"k": jnp.ones(1, dtype)}}
    lanes = jax.tree.map(lambda a: jnp.stack([jnp.asarray(a)] * 2), state)
    params = {"stiff": {"k": jnp.ones((2, 1), dtype)}}
    message = rf"System: params\['stiff(\.|'\]\[')k'\] has dtype {np.dtype(dtype).name}; give float64"
    for call in (
        lambda: vm.initial_state(SYSTEM.replace(params=short), *start),
        lambda: vm.simulate(SYSTEM.replace(params=short), vm.fully_explicit(2), state, **step),
        lambda: vm.simulate_batch(SYSTEM, vm.fully_explicit(2), lanes, **step, params=params),
    ):
        with pytest.raises(ValueError, match=message):
            call()


def test_whole_numbers_and_flags_may_be_params():
    system = SYSTEM.replace(params={"stiff": {"k": 1}, "flag": True, "count": np.int32(3)})
    assert vm.initial_state(system, [0.0], [1.0], [0.0], [0.0]).p_f.dtype == float
