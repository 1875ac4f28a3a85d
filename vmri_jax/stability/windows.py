"""Unstable intervals of a parameter, located between samples and refined by bisection."""

from collections.abc import Callable, Sequence

import numpy as np

POINTS_PER_CALL = 64
"""Samples that all brackets together get in a call of `label`, the number that `multipliers` computes at a time for small systems; more samples
divide brackets faster, and each costs an eigenvalue problem."""


def find_windows(
    label: Callable[[np.ndarray], Sequence], x: np.ndarray, labels: Sequence, resolution: float
) -> list[tuple[float, float]]:
    """Unstable intervals of x between its first and last value.

    Between neighbouring samples with different labels lies an end of a window, or a whole window. All such brackets are
    divided at the same time, until they are shorter than `resolution`; shorter windows are left out.

    Args:
        label: function of an array of samples that returns a label for each: None for unstable, else any value to compare.
        x: (k,) increasing samples to start from.
        labels: their labels.
        resolution: length of a bracket at which its division ends.
    """
    edges = [x[0]] if labels[0] is None else []
    samples = zip(x, x[1:], labels, labels[1:], strict=False)
    brackets = [(a, b, label_a, label_b) for a, b, label_a, label_b in samples if label_a != label_b]
    while brackets:
        count = max(1, POINTS_PER_CALL // len(brackets))
        fractions = np.arange(1, count + 1) / (count + 1)
        inner = np.array([a + (b - a) * fractions for a, b, _, _ in brackets])
        inner_labels = iter(label(inner.reshape(-1)))
        divided = []
        for (a, b, label_a, label_b), points in zip(brackets, inner, strict=True):
            nodes = [a, *points, b]
            node_labels = [label_a, *(next(inner_labels) for _ in points), label_b]
            pieces = zip(nodes, nodes[1:], node_labels, node_labels[1:], strict=False)
            divided += [piece for piece in pieces if piece[2] != piece[3]]
        brackets = [piece for piece in divided if piece[1] - piece[0] > resolution]
        # Of a short bracket with an unstable side, the stable end: the window includes the bracket. Two different stable labels hide a
        # window shorter than the resolution.
        for a, b, label_a, label_b in divided:
            if b - a <= resolution and None in (label_a, label_b):
                edges.append(a if label_b is None else b)
    if labels[-1] is None:
        edges.append(x[-1])
    edges = [float(edge) for edge in sorted(edges)]
    return list(zip(edges[::2], edges[1::2], strict=True))
