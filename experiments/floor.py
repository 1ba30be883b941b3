"""What a tube without any error would score: the least that sampling and the way back to the path cost."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from latentds import Demonstration, metrics
from latentds.benchmark import RolloutProtocol

Array = NDArray[np.float64]


def sampled(shown: Demonstration, protocol: RolloutProtocol, count: int = 100) -> float:
    """Mean exact DTW between the sampled demonstration and itself, late by a fraction of a sample, even over [0, 1).

    Off the demonstrated start nobody knows the clock: even a perfect rollout is late by some such fraction.
    """
    times, reference = protocol.times(shown).numpy(), protocol.reference(shown)
    late = (np.arange(count) + 0.5) / count * (times[1] - times[0])
    return float(np.mean([metrics.dtw(shown.at(times + seconds), reference) for seconds in late]))


def joined(shown: Demonstration, protocol: RolloutProtocol, starts: Array, kappa: float = 20.0) -> list[float]:
    """Exact DTW of the demonstration itself, joined from each start (n,) at its nearest point.

    The way there shrinks at ``kappa``, as in a tube without any error; a start behind the first point is late.
    """
    times, reference = protocol.times(shown).numpy(), protocol.reference(shown)
    fine = np.linspace(0, shown.duration, 20_001)
    path = shown.at(fine)
    speed, scores = (path[1] - path[0]) / fine[1], []
    for start in starts:
        nearest = int(np.linalg.norm(path - start, axis=1).argmin())
        away, late = start - path[nearest], 0.0
        if nearest == 0:
            late = -float(away @ speed / (speed @ speed))
        clocks = times + fine[nearest] - late
        motion = shown.at(clocks) + np.minimum(clocks, 0)[:, None] * speed
        motion += np.exp(-kappa * times / shown.duration)[:, None] * (away + late * speed)
        scores.append(metrics.dtw(motion, reference))
    return scores
