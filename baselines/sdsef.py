"""SDS-EF: stable dynamics from Euclideanizing flows, learned by gradient (Rana et al. 2020)."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from latentds.arguments import refuse_tracing, whole_number
from latentds.base import FitReport, LatentDS
from latentds.demonstration import Demonstration, demonstrations_of, goal_apart
from latentds.dynamics import Frame, LatentDynamics

from .couplings import AffineCouplings, no_autocast
from .networks import linear, seeded_generator
from .training import Plan, Training, descend

PLANS = {
    "official": Plan(epochs=5000, learning_rate=1e-4, weight_decay=1e-10, clip=0.1, patience=250),
    "tuned": Plan(epochs=710, learning_rate=1e-3, n_batches=4, warm_up=0.05, clip=1.0, slack=0.3),
}
STAGES = 8
"""Steps from the chord to the demonstration in the tuned recipe."""
GUARD = 1e-3
"""Share of the demonstration's latent length below which the speed falls linearly: a unit vector is not Lipschitz."""
BEND = 0.05
"""Scale of the tuned recipe's straightness, in sizes of the demonstration."""
REST = 1e-2
"""Share of the mean speed below which the tuned recipe no longer asks for relative accuracy."""
FAR = 1.5
"""Latent lengths from the goal within which the nodes of a rollout are ``GUARD`` lengths apart; further out sparser."""
TAIL = 40
"""Nodes of a rollout within the guard, each a factor e nearer to the goal: the last is at 1e-20 of the length."""


class SDSEF(LatentDS):
    """Stable dynamics by Euclideanizing flows: ẏ = -exp(g(y)) J_φ⁻¹ z/‖z‖, z = φ(y) - φ(y*) (Rana et al. 2020).

    φ = ψ⁻¹ is a chain of affine couplings and g a small network; both are learned together from velocities. Learns
    from one demonstration or from several, pooled; their goals' mean is the attractor.

    ``recipe="official"`` minimises the SmoothL1 error of the velocities as the authors' code does. From a single
    winding demonstration it learns shortcuts, so ``"tuned"``, our own, also asks that the demonstration lie on one
    latent ray, which is where every motion of this system runs.

    ``fit_report.mse`` is the mean over all N n entries of the squared velocity error, (units / second)².

    Args:
        dim: n >= 1.
        n_layers: L >= 1, couplings.
        n_features: F >= 1, random Fourier features in each half of a coupling.
        recipe: "tuned" or "official".
        seed: of the frozen features, the initial network and the batches; None draws them from torch's generator.
        epochs: most passes over the samples, >= 1, in place of the recipe's own 5000 (official) or 710 (tuned); None
            keeps those. The tuned recipe learns in stages, each of which gets one epoch at least.
    """

    diffeomorphism: AffineCouplings
    dynamics: NormalizedDescent

    def __init__(
        self,
        dim: int,
        *,
        n_layers: int = 10,
        n_features: int = 200,
        recipe: str = "tuned",
        seed: int | None = None,
        epochs: int | None = None,
    ) -> None:
        if recipe not in list(PLANS):
            raise ValueError(f"recipe: expected one of {sorted(PLANS)}, got {recipe!r}")
        self_seed = None if seed is None else whole_number(seed, "seed", at_least=0)
        generator = seeded_generator(self_seed)
        psi = AffineCouplings(dim, n_layers, n_features, generator=generator)
        super().__init__(dim, psi, NormalizedDescent(psi, generator=generator))
        self.n_layers, self.n_features = psi.n_layers, psi.n_features
        self.recipe = recipe
        self.seed = self_seed
        self.epochs = None if epochs is None else whole_number(epochs, "epochs", at_least=1)

    def fit(self, demonstration: Demonstration | Sequence[Demonstration], *, progress: bool = False) -> SDSEF:
        shown = demonstrations_of(demonstration, self.dim)
        began = time.perf_counter()
        psi = self.diffeomorphism
        # A fresh system is trained, in float32 and in normalised units: twice as fast as float64, no worse, and the
        # rounding hides the noise of the units that the demonstration came in. An interrupted fit leaves self alone.
        learner = SDSEF(
            self.dim, n_layers=psi.n_layers, n_features=psi.n_features, recipe=self.recipe, seed=self.seed
        ).to(self.attractor.device, torch.float32)
        data = Normalized.of(shown)
        plan = PLANS[self.recipe]
        plan = plan if self.epochs is None else replace(plan, epochs=self.epochs)
        train = _train_tuned if self.recipe == "tuned" else _train_official
        training = train(learner, data, plan, seeded_generator(self.seed), progress)
        self.load_state_dict(learner.state_dict())
        self._place(data, shown)
        with torch.no_grad():
            missed = [self(d.positions.to(self.attractor)) - d.velocities.to(self.attractor) for d in shown]
            mse = float(torch.cat(missed).square().mean())
        seconds, origins = time.perf_counter() - began, tuple(d.fingerprint for d in shown)
        self.fit_report = FitReport(mse, psi.n_layers, seconds, training.history, training.notes, origins)
        return self

    @torch.no_grad()
    def _place(self, data: Normalized, shown: Sequence[Demonstration]) -> None:
        """From normalised units to those of the demonstrations."""
        psi, dynamics = self.diffeomorphism, self.dynamics
        psi.center.copy_(data.center)
        psi.scale.copy_(data.scale)
        self.attractor.copy_(torch.stack([d.goal for d in shown]).mean(0))
        starts = torch.stack([d.start for d in shown]).to(self.attractor)
        self.start.copy_(starts[self.lyapunov(starts).argmax()])  # the farthest in latent space
        dynamics.duration.fill_(data.duration)
        log_speeds = dynamics.network(data.points.to(self.attractor))
        dynamics.log_speed_range.copy_(torch.stack([log_speeds.min() - 1, log_speeds.max() + 1]))


class NormalizedDescent(LatentDynamics):
    """ẋ = -exp(g(y)) z / max(‖z‖, ε), z = x - x*: straight to the goal, at a speed that is a function of y = ψ(x).

    g, a network of 2 x 100 leaky ReLUs over normalised y, is held within the range that it had along the
    demonstration, widened by 1 each way, so that speeds far away stay bounded and above 0. ε is ``GUARD`` lengths.

    Args:
        diffeomorphism: ψ, for :meth:`flow` and for normalising; a reference, not a submodule.
        generator: draws the network's weights (torch's global one if None).

    Attributes:
        duration: () buffer, seconds in one unit of time of g.
        log_speed_range: (2,) buffer.
    """

    duration: Tensor
    log_speed_range: Tensor
    psi: AffineCouplings

    def __init__(self, diffeomorphism: AffineCouplings, *, generator: torch.Generator | None = None) -> None:
        super().__init__()
        object.__setattr__(self, "psi", diffeomorphism)
        sizes = [diffeomorphism.dim, 100, 100, 1]
        maps = [linear(a, b, generator) for a, b in pairwise(sizes)]
        self.network = nn.Sequential(maps[0], nn.LeakyReLU(), maps[1], nn.LeakyReLU(), maps[2])
        self.register_buffer("duration", torch.ones((), dtype=torch.float64))
        self.register_buffer("log_speed_range", torch.tensor([-1.0, 1.0], dtype=torch.float64))

    def forward(self, x: Tensor, y: Tensor, frame: Frame) -> Tensor:
        offset = x - frame.attractor
        distance = torch.linalg.vector_norm(offset, dim=-1).clamp(min=GUARD * frame.length)
        pull: Tensor = self.speed(y) / distance
        return -pull.unsqueeze(-1) * offset

    def speed(self, y: Tensor) -> Tensor:
        """exp(g(y)), latent units per second: (..., n) -> (...)."""
        with no_autocast(y):
            log_speed: Tensor = self.network(self.psi.normalize(y)).squeeze(-1)
        return log_speed.clamp(*self.log_speed_range).exp() / self.duration

    def flow(self, x: Tensor, t: Tensor, frame: Frame) -> Tensor:
        """Every motion runs on the ray from x to x*, so only its timing is integrated.

        The ray is sampled evenly in w, a C¹ function of the distance r that is linear along the demonstration,
        log r below the guard and logarithmic far outside. dt/dw is known at the nodes, the times there follow by a
        rule of fourth order, and w at the given times by cubic Hermite interpolation.
        """
        refuse_tracing("this rollout")
        guard = GUARD * frame.length
        offset = x - frame.attractor
        floor = torch.finfo(x.dtype).tiny ** 0.25
        distance = (offset.square().sum(-1) + (floor * frame.length) ** 2).sqrt()
        begin = _stretch(distance, guard)
        end = begin.detach().clamp(max=0.0) - TAIL
        spread = (begin.detach() - end).nan_to_num(0.0, 4096).flatten()
        # The demonstrated start spreads over a whole number of cells: rounding down or up there would make it jump.
        n_cells = 1 + int(torch.cat([spread, spread.new_tensor([8.0])]).amax().clamp(max=4096).round())
        step = (begin - end) / n_cells
        nodes = begin.unsqueeze(-1) - step.unsqueeze(-1) * torch.arange(n_cells + 1, dtype=x.dtype, device=x.device)
        radii, growth = _unstretch(nodes, guard)
        direction = (offset / distance.unsqueeze(-1)).unsqueeze(-2)
        path = self.psi(frame.attractor + radii.unsqueeze(-1) * direction)
        speed = self.speed(path) * (radii / guard).clamp(max=1.0)
        slowness = growth / speed * step.unsqueeze(-1)
        stamps = _cumulative(slowness)
        times = t.expand(*stamps.shape[:-1], -1).clamp(max=stamps[..., -1:])
        cell = torch.searchsorted(stamps.detach(), times.detach().contiguous(), right=True).clamp(1, n_cells) - 1
        here, there = stamps.gather(-1, cell), stamps.gather(-1, cell + 1)
        first, last = slowness.gather(-1, cell), slowness.gather(-1, cell + 1)
        along = cell + _hermite((times - here) / (there - here), (there - here) / first, (there - here) / last)
        later, _ = _unstretch(begin.unsqueeze(-1) - step.unsqueeze(-1) * along, guard)
        states: Tensor = frame.attractor + later.unsqueeze(-1) * direction
        return states

    def convergence_rate_bound(self, radius: float, frame: Frame) -> float:
        finite = all(bool(torch.isfinite(part).all()) for part in self.state_dict().values())
        if not (finite and self.duration > 0 and frame.length > 0):
            return -math.inf
        slowest = float(torch.exp(self.log_speed_range.min()) / self.duration)
        return slowest / max(radius, GUARD * float(frame.length))

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *rest: Any) -> None:
        """Refuse numbers that no such dynamics can have: those of a file, say."""
        duration, ends = (state_dict.get(prefix + name) for name in ("duration", "log_speed_range"))
        if duration is not None and not bool((duration > 0).all()):
            rest[-1].append(f"duration: expected a number > 0, got {duration.tolist()}")
        elif ends is not None and not bool((ends.diff() >= 0).all()):
            rest[-1].append(f"log_speed_range: expected its lower end first, got {ends.tolist()}")
        else:
            super()._load_from_state_dict(state_dict, prefix, *rest)


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

    @classmethod
    def of(cls, shown: Sequence[Demonstration]) -> Normalized:
        goal = torch.stack([d.goal for d in shown]).mean(0)
        for d in shown:
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
        )

    def straightened(self, share: float) -> Normalized:
        """The demonstrations on their way from their chords, share 0, to themselves, share 1."""
        return self._replace(
            points=torch.lerp(self.chord_points, self.points, share),
            velocities=torch.lerp(self.chord_velocities, self.velocities, share),
        )


def _train_official(
    learner: SDSEF, data: Normalized, plan: Plan, generator: torch.Generator | None, progress: bool
) -> Training:
    points, velocities, goal = (part.to(learner.attractor) for part in (data.points, data.velocities, data.goal))
    linearize, network = _linearize(learner), learner.dynamics.network

    def loss(batch: Tensor) -> Tensor:
        u = points[batch]
        x, push = linearize(torch.cat([u, goal.unsqueeze(0)]))
        predicted = -network(u).exp() * push(_unit(x - x[-1]))[:-1]
        return nn.functional.smooth_l1_loss(predicted, velocities[batch])

    return descend(loss, list(learner.parameters()), len(points), plan, generator=generator, progress=progress)


def _train_tuned(
    learner: SDSEF, data: Normalized, plan: Plan, generator: torch.Generator | None, progress: bool
) -> Training:
    return descend_bending(partial(_tuned_loss, learner), learner, data, plan, generator, progress)


def descend_bending(
    loss_of: Callable[[Normalized], Callable[[Tensor], Tensor]],
    learner: LatentDS,
    data: Normalized,
    plan: Plan,
    generator: torch.Generator | None,
    progress: bool,
) -> Training:
    """Continuation: a chord lies on one latent ray to begin with, and a curve that bends slowly is held there.

    In the plane a curve may cross itself while it bends, so there the demonstration is learned at once.
    """
    stages = STAGES if learner.dim > 2 else 1
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


def _tuned_loss(learner: SDSEF, data: Normalized) -> Callable[[Tensor], Tensor]:
    def descent(u: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        return _unit(z), -learner.dynamics.network(u).exp()

    return ray_loss(learner.diffeomorphism, descent, data)


def ray_loss(
    psi: AffineCouplings, field: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]], data: Normalized
) -> Callable[[Tensor], Tensor]:
    """2 mean(√(1 + ‖v̂-v‖²/‖v‖²) - 1) + mean(√(1 + ‖J_φ⁻¹ d / 0.05‖²) - 1) + mean ‖z/‖z‖ - e‖².

    e is the direction of z at the demonstrated start and d = z - max(0, z·e) e the way off the ray along it. The goals
    themselves have no direction and are left out.

    Args:
        psi: φ⁻¹, of which z = φ(u) - φ(goal).
        field: u and z, (b, n) each -> a latent velocity, (b, n), and a factor, (b, 1), which v̂ = J_φ⁻¹ (…) has, too.
        data: the demonstrations.
    """
    points, velocities, starts, goal = (
        part.to(psi.center) for part in (data.points, data.velocities, data.starts, data.goal)
    )
    owner = data.owner.to(points.device)
    linearize = psi.compiled_linearize() if points.device.type == "cpu" else psi.linearize
    squared_speeds = velocities.square().sum(-1)
    squared_speeds = squared_speeds + REST**2 * squared_speeds.mean()
    anchors = torch.cat([starts, goal.unsqueeze(0)])

    def loss(batch: Tensor) -> Tensor:
        u, v, n = points[batch], velocities[batch], len(batch)
        x, push = linearize(torch.cat([u, anchors]))
        z = x - x[-1]
        ray = _unit(z[n:-1])[owner[batch]]
        aside = z[:n] - (z[:n] * ray).sum(-1, keepdim=True).clamp(min=0) * ray
        latent, factor = field(u, z[:n])
        rest = torch.zeros_like(anchors)
        flow, away = push(torch.stack([torch.cat([latent, rest]), torch.cat([aside, rest])]))[:, :n]
        error = (factor * flow - v).square().sum(-1) / squared_speeds[batch]
        bend = (away / BEND).square().sum(-1)
        turn = (_unit(z[:n]) - ray).square().sum(-1)
        return torch.mean(2 * ((1 + error).sqrt() - 1) + (1 + bend).sqrt() - 1 + turn)

    return loss


def _unit(z: Tensor) -> Tensor:
    return nn.functional.normalize(z, dim=-1, eps=1e-6)


def _linearize(learner: SDSEF) -> Callable[[Tensor], tuple[Tensor, Callable[[Tensor], Tensor]]]:
    psi = learner.diffeomorphism
    return psi.compiled_linearize() if learner.attractor.device.type == "cpu" else psi.linearize


def _stretch(r: Tensor, guard: Tensor) -> Tensor:
    """w(r): log(r/ε) below the guard ε, r/ε - 1 up to FAR lengths, then 100 asinh of a hundredth of the rest."""
    unit = r / guard
    edge = FAR / GUARD
    beyond = torch.asinh((unit - edge).clamp(min=0) / 100) * 100
    return torch.log(unit.clamp(max=1.0)) + unit.clamp(1.0, edge) - 1 + beyond


def _unstretch(w: Tensor, guard: Tensor) -> tuple[Tensor, Tensor]:
    """r(w) and dr/dw."""
    edge = FAR / GUARD - 1
    tail = torch.exp(w.clamp(max=0.0))
    beyond = (w - edge).clamp(min=0) / 100
    return guard * (tail + w.clamp(0.0, edge) + 100 * torch.sinh(beyond)), guard * tail * torch.cosh(beyond)


def _cumulative(f: Tensor) -> Tensor:
    """Integrals from the first node to each, (..., K + 1) with unit spacing, of fourth order, K >= 3."""
    inner = (13 * (f[..., 1:-2] + f[..., 2:-1]) - f[..., :-3] - f[..., 3:]) / 24
    first = (9 * f[..., 0] + 19 * f[..., 1] - 5 * f[..., 2] + f[..., 3]) / 24
    last = (9 * f[..., -1] + 19 * f[..., -2] - 5 * f[..., -3] + f[..., -4]) / 24
    cells = torch.cat([first.unsqueeze(-1), inner, last.unsqueeze(-1)], -1)
    return torch.cat([torch.zeros_like(cells[..., :1]), cells.clamp(min=0).cumsum(-1)], -1)


def _hermite(s: Tensor, left: Tensor, right: Tensor) -> Tensor:
    """From 0 to 1 over s in [0, 1], with slopes ``left`` at 0 and ``right`` at 1."""
    return s * (left + s * (3 - 2 * left - right + s * (left + right - 2)))
