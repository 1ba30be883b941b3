"""The neural Lyapunov method: V is convex and falls as fast as promised, and the field is Lipschitz at the goal."""

from __future__ import annotations

import pytest
import torch
from torch.nn.functional import softplus

import latentds
from baselines.lyapunov import Bowl, NeuralLyapunov
from latentds.testing import parametrize_stable_ds, wavy_motion

pytestmark = pytest.mark.slow  # fits and integrates for each clause; `make test` runs it


def small(dim, **settings):
    return NeuralLyapunov(dim, **{"n_units": 24, "n_convex": 12, "alpha": 1.0, "seed": 0, "epochs": 40, **settings})


@parametrize_stable_ds({"NeuralLyapunov": small}, dims=[2])
def test_contract(check):
    check()


@parametrize_stable_ds({"NeuralLyapunov": small}, dims=[1, 7])
def test_contract_in_other_dimensions(check):
    check()


@pytest.fixture(scope="module")
def fitted():
    return small(3, epochs=100).fit(wavy_motion(3))


@pytest.fixture
def places(fitted, draw):
    return fitted.attractor + 3 * torch.randn(500, 3, generator=draw, dtype=torch.float64)


def test_the_bowl_is_a_convex_network_without_its_tangent(draw):
    """Written plainly, and differentiated by autograd."""
    bowl = Bowl(3, 7, draw)
    u = 3 * torch.randn(20, 3, generator=draw, dtype=torch.float64)

    def network(row):
        (first, second), (inner, outer) = bowl.direct, map(softplus, bowl.passed)
        return outer @ softplus(inner @ softplus(first(row)) + second(row))

    zero = torch.zeros(3, dtype=torch.float64)
    height, tilt = network(zero), torch.func.grad(network)(zero)
    value, slope = bowl(u)
    torch.testing.assert_close(value, torch.stack([network(row) - height - tilt @ row for row in u]))
    torch.testing.assert_close(slope, torch.stack([torch.func.grad(network)(row) - tilt for row in u]))


def test_v_is_convex(fitted, places):
    here, there = places[:250], places[250:]
    with torch.no_grad():
        between = fitted.lyapunov((here + there) / 2)
        assert bool((between <= (fitted.lyapunov(here) + fitted.lyapunov(there)) / 2).all())


def test_v_falls_as_fast_as_promised(fitted, places):
    with torch.no_grad():
        velocity = fitted(places)
    energy, slope = torch.func.jvp(fitted.lyapunov, (places,), (velocity,))
    least = fitted.alpha / fitted.duration * energy
    assert bool((slope <= -least * (1 - 1e-9)).all())
    assert bool((slope < -least * (1 + 1e-6)).any()), "the projection acts everywhere: f̂ is never seen"


def test_the_field_is_lipschitz_at_the_goal(fitted, draw):
    """Where the paper's own jumps, unless its network happens to vanish there."""
    ways = torch.nn.functional.normalize(torch.randn(50, 3, generator=draw, dtype=torch.float64), dim=-1)
    with torch.no_grad():
        slopes = [fitted(fitted.attractor + r * ways).norm(dim=-1) / r for r in (1e-3, 1e-5, 1e-7)]
        assert not fitted(fitted.attractor).any()
    torch.testing.assert_close(slopes[1], slopes[0], rtol=0.1, atol=0)
    torch.testing.assert_close(slopes[2], slopes[1], rtol=0.1, atol=0)


def test_is_saved_and_loaded(fitted, places, tmp_path):
    fitted.save(tmp_path / "ds")
    with torch.no_grad():
        assert torch.equal(latentds.load(tmp_path / "ds", classes=[NeuralLyapunov])(places), fitted(places))


def test_follows_what_it_was_shown():
    shown = wavy_motion(2)
    assert small(2, epochs=400, n_units=48).fit(shown).fit_report.fidelity.miss < 0.02


@pytest.mark.parametrize(("argument", "value"), [("n_units", 0), ("n_convex", 0), ("alpha", 0), ("seed", -1)])
def test_bad_arguments_are_named(argument, value):
    with pytest.raises(ValueError, match=f"^{argument}: expected"):
        small(2, **{argument: value})
