"""Homotopies from a straight line to a curve: sequences of curves for the matching to follow without tangling."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..arguments import whole_number

Array = NDArray[np.float64]


def linear_homotopy(x: Array, y: Array, steps: int) -> Array:
    """x + (k/K)(y - x), k = 0 … K: every point moves on a straight line. (N, n) and (N, n) -> (K+1, N, n).

    One step is plain greedy matching. On tight 3-D spirals it is the better of the two; in 2-D the curve can cross
    itself on the way, and then no diffeomorphism follows.
    """
    share = np.linspace(0, 1, whole_number(steps, "steps", at_least=1) + 1)[:, None, None]
    moved: Array = x + share * (y - x)
    return moved


def curvature_homotopy(y: Array, steps: int) -> Array:
    """The curve y (N, n) with its turning scaled by k/K, k = 0 … K: from a straight rod of its length to itself.

    The turning from segment to segment is written in a Bishop (rotation-minimising) frame, scaled, and integrated back;
    each curve is then laid rigidly on the next. Returns (K+1, N, n).
    """
    count = whole_number(steps, "steps", at_least=1)
    segments = np.diff(y, axis=0)
    lengths = np.linalg.norm(segments, axis=1)
    turning = _turning(segments / lengths[:, None])
    scaled = np.linspace(0, 1, count + 1)[:, None, None] * turning
    frames = np.repeat(_frame(segments[0])[None], count + 1, axis=0)
    tangents = np.empty((count + 1, len(segments), y.shape[1]))
    tangents[:, 0] = frames[:, :, 0]
    for i in range(len(turning)):
        frames = _turned(frames, scaled[:, i])
        tangents[:, i + 1] = frames[:, :, 0]
    curves = np.concatenate(
        [np.zeros((count + 1, 1, y.shape[1])), np.cumsum(tangents * lengths[:, None], axis=1)], axis=1
    )
    curves[count] = y
    for k in range(count - 1, -1, -1):
        curves[k] = _laid_on(curves[k], curves[k + 1])
    return curves


def _turning(tangents: Array) -> Array:
    """Rotation vectors between successive unit tangents, in the transported normal frame: (m, n) -> (m-1, n-1)."""
    frame = _frame(tangents[0])
    turning = np.empty((len(tangents) - 1, tangents.shape[1] - 1))
    for i, tangent in enumerate(tangents[1:]):
        local = frame.T @ tangent
        sine = np.linalg.norm(local[1:])
        angle = np.arctan2(sine, local[0])
        if sine > 1e-12:
            turning[i] = angle / sine * local[1:]
        else:  # straight on, or straight back: any normal will do
            turning[i] = 0.0
            turning[i, :1] = angle
        frame = _turned(frame[None], turning[i][None])[0]
    return turning


def _frame(direction: Array) -> Array:
    """An orthonormal basis (n, n) whose first column points along ``direction`` (n,)."""
    frame: Array = np.linalg.svd(direction[:, None])[0]
    frame[:, 0] *= np.sign(frame[:, 0] @ direction)
    return frame


def _turned(frames: Array, turning: Array) -> Array:
    """Frames (k, n, n), columns tangent and normals, rotated by turning (k, n-1) in the plane of tangent and normal."""
    angle = np.linalg.norm(turning, axis=1)
    axis = turning / np.where(angle > 0, angle, 1.0)[:, None]
    normal = np.einsum("kij,kj->ki", frames[:, :, 1:], axis)
    tangent = frames[:, :, 0]
    cosine, sine = np.cos(angle)[:, None], np.sin(angle)[:, None]
    turned: Array = frames.copy()
    turned[:, :, 0] = cosine * tangent + sine * normal
    change = (cosine - 1) * normal - sine * tangent
    turned[:, :, 1:] += change[:, :, None] * axis[:, None, :]
    return turned


def _laid_on(curve: Array, other: Array) -> Array:
    """The rigid motion of ``curve`` nearest to ``other``, both (N, n) (Kabsch)."""
    centre, target = curve.mean(0), other.mean(0)
    left, _, right = np.linalg.svd((curve - centre).T @ (other - target))
    left[:, -1] *= np.sign(np.linalg.det(left @ right))
    laid: Array = (curve - centre) @ left @ right + target
    return laid
