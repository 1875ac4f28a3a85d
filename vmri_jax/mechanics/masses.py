"""Constant masses: a mass matrix, stored as its diagonal if it is diagonal."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from vmri_jax import kernels
from vmri_jax.mechanics.arrays import Numbers, is_concrete, library, real_array
from vmri_jax.refusals import Refused


class MassMatrix(eqx.Module):
    """A constant mass matrix: positive masses, its diagonal, or a full symmetric positive definite matrix."""

    entries: Float[Numbers, "n"] | Float[Numbers, "n n"]

    @property
    def is_diagonal(self) -> bool:
        """Whether the entries are masses."""
        return self.entries.ndim == 1

    @property
    def size(self) -> int:
        """Number of coordinates n."""
        return self.entries.shape[0]

    def times(self, v):
        """``M v`` for (..., n)."""
        return self.entries * v if self.is_diagonal else kernels.matvec(self.entries, v)

    def solve(self, p):
        """``M^-1 p`` for (..., n)."""
        return p * (1 / self.entries) if self.is_diagonal else jnp.linalg.solve(self.entries, p[..., None])[..., 0]

    def inverse(self) -> "MassMatrix":
        """``M^-1`` as an operator, computed once."""
        return MassMatrix(1 / self.entries if self.is_diagonal else kernels.inverse(self.entries))


def correlation(matrix: np.ndarray) -> np.ndarray:
    """A matrix over the square roots of its diagonal, ``M_ij / sqrt(M_ii M_jj)``: the units of its coordinates
    cancel."""
    diagonal = np.diagonal(matrix)
    root = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    return matrix / root[:, None] / root


class ConstantMass(eqx.Module):
    """Kinetic energy ``T = v_s^T M_s v_s / 2 + v_f^T M_f v_f / 2`` with constant masses.

    Args:
        slow, fast: (n,) masses per coordinate, or an (n, n) symmetric positive definite mass matrix. If q_s and q_f are
            dictionaries: a dictionary with the mass of each body. An array with the leading axes of the position is per
            row: for positions (atoms, 3) a number is the mass of all atoms, (atoms,) has a mass for each atom, and
            (atoms, 3) a mass for each coordinate.

    Raises:
        TypeError: masses that are not real numbers.
        ValueError: a mass that is not positive, a matrix that is not symmetric positive definite, arrays of float32.
    """

    slow: Float[Numbers, "n_s"] | Float[Numbers, "n_s n_s"]
    fast: Float[Numbers, "n_f"] | Float[Numbers, "n_f n_f"]

    def __init__(self, slow, fast):
        self.slow, self.fast = _masses("ConstantMass: slow", slow), _masses("ConstantMass: fast", fast)

    @property
    def slow_mass(self) -> MassMatrix:
        """``M_s`` as an operator."""
        return _operator(self.slow)

    @property
    def fast_mass(self) -> MassMatrix:
        """``M_f`` as an operator."""
        return _operator(self.fast)

    @property
    def is_diagonal(self) -> bool:
        """Whether there are masses alone, no matrix."""
        return self.slow_mass.is_diagonal and self.fast_mass.is_diagonal

    @property
    def diagonal(self):
        """The diagonals (n_s,) of M_s and (n_f,) of M_f."""
        return tuple(mass if mass.ndim == 1 else jnp.diagonal(mass) for mass in (self.slow, self.fast))

    @property
    def matrix(self):
        """The mass matrix (n_s + n_f, n_s + n_f), of NumPy if the masses are known."""
        xp = library(self)
        slow, fast = (mass if mass.ndim == 2 else xp.diag(mass) for mass in (self.slow, self.fast))
        corner = xp.zeros((len(slow), len(fast)))
        return xp.block([[slow, corner], [corner.T, fast]])

    def __call__(self, q_s, q_f, v_s, v_f, params):
        p_s, p_f = self.momentum(v_s, v_f)
        return (jnp.sum(v_s * p_s) + jnp.sum(v_f * p_f)) / 2

    def momentum(self, v_s, v_f):
        """``(M_s v_s, M_f v_f)``, over any leading axes."""
        return self.slow_mass.times(v_s), self.fast_mass.times(v_f)

    def velocity(self, p_s, p_f):
        """``(M_s^-1 p_s, M_f^-1 p_f)``, over any leading axes."""
        return self.slow_mass.solve(p_s), self.fast_mass.solve(p_f)


class WithMassMatrix(ABC):
    """A kinetic energy that may have the form ``T = v^T M v / 2`` with masses M, functions of the positions, in closed
    form."""

    @property
    @abstractmethod
    def has_mass_matrix(self) -> bool:
        """Whether it has this form."""

    @abstractmethod
    def mass_matrix(self, q_s, q_f, params, *others: Any) -> Any:
        """M (n, n) of this energy and of `others` of its system, which have this form, too."""


def _masses(name: str, masses):
    """Masses as `ConstantMass` takes them, as float64: lists and NumPy arrays as NumPy arrays, which keep all digits
    before 64-bit mode is on."""
    if isinstance(masses, Mapping) and masses:
        return {
            body: _positive(f"{name}[{body!r}]", real_array(f"{name}[{body!r}]", mass)) for body, mass in masses.items()
        }
    masses = real_array(name, [] if isinstance(masses, Mapping) else masses)  # without bodies a vector without entries
    if masses.ndim == 1:
        return _positive(name, masses)
    if masses.ndim != 2 or masses.shape[0] != masses.shape[1]:
        raise Refused(f"{name} has shape {masses.shape}; give (n,) masses or an (n, n) mass matrix.")
    if is_concrete(masses):
        with np.errstate(invalid="ignore"):  # of infinities, which are not symmetric below
            scaled = correlation(np.asarray(masses))
        if not np.allclose(scaled, scaled.T) or np.any(np.linalg.eigvalsh(scaled) <= 0):
            raise Refused(f"{name} must be a symmetric positive definite matrix.")
    return masses


def _positive(name: str, masses):
    if is_concrete(masses) and not (np.isfinite(masses).all() and np.all(np.asarray(masses) > 0)):
        raise Refused(f"{name} = {masses}; every mass must be positive and finite.")
    return masses


def _operator(masses) -> MassMatrix:
    if isinstance(masses, dict):
        raise Refused(
            f"ConstantMass: the masses of {', '.join(masses)} are given by name, and the sizes of these bodies are not "
            "known. Give the start as dictionaries, too: vmri_jax.Problem(system, q_s={...}, q_f={...})."
        )
    return MassMatrix(masses)
