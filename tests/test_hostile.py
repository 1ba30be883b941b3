"""Hostile demonstrations, hostile inputs to fitted systems, threads and processes."""

from __future__ import annotations

import copy
import multiprocessing
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import seed as seeded

from baselines import FDM, SDSEF
from experiments import tampering
from experiments.fuzz import FOLLOWS, SAYS, _missed, outcome, summary
from experiments.hostile import FLAWS, METHODS, SHAPES, SLOW, Case, cases
from experiments.tampering import TAMPERINGS
from latentds import ChebyshevDS, Demonstration, StableDS, TubeDS, datasets
from latentds.certificate import Certificate, Line
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


@pytest.mark.parametrize(
    "seed", [pytest.param(0, id="goals apart", marks=pytest.mark.slow), pytest.param(1, id="one goal")]
)
def test_several_start_apart_and_are_each_followed(seed):
    case = PLAIN._replace(method="TubeDS", n_shown=3, apart=0.04, seed=seed)
    shown = case.shown()
    apart = [torch.linalg.vector_norm(one.positions - shown[0].positions, dim=-1) / shown[0].size for one in shown]
    for gaps in apart[1:]:
        assert float(gaps[0]) == pytest.approx(0.04)
        assert float(gaps[-1]) == pytest.approx(0 if seed else 0.04, abs=1e-12)
    assert outcome(case) == FOLLOWS


def test_no_other_demonstration_excuses_a_misfit(monkeypatch):
    class FirstAlone(FDM):
        def _learn_and_measure(self, shown, progress):
            return super()._learn_and_measure(shown[:1], progress)

    monkeypatch.setitem(METHODS, "broken", lambda dim: FirstAlone(dim, n_layers=40))
    found = outcome(PLAIN._replace(method="broken", n_shown=3, apart=0.5))
    assert found.startswith("BROKEN a silent misfit off by")


@pytest.mark.parametrize(
    ("aside", "share", "told"), [(0.0, 1.0, ""), (0.0, 0.9, "0.1"), (0.1, 0.9, ""), (0.1, 0.7, "0.3")]
)
def test_goals_apart_excuse_no_more_than_the_end(aside, share, told):
    line = np.linspace(0, 1, 100)[:, None] * np.array([1.0, 0.0])
    shown = [Demonstration(line + offset, 0.01) for offset in ([0, aside], [0, -aside])]
    paths = torch.stack([one.start + share * (one.positions - one.start) for one in shown])
    assert _missed(shown, paths) == (f"off by {told} of the size at its end" if told else "")


@pytest.fixture(scope="module")
def followed():
    case = PLAIN._replace(method="FDM")
    return METHODS["FDM"](case.dim).fit(case.shown())


def tampered(kind, ds):
    return TAMPERINGS[kind](copy.deepcopy(ds), PLAIN.shown(), np.random.default_rng(0))


CHANGED = [kind for kind in TAMPERINGS if " by " in kind]
OTHER_CODE = [kind for kind in CHANGED if "dynamics" in kind or ("fast" in kind and "subclass" in kind)]


@pytest.mark.filterwarnings("ignore:compare. 1 of 2 rows failed")
@pytest.mark.parametrize("kind", ["turned by a subclass", OTHER_CODE[0], "nan in it", "reports a mute error"])
def test_what_is_promised_of_tampering_holds(kind, followed):
    assert tampered(kind, followed) == ""


def certificate(*lines):
    made = tuple(Line(claim, verdict, 1, 1.0, "") for claim, verdict in lines)
    return lambda ds, n_samples: Certificate("", 2, ((), ()), 10, 0, made)


FALSIFIED = ("follows its demonstration", "falsified")
PROVEN = ("latent motions approach the goal", "proven")


def test_the_fuzzer_tells_what_is_not_said_of_tampering(followed, monkeypatch):
    assert len(CHANGED) == 11
    monkeypatch.setattr(tampering, "certify", certificate())
    for kind in CHANGED:
        assert tampered(kind, followed) == "a certificate that says that it follows", kind
    assert tampered("nan in it", followed).startswith("a certificate that does not say first")
    found = outcome(PLAIN._replace(tampering="turned by a hook"))
    assert found == "BROKEN after tampering, turned by a hook: a certificate that says that it follows"
    monkeypatch.setattr(tampering, "certify", certificate(FALSIFIED, PROVEN))
    assert len(OTHER_CODE) == 3
    for kind in CHANGED:
        assert (tampered(kind, followed) == "a rate that is proven of other code") == (kind in OTHER_CODE), kind
    monkeypatch.setattr(StableDS, "controller", lambda ds: lambda y: 0 * y)
    assert tampered("halved by a hook", followed) == "a controller that runs another field"


def test_the_fuzzer_tells_a_number_that_is_left_out(followed, monkeypatch):
    monkeypatch.setattr(StableDS, "save", lambda ds, path: None)
    assert tampered("nan in it", followed).startswith("a controller or a file with nan in ")
    name, centers = "diffeomorphism.centers", followed.diffeomorphism.centers
    monkeypatch.setattr(
        FDM, "forward", lambda ds, y: torch.ones_like(y) * (1 + ds.diffeomorphism.centers.isnan().any())
    )
    monkeypatch.setattr(FDM, "state_dict", lambda ds: {name: ds.diffeomorphism.centers}, raising=False)
    assert tampered("nan in it", followed) == f"velocities of another system with nan in {name}"
    assert not centers.isnan().any()


@pytest.mark.parametrize(
    ("kind", "bad", "good", "told"),
    [
        ("nothing", ("failed", "no", 1.0), ("ok", "", 1.0), ""),
        ("nothing", ("failed", "", 1.0), ("ok", "", 1.0), "rows that do not say 'failed'"),
        ("nothing", ("ok", "", 1.0), ("ok", "", 1.0), "rows that do not say 'failed'"),
        ("nothing", ("failed", "no", 1.0), ("failed", "no", 1.0), "another method's rows fail with it"),
        ("tensors", ("failed", "no", 1.0), ("ok", "", 1.0), "rows that do not say 'ok'"),
        ("tensors", ("ok", "", 2.0), ("ok", "", 1.0), "rows that are not right"),
    ],
)
def test_the_fuzzer_tells_rows_that_are_wrong(kind, bad, good, told, followed, monkeypatch):
    rows = pd.DataFrame([("bad", *bad), ("good", *good)], columns=["method", "status", "error", "dtw"])
    monkeypatch.setattr(tampering, "compare", lambda *_, **__: rows.assign(mse=0.5, n_layers=3, follows=True))
    assert tampered(f"reports {kind}", followed).startswith(told)
    assert bool(tampered(f"reports {kind}", followed)) == bool(told)


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
