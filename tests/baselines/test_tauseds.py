"""τ-SEDS: its transformation against its definition and autograd, and that it learns what SEDS cannot."""

from __future__ import annotations

import pytest
import torch
from scipy.optimize import brentq

from baselines import SEDS, TauSEDS
from latentds import datasets
from latentds.testing import parametrize_stable_ds, wavy_motion

pytestmark = pytest.mark.slow  # fits and integrates for each clause; `make test` runs it

METHODS = {"TauSEDS": lambda dim: TauSEDS(dim, n_components=2, n_asymmetric=1, iterations=10, seed=0)}


@parametrize_stable_ds(METHODS, dims=[2, 3, 7], fitted=[True])
def test_contract(check):
    check()


@parametrize_stable_ds(METHODS, dims=[1], fitted=[False])
def test_contract_before_a_fit(check):
    check()


@pytest.fixture
def ds(draw):
    ds = TauSEDS(3, n_components=2, seed=0, iterations=20).fit(datasets.unstable_spiral(1, 100))
    with torch.no_grad():
        for parameter in ds.energy.parameters():
            parameter.add_(0.2 * torch.randn(parameter.shape, generator=draw, dtype=torch.float64))
    return ds


def test_v_is_the_squared_distance_in_taus_space_and_directions_stay(ds, draw):
    z = torch.randn(50, 3, generator=draw, dtype=torch.float64)
    image = ds.tau(z)
    torch.testing.assert_close(image.square().sum(-1), ds.energy(z))
    torch.testing.assert_close(image / image.norm(dim=-1, keepdim=True), z / z.norm(dim=-1, keepdim=True))


def test_its_jacobian_is_autograds_and_is_inverted(ds, draw):
    z, tangent = torch.randn(2, 20, 3, generator=draw, dtype=torch.float64)
    _, pushed = torch.func.jvp(ds.tau, (z,), (tangent,))
    torch.testing.assert_close(ds.push(z, tangent), pushed)
    torch.testing.assert_close(ds.pull(z, pushed), tangent)


def test_every_place_of_taus_space_has_one_root_along_its_ray(ds, draw):
    """By SciPy: τ(r ẑ) grows in r, so that τ⁻¹ is one number."""
    direction = torch.nn.functional.normalize(torch.randn(3, generator=draw, dtype=torch.float64), dim=0)
    root = brentq(lambda r: float(ds.tau(r * direction).detach().norm()) - 1.7, 1e-6, 1e3)
    torch.testing.assert_close(ds.tau(root * direction), 1.7 * direction, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("stroke", ["wave", "curl"])
def test_directions_are_nearer_than_those_of_seds_where_a_stroke_leads_away_first(stroke):
    shown, errors = datasets.drawn(stroke, n_points=200), []
    for method in (SEDS, TauSEDS):
        fitted = method(2, seed=0).fit(shown)
        with torch.no_grad():
            velocities = fitted(shown.positions[:-5])
        errors.append(float((1 - torch.cosine_similarity(velocities, shown.velocities[:-5], dim=-1)).mean()))
    assert errors[1] < 0.85 * errors[0]


def test_v_falls_along_every_motion():
    fitted = TauSEDS(2, n_components=2, iterations=20, seed=0).fit(wavy_motion(2))
    y = 3 * torch.randn(200, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    energy, rate = torch.func.jvp(fitted.lyapunov, (y,), (fitted(y),))
    assert bool((rate < 0).all())
    assert bool((energy > 0).all())
