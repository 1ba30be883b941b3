"""SEDS: its constraint, its formula, what it learns and what it cannot."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from baselines import SEDS
from baselines.seds import LEAST_RATE
from latentds import Demonstration, datasets
from latentds.testing import parametrize_stable_ds, wavy_motion

pytestmark = pytest.mark.slow  # fits and integrates for each clause; `make test` runs it

METHODS = {"SEDS": lambda dim: SEDS(dim, n_components=2, iterations=10, seed=0)}


@parametrize_stable_ds(METHODS, dims=[2], fitted=[True])
def test_contract(check):
    check()


@parametrize_stable_ds(METHODS, dims=[1, 7], fitted=[True])
def test_contract_in_other_dimensions(check):
    check()


@parametrize_stable_ds(METHODS, dims=[3], fitted=[False])
def test_contract_before_a_fit(check):
    check()


@torch.no_grad()
def test_every_linear_system_is_stable_whatever_its_parameters(draw):
    ds = SEDS(3, n_components=4, iterations=3, seed=0).fit(wavy_motion(3))
    for parameter in ds.parameters():
        parameter.add_(torch.randn(parameter.shape, generator=draw, dtype=torch.float64))
    rates = np.linalg.eigvalsh((ds.systems.slopes() + ds.systems.slopes().mT) / 2)
    assert rates.max() <= 1e-12
    y = ds.attractor + torch.randn(500, 3, generator=draw, dtype=torch.float64)
    falling = (ds(y) * (y - ds.attractor)).sum(-1) / (y - ds.attractor).square().sum(-1)
    assert float(falling.max()) <= -LEAST_RATE / float(ds.duration) * (1 - 1e-9)


def test_velocity_is_the_mixture_of_linear_systems():
    shown = wavy_motion(2)
    ds = SEDS(2, n_components=3, iterations=10, seed=0).fit(shown)
    gate, slopes = ds.systems.mixture, ds.systems.slopes().detach().numpy()
    y = shown.positions[50].numpy()
    z = (y - shown.goal.numpy()) / float(ds.size)
    heights = [
        np.exp(h - np.square(w @ (z - m)).sum() / 2)
        for h, m, w in zip(
            *(part.detach().numpy() for part in (gate.log_heights, gate.means, gate.whiteners)), strict=True
        )
    ]
    wanted = sum(h * (a - LEAST_RATE * np.eye(2)) @ z for h, a in zip(heights, slopes, strict=True)) / sum(heights)
    found = ds(shown.positions[50]).detach().numpy()
    np.testing.assert_allclose(found, wanted * float(ds.size / ds.duration), rtol=1e-9)


def test_it_learns_what_comes_nearer_to_the_goal_and_cannot_learn_a_spiral():
    s = torch.linspace(0, 1, 300, dtype=torch.float64)
    eased = s**3 * (10 - 15 * s + 6 * s**2)
    bend = torch.stack([1 - eased, 0.3 * torch.sin(torch.pi * eased)], dim=-1)
    shown = [Demonstration(bend + (1 - eased).unsqueeze(-1) * torch.tensor([0.0, 0.05 * k]), 0.01) for k in (-1, 0, 1)]
    ds = SEDS(2, seed=0).fit(shown)
    assert ds.fit_report.mse < 0.01 * float(shown[1].velocities.square().mean())
    assert ds.fit_report.fidelity.follows
    winding = SEDS(3, n_components=6, iterations=50, seed=0).fit(datasets.unstable_spiral(3, 300))
    assert not winding.fit_report.fidelity.follows
