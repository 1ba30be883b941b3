"""CDSP: it contracts partially whatever its parameters are, and two of its motions may part all the same."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.linalg import expm

from baselines import CDSP, LPVDS
from baselines.lpvds import LEAST_RATE
from latentds import Demonstration, datasets
from latentds.testing import parametrize_stable_ds, wavy_motion

pytestmark = pytest.mark.slow  # fits and integrates for each clause; `make test` runs it

pytest.importorskip("cvxpy")


def small(dim, **settings):
    return CDSP(dim, **{"n_components": 2, "iterations": 3, "seed": 0, **settings})


@parametrize_stable_ds({"CDSP": small}, dims=[2, 3, 7], fitted=[True])
def test_contract(check):
    check()


@parametrize_stable_ds({"CDSP": small}, dims=[1], fitted=[False])
def test_contract_before_a_fit(check):
    check()


@pytest.fixture(scope="module")
def curl():
    return CDSP(2, seed=0).fit(datasets.drawn("curl", n_points=200))


def test_v_falls_at_the_rate_whatever_the_parameters_are(draw):
    ds = CDSP(3)
    ds.systems.load_state_dict(small(3, n_components=4).fit(wavy_motion(3)).systems.state_dict())
    with torch.no_grad():
        for parameter in ds.parameters():
            parameter.add_(0.5 * torch.randn(parameter.shape, generator=draw, dtype=torch.float64))
    y = 2 * torch.randn(500, 3, generator=draw, dtype=torch.float64)
    energy, rate = torch.func.jvp(ds.lyapunov, (y,), (ds(y),))
    assert bool((rate <= -2 * LEAST_RATE * energy * (1 - 1e-9)).all())


def test_two_motions_may_part_for_a_while(curl):
    """The largest growth of their distance in M, by the derivative of the field along the demonstration."""
    shown = datasets.drawn("curl", n_points=200)
    slopes = torch.func.vmap(torch.func.jacrev(curl))(shown.positions).detach() * shown.duration
    metric = curl.systems.linear.metric().detach()
    energy, rate = torch.func.jvp(curl.lyapunov, (shown.positions[:-1],), (curl(shown.positions[:-1]),))
    assert bool((rate * shown.duration <= -2 * LEAST_RATE * energy * (1 - 1e-9)).all())  # and yet:
    root = torch.linalg.cholesky(metric).mT
    seen = root @ slopes @ torch.linalg.inv(root)
    growth = torch.linalg.eigvalsh((seen + seen.mT) / 2)[:, -1]
    assert float(growth.max()) > 0
    fastest = growth.argmax()
    y = shown.positions[fastest]
    aside = torch.linalg.solve(root, torch.linalg.eigh((seen + seen.mT)[fastest] / 2)[1][:, -1])
    pair = torch.stack([y, y + 1e-4 * shown.size * aside / aside.norm()]).detach()
    apart = curl.rollout(pair, torch.linspace(0, 0.02 * shown.duration, 5, dtype=torch.float64)).diff(dim=0)[0]
    distances = torch.sqrt(((apart @ metric) * apart).sum(-1))
    assert bool((distances.diff() > 0).all())


def test_finds_the_linear_system_that_moved():
    """One that spirals in, whose motion is known: exp(At) y₀."""
    matrix, times = np.array([[-1.5, 4.0], [-4.0, -1.0]]), np.linspace(0, 4, 300)
    path = np.stack([expm(matrix * t) @ [1.0, 0.3] for t in times])
    path[-1] = 0
    ds = CDSP(2, n_components=1, seed=0).fit(Demonstration(path, float(times[1])))
    with torch.no_grad():
        found = ds(torch.eye(2, dtype=torch.float64)).T
    np.testing.assert_allclose(found, matrix, atol=0.1)


def test_follows_velocities_nearer_than_lpvds():
    shown = datasets.drawn("hook", n_points=200)
    assert CDSP(2, seed=0).fit(shown).fit_report.mse < LPVDS(2, seed=0).fit(shown).fit_report.mse
