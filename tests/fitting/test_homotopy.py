"""Isotopies begin on a line, end on the curve, and unbending keeps every segment as long as it is."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from latentds.curves import laid_on
from latentds.fitting.homotopy import curvature_homotopy, linear_homotopy
from latentds.testing import wavy_motion


def lengths(curves):
    return np.linalg.norm(np.diff(curves, axis=-2), axis=-1)


def zigzag(dim):
    """Turns straight back twice: no rotation is the smallest there."""
    x = np.zeros((5, dim))
    x[:, 0] = [0, 1, 0.4, 1.2, 2.0]
    return x


CURVES = {f"{dim}-D": wavy_motion(dim, n_points=80).positions.numpy() for dim in (1, 2, 3, 7)}
CURVES |= {f"zigzag {dim}-D": zigzag(dim) for dim in (1, 2, 3, 7)}


each_curve = pytest.mark.parametrize("curve", CURVES.values(), ids=CURVES.keys())
bending = pytest.mark.parametrize("curve", [c for c in CURVES.values() if c.shape[1] > 1])


@pytest.mark.parametrize("steps", [1, 7])
@each_curve
def test_straight_isotopy_moves_every_point_evenly(curve, steps):
    line = np.linspace(curve[0], curve[-1], len(curve))
    curves = linear_homotopy(line, curve, steps)
    assert curves.shape == (steps + 1, *curve.shape)
    assert np.array_equal(curves[0], line)
    np.testing.assert_allclose(curves[-1], curve, rtol=0, atol=1e-15)
    np.testing.assert_allclose(np.diff(curves, axis=0), np.tile((curve - line) / steps, (steps, 1, 1)), atol=1e-14)


@pytest.mark.parametrize("steps", [1, 7])
@each_curve
def test_unbending_ends_on_the_curve_and_stretches_nothing(curve, steps):
    curves = curvature_homotopy(curve, steps)
    assert curves.shape == (steps + 1, *curve.shape)
    assert np.array_equal(curves[-1], curve)
    np.testing.assert_allclose(lengths(curves), np.tile(lengths(curve), (steps + 1, 1)), rtol=1e-12)


@each_curve
def test_unbending_begins_with_a_straight_rod(curve):
    rod = curvature_homotopy(curve, 5)[0]
    along = (rod[-1] - rod[0]) / np.linalg.norm(rod[-1] - rod[0])
    np.testing.assert_allclose(np.diff(rod, axis=0), lengths(rod)[:, None] * along, rtol=0, atol=1e-12)


@bending
def test_unbending_turns_evenly(curve):
    """In every step the angles between neighbouring segments grow by the same share."""
    curves = curvature_homotopy(curve, 4)
    tangents = np.diff(curves, axis=1) / lengths(curves)[..., None]
    angles = np.arctan2(
        np.linalg.norm(np.diff(tangents, axis=1), axis=-1) / 2,
        np.linalg.norm(tangents[:, 1:] + tangents[:, :-1], axis=-1) / 2,
    )
    np.testing.assert_allclose(angles, np.linspace(0, 1, 5)[:, None] * angles[-1], rtol=0, atol=1e-7)


@each_curve
def test_each_curve_lies_rigidly_nearest_to_the_next(curve):
    """No small shift or rotation brings one nearer to its successor."""
    curves = curvature_homotopy(curve, 6)
    rng = np.random.default_rng(0)
    dim = curve.shape[1]
    for one, after in pairwise(curves):
        best = ((one - after) ** 2).sum()
        for _ in range(20):
            skew = 1e-3 * np.triu(rng.standard_normal((dim, dim)), 1)
            turn = np.linalg.qr(np.eye(dim) + skew - skew.T)[0]
            turn *= np.sign(np.diag(turn))
            middle = one.mean(0)
            moved = (one - middle) @ turn + middle + 1e-3 * rng.standard_normal(dim)
            assert ((moved - after) ** 2).sum() >= best - 1e-12


def test_a_curve_is_laid_on_its_mirror_image_without_being_mirrored():
    t = np.linspace(0, 4, 50)[:, None]
    helix = np.hstack([np.cos(t), np.sin(t), 0.3 * t])
    laid = laid_on(helix, helix * [1, 1, -1])

    def handedness(curve):
        first, second, third = (np.diff(curve, k, axis=0)[:47] for k in (1, 2, 3))
        return np.sign(np.einsum("ij,ij->i", np.cross(first, second), third))

    np.testing.assert_array_equal(handedness(laid), handedness(helix))
    np.testing.assert_allclose(
        np.linalg.norm(np.diff(laid, axis=0), axis=1), np.linalg.norm(np.diff(helix, axis=0), axis=1)
    )


def test_unbending_moves_with_the_curve():
    curve = CURVES["3-D"]
    turn = np.linalg.qr(np.random.default_rng(1).standard_normal((3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    moved = 1000 * curve @ turn + [5.0, -3.0, 2.0]
    np.testing.assert_allclose(
        curvature_homotopy(moved, 6), 1000 * curvature_homotopy(curve, 6) @ turn + [5.0, -3.0, 2.0], rtol=0, atol=1e-6
    )


@pytest.mark.parametrize("steps", [0, -1, 1.5])
def test_bad_steps(steps):
    curve = CURVES["2-D"]
    for call in (lambda: linear_homotopy(curve, curve, steps), lambda: curvature_homotopy(curve, steps)):
        with pytest.raises(ValueError, match="steps: expected a whole number >= 1"):
            call()
