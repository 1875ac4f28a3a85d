"""Constant masses: a mass matrix, stored as its diagonal if it is diagonal."""

from collections.abc import Mapping

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from vmri_jax import kernels
from vmri_jax.mechanics.arrays import Numbers, is_concrete, real_array
from vmri_jax.refusals import Refused


class Diagonal(eqx.Module):
    """A diagonal mass matrix of positive masses."""

    masses: Float[Numbers, "n"]

    @property
    def size(self) -> int:
        """Number of coordinates n."""
        return self.masses.shape[0]

    @property
    def matrix(self):
        """``M`` as an array (n, n)."""
        return jnp.diag(self.masses)

    def times(self, v):
        """``M v`` for (..., n)."""
        return self.masses * v

    def solve(self, p):
        """``M^-1 p`` for (..., n)."""
        return p * (1 / self.masses)

    def inverse(self) -> "Diagonal":
        """``M^-1`` as an operator, computed once."""
        return Diagonal(1 / self.masses)


class Dense(eqx.Module):
    """A full mass matrix, symmetric positive definite."""

    matrix: Float[Numbers, "n n"]

    @property
    def size(self) -> int:
        """Number of coordinates n."""
        return self.matrix.shape[0]

    def times(self, v):
        """``M v`` for (..., n)."""
        return kernels.matvec(self.matrix, v)

    def solve(self, p):
        """``M^-1 p`` for (..., n)."""
        return jnp.linalg.solve(self.matrix, p[..., None])[..., 0]

    def inverse(self) -> "Dense":
        """``M^-1`` as an operator, computed once."""
        return Dense(kernels.inverse(self.matrix))


def mass_array(name: str, mass):
    """Masses (n,), or a mass matrix (n, n), as `ConstantMass` takes them: an array of float64.

    Lists and NumPy arrays become a NumPy array, which keeps all digits even before 64-bit mode is on.
    """
    mass = real_array(f"ConstantMass: {name}", mass)
    if mass.ndim not in (1, 2) or (mass.ndim == 2 and mass.shape[0] != mass.shape[1]):
        raise Refused(f"ConstantMass: {name} has shape {mass.shape}; give (n,) masses or an (n, n) mass matrix.")
    if not is_concrete(mass):
        return mass
    values = np.asarray(mass)
    if not np.all(np.isfinite(values)):
        raise Refused(f"ConstantMass: {name} = {values} is not finite.")
    if mass.ndim == 1 and np.any(values <= 0):
        raise Refused(f"ConstantMass: {name} = {values}; every mass must be positive.")
    if mass.ndim == 2:
        scaled = correlation(values)
        if not np.allclose(scaled, scaled.T) or np.any(np.linalg.eigvalsh(scaled) <= 0):
            raise Refused(f"ConstantMass: {name} must be a symmetric positive definite matrix.")
    return mass


def correlation(matrix: np.ndarray) -> np.ndarray:
    """A matrix over the square roots of its diagonal, ``M_ij / sqrt(M_ii M_jj)``: the units of its coordinates cancel."""
    diagonal = np.diagonal(matrix)
    root = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    return matrix / root[:, None] / root


class ConstantMass(eqx.Module):
    """Kinetic energy ``T = v_s^T M_s v_s / 2 + v_f^T M_f v_f / 2`` with constant masses.

    Args:
        slow, fast: (n,) masses per coordinate, or an (n, n) symmetric positive definite mass matrix. If q_s and q_f are dictionaries: a
            dictionary with the mass of each body. An array with the leading axes of the position is per row: for positions (atoms, 3) a
            number is the mass of all atoms, (atoms,) has a mass for each atom, and (atoms, 3) a mass for each coordinate.

    Raises:
        TypeError: masses that are not real numbers.
        ValueError: a mass that is not positive, a matrix that is not symmetric positive definite, arrays of float32.
    """

    slow: Float[Numbers, "n_s"] | Float[Numbers, "n_s n_s"]
    fast: Float[Numbers, "n_f"] | Float[Numbers, "n_f n_f"]

    def __init__(self, slow, fast):
        self.slow, self.fast = _masses("slow", slow), _masses("fast", fast)

    @property
    def slow_mass(self) -> Diagonal | Dense:
        """``M_s`` as an operator."""
        return _operator(self.slow)

    @property
    def fast_mass(self) -> Diagonal | Dense:
        """``M_f`` as an operator."""
        return _operator(self.fast)

    def __call__(self, q_s, q_f, v_s, v_f, params):
        p_s, p_f = self.momentum(v_s, v_f)
        return (jnp.sum(v_s * p_s) + jnp.sum(v_f * p_f)) / 2

    def momentum(self, v_s, v_f):
        """``(M_s v_s, M_f v_f)``, over any leading axes."""
        return self.slow_mass.times(v_s), self.fast_mass.times(v_f)

    def velocity(self, p_s, p_f):
        """``(M_s^-1 p_s, M_f^-1 p_f)``, over any leading axes."""
        return self.slow_mass.solve(p_s), self.fast_mass.solve(p_f)


def _masses(name: str, mass):
    if isinstance(mass, Mapping):
        return {body: _positive(f"ConstantMass: {name}[{body!r}]", value) for body, value in mass.items()}
    return mass_array(name, mass)


def _positive(name: str, mass):
    mass = real_array(name, mass)
    if is_concrete(mass) and not (np.isfinite(mass).all() and np.all(np.asarray(mass) > 0)):
        raise Refused(f"{name} = {mass}; every mass must be positive and finite.")
    return mass


def _operator(mass) -> Diagonal | Dense:
    if isinstance(mass, dict):
        raise Refused(
            f"ConstantMass: the masses of {', '.join(mass)} are given by name, and the sizes of these bodies are not known. Give the start "
            "as dictionaries, too: vmri_jax.Problem(system, q_s={...}, q_f={...})."
        )
    return Diagonal(mass) if mass.ndim == 1 else Dense(mass)
