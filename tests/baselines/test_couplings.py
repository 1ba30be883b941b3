"""Affine couplings: inverse, derivatives, determinant against autograd; the compiled sweep against the torch path."""

from __future__ import annotations

import copy
import os
import pickle
import subprocess
import sys

import pytest
import torch

from baselines.couplings import AffineCouplings
from latentds.kernels.dispatch import reference


def couplings(dim, n_layers=5, n_features=20, seed=0, strength=0.15):
    """Random, bent couplings, off centre and scaled."""
    draw = torch.Generator().manual_seed(seed)
    psi = AffineCouplings(dim, n_layers, n_features, generator=draw)
    torch.nn.init.normal_(psi.amplitudes, std=strength, generator=draw)
    psi.center.copy_(torch.randn(dim, generator=draw))
    psi.scale.copy_(torch.rand(dim, generator=draw) + 0.5)
    return psi


def points(*shape, seed=1):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("n_layers", [1, 2, 5])
@pytest.mark.parametrize("dim", [1, 2, 3, 7])
class TestAgainstAutograd:
    def test_inverse(self, dim, n_layers):
        psi, x = couplings(dim, n_layers), points(50, dim)
        torch.testing.assert_close(psi.inverse(psi(x)), x, rtol=0, atol=1e-11)
        torch.testing.assert_close(psi(psi.inverse(x)), x, rtol=0, atol=1e-11)

    def test_jacobian_and_its_determinant(self, dim, n_layers):
        psi, x = couplings(dim, n_layers), points(6, dim)
        oracle = torch.stack([torch.func.jacrev(psi)(row) for row in x])
        torch.testing.assert_close(psi.jacobian(x), oracle, rtol=1e-9, atol=1e-11)
        torch.testing.assert_close(psi.log_abs_det_jacobian(x), torch.linalg.slogdet(oracle).logabsdet)

    def test_linearize(self, dim, n_layers):
        psi, y, tangents = couplings(dim, n_layers), points(6, dim), points(3, 6, dim, seed=2)
        x, push = psi.linearize(y)
        torch.testing.assert_close(x, psi.inverse(y))
        oracle = torch.stack([torch.func.jvp(psi, (x,), (t,))[1] for t in tangents])
        torch.testing.assert_close(push(tangents), oracle)
        torch.testing.assert_close(push(tangents[0]), oracle[0])

    def test_compiled_sweep(self, dim, n_layers):
        psi = couplings(dim, n_layers, strength=0.03).float()
        exact = copy.deepcopy(psi).double()
        y, tangents, weights = points(30, dim), points(2, 30, dim, seed=2), points(3, 30, dim, seed=3)

        def outcome(module, linearize, dtype):
            given = y.to(dtype).requires_grad_()
            x, push = linearize(given)
            results = torch.cat([x.unsqueeze(0), push(tangents.to(dtype))])
            gradients = torch.autograd.grad((results * weights.to(dtype)).sum(), [given, *module.parameters()])
            return [results.detach(), *gradients]

        compiled = outcome(psi, psi.compiled_linearize(), torch.float32)
        for got, wanted in zip(compiled, outcome(exact, exact.linearize, torch.float64), strict=True):
            gap = 2e-5 * float(wanted.abs().max()) if wanted.numel() else 0
            torch.testing.assert_close(got.double(), wanted, rtol=0, atol=gap)


@pytest.mark.parametrize("n_features", [1, 7, 8, 21, 200])
@pytest.mark.parametrize("dim", [1, 2, 3, 7])
def test_kernels_compute_what_torch_does(dim, n_features):
    psi, y = couplings(dim, 4, n_features, strength=0.3 * n_features**-0.5), points(5, 40, dim)
    tangents = points(3, 5, 40, dim, seed=2)

    def outcome(psi):
        x, push = psi.linearize(y)
        return x, push(tangents), push(tangents[0]), psi.inverse(y), psi(y / y.abs().amax()), psi.jacobian(x[1])

    with torch.no_grad():
        by_kernel = outcome(psi)
        with reference():
            by_torch = outcome(psi)
        for got, wanted in zip(by_kernel, by_torch, strict=True):
            gap = (got - wanted).abs().amax(-1) / wanted.abs().amax(-1).clamp(min=1)
            assert float(gap.max()) < 1e-9
        assert bool(psi(torch.full((2, dim), torch.nan, dtype=torch.float64)).isnan().any())


def test_angles_that_a_polynomial_does_not_reach():
    psi, y = couplings(2, 1, 50), 1e8 * points(20, 2)
    with torch.no_grad():
        x = psi.inverse(y)
        with reference():
            torch.testing.assert_close(x, psi.inverse(y), rtol=1e-6, atol=0)


def test_kernels_compute_float32_in_float64_and_round():
    psi, x = couplings(3).float(), points(50, 3).float()
    exact = copy.deepcopy(psi).double()
    with torch.no_grad():
        torch.testing.assert_close(psi(x).double(), exact(x.double()), rtol=1e-7, atol=1e-7)


def test_parameters_of_another_size_are_not_read_by_kernels():
    psi, x = couplings(3), points(4, 3)
    psi.amplitudes = torch.nn.Parameter(psi.amplitudes.detach()[:-5])
    with torch.no_grad(), pytest.raises(RuntimeError):
        psi(x)


def test_gradcheck():
    psi, y = couplings(3, 3, 4), points(2, 3).requires_grad_()

    def velocity(y, amplitudes):
        x, push = torch.func.functional_call(_Linearized(psi), {"psi.amplitudes": amplitudes}, (y,))
        return push(-x)

    assert torch.autograd.gradcheck(velocity, (y, psi.amplitudes))
    assert torch.autograd.gradgradcheck(velocity, (y, psi.amplitudes))


class _Linearized(torch.nn.Module):
    def __init__(self, psi):
        super().__init__()
        self.psi = psi

    def forward(self, y):
        return self.psi.linearize(y)


def test_starts_as_the_identity():
    y = points(9, 4)
    psi = AffineCouplings(4, 6, 10)
    torch.testing.assert_close(psi(y), y)
    torch.testing.assert_close(psi.log_abs_det_jacobian(y), torch.zeros(9, dtype=torch.float64))


@pytest.mark.parametrize("shape", [(), (1,), (4, 3), (0,)])
def test_batches(shape):
    psi, x = couplings(3), points(*shape, 3)
    flat = x.reshape(-1, 3)
    for method in (psi, psi.inverse, psi.jacobian, psi.log_abs_det_jacobian):
        rows = torch.stack([method(row) for row in flat]) if len(flat) else method(flat)
        torch.testing.assert_close(method(x), rows.reshape((*shape, *rows.shape[1:])))


def test_vmap_and_export():
    psi, x = couplings(3), points(5, 3)
    torch.testing.assert_close(torch.func.vmap(psi)(x), psi(x))
    exported = torch.export.export(psi, (x,))
    torch.testing.assert_close(exported.module()(x), psi(x))


def test_every_amplitude_gets_a_gradient():
    psi, y = couplings(3), points(9, 3)
    x, push = psi.linearize(y)
    push(x).square().sum().backward()
    assert bool((psi.amplitudes.grad != 0).all())


def test_saves_loads_and_draws_from_its_generator_alone():
    psi, x = couplings(3), points(5, 3)
    other = AffineCouplings(3, 5, 20)
    other.load_state_dict(psi.state_dict())
    for same in (other, copy.deepcopy(psi), pickle.loads(pickle.dumps(psi))):
        assert torch.equal(same(x), psi(x))
    before = torch.get_rng_state()
    twins = [AffineCouplings(3, 2, 5, generator=torch.Generator().manual_seed(7)) for _ in range(2)]
    assert torch.equal(before, torch.get_rng_state())
    assert torch.equal(twins[0].frequencies, twins[1].frequencies)
    assert psi.float()(x.float()).dtype == torch.float32


@pytest.mark.parametrize(
    ("argument", "value"), [("dim", 0), ("n_layers", 0), ("n_features", 1.5), ("sigma", 0.0), ("sigma", "wide")]
)
def test_bad_arguments_are_named(argument, value):
    given = {"dim": 3, "n_layers": 2, "n_features": 5, argument: value}
    with pytest.raises(ValueError, match=f"^{argument}: expected"):
        AffineCouplings(**given)


GRADIENT = """
import torch
from baselines.coupling_kernels import Couplings

draw = torch.Generator().manual_seed(0)
frequencies = torch.randn(4 * 2 * 60 * 3 // 2, generator=draw)
phases = torch.rand(4, 2, 60, generator=draw)
amplitudes = (0.05 * torch.randn(4 * 2 * 60 * 3 // 2, generator=draw)).requires_grad_()
x, push = Couplings(frequencies, phases).linearize(torch.randn(50, 3, generator=draw), amplitudes)
(x.sum() + push(torch.ones(50, 3)).square().sum()).backward()
print(amplitudes.grad.numpy().tobytes().hex())
"""


@pytest.mark.slow
def test_kernels_just_compiled_and_kernels_from_disk_round_alike(tmp_path):
    """A fit is repeated to the bit in the next process, too."""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-c", GRADIENT]
    first, second = (
        subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout for _ in range(2)
    )
    assert len(first) > 1000
    assert first == second
