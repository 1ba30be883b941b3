"""What each section needs to know, computed: one line of a frame for each line of its table."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from operator import attrgetter
from typing import Any

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray

from experiments import compared, report
from experiments.compared import RIVALS, greedy
from experiments.paper import tuning, variants
from experiments.paper.held_out import held_out
from experiments.paper.study import SDS_EF, Study, paths, rows
from experiments.published import TABLE_ONE, TABLE_TWO, Size
from experiments.report import mean_or_inf, welch
from latentds import Demonstration, StableDS, datasets, metrics
from latentds.benchmark import Cell, Outcome
from latentds.fitting.tuning import choose

Array = NDArray[np.float64]

NEAR = 0.05
"""Radius of the ball of starts in the plane, in sizes of the motion; the paper's 0.1 on the spirals' sphere."""


def table_one() -> pd.DataFrame:
    """MSE at the paper's own hyperparameters, beside the paper's."""
    lines = []
    for name in TABLE_ONE["Chebyshev"]:
        for method in RIVALS:
            paper = TABLE_ONE[method][name]
            ours = tuning.trace(method, compared.spiral(name), paper.beta, paper.mu, [paper.n_layers])[0]
            lines.append({"spiral": name, "method": method, "paper": paper, "ours": ours, "ratio": ours / paper.mse})
    return pd.DataFrame(lines)


def tuned(study: Study) -> pd.DataFrame:
    """What the paper's rule chooses; ``fewer``: whether that is good with at most the paper's layers, None without."""
    lines = []
    for shown in study.spirals:
        for method in RIVALS:
            grid, more = study.tried(method, shown)
            choice, paper = choose(grid), TABLE_ONE[method].get(shown.name)
            lines.append(
                {
                    "spiral": shown.name,
                    "method": method,
                    "paper": paper,
                    "choice": choice,
                    "with TPE": choose([*grid, *more]).least_mse.n_layers,
                    "fewer": paper and choice.good and choice.least_mse.n_layers <= paper.n_layers,
                }
            )
    return pd.DataFrame(lines).astype({"fewer": object})


def table_two(study: Study) -> pd.DataFrame:
    """Test MSE of SDS-EF, and the best of a grid; ``ratio`` to the paper's where sizes are the paper's, else NaN."""
    plan, lines = study.plan, []
    official = study.rows[(study.rows["method"] == SDS_EF[1]) & (study.rows["start"] == 0)].set_index("demonstration")
    sizes = list(itertools.product(plan.layers, plan.features))
    grid = [held_out(shown, *size, plan.epochs) for shown in study.spirals for size in sizes]
    tried = rows(study.run(grid, study.protocol(n_starts=0))).set_index(["demonstration", "method"])["mse"]
    for shown in study.spirals:
        printed, row = TABLE_TWO.get(shown.name), official.loc[shown.name]
        known = [Size(*size, tried[shown.name, cell.method]) for size, cell in zip(sizes, grid, strict=False)]
        good = [size for size in known if np.isfinite(size.mse)]
        compared = printed is not None and plan.printed
        lines.append(
            {
                "spiral": shown.name,
                "paper": printed,
                "ours": Size(*(printed[:2] if printed and compared else plan.official), row["mse"]),
                "ratio": row["mse"] / printed.mse if printed and compared else np.nan,
                "best": min(good, key=attrgetter("mse"), default=Size(0, 0)),
                "path length": row["path_length_ratio"],
            }
        )
    return pd.DataFrame(lines)


def similarity(fast: Mapping[str, Mapping[str, Array]], exact: Mapping[str, Mapping[str, Array]]) -> pd.DataFrame:
    """Of FastDTW and exact DTW, {spiral: {method: scores}}: who is nearer, and p-values of the two rivals."""
    return pd.DataFrame(
        [
            {
                "spiral": name,
                "fast": welch(*(of[method] for method in RIVALS)),
                "exact": welch(*(exact[name][method] for method in RIVALS)),
                "paired": report.paired(*(exact[name][method] for method in RIVALS)),
                "lower": min(RIVALS, key=lambda method, of=of: mean_or_inf(of[method])),  # type: ignore[misc]
                "nearer": mean_or_inf(of["Chebyshev"]) < mean_or_inf(of["FDM"]),
                "best": min(of, key=lambda method, of=of: mean_or_inf(of[method])),  # type: ignore[misc]
            }
            for name, of in fast.items()
        ]
    )


def parameters(study: Study) -> pd.DataFrame:
    """Layers that the rule needs, and parameters that SDS-EF has."""
    first = study.rows[study.rows["start"] == 1].set_index(["demonstration", "method"])["n_parameters"]
    lines = []
    for shown in study.spirals:
        choices = {method: study.choice(method, shown) for method in RIVALS}
        line: dict[str, Any] = {"spiral": shown.name, "a layer": 2 * shown.dim + 1}
        line |= {method: choice.least_mse.n_layers for method, choice in choices.items()}
        line |= {f"{method} good": choice.good for method, choice in choices.items()}
        lines.append(line | {method: int(first[shown.name, method]) for method in SDS_EF})
    return pd.DataFrame(lines)


def planes(study: Study) -> tuple[pd.DataFrame, list[Demonstration], dict[str, dict[str, StableDS]]]:
    """Scores in sizes of the motion, and how far the paper's attractor is off; the motions drawn; what is fitted."""
    drawn = [datasets.archimedean_spiral(), *(datasets.drawn(name) for name in study.plan.strokes)]
    written = compared.handwriting() if study.plan.lasa else {}
    lines, fitted = [], {}
    for shown in [*drawn, *(written[shape][0] for shape in study.plan.lasa if written)]:
        chosen = {method: tuning.setting(study.choice(method, shown).least_beta) for method in RIVALS}
        cells = [Cell(method, greedy(method, setting), shown) for method, setting in chosen.items()]
        outcomes = study.run(cells, study.protocol(radius=NEAR * shown.size))
        near = rows(outcomes).query("start > 0").groupby("method")["dtw_per_point"]
        line: dict[str, Any] = {"motion": shown.name, "chosen": chosen}
        for method, setting in chosen.items():
            off = variants.Variant(greedy(method, setting, pinned=False)(shown.dim), printed=True).fit(shown).attractor
            line[f"{method} off"] = float(torch.linalg.vector_norm(off - shown.goal)) / shown.size
            line[method] = near.get_group(method).to_numpy() / shown.size
        lines.append(line | {"p": welch(*(line[method] for method in RIVALS))})
        if shown in drawn:
            fitted[shown.name] = {cell.method: cell.factory(2).fit(shown) for cell in cells}
    return pd.DataFrame(lines), drawn, fitted


def joints(study: Study) -> tuple[pd.DataFrame, list[Demonstration], list[Outcome]]:
    """FastDTW and exact DTW of both rivals from the demonstrated start; the motions; their rollouts."""
    shown = list(study.recorded) or [datasets.joint_motion(seed) for seed in range(study.plan.arms)]
    chosen = {d.name: {method: tuning.setting(study.choice(method, d).least_beta) for method in RIVALS} for d in shown}
    cells = [Cell(method, greedy(method, setting), d) for d in shown for method, setting in chosen[d.name].items()]
    outcomes = study.run(cells, study.protocol(n_starts=0))
    found = rows(outcomes).set_index(["demonstration", "method"])
    scored = [(method, score) for method in RIVALS for score in ("dtw_fast", "dtw")]
    lines = [
        {"motion": d.name, "chosen": chosen[d.name]} | {f"{m} {s}": found.loc[(d.name, m), s] for m, s in scored}
        for d in shown
    ]
    return pd.DataFrame(lines), shown, outcomes


def sensitivity(study: Study) -> pd.DataFrame:
    """Scores of both rivals under each change; ``turned``: another is nearer than in the first line of its spiral."""
    names = study.plan.sensitive
    settings = {name: {method: study.setting(method, compared.spiral(name)) for method in RIVALS} for name in names}
    protocol = study.protocol()
    outcomes = study.run(variants.cells(settings), protocol)
    near = rows(outcomes).query("start > 0").groupby(["demonstration", "method"])
    lines: list[dict[str, Any]] = []

    def of(name: str, change: str, score: str = "dtw") -> list[Array]:
        return [near.get_group((name, f"{method} | {change}"))[score].to_numpy() for method in RIVALS]

    for name in names:
        first = variants.CHANGES[0].name
        reference = protocol.reference(compared.spiral(name))
        moved = paths(outcomes, name, [f"{method} | {first}" for method in RIVALS]).values()
        found = {
            f"{first}: exact DTW": of(name, first),
            "FastDTW, radius 1": of(name, first, "dtw_fast"),
            "FastDTW, radius 5": [np.array([metrics.fast_dtw(p, reference, 5) for p in some[1:]]) for some in moved],
            "exact DTW over each rollout's own length": [
                s / r for s, r in zip(of(name, first), of(name, first, "path_length_ratio"), strict=True)
            ],
        }
        for change in variants.CHANGES[1:]:
            if (name, f"{RIVALS[0]} | {change.name}") in near.groups:
                found[change.name] = of(name, change.name)
        nearer = [mean_or_inf(one) < mean_or_inf(other) for one, other in found.values()]
        for (what, both), here in zip(found.items(), nearer, strict=True):
            line = {"spiral": name, "change": what, "nearer": RIVALS[not here], "p": welch(*both)}
            lines.append(line | {"turned": here != nearer[0]} | dict(zip(RIVALS, both, strict=True)))
    return pd.DataFrame(lines)
