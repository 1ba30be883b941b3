"""Greedy matching against a plain loop that searches every width; the fits of ChebyshevDS and FDM against Table I."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.optimize import minimize_scalar

from baselines import FDM
from latentds import ChebyshevDS, Demonstration, TubeDS, datasets
from latentds.fitting.embedding import chebyshev_columns, map_to_endpoints, straight_column
from latentds.fitting.homotopy import linear_homotopy
from latentds.fitting.matching import PINS, match, match_along, pin_ends
from latentds.testing import wavy_motion
from latentds.translations import WIDTH_BOUND

# Table I of the paper: complexity -> (beta, mu, layers, MSE per coordinate).
TABLE_I = {
    ChebyshevDS: {
        1: (0.9, 0.6, 50, 7.38e-7),
        3: (0.9, 0.8, 75, 5.73e-7),
        7: (0.5, 0.9, 175, 7.26e-6),
        10: (0.4, 0.9, 300, 9.51e-6),
        15: (0.3, 0.8, 750, 1.62e-5),
    },
    FDM: {
        1: (0.9, 0.8, 50, 2.52e-8),
        3: (0.9, 0.9, 75, 9.64e-8),
        7: (0.6, 0.9, 150, 3.35e-6),
        10: (0.5, 0.9, 300, 5.39e-6),
        15: (0.3, 0.8, 750, 1.56e-5),
    },
}


def pair(shown, columns):
    y = shown.positions.numpy()
    return map_to_endpoints(columns, y[0], y[-1]), y


def cases():
    for shown in (wavy_motion(1), wavy_motion(2), wavy_motion(7), datasets.unstable_spiral(3, 300)):
        yield pytest.param(*pair(shown, straight_column(len(shown))), id=f"{shown.name}, straight")
        yield pytest.param(*pair(shown, chebyshev_columns(len(shown), shown.dim)[::-1]), id=f"{shown.name}, Chebyshev")


def moved_by(x, c, v, rho):
    return x + np.exp(-(rho**2) * ((x - c) ** 2).sum(1))[:, None] * v


def squared_error(x, y):
    return ((y - x) ** 2).sum()


def bounded(x, c, v, limit, y):
    """What scipy's bounded scalar minimiser makes of one layer, as one would write the method first."""

    def after(rho):
        return squared_error(moved_by(x, c, v, rho), y)

    return minimize_scalar(after, bounds=(0, limit), method="bounded").fun


@pytest.mark.parametrize(
    ("beta", "mu"), [(0.5, 0.9), *(pytest.param(*both, marks=pytest.mark.slow) for both in ((0.9, 0.6), (1.0, 0.99)))]
)
@pytest.mark.parametrize(("x", "y"), list(cases()))
def test_every_layer_is_the_best_greedy_one(x, y, beta, mu):
    """Replayed by a plain loop: the centre is the worst point, it moves by β of its error, and no ρ is better."""
    layers = match(x, y, 20, beta, mu)
    assert len(layers.widths) == 20
    size = np.ptp(y, axis=0).max()
    for c, v, rho in zip(*layers, strict=True):
        error = y - x
        worst = (error**2).sum(1).argmax()
        np.testing.assert_allclose(c, x[worst], rtol=0, atol=1e-9 * size)
        np.testing.assert_allclose(v, beta * error[worst], rtol=1e-6, atol=1e-12 * size)
        limit = mu * WIDTH_BOUND / np.linalg.norm(v)
        assert 0 < rho <= limit * (1 + 1e-12)
        after = moved_by(x, c, v, rho)
        dense = min(squared_error(moved_by(x, c, v, r), y) for r in limit * np.geomspace(1e-4, 1, 1500))
        assert squared_error(after, y) <= dense * (1 + 1e-6)
        assert squared_error(after, y) <= bounded(x, c, v, limit, y) * (1 + 1e-9)
        x = after


@pytest.mark.parametrize("factor", [1e-9, 1e-3, 1e3, 1e9])
def test_units_do_not_matter(factor):
    x, y = pair(wavy_motion(3), straight_column(200))
    plain, scaled = match(x, y, 20, 0.5, 0.9), match(factor * x, factor * y, 20, 0.5, 0.9)
    np.testing.assert_allclose(scaled.centers, factor * plain.centers, rtol=1e-5, atol=1e-6 * factor)
    np.testing.assert_allclose(scaled.directions, factor * plain.directions, rtol=1e-4, atol=1e-6 * factor)
    np.testing.assert_allclose(scaled.widths * factor, plain.widths, rtol=1e-4)


def test_perfect_match_needs_no_layer():
    y = wavy_motion(2).positions.numpy()
    assert len(match(y, y, 10, 0.5, 0.9).widths) == 0


@pytest.mark.parametrize("c", [1, 3, 7, 10, 15])
@pytest.mark.parametrize("method", TABLE_I, ids=lambda method: method.__name__)
def test_table_1(method, c):
    beta, mu, n_layers, reported = TABLE_I[method][c]
    shown = datasets.unstable_spiral(c)
    ds = method(3, n_layers=n_layers, beta=beta, mu=mu).fit(shown)
    assert ds.fit_report.mse < 3 * reported
    assert ds.fit_report.n_layers == n_layers + PINS
    latent = chebyshev_columns(1000, 3)[::-1] if method is ChebyshevDS else straight_column(1000)
    with torch.no_grad():
        mapped = ds.decode(torch.from_numpy(map_to_endpoints(latent, shown.start.numpy(), shown.goal.numpy())))
    assert ds.fit_report.mse == pytest.approx((mapped - shown.positions).square().mean().item(), rel=1e-9)


@pytest.mark.parametrize("method", TABLE_I, ids=lambda method: method.__name__)
@pytest.mark.parametrize("dim", [1, 2, 3, 7])
def test_attractor_is_the_end_of_the_demonstration(method, dim):
    shown = wavy_motion(dim)
    ds = method(dim, n_layers=40).fit(shown)
    with torch.no_grad():
        end = ds.rollout(shown.start, torch.tensor([0.0, 100 * shown.duration]))[-1]
        assert (ds.attractor - shown.goal).abs().max() < 1e-9
        assert (end - shown.goal).abs().max() < 1e-9
        assert (ds.decode(ds.frame().attractor) - shown.goal).abs().max() < 1e-9


@pytest.mark.parametrize("c", [7, 15])
@pytest.mark.parametrize("method", TABLE_I, ids=lambda method: method.__name__)
def test_the_ends_are_pinned(method, c):
    """Without, ψ⁻¹ of the start and the goal lie up to the size of the motion from the ends of the latent line."""
    beta, mu, n_layers, _ = TABLE_I[method][c]
    shown = datasets.unstable_spiral(c)
    ds = method(3, n_layers=n_layers, beta=beta, mu=mu).fit(shown)
    for end in (shown.start, shown.goal):
        with torch.no_grad():
            torch.testing.assert_close(ds.encode(end), end, rtol=0, atol=1e-6)


def test_pins_leave_a_perfect_match_alone():
    y = wavy_motion(2).positions.numpy()
    assert len(pin_ends(match(y, y, 10, 0.5, 0.9), y, y, 0.9).widths) == 0


@pytest.mark.parametrize("method", TABLE_I, ids=lambda method: method.__name__)
def test_a_coordinate_at_rest_works(method):
    """Start and goal coincide in it, or it never moves at all."""
    t = torch.linspace(0, 1, 100, dtype=torch.float64)
    shown = Demonstration(torch.stack([t, torch.sin(math.pi * t), torch.ones_like(t)], dim=1), 0.01)
    ds = method(3, n_layers=40).fit(shown)
    with torch.no_grad():
        path = ds.rollout(shown.start, shown.times)
    assert ds.fit_report.mse < 1e-4
    assert torch.cdist(path, shown.positions).amin(1).max() < 0.1


@pytest.mark.parametrize("method", TABLE_I, ids=lambda method: method.__name__)
@pytest.mark.parametrize(
    ("argument", "values"),
    [
        ("n_layers", [0, -1, 1.5, True, "many"]),
        ("beta", [0, -0.1, 1.001, math.nan, math.inf, "half", None]),
        ("mu", [0, 1, 1.5, -1, math.nan, "most", None]),
    ],
)
def test_hyperparameters_out_of_range(method, argument, values):
    for value in values:
        with pytest.raises(ValueError, match=f"{argument}: expected a (whole )?number .*, got"):
            method(3, **{argument: value})
    with pytest.raises(ValueError, match="dim: expected a whole number >= 1, got 0"):
        method(0)


@pytest.mark.parametrize("method", TABLE_I, ids=lambda method: method.__name__)
def test_bad_demonstrations(method):
    ds, shown = method(3, n_layers=5), wavy_motion(3)
    t = torch.linspace(0, 2 * math.pi, 50, dtype=torch.float64)
    loop = torch.stack([torch.cos(t), torch.sin(t), 0 * t], dim=1)
    loop[-1] = loop[0]
    bad = {
        "expected dimension 3, got 2": wavy_motion(2),
        "expected a goal apart from the start, got a closed loop": Demonstration(loop, 0.1),
        "got list \\(empty\\)": [],
        "expected a Demonstration or a non-empty list of them, got Tensor": shown.positions,
        "expected a Demonstration or a non-empty list of them, got NoneType": None,
        "expected a Demonstration or a non-empty list of them, got list": [shown, 3],
    }
    for message, demonstration in bad.items():
        with pytest.raises(ValueError, match=f"demonstration: .*{message}"):
            ds.fit(demonstration)
        assert ds.fit_report is None
        assert bool((ds.attractor == 0).all())


@pytest.mark.parametrize(
    "method", [*TABLE_I, pytest.param(TubeDS, marks=pytest.mark.slow)], ids=lambda method: method.__name__
)
@pytest.mark.parametrize("gap", [0.0, 1e-7])
def test_a_fit_that_fails_leaves_the_last_one(method, gap):
    """Here the goal lies so near the start that no latent line leads from one to the other."""
    ds = method(2, n_layers=20).fit(wavy_motion(2))
    before, report = {name: value.clone() for name, value in ds.state_dict().items()}, ds.fit_report
    t = torch.linspace(0, 1.5 * math.pi, 50, dtype=torch.float64)
    bow = torch.stack([torch.cos(t), torch.sin(t)], dim=1)
    bow[-1] = bow[0] + gap
    with pytest.raises(ValueError, match=r"got a closed loop|does not meet itself"):
        ds.fit(Demonstration(bow, 0.1))
    assert ds.fit_report is report
    assert all(torch.equal(value, before[name]) for name, value in ds.state_dict().items())


def test_a_map_that_floats_cannot_invert_is_refused(monkeypatch):
    ds = FDM(2, n_layers=20)
    monkeypatch.setattr(ds.diffeomorphism, "inverse", lambda y: y * (1 + 1e-3))
    with pytest.raises(ValueError, match="demonstration: expected a motion whose map inverts in floats, got one that"):
        ds.fit(wavy_motion(2))
    assert ds.fit_report is None
    assert bool((ds.attractor == 0).all())


@pytest.mark.parametrize(("n_layers", "steps"), [(40, 4), (41, 4), (20, 1), (7, 5)])
def test_continuation_matches_curve_after_curve(n_layers, steps):
    """Half of the layers shared evenly, the last curve takes the rest: the same, one call after the other."""
    x, y = pair(wavy_motion(2), straight_column(len(wavy_motion(2))))
    curves = linear_homotopy(x, y, steps)
    share = n_layers // (2 * steps)
    expected = []
    for target, count in zip(curves[1:], [share] * (steps - 1) + [n_layers - share * (steps - 1)], strict=True):
        if count:
            layers = match(x, target, count, 0.5, 0.9)
            for c, v, rho in zip(*layers, strict=True):
                x = moved_by(x, c, v, rho)
            expected.append(layers)
    found = match_along(curves, n_layers, 0.5, 0.9)
    for part, wanted in zip(found, zip(*expected, strict=True), strict=True):
        np.testing.assert_allclose(part, np.concatenate(wanted), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("narrowest", [0.05, 0.3, 2.0])
def test_no_layer_is_narrower_than_asked(narrowest):
    x, y = pair(wavy_motion(2), straight_column(len(wavy_motion(2))))
    free = match_along(linear_homotopy(x, y, 2), 30, 0.5, 0.9)
    bound = match_along(linear_homotopy(x, y, 2), 30, 0.5, 0.9, narrowest)
    assert (1 / free.widths).min() < narrowest  # else the bound would not be felt
    assert (1 / bound.widths).min() >= narrowest * (1 - 1e-12)


@pytest.mark.parametrize("method", TABLE_I, ids=lambda method: method.__name__)
def test_no_depth_asked_for_is_the_papers_rule(method):
    shown = datasets.unstable_spiral(3, 300)
    ds = method(3, n_layers=None).fit(shown)
    normalised = ds.fit_report.mse / (shown.size / 2) ** 2
    assert normalised < 1.1e-5
    assert 25 <= ds.diffeomorphism.n_layers - PINS <= 100
    assert "by the paper's rule" in ds.fit_report.notes[0]
    fresh = method(3, n_layers=None)
    fresh.load_state_dict(ds.state_dict())
    assert torch.equal(fresh.start, ds.start)
    assert torch.equal(fresh(shown.positions), ds(shown.positions))
    with pytest.raises(ValueError, match="n_layers: expected a number beside beta"):
        method(3, n_layers=None, beta=0.7)


@pytest.mark.parametrize("method", TABLE_I, ids=lambda method: method.__name__)
def test_of_several_the_mean_is_learned_and_that_is_said(method):
    shown, shift = wavy_motion(3), torch.tensor([0.0, 0.1, 0.0], dtype=torch.float64)
    way = torch.linspace(1, 0, len(shown), dtype=torch.float64).unsqueeze(-1)
    apart = [Demonstration(shown.positions + sign * way * shift, shown.dt) for sign in (-1, 1)]
    ds = method(3, n_layers=150).fit(apart)
    assert "learned the mean of 2 demonstrations, as it learns from one" in ds.fit_report.notes
    with torch.no_grad():
        missed = (ds.rollout(shown.start, shown.times) - shown.positions).norm(dim=-1)
    assert float(missed.max()) < 0.05 * shown.size
    assert torch.equal(ds.attractor, shown.goal)
