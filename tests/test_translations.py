"""Locally weighted translations against a plain loop, a scalar root finder and autograd."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.optimize import brentq

from baselines.couplings import AffineCouplings
from latentds import LocallyWeightedTranslations, translations
from latentds.translations import WIDTH_BOUND


def random_psi(dim, n_layers=12, strength=1.0, seed=3):
    """``strength`` is ‖a‖'s scale: 1 asks for about 0.7 of the invertibility bound, 10 for 0.995."""
    draw = torch.Generator().manual_seed(seed)
    psi = LocallyWeightedTranslations(dim, n_layers)
    with torch.no_grad():
        psi.centers.normal_(generator=draw)
        psi.log_widths.normal_(0, 0.5, generator=draw)
        psi.strengths.normal_(generator=draw)
        psi.strengths.mul_(strength / psi.strengths.norm(dim=-1, keepdim=True))
    return psi


def plain(psi):
    """(c, v, ρ) of every layer as NumPy arrays."""
    return zip(*(part.detach().numpy() for part in (psi.centers, psi.directions, psi.widths)), strict=True)


def numpy_forward(psi, x):
    for c, v, rho in plain(psi):
        x = x + np.exp(-(rho**2) * ((x - c) ** 2).sum(-1, keepdims=True)) * v
    return x


def numpy_inverse(psi, y):
    for c, v, rho in reversed(list(plain(psi))):
        s = brentq(
            lambda s, y=y, c=c, v=v, rho=rho: s - math.exp(-(rho**2) * ((y - s * v - c) ** 2).sum()), 0, 1, xtol=1e-15
        )
        y = y - s * v
    return y


@pytest.fixture(params=[1, 2, 3, 7])
def dim(request):
    return request.param


@pytest.fixture
def points(dim, draw):
    return 1.5 * torch.randn(9, dim, generator=draw, dtype=torch.float64)


@pytest.mark.parametrize("strength", [0.3, 3.0, 30.0])
@torch.no_grad()
def test_forward_and_inverse_match_a_plain_loop(dim, points, strength):
    psi = random_psi(dim, strength=strength)
    expected = numpy_forward(psi, points.numpy())
    np.testing.assert_allclose(psi(points), expected, rtol=1e-12, atol=1e-12)
    y = torch.from_numpy(expected)
    x = psi.inverse(y).numpy()
    np.testing.assert_allclose(numpy_forward(psi, x), expected, rtol=1e-11, atol=1e-11)
    if strength < 10:
        np.testing.assert_allclose(x, [numpy_inverse(psi, row) for row in expected], rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(x, points, rtol=1e-8, atol=1e-8)


def test_jacobian_determinant_and_tangent_match_autograd(dim, points):
    psi = random_psi(dim)
    wanted = torch.stack([torch.autograd.functional.jacobian(psi, row) for row in points])
    with torch.no_grad():
        jacobian = psi.jacobian(points)
        torch.testing.assert_close(jacobian, wanted, rtol=1e-10, atol=1e-12)
        sign, log_size = torch.linalg.slogdet(jacobian)
        assert (sign > 0).all()
        torch.testing.assert_close(psi.log_abs_det_jacobian(points), log_size, rtol=1e-9, atol=1e-10)
        x, push = psi.linearize(psi(points))
        torch.testing.assert_close(x, points, rtol=1e-9, atol=1e-10)
        tangent = points.roll(1, 0)
        torch.testing.assert_close(push(tangent), (wanted @ tangent.unsqueeze(-1)).squeeze(-1), rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("method", ["forward", "inverse", "jacobian", "log_abs_det_jacobian"])
def test_gradients_to_input_and_parameters(method, draw):
    psi = random_psi(2, 3)
    y = torch.randn(2, 2, generator=draw, dtype=torch.float64, requires_grad=True)
    names, values = zip(*psi.named_parameters(), strict=True)

    def call(y, *parameters):
        state = dict(zip(names, parameters, strict=True))
        with torch.nn.utils.stateless._reparametrize_module(psi, state):
            return getattr(psi, method)(y)

    assert torch.autograd.gradcheck(call, (y, *values))
    assert torch.autograd.gradgradcheck(call, (y, *values))


def test_functional_transforms(points, dim):
    psi = random_psi(dim, 5)
    y = psi(points).detach()
    for call in (psi, psi.inverse):
        at = y if call == psi.inverse else points
        reverse = torch.stack([torch.func.jacrev(call)(row) for row in at])
        forward = torch.stack([torch.func.jacfwd(call)(row) for row in at])
        torch.testing.assert_close(forward, reverse, rtol=1e-9, atol=1e-10)
        torch.testing.assert_close(torch.func.vmap(torch.func.jacfwd(call))(at), reverse, rtol=1e-9, atol=1e-10)
        torch.testing.assert_close(torch.func.vmap(call)(at), call(at), rtol=1e-12, atol=1e-12)
        tangent = at.roll(1, 0)
        value, pushed = torch.func.jvp(call, (at,), (tangent,))
        torch.testing.assert_close(value, call(at), rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(pushed, (reverse @ tangent.unsqueeze(-1)).squeeze(-1), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("early", [True, False])
def test_eight_steps_find_every_root(dtype, early, monkeypatch):
    """With t = √(2a)(s - b/a) the equation is t + τ = κ exp(-t²/2), κ = √(2a) exp(-p): all of κ < √e and of τ.

    Where a reaches the bound e/2, p is 0 and τ is 2, the root is threefold.
    """
    if not early:
        monkeypatch.setattr(translations, "_everywhere", lambda done: False)
    eps = torch.finfo(dtype).eps
    a = math.e / 2 * torch.cat([1 - torch.logspace(-17, -0.1, 30, dtype=torch.float64), torch.logspace(-40, -1, 5)])
    p = torch.cat([torch.zeros(1), torch.logspace(-17, 2, 60, dtype=torch.float64)])
    beside = torch.logspace(-16, 0.5, 100, dtype=torch.float64)
    tau = torch.cat([torch.linspace(-30, 30, 601), 2 + beside, 2 - beside, torch.tensor([-1e6, 1e6])])
    a, p, tau = torch.meshgrid(a.double(), p.double(), tau.double(), indexing="ij")
    s0 = tau / (2 * a).sqrt()
    a, b, c = (part.to(dtype) for part in (a, a * s0, p + a * s0.square()))
    s = translations._solve(a, b, c)
    a, b, c, s = (part.numpy().astype(np.longdouble) for part in (a, b, c, s))
    with np.errstate(over="ignore", invalid="ignore"):
        k = np.exp(np.minimum(s * (2 * b - a * s) - c, 0))
    assert ((s >= 0) & (s <= 1)).all()
    assert np.abs(s - k).max() <= 20 * eps


def test_bound_holds_by_parametrisation(dim):
    """Whatever an optimiser does to the free parameters, ρ‖v‖√(2/e) < 1 and the margin stays above 0."""
    for strength in (0.0, 1e-3, 1.0, 1e3, 1e6):
        psi = random_psi(dim, strength=max(strength, 1e-9))
        with torch.no_grad():
            bound = psi.widths * psi.directions.norm(dim=-1) / WIDTH_BOUND
            assert (psi.margins > 0).all()
            torch.testing.assert_close(psi.margins, 1 - bound, rtol=1e-9, atol=1e-12)


def test_margin_is_the_smallest_slope_of_a_layer():
    psi = random_psi(1, 1, strength=5.0)
    with torch.no_grad():
        x = psi.centers[0] + torch.linspace(-3, 3, 200_001, dtype=torch.float64).unsqueeze(-1) / psi.widths
        slope = psi.jacobian(x).squeeze()
    assert slope.min() >= psi.margins.item() - 1e-12
    assert slope.min().item() == pytest.approx(psi.margins.item(), rel=1e-6)


def test_identity_at_first(dim, points):
    psi = LocallyWeightedTranslations(dim, 4)
    assert torch.equal(psi(points), points)
    assert torch.equal(psi.inverse(points), points)
    assert torch.equal(psi.jacobian(points), torch.eye(dim, dtype=torch.float64).expand(len(points), dim, dim))


def test_assign_takes_layers_and_leaves_the_rest_alone(dim, points, draw):
    source = random_psi(dim, 3)
    psi = random_psi(dim, 8, seed=5)
    psi.assign(source.centers.detach(), source.directions.detach(), source.widths.detach())
    torch.testing.assert_close(psi(points), source(points), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("count", "factor", "width"), [(3, 1.0, 1.0), (1, 1.001, 1.0), (1, math.nan, 1.0), (1, 0.5, 0.0), (1, 0.5, -1.0)]
)
def test_assign_refuses_layers_that_are_not_invertible(count, factor, width):
    psi = LocallyWeightedTranslations(1, 2)
    v = torch.full((count, 1), factor * WIDTH_BOUND)
    with pytest.raises(ValueError, match="layers: expected at most 2 with widths > 0"):
        psi.assign(torch.zeros(count, 1), v, torch.full((count,), width))
    assert (psi.strengths == 0).all()


def test_inverse_on_hard_layers(draw):
    """Near the invertibility bound Newton's method alone would fail on 3-4 % of these."""
    for mu in (0.5, 0.9, 0.99, 0.9999):
        strength = mu / math.sqrt(1 - mu**2)
        psi = random_psi(3, 1, strength=strength)
        x = psi.centers + 2 * torch.randn(20_000, 3, generator=draw, dtype=torch.float64)
        with torch.no_grad():
            y = psi(x)
            assert (psi(psi.inverse(y)) - y).abs().max() < 1e-12


def test_shapes(dim):
    psi = random_psi(dim)
    for shape in ((), (1,), (5,), (2, 3), (0,)):
        x = torch.zeros(*shape, dim, dtype=torch.float64)
        assert psi(x).shape == psi.inverse(x).shape == (*shape, dim)
        assert psi.jacobian(x).shape == (*shape, dim, dim)
        assert psi.log_abs_det_jacobian(x).shape == shape


@pytest.mark.parametrize("value", [0, -1, 2.5, True, "3", None])
def test_bad_sizes(value):
    with pytest.raises(ValueError, match="dim: expected a whole number >= 1"):
        LocallyWeightedTranslations(value, 5)
    with pytest.raises(ValueError, match="n_layers: expected a whole number >= 1"):
        LocallyWeightedTranslations(2, value)


@pytest.mark.parametrize("psi", [LocallyWeightedTranslations(3, 5), AffineCouplings(3, 2, 10)], ids=["LWT", "AC"])
@pytest.mark.parametrize("call", ["forward", "inverse", "linearize", "jacobian", "log_abs_det_jacobian"])
@pytest.mark.parametrize("shape", [(4, 2), (4, 1), (4,), (3, 4), ()])
@pytest.mark.parametrize("traced", [False, True])
def test_points_of_another_dimension_are_refused(psi, call, shape, traced):
    points = torch.zeros(shape, dtype=torch.float64, requires_grad=traced)
    with pytest.raises(ValueError, match=r"[xy]: expected shape \(\.\.\., 3\), got "), torch.set_grad_enabled(traced):
        getattr(psi, call)(points)


def test_a_table_is_of_the_map_itself_and_of_no_subclass():
    """One whose layers are made in another way must not be compiled as if they were made in this one."""
    psi = random_psi(2, 3)
    assert psi.table().shape == (3, 6)
    assert AffineCouplings(2, 2, 10).table() is None
    assert type("Other", (LocallyWeightedTranslations,), {})(2, 3).table() is None
    torch.nn.utils.parametrize.register_parametrization(psi, "centers", torch.nn.Identity())
    assert psi.table() is None
