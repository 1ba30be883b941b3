"""The field's own ways to show handwriting and to judge what was learned, each as a cell of a comparison."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from latentds import Demonstration, StableDS
from latentds.benchmark import Cell, Factory
from latentds.fidelity import largest_speed
from latentds.metrics import velocity_cosine

TRAINING = 4
"""Demonstrations that protocol C trains on; it is judged by the others."""


def thinned(shown: Demonstration, stride: int) -> Demonstration:
    """Every ``stride``-th sample."""
    return replace(shown, positions=shown.positions[::stride], dt=shown.dt * stride)


def protocol_c(label: str, factory: Factory, shape: Sequence[Demonstration], seed: int = 0) -> Cell:
    """Held-out velocities (Figueroa and Billard 2018): trained on four, judged by the others, every second sample.

    Rows tell, beside the usual, ``train_rmse``, ``train_e``, ``test_rmse`` and ``test_e``: see :func:`velocity_errors`;
    and ``command``, the largest velocity along motions from the starts that were shown over the largest shown.
    """
    thin = [thinned(shown, 2) for shown in shape]
    return Cell(label, factory, thin[:TRAINING], seed, judges=thin[TRAINING:], measure=held_out_velocities)


def held_out_velocities(ds: StableDS, cell: Cell) -> dict[str, float]:
    """The velocity errors at the samples shown and at the judges', and the largest command."""
    with torch.no_grad():
        command = max(largest_speed(ds, ds.rollout(one.start, one.times)) for one in cell.shown)
    fastest = max(float(one.velocities.norm(dim=-1).max()) for one in cell.shown)
    return {"command": command / fastest} | {
        f"{part}_{what}": value
        for part, group in (("train", cell.shown), ("test", cell.judges))
        for what, value in velocity_errors(ds, group).items()
    }


def velocity_errors(ds: StableDS, demonstrations: Sequence[Demonstration]) -> dict[str, float]:
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
