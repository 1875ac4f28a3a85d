"""Trials: runs of a scheme with their errors, and the seconds of their steps."""

from dataclasses import dataclass, replace

import numpy as np

from vmri_jax.accuracy.companions import Compared
from vmri_jax.accuracy.families import Family
from vmri_jax.running.simulation import Simulation
from vmri_jax.running.timing import least_seconds

LEAST_TIME = 0.02
"""Least seconds a and b N in ``a + b N``, as a part of the seconds of a macro step, and of the steps of a run, as a
part of its seconds, since the noise of the clock may make them zero. A larger value changes the number of
micro steps less."""
FEWEST_SAMPLES = 4
"""Least samples of the seconds of a run, of which the least counts. With fewer of them other programs on the machine
distort the prices of the steps."""
MOST_SAMPLES = 24
"""Most samples, of short runs, whose time is mostly the call; with fewer its noise hides the time of the steps."""
SAMPLED_SECONDS = 0.1
"""Seconds of all samples, unless their number ends them; a larger value makes searches longer and prices surer."""
TIMED_SECONDS = 0.02
"""Seconds of a run after which its timing ends; with a larger value searches with long runs take longer."""


@dataclass(frozen=True)
class Trial(Compared):
    """A run of a scheme of a family, its companion and its errors."""

    family: Family
    num_micro: int

    @property
    def python(self) -> str:
        """The Python expression of the scheme, which identifies it in a search."""
        return self.family.python.format(self.num_micro)

    def steps_for(self, error: float, order: float | None = None) -> int:
        """Macro steps for this error, ``n (e / error)^(1 / p)``, with the order of the scheme if None is given."""
        return max(1, int(np.ceil(self.run.num_steps * (self.error / error) ** (1 / (order or self.run.order)))))


def seconds_of_steps(*runs: Simulation) -> np.ndarray:
    """Seconds of a macro step of each run, ``(T(2 n) - T(n)) / n``: the difference cancels the fixed cost of a call."""
    timed = [_begin_of(run) for run in runs]
    doubles = [replace(run, num_steps=2 * run.num_steps, save_every=2 * run.save_every) for run in timed]
    calls = [run.in_pieces for run in (*timed, *doubles)]
    samples = int(np.clip(SAMPLED_SECONDS / (sum(least_seconds(calls, 1)) or np.inf), FEWEST_SAMPLES, MOST_SAMPLES))
    single, double = np.reshape(least_seconds(calls, samples), (2, -1))
    num_steps = [run.num_steps for run in timed]
    return np.maximum(double - single, LEAST_TIME * double) / num_steps  # noise may make the difference negative


def _begin_of(run: Simulation) -> Simulation:
    """The run, or its begin where the run takes longer than `TIMED_SECONDS`."""
    saves = int(np.clip(run.num_saves * TIMED_SECONDS / least_seconds([run.in_pieces], 1)[0], 1, run.num_saves))
    return replace(run, num_steps=run.save_every * saves)
