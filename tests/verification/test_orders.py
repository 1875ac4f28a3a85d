"""Orders of convergence, positions and momenta, against high-accuracy solutions of the continuous equations.

Least-squares slopes with the round-off plateau masked. Step counts are chosen inside the asymptotic range: omega H below
about 1, and smaller where a first-order error of the momenta is at first hidden by a larger second-order one.
"""

import pytest

from tests.support import PROBLEMS, convergence, ground_truth
from vmri_jax import explicit_slow, fully_explicit, fully_implicit, galerkin
from vmri_jax.diagnostics import observed_order

TRUTH_ACCURACY = 1e-14
FINE, FINEST = (800, 1600, 3200), (3200, 6400, 12800)
SECOND, FOURTH, SIXTH = (200, 400, 800), (100, 200, 400), (50, 100, 150)

# scheme, macro steps on [0, 1], order
EXPLICIT = [
    (explicit_slow(5, 0.0), FINEST, 1),
    (explicit_slow(5, 1.0), FINEST, 1),
    (explicit_slow(5, 0.5), SECOND, 2),
    (fully_explicit(5, 0.0), FINEST, 1),
    (fully_explicit(5, 1.0), FINEST, 1),
    (fully_explicit(5, 0.5), SECOND, 2),
]
IMPLICIT = [(fully_implicit(5), SECOND, 2)] + [
    (galerkin(2, degree, rule), steps, 2 * degree)
    for rule in ("gauss", "lobatto")
    for degree, steps in ((1, SECOND), (2, FOURTH), (3, SIXTH))
]


NAMES = [f"{kind} alpha {alpha}" for kind in ("explicit slow", "fully explicit") for alpha in (0, 1, 0.5)]
NAMES += ["fully implicit"] + [f"{rule} {degree}" for rule in ("gauss", "lobatto") for degree in (1, 2, 3)]


@pytest.mark.parametrize("name", ["fpu", "tsp"])
@pytest.mark.parametrize(("scheme", "steps", "order"), EXPLICIT + IMPLICIT, ids=NAMES)
def test_observed_order(name, scheme, steps, order):
    truth = ground_truth({"fpu": "fpu3_t1", "tsp": "tsp_t1"}[name])
    macro_dt, *errors = convergence(PROBLEMS[name](), scheme, truth, steps, num_saves=50)
    observed = [observed_order(macro_dt, e, floor=TRUTH_ACCURACY) for e in errors]
    assert observed == pytest.approx([order, order], abs=0.1)  # measured 0.041, 0.2 wanted
    assert scheme.order == order
