"""Where the latent points lie: the Laplacian eigenmap of the demonstration graph, or an evenly spaced line."""

from __future__ import annotations

import math

import numpy as np
import scipy
import scipy.sparse
import scipy.sparse.linalg
import scipy.spatial

from ..arguments import Array, whole_number
from ..curves import evenly_resampled, extent, jitter, progress_along


def chebyshev_eigenvalues(n_points: int, dim: int) -> Array:
    """The smallest eigenvalue of each block H_j, j = 1 … n, of the graph Laplacian with K = n+1 copies: (n,).

    The graph is K copies of a path of N nodes whose last nodes form a K-cycle (paper, Sec. IV). Its Laplacian splits
    into K tridiagonal blocks (paper, Prop. 2): diagonal 1, 2, …, 2, 3 - 2cos(2πj/K), off-diagonal -1. With
    λ = 2 - 2cos θ the last row asks cos((N+½)θ) = (2cos(2πj/K) - 1) cos((N-½)θ); its smallest root lies in
    (0, π/(2N-1)).

    λN² → π²/4. Blocks j and K-j agree; for odd n the block j = K/2 stands alone, so "n repeating eigenvalues" (paper,
    Sec. IV-B) holds for even n only.

    Args:
        n_points: N >= 3.
        dim: n >= 1.
    """
    return 2 - 2 * np.cos(_angles(n_points, dim))


def chebyshev_columns(n_points: int, dim: int) -> Array:
    """The eigenvectors' first N entries, u_i = cos((i+½)θ) / cos(θ/2), i = 0 … N-1, a column per block: (N, n).

    The paper's Prop. 3 prints i = 1 … N, off by one: it gives u_1 = 1 - λ where the recursion starts at 1.
    """
    theta = _angles(n_points, dim)
    index = np.arange(n_points)[:, None]
    return np.cos((index + 0.5) * theta) / np.cos(theta / 2)


def neighbour_columns(positions: Array, n_neighbours: int = 10) -> Array:
    """As :func:`chebyshev_columns`, of a graph that knows where points lie: (N, n), (N, n) from start to goal.

    Each copy of the path gives way to Belkin and Niyogi's graph (2003): edges between points of which one is among the
    ``n_neighbours`` nearest of the other, or that follow each other, so that it is one graph; weights by the heat
    kernel, as wide as the mean square of those distances; L u = λ D u. The copies are joined at the start, by edges of
    weight 1, as the paper joins its paths.

    Args:
        positions: (N, n), N >= 3.
        n_neighbours: at least 1, at most N - 1.

    Source: Belkin and Niyogi, "Laplacian eigenmaps for dimensionality reduction and data representation", Neural
    Computation 15 (2003), Sec. 2.
    """
    count, dim = positions.shape
    nearest = scipy.spatial.KDTree(positions).query(positions, min(n_neighbours, count - 1) + 1)[1][:, 1:]
    ends = np.stack([np.repeat(np.arange(count), nearest.shape[1]), nearest.ravel()])
    ends = np.concatenate([ends, [np.arange(count - 1), np.arange(1, count)]], axis=1)
    first, second = np.unique(np.sort(ends, axis=0), axis=1)
    gaps = ((positions[first] - positions[second]) ** 2).sum(1)
    upper = scipy.sparse.coo_array((np.exp(-gaps / gaps.mean()), (first, second)), shape=(count, count))
    weights = (upper + upper.T).tocsc()
    degrees = weights.sum(0)
    degrees[0] += 2
    laplacian = scipy.sparse.diags_array(degrees) - weights
    columns = np.empty((count, dim))
    for j in range(dim):
        joined = laplacian.copy()
        joined[0, 0] -= 2 * math.cos(2 * math.pi * (j + 1) / (dim + 1))
        column = scipy.sparse.linalg.eigsh(
            joined.tocsc(), 1, scipy.sparse.diags_array(degrees).tocsc(), sigma=0, v0=np.ones(count)
        )[1][:, 0]
        columns[:, j] = column / column[-1]
    return columns


def straight_column(n_points: int) -> Array:
    """Evenly spaced, from 0 at the start to 1 at the goal: (N, 1). FDM's latent line, uniform in time."""
    return np.linspace(0, 1, n_points)[:, None]


def map_to_endpoints(columns: Array, start: Array, goal: Array) -> Array:
    """Map each column affinely so that the rows run from ``start`` to ``goal``, both (n,): (N, n) or (N, 1) -> (N, n).

    A coordinate in which start and goal coincide collapses to it.
    """
    progress = (columns - columns[0]) / (columns[-1] - columns[0])
    placed: Array = start + progress * (goal - start)
    placed[-1] = goal
    return placed


def _angles(n_points: int, dim: int) -> Array:
    n = whole_number(n_points, "n_points", at_least=3)
    copies = whole_number(dim, "dim", at_least=1) + 1
    edge = math.pi / (2 * n - 1)

    def last_row(theta: float, j: int) -> float:
        return math.cos((n + 0.5) * theta) - (2 * math.cos(2 * math.pi * j / copies) - 1) * math.cos((n - 0.5) * theta)

    return np.array(
        [scipy.optimize.brentq(last_row, 0, edge, args=(j,), xtol=1e-18, rtol=1e-15) for j in range(1, copies)]
    )


def arc_length_path(positions: Array, times: Array, n_points: int) -> tuple[Array, Array, Array]:
    """The path evenly spaced in arc length, and when the motion was where along it.

    Points nearer to the last kept one than the recording's noise (read off its second differences, between 0.05 % and
    1 % of the motion's size) are dropped: at rest, jitter would pile up as path. A rest at the goal is cut off; other
    rests stay as time spent between two points.

    Args:
        positions: (N, n), the last point the goal.
        times: (N,) seconds, increasing from 0.
        n_points: points of the path, >= 2.

    Returns:
        path (n_points, n) from start to goal; progress (m,), strictly decreasing from 1 to 0; its times (m,), strictly
        increasing from 0.
    """
    size = extent(positions)
    apart = float(np.clip(4 * jitter(positions), 5e-4 * size, 1e-2 * size))
    away = np.linalg.norm(positions - positions[-1], axis=1) > apart
    last = min(int(np.flatnonzero(away)[-1]) + 1, len(positions) - 1) if away.any() else len(positions) - 1
    kept = [0]
    for i in range(1, last):
        if np.linalg.norm(positions[i] - positions[kept[-1]]) > apart:
            kept.append(i)
    if len(kept) > 1 and np.linalg.norm(positions[-1] - positions[kept[-1]]) < apart / 2:
        kept.pop()
    points = np.concatenate([positions[kept], positions[-1:]])
    return evenly_resampled(points, n_points), 1 - progress_along(points), times[[*kept, last]] - times[0]
