"""Diffeomorphisms as transforms of torch.distributions: what torch asks of one, and a density that is learned."""

from __future__ import annotations

import copy
import math
import pickle

import pytest
import torch
from torch.distributions import Independent, MultivariateNormal, Normal, TransformedDistribution

from baselines.couplings import AffineCouplings
from latentds import LocallyWeightedTranslations, as_transform
from latentds.kernels.dispatch import reference

F64 = torch.float64


def bent(dim, kind, size=0.7):
    draw = torch.Generator().manual_seed(0)
    psi = LocallyWeightedTranslations(dim, 6) if kind == "translations" else AffineCouplings(dim, 4, 10, generator=draw)
    with torch.no_grad():
        for parameter in psi.parameters():
            parameter.normal_(0, size if kind == "translations" else 0.1, generator=draw)
    return psi


@pytest.fixture(params=["translations", "couplings"])
def psi(request):
    return bent(3, request.param)


def standard(dim, *batch):
    return Independent(Normal(torch.zeros(*batch, dim, dtype=F64), 1.0), 1)


@pytest.mark.parametrize("batch", [(), (4,), (2, 3), (0,)])
@torch.no_grad()
def test_there_and_back_with_the_determinant_of_autograd(psi, batch, draw):
    transform, x = as_transform(psi), torch.randn(*batch, 3, generator=draw, dtype=F64)
    y = transform(x)
    assert y.shape == x.shape
    torch.testing.assert_close(transform.inv(y), x)
    log_det = transform.log_abs_det_jacobian(x, y)
    assert log_det.shape == batch
    torch.testing.assert_close(transform.inv.log_abs_det_jacobian(y, x), -log_det)
    rows = [torch.linalg.slogdet(torch.func.jacrev(transform)(row))[1] for row in x.reshape(-1, 3)]
    torch.testing.assert_close(log_det, torch.stack(rows).reshape(batch) if rows else log_det)


def test_what_torch_asks_of_a_transform(psi):
    transform = as_transform(psi)
    assert transform.domain.event_dim == transform.codomain.event_dim == transform.event_dim == 1
    assert transform.bijective
    assert transform.domain.check(torch.zeros(2, 3)).shape == (2,)
    assert transform.inv.inv is transform
    assert transform == as_transform(psi)
    assert transform != as_transform(bent(3, "translations"))
    assert transform.inv == as_transform(psi).inv
    assert transform.with_cache(0) is transform
    assert transform.with_cache(1) == transform
    assert transform.forward_shape((5, 3)) == transform.inverse_shape((5, 3)) == (5, 3)
    for twin in (copy.deepcopy(transform.with_cache()), pickle.loads(pickle.dumps(transform.with_cache()))):
        assert torch.equal(twin(torch.ones(3, dtype=F64)), transform(torch.ones(3, dtype=F64)))
        assert twin.psi is not psi


def test_a_density(psi, draw):
    """Against the change of variables written out, and against itself: the density of samples integrates to one."""
    flow = TransformedDistribution(standard(3), as_transform(psi))
    assert (flow.batch_shape, flow.event_shape) == ((), (3,))
    y = torch.randn(50, 3, generator=draw, dtype=F64)
    x = psi.inverse(y)
    wanted = standard(3).log_prob(x) - torch.linalg.slogdet(psi.jacobian(x))[1]
    torch.testing.assert_close(flow.log_prob(y), wanted)
    cover = MultivariateNormal(torch.zeros(3, dtype=F64), 9 * torch.eye(3, dtype=F64))
    with torch.random.fork_rng(devices=[]), torch.no_grad():
        torch.manual_seed(0)
        points = cover.sample((20_000,))
        total = (flow.log_prob(points) - cover.log_prob(points)).exp().mean()
        assert flow.rsample((5, 2)).shape == (5, 2, 3)
    assert float(total) == pytest.approx(1, abs=0.1)
    wide = TransformedDistribution(standard(3, 4), [as_transform(psi), as_transform(psi).inv])
    assert wide.batch_shape == (4,)
    torch.testing.assert_close(wide.log_prob(y[:4]), standard(3, 4).log_prob(y[:4]))


@pytest.mark.parametrize("cache_size", [0, 1])
def test_trains_a_density(cache_size, draw):
    """A crescent, whole batch after whole batch: the very tensors that a cache would know again."""
    angle = math.pi * torch.rand(300, 1, generator=draw, dtype=F64)
    shown = torch.cat([angle.cos(), angle.sin()], -1) + 0.1 * torch.randn(300, 2, generator=draw, dtype=F64)
    shown = (shown - shown.mean(0)) / shown.std(0)
    psi = bent(2, "translations", 0.1)
    flow = TransformedDistribution(standard(2), as_transform(psi, cache_size))
    optimiser = torch.optim.Adam(psi.parameters(), lr=0.03)
    losses = []
    for _ in range(120):
        optimiser.zero_grad()
        loss = -flow.log_prob(shown).mean()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    best = -MultivariateNormal(torch.zeros(2, dtype=F64), shown.T.cov()).log_prob(shown).mean()
    assert losses[-1] < float(best) - 0.2  # than any Gaussian
    assert len(set(losses)) == len(losses)


def test_a_cache_that_knows_when_the_map_has_changed(psi):
    transform, x = as_transform(psi, cache_size=1), torch.ones(3, dtype=F64)
    y = transform(x)
    assert transform(x) is y
    assert transform.inv(y) is x
    next(psi.parameters()).data.add_(0.1)
    assert not torch.equal(transform(x), y)
    assert transform.inv(y) is not x
    torch.testing.assert_close(torch.func.vmap(transform)(x.expand(2, 3))[0], transform(x))
    with reference():
        torch.testing.assert_close(transform(x), psi(x))


def test_refuses_what_it_cannot_transform(psi):
    with pytest.raises(ValueError, match="psi: expected a Diffeomorphism"):
        as_transform(torch.nn.Linear(3, 3))
    with pytest.raises(ValueError, match=r"shape: expected \(\.\.\., 3\), got \(2,\)"):
        TransformedDistribution(standard(2), as_transform(psi))
    with pytest.raises(ValueError, match=r"x: expected the diffeomorphism's torch.float64, got torch.float32"):
        as_transform(psi)(torch.zeros(3))
    with pytest.raises(ValueError, match="y: expected shape"):
        as_transform(psi).inv(torch.zeros(2, dtype=F64))
