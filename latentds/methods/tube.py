"""TubeDS, our own method: an arc-length line, continuation along a homotopy, refinement, a contracting tube."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..arguments import number_in
from ..base import FitReport, LatentDS, Learned
from ..demonstration import Demonstration, goal_apart, jitter
from ..diffeomorphism import Layers, LocallyWeightedTranslations
from ..dynamics import TubeDynamics
from ..fidelity import Excerpt, measure
from ..fitting.bundle import across_of, bundle, frames, smoothed, timing_of
from ..fitting.embedding import arc_length_path, map_to_endpoints, straight_column
from ..fitting.homotopy import (
    clear_direction,
    curvature_homotopy,
    drawn_homotopy,
    linear_homotopy,
    zoom_homotopy,
)
from ..fitting.matching import apply_layers, match_along, pin_ends, track
from ..fitting.refinement import refine
from ..fitting.strands import Strands, crowded, segment_distances
from ..metrics import dtw
from ..time_law import PiecewiseLinearLaw

Array = NDArray[np.float64]

DEPTHS = (300, 1000, 12000)
"""Layers where none are asked for: of the first try; of one more; at most of matches that track a homotopy closely."""
START_MISS = 0.005
"""Largest distance of the motion from the demonstrated start and the path, in its sizes, that a fit is content with."""
FINE = 500
"""Steps of a homotopy that is tracked; it takes several at once where strands are far apart."""
TRACKED = (3.0, 1.5)
"""Least widths of a layer in distances between points that are tried when a homotopy is tracked."""
SEARCH_SECONDS = 12.0
"""CPU seconds after which no further match is tried; the last one may take two more."""
SHOWS = 0.01
"""Miss of the demonstration itself, in its sizes, above which a fit that chooses its depth says so."""
BLURRED = 0.02
"""Noise or steps of a recording, in its sizes, from which on a deeper search is of no use."""
CLEAR = 0.02
"""Least share of their distance that strands keep on a linear homotopy worth tracking."""
FINEST = 4800
"""Points of the path that a fit is held against, and …"""
MOST_POINTS = 2000
"""… at most so many of them, denser where strands are close, that it is then matched on."""
N_POINTS = 600
"""Points, even in arc length, that ψ is matched on."""
LINEAR = ((20, 1.0), (20, 2.0), (20, 4.0), (5, 2.0), (5, 4.0))
"""Matches tried along the linear homotopy: steps, and length of the latent line in distances from start to goal."""
CURVATURE = ((20, (1.5, 6.0, 12.0)), (5, (1.5, 6.0)))
"""And along the curvature homotopy: steps, and least widths 1/ρ of a layer in distances between points of the path."""
WIDTH = 3.0
"""That of a layer along the linear one: narrower layers fit the path better, and what lies beside it worse."""
DECIMALS = 9
"""To which the motion is rounded, in its own sizes."""
TUBE = 0.02
"""Radius of the tube that the report speaks of, in lengths of the latent line."""
CONTRACTIONS = tuple(float(kappa) for kappa in np.geomspace(1, 20, 6))
"""Rates κ, per duration, among which one is chosen for several demonstrations."""
JUDGED = 20.0
"""κ under which matches are judged: they lead back to the path or they do not, whatever pull the motion is given."""
NEAR, STARTS = 0.05, 32
"""Distance from the demonstrated start, in sizes of the motion, and number of the starts that also judge a match."""
ROWS = 120
"""Points, even in time, of the rollouts that judge a match."""
MAX_CONDITION = 100.0
"""cond(J) along the path above which a match is judged by all of it, below by its root."""
TRIES, CLOSE = 3, 1.3
"""So many matches are refined if they score within this factor of the best, …"""
GOOD_SCORE = 0.06
"""… and further ones until one scores less than this, or three times this after so many."""
HOPELESS = 1.0
"""Where the best of so many scores more than this, and the depth is not given, more layers are the next to be tried."""
FIRST_STEPS, STEPS = 60, 300
"""L-BFGS steps of a match with what lies beside the path: of every match, and of those that are refined."""
BESIDE = 2.0
"""What the distance of ψ's tube from the one around the path counts beside that of the motions that judge a match."""
FAR = 0.25
"""Distance from the axis, in sizes of the motion, beyond which the inward pull stops growing."""


@dataclass(frozen=True)
class TubeReport(FitReport):
    """What a fit of :class:`TubeDS` reached and what it costs.

    Attributes:
        isotopy: the homotopy that was kept, "straight" (linear) or "unbending" (curvature).
        rollout_error: mean distance of the rollout from the demonstrated start to the demonstration at equal progress,
            in sizes of the motion.
        condition_path: largest cond(J_ψ) along the path.
        condition_tube: the same within 0.02 latent lengths of it.
        largest_velocity: largest ‖f‖ in that tube, in mean speeds of the demonstration.
        largest_gradient: largest ‖∂f/∂y‖ (spectral) in that tube, per demonstration duration: what a controller must
            follow; it grows with the contraction κ.
        spread: standard deviation of several demonstrations about their mean path, per coordinate; zeros for one.
        contraction: κ, per duration of the demonstration: the one asked for, or read from what was shown.
    """

    isotopy: str = ""
    rollout_error: float = 0.0
    condition_path: float = 1.0
    condition_tube: float = 1.0
    largest_velocity: float = 0.0
    largest_gradient: float = 0.0
    spread: tuple[float, ...] = ()
    contraction: float = 0.0


class TubeDS(LatentDS):
    """Stable motion that keeps to a contracting tube around the demonstration, with nothing to tune.

    Points evenly spaced in arc length are matched to a straight line, so that ψ is near-isometric along the path; the
    timing lives in the time law alone. Matching follows the linear or the curvature homotopy, whichever rolls out
    better and is better conditioned, and is then refined jointly. Across the path the latent point is drawn in at
    rate κ. The attractor is exact.

    Several demonstrations of one motion are fitted by their mean path at equal progress, with a common goal, and by the
    time law under which each, from where it starts, keeps its own times most nearly. What lies beside that path is
    matched too, as far as it leaves room, so that ψ is near-isometric across it.

    Args:
        dim: n >= 1.
        n_layers: M >= 1; None for 300, or as many as it takes to follow the path: see ``DEPTHS``.
        contraction: κ > 0, per duration of the demonstration: a start off the path comes back within about
            3/κ of it. A larger κ costs proportionally larger velocity gradients (see the report). None, the default,
            is 20 for one demonstration, which says nothing about what lies beside it, and for several that one of
            ``CONTRACTIONS`` under which their own starts lead most nearly along them. ``fit_report.contraction`` tells
            it.
        refined: whether L-BFGS refines the match; without it a fit takes a tenth of the time.
        homotopy: the one that matching may follow, "linear" or "curvature" (n >= 2), or "both".
    """

    diffeomorphism: LocallyWeightedTranslations
    dynamics: TubeDynamics
    report_type = TubeReport

    def __init__(
        self,
        dim: int,
        *,
        n_layers: int | None = None,
        contraction: float | None = None,
        refined: bool = True,
        homotopy: str = "both",
    ) -> None:
        along, across = PiecewiseLinearLaw.uniform(), PiecewiseLinearLaw(torch.ones(1), torch.ones(1))
        psi = LocallyWeightedTranslations(dim, 1 if n_layers is None else n_layers, any_number=n_layers is None)
        super().__init__(dim, psi, TubeDynamics(along, across))
        self.n_layers = None if n_layers is None else psi.n_layers
        self.contraction = None if contraction is None else number_in(contraction, "contraction", 0, float("inf"))
        self.refined = bool(refined)
        known = ("linear", "curvature", "both") if self.dim > 1 else ("linear", "both")
        if homotopy not in known:
            raise ValueError(f"homotopy: expected one of {known} in {self.dim} dimensions, got {homotopy!r}")
        self.homotopy = homotopy

    def _learn(self, demonstrations: Sequence[Demonstration], progress: bool) -> Learned:
        shown, strands, arrivals = mean_motion(demonstrations)
        # L-BFGS runs on to another match from another rounding, so that none may come from the units or the origin.
        origin, unit = shown.goal.numpy(), shown.size
        shape = Demonstration(((shown.positions - shown.goal) / unit).round(decimals=DECIMALS), shown.dt)
        path, way, times = arc_length_path(shape.positions.numpy(), shape.times.numpy(), N_POINTS)
        _refuse_crossings(path, origin, unit)
        goal_apart(shown, shown.goal)
        several = Several((strands - origin) / unit, arrivals) if len(demonstrations) > 1 else None
        law = PiecewiseLinearLaw.from_timing(torch.from_numpy(way), torch.from_numpy(times))
        judged = []
        for candidate in _candidates(path, self.n_layers or DEPTHS[0], self.homotopy):
            tube = candidate.widened(path, FIRST_STEPS) if several and self.refined else candidate
            judged.append((self._score(tube, path, shape, law, several), tube))
        judged.sort(key=lambda pair: pair[0])
        if self.refined:
            for tried, (score, candidate) in enumerate(list(judged)):
                close = tried < TRIES and score < CLOSE * judged[0][0]
                enough = min(score for score, _ in judged) < GOOD_SCORE * (1 if tried < TRIES else 3)
                hopeless = self.n_layers is None and tried >= TRIES and min(score for score, _ in judged) > HOPELESS
                if tried and (enough or hopeless) and not close:
                    break
                better = candidate.widened(path, STEPS) if several else candidate.refined(path)
                judged.append((self._score(better, path, shape, law, several), better))
        found = min(judged, key=lambda pair: pair[0])[1]
        notes: tuple[str, ...] = ()
        if self.n_layers is None:
            found, notes = self._followed(found, path, shape, law)
        best = found.placed(origin, unit)
        kappa = self.contraction or JUDGED
        if several:
            law, kappa, _ = self._settled(found, shape, law, several)
        self._take(best, shown, law, kappa)
        self._refuse_folds(shown)
        details = self._conditioning(origin + unit * path, shown) | {
            "isotopy": best.isotopy,
            "spread": tuple(float(value) for value in strands.std(0).mean(0)),
            "contraction": kappa,
        }
        return Learned(best.mse(origin + unit * path), self.diffeomorphism.n_layers, notes=notes, details=details)

    @torch.no_grad()
    def _take(self, candidate: Candidate, shown: Demonstration, law: PiecewiseLinearLaw, kappa: float = JUDGED) -> None:
        """Take a match, and the dynamics for it."""
        self.diffeomorphism.assign(*(torch.from_numpy(part) for part in candidate.layers))
        self.attractor.copy_(shown.goal)
        self.start.copy_(shown.start)
        far = torch.as_tensor(FAR * shown.size) / self.frame().length.cpu()
        self.dynamics.law = law.to(self.attractor)
        transverse = PiecewiseLinearLaw(far.reshape(1), (far * kappa / shown.duration).reshape(1))
        self.dynamics.transverse_law = transverse.to(self.attractor)

    @torch.no_grad()
    def _settled(
        self, candidate: Candidate, shown: Demonstration, law: PiecewiseLinearLaw, several: Several
    ) -> tuple[PiecewiseLinearLaw, float, float]:
        """Time law and κ under which a match leads several from their own starts most nearly along; and how nearly.

        The last is the mean distance in sizes of the motion.
        """
        self._take(candidate, shown, law)
        progress = self.dynamics.phase(self.encode(torch.from_numpy(several.strands).to(self.attractor)), self.frame())
        way, times = timing_of(progress.cpu().double().numpy(), several.arrivals)
        law = PiecewiseLinearLaw.from_timing(torch.from_numpy(way), torch.from_numpy(times))
        found = []
        for kappa in CONTRACTIONS if self.contraction is None else (self.contraction,):
            self._take(candidate, shown, law, kappa)
            found.append((several.missed(self), kappa))
        miss, kappa = min(found)
        return law, kappa, miss

    @torch.no_grad()
    def _score(
        self, candidate: Candidate, path: Array, shown: Demonstration, law: PiecewiseLinearLaw, several: Several | None
    ) -> float:
        """How badly it rolls out from the demonstrated start (thrice) and NEAR it, times √cond(J), or more.

        Of several demonstrations, how badly their own starts lead along them and how badly what lies beside their mean
        is matched count, too.
        """
        told = self._settled(candidate, shown, law, several)[2] if several else 0.0
        self._take(candidate, shown, law)
        around = np.random.default_rng(1).standard_normal((STARTS, self.dim))
        around *= NEAR * shown.size / np.linalg.norm(around, axis=1, keepdims=True)
        starts = shown.start + torch.from_numpy(np.concatenate([np.zeros((1, self.dim)), around]))
        starts = starts.to(self.attractor)
        times, step = np.linspace(0, shown.duration, ROWS, retstep=True)
        paths = self.rollout(starts, torch.from_numpy(times)).cpu().numpy()
        # Which fraction of a step a start is ahead is chance, and would drown the rest where steps are long.
        share = self.dynamics.phase(self.encode(starts), self.frame()).abs()
        left = self.dynamics.law.time_to_go(share).cpu().numpy()
        ahead = (left[0] - left) / step
        clocks = times + step * (ahead - ahead.round())[:, None]
        misses = [dtw(path, motion) / ROWS / shown.size for path, motion in zip(paths, shown.at(clocks), strict=True)]
        condition = float(self.condition_number(self._line()).max())
        score = (
            3 * (misses[0] + told) + float(np.mean(misses[1:])) + (BESIDE * candidate.beside(path) if several else 0.0)
        )
        score *= math.sqrt(condition)
        score *= max(1.0, condition / MAX_CONDITION)
        return score if math.isfinite(score) else math.inf

    @torch.no_grad()
    def _followed(
        self, found: Candidate, path: Array, shape: Demonstration, law: PiecewiseLinearLaw
    ) -> tuple[Candidate, tuple[str, ...]]:
        """The match that was found, or a deeper one, the first that follows the path; what stood in the way if none."""
        fine, way, times = arc_length_path(shape.positions.numpy(), shape.times.numpy(), FINEST)
        even = np.linspace(0, times[-1], 8 * ROWS)
        share = np.interp(even, times, 1 - way)
        timed = np.stack([np.interp(share, np.linspace(0, 1, FINEST), column) for column in fine.T], 1)
        wanted = (Excerpt.of(Demonstration(torch.from_numpy(timed), float(even[1]))),)

        def badness(candidate: Candidate) -> float:
            self._take(candidate, shape, law)
            told = measure(self, wanted)
            return max(told.miss / START_MISS, *(bad for bad, _ in told.findings))

        began, blur = time.thread_time(), _blur(shape)
        best, least, dense = found, badness(found), crowded(fine, MOST_POINTS)
        tried = () if least <= 1 or blur else _deeper(path, dense, self.homotopy)
        again: list[tuple[float, Candidate]] = []
        stopped = False
        for candidate in tried:
            again.append((badness(candidate), candidate))
            stopped = time.thread_time() - began > SEARCH_SECONDS
            if again[-1][0] <= 1 or stopped:
                break
        else:
            for _, candidate in sorted(again, key=lambda pair: pair[0])[: 1 if self.refined else 0]:
                better = candidate.refined(dense if len(candidate.line) == len(dense) else path, 100)
                again.append((badness(better), better))
        best, least = min([(least, best), *again], key=lambda pair: pair[0])[::-1]
        self._take(best, shape, law)
        motion = self.rollout(shape.start.to(self.attractor), torch.from_numpy(even)).cpu().numpy()
        missed = dtw(motion, shape.at(even)) / len(even) / shape.size
        notes = [blur] if blur else []
        if least > 1 and not blur:
            near = float(Strands(path, N_POINTS).clearance(path).min())
            notes.append(f"no match tried follows the path closely; its strands come within {near:.2g} of its size")
            if stopped:
                notes.append(f"the search for a match stopped after {SEARCH_SECONDS:g} s")
        if not missed <= SHOWS:
            notes.append(f"misses the demonstration itself by {missed:.2g} of its size")
        return best, tuple(notes)

    def _line(self) -> Tensor:
        """Latent points from the encoded start to x*, one for each of the path, (N_POINTS, n)."""
        share = torch.linspace(1, 0, N_POINTS, dtype=self.attractor.dtype, device=self.attractor.device)
        frame = self.frame()
        return frame.attractor + share.unsqueeze(-1) * frame.length * frame.axis

    @torch.no_grad()
    def _conditioning(self, path: Array, shown: Demonstration) -> dict[str, float]:
        """What the report tells of rollout error, conditioning, velocities and gradients: see :class:`TubeReport`."""
        line, frame = self._line(), self.frame()
        across = torch.linalg.svd(frame.axis.unsqueeze(-1))[0][:, 1:].T * TUBE * frame.length
        some = line[:: max(4, self.dim**2 // 16)]
        tube = torch.cat([line, *(some + side * offset for offset in across for side in (1, -1))])
        missed = torch.linalg.vector_norm(self.diffeomorphism(line).cpu() - torch.from_numpy(path), dim=-1).mean()
        y = self.diffeomorphism(tube)
        step = 1e-6 * shown.size
        nudges = step * torch.eye(self.dim, dtype=y.dtype, device=y.device)
        slopes = (self(y.unsqueeze(-2) + nudges) - self(y.unsqueeze(-2) - nudges)) / (2 * step)
        length = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
        return {
            "rollout_error": float(missed) / shown.size,
            "condition_path": float(self.condition_number(line).max()),
            "condition_tube": float(self.condition_number(tube).max()),
            "largest_velocity": float(torch.linalg.vector_norm(self(y), dim=-1).max()) * shown.duration / length,
            "largest_gradient": float(torch.linalg.matrix_norm(slopes, 2).max()) * shown.duration,
        }


class Several(NamedTuple):
    """Several demonstrations, moved onto their common goal."""

    strands: Array
    """(K, N, n) each at even progress"""
    arrivals: Array
    """(K, N) when it is there, in seconds"""

    def missed(self, ds: TubeDS) -> float:
        """Mean distance of the motions from their starts to them, in units of the strands."""
        misses = []
        for strand, arrival in zip(self.strands, self.arrivals, strict=True):
            times = np.linspace(0, arrival[-1], ROWS)
            motion = np.stack([np.interp(times, arrival, column) for column in strand.T], axis=1)
            path = ds.rollout(torch.from_numpy(strand[0]).to(ds.attractor), torch.from_numpy(times)).cpu().numpy()
            misses.append(dtw(path, motion) / ROWS)
        return float(np.mean(misses))


class Candidate(NamedTuple):
    """A match, and how it came about."""

    isotopy: str
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

    def beside(self, path: Array) -> float:
        """How far, root mean square, what lies beside the line is carried from where it belongs beside the path."""
        pairs = bundle(self.line, path, self._across(path))
        squares = np.square(apply_layers(self.layers, pairs.x) - pairs.y).sum(1)
        return float(np.sqrt((pairs.weights * squares).sum() / pairs.weights.sum()))

    def _across(self, path: Array) -> Array:
        """The directions beside the line, (n, n-1), that this match carries nearest to the path's :func:`frames`."""
        axis = self.line[-1] - self.line[0]
        length = float(np.linalg.norm(axis))
        basis = across_of(axis / length)
        if basis.shape[1] < 2:
            return basis
        some = slice(None, None, max(1, len(path) // 60))
        sides = frames(smoothed(path))[some]
        turned = np.zeros((basis.shape[1], basis.shape[1]))
        for index, side in enumerate(basis.T):
            step = 0.01 * length * side
            moved = apply_layers(self.layers, np.concatenate([self.line[some] + step, self.line[some] - step]))
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


def _candidates(path: Array, n_layers: int, homotopy: str) -> Iterator[Candidate]:
    """Matches of a line to the path (N, n), along either homotopy or the one that is asked for."""
    apart = float(np.linalg.norm(np.diff(path, axis=0), axis=1).max())  # less where a corner is cut
    chord = map_to_endpoints(straight_column(len(path)), path[0], path[-1])
    middle = chord.mean(0)

    def matched(isotopy: str, curves: Array, width: float) -> Candidate:
        return Candidate(isotopy, match_along(curves, n_layers, 0.9, 0.9, width * apart), curves[0])

    most = max(1, n_layers // 10)
    for steps, stretch in LINEAR if homotopy != "curvature" else ():
        line = middle + stretch * (chord - middle)
        yield matched("straight", linear_homotopy(line, path, min(steps, most)), WIDTH)
    if path.shape[1] > 1 and homotopy != "linear":
        for steps, widths in CURVATURE:
            curves = curvature_homotopy(path, min(steps, most))
            for width in widths:
                yield matched("unbending", curves, width)


def _deeper(path: Array, dense: Array, homotopy: str) -> Iterator[Candidate]:
    """Matches for a path that those of ``DEPTHS[0]`` layers do not follow, the quickest first.

    More layers; then homotopies tracked as closely as strands need, on points that are denser where they are close.
    """
    yield from _candidates(path, DEPTHS[1], homotopy)
    steps = np.linalg.norm(np.diff(dense, axis=0), axis=1)
    length, apart = float(steps.sum()), float(np.median(steps))

    def tracked(isotopy: str, curves: Array) -> Iterator[Candidate]:
        for width in TRACKED:
            layers = track(curves, DEPTHS[2], width * apart)
            if layers is not None:
                yield Candidate(isotopy, pin_ends(layers, curves[0], dense, 0.9), curves[0])
                return

    if homotopy != "curvature":
        direction, clear = clear_direction(path)
        for share in (1.0, 0.25) if clear > CLEAR else ():
            yield from tracked("straight", drawn_homotopy(dense, direction, share * length, FINE))
    if path.shape[1] > 1 and homotopy != "linear":
        yield from tracked("unbending", curvature_homotopy(dense, FINE))
        for pivot in (0.5, 0.0, 1.0):
            yield from tracked("unbending", zoom_homotopy(dense, FINE, pivot))


def _blur(shown: Demonstration) -> str:
    """What hides the motion in a recording: noise, read off its fourth differences, or steps; "" if little does."""
    positions = shown.positions.numpy()
    if len(positions) < 10:
        return ""
    noise = jitter(positions, 4) / shown.size
    if noise > BLURRED:
        return f"noise of {noise:.2g} of its size hides the motion"
    moves = np.abs(np.diff(positions, axis=0))
    steps = [float(np.median(one[one > 0])) for one in moves.T if 0 < np.count_nonzero(one) < len(one) / 2]
    if steps and max(steps) > BLURRED * shown.size:
        return f"recorded in steps of {max(steps) / shown.size:.2g} of its size, which hide the motion between them"
    return ""


def mean_motion(shown: Sequence[Demonstration]) -> tuple[Demonstration, Array, Array]:
    """The mean of several demonstrations at equal progress, with the mean goal; each at even progress; and when.

    Each, (K, N, n), is moved onto the common goal, the more the farther along it is; its times are (K, N), in seconds.
    """
    goal = np.mean([one.goal.numpy() for one in shown], axis=0)
    paths, arrivals, even = [], [], np.linspace(0, 1, N_POINTS)
    for one in shown:
        path, way, times = arc_length_path(one.positions.numpy(), one.times.numpy(), N_POINTS)
        paths.append(path + even[:, None] * (goal - path[-1]))
        arrivals.append(np.interp(even, 1 - way, times))
    strands = np.stack(paths)
    if len(shown) == 1:
        return shown[0], strands, np.stack(arrivals)
    count, arrival = max(len(one) for one in shown), np.mean(arrivals, axis=0)
    at = np.interp(np.linspace(0, arrival[-1], count), arrival, even)
    mean = np.stack([np.interp(at, even, column) for column in strands.mean(0).T], axis=1)
    return (
        Demonstration(torch.from_numpy(mean), arrival[-1] / (count - 1), f"mean of {len(shown)}"),
        strands,
        np.stack(arrivals),
    )


def _refuse_crossings(path: Array, origin: Array, unit: float) -> None:
    """Refuse a path that meets itself: an autonomous system has one velocity per point.

    The path is told in the demonstration's units, ``origin`` + ``unit`` times it.

    Stretches closer along the path than 2 % of it may touch: that is noise, not a crossing.
    """
    start, step = path[:-1], np.diff(path, axis=0)
    count = len(step)
    first, second = np.triu_indices(count, max(2, count // 50))
    gap = start[first] - start[second]
    near = segment_distances(gap, step[first], step[second])
    worst = int(np.argmin(near))
    if near[worst] < 1e-7 * np.ptp(path, axis=0).max():
        where = f"[{', '.join(f'{value:.4g}' for value in origin + unit * start[first[worst]])}]"
        raise ValueError(
            f"demonstration: expected a path that does not meet itself, got one that comes back to {where} "
            f"({first[worst] / count:.0%} and {(second[worst] + 1) / count:.0%} of the way); "
            "an autonomous system has one velocity at each point"
        )
