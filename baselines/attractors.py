"""Several attractors in one field: found among unlabelled samples, learned one by one (Fichera and Billard 2022)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, cast

import numpy as np
import scipy.sparse as sparse
import scipy.spatial
import torch
from scipy.sparse import csgraph
from scipy.sparse import linalg as sparse_linalg
from torch import Tensor, nn

from latentds import Demonstration, StableDS, TubeDS
from latentds.arguments import Array, number_in, point_array, real_array, whole_number
from latentds.curves import extent
from latentds.demonstration import demonstrations_of
from latentds.integrate import integrate

REST_SPEED = 0.1
"""Share of the mean speed below which a velocity tells less and less of where to go: the step ahead shrinks with it."""
SPACING = 2.0
"""Median distances to the last neighbour that the step ahead spans at least, where samples are sparse."""
REACH = 3.0
"""Steps from where a sample leads up to which another is its neighbour: a gap that is wider reads as an end."""
LEAST_SHARE = 0.02
"""Share of all samples that lead to an attractor, at least; fewer are noise."""
KEPT_SAMPLES = 200
"""Samples of each system that its region lies around."""
SHARED = 0.5
"""Distance to the nearest system's samples, as a share of that to another's, up to which the other has no say."""


class Separated(NamedTuple):
    """K attractors (K, n) in the units of the positions, those of most samples first, and of each sample, (N, K), the
    chances of ending at them, which are vectors of the Laplacian's zero eigenvalues, and the label (N,) int64 of the
    likeliest, 0 to K - 1; -1 where it is likelier to end in noise."""

    labels: np.ndarray
    attractors: Array
    embedding: Array


def separate(positions: Any, velocities: Any, *, n_neighbours: int = 10, resolution: float = 0.03) -> Separated:
    """Which attractor each sample of a velocity field leads to, how many there are, and where.

    As in the paper, samples are nodes of a graph whose kernel is augmented by velocity: an edge is the heavier, the
    nearer x_j is to x_i and the smaller the angle θ between ẋ_i and x_j - x_i; the zero eigenvalues of its Laplacian
    count the sub-dynamics, and their vectors separate them. The rest is our own. The kernel, exp((d/h) cos θ - d²/2h²),
    is a Gaussian around where x_i leads, a step h ahead. The paper's graph is symmetric, and one edge across a border
    of basins joins them. Ours stays directed, with the Laplacian I - P of the random walk: its zero eigenvalues
    are the sets that the walk cannot leave, counted exactly as strongly connected components without a way out; the
    right vectors are the chances of ending in each, the left ones where the walk then stays, the mean of which is the
    attractor. A saddle, though slow, has a way out. The paper's further eigenvectors, in which each sub-dynamics is
    linear, are not computed. Deterministic; the same in any units of length and time; a ValueError names the argument.

    Args:
        positions: (N, n), N > ``n_neighbours``.
        velocities: (N, n). Where samples end at speed, as a recording that was cut does, is an attractor, too.
        n_neighbours: edges from each sample at most, >= 2.
        resolution: in (0, 1), in sizes of the whole, its largest extent along an axis: attractors that are nearer to
            each other are one, and the step ahead is as long at least. Noise of the positions must stay well below.
    """
    count = whole_number(n_neighbours, "n_neighbours", at_least=2)
    resolution = number_in(resolution, "resolution", 0, 1)
    points, moves = point_array(positions, "positions"), real_array(velocities, "velocities")
    if len(points) <= count:
        raise ValueError(f"positions: expected more than n_neighbours = {count} samples, got {len(points)}")
    if moves.shape != points.shape or not np.isfinite(moves).all() or not moves.any():
        got = f"shape {moves.shape}" if moves.shape != points.shape else f"{moves.min()} to {moves.max()}"
        raise ValueError(f"velocities: expected {points.shape} finite numbers, not all 0, got {got}")
    middle, size = points.mean(axis=0), extent(points)
    places = (points - middle) / size
    chances = _walk(places, moves / np.abs(moves).max(), count, resolution)
    _, component = csgraph.connected_components(chances, connection="strong")
    here, there = component[np.array(chances.nonzero())]
    closed = np.setdiff1d(component, here[here != there])
    ends = np.stack([_staying(chances, component == one) for one in closed], axis=1)
    near = scipy.spatial.distance.cdist(ends.T @ places, ends.T @ places) < resolution
    together = np.eye(len(closed))[csgraph.connected_components(near)[1]]
    shares = _absorbed(chances, (component[:, None] == closed).astype(float)) @ together
    centers, weight = (ends @ (together / together.sum(axis=0).clip(min=1))).T @ places, shares.mean(axis=0)
    kept = [one for one in np.argsort(-weight, kind="stable") if weight[one] >= min(LEAST_SHARE, weight.max())]
    shares, noise = shares[:, kept], 1 - shares[:, kept].sum(axis=1)
    labels = np.where(shares.max(axis=1) > noise, shares.argmax(axis=1), -1)
    return Separated(labels.astype(np.int64), middle + size * centers[kept], shares)


def _walk(places: Array, moves: Array, count: int, resolution: float) -> sparse.csr_matrix:
    """P, (N, N): the chances of going from each sample to those around where it leads."""
    tree = scipy.spatial.cKDTree(places)
    gaps, around = tree.query(places, count + 1)
    moves = moves[around].mean(axis=1)  # a sample that noise carried across a border goes with those there
    speeds = np.linalg.norm(moves, axis=1, keepdims=True)
    step, rest = max(resolution, SPACING * np.median(gaps[:, -1])), REST_SPEED * speeds.mean()
    ahead = places + step * moves / np.maximum(speeds, rest)
    gaps, found = tree.query(ahead, min(4 * count, len(places)), distance_upper_bound=REACH * step)
    used, found = np.isfinite(gaps), found % len(places)  # what is too far has the number N
    # Of samples that move, only edges forward; where they hardly do, a direction is mostly noise.
    used &= (((places[found] - places[:, None]) * moves[:, None]).sum(axis=-1) > 0) | (speeds < rest)
    used &= used.cumsum(axis=1) <= count
    # A sample that has none ahead goes to those around it, and so belongs to what has arrived there.
    lost = ~used.any(axis=1)
    row = np.append(used.nonzero()[0], lost.nonzero()[0].repeat(count + 1))
    column = np.append(found[used], around[lost])
    weights = np.append(np.exp(-np.square(gaps[used] / step) / 2), np.ones(around[lost].size))
    graph = sparse.csr_matrix((weights, (row, column)), shape=(len(places),) * 2)
    return sparse.csr_matrix(sparse.diags(1 / np.asarray(graph.sum(axis=1))[:, 0]) @ graph)


def _staying(chances: sparse.csr_matrix, members: np.ndarray) -> Array:
    """(N,), where the walk is found in a set that it cannot leave: πP = π, and Σπ = 1 for one of these equations."""
    stays, count = np.zeros(len(members)), int(members.sum())
    balance = (chances[members][:, members].T - sparse.identity(count)).tocsr()
    balance = sparse.vstack([balance[:-1], np.ones((1, count))], format="csc")
    stays[members] = sparse_linalg.splu(balance).solve(np.eye(1, count, count - 1)[0])
    return stays


def _absorbed(chances: sparse.csr_matrix, inside: Array) -> Array:
    """(N, m), the chances of ending in each closed set, of which ``inside`` tells the members: (I - P) S = 0."""
    arrived = inside.any(axis=1)
    if not arrived.all():
        remaining = sparse.identity(int((~arrived).sum())) - chances[~arrived][:, ~arrived]
        inside[~arrived] = sparse_linalg.splu(remaining.tocsc()).solve(chances[~arrived][:, arrived] @ inside[arrived])
    return inside


class MultipleAttractors(nn.Module):
    """ẏ = Σ_k w_k(y) f_k(y): stable systems f_k, glued by a membership w_k >= 0 of sum 1. Our own, not the paper's.

    With r_k the distance of y to the nearest kept sample of system k, its attractor among them, w_k is 1 where r_k is
    at most ``SHARED`` of every other r_j, 0 where some r_j is at most that of r_k, and continuous, with kinks, between.

    Proven, of f_k that are globally asymptotically stable: in the ball of ``radii[k]`` > 0 around attractor k the field
    is f_k, so that the attractor is asymptotically stable, and no motion leaves a sublevel set of V_k within the ball,
    all of which is basin. There is such a set, as V_k is continuous and 0 at the attractor alone; its level is not
    computed, so how large the basin is is not proven. Between the regions nothing is: weighted velocities may cancel,
    and a motion may be held by other equilibria or orbits, as the borders of basins must have, or change regions.

    Args:
        systems: K >= 1 of one dimension n; kept, not copied.
        samples: K arrays (m_k, n) of what each was shown, m_k >= 3; ``KEPT_SAMPLES`` of each become a buffer.
        notes: what the user should know of how they were learned.
    """

    def __init__(self, systems: Sequence[StableDS], samples: Sequence[Any], notes: Sequence[str] = ()) -> None:
        super().__init__()
        if not systems or not all(isinstance(one, StableDS) and one.dim == systems[0].dim for one in systems):
            raise ValueError(f"systems: expected one StableDS or more, all of one dimension, got {systems!r:.80}")
        self.dim, pieces = systems[0].dim, [point_array(piece, "samples") for piece in samples]
        if (got := [piece.shape[1] for piece in pieces]) != (wanted := [self.dim] * len(systems)):
            raise ValueError(f"samples: expected arrays of points of dimensions {wanted}, got {got}")
        kept = [piece[np.linspace(0, len(piece) - 1, KEPT_SAMPLES).round().astype(int)] for piece in pieces]
        self.systems, self.notes = nn.ModuleList(systems), tuple(notes)
        self.register_buffer("samples", torch.from_numpy(np.stack(kept)).to(systems[0].attractor))

    @classmethod
    def fit(
        cls,
        demonstrations: Sequence[Demonstration],
        *,
        labels: Sequence[int] | None = None,
        method: Callable[[int], StableDS] = TubeDS,
        n_neighbours: int = 10,
        resolution: float = 0.03,
    ) -> MultipleAttractors:
        """Group demonstrations by the attractor that they lead to, and fit a system to each group.

        Args:
            demonstrations: one or more, of one dimension and one unit of time.
            labels: of each, a whole number >= 0, or -1 to leave it out; None to :func:`separate` their samples.
            method: makes a system, given its dimension. TubeDS takes a group for tries at one motion, CLFDM does not.
            n_neighbours, resolution: see :func:`separate`, whose errors are this one's, too.
        """
        given = demonstrations if isinstance(demonstrations, Sequence) else [demonstrations]
        shown = demonstrations_of(demonstrations, getattr(next(iter(given), None), "dim", 1))
        if labels is None:
            owners, notes = _grouped(shown, n_neighbours, resolution)
        else:
            owners, notes = [whole_number(label, "labels", at_least=-1) for label in labels], []
        if len(owners) != len(shown) or max(owners) < 0:
            raise ValueError(f"labels: expected {len(shown)}, one per demonstration and not all -1, got {owners}")
        if out := [one.name or f"number {at}" for at, one in enumerate(shown) if owners[at] < 0]:
            notes.append(f"left out: {', '.join(out)}")
        groups = [[one for one, o in zip(shown, owners, strict=True) if o == k] for k in sorted({*owners} - {-1})]
        systems = [method(shown[0].dim).fit(group) for group in groups]
        for k, (group, ds) in enumerate(zip(groups, systems, strict=True)):
            told = ds.fit_report.notes if ds.fit_report else ()
            notes += [f"attractor {k}: from {len(group)} of {len(shown)} demonstrations", *told]
        return cls(systems, [torch.cat([one.positions for one in group]) for group in groups], notes)

    @property
    def attractors(self) -> Tensor:
        """(K, n), those of the systems as they are now."""
        return torch.stack([ds.get_buffer("attractor") for ds in self.systems])

    @property
    def radii(self) -> Tensor:
        """(K,), of the balls around the attractors in which, by the triangle inequality, one system alone has a say."""
        gaps = self._squared_distances(self.attractors).sqrt()
        return gaps.masked_fill(torch.eye(len(gaps)).to(gaps) > 0, torch.inf).amin(-1) * SHARED / (1 + SHARED)

    def membership(self, y: Tensor) -> Tensor:
        """w(y), what each system counts: (..., n) -> (..., K)."""
        points, wanted = cast(StableDS, self.systems[0])._points(y)
        squares = self._squared_distances(points) + torch.finfo(points.dtype).tiny  # no 0/0 where two share a sample
        ratios = squares.amin(-1, keepdim=True) / squares
        risen = ((ratios - SHARED**2) / (1 - SHARED**2)).clamp(min=0)
        return nn.functional.normalize(risen.square() * (3 - 2 * risen), p=1, dim=-1).to(wanted)

    def forward(self, y: Tensor) -> Tensor:
        """Velocity at ``y``: (..., n) -> (..., n), units per second."""
        points, wanted = cast(StableDS, self.systems[0])._points(y)
        weights = self.membership(points).unsqueeze(-1)
        velocities = torch.stack([ds(points) for ds in self.systems], dim=-2)
        return torch.where(weights == 0, 0.0, weights * velocities).sum(-2).to(wanted)  # not 0 times infinity

    def rollout(self, y0: Tensor, t: Tensor) -> Tensor:
        """The motion from ``y0``, as :meth:`latentds.StableDS.rollout` integrates it; at an attractor it rests."""
        first = cast(StableDS, self.systems[0])
        points, wanted = first._points(y0, "y0")
        near = torch.finfo(points.dtype).eps ** 0.5 * torch.std(self.get_buffer("samples"), dim=(0, 1)).amax()

        def velocity(y: Tensor) -> Tensor:
            gaps = torch.linalg.vector_norm(y.unsqueeze(-2) - self.attractors, dim=-1)
            return torch.where(gaps.amin(-1, keepdim=True) < near, 0.0, self(y))

        return integrate(velocity, points, first._times(t), self.attractors[0]).to(wanted)

    def _squared_distances(self, y: Tensor) -> Tensor:
        """(..., n) -> (..., K), to the nearest sample of each system, its attractor among them."""
        kept = torch.cat([self.get_buffer("samples"), self.attractors.unsqueeze(1)], dim=1)
        return (y[..., None, None, :] - kept).square().sum(-1).amin(-1)


def _grouped(shown: Sequence[Demonstration], n_neighbours: int, resolution: float) -> tuple[list[int], list[str]]:
    """The label of the end of each demonstration, and what there is to tell."""
    positions, velocities = torch.cat([one.positions for one in shown]), torch.cat([one.velocities for one in shown])
    found = separate(positions, velocities, n_neighbours=n_neighbours, resolution=resolution)
    noise, *leading = np.bincount(found.labels + 1, minlength=len(found.attractors) + 1).tolist()
    notes = [f"attractors: {len(leading)}, to which {leading} samples lead; {noise} lead to none and are noise"]
    owners = []
    for one, labels in zip(shown, np.split(found.labels, np.cumsum([len(one) for one in shown])[:-1]), strict=True):
        owners.append(int(labels[-1]))
        if (others := int((labels != owners[-1]).sum())) > 0:
            notes.append(f"{one.name or repr(one)}: {others} of {len(one)} samples do not lead to where it ends")
    return owners, notes
