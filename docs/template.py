"""A method to copy: a linear pull to the goal, as fast as the demonstration was on the whole."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from latentds import Demonstration, Learned, StableDS


class LinearDS(StableDS):
    """ẏ = -r (y - y*), r > 0: what it learns is r.

    Args:
        dim: n >= 1.
    """

    def __init__(self, dim: int) -> None:
        super().__init__(dim)  # which gives it the buffer ``attractor``
        self.log_rate = nn.Parameter(torch.zeros((), dtype=torch.float64))  # positive whatever an optimiser does

    def _learn(self, shown: Sequence[Demonstration], progress: bool) -> Learned:
        with torch.no_grad():
            self.attractor.copy_(torch.stack([one.goal for one in shown]).mean(0))
            offsets = torch.cat([one.positions for one in shown]) - self.attractor
            velocities = torch.cat([one.velocities for one in shown])
            rate = -(offsets * velocities).sum() / offsets.square().sum()  # least squares
            self.log_rate.copy_(rate.clamp(min=0.1 / shown[0].duration).log())
            missed = self(offsets + self.attractor) - velocities
        return Learned(mse=float(missed.square().mean()), n_layers=0)

    def forward(self, y: Tensor) -> Tensor:
        points, dtype = self._points(y)  # checked, in this system's dtype; and the dtype to answer in
        return (-self.log_rate.exp() * (points - self.attractor)).to(dtype)

    def lyapunov(self, y: Tensor) -> Tensor:
        points, dtype = self._points(y)
        return (self.log_rate.exp() * (points - self.attractor).square().sum(-1)).to(dtype)


if __name__ == "__main__":
    from latentds.testing import check_stable_ds

    check_stable_ds(LinearDS)  # every promise, tried before and after a fit, in 2, 3 and 7 dimensions
