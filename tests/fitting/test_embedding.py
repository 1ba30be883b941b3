"""The Chebyshev embedding against the explicit Laplacian of the demonstration graph."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from numpy.polynomial import Chebyshev
from scipy.linalg import eigh

from latentds.fitting.embedding import (
    arc_length_path,
    chebyshev_columns,
    chebyshev_eigenvalues,
    map_to_endpoints,
    neighbour_columns,
    straight_column,
)
from tests.motions import pause, rest_at_both_ends


def laplacian(n_points, copies):
    """K paths of N nodes; their last nodes form a cycle (for K = 2 the circulant counts that one edge twice)."""
    size = n_points * copies
    adjacency = np.zeros((size, size))
    for k in range(copies):
        for i in range(n_points - 1):
            a = k * n_points + i
            adjacency[a, a + 1] += 1
            adjacency[a + 1, a] += 1
        a, b = (k + 1) * n_points - 1, ((k + 1) % copies + 1) * n_points - 1
        adjacency[a, b] += 1
        adjacency[b, a] += 1
    return np.diag(adjacency.sum(1)) - adjacency


@pytest.mark.parametrize("n_points", [3, 10, 40])
@pytest.mark.parametrize("dim", [1, 2, 3, 4, 7])
def test_columns_are_eigenvectors_of_the_graph(dim, n_points):
    """Lemma 1: each copy carries the column times a power of the K-th root of unity."""
    copies = dim + 1
    graph = laplacian(n_points, copies)
    values, columns = chebyshev_eigenvalues(n_points, dim), chebyshev_columns(n_points, dim)
    for j, (value, column) in enumerate(zip(values, columns.T, strict=True), start=1):
        whole = np.outer(np.exp(2j * math.pi * j * np.arange(copies) / copies), column).ravel()
        assert np.abs(graph @ whole - value * whole).max() < 1e-12
        assert column[0] == pytest.approx(1)


@pytest.mark.parametrize("n_points", [10, 40])
@pytest.mark.parametrize("dim", [1, 2, 3, 4, 7])
def test_eigenvalues_are_the_smallest_after_zero(dim, n_points):
    found = eigh(laplacian(n_points, dim + 1), eigvals_only=True)
    assert abs(found[0]) < 1e-12
    assert np.sort(chebyshev_eigenvalues(n_points, dim)) == pytest.approx(found[1 : dim + 1], abs=1e-13)


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_columns_of_neighbours_are_eigenvectors_of_their_copied_graph(dim, draw):
    """Belkin and Niyogi's graph, written out: all copies at once, joined at their starts."""
    points = np.cumsum(np.abs(torch.randn(30, dim, generator=draw, dtype=torch.float64).numpy()) + 0.1, axis=0)
    squares = ((points[:, None] - points) ** 2).sum(-1)
    near = squares <= np.sort(squares, axis=1)[:, [4]]
    near = (near | near.T | (np.abs(np.subtract.outer(range(30), range(30))) == 1)) & ~np.eye(30, dtype=bool)
    weights = np.where(near, np.exp(-squares / squares[near].mean()), 0)
    copies = dim + 1
    whole = np.kron(np.eye(copies), weights)
    for k in range(copies):
        a, b = 30 * k, 30 * ((k + 1) % copies)
        whole[a, b] += 1
        whole[b, a] += 1
    degrees = np.diag(whole.sum(1))
    columns = neighbour_columns(points, 4)
    values = np.linalg.eigvals(np.linalg.solve(degrees, degrees - whole)).real
    for j, column in enumerate(columns.T, start=1):
        turned = np.outer(np.exp(2j * math.pi * j * np.arange(copies) / copies), column).ravel()
        value = (turned.conj() @ (degrees - whole) @ turned / (turned.conj() @ degrees @ turned)).real
        assert np.abs((degrees - whole) @ turned - value * degrees @ turned).max() < 1e-9
        assert (np.sort(values)[1 : dim + 1] == pytest.approx(value, abs=1e-9)) or dim > 1
        assert value < np.sort(values)[dim] + 1e-9  # the smallest after 0, block by block


@pytest.mark.parametrize("dim", range(1, 9))
def test_blocks_j_and_k_minus_j_agree_and_an_odd_dimension_leaves_one_alone(dim):
    """Prop. 2; so "n repeating eigenvalues" (paper, Sec. IV-B) holds for even n only."""
    values, columns = chebyshev_eigenvalues(30, dim), chebyshev_columns(30, dim)
    assert values == pytest.approx(values[::-1], rel=1e-12)
    assert np.abs(columns - columns[:, ::-1]).max() < 1e-12
    found = eigh(laplacian(30, dim + 1), eigvals_only=True)
    multiplicity = [int((np.abs(found - value) < 1e-11).sum()) for value in values]
    assert multiplicity == [1 if 2 * j == dim + 1 else 2 for j in range(1, dim + 1)]


def test_paper_formula_is_off_by_one():
    """Prop. 3 prints u_i = T_i - (λ/2) V_{i-1} for i = 1 … N; the recursion u_2 = (1-λ) u_1 needs i = 0 … N-1."""
    n_points, dim = 25, 3
    for value, column in zip(chebyshev_eigenvalues(n_points, dim), chebyshev_columns(n_points, dim).T, strict=True):
        theta = math.acos(1 - value / 2)

        def paper(i, theta=theta, value=value):
            return Chebyshev.basis(i)(math.cos(theta)) - value / 2 * math.sin(i * theta) / math.sin(theta)

        assert column == pytest.approx([paper(i) for i in range(n_points)], abs=1e-12)
        assert paper(1) == pytest.approx(1 - value)
        assert column[1] == pytest.approx((1 - value) * column[0])
        assert column[2:] == pytest.approx((2 - value) * column[1:-1] - column[:-2], abs=1e-13)


@pytest.mark.parametrize("dim", [1, 2, 3, 7])
def test_eigenvalues_fall_as_one_over_n_squared(dim):
    gaps = [np.abs(chebyshev_eigenvalues(n, dim) * n**2 - math.pi**2 / 4).max() for n in (100, 200, 400, 800)]
    assert gaps[-1] < 0.01
    assert [a / b for a, b in pairwise(gaps)] == pytest.approx([2] * 3, rel=0.05)


@pytest.mark.parametrize("n_points", [3, 4, 10, 1000])
@pytest.mark.parametrize("dim", [1, 2, 3, 7, 10])
def test_lemmas_2_and_3(dim, n_points):
    values = chebyshev_eigenvalues(n_points, dim)
    assert (values > 0).all()
    assert (values < 2 * (1 - math.cos(math.pi / n_points))).all()
    assert (np.diff(chebyshev_columns(n_points, dim), axis=0) < 0).all()


def test_proposition_5_is_one_over_n_only():
    """The paper says that two columns differ by O(1/N²); they differ by O(1/N)."""
    gaps = np.array([np.ptp(chebyshev_columns(n, 3), axis=1).max() for n in (100, 200, 400, 800)])
    assert gaps == pytest.approx([3.9e-3, 2.0e-3, 9.8e-4, 4.9e-4], rel=0.05)
    assert gaps[:-1] / gaps[1:] == pytest.approx([2] * 3, rel=0.05)


def test_place_runs_from_start_to_goal_and_collapses_where_they_agree():
    start, goal = np.array([1.0, -2.0, 0.5]), np.array([3.0, -2.0, -1.0])
    placed = map_to_endpoints(chebyshev_columns(50, 3)[::-1], start, goal)
    assert (placed[0] == start).all()
    assert (placed[-1] == goal).all()
    assert (placed[:, 1] == -2.0).all()
    assert (np.diff(placed[:, 0]) > 0).all()
    assert (np.diff(placed[:, 2]) < 0).all()
    line = map_to_endpoints(straight_column(50), start, goal)
    assert np.diff(line, axis=0) == pytest.approx(np.tile((goal - start) / 49, (49, 1)))


@pytest.mark.parametrize(("n_points", "dim", "name"), [(2, 3, "n_points"), (3.5, 3, "n_points"), (10, 0, "dim")])
def test_bad_input(n_points, dim, name):
    with pytest.raises(ValueError, match=f"{name}: expected a whole number"):
        chebyshev_eigenvalues(n_points, dim)
    with pytest.raises(ValueError, match=f"{name}: expected a whole number"):
        chebyshev_columns(n_points, dim)


def test_only_the_order_of_a_column_counts_not_its_scale():
    start, goal = np.array([1.0, -2.0]), np.array([3.0, 5.0])
    for columns in (straight_column(50), chebyshev_columns(50, 2)[::-1]):
        np.testing.assert_allclose(
            map_to_endpoints(7 - 3 * columns, start, goal), map_to_endpoints(columns, start, goal), rtol=0, atol=1e-12
        )
    assert straight_column(50)[[0, -1]].tolist() == [[0], [1]]


def test_without_noise_every_point_that_moves_counts():
    """Told exactly by a line: steps of a thousandth of its length are path, a tenth of that is not."""
    line = np.linspace(2, 3, 1001)
    path, way, times = arc_length_path(np.stack([line, 0 * line], 1), np.linspace(5, 6, 1001), 11)
    np.testing.assert_allclose(path, np.stack([np.linspace(2, 3, 11), np.zeros(11)], 1), atol=1e-12)
    np.testing.assert_allclose(way, np.linspace(1, 0, 1001), atol=1e-12)
    np.testing.assert_allclose(times, np.linspace(0, 1, 1001), atol=1e-12)
    finer = np.linspace(2, 3, 10001)
    way = arc_length_path(np.stack([finer, 0 * finer], 1), np.linspace(0, 1, 10001), 11)[1]
    assert 1000 < len(way) <= 2001
    assert np.abs(np.diff(way)[:-1]).min() > 5e-4


@pytest.mark.parametrize("noise", [5e-4, 1e-3])
def test_steps_within_the_noise_are_no_path(noise):
    """The noise is that of one coordinate; nothing but it is known to be smaller than a step."""
    line = np.linspace(0, 1, 5000)
    shown = np.stack([line, line**2], 1) + noise * np.random.default_rng(0).standard_normal((5000, 2))
    path, way, _ = arc_length_path(shown, line, 5000)
    assert np.abs(np.diff(way)[:-1]).min() * np.linalg.norm(np.diff(path, axis=0), axis=1).sum() > 2 * noise


def test_a_motion_that_dithers_before_its_goal_ends_with_a_whole_step():
    """The last but one lies a fifth of the least step from the goal, and no velocity is to be read off that."""
    line = np.array([*np.arange(10) / 10, 1 - 1e-4, 1 - 5.5e-4, 1.0])
    _, way, times = arc_length_path(line[:, None], np.arange(13.0), 5)
    np.testing.assert_allclose(way, np.linspace(1, 0, 11), atol=1e-12)
    assert times.tolist() == [*range(10), 12]


@pytest.mark.parametrize("rest", [1, 2, 7])
@pytest.mark.parametrize("moving", [10, 11])
def test_a_rest_at_the_goal_takes_no_time(rest, moving):
    line = np.concatenate([np.linspace(0, 1, moving), np.ones(rest)])
    clock = np.arange(len(line)) * 0.5
    _, way, times = arc_length_path(np.stack([line, 3 - line], 1), clock, 5)
    np.testing.assert_allclose(way, np.linspace(1, 0, moving), atol=1e-12)
    assert times.tolist() == clock[:moving].tolist()


def test_points_are_even_and_times_fit():
    t = np.linspace(0, 1, 500)
    positions = np.stack([np.cos(2 * t**3), np.sin(2 * t**3)], 1)  # uneven: almost all points lie at the start
    path, way, times = arc_length_path(positions, 3 * t, 100)
    gaps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    assert np.ptp(gaps) < 0.01 * gaps.mean()
    assert np.array_equal(path[[0, -1]], positions[[0, -1]])
    assert (np.diff(way) < 0).all()
    assert (np.diff(times) > 0).all()
    assert way[[0, -1]].tolist() == [1, 0]
    np.testing.assert_allclose(way, 1 - (times / 3) ** 3, atol=3e-3)


def test_jitter_at_rest_adds_no_path():
    way = pause(np.linspace(0, 1, 3000))
    clean = np.stack([way, way**2], 1)
    noisy = clean + 5e-4 * np.random.default_rng(0).standard_normal(clean.shape)
    raw, length = (np.linalg.norm(np.diff(p, axis=0), axis=1).sum() for p in (noisy, clean))
    path = arc_length_path(noisy, np.arange(3000.0), 400)[0]
    assert raw > 2 * length
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).sum() == pytest.approx(length, rel=0.03)


def test_rest_at_the_goal_is_cut_and_at_the_start_kept():
    way = rest_at_both_ends(np.linspace(0, 1, 401))
    _, _, times = arc_length_path(np.stack([way, way**2], 1), np.linspace(0, 4, 401), 100)
    assert times[-1] == pytest.approx(3.0, abs=0.03)
    assert times[1] == pytest.approx(1.0, abs=0.03)
