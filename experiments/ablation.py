"""What each idea of TubeDS buys: the ideas on and off, on spirals, LASA handwriting and recordings of your own.

    python -m experiments.ablation [--quick] [--out results/ablation] [--data FOLDER_OR_FILE ...] [--jobs 2]

LASA needs ``make lasa`` once and is left out without it. A recording is any file that ``Demonstration.load`` reads; a
folder gives all its .npz and .csv files; without any, three made-up arm motions stand in. Leaves rows.csv, summary.md,
settings.json and pictures in ``--out``; finished trials stay in cells.sqlite there, so that the same command goes on
where it was interrupted.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, NamedTuple
from unittest.mock import patch

import joblib
import numpy as np
import pandas as pd
import torch
import typer
from matplotlib.figure import Figure
from rich.console import Console
from rich.markdown import Markdown
from rich.progress import track

from baselines import FDM
from experiments import report
from experiments.spirals import CHEBYSHEV, STABLE, STRAIGHT, spirals
from latentds import ChebyshevDS, Demonstration, datasets, kernels, metrics, plotting
from latentds.base import LatentDS
from latentds.benchmark import Cell, Factory, Protocol, evaluate
from latentds.fitting.matching import PINS
from latentds.methods import tube
from latentds.methods.tube import TubeDS
from latentds.store import CellStore, fingerprint

PROTOCOL = Protocol()
MANY = Protocol(n_starts=200)
"""On each spiral for TubeDS alone: over 20 starts a mean is still a matter of chance."""
NEAR = 0.05
"""Radius of the ball of starts around a recording's start, in sizes of the motion; .1 on the spirals' sphere."""
KAPPAS = (0.5, 5.0, 80.0)
"""Beside the default, 20; the first is as good as none. Refinement moves the scores of off-path starts little."""
CHOSEN = (
    "Chebyshev", "Chebyshev + both", "FDM", "FDM + both",
    "TubeDS, straight alone", "TubeDS, unbending alone", "TubeDS, not refined", "TubeDS",
)  # fmt: skip
"""Tried on every motion; the others on the spirals alone."""
LASA, SIX, MORE = "LASA", "LASA, six shown", "more starts"
FAMILIES = ("unstable", "stable", LASA, "recordings")


class Trial(NamedTuple):
    """One fit and its rollouts.

    Without ``tests`` it starts as in the head-to-head: at the demonstrated start and around it. With them it starts
    where each of them starts, and that one is what it is judged by.
    """

    family: str
    method: str
    factory: Factory
    shown: Sequence[Demonstration]
    tests: Sequence[Demonstration] = ()
    isotopy: str = ""
    """The only one that TubeDS may try, if not empty."""


# --- what is tried ----------------------------------------------------------------------------------------------------


def methods(name: str) -> dict[str, tuple[Factory, str]]:
    """{label: (factory, isotopy)} for the motion of that name."""
    found: dict[str, tuple[Factory, str]] = {}
    for label, kind, table in (("Chebyshev", ChebyshevDS, CHEBYSHEV), ("FDM", FDM, STRAIGHT)):
        beta, mu, n_layers, _ = table.get(name, STABLE)
        for idea, settings in (
            (", ends not pinned", {"pinned": False}),
            ("", {}),
            (" + continuation", {"steps": steps_for(n_layers)}),
            (" + refinement", {"refined": True}),
            (" + both", {"steps": steps_for(n_layers), "refined": True}),
        ):
            found[label + idea] = (
                lambda dim, kind=kind, beta=beta, mu=mu, layers=n_layers, settings=settings: kind(
                    dim, n_layers=layers, beta=beta, mu=mu, **settings
                ),
                "",
            )
    for isotopy in ("straight", "unbending"):
        found[f"TubeDS, {isotopy} alone"] = (TubeDS, isotopy)
    found["TubeDS, not refined"] = (lambda dim: TubeDS(dim, refined=False), "")
    for kappa in KAPPAS:
        label = f"TubeDS, not refined, κ = {kappa:g}"
        found[label] = (lambda dim, kappa=kappa: TubeDS(dim, contraction=kappa, refined=False), "")
    found["TubeDS"] = (TubeDS, "")
    return found


def steps_for(n_layers: int) -> int:
    """Continuation steps: one for ten layers, as in TubeDS."""
    return max(1, min(20, n_layers // 10))


def trials(quick: bool, recordings: Sequence[Demonstration], handwriting: bool) -> Iterator[Trial]:
    def of(family: str, shown: Demonstration, tests: Sequence[Demonstration] = ()) -> Iterator[Trial]:
        for label, (factory, isotopy) in methods(shown.name).items():
            if label in CHOSEN or family in ("unstable", "stable"):
                yield Trial(family, label, factory, [shown], tests, isotopy)

    for shown in spirals(quick):
        yield from of(shown.name.split()[0], shown)
        yield Trial(MORE, f"TubeDS, {MANY.n_starts} starts", TubeDS, [shown])
        if shown.name in CHEBYSHEV:
            yield from layer_trials(shown)
    for shown in recordings or [datasets.joint_motion(seed) for seed in range(1 if quick else 3)]:
        yield from of("recordings", shown)
    if handwriting:
        for shape in datasets.lasa_shapes()[:: 9 if quick else 1]:
            written = [Demonstration(d.positions, d.dt, shape) for d in datasets.lasa(shape)]
            yield from of(LASA, written[0], written)
            for i in (0, 3, 6):
                rest = written[:i] + written[i + 1 :]
                yield Trial(SIX, f"TubeDS without {i + 1}", TubeDS, rest, [written[i]])


def layer_trials(shown: Demonstration) -> Iterator[Trial]:
    """Half of the paper's layers, the pins among them, with continuation and refinement, β and μ as in TubeDS."""
    for label, kind, settings in (("Chebyshev", ChebyshevDS, CHEBYSHEV), ("FDM", FDM, STRAIGHT)):
        half = settings[shown.name].n_layers // 2
        yield Trial(
            "layers",
            label,
            lambda dim, kind=kind, half=half: kind(
                dim, n_layers=half - PINS, beta=0.9, mu=0.9, steps=steps_for(half), refined=True
            ),
            [shown],
        )


def load(paths: Sequence[Path]) -> list[Demonstration]:
    files = [f for p in paths for f in (sorted(p.iterdir()) if p.is_dir() else [p]) if f.suffix in (".npz", ".csv")]
    if paths and not files:
        raise ValueError(f"data: expected .npz or .csv files, found none in {', '.join(map(str, paths))}")
    found = [Demonstration.load(file) for file in files]
    if twice := [name for name, count in Counter(d.name for d in found).items() if count > 1]:
        raise ValueError(f"data: expected recordings of different names, got {twice[0]!r} again")
    return found


# --- one trial --------------------------------------------------------------------------------------------------------


def results(todo: Sequence[Trial], jobs: int, path: Path) -> Iterator[tuple[Sequence[dict[str, Any]], np.ndarray]]:
    """What came of each trial, in order; finished ones from the file that an earlier run left."""
    with CellStore(path) as store:
        keys, known = [_key(trial) for trial in todo], store.keys()
        missing = [trial for trial, key in zip(todo, keys, strict=True) if key not in known]
        work = (joblib.delayed(attempt)(trial) for trial in missing)
        spread = joblib.Parallel(n_jobs=jobs, return_as="generator", batch_size=1)(work)
        for key in keys:
            found = store.get(key) if key in known else next(spread)
            assert found is not None
            rows, paths = found
            if key not in known and not rows[0]["error"]:
                store.put(key, tuple(rows), paths)
            yield rows, paths


def _key(trial: Trial) -> str:
    motions = [(d.positions, d.dt, d.name) for d in (*trial.shown, *trial.tests)]
    made = trial.factory(trial.shown[0].dim)
    scoring = (attempt, from_other_starts, costs, PROTOCOL, MANY, NEAR)
    return fingerprint(trial.family, trial.method, trial.isotopy, made, len(trial.shown), motions, scoring)


def attempt(trial: Trial) -> tuple[list[dict[str, Any]], np.ndarray]:
    """A row per start, and the rollouts (starts, 500, n)."""
    made: list[LatentDS] = []

    def factory(dim: int) -> LatentDS:
        made.append(trial.factory(dim))
        return made[-1]

    shown = trial.shown[0]
    with only(trial.isotopy):
        if trial.tests:
            rows, paths = from_other_starts(factory(shown.dim), trial)
        else:
            protocol = MANY if trial.family == MORE else PROTOCOL
            if trial.family == "recordings":
                protocol = Protocol(n_starts=6, radius=NEAR * shown.size)
            outcome = evaluate(Cell(trial.method, factory, shown), protocol)
            rows, paths = [dict(row) for row in outcome.rows], outcome.paths
    common = {"family": trial.family, "seed": 0, "dim": shown.dim, "size": shown.size} | costs(made[-1], shown)
    kept = ("method", "demonstration", "start", "status", "error", "dtw", "mse", "n_layers", "fit_seconds")
    per_size = PROTOCOL.n_points * shown.size
    return [{k: row[k] for k in kept} | common | {"share": row["dtw"] / per_size} for row in rows], paths


@contextmanager
def only(isotopy: str) -> Iterator[None]:
    """TubeDS tries the candidates of one isotopy alone."""
    every = tube._candidates
    if not isotopy:
        yield
        return
    with patch.object(tube, "_candidates", lambda *given: (c for c in every(*given) if c.isotopy == isotopy)):
        yield


def from_other_starts(ds: LatentDS, trial: Trial) -> tuple[list[dict[str, Any]], np.ndarray]:
    kernels.warmup([ds.dim])
    began, error = time.perf_counter(), ""
    paths = np.full((len(trial.tests), PROTOCOL.n_points, ds.dim), np.nan)
    try:
        ds.fit(trial.shown)
        with torch.no_grad():
            for path, test in zip(paths, trial.tests, strict=True):
                path[:] = ds.rollout(test.start, PROTOCOL.times(test)).numpy()
    except Exception as raised:
        error = f"{type(raised).__name__}: {raised}"
    fit = ds.fit_report
    facts = {"mse": fit.mse, "n_layers": fit.n_layers, "fit_seconds": fit.seconds} if fit else {}
    nothing = {"mse": math.nan, "n_layers": math.nan, "fit_seconds": time.perf_counter() - began}
    return [
        nothing
        | facts
        | {"method": trial.method, "demonstration": test.name, "start": i, "error": error}
        | {"status": "failed" if error else "ok" if np.isfinite(path).all() else "diverged"}
        | {"dtw": metrics.dtw(path, PROTOCOL.reference(test))}
        for i, (path, test) in enumerate(zip(paths, trial.tests, strict=True))
    ], paths


def costs(ds: LatentDS, shown: Demonstration) -> dict[str, Any]:
    """cond(J) along the path, and what TubeDS reports beside it."""
    fit = ds.fit_report
    if isinstance(fit, tube.TubeReport):
        names = ("isotopy", "condition_path", "condition_tube", "largest_velocity", "largest_gradient")
        exact = bool((ds.attractor - shown.goal).abs().max() <= 1e-9 * shown.size)
        return {name: getattr(fit, name) for name in names} | {"attractor_exact": exact}
    with torch.no_grad():
        rows = ds.jacobian(ds.encode(shown.positions))
        return {"condition_path": float(torch.linalg.cond(rows).max()) if torch.isfinite(rows).all() else math.inf}


def sampling_floor(shown: Demonstration, count: int = 100) -> float:
    """Mean exact DTW between the sampled demonstration and itself, late by a fraction of a sample, even over [0, 1).

    Off the demonstrated start nobody knows the clock: even a perfect rollout is late by some such fraction.
    """
    times, reference = PROTOCOL.times(shown).numpy(), PROTOCOL.reference(shown)
    late = (np.arange(count) + 0.5) / count * (times[1] - times[0])
    scores = [metrics.dtw(shown.at(times + seconds), reference) for seconds in late]
    return float(np.mean(scores))


def joined(shown: Demonstration, starts: np.ndarray, kappa: float = 20.0) -> list[float]:
    """Exact DTW of the demonstration itself, joined from each start (n,) at its nearest point.

    The way there shrinks at ``kappa``, as in a tube without any error; a start behind the first point is late.
    """
    times, reference = PROTOCOL.times(shown).numpy(), PROTOCOL.reference(shown)
    fine = np.linspace(0, shown.duration, 20_001)
    path = shown.at(fine)
    speed, scores = (path[1] - path[0]) / fine[1], []
    for start in starts:
        nearest = int(np.linalg.norm(path - start, axis=1).argmin())
        away, late = start - path[nearest], 0.0
        if nearest == 0:
            late = -float(away @ speed / (speed @ speed))
        clocks = times + fine[nearest] - late
        motion = shown.at(clocks) + np.minimum(clocks, 0)[:, None] * speed
        motion += np.exp(-kappa * times / shown.duration)[:, None] * (away + late * speed)
        scores.append(metrics.dtw(motion, reference))
    return scores


def fit_seconds(refined: bool) -> float:
    """Median of three fits of 150 layers to 1000 points."""
    shown, seconds = datasets.unstable_spiral(7), []
    for _ in range(3):
        began = time.perf_counter()
        TubeDS(3, n_layers=150, refined=refined).fit(shown)
        seconds.append(time.perf_counter() - began)
    return float(np.median(seconds))


# --- what came of it --------------------------------------------------------------------------------------------------


class Goal(NamedTuple):
    what: str
    goal: str
    reached: str
    met: bool | None
    """None: not measured, or reported without a goal."""

    def line(self) -> list[str]:
        return [self.what, self.goal, self.reached, "—" if self.met is None else "yes" if self.met else "**no**"]


def most(what: str, values: pd.Series, bound: float, unit: str = "") -> Goal:
    """That none is larger than ``bound``; names those that are."""
    if values.empty:
        return Goal(what, f"≤ {bound:g}{unit}", "not measured", None)
    over = values[~(values <= bound)]
    reached = f"{values.max():.3g}{unit}"
    if len(over) and len(values) > 1:
        reached += f"; above it: {', '.join(f'{name} {value:.3g}' for name, value in over.items())}"
    return Goal(what, f"≤ {bound:g}{unit}", reached, over.empty)


def goals(rows: pd.DataFrame, seconds: dict[bool, float]) -> list[Goal]:
    ours = rows[rows["method"] == "TubeDS"]
    sphere = ours[ours["family"].isin(("unstable", "stable"))]
    near = sphere[sphere["start"] > 0].groupby("demonstration", sort=False)["dtw"]
    plain = rows[(rows["method"] == "Chebyshev") & (rows["start"] > 0)].groupby("demonstration", sort=False)["dtw"]
    gain = (plain.mean() / near.mean()).dropna()
    gain = gain[[name for name in gain.index if name == "unstable c=7" or name.startswith("stable")]]
    first = ours[ours["start"] == 0].set_index("demonstration")
    drawn, joints = first[first["family"] == LASA], first[(first["family"] == "recordings") & (first["dim"] == 7)]
    six = rows[rows["family"] == SIX]["share"]
    low = gain[~(gain >= 3)]
    found = [
        most("spirals: exact DTW from the demonstrated start", first.loc[list(near.groups), "dtw"], 3),
        most("spirals: mean exact DTW over 20 starts", near.mean(), 8),
        most("spirals: largest exact DTW over 20 starts", near.max(), 20),
        Goal(
            "ChebyshevDS' mean over TubeDS', unstable c=7 and stable",
            "≥ 3",
            f"{gain.min():.3g}" + "".join(f"; {name} {value:.3g}" for name, value in low.items()),
            bool((gain >= 3).all()),
        ),
        *layer_goals(rows),
        most(f"{len(drawn)} LASA shapes: DTW/500 from the start, of the size", drawn["share"], 0.005),
        most("LASA: cond(J) along the path", drawn["condition_path"], 100),
        most("LASA, six shown, from the seventh's start: mean DTW/500", pd.Series({"": six.mean()}).dropna(), 0.06),
        most("7-D recordings: DTW/500 from the start", joints["dtw"] / PROTOCOL.n_points, 0.003),
        Goal(
            "attractor is the goal", "to 1e-9 of the size", "all" if (met := all(first["attractor_exact"])) else "", met
        ),
    ]
    for refined, bound in ((False, 1), (True, 10)):
        name = f"fit of 150 layers to 1000 points, refinement {'on' if refined else 'off'}"
        found.append(most(name, pd.Series({"": seconds[refined]}), bound, " s"))
    return found


def layer_goals(rows: pd.DataFrame) -> list[Goal]:
    found = []
    reached = rows[(rows["family"] == "layers") & (rows["start"] == 0)]
    for _, row in reached.iterrows():
        name, table = row["demonstration"], CHEBYSHEV if row["method"] == "Chebyshev" else STRAIGHT
        paper = table[name]
        hoped = name in ("unstable c=7", "unstable c=10", "unstable c=15")
        what = f"{row['method']} + both, {name}: MSE with {paper.n_layers // 2} of the paper's {paper.n_layers} layers"
        met = bool(row["mse"] <= paper.mse) if hoped else None
        found.append(
            Goal(what, f"≤ {paper.mse:.2e}" if hoped else f"(paper {paper.mse:.2e})", f"{row['mse']:.2e}", met)
        )
    return found


def summarize(rows: pd.DataFrame, best: dict[str, tuple[float, float]], seconds: dict[bool, float]) -> str:
    parts = ["# The ideas on and off", "## Must reach"]
    parts.append(report.table(("what", "goal", "reached", "met"), [goal.line() for goal in goals(rows, seconds)]))
    for family in FAMILIES:
        if not (found := rows[rows["family"] == family]).empty:
            unit = "exact DTW" if family in ("unstable", "stable") else "DTW/500 in sizes of the motion"
            count = found["demonstration"].nunique()
            parts += [f"## {family.capitalize() if family != LASA else LASA}: {unit}, {count} motions", ideas(found)]
    parts += ["## TubeDS on each spiral: exact DTW", each_spiral(rows, best), FLOOR]
    parts += ["## What the contraction κ costs and buys", contraction(rows)]
    if (rows["family"] == SIX).any():
        parts += ["## LASA, shape by shape: DTW/500 in sizes of the motion", each_shape(rows)]
    if (bad := rows[rows["error"] != ""]).any(axis=None):
        counts = bad.groupby(["demonstration", "method", "error"], sort=False).size()
        parts += [
            "## Failures",
            report.table(("motion", "method", "error", "rows"), [[*k, str(n)] for k, n in counts.items()]),
        ]
    return "\n\n".join(parts) + "\n"


FLOOR = """The floor is what the sampling alone costs: the mean exact DTW between the demonstration at 500 points and
itself late by a random fraction of a sample. A start off the demonstrated one does not say what time it is, so this is
what a rollout with the right path at the right speed scores on average. "Joined" adds the way back: from each of the
200 starts the demonstration itself is joined where it is nearest, and the offset shrinks at κ = 20, as in a tube
without error."""


def ideas(rows: pd.DataFrame) -> str:
    """A line per method: mean and worst from the demonstrated start and from the others."""
    score, digits = ("dtw", ".2f") if rows["family"].iloc[0] in ("unstable", "stable") else ("share", ".4f")
    lines = []
    for label, found in rows.groupby("method", sort=False):
        at, off = found[found["start"] == 0], found[found["start"] > 0]
        lost = int((found["status"] != "ok").sum())
        numbers = [format(f(part[score]), digits) for part in (at, off) for f in (pd.Series.mean, pd.Series.max)]
        costs = [f"{at['condition_path'].max():.2g}", f"{at['fit_seconds'].median():.2f}"]
        lines.append([str(label), *numbers, *costs, str(lost or "")])
    head = ("method", "shown start, mean", "worst", "other starts, mean", "worst", "worst cond(J)", "fit [s]", "lost")
    return report.table(head, lines)


def each_spiral(rows: pd.DataFrame, best: dict[str, tuple[float, float]]) -> str:
    lines = []
    for name, (floor, tube_alone) in best.items():
        of = rows[(rows["demonstration"] == name) & (rows["family"] != "layers")]
        dtw = {label: found.set_index("start")["dtw"] for label, found in of.groupby("method")}
        twenty, many = dtw["TubeDS"].drop(0), dtw[f"TubeDS, {MANY.n_starts} starts"].drop(0)
        rivals = [dtw[label].drop(0).mean() for label in ("Chebyshev", "FDM")]
        numbers = [dtw["TubeDS"][0], twenty.mean(), twenty.max(), many.mean(), many.max(), tube_alone, floor, *rivals]
        isotopy = of[of["method"] == "TubeDS"]["isotopy"].iloc[0]
        lines.append([name, *(f"{number:.2f}" for number in numbers), isotopy])
    ours = ("shown start", "20 starts, mean", "worst", f"{MANY.n_starts} starts, mean", "worst", "joined", "floor")
    return report.table(("spiral", *ours, "Chebyshev, 20", "FDM, 20", "isotopy"), lines)


def contraction(rows: pd.DataFrame) -> str:
    """Scores and costs in the tube against κ; medians over motions."""
    lines = []
    for family in ("unstable", "stable"):
        for kappa in sorted((*KAPPAS, 20.0)):
            label = "TubeDS, not refined" + (f", κ = {kappa:g}" if kappa in KAPPAS else "")
            found = rows[(rows["family"] == family) & (rows["method"] == label)]
            if found.empty:
                continue
            off, each = found[found["start"] > 0]["share"], found[found["start"] == 0]
            numbers = [off.mean(), off.max(), each["largest_velocity"].median(), each["largest_gradient"].median()]
            lines.append(
                [
                    family,
                    f"{kappa:g}",
                    *(format(x, f) for x, f in zip(numbers, (".4f", ".4f", ".1f", ".0f"), strict=True)),
                ]
            )
    head = ("motions", "κ", "other starts, mean", "worst", "largest velocity", "largest gradient")
    return report.table(head, lines)


def each_shape(rows: pd.DataFrame) -> str:
    one, six = rows[(rows["family"] == LASA) & (rows["method"] == "TubeDS")], rows[rows["family"] == SIX]
    lines = []
    for name, found in one.groupby("demonstration", sort=False):
        at = found[found["start"] == 0].iloc[0]
        seventh = six[six["demonstration"] == name]["share"]
        numbers = [at["share"], found[found["start"] > 0]["share"].mean(), seventh.mean(), seventh.max()]
        lines.append([str(name), *(f"{x:.4f}" for x in numbers), f"{at['condition_path']:.3g}", at["isotopy"]])
    means = [
        one[one["start"] == 0]["share"].mean(),
        one[one["start"] > 0]["share"].mean(),
        six["share"].mean(),
        six["share"].max(),
    ]
    lines.append(
        ["**mean**, worst of six shown", *(f"{x:.4f}" for x in means), f"{one['condition_path'].max():.3g}", ""]
    )
    head = ("shape", "shown start", "other six starts", "six shown, seventh's start", "worst", "cond(J)", "isotopy")
    return report.table(head, lines)


# --- pictures ---------------------------------------------------------------------------------------------------------


def gains(rows: pd.DataFrame) -> Figure:
    """Mean score of every method on every family, from the demonstrated start and from the others."""
    families = [family for family in FAMILIES if (rows["family"] == family).any()]
    labels = list(rows[rows["family"].isin(families)]["method"].unique())
    figure = Figure(figsize=(3.2 * len(families) + 2, 5.2), dpi=plotting.DPI, layout="constrained")
    panels = figure.subplots(1, len(families), sharey=True, squeeze=False)[0]
    place = -np.arange(len(labels))
    for axes, family in zip(panels, families, strict=True):
        found = rows[rows["family"] == family]
        for part, colour, shift, name in (
            (found[found["start"] > 0], plotting.COLORS["Chebyshev"], 0.19, "other starts"),
            (found[found["start"] == 0], plotting.COLORS["FDM"], -0.19, "demonstrated start"),
        ):
            means = part.groupby("method")["share"].mean().reindex(labels)
            axes.barh(place + shift, means, 0.36, color=colour, label=name)
        axes.set(xscale="log", xlim=(5e-5, 1), title=family, xlabel="DTW/500 [sizes of the motion]")
        axes.set_yticks(place, labels)
        axes.grid(axis="x", color="#DDDDDD", lw=0.6)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False)
    return figure


def handwriting_grid(shapes: dict[str, tuple[Sequence[Demonstration], np.ndarray]]) -> Figure:
    """Every shape: what was shown, the rollout from its start, and those from the other demonstrations' starts."""
    columns = 6 if len(shapes) > 4 else len(shapes)
    height = math.ceil(len(shapes) / columns)
    figure = Figure(figsize=(2.1 * columns, 2.2 * height + 0.4), dpi=plotting.DPI, layout="constrained")
    panels = figure.subplots(height, columns, squeeze=False).ravel()
    for axes in panels[len(shapes) :]:
        axes.set_axis_off()
    for axes, (name, (written, paths)) in zip(panels, shapes.items(), strict=False):
        for i, path in enumerate(paths[1:]):
            axes.plot(*path.T, color="#56B4E9", lw=0.8, label="" if i else "from the other six starts")
            axes.plot(*path[0], ".", color="#0072B2", ms=4)
        axes.plot(*paths[0].T, color=plotting.COLORS["TubeDS"], lw=2.2, label="from the demonstrated start")
        axes.plot(*written[0].positions.T, "--", color=plotting.SHOWN, lw=0.9, label="demonstration")
        axes.plot(*written[0].goal, "*", color="#E69F00", mec=plotting.SHOWN, mew=0.5, ms=9)
        axes.set_title(name, fontsize=9)
        axes.set_aspect("equal", adjustable="datalim")
        axes.set(xticks=[], yticks=[])
        axes.spines[:].set_color("#CCCCCC")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    return figure


def main(
    quick: Annotated[bool, typer.Option(help="Three spirals and three shapes.")] = False,
    out: Annotated[Path, typer.Option(help="Folder for rows, summary and pictures.")] = Path("results/ablation"),
    data: Annotated[list[Path] | None, typer.Option(help="A recording, or a folder of them; repeat for more.")] = None,
    jobs: Annotated[int, typer.Option(help="Processes; -1: all cores.")] = 2,
) -> None:
    """Turn the ideas of TubeDS on and off."""
    began, console = time.perf_counter(), Console()
    try:
        recordings = load(data or [])
    except (ValueError, FileNotFoundError) as error:
        raise typer.BadParameter(str(error)) from None
    try:
        handwriting = bool(datasets.lasa_shapes())
    except ImportError:
        handwriting = False
        console.print("LASA handwriting is not installed and left out: run `make lasa` once.")
    kernels.warmup([2, 3, 7])
    todo = list(trials(quick, recordings, handwriting))
    out.mkdir(parents=True, exist_ok=True)
    spread = results(todo, jobs, out / "cells.sqlite")
    found, shapes = [], {}
    try:
        for trial, (rows, paths) in track(zip(todo, spread, strict=True), "fitting …", len(todo), console=console):
            found += rows
            if trial.family == LASA and trial.method == "TubeDS":
                shapes[trial.shown[0].name] = (trial.tests, paths)
    except KeyboardInterrupt:
        console.print("Interrupted; the same command goes on from here.")
        raise typer.Exit(130) from None
    rows = pd.DataFrame(found)
    best = {
        shown.name: (sampling_floor(shown), float(np.mean(joined(shown, MANY.starts(shown)[1:].numpy()))))
        for shown in spirals(quick)
    }
    summary = summarize(rows, best, {refined: fit_seconds(refined) for refined in (False, True)})
    took = time.perf_counter() - began
    settings = {"command": {"quick": quick, "jobs": jobs, "recordings": len(recordings), "seconds": round(took, 1)}}
    settings |= {"protocol": asdict(PROTOCOL), "environment": report.environment()}
    report.write(out / "rows.csv", rows.to_csv(index=False))
    report.write(out / "settings.json", settings)
    report.write(out / "summary.md", summary)
    gains(rows).savefig(out / "gains.png")
    if shapes:
        handwriting_grid(shapes).savefig(out / "lasa.png")
    console.print(Markdown(summary))
    console.print(f"{out}: rows.csv, summary.md, settings.json and pictures, after {took:.0f} s")


if __name__ == "__main__":
    typer.run(main)
