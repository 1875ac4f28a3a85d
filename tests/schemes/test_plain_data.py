"""Schemes as plain data and back."""

import json

import jax
import numpy as np
import pytest

import vmri_jax as vm
from vmri_jax.schemes.plain_data import from_plain, to_plain

SIMPSON = vm.quadrature.simpson
SCHEMES = [
    vm.fully_implicit(3),
    vm.explicit_slow(4, alpha=0.3),
    vm.mollified_impulse(5),
    vm.takahashi_imada(2),
    vm.galerkin(1, 5, "lobatto"),
    vm.fully_explicit(8).with_potentials(bends=vm.micro(SIMPSON, every=4), slow=vm.macro(SIMPSON)),
    vm.compose(vm.fully_explicit(10), "kahan-li8"),
]


@pytest.mark.parametrize("scheme", SCHEMES, ids=range(len(SCHEMES)))
def test_a_scheme_survives_json(scheme):
    read = from_plain(json.loads(json.dumps(to_plain(scheme))))
    assert jax.tree.structure(read) == jax.tree.structure(scheme)
    for ours, theirs in zip(jax.tree.leaves(read), jax.tree.leaves(scheme), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert str(read.describe()) == str(scheme.describe())


def test_a_composition_of_a_composition_is_refused():
    plain = to_plain(SCHEMES[-1])
    with pytest.raises(ValueError, match="stages of a composition"):
        from_plain({"scheme": plain, "coefficients": [1.0]})
