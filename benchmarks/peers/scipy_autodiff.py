"""scipy with equations made by automatic differentiation."""

from functools import partial

from benchmarks.peers import autodiff, scipy

ladders = partial(scipy.ladders, equations=autodiff)
energy = autodiff.energy
