"""ProMP: a distribution over motions of a phase, conditioned on where this one begins (Paraschos et al. 2013)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from latentds.arguments import whole_number
from latentds.base import Learned
from latentds.demonstration import Demonstration
from latentds.resizing import assign, make_room

from .phase import PhaseDriven, refuse_closed

OBSERVATION_NOISE = 0.01
"""Standard deviation of a weight that no demonstration tells of, in sizes: all there is with a single one."""
RIDGE_WEIGHT = 1e-8
"""Of the least squares that finds a demonstration's weights."""


class ProMP(PhaseDriven):
    """Probabilistic movement primitive: y(s) = Σ_i w_i φ_i(s), w ~ N(μ, Σ), s = t / duration up to 1.

    Paraschos et al. 2013: φ are normalised Gaussians even in s; each demonstration's w is a least squares, μ their mean
    and Σ their covariance, with the square of ``OBSERVATION_NOISE`` added on its diagonal, without which a single
    demonstration could begin only where it began. A rollout is the mean motion given that it is at its start now and at
    the goal at the end, eq. 5 with no noise, twice. One demonstration says nothing of how offsets die: they do within a
    basis function.

    At the end of the phase the motion stays where it is, at the goal. There is no attractor beyond that: it does not
    return to the goal from elsewhere, and cannot :meth:`resume` once its phase has ended.

    ``fit_report.mse`` is of the positions from the demonstrated starts, per coordinate; ``n_layers`` is the number of
    basis functions. Goal, start and duration are the means of several demonstrations'.

    Args:
        dim: n >= 1.
        n_basis: B >= 3 basis functions in each coordinate.

    Attributes:
        mean: (B, n), μ.
        deviations: (D, B, n), of each demonstration's weights from μ, over √D: Σ is the sum of their outer products.
        doubt: () buffer, ``OBSERVATION_NOISE`` in the units of the positions.
    """

    doubt: Tensor

    def __init__(self, dim: int, *, n_basis: int = 20) -> None:
        super().__init__(dim)
        self.n_basis = whole_number(n_basis, "n_basis", at_least=3)
        straight = torch.linspace(1, 0, self.n_basis, dtype=torch.float64)
        self.mean = nn.Parameter(straight.unsqueeze(-1) * self.start)
        self.deviations = nn.Parameter(torch.zeros(1, self.n_basis, self.dim, dtype=torch.float64))
        self.register_buffer("doubt", torch.tensor(OBSERVATION_NOISE, dtype=torch.float64))

    def _learn(self, shown: Sequence[Demonstration], progress: bool) -> Learned:
        refuse_closed(shown)
        weights = torch.stack([self._weights(d) for d in shown])
        mean = weights.mean(0)
        assign(self, {"mean": mean, "deviations": (weights - mean) / len(shown) ** 0.5})
        with torch.no_grad():
            self.doubt.fill_(OBSERVATION_NOISE * max(d.size for d in shown))
            self._place(shown)
        return self._learned(shown, self.n_basis)

    def _weights(self, shown: Demonstration) -> Tensor:
        values = basis(self.n_basis, shown.times / shown.duration)[0].numpy()
        ridge = (RIDGE_WEIGHT * len(values)) ** 0.5 * np.eye(self.n_basis)
        wanted = np.concatenate([(shown.positions - shown.goal).numpy(), np.zeros((self.n_basis, self.dim))])
        solved, *_ = np.linalg.lstsq(np.concatenate([values, ridge]), wanted)  # torch's rounds by its threads
        return torch.from_numpy(solved) + shown.goal

    def motion(self, y: Tensor, since: float, s: Tensor, *, at_rest: bool = False) -> Tensor:
        return self._conditioned(y, since, basis(self.n_basis, s.clamp(max=1.0))[0])

    def velocity(self, s: Tensor) -> Tensor:
        return self._conditioned(self.start, 0.0, basis(self.n_basis, s)[1])

    def _conditioned(self, y: Tensor, since: float, values: Tensor) -> Tensor:
        """What φ (T, B), or its derivative, makes of the weights given y (..., n) at ``since`` and the goal at 1."""
        if not since < 1:
            raise ValueError(f"since: expected a time before the motion ends, got {since:g} of its duration")
        ends, _ = basis(self.n_basis, values.new_tensor([since, 1.0]))
        targets = torch.stack([y, self.attractor.expand_as(y)], dim=-2)
        surprise = (targets - ends @ self.mean).flatten(-2)
        between = self._covariance(ends, ends)
        gain = torch.linalg.solve(between, self._covariance(ends, values))  # symmetric, so that its transpose is wanted
        moved: Tensor = (gain.mT * surprise.unsqueeze(-2)).sum(-1)
        return values @ self.mean + moved.reshape(*y.shape[:-1], len(values), self.dim)

    def _covariance(self, one: Tensor, other: Tensor) -> Tensor:
        """Of the positions that φ (A, B) and φ (C, B) make: (A n, C n)."""
        first, second = one @ self.deviations, other @ self.deviations  # (D, A, n), (D, C, n)
        shown = torch.einsum("dai,dcj->aicj", first, second)
        doubt = self.doubt.square() * torch.einsum("ac,ij->aicj", one @ other.mT, torch.eye(self.dim).to(one))
        return (shown + doubt).reshape(len(one) * self.dim, len(other) * self.dim)

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *rest: object) -> None:
        make_room(self, state_dict, prefix, ["deviations"])
        super()._load_from_state_dict(state_dict, prefix, *rest)


def basis(n_basis: int, s: Tensor) -> tuple[Tensor, Tensor]:
    """φ and dφ/ds at phases (T,): (T, B) each. Neighbours meet at exp(-½) of their height."""
    centers = torch.linspace(0, 1, n_basis, dtype=s.dtype, device=s.device)
    offsets = (s.unsqueeze(-1) - centers) * (n_basis - 1) / 2
    slopes = -2 * offsets * (n_basis - 1) / 2
    values = torch.softmax(-offsets.square(), dim=-1)
    return values, values * (slopes - (values * slopes).sum(-1, keepdim=True))
