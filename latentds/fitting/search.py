"""The search for a match of a latent line to a path that TubeDS moves along: candidates, their scores, a budget.

Nothing here knows the system that is fitted: a candidate is scored by a system that is made of it alone. The search is
counted in layers and candidates, never in seconds, so that the same motion gives the same match on every machine.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from ..arguments import Array
from ..curves import extent, frame_along, interpolated, segment_distances, step_lengths
from ..demonstration import Demonstration
from ..fidelity import Excerpt, System, measure
from ..findings import HIDDEN, what_hides
from ..metrics import dtw
from ..time_law import KnottedLaw
from ..translations import Layers
from .bundle import bundle, frames_across, smoothed
from .embedding import arc_length_path, map_to_endpoints, straight_column
from .homotopy import clear_direction, curvature_homotopy, drawn_homotopy, linear_homotopy, zoom_homotopy
from .matching import apply_layers, match_along, pin_ends, track
from .refinement import refine
from .strands import Strands, crowded
from .velocities import Fitted, Shown, learned, with_wide_layers


@dataclass(frozen=True)
class Plan:
    """How a match is searched for. Lengths are in sizes of the motion, unless said otherwise.

    Attributes:
        n_points: of the path, even in arc length, that ψ is matched on.
        n_layers: of the first candidates, where none are asked for; deeper_layers: of those that come next;
            tracked_layers: at most, of a match that tracks a homotopy closely.
        linear: candidates along the linear homotopy: steps, and length of the latent line in distances from start to
            goal; least_width: of a layer there, 1/ρ in distances between points of the path. Narrower layers fit the
            path better, and what lies beside it worse.
        curvature: candidates along the curvature homotopy: steps, and least widths.
        homotopy_steps: of a homotopy that is tracked, which takes several at once where strands are far apart.
        tracking_widths: least widths that are tried when a homotopy is tracked.
        clear: least share of their distance that strands keep on a linear homotopy worth tracking.
        dense_points: of the path that a match is held against; crowded_points: at most so many of them, denser where
            strands are close, that a deeper match is made on.
        trial_contraction: κ under which candidates are scored: they lead back to the path or they do not, whatever pull
            the motion is given.
        contractions: among which κ is chosen for several demonstrations, per duration: the least that leads from their
            starts as near as any, but for the factor ``gentle``. A stronger pull makes velocities beside them worse.
        near, n_starts: distance from the demonstrated start, and number, of the starts that also score a candidate.
        n_times: even in time, of the rollouts that score one.
        tube_weight: what the distance of ψ's tube from the one around the path counts beside that of the rollouts.
        max_condition: cond(J) along the path above which it counts in full, below by its root.
        least_refined, close_score: so many candidates are refined if they score within this factor of the best, ...
        good_score: ... and further ones until one scores less than this, or three times this after so many.
        deepen_above_score: where the best of so many scores more than this, and the depth is not given, more layers are
            the next to be tried.
        first_steps: of L-BFGS, with what lies beside the path, for every candidate of several demonstrations;
            race_steps: for those refined of one; steps: for those refined of several, and those of one whose score is
            then within the factor ``may_win`` of the best.
        follows_below: largest distance of the motion from the demonstrated start and the path that ends the search.
        note_above_miss: distance from the demonstration itself above which a fit that chooses its depth says so.
        hidden_above: noise or steps of a recording from which on a deeper search is of no use.
        layer_budget: layers that a deeper search may lay in all before it tries no further candidate.
    """

    n_points: int = 600
    n_layers: int = 300
    deeper_layers: int = 1000
    tracked_layers: int = 12000
    linear: tuple[tuple[int, float], ...] = ((20, 1.0), (20, 2.0), (20, 4.0), (5, 2.0), (5, 4.0))
    least_width: float = 3.0
    curvature: tuple[tuple[int, tuple[float, ...]], ...] = ((20, (1.5, 6.0, 12.0)), (5, (1.5, 6.0)))
    homotopy_steps: int = 500
    tracking_widths: tuple[float, ...] = (3.0, 1.5)
    clear: float = 0.02
    dense_points: int = 4800
    crowded_points: int = 2000
    trial_contraction: float = 20.0
    gentle: float = 1.03
    contractions: tuple[float, ...] = tuple(float(kappa) for kappa in np.geomspace(1, 20, 6))
    near: float = 0.05
    n_starts: int = 32
    n_times: int = 120
    tube_weight: float = 2.0
    max_condition: float = 100.0
    least_refined: int = 3
    close_score: float = 1.3
    good_score: float = 0.06
    deepen_above_score: float = 1.0
    first_steps: int = 60
    race_steps: int = 50
    may_win: float = 1.2
    steps: int = 300
    follows_below: float = 0.005
    note_above_miss: float = 0.01
    hidden_above: float = HIDDEN
    layer_budget: int = 40_000


PLAN = Plan()


class Candidate(NamedTuple):
    """A match, and the homotopy that it came along: linear, curvature or zoom."""

    homotopy: str
    layers: Layers
    line: Array
    """(N, n) the latent points"""

    def refined(self, path: Array, steps: int = 300) -> Candidate:
        weights = np.ones(len(path))
        weights[[0, -1]] = 0.05 * len(path)  # the start must encode to the start, the goal to the goal
        return self._replace(layers=refine(self.layers, self.line, path, 0.95, weights=weights, steps=steps))

    def widened(self, path: Array, steps: int) -> Candidate:
        """Refined with what lies beside the path, (N, n): see :func:`latentds.fitting.bundle.bundle`."""
        pairs = bundle(self.line, path, self._across(path))
        return self._replace(layers=refine(self.layers, pairs.x, pairs.y, 0.95, weights=pairs.weights, steps=steps))

    def tube_error(self, path: Array) -> float:
        """How far, root mean square, what lies beside the line is carried from where it belongs beside the path."""
        pairs = bundle(self.line, path, self._across(path))
        squares = np.square(apply_layers(self.layers, pairs.x) - pairs.y).sum(1)
        return float(np.sqrt((pairs.weights * squares).sum() / pairs.weights.sum()))

    def _across(self, path: Array) -> Array:
        """The directions beside the line, (n, n-1), that this match carries nearest to the path's own."""
        axis = self.line[-1] - self.line[0]
        length = float(np.linalg.norm(axis))
        basis = frame_along(axis / length)[:, 1:]
        if basis.shape[1] < 2:
            return basis
        every = slice(None, None, max(1, len(path) // 60))
        sides = frames_across(smoothed(path))[every]
        turned = np.zeros((basis.shape[1], basis.shape[1]))
        for index, side in enumerate(basis.T):
            step = 0.01 * length * side
            moved = apply_layers(self.layers, np.concatenate([self.line[every] + step, self.line[every] - step]))
            apart = np.subtract(*np.split(moved, 2))
            turned[:, index] = np.einsum("in,ina->a", apart, sides)
        left, _, right = np.linalg.svd(turned)
        left[:, -1] *= np.linalg.det(left) * np.linalg.det(right)
        rotated: Array = basis @ (left @ right).T
        return rotated

    def placed(self, origin: Array, unit: float) -> Candidate:
        """The same match in other units, about another origin."""
        centers, directions, widths = self.layers
        layers = Layers(origin + unit * centers, unit * directions, widths / unit)
        return self._replace(layers=layers, line=origin + unit * self.line)

    def mse(self, path: Array) -> float:
        line = self.line
        if len(line) != len(path):  # matched on points that crowd where strands are close
            line = line[:1] + np.linspace(0, 1, len(path))[:, None] * (line[-1] - line[0])
        return float(np.square(apply_layers(self.layers, line) - path).mean())


class Trial(System, Fitted, Protocol):
    """The system that a candidate makes."""

    def progress(self, y: Tensor) -> Tensor:
        """1 at the demonstrated start, 0 at the goal: (..., n) -> (...)."""

    def line_condition(self, n_points: int) -> Tensor:
        """cond(J) along the latent line, (n_points,)."""


TryOut = Callable[[Layers, KnottedLaw, float], Trial]
"""The system of layers, time law and κ, for the motion that is searched for."""


class Several(NamedTuple):
    """Several demonstrations, moved onto their common goal."""

    strands: Array
    """(K, N, n) each at even progress"""
    arrivals: Array
    """(K, N) when it is there, in seconds"""

    def missed_by(self, ds: Trial, n_times: int) -> float:
        """Mean distance of the motions from their starts to them, in units of the strands."""
        misses = []
        for strand, arrival in zip(self.strands, self.arrivals, strict=True):
            times = np.linspace(0, arrival[-1], n_times)
            path = ds.rollout(torch.from_numpy(strand[0]), torch.from_numpy(times)).numpy()
            misses.append(dtw(path, interpolated(times, arrival, strand)) / n_times)
        return float(np.mean(misses))


class Match(NamedTuple):
    """What a search ends with."""

    candidate: Candidate
    law: KnottedLaw
    contraction: float
    notes: tuple[str, ...]


@dataclass(frozen=True)
class Search:
    """A motion to be matched, and how.

    Args:
        shape: the motion, about its goal and in its own sizes.
        several: the demonstrations of which it is the mean, if they are several.
        try_out: makes the system of a candidate.
        n_layers: M; None to choose it.
        homotopy: "linear", "curvature" or "both".
        refined: whether L-BFGS refines candidates.
        contraction: κ; None to choose it.
        plan: the rest.
    """

    shape: Demonstration
    several: Several | None
    try_out: TryOut
    n_layers: int | None
    homotopy: str
    refined: bool
    contraction: float | None
    plan: Plan

    @cached_property
    def path_and_law(self) -> tuple[Array, KnottedLaw]:
        """(N, n) even in arc length, and the demonstrated time law."""
        points, way, times = arc_length_path(self.shape.positions.numpy(), self.shape.times.numpy(), self.plan.n_points)
        return points, KnottedLaw.from_timing(torch.from_numpy(way), torch.from_numpy(times))

    @torch.no_grad()
    def run(self) -> Match:
        path, law = self.path_and_law
        few = self._few(path, law)
        best = few[0] if self.several is None else next((c for c in few if self._off(self._trial(c, law)) <= 1), few[0])
        notes: tuple[str, ...] = ()
        if self.n_layers is None:
            best, notes = self._search_deeper(best, path, law)
        kappa = self.contraction or self.plan.trial_contraction
        if self.several is not None:
            law, kappa, missed = self._choose_law_and_contraction(best, law, self.several)
            if self.refined and self.n_layers is None:
                best, law = self._with_velocities(best, law, kappa, missed, self.several)
        return Match(best, law, kappa, notes)

    @torch.inference_mode(False)  # type: ignore[untyped-decorator]
    def _with_velocities(
        self, best: Candidate, law: KnottedLaw, kappa: float, missed: float, several: Several
    ) -> tuple[Candidate, KnottedLaw]:
        """The match and law whose velocities are nearer to those shown, if its motions stay as near."""
        shown = Shown.of(several.strands, several.arrivals, self.plan.n_times)
        more = with_wide_layers(best.layers, shown, self.shape.size)
        n_wide = len(more.widths) - len(best.layers.widths)
        allowed = max(1.0, self._off(self.try_out(best.layers, law, kappa)))
        for layers, own in learned(self.try_out(more, law, kappa), shown, n_wide):
            trial = self.try_out(layers, own, kappa)
            as_near = several.missed_by(trial, self.plan.n_times) <= self.plan.gentle * missed
            if as_near and self._off(trial) <= allowed:
                return best._replace(layers=layers), own
        return best, law

    def _few(self, path: Array, law: KnottedLaw) -> list[Candidate]:
        """The candidates that score within ``close_score`` of the best, the best first."""
        plan, several = self.plan, self.several
        scored = []
        for candidate in self._candidates(path, self.n_layers or plan.n_layers):
            wide = candidate.widened(path, plan.first_steps) if several and self.refined else candidate
            scored.append((self._score(wide, path, law), wide))
        scored.sort(key=lambda pair: pair[0])
        for tried, (score, candidate) in enumerate(list(scored) if self.refined else ()):
            close = tried < plan.least_refined and score < plan.close_score * scored[0][0]
            least = min(score for score, _ in scored)
            enough = least < plan.good_score * (1 if tried < plan.least_refined else 3)
            deepen = self.n_layers is None and tried >= plan.least_refined and least > plan.deepen_above_score
            if tried and (enough or deepen) and not close:
                break
            better = candidate.widened(path, plan.steps) if several else candidate.refined(path, plan.race_steps)
            scored.append((self._score(better, path, law), better))
        scored.sort(key=lambda pair: pair[0])
        for score, candidate in scored[: plan.least_refined] if self.refined and not several else ():
            if score < plan.may_win * scored[0][0]:
                better = candidate.refined(path, plan.steps)
                scored.append((self._score(better, path, law), better))
        scored.sort(key=lambda pair: pair[0])
        return [candidate for score, candidate in scored if score <= plan.close_score * scored[0][0]] or [scored[0][1]]

    def _candidates(self, path: Array, n_layers: int) -> Iterator[Candidate]:
        """Matches of a line to the path (N, n), along either homotopy or the one that is asked for."""
        apart = float(step_lengths(path).max())  # less where a corner is cut
        chord = map_to_endpoints(straight_column(len(path)), path[0], path[-1])
        middle = chord.mean(0)

        def matched(homotopy: str, curves: Array, width: float) -> Candidate:
            return Candidate(homotopy, match_along(curves, n_layers, 0.9, 0.9, width * apart), curves[0])

        most = max(1, n_layers // 10)
        for steps, stretch in self.plan.linear if self.homotopy != "curvature" else ():
            line = middle + stretch * (chord - middle)
            yield matched("linear", linear_homotopy(line, path, min(steps, most)), self.plan.least_width)
        if path.shape[1] > 1 and self.homotopy != "linear":
            for steps, widths in self.plan.curvature:
                curves = curvature_homotopy(path, min(steps, most))
                for width in widths:
                    yield matched("curvature", curves, width)

    def _score(self, candidate: Candidate, path: Array, law: KnottedLaw) -> float:
        """How badly it rolls out from the demonstrated start (thrice) and from near it, times √cond(J), or more.

        Of several demonstrations, how badly their own starts lead along them and how badly what lies beside their mean
        is matched count, too.
        """
        plan, shown, several = self.plan, self.shape, self.several
        missed = self._choose_law_and_contraction(candidate, law, several)[2] if several else 0.0
        ds = self.try_out(candidate.layers, law, plan.trial_contraction)
        around = np.random.default_rng(1).standard_normal((plan.n_starts, shown.dim))
        around *= plan.near * shown.size / np.linalg.norm(around, axis=1, keepdims=True)
        starts = shown.start + torch.from_numpy(np.concatenate([np.zeros((1, shown.dim)), around]))
        times, step = np.linspace(0, shown.duration, plan.n_times, retstep=True)
        paths = ds.rollout(starts, torch.from_numpy(times)).numpy()
        # Which fraction of a step a start is ahead is chance, and would drown the rest where steps are long.
        left = law.time_to_go(ds.progress(starts).abs()).numpy()
        ahead = (left[0] - left) / step
        clocks = times + step * (ahead - ahead.round())[:, None]
        motions = shown.at(clocks)
        unit = plan.n_times * shown.size
        misses = [dtw(path, motion) / unit for path, motion in zip(paths, motions, strict=True)]
        condition = float(ds.line_condition(plan.n_points).max())
        beside = plan.tube_weight * candidate.tube_error(path) if several else 0.0
        score = 3 * (misses[0] + missed) + float(np.mean(misses[1:])) + beside
        score *= math.sqrt(condition)
        score *= max(1.0, condition / plan.max_condition)
        return score if math.isfinite(score) else math.inf

    def _choose_law_and_contraction(
        self, candidate: Candidate, law: KnottedLaw, several: Several
    ) -> tuple[KnottedLaw, float, float]:
        """Time law and κ under which a match leads several from their own starts most nearly along; and how nearly.

        The last is the mean distance in sizes of the motion.
        """
        trial = self.try_out(candidate.layers, law, self.plan.trial_contraction)
        progress = trial.progress(torch.from_numpy(several.strands)).numpy()
        pooled = KnottedLaw.pooled(progress, several.arrivals)
        misses = {}
        for kappa in self.plan.contractions if self.contraction is None else (self.contraction,):
            misses[kappa] = several.missed_by(self.try_out(candidate.layers, pooled, kappa), self.plan.n_times)
        enough = self.plan.gentle * min(misses.values())
        kappa = min((kappa for kappa, miss in misses.items() if miss <= enough), default=self.plan.trial_contraction)
        return pooled, kappa, misses.get(kappa, math.inf)

    @cached_property
    def _fine(self) -> tuple[Array, Array, Array]:
        """The path, dense and even in arc length, how much of the way is left there, and when."""
        return arc_length_path(self.shape.positions.numpy(), self.shape.times.numpy(), self.plan.dense_points)

    @cached_property
    def _crowded(self) -> Array:
        """The path again, denser where its strands are close."""
        return crowded(self._fine[0], self.plan.crowded_points)

    @cached_property
    def _even(self) -> Array:
        """Times at which a match is held against the motion."""
        return np.linspace(0, self._fine[2][-1], 8 * self.plan.n_times)

    @cached_property
    def _wanted(self) -> tuple[Excerpt, ...]:
        fine, way, times = self._fine
        share = np.interp(self._even, times, 1 - way)
        timed = interpolated(share, np.linspace(0, 1, len(fine)), fine)
        return (Excerpt.of(Demonstration(torch.from_numpy(timed), float(self._even[1]))),)

    def _trial(self, candidate: Candidate, law: KnottedLaw) -> Trial:
        """The system of a match, of several demonstrations with their own law and κ."""
        if self.several is None:
            return self.try_out(candidate.layers, law, self.plan.trial_contraction)
        own, kappa, _ = self._choose_law_and_contraction(candidate, law, self.several)
        return self.try_out(candidate.layers, own, kappa)

    def _off(self, ds: Trial) -> float:
        """How far a system is from following the path, above 1 if it does not."""
        fidelity = measure(ds, self._wanted)
        if self.several is not None:  # whose mean is nobody's motion: it is to be led along, in no time of its own
            return max(bad for bad, _ in replace(fidelity, timing=0.0).findings)
        return max(fidelity.miss / self.plan.follows_below, *(bad for bad, _ in fidelity.findings))

    def _search_deeper(self, first: Candidate, path: Array, law: KnottedLaw) -> tuple[Candidate, tuple[str, ...]]:
        """The match that was found, or a deeper one, the first that follows the path; what stood in the way if none."""
        plan, shown = self.plan, self.shape
        even = self._even

        def badness(candidate: Candidate) -> float:
            return self._off(self._trial(candidate, law))

        hidden = what_hides(shown.positions.numpy(), plan.hidden_above)
        best, least = first, badness(first)
        again: list[tuple[float, Candidate]] = []
        laid, stopped = 0, False
        for layers, candidate in self._deeper(path) if least > 1 and not hidden else ():
            laid += layers
            if candidate is not None:
                if self.several is not None and self.refined and len(candidate.line) == len(path):
                    candidate = candidate.widened(path, plan.first_steps)
                again.append((badness(candidate), candidate))
            stopped = laid >= plan.layer_budget
            if stopped or (candidate is not None and again[-1][0] <= 1):
                break
        else:
            for _, candidate in sorted(again, key=lambda pair: pair[0])[: 1 if self.refined else 0]:
                better = candidate.refined(path if len(candidate.line) == len(path) else self._crowded, 100)
                again.append((badness(better), better))
        best, least = min([(least, best), *again], key=lambda pair: pair[0])[::-1]
        motion = self._trial(best, law).rollout(shown.start, torch.from_numpy(even)).numpy()
        missed = dtw(motion, shown.at(even)) / len(even) / shown.size
        notes = [str(hidden)] if hidden else []
        if least > 1 and not hidden:
            near = float(Strands(path, plan.n_points).clearance(path).min())
            notes.append(f"no match tried follows the path closely; its strands come within {near:.2g} of its size")
            if stopped:
                notes.append(f"the search for a match stopped after {laid} layers")
        if not missed <= plan.note_above_miss:
            notes.append(f"misses the demonstration itself by {missed:.2g} of its size")
        return best, tuple(notes)

    def _deeper(self, path: Array) -> Iterator[tuple[int, Candidate | None]]:
        """Layers laid and a match, if it ended in one, for a path that the first ones do not follow, quickest first.

        More layers; then homotopies tracked as closely as strands need, on points that are denser where they are close.
        """
        plan = self.plan
        for candidate in self._candidates(path, plan.deeper_layers):
            yield len(candidate.layers.widths), candidate
        dense = self._crowded
        steps = step_lengths(dense)
        length, apart = float(steps.sum()), float(np.median(steps))

        def tracked(homotopy: str, curves: Array) -> Iterator[tuple[int, Candidate | None]]:
            for width in plan.tracking_widths:
                layers, arrived = track(curves, plan.tracked_layers, width * apart)
                if arrived:
                    pinned = pin_ends(layers, curves[0], dense, 0.9)
                    yield len(layers.widths), Candidate(homotopy, pinned, curves[0])
                    return
                yield len(layers.widths), None

        if self.homotopy != "curvature":
            direction, clear = clear_direction(path)
            for share in (1.0, 0.25) if clear > plan.clear else ():
                yield from tracked("linear", drawn_homotopy(dense, direction, share * length, plan.homotopy_steps))
        if path.shape[1] > 1 and self.homotopy != "linear":
            yield from tracked("curvature", curvature_homotopy(dense, plan.homotopy_steps))
            for pivot in (0.5, 0.0, 1.0):
                yield from tracked("zoom", zoom_homotopy(dense, plan.homotopy_steps, pivot))


def refuse_crossings(path: Array, origin: Array, unit: float) -> None:
    """Refuse a path that meets itself: an autonomous system has one velocity per point.

    The path is told in the demonstration's units, ``origin`` + ``unit`` times it.

    Stretches closer along the path than 2 % of it may touch: that is noise, not a crossing.
    """
    start, step = path[:-1], np.diff(path, axis=0)
    count = len(step)
    first, second = np.triu_indices(count, max(2, count // 50))
    gap = start[first] - start[second]
    touching = 1e-7 * extent(path)
    lengths = np.linalg.norm(step, axis=1)
    close = np.einsum("ij,ij->i", gap, gap) < (lengths[first] + lengths[second] + touching) ** 2
    first, second = first[close], second[close]
    near = segment_distances(gap[close], step[first], step[second])
    if near.min(initial=math.inf) < touching:
        worst = int(near.argmin())
        where = f"[{', '.join(f'{value:.4g}' for value in origin + unit * start[first[worst]])}]"
        raise ValueError(
            f"demonstration: expected a path that does not meet itself, got one that comes back to {where} "
            f"({first[worst] / count:.0%} and {(second[worst] + 1) / count:.0%} of the way); "
            "an autonomous system has one velocity at each point"
        )
