"""The comparison: shared starts, cells that do not disturb each other, failures told instead of raised."""

import math

import joblib
import numpy as np
import pytest
import torch
from scipy import stats

from baselines import FDM
from latentds import ChebyshevDS, Demonstration, StableDS, datasets, metrics
from latentds.base import FitReport
from latentds.benchmark import COLUMNS, Cell, Protocol, compare, run
from latentds.fitting.matching import PINS

SPIRAL = datasets.unstable_spiral(1, 60)
TIMES = ["fit_seconds", "rollout_seconds"]


class Straight(StableDS):
    """ẏ = -k (y - y*), k drawn at random: the smallest method, third-party style."""

    def fit(self, demonstration, *, progress=False):
        self.attractor.copy_(demonstration.goal)
        self.register_buffer("rate", 1 + torch.rand((), dtype=torch.float64))
        self.fit_report = FitReport(0.0, 1, 0.0)
        return self

    def forward(self, y):
        return -self.rate * (y - self.attractor)

    def lyapunov(self, y):
        return (y - self.attractor).square().sum(-1)

    def rollout(self, y0, t):
        decay = torch.exp(-self.rate * (t - t[0]))[:, None]
        return self.attractor + decay * (y0 - self.attractor).unsqueeze(-2)


class Explosive(Straight):
    def rollout(self, y0, t):
        path = super().rollout(y0, t)
        path[1, 5:] = math.nan
        return path


class Lone(Straight):
    """Forgets that starts come in batches."""

    def rollout(self, y0, t):
        return super().rollout(y0, t)[0]


class Lost(Straight):
    """Converges, but not to the goal."""

    def fit(self, demonstration, *, progress=False):
        super().fit(demonstration)
        self.attractor += 0.01
        return self


class Slow(Straight):
    def fit(self, demonstration, *, progress=False):
        super().fit(demonstration)
        self.rate.fill_(0.01)
        return self


def refuse(dim):
    raise RuntimeError("no such thing")


QUICK = {"n_starts": 3, "n_points": 50, "n_jobs": 1}
SMALL = {"Chebyshev": lambda dim: ChebyshevDS(dim, n_layers=8), "FDM": lambda dim: FDM(dim, n_layers=8)}


def test_one_row_per_method_demonstration_seed_and_start():
    shown = [SPIRAL, datasets.archimedean_spiral(40)]
    rows = compare({"b": Straight, "a": Straight}, shown, seeds=(0, 5), **QUICK)
    assert tuple(rows.columns) == COLUMNS
    expected = [(m, d.name, s, i) for d in shown for m in "ba" for s in (0, 5) for i in range(4)]
    assert list(rows[["method", "demonstration", "seed", "start"]].itertuples(index=False, name=None)) == expected
    assert (rows["status"] == "ok").all()
    assert rows["converged"].dtype == bool
    assert rows["converged"].all()


def test_scores_are_those_of_the_rollouts():
    protocol = Protocol(n_starts=2, n_points=50)
    (outcome,) = run([Cell("Chebyshev", SMALL["Chebyshev"], SPIRAL)], protocol, n_jobs=1)
    ds = ChebyshevDS(3, n_layers=8).fit(SPIRAL)
    shown = protocol.reference(SPIRAL)
    assert np.allclose(shown[[0, -1]], SPIRAL.positions[[0, -1]])
    for start, row in zip(protocol.starts(SPIRAL), outcome.rows, strict=True):
        with torch.no_grad():
            path = ds.rollout(start, protocol.times(SPIRAL))
        assert row["dtw"] == pytest.approx(metrics.dtw(path, shown), rel=1e-6)
        assert row["dtw_fast"] == pytest.approx(metrics.fast_dtw(path, shown), rel=1e-6)
        assert row["dtw_per_point"] == row["dtw"] / 50
        assert row["endpoint_error"] == pytest.approx(metrics.endpoint_error(path, shown), abs=1e-6)
        assert row["mse"] == pytest.approx(ds.fit_report.mse)
        assert row["n_layers"] == 8 + PINS
        assert row["n_parameters"] == sum(p.numel() for p in ds.parameters())
        assert np.allclose(outcome.paths[row["start"]], path, atol=1e-9)


def test_starts_are_shared_and_uniform_in_the_ball():
    protocol = Protocol(n_starts=4000, radius=0.1)
    starts = protocol.starts(SPIRAL)
    assert (starts[0] == SPIRAL.start).all()
    offsets = (starts[1:] - SPIRAL.start).numpy()
    distance = np.linalg.norm(offsets, axis=1) / 0.1
    assert distance.max() < 1
    assert stats.kstest(distance**3, "uniform").pvalue > 0.01
    directions = np.linalg.norm((offsets / distance[:, None] / 0.1).mean(axis=0))
    assert directions < 0.05
    other = datasets.stable_spiral(2, 50)
    assert np.allclose(protocol.starts(other) - other.start, starts - SPIRAL.start, atol=1e-15)
    assert (Protocol(n_starts=20).starts(SPIRAL) == starts[:21]).all()
    assert (Protocol(n_starts=20, radius=0.0).starts(SPIRAL) == SPIRAL.start).all()


def test_a_cell_does_not_depend_on_the_others_nor_on_the_generator():
    alone = compare({"random": Straight}, SPIRAL, seeds=(3,), **QUICK)
    torch.manual_seed(99)
    torch.rand(7)
    company = compare({"first": Straight, "random": Straight}, SPIRAL, seeds=(1, 3), **QUICK)
    again = company[(company["method"] == "random") & (company["seed"] == 3)]
    assert alone.drop(columns=TIMES).equals(again.drop(columns=TIMES).reset_index(drop=True))
    assert company["dtw"].nunique() == 2 * 4  # the seed decides, not the label


def test_nothing_global_changes():
    torch.manual_seed(7)
    before = torch.get_rng_state(), torch.get_num_threads(), torch.get_default_dtype(), torch.is_grad_enabled()
    numpy_before = np.random.get_state()[1].copy()  # noqa: NPY002
    compare({"random": Straight, "bad": refuse, **SMALL}, SPIRAL, **QUICK)
    after = torch.get_rng_state(), torch.get_num_threads(), torch.get_default_dtype(), torch.is_grad_enabled()
    assert torch.equal(before[0], after[0])
    assert before[1:] == after[1:]
    assert (np.random.get_state()[1] == numpy_before).all()  # noqa: NPY002


@pytest.mark.parametrize(
    "bad", [refuse, Lone, lambda dim: 3, lambda dim: ChebyshevDS(dim + 1), lambda dim: FDM(dim, beta=-1)]
)
def test_a_method_that_raises_becomes_rows_that_say_so(bad):
    rows = compare({"bad": bad, "good": Straight}, SPIRAL, **QUICK)
    failed = rows[rows["method"] == "bad"]
    assert len(failed) == 4
    assert (failed["status"] == "failed").all()
    assert failed["error"].str.contains("Error: ").all()
    assert failed[["dtw", "dtw_fast", "frechet"]].isna().all(axis=None)
    assert not failed["converged"].any()
    assert (rows[rows["method"] == "good"]["status"] == "ok").all()


def test_a_rollout_that_diverges_is_told_start_by_start():
    rows = compare({"explosive": Explosive}, SPIRAL, **QUICK)
    assert list(rows["status"]) == ["ok", "diverged", "ok", "ok"]
    assert list(rows["dtw"].isna()) == [False, True, False, False]


@pytest.mark.parametrize("method", [Lost, Slow])
def test_converged_wants_the_goal_in_time(method):
    assert not compare({"m": method}, SPIRAL, **QUICK)["converged"].any()


def test_processes_and_threads_give_the_serial_rows():
    methods = {**SMALL, "random": Straight, "lambda": lambda dim: Straight(dim)}
    settings = {"n_starts": 2, "n_points": 50, "seeds": (0, 1)}
    serial = compare(methods, SPIRAL, n_jobs=1, **settings).drop(columns=TIMES)
    processes = compare(methods, SPIRAL, n_jobs=2, **settings).drop(columns=TIMES)
    with joblib.parallel_config(backend="threading", n_jobs=3):
        threads = compare(methods, SPIRAL, **settings).drop(columns=TIMES)
    assert serial.equals(threads)
    assert serial.equals(processes)


def test_progress_names_method_and_demonstration(capsys):
    rows = compare({"Straight": Straight}, SPIRAL, progress=True, **QUICK)
    shown = capsys.readouterr().out
    assert len(rows) == 4
    assert "Straight · unstable c=1" in shown
    assert "1/1" in shown


def test_settings_may_change_with_the_demonstration():
    cells = [
        Cell("FDM", lambda dim, m=m: FDM(dim, n_layers=m), datasets.unstable_spiral(c, 60)) for c, m in ((1, 4), (3, 6))
    ]
    layers = {o.demonstration: o.rows[0]["n_layers"] for o in run(cells, Protocol(n_starts=0, n_points=20), n_jobs=1)}
    assert layers == {"unstable c=1": 4 + PINS, "unstable c=3": 6 + PINS}


def test_a_dimension_of_seven_and_an_unnamed_demonstration():
    shown = Demonstration(np.random.default_rng(0).standard_normal((50, 7)).cumsum(axis=0), 0.01)
    rows = compare(SMALL, shown, **QUICK)
    assert (rows["status"] == "ok").all()
    assert (rows["demonstration"] == "").all()


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"methods": {}}, "methods"),
        ({"methods": [Straight]}, "methods"),
        ({"methods": {"a": "FDM"}}, "methods"),
        ({"methods": {1: Straight}}, "methods"),
        ({"demonstrations": []}, "demonstrations"),
        ({"demonstrations": [SPIRAL, 3]}, "demonstrations"),
        ({"demonstrations": SPIRAL.positions}, "demonstrations"),
        ({"demonstrations": [SPIRAL, SPIRAL]}, "demonstrations"),
        ({"n_starts": -1}, "n_starts"),
        ({"n_starts": 2.5}, "n_starts"),
        ({"radius": -0.1}, "radius"),
        ({"radius": math.nan}, "radius"),
        ({"radius": math.inf}, "radius"),
        ({"radius": "wide"}, "radius"),
        ({"seeds": ()}, "seeds"),
        ({"seeds": (0, 0)}, "seeds"),
        ({"seeds": (-1,)}, "seeds"),
        ({"seeds": (0.5,)}, "seeds"),
        ({"seeds": 3}, "seeds"),
        ({"n_points": 1}, "n_points"),
        ({"n_jobs": 0}, "n_jobs"),
        ({"n_jobs": 1.5}, "n_jobs"),
        ({"n_jobs": "all"}, "n_jobs"),
    ],
)
def test_bad_input_is_named_before_any_work(change, named):
    def work(dim):
        raise AssertionError("work was done")

    with pytest.raises(ValueError, match=f"^{named}: expected"):
        compare(**{"methods": {"m": work}, "demonstrations": SPIRAL, "n_jobs": 1, **change})


def test_cells_that_are_alike_are_refused():
    with pytest.raises(ValueError, match=r"^cells: expected each only once"):
        run([Cell("a", Straight, SPIRAL), Cell("a", Slow, SPIRAL)])
