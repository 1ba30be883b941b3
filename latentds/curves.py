"""Curves as points (N, n): lengths, resampling, frames that turn no more than the curve, distances of segments."""

from __future__ import annotations

import math

import numpy as np

from .arguments import Array


def extent(points: Array) -> float:
    """The size of a motion: its largest extent along an axis."""
    return float(np.ptp(points, axis=0).max())


def step_lengths(points: Array) -> Array:
    """(N, n) -> (N-1,)."""
    lengths: Array = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return lengths


def arc_lengths(points: Array) -> Array:
    """Length of the polygon through points (N, n) up to each of them, from 0: (N,)."""
    return np.concatenate([[0.0], np.cumsum(step_lengths(points))])


def progress_along(points: Array) -> Array:
    """Share of the length of a curve (N, n) up to each of its points, 0 to 1: (N,)."""
    arc = arc_lengths(points)
    share: Array = arc / arc[-1]
    return share


def interpolated(at: Array, known: Array, points: Array) -> Array:
    """Points (N, n) at increasing ``known`` (N,), linearly at ``at`` (...), held beyond the ends: (..., n)."""
    return np.stack([np.interp(at, known, column) for column in points.T], axis=-1)


def evenly_resampled(points: Array, count: int) -> Array:
    """So many points, evenly spaced in arc length: (N, n) -> (count, n)."""
    arc = arc_lengths(points)
    return interpolated(np.linspace(0, arc[-1], count), arc, points)


def jitter(points: Array, order: int = 2) -> float:
    """Length of the noise in a recording (N, n), in the units of the positions.

    Read off its differences of that order k, N > k, in which a motion like a polynomial of a lower degree does not
    show: those of white noise of standard deviation s have s √C(2k, k).
    """
    differences = np.linalg.norm(np.diff(points, order, axis=0), axis=1)
    return float(np.median(differences)) / math.sqrt(math.comb(2 * order, order))


def directions_along(points: Array) -> Array:
    """Unit tangents of a smooth curve: (N, n) -> (N, n)."""
    tangents = np.gradient(points, axis=0)
    lengths = np.linalg.norm(tangents, axis=1, keepdims=True)
    directions: Array = tangents / np.maximum(lengths, 1e-12 * lengths.max())
    return directions


def frame_along(direction: Array) -> Array:
    """An orthonormal right-handed basis (n, n) whose first column points along ``direction`` (n,)."""
    frame: Array = np.linalg.svd(direction[:, None])[0]
    frame[:, 0] *= np.sign(frame[:, 0] @ direction)
    if len(direction) > 1 and np.linalg.det(frame) < 0:
        frame[:, -1] *= -1
    return frame


def transported_frames(tangents: Array) -> tuple[Array, Array]:
    """Frames that turn no more than a curve does (Bishop 1975), and by how much.

    Args:
        tangents: (N, n), of length 1.

    Returns:
        (N, n, n) orthonormal, the tangent first; and rotation vectors from each tangent to the next in the normals of
        its frame, (N-1, n-1).
    """
    frames = np.empty((*tangents.shape, tangents.shape[1]))
    turning = np.zeros((len(tangents) - 1, tangents.shape[1] - 1))
    frames[0] = frame_along(tangents[0])
    for i, tangent in enumerate(tangents[1:]):
        local = frames[i].T @ tangent
        sine = np.linalg.norm(local[1:])
        angle = np.arctan2(sine, local[0])
        if sine > 1e-12:
            turning[i] = angle / sine * local[1:]
        else:  # straight on, or straight back: any normal will do
            turning[i, :1] = angle
        frames[i + 1] = turned(frames[i][None], turning[i][None])[0]
    return frames, turning


def turned(frames: Array, turning: Array) -> Array:
    """Frames (k, n, n), columns tangent and normals, rotated by turning (k, n-1) in the plane of tangent and normal."""
    angle = np.linalg.norm(turning, axis=1)
    axis = turning / np.where(angle > 0, angle, 1.0)[:, None]
    normal = np.einsum("kij,kj->ki", frames[:, :, 1:], axis)
    tangent = frames[:, :, 0]
    cosine, sine = np.cos(angle)[:, None], np.sin(angle)[:, None]
    rotated: Array = frames.copy()
    rotated[:, :, 0] = cosine * tangent + sine * normal
    change = (cosine - 1) * normal - sine * tangent
    rotated[:, :, 1:] += change[:, :, None] * axis[:, None, :]
    return rotated


def segment_distances(gap: Array, step: Array, other: Array) -> Array:
    """Distances (m,) of segments a + s step and b + t other with s, t in [0, 1] and gap = a - b, all (m, n).

    Clamp one, solve for the other, clamp, solve back.
    """
    a, e = (step**2).sum(1), (other**2).sum(1)
    b, c, f = (step * other).sum(1), (step * gap).sum(1), (other * gap).sum(1)
    denominator = a * e - b * b
    s = np.clip(np.where(denominator > 1e-12 * a * e, (b * f - c * e) / np.maximum(denominator, 1e-300), 0.0), 0, 1)
    t = np.clip((b * s + f) / np.maximum(e, 1e-300), 0, 1)
    s = np.clip((b * t - c) / np.maximum(a, 1e-300), 0, 1)
    distances: Array = np.linalg.norm(gap + s[:, None] * step - t[:, None] * other, axis=1)
    return distances


def laid_on(curve: Array, other: Array) -> Array:
    """The rigid motion of ``curve`` nearest to ``other``, both (N, n) (Kabsch)."""
    centre, target = curve.mean(0), other.mean(0)
    left, _, right = np.linalg.svd((curve - centre).T @ (other - target))
    left[:, -1] *= np.sign(np.linalg.det(left @ right))
    laid: Array = (curve - centre) @ left @ right + target
    return laid
