"""What lies beside a path: frames, and room for a tube."""

import numpy as np
import pytest

from latentds.curves import frame_along
from latentds.fitting.bundle import bundle, radius

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
