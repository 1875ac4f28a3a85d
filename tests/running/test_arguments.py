"""What arguments of runs are told."""

import pytest

import vmri_jax as vm
from vmri_jax.running.arguments import nothing_fast


@pytest.mark.parametrize(
    ("scheme", "num_fast", "told"),
    [
        (vm.fully_implicit(1), 0, False),
        (vm.compose(vm.fully_implicit(1), "kahan-li8"), 0, False),  # its num_micro counts the micro steps of 17 stages
        (vm.compose(vm.fully_implicit(2), "yoshida4"), 0, True),
        (vm.fully_implicit(2), 0, True),
        (vm.fully_implicit(2), 3, False),
    ],
)
def test_several_micro_steps_for_nothing_fast(scheme, num_fast, told):
    assert ("Take num_micro=1" in nothing_fast(scheme, num_fast)) == told
