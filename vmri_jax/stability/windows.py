"""Intervals of a parameter in which something is unstable, found between samples and refined by bisection."""

from collections.abc import Callable, Sequence

import numpy as np

POINTS = 64
"""Samples per call."""


def find_windows(
    label: Callable[[np.ndarray], Sequence], x: np.ndarray, labels: Sequence, resolution: float
) -> list[tuple[float, float]]:
    """Unstable intervals of x between its first and last value.

    Neighbouring samples with different labels hold an end of a window between them, or a whole one. Such intervals are
    divided again and again, all at the same time, until they are shorter than `resolution`; a window shorter than that is
    left out.

    Args:
        label: of an array of samples; None means unstable, anything else is compared.
        x: (k,) increasing samples to start from.
        labels: their labels.
        resolution: length.
    """
    found = [x[0]] if labels[0] is None else []
    samples = zip(x, x[1:], labels, labels[1:], strict=False)
    brackets = [(a, b, at_a, at_b) for a, b, at_a, at_b in samples if at_a != at_b]
    while brackets:
        between = max(1, POINTS // len(brackets))
        fractions = np.arange(1, between + 1) / (between + 1)
        inner = np.array([a + (b - a) * fractions for a, b, _, _ in brackets])
        inner_labels = iter(label(inner.reshape(-1)))
        divided = []
        for (a, b, at_a, at_b), points in zip(brackets, inner, strict=True):
            nodes = [a, *points, b]
            at = [at_a, *(next(inner_labels) for _ in points), at_b]
            divided += [piece for piece in zip(nodes, nodes[1:], at, at[1:], strict=False) if piece[2] != piece[3]]
        brackets = [piece for piece in divided if piece[1] - piece[0] > resolution]
        found += [
            a if at_b is None else b for a, b, at_a, at_b in divided if b - a <= resolution and None in (at_a, at_b)
        ]
    if labels[-1] is None:
        found.append(x[-1])
    found = [float(edge) for edge in sorted(found)]
    return list(zip(found[::2], found[1::2], strict=True))
