"""Which of many methods differ over many motions: ranks, and what of them is not chance (Demšar 2006).

The unit is a motion. Scores are frames (motions, methods), less is better; NaN and inf are failures and rank last.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy import stats

LEVEL = 0.05


class Ranking(NamedTuple):
    """What :func:`ranked` tells of some scores.

    Attributes:
        mean: mean rank of each method, 1 the best, in that order.
        p: of Friedman's test, that all methods rank alike; NaN where two methods or two motions are all there are.
        critical: Nemenyi's critical difference of two mean ranks at ``LEVEL``.
        n_motions: over how many.
    """

    mean: pd.Series[float]
    p: float
    critical: float
    n_motions: int


def ranked(scores: pd.DataFrame) -> Ranking:
    """Ranks within each motion, ties sharing theirs; a motion that no method was scored on is left out."""
    scores = failures_last(scores)
    count, k = scores.shape
    ranks = scores.rank(axis=1)
    enough = k > 2 and count > 1 and bool((ranks.nunique(axis=1) > 1).any())
    p = float(stats.friedmanchisquare(*ranks.to_numpy().T).pvalue) if enough else np.nan
    width = stats.studentized_range.ppf(1 - LEVEL, k, np.inf) / np.sqrt(2)
    critical = float(width * np.sqrt(k * (k + 1) / (6 * count)))
    return Ranking(ranks.mean().sort_values(kind="stable"), p, critical, count)


def against(scores: pd.DataFrame, one: str) -> pd.DataFrame:
    """Each other method against ``one``.

    Returns:
        A row for each, with "p" of Wilcoxon's signed-rank test, corrected by Holm's procedure, and whether it is
        "better" on more motions than it is worse on.
    """
    scores = failures_last(scores)
    largest = scores.replace(np.inf, np.nan).max().max()
    known = scores.replace(np.inf, 10 * largest)  # a failure is a larger difference than any other
    raw, better = {}, {}
    for other in known.columns.drop(one):
        apart = known[other] - known[one]
        raw[other] = float(stats.wilcoxon(apart).pvalue) if (apart != 0).any() else 1.0
        better[other] = bool((apart < 0).sum() > (apart > 0).sum())
    return pd.DataFrame({"p": holm(pd.Series(raw, dtype=float)), "better": pd.Series(better, dtype=bool)})


def holm(p: pd.Series[float]) -> pd.Series[float]:
    """Corrected p-values: the i-th least of m times m - i + 1, none less than one before it, none above 1."""
    order = p.sort_values()
    corrected = (order * np.arange(len(order), 0, -1)).cummax().clip(upper=1.0)
    return corrected.reindex(p.index)


def failures_last(scores: pd.DataFrame) -> pd.DataFrame:
    """NaN as inf, without the motions that no method was scored on."""
    return scores.dropna(how="all").fillna(np.inf)
