"""Curves: lengths, resampling, frames, noise, distances."""

from __future__ import annotations

import math

import numpy as np
import pytest

from latentds.curves import (
    arc_lengths,
    directions_along,
    evenly_resampled,
    interpolated,
    jitter,
    segment_distances,
    transported_frames,
)


def arc(angle, dim=2, count=600):
    """A circular arc of radius 1 from (0, 1) on, in the first two coordinates."""
    turned = np.linspace(0, angle, count)
    return np.stack([np.sin(turned), np.cos(turned), *np.zeros((dim - 2, count))], axis=1)


@pytest.mark.parametrize("dim", [2, 3, 7])
def test_frames_are_right_handed_and_their_turning_leads_from_one_to_the_next(dim):
    path = np.cumsum(np.cumsum(np.random.default_rng(0).standard_normal((300, dim)), axis=0) + 40, axis=0)
    tangents = directions_along(path)
    frames, turning = transported_frames(tangents)
    np.testing.assert_allclose(frames[:, :, 0], tangents, atol=1e-9)
    np.testing.assert_allclose(frames.mT @ frames, np.broadcast_to(np.eye(dim), frames.shape), atol=1e-10)
    np.testing.assert_allclose(np.linalg.det(frames), 1, atol=1e-9)
    cosines = (tangents[1:] * tangents[:-1]).sum(1)
    np.testing.assert_allclose(np.cos(np.linalg.norm(turning, axis=1)), cosines, atol=1e-9)


def test_frames_turn_no_more_than_the_curve():
    across = transported_frames(directions_along(arc(3.0, 3)))[0][:, :, 1:]
    upright = across[:, 2]  # what of the normals stands upright on a flat curve stays so
    assert np.ptp(upright, axis=0).max() < 1e-12
    line = np.linspace(1, 0, 200)[:, None] * np.random.default_rng(5).standard_normal(5)
    assert np.ptp(transported_frames(directions_along(line))[0], axis=0).max() < 1e-11


def test_resampled_points_are_even_in_arc_length():
    uneven = arc(2.0)[np.unique((599 * np.linspace(0, 1, 600) ** 2).round().astype(int))]
    steps = np.diff(arc_lengths(evenly_resampled(uneven, 9)))
    np.testing.assert_allclose(steps, 2 * math.sin(2.0 / 16), rtol=1e-3)


def test_interpolation_is_linear_and_held_beyond_the_ends():
    known, points = np.array([0.0, 1.0, 3.0]), np.eye(3)[:, :2]
    np.testing.assert_allclose(interpolated(np.array([-1.0, 2.0, 9.0]), known, points), [[1, 0], [0, 0.5], [0, 0]])


def test_distances_of_segments_are_those_of_their_points():
    draw = np.random.default_rng(0)
    start, step, other_start, other = draw.standard_normal((4, 50, 3))
    share = np.linspace(0, 1, 201)
    first = start[:, None] + share[:, None] * step[:, None]
    second = other_start[:, None] + share[:, None] * other[:, None]
    tried = np.linalg.norm(first[:, :, None] - second[:, None], axis=-1).min((1, 2))
    found = segment_distances(start - other_start, step, other)
    assert (found <= tried + 1e-12).all()
    assert np.abs(found - tried).max() < 0.03


def test_arc_lengths_are_those_of_the_polygon():
    points = np.random.default_rng(0).standard_normal((20, 3))
    expected = [sum(math.dist(points[j], points[j + 1]) for j in range(i)) for i in range(20)]
    np.testing.assert_allclose(arc_lengths(points), expected, rtol=1e-14)


@pytest.mark.parametrize("order", [2, 4])
@pytest.mark.parametrize("dim", [1, 3])
def test_jitter_is_the_noise_and_none_of_the_motion(order, dim):
    """A polynomial of a lower degree than the order does not show; noise does, as long as its median."""
    draw = np.random.default_rng(0)
    time, noise = np.linspace(0, 1, 4000)[:, None], 0.03 * draw.standard_normal((4000, dim))
    motion = sum(draw.standard_normal(dim) * time**k for k in range(order))
    assert jitter(motion, order) < 1e-12
    assert jitter(motion + noise, order) == pytest.approx(np.median(np.linalg.norm(noise, axis=1)), rel=0.05)


def test_jitter_reads_second_differences_unless_told():
    positions = np.random.default_rng(0).standard_normal((9, 2))
    assert jitter(positions) == jitter(positions, 2) != jitter(positions, 4)
