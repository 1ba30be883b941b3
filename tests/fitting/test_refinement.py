"""Joint refinement against autograd through the diffeomorphism itself."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from latentds import datasets
from latentds.fitting import refinement
from latentds.fitting.embedding import map_to_endpoints, straight_column
from latentds.fitting.matching import match
from latentds.fitting.refinement import refine
from latentds.testing import wavy_motion
from latentds.translations import WIDTH_BOUND, Layers, LocallyWeightedTranslations


def pairs(dim, count=120):
    y = wavy_motion(dim, n_points=count).positions.numpy()
    return map_to_endpoints(straight_column(count), y[0], y[-1]), y


def decode(layers, x):
    psi = LocallyWeightedTranslations(x.shape[1], len(layers.widths))
    psi.assign(*(torch.from_numpy(np.asarray(part)) for part in layers))
    with torch.no_grad():
        return psi(torch.from_numpy(x)).numpy()


def mse(layers, x, y, weights=None):
    squares = ((decode(layers, x) - y) ** 2).mean(1)
    return np.average(squares, weights=weights)


@pytest.fixture
def objective(monkeypatch):
    """What refine hands to the optimiser: (loss, start)."""
    caught = []

    def catch(loss, start, **options):
        caught.append((loss, start))
        return minimize(loss, start, **options)

    minimize = refinement.minimize
    monkeypatch.setattr(refinement, "minimize", catch)
    return caught


@pytest.mark.parametrize("dim", [1, 2, 3, 7])
@pytest.mark.parametrize("weighted", [False, True])
def test_gradient_of_the_loss_is_autograds(dim, weighted, objective):
    x, y = pairs(dim, 60)
    weights = np.linspace(0, 2, len(x)) if weighted else None
    layers = match(x, y, 12, 0.5, 0.9)
    refine(layers, x, y, 0.95, weights=weights, steps=2)  # above the match's μ: no layer is shortened
    loss, start = objective[0]
    at = start + 0.01 * np.random.default_rng(0).standard_normal(len(start))
    value, gradient = loss(at)

    shape = layers.centers.shape
    unit = np.abs(y - y.mean(0)).max()
    flat = torch.from_numpy(at).requires_grad_()
    centers, free = flat[: -shape[0]].reshape(2, *shape)
    widths = torch.exp(flat[-shape[0] :]) / unit
    directions = 0.95 * WIDTH_BOUND / widths[:, None] * free / (1 + free.square().sum(1, keepdim=True)).sqrt()
    moved = torch.from_numpy(x)
    for c, v, rho in zip(centers * unit, directions, widths, strict=True):
        moved = moved + torch.exp(-(rho**2) * (moved - c).square().sum(1, keepdim=True)) * v
    squares = (moved - torch.from_numpy(y)).square().mean(1)
    share = torch.from_numpy(np.ones(len(x)) if weights is None else weights)
    expected = (squares * share).sum() / share.sum() / mse(layers, x, y, weights)  # 1 where it starts
    assert value == pytest.approx(expected.item(), rel=1e-6)
    wanted = torch.autograd.grad(expected, flat)[0].numpy()
    np.testing.assert_allclose(gradient, wanted, rtol=1e-6, atol=1e-6 * np.abs(wanted).max())


@pytest.mark.parametrize("dim", [1, 2, 3, 7])
def test_error_falls_and_the_bound_holds(dim):
    x, y = pairs(dim)
    layers = match(x, y, 15, 0.5, 0.9)
    better = refine(layers, x, y, 0.9, steps=60)
    assert mse(better, x, y) < 0.5 * mse(layers, x, y)
    assert np.max(better.widths * np.linalg.norm(better.directions, axis=1)) < 0.9 * WIDTH_BOUND
    assert [part.shape for part in better] == [part.shape for part in layers]


@pytest.mark.parametrize("steps", [1, 5, 300])
def test_error_never_rises(steps):
    shown = datasets.unstable_spiral(3, 200).positions.numpy()
    x = map_to_endpoints(straight_column(len(shown)), shown[0], shown[-1])
    layers = match(x, shown, 40, 0.9, 0.9)
    assert mse(refine(layers, x, shown, 0.9, steps=steps), x, shown) <= mse(layers, x, shown)


def test_a_layer_above_the_bound_comes_back_within():
    """A tighter μ than the match was made with."""
    x, y = pairs(2)
    layers = match(x, y, 15, 0.9, 0.99)
    better = refine(layers, x, y, 0.3, steps=5)
    assert np.max(better.widths * np.linalg.norm(better.directions, axis=1)) <= 0.3 * WIDTH_BOUND


def test_weights_draw_the_error_away():
    x, y = pairs(3)
    layers = match(x, y, 8, 0.5, 0.9)
    weights = np.ones(len(x))
    weights[0] = 1000.0
    missed = [
        np.linalg.norm(decode(refine(layers, x, y, 0.9, weights=given), x)[0] - y[0]) for given in (None, weights)
    ]
    assert missed[1] < 0.2 * missed[0]


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_units_do_not_matter(scale):
    x, y = pairs(2)
    layers = match(x, y, 10, 0.5, 0.9)
    scaled = Layers(layers.centers * scale, layers.directions * scale, layers.widths / scale)
    here, there = refine(layers, x, y, 0.9, steps=10), refine(scaled, scale * x, scale * y, 0.9, steps=10)
    np.testing.assert_allclose(decode(there, scale * x) / scale, decode(here, x), rtol=0, atol=1e-6)


def test_nothing_to_refine():
    x, y = pairs(2)
    none = Layers(np.empty((0, 2)), np.empty((0, 2)), np.empty(0))
    assert len(refine(none, x, y, 0.9).widths) == 0
    layers = match(x, y, 5, 0.5, 0.9)
    same = refine(layers, x, decode(layers, x), 0.9)
    np.testing.assert_allclose(decode(same, x), decode(layers, x), rtol=0, atol=1e-12)


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_a_layer_that_was_planted_is_found(dim):
    """The least error is 0 here, so that stopping early shows."""
    x = np.random.default_rng(dim).uniform(-1, 1, (80, dim))
    planted = Layers(np.full((1, dim), 0.2), np.full((1, dim), 0.3), np.array([0.7]))
    y = decode(planted, x)
    nearby = Layers(planted.centers + 0.1, planted.directions * 0.8, planted.widths * 1.1)
    assert mse(refine(nearby, x, y, 0.95), x, y) < 1e-8 * mse(nearby, x, y)
