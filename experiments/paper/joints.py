"""Table III: motions of a 7-joint arm, made up or from recordings, in the place of those that are not public."""

from __future__ import annotations

from itertools import chain, repeat

from experiments.compared import RIVALS, greedy
from experiments.paper.document import Document
from experiments.paper.study import Study, brief
from experiments.published import TABLE_THREE
from latentds import datasets, plotting
from latentds.benchmark import Cell


def joints(study: Study, document: Document) -> None:
    motions = list(study.recorded) or [datasets.joint_motion(seed) for seed in range(study.plan.arms)]
    chosen = {(d.name, method): study.least_beta(method, d) for d in motions for method in RIVALS}
    cells = [Cell(method, greedy(method, chosen[d.name, method]), d) for d in motions for method in RIVALS]
    rows, paths = study.run(cells, study.protocol(n_starts=0))
    scores = rows.set_index(["demonstration", "method"])
    document.add(
        "The paper's six recordings are not public, so its scores cannot be reproduced; "
        + (
            f"these are {len(motions)} recordings given by `--data`."
            if study.recorded
            else "made-up motions of a 7-joint arm stand in."
        )
        + " Hyperparameters by the paper's rule with the least β; FastDTW (radius 1) of 500 points, raw sums in rad, "
        "from the demonstrated start. The paper names neither the number of points nor the unit."
    )
    printed = chain((f"{case}: {score}" for case, score in TABLE_THREE.items()), repeat("—: nan"))
    lines = []
    for shown, paper in zip(motions, printed, strict=False):
        ours, fdm = ([f"{scores.loc[(shown.name, m), s]:.2f}" for s in ("dtw_fast", "dtw")] for m in RIVALS)
        lines.append([shown.name, paper, *ours, brief(chosen[shown.name, "Chebyshev"]), *fdm])
    header = ["motion", "paper's case (another motion)", "Chebyshev, FastDTW", "exact", "β / μ / M: MSE"]
    document.table([*header, "FDM, FastDTW", "exact"], lines)
    fast = scores.xs("Chebyshev", level="method")["dtw_fast"]
    worst = max(motions, key=lambda shown: fast[shown.name])
    whose = "recordings of the user" if study.recorded else "made-up motions"
    for motion in dict.fromkeys((motions[0], worst)):
        drawn = plotting.joints(motion, {method: paths[method, motion.name, 0] for method in RIVALS})
        document.show(f"joints_{motion.name.replace(' ', '_')}", drawn, f"{motion.name}: joints over time")
    document.find(
        "Table III, 7-D joint space",
        f"FastDTW {min(TABLE_THREE.values())} … {max(TABLE_THREE.values())}",
        f"{fast.min():.2f} … {fast.max():.2f} on {whose}",
        "not reproducible: its recordings are not public",
    )
