"""Scores over starts: their mean and spread, and whether two methods' differ."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

Array = NDArray[np.float64]


def welch(first: Any, second: Any) -> float:
    """p of Welch's t-test: two samples that may differ in variance, as the paper takes it."""
    return float(stats.ttest_ind(first, second, equal_var=False).pvalue)


def paired(first: Any, second: Any) -> float:
    """p of the paired t-test: both methods move from the same starts."""
    return float(stats.ttest_rel(first, second).pvalue)


def level(scores: Array) -> float:
    """The mean; inf where a rollout failed."""
    return float(scores.mean()) if np.isfinite(scores).all() else np.inf


def mean_and_spread(scores: Array) -> str:
    """Mean ± standard deviation."""
    return f"{scores.mean():.2f} ± {scores.std(ddof=1):.2f}" if np.isfinite(scores).all() else "failed"
