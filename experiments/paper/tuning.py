"""Hyperparameters as the paper chooses them: grids and its selection rule, kept in Optuna's studies.

A greedy match with M layers begins with every match with fewer, so one fit gives the error at every M of the grid.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import joblib
import numpy as np
import optuna

from experiments.compared import GREEDY
from latentds import Demonstration
from latentds.cache import fingerprint
from latentds.fitting.matching import add_greedy_layers
from latentds.fitting.tuning import BETAS, DEPTHS, GOOD, MUS, Tried


class Grid(NamedTuple):
    """What is tried; ``n_more`` trials of Optuna's TPE sampler between the grid's values follow."""

    betas: Sequence[float]
    mus: Sequence[float]
    n_layers: Sequence[int]
    n_more: int


FULL = Grid(BETAS, MUS, DEPTHS, n_more=20)
QUICK = Grid((0.3, 0.5, 0.7, 0.9), (0.6, 0.8, 0.9), (50, 75, 100, 150, 175, 200, 300, 750), n_more=3)


def trace(method: str, shown: Demonstration, beta: float, mu: float, n_layers: Sequence[int]) -> list[float]:
    """The MSE per coordinate of a greedy match after each of ``n_layers`` layers, which increase."""
    target, moved = shown.positions.numpy(), GREEDY[method].latent_line(shown)
    errors = []
    for fewer, count in itertools.pairwise((0, *n_layers)):
        moved = add_greedy_layers(moved, target, count - fewer, beta, mu)[1]
        errors.append(float(np.square(moved - target).mean()))
    return errors


def tune(method: str, shown: Demonstration, grid: Grid, file: Path, n_jobs: int) -> tuple[list[Tried], list[Tried]]:
    """All combinations of the grid, and those that TPE tried after them.

    Args:
        method: of ``GREEDY``.
        file: of SQLite, in which every trial is kept: an interrupted search goes on; made if absent.
        n_jobs: processes.
    """
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    storage = optuna.storages.RDBStorage(f"sqlite:///{file}")
    name = f"{method} · {shown.name} · {fingerprint(method, shown.positions, tuple(grid))[:12]}"
    # An MSE is divided by the square of half the largest extent, 1 for the paper's spirals.
    unit = (shown.size / 2) ** 2
    combinations = list(itertools.product(grid.betas, grid.mus))

    def errors_at(beta: float, mu: float) -> list[float]:
        return trace(method, shown, beta, mu, grid.n_layers)

    @cache
    def errors_on_grid() -> dict[tuple[float, float], list[float]]:
        work = (joblib.delayed(trace)(method, shown, beta, mu, grid.n_layers) for beta, mu in combinations)
        return dict(zip(combinations, joblib.Parallel(n_jobs)(work), strict=True))

    def search(
        sampler: optuna.samplers.BaseSampler, kind: str, n_trials: int, errors: Callable[[float, float], list[float]]
    ) -> list[Tried]:
        def objective(trial: optuna.Trial) -> float:
            reached = errors(trial.suggest_float("beta", 0.05, 1.0), trial.suggest_float("mu", 0.05, 0.95))
            trial.set_user_attr("mse", reached)
            return layers_needed(np.array(reached) / unit, grid.n_layers)

        study = optuna.create_study(
            storage=storage, study_name=f"{name} · {kind}", sampler=sampler, load_if_exists=True
        )
        if (left := n_trials - len(_finished(study))) > 0:
            study.optimize(objective, n_trials=left)
        return [
            Tried(trial.params["beta"], trial.params["mu"], count, error, error / unit)
            for trial in _finished(study)
            if "mse" in trial.user_attrs
            for count, error in zip(grid.n_layers, trial.user_attrs["mse"], strict=True)
        ]

    every = optuna.samplers.GridSampler({"beta": grid.betas, "mu": grid.mus}, seed=0)
    between = optuna.samplers.TPESampler(seed=0, n_startup_trials=5)
    on_grid = search(every, "grid", len(combinations), lambda beta, mu: errors_on_grid()[beta, mu])
    return on_grid, search(between, "TPE", grid.n_more, errors_at)


def _finished(study: optuna.Study) -> list[optuna.trial.FrozenTrial]:
    return [trial for trial in study.get_trials(deepcopy=False) if trial.state.is_finished()]


def layers_needed(normalised: np.ndarray, n_layers: Sequence[int]) -> float:
    """The rule as one number for a sampler that minimises: the layers needed, else above every number of layers."""
    good = np.flatnonzero(normalised < GOOD)
    return float(n_layers[good[0]]) if len(good) else n_layers[-1] * (1 + float(normalised.min()) / GOOD)
