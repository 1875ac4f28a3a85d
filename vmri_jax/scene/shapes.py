"""Solid shapes of rigid bodies: their moments of inertia, and the corners and faces that are drawn."""

from dataclasses import dataclass

import numpy as np

from vmri_jax.mechanics.arrays import library

SIDES = 20
"""Side faces of a drawn cylinder. More look rounder and take longer to draw."""

Polyhedron = tuple[np.ndarray, list[list[int]]]
"""Corners (n, 3) in the axes of a body, and faces as lists of numbers of corners, anticlockwise as seen from
outside."""


@dataclass(frozen=True)
class Box:
    """A solid box with edges (a, b, c), m, along the axes of the body; an edge of zero makes a plate."""

    edges: tuple[float, float, float]

    def inertia(self, mass):
        """``J_1 = m (b^2 + c^2) / 12`` and so on, (3,) kg m^2."""
        squares = library(self.edges).asarray(self.edges) ** 2
        return mass * (squares.sum() - squares) / 12

    def polyhedron(self) -> Polyhedron:
        """Eight corners and six faces."""
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        faces = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
        return signs * np.asarray(self.edges, dtype=float) / 2, faces


@dataclass(frozen=True)
class Cylinder:
    """A solid cylinder with this radius and length, m, its axis along the third axis of the body."""

    radius: float
    length: float

    def inertia(self, mass):
        """``J_1 = J_2 = m (3 r^2 + l^2) / 12``, ``J_3 = m r^2 / 2``, (3,) kg m^2."""
        across = mass * (3 * self.radius**2 + self.length**2) / 12
        return library(across, self.radius).stack([across, across, mass * self.radius**2 / 2])

    def polyhedron(self) -> Polyhedron:
        """Two polygons with `SIDES` corners each, and the side faces between them."""
        angle = 2 * np.pi * np.arange(SIDES) / SIDES
        circle = self.radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        ends = [np.column_stack([circle, np.full(SIDES, z)]) for z in (-self.length / 2, self.length / 2)]
        around = [[i, (i + 1) % SIDES, SIDES + (i + 1) % SIDES, SIDES + i] for i in range(SIDES)]
        return np.concatenate(ends), [*around, [*range(SIDES)][::-1], [*range(SIDES, 2 * SIDES)]]


@dataclass(frozen=True)
class Ball:
    """A solid ball with this radius, m."""

    radius: float

    def inertia(self, mass):
        """``J = 2 m r^2 / 5``, (3,) kg m^2."""
        return np.ones(3) * (0.4 * mass * self.radius**2)


@dataclass(frozen=True)
class Rod:
    """A thin rod of this length, m, along the third axis of the body; it has no directors across."""

    length: float

    def inertia(self, mass):
        """``J_1 = J_2 = m l^2 / 12``, ``J_3 = 0``, (3,) kg m^2."""
        across = mass * self.length**2 / 12
        return library(across).stack([across, across, 0 * across])


Shape = Box | Cylinder | Ball | Rod


def box_of(mass: float, moments) -> Box:
    """The solid box with this mass, kg, and these principal moments of inertia (3,), kg m^2."""
    # J_1 = m (b^2 + c^2) / 12 and so on, solved for the squares of the edges: a^2 = 6 (J_1 + J_2 + J_3 - 2 J_1) / m
    squares = 6 * (np.sum(moments) - 2 * np.asarray(moments)) / mass
    a, b, c = np.sqrt(np.maximum(squares, 0.0)).tolist()
    return Box((a, b, c))
