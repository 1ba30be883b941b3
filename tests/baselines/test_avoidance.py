"""Coupling terms: against another library's, that they do no work, and that weights are found that made motions."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from baselines import DMP, AvoidanceTerms
from baselines.avoidance import FADING_AWAY, NARROWING
from latentds import Demonstration, datasets
from latentds.testing import wavy_motion

coupling = pytest.importorskip("movement_primitives.dmp", reason="needs the dev extra")


@pytest.fixture(scope="module")
def dmp():
    return DMP(2).fit(datasets.drawn("wave", n_points=300))


@pytest.fixture(scope="module")
def terms(dmp):
    terms = AvoidanceTerms(dmp)
    with torch.no_grad():
        terms.weights[1, 2], terms.weights[2, 1] = 200.0, 90.0
    return terms


@pytest.mark.parametrize("beta", NARROWING)
def test_a_term_is_another_librarys_but_for_the_distance(beta, draw):
    terms = AvoidanceTerms(DMP(3).fit(wavy_motion(3)))
    way = float(torch.linalg.vector_norm(terms.dmp.start - terms.dmp.attractor))
    for y, velocity, obstacle in torch.randn(20, 3, 3, generator=draw, dtype=torch.float64):
        wanted = coupling.obstacle_avoidance_acceleration_3d(y.numpy(), velocity.numpy(), obstacle.numpy(), 1.0, beta)
        feature = terms.features(y, velocity, obstacle)[:, NARROWING.index(beta)]
        faded = np.exp(-np.array(FADING_AWAY) * float(torch.linalg.vector_norm(obstacle - y)) / way)
        np.testing.assert_allclose(feature.detach(), wanted[:, None] * faded, rtol=1e-6)


@pytest.mark.parametrize("dim", [2, 3, 7])
def test_they_do_no_work_in_any_dimension(dim, draw):
    terms = AvoidanceTerms(DMP(dim).fit(wavy_motion(dim)))
    y, velocity, obstacle = torch.randn(3, 50, dim, generator=draw, dtype=torch.float64)
    features = terms.features(y, velocity, obstacle)
    work = (features * velocity[..., None, None]).sum(-3)
    assert float(work.abs().max()) < 1e-12 * float(features.abs().max())
    assert float(features.abs().max()) > 0


def test_nothing_is_nan_at_the_obstacle_at_rest_and_straight_ahead(terms):
    y, still, ahead = torch.zeros(2), torch.zeros(2), torch.ones(2)
    for case in ((y, ahead, y), (y, still, ahead), (y, ahead, ahead)):
        assert float(terms.features(*(part.double() for part in case)).abs().max()) < 1e-15


def test_without_weights_it_is_the_dmp(dmp):
    starts, times = dmp.start + torch.eye(2), torch.linspace(0, 2, 50, dtype=torch.float64)
    torch.testing.assert_close(
        AvoidanceTerms(dmp).rollout(starts, times, [0.1, 0.2]), dmp.rollout(starts, times), rtol=0, atol=1e-6
    )


def test_it_keeps_clear_and_still_arrives(terms):
    dmp = terms.dmp
    times = torch.linspace(0, 2 * float(dmp.duration), 400, dtype=torch.float64)
    own = dmp.rollout(dmp.start, times).detach()
    obstacle = own[90] + 0.02
    path = terms.rollout(dmp.start, times, obstacle)

    def clearance(motion):
        return float((motion - obstacle).norm(dim=-1).min())

    assert clearance(path) > 2 * clearance(own)
    torch.testing.assert_close(path[-1], dmp.attractor, rtol=0, atol=1e-3)


def test_weights_that_made_motions_are_found(terms):
    """And those of 0 are found to be 0, nearly."""
    dmp = terms.dmp
    times = torch.linspace(0, float(dmp.duration), 600, dtype=torch.float64)
    own = dmp.rollout(dmp.start, times).detach()
    obstacles = own[[150, 200, 250, 300]] + torch.tensor([0.03, -0.02])
    around = [Demonstration.from_times(times, terms.rollout(dmp.start, times, one)) for one in obstacles]
    for one in around:  # the DMP's end is not quite its goal
        one.positions[-1] = dmp.attractor
    found = AvoidanceTerms(dmp).learn(around, obstacles)
    other = own[225] - 0.04
    wanted = terms.rollout(dmp.start, times, other)
    missed = (found.rollout(dmp.start, times, other) - wanted).norm(dim=-1).max()
    assert float(missed) < 0.1 * float((wanted - own).norm(dim=-1).max())
    assert bool((found.weights >= 0).all())


@pytest.mark.parametrize(
    ("moved", "obstacles", "message"),
    [
        (0.0, [1.0], "obstacles: expected"),
        (0.0, [1.0, float("nan")], "obstacles: expected"),
        (3.0, [1.0, 1.0], "around: expected"),
    ],
)
def test_bad_input_is_refused(dmp, moved, obstacles, message):
    shown = datasets.drawn("wave", n_points=100)
    with pytest.raises(ValueError, match="obstacle: expected"):
        AvoidanceTerms(dmp).rollout(shown.start, shown.times, [0.0, float("nan")])
    with pytest.raises(ValueError, match=message):
        AvoidanceTerms(dmp).learn(Demonstration(shown.positions + moved, shown.dt), obstacles)
