"""What methods share whose diffeomorphism is a chain of affine couplings, learned by gradient from velocities."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor, nn

from latentds.base import LatentDS, Learned
from latentds.demonstration import Demonstration, goal_apart
from latentds.dynamics import LatentDynamics

from .couplings import AffineCouplings
from .networks import seeded_generator
from .training import Plan, Training, descend

BENDING_STAGES = 8
"""Steps from the chord to the demonstration in the tuned recipe."""
STRAIGHTNESS_SCALE = 0.05
"""Scale of the tuned recipe's straightness, in sizes of the demonstration."""
REST_SPEED = 1e-2
"""Share of the mean speed below which the tuned recipe no longer asks for relative accuracy."""


class FlowDynamics(LatentDynamics):
    """Latent dynamics that are learned in units of the demonstration's box and duration.

    Attributes:
        duration: () buffer, seconds in one unit of time.
    """

    duration: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("duration", torch.ones((), dtype=torch.float64))

    @torch.no_grad()
    def settle(self, points: Tensor, duration: float) -> None:
        """Take what was learned at points (N, n) in [-1/2, 1/2] to seconds, of which ``duration`` make one unit."""
        self.duration.fill_(duration)


class FlowDS(LatentDS):
    """A system whose ψ is a chain of couplings and whose dynamics are learned with it, by gradient, from velocities.

    Learns from one demonstration or from several, pooled; their goals' mean is the attractor. ``fit_report.mse`` is the
    mean over all N n entries of the squared velocity error, (units / second)². A subclass keeps its ``seed``.
    """

    diffeomorphism: AffineCouplings
    dynamics: FlowDynamics
    seed: int | None

    @abstractmethod
    def _train(self, data: Normalized, generator: torch.Generator | None, progress: bool) -> Training:
        """Learn, in this system's dtype and in the units of ``data``."""

    def _learn(self, shown: Sequence[Demonstration], progress: bool) -> Learned:
        # A fresh system is trained, in float32 and in normalised units: twice as fast as float64, no worse, and the
        # rounding hides the noise of the units that the demonstration came in.
        learner = type(self)(**self.settings).to(self.attractor.device, torch.float32)
        data, psi = Normalized.of(shown), self.diffeomorphism
        training = learner._train(data, seeded_generator(self.seed), progress)
        self.load_state_dict(learner.state_dict())
        with torch.no_grad():
            psi.center.copy_(data.center)
            psi.scale.copy_(data.scale)
            self.attractor.copy_(torch.stack([d.goal for d in shown]).mean(0))
            starts = torch.stack([d.start for d in shown]).to(self.attractor)
            self.start.copy_(starts[self.lyapunov(starts).argmax()])  # the farthest in latent space
            self.dynamics.settle(data.points, data.duration)
            missed = [self(d.positions.to(self.attractor)) - d.velocities.to(self.attractor) for d in shown]
            mse = float(torch.cat(missed).square().mean())
        return Learned(mse, psi.n_layers, training.history, training.notes)


class Normalized(NamedTuple):
    """Demonstrations in units of their box and their mean duration; their m goals are the last points."""

    points: Tensor
    """(N, n) in [-1/2, 1/2]"""
    velocities: Tensor
    """(N, n)"""
    chord_points: Tensor
    """(N, n) on the straight line from each start to each end, evenly in arc length"""
    chord_velocities: Tensor
    """(N, n)"""
    owner: Tensor
    """(N,) which demonstration"""
    starts: Tensor
    """(m, n)"""
    goal: Tensor
    """(n,)"""
    center: Tensor
    scale: Tensor
    duration: float
    steps: Tensor
    """(m,) from sample to sample of each, in durations"""

    @classmethod
    def of(cls, shown: Sequence[Demonstration], *, closed: bool = False) -> Normalized:
        """At least one demonstration; one that ends where it begins is refused by a ValueError, unless ``closed``."""
        goal = torch.stack([d.goal for d in shown]).mean(0)
        for d in shown if not closed else ():
            goal_apart(d, goal)
        every = torch.cat([d.positions for d in shown])
        low, high = every.amin(0), every.amax(0)
        center, extent = (low + high) / 2, high - low
        scale = extent.clamp(min=1e-6 * float(extent.max()))  # an axis at rest is noise, not motion
        duration = sum(d.duration for d in shown) / len(shown)
        columns: list[tuple[Tensor, ...]] = []
        for i, d in enumerate(shown):
            points, velocities = (d.positions - center) / scale, d.velocities / scale * duration
            steps = points.diff(dim=0).norm(dim=-1)
            length, chord = steps.sum(), points[-1] - points[0]
            progress = torch.cat([steps[:1] * 0, steps.cumsum(0)]) / length
            rate = velocities.norm(dim=-1) / length
            chords = points[0] + progress.unsqueeze(-1) * chord, rate.unsqueeze(-1) * chord
            columns.append((points, velocities, *chords, torch.full((len(d),), i)))
        last = torch.cat([torch.arange(len(d)) == len(d) - 1 for d in shown]).to(torch.uint8).argsort(stable=True)
        starts = torch.stack([(d.start - center) / scale for d in shown])
        samples = [torch.cat(column)[last] for column in zip(*columns, strict=True)]
        points, velocities, chord_points, chord_velocities, owner = samples
        return cls(
            points,
            velocities,
            chord_points,
            chord_velocities,
            owner,
            starts,
            (goal - center) / scale,
            center,
            scale,
            duration,
            points.new_tensor([d.dt / duration for d in shown]),
        )

    def straightened(self, share: float) -> Normalized:
        """The demonstrations on their way from their chords, share 0, to themselves, share 1."""
        return self._replace(
            points=torch.lerp(self.chord_points, self.points, share),
            velocities=torch.lerp(self.chord_velocities, self.velocities, share),
        )


def descend_bending(
    learner: FlowDS,
    loss_of: Callable[[Normalized], Callable[[Tensor], Tensor]],
    data: Normalized,
    plan: Plan,
    generator: torch.Generator | None,
    progress: bool,
) -> Training:
    """Continuation: a chord lies on one latent ray to begin with, and a curve that bends slowly is held there.

    In the plane a curve may cross itself while it bends, so there the demonstration is learned at once.
    """
    stages = BENDING_STAGES if learner.dim > 2 else 1
    short = plan.epochs // 19
    history: list[float] = []
    notes: list[str] = []
    for stage in range(1, stages + 1):
        title = f"stage {stage} of {stages}"
        if stage == stages:
            effort = replace(plan, epochs=plan.epochs - (stages + 2) * short if stages > 1 else plan.epochs)
        else:  # what the first bend leaves unlearned, no later stage has been seen to mend
            effort = replace(plan, epochs=max(1, 4 * short if stage == 1 else short), warm_up=0.3)
        training = descend(
            loss_of(data.straightened(stage / stages)),
            list(learner.parameters()),
            len(data.points) - len(data.starts),
            effort,
            generator=generator,
            progress=title if progress else False,
        )
        history += training.history
        notes += [f"{title}: {note}" for note in training.notes]
    return Training(tuple(history), tuple(notes))


Field = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""u and z = φ(u) - φ(goal), (b, n) each -> a latent velocity, (b, n), and a factor, (b, 1), that v̂ = J_φ⁻¹ (…) has."""


def velocity_loss(psi: AffineCouplings, field: Field, data: Normalized) -> Callable[[Tensor], Tensor]:
    """SmoothL1 error of the velocities, as SDS-EF's authors take it: the mean over points and coordinates.

    Args:
        psi: φ⁻¹.
        field: the latent dynamics.
        data: the demonstrations.
    """
    points, velocities, goal = (part.to(psi.center) for part in (data.points, data.velocities, data.goal))
    linearize = quickest_linearize(psi)

    def loss(batch: Tensor) -> Tensor:
        u = points[batch]
        x, push = linearize(torch.cat([u, goal.unsqueeze(0)]))
        latent, factor = field(u, x[:-1] - x[-1])
        flow = push(torch.cat([latent, torch.zeros_like(goal).unsqueeze(0)]))[:-1]
        return nn.functional.smooth_l1_loss(factor * flow, velocities[batch])

    return loss


def ray_loss(psi: AffineCouplings, field: Field, data: Normalized) -> Callable[[Tensor], Tensor]:
    """2 mean(√(1 + ‖v̂-v‖²/‖v‖²) - 1) + mean(√(1 + ‖J_φ⁻¹ d / 0.05‖²) - 1) + mean ‖z/‖z‖ - e‖².

    e is the direction of z at the demonstrated start and d = z - max(0, z·e) e the way off the ray along it. The goals
    themselves have no direction and are left out.

    Args:
        psi: φ⁻¹.
        field: the latent dynamics.
        data: the demonstrations.
    """
    points, velocities, starts, goal = (
        part.to(psi.center) for part in (data.points, data.velocities, data.starts, data.goal)
    )
    owner = data.owner.to(points.device)
    linearize = quickest_linearize(psi)
    squared_speeds = velocities.square().sum(-1)
    squared_speeds = squared_speeds + REST_SPEED**2 * squared_speeds.mean()
    anchors = torch.cat([starts, goal.unsqueeze(0)])

    def loss(batch: Tensor) -> Tensor:
        u, v, n = points[batch], velocities[batch], len(batch)
        x, push = linearize(torch.cat([u, anchors]))
        z = x - x[-1]
        ray = unit_vector(z[n:-1])[owner[batch]]
        aside = z[:n] - (z[:n] * ray).sum(-1, keepdim=True).clamp(min=0) * ray
        latent, factor = field(u, z[:n])
        rest = torch.zeros_like(anchors)
        flow, away = push(torch.stack([torch.cat([latent, rest]), torch.cat([aside, rest])]))[:, :n]
        error = (factor * flow - v).square().sum(-1) / squared_speeds[batch]
        bend = (away / STRAIGHTNESS_SCALE).square().sum(-1)
        turn = (unit_vector(z[:n]) - ray).square().sum(-1)
        return torch.mean(2 * ((1 + error).sqrt() - 1) + (1 + bend).sqrt() - 1 + turn)

    return loss


def unit_vector(z: Tensor) -> Tensor:
    """z/‖z‖, and 0 at 0: (..., n) -> (..., n)."""
    return nn.functional.normalize(z, dim=-1, eps=1e-6)


def quickest_linearize(psi: AffineCouplings) -> Callable[[Tensor], tuple[Tensor, Callable[[Tensor], Tensor]]]:
    """ψ's ``linearize``, compiled where it can be."""
    return psi.compiled_linearize() if psi.center.device.type == "cpu" else psi.linearize
