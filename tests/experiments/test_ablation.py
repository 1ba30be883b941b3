"""The ablation's own arithmetic: the sampling floor, one isotopy alone, goals that name what misses them."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from experiments import ablation
from latentds import Demonstration, TubeDS
from latentds.store import CellStore
from latentds.testing import wavy_motion


def test_floor_of_an_even_straight_line():
    """Late by a share f of the step h, a point lies f h from one sample and (1-f) h from another: h/4 on average."""
    way = np.linspace(0, 2, 1000)
    shown = Demonstration(np.stack([way, 0 * way], 1), 0.01)
    assert ablation.sampling_floor(shown) == pytest.approx(2 / 4, rel=0.01)


def test_joining_a_straight_line():
    """Beside its start the offset dies at κ; behind it, m steps h late, m (m+1)/2 h are lost at either end."""
    way = np.linspace(0, 2, 500)
    shown, kappa = Demonstration(np.stack([way, 0 * way], 1), 0.01), 20.0
    beside, behind = ablation.joined(shown, np.array([[0, 0.1], [-5 * way[1], 0]]), kappa)
    assert beside == pytest.approx(0.1 * np.exp(-kappa * np.linspace(0, 1, 500)).sum(), rel=1e-3)
    assert behind == pytest.approx(5 * 6 * way[1], rel=1e-3)


@pytest.mark.parametrize("isotopy", ["straight", "unbending"])
def test_one_isotopy_alone(isotopy):
    with ablation.only(isotopy):
        report = TubeDS(2, n_layers=20, refined=False).fit(wavy_motion(2)).fit_report
    assert report.isotopy == isotopy


def test_goals_name_what_misses_them():
    goal = ablation.most("score", pd.Series({"a": 1.0, "b": 9.0, "c": np.nan}), 8)
    assert goal.met is False
    assert "b 9" in goal.reached
    assert "c nan" in goal.reached
    assert ablation.most("score", pd.Series({"a": 1.0}), 8).met
    assert ablation.most("score", pd.Series(dtype=float), 8).met is None


def test_a_trial_tells_its_scores_and_costs():
    shown = wavy_motion(2)
    rows, paths = ablation.attempt(
        ablation.Trial("recordings", "TubeDS", lambda dim: TubeDS(dim, n_layers=20, refined=False), [shown])
    )
    assert paths.shape == (7, 500, 2)
    assert [row["start"] for row in rows] == list(range(7))
    assert rows[0]["share"] == pytest.approx(rows[0]["dtw"] / 500 / shown.size)
    assert rows[0]["share"] < 0.01
    assert rows[0]["attractor_exact"]
    assert rows[0]["condition_path"] >= 1


def test_a_trial_that_fails_says_so():
    loop = np.linspace(0, 2 * np.pi, 100)
    shown = Demonstration(np.stack([np.cos(loop), np.sin(loop)], 1), 0.01, "loop")
    rows, _ = ablation.attempt(ablation.Trial(ablation.LASA, "TubeDS", TubeDS, [shown], [shown]))
    assert rows[0]["status"] == "failed"
    assert "does not meet itself" in rows[0]["error"]
    assert np.isnan(rows[0]["share"])


def test_a_rerun_goes_on_where_it_stopped(tmp_path):
    shown, file = wavy_motion(2), tmp_path / "cells.sqlite"
    few, more = (
        ablation.Trial("recordings", f"TubeDS {n}", lambda dim, n=n: TubeDS(dim, n_layers=n, refined=False), [shown])
        for n in (10, 20)
    )
    several = ablation.Trial(ablation.SIX, "TubeDS", few.factory, [shown, shown], [shown])
    (first,) = ablation.results([few], 1, file)
    again = list(ablation.results([more, few, several], 1, file))
    assert again[1][0] == tuple(first[0])  # fit seconds and all
    np.testing.assert_array_equal(again[1][1], first[1])
    assert [rows[0]["method"] for rows, _ in again] == ["TubeDS 20", "TubeDS 10", "TubeDS"]
    assert [len(rows) for rows, _ in again] == [7, 7, 1]
    with CellStore(file) as store:
        assert len(store) == 3


def test_recordings_are_read_from_files_and_folders(tmp_path):
    for name in ("one", "two"):
        shown = wavy_motion(2)
        Demonstration(shown.positions, shown.dt, name).save(tmp_path / f"{name}.npz")
    assert [shown.name for shown in ablation.load([tmp_path])] == ["one", "two"]
    with pytest.raises(ValueError, match="data: expected recordings of different names"):
        ablation.load([tmp_path, tmp_path / "one.npz"])
    with pytest.raises(ValueError, match="data: expected"):
        ablation.load([tmp_path / "three.txt"])
