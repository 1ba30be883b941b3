"""How near the strands of a curve come to one another."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def segment_distances(gap: Array, step: Array, other: Array) -> tuple[Array, Array]:
    """Distances of pairs of segments, a + s step and b + t other with s, t in [0, 1] and gap = a - b; and t: (m,) each.

    (m, n) each. Clamp one, solve for the other, clamp, solve back.
    """
    a, e = (step**2).sum(1), (other**2).sum(1)
    b, c, f = (step * other).sum(1), (step * gap).sum(1), (other * gap).sum(1)
    denominator = a * e - b * b
    s = np.clip(np.where(denominator > 1e-12 * a * e, (b * f - c * e) / np.maximum(denominator, 1e-300), 0.0), 0, 1)
    t = np.clip((b * s + f) / np.maximum(e, 1e-300), 0, 1)
    s = np.clip((b * t - c) / np.maximum(a, 1e-300), 0, 1)
    return np.linalg.norm(gap + s[:, None] * step - t[:, None] * other, axis=1), t


def clearance(curve: Array, points: int = 150) -> Array:
    """How far each point of a curve (N, n) is from other strands, at most a tenth of the curve's length: (N,).

    Another strand is what lies farther along the curve than half a circle of that diameter. Looked at on a polygon
    through so many points.
    """
    chosen = np.unique(np.linspace(0, len(curve) - 1, points).round().astype(int))
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    corners, along = curve[chosen], arc[chosen]
    first, second = np.triu_indices(len(corners) - 1, 2)
    step = np.diff(corners, axis=0)
    middle = (corners[1:] + corners[:-1]) / 2
    # a pair is of two strands if its middles are: near the end of one arc segments come as close as one likes
    span = (along[second + 1] + along[second] - along[first + 1] - along[first]) / 2
    strands = span > 0.5001 * math.pi * np.linalg.norm(middle[first] - middle[second], axis=1)
    first, second = first[strands], second[strands]
    nearest = np.full(len(corners), 0.1 * arc[-1])
    if len(first):
        apart = segment_distances(corners[first] - corners[second], step[first], step[second])[0]
        for ends in (first, first + 1, second, second + 1):
            np.minimum.at(nearest, ends, apart)
    found: Array = np.interp(np.arange(len(curve)), chosen, nearest)
    return found


def crowded(curve: Array, most: int) -> Array:
    """Points of a curve (N, n), denser where its strands are close: at most ``most`` of them, (m, n).

    Even in arc length but for that; as many as leave half of the clearance between two of them, from 600 on.
    """
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    density = np.maximum(600 / arc[-1], 2 / np.maximum(clearance(curve, 600), 1e-12))
    count = np.concatenate([[0.0], np.cumsum((density[1:] + density[:-1]) / 2 * np.diff(arc))])
    even = np.interp(np.linspace(0, count[-1], min(most, math.ceil(count[-1]) + 1)), count, arc)
    points: Array = np.stack([np.interp(even, arc, column) for column in curve.T], axis=1)
    points[[0, -1]] = curve[[0, -1]]
    return points


def progress_along(curve: Array) -> Array:
    """Share of the length of a curve (N, n) up to each of its points, 0 to 1: (N,)."""
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    share: Array = arc / arc[-1]
    return share
