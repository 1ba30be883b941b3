"""The paper's spirals: on their sphere, at their length, with the speeds that their names claim."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from latentds import datasets


@pytest.mark.parametrize("c", datasets.UNSTABLE_COMPLEXITIES)
def test_unstable_spiral(c):
    shown = datasets.unstable_spiral(c)
    assert shown.positions.shape == (1000, 3)
    assert shown.duration == pytest.approx(3.14)
    torch.testing.assert_close(shown.positions.norm(dim=1), torch.ones(1000, dtype=torch.float64))
    assert shown.start.tolist() == [0, 0, 1]
    assert (shown.goal - torch.tensor([0, 0, -1.0])).norm().item() == pytest.approx(math.pi - 3.14, rel=1e-3)
    assert shown.velocities[-1].norm().item() == pytest.approx(1.0, abs=0.01)
    turns = np.unwrap(torch.atan2(shown.positions[1:, 1], shown.positions[1:, 0]).numpy())
    assert np.ptp(turns) == pytest.approx(c * 3.14, rel=0.01)


@pytest.mark.parametrize("c", datasets.STABLE_COMPLEXITIES)
def test_stable_spiral(c):
    shown = datasets.stable_spiral(c)
    assert shown.positions.shape == (1000, 3)
    assert 15.0 < shown.duration < 16.0
    assert shown.velocities[-1].norm().item() == pytest.approx(0.01, rel=0.05)
    assert (shown.velocities.norm(dim=1)[:-1] > 0.0099).all()
    solved = solve_ivp(
        lambda _, angle: 0.3 * (np.array([math.pi, 2 * c * math.pi]) - angle),
        (0, shown.duration), [0, 0], t_eval=shown.times.numpy(), rtol=1e-10, atol=1e-12,
    )  # fmt: skip
    theta, psi = solved.y
    exact = np.stack([np.sin(theta) * np.cos(psi), np.sin(theta) * np.sin(psi), np.cos(theta)], axis=1)
    assert np.abs(shown.positions.numpy() - exact).max() < 5e-3 * c  # Euler's error at 0.003 s


def test_paper_stop_rule_would_stop_at_once():
    """Steps of 0.003 s are shorter than 1e-2 from the first on, for every complexity: the rule cannot be meant."""
    for c in datasets.STABLE_COMPLEXITIES:
        fastest = 0.3 * math.hypot(math.pi, 2 * c * math.pi)
        step = datasets.stable_spiral(c, 5000).positions[:2].diff(dim=0).norm().item()
        assert step < 1e-2
        assert 0.003 * 0.3 * math.pi < 1e-2 < fastest


def test_archimedean_spiral():
    shown = datasets.archimedean_spiral(700)
    assert shown.positions.shape == (700, 2)
    assert shown.duration == pytest.approx(12)
    radius = shown.positions.norm(dim=1)
    torch.testing.assert_close(radius, torch.linspace(0.1, 0, 700, dtype=torch.float64))
    assert shown.goal.tolist() == [0, 0]
    turns = np.unwrap(torch.atan2(shown.positions[:-1, 1], shown.positions[:-1, 0]).numpy())
    assert np.ptp(turns) == pytest.approx(3 * math.pi, rel=0.01)


def test_suite_is_the_papers_ten():
    names = [shown.name for shown in datasets.spiral_suite(50)]
    assert names == [f"unstable c={c}" for c in (1, 3, 7, 10, 15)] + [f"stable c={c}" for c in (1, 2, 3, 5, 7)]


@pytest.mark.parametrize("n_points", [3, 50, 1001])
def test_number_of_points(n_points):
    assert {len(shown) for shown in datasets.spiral_suite(n_points)} == {n_points}


@pytest.mark.parametrize("spiral", [datasets.unstable_spiral, datasets.stable_spiral])
@pytest.mark.parametrize("c", [0, -1, math.nan, math.inf, "three", None])
def test_bad_complexity(spiral, c):
    with pytest.raises(ValueError, match="c: expected a number in "):
        spiral(c)


@pytest.mark.parametrize("n_points", [2, 0, -5, 100.0, "many", None])
def test_bad_number_of_points(n_points):
    for make in (
        lambda: datasets.unstable_spiral(1, n_points),
        lambda: datasets.stable_spiral(1, n_points),
        lambda: datasets.archimedean_spiral(n_points),
    ):
        with pytest.raises(ValueError, match="n_points: expected a whole number >= 3, got "):
            make()


def test_a_smaller_slowest_speed_ends_later():
    early, late = datasets.stable_spiral(3, slowest=1e-1), datasets.stable_spiral(3, slowest=1e-3)
    assert early.duration < datasets.stable_spiral(3).duration < late.duration
    assert late.velocities[-1].norm().item() == pytest.approx(1e-3, rel=0.05)


@pytest.mark.parametrize("seed", range(5))
def test_joint_motion_is_smooth_within_the_limits_and_at_rest_at_both_ends(seed):
    shown = datasets.joint_motion(seed, 500)
    assert shown.positions.shape == (500, 7)
    assert (shown.positions.abs().numpy() < datasets.JOINT_LIMITS).all()
    speeds = shown.velocities.norm(dim=1)
    assert max(speeds[0], speeds[-1]) < 0.01 * speeds.max()
    accelerations = shown.velocities.diff(dim=0).norm(dim=1)
    assert accelerations.diff().abs().max() < 0.2 * accelerations.max()
    torch.testing.assert_close(shown.positions, datasets.joint_motion(seed, 500).positions)
    assert not torch.equal(shown.positions, datasets.joint_motion(seed + 1, 500).positions)


@pytest.mark.parametrize("name", datasets.STROKES)
def test_a_drawn_stroke_passes_its_points_and_never_itself(name):
    shown = datasets.drawn(name)
    pen = torch.tensor(datasets.STROKES[name], dtype=torch.float64)
    assert torch.cdist(pen, shown.positions).min(dim=1).values.max() < 0.01
    assert shown.velocities[[0, -1]].norm(dim=1).max() < 0.01 * shown.velocities.norm(dim=1).max()
    few = datasets.drawn(name, 200).positions
    apart = torch.cdist(few, few)
    far_along = (torch.arange(200)[:, None] - torch.arange(200)).abs() > 60
    assert apart[far_along].min() > 0.1


def test_datasets_refuse_what_does_not_exist():
    with pytest.raises(ValueError, match=r"name: expected one of hook.*'circle'"):
        datasets.drawn("circle")
    with pytest.raises(ValueError, match="seed"):
        datasets.joint_motion(-1)
    with pytest.raises(ValueError, match="slowest"):
        datasets.stable_spiral(1, slowest=0)
