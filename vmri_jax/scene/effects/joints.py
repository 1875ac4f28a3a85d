"""Joints between rigid bodies: each is a set of constraints, listed below.

The point of the joint is at ``phi + rho`` in each body, so that the gap is ``D = phi_b + rho_b - phi_a - rho_a``. The
triad ``(m, m', n)`` is fixed in a and the triad ``(e, e', f)`` in b; they coincide at the start, and n points along the
axis.

| joint | rows |
|---|---|
| spherical | ``D`` |
| universal | ``D``, ``n . e``, e along a second axis |
| revolute | ``D``, ``n . e``, ``n . e'`` |
| fixed | ``D``, ``n . e``, ``n . e'``, ``m . e'`` |
| cylindrical | ``m . D``, ``m' . D``, ``n . e``, ``n . e'`` |
| prismatic | ``m . D``, ``m' . D``, ``n . e``, ``n . e'``, ``m . e'`` |
| screw | ``m . D``, ``m' . D``, ``n . e``, ``n . e'``, ``m' . e cos a - m . e sin a`` with ``a = 2 pi n . D / pitch`` |
| planar | ``n . D``, ``n . e``, ``n . e'`` |

Between macro nodes the interpolated directors of a slow body are a little too short. A row that is a product of vectors
of both triads is then only scaled: it still vanishes for the right directions of the axes.

Source: P. Betsch, S. Leyendecker, Int. J. Numer. Meth. Engng 67 (2006).
"""

from functools import cached_property
from typing import Any

import numpy as np

from vmri_jax.mechanics.arrays import library
from vmri_jax.mechanics.constraints import START_TOLERANCE
from vmri_jax.scene.declare import number
from vmri_jax.scene.effects.joint_base import FREEDOMS, GAP, PARALLEL, AboutAxis, Joint
from vmri_jax.scene.products import products

ACROSS = (("m", "D"), ("m'", "D"))
"""Rows that keep the points of both bodies on one line along the axis n."""
UNTURNED = ("m", "e'")
"""Row that keeps b from turning about the axis n."""


class Spherical(Joint):
    """Ball joints: both bodies share a point; three rows, ``D = 0``.

    Args:
        between, at: as of `Joint`. A body that is a point mass is joined at its position.
    """


class Revolute(AboutAxis):
    """Hinges: b turns about an axis that is fixed in both bodies; five rows, ``D = 0, n . e = n . e' = 0``.

    Args:
        between, at, axis: as of `Joint`, and the axis in space at the start.
    """

    freedoms = ("turn",)


class Universal(AboutAxis):
    """Cardan joints: an axis n of a and an axis e of b stay perpendicular; four rows, ``D = 0, n . e = 0``.

    Args:
        between, at: as of `Joint`.
        axis: (3,) the axis n that is fixed in a, in space at the start; or an axis for each pair, (n, 3).
        second: (3,) the axis e that is fixed in b, perpendicular to `axis` at the start; or an axis for each pair,
            (n, 3).
    """

    second: Any = (1.0, 0.0, 0.0)

    freedoms = ("turn", "tilt")
    rows = (*GAP, ("n", "e"))

    @cached_property
    def triads(self):
        first, second = self._directions("axis"), self._directions("second")
        product, xp = (first * second).sum(axis=-1), library(first, second)
        self.require(abs(product) < START_TOLERANCE, "axis . second", product, "the axes must be perpendicular")
        return [xp.stack([m, xp.cross(n, m), n]) for n, m in zip(first, second, strict=True)]


class Fixed(AboutAxis):
    """Two bodies that move as one; six rows, ``D = 0, n . e = n . e' = m . e' = 0``.

    Args:
        between, at: as of `Joint`.
    """

    rows = (*GAP, *PARALLEL, UNTURNED)


class Cylindrical(AboutAxis):
    """b slides along an axis and turns about it; four rows, ``m . D = m' . D = 0, n . e = n . e' = 0``.

    Args:
        between, at, axis: as of `Revolute`.
    """

    freedoms = ("turn", "slide")
    rows = (*ACROSS, *PARALLEL)


def screwed(q, params):
    """The rows of `Cylindrical` and ``m' . e cos a - m . e sin a``, (..., 5)."""
    # rather than a difference of angles, which would jump by 2 pi after half a turn
    rows, xp = products(len(Screw.rows), q, params), library(q)
    sine, cosine, slide = rows[..., -3], rows[..., -2], rows[..., -1]
    angle = 2 * np.pi * slide / params["pitch"]
    difference = sine * xp.cos(angle) - cosine * xp.sin(angle)
    return xp.concatenate([rows[..., :-3], difference[..., None]], axis=-1)


class Screw(AboutAxis):
    """Nuts on bolts: b moves along the axis as it turns; five rows, the four of `Cylindrical` and
    ``m' . e cos a = m . e sin a``.

    The angle a follows from the distance along the axis, ``a = 2 pi n . D / pitch``.

    Args:
        between, at, axis: as of `Revolute`.
        pitch: how far b moves along the axis per turn, m, not zero, negative for a left-handed screw; one number, or a
            number for each pair. A millimetre by default.
    """

    pitch: Any = number(default=1e-3)

    freedoms = ("turn",)
    rows = (*Cylindrical.rows, *FREEDOMS["turn"], *FREEDOMS["slide"])

    def check_parameters(self):
        super().check_parameters()
        pitch = self.parameters["pitch"]
        self.require(pitch != 0, "pitch", pitch, "it must not be zero; take Revolute if b does not move along the axis")

    @property
    def function(self):
        return screwed


class Planar(AboutAxis):
    """b moves in the plane of m and m' and turns about n; three rows, ``n . D = 0, n . e = n . e' = 0``.

    The freedoms are "along" and "across", the distances along m and m', and "turn". m is the first of the axes x, y, z
    of space that make the largest angle with n, or its part in the plane; m' is n x m: x and y for a normal z, x and -z
    for a normal y, y and z for a normal x.

    Args:
        between, at: as of `Joint`.
        axis: (3,) the normal n of the plane in space at the start; or a normal for each pair, (n, 3).
    """

    freedoms = ("along", "across", "turn")
    rows = (("n", "D"), *PARALLEL)


class Prismatic(AboutAxis):
    """Slides: b moves along an axis and does not turn; five rows, the four of `Cylindrical` and ``m . e' = 0``.

    Args:
        between, at, axis: as of `Revolute`.
    """

    freedoms = ("slide",)
    rows = (*ACROSS, *PARALLEL, UNTURNED)
