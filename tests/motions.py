"""Motions that several test files fit to or look at, and numbers as tensors."""

from __future__ import annotations

import numpy as np
import torch

from latentds import Demonstration


def tensor(values):
    return torch.as_tensor(values, dtype=torch.float64)


def motion(clock, *, dt=0.01, count=400):
    """A bent plane curve travelled by a clock: share of the time -> share of the way."""
    way = clock(np.linspace(0, 1, count))
    return Demonstration(tensor(np.stack([1 - way, 0.3 * np.sin(4 * way)], 1)), dt)


def rest_first(t):
    return np.clip((t - 0.3) / 0.7, 0, 1)


def pause(t):
    return np.interp(t, [0, 0.35, 0.6, 1], [0, 0.5, 0.5, 1])


def rest_at_both_ends(t):
    return np.interp(t, [0, 0.25, 0.75, 1], [0, 0, 1, 1])


def creep_then_dash(t):
    return t**5


def planar_spiral(turns, count=600):
    way = np.linspace(1, 0.05, count)
    angle = 2 * np.pi * turns * way
    return Demonstration(way[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1), 0.01)
