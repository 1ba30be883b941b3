"""CLF-DM: its Lyapunov function, the correction, and that it leaves alone what descends."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from baselines import CLFDM
from baselines.clfdm import ARRIVING_RADIUS, ARRIVING_RATE, DESCENT_RATE, AsymmetricQuadratics
from latentds import Demonstration
from latentds.testing import parametrize_stable_ds, wavy_motion

pytestmark = pytest.mark.slow  # fits and integrates for each clause; `make test` runs it

METHODS = {"CLFDM": lambda dim: CLFDM(dim, n_components=2, n_asymmetric=1, iterations=10, seed=0)}


@parametrize_stable_ds(METHODS, dims=[1, 2, 7], fitted=[True])
def test_contract(check):
    check()


@parametrize_stable_ds(METHODS, dims=[3], fitted=[False])
def test_contract_before_a_fit(check):
    check()


@pytest.fixture
def energy(draw):
    energy = AsymmetricQuadratics(3, 2)
    with torch.no_grad():
        for parameter in energy.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=draw, dtype=torch.float64))
    return energy


def test_v_is_the_papers_and_its_gradient_is_right(energy, draw):
    z = torch.randn(40, 3, generator=draw, dtype=torch.float64)
    forms = [np.array((root @ root.mT).tolist()) for root in energy.roots]
    quadratic = np.array((energy.root @ energy.root.mT).tolist()) + 0.01 * np.eye(3)
    for point in z.numpy()[:5]:
        centers = np.array(energy.centers.tolist())
        values = [point @ form @ (point - center) for form, center in zip(forms, centers, strict=True)]
        wanted = point @ quadratic @ point + sum(max(0, value) ** 2 for value in values)
        assert energy(torch.from_numpy(point)).item() == pytest.approx(wanted)
    point = z.clone().requires_grad_()
    (slope,) = torch.autograd.grad(energy(point).sum(), point)
    torch.testing.assert_close(energy.gradient(z), slope)
    assert bool(((energy.gradient(z) * z).sum(-1) > 0).all())


@torch.no_grad()
def test_v_falls_at_its_rate_from_everywhere(draw):
    ds = CLFDM(2, n_components=3, iterations=30, seed=0).fit(wavy_motion(2))
    y = ds.attractor + 10 ** torch.linspace(-6, 2, 400).unsqueeze(-1) * torch.randn(400, 2, generator=draw).double()
    energy, falling = torch.func.jvp(ds.lyapunov, (y,), (ds(y),))
    assert float((falling / energy).max()) <= -DESCENT_RATE / float(ds.duration) * (1 - 1e-6)


@torch.no_grad()
def test_the_correction_is_the_least_that_does():
    ds = CLFDM(2, n_components=3, iterations=30, seed=0).fit(wavy_motion(2))
    grid = torch.cartesian_prod(*[torch.linspace(-1, 1, 21, dtype=torch.float64)] * 2)
    z = grid[grid.norm(dim=-1) > 10 * ARRIVING_RADIUS]
    slope, energy = ds.energy.gradient(z), ds.energy(z)
    wish = ds.regression(z)
    speed = wish.norm(dim=-1, keepdim=True)
    wish = wish * (1 + (speed / (2 * ds.pace)) ** 8) ** -0.125
    change = ds.normalized_velocity(z) - wish
    descends = (slope * wish).sum(-1) <= -DESCENT_RATE * energy
    assert 0.1 < float(descends.double().mean()) < 0.9
    assert float(change[descends].abs().max()) < 1e-12
    along = (change * slope).sum(-1) / slope.norm(dim=-1)
    torch.testing.assert_close(along[~descends].abs(), change[~descends].norm(dim=-1))
    corrected = (slope * ds.normalized_velocity(z)).sum(-1)[~descends]
    torch.testing.assert_close(corrected, -DESCENT_RATE * energy[~descends])


def test_v_stays_as_steep_as_it_began_and_motions_arrive():
    """Directions that no V has leave its steepness open: without a weight it grew a hundred thousandfold."""
    shown = Demonstration(there_and_back(), 0.01)
    ds = CLFDM(2, n_components=3, seed=0).fit(shown)
    assert max(float(part.detach().abs().max()) for part in ds.energy.parameters()) < 100
    with torch.no_grad():
        left = ds.rollout(shown.start, torch.tensor([0.0, 3 * shown.duration]))[-1] - shown.goal
        u = 1e-4 * torch.tensor([[1.0, 0.0], [0.0, 1.0]], dtype=torch.float64)
        pulled = ds.normalized_velocity(u)
    assert float(left.norm()) < 0.02 * shown.size
    assert bool(((pulled * u).sum(-1) < -ARRIVING_RATE / 2 * u.square().sum(-1)).all())


def test_it_tells_where_demonstrations_rise():
    shown = Demonstration(there_and_back(), 0.01)
    plain = CLFDM(2, n_components=3, n_asymmetric=0, iterations=1, seed=0).fit(shown)
    assert any("V rises along" in note for note in plain.fit_report.notes)
    assert float(plain(shown.goal).detach().abs().max()) == 0


def there_and_back():
    s = torch.linspace(0, 1, 200, dtype=torch.float64)
    return torch.stack([torch.sin(4 * s), 0.1 * s], dim=-1)
