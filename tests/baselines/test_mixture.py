"""Gaussian mixtures and their regression, against gmr and scikit-learn."""

from __future__ import annotations

import gmr
import numpy as np
import pytest
import torch
from sklearn.mixture import GaussianMixture as Reference

from baselines.mixture import GaussianMixture, MixtureRegression, fit_mixture
from baselines.training import descend_smoothly


@pytest.fixture(scope="module")
def samples():
    draw = np.random.default_rng(0)
    x = draw.uniform(-1, 1, (400, 2))
    return np.concatenate([x, np.tanh(3 * x[:, ::-1]) + 0.1 * draw.standard_normal((400, 2))], axis=1)


def test_responsibilities_are_scikit_learns(samples):
    reference = Reference(3, random_state=0).fit(samples)
    mixture = GaussianMixture(4)
    mixture.assign(reference.weights_, reference.means_, reference.covariances_)
    with torch.no_grad():
        found = mixture(torch.from_numpy(samples))
    np.testing.assert_allclose(found.numpy(), reference.predict_proba(samples), atol=1e-12)


def test_regression_is_the_conditional_mean_of_gmr(samples):
    mixture = fit_mixture(samples, 4, 0)
    regression = MixtureRegression(2)
    regression.assign(*mixture)
    reference = gmr.GMM(4, *mixture)
    with torch.no_grad():
        found = regression(torch.from_numpy(samples[:, :2]))
    np.testing.assert_allclose(found.numpy(), reference.predict(np.array([0, 1]), samples[:, :2]), atol=1e-10)


def test_the_information_criterion_finds_the_number_of_clusters():
    draw = np.random.default_rng(0)
    centers = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    samples = centers.repeat(100, axis=0) + 0.05 * draw.standard_normal((300, 2))
    weights, means, _ = fit_mixture(samples, None, 0)
    np.testing.assert_allclose(weights, 1 / 3, atol=1e-3)
    np.testing.assert_allclose(means[np.lexsort(means.round(1).T)], centers, atol=0.02)


def test_a_state_of_more_components_loads(samples):
    fitted, fresh = MixtureRegression(2), MixtureRegression(2)
    fitted.assign(*fit_mixture(samples, 4, 0))
    fresh.load_state_dict(fitted.state_dict())
    x = torch.from_numpy(samples[:, :2])
    assert torch.equal(fresh(x), fitted(x))
    assert fresh.mixture.n_components == 4


def test_smooth_descent_finds_the_minimum_of_a_narrow_valley():
    place = torch.nn.Parameter(torch.tensor([-1.2, 1.0], dtype=torch.float64))
    history = descend_smoothly(lambda: rosen(place), {place: 0.5}, 200)
    np.testing.assert_allclose(place.detach(), [1, 1], atol=1e-3)
    assert history[-1] < 1e-6 < history[0]


def rosen(x):
    return 100 * (x[1] - x[0] ** 2) ** 2 + (1 - x[0]) ** 2
