"""diffrax with equations made by automatic differentiation."""

from functools import partial

from benchmarks.peers import autodiff, diffrax

ladders = partial(diffrax.ladders, equations=autodiff)
batch_ladders = partial(diffrax.batch_ladders, equations=autodiff)
energy = autodiff.energy
