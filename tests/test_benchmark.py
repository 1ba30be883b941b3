"""The comparison: shared starts, cells that do not disturb each other, failures told instead of raised."""

import ctypes
import math
import os
import signal
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import joblib
import numpy as np
import pandas as pd
import pytest
import rich
import torch
from scipy import stats

from baselines import FDM
from latentds import ChebyshevDS, Demonstration, Learned, StableDS, TubeDS, datasets, metrics
from latentds.benchmark import COLUMNS, Cell, RolloutProtocol, compare, evaluate, run, table
from latentds.cache import CellStore
from latentds.cell import judge
from latentds.fitting.matching import PINS

SPIRAL = datasets.unstable_spiral(1, 60)
TIMES = ["fit_seconds", "rollout_seconds"]


class Straight(StableDS):
    """ẏ = -k (y - y*), k drawn at random: the smallest method, third-party style."""

    def _learn(self, shown, progress):
        self.attractor.copy_(shown[0].goal)
        self.register_buffer("rate", 1 + torch.rand((), dtype=torch.float64))
        return Learned(0.0, 1)

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

    def _learn(self, shown, progress):
        learned = super()._learn(shown, progress)
        self.attractor += 0.01
        return learned


class Naps(Straight):
    def _learn(self, shown, progress):
        time.sleep(0.3)
        return super()._learn(shown, progress)


class Slow(Straight):
    def _learn(self, shown, progress):
        learned = super()._learn(shown, progress)
        self.rate.fill_(0.01)
        return learned


class Several(Straight):
    """Learns the goal of the first."""

    def _learn(self, shown, progress):
        return super()._learn(shown[:1], progress)


class Unfit(Straight):
    def _learn(self, shown, progress):
        raise RuntimeError("cannot learn this")


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
    protocol = RolloutProtocol(n_starts=2, n_points=50)
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
    protocol = RolloutProtocol(n_starts=4000, radius=0.1)
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
    assert (RolloutProtocol(n_starts=20, radius=0.1).starts(SPIRAL) == starts[:21]).all()
    near = RolloutProtocol(n_starts=20)
    for shown in (SPIRAL, replace(SPIRAL, positions=1000 * SPIRAL.positions)):
        assert torch.allclose(near.starts(shown) - shown.start, 0.5 * shown.size * (starts[:21] - SPIRAL.start))
    assert (RolloutProtocol(n_starts=20, radius=0.0).starts(SPIRAL) == SPIRAL.start).all()


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
    with pytest.warns(RuntimeWarning):
        compare({"random": Straight, "bad": Unfit, **SMALL}, SPIRAL, **QUICK)
    after = torch.get_rng_state(), torch.get_num_threads(), torch.get_default_dtype(), torch.is_grad_enabled()
    assert torch.equal(before[0], after[0])
    assert before[1:] == after[1:]
    assert (np.random.get_state()[1] == numpy_before).all()  # noqa: NPY002


@pytest.mark.parametrize("bad", [Lone, Unfit])
def test_a_method_that_raises_becomes_rows_that_say_so(bad):
    with pytest.warns(RuntimeWarning, match="compare: 4 of 8 rows failed, their scores are NaN: 4 of 'bad', .*Error: "):
        rows = compare({"bad": bad, "good": Straight}, SPIRAL, **QUICK)
    failed = rows[rows["method"] == "bad"]
    assert len(failed) == 4
    assert (failed["status"] == "failed").all()
    assert failed["error"].str.contains("Error: ").all()
    assert failed[["dtw", "dtw_fast", "frechet"]].isna().all(axis=None)
    assert not failed["converged"].any()
    assert (rows[rows["method"] == "good"]["status"] == "ok").all()


@pytest.mark.parametrize(
    ("bad", "told"),
    [
        (FDM(3), r"a callable\(dim\), got a FDM for 'bad': write lambda dim: FDM\(dim\)"),
        (refuse, "'bad' to make a StableDS, got RuntimeError: no such thing"),
        (lambda dim: 3, "'bad' to make a StableDS, got TypeError: expected a StableDS, got int"),
        (lambda dim: ChebyshevDS(dim + 1), "'bad' to make a StableDS, got ValueError: expected a system of 3 dim"),
        (lambda dim: FDM(dim, beta=-1), "'bad' to make a StableDS, got ValueError: beta: expected a number in"),
    ],
)
def test_a_method_that_cannot_be_made_is_refused_before_any_work(bad, told):
    def work(dim):
        ds = Straight(dim)
        ds.fit = lambda demonstration: pytest.fail("work was done")
        return ds

    with pytest.raises(ValueError, match=f"^methods: expected {told}"):
        compare({"good": work, "bad": bad}, SPIRAL, **QUICK)


@pytest.mark.parametrize("bad", [refuse, lambda dim: 3])
def test_a_cell_that_cannot_be_made_tells_it_in_its_rows(bad):
    (outcome,) = run([Cell("bad", bad, SPIRAL)], RolloutProtocol(n_starts=1, n_points=20), n_jobs=1)
    assert [row["status"] for row in outcome.rows] == ["failed"] * 2


def test_without_failures_nothing_is_warned_of(recwarn):
    compare({"good": Straight}, SPIRAL, **QUICK)
    assert not [warning for warning in recwarn if issubclass(warning.category, RuntimeWarning)]


def test_a_rollout_that_diverges_is_told_start_by_start():
    rows = compare({"explosive": Explosive}, SPIRAL, **QUICK)
    assert list(rows["status"]) == ["ok", "diverged", "ok", "ok"]
    assert list(rows["dtw"].isna()) == [False, True, False, False]


def test_rows_tell_what_follows_and_nothing_else_does():
    methods = {"FDM": lambda dim: FDM(dim, n_layers=60), "straight": Straight, "explosive": Explosive}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        rows = compare(methods, SPIRAL, **QUICK)
    assert rows["follows"].dtype == bool
    assert rows.groupby("method")["follows"].mean().to_dict() == {"FDM": 1, "straight": 0, "explosive": 0}
    assert set(rows[rows["method"] == "straight"]["status"]) == {"ok"}


@pytest.mark.parametrize("method", [Lost, Slow])
def test_converged_wants_the_goal_in_time(method):
    assert not compare({"m": method}, SPIRAL, **QUICK)["converged"].any()


def test_of_several_goals_the_systems_own_is_to_be_reached():
    """It is one of them or between them; one system cannot end at each."""
    line = SPIRAL.positions
    drift = 0.01 * torch.linspace(0, 1, len(line))[:, None]
    shown = [Demonstration(line - side * drift, SPIRAL.dt, f"{side}") for side in (0, 1)]
    assert compare({"between": Straight}, [shown], **QUICK)["converged"].all()
    assert not compare({"beside": Lost}, [shown], **QUICK)["converged"].any()


@pytest.mark.slow
def test_processes_and_threads_give_the_serial_rows():
    methods = {**SMALL, "random": Straight, "lambda": lambda dim: Straight(dim)}
    settings = {"n_starts": 2, "n_points": 50, "seeds": (0, 1)}
    serial = compare(methods, SPIRAL, n_jobs=1, **settings).drop(columns=TIMES)
    processes = compare(methods, SPIRAL, n_jobs=2, **settings).drop(columns=TIMES)
    with joblib.parallel_config(backend="threading", n_jobs=3):
        threads = compare(methods, SPIRAL, **settings).drop(columns=TIMES)
    assert serial.equals(threads)
    assert serial.equals(processes)


def test_progress_names_what_is_awaited(capsys):
    rich.reconfigure()  # the command, tried in the same process, sends bars to stderr
    rows = compare({"Straight": Straight}, SPIRAL, progress=True, **QUICK)
    shown = capsys.readouterr().out
    assert len(rows) == 4
    assert "fitted Straight · unstable c=1" in shown
    assert "1/1" in shown
    rich.reconfigure(force_terminal=True, width=100)  # where it is drawn ten times a second
    try:
        compare(dict.fromkeys("abc", Naps), SPIRAL, progress=True, **QUICK)
    finally:
        rich.reconfigure()
    assert "fitting a · unstable c=1, b · unstable c=1 and 1 more" in capsys.readouterr().out


def test_settings_may_change_with_the_demonstration():
    cells = [
        Cell("FDM", lambda dim, m=m: FDM(dim, n_layers=m), datasets.unstable_spiral(c, 60)) for c, m in ((1, 4), (3, 6))
    ]
    layers = {
        o.demonstration: o.rows[0]["n_layers"] for o in run(cells, RolloutProtocol(n_starts=0, n_points=20), n_jobs=1)
    }
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


def moved(name, by=0.1, every=1):
    """The spiral shown otherwise: off at first, to the same goal."""
    shift = by * torch.linspace(1, 0, len(SPIRAL), dtype=torch.float64).unsqueeze(1)
    return Demonstration((SPIRAL.positions + shift)[::every], every * SPIRAL.dt, name)


OTHERS = [moved("low", -0.1), moved("high", 0.1), moved("slow", 0.2, 2)]


def test_others_may_judge():
    """One is shown; rollouts begin, last and are scored as each judge does."""
    rows = compare(SMALL, SPIRAL, judged_by=OTHERS, **QUICK | {"n_starts": 0})
    assert tuple(rows.columns) == (*COLUMNS[:2], "judge", *COLUMNS[2:])
    judged = [(m, SPIRAL.name, d.name, i) for m in SMALL for i, d in enumerate(OTHERS)]
    assert list(rows[["method", "demonstration", "judge", "start"]].itertuples(index=False, name=None)) == judged
    ds = ChebyshevDS(3, n_layers=8).fit(SPIRAL)
    for one, (_, row) in zip(OTHERS, rows[rows["method"] == "Chebyshev"].iterrows(), strict=True):
        times = torch.linspace(0, one.duration, 50, dtype=torch.float64)
        with torch.no_grad():
            path, velocities = ds.rollout(one.start, times), ds(one.positions)
        assert row["dtw"] == pytest.approx(metrics.dtw(path, one.at(times.numpy())), rel=1e-6)
        assert row["velocity_rmse"] == pytest.approx(metrics.velocity_rmse(velocities, one.velocities), rel=1e-6)
        assert row["mse"] == pytest.approx(ds.fit_report.mse)


def test_every_judge_has_its_perturbed_starts():
    protocol = RolloutProtocol(n_starts=2, n_points=20)
    (outcome,) = run([Cell("m", Straight, SPIRAL, judges=OTHERS)], protocol, n_jobs=1)
    assert [row["start"] for row in outcome.rows] == list(range(9))
    assert [row["judge"] for row in outcome.rows] == [d.name for d in OTHERS for _ in range(3)]
    assert np.allclose(outcome.paths[:, 0], torch.cat([protocol.starts(judge) for judge in OTHERS]))


def test_several_may_be_shown_as_one_motion():
    """They are fitted together, and without other judges each judges."""
    cut = [OTHERS[:2], [SPIRAL]]
    tube = {"TubeDS": lambda dim: TubeDS(dim, n_layers=20, refined=False)}
    rows = compare(tube, cut, judged_by=[OTHERS[2], OTHERS], **QUICK | {"n_starts": 0})
    assert list(rows["demonstration"]) == ["low + high"] + ["unstable c=1"] * 3
    assert list(rows["judge"]) == ["slow", "low", "high", "slow"]
    ds = tube["TubeDS"](3).fit(OTHERS[:2])
    with torch.no_grad():
        path = ds.rollout(OTHERS[2].start, torch.linspace(0, OTHERS[2].duration, 50, dtype=torch.float64))
    reference = RolloutProtocol(n_points=50).reference(OTHERS[2])
    assert rows["dtw"][0] == pytest.approx(metrics.dtw(path, reference), rel=1e-6)
    assert list(compare(tube, [OTHERS[:2]], **QUICK | {"n_starts": 0})["judge"]) == ["low", "high"]


def test_a_demonstration_that_judges_itself_is_nothing_new():
    plain = compare({"m": Straight}, SPIRAL, **QUICK)
    again = compare({"m": Straight}, [[SPIRAL]], judged_by=[SPIRAL], **QUICK)
    assert plain.drop(columns=TIMES).equals(again.drop(columns=TIMES))


def test_judges_and_what_is_measured_tell_kept_cells_apart(tmp_path):
    def least(ds, cell):
        return {"least": float(ds.rate)}

    def most(ds, cell):
        return {"most": float(ds.rate)}

    protocol, found = RolloutProtocol(n_starts=0, n_points=20), []
    for settings in ({}, {"judges": OTHERS}, {"judges": OTHERS[:2]}, {"measure": least}, {"measure": most}):
        (outcome,) = run([Cell("m", Straight, SPIRAL, **settings)], protocol, n_jobs=1, store=tmp_path / "cells")
        found.append(outcome)
    for both in ([SPIRAL, *OTHERS], [*OTHERS, SPIRAL]):
        (outcome,) = run([Cell("m", Several, both, judges=SPIRAL)], protocol, n_jobs=1, store=tmp_path / "cells")
    assert [len(outcome.rows) for outcome in found] == [1, 3, 2, 1, 1]
    with CellStore(tmp_path / "cells") as store:
        assert len(store) == 7
    assert found[3].rows[0]["least"] == found[4].rows[0]["most"] > 1
    assert "least" not in found[0].rows[0]


def test_a_fitted_system_is_judged_without_another_fit():
    cell, protocol = Cell("Chebyshev", SMALL["Chebyshev"], SPIRAL, judges=OTHERS), RolloutProtocol(1, 0.1, 20)
    ds = ChebyshevDS(3, n_layers=8).fit(SPIRAL)
    ds.fit = lambda *_: pytest.fail("it was fitted again")
    judged, whole = judge(ds, cell, protocol), evaluate(cell, protocol)
    frames = [table([cell], [outcome]).drop(columns=TIMES) for outcome in (judged, whole)]
    assert frames[0].equals(frames[1])
    assert np.array_equal(judged.paths, whole.paths)
    assert judged.rows[0]["fit_seconds"] == ds.fit_report.seconds


def test_what_is_measured_gets_columns():
    rows = compare(
        {"m": Straight}, SPIRAL, measure=lambda ds, cell: {"rate": float(ds.rate), "of": cell.method}, **QUICK
    )
    assert tuple(rows.columns) == (*COLUMNS, "rate", "of")
    assert (rows["rate"] > 1).all()
    assert (rows["of"] == "m").all()


def test_a_table_has_the_order_of_the_cells():
    cells = [Cell(name, Straight, SPIRAL) for name in "abc"]
    outcomes, paths = [evaluate(cell, RolloutProtocol(1, 0.1, 20)) for cell in cells], {}
    rows = table(cells, [outcomes[2], outcomes[0]], paths)
    assert list(rows["method"]) == ["a", "a", "c", "c"]
    assert list(paths) == [cells[0].name, cells[2].name]


def test_what_is_measured_hides_no_column():
    cell = Cell("m", Straight, SPIRAL, measure=lambda ds, cell: {"mse": 0.0, "more": 1.0})
    (outcome,) = run([cell], RolloutProtocol(n_starts=0, n_points=20), n_jobs=1)
    assert "measure: expected names that rows do not have, got ['mse']" in outcome.rows[0]["error"]


@pytest.mark.parametrize(
    ("shown", "judges", "named"),
    [
        (SPIRAL, datasets.archimedean_spiral(40), "judged_by: expected demonstrations of 3 dimensions"),
        ([[SPIRAL, datasets.archimedean_spiral(40)]], None, "demonstrations: expected demonstrations of 3 dimensions"),
        ([SPIRAL], OTHERS, "judged_by: expected one item for each of the 1 motions"),
        ([SPIRAL], SPIRAL, "judged_by: expected one item for each of the 1 motions"),
        (SPIRAL, [], "judged_by: expected a Demonstration or a non-empty"),
        ([[]], None, "demonstrations: expected a Demonstration or a non-empty"),
        ([[SPIRAL], SPIRAL], None, "demonstrations: expected each only once"),
        ([[SPIRAL, SPIRAL], SPIRAL], None, "demonstrations: expected each only once"),
    ],
)
def test_bad_judges_are_refused(shown, judges, named):
    with pytest.raises(ValueError, match=f"^{named}"):
        compare({"m": Straight}, shown, judged_by=judges, **QUICK)


@pytest.mark.parametrize("name", ["shown", "judges"])
def test_a_cell_names_what_is_wrong(name):
    with pytest.raises(ValueError, match=f"^{name}: expected a Demonstration"):
        Cell("m", Straight, **{"shown": SPIRAL, "judges": SPIRAL, name: []})


def test_cells_that_are_alike_are_refused():
    with pytest.raises(ValueError, match=r"^cells: expected each only once"):
        run([Cell("a", Straight, SPIRAL), Cell("a", Slow, SPIRAL)])


@ctypes.CFUNCTYPE(None)
def ctrl_c():
    """Within a callback from compiled code, where Python drops the KeyboardInterrupt."""
    signal.raise_signal(signal.SIGINT)


class GoesOn(Straight):
    def _learn(self, shown, progress):
        ctrl_c()
        return super()._learn(shown, progress)


class Stumbles(Straight):
    def _learn(self, shown, progress):
        ctrl_c()
        raise RuntimeError("no compiled object yet")


class Raises(Straight):
    def _learn(self, shown, progress):
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt as interrupt:
            raise SystemError("returned a result with an exception set") from interrupt


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("method", [GoesOn, Stumbles, Raises])
def test_ctrl_c_is_no_failure_of_the_method_that_it_hits(method):
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            compare({"first": method, "second": Straight}, SPIRAL, **QUICK)
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)


def test_who_hears_ctrl_c_otherwise_still_does():
    heard = []
    before = signal.signal(signal.SIGINT, lambda *_: heard.append(True))
    try:
        rows = compare({"m": GoesOn}, SPIRAL, **QUICK)
    finally:
        signal.signal(signal.SIGINT, before)
    assert heard == [True]
    assert (rows["status"] == "ok").all()
    with ThreadPoolExecutor(1) as pool:  # where no handler can be set
        (outcome,) = pool.submit(lambda: list(run([Cell("m", Straight, SPIRAL)], n_jobs=1))).result()
    assert outcome.rows[0]["status"] == "ok"


class Exits(Straight):
    def _learn(self, shown, progress):
        raise SystemExit("no licence")


class Generates(Straight):
    def _learn(self, shown, progress):
        raise GeneratorExit("over")


class CannotSay(Straight):
    def _learn(self, shown, progress):
        class Mute(Exception):
            def __str__(self):
                raise RuntimeError("no text")

        raise Mute


class EndsInSaying(Straight):
    def _learn(self, shown, progress):
        class Leaves(Exception):
            def __str__(self):
                raise SystemExit

        raise Leaves


class RaisesItsOwn(Straight):
    def _learn(self, shown, progress):
        raise type("OutOfBudget", (BaseException,), {})("spent")


class SaysWhatNoFileHolds(Straight):
    def _learn(self, shown, progress):
        raise OSError(os.fsdecode(b"caf\xe9"))


class ReportsFloat32(Straight):
    def _learn(self, shown, progress):
        super()._learn(shown, progress)
        return Learned(np.float32(0.5), np.int64(3))


class HoldsBfloat16(Straight):
    def __init__(self, dim):
        super().__init__(dim)
        self.register_buffer("table", torch.zeros(3, dtype=torch.bfloat16))


class HoldsASparseTensor(Straight):
    def __init__(self, dim):
        super().__init__(dim)
        self.graph = torch.eye(3).to_sparse()


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("stored", [False, True])
@pytest.mark.parametrize(
    ("method", "status"),
    [(bad, "failed") for bad in (Exits, Generates, CannotSay, EndsInSaying, RaisesItsOwn, SaysWhatNoFileHolds)]
    + [(odd, "ok") for odd in (ReportsFloat32, HoldsBfloat16, HoldsASparseTensor)],
)
def test_one_bad_method_does_not_end_a_comparison(method, status, stored, tmp_path):
    store = {"store": tmp_path / "cells.sqlite"} if stored else {}
    rows = compare({"bad": method, "good": Straight}, SPIRAL, **QUICK, **store)
    assert rows.groupby("method")["status"].unique().map(list).to_dict() == {"bad": [status], "good": ["ok"]}
    again = compare({"bad": method, "good": Straight}, SPIRAL, **QUICK, **store)
    if stored and status == "ok":
        pd.testing.assert_frame_equal(rows, again)


@pytest.mark.parametrize(
    "value", [np.float32(1), np.int64(2), np.bool_(True), torch.tensor(0.5), np.array(3.0), "x", None]
)
def test_what_is_measured_is_kept_as_pythons_own(value, tmp_path):
    cell = Cell("m", Straight, SPIRAL, measure=lambda ds, cell: {"extra": value})
    store = tmp_path / "cells.sqlite"
    first, again = (
        [outcome.rows[0]["extra"] for outcome in run([cell], RolloutProtocol(0, 0.1, 20), n_jobs=1, store=store)]
        for _ in range(2)
    )
    assert first == again
    assert type(first[0]) in (bool, int, float, str, type(None))


def test_what_is_no_number_fails_its_cell():
    cell = Cell("m", Straight, SPIRAL, measure=lambda ds, cell: {"extra": [1, 2]})
    (outcome,) = run([cell], RolloutProtocol(0, 0.1, 20), n_jobs=1)
    assert outcome.rows[0]["error"] == "TypeError: measure: expected names with numbers or strings, got 'extra': list"


def test_what_a_store_cannot_hold_is_refused_before_any_work(tmp_path):
    store = tmp_path / "cells.sqlite"
    with pytest.raises(ValueError, match=r"^seeds: expected whole numbers below 2\*\*63 for a store, got 9"):
        run([Cell("m", Straight, SPIRAL, seed=2**63)], n_jobs=1, store=store)
    named = Demonstration(SPIRAL.positions, SPIRAL.dt, os.fsdecode(b"caf\xe9"))
    with pytest.raises(ValueError, match=r"^store: expected names that UTF-8 can write, got 'caf\\udce9'; pass name="):
        run([Cell("m", Straight, named)], n_jobs=1, store=store)
    assert not store.exists()
