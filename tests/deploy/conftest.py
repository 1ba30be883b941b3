"""Systems with every law and form of dynamics of the package, with layers as a fit leaves them."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from latentds import LatentDS, LocallyWeightedTranslations
from latentds.dynamics import RayDynamics, TubeDynamics
from latentds.time_law import ChebyshevLaw, KnottedLaw

DYNAMICS = {
    "ray, eigenmap": lambda: RayDynamics(ChebyshevLaw(2.0)),
    "ray, uniform": lambda: RayDynamics(KnottedLaw.uniform(2.0)),
    "tube, demonstrated": lambda: TubeDynamics(demonstrated(), KnottedLaw(torch.ones(1), torch.ones(1))),
    "tube, eigenmap": lambda: TubeDynamics(ChebyshevLaw(0.5), demonstrated()),
}


def demonstrated():
    return KnottedLaw(torch.tensor([0.1, 0.4, 0.7, 1.0]), torch.tensor([0.2, 0.5, 0.3, 1.0]))


class Field(LatentDS):
    """Wide and strong layers, narrow and weak ones, and an attractor off the origin."""

    def __init__(self, dim, dynamics="tube, demonstrated", n_layers=30):
        super().__init__(dim, LocallyWeightedTranslations(dim, n_layers), DYNAMICS[dynamics]())
        draw = torch.Generator().manual_seed(dim)
        with torch.no_grad():
            psi = self.diffeomorphism
            psi.centers.normal_(generator=draw)
            psi.log_widths.copy_(torch.linspace(-1, 3, n_layers))
            psi.strengths.normal_(0, 0.3, generator=draw)
            self.attractor.normal_(generator=draw)
            self.start.copy_(self.attractor + 1)

    def _learn(self, shown, progress):
        raise NotImplementedError


@pytest.fixture
def make_field():
    return Field


@pytest.fixture(params=DYNAMICS)
def dynamics(request):
    return request.param


@pytest.fixture
def positions(draw):
    """Of a field: near its attractor, at it, and far away; the field's speed at the first half is its largest."""

    def of(ds, count=60):
        spread = torch.cat([torch.ones(count // 2), torch.logspace(-9, 3, count - count // 2 - 1), torch.zeros(1)])
        points = torch.randn(count, ds.dim, generator=draw, dtype=torch.float64) * spread.unsqueeze(-1)
        return (ds.attractor.to(points) + points).to(ds.attractor)

    return of


@pytest.fixture
def assert_same_velocity():
    """Equal up to a share of the largest speed."""

    def check(velocities, ds, points, limit):
        with torch.no_grad():
            expected = ds(points)
        assert velocities.shape == expected.shape
        assert torch.isfinite(expected).all()
        error = (torch.as_tensor(velocities, dtype=torch.float64) - expected.double()).abs().max()
        assert error <= limit * torch.linalg.vector_norm(expected.double(), dim=-1).max()

    return check


@pytest.fixture
def assert_spoils_its_row_alone(positions):
    """A position that is not finite has a velocity of NaN and changes no other, not by a bit."""

    def check(run, ds, dtype=torch.float64):
        points = positions(ds).to(dtype)
        expected = run(ds, points)
        spoiled = {4: np.nan, 7: np.inf, 12: -np.inf}
        for row, bad in spoiled.items():
            points[row, row % ds.dim] = bad
        velocities = run(ds, points)
        assert np.isnan(velocities[list(spoiled)]).all()
        assert np.array_equal(np.delete(velocities, list(spoiled), 0), np.delete(expected, list(spoiled), 0))

    return check
