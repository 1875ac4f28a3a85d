"""The errors and orders of the independent re-run of the reference study: FPU chain, t = 1.

Its numbers are errors at the end time t = 1, the largest over all components (slow and fast), not a sup over the nodes
on the way, which is up to 9 times larger for the momenta (the fast momenta are worst in between).
"""

import numpy as np
import pytest

from tests.support import PROBLEMS, convergence, ground_truth
from vmri_jax import explicit_slow, fully_explicit, fully_implicit
from vmri_jax.diagnostics import observed_order

STEPS = (100, 200, 500, 1000, 2000)

# scheme, order of q and p between H = 0.01 and 0.0005, errors of q at H = 0.01 and 0.001, errors of p
TABLE = {
    "fully explicit, 0, 5": (fully_explicit(5, 0.0), (0.98, 0.91), (1.0e-3, 1.1e-4), (8.5e-3, 1.0e-3)),
    "fully explicit, 1/2, 5": (fully_explicit(5, 0.5), (2.00, 2.01), (4.8e-4, 4.9e-6), (1.7e-2, 1.6e-4)),
    "explicit slow, 0, 5": (explicit_slow(5, 0.0), (0.99, 1.46), (1.1e-3, 1.1e-4), (3.4e-2, 8.5e-4)),
    "explicit slow, 1/2, 5": (explicit_slow(5, 0.5), (2.00, 1.99), (1.0e-3, 9.9e-6), (3.1e-2, 3.2e-4)),
    "fully implicit, 5": (fully_implicit(5), (2.00, 1.99), (1.0e-3, 9.9e-6), (3.1e-2, 3.2e-4)),
    "fully implicit, 10": (fully_implicit(10), (2.00, 2.00), (2.5e-4, 2.5e-6), (8.0e-3, 8.1e-5)),
}


@pytest.mark.parametrize("row", TABLE)
def test_errors_and_orders_of_the_table(row):
    scheme, orders, q_errors, p_errors = TABLE[row]
    truth = ground_truth("fpu3_t1")
    macro_dt, e_q, e_p = convergence(PROBLEMS["fpu"](), scheme, truth, STEPS, num_saves=1)
    assert np.allclose(macro_dt[[0, 3]], [0.01, 0.001])
    ratios = np.array([e_q[[0, 3]] / q_errors, e_p[[0, 3]] / p_errors])
    assert np.abs(np.log(ratios)).max() < np.log(1.1)  # measured 0.96 to 1.04
    fitted = [observed_order(macro_dt, e_q), observed_order(macro_dt, e_p)]
    assert fitted == pytest.approx(orders, abs=0.03)  # measured 0.011
