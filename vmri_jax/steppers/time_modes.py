"""Modes of time: coordinates of the polynomials on one interval that decouple its stiffness and mass matrix.

With A, B (r, r) the stiffness and the mass matrix of the polynomials, the equations of one interval are decoupled by
the eigenvectors of A^-1 B (Butcher 1976; Hairer, Wanner, *Solving Ordinary Differential Equations II*, IV.8). Complex
arrays are stored as all real parts before all imaginary ones, so that rows fill vector registers.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from vmri_jax.schemes.path import lagrange_basis, lagrange_derivative
from vmri_jax.schemes.quadrature import interpolatory_weights
from vmri_jax.schemes.scheme import Scheme


class TimeModes(NamedTuple):
    """Eigenvectors of ``A^-1 B``, one of every complex pair.

    An axis of size k = 2 m stores m complex slots: m real parts, then m imaginary parts. A slot holds one complex mode,
    or two real modes; an unused half is zero.

    gamma: eigenvalues, real and imaginary parts.
    mode: number of the mode of each half of a slot.
    of_rows: ``A^-T``, from the rows of the momentum equations to increments.
    of_values: from values at the nodes to modes.
    increments, multipliers: from modes to increments, and through A to multipliers.
    """

    gamma: Float[np.ndarray, "2 modes"]
    mode: Int[np.ndarray, "k"]
    of_rows: Float[np.ndarray, "r r"]
    of_values: Float[np.ndarray, "r k"]
    increments: Float[np.ndarray, "k r"]
    multipliers: Float[np.ndarray, "k r"]

    @classmethod
    def of(cls, scheme: Scheme) -> "TimeModes":
        """The modes of a scheme: A has the nodes of the rule of T, B those of the rule of W."""
        a, b = (
            _form(basis, scheme.degree, placed.rule.nodes)[:-1, 1:]
            for basis, placed in ((lagrange_derivative, scheme.kinetic), (lagrange_basis, scheme.fast))
        )
        gamma, vectors = np.linalg.eig(np.linalg.solve(a, b))
        order = np.argsort(-np.sign(np.imag(gamma)), kind="stable")  # Im > 0, Im = 0, Im < 0
        gamma, vectors = gamma[order], vectors[:, order]
        pairs, distinct = int(np.sum(np.imag(gamma) > 0)), int(np.sum(np.imag(gamma) >= 0))
        half = (pairs + distinct + 1) // 2
        first, second = np.arange(half), np.concatenate([np.arange(pairs), np.arange(half, distinct)])

        def parts(z):
            """(k, m) the slots of modes (r, m), zero in unused halves."""
            imaginary = np.where(np.imag(gamma)[:, None] == 0, z.real, z.imag)
            both = z.real[first], imaginary[second]
            return np.concatenate([np.pad(a, [(0, half - len(a)), (0, 0)]) for a in both])

        to = np.linalg.inv(vectors)
        # A mode v z and its conjugate add up to 2 Re(v z) = 2 (Re v Re z - Im v Im z). `parts` keeps Re v and Im v with
        # the sign plus: the minus comes from conj(v).
        back = (np.where(np.imag(gamma) > 0, 2.0, 1.0) * vectors.conj()).T
        mode = np.concatenate([np.pad(a, (0, half - len(a)), mode="edge") for a in (first, second)])
        eigenvalues = np.stack([np.real(gamma), np.imag(gamma)])[:, :distinct]
        return cls(eigenvalues, mode, np.linalg.inv(a).T, parts(to).T, parts(back), parts(back @ a.T))


def _form(basis, degree: int, nodes) -> np.ndarray:
    """``sum_n w_n b_i(c_n) b_j(c_n)`` (r + 1, r + 1), with the functions b of the basis and the interpolatory rule on
    the nodes c_n."""
    values = basis(degree, np.array(nodes))
    return values.T @ (interpolatory_weights(nodes)[:, None] * values)


def times_i(z):
    """``i z`` for complex z, stored as all real parts before all imaginary ones."""
    re, im = jnp.split(z, 2, axis=-1)
    return jnp.concatenate([-im, re], axis=-1)


def product(matrix, z):
    """(rows, k) products of complex matrices, real and imaginary part (columns, rows, k), with vectors z (columns,
    k)."""
    re, im = matrix
    return jnp.sum(re * z[:, None] + im * times_i(z)[:, None], axis=0)
