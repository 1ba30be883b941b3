"""The training scripts: what they promise is reached, and a run that was stopped ends where it would have ended."""

from __future__ import annotations

import pytest
import torch
from torch import nn

import latentds
from experiments.training import context, density, loop
from experiments.training.__main__ import Script, run


@pytest.mark.slow
def test_motions_pass_the_point_and_keep_out_of_the_sphere(tmp_path):
    learned = run(Script.VIA_POINT, True, 0, tmp_path)
    told = learned.numbers
    assert told["largest distance from the via-point, fitted"] > 0.15
    assert told["largest distance from the via-point, trained"] < 0.02
    assert told["least clearance of the sphere, fitted"] < 0 <= told["least clearance of the sphere, trained"]
    assert told["distance of the attractor from the goal"] == 0
    assert learned.history[-1] < 0.1 * learned.history[0]
    folder = tmp_path / "via-point"
    ds = latentds.load(folder / "system.safetensors")
    assert not ds.fit_report_is_current
    assert str(latentds.certify(ds)) in (folder / "summary.md").read_text()
    assert (folder / "picture.png").stat().st_size > 5000


def test_the_density_beats_a_gaussian_and_is_one(tmp_path):
    learned = run(Script.DENSITY, True, 0, tmp_path)
    told = learned.numbers
    gaussian, ours, truth = (value for what, value in told.items() if what.startswith("held-out"))
    assert gaussian + 0.5 < ours < truth
    assert told["integral of the learned density"] == pytest.approx(1, abs=0.01)
    assert learned.history[-1] < learned.history[0]


def test_the_true_density_is_one():
    points, area = density.grid()
    inside = points[..., 0].atan2(points[..., 1]).sub(torch.pi / 2).add(torch.pi) % (2 * torch.pi) - torch.pi
    total = density.true_log_prob(points).exp()[inside.abs() < density.SPAN / 2].sum() * area
    assert float(total) == pytest.approx(1, abs=0.01)


@pytest.mark.slow
def test_the_network_finds_goals_through_frozen_rollouts(tmp_path):
    learned = run(Script.CONTEXT, True, 0, tmp_path)
    told = learned.numbers
    assert (
        told["distance that the noise alone costs"]
        < told["held-out distance from the cup, goal by the network"]
        < 0.6 * told["held-out distance from the cup, goal as demonstrated"]
    )
    assert learned.history[-1] < 0.5 * learned.history[0]


def test_cameras_see_the_middle_in_the_middle():
    assert context.project(torch.zeros(3, dtype=torch.float64)).abs().max() < 1e-15
    above = context.project(torch.tensor([0.0, 0.0, 0.1], dtype=torch.float64))
    assert (above[1::2] > 0).all()


@pytest.fixture
def task():
    """A small module, and a loss that draws."""

    def make():
        psi = density.spread_out(5, torch.eye(8, 2, dtype=torch.float64), torch.Generator().manual_seed(0))
        return psi, lambda draw: psi(torch.randn(4, 2, generator=draw, dtype=torch.float64) + 1).square().mean()

    return make


@pytest.mark.parametrize("stop", [3, 20, 39, 50])
def test_a_run_that_was_stopped_ends_where_it_would_have_ended(task, tmp_path, stop):
    def plan(name):
        return loop.Loop("task", 50, 1e-2, 0, tmp_path / name)

    whole, loss = task()
    history = plan("whole").run(whole, loss)
    stopped, loss = task()
    count = 0

    def fails(draw):
        nonlocal count
        count += 1
        if count > stop:
            raise KeyboardInterrupt
        return loss(draw)

    if stop < 50:
        with pytest.raises(KeyboardInterrupt):
            plan("stopped").run(stopped, fails)
        assert (tmp_path / "stopped").exists() == (stop >= loop.STEPS_PER_CHECKPOINT)
    else:
        plan("stopped").run(stopped, fails)
    again, loss = task()
    assert plan("stopped").run(again, loss) == history
    assert all(map(torch.equal, whole.parameters(), again.parameters()))
    assert not torch.equal(whole.centers, task()[0].centers)


def test_foreign_and_damaged_checkpoints_are_refused(task, tmp_path):
    module, loss = task()
    loop.Loop("task", 2, 1e-2, 0, tmp_path / "kept").run(module, loss)
    with pytest.raises(ValueError, match=r"checkpoint: expected .*'seed': 1"):
        loop.Loop("task", 2, 1e-2, 1, tmp_path / "kept").run(module, loss)
    (tmp_path / "kept").write_bytes(b"nothing")
    with pytest.raises(ValueError, match=r"checkpoint: .* none of this loop's"):
        loop.Loop("task", 2, 1e-2, 0, tmp_path / "kept").run(module, loss)


def test_a_loss_that_is_not_finite_is_told(tmp_path):
    module = nn.Linear(1, 1)
    with pytest.raises(FloatingPointError, match="at step 0, got nan"):
        loop.Loop("task", 2, 1e-2, 0, tmp_path / "kept").run(module, lambda _: module.weight.sum() * torch.nan)
    assert not (tmp_path / "kept").exists()
