"""The compiled path against the torch path: equal to rounding where it serves, and absent where it would be wrong."""

from __future__ import annotations

import copy
import io
import math
import multiprocessing
import os
import pickle
import shutil
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest
import torch
import torch.autograd.forward_ad as forward_ad
from torch._subclasses.fake_tensor import FakeTensorMode

from latentds import ChebyshevDS, LocallyWeightedTranslations, datasets, warmup
from latentds.kernels import compiling, dispatch, lanes, translations
from latentds.translations import WIDTH_BOUND

OPERATIONS = ("forward", "inverse", "jacobian")


def random_map(dim, n_layers=40, dtype=torch.float64, seed=0):
    """Layers as a fit leaves them: wide and strong ones, narrow and weak ones."""
    draw = torch.Generator().manual_seed(seed)
    psi = LocallyWeightedTranslations(dim, n_layers)
    with torch.no_grad():
        psi.centers.copy_(torch.randn(n_layers, dim, generator=draw))
        psi.log_widths.copy_(torch.linspace(-1, 3, n_layers))
        psi.strengths.copy_(0.3 * torch.randn(n_layers, dim, generator=draw))
    return psi.to(dtype)


def random_points(*shape, dtype=torch.float64, seed=1):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


def both(function):
    """The value by the kernels and by torch."""
    with torch.no_grad():
        fast = function()
        with dispatch.reference():
            return fast, function()


def assert_equal(fast, slow, dtype=torch.float64):
    assert fast.shape == slow.shape
    assert fast.dtype == slow.dtype == dtype
    if slow.numel():
        limit = {torch.float64: 1e-12, torch.float32: 1e-5}[dtype]
        assert (fast - slow).abs().max() <= limit * slow.abs().max()


@pytest.mark.parametrize("operation", OPERATIONS)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("dim", [1, 2, 3, 7])
def test_both_paths_agree(operation, dtype, dim):
    psi, points = random_map(dim, dtype=dtype), random_points(1100, dim, dtype=dtype)
    assert translations.can_use_kernel(psi, points)
    assert_equal(*both(lambda: getattr(psi, operation)(points)), dtype)


@pytest.mark.parametrize("dim", [1, 3])
def test_tangents_agree(dim):
    psi, points, tangents = random_map(dim), random_points(1100, dim), random_points(1100, dim, seed=2)

    def linearized():
        x, push = psi.linearize(points)
        return torch.stack([x, push(tangents), push(torch.ones(dim, dtype=torch.float64))])

    fast, slow = both(linearized)
    for one, other in zip(fast, slow, strict=True):
        assert_equal(one, other)


@pytest.mark.parametrize("operation", OPERATIONS)
@pytest.mark.parametrize(
    "points",
    [
        random_points(3),
        random_points(0, 3),
        random_points(2, 0, 3),
        random_points(1, 3),
        random_points(9, 3),
        random_points(1029, 3),
        random_points(4, 1, 5, 3),
        random_points(3, 20).T,
        random_points(20, 6)[::2, ::2],
        random_points(1, 3).expand(6, 3),
    ],
    ids=lambda points: f"{tuple(points.shape)}, strides {points.stride()}",
)
def test_any_shape_and_stride(operation, points):
    psi = random_map(3)
    before = points.clone()
    fast, slow = both(lambda: getattr(psi, operation)(points))
    assert_equal(fast, slow)
    assert fast.is_contiguous()
    assert torch.equal(points, before)


def test_a_point_gets_the_same_answer_alone_and_in_a_crowd():
    psi, points = random_map(3), random_points(200, 3)
    with torch.no_grad():
        alone = torch.stack([psi.inverse(point) for point in points])
        assert_equal(alone, psi.inverse(points))


def test_exponential():
    x = np.concatenate([np.linspace(-649, 0, 5001), -np.geomspace(1e-300, 1, 200)])
    value = np.array([lanes.exp(float(v)) for v in x])
    assert np.abs(value / np.exp(x) - 1).max() < 2e-13  # |x| times the rounding of ln 2: weights below e^-60 do not act
    near = x > -2
    assert np.abs(value / np.exp(x) - 1)[near].max() < 6e-16
    assert all(lanes.exp(v) == 0.0 for v in (-650.5, -746.0, -1e6, -1e300, -math.inf))


@pytest.mark.parametrize("operation", OPERATIONS)
def test_bad_rows_stay_alone(operation):
    psi, points = random_map(3), random_points(50, 3)
    with torch.no_grad():
        clean = getattr(psi, operation)(points)
        points[7, 1] = math.nan
        points[20] = torch.tensor([math.inf, 0.0, -math.inf])
        value = getattr(psi, operation)(points)
    good = torch.ones(50, dtype=torch.bool)
    good[[7, 20]] = False
    assert torch.equal(value[good], clean[good])
    assert value[7].isnan().all()
    if operation != "jacobian":  # far from every layer nothing moves
        assert torch.equal(value[20], points[20])


@pytest.mark.parametrize("dim", [2, 3, 7])
def test_inverse_never_fails(dim):
    """35 000 layers a dimension up to a 1e-4 part from losing invertibility, at their centre, edge and surroundings."""
    count, rng = 35_000, np.random.default_rng(dim)
    mu = 1 - 10.0 ** rng.uniform(-4, 0, count)
    widths = 10.0 ** rng.uniform(-3, 3, count)
    direction = rng.standard_normal((count, dim))
    direction *= (mu * WIDTH_BOUND / widths / np.linalg.norm(direction, axis=1))[:, None]
    center = rng.standard_normal((count, dim))
    layers = np.column_stack([center, direction, widths**2, (mu * WIDTH_BOUND) ** 2])
    # the hardest points lie along v, where the slope of the layer falls to 1 - μ
    along = rng.uniform(-1, 2, (count, 9, 1)) * direction[:, None]
    points = center[:, None] + along + 0.3 * rng.standard_normal((count, 9, dim)) / widths[:, None, None]
    points[:, 0], points[:, 1] = center, center + direction
    crowd, alone = np.empty((9, dim)), np.empty((1, dim))
    kernel = translations.inverse_kernel(dim)
    for j in range(count):
        y, layer = points[j], layers[j : j + 1]
        kernel(layer, y, crowd)
        kernel(layer, y[:1], alone)
        for x, target in ((crowd, y), (alone, y[:1])):
            w = x - center[j]
            back = x + np.exp(-layer[0, 2 * dim] * (w * w).sum(1))[:, None] * direction[j]
            assert np.abs(back - target).max() <= 1e-14 * (np.abs(target).max() + np.abs(direction[j]).max())


# --- derivatives ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("operation", OPERATIONS)
def test_gradients_of_parameters_are_those_of_the_torch_path(operation):
    psi, points = random_map(2, 6), random_points(5, 2)
    parameters = tuple(psi.parameters())

    def gradients():
        value = getattr(psi, operation)(points)
        first = torch.autograd.grad(value.square().sum(), parameters, create_graph=True)
        second = torch.autograd.grad(sum(g.square().sum() for g in first), parameters)
        return value, *first, *second

    assert translations.can_use_kernel(psi, points)
    fast = gradients()
    assert "Compiled" in type(fast[0].grad_fn).__name__
    with dispatch.reference():
        slow = gradients()
    for one, other in zip(fast, slow, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-11)


CALLS = {
    **{name: lambda psi, x, t, name=name: getattr(psi, name)(x) for name in OPERATIONS},
    "push": lambda psi, x, t: psi.linearize(x)[1](t),
    "push of one": lambda psi, x, t: psi.linearize(x)[1](t[0]),
    "push at one": lambda psi, x, t: psi.linearize(x[0])[1](t),
}


def first_gradients(call, psi, x, t):
    """Of a loss that weighs every entry differently, by points, tangents and parameters."""
    asked = [tensor for tensor in (x, t, *psi.parameters()) if tensor.requires_grad]
    value = call(psi, x, t)
    weights = torch.linspace(-1, 1, value.numel(), dtype=value.dtype).reshape(value.shape)
    return torch.autograd.grad((weights * value.sin()).sum(), asked, allow_unused=True)


@pytest.mark.parametrize("call", CALLS)
@pytest.mark.parametrize(
    "dim", [1, pytest.param(2, marks=pytest.mark.slow), 3, pytest.param(7, marks=pytest.mark.slow)]
)
def test_adjoint_kernels_give_the_gradients_of_the_torch_path(call, dim):
    psi, x, t = random_map(dim), random_points(77, dim), random_points(77, dim, seed=2)
    for learned, moved in ((True, True), (True, False), (False, True)):
        psi.requires_grad_(learned)
        x.requires_grad_(moved)
        t.requires_grad_(moved)
        fast = first_gradients(CALLS[call], psi, x, t)
        with dispatch.reference():
            slow = first_gradients(CALLS[call], psi, x, t)
        for one, other in zip(fast, slow, strict=True):
            assert (one is None) == (other is None)
            if other is not None:
                assert_equal(one, other)


def test_adjoint_kernels_serve_float32_cores_and_batches_of_none(monkeypatch):
    psi, x = random_map(3, dtype=torch.float32), random_points(2, 700, 3, dtype=torch.float32).requires_grad_()
    alone = first_gradients(CALLS["inverse"], psi, x, x)
    with dispatch.reference():
        slow = first_gradients(CALLS["inverse"], psi, x, x)
    for one, other in zip(alone, slow, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-3)  # the torch path computes in float32
    monkeypatch.setattr(dispatch, "PARALLEL_THRESHOLD", 1)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    monkeypatch.setattr(dispatch, "_available_cores", lambda: 2)
    shared = [first_gradients(CALLS["inverse"], psi, x, x) for _ in range(5)]
    for gradients in shared:
        assert all(torch.equal(one, other) for one, other in zip(gradients, alone, strict=True))
    nobody, nothing = torch.zeros(0, 3).requires_grad_(), torch.zeros(0, 3)
    for gradients in first_gradients(CALLS["inverse"], psi, nobody, nothing):
        assert not gradients.any()


def test_what_is_not_a_number_spoils_the_gradients_on_both_paths():
    psi, x = random_map(2), random_points(9, 2)
    x[3, 1] = math.nan
    for call in ("forward", "inverse", "jacobian"):
        fast = first_gradients(CALLS[call], psi, x, x)
        with dispatch.reference():
            slow = first_gradients(CALLS[call], psi, x, x)
        assert all(g.isnan().all() for g in (*fast, *slow))


@pytest.mark.parametrize("call", ["forward", "inverse", "jacobian", "push"])
def test_gradients_of_gradients(call):
    psi, x, t = random_map(2, 6), random_points(3, 2).requires_grad_(), random_points(3, 2, seed=2).requires_grad_()

    def function(x, t, *parameters):
        return torch.func.functional_call(Calls(psi, call), dict(zip(names, parameters, strict=True)), (x, t))

    names = [f"psi.{name}" for name, _ in psi.named_parameters()]
    leaves = [p.detach().requires_grad_() for p in psi.parameters()]
    assert torch.autograd.gradgradcheck(function, (x, t, *leaves))


class Calls(torch.nn.Module):
    def __init__(self, psi, call):
        super().__init__()
        self.psi, self.call = psi, CALLS[call]

    def forward(self, x, t):
        return self.call(self.psi, x, t)


def test_gradients_that_are_not_plain_take_the_torch_path():
    psi, x = random_map(2, 6), random_points(4, 2).requires_grad_()
    value = psi(x)
    rows = torch.eye(value.numel(), dtype=torch.float64).reshape(-1, *value.shape)
    (batched,) = torch.autograd.grad(value, x, rows, is_grads_batched=True)
    with torch.no_grad():
        jacobians = psi.jacobian(x)
    for i in range(4):
        torch.testing.assert_close(batched[2 * i : 2 * i + 2, i], jacobians[i])


def test_gradients_through_the_velocity():
    ds = ChebyshevDS(2, n_layers=10).fit(datasets.archimedean_spiral(50))
    points, parameters = 0.05 * random_points(5, 2), tuple(ds.parameters())
    fast = torch.autograd.grad(ds(points).square().sum(), parameters)
    with dispatch.reference():
        slow = torch.autograd.grad(ds(points).square().sum(), parameters)
    for one, other in zip(fast, slow, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-8, atol=1e-12)


def test_gradients_reach_parameters_that_were_swapped_in():
    psi, other, points = random_map(2, 6), random_map(2, 6, seed=3), random_points(5, 2)
    swapped = {name: torch.nn.Parameter(value.detach()) for name, value in other.named_parameters()}
    value = torch.func.functional_call(psi, swapped, (points,))
    gradients = torch.autograd.grad(value.sum(), list(swapped.values()))
    with dispatch.reference():
        expected = torch.autograd.grad(other(points).sum(), list(other.parameters()))
    for one, wanted in zip(gradients, expected, strict=True):
        torch.testing.assert_close(one, wanted)


@pytest.mark.parametrize("operation", ["forward", "inverse"])
def test_input_gradients_and_function_transforms(operation):
    psi, points, tangents = random_map(2, 6), random_points(4, 2), random_points(4, 2, seed=2)
    function = getattr(psi, operation)
    with torch.no_grad():
        expected = psi.jacobian(points if operation == "forward" else psi.inverse(points))
        expected = expected if operation == "forward" else torch.linalg.inv(expected)
    assert torch.autograd.gradcheck(function, points.clone().requires_grad_())
    pushed = torch.einsum("bij,bj->bi", expected, tangents)
    for parameters_learn in (True, False):
        psi.requires_grad_(parameters_learn)
        torch.testing.assert_close(torch.vmap(torch.func.jacrev(function))(points), expected)
        torch.testing.assert_close(torch.vmap(torch.func.jacfwd(function))(points), expected)
        torch.testing.assert_close(torch.func.jvp(function, (points,), (tangents,))[1], pushed)
        with forward_ad.dual_level():
            dual = function(forward_ad.make_dual(points, tangents))
            torch.testing.assert_close(forward_ad.unpack_dual(dual).tangent, pushed)


def test_transforms_of_a_tangent_map_made_outside_them():
    psi, points, tangents = random_map(2, 6), random_points(4, 2), random_points(3, 4, 2, seed=2)
    with torch.no_grad():
        _, push = psi.linearize(points)
        expected = torch.stack([push(t) for t in tangents])
        torch.testing.assert_close(torch.vmap(push)(tangents), expected)
        torch.testing.assert_close(torch.func.jvp(push, (tangents[0],), (tangents[1],))[1], expected[1])


def test_the_rule():
    psi, points = random_map(2), random_points(3, 2)
    assert translations.can_use_kernel(psi, points)
    assert not translations.can_use_kernel(psi, points.float())
    assert not translations.can_use_kernel(psi, points.to("meta"))
    assert not translations.can_use_kernel(psi, points.half())
    assert not translations.can_use_kernel(psi, points.as_subclass(type("Marked", (torch.Tensor,), {})))
    asked = points.clone().requires_grad_()
    assert translations.can_use_kernel(psi, asked)
    assert psi(asked).requires_grad
    with dispatch.reference():
        assert not translations.can_use_kernel(psi, points)
    with FakeTensorMode():
        assert not translations.can_use_kernel(psi, points)
    with forward_ad.dual_level():
        assert not translations.can_use_kernel(psi, points)
    torch.nn.utils.parametrize.register_parametrization(psi, "centers", torch.nn.Identity())
    assert not translations.can_use_kernel(psi, points)


def test_traced_and_exported_programs_hold_torch_operations():
    psi, points, other = random_map(2, 4).requires_grad_(False), random_points(3, 2), random_points(3, 2, seed=5)
    traced = torch.fx.experimental.proxy_tensor.make_fx(lambda x: psi(x))(points)
    exported = torch.export.export(psi, (points,)).module()
    for program in (traced, exported):
        torch.testing.assert_close(program(other), psi(other))


# --- state ------------------------------------------------------------------------------------------------------------


def changed_by_optimizer(psi):
    optimizer = torch.optim.SGD(psi.parameters(), lr=0.1)
    psi(random_points(4, 2)).square().sum().backward()
    optimizer.step()


def changed_by_data(psi):
    psi.centers.data.mul_(1.5)


def changed_by_loading(psi):
    psi.load_state_dict(random_map(2, seed=9).state_dict())


@pytest.mark.parametrize("change", [changed_by_optimizer, changed_by_data, changed_by_loading])
def test_never_stale(change):
    psi, points = random_map(2), random_points(20, 2)
    before, _ = both(lambda: psi.inverse(points))
    change(psi)
    fast, slow = both(lambda: psi.inverse(points))
    assert_equal(fast, slow)
    assert not torch.equal(fast, before)


@pytest.mark.parametrize(
    "copied",
    [copy.deepcopy, lambda psi: pickle.loads(pickle.dumps(psi)), lambda psi: psi.float().double()],
    ids=["deepcopy", "pickle", "to"],
)
def test_copies_compute_the_same(copied):
    psi, points = random_map(2, dtype=torch.float32).double(), random_points(20, 2)
    with torch.no_grad():
        expected = psi(points)
        twin = copied(psi)
        assert torch.equal(twin(points), expected)
        torch.save(twin.state_dict(), io.BytesIO())


# --- cores and compiling ----------------------------------------------------------------------------------------------


def test_cores_share_the_rows(monkeypatch):
    monkeypatch.setattr(dispatch, "_available_cores", lambda: 3)
    threads = torch.get_num_threads()
    psi, points = random_map(3), random_points(20_000, 3)
    try:
        torch.set_num_threads(1)
        with torch.no_grad():
            alone = psi.jacobian(points)
        torch.set_num_threads(3)
        with torch.no_grad():
            together = psi.jacobian(points)
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(alone, together)


def decoded(connection, psi, points):
    with torch.no_grad():
        connection.send(psi(points).numpy())


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_forked_processes_have_their_own_threads(monkeypatch):
    monkeypatch.setattr(dispatch, "PARALLEL_THRESHOLD", 0)
    psi, points = random_map(3), random_points(1000, 3)
    with torch.no_grad():
        expected = psi(points)
    here, there = multiprocessing.Pipe()
    child = multiprocessing.get_context("fork").Process(target=decoded, args=(there, psi, points))
    child.start()
    try:
        assert here.poll(60)
        np.testing.assert_array_equal(here.recv(), expected.numpy())
    finally:
        child.terminate()
        child.join()


def test_compiling_where_no_cache_can_be_kept(monkeypatch, capsys):
    def refusing(*args, cache=False, **options):
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return njit(*args, **options)

    njit = numba.njit
    monkeypatch.setattr(numba, "njit", refusing)
    monkeypatch.setattr(compiling, "n_compiled", 0)

    def twice(x):
        return 2 * x

    for _ in range(2):  # and said once
        assert compiling.compiled(twice, "float64(float64)")(1.5) == 3.0
    told = "latentds: compiling for this CPU, about ten seconds for a first fit, anew in every process\n"
    assert capsys.readouterr().err == told


@pytest.mark.slow
def test_an_edit_of_what_a_kernel_inlines_compiles_it_anew(tmp_path):
    shutil.copytree(
        Path(compiling.__file__).parents[1], tmp_path / "latentds", ignore=shutil.ignore_patterns("__pycache__")
    )
    code = (
        "import numpy as np; from latentds.kernels.compiling import compiled; from latentds.kernels.lanes import exp;"
        "from latentds.kernels import translations;"
        "kernel = compiled(lambda x: exp(x), 'float64(float64)');"
        "print(kernel(-2.0), sum(translations.pack_kernel().stats.cache_hits.values()))"
    )

    def run():
        process = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
        value, hits = process.stdout.split()
        return float(value), int(hits)

    assert run() == (pytest.approx(math.exp(-2)), 0)
    assert run()[1] == 1
    lanes_file = tmp_path / "latentds" / "kernels" / "lanes.py"
    before = lanes_file.stat()
    lanes_file.write_text(lanes_file.read_text().replace("where(x > -650.0", "where(x > -1.0"))
    os.utime(lanes_file, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert run() == (0.0, 0)
    assert run() == (0.0, 1)


def test_warmup_compiles_everything(capsys):
    warmup([2])
    ds = ChebyshevDS(2, n_layers=5).fit(datasets.archimedean_spiral(50))
    ds.controller()(np.zeros(2))
    capsys.readouterr()
    with torch.no_grad():
        for points in (random_points(2), random_points(1100, 2)):
            ds(points), ds.jacobian(points)
    assert capsys.readouterr().err == ""
