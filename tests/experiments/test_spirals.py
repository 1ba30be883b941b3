"""The head-to-head's tables say what its rows say."""

import itertools
import json

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from experiments import spirals
from latentds import ChebyshevDS, benchmark
from latentds.benchmark import COLUMNS


def made_up(score):
    """Rows of two methods on two spirals, scores by a function of (method, spiral, start)."""
    rows = [
        {"method": m, "demonstration": d, "seed": 0, "start": s, "status": "ok", "error": "", "follows": True}
        | {"converged": True, "dtw": score(m, d, s), "dtw_fast": score(m, d, s), "mse": 1e-6}
        for d in ("unstable c=3", "unstable c=7")
        for m in ("Chebyshev", "FDM")
        for s in range(5)
    ]
    return pd.DataFrame(rows, columns=list(COLUMNS))


def line(summary, section, spiral):
    after = summary.split(section)[1]
    return next(row for row in after.splitlines() if row.startswith(f"| {spiral} "))


def summary_of(rows):
    return spirals.summarize(rows, ["unstable c=3", "unstable c=7"], ["Chebyshev", "FDM"])


@pytest.mark.filterwarnings("ignore:Precision loss")  # made-up scores differ by a constant
def test_means_spreads_and_the_best_in_bold():
    rows = made_up(lambda m, d, s: 100 if s == 0 else s + (10 if m == "FDM" else 0))
    found = line(summary_of(rows), "exact DTW over", "unstable c=7")
    assert found.startswith("| unstable c=7 | **2.50 ± 1.29** | 12.50 ± 1.29 | ")
    assert line(summary_of(rows), "exact DTW from the demonstrated", "unstable c=7").count("**100.00**") == 2


def test_p_values_are_paired_and_welchs():
    rng = np.random.default_rng(0)
    noise = {s: rng.standard_normal() for s in range(5)}
    rows = made_up(lambda m, d, s: 10 + noise[s] + (0.1 + 0.01 * s if m == "FDM" else 0))
    paired, welch = line(summary_of(rows), "exact DTW over", "unstable c=3").split("|")[-2].split("/")
    assert float(paired) < 0.001 < 0.5 < float(welch)  # a small, steady difference under a large shared spread


def test_fits_that_do_not_follow_are_told_for_each_spiral_and_seed():
    first = made_up(lambda m, d, s: 1.0)
    off = first.assign(seed=1, follows=first["method"] != "FDM")
    off.loc[(off["method"] == "Chebyshev") & (off["demonstration"] == "unstable c=3"), "method"] = "third"
    assert line(summary_of(first), "Fits that follow", "unstable c=7") == "| unstable c=7 | yes | yes |"
    assert line(summary_of(off), "Fits that follow", "unstable c=7") == "| unstable c=7 | yes | **no** |"
    assert line(summary_of(off), "Fits that follow", "unstable c=3") == "| unstable c=3 | — | **no** |"
    both = line(summary_of(pd.concat([first, off])), "Fits that follow", "unstable c=7")
    assert both == "| unstable c=7 | yes | 1 of 2 seeds |"


def test_seeds_stand_side_by_side_for_the_methods_that_they_change():
    first = made_up(lambda m, d, s: 10.0 + s).assign(seed=0)
    second = first.assign(seed=1, dtw=first["dtw"] + (first["method"] == "FDM"))
    summary = summary_of(pd.concat([first, second]))
    assert line(summary, "seed by seed", "unstable c=7") == "| unstable c=7 | FDM | 10.00 | 11.00 |"
    assert "| unstable c=7 | Chebyshev |" not in summary.split("seed by seed")[1]
    assert "seed by seed" not in summary_of(first)


@pytest.mark.filterwarnings("ignore:Precision loss")  # made-up scores differ by a constant
def test_fast_dtw_that_differs_is_marked():
    rows = made_up(lambda m, d, s: 10.0 + 1e-3 * s)
    rows.loc[(rows["method"] == "FDM") & (rows["demonstration"] == "unstable c=3"), "dtw_fast"] = 10.6
    rows.loc[(rows["method"] == "FDM") & (rows["demonstration"] == "unstable c=7"), "dtw_fast"] = 10.4
    summary = summary_of(rows)
    assert "**10.00 ± 0.00** †" in line(summary, "exact DTW over", "unstable c=3")
    assert "†" not in line(summary, "exact DTW over", "unstable c=7")
    assert "differs by at most 6.0%: FDM at unstable c=3." in summary


def test_the_papers_mse_stands_beside_ours():
    found = line(summary_of(made_up(lambda m, d, s: 1.0 + s)), "Table I", "unstable c=7")
    assert "| 1.00e-06 | 7.26e-06 | 0.14 | 1.00e-06 | 3.35e-06 | 0.30 |" in found


def test_failures_are_told():
    rows = made_up(lambda m, d, s: np.nan if m == "FDM" and d == "unstable c=7" else 1.0 + s)
    lost = (rows["method"] == "FDM") & (rows["demonstration"] == "unstable c=7")
    rows.loc[lost, ["status", "error"]] = ["failed", "RuntimeError: lost"]
    assert "| failed |" in line(summary_of(rows), "exact DTW over", "unstable c=7")
    assert "FDM | failed | RuntimeError: lost | 5 |" in summary_of(rows)
    assert "None." in summary_of(made_up(lambda m, d, s: 1.0 + s))


def test_a_method_that_is_not_done_leaves_a_gap():
    rows = made_up(lambda m, d, s: 1.0 + s)
    rows = rows[rows["method"] == "Chebyshev"]
    assert "| — |" in line(summary_of(rows), "exact DTW over", "unstable c=7")


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(spirals, "methods", lambda *_: {
        "Chebyshev": lambda dim: ChebyshevDS(dim, n_layers=8),
        "FDM": lambda dim: ChebyshevDS(dim, n_layers=5),
    })  # fmt: skip


def command(*arguments):
    import typer

    app = typer.Typer()
    app.command()(spirals.main)
    return CliRunner().invoke(app, ["--quick", "--jobs", "1", *map(str, arguments)])


@pytest.mark.slow
def test_the_command_leaves_rows_summary_settings_and_pictures(small, tmp_path):
    result = command("--out", tmp_path / "new")
    assert result.exit_code == 0, result.output
    found = {path.name for path in (tmp_path / "new").iterdir()}
    pictures = {
        "report.html",
        "unstable_c3.png",
        "unstable_c7.png",
        "stable_c2.png",
        "dtw_unstable.png",
        "dtw_stable.png",
    }
    assert found == {"rows.csv", "summary.md", "settings.json", "report.html", "cells.sqlite"} | pictures
    rows = pd.read_csv(tmp_path / "new" / "rows.csv")
    assert len(rows) == 3 * 2 * 21
    assert "unstable c=7" in result.output
    settings = json.loads((tmp_path / "new" / "settings.json").read_text())
    assert settings["methods"]["unstable c=7"]["Chebyshev"]["n_layers"] == 8
    assert settings["environment"]["packages"]["torch"]
    assert settings["protocol"] == {"n_starts": 20, "radius": 0.1, "n_points": 500, "fast_dtw": True}


@pytest.mark.slow
def test_an_interrupted_command_tells_what_is_done(small, tmp_path, monkeypatch):
    def stopped(*arguments, **settings):
        yield from itertools.islice(benchmark.run(*arguments, **settings), 1)
        raise KeyboardInterrupt

    monkeypatch.setattr(spirals, "run", stopped)
    result = command("--out", tmp_path)
    assert result.exit_code == 130
    assert "Interrupted: 1 of 6 cells are done" in result.output
    assert len(pd.read_csv(tmp_path / "rows.csv")) == 21
    assert (tmp_path / "dtw_unstable.png").exists()
