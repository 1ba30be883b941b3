"""Hostile demonstrations, hostile inputs to fitted systems, threads and processes."""

from __future__ import annotations

import multiprocessing
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import seed as seeded

from baselines import FDM, SDSEF
from experiments.fuzz import FLAWS, FOLLOWS, METHODS, SAYS, SHAPES, SLOW, Case, cases, outcome, summary
from latentds import ChebyshevDS, Demonstration, TubeDS, datasets
from latentds.testing import wavy_motion


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
def test_hostile_demonstrations(name):
    """The first few of the thousand that `make fuzz` tries, by every method."""
    ends = []

    @seeded(7)
    @settings(
        max_examples=3 if name == SLOW else 12,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(cases(largest=100))
    def attempt(case):
        ends.append(outcome(case._replace(method=name)))
        assert not ends[-1].startswith("BROKEN"), f"{case}: {ends[-1]}"

    attempt()
    assert {FOLLOWS, SAYS} & set(ends)  # not all are refused


PLAIN = Case("FDM", "smooth", "none", "float64", 100, 2, 1.0, 0.0, 0.01, 0)


FITTED = [pytest.param(name, marks=[pytest.mark.slow] * (name == SLOW)) for name in METHODS]


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
def test_harmless_demonstrations_are_fitted(name):
    assert outcome(PLAIN._replace(method=name, dim=1, shape="collinear")) == FOLLOWS
    for dim in (2, 10):
        assert outcome(PLAIN._replace(method=name, dim=dim)) == FOLLOWS


@pytest.mark.parametrize("form", ["float32", "strided", "transposed", "requires_grad", "numpy", "list"])
def test_every_form_is_the_same_motion(form):
    """So every method is fitted to the same numbers, whatever they came in."""
    numbers = torch.from_numpy(PLAIN._replace(form="numpy").positions())
    shown = Demonstration(PLAIN._replace(form=form).positions(), PLAIN.dt)
    assert shown.positions.dtype == torch.float64
    assert not shown.positions.requires_grad
    assert torch.equal(shown.positions, numbers.float().double() if form == "float32" else numbers)


@pytest.mark.parametrize("name", FITTED)
def test_what_a_coarse_form_rounds_is_followed(name):
    assert outcome(PLAIN._replace(method=name, form="float16")) == FOLLOWS


@pytest.mark.parametrize("name", FITTED)
@pytest.mark.parametrize(("scale", "offset"), [(1e-9, 0.0), (1e9, 0.0), (1.0, 1e6)])
def test_every_scale_is_taken(name, scale, offset):
    assert outcome(PLAIN._replace(method=name, scale=scale, offset=offset, dim=3)) == FOLLOWS


def told_apart(cases):
    kinds = {case.positions().tobytes() for case in cases}
    return len(kinds) == len(cases)


@pytest.mark.parametrize("dim", [1, 2, 3, 7])
def test_every_shape_and_every_flaw_is_alive(dim):
    case = PLAIN._replace(form="numpy", dim=dim)
    assert told_apart([case._replace(flaw=flaw) for flaw in FLAWS])
    shapes = [case._replace(shape=shape) for shape in SHAPES]
    assert told_apart(shapes)
    for shape in shapes:
        path = shape.positions()
        assert path.shape == (100, dim)
        assert 0.01 < np.ptp(path, axis=0).max() < 20
    near = [shape.positions() for shape in shapes if shape.shape.startswith("near")]
    assert all(
        np.linalg.norm(path[-1] - path[0]) < np.linalg.norm(np.diff(path, axis=0), axis=1).sum() / 5 for path in near
    )
    for unknown in (case._replace(shape="square"), case._replace(flaw="hopeless")):
        with pytest.raises(ValueError, match=r"expected one of .* got"):
            unknown.positions()


@pytest.mark.parametrize("flaw", ["nan", "inf"])
@pytest.mark.parametrize("seed", range(4))
def test_numbers_that_are_none_are_refused_by_name(flaw, seed):
    assert outcome(PLAIN._replace(flaw=flaw, seed=seed)).startswith("refused: positions: expected finite numbers")


def test_the_fuzzer_tells_a_broken_promise(monkeypatch):
    class Unstable(FDM):
        def forward(self, y):
            return -super().forward(y)

    class Crashes(FDM):
        def _learn(self, shown, progress):
            raise IndexError("off by one")

    class Mumbles(FDM):
        def _learn(self, shown, progress):
            raise ValueError("no")

    class Forgets(FDM):
        """Learns a part, and is held against that part alone."""

        def _learn_and_measure(self, shown, progress):
            return super()._learn_and_measure([Demonstration(shown[0].positions[-30:], shown[0].dt)], progress)

    stubs = {Unstable: "V decreases", Crashes: "off by one", Mumbles: "names no", Forgets: "a silent misfit off by"}
    for broken, message in stubs.items():
        monkeypatch.setitem(METHODS, "broken", broken)
        found = outcome(PLAIN._replace(method="broken"))
        assert found.startswith("BROKEN")
        assert message in found
        assert "1  BROKEN" in summary([(PLAIN, found, 0.1)])


def test_the_summary_counts_each_end_of_each_method():
    ends = [FOLLOWS, SAYS, SAYS, "refused: dt: expected a number > 0, got -1", "BROKEN certificate: falsified  V (x 1)"]
    told = summary([(PLAIN, found, 0.1) for found in ends] + [(PLAIN._replace(method="TubeDS"), FOLLOWS, 2.0)])
    assert told.startswith("6 cases, slowest 2.0 s\n")
    assert "| FDM | 1 | 2 | 1 | 1 |\n| TubeDS | 1 | 0 | 0 | 0 |\n" in told
    assert "     1  refused: dt: expected a number > 0\n     1  BROKEN certificate: falsified V" in told


@pytest.fixture
def ds(fitted, method):
    return fitted(method, 3)


def calls(ds):
    times = torch.tensor([0.0, 0.5, 3.0])
    return {
        "forward": ds,
        "lyapunov": ds.lyapunov,
        "encode": ds.encode,
        "decode": ds.decode,
        "jacobian": ds.jacobian,
        "rollout": lambda y: ds.rollout(y, times),
    }


@torch.no_grad()
def test_far_away_nothing_breaks(ds, draw):
    y = 1e6 * torch.randn(50, 3, generator=draw, dtype=torch.float64)
    for name, call in calls(ds).items():
        assert torch.isfinite(call(y)).all(), name
    if isinstance(ds, SDSEF):
        return  # couplings multiply 1e6 by functions of 1e6, layer after layer: no float carries them back exactly
    assert (ds.decode(ds.encode(y)) - y).abs().max() < 1e-3
    energy = ds.lyapunov(ds.rollout(y, torch.tensor([0.0, 1.0, 10.0])))
    assert (energy.diff(dim=-1) <= 1e-9 * energy.amax()).all()


@torch.no_grad()
def test_at_the_attractor_nothing_breaks(ds):
    y = ds.attractor.expand(3, 3)
    for name, call in calls(ds).items():
        assert torch.isfinite(call(y)).all(), name
    assert ds(y).abs().max() < 1e-9
    assert (ds.rollout(y, torch.tensor([0.0, 1e6])) - ds.attractor).abs().max() < 1e-9
    nearly = ds.attractor + torch.tensor([1e-300, 1e-160, 5e-324], dtype=torch.float64)
    assert torch.isfinite(ds(nearly)).all()
    assert torch.isfinite(ds.rollout(nearly, torch.tensor([0.0, 1.0]))).all()


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf"), 1e308])
@pytest.mark.parametrize("count", [3, 50])
@torch.no_grad()
def test_a_bad_row_spoils_itself_alone(ds, draw, bad, count):
    y = torch.randn(count, 3, generator=draw, dtype=torch.float64)
    spoiled = y.clone()
    spoiled[1, 2] = bad
    others = torch.arange(count) != 1
    for name, call in calls(ds).items():
        found, wanted = call(spoiled), call(y)
        torch.testing.assert_close(found[others], wanted[others], rtol=1e-6, atol=1e-9, msg=name)
        if np.isnan(bad) and name != "rollout":
            assert found[1].isnan().any(), name


def test_gradients_are_finite_far_away_and_at_the_attractor(ds):
    for y in (1e6 * torch.ones(3, dtype=torch.float64), ds.attractor.clone()):
        point = y.clone().requires_grad_()
        (ds(point).sum() + ds.lyapunov(point) + ds.rollout(point, torch.tensor([0.0, 1.0])).sum()).backward()
        assert torch.isfinite(point.grad).all()


@pytest.mark.slow
@torch.no_grad()
def test_eight_threads_give_the_serial_result(ds, draw):
    batches = [torch.randn(n, 3, generator=draw, dtype=torch.float64) for n in (1, 7, 20) * 4]
    times = torch.linspace(0, 1, 5)

    def evaluate(y):
        return torch.cat([ds(y), ds.encode(y), ds.rollout(y, times).flatten(0, 1)])

    serial = [evaluate(y) for y in batches]
    with ThreadPoolExecutor(8) as pool:
        for found, wanted in zip(pool.map(evaluate, batches), serial, strict=True):
            torch.testing.assert_close(found, wanted, rtol=1e-13, atol=1e-13)


def test_eight_threads_fit_as_one_does():
    motions = [wavy_motion(3, seed) for seed in range(8)]

    def fit(shown):
        ds = ChebyshevDS(3, n_layers=30).fit(shown)
        with torch.no_grad():
            return ds(shown.positions)

    serial = [fit(shown) for shown in motions]
    with ThreadPoolExecutor(8) as pool:
        for found, wanted in zip(pool.map(fit, motions), serial, strict=True):
            torch.testing.assert_close(found, wanted, rtol=1e-13, atol=1e-13)


def _in_another_process(ds, y, queue):
    torch.set_num_threads(1)  # torch itself hangs in a fork of a process in which it ran in parallel (GNU OpenMP)
    with torch.no_grad():
        refitted = FDM(3, n_layers=10).fit(datasets.unstable_spiral(1, 100))
        queue.put((ds(y).numpy(), ds.rollout(y, torch.linspace(0, 1, 5)).numpy(), refitted(y).numpy()))


@pytest.mark.slow
@pytest.mark.parametrize("how", ["fork", "spawn"])
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of fork in a threaded process: that is the test
def test_other_processes_give_the_same_result(how, draw):
    if how not in multiprocessing.get_all_start_methods():
        pytest.skip(f"no {how} on {sys.platform}")
    ds, y = TubeDS(3, n_layers=20, refined=False).fit(wavy_motion(3)), torch.randn(300, 3, generator=draw).double()
    torch.set_num_threads(2)
    torch.randn(2_000_000).exp().sum()  # torch's own threads start
    torch.set_num_threads(1)
    context = multiprocessing.get_context(how)
    queue = context.Queue()
    with torch.no_grad():
        wanted = (
            ds(y),
            ds.rollout(y, torch.linspace(0, 1, 5)),
            FDM(3, n_layers=10).fit(datasets.unstable_spiral(1, 100))(y),
        )
    process = context.Process(target=_in_another_process, args=(ds, y, queue))
    process.start()
    try:
        for found, expected in zip(queue.get(timeout=120), wanted, strict=True):
            np.testing.assert_allclose(found, expected.numpy(), rtol=1e-12, atol=1e-12)
        process.join(30)
        assert process.exitcode == 0
    finally:
        process.kill()
