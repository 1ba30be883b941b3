"""What the paper says of its latent space, measured: the embedding's columns and the graph's eigenvalues."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from latentds.fitting.embedding import chebyshev_columns, chebyshev_eigenvalues, map_to_endpoints

Array = NDArray[np.float64]

DIMS = (2, 3, 4, 5, 6, 7)
COUNTS = (100, 200, 400, 800, 1600, 2000)
PATH = 60
"""Nodes a path of the explicit Laplacian."""


def embedding(dims: Sequence[int] = DIMS, counts: Sequence[int] = COUNTS) -> pd.DataFrame:
    """One row per n and N: how far the columns lie apart, how bent their curve is, and what the lemmas say of them.

    ``entry``: the largest difference of two columns' entries where both begin with 1; ``norm``: of their vectors;
    ``unit``: of vectors scaled to length 1; ``bend``: the largest distance of the placed points from the straight line,
    in its lengths; ``bound``: the largest λ over Lemma 3's bound; ``limit``: λN² over π²/4.
    """
    rows = []
    for n in dims:
        for count in counts:
            columns, eigenvalues = chebyshev_columns(count, n), chebyshev_eigenvalues(count, n)
            units = columns / np.linalg.norm(columns, axis=0)
            gaps = columns[:, :, None] - columns[:, None, :]
            placed = map_to_endpoints(columns, np.zeros(n), np.ones(n))
            aside = placed - placed.mean(axis=1, keepdims=True)
            steps = np.diff(columns, axis=0)
            rows.append(
                {
                    "n": n,
                    "N": count,
                    "entry": np.abs(gaps).max(),
                    "norm": np.linalg.norm(gaps, axis=0).max(),
                    "unit": np.linalg.norm(units[:, :, None] - units[:, None, :], axis=0).max(),
                    "bend": np.linalg.norm(aside, axis=1).max() / np.sqrt(n),
                    "monotone": bool((steps < 0).all()),
                    "spacing": bool((np.diff(np.abs(steps), axis=0) > 0).all()),
                    "bound": (eigenvalues / (2 * (1 - np.cos(np.pi / count)))).max(),
                    "limit": (eigenvalues * count**2 / (np.pi**2 / 4)).min(),
                }
            )
    return pd.DataFrame(rows)


def slope(frame: pd.DataFrame, n: int, column: str) -> float:
    """k of column ~ N^k in dimension n, fitted on log scales."""
    chosen = frame[frame["n"] == n]
    return float(np.polyfit(np.log(chosen["N"]), np.log(chosen[column]), 1)[0])


def laplacian(count: int, n: int) -> Array:
    """Of K = n+1 copies of a path of ``count`` nodes, their last nodes in a cycle: (NK, NK)."""
    copies = n + 1
    nodes = np.arange(copies * count).reshape(copies, count)
    edges = [*zip(nodes[:, :-1].ravel(), nodes[:, 1:].ravel(), strict=True)]
    edges += [*zip(nodes[:, -1], np.roll(nodes[:, -1], -1), strict=True)]
    found = np.zeros((nodes.size, nodes.size))
    for a, b in edges:
        found[a, b] = found[b, a] = -1
    np.fill_diagonal(found, -found.sum(axis=1))
    return found


def spectrum(dims: Sequence[int] = DIMS, count: int = PATH) -> pd.DataFrame:
    """Repeated eigenvalues of the explicit Laplacian beside Prop. 2; how many of the n smallest above 0 repeat."""
    rows = []
    for n in dims:
        values = np.linalg.eigvalsh(laplacian(count, n))
        times = np.array([(np.abs(values - value) < 1e-9).sum() for value in values])
        copies = n + 1
        rows.append(
            {
                "n": n,
                "K": copies,
                "paper": copies // 2 - 1 if copies % 2 == 0 else (copies - 1) // 2,
                "distinct": int((times == 2).sum() // 2),
                "per node": (times == 2).sum() / 2 / count,
                "of the n smallest": int((times[1 : n + 1] == 2).sum()),
            }
        )
    return pd.DataFrame(rows)
