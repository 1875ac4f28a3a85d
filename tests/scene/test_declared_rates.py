"""Effects with declared rates: potentials between the grids, and stiff ones between slow and fast bodies."""

import numpy as np
import pytest

import vmri_jax as vm
from tests.support import until_failure
from vmri_jax.scene import Body, Gravity, RigidLink, Scene, Spring

CHAIN = Scene(
    [Body(name, 1.0, [float(i), 0.1 * (i % 2)]) for i, name in enumerate("abcd")],
    [
        Gravity(rate="slow"),
        Spring([("a", "b"), ("b", "c"), ("c", "d")], 4e3, name="bonds", rate="fast"),
        Spring([("a", "c"), ("b", "d")], 50.0, 2.1, name="bends", rate=4),
    ],
)
HUB = Scene(
    [
        Body("hub", 50.0, [0.0, 0.0], pace="slow"),
        Body("boom", 1.0, [1.0, 0.0], [0.0, 0.3], pace="fast"),
        Body("tip", 1.0, [2.0, 0.0]),
    ],
    [Spring(("hub", "boom"), 5e3, 1.01, name="hinge", rate="fast"), Spring(("boom", "tip"), 20.0, 1.1)],
)


def homes(scene: Scene) -> dict:
    return {part.effect.name: part.home for part in scene.sorting.placed}


def test_a_potential_at_every_fourth_micro_node():
    """`tests/verification/test_rates.py` compares the steps of such systems with the textbook."""
    assert homes(CHAIN) == {"gravity": "slow_potential", "bonds": "fast_potential", "bends": 4}
    assert {pace.value for pace in CHAIN.sorting.paces.values()} == {"fast"}
    rows = {row.name: row for row in CHAIN.explain(vm.fully_explicit(12), measure=False).rows}
    assert [rows[name].evaluations for name in ("gravity", "bends", "bonds")] == [1, 3, 12]
    assert rows["bends"].kind == "potential on one in 4 micro nodes"
    description = vm.plan(CHAIN, vm.fully_explicit(12)).describe()
    assert "kicks of V_4 at both ends" in description
    assert "V_4               trapezoidal rule on every 4 micro intervals" in description


def test_every_that_does_not_divide_is_refused():
    with pytest.raises(ValueError, match=r"the potential 4 is placed with every=4, which does not divide num_micro=10"):
        vm.simulate(CHAIN, vm.fully_explicit(10), macro_dt=0.05, num_steps=3)
    with pytest.raises(ValueError, match=r"springs: rate is 0; .* a whole number k"):
        Spring(("a", "b"), 1.0, rate=0)
    with pytest.raises(ValueError, match=r"links: rate is 4"):
        RigidLink(("a", "b"), rate=4)


def test_a_stiff_hinge_between_a_slow_and_a_fast_body():
    """Frequency 71: kicks at the macro nodes, 0.05 apart, are beyond their limit 2; on the micro grid the energy is
    kept."""
    assert homes(HUB)["hinge"] == "fast"
    assert {name: pace.value for name, pace in HUB.sorting.paces.items()} == {
        "hub": "slow",
        "boom": "fast",
        "tip": "slow",
    }
    rows = {row.name: row for row in HUB.explain(vm.explicit_slow(10), measure=False).rows}
    assert (rows["hinge"].kind, rows["hinge"].evaluations) == ("potential on the micro grid", 10)
    run = vm.simulate(HUB, vm.explicit_slow(10), macro_dt=0.05, num_steps=100)
    assert np.ptp(run.energy) < 0.25 * float(run.energy[0])  # measured 0.17
    kicked = until_failure(HUB.replace("hinge", rate="slow"), vm.explicit_slow(10), macro_dt=0.05, num_steps=100)
    assert not kicked.success or np.ptp(kicked.energy) > 100 * float(run.energy[0])
