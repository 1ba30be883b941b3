"""A comparison as one HTML file that needs nothing else: to sort, to switch, to turn and to play, without a network."""

from __future__ import annotations

import base64
import hashlib
import json
import math
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from .. import plotting
from ..arguments import real_array
from ..benchmark import Cell
from ..cell import COLUMNS, joint_name, several
from ..certificate import certify
from ..demonstration import Demonstration
from ..files import atomic_write

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]

ROOM = 900_000
"""Bytes of a file that rollouts may take, beside the 5 MB of Plotly: they are thinned to that."""
FEWEST = 120
"""Points to which a rollout is thinned before some rollouts are left out."""
WIDER = 1.5
"""The picture is a box so many times as wide as the demonstration; rollouts that leave it are counted."""
GAP = -32768
"""Stands for no number among 16-bit positions."""
SURE = 0.01
"""p from which on a difference between methods is called one that chance may make."""
PACKAGES = ("latentds", "torch", "numpy", "scipy", "numba", "fastdtw", "pandas", "joblib")


def write(
    path: str | os.PathLike[str],
    rows: pd.DataFrame,
    demonstrations: Demonstration | Sequence[Demonstration | Sequence[Demonstration]],
    *,
    paths: Mapping[tuple[str, str, int], Any] | None = None,
    settings: Mapping[str, Any] | None = None,
) -> None:
    """Write what :func:`latentds.compare` found as one page of HTML. Atomic.

    The page tells which method follows best in a sentence, ranks them in a table that sorts, and shows their motions:
    to turn, to play over time, each method on or off; with distances, speeds, coordinates over time, certificates and
    settings. It loads nothing, and runs no script but its own, whatever labels and names hold.

    Args:
        path: the file, by custom ``*.html``.
        rows: of ``compare``, or of outcomes of :func:`latentds.benchmark.run`. A column "certificate" (JSON, as
            :func:`findings` gives it) is shown, too.
        demonstrations: those that were compared on, as ``compare`` takes them; they are the judges.
        paths: the rollouts, {(method, demonstration, seed): (B, T, n)}, as ``compare(…, paths=paths)`` fills them; of
            several seeds the first is drawn. Without them the page has no motions but the demonstrated ones.
        settings: what else to tell of how this was made, by name; versions, machine and date are added.

    Raises:
        ValueError: if an argument is none of this, or the demonstrations do not fit the rows.
        ImportError: without plotly and jinja2: ``pip install 'latentds[cli]'``.
    """
    motions = _motions(rows, demonstrations)
    colors = _colors(list(rows["method"].unique()))
    data = {
        "labels": list(colors),
        "colors": list(colors.values()),
        "shown": plotting.SHOWN,
        "motions": [_drawn(motion, rows, paths or {}, list(colors), len(motions)) for motion in motions],
    }
    text = _page(
        title=motions[0].name if len(motions) == 1 else f"{len(motions)} motions",
        verdict=verdict(rows, demonstrations),
        ranking=ranking(rows, demonstrations),
        by_motion=_by_motion(rows, motions, list(colors)) if len(motions) > 1 else [],
        certificates=_certificates(rows),
        settings=_flat({**(settings or {}), **environment()}),
        colors=colors,
        labels=[motion.name for motion in motions],
        starts=max(motion.share - 1 for motion in motions),
        drawn=paths is not None,
        data=data,
    )
    with atomic_write(path) as file:
        file.write(text.encode())


def findings(ds: Any, cell: Cell) -> dict[str, str]:
    """For :class:`~latentds.benchmark.Cell`'s ``measure``: the certificate as JSON, and the notes of the fit."""
    notes = ds.fit_report.notes if ds.fit_report else ()
    return {"certificate": certify(ds).to_json(), "notes": "; ".join(notes)}


def environment() -> dict[str, Any]:
    """Date, versions and kind of machine."""
    return {
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cpu": _cpu(),
        "cores": os.cpu_count(),
        "packages": {name: metadata.version(name) for name in PACKAGES},
    }


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


# What was compared ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Motion:
    """One motion of a comparison: its judges, and how many starts each has."""

    name: str
    shown: tuple[Demonstration, ...]
    share: int

    @property
    def size(self) -> float:
        return max(one.size for one in self.shown)

    def judge(self, start: int) -> Demonstration:
        """The one that a start, by its number, belongs to."""
        return self.shown[start // self.share]


def _motions(rows: pd.DataFrame, demonstrations: Any) -> list[_Motion]:
    if missing := {*COLUMNS} - set(rows):
        raise ValueError(f"rows: expected the columns of compare, got none named {sorted(missing)}")
    if rows.empty:
        raise ValueError("rows: expected at least one")
    items = [demonstrations] if isinstance(demonstrations, Demonstration) else list(demonstrations)
    found = {joint_name(some): some for some in (several(item, "demonstrations") for item in items)}
    names = list(rows["demonstration"].unique())
    if absent := [name for name in names if name not in found]:
        raise ValueError(f"demonstrations: expected those of the rows, got none named {absent[0]!r}")
    motions = []
    for name in names:
        count = int(rows.loc[rows["demonstration"] == name, "start"].max()) + 1
        if count % (judges := len(found[name])):
            raise ValueError(f"demonstrations: expected the judges of {name!r}, got {judges} for {count} starts")
        if "judge" in rows and {*rows.loc[rows["demonstration"] == name, "judge"]} != {d.name for d in found[name]}:
            raise ValueError(f"rows: expected motions judged by those that were shown, got {name!r} judged by others")
        motions.append(_Motion(name, found[name], count // len(found[name])))
    return motions


def _colors(labels: Sequence[str]) -> dict[str, str]:
    """A colour for each: the one that it has in every picture, unless another label here has it already."""
    free = [c for c in (*plotting.OTHERS, *plotting.COLORS.values()) if c not in map(plotting.color_of, labels)]
    colors: dict[str, str] = {}
    for label in labels:
        color = plotting.color_of(label)
        colors[label] = free.pop(0) if color in colors.values() and free else color
    return colors


def _distances(rows: pd.DataFrame, motion: _Motion, label: str) -> tuple[Array, Array]:
    """Exact DTW over points in sizes of the motion, means over seeds: from demonstrated starts, and from the others."""
    of = rows[(rows["demonstration"] == motion.name) & (rows["method"] == label)]
    score = of.groupby("start")["dtw_per_point"].apply(lambda values: values.mean(skipna=False))
    own = score.index.to_numpy() % motion.share == 0
    values = score.to_numpy(dtype=np.float64) / [motion.judge(start).size for start in score.index]
    return values[own], values[~own]


def _level(scores: Array) -> float:
    """The mean; inf where a rollout failed."""
    return float(scores.mean()) if len(scores) and np.isfinite(scores).all() else math.inf


def _spread(scores: Array) -> float:
    return float(scores.std(ddof=1)) if len(scores) > 1 else 0.0


def _judged(own: Array, others: Array) -> Array:
    """What methods are ranked by: starts nobody showed, if there are some."""
    return others if len(others) else own


def ranking(rows: pd.DataFrame, demonstrations: Any) -> list[dict[str, Any]]:
    """A line for each method, the best first; arguments as for :func:`write`.

    Returns:
        Mappings of "method"; "level", "spread" and "worst": mean, standard deviation and largest exact DTW over points,
        in sizes of the motion, from the starts around the demonstrated one (from that if there are no others), means
        over motions; "own" from the demonstrated one; "end", how far motions end from the demonstrated end, in sizes;
        "arrives" and "follows", (how many, of how many) rows converged and fits follow; "seconds" of a fit; "failed"
        rows; "motions".
    """
    motions = _motions(rows, demonstrations)
    lines = []
    for label in rows["method"].unique():
        of = rows[rows["method"] == label]
        known = [motion for motion in motions if (of["demonstration"] == motion.name).any()]
        pairs = [_distances(rows, motion, label) for motion in known]
        judged = [_judged(*pair) for pair in pairs]
        fits = of.groupby(["demonstration", "seed"], sort=False).first()
        sizes = of["demonstration"].map({motion.name: motion.size for motion in motions})
        lines.append(
            {
                "method": label,
                "level": float(np.mean([_level(scores) for scores in judged])),
                "own": float(np.mean([_level(own) for own, _ in pairs])),
                "spread": float(np.mean([_spread(scores) for scores in judged])),
                "worst": float(np.max([scores.max() for scores in judged])),
                "end": float((of["endpoint_error"] / sizes).mean(skipna=False)),
                "arrives": (int(of["converged"].sum()), len(of)),
                "follows": (int(fits["follows"].sum()), len(fits)),
                "seconds": float(fits["fit_seconds"].mean()),
                "failed": int((of["status"] != "ok").sum()),
                "motions": len(known),
            }
        )
    return sorted(lines, key=lambda line: (-line["motions"], line["level"]))


def _by_motion(rows: pd.DataFrame, motions: Sequence[_Motion], labels: Sequence[str]) -> list[dict[str, Any]]:
    lines = []
    for motion in motions:
        scores = {label: _judged(*_distances(rows, motion, label)) for label in labels}
        levels = {label: _level(found) for label, found in scores.items()}
        best = min(levels.values())
        cells = [
            {"level": level, "spread": _spread(scores[label]), "best": level == best} for label, level in levels.items()
        ]
        lines.append({"name": motion.name, "cells": cells})
    return lines


# What it says --------------------------------------------------------------------------------------------------------


def percent(share: float) -> str:
    """Two figures; a dash for none."""
    if not math.isfinite(share):
        return "—"
    return f"{100 * share:.2g} %" if 100 * share < 99.5 else f"{100 * share:.0f} %"


def verdict(rows: pd.DataFrame, demonstrations: Any) -> list[str]:
    """Sentences: which method follows best, by how much, whether that may be chance, and what is off.

    Arguments as for :func:`write`.
    """
    motions, lines = _motions(rows, demonstrations), ranking(rows, demonstrations)
    best, *others = lines
    what = motions[0].name if len(motions) == 1 else f"{len(motions)} motions"
    count = max(motion.share for motion in motions) - 1
    where = f"from {count} starts around the demonstrated one" if count else "from the demonstrated start"
    if not math.isfinite(best["level"]):
        said = [f"No method moves through all of {what}: rollouts fail or diverge."]
    elif not others:
        follows = best["follows"][0] == best["follows"][1]
        verb = "follows" if follows else "does not follow as it should"
        said = [
            f"{best['method']} {verb}: {what}, at a mean distance of {percent(best['own'])} of the motion's size "
            f"from the demonstrated start" + (f", {percent(best['level'])} {where}." if count else ".")
        ]
    else:
        second = others[0]
        said = [
            f"{best['method']} follows {what} best: {percent(best['level'])} of the motion's size away on the mean "
            f"{where}, before {second['method']} with {percent(second['level'])}"
            f"{_certainty(best, second, motions, rows)}."
        ]
    notes = [note for text in rows.get("notes", []) if isinstance(text, str) for note in text.split("; ") if note]
    if len(lines) == 1 and notes:
        said.append(f"Noted: {'; '.join(dict.fromkeys(notes))}.")
    for line in lines:
        arrived, of = line["arrives"]
        if line["failed"]:
            said.append(f"{line['method']}: {line['failed']} of {of} motions fail or diverge.")
        elif arrived < of:
            said.append(f"{line['method']}: {of - arrived} of {of} motions do not arrive at the goal.")
        followed, fits = line["follows"]
        if followed < fits and len(lines) > 1:
            told = f"{fits - followed} of {fits} fits, by its own measurement"
            said.append(f"{line['method']} does not follow in {told}.")
    false = {(one["method"], claim) for one in _certificates(rows) for claim in one["false"]}
    return said + [f"{method}: the certificate found false that {claim}." for method, claim in sorted(false)]


def _certainty(
    best: Mapping[str, Any], second: Mapping[str, Any], motions: Sequence[_Motion], rows: pd.DataFrame
) -> str:
    """Of one motion, whether chance may make the difference; of several, on how many it is the nearest."""
    if not math.isfinite(second["level"]):
        return ""
    pairs = [[_judged(*_distances(rows, m, line["method"])) for line in (best, second)] for m in motions]
    if len(motions) > 1:
        ahead = sum(_level(first) < _level(other) for first, other in pairs)
        return f", and nearer than that on {ahead} of {len(motions)}"
    ((first, other),) = pairs
    if len(first) < 3 or len(first) != len(other) or (first == other).all():
        return ""
    p = float(stats.ttest_rel(first, other).pvalue)
    told = f"p = {p:.1g}, paired t-test over the {len(first)} starts"
    return f" ({told})" if p < SURE else f", a difference that chance may make ({told})"


def _certificates(rows: pd.DataFrame) -> list[dict[str, Any]]:
    """What each fit's certificate says; of several seeds the first one's."""
    if "certificate" not in rows:
        return []
    found = []
    for (name, label), of in rows.groupby(["demonstration", "method"], sort=False):
        text = of["certificate"].iloc[0]
        if isinstance(text, str):
            told = json.loads(text)
            lines = told["lines"]
            counts = [[line["verdict"] for line in lines].count(kind) for kind in ("proven", "not falsified")]
            false = [line["claim"] for line in lines if line["verdict"] == "falsified"]
            found.append({"motion": name, "method": label, "counts": counts, "false": false, "lines": lines})
    return found


def _flat(settings: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """Names and texts, a line each; the innermost mappings in one."""
    lines: list[tuple[str, str]] = []
    for key, value in settings.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping) and any(isinstance(inside, Mapping) for inside in value.values()):
            lines += _flat(value, f"{name} · ")
        elif isinstance(value, Mapping):
            lines.append((name, ", ".join(f"{part} {inside}" for part, inside in value.items())))
        else:
            lines.append((name, ", ".join(map(str, value)) if isinstance(value, (list, tuple)) else str(value)))
    return lines


# What it draws -------------------------------------------------------------------------------------------------------


def _drawn(
    motion: _Motion,
    rows: pd.DataFrame,
    paths: Mapping[tuple[str, str, int], Any],
    labels: Sequence[str],
    n_motions: int,
) -> dict[str, Any]:
    """A motion and its rollouts as numbers for the page."""
    first = motion.shown[0]
    moved: dict[str, Array] = {}
    for (label, name, _), batch in paths.items():
        if name == motion.name and label in labels and label not in moved:
            array = real_array(batch, "paths")
            if array.shape[::2] != (motion.share * len(motion.shown), first.dim):
                wanted = f"({motion.share * len(motion.shown)}, T, {first.dim})"
                raise ValueError(f"paths: expected {wanted} for {label!r} and {name!r}, got {array.shape}")
            moved[label] = array
    count, some = _thinned(motion, n_motions * (1 + len(labels)))
    n_points = min((len(batch[0]) for batch in moved.values()), default=500)
    grid = _grid(first, min(count, n_points), n_points)
    chosen = np.unique(np.linspace(1, motion.share - 1, some).round().astype(int)) if some else np.empty(0, int)
    starts = np.concatenate([i * motion.share + np.r_[0, chosen] for i in range(len(motion.shown))]).astype(int)
    shown = np.stack([one.at(grid * one.duration) for one in motion.shown])
    middle, half = (shown.min((0, 1)) + shown.max((0, 1))) / 2, motion.size / 2 * WIDER
    low, high = middle - half, middle + half
    return {
        "name": motion.name,
        "columns": list(first.columns) or _axes(first.dim),
        "dim": first.dim,
        "durations": [motion.judge(int(start)).duration for start in starts],
        "own": (starts % motion.share == 0).tolist(),
        "low": low.tolist(),
        "high": high.tolist(),
        "grid": _packed(grid, "<f4"),
        "shown": _packed(_quantized(shown, low, high), "<i2"),
        "shown_durations": [one.duration for one in motion.shown],
        "shown_speed": _packed(_speed(first.velocities.numpy(), first.times.numpy() / first.duration, grid), "<f4"),
        "starts": {"drawn": len(starts), "of": motion.share * len(motion.shown)},
        "methods": [
            _rollouts(moved[label], starts, grid, first.duration, low, high) if label in moved else None
            for label in labels
        ],
        "scores": [
            {"own": _finite(own), "others": _finite(others)}
            for own, others in (_distances(rows, motion, label) for label in labels)
        ],
    }


def _thinned(motion: _Motion, parts: int) -> tuple[int, int]:
    """Points of each rollout, and rollouts beside each demonstrated start, for which ``parts`` parts of ROOM do."""
    room = ROOM * 3 / 4 / 2 / parts / motion.shown[0].dim / len(motion.shown)
    some = motion.share - 1
    if room / (1 + some) < FEWEST:
        some = max(0, min(some, int(room / FEWEST) - 1))
    return max(2, int(room / (1 + some))), some


def _grid(shown: Demonstration, count: int, n_points: int) -> Array:
    """``count`` of ``n_points`` shares of the duration: half of them even in time, half of them even along the path."""
    even = np.linspace(0, 1, n_points)
    if count >= n_points:
        return even
    steps = np.linalg.norm(np.diff(shown.at(even * shown.duration), axis=0), axis=1)
    passed = even + np.concatenate([[0.0], np.cumsum(steps)]) / steps.sum()
    return even[np.unique(np.searchsorted(passed, np.linspace(0, passed[-1], count)).clip(0, n_points - 1))]


def _rollouts(
    batch: Array, starts: NDArray[Any], grid: Array, duration: float, low: Array, high: Array
) -> dict[str, Any]:
    even = np.linspace(0, 1, batch.shape[1])
    nearest = np.searchsorted(even, grid - 1e-9).clip(0, len(even) - 1)
    with np.errstate(all="ignore"):
        velocities = np.gradient(batch[0], duration / (len(even) - 1), axis=0)
        inside = np.all((batch >= low) & (batch <= high), axis=(1, 2))
    return {
        "paths": _packed(_quantized(batch[starts][:, nearest], low, high), "<i2"),
        "speed": _packed(_speed(velocities, even, grid), "<f4"),
        "gone": int((~inside).sum()),
    }


def _speed(velocities: Array, shares: Array, grid: Array) -> Array:
    with np.errstate(all="ignore"):
        speed: Array = np.interp(grid, shares, np.linalg.norm(velocities, axis=1))
    return speed


def _quantized(values: Array, low: Array, high: Array) -> NDArray[np.int16]:
    """Points (..., n) of a box as 16-bit numbers; a point outside it is a gap in all its coordinates."""
    with np.errstate(invalid="ignore"):
        inside = np.all((values >= low) & (values <= high), axis=-1, keepdims=True)
        share = np.where(inside, (values - low) / (high - low), 0.0)
    whole: NDArray[np.int16] = np.where(inside, np.round(65534 * share) - 32767, GAP).astype(np.int16)
    return whole


def _packed(values: NDArray[Any], dtype: str) -> str:
    return base64.b64encode(np.ascontiguousarray(values, dtype=dtype).tobytes()).decode()


def _finite(scores: Array) -> list[float | None]:
    """For JSON, in percent."""
    return [round(100 * float(score), 6) if math.isfinite(score) else None for score in scores]


def _axes(dim: int) -> list[str]:
    return list("xyz"[:dim]) if dim <= 3 else [f"y{i + 1}" for i in range(dim)]


# The page ------------------------------------------------------------------------------------------------------------


def _page(**told: Any) -> str:
    try:
        from jinja2 import Environment, StrictUndefined
        from markupsafe import Markup
        from plotly.offline import get_plotlyjs
    except ImportError as error:
        raise ImportError(f"reports need {error.name}: pip install 'latentds[cli]'") from error
    here = Path(__file__).parent
    style, script = ((here / f"page.{kind}").read_text(encoding="utf-8") for kind in ("css", "js"))
    plotly = get_plotlyjs()
    hashes = [base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in (plotly, script)]
    pages = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    pages.policies["json.dumps_kwargs"] = {"allow_nan": False}
    pages.filters["percent"] = percent
    page = pages.from_string((here / "page.html").read_text(encoding="utf-8"))
    return page.render(
        style=Markup(style),
        script=Markup(script),
        plotly=Markup(plotly),
        allowed=" ".join(f"'sha256-{value}'" for value in hashes),
        **told,
    )
