"""Other people's figures that ours are set beside, each once, with where it is printed."""

from __future__ import annotations

from typing import NamedTuple


class Setting(NamedTuple):
    """Hyperparameters of a greedy match; ``mse`` is what was reached with them."""

    beta: float
    mu: float
    n_layers: int
    mse: float = float("nan")


class Size(NamedTuple):
    """Of an SDS-EF network, L and n_f; ``mse`` is the test MSE that was reached with it."""

    n_layers: int
    n_features: int
    mse: float = float("nan")


# Gupta, Nayak and Billard, "Learning High Dimensional Demonstrations Using Laplacian Eigenmaps": "the paper".

TABLE_ONE = {
    "Chebyshev": {
        "unstable c=1": Setting(0.9, 0.6, 50, 7.38e-7),
        "unstable c=3": Setting(0.9, 0.8, 75, 5.73e-7),
        "unstable c=7": Setting(0.5, 0.9, 175, 7.26e-6),
        "unstable c=10": Setting(0.4, 0.9, 300, 9.51e-6),
        "unstable c=15": Setting(0.3, 0.8, 750, 1.62e-5),
    },
    "FDM": {
        "unstable c=1": Setting(0.9, 0.8, 50, 2.52e-8),
        "unstable c=3": Setting(0.9, 0.9, 75, 9.64e-8),
        "unstable c=7": Setting(0.6, 0.9, 150, 3.35e-6),
        "unstable c=10": Setting(0.5, 0.9, 300, 5.39e-6),
        "unstable c=15": Setting(0.3, 0.8, 750, 1.56e-5),
    },
}
"""Its Table I: {method: {spiral: hyperparameters and MSE}}; none for the stable spirals."""

TABLE_TWO = {
    "unstable c=1": Size(10, 250, 1.18e-2),
    "unstable c=3": Size(10, 150, 1.99e-2),
    "unstable c=7": Size(30, 350, 5.66e-2),
    "unstable c=10": Size(40, 200, 7.26e-2),
    "unstable c=15": Size(40, 300, 1.32e-1),
}
"""Its Table II, of SDS-EF; none for the stable spirals."""

TABLE_THREE = {"a": 25.92, "b": 19.28, "c": 81.25, "d": 9.52, "e": 9.74, "f": 18.31}
"""Its Table III: FastDTW of six guided motions of a 7-joint arm."""


class HeldOut(NamedTuple):
    """Of protocol C, over the 26 shapes: what another's figures say, as they say it."""

    method: str
    rmse: str
    e: str
    dtwd: str


# Stored with the code of Figueroa and Billard, "A Physically-Consistent Bayesian Non-Parametric Mixture Model for
# Dynamical System Learning" (2018): github.com/nbfigueroa/ds-opt.

HELD_OUT_HANDWRITING = (
    HeldOut("SEDS (seds_stats_all.mat)", "6.34 ± 3.2", "0.099", "3954 (median 2130)"),
    HeldOut("LPV-DS, PC-GMM, O2 (stats_all_test.fig)", "5.19", "0.062", "1749"),
    HeldOut("LPV-DS, PC-GMM, O3 (stats_all_test.fig)", "5.28", "0.063", "—"),
)
