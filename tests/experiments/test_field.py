"""The field's protocols, against their definitions."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
import torch

from experiments.field.protocols import held_out_velocities, protocol_c, velocity_errors
from experiments.several import FIGURES, summary
from latentds import Demonstration, TubeDS
from latentds.testing import wavy_motion


def test_velocity_errors_are_as_defined():
    shown = [wavy_motion(2, seed, n_points=60) for seed in (0, 1)]
    ds = TubeDS(2)
    total, turned, count, moving = 0.0, 0.0, 0, 0
    for d in shown:
        for y, v in zip(d.positions, d.velocities.numpy(), strict=True):
            w = ds(y).detach().numpy()
            total, count = total + np.sqrt(((w - v) ** 2).mean()), count + 1
            if np.linalg.norm(v) > 0:
                turned += abs(1 - w @ v / np.linalg.norm(w) / np.linalg.norm(v))
                moving += 1
    found = velocity_errors(ds, shown)
    assert found["rmse"] == pytest.approx(total / count)
    assert found["e"] == pytest.approx(turned / moving)


def test_protocol_c_trains_on_four_and_every_second_sample():
    shape = [Demonstration(torch.rand(11, 2), 0.1, f"shape {i}") for i in range(7)]
    cell = protocol_c("any", TubeDS, shape)
    assert [d.name for d in cell.shown] == [f"shape {i}" for i in range(4)]
    assert [d.name for d in cell.judges] == [f"shape {i}" for i in range(4, 7)]
    assert torch.equal(cell.shown[1].positions, shape[1].positions[::2])
    assert cell.shown[1].duration == pytest.approx(shape[1].duration)


def test_the_largest_command_is_over_the_largest_speed_shown():
    shape = [wavy_motion(2, seed, n_points=60) for seed in range(7)]
    ds = TubeDS(2, n_layers=20, refined=False).fit(shape[0])
    cell = protocol_c("any", TubeDS, shape)
    commands = [float(ds(ds.rollout(d.start, d.times)).norm(dim=-1).max()) for d in cell.shown]
    fastest = max(float(d.velocities.norm(dim=-1).max()) for d in cell.shown)
    assert held_out_velocities(ds, cell)["command"] == pytest.approx(max(commands) / fastest)


def test_the_study_of_several_tells_means_worst_and_the_best_other():
    figures = dict.fromkeys(FIGURES, 1.0)
    rows = pd.DataFrame(
        [
            {"demonstration": shape, "method": method, **figures, "test_rmse": rmse, "command": judge}
            for shape, method, rmse in [
                ("A", "TubeDS", 2.0),
                ("A", "DMP", 3.0),
                ("B", "TubeDS", 4.0),
                ("B", "SEDS", 1.0),
            ]
            for judge in (0.5, 0.75)
        ]
    )
    text = summary(rows)
    assert "| TubeDS | 3 (4) | 1 (1) | 1 (1) | 1 (1) | 0.75 (0.75) |" in text
    assert "| A | 2 | 1 | 1 | 1 | 0.75 | 3 (DMP) |" in text
    assert "| B | 4 | 1 | 1 | 1 | 0.75 | 1 (SEDS) |" in text
