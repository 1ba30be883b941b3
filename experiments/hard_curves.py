"""Curves that are hard to learn from, and which of them a method follows from their start with its default settings.

    python -m experiments.hard_curves [--quick] [--out results/hard-curves]

Prints a line per curve and per kind of them, and leaves rows.csv in ``--out``. "Follows" means: from the demonstrated
start, the exact DTW to the curve without its noise over 400 points is within 1 % of its size. A miss that no note tells
is a silent one.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import pandas as pd
import torch
import typer

from experiments import report
from latentds import Demonstration, FitWarning, TubeDS, datasets, metrics
from latentds.arguments import Array
from latentds.curves import evenly_resampled, extent, interpolated
from latentds.methods.tube import TubeReport

LARGEST_MISS = 0.01
"""Exact DTW per point, in sizes of the motion, up to which a rollout follows."""
ROLLOUT_POINTS = 400
REFUSED = "refused: "
"""How the note of a curve that no fit takes begins."""
KINDS = {
    "noise": ("noise",),
    "steps": ("quantised",),
    "few or many points": ("points",),
    "spiral": ("spiral", "stable c="),
    "knot": ("knot",),
    "Lissajous": ("Lissajous",),
    "near crossing": ("eight in space", "loop-the-loop"),
    "nearly closed": ("circle",),
    "turning back": ("hook", "hairpin", "switchbacks"),
    "helix": ("helix",),
    "wave": ("sine", "wave"),
    "random": ("random",),
}
"""Words of the names of each kind of curve; the first that fits."""


class Curve(NamedTuple):
    """A demonstration, and the motion that it shows without what spoils it."""

    shown: Demonstration
    clean: Demonstration


def curves(seed: int = 0) -> Iterator[Curve]:
    """All of them, in the same order for the same seed; the seed draws noise, planes and random curves."""
    draw = np.random.default_rng(seed)
    for name, path, recorded in chain(((name, path, path) for name, path in _paths(draw)), _spoiled(draw)):
        yield Curve(_shown(recorded, name), _shown(path, name))


def _shown(path: Array, name: str) -> Demonstration:
    return Demonstration(torch.from_numpy(np.ascontiguousarray(path)), 5 / (len(path) - 1), name)


def _even(count: int = 1000) -> Array:
    return np.linspace(0, 1, count)


def _columns(*columns: Array) -> Array:
    return np.stack(columns, axis=1)


def _paths(draw: np.random.Generator) -> Iterator[tuple[str, Array]]:
    t = _even()
    for gap in (1e-1, 1e-2, 1e-3, 1e-4):
        angle = 2 * np.pi * (0.9 * t + 0.02)
        yield f"eight in space, gap {gap:g}", _columns(np.sin(angle), np.sin(2 * angle) / 2, gap * t)
    angle = 2 * np.pi * 0.97 * t + 0.1
    yield "eight in space, gap 1e-3, from the far end", _columns(np.cos(angle), np.sin(2 * angle), 1e-3 * np.sin(angle))
    for turns, height in ((5.0, 1.0), (10.0, 2.0), (20.0, 2.0), (30.0, 2.0), (30.0, 6.0)):
        angle = 2 * np.pi * turns * t
        yield f"helix, {turns:g} turns, {height:g} high", _columns(np.cos(angle), np.sin(angle), height * t)
    for gap in (1e-1, 1e-2, 1e-3):
        angle = 2 * np.pi * (1 - gap) * t
        yield f"circle open by {gap:g}", _columns(np.cos(angle), np.sin(angle))
    angle = 2 * np.pi * 0.99 * t
    plane = np.linalg.qr(draw.standard_normal((7, 2)))[0]
    yield "circle open by 0.01, in 7-D", _columns(np.cos(angle), np.sin(angle)) @ plane.T
    for back in (0.5, 0.9, 0.99):
        bend = np.interp(t, [0, 0.45, 0.55, 1], [0, 0, np.pi, np.pi])
        hook = np.cumsum(_columns(np.cos(bend), np.sin(bend)), axis=0)
        yield f"hook, {back:g} of the way back", hook[: int(len(t) * (0.55 + 0.45 * back))]
    for turns in (1.5, 3.0, 5.0):
        for inward in (True, False):
            radius, angle = 0.05 + 0.95 * t, 2 * np.pi * turns * t
            spiral = _columns(radius * np.cos(angle), radius * np.sin(angle))
            yield f"planar spiral, {turns:g} turns {'in' if inward else 'out'}", spiral[::-1] if inward else spiral
    yield "planar spiral, 5 turns in, evenly", evenly_resampled(spiral[::-1], len(spiral))
    yield "paper's Archimedean spiral", datasets.archimedean_spiral().positions.numpy()
    way = _even(600)
    arm = way[:, None] * _columns(np.cos(5 * np.pi * way), np.sin(5 * np.pi * way))
    yield "planar spiral in and out", np.concatenate([arm[:0:-1], -arm])
    angle = 2 * np.pi * 0.98 * t
    yield "Lissajous 3:4:5", _columns(np.sin(3 * angle), np.sin(4 * angle + 0.4), np.sin(5 * angle + 1.1))
    yield "Lissajous 5:7:8", _columns(np.cos(5 * angle), np.cos(7 * angle + 0.7), np.cos(8 * angle + 0.2))
    for p, q in ((2, 3), (2, 5), (3, 4)):
        ring = 2 + np.cos(q * angle)
        knot = _columns(ring * np.cos(p * angle), ring * np.sin(p * angle), np.sin(q * angle))
        yield f"torus knot {p}, {q}, opened", knot
    ring = 2 + np.cos(2 * angle)
    yield "figure-eight knot, opened", _columns(ring * np.cos(3 * angle), ring * np.sin(3 * angle), np.sin(4 * angle))
    for apart in (0.1, 0.02, 0.005):
        knots = np.array([[0, 0], [1, 0], [1, apart], [0, apart]])
        yield f"hairpin, {apart:g} apart", _rounded(knots, 1000)
    fold = np.array([[x, y] for k in range(8) for x, y in (((0, 1)[k % 2], 0.1 * k), ((1, 0)[k % 2], 0.1 * k))], float)
    yield "eight switchbacks", _rounded(fold, 1500)
    yield "sine, 15 periods", _columns(3 * t, 0.3 * np.sin(30 * np.pi * t))
    yield "sine, 15 periods, steep", _columns(t, 0.3 * np.sin(30 * np.pi * t))
    yield "sine, 15 periods, in 3-D", _columns(2 * t, 0.3 * np.sin(30 * np.pi * t), 0.3 * np.sin(16 * np.pi * t))
    yield "sine, in 1-D, slowing", 1 - np.square(1 - t)[:, None]
    yield "square wave", _rounded(np.array([[k // 2, (k + 1) // 2 % 2] for k in range(12)], float), 1000, 0.0)
    angle = 2 * np.pi * np.clip(3 * t - 1, 0, 1)
    yield "loop-the-loop, 1e-2 apart", _columns(3 * t + np.sin(angle), 1 - np.cos(angle), 0.01 * t)
    yield "unstable c=15", datasets.unstable_spiral(15).positions.numpy()
    yield "stable c=7", datasets.stable_spiral(7).positions.numpy()
    for dim in (2, 5, 10, 20, 30):
        yield f"random, {dim}-D", _random(dim, 3, 1000, draw)
    yield "random, 10-D, 8 bends", _random(10, 8, 1000, draw)
    for count in (3, 4, 5, 8):
        yield f"{count} points", _random(3, 1, count, draw)
    yield "20 points of a spiral", datasets.unstable_spiral(3, 20).positions.numpy()
    yield "200000 points", datasets.unstable_spiral(3, 200_000).positions.numpy()
    rests = np.interp(_even(20_000), [0, 0.2, 0.4, 0.6, 0.8, 1], [0, 0, 0.5, 0.5, 1, 1])
    yield "20000 points, rests", _columns(np.cos(4 * rests), np.sin(4 * rests), rests)


def _spoiled(draw: np.random.Generator) -> Iterator[tuple[str, Array, Array]]:
    """(name, motion, as it was recorded)."""
    t = _even()
    arc = _columns(np.cos(4 * t), np.sin(4 * t))
    wave = _columns(2 * t, 0.4 * np.sin(6 * np.pi * t), 0.2 * np.cos(5 * t))
    spiral = datasets.unstable_spiral(7).positions.numpy()
    for share in (0.001, 0.01, 0.05):
        for name, path in (("arc", arc), ("wave in 3-D", wave), ("unstable c=7", spiral)):
            yield f"{name}, {share:.1%} noise", path, path + share * extent(path) * draw.standard_normal(path.shape)
    for share in (0.01, 0.05):
        for name, path in (("arc", arc), ("wave in 3-D", wave)):
            step = share * extent(path)
            yield f"{name}, quantised to {share:.0%}", path, step * np.round(path / step)


def _rounded(knots: Array, count: int, share: float = 0.01) -> Array:
    """Straight from knot to knot, at even speed, with corners rounded over that share of the way."""
    fine = evenly_resampled(interpolated(_even(count), _even(len(knots)), knots), count)
    width = max(1, int(share * count))
    padded = np.concatenate([np.repeat(fine[:1], width, 0), fine, np.repeat(fine[-1:], width, 0)])
    kernel = np.hanning(2 * width + 1) + (width == 1)
    smooth = np.stack([np.convolve(column, kernel / kernel.sum(), "valid") for column in padded.T], axis=1)
    smooth[[0, -1]] = fine[[0, -1]]
    return np.asarray(smooth if share else fine)


def _random(dim: int, bends: int, count: int, draw: np.random.Generator) -> Array:
    t = _even(count)[:, None]
    waves = [
        draw.standard_normal(dim) * np.sin(np.pi * k * t + draw.uniform(0, 6.28, dim)) for k in range(1, bends + 2)
    ]
    return np.asarray(sum(waves) + 2 * t * draw.standard_normal(dim))


def row(curve: Curve) -> dict[str, Any]:
    """What became of one curve."""
    shown, clean = curve
    began = time.perf_counter()
    about: dict[str, Any] = {"curve": shown.name, "kind": kind_of(shown.name), "dim": shown.dim, "points": len(shown)}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FitWarning)  # the row tells it
            ds = TubeDS(shown.dim).fit(shown)
    except ValueError as error:
        return about | {"follows": False, "seconds": time.perf_counter() - began, "note": f"{REFUSED}{error}"}
    seconds = time.perf_counter() - began
    times = np.linspace(0, clean.duration, ROLLOUT_POINTS)
    with torch.no_grad():
        path = ds.rollout(shown.start, torch.from_numpy(times)).numpy()
    missed = metrics.dtw(path, clean.at(times)) / ROLLOUT_POINTS / clean.size
    fit = ds.fit_report
    assert isinstance(fit, TubeReport)
    assert fit.fidelity is not None
    return about | {
        "n_layers": fit.n_layers,
        "miss": missed,
        "nearby": fit.fidelity.nearby,
        "follows": missed <= LARGEST_MISS,
        "seconds": seconds,
        "homotopy": fit.homotopy,
        "condition": fit.condition_path,
        "note": "; ".join(fit.notes),
    }


def kind_of(name: str) -> str:
    return next(kind for kind, words in KINDS.items() if any(word in name for word in words))


def by_kind(table: pd.DataFrame) -> pd.DataFrame:
    """A row per kind: how many curves follow, miss and say so, miss silently, are refused; median seconds of a fit."""
    note, follows = table["note"], table["follows"].astype(bool)
    refused = note.str.startswith(REFUSED)
    became = {
        "follow": follows,
        "miss, noted": ~follows & ~refused & note.ne(""),
        "miss silently": ~follows & note.eq(""),
        "refused": refused,
    }
    kinds = table["kind"]
    counts = pd.DataFrame(became).groupby(kinds, sort=False).sum()
    return counts.assign(**{"median seconds": table["seconds"].groupby(kinds, sort=False).median()})


def main(
    quick: Annotated[bool, typer.Option(help="Every sixth curve.")] = False,
    only: Annotated[str, typer.Option(help="Curves whose name holds this.")] = "",
    seed: Annotated[int, typer.Option(min=0, help="Of noise, planes and random curves.")] = 0,
    out: Annotated[Path, typer.Option(help="Folder for rows.csv.")] = Path("results/hard-curves"),
) -> None:
    """Fit TubeDS to curves that are hard to learn from."""
    rows = []
    for curve in [c for c in list(curves(seed))[:: 6 if quick else 1] if only in c.shown.name]:
        rows.append(row(curve))
        print(", ".join(f"{key} {v:.3g}" if isinstance(v, float) else f"{v}" for key, v in rows[-1].items()))
    table = pd.DataFrame(rows)
    out.mkdir(parents=True, exist_ok=True)
    report.write(out / "rows.csv", table.to_csv(index=False))
    kinds = by_kind(table)
    print(f"\n{kinds.to_string(float_format='{:.1f}'.format)}\n")
    took = f"{table['seconds'].median():.1f} s in the median, {table['seconds'].max():.1f} s at most"
    counts = kinds.sum().astype(int)
    print(f"{counts['follow']} of {len(table)} follow; {counts['miss silently']} miss silently; fits took {took}")


if __name__ == "__main__":
    typer.run(main)
