"""The Chebyshev embedding against the explicit Laplacian of the demonstration graph."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from numpy.polynomial import Chebyshev
from scipy.linalg import eigh

from latentds.fitting.embedding import chebyshev_columns, chebyshev_eigenvalues, map_to_endpoints, straight_column


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
