"""What lies beside a path: frames, room for a tube, and how offsets die."""

import numpy as np
import pytest

from latentds.curves import frame_along
from latentds.fitting.bundle import bundle, radius, timing_of

rng = np.random.default_rng


def straight(dim, count=200):
    return np.linspace(1, 0, count)[:, None] * rng(dim).standard_normal(dim)


def arc(angle, dim=2, count=600):
    """A circular arc of radius 1 from (0, 1) on, in the first two coordinates."""
    turned = np.linspace(0, angle, count)
    return np.stack([np.sin(turned), np.cos(turned), *np.zeros((dim - 2, count))], axis=1)


@pytest.mark.parametrize("dim", [1, 2, 3, 7])
def test_a_straight_path_is_its_own_tube(dim):
    path = straight(dim)
    axis = path[-1] - path[0]
    pairs = bundle(path, path, frame_along(axis / np.linalg.norm(axis))[:, 1:])
    np.testing.assert_allclose(pairs.x, pairs.y, atol=1e-12)
    assert len(pairs.weights) == len(pairs.x) > len(path)
    assert (pairs.weights > 0).all()


def test_a_tube_keeps_off_other_strands_and_bends_no_further_than_the_path():
    near = 0.06
    there = np.stack([np.linspace(0, 1, 300), np.zeros(300)], axis=1)
    turn = near / 2 * np.stack([np.sin(np.linspace(0, np.pi, 60)), 1 - np.cos(np.linspace(0, np.pi, 60))], axis=1)
    hairpin = np.concatenate([there, turn + np.array([1, 0]), there[::-1] + np.array([0, near])])
    assert radius(hairpin, hairpin, 0.2)[[100, 500]].max() < near / 2
    round_ = arc(2.0)
    assert radius(round_, round_, 5.0)[100:-100].max() < 1  # of radius 1 itself


def smooth_fall(start, count=400):
    """From ``start`` at rest to 0 at rest, evenly in time."""
    t = np.linspace(0, 1, count)
    return start * (1 - (10 * t**3 - 15 * t**4 + 6 * t**5))


def test_equal_motions_keep_their_timing():
    times = np.linspace(0, 3, 400)
    way, found = timing_of(np.stack([smooth_fall(1.0)] * 2), np.stack([times] * 2))
    assert found[0] == 0
    assert way[0] == 1
    assert way[-1] == 0
    assert (np.diff(found) > 0).all()
    assert (np.diff(way) < 0).all()
    assert abs(np.interp(times, found, way) - smooth_fall(1.0)).max() < 0.02


def test_who_starts_behind_does_not_wait_where_others_stood():
    starts, times = (1.25, 1.0, 0.8), np.linspace(0, 3, 400)
    progress = np.stack([smooth_fall(start) for start in starts])
    way, found = timing_of(progress, np.stack([times] * 3))
    takes = found[-1] - np.interp(-np.array(starts), -way, found)
    assert takes[0] < 3.3  # at the mean speed before the others' start, and at rest there, it would be 3.7
    assert abs(takes - 3).max() < 0.45
    slow = timing_of(progress, np.stack([1000 * times] * 3))
    np.testing.assert_allclose(slow[1], 1000 * found, rtol=1e-9)
