"""The contract accepts an honest method and rejects each way of breaking it, by the right line."""

from __future__ import annotations

import random

import numpy as np
import pytest
import torch
from torch import nn

from latentds import FitReport, LatentDS, LocallyWeightedTranslations, StableDS
from latentds.demonstration import only_demonstration
from latentds.dynamics import RayDynamics
from latentds.testing import check_stable_ds, wavy_motion
from latentds.time_law import PiecewiseLinearLaw


class Plain(StableDS):
    """ẏ = -rate (y - y*): the smallest honest method, written as a third party would."""

    def __init__(self, dim):
        super().__init__(dim)
        self.rate = nn.Parameter(torch.ones((), dtype=torch.float64))

    def fit(self, demonstration, *, progress=False):
        shown = only_demonstration(demonstration, self.dim, "Plain")
        self.attractor.copy_(shown.goal)
        with torch.no_grad():
            self.rate.fill_(3 / shown.duration)
            missed = self(shown.positions) - shown.velocities
        self.fit_report = FitReport(float(missed.square().mean()), 0, 0.0)
        return self

    def forward(self, y):
        points, wanted = self._points(y)
        return (-self.rate * (points - self.attractor)).to(wanted)

    def lyapunov(self, y):
        points, wanted = self._points(y)
        return ((points - self.attractor).square().sum(-1) + 0 * self.rate).to(wanted)

    def rollout(self, y0, t):
        points, wanted = self._points(y0, "y0")
        decay = torch.exp(-self.rate * self._times(t)).unsqueeze(-1)
        paths = self.attractor + decay * (points - self.attractor).unsqueeze(-2)
        return torch.cat([points.unsqueeze(-2), paths[..., 1:, :]], dim=-2).to(wanted)


class Latent(LatentDS):
    """The smallest honest latent method: a bent space, not fitted to anything but the goal."""

    def __init__(self, dim):
        psi = LocallyWeightedTranslations(dim, 2)
        super().__init__(dim, psi, RayDynamics(dim, PiecewiseLinearLaw.uniform()))

    def fit(self, demonstration, *, progress=False):
        shown = only_demonstration(demonstration, self.dim, "Latent")
        psi = self.diffeomorphism
        centers = torch.stack([shown.start, shown.goal])
        psi.assign(centers, torch.full_like(centers, 0.1 * shown.size), torch.full((2,), 1.5 / shown.size))
        self.attractor.copy_(shown.goal)
        with torch.no_grad():
            self.dynamics.set_endpoints(psi.inverse(shown.start), psi.inverse(shown.goal))
        self.fit_report = FitReport(0.0, 2, 0.0)
        return self


def test_accepts_honest_methods():
    check_stable_ds(Plain)
    check_stable_ds(Latent, dims=[1, 3])


class RunsAway(Plain):
    def forward(self, y):
        return -super().forward(y)


class HasTwoEquilibria(Plain):
    """Looks right near the demonstration; a second equilibrium waits far out."""

    def forward(self, y):
        points, wanted = self._points(y)
        offset = points - self.attractor
        distance = offset.norm(dim=-1, keepdim=True)
        return (-self.rate * (1 - distance / 5) * offset).to(wanted)


class HasAnotherAttractor(Plain):
    def fit(self, demonstration, *, progress=False):
        super().fit(demonstration)
        self.attractor.copy_(demonstration.start)
        return self


class MovesAtTheAttractor(Plain):
    def forward(self, y):
        return super().forward(y) + 0.1


class HasNegativeV(Plain):
    def lyapunov(self, y):
        return -super().lyapunov(y)


class NeverArrives(Plain):
    """V decreases all the way, but to a small sphere around the goal."""

    def rollout(self, y0, t):
        paths = super().rollout(y0, t)
        start, offset = paths[..., :1, :], paths - self.attractor
        distance, first = offset.norm(dim=-1, keepdim=True), (start - self.attractor).norm(dim=-1, keepdim=True)
        outside = self.attractor + offset / distance * (0.01 + (first - 0.01) * distance / first)
        return torch.cat([start, torch.where(first > 0.01, outside, start)[..., 1:, :]], dim=-2)


class RollsOutFaster(Plain):
    def rollout(self, y0, t):
        return super().rollout(y0, 1.01 * torch.as_tensor(t))


class BeginsElsewhere(Plain):
    def rollout(self, y0, t):
        return super().rollout(y0, t) * (1 + 1e-12)


class SqueezesABatchOfOne(Plain):
    def forward(self, y):
        return super().forward(y).squeeze(0)


class FailsOnAnEmptyBatch(Plain):
    def forward(self, y):
        torch.as_tensor(y).max()
        return super().forward(y)


class MixesRows(Plain):
    def forward(self, y):
        return super().forward(y) * (1 + 1e-3 * torch.as_tensor(y).detach().mean().tanh())


class EncodesWrongly(Latent):
    def encode(self, y):
        return super().encode(y) + 1e-3


class Folds(Latent):
    """ψ is not injective: it folds space, so no inverse exists."""

    def decode(self, x):
        return super().decode(x).abs()


class HasAWrongJacobian(Latent):
    def jacobian(self, x):
        return super().jacobian(x).transpose(-1, -2)


class DetachesGradients(Plain):
    def forward(self, y):
        return super().forward(y).detach()


class DetachesAParameter(Plain):
    def forward(self, y):
        points, wanted = self._points(y)
        return (-self.rate.detach() * (points - self.attractor)).to(wanted)

    def lyapunov(self, y):
        points, wanted = self._points(y)
        return (points - self.attractor).square().sum(-1).to(wanted)


class AnswersInFloat64(Plain):
    def forward(self, y):
        return super().forward(y).to(torch.float64)


class KeepsAFloat64Tensor(Plain):
    def __init__(self, dim):
        super().__init__(dim)
        self.scale = torch.ones(dim, dtype=torch.float64)

    def forward(self, y):
        return (super().forward(y) * self.scale).to(torch.float64)


class DropsABuffer(Plain):
    """The rate is learned, yet neither a parameter nor a buffer."""

    def __init__(self, dim):
        super().__init__(dim)
        del self.rate
        self.rate = torch.ones((), dtype=torch.float64)


class HidesTheAttractor(Plain):
    def __init__(self, dim):
        super().__init__(dim)
        del self.attractor
        self.attractor = torch.zeros(dim, dtype=torch.float64)


class CannotBePickled(Plain):
    def __init__(self, dim):
        super().__init__(dim)
        self.shift = lambda y: y


class ReturnsNothing(Plain):
    def fit(self, demonstration, *, progress=False):
        super().fit(demonstration)


class LeavesNoReport(Plain):
    def fit(self, demonstration, *, progress=False):
        super().fit(demonstration)
        self.fit_report = None
        return self


class RemembersTheLastFit(Plain):
    def fit(self, demonstration, *, progress=False):
        before = self.rate.item()
        super().fit(demonstration)
        with torch.no_grad():
            self.rate.add_(0.1 * before)
        return self


class IgnoresTheSeed(Plain):
    def fit(self, demonstration, *, progress=False):
        super().fit(demonstration)
        with torch.no_grad():
            self.rate.mul_(1 + random.random())
        return self


class DependsOnUnits(Plain):
    def forward(self, y):
        return super().forward(y).clamp(-1e3, 1e3)


class ChangesTheDefaultDtype(Plain):
    def fit(self, demonstration, *, progress=False):
        torch.set_default_dtype(torch.float64)
        return super().fit(demonstration)


class ChangesThreads(Plain):
    def fit(self, demonstration, *, progress=False):
        torch.set_num_threads(torch.get_num_threads() + 1)
        return super().fit(demonstration)


class SeedsTorch(Plain):
    def fit(self, demonstration, *, progress=False):
        torch.manual_seed(0)
        return super().fit(demonstration)


class SeedsNumPy(Plain):
    def fit(self, demonstration, *, progress=False):
        np.random.seed(0)  # noqa: NPY002
        return super().fit(demonstration)


class IsNoStableDS(nn.Module):
    def __init__(self, dim):
        super().__init__()


BROKEN = {
    RunsAway: "V̇ = ",
    HasTwoEquilibria: "V̇ = ",
    HasAnotherAttractor: "attractor",
    MovesAtTheAttractor: "at the attractor",
    HasNegativeV: "V = ",
    NeverArrives: "still",
    RollsOutFaster: "off the integral",
    BeginsElsewhere: "begin at y0",
    SqueezesABatchOfOne: "velocity of batch",
    FailsOnAnEmptyBatch: "raised",
    MixesRows: "velocity of batch",
    EncodesWrongly: "decode",
    Folds: "decode",
    HasAWrongJacobian: "jacobian",
    DetachesGradients: "no gradient leaves velocity|V̇",
    DetachesAParameter: "no gradient reaches rate",
    AnswersInFloat64: "float32 input is torch.float64",
    KeepsAFloat64Tensor: "float32 input is torch.float64",
    DropsABuffer: "after state_dict",
    HidesTheAttractor: "no buffer",
    CannotBePickled: "pickle",
    ReturnsNothing: "return self",
    LeavesNoReport: "fit_report",
    RemembersTheLastFit: "refit",
    IgnoresTheSeed: "same fit",
    DependsOnUnits: "other units",
    ChangesTheDefaultDtype: "default dtype",
    ChangesThreads: "thread count",
    SeedsTorch: "seeds torch",
    SeedsNumPy: "NumPy",
    IsNoStableDS: "expected a StableDS",
}


@pytest.mark.parametrize("stub", BROKEN, ids=lambda stub: stub.__name__)
def test_rejects(stub):
    dtype, threads = torch.get_default_dtype(), torch.get_num_threads()
    try:
        with pytest.raises(AssertionError, match=BROKEN[stub]) as caught:
            check_stable_ds(stub, dims=[2])
    finally:
        torch.set_default_dtype(dtype)
        torch.set_num_threads(threads)
    assert stub.__name__ in str(caught.value) or "factory" in str(caught.value)
    assert "2-D" in str(caught.value)


@pytest.mark.parametrize("dim", [1, 2, 3, 7])
def test_wavy_motion_never_meets_itself(dim):
    shown = wavy_motion(dim)
    apart = torch.cdist(shown.positions, shown.positions).fill_diagonal_(1)
    assert apart.min() > 1e-4
    assert shown.dim == dim
