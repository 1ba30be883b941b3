"""NCDS: any two motions approach each other at the rate that is certified."""

from __future__ import annotations

import pytest
import torch

from baselines import NCDS
from baselines.contracting import ContractingDynamics
from latentds import certify
from latentds.dynamics import Frame
from latentds.metrics import dtw
from latentds.testing import parametrize_stable_ds, wavy_motion

pytestmark = pytest.mark.slow  # fits and integrates for each clause; `make test` runs it


def small(dim, **settings):
    return NCDS(dim, **{"n_layers": 4, "n_features": 20, "n_units": 8, "seed": 0, "epochs": 40, **settings})


@parametrize_stable_ds({"NCDS": small}, dims=[2])
def test_contract(check):
    check()


@parametrize_stable_ds({"NCDS": small}, dims=[1, 7])
def test_contract_in_other_dimensions(check):
    check()


def test_two_motions_approach_at_the_rate(draw):
    dynamics = ContractingDynamics(3, 8, 0.5, generator=draw)
    torch.nn.init.normal_(dynamics.turning, generator=draw)
    dynamics.duration.fill_(2.0)
    frame = Frame.between(torch.ones(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
    x, times = torch.randn(2, 3, generator=draw, dtype=torch.float64), torch.linspace(0, 4, 9, dtype=torch.float64)
    with torch.no_grad():
        apart = (dynamics.flow(x[0], times, frame) - dynamics.flow(x[1], times, frame)).norm(dim=-1)
    assert (apart <= apart[0] * torch.exp(-0.25 * times) * (1 + 1e-6)).all()
    slopes = torch.func.vmap(torch.func.jacrev(dynamics.pull))(x)
    assert torch.linalg.eigvalsh((slopes + slopes.mT) / 2).max() <= -0.5 + 1e-9


def test_follows_what_it_was_shown():
    shown = wavy_motion(2)
    ds = small(2, n_features=100, epochs=300).fit(shown)
    with torch.no_grad():
        path = ds.rollout(shown.start, shown.times)
    assert dtw(path, shown.positions) / len(shown) < 0.1 * shown.size
    falsified = {line.claim for line in certify(ds, n_samples=200).falsified}
    assert falsified <= {"follows its demonstration"}  # 300 epochs of a small one are few
