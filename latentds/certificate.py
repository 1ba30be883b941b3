"""What is proven about a fitted system, what was searched for in vain, and what turned out to be false."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from .arguments import real_array, whole_number
from .base import ROLLOUT_ERRORS, LatentDS, MovedDS, StableDS
from .fidelity import FLOW_GAP_LIMIT, NEARBY_STARTS, ROUNDING_LIMIT, Excerpt, measure
from .kernels.private import is_altered
from .probes import flow_gap, restart_gap, round_trip_gap

Verdict = Literal["proven", "not falsified", "falsified"]

ARRIVES_WITHIN = 100.0
"""Durations within which every motion must arrive: far beyond what any pause or far start of a sound fit costs."""
N_TIMES = 101
"""Times of one duration at which motions are looked at."""


@dataclass(frozen=True)
class Line:
    """One claim about a system.

    Attributes:
        claim: what is claimed.
        verdict: "proven" by construction (all that the proof rests on was checked on the very numbers that run; exact
            arithmetic assumed), "not falsified" by a search, or "falsified".
        tries: points, starts or layers that were tried.
        worst: the number nearest to breaking the claim, or the largest found after it broke; see ``detail``.
        detail: what ``worst`` is.
        counterexample: (n,) the point in demonstration space at which the claim fails, if it does at a point.
    """

    claim: str
    verdict: Verdict
    tries: int
    worst: float
    detail: str
    counterexample: tuple[float, ...] | None = None

    def __str__(self) -> str:
        verdict = self.verdict + (f" in {self.tries} tries" if self.verdict == "not falsified" else "")
        text = f"{verdict:28} {self.claim} ({self.detail} {self.worst:.3g})"
        if self.counterexample is not None:
            text += f"\n{'':28} at y = [{', '.join(f'{value:.6g}' for value in self.counterexample)}]"
        return text


@dataclass(frozen=True)
class Certificate:
    """What :func:`certify` found.

    Attributes:
        method: the system's class.
        dim: n.
        region: (low, high), corners of the box that was searched, each (n,).
        n_samples, seed: of the search.
        lines: one for each claim.
    """

    method: str
    dim: int
    region: tuple[tuple[float, ...], tuple[float, ...]]
    n_samples: int
    seed: int
    lines: tuple[Line, ...]

    @property
    def holds(self) -> bool:
        """Whether no claim was falsified."""
        return not self.falsified

    @property
    def falsified(self) -> tuple[Line, ...]:
        return tuple(line for line in self.lines if line.verdict == "falsified")

    def __str__(self) -> str:
        box = " x ".join(f"[{low:.3g}, {high:.3g}]" for low, high in zip(*self.region, strict=True))
        head = f"{self.method}, {self.dim}-D, searched in {box} (seed {self.seed})"
        return "\n".join([head, *(f"  {line}" for line in self.lines)])

    def to_json(self) -> str:
        """All fields as a JSON object; numbers that are not finite become strings."""
        return json.dumps(_plain(asdict(self) | {"holds": self.holds}), indent=1, allow_nan=False)


def certify(ds: StableDS, region: Any = None, *, n_samples: int = 1000, seed: int = 0) -> Certificate:
    """State what holds of a system by construction, and try to falsify the rest.

    Searched for, in the region and where motions from it run: an attractor that moves, an inverse or a Jacobian that is
    off, folds, equilibria other than the attractor, points at which V does not decrease, motions along which it rises,
    that differ from their two halves or that do not arrive. A system that was fitted is also held against what its
    report keeps of the demonstrations, as after the fit (:mod:`latentds.fidelity`), with the numbers that it has now.

    Args:
        ds: any system, fitted or not; it is left as it is.
        region: (2, n) lowest and highest corner of a box, in the units of the demonstration. By default one around the
            image of the latent ball that the demonstration spans, of a system without
            :meth:`~latentds.StableDS.surroundings` around what it was shown; needed if it was shown nothing.
        n_samples: points to sample, >= 10. The costlier searches try fewer.
        seed: of the samples, >= 0.

    Raises:
        ValueError: naming the argument, what was expected and what came.
    """
    if not isinstance(ds, StableDS):
        raise ValueError(f"ds: expected a StableDS, got {type(ds).__name__}")
    count = whole_number(n_samples, "n_samples", at_least=10)
    generator = torch.Generator().manual_seed(whole_number(seed, "seed", at_least=0))
    box = _region(ds, region, generator)
    search = _Search(ds, box, count, generator)
    corners = (tuple(box[0].tolist()), tuple(box[1].tolist()))
    return Certificate(type(ds).__name__, ds.dim, corners, count, seed, tuple(search.lines()))


class _Search:
    """Everything is measured against the size of the region and the time that it takes to cross it."""

    def __init__(self, ds: StableDS, box: Tensor, n_samples: int, generator: torch.Generator) -> None:
        self.ds, self.box, self.generator = ds, box.to(ds.attractor), generator
        self.goal = ds.attractor.detach()
        self.size = float((box[1] - box[0]).max())
        self.tolerance = torch.finfo(self.goal.dtype).eps ** 0.4  # 5e-7 in float64
        self.rounding = max(ROUNDING_LIMIT, self.tolerance)
        inside = box[0] + (box[1] - box[0]) * self._uniform(n_samples - n_samples // 4, ds.dim)
        radii = self.size * 10 ** (-3 * self._uniform(n_samples // 4, 1))
        near = self.goal.cpu() + radii * self._directions(n_samples // 4)
        points = torch.cat([inside.to(self.box), near.to(self.box).clamp(self.box[0], self.box[1])])
        at_goal = torch.linalg.vector_norm(points - self.goal, dim=-1) <= 1e-4 * self.size
        self.points = points[~at_goal]
        with torch.no_grad():
            self.velocity = ds(self.points)
            speed = torch.linalg.vector_norm(self.velocity, dim=-1)
        finite = speed[torch.isfinite(speed)]
        self.speed = max(float(finite.median()) if len(finite) else 0.0, torch.finfo(self.goal.dtype).tiny)
        self.numbers = all(bool(torch.isfinite(values).all()) for values in ds.state_dict().values())
        self.shown = _shown(ds)
        self.duration = self.shown[0].duration if self.shown else min(self.size / self.speed, 1e30)
        demonstrated = torch.tensor([one.path[0] for one in self.shown], dtype=torch.float64).reshape(-1, ds.dim)
        chosen = self.points[:: max(1, len(self.points) // 32)]
        self.starts = torch.cat([demonstrated.to(self.points), chosen])
        self.times = torch.linspace(0, self.duration, N_TIMES, dtype=torch.float64).to(self.points.device)

    def lines(self) -> list[Line]:
        lines, inside = [self._finite()], self.ds
        while isinstance(inside, MovedDS):
            inside = inside.ds
        if isinstance(inside, LatentDS):
            lines += self._invertibility(inside)
        if not self.numbers:
            return lines
        if isinstance(self.ds, LatentDS):
            lines += [self._rate(self.ds)]
        if lines[0].verdict == "falsified":
            return [*lines, self._attractor()]
        try:
            self._move()
        except ROLLOUT_ERRORS as error:
            reason = f"{type(error).__name__}: {error}; motions:"
            return [*lines, Line("motions can be computed", "falsified", len(self.starts), 0, reason)]
        lines += [self._attractor()]
        if isinstance(self.ds, LatentDS):
            lines += self._maps(self.ds)
        lines += [self._equilibria(), self._positive(), self._descent(), *self._motions(), self._convergence()]
        return [*lines, self._follows()] if self.shown else lines

    def _move(self) -> None:
        """Motions at ``times``, and from there on to when they must have arrived: one rollout, which may be costly."""
        later = torch.logspace(-2, math.log10(ARRIVES_WITHIN), N_TIMES - 1, dtype=torch.float64)
        clock, order = torch.cat([self.times, self.duration * later.to(self.times)]).sort()
        with torch.no_grad():
            moved = self.ds.rollout(self.starts, clock)[:, order.argsort()]
        self.paths = moved[:, :N_TIMES]
        self.long_paths = torch.cat([moved[:, :1], moved[:, N_TIMES:]], dim=1)

    def _finite(self) -> Line:
        broken = ~torch.isfinite(self.velocity).all(-1) | (not self.numbers)  # which no sample may show
        claim = "parameters and velocities are finite"
        return self._judge(claim, broken.to(self.goal), 0.5, "share that is not", self.points)

    def _invertibility(self, ds: LatentDS) -> list[Line]:
        proof = None if is_altered(ds.diffeomorphism) else ds.diffeomorphism.invertibility()
        return [] if proof is None else [_settled(proof.claim, proof.n_checked, proof.margin, proof.detail, proof.fold)]

    def _rate(self, ds: LatentDS) -> Line:
        """Proven in the ball around x* that holds all of the region, or all samples if ψ knows no such ball.

        Where the numbers break what the proof rests on, samples have to do, and the places that their motions pass.
        """
        claim = "latent motions approach the goal, -V̇/2V >= rate > 0"
        with torch.no_grad():
            frame, x = ds.frame(), ds.encode(self.points)
            goal = frame.attractor
            box, where = ds.diffeomorphism.inverse_box(self.box[0], self.box[1]), "in the region"
            if box is None:
                farthest, where = (x - goal).nan_to_num(), "where samples lie"
            else:
                farthest = torch.maximum((box[0] - goal).abs(), (box[1] - goal).abs()).unsqueeze(0)
            radius = float(torch.linalg.vector_norm(farthest, dim=-1).max())
            bound = ds.dynamics.convergence_rate_bound(radius, frame)
            known = type(ds).forward is LatentDS.forward and not is_altered(ds)
            if known and bound is not None and 0 < bound < math.inf:
                return Line(claim, "proven", 1, bound, f"least rate {where}, per second:")
            x = torch.cat([x, ds.latent_motion(self.starts, self.times).flatten(0, 1)])
            x = x[(x != goal).any(-1)]
            y, offset = ds.decode(x), x - goal
            rates = -(ds.dynamics(x, y, frame) * offset).sum(-1) / offset.square().sum(-1)
        line = self._judge(claim, -rates, -torch.finfo(rates.dtype).tiny, "least rate of samples, per second:", y)
        return replace(line, worst=-line.worst)

    def _attractor(self) -> Line:
        with torch.no_grad():
            speed = float(torch.linalg.vector_norm(self.ds(self.goal))) / self.speed
            later = self.ds.rollout(self.goal, torch.tensor([0.0, self.duration], dtype=torch.float64))
            errors = [speed, float((later[-1] - self.goal).abs().max()) / self.size]
            if isinstance(self.ds, LatentDS):
                errors.append(float((self.ds.decode(self.ds.frame().attractor) - self.goal).abs().max()) / self.size)
        worst = torch.tensor(errors).nan_to_num(nan=math.inf).amax().expand(1)
        return self._judge("the attractor rests", worst, self.tolerance, "relative error", self.goal.unsqueeze(0))

    def _maps(self, ds: LatentDS) -> list[Line]:
        """ψ, its inverse and its Jacobian, at the samples and where motions run."""
        passed = self.paths.flatten(0, 1)
        points = torch.cat([self.points, passed])
        with torch.no_grad():
            x = ds.encode(points)
            there = round_trip_gap(ds, points) / self.size
            # In units of the longest way to the goal: of a demonstration, if there is one.
            way = torch.linalg.vector_norm(ds.encode(self.starts) - ds.frame().attractor, dim=-1, keepdim=True)
            back = ds.latent_error(self.starts, self.times) * way / way[: len(self.shown) or None].max()
        return [
            self._judge("decode inverts encode", there, self.tolerance, "relative error", points),
            self._judge("encode inverts decode", back.flatten(), self.rounding, "error in latent lengths", passed),
            self._jacobian(ds),
            self._conditioning(ds, x, points),
        ]

    def _jacobian(self, ds: LatentDS) -> Line:
        points = self.points[:: max(1, len(self.points) // 64)]
        with torch.no_grad():
            x = ds.encode(points)
            closed = ds.jacobian(x)
        x = x.requires_grad_()
        rows = [torch.autograd.grad(column.sum(), x, retain_graph=True)[0] for column in ds.decode(x).unbind(-1)]
        wanted = torch.stack(rows, dim=-2)
        error = torch.linalg.matrix_norm(closed - wanted) / torch.linalg.matrix_norm(wanted)
        return self._judge("the closed-form Jacobian is autograd's", error, self.tolerance, "relative error", points)

    def _conditioning(self, ds: LatentDS, x: Tensor, points: Tensor) -> Line:
        with torch.no_grad():
            condition = ds.condition_number(x)
            signs = torch.linalg.slogdet(ds.jacobian(x).to(torch.float64))[0]
        folded = signs != signs.median()
        limit = 1 / torch.finfo(self.goal.dtype).eps
        badness = torch.where(folded, math.inf, condition)
        claim = "ψ neither folds nor flattens space"
        return self._judge(claim, badness, limit, "cond(J)", points)

    def _pace(self, y: Tensor) -> Tensor:
        """f(y)/‖y - y*‖, per duration: dividing takes the attractor itself away from those who look for zeros."""
        offset = torch.linalg.vector_norm(y - self.goal, dim=-1, keepdim=True)
        paced: Tensor = self.ds(y) / offset.clamp(min=1e-9 * self.size) * self.duration
        return paced

    def _slowest_on_the_way(self) -> tuple[Tensor, Tensor]:
        """Where motions are slowest for how far they have to go, and how slow: (B, n) and (B,).

        A field may stand still on a line that a rollout, which takes steps, has stepped over. So the few slowest places
        of each motion are narrowed down, by golden sections of the steps before and after them.
        """
        ratio = (5**0.5 - 1) / 2

        def speed(y: Tensor) -> Tensor:
            speeds: Tensor = torch.linalg.vector_norm(self._pace(y), dim=-1).nan_to_num(nan=0.0)
            return speeds

        paths = self.long_paths
        inner = speed(paths[:, 1:-1])
        place = inner.topk(min(4, inner.shape[1]), dim=-1, largest=False).indices + 1
        row = torch.arange(len(paths), device=place.device).unsqueeze(-1)
        middle = paths[row, place]
        low, high = (
            torch.cat(parts).flatten(0, 1)
            for parts in ([paths[row, place - 1], middle], [middle, paths[row, place + 1]])
        )
        for _ in range(70):
            left, right = high + ratio * (low - high), low + ratio * (high - low)
            speeds = speed(torch.stack([left, right]))
            first = (speeds[0] < speeds[1]).unsqueeze(-1)
            low, high = torch.where(first, low, left), torch.where(first, right, high)
        return low, speed(low)

    def _equilibria(self) -> Line:
        """Damped Newton steps on f(y)/‖y - y*‖ = 0 from the samples, and the slowest places of motions."""
        pace = self._pace
        lengths = torch.tensor([2.0, 1.0, 0.3]).to(self.points).view(-1, 1, 1, 1)  # 2 is right for a double root
        damping = torch.tensor([1e-12, 1e-4, 1e-2, 1.0]).to(self.points).view(-1, 1, 1)
        nudge = 1e-3 * self.tolerance**0.5 * self.size
        nudges = nudge * torch.eye(self.ds.dim).to(self.points)
        with torch.no_grad():
            y, relative = self.points, torch.linalg.vector_norm(pace(self.points), dim=-1)
            for _ in range(30):
                ahead, behind = (pace(y.unsqueeze(-2) + side * nudges) for side in (1, -1))
                slopes = (ahead - behind).mT.nan_to_num() / (2 * nudge)
                left, stretch, right = torch.linalg.svd(slopes)
                along = (left.mT @ pace(y).nan_to_num().unsqueeze(-1)).squeeze(-1)
                damped = along * stretch / (stretch.square() + damping * stretch[:, :1].square()).clamp(min=1e-300)
                trials = (y - lengths * (damped.unsqueeze(-2) @ right).squeeze(-2)).flatten(0, 1)
                trials = trials.clamp(self.box[0], self.box[1])
                left_over = torch.linalg.vector_norm(pace(trials), dim=-1).nan_to_num(nan=math.inf)
                best = left_over.argmin(0)
                rows = left_over.amin(0).argsort()[: max(32, len(y) // 2)]  # give up the worse half at every step
                y = trials[best, torch.arange(len(y))][rows]
            slow, slowness = self._slowest_on_the_way()
            every = torch.cat([self.points, y, slow])
            relative = torch.cat([relative, left_over.amin(0)[rows], slowness])
        away = torch.linalg.vector_norm(every - self.goal, dim=-1) > 1e-4 * self.size
        # Beside the field's own pace, since one may be slow as a whole; far beyond any pause that a fit leaves in it.
        usual = max(float(relative[: len(self.points)].nan_to_num().median()), torch.finfo(y.dtype).tiny)
        slowness, claim = usual / relative[away], "no equilibrium but the attractor"
        return self._judge(claim, slowness, 1e10, "largest slowness", every[away])

    def _positive(self) -> Line:
        """A V that is flat, or that jumps at the attractor, proves nothing, whatever its slope."""
        least = 8 * torch.finfo(self.goal.dtype).eps * float(self.goal.abs().max())
        distances = torch.tensor([max(share * self.size, least) for share in (1e-7, 1e-10, 1e-13)]).to(self.goal)
        rings = self.goal + distances.view(-1, 1, 1) * self._directions(64).to(self.goal)
        with torch.no_grad():
            high = self.ds.lyapunov(self.points)
            around = self.ds.lyapunov(rings).abs()
            best = around.amax(-1).argmin()  # V may be steep, and need not be low on each of them
            low = torch.cat([self.ds.lyapunov(self.goal).abs().unsqueeze(0), around[best]]) / high.max()
        badness = torch.cat([torch.where(high > 0, 0.0, math.inf), low])
        points = torch.cat([self.points, self.goal.unsqueeze(0), rings[best]])
        claim, detail = "V is above 0, and falls to 0 at the attractor", "V beside it over the largest"
        return self._judge(claim, badness, 1e-2, detail, points)

    def _motions(self) -> list[Line]:
        """What holds of every flow: V falls along it, and half a motion and half a motion are the motion."""
        with torch.no_grad():
            energy = self.ds.lyapunov(self.paths)
            rise = energy.diff(dim=-1) / energy[:, :1]
            apart = restart_gap(self.ds, self.paths, self.times) / self.size
            few = self.starts[: len(self.shown) + NEARBY_STARTS]
            off = flow_gap(self.ds, few, self.times, FLOW_GAP_LIMIT / 2 * self.size) / self.size
        before = self.paths[:, :-1].flatten(0, 1)
        return [
            self._judge("V falls along motions", rise.flatten(), self.tolerance, "largest rise over V(0)", before),
            self._judge("a motion is its two halves", apart, self.rounding, "largest distance", self.starts),
            self._judge("motions are the field's integral", off, FLOW_GAP_LIMIT, "largest distance", few),
        ]

    def _descent(self) -> Line:
        """Sampling, then gradient ascent on V̇/V from the worst points, by differences."""
        relative, cosine = self._slopes(self.points)
        every, cosines = [self.points], [cosine]
        nudge = 1e-4 * self.size
        nudges = nudge * torch.cat([torch.zeros(1, self.ds.dim), torch.eye(self.ds.dim)]).to(self.points)
        y = self.points[torch.cat([relative.argsort()[-16:], cosine.argsort()[-16:]])]
        for stage in range(8):
            around = (y.unsqueeze(-2) + nudges).flatten(0, 1)
            relative, cosine = self._slopes(around)
            every.append(around)
            cosines.append(cosine)
            relative = relative.view(len(y), -1)
            uphill = torch.nn.functional.normalize((relative[:, 1:] - relative[:, :1]).nan_to_num(), dim=-1)
            y = (y + 0.02 * 0.8**stage * self.size * uphill).clamp(self.box[0], self.box[1])
        points = torch.cat(every)
        away = torch.linalg.vector_norm(points - self.goal, dim=-1) > 1e-4 * self.size
        claim, detail = "V decreases, V̇ < 0", "largest cosine of ∇V and f"
        return self._judge(claim, torch.cat(cosines)[away], -torch.finfo(points.dtype).tiny, detail, points[away])

    def _slopes(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """V̇/V, and the cosine of ∇V and f, NaN where one of them is 0: both (B,)."""
        y = points.detach().clone().requires_grad_()
        energy = self.ds.lyapunov(y) + 0 * y.sum(-1)  # a constant V has a gradient too
        (uphill,) = torch.autograd.grad(energy.sum(), y)
        with torch.no_grad():
            velocity = self.ds(points)
        slope = (uphill * velocity).sum(-1)
        relative = torch.where(torch.isfinite(slope), slope / energy.detach(), math.inf)
        uphill, ahead = (v / torch.linalg.vector_norm(v, dim=-1, keepdim=True) for v in (uphill, velocity))
        return relative, (uphill * ahead).sum(-1)

    def _convergence(self) -> Line:
        left = torch.linalg.vector_norm(self.long_paths[:, -1] - self.goal, dim=-1) / self.size
        claim = f"every motion arrives within {ARRIVES_WITHIN:g} durations"
        return self._judge(claim, left, 1e-3, "largest distance left", self.starts)

    def _follows(self) -> Line:
        """Measured again, on the numbers as they are now, against what the report keeps of the demonstrations."""
        fidelity = measure(self.ds, self.shown)
        badness, words = max(fidelity.findings)
        verdict: Verdict = "not falsified" if fidelity.follows else "falsified"
        tries = len(self.shown) + NEARBY_STARTS
        return Line("follows its demonstration", verdict, tries, badness, f"{words}; share of the limit")

    def _judge(self, claim: str, badness: Tensor, limit: float, detail: str, points: Tensor) -> Line:
        """Falsified where ``badness`` (B,) is above ``limit``, or NaN, at one of the ``points`` (B, n)."""
        badness = badness.nan_to_num(nan=math.inf)
        worst = int(badness.argmax())
        holds = float(badness[worst]) <= limit
        point = None if holds else tuple(points[worst].tolist())
        verdict: Verdict = "not falsified" if holds else "falsified"
        return Line(claim, verdict, len(badness), float(badness[worst]), detail, point)

    def _uniform(self, *shape: int) -> Tensor:
        return torch.rand(*shape, generator=self.generator, dtype=torch.float64)

    def _directions(self, count: int) -> Tensor:
        draws = torch.randn(count, self.ds.dim, generator=self.generator, dtype=torch.float64)
        return torch.nn.functional.normalize(draws, dim=-1)


def _settled(
    claim: str, tries: int, worst: float, detail: str, counterexample: tuple[float, ...] | None = None
) -> Line:
    """A claim about parameters, true or not: that ``worst`` > 0."""
    holds = worst > 0 and math.isfinite(worst)
    return Line(claim, "proven" if holds else "falsified", tries, worst, detail, counterexample)


def _shown(ds: StableDS) -> tuple[Excerpt, ...]:
    """What the report of its fit keeps of the demonstrations."""
    shown = ds.excerpts()
    if any(len(one.path[0]) != ds.dim for one in shown):
        raise ValueError(f"ds: expected a fit_report that keeps demonstrations of dimension {ds.dim}, got another")
    return shown


def _region(ds: StableDS, region: Any, generator: torch.Generator) -> Tensor:
    if region is not None:
        corners = real_array(region, "region")
        if corners.shape != (2, ds.dim) or not np.isfinite(corners).all() or not (corners[0] < corners[1]).all():
            raise ValueError(f"region: expected (2, {ds.dim}) finite corners, low below high, got {corners.tolist()}")
        return torch.from_numpy(corners)
    draws = torch.randn(256, ds.dim, generator=generator, dtype=torch.float64)
    directions = torch.nn.functional.normalize(draws, dim=-1)
    radii = torch.linspace(0.1, 1, 256, dtype=torch.float64).unsqueeze(-1)
    with torch.no_grad():
        around = ds.surroundings((radii * directions).to(ds.attractor))
    places = [ds.attractor.unsqueeze(0)] if around is None else [around, ds.attractor.unsqueeze(0)]
    points = torch.cat(places).detach().cpu().double()
    points = points[torch.isfinite(points).all(-1)]
    if len(points) <= 1:  # no latent space, or one with NaN: where it was shown, it is to be found out
        rows = [row for one in ds.excerpts() for row in one.path]
        points = torch.cat([points, torch.tensor(rows, dtype=torch.float64).reshape(-1, ds.dim)])
    if not bool((points != points[:1]).any()):
        raise ValueError(f"region: expected (2, {ds.dim}) corners, as {type(ds).__name__} implies none, got None")
    low, high = points.amin(0), points.amax(0)
    margin = (0.25 * (high - low)).clamp(min=0.01 * float((high - low).max()))
    return torch.stack([low - margin, high + margin])


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(part) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(part) for part in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value
