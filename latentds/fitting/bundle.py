"""What lies beside a path: frames carried along it, how far a tube around it may reach."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy

from ..arguments import Array
from ..curves import directions_along, extent, step_lengths, transported_frames
from .strands import Strands

TUBE_RADIUS = 0.3
"""Radius of the tube in sizes of the motion, where the path leaves room for it, …"""
SHARE_OF_CLEARANCE, SHARE_OF_CURVATURE_RADIUS = 0.4, 0.6
"""… that is, less than such a share of the distance to the next strand, and of the radius of curvature; …"""
LEAST_RADIUS_SHARE = 0.05
"""… but no thinner than such a share of ``TUBE_RADIUS``."""
SMOOTHING_WIDTH = 0.05
"""Standard deviation, in sizes of the motion, over which a path is averaged that a whole tube lies around: hooks that
are smaller than the tube are wide are no turns of the tube."""
EXTENSIONS = 0.4, 0.05
"""How far the path is carried on straight before its start and beyond its goal, in sizes, where there is room."""
BESIDE_WEIGHT = 0.5
"""Weight of what lies beside the path: a point there counts as so many of the path."""


class Bundle(NamedTuple):
    """Pairs of points that a near-isometric map of a line's surroundings to a path's would take to one another."""

    x: Array
    """(m, n) on the latent line, its extensions and beside both"""
    y: Array
    """(m, n) where they belong"""
    weights: Array
    """(m,)"""


def bundle(line: Array, path: Array, across: Array) -> Bundle:
    """The line (N, n) with what lies beside it, and the path (N, n) with what lies there.

    Args:
        line: evenly spaced.
        path: evenly spaced.
        across: (n, n-1) the directions beside the line that the path's :func:`frames_across` belong to.
    """
    count, dim = path.shape
    size, length = extent(path), float(step_lengths(path).sum())
    axis = line[-1] - line[0]
    scale = float(np.linalg.norm(axis)) / length
    axis = axis / np.linalg.norm(axis)
    smooth = smoothed(path)
    reach = radius(path, smooth, TUBE_RADIUS * size)
    middle = path + (reach / (TUBE_RADIUS * size))[:, None] * (smooth - path)
    sides = frames_across(smooth)
    x, y = [line], [path]
    weights = [np.ones(count)]
    weights[0][[0, -1]] = 0.05 * count  # the start must encode to the start, the goal to the goal
    every = max(2, 2 * (dim - 1))
    for side in range(dim - 1):
        for sign in (-1, 1):
            offset = sign * reach[::every, None]
            offset[1::2] /= 2
            x.append(line[::every] + scale * offset * across[:, side])
            y.append(middle[::every] + offset * sides[::every, :, side])
            weights.append(np.full(len(offset), BESIDE_WEIGHT * every / (dim - 1)))
    directions = directions_along(smooth)
    for end, sign, far, weight in ((0, -1, EXTENSIONS[0], 1.0), (-1, 1, EXTENSIONS[1], BESIDE_WEIGHT)):
        ahead = np.linspace(0, far * size, 12)[1:, None]
        ahead = ahead[: _free(path[end] + sign * ahead * directions[end], path, ahead[:, 0])]
        for side in (None, *range(dim - 1)):
            for turn in (0,) if side is None else (-1, 1):
                beside = across[:, side or 0] * turn * reach[end] if dim > 1 else np.zeros(dim)
                there = sides[end, :, side or 0] * turn * reach[end] if dim > 1 else np.zeros(dim)
                x.append(line[end] + scale * (sign * ahead * axis + beside))
                y.append(path[end] + sign * ahead * directions[end] + there)
                weights.append(np.full(len(ahead), weight / (1 if side is None else dim - 1)))
    return Bundle(np.concatenate(x), np.concatenate(y), np.concatenate(weights))


def _free(points: Array, path: Array, away: Array) -> int:
    """How many points of a straight extension lie nearer to the path's end than to any other part, but for half."""
    nearest = np.linalg.norm(points[:, None] - path[None], axis=2).min(1)
    blocked = np.flatnonzero(nearest < 0.95 * away)
    return len(points) if not len(blocked) else int(blocked[0]) // 2


def smoothed(path: Array) -> Array:
    """An evenly spaced path averaged over ``SMOOTHING_WIDTH`` of its size, the ends kept: (N, n) -> (N, n)."""
    step = float(step_lengths(path).mean())
    width = SMOOTHING_WIDTH * extent(path) / step
    count = len(path)
    pad = min(count - 1, int(4 * width) + 1)
    before, after = 2 * path[0] - path[pad:0:-1], 2 * path[-1] - path[-2 : -2 - pad : -1]
    averaged: Array = scipy.ndimage.gaussian_filter1d(np.concatenate([before, path, after]), width, axis=0)
    return averaged[pad : pad + count]


def radius(path: Array, smooth: Array, wanted: float) -> Array:
    """How wide a tube around an evenly spaced path (N, n) may be at each point, at most ``wanted``: (N,)."""
    clearance = Strands(path).clearance(path)
    tangents = np.gradient(smooth, axis=0)
    speeds = np.maximum(np.linalg.norm(tangents, axis=1), 1e-12 * extent(path))
    bends = np.linalg.norm(np.gradient(tangents / speeds[:, None], axis=0), axis=1) / speeds
    most = np.minimum(SHARE_OF_CLEARANCE * clearance, SHARE_OF_CURVATURE_RADIUS / np.maximum(bends, 1e-12 / wanted))
    near = max(1, len(path) // 60)
    most = scipy.ndimage.gaussian_filter1d(scipy.ndimage.minimum_filter1d(most, 2 * near + 1), near, mode="nearest")
    radii: Array = np.minimum(np.clip(most, LEAST_RADIUS_SHARE * wanted, wanted), SHARE_OF_CLEARANCE * clearance)
    return radii


def frames_across(path: Array) -> Array:
    """Directions across a smooth path that turn no more than it does: (N, n) -> (N, n, n-1), orthonormal."""
    return transported_frames(directions_along(path))[0][:, :, 1:]
