"""Systems among torch's other modules: meta devices, tracing, autocast, ensembles, data loaders, several processes."""

from __future__ import annotations

import copy
import subprocess
import sys
import warnings

import pytest
import torch
from torch.func import functional_call, stack_module_state, vmap
from torch.utils.data import DataLoader, Dataset

from baselines import FDM, SDSEF
from baselines.couplings import AffineCouplings
from latentds import ChebyshevDS, Learned, LocallyWeightedTranslations, StableDS, TubeDS
from latentds.testing import wavy_motion

F64 = torch.float64

KINDS = {
    "ChebyshevDS": lambda: ChebyshevDS(2, n_layers=3),
    "TubeDS": lambda: TubeDS(2, n_layers=3, refined=False),
    "FDM": lambda: FDM(2, n_layers=3),
    "SDSEF": lambda: SDSEF(2, n_layers=3, n_features=20, epochs=5, seed=0),
    "MovedDS": lambda: FDM(2, n_layers=3).transformed(translation=[1.0, 2.0], scale=2.0).slowed(2.0),
}
"""The constructors; each is fitted once."""


@pytest.fixture(scope="module", params=KINDS)
def pair(request):
    return KINDS[request.param], KINDS[request.param]().fit(wavy_motion(2))


@pytest.fixture
def make(pair):
    return pair[0]


@pytest.fixture
def ds(pair):
    return copy.deepcopy(pair[1])


def places(count=20):
    """On the motion, near it and far away."""
    draw = torch.Generator().manual_seed(3)
    spread = 10 ** torch.linspace(-6, 1, count, dtype=F64).unsqueeze(-1)
    shown = wavy_motion(2).positions
    return shown[torch.linspace(0, len(shown) - 1, count).long()] + spread * torch.randn(
        count, 2, generator=draw, dtype=F64
    )


# --- the meta device --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("assign", [False, True])
@torch.no_grad()
def test_made_on_the_meta_device_and_filled_later(make, ds, assign):
    with torch.device("meta"):
        empty = make()
        assert all(t.is_meta for t in (*empty.parameters(), *empty.buffers()))
        assert empty(torch.zeros(5, 2, dtype=F64)).shape == (5, 2)  # shapes alone
    full = empty if assign else empty.to_empty(device="cpu")
    full.load_state_dict(ds.state_dict(), assign=assign)
    y, times = places(), torch.linspace(0, 2, 5)
    assert torch.equal(full(y), ds(y))
    assert torch.equal(full.rollout(y, times), ds.rollout(y, times))


# --- tracing ----------------------------------------------------------------------------------------------------------


def traced(call, *example):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch: deprecated, and what it thinks of every Python number
        return torch.jit.trace(call, example, check_trace=False)


@pytest.mark.parametrize("grad", [False, True])
def test_a_trace_of_an_easy_point_is_right_at_every_other(ds, grad):
    with torch.set_grad_enabled(grad):
        found = traced(ds, 1e3 * torch.ones(1, 2, dtype=F64))
        with torch.jit.optimized_execution(False):  # whose search takes minutes
            answers = [found(y) for y in (places(), places(6).reshape(3, 2, 2)[:, 0])]
        for answer, y in zip(answers, (places(), places(6).reshape(3, 2, 2)[:, 0]), strict=True):
            torch.testing.assert_close(answer, ds(y), rtol=1e-9, atol=1e-12)


class Bare(StableDS):
    """A method whose motions are integrated."""

    def _learn(self, shown, progress):
        return Learned(0.0)

    def forward(self, y):
        return self.attractor - y

    def lyapunov(self, y):
        return (y - self.attractor).square().sum(-1)


class Rollout(torch.nn.Module):
    def __init__(self, ds):
        super().__init__()
        self.ds = ds

    def forward(self, y):
        return self.ds.rollout(y, torch.linspace(0, 2, 5, dtype=F64))


def test_a_trace_of_a_rollout_is_right_at_every_other_point_or_refused(ds):
    rollout, easy = Rollout(ds), 1e3 * torch.ones(1, 2, dtype=F64)
    if isinstance(ds, SDSEF):
        with pytest.raises(RuntimeError, match=r"this rollout .* cannot be traced"):
            traced(rollout, easy)
    else:
        found = traced(rollout, easy)
        with torch.jit.optimized_execution(False):
            torch.testing.assert_close(found(places()), rollout(places()), rtol=1e-7, atol=1e-9)


def test_a_trace_of_an_integration_is_refused():
    for system in (Bare(2), Bare(2).slowed(2.0)):
        with pytest.raises(RuntimeError, match=r"this rollout .* cannot be traced"):
            traced(Rollout(system), torch.ones(1, 2, dtype=F64))


# --- precision --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_autocast_does_not_make_another_system_of_it(ds, dtype):
    ds, y, times = ds.float(), places().float(), torch.linspace(0, 2, 5)
    calls = (ds, ds.lyapunov, lambda y: ds.rollout(y, times), ds.with_goal([3.0, 1.0]))
    for grad in (False, True):
        with torch.set_grad_enabled(grad):
            for call in calls:
                wanted = call(y)
                with torch.autocast("cpu", dtype=dtype):
                    found = call(y)
                assert found.dtype == torch.float32
                assert torch.equal(found, wanted)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
@pytest.mark.parametrize("psi", [LocallyWeightedTranslations(2, 3), AffineCouplings(2, 2, 5)])
def test_maps_refuse_half_precision_too(psi, dtype):
    with pytest.raises(ValueError, match=f"dtype: expected torch.float64 or torch.float32, got {dtype}"):
        psi.to(dtype)
    assert all(t.dtype == F64 for t in psi.state_dict().values())


# --- ensembles --------------------------------------------------------------------------------------------------------


def ensemble(ds, count=3):
    many = [copy.deepcopy(ds) for _ in range(count)]
    with torch.no_grad():
        for i, one in enumerate(many):
            one.attractor.add_(0.1 * i)
            for parameter in one.parameters():
                parameter.add_(0.01 * i)
    return many


def test_an_ensemble_in_one_call(ds):
    many, y = ensemble(ds), places()
    state, empty = stack_module_state(many), copy.deepcopy(ds).to("meta")

    def member(parameters, buffers, y):
        return functional_call(empty, (parameters, buffers), (y,))

    wanted = torch.stack([one(y) for one in many])
    assert not torch.allclose(wanted[0], wanted[1])
    torch.testing.assert_close(vmap(member, (0, 0, None))(*state, y), wanted, rtol=1e-9, atol=1e-12)
    own = vmap(member, (0, 0, 0))(*state, torch.stack([y, y + 1, y - 1]))
    torch.testing.assert_close(own[1], many[1](y + 1), rtol=1e-9, atol=1e-12)


def test_an_ensemble_learns_as_its_members_do(ds):
    many, y = ensemble(ds), places(6)
    state, empty = stack_module_state(many), copy.deepcopy(ds).to("meta")

    def loss(parameters, buffers):
        return functional_call(empty, (parameters, buffers), (y,)).square().mean()

    slopes = vmap(torch.func.grad(loss))(*state)
    for i, one in enumerate(many):
        one(y).square().mean().backward()
        for name, parameter in one.named_parameters():
            if parameter.grad is not None:
                torch.testing.assert_close(slopes[name][i], parameter.grad, rtol=1e-6, atol=1e-9)


# --- processes --------------------------------------------------------------------------------------------------------


class Velocities(Dataset):
    """Items that are computed by the workers, in chunks large enough for more than one core."""

    def __init__(self, ds, chunks):
        self.ds, self.chunks = ds, chunks

    def __len__(self):
        return len(self.chunks)

    def __getitem__(self, index):
        with torch.no_grad():
            return self.ds(self.chunks[index])


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["FDM", "SDSEF"])
@torch.no_grad()
def test_workers_of_a_data_loader_compute_what_we_do(kind):
    ds = KINDS[kind]().fit(wavy_motion(2))
    chunks = torch.randn(4, 50_000, 2, generator=torch.Generator().manual_seed(0), dtype=F64)
    wanted = ds(chunks)  # with our own threads, before the workers are forked
    loader = DataLoader(Velocities(ds, chunks), batch_size=2, num_workers=2, timeout=120)
    torch.testing.assert_close(torch.cat(list(loader)), wanted, rtol=1e-9, atol=1e-12)


RANK = """
import os, sys, time, torch
from torch.nn.parallel import DistributedDataParallel

rank, store, learned = int(sys.argv[1]), sys.argv[2], sys.argv[3]
torch.set_num_threads(1)
ds, y = torch.load(learned, weights_only=False)
torch.distributed.init_process_group("gloo", init_method=f"file://{store}", rank=rank, world_size=2)
if rank == 1:
    ds.attractor.add_(5.0)  # the first process's buffers count
shared = DistributedDataParallel(ds)
optimiser = torch.optim.SGD(shared.parameters(), 1e-3)
for _ in range(3):
    optimiser.zero_grad()
    shared(y[rank::2]).square().mean().backward()
    optimiser.step()
torch.save(ds.state_dict(), f"{learned}.{rank}")
while not os.path.exists(f"{learned}.{1 - rank}"):
    time.sleep(0.01)
os._exit(0)  # gloo's own way out aborts now and then
"""
"""One of two processes: steps on its half of the batch, through the velocity."""


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["FDM", "SDSEF"])
def test_two_processes_train_as_one(kind, tmp_path):
    ds, y = KINDS[kind]().fit(wavy_motion(2)), places(8)
    before, learned = copy.deepcopy(ds.state_dict()), tmp_path / "ds"
    torch.save((ds, y), learned)
    ranks = [
        subprocess.Popen([sys.executable, "-c", RANK, str(rank), str(tmp_path / "store"), str(learned)])
        for rank in (0, 1)
    ]
    try:
        assert [process.wait(120) for process in ranks] == [0, 0]
    finally:
        for process in ranks:
            process.kill()
    optimiser = torch.optim.SGD(ds.parameters(), 1e-3)
    for _ in range(3):
        optimiser.zero_grad()
        ds(y).square().mean().backward()
        optimiser.step()
    wanted = ds.state_dict()
    assert any(not torch.equal(before[name], value) for name, value in wanted.items())
    for rank in (0, 1):
        found = torch.load(f"{learned}.{rank}")
        for name, value in wanted.items():
            torch.testing.assert_close(found[name], value, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("mode", [torch.inference_mode, torch.no_grad])
@pytest.mark.parametrize("several", [False, True])
def test_a_fit_by_gradients_is_the_same_in_any_mode(mode, several):
    shown = [wavy_motion(2), wavy_motion(2, seed=1)] if several else wavy_motion(2)
    fitted = [SDSEF(2, n_layers=2, n_features=8, epochs=3, seed=0) for _ in range(2)]
    fitted[0].fit(shown)
    with mode():
        fitted[1].fit(shown)
    here, there = (one.state_dict() for one in fitted)
    assert all(torch.equal(here[name], there[name]) for name in here)
    assert all(parameter.requires_grad and not parameter.is_inference() for parameter in fitted[1].parameters())
