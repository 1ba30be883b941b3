"""SDS-EF as the paper tests it: trained on 70 % of the points, judged by the velocities at the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from torch import Tensor

from baselines import SDSEF
from latentds import Demonstration
from latentds.base import Learned, StableDS
from latentds.benchmark import Cell
from latentds.demonstration import only_one
from latentds.metrics import mse

TEST_SHARE = 0.3
"""Of the points, on which it is judged and not trained."""


class HeldOut(StableDS):
    """SDS-EF by its authors' recipe, trained on 70 % of the points; ``fit_report.mse`` is of velocities at the others.

    The 30 % are drawn at random, the ends excepted. Training takes velocities from positions even in time, so a cubic
    spline through the 70 % is sampled evenly; it never sees the others.

    Args:
        dim: n >= 1.
        n_layers: L >= 1.
        n_features: n_f >= 1.
        epochs: most of them; the authors' code has 5000, and stops after 250 without improvement.
    """

    def __init__(self, dim: int, *, n_layers: int = 10, n_features: int = 200, epochs: int = 5000) -> None:
        super().__init__(dim)
        self.learner = SDSEF(dim, n_layers=n_layers, n_features=n_features, recipe="official", seed=0, epochs=epochs)
        self.n_layers, self.n_features, self.epochs = n_layers, n_features, epochs

    def _learn(self, shown: Sequence[Demonstration], progress: bool) -> Learned:
        motion = only_one(shown, "HeldOut")
        count, times = len(motion), motion.times.numpy()
        test = np.sort(1 + np.random.default_rng(0).permutation(count - 2)[: round(TEST_SHARE * count)])
        train = np.setdiff1d(np.arange(count), test)
        even = np.linspace(0, times[-1], len(train))
        curve = CubicSpline(times[train], motion.positions.numpy()[train])
        learned = self.learner._learn([Demonstration(curve(even), float(even[1]), motion.name)], progress)
        self.attractor.copy_(motion.goal)
        with torch.no_grad():
            missed = mse(self(motion.positions[test]), motion.velocities[test])
        return replace(learned, mse=missed)

    def forward(self, y: Tensor) -> Tensor:
        velocity: Tensor = self.learner(y)
        return velocity

    def lyapunov(self, y: Tensor) -> Tensor:
        return self.learner.lyapunov(y)

    def rollout(self, y0: Tensor, t: Tensor) -> Tensor:
        return self.learner.rollout(y0, t)


def held_out(shown: Demonstration, n_layers: int, n_features: int, epochs: int, label: str = "") -> Cell:
    """The cell of SDS-EF with the paper's split; its ``mse`` is the test MSE."""
    factory = partial(HeldOut, n_layers=n_layers, n_features=n_features, epochs=epochs)
    return Cell(label or f"SDS-EF {n_layers}x{n_features}", factory, shown)
