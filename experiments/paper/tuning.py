"""Hyperparameters as the paper chooses them: grids and its selection rule, kept in Optuna's studies.

A greedy match with M layers begins with every match with fewer, so one fit gives the error at every M of the grid.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import joblib
import numpy as np
import optuna
from numpy.typing import NDArray

from experiments.compared import GREEDY
from experiments.published import Setting
from latentds import Demonstration
from latentds.cache import fingerprint
from latentds.fitting.matching import add_greedy_layers
from latentds.fitting.tuning import BETAS, DEPTHS, GOOD, MUS, Tried

Array = NDArray[np.float64]


class Grid(NamedTuple):
    """What is tried; ``n_more`` trials of Optuna's TPE sampler between the grid's values follow."""

    betas: Sequence[float]
    mus: Sequence[float]
    n_layers: Sequence[int]
    n_more: int


FULL = Grid(
    betas=BETAS,
    mus=MUS,
    n_layers=DEPTHS,
    n_more=20,
)
QUICK = Grid((0.3, 0.5, 0.7, 0.9), (0.6, 0.8, 0.9), (50, 75, 100, 150, 175, 200, 300, 750), n_more=3)


def setting(one: Tried) -> Setting:
    return Setting(*one[:4])


def trace(method: str, shown: Demonstration, beta: float, mu: float, n_layers: Sequence[int]) -> list[float]:
    """The MSE per coordinate of a greedy match after each of ``n_layers`` layers, which increase."""
    target, moved = shown.positions.numpy(), GREEDY[method].latent_line(shown)
    found, used = [], 0
    for count in n_layers:
        moved = add_greedy_layers(moved, target, count - used, beta, mu)[1]
        used = count
        found.append(float(np.square(moved - target).mean()))
    return found


class Tuner:
    """Studies in one SQLite file; a study that was interrupted goes on.

    Args:
        path: of the file; made if absent.
        n_jobs: processes.
    """

    def __init__(self, path: Path, n_jobs: int) -> None:
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        self.storage = optuna.storages.RDBStorage(f"sqlite:///{path}")
        self.n_jobs = n_jobs

    def greedy(self, method: str, shown: Demonstration, grid: Grid) -> tuple[list[Tried], list[Tried]]:
        """All combinations of the grid, and those that TPE tried after them."""
        name = f"{method} · {shown.name} · {fingerprint(method, shown.positions, tuple(grid))[:12]}"
        every = list(itertools.product(grid.betas, grid.mus))
        study = self._study(f"{name} · grid", optuna.samplers.GridSampler({"beta": grid.betas, "mu": grid.mus}, seed=0))
        if len(_finished(study)) < len(every):
            work = (joblib.delayed(trace)(method, shown, beta, mu, grid.n_layers) for beta, mu in every)
            known = dict(zip(every, joblib.Parallel(self.n_jobs)(work), strict=True))
            self._optimize(study, lambda beta, mu: known[beta, mu], shown, grid, len(every))
        more = self._study(f"{name} · TPE", optuna.samplers.TPESampler(seed=0, n_startup_trials=5))
        self._optimize(more, lambda beta, mu: trace(method, shown, beta, mu, grid.n_layers), shown, grid, grid.n_more)
        return _tried(study, shown, grid), _tried(more, shown, grid)

    def _optimize(
        self,
        study: optuna.Study,
        errors_of: Callable[[float, float], list[float]],
        shown: Demonstration,
        grid: Grid,
        n_trials: int,
    ) -> None:
        def merit(trial: optuna.Trial) -> float:
            errors = errors_of(trial.suggest_float("beta", 0.05, 1.0), trial.suggest_float("mu", 0.05, 0.95))
            trial.set_user_attr("mse", errors)
            return _merit(np.array(errors) / _unit(shown), grid.n_layers)

        if (left := n_trials - len(_finished(study))) > 0:
            study.optimize(merit, n_trials=left)

    def _study(self, name: str, sampler: optuna.samplers.BaseSampler) -> optuna.Study:
        return optuna.create_study(storage=self.storage, study_name=name, sampler=sampler, load_if_exists=True)


def _finished(study: optuna.Study) -> list[optuna.trial.FrozenTrial]:
    return [trial for trial in study.get_trials(deepcopy=False) if trial.state.is_finished()]


def _tried(study: optuna.Study, shown: Demonstration, grid: Grid) -> list[Tried]:
    return [
        Tried(t.params["beta"], t.params["mu"], count, error, error / _unit(shown))
        for t in _finished(study)
        if "mse" in t.user_attrs
        for count, error in zip(grid.n_layers, t.user_attrs["mse"], strict=True)
    ]


def _unit(shown: Demonstration) -> float:
    """What an MSE is divided by: the square of half the largest extent, 1 for the paper's spirals."""
    return (shown.size / 2) ** 2


def _merit(normalised: Array, n_layers: Sequence[int]) -> float:
    """The rule as one number for a sampler that minimises: the layers needed, else above every number of layers."""
    good = np.flatnonzero(normalised < GOOD)
    return float(n_layers[good[0]]) if len(good) else n_layers[-1] * (1 + float(normalised.min()) / GOOD)
