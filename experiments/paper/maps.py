"""What the paper sets aside: a graph that sees where points lie, and landmarks carried by a flow (LDDMM)."""

from __future__ import annotations

import statistics
import time
import warnings
from collections.abc import Callable
from typing import NamedTuple

import joblib
import torch
from torch import Tensor

from baselines import LDDMM
from experiments.paper.document import REPRODUCED, Document
from experiments.paper.study import Study
from latentds import ChebyshevDS, Demonstration, FitWarning, LatentDS, datasets

N_POINTS = 1000
REPEATS = 5
"""Of each timing, whose median counts."""
MAPS: dict[str, Callable[[int], LatentDS]] = {
    "path": ChebyshevDS,
    "neighbours": lambda dim: ChebyshevDS(dim, embedding="neighbours"),
    "LDDMM": LDDMM,
}
"""The paper's embedding by greedy matching, Belkin and Niyogi's likewise, and the paper's by a flow of landmarks."""


class Mapped(NamedTuple):
    """What one map is like on one motion; lengths in sizes of the motion."""

    mse: float
    seconds: float
    """of the fit"""
    gap: float
    """the largest distance of ψ⁻¹(ψ(x)) from x on the latent points"""
    inverse: float
    """milliseconds of ψ⁻¹ of all points"""


def maps(study: Study, document: Document) -> None:
    motions = [datasets.drawn(name, N_POINTS) for name in study.plan.strokes] + study.spirals
    found = joblib.Parallel(n_jobs=study.jobs)(joblib.delayed(mapped)(m, name) for m in motions for name in MAPS)
    rows = [dict(zip(MAPS, found[i : i + len(MAPS)], strict=True)) for i in range(0, len(found), len(MAPS))]
    document.add(
        "All at their defaults. *Path* is the paper's graph, of whose samples only the order counts, and *neighbours* "
        "Belkin and Niyogi's, of ten nearest neighbours and the heat kernel, copied and joined as the paper does it; "
        "both are matched greedily by 150 layers. *LDDMM* carries the path's latent points by a geodesic flow of 80 "
        "landmarks (Joshi and Miller). MSE in squares of the size; *gap* is the largest distance of ψ⁻¹(ψ(x)) from x "
        "in sizes, *ψ⁻¹* the milliseconds for all points, beside whatever else the machine did."
    )
    lines = []
    for motion, row in zip(motions, rows, strict=True):
        near, flow = row["path"], row["LDDMM"]
        errors = [f"{one.mse:.1e}" if one else "refused" for one in row.values()]
        both = [
            [f"{one.seconds:.1f}", f"{one.gap:.0e}", f"{one.inverse:.1f}"] if one else ["—"] * 3 for one in (near, flow)
        ]
        lines.append([motion.name, *errors, *(part for pair in zip(*both, strict=True) for part in pair)])
    timed = [f"{what}, {name}" for what in ("fit, s", "gap", "ψ⁻¹, ms") for name in ("greedy", "LDDMM")]
    document.table(["motion", *(f"MSE, {name}" for name in MAPS), *timed], lines)
    refused = sum(row["neighbours"] is None for row in rows)
    nearer = sum(row["neighbours"] is not None and row["neighbours"].mse < row["path"].mse for row in rows)
    document.find(
        'A binary path graph: "only N and n are required"',
        "nothing lost",
        f"neighbours are nearer on {nearer} of {len(rows)} motions, and their graph turns back on {refused}",
        REPRODUCED if nearer <= len(rows) // 4 else "in part",
    )
    pairs = [(row["path"], row["LDDMM"]) for row in rows if row["LDDMM"]]
    slower = statistics.median(flow.inverse / near.inverse for near, flow in pairs)
    fits = statistics.median(flow.seconds / near.seconds for near, flow in pairs)
    document.find(
        'LDDMM is "hard to invert"',
        "without numbers",
        f"ψ⁻¹ is off by at most {max(flow.gap for _, flow in pairs):.0e} sizes on {len(pairs)} of {len(rows)} motions, "
        f"and takes {slower:.0f} times as long as greedy layers', a fit {fits:.0f} times; nearer on "
        f"{sum(flow.mse < near.mse for near, flow in pairs)}",
        "slow, not hard" if len(pairs) == len(rows) else "in part",
    )


def mapped(shown: Demonstration, name: str) -> Mapped | None:
    """How near the map of this name comes, and how it inverts; None if it refuses the motion."""
    torch.set_num_threads(1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FitWarning)
        try:
            ds = MAPS[name](shown.dim).fit(shown)
        except ValueError:
            return None
    report = ds.fit_report
    assert report is not None
    with torch.no_grad():
        x = ds.encode(shown.positions)
        back = ds.encode(ds.decode(x)) - x
        gap = float(torch.linalg.vector_norm(back, dim=-1).max()) / shown.size
        took = statistics.median(_milliseconds(ds.encode, shown.positions) for _ in range(REPEATS))
    return Mapped(report.mse / shown.size**2, report.seconds, gap, took)


def _milliseconds(call: Callable[[Tensor], Tensor], points: Tensor) -> float:
    began = time.perf_counter()
    call(points)
    return 1e3 * (time.perf_counter() - began)
