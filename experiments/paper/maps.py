"""What the paper sets aside: a graph that sees where points lie, and landmarks carried by a flow (LDDMM)."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import torch
from torch import Tensor

from baselines import LDDMM
from experiments.paper.document import REPRODUCED, Document
from experiments.paper.study import Study
from latentds import ChebyshevDS, LatentDS, StableDS, datasets
from latentds.benchmark import Cell, RolloutProtocol

N_POINTS = 1000
REPEATS = 3
"""Of each timing, whose median counts."""
MAPS: dict[str, Callable[[int], LatentDS]] = {
    "path": ChebyshevDS,
    "neighbours": partial(ChebyshevDS, embedding="neighbours"),
    "LDDMM": LDDMM,
}
"""The paper's embedding by greedy matching, Belkin and Niyogi's likewise, and the paper's by a flow of landmarks."""
PROTOCOL = RolloutProtocol(n_starts=0, n_points=100, fast_dtw=False)
"""No starts but the demonstrated one: rollouts are not what is compared here."""


def maps(study: Study, document: Document) -> None:
    motions = [datasets.drawn(name, N_POINTS) for name in study.plan.strokes] + study.spirals
    cells = [Cell(name, factory, motion, measure=inverted) for motion in motions for name, factory in MAPS.items()]
    frame, _ = study.run(cells, PROTOCOL)
    found = {(row["demonstration"], row["method"]): row for row in frame.to_dict("records") if not row["error"]}
    rows = [{name: found.get((motion.name, name)) for name in MAPS} for motion in motions]
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
        errors = [f"{one['relative_mse']:.1e}" if one else "refused" for one in row.values()]
        both = [
            [f"{one['fit_seconds']:.3g}", f"{one['gap']:.0e}", f"{one['inverse_ms']:.3g}"] if one else ["—"] * 3
            for one in (near, flow)
        ]
        lines.append([motion.name, *errors, *(part for pair in zip(*both, strict=True) for part in pair)])
    timed = [f"{what}, {name}" for what in ("fit, s", "gap", "ψ⁻¹, ms") for name in ("greedy", "LDDMM")]
    document.table(["motion", *(f"MSE, {name}" for name in MAPS), *timed], lines)
    refused = sum(row["neighbours"] is None for row in rows)
    nearer = sum(_nearer(row["neighbours"], row["path"]) for row in rows)
    document.find(
        'A binary path graph: "only N and n are required"',
        "nothing lost",
        f"neighbours are nearer on {nearer} of {len(rows)} motions, and their graph turns back on {refused}",
        REPRODUCED if nearer <= len(rows) // 4 else "in part",
    )
    pairs = [(near, flow) for row in rows if (near := row["path"]) and (flow := row["LDDMM"])]
    slower = statistics.median(flow["inverse_ms"] / near["inverse_ms"] for near, flow in pairs)
    fits = statistics.median(flow["fit_seconds"] / near["fit_seconds"] for near, flow in pairs)
    document.find(
        'LDDMM is "hard to invert"',
        "without numbers",
        f"ψ⁻¹ is off by at most {max(flow['gap'] for _, flow in pairs):.0e} sizes on {len(pairs)} of {len(rows)} "
        f"motions, and takes {slower:.0f} times as long as greedy layers', a fit {fits:.0f} times; nearer on "
        f"{sum(_nearer(flow, near) for near, flow in pairs)}",
        "slow, not hard" if len(pairs) == len(rows) else "in part",
    )


def inverted(ds: StableDS, cell: Cell) -> Mapping[str, float]:
    """For a cell's ``measure``: how near the map comes, and how it inverts, in sizes of the motion."""
    assert isinstance(ds, LatentDS)
    shown = cell.shown[0]
    with torch.no_grad():
        x = ds.encode(shown.positions)
        gap = torch.linalg.vector_norm(ds.encode(ds.decode(x)) - x, dim=-1).max()
        took = statistics.median(_milliseconds(ds.encode, shown.positions) for _ in range(REPEATS))
    report = ds.fit_report
    assert report is not None
    return {"relative_mse": report.mse / shown.size**2, "gap": float(gap) / shown.size, "inverse_ms": took}


def _nearer(one: Mapping[Any, Any] | None, other: Mapping[Any, Any] | None) -> bool:
    return one is not None and other is not None and bool(one["relative_mse"] < other["relative_mse"])


def _milliseconds(call: Callable[[Tensor], Tensor], points: Tensor) -> float:
    began = time.perf_counter()
    call(points)
    return 1e3 * (time.perf_counter() - began)
