"""How near the strands of a curve come to one another."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..arguments import Array
from ..curves import arc_lengths, interpolated, segment_distances, step_lengths


class Strands:
    """The strands of a curve (N, n) and of those that it comes from, all of as many points.

    Two points are of two strands if one lies farther along a curve than half a circle whose diameter is their distance:
    along the final curve, or along the one that is looked at. Looked at on polygons through so many points.
    """

    def __init__(self, final: Array, points: int = 150) -> None:
        self.chosen = np.unique(np.linspace(0, len(final) - 1, points).round().astype(int))
        self.pairs = np.stack(np.triu_indices(len(self.chosen) - 1, 2))
        self.final = self._apart(final)

    def clearance(self, curve: Array) -> Array:
        """How far each point is from other strands, at most a tenth of the curve's length: (N, n) -> (N,)."""
        first, second = self.pairs[:, self.final | self._apart(curve)]
        corners = curve[self.chosen]
        step = np.diff(corners, axis=0)
        nearest = np.full(len(corners), 0.1 * step_lengths(corners).sum())
        if len(first):
            apart = segment_distances(corners[first] - corners[second], step[first], step[second])
            for ends in (first, first + 1, second, second + 1):
                np.minimum.at(nearest, ends, apart)
        clearance: Array = np.interp(np.arange(len(curve)), self.chosen, nearest)
        return clearance

    def _apart(self, curve: Array) -> NDArray[np.bool_]:
        """Which pairs of segments are of two strands of this curve, by their middles."""
        arc = arc_lengths(curve)[self.chosen]
        middle, along = (curve[self.chosen][1:] + curve[self.chosen][:-1]) / 2, (arc[1:] + arc[:-1]) / 2
        first, second = self.pairs
        squared = sum((column[second] - column[first]) ** 2 for column in middle.T)
        apart: NDArray[np.bool_] = (along[second] - along[first]) ** 2 > (0.5001 * math.pi) ** 2 * squared
        return apart


def crowded(curve: Array, most: int) -> Array:
    """Points of a curve (N, n), denser where its strands are close: at most ``most`` of them, (m, n).

    Even in arc length but for that; as many as leave half of the clearance between two of them, from 600 on.
    """
    arc = arc_lengths(curve)
    density = np.maximum(600 / arc[-1], 2 / np.maximum(Strands(curve, 600).clearance(curve), 1e-12))
    count = np.concatenate([[0.0], np.cumsum((density[1:] + density[:-1]) / 2 * np.diff(arc))])
    even = np.interp(np.linspace(0, count[-1], min(most, math.ceil(count[-1]) + 1)), count, arc)
    points = interpolated(even, arc, curve)
    points[[0, -1]] = curve[[0, -1]]
    return points
