"""Small networks, and the fit that methods share which regress velocities by gradient."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import TypeVar

import torch
from torch import Tensor, nn

from latentds.arguments import whole_number
from latentds.base import Learned, StableDS
from latentds.demonstration import Demonstration

from .couplings import no_autocast
from .pooling import Pool
from .training import Plan, Training, descend

Normal = TypeVar("Normal", bound="NormalizedDS")
Regressing = TypeVar("Regressing", bound="VelocityRegression")

EPOCHS = 300
"""Passes over the samples by default: with 1000 a network follows what it was shown nearer, and a demonstration that it
was not shown much less. Chosen, as ``weight_decay`` is, by the fourth of LASA shapes of which three were shown."""
MOST_SAMPLES = 2000
"""Samples of all demonstrations together above which only every second, third, … is taken: they lie close together."""


class NormalizedDS(StableDS):
    """ẏ = size f(u) / duration, u = (y - y*) / size, with f learned from pooled velocities.

    Learns from one demonstration or from several; the mean of their goals is the attractor. ``fit_report.mse`` is the
    mean over all N n entries of the squared velocity error, (units / second)².

    Args:
        dim: n >= 1.
        seed: of all that a fit draws; None takes it from torch's generator.

    Attributes:
        size, duration: () buffers, > 0: the units of length and of time in which f is written.
    """

    size: Tensor
    duration: Tensor

    def __init__(self, dim: int, *, seed: int | None) -> None:
        super().__init__(dim)
        self.seed = None if seed is None else whole_number(seed, "seed", at_least=0)
        self.register_buffer("size", torch.ones((), dtype=torch.float64))
        self.register_buffer("duration", torch.ones((), dtype=torch.float64))

    @abstractmethod
    def _train(self: Normal, pool: Pool, progress: bool) -> tuple[Normal, Training]:
        """A new system of the same settings, on whatever device and in whatever dtype, whose f has learned."""

    @abstractmethod
    def normalized_velocity(self, u: Tensor) -> Tensor:
        """f: (..., n) -> (..., n)."""

    def _learn(self, shown: Sequence[Demonstration], progress: bool) -> Learned:
        pool = Pool.of(shown)
        learner, training = self._train(pool, progress)
        self.load_state_dict(learner.state_dict())
        with torch.no_grad():
            self.attractor.copy_(pool.goal)
            self.size.copy_(pool.size)
            self.duration.copy_(pool.duration)
            missed = [self(d.positions.to(self.attractor)) - d.velocities.to(self.attractor) for d in shown]
        mse = float(torch.cat(missed).square().mean())
        return Learned(mse, training.n_parts, training.history, training.notes)

    def forward(self, y: Tensor) -> Tensor:
        points, wanted = self._points(y)
        with no_autocast(points):
            velocity = self.normalized_velocity(self._normalize(points))
        return (velocity * self.size / self.duration).to(wanted)

    def _normalize(self, points: Tensor) -> Tensor:
        return (points - self.attractor) / self.size


class VelocityRegression(NormalizedDS):
    """A :class:`NormalizedDS` whose f is made of networks and learned by gradient, in float32.

    A subclass may set ``weight_decay``, Adam's L2 penalty.

    Args:
        dim: n >= 1.
        seed: of the initial networks and the batches; None draws them from torch's generator.
        epochs: passes over the samples, >= 1.
    """

    weight_decay = 0.0

    def __init__(self, dim: int, *, seed: int | None, epochs: int) -> None:
        super().__init__(dim, seed=seed)
        self.epochs = whole_number(epochs, "epochs", at_least=1)

    def _train(self: Regressing, pool: Pool, progress: bool) -> tuple[Regressing, Training]:
        pool = thinned(pool)
        learner = type(self)(**self.settings).to(self.attractor.device, torch.float32)
        points, velocities = pool.points.to(learner.attractor), pool.velocities.to(learner.attractor)
        typical = velocities.square().sum(-1).mean()

        def loss(batch: Tensor) -> Tensor:
            missed = learner.normalized_velocity(points[batch]) - velocities[batch]
            return missed.square().sum(-1).mean() / typical

        plan = Plan(
            self.epochs, learning_rate=3e-3, n_batches=4, warm_up=0.05, clip=1.0, weight_decay=self.weight_decay
        )
        generator = seeded_generator(self.seed)
        parameters = list(learner.parameters())
        return learner, descend(loss, parameters, len(points), plan, generator=generator, progress=progress)


def thinned(pool: Pool) -> Pool:
    """Every second, third, … sample of a pool of more than ``MOST_SAMPLES``."""
    stride = math.ceil(len(pool.points) / MOST_SAMPLES)
    return pool._replace(points=pool.points[::stride], velocities=pool.velocities[::stride])


def seeded_generator(seed: int | None) -> torch.Generator | None:
    """None, torch's own generator, for None."""
    return None if seed is None else torch.Generator().manual_seed(seed)


def perceptron(sizes: Iterable[int], generator: torch.Generator | None) -> nn.Sequential:
    """Linear maps between these sizes, in float64, with SiLU between them."""
    parts: list[nn.Module] = []
    for n_in, n_out in pairwise(sizes):
        parts += [linear(n_in, n_out, generator), nn.SiLU()]
    return nn.Sequential(*parts[:-1])


def linear(n_in: int, n_out: int, generator: torch.Generator | None) -> nn.Linear:
    """torch's own initial weights, but from a generator and without touching the global one."""
    device = torch.get_default_device()  # which skip_init does not ask
    layer: nn.Linear = nn.utils.skip_init(  # type: ignore[no-untyped-call]
        nn.Linear, n_in, n_out, dtype=torch.float64, device=device
    )
    bound = n_in**-0.5
    for part in (layer.weight, layer.bias):
        nn.init.uniform_(part, -bound, bound, generator=generator)
    return layer
