"""Systems: masses, replacing fields, what depends on what."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vmri_jax import ConstantMass, Refused, System
from vmri_jax.diagnostics import energy
from vmri_jax.mechanics.functions import traced_once
from vmri_jax.mechanics.structure import depends_on


def test_diagonal_and_matrix_masses_agree():
    rng = np.random.default_rng(0)
    slow, fast = rng.uniform(1, 2, size=3), rng.uniform(1, 2, size=2)
    v_s, v_f = rng.normal(size=(4, 3)), rng.normal(size=(4, 2))
    a, b = ConstantMass(slow, fast), ConstantMass(np.diag(slow), np.diag(fast))
    for x, y in zip(a.momentum(v_s, v_f), b.momentum(v_s, v_f), strict=True):
        assert np.allclose(x, y, rtol=1e-15)
    for x, y in zip(b.velocity(*b.momentum(v_s, v_f)), (v_s, v_f), strict=True):
        assert np.allclose(x, y, rtol=1e-13)
    energy = a(None, None, v_s[0], v_f[0], None)
    assert np.isclose(energy, (slow @ v_s[0] ** 2 + fast @ v_f[0] ** 2) / 2, rtol=1e-15)
    assert np.isclose(energy, b(None, None, v_s[0], v_f[0], None), rtol=1e-15)


def test_masses_may_be_traced():
    def kinetic(m):
        return ConstantMass(m * jnp.ones(2), jnp.ones(1))(None, None, jnp.ones(2), jnp.ones(1), None)

    assert float(jax.jit(jax.grad(kinetic))(3.0)) == 1.0


def double_well(q_s, q_f, params):
    return params["a"] * jnp.sum(q_s**2)


def test_replace_changes_one_field_only():
    system = System(ConstantMass([1.0], [1.0]), slow_potential=double_well, params={"a": np.asarray(1.0)})
    changed = system.replace(params={"a": np.asarray(2.0)})
    assert changed.slow_potential == traced_once(double_well)
    assert float(changed.params["a"]) == 2.0
    assert float(system.params["a"]) == 1.0
    assert jax.tree.structure(system) == jax.tree.structure(changed)


def test_terms_are_filtered_and_mapped(sam):
    system = sam.system.replace(
        potentials={"wells": double_well, 3: double_well}, params={**sam.system.params, "a": 2.0}
    )
    names = "T", "V", "W", "g", "g_s", "wells", 3
    assert tuple(term.name for term in system.terms) == names
    assert [term.label for term in system.of_kind("potential")] == ["V", "W", "wells", "V_3"]
    assert [term.place for term in system.terms][-2:] == ["potentials['wells']", "potentials[3]"]
    assert system.only(lambda term: True) == system
    left = system.only(lambda term: term.name in ("W", 3))
    assert [term.name for term in left.terms] == ["T", "W", 3]
    assert not left.is_constrained

    def twice(term):
        return term.function if term.kind == "kinetic" else lambda *arguments: 2 * term.function(*arguments)

    def values(system):
        q = sam.q_s, sam.q_f
        return np.concatenate([list(system.all_potentials(*q).values()), system.constraints(0.0, *q)])

    np.testing.assert_allclose(values(system.mapped(twice)), 2 * values(system), rtol=1e-15)


def test_constraints_join_coupling_and_slow_ones(sam, fpu):
    values = sam.system.constraints(0.0, sam.q_s + 0.1, sam.q_f)
    assert values.shape == (4,)
    assert np.array_equal(values[:3], sam.system.constraint(sam.q_s + 0.1, sam.q_f, sam.system.params))
    assert np.array_equal(values[3:], sam.system.slow_constraint(sam.q_s + 0.1, sam.system.params))
    assert sam.system.num_constraints(sam.q_s, sam.q_f) == (3, 1)
    assert fpu.system.constraints(0.0, fpu.q_s, fpu.q_f).shape == (0,)
    assert fpu.system.num_constraints(fpu.q_s, fpu.q_f) == (0, 0)


def test_dependence_is_read_off_the_function():
    x, y = np.ones(2), np.ones(3)
    assert depends_on(lambda x, y: jnp.sum(x), x, y) == (True, False)
    assert depends_on(lambda x, y: jnp.sum(x) * y, x, y) == (True, True)
    assert depends_on(lambda x, y: 3.0 * jnp.sum(jnp.ones(2)), x, y) == (False, False)
    assert depends_on(lambda x, y: x[0] + 0 * y[0], x, y) == (True, True)  # conservative

    def unused(x, y):
        return (jnp.sin(y), jnp.cos(x))[1]

    assert depends_on(unused, x, y) == (True, False)
    inner = jax.jit(lambda x, y: jnp.sin(x))
    assert depends_on(lambda tree: inner(tree["a"], tree["b"]), {"a": x, "b": x}) == (True,)


def of_both(q_s, q_f, params):
    return jnp.sum(q_s) * jnp.sum(q_f)


def test_further_potentials_count_in_the_energy():
    system = System(ConstantMass([1.0], [2.0]), potentials={"a": of_both, 4: of_both, "fast": of_both})
    q_s, q_f = np.array([2.0]), np.array([3.0])
    assert system.all_potentials(q_s, q_f) == {"slow": 0.0, "fast": 6.0, "a": 6.0, 4: 6.0}
    assert float(energy(system, q_s, q_f, 0 * q_s, 0 * q_f)) == 18.0
    assert system.replace(params=1.0).potentials == system.potentials
    assert "potential a" in repr(system)


@pytest.mark.parametrize(
    ("potentials", "message"),
    [
        (of_both, "give functions by name"),
        ({0: of_both}, "a whole number k of at least 1"),
        ({"kinetic": of_both}, "the name of another term"),
        ({"V_2": of_both, 2: of_both}, "the name of another term"),
        ({"W": of_both}, "the name of another term"),
        ({"a": 1.0}, r"potentials\['a'\] is 1.0; it must be a function"),
        ({"a": lambda q_f, params: 0.0}, r"it is called with \(q_s, q_f, params\)"),
    ],
)
def test_further_potentials_that_are_refused(potentials, message):
    with pytest.raises(Refused, match=message):
        System(ConstantMass([1.0], [2.0]), potentials=potentials)
