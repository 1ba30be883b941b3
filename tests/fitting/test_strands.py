"""How near strands come, held against circles and against a plain loop over points."""

from __future__ import annotations

import numpy as np
import pytest

from latentds.fitting.homotopy import clear_direction, drawn_homotopy, zoom_homotopy
from latentds.fitting.strands import Strands, crowded


def circle(share=0.95, count=600):
    angle = 2 * np.pi * share * np.linspace(0, 1, count)
    return np.stack([np.cos(angle), np.sin(angle)], 1)


def hairpin(gap, count=600):
    way = np.linspace(-1, 1, count)
    return np.stack([np.abs(way), gap * np.sign(way) / 2], 1)


def test_clearance_is_the_gap_of_a_hairpin_and_nothing_limits_a_line():
    path = hairpin(0.1)
    found = Strands(path).clearance(path)
    assert found[:100] == pytest.approx(0.1, rel=0.05)
    line = np.linspace([0.0, 0], [3, 0], 300)
    assert Strands(line).clearance(line) == pytest.approx(0.3)


def test_strands_to_be_count_before_they_are():
    """A line that is to become a hairpin has none of its own."""
    path = hairpin(0.1)
    line = np.linspace([0.0, 0], [0.5, 0], len(path))
    assert Strands(path).clearance(line).min() < 0.05 <= Strands(line).clearance(line).min()


def test_points_crowd_where_strands_are_close():
    path = crowded(hairpin(0.01), 3000)
    gaps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    assert len(path) > 600
    assert np.median(gaps) < 0.006
    assert np.array_equal(path[[0, -1]], hairpin(0.01)[[0, -1]])


@pytest.mark.parametrize("pivot", [0.0, 0.5, 1.0])
def test_zooming_in_keeps_strands_apart_and_ends_at_the_curve(pivot):
    path = circle()
    curves = zoom_homotopy(path, 40, pivot)
    lengths = np.linalg.norm(np.diff(curves, axis=1), axis=-1).sum(1)
    strands = Strands(path)
    assert np.array_equal(curves[-1], path)
    assert np.ptp(lengths) < 0.02 * lengths[-1]
    assert min(strands.clearance(curve).min() for curve in curves) > 0.9 * strands.clearance(path).min()
    assert np.linalg.matrix_rank(np.diff(curves[0], axis=0), tol=1e-9) == 1


def test_the_clear_direction_passes_a_crossing_in_the_right_order():
    """A loop in the plane, lifted by a hair: seen along the third axis, and from one side alone."""
    t = np.linspace(0, 1, 400)
    angle = 2 * np.pi * np.clip(3 * t - 1, 0, 1)
    loop = np.stack([3 * t + np.sin(angle), 1 - np.cos(angle), 0.01 * t], 1)
    direction, clear = clear_direction(loop)
    assert direction[2] > 0.9
    assert clear > 0.5
    assert clear_direction(loop[:, :2])[1] < 0.05
    curves = drawn_homotopy(loop, direction, 5.0, 60)
    assert np.array_equal(curves[-1], loop)
    assert np.linalg.norm(curves[0][-1] - curves[0][0]) == pytest.approx(5.0)
