"""The paper's head-to-head: every method learns ten spirals and starts at the demonstrated point and 20 around it.

    python -m experiments.spirals [--quick] [--out results/spirals] [--jobs N] [--seeds 0 --seeds 1 …] [--dask tcp://…]

Leaves rows.csv, summary.md, settings.json, pictures and report.html, all of it to look at, in ``--out``.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from itertools import chain
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
import typer
from rich.console import Console
from rich.markdown import Markdown

from experiments import report
from experiments.compared import RIVALS, cluster, methods, spirals
from experiments.published import TABLE_ONE
from latentds import Demonstration, plotting
from latentds import report as page
from latentds.benchmark import COLUMNS, Cell, Outcome, Paths, RolloutProtocol, run, table


def main(
    quick: Annotated[bool, typer.Option(help="Three spirals and a smaller SDS-EF: a minute or two.")] = False,
    out: Annotated[Path, typer.Option(help="Folder for rows, summary, settings and pictures.")] = Path(
        "results/spirals"
    ),
    jobs: Annotated[int | None, typer.Option(help="Processes; all cores by default.")] = None,
    seeds: Annotated[list[int] | None, typer.Option(help="Repeat for more; 0 by default.")] = None,
    dask: Annotated[str | None, typer.Option(help="Scheduler of a Dask cluster, tcp://…, to run on.")] = None,
) -> None:
    """Compare the methods on the paper's spirals.

    Finished cells are kept in cells.sqlite beside the results: an interrupted run goes on where it stopped.
    """
    began, console = time.perf_counter(), Console(width=None if sys.stdout.isatty() else 120)
    shown, seeds = spirals(quick), seeds or [0]
    cells = [
        Cell(label, f, d, seed, measure=page.findings)
        for d in shown
        for label, f in methods(d.name, quick).items()
        for seed in seeds
    ]
    done: list[Outcome] = []
    out.mkdir(parents=True, exist_ok=True)
    try:
        with cluster(dask):
            for outcome in run(cells, PROTOCOL, n_jobs=jobs, progress=True, store=out / "cells.sqlite"):
                done.append(outcome)
    except KeyboardInterrupt:
        console.print(f"Interrupted: {len(done)} of {len(cells)} cells are done; the same command goes on from here.")
    if done:
        paths: Paths = {}
        every = table(cells, done, paths)
        rows = every[list(COLUMNS)]
        seconds = time.perf_counter() - began
        settings = {
            "command": {"quick": quick, "jobs": jobs, "seeds": seeds, "seconds": round(seconds, 1)},
            "protocol": asdict(PROTOCOL),
            "methods": {d.name: {m: f(d.dim).settings for m, f in methods(d.name, quick).items()} for d in shown},
        }
        summary = summarize(rows, [d.name for d in shown], list(methods(shown[0].name, quick)))
        report.write(out / "rows.csv", rows.to_csv(index=False))
        report.write(out / "settings.json", settings | {"environment": report.environment()})
        report.write(out / "summary.md", summary)
        draw(rows, paths, shown, out)
        page.write(out / "report.html", every, shown, paths=paths, settings=settings)
        console.print(Markdown(summary))
        console.print(f"{out}: report.html, rows.csv, summary.md, settings.json and pictures, after {seconds:.0f} s")
    if len(done) < len(cells):
        raise typer.Exit(130)


def summarize(rows: pd.DataFrame, names: list[str], labels: list[str]) -> str:
    """The tables, as Markdown."""
    near, demonstrated = rows[rows["start"] > 0], rows[rows["start"] == 0]
    parts = []
    for family in dict.fromkeys(name.split()[0] for name in names):
        members = [name for name in names if name.startswith(family)]
        title = f"{family.capitalize()} spirals"
        parts += [f"## {title}: exact DTW over the perturbed starts, mean ± sd", _scores(near, "dtw", members, labels)]
        parts += [f"## {title}: exact DTW from the demonstrated start", _scores(demonstrated, "dtw", members, labels)]
        if demonstrated["seed"].nunique() > 1:
            parts += [f"## {title}: the same, seed by seed", _by_seed(demonstrated, members)]
    parts += [NOTES, _fast_beside_exact(near)]
    if known := [name for name in names if name in TABLE_ONE[RIVALS[0]]]:
        parts += ["## Fit: mean squared error per coordinate beside the paper's Table I", _table_one(rows, known)]
    parts += ["## Fits that follow their demonstration, by their own measurement", _follows(rows, names, labels)]
    parts += ["## Rollouts that failed, diverged or did not converge", _failures(rows)]
    return "# Ten spirals\n\n" + "\n\n".join(parts) + "\n"


PROTOCOL = RolloutProtocol(radius=0.1)
NOTES = f"""Raw sums of Euclidean distances over 500 points; lower is better, **bold** the best. †: FastDTW differs from
exact DTW by more than 5 %. p: {RIVALS[0]} against {RIVALS[1]} on the shared starts, paired t-test and Welch's."""


def _fast_beside_exact(near: pd.DataFrame) -> str:
    """By how much the paper's score differs from the exact one, in a sentence."""
    means = near.groupby(["method", "demonstration"])[["dtw", "dtw_fast"]].mean().dropna()
    if means.empty:
        return "FastDTW: no rollouts to compare it on."
    off = (means["dtw_fast"] / means["dtw"] - 1).abs()
    method, spiral = off.idxmax()
    return f"FastDTW (radius 1), the paper's score, differs by at most {off.max():.1%}: {method} at {spiral}."


def _fits(rows: pd.DataFrame, name: str, labels: Sequence[str]) -> dict[str, pd.DataFrame]:
    """{method: its rows on the spiral of that name}."""
    of = rows[rows["demonstration"] == name]
    return {label: of[of["method"] == label] for label in labels}


def _scores(rows: pd.DataFrame, score: str, names: list[str], labels: list[str]) -> str:
    tested = rows["start"].nunique() > 1
    lines = []
    for name in names:
        fits = _fits(rows, name, labels)
        # A deterministic method scores the same with every seed: seeds must not count as more starts.
        starts = {label: fit.groupby("start")[score].mean() for label, fit in fits.items()}
        means = {label: values.mean(skipna=False) for label, values in starts.items()}
        best = min((mean for mean in means.values() if np.isfinite(mean)), default=np.nan)
        line = [name]
        for label, values in starts.items():
            if values.empty or not np.isfinite(means[label]):
                line.append("—" if values.empty else "failed")
                continue
            text = f"{means[label]:.2f}" + (f" ± {values.std():.2f}" if tested else "")
            text = f"**{text}**" if means[label] == best else text
            exact, fast = fits[label]["dtw"].mean(), fits[label]["dtw_fast"].mean()
            line.append(text + (" †" if abs(fast - exact) > 0.05 * exact else ""))
        lines.append(line + ([_p_values(*(starts[rival] for rival in RIVALS))] if tested else []))
    return report.table(["spiral", *labels, *(["p paired / Welch"] if tested else [])], lines)


def _by_seed(rows: pd.DataFrame, names: list[str]) -> str:
    """The methods that a seed changes."""
    rows = rows[rows["demonstration"].isin(names)]
    means = rows.pivot_table(index=["demonstration", "method"], columns="seed", values="dtw", sort=False)
    means = means[means.max(axis=1) > means.min(axis=1) * (1 + 1e-9)]
    lines = [
        [*key, *("—" if np.isnan(mean) else f"{mean:.2f}" for mean in seeds)] for key, *seeds in means.itertuples()
    ]
    return report.table(["spiral", "method", *(f"seed {seed}" for seed in means.columns)], lines)


def _p_values(first: pd.Series, second: pd.Series) -> str:
    if len(first) < 2 or len(first) != len(second) or not np.isfinite([*first, *second]).all():
        return "—"
    return f"{report.paired(first, second):.1e} / {report.welch(first, second):.1e}"


def _table_one(rows: pd.DataFrame, names: list[str]) -> str:
    lines = []
    for name in names:
        errors = [(fit["mse"].mean(), TABLE_ONE[label][name].mse) for label, fit in _fits(rows, name, RIVALS).items()]
        cells = [(f"{ours:.2e}", f"{paper:.2e}", f"{ours / paper:.2f}") for ours, paper in errors]
        lines.append([name, *chain(*cells)])
    return report.table(["spiral", *(f"{r}{what}" for r in RIVALS for what in ("", ", paper", ", ratio"))], lines)


def _follows(rows: pd.DataFrame, names: list[str], labels: list[str]) -> str:
    fits = {name: _fits(rows, name, labels).values() for name in names}
    by_seed = {name: [fit.groupby("seed")["follows"].all().tolist() for fit in of] for name, of in fits.items()}
    return report.table(["spiral", *labels], [[name, *map(_how_many, of)] for name, of in by_seed.items()])


def _how_many(follows: list[bool]) -> str:
    if len(set(follows)) > 1:
        return f"{sum(follows)} of {len(follows)} seeds"
    return {True: "yes", False: "**no**"}[follows[0]] if follows else "—"


def _failures(rows: pd.DataFrame) -> str:
    bad = rows[(rows["status"] != "ok") | ~rows["converged"]]
    if bad.empty:
        return "None."
    bad = bad.assign(what=bad["status"].where(bad["status"] != "ok", "not converged"))
    groups = bad.groupby(["demonstration", "method", "what", "error"], sort=False).size()
    lines = [[*map(str, key), str(count)] for key, count in groups.items()]
    return report.table(["spiral", "method", "what", "error", "rows"], lines)


def draw(rows: pd.DataFrame, moved: Paths, shown: list[Demonstration], out: Path) -> None:
    """A picture of every spiral's rollouts with its first seed, and of each family's scores."""
    for demonstration in shown:
        paths: dict[str, Any] = {}
        for (method, of, _), path in moved.items():
            if of == demonstration.name:
                paths.setdefault(method, path)
        name = demonstration.name.replace(" ", "_").replace("=", "")
        plotting.replications(demonstration, paths).savefig(out / f"{name}.png")
    for family in dict.fromkeys(d.name.split()[0] for d in shown):
        scored = rows[rows["demonstration"].str.startswith(family)]
        if not scored.empty:
            plotting.dtw_bars(scored, f"{family} spirals").savefig(out / f"dtw_{family}.png")


if __name__ == "__main__":
    typer.run(main)
