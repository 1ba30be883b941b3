"""The field's protocols, against their definitions."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from experiments.field.protocols import protocol_c, velocity_errors
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
