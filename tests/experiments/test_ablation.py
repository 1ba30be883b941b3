"""The ablation's own arithmetic: its cells, what they measure, the floor, and goals that name what misses them."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from experiments import ablation, report
from latentds import ChebyshevDS, Demonstration, TubeDS, datasets
from latentds.benchmark import RolloutProtocol
from latentds.testing import wavy_motion


def tube(n_layers):
    return lambda dim: TubeDS(dim, n_layers=n_layers, refined=False)


def part(*cells, protocol=None):
    return ablation.Part("recordings", protocol or RolloutProtocol(n_starts=2), list(cells))


def rows_of(part, path):
    """A list for each cell: its rows as mappings."""
    rows = ablation.results(part, 1, path / "cells.sqlite", {})
    return [of.to_dict("records") for _, of in rows.groupby(["method", "demonstration"], sort=False)]


def test_floor_of_an_even_straight_line():
    """Late by a share f of the step h, a point lies f h from one sample and (1-f) h from another: h/4 on average."""
    way = np.linspace(0, 2, 1000)
    shown = Demonstration(np.stack([way, 0 * way], 1), 0.01)
    assert ablation.sampling_floor(shown, RolloutProtocol()) == pytest.approx(2 / 4, rel=0.01)


def test_joining_a_straight_line():
    """Beside its start the offset dies at κ; behind it, m steps h late, m (m+1)/2 h are lost at either end."""
    way = np.linspace(0, 2, 500)
    shown, kappa = Demonstration(np.stack([way, 0 * way], 1), 0.01), 20.0
    beside, behind = ablation.joined_floor(shown, RolloutProtocol(), np.array([[0, 0.1], [-5 * way[1], 0]]), kappa)
    assert beside == pytest.approx(0.1 * np.exp(-kappa * np.linspace(0, 1, 500)).sum(), rel=1e-3)
    assert behind == pytest.approx(5 * 6 * way[1], rel=1e-3)


def test_goals_name_what_misses_them():
    goal = report.at_most("score", pd.Series({"a": 1.0, "b": 9.0, "c": np.nan}), 8)
    assert goal.met is False
    assert "b 9" in goal.reached
    assert "c nan" in goal.reached
    assert report.at_most("score", pd.Series({"a": 1.0}), 8).met
    assert report.at_most("score", pd.Series(dtype=float), 8).met is None


def test_goals_of_measurements():
    slow, fast = np.array([3.0, 4.0, 5.0]), np.array([1.0, 1.0, 2.0])
    ratio = report.ratio("call", 3, slow, fast)
    assert ratio.reached == "4"  # of medians
    assert ratio.quartiles == "2.75 to 3.5"  # round by round
    assert ratio.note == "4 s against 1 s"
    assert ratio.met
    assert not report.median("call", "µs", 3.5, slow, at_most=True).met
    table = report.goal_table([ratio, report.Goal("other", "≤ 1", "not measured")])
    assert table.splitlines()[0] == "| what | goal | reached | quartiles | unit | met | note |"
    assert table.splitlines()[-1] == "| other | ≤ 1 | not measured |  |  | — |  |"
    alone = report.goal_table([report.Goal("other", "≤ 1", "2", met=False)])
    assert alone.splitlines()[0] == "| what | goal | reached | met |"


def test_every_idea_is_another_setting():
    found = {label: factory(3).settings for label, factory in ablation.variants("unstable c=7").items()}
    assert len({str(settings) + label[:3] for label, settings in found.items()}) == len(found) == 17
    assert set(ablation.TRIED_EVERYWHERE) <= set(found)
    assert found["TubeDS, straight alone"]["homotopy"] == "linear"
    assert found["TubeDS, unbending alone"]["homotopy"] == "curvature"
    assert found["Chebyshev + both"] == ChebyshevDS(3, n_layers=175, steps=17, refined=True).settings


def test_parts_hold_who_is_shown_and_who_judges():
    spirals = [datasets.unstable_spiral(3, 50), datasets.stable_spiral(2, 50)]
    seven = [Demonstration(wavy_motion(2, seed=i).positions, 0.01, "shape") for i in range(7)]
    found = {p.family: p for p in ablation.parts(spirals, [datasets.joint_motion(0, 50)], {"shape": seven})}
    assert list(found) == ["unstable", "stable", "more starts", "layers", "recordings", "LASA", "LASA, six shown"]
    assert [len(p.cells) for p in found.values()] == [17, 17, 2, 2, 8, 8, 3]
    first = found["LASA"].cells[0]
    assert (first.shown, first.judges) == ((seven[0],), tuple(seven))
    last = found["LASA, six shown"].cells[-1]
    assert (last.shown, last.judges, last.demonstration) == (tuple(seven[:6]), (seven[6],), "shape")
    assert found["layers"].cells[0].factory(3).n_layers + 2 == 75 // 2


def test_a_cell_tells_its_scores_and_costs(tmp_path):
    shown = wavy_motion(2)
    (rows,) = rows_of(part(ablation.cell("TubeDS", tube(20), shown)), tmp_path)
    assert [row["start"] for row in rows] == list(range(3))
    assert rows[0]["share"] == pytest.approx(rows[0]["dtw"] / 500 / shown.size)
    assert rows[0]["share"] < 0.01
    assert rows[0]["attractor_exact"]
    assert rows[0]["condition_path"] >= 1
    assert rows[0]["homotopy"] in ("linear", "curvature", "zoom")


def test_a_cell_that_fails_says_so(tmp_path):
    loop = np.linspace(0, 2 * np.pi, 100)
    shown = Demonstration(np.stack([np.cos(loop), np.sin(loop)], 1), 0.01, "loop")
    (rows,) = rows_of(part(ablation.cell("TubeDS", TubeDS, shown, judges=[shown])), tmp_path)
    assert rows[0]["status"] == "failed"
    assert "does not meet itself" in rows[0]["error"]
    assert np.isnan(rows[0]["share"])


@pytest.mark.slow
def test_a_rerun_goes_on_where_it_stopped(tmp_path):
    shown = Demonstration(wavy_motion(2).positions, 0.01, "shown")
    few, more = (ablation.cell(f"TubeDS {n}", tube(n), shown) for n in (10, 20))
    several = ablation.cell("TubeDS", tube(10), [shown, shown], judges=shown)
    (first,) = rows_of(part(few), tmp_path)
    again = rows_of(part(more, few, several), tmp_path)
    assert again[1] == first  # fit seconds and all
    assert [rows[0]["method"] for rows in again] == ["TubeDS 20", "TubeDS 10", "TubeDS"]


def test_the_summary_tells_every_table(tmp_path):
    spiral, seven = datasets.unstable_spiral(3, 60), [wavy_motion(2, seed=i) for i in range(7)]
    found = [
        {
            "family": p.family,
            "method": c.method,
            "demonstration": c.demonstration or "shape",
            "start": start,
            "dim": d.dim,
        }
        | {"status": "ok", "error": "", "dtw": 1.0 + start, "share": 1e-3, "mse": 1e-6, "fit_seconds": 0.1}
        | {"condition_path": 5.0, "attractor_exact": True, "homotopy": "linear"}
        | {"largest_velocity": 2.0, "largest_gradient": 700.0}
        for p in ablation.parts([spiral], [datasets.joint_motion(0, 60)], {"shape": seven})
        for c in p.cells
        for d in c.judges
        for start in range(2)
    ]
    rows = pd.DataFrame(found)
    summary = ablation.summarize(rows, {spiral.name: (0.5, 1.5)}, {False: 0.5, True: 20.0})
    assert "| fit of 150 layers to 1000 points, refinement on | ≤ 10 s | 20 s | **no** |" in summary
    assert "| attractor is the goal | to 1e-9 of the size | all | yes |" in summary
    assert (
        "FDM + both, unstable c=3: MSE with 37 of the paper's 75 layers | (paper 9.64e-08) | 1.00e-06 | — |" in summary
    )
    assert "## Failures" not in summary
    rows["attractor_exact"] = rows["attractor_exact"].astype(object).mask(rows["method"] == "TubeDS")  # as if it failed
    assert "| attractor is the goal | to 1e-9 of the size | not all | **no** |" in ablation.summarize(
        rows, {spiral.name: (0.5, 1.5)}, {False: 0.5, True: 20.0}
    )
