"""Floats of less than 64 bits are refused by name; numbers given before 64-bit mode keep all their digits."""

import os
import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from vmri_jax import ConstantMass, System, fully_explicit, initial_state, simulate, simulate_batch

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
try:
    vm.ConstantMass(jnp.array([0.1]), [0.1])
except ValueError as error:
    print(error)
params = {"k": jnp.array(0.1)}
masses = jnp.array([0.1])
jax.config.update("jax_enable_x64", True)
for make in (
    lambda: vm.ConstantMass([0.1], masses),
    lambda: vm.initial_state(vm.System(vm.ConstantMass([0.1], [0.1]), params=params), [0.1], [0.1], [0.0], [0.0]),
):
    try:
        make()
    except ValueError as error:
        print(error)
"""


def printed(program: str) -> list[str]:
    """What a program prints in a process whose JAX has no settings."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "XLA_"))}
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_masses_and_params_made_before_64_bit_mode_are_exact():
    assert printed(EARLY) == ["0.0 float64"]


def test_arrays_of_jax_made_before_64_bit_mode_are_refused_by_name():
    off, masses, params = printed(SHORT)
    assert "vmri_jax needs 64-bit floats" in off
    assert "vm.configure()" in off
    assert "ConstantMass: fast has dtype float32; give float64" in masses
    assert "System: params['k'] has dtype float32; give float64" in params
    assert "made after vm.configure()" in params


def one_spring(q_f, params):
    return jnp.sum(params["stiff"]["k"] * q_f**2) / 2


SYSTEM = System(ConstantMass([1.0], [1.0]), None, one_spring, params={"stiff": {"k": jnp.ones(1)}})


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.bfloat16, np.float16, np.complex64])
def test_params_are_refused_at_every_door(dtype):
    state = initial_state(SYSTEM, [0.0], [1.0], [0.0], [0.0])
    short = {"stiff": {"k": jnp.ones(1, dtype)}}
    system = SYSTEM.replace(params=short)
    message = rf"System: params\['stiff(\.|'\]\[')k'\] has dtype {np.dtype(dtype).name}; give float64"
    with pytest.raises(ValueError, match=message):
        initial_state(system, [0.0], [1.0], [0.0], [0.0])
    with pytest.raises(ValueError, match=message):
        simulate(system, fully_explicit(2), state, macro_dt=0.1, num_steps=1)
    states = vm.State(*(jnp.stack([a, a]) for a in (state.t, state.q_s, state.q_f, state.p_s, state.p_f)))
    with pytest.raises(ValueError, match=message):
        simulate_batch(
            SYSTEM,
            fully_explicit(2),
            states,
            macro_dt=0.1,
            num_steps=1,
            params={"stiff": {"k": jnp.ones((2, 1), dtype)}},
        )


def test_whole_numbers_and_flags_may_be_params():
    system = SYSTEM.replace(params={"stiff": {"k": 1}, "flag": True, "count": np.int32(3)})
    assert initial_state(system, [0.0], [1.0], [0.0], [0.0]).p_f.dtype == float
