"""The field's protocols, scores and statistics, against their definitions and by hand."""

from __future__ import annotations

import json
import math

import numpy as np
import pandas as pd
import pytest
import torch
from scipy import stats
from typer.testing import CliRunner

from baselines import DMP
from experiments.field import __main__ as command
from experiments.field import motions as field
from experiments.field import page, references, scores
from experiments.field.methods import METHODS, OURS, factory_of
from experiments.field.motions import Motion
from experiments.field.ranks import against, holm, ranked
from latentds import Demonstration, TubeDS
from latentds.benchmark import Cell
from latentds.testing import wavy_motion


def straight(*starts, n_points=11):
    """Straight motions to 0 in a second from each start in the plane."""
    way = torch.linspace(1, 0, n_points, dtype=torch.float64)[:, None]
    return [Demonstration(way * torch.tensor(y), 1 / (n_points - 1), f"line {i}") for i, y in enumerate(starts)]


# --- what is shown ----------------------------------------------------------------------------------------------------


def test_protocols_show_what_they_say():
    shape = [Demonstration(torch.rand(41, 2), 0.1, f"shape {i}") for i in range(7)]
    kept = field.held_out("shape", shape)
    assert all(torch.equal(d.positions, whole.positions[::2]) for d, whole in zip(kept.shown, shape[:4], strict=True))
    assert [d.name for d in kept.judges] == [f"shape {i}" for i in range(4, 7)]
    assert kept.shown[1].duration == pytest.approx(shape[1].duration)
    out = field.leave_one_out("shape", shape, 3)
    assert [d.name for d in out.shown] == [f"shape {i}" for i in (0, 1, 2, 4, 5, 6)]
    assert out.judges == (shape[3],)
    inside = field.in_sample("shape", shape)
    assert [len(d) for d in inside.shown] == [11] * 7
    assert [d.name for d in inside.judges] == [d.name for d in shape]
    assert torch.equal(inside.judges[2].positions, shape[2].positions[::10])
    for wrong, fold in ((shape, 7), (shape, -1), (shape[:1], 0)):
        with pytest.raises(ValueError, match="expected"):
            field.leave_one_out("shape", wrong, fold)


def test_without_handwriting_there_are_motions_and_names_are_never_shared(monkeypatch):
    monkeypatch.setattr(field, "handwriting", dict)
    every = field.motions(False)
    assert {motion.protocol for motion in every} == {field.ALONE}
    assert len({motion.name for motion in every}) == len(every) == 16
    monkeypatch.setattr(
        field, "handwriting", lambda: {name: straight(*[(1.0, 0.0)] * 7, n_points=41) for name in field.TEN}
    )
    every = field.motions(False)
    assert len({motion.name for motion in every}) == len(every) == 16 + 10 * 4
    assert {page.family_of(motion) for motion in every} == {
        "handwriting, 4 shown", "6 shown", "7 shown", "spirals", "joints", "strokes",
    }  # fmt: skip


def test_printed_hyperparameters_are_taken_where_there_are_some():
    winding, hook = (Motion(name, field.ALONE, (wavy_motion(3),)) for name in ("unstable c=7", "hook"))
    assert factory_of("FDM", winding)(3).n_layers == 150
    assert factory_of("FDM", winding)(3).beta == 0.6
    assert factory_of("FDM", hook)(2).n_layers is None
    assert factory_of("ProMP", hook)(2).n_basis == 50
    assert factory_of("ProMP", hook._replace(shown=hook.shown * 2))(2).n_basis == 20
    assert isinstance(factory_of(OURS, winding)(3), TubeDS)


# --- scores -----------------------------------------------------------------------------------------------------------


def test_velocity_errors_are_as_defined():
    shown = [wavy_motion(2, seed, n_points=60) for seed in (0, 1)]
    ds = TubeDS(2)
    total, turned, count, moving = 0.0, 0.0, 0, 0
    for d in shown:
        for y, v in zip(d.positions, d.velocities.numpy(), strict=True):
            w = ds(y).detach().numpy()
            total, count = total + np.sqrt(((w - v) ** 2).mean()), count + 1
            if np.linalg.norm(v) > 0:
                turned += abs(1 - w @ v / np.linalg.norm(w) / np.linalg.norm(v))
                moving += 1
    found = scores.velocity_errors(ds, shown)
    assert found["rmse"] == pytest.approx(total / count)
    assert found["e"] == pytest.approx(turned / moving)


def test_references_are_as_worked_out_by_hand():
    """The mean of two lines along x, 2 and 4 long, is 3 long; a start beside it at x = 1.5 is one unit off."""
    shown, start = straight((2.0, 0.0), (4.0, 0.0)), torch.tensor([1.5, 1.0], dtype=torch.float64)
    times = torch.tensor([0.0, 0.25, 0.5, 2.0], dtype=torch.float64)
    assert references.plain_mean(shown, start, times) == pytest.approx(np.array([[3, 0], [2.25, 0], [1.5, 0], [0, 0]]))
    late = [[1.5, 1], [1.125, 0.75], [0.75, 0.5], [0, 0]]
    assert references.dying_offset(shown, start, times) == pytest.approx(np.array(late))
    joined = [[1.5, 1], [0.75, 0.5], [0, 0], [0, 0]]
    assert references.nearest_join(shown, start, times) == pytest.approx(np.array(joined))
    at = torch.tensor([[1.9, 5.0], [-1.0, 0.0]], dtype=torch.float64)
    assert references.nearest_velocity(shown[:1], at).numpy() == pytest.approx(np.array([[-2.0, 0], [-2, 0]]))
    for wrong in ((start[:1], times), (start, -times), (start, times[:, None])):
        with pytest.raises(ValueError, match="expected"):
            references.dying_offset(shown, *wrong)


def test_curves_are_scored_as_worked_out_by_hand():
    """Beside a line of length 1 a parallel one lies as far off at each of its points as at any other."""
    shown = straight((1.0, 0.0), (1.0, 0.0))
    moved = Demonstration(shown[0].positions + torch.tensor([0.0, 0.5]), 0.1, "line 2")
    rows = scores.referred(Motion("line", field.HELD_OUT, tuple(shown), (moved,)))
    mean = next(row for row in rows if row["method"] == "plain mean")
    assert mean["own"] == pytest.approx(0, abs=1e-12)
    assert mean["unseen"] == pytest.approx(0.5)
    assert mean["dtwd"] == pytest.approx(0.5 * scores.N_POINTS)
    assert (mean["command"], mean["arrives"]) == (pytest.approx(1.0), 1.0)
    assert 0.95 <= mean["arrival"] <= 1.0  # within 2 % of its length at .98, looked at every .05
    nearest = next(row for row in rows if row["method"] == "nearest velocity")
    assert nearest["test_rmse"] == pytest.approx(0, abs=1e-12)


def test_a_motion_that_is_lost_or_stays_away_is_scored_so():
    shown = straight((1.0, 0.0))
    motion = Motion("line", field.ALONE, tuple(shown))
    lost = scores.of_curves(motion, lambda starts, times: np.full((len(starts), len(times), 2), np.nan))
    assert lost["own"] == math.inf
    assert lost["arrives"] == 0
    assert math.isnan(lost["arrival"])
    still = scores.of_curves(motion, lambda starts, times: starts.numpy()[:, None].repeat(len(times), 1))
    assert still["own"] == pytest.approx(0.5, rel=0.01)  # from 1 to points between 0 and 1
    assert (still["command"], still["arrives"]) == (0.0, 0.0)


def test_a_fields_motion_goes_on_after_it_was_held_and_a_clock_ran_on():
    shown = wavy_motion(2)
    motion = Motion("wavy", field.ALONE, (shown,))
    for method, least, most in ((TubeDS, 0, 0.005), (DMP, 0.01, 1)):
        ds = method(2).fit(shown)
        figures = scores.measured(ds, Cell("any", method, shown), motion, pictured=False)
        assert least <= figures["held"] <= most
        assert figures["held"] < figures["pushed"] or method is DMP
        assert figures["own"] < 0.01
    half = torch.tensor([0, shown.duration / 2], dtype=torch.float64)
    ds = TubeDS(2).fit(shown)
    with torch.no_grad():
        there = ds.rollout(shown.start, half)[-1]
        rest = ds.rollout(there, shown.duration / 2 * torch.linspace(0, 1, 250, dtype=torch.float64)).numpy()
        found = scores.pushed_and_held(ds, shown)["held"]
    wanted = shown.at(shown.duration / 2 * (1 + np.linspace(0, 1, 250)))
    assert found == pytest.approx(scores.metrics.dtw(rest, wanted) / 250 / shown.size)


def test_dtwd_by_ds_opts_rule_counts_lingering():
    shown = Demonstration(
        torch.linspace(100, 0, 101, dtype=torch.float64)[:, None] * torch.tensor([1.0, 0.0]), 0.01, "l"
    )

    def exact(starts, times):
        left = (starts[0, 0] - 100 * times).clamp(min=0)
        return torch.stack([left, 0 * left], -1).numpy()[None]

    def stops_beside(starts, times):  # by 10, where it creeps on until step 3000
        left = (starts[0, 0] - 100 * times).clamp(min=0)
        return torch.stack([left, torch.where(left > 0, 0.0, 10 + times)], -1).numpy()[None]

    begins = 100 - scores.THEIR_START + 1
    missed = sum(100 - begins - k for k in range(100 - begins))
    assert scores.their_dtwd(exact, [shown]) == pytest.approx(missed, rel=1e-6)
    assert scores.their_dtwd(stops_beside, [shown]) > 10 * 2900


def brute_force(path, reference, join):
    """The least over all monotone alignments, one by one, of what ``join`` makes of the distances of its pairs."""
    last = len(path) - 1, len(reference) - 1

    def ways(i, j):
        if (i, j) == last:
            return [[(i, j)]]
        ahead = [(i + a, j + b) for a, b in ((1, 0), (0, 1), (1, 1)) if i + a <= last[0] and j + b <= last[1]]
        return [[(i, j), *way] for step in ahead for way in ways(*step)]

    return min(join(np.linalg.norm(path[i] - reference[j]) for i, j in way) for way in ways(0, 0))


def test_protocol_a_is_as_defined():
    shape = [wavy_motion(2, seed, n_points=41) for seed in range(3)]
    ds = TubeDS(2, n_layers=20, refined=False).fit(shape[0])
    errors = []
    for d in shape:
        samples = d.positions[::10].numpy()
        path = ds.rollout(d.start, 10 * d.dt * torch.arange(5, dtype=torch.float64)).detach().numpy()
        rmse = np.sqrt(sum((a - b) ** 2 for a, b in zip(path.flat, samples.flat, strict=True)) / 10)
        errors.append([rmse, brute_force(path, samples, sum) / 5, brute_force(path, samples, max)])
    found = scores.measured(ds, Cell("any", TubeDS, shape), field.in_sample("wavy", shape), pictured=False)
    assert [found[f"{name}_a"] for name in ("rmse", "dtwd", "fd")] == pytest.approx(np.mean(errors, axis=0))


# --- statistics -------------------------------------------------------------------------------------------------------


def test_ranks_and_critical_difference_are_those_of_demsar():
    """His table 2 and section 3.2.2: four methods on fourteen sets, chi² 9.28, and CD 1.25 at .05."""
    ranks = {"C4.5": 3.143, "+m": 2.000, "+cf": 2.893, "+m+cf": 1.964}
    found = ranked(pd.DataFrame(np.random.default_rng(0).random((14, 4)), columns=list(ranks)))
    assert found.critical == pytest.approx(1.25, abs=0.01)
    chi = 12 * 14 / (4 * 5) * (sum(rank**2 for rank in ranks.values()) - 4 * 25 / 4)
    assert chi == pytest.approx(9.28, abs=0.05)  # his numbers, by the formula that SciPy is held to here:
    few = pd.DataFrame({"a": [1, 1, 1, 2], "b": [2, 2, 3, 1], "c": [3, 3, 2, 3]})
    mean = few.rank(axis=1).mean()
    chi = 12 * 4 / (3 * 4) * (mean.pow(2).sum() - 3 * 16 / 4)
    assert ranked(few).p == pytest.approx(stats.chi2.sf(chi, 2))
    assert list(ranked(few).mean.index) == ["a", "b", "c"]


def test_failures_rank_last_and_motions_without_scores_do_not_count():
    frame = pd.DataFrame({"a": [1.0, math.nan, math.nan], "b": [math.inf, 2.0, math.nan], "c": [3.0, 3.0, math.nan]})
    found = ranked(frame)
    assert found.n_motions == 2
    assert found.mean.to_dict() == {"a": 2.0, "b": 2.0, "c": 2.0}


def test_holm_is_as_worked_out_by_hand():
    p = pd.Series({"a": 0.01, "b": 0.04, "c": 0.03, "d": 0.9})
    assert holm(p).round(6).to_dict() == {"a": 0.04, "b": 0.09, "c": 0.09, "d": 0.9}


def test_wilcoxon_holds_every_other_against_one():
    draw = np.random.default_rng(0)
    ours = draw.random(12)
    frame = pd.DataFrame({"ours": ours, "same": ours, "worse": ours + draw.random(12) + 0.1, "lost": [math.nan] * 12})
    p = against(frame, "ours")["p"]
    assert p["same"] == 1.0
    assert p["worse"] == pytest.approx(3 * stats.wilcoxon(frame["worse"] - frame["ours"]).pvalue)
    assert p["lost"] < 0.01
    assert not against(frame, "ours")["better"].any()
    assert against(frame.drop(columns="same"), "worse")["better"].to_dict() == {"ours": True, "lost": False}


# --- what is told -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    """The command, with two methods and two motions."""
    folder = tmp_path_factory.mktemp("field")
    patch = pytest.MonkeyPatch()
    shape = [wavy_motion(2, 0, n_points=60)] * 7
    every = [field.held_out("wavy", shape), Motion("hook", field.ALONE, (wavy_motion(2, 1, n_points=60),))]
    fewer = {OURS: lambda dim: TubeDS(dim, n_layers=30, refined=False), "DMP": DMP, "FDM": METHODS["FDM"]}
    try:
        patch.setattr(command, "METHODS", fewer)
        patch.setattr(command, "factory_of", lambda label, motion: fewer[label])
        patch.setattr(command, "motions", lambda quick, data: every)
        app = command.typer.Typer()
        app.command()(command.main)
        result = CliRunner().invoke(app, ["--quick", "--out", str(folder), "--jobs", "1"], catch_exceptions=False)
    finally:
        patch.undo()
    return folder, result.output, every


def test_the_command_leaves_a_page_rows_and_pictures(told):
    folder, said, _ = told
    rows = pd.read_csv(folder / "rows.csv")
    assert set(rows["motion"]) == {"wavy 4", "hook"}
    assert {"own", "beside", "unseen", "test_rmse", "pushed", "held", "arrives", "us", "claims"} <= set(rows.columns)
    assert (rows.loc[rows["method"].isin(["TubeDS", "DMP", "FDM"]), "status"] == "ok").all()
    assert {"field.html", "summary.md", "grid.png", "ranks.png", "time.png"} <= {path.name for path in folder.iterdir()}
    text = (folder / "summary.md").read_text()
    assert text.strip() in said
    page = (folder / "field.html").read_text()
    assert page.count("data:image/png") == 3
    assert "http" not in page.split("</style>")[1]


def test_what_is_drawn_is_the_field_and_the_motions(told):
    every = told[2]
    ds, (motion, _) = TubeDS(2), every
    kept = json.loads(scores.drawn(ds, motion)["drawn"])
    x, y = scores.window(motion)
    corner = torch.tensor([x[3], y[5]])
    assert kept["field"][5][3] == pytest.approx(ds(corner).tolist(), abs=1e-3)
    assert np.array(kept["paths"])[:, 0] == pytest.approx(
        np.stack([one.start.numpy() for one in (*motion.shown, *motion.judges)]), abs=1e-3
    )


def rows_of(**methods):
    """A row for each method and motion: its score is asked as "own"."""
    return pd.DataFrame(
        [
            {"method": method, "motion": f"m{i}", "protocol": field.ALONE, "seed": 0, "own": value, "family": "strokes"}
            for method, values in methods.items()
            for i, value in enumerate(values)
        ]
    )


def test_the_verdict_names_where_ours_is_behind_and_only_where_it_is_told_apart():
    many = {name: [3.0 + i] * 30 for i, name in enumerate(("FDM", "SEDS", "CLF-DM"))}
    behind = rows_of(**many, TubeDS=[9.0] * 30)
    ranking = page.ranking_of(behind, "own")
    text = page.verdict(behind, {"own": ranking})
    assert "among the fields to CLF-DM in repeats; FDM in repeats; SEDS in repeats;" in text
    assert text.endswith("Lowest mean rank of the fields: FDM in repeats.")
    ahead = rows_of(**many, TubeDS=[1.0] * 30)
    assert "among the fields to none; on handwriting, among what is no field, to none" in page.verdict(
        ahead, {"own": page.ranking_of(ahead, "own")}
    )
    table = page.rank_table({"own": ranking})
    assert table.iloc[0, 0] == "**1.0**"
    assert table.loc["TubeDS"].iloc[0] == "4.0"
    signs = page.against_table(behind)["repeats"]
    assert signs["FDM"].endswith("+")


def test_medians_worst_and_losses_are_told():
    rows = rows_of(TubeDS=[1.0, 2.0, 4.0], FDM=[1.0, math.nan, math.inf], DMP=[1.0, 1.0, 1.0])
    table = page.by_family(rows, "own")
    assert table["strokes [3]"].to_dict() == {"TubeDS": "2 (4)", "FDM": "lost (lost)", "DMP": "1 (1)"}
