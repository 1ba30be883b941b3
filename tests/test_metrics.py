"""Metrics against plain-Python definitions, and the properties that hold for every pair of paths."""

import itertools
import math
import time

import numpy as np
import pytest
import torch
from scipy.spatial.distance import directed_hausdorff

from latentds import metrics
from latentds.datasets import stable_spiral


def alignments(n, m):
    """Every monotone alignment of n points with m points, as lists of index pairs."""
    if n == 1:
        return [[(0, j) for j in range(m)]]
    if m == 1:
        return [[(i, 0) for i in range(n)]]
    shorter = itertools.chain(alignments(n - 1, m), alignments(n, m - 1), alignments(n - 1, m - 1))
    return [[*way, (n - 1, m - 1)] for way in shorter]


def cost(way, a, b):
    return [math.dist(a[i], b[j]) for i, j in way]


def walk(rng, n, dim):
    return rng.standard_normal((n, dim)).cumsum(axis=0)


@pytest.mark.parametrize(("n", "m", "dim"), [(1, 1, 1), (1, 4, 2), (5, 1, 3), (4, 5, 2), (6, 6, 3), (5, 4, 7)])
def test_exact_scores_are_the_least_over_every_alignment(n, m, dim):
    rng = np.random.default_rng(n * 100 + m)
    a, b = walk(rng, n, dim), walk(rng, m, dim)
    ways = alignments(n, m)
    assert metrics.dtw(a, b) == pytest.approx(min(sum(cost(way, a, b)) for way in ways), rel=1e-12)
    assert metrics.frechet(a, b) == pytest.approx(min(max(cost(way, a, b)) for way in ways), rel=1e-12)


@pytest.mark.parametrize("seed", range(10))
def test_properties(seed):
    rng = np.random.default_rng(seed)
    n, m, dim = rng.integers(2, 80, size=3)
    a, b, c = walk(rng, n, dim), walk(rng, m, dim), walk(rng, n, dim)
    assert metrics.dtw(a, a) == metrics.frechet(a, a) == metrics.endpoint_error(a, a) == 0
    assert metrics.dtw(a, b) == pytest.approx(metrics.dtw(b, a), rel=1e-12)
    assert metrics.frechet(a, b) == pytest.approx(metrics.frechet(b, a), rel=1e-12)
    pointwise = np.linalg.norm(a - c, axis=1)
    assert metrics.dtw(a, c) <= pointwise.sum() * (1 + 1e-12)
    assert metrics.frechet(a, c) <= pointwise.max() * (1 + 1e-12)
    assert metrics.fast_dtw(a, b) >= metrics.dtw(a, b) * (1 - 1e-12)
    assert metrics.fast_dtw(a, b, radius=100) == pytest.approx(metrics.dtw(a, b), rel=1e-12)
    hausdorff = max(directed_hausdorff(a, b)[0], directed_hausdorff(b, a)[0])
    assert metrics.frechet(a, b) >= hausdorff * (1 - 1e-12)
    assert metrics.frechet(a, b) >= metrics.endpoint_error(a, b) * (1 - 1e-12)
    assert metrics.dtw(a, b) <= metrics.frechet(a, b) * (n + m)
    # every score is a length, so it does not see where the paths lie, and grows with their scale
    for score in (metrics.dtw, metrics.fast_dtw, metrics.frechet, metrics.endpoint_error):
        assert score(3 * a + 5, 3 * b + 5) == pytest.approx(3 * score(a, b), rel=1e-9)


def test_warping_ignores_timing_and_repeats():
    path = stable_spiral(3, n_points=200).positions.numpy()
    slow = np.repeat(path, 3, axis=0)
    assert metrics.dtw(slow, path) == metrics.frechet(slow, path) == 0
    assert metrics.path_length_ratio(slow, path) == pytest.approx(1, rel=1e-12)


def test_path_length_ratio_gives_a_shortcut_away():
    angle = np.linspace(0, np.pi, 400)
    half_circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    assert metrics.path_length_ratio(half_circle[[0, -1]], half_circle) == pytest.approx(2 / np.pi, rel=1e-4)
    assert math.isnan(metrics.path_length_ratio(half_circle, half_circle[:1]))


def test_velocity_scores():
    rng = np.random.default_rng(0)
    v, gust = rng.standard_normal((50, 3)), np.array([3, 0, 4])
    assert metrics.velocity_cosine(4 * v, v) == pytest.approx(1)
    assert metrics.velocity_cosine(-v, v) == pytest.approx(-1)
    assert metrics.velocity_rmse(v, v) == 0
    assert metrics.velocity_rmse(v + gust, v) == pytest.approx(5)
    assert metrics.mse(v + gust, v) == pytest.approx(25 / 3)
    # at rest in half of the points: those count 0 if the reference moves there, nothing if it rests there too
    resting = np.where(np.arange(50)[:, None] < 25, v, 0)
    assert metrics.velocity_cosine(resting, v) == pytest.approx(0.5)
    assert metrics.velocity_cosine(resting, resting) == pytest.approx(1)
    assert math.isnan(metrics.velocity_cosine(v, np.zeros_like(v)))


SCORES = [
    metrics.dtw, metrics.fast_dtw, metrics.frechet, metrics.endpoint_error, metrics.path_length_ratio,
    metrics.mse, metrics.velocity_rmse, metrics.velocity_cosine,
]  # fmt: skip


@pytest.mark.parametrize("score", SCORES)
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e200])
@pytest.mark.parametrize("row", [0, 7, -1])
def test_a_path_that_ran_away_scores_nan(score, bad, row):
    path = walk(np.random.default_rng(0), 20, 3)
    gone = path.copy()
    gone[row, 1] = bad
    assert math.isnan(score(gone, path))


@pytest.mark.parametrize("score", SCORES)
def test_tensors_arrays_and_lists_are_alike(score):
    rng = np.random.default_rng(0)
    a, b = walk(rng, 12, 2), walk(rng, 12, 2)
    tensor = torch.tensor(a, requires_grad=True)
    assert score(tensor, b.tolist()) == score(a, np.asfortranarray(b))
    assert isinstance(score(a.astype(np.float32), torch.from_numpy(b).float()), float)


@pytest.mark.parametrize("score", SCORES)
@pytest.mark.parametrize(
    ("path", "named"),
    [
        (np.zeros(5), "path"),
        (np.zeros((5, 2)), "path"),
        (np.zeros((0, 3)), "path"),
        (np.zeros((2, 5, 3)), "path"),
        ("path", "path"),
        (np.zeros((5, 3), complex), "path"),
    ],
)
def test_bad_input_is_named(score, path, named):
    with pytest.raises(ValueError, match=f"^{named}: expected"):
        score(path, np.zeros((5, 3)))
    with pytest.raises(ValueError, match="expected"):
        score(np.zeros((5, 3)), path)


@pytest.mark.parametrize("radius", [0, -1, 1.5, "1"])
def test_bad_radius_is_named(radius):
    with pytest.raises(ValueError, match=r"^radius: expected"):
        metrics.fast_dtw(np.zeros((5, 3)), np.zeros((5, 3)), radius=radius)


def test_exact_dtw_is_faster_than_the_approximation():
    path = stable_spiral(5, n_points=500).positions.numpy()
    other = path + 0.01

    def best(score):
        times = []
        for _ in range(5):
            began = time.perf_counter()
            score(path, other)
            times.append(time.perf_counter() - began)
        return min(times)

    metrics.dtw(path, other)
    assert best(metrics.dtw) < best(metrics.fast_dtw)
