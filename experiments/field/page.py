"""What the comparison tells: sections of words and tables, as Markdown and as a page, and pictures."""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from PIL import Image

from experiments import report
from experiments.field.methods import DRAWN_AT_RANDOM, METHODS, OURS, PHASE_DRIVEN
from experiments.field.motions import ALONE, DEFINITIONS, HELD_OUT, IN_SAMPLE, LEAVE_ONE_OUT, YOURS, Motion
from experiments.field.ranks import LEVEL, Ranking, against, ranked
from experiments.field.references import CURVES
from experiments.field.scores import (
    ARRIVED,
    HELD_FOR,
    N_BESIDE,
    N_POINTS,
    N_PUSHES,
    PATIENCE,
    PUSH,
    window,
)
from experiments.published import HELD_OUT_HANDWRITING
from latentds import plotting
from latentds import report as latentds_report
from latentds.arguments import Array
from latentds.cell import STARTS_WITHIN
from latentds.files import atomic_write

FIELDS = [label for label in METHODS if label not in PHASE_DRIVEN]
BESIDES = [*PHASE_DRIVEN, *CURVES, "nearest velocity"]
FARTHEST_DRAWN = 1.0
"""Distance, in sizes, beyond which a picture does not show how far."""
RANKED = {
    "own": "repeats",
    "beside": "from beside",
    "unseen": "from unseen starts",
    "test_rmse": "velocity error",
    "test_e": "direction error",
    "pushed": "after a push",
}
"""Questions, each a column of the ranks. Held still, a field goes on where it was, so that has no rank of its own."""
CLOCKED = ("own", "beside", "unseen")
"""What curves can be asked, too."""
COUNTED_ONCE = (HELD_OUT, ALONE, YOURS)
"""Protocols whose motions are ranked: those of the others are of the same shapes again."""


class Section(NamedTuple):
    """A heading, what is to be known, and a table whose index is its first column."""

    title: str
    told: str
    table: pd.DataFrame | None = None


def summary(rows: pd.DataFrame, every: Sequence[Motion]) -> str:
    """All sections as Markdown."""
    parts = []
    for section in sections(rows, every):
        parts += [f"## {section.title}", section.told]
        if section.table is not None:
            table = section.table.fillna("—").reset_index().astype(str)
            parts.append(report.table(list(table.columns), table.to_numpy().tolist()))
    return "\n\n".join(parts) + "\n"


def document(text: str, drawn: Sequence[Path]) -> str:
    """A page of the docs: the summary under a title, with the pictures behind the ranks."""
    verdict, ranks, rest = text.split("\n\n## ", 2)
    shown = "\n\n".join(f"![{TOLD_PICTURES[path.stem]}](images/field/{path.name})" for path in drawn)
    return f"{HEAD}\n\n{verdict}\n\n## {ranks}\n\n{shown}\n\n## {rest}"


def sections(rows: pd.DataFrame, every: Sequence[Motion]) -> list[Section]:
    """What is told, in order."""
    first = rows[rows["seed"] == 0].assign(family=rows["motion"].map({one.name: family_of(one) for one in every}))
    rankings = {question: ranking for question in RANKED if (ranking := ranking_of(first, question)) is not None}
    parts = [Section("Verdict", verdict(first, rankings)), Section("Ranks", TOLD_RANKS, rank_table(rankings))]
    clocks = [*PHASE_DRIVEN, *CURVES]
    apart = {question: ranking for question in CLOCKED if (ranking := ranking_of(first, question, clocks)) is not None}
    parts.append(Section("Ranks of what follows a clock", TOLD_CLOCKS, rank_table(apart)))
    parts.append(Section(f"Against {OURS}", TOLD_AGAINST, against_table(first)))
    for question, told in TOLD.items():
        if question in first and first[question].notna().any():
            parts.append(Section(told[0], told[1], by_family(first, question)))
    parts.append(Section("Does it arrive?", arrivals(first)))
    if IN_SAMPLE in set(first["protocol"]):
        parts.append(Section("In sample, step against step", TOLD_IN_SAMPLE, in_sample_table(first)))
    if HELD_OUT in set(first["protocol"]):
        parts.append(Section("Beside published figures", TOLD_PUBLISHED, published_table(first)))
    parts.append(Section("What it costs, and what a robot would see", TOLD_COST, cost_table(first)))
    if rows["seed"].nunique() > 1:
        parts.append(Section("Three seeds", TOLD_SEEDS, seed_table(rows)))
    where = report.environment()
    shown = dict.fromkeys(motion.protocol for motion in every)
    protocols = " ".join(DEFINITIONS[protocol] for protocol in shown)
    machine = f"Revision {where['revision']}, {where['date'][:10]}, {where['cores']} cores of {where['cpu']}."
    return [*parts, Section("How it was measured", f"{protocols} {machine}")]


def family_of(motion: Motion) -> str:
    """The column of a motion: its protocol, and of motions shown alone what they are."""
    alone = {2: "strokes", 3: "spirals", 7: "joints"}
    names = {HELD_OUT: "handwriting, 4 shown", LEAVE_ONE_OUT: "6 shown", IN_SAMPLE: "7 shown", YOURS: "yours"}
    return alone[motion.shown[0].dim] if motion.protocol == ALONE else names[motion.protocol]


# --- words ------------------------------------------------------------------------------------------------------------

HEAD = """# The field, compared

Written by `make field ARGS='--doc docs/comparison.md'`; do not edit. Which method to take, in plain words:
[Which method when](which-method.md)."""
TOLD_PICTURES = {
    "grid": "Shapes by methods: shown, black, kept back, grey, motions from all starts, coloured, and the field",
    "ranks": "Mean ranks, a panel for each question",
    "time": "Distance over fitting time",
}
TOLD_RANKS = (
    "Mean rank over motions, 1 the best, of the methods that are velocity fields; a failure ranks last; each "
    f"shape counts once. In brackets behind a question: over how many motions, and Nemenyi's critical difference at "
    f"{LEVEL:g}: two methods nearer than that are not told apart. **Bold**: not told apart from the best."
)
TOLD_CLOCKS = (
    "ProMP and DMP follow a clock, and so do three curves that learn next to nothing: the mean of what was shown, and "
    "the mean from a start, whose offset dies along it. They are ranked apart, for none is a field that a robot can be "
    "pushed in. Of a single demonstration the mean is that itself."
)
TOLD_AGAINST = (
    f"Wilcoxon's signed-rank test over the same motions, corrected by Holm's procedure within a question: p, and "
    f"whether the method is better (+) or worse (−) than {OURS} on more of them."
)
TOLD = {
    "own": (
        "Repeats what it was shown",
        f"From each shown start to its demonstration: exact DTW over {N_POINTS} points, over their number, in sizes of "
        "the demonstration. Median over motions (worst).",
    ),
    "beside": (
        "From beside the shown start",
        f"The same from {N_BESIDE} starts in a ball of {STARTS_WITHIN:g} sizes around the first shown one.",
    ),
    "unseen": (
        "From starts that were not shown",
        "From the start of each demonstration that was kept back to that demonstration.",
    ),
    "pushed": (
        "Pushed off half-way",
        f"By {PUSH:g} sizes, in {N_PUSHES} directions: distance of the rest of the motion to the second half of the "
        "demonstration.",
    ),
    "held": (
        "Held still half-way",
        f"For {HELD_FOR:g} of the duration, then released for the time that was left: distance to the second half of "
        "the demonstration. A field goes on where it was, a clock ran on.",
    ),
}
TOLD_IN_SAMPLE = (
    "Protocol A, mm: root mean squared distance of step k from sample k, every tenth; exact DTW over their number; "
    "discrete Fréchet distance. Mean over shapes (worst)."
)
TOLD_PUBLISHED = (
    "Protocol C, mean ± standard deviation over shapes. Velocity RMSE, mm/s: mean over samples of the root of the mean "
    "over coordinates; ė: mean of 1 − cos; DTWD, mm: raw sum of exact DTW over 500 points from the kept-back starts. "
    "DTWD by ds-opt's rule: from the twentieth sample, 0.01 s a step until rest, so that slow arrival counts; the "
    "speed that counts as rest is ours. Of CONDOR and PUMA no printed numbers were found."
)
TOLD_COST = (
    "Over all motions; medians, and worst where it is said. Fits without the library's own measuring of what was "
    "learned, in one thread. A velocity: at one point, from Python. Arrival: in durations, from the first shown start, "
    "where it does. Command: the largest speed along motions from shown starts, over the largest that was shown. "
    "Certificate: claims proven / searched for in vain / falsified, over the motions that are drawn."
)
TOLD_SEEDS = (
    "The motions of the pictures, three fits each: median of what it repeats, seed by seed, and of unseen starts. "
    "Other methods draw nothing."
)


def verdict(rows: pd.DataFrame, rankings: Mapping[str, Ranking]) -> str:
    """Who is first where, and where our own method is behind: from the ranks alone."""
    first: dict[str, list[str]] = {}
    for question, ranking in rankings.items():
        first.setdefault(ranking.mean.index[0], []).append(RANKED[question])
    leads = "; ".join(f"{method} in {', '.join(questions)}" for method, questions in first.items())
    fields = {question: scores_of(rows, question) for question in RANKED}
    several = rows[rows["protocol"] == HELD_OUT]
    clocks = {
        question: scores_of(several, question, [OURS, *BESIDES]) for question in (*CLOCKED, "test_rmse", "test_e")
    }
    worst = rows[(rows["method"] == OURS) & rows["protocol"].isin(COUNTED_ONCE)].nlargest(3, "own")
    hard = ", ".join(f"{name} {value:.3f}" for name, value in zip(worst["motion"], worst["own"], strict=True))
    return (
        f"Where {OURS} loses: among the fields to {_lost(fields) or 'none'}; on handwriting, among what is no field, "
        f"to {_lost(clocks) or 'none'} (Wilcoxon with Holm's correction, p < {LEVEL:g}). It repeats worst {hard} "
        f"sizes. Lowest mean rank of the fields: {leads}."
    )


def _lost(scores: Mapping[str, pd.DataFrame]) -> str:
    """Which methods are better than ours at what, beyond chance."""
    better: dict[str, list[str]] = {}
    for question, of in scores.items():
        if OURS in of and of.shape[1] > 1:
            found = against(of, OURS)
            for method in found.index[(found["p"] < LEVEL) & found["better"]]:
                better.setdefault(method, []).append(RANKED[question])
    return "; ".join(f"{method} in {', '.join(questions)}" for method, questions in better.items())


# --- tables -----------------------------------------------------------------------------------------------------------


def ranking_of(first: pd.DataFrame, question: str, methods: Sequence[str] = FIELDS) -> Ranking | None:
    """Of these methods; None where the question was not asked."""
    scores = scores_of(first, question, methods)
    return None if scores.empty else ranked(scores)


def scores_of(first: pd.DataFrame, question: str, methods: Sequence[str] = FIELDS) -> pd.DataFrame:
    """(motions, methods) of one question, each shape once."""
    if question not in first or first.empty:
        return pd.DataFrame()
    chosen = first[first["method"].isin(methods) & first["protocol"].isin(COUNTED_ONCE)]
    asked = chosen.groupby("motion")[question].transform(lambda values: values.notna().any())
    return chosen[asked].pivot(index="motion", columns="method", values=question)


def rank_table(rankings: Mapping[str, Ranking]) -> pd.DataFrame:
    columns = {}
    for question, ranking in rankings.items():
        close = ranking.mean - ranking.mean.iloc[0] <= ranking.critical
        texts = {name: f"**{rank:.1f}**" if close[str(name)] else f"{rank:.1f}" for name, rank in ranking.mean.items()}
        columns[f"{RANKED[question]} ({ranking.n_motions}, {ranking.critical:.1f})"] = pd.Series(texts)
    order = pd.DataFrame({question: ranking.mean for question, ranking in rankings.items()}).mean(axis=1).sort_values()
    table = pd.DataFrame(columns).reindex(order.index)
    table.loc["*Friedman's p*"] = [f"{ranking.p:.1g}" for ranking in rankings.values()]
    return table.rename_axis("method")


def against_table(first: pd.DataFrame) -> pd.DataFrame:
    columns = {}
    for question, title in RANKED.items():
        scores = scores_of(first, question)
        if not scores.empty and OURS in scores:
            found = against(scores, OURS)
            columns[title] = found["p"].map("{:.2g} ".format) + found["better"].map({True: "+", False: "−"})
    return pd.DataFrame(columns).reindex([one for one in FIELDS if one != OURS]).rename_axis("method")


def by_family(first: pd.DataFrame, question: str) -> pd.DataFrame:
    """A line for each method, fields first; median (worst) over the motions of each family.

    Shapes that several protocols show count once, but for starts that were not shown, which two protocols ask for.
    """
    columns = {}
    counted = first if question == "unseen" else first[first["protocol"].isin(COUNTED_ONCE)]
    for family in counted["family"].unique():
        here = counted[counted["family"] == family]
        if here[question].notna().any():
            texts = {}
            for method, of in here.groupby("method"):
                values = of[question].to_numpy(dtype=np.float64)
                if method in BESIDES and np.isnan(values).all():
                    texts[method] = "—"
                else:
                    values = np.where(np.isnan(values), np.inf, values)
                    texts[method] = f"{_brief(np.median(values))} ({_brief(values.max())})"
            columns[f"{family} [{here['motion'].nunique()}]"] = pd.Series(texts)
    table = pd.DataFrame(columns).reindex([*FIELDS, *BESIDES]).dropna(how="all").fillna("—")
    return table[(table != "—").any(axis=1)].rename_axis("method")


def arrivals(first: pd.DataFrame) -> str:
    """Which methods' motions do not all arrive, in words."""
    shares = first.groupby("method")["arrives"].agg(["mean", "min"]).reindex([*FIELDS, *BESIDES]).dropna()
    late = shares[shares["min"] < 1]
    told = "; ".join(f"{name} {of['mean']:.0%} on the mean, {of['min']:.0%} at worst" for name, of in late.iterrows())
    return (
        f"Share of the shown starts and those beside from which the motion is within {ARRIVED:g} sizes of the goal "
        f"after {PATIENCE:g} durations: all of every motion" + (f", but {told}." if told else ".")
    )


def _brief(value: float) -> str:
    return "lost" if not np.isfinite(value) or value > 100 else f"{value:.3g}"


def in_sample_table(first: pd.DataFrame) -> pd.DataFrame:
    here = first[first["protocol"] == IN_SAMPLE]
    names = {"rmse_a": "RMSE", "dtwd_a": "DTWD", "fd_a": "FD"}
    return _mean_and_worst(here, names)


def _mean_and_worst(here: pd.DataFrame, names: Mapping[str, str]) -> pd.DataFrame:
    of = here.groupby("method")[list(names)]
    mean, worst = of.mean(), of.max()
    texts = {
        title: {one: f"{mean[key][one]:.3g} ({worst[key][one]:.3g})" for one in mean.index if mean[key][one] < 1e4}
        for key, title in names.items()
    }
    return pd.DataFrame(texts).reindex([*FIELDS, *BESIDES]).dropna(how="all").fillna("lost").rename_axis("method")


def published_table(first: pd.DataFrame) -> pd.DataFrame:
    """Our fits, then what others print of the same metric and split."""
    names = {"test_rmse": "velocity RMSE", "test_e": "ė", "dtwd": "DTWD", "dtwd_theirs": "DTWD, ds-opt's rule"}
    here = first[first["protocol"] == HELD_OUT]
    lines: dict[str, dict[str, str]] = {}
    for method in [*FIELDS, *BESIDES]:
        of = here[here["method"] == method]
        if len(of):
            lines[method] = {title: _mean_and_spread(of[key]) for key, title in names.items()}
    for one in HELD_OUT_HANDWRITING:
        lines[f"*{one.method}, published*"] = {
            "velocity RMSE": one.rmse,
            "ė": one.e,
            "DTWD": "—",
            "DTWD, ds-opt's rule": one.dtwd,
        }
    return pd.DataFrame(lines).T.rename_axis("method")


def _mean_and_spread(values: pd.Series[float]) -> str:
    if values.isna().all():
        return "—"
    if not np.isfinite(values).all() or values.max() > 1e6:
        return "lost"
    return f"{values.mean():.3g} ± {values.std():.2g}"


def cost_table(first: pd.DataFrame) -> pd.DataFrame:
    fits = first[first["method"].isin(METHODS)]
    of = fits.groupby("method")
    table = pd.DataFrame(
        {
            "fit [s]": of["fit_seconds"].median().map("{:.2g}".format),
            "a velocity [µs]": of["us"].median().map("{:.0f}".format),
            "numbers": of["n_parameters"].median().map("{:.0f}".format),
            "arrival, median": of["arrival"].median().map("{:.3g}".format),
            "arrival, worst": of["arrival"].max().map("{:.3g}".format),
            "command, worst": of["command"].agg(lambda ratios: _brief(ratios.max(skipna=False))),
            "fits that failed": of["error"].apply(lambda errors: str(int((errors != "").sum()))),
        }
    )
    if "claims" in fits:
        claims = fits.dropna(subset=["claims"]).groupby("method")["claims"]
        added = claims.apply(lambda texts: np.array([list(map(int, text.split(" / "))) for text in texts]).sum(0))
        table["certificate"] = added.map(lambda sums: " / ".join(map(str, sums)))
    return table.reindex(list(METHODS)).dropna(how="all").rename_axis("method")


def seed_table(rows: pd.DataFrame) -> pd.DataFrame:
    motions = rows.loc[rows["seed"] > 0, "motion"].unique()
    here = rows[rows["motion"].isin(motions) & rows["method"].isin(DRAWN_AT_RANDOM)]
    lines = {}
    for question in ("own", "unseen"):
        medians = here.groupby(["method", "seed"])[question].median().unstack()
        lines[RANKED[question]] = medians.apply(lambda of: ", ".join(map(_brief, of)), axis=1)
    return pd.DataFrame(lines).reindex([one for one in METHODS if one in DRAWN_AT_RANDOM]).rename_axis("method")


# --- pictures ---------------------------------------------------------------------------------------------------------


def pictures(rows: pd.DataFrame, every: Sequence[Motion], out: Path) -> list[Path]:
    """Draw what there is, as PNG into that folder."""
    first = rows[rows["seed"] == 0]
    figures: dict[str, Figure] = {}
    if "drawn" in first and first["drawn"].notna().any():
        figures["grid"] = grid(first.dropna(subset=["drawn"]), every)
    rankings = {question: ranking for question in RANKED if (ranking := ranking_of(first, question)) is not None}
    figures["ranks"] = rank_picture(rankings)
    figures["time"] = accuracy_over_time(first)
    out.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, figure in figures.items():
        paths.append(out / f"{name}.png")
        figure.savefig(paths[-1], dpi=80 if name == "grid" else 110)
        with Image.open(paths[-1]) as picture:
            picture.convert("RGB").quantize(256).save(paths[-1], optimize=True)  # half of the bytes
    return paths


def grid(drawn: pd.DataFrame, every: Sequence[Motion]) -> Figure:
    """Shapes by methods: streamlines, what was shown, black, what was kept back, grey, and motions."""
    motions = [one for one in every if one.name in set(drawn["motion"])]
    labels = [label for label in METHODS if label in set(drawn["method"])]
    figure = Figure(figsize=(1.75 * len(labels), 1.85 * len(motions) + 0.3), layout="constrained")
    axes = figure.subplots(len(motions), len(labels), squeeze=False)
    at = drawn.set_index(["motion", "method"])["drawn"]
    for across, motion in zip(axes, motions, strict=True):
        x, y = window(motion)
        for ax, label in zip(across, labels, strict=True):
            ax.set(xticks=[], yticks=[], xlim=x[[0, -1]], ylim=y[[0, -1]], aspect="equal")
            if (motion.name, label) in at.index:
                kept = json.loads(at[motion.name, label])
                _draw(ax, motion, x, y, np.array(kept["field"]), np.array(kept["paths"]), plotting.color_of(label))
        across[0].set_ylabel(motion.name, fontsize=8)
    for ax, label in zip(axes[0], labels, strict=True):
        ax.set_title(label, fontsize=8)
    return figure


def _draw(ax: Any, motion: Motion, x: Array, y: Array, field: Array, paths: Array, color: str) -> None:
    u, v = field[..., 0], field[..., 1]
    if np.hypot(u, v).max() > 0:
        ax.streamplot(x, y, u, v, color="#BBBBBB", linewidth=0.4, arrowsize=0.4, density=0.7)
    for one in motion.judges:
        ax.plot(*one.positions.numpy().T, color="#888888", lw=0.6)
    for one in motion.shown:
        ax.plot(*one.positions.numpy().T, color=plotting.SHOWN, lw=0.8)
    for path in paths:
        ax.plot(*path.T, color=color, lw=0.9)
    ax.plot(*motion.shown[0].goal.numpy(), "*", color=plotting.SHOWN, ms=4)


def rank_picture(rankings: Mapping[str, Ranking]) -> Figure:
    """A panel for each question: mean ranks in order, and the critical difference from the best as a band."""
    count = len(rankings)
    figure = Figure(figsize=(2.6 * min(count, 3) + 0.4, 2.6 * -(-count // 3)), layout="constrained")
    panels = figure.subplots(-(-count // 3), min(count, 3), squeeze=False).ravel()
    for ax in panels[count:]:
        ax.set_visible(False)
    for ax, (question, ranking) in zip(panels, rankings.items(), strict=False):
        places = np.arange(len(ranking.mean))
        ax.axvspan(ranking.mean.iloc[0], ranking.mean.iloc[0] + ranking.critical, color="#EEEEEE", lw=0)
        ax.scatter(ranking.mean, places, c=[plotting.color_of(name) for name in ranking.mean.index], s=22, zorder=3)
        ax.set_yticks(places, list(ranking.mean.index), fontsize=7)
        ax.set_title(f"{RANKED[question]}, {ranking.n_motions} motions", fontsize=8)
        ax.tick_params(axis="x", labelsize=7)
        ax.invert_yaxis()
        report.plain(ax, "x")
    figure.supxlabel("mean rank; grey: not told apart from the best", fontsize=8)
    return figure


def accuracy_over_time(first: pd.DataFrame) -> Figure:
    """Median distance over median fitting time, of what was shown and of what was kept back."""
    figure = Figure(figsize=(8.0, 3.6), layout="constrained")
    panels = {question: RANKED[question] for question in ("own", "unseen") if question in first}
    for ax, (question, title) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True):
        fits = first[first["method"].isin(METHODS) & first["protocol"].isin(COUNTED_ONCE) & first[question].notna()]
        for label, of in fits.groupby("method"):
            at = of["fit_seconds"].median(), min(of[question].median(), FARTHEST_DRAWN)
            lost = at[1] == FARTHEST_DRAWN
            ax.scatter(*at, color=plotting.color_of(label), s=24, zorder=3, marker="^" if lost else "o")
            ax.annotate(f"{label}, farther" if lost else label, at, (4, 3), textcoords="offset points", fontsize=7)
        ax.set(xscale="log", yscale="log", xlabel="fit [s], median", title=title)
        ax.set_ylabel("distance [sizes], median")
        report.plain(ax)
    return figure


# --- the page ---------------------------------------------------------------------------------------------------------


def write(path: Path, rows: pd.DataFrame, every: Sequence[Motion], drawn: Sequence[Path]) -> None:
    """Sections and pictures as one HTML file that needs nothing else, in the style of the library's reports. Atomic."""
    style = (Path(latentds_report.__file__).parent / "page.css").read_text(encoding="utf-8")
    body = []
    for section in sections(rows, every):
        body.append(f"<h2>{html.escape(section.title)}</h2>\n<p>{html.escape(section.told).replace('**', '')}</p>")
        if section.table is not None:
            body.append(section.table.fillna("—").replace(r"\*+", "", regex=True).to_html(escape=True))
    for picture in drawn:
        data = base64.b64encode(picture.read_bytes()).decode()
        body.append(f'<p><img alt="{html.escape(picture.stem)}" src="data:image/png;base64,{data}"></p>')
    page = (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>Methods of the field</title>\n'
        f"<style>{style}\nimg {{ max-width: 100% }} table {{ overflow-x: auto }}</style></head>\n"
        f"<body><main><h1>Methods of the field</h1>\n{chr(10).join(body)}\n</main></body></html>\n"
    )
    with atomic_write(path) as file:
        file.write(page.encode())
