"""The field's own ways to show handwriting and to judge what was learned, each as a cell of a comparison."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from latentds import Demonstration, StableDS, metrics
from latentds.arguments import whole_number
from latentds.benchmark import Cell, Factory
from latentds.fidelity import largest_speed
from latentds.metrics import velocity_cosine

TRAINING = 4
"""Demonstrations that protocol C trains on; it is judged by the others."""


def thinned(shown: Demonstration, stride: int) -> Demonstration:
    """Every ``stride``-th sample."""
    return replace(shown, positions=shown.positions[::stride], dt=shown.dt * stride)


def leave_one_out(label: str, factory: Factory, shape: Sequence[Demonstration], left_out: int, seed: int = 0) -> Cell:
    """All demonstrations but one are shown, and that one, by number from 0, judges a rollout from its start."""
    others, judge = _apart(shape, left_out)
    return Cell(label, factory, called(f"all but {judge.name}", others), seed, judges=judge)


def one_to_others(label: str, factory: Factory, shape: Sequence[Demonstration], shown: int, seed: int = 0) -> Cell:
    """One demonstration, by number from 0, is shown, and each other judges a rollout from its start."""
    judges, only = _apart(shape, shown)
    return Cell(label, factory, only, seed, judges=judges)


def called(name: str, shown: Sequence[Demonstration]) -> list[Demonstration]:
    """Demonstrations of one name, which is then that of the cell: a progress bar has no room for seven."""
    return [replace(one, name=name) for one in shown]


def _apart(shape: Sequence[Demonstration], which: int) -> tuple[list[Demonstration], Demonstration]:
    """The others, and the one of that number."""
    if len(shape) < 2 or not whole_number(which, "which", at_least=0) < len(shape):
        raise ValueError(f"shape: expected 2 demonstrations or more, and number {which} among them, got {len(shape)}")
    return [one for i, one in enumerate(shape) if i != which], shape[which]


def protocol_a(label: str, factory: Factory, shape: Sequence[Demonstration], seed: int = 0) -> Cell:
    """In sample (CONDOR, PUMA): trained on all, judged by the same, see :func:`in_sample`.

    The first alone judges what every cell's rows tell, because each of its judges is rolled out on its own.
    """
    together = called(f"{shape[0].name} to {shape[-1].name}", shape)
    return Cell(label, factory, together, seed, judges=shape[:1], measure=in_sample)


def in_sample(ds: StableDS, cell: Cell) -> dict[str, float]:
    """Means over what was shown of the :func:`path_errors` of motions from the same starts, every tenth sample."""
    judges = [thinned(one, 10) for one in cell.shown]
    return path_errors([path.numpy() for path in motions(ds, judges)], judges)


def path_errors(paths: Sequence[Any], judges: Sequence[Demonstration]) -> dict[str, float]:
    """How far paths are from as many demonstrations, step k from sample k, in the mean over them.

    ``rmse``: root of the mean over points and coordinates; ``dtwd``: exact DTW over the number of points; ``fd``:
    discrete Fréchet distance.
    """
    each = [
        (np.sqrt(metrics.mse(path, y)), metrics.dtw(path, y) / len(y), metrics.frechet(path, y))
        for path, y in zip(paths, (one.positions for one in judges), strict=True)
    ]
    return dict(zip(("rmse", "dtwd", "fd"), np.mean(each, axis=0).tolist(), strict=True))


def motions(ds: StableDS, demonstrations: Sequence[Demonstration]) -> list[Tensor]:
    """From each one's start at its times; all at once, as many starts are integrated in the time of one."""
    times, place = torch.cat([one.times for one in demonstrations]).unique(return_inverse=True)
    with torch.no_grad():
        paths = ds.rollout(torch.stack([one.start for one in demonstrations]), times)
    places = place.split([len(one) for one in demonstrations])
    return [path[at] for path, at in zip(paths, places, strict=True)]


def protocol_c(label: str, factory: Factory, shape: Sequence[Demonstration], seed: int = 0) -> Cell:
    """Held-out velocities (Figueroa and Billard 2018): trained on four, judged by the others, every second sample.

    Rows tell, beside the usual, ``train_rmse``, ``train_e``, ``test_rmse`` and ``test_e``: see :func:`velocity_errors`;
    and ``command``, the largest velocity along motions from the starts that were shown over the largest shown.
    """
    thin = [thinned(shown, 2) for shown in shape]
    together = called(f"{shape[0].name} to {shape[TRAINING - 1].name}", thin[:TRAINING])
    return Cell(label, factory, together, seed, judges=thin[TRAINING:], measure=held_out_velocities)


def held_out_velocities(ds: StableDS, cell: Cell) -> dict[str, float]:
    """The velocity errors at the samples shown and at the judges', and the largest command."""
    with torch.no_grad():
        command = largest_speed(ds, torch.cat(motions(ds, cell.shown)))
    fastest = max(float(one.velocities.norm(dim=-1).max()) for one in cell.shown)
    return {"command": command / fastest} | {
        f"{part}_{what}": value
        for part, group in (("train", cell.shown), ("test", cell.judges))
        for what, value in velocity_errors(ds, group).items()
    }


def velocity_errors(ds: Callable[[Tensor], Tensor], demonstrations: Sequence[Demonstration]) -> dict[str, float]:
    """How far off the velocities are at all samples of some demonstrations together, as ds-opt counts.

    ``rmse``: mean over samples of the root of the mean over coordinates of the squared error, units per second; ``e``:
    mean of 1 - cos of the angle, samples at rest left out.
    """
    positions, shown = (
        torch.cat([d.positions for d in demonstrations]),
        torch.cat([d.velocities for d in demonstrations]),
    )
    with torch.no_grad():
        missed = (ds(positions) - shown).numpy()
        cosine = velocity_cosine(ds(positions), shown)
    return {"rmse": float(np.sqrt(np.square(missed).mean(axis=1)).mean()), "e": 1 - cosine}
